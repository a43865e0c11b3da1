"""Orthographic height maps from a depth image or from the true geometry.

A height map answers "how high is the scene above (x, y)?", which is all that a straight descent
has to know. Its frame V is the world, or the world turned so that a hand which comes from another
side comes down along -z of V (`tilted_view`); the table is a slope there. `local_maxima` finds the
peaks of such a map, or of any image. This module knows no simulator and no network.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import cv2
import numpy as np

from utils.depth import (
    HOLE_REACH,
    at_edges,
    depth_of_plane,
    near_side,
    nearest_values,
    reach_in_pixels,
)
from utils.geometry import ConvexSolid, SceneGeometry, Workspace, intersect_lines
from utils.transforms import (
    RGBDFrame,
    deproject,
    inverse_pose,
    known_depth,
    tilt_rotation,
    transform_points,
)

# Depth cameras lose thin parts whole, such as the mast of a toy ship. So matter in a hole that is
# not at an edge may be this much higher than the surface beside it.
HOLE_RISE = 0.015  # m
WALL = 0.05  # m over all that is known: height assumed in holes that are too wide to fill
WALL_LABEL = -2
OTHER_LABEL = -3  # of objects that are not the target (`utils.target`)
MARGIN = 0.08  # m, by which the grid reaches beyond the workspace
# What stands as near as this around the workspace is in the way of a hand that comes from a side:
# the hand is 0.2 m long and starts 0.1 m before the grasp.
_HAND_REACH, _STANDS = 0.30, 0.02  # m, and m over the table
_LABEL_FLOOR = 0.004  # m over the table, from which matter belongs to an object
# Pieces of which more than this share is so near a fixture's edge, and no higher over it, are its.
_RIM_REACH, _RIM_RISE, _RIM_SHARE = 0.012, 0.015, 0.7  # m, m
_LEAST_RISE = 0.001  # m of a labelled surface over what it rests on
_RIM = 3  # cells from a label, in which a tilted view takes it for unlabelled matter
PIVOT_HEIGHT = 0.05  # m over the table, of the point about which a view is tilted
STEEPEST = 0.02  # least cosine between a view and the vertical: a table seen along itself is a wall
FARTHEST = 1.0  # m, a table in a tilted view is no farther from the pivot


@dataclass(frozen=True)
class HeightMap:
    """Heights over a square grid; cell [row, col] is centred at origin + cell * (col, row) in V.

    height: (R, C) metres in V, the highest surface known in the cell; hidden cells hold the lowest
        height nearby, as if nothing were there.
    ceiling: (R, C) metres in V, the highest that matter could reach which was hidden or not
        measured; equals `height` where the surface was measured.
    label: (R, C) int, which object the cell belongs to; -1 for the table, WALL_LABEL for walls
        around the workspace, OTHER_LABEL for objects that are not to be grasped.
    centres: (M, 3) each label's centre of mass in V, or an estimate of it.
    table_height: metres in W.
    T_WV: (4, 4) the map's frame in W; the identity for a map from above.
    fixed: (R, C) metres in V, the tops of fixtures (`RGBDFrame.fixtures`) or true walls, -inf
        beside them; None where nothing is known of any.
    """

    height: np.ndarray
    ceiling: np.ndarray
    label: np.ndarray
    centres: np.ndarray
    origin: np.ndarray
    cell: float
    table_height: float
    T_WV: np.ndarray = field(default_factory=lambda: np.eye(4))
    fixed: np.ndarray | None = None
    _highest: dict = field(default_factory=dict, init=False, repr=False, compare=False)

    def index(self, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Row and column (...) of the cells of points (..., 2); the nearest cell if outside."""
        rows, cols = self.height.shape
        col, row = (
            np.clip(np.rint((xy[..., k] - self.origin[k]) / self.cell), 0, count - 1)
            for k, count in enumerate((cols, rows))
        )
        return row.astype(np.intp), col.astype(np.intp)

    def rise(self, points: np.ndarray) -> np.ndarray:
        """(...) metres of points (..., 3) in V over the table."""
        return points @ self.T_WV[2, :3] + (self.T_WV[2, 3] - self.table_height)

    def table(self) -> np.ndarray:
        """(R, C) float32 metres in V of the table."""
        return table_slope(self.height.shape, self.origin, self.cell, self.table_height, self.T_WV)

    def every(self, stride: int) -> HeightMap:
        """A coarser map: every `stride`-th cell along rows and columns."""
        if stride == 1:
            return self
        height, ceiling, label = (
            np.ascontiguousarray(part[::stride, ::stride])
            for part in (self.height, self.ceiling, self.label)
        )
        fixed = None if self.fixed is None else self.fixed[::stride, ::stride]
        cell = stride * self.cell
        return replace(self, height=height, ceiling=ceiling, label=label, cell=cell, fixed=fixed)

    def highest_around(self, surface: str, radius: int, shape: int) -> np.ndarray:
        """(R, C) highest `surface` (height or ceiling) within `radius` cells of each one, in a
        window of one of OpenCV's `shape`s. The result is kept."""
        if (surface, radius, shape) not in self._highest:
            window = cv2.getStructuringElement(shape, (2 * radius + 1, 2 * radius + 1))
            self._highest[surface, radius, shape] = cv2.dilate(getattr(self, surface), window)
        return self._highest[surface, radius, shape]


def grid_points(workspace: Workspace, margin: float, cell: float) -> tuple[np.ndarray, np.ndarray]:
    """Centres (R, C, 2) of the cells over the workspace widened by `margin`, and the first one."""
    half = workspace.size / 2 + margin
    count = int(np.floor(2 * half / cell)) + 1
    steps = (np.arange(count) - (count - 1) / 2) * cell
    x, y = np.meshgrid(workspace.centre[0] + steps, workspace.centre[1] + steps)
    points = np.stack([x, y], axis=-1)
    return points, points[0, 0]


def tilted_view(approach: np.ndarray, workspace: Workspace) -> np.ndarray:
    """(4, 4) T_WV of the frame in which a hand that comes along `approach` (3,) comes straight
    down: the world, turned about a point over the middle of the workspace."""
    pivot = np.array([*workspace.centre, workspace.table_height + PIVOT_HEIGHT])
    T = np.eye(4)
    T[:3, :3] = tilt_rotation(approach)
    T[:3, 3] = pivot - T[:3, :3] @ pivot
    return T


def table_slope(
    shape: tuple[int, int], origin: np.ndarray, cell: float, table: float, T_WV: np.ndarray
) -> np.ndarray:
    """(R, C) float32 metres in V: the table, `table` m high in W, in each cell of a grid."""
    steep_x, steep_y, up = T_WV[2, :3]
    rows, columns = (np.arange(count) for count in shape)
    # Where the hand comes along the table, the table is a wall on one side.
    level = (table - T_WV[2, 3]) - steep_x * (origin[0] + cell * columns)
    slope = (level - steep_y * (origin[1] + cell * rows)[:, None]) / max(up, STEEPEST)
    return np.clip(slope, -FARTHEST, FARTHEST).astype(np.float32)


def height_map_from_frame(
    frame: RGBDFrame, workspace: Workspace, cell: float = 0.002, margin: float = MARGIN
) -> HeightMap:
    """The height map of a depth image from above; uses nothing of the frame but depth, K and T_WC.

    Unknown pixels count as the nearest surface beside them (`near_side`); the ceiling over those
    that are not `at_edges` is a little higher. Labels are the pieces between height
    discontinuities; their centres are volume centroids of the columns between the table and the
    visible surface.
    """
    grid, origin = grid_points(workspace, margin, cell)
    table = float(workspace.table_height)
    seen = _seen(*without_holes(frame, workspace), np.eye(4), grid.shape[:2], origin, cell, table)
    if not frame.fixtures:
        label = label_walls(label_pieces(seen.height, table, cell), grid, workspace, cell)
        centres = _column_centroids(seen.height - table, label, grid, table)
        return HeightMap(*seen.walled(), label, centres, origin, cell, table)
    fixed = _tops(frame.fixtures, grid, origin, cell)
    bare = _bare(seen.height, fixed)
    label = label_pieces(np.where(bare, table, seen.height), table, cell)
    label = without_rims(np.where(bare, WALL_LABEL, label), seen.height, fixed, cell)
    base = base_heights(label, fixed, table)
    on = np.append(base, (table, table))[label]  # the last two are of walls and of the table
    centres = _column_centroids(np.maximum(seen.height - on, _LEAST_RISE), label, grid, 0.0)
    centres[:, 2] += base
    height, ceiling = (np.maximum(surface, fixed) for surface in seen.walled())
    return HeightMap(height, ceiling, label, centres, origin, cell, table, fixed=fixed)


def base_heights(label: np.ndarray, fixed: np.ndarray, table: float) -> np.ndarray:
    """(M,) metres in W of what each label (R, C) rests on: a fixture where most of it lies over
    one, the table otherwise. fixed: (R, C) of a map from above, see `HeightMap`."""
    on = np.flatnonzero(label >= 0)
    ground, owner = np.maximum(fixed.take(on), table), label.take(on)
    parts = (ground[owner == number] for number in range(_count(label)))
    return np.array([np.median(part) if len(part) else table for part in parts])


def without_rims(
    label: np.ndarray, height: np.ndarray, fixed: np.ndarray, cell: float
) -> np.ndarray:
    """The labels (R, C) with WALL_LABEL on pieces that lie along a fixture's edge and hardly rise
    over it: depth cameras round edges off. fixed: (R, C) the fixtures' tops, -inf beside them."""
    reach = 2 * int(_RIM_REACH / cell) + 1
    window = np.ones((reach, reach))
    fixed = np.maximum(fixed, -FARTHEST)  # so that heights can be subtracted
    near = cv2.dilate(fixed, window)
    edge = near - cv2.erode(fixed, window) > _LABEL_FLOOR
    edge &= height < near + _RIM_RISE
    count = np.bincount(label[label >= 0], minlength=_count(label))
    on_edge = np.bincount(label[(label >= 0) & edge], minlength=_count(label))
    kept = on_edge < _RIM_SHARE * count
    number = np.append(np.where(kept, np.cumsum(kept) - 1, WALL_LABEL), (WALL_LABEL, -1))
    return number[label]


def _count(label: np.ndarray) -> int:
    """Number of objects in labels (R, C), of which some or all may be negative."""
    return max(int(label.max()) + 1, 0)


def _bare(height: np.ndarray, fixed: np.ndarray) -> np.ndarray:
    """(R, C) bool: the surface there is that of a fixture. fixed: (R, C) the fixtures' tops."""
    return height < cv2.dilate(fixed, np.ones((5, 5))) + _LABEL_FLOOR


def tilted_height_map(
    overhead: HeightMap, filled: RGBDFrame, hiding: np.ndarray, T_WV: np.ndarray
) -> HeightMap:
    """The map of the same scene in another frame, on a grid like that of the map from above.

    filled, hiding: the frame `without_holes`. Objects are those of the map from above: a surface
    belongs to the object over its place on the table.
    """
    shape, origin, cell = overhead.height.shape, overhead.origin, overhead.cell
    seen = _seen(filled, hiding, T_WV, shape, origin, cell, overhead.table_height)
    row, column = np.indices(shape, sparse=True)
    surface = np.broadcast_arrays(origin[0] + cell * column, origin[1] + cell * row, seen.height)
    points = transform_points(T_WV, np.stack(surface, axis=-1))
    place = (points[..., :2] - origin) / cell
    matter = points[..., 2] > overhead.table_height + _LABEL_FLOOR
    matter &= ((place >= 0) & (place <= (shape[1] - 1, shape[0] - 1))).all(axis=-1)
    label = np.where(matter, overhead.label[overhead.index(points[..., :2])], -1)
    # At the rim of an object its surface may lie beside its label.
    known = label != -1
    rim = cv2.dilate(known.astype(np.uint8), np.ones((2 * _RIM + 1, 2 * _RIM + 1))) > 0
    rim &= matter & ~known
    if rim.any():
        label = np.where(rim, nearest_values(label, known), label)
    centres = transform_points(inverse_pose(T_WV), overhead.centres)
    height, ceiling = seen.walled()
    if filled.fixtures:
        grid = np.stack(surface[:2], axis=-1)
        turned = [solid.transformed(inverse_pose(T_WV)) for solid in filled.fixtures]
        fixed = _tops(turned, grid, origin, cell)
        label = np.where(_bare(height, fixed), WALL_LABEL, label)
        height, ceiling = np.maximum(height, fixed), np.maximum(ceiling, fixed)
    else:
        fixed = None
    table = overhead.table_height
    return HeightMap(height, ceiling, label, centres, origin, cell, table, T_WV, fixed)


class _Seen(NamedTuple):
    """height, ceiling: as in `HeightMap`, without walls. unknown: (R, C) bool, cells of which not
    even the surroundings are known."""

    height: np.ndarray
    ceiling: np.ndarray
    unknown: np.ndarray

    def walled(self) -> tuple[np.ndarray, np.ndarray]:
        """Height and ceiling, with walls where any matter is possible."""
        height = np.where(self.unknown, self.height.max() + WALL, self.height)
        return height, np.maximum(self.ceiling, height)


def without_holes(frame: RGBDFrame, workspace: Workspace) -> tuple[RGBDFrame, np.ndarray]:
    """The frame, its unknown pixels filled with the nearest surface beside them (`near_side`), and
    which of them (H, W) may hide matter: those that are not `at_edges`. Both without the rows and
    columns in which nothing lies over the workspace or stands around it."""
    measured = known_depth(frame.depth)
    hiding = ~measured & ~at_edges(frame.depth)
    if not measured.all():
        reach = reach_in_pixels(frame, HOLE_REACH)
        frame = replace(frame, depth=near_side(frame.depth, reach))
    rows, columns = _around(frame, workspace)
    return frame.part(rows, columns), hiding[rows, columns]


def _around(frame: RGBDFrame, workspace: Workspace) -> tuple[slice, slice]:
    """The rows and the columns whose points lie over the grid, or stand where they are in the way
    of a hand that comes from a side; what has no depth counts as table."""
    known = known_depth(frame.depth)
    depth = np.where(known, frame.depth, depth_of_plane(frame, workspace.table_height))
    v, u = np.mgrid[: depth.shape[0], : depth.shape[1]]
    ahead = np.isfinite(depth) & (depth > 0)
    places = deproject(np.stack([u, v], axis=-1), np.where(ahead, depth, 0), frame.K, frame.T_WC)
    apart = np.abs(places[..., :2] - workspace.centre).max(axis=-1)
    near = ahead & (apart <= workspace.size / 2 + MARGIN)
    stands = places[..., 2] > workspace.table_height + _STANDS
    near |= ahead & stands & (apart <= workspace.size / 2 + _HAND_REACH)
    if not near.any():
        return slice(0, depth.shape[0]), slice(0, depth.shape[1])
    # Two pixels more: the rays that graze an edge pass between a pixel and the next.
    rows, columns = (
        slice(max(int(found[0]) - 2, 0), min(int(found[-1]) + 3, side))
        for found, side in zip((np.flatnonzero(near.any(axis=k)) for k in (1, 0)), depth.shape)
    )
    return rows, columns


def _seen(
    frame: RGBDFrame,
    hiding: np.ndarray,
    T_WV: np.ndarray,
    shape: tuple[int, int],
    origin: np.ndarray,
    cell: float,
    table: float,
) -> _Seen:
    """What a frame without holes tells about the cells of a grid in V."""
    slope = table_slope(shape, origin, cell, table, T_WV)
    unknown = ~known_depth(frame.depth)
    to_table = np.where(unknown, depth_of_plane(frame, table), 0) if unknown.any() else None
    frame = replace(frame, T_WC=inverse_pose(T_WV) @ frame.T_WC)
    seen = _highest(_surface_points(frame, origin, cell), shape)
    hidden = ~np.isfinite(seen)
    # The lowest surface within 2 cm, so that an occluded flank does not widen the object.
    # OpenCV pads with the largest float, which a cell far outside the view would inherit.
    lowest = cv2.erode(np.where(hidden, np.inf, seen), np.ones((3, 3)), iterations=int(0.02 / cell))
    height = np.maximum(np.where(hidden, np.where(lowest < 1e3, lowest, slope), seen), slope)
    # The rays that graze an edge bound the matter in its shadow.
    ceiling = _highest(_grazing_points(frame, origin, cell), shape)
    ceiling = np.maximum(ceiling, height)
    if T_WV[2, 2] == 1.0:  # a camera above has seen what is over a surface that it sees
        ceiling = np.where(hidden, ceiling, height)
    if hiding.any():
        nearer = replace(frame, depth=np.where(hiding, frame.depth - HOLE_RISE, 0))
        risen = _highest(_surface_points(nearer, origin, cell), shape)
        ceiling = np.maximum(ceiling, risen)
    if to_table is None:
        return _Seen(height, ceiling, np.zeros(shape, bool))
    below = _highest(_surface_points(replace(frame, depth=to_table), origin, cell), shape)
    return _Seen(height, ceiling, hidden & np.isfinite(below))


def height_map_from_scene(
    scene: SceneGeometry,
    workspace: Workspace,
    cell: float = 0.0015,
    margin: float = MARGIN,
    T_WV: np.ndarray | None = None,
) -> HeightMap:
    """Exact height map: vertical lines through the cells' centres against every convex solid.

    T_WV: (4, 4) the map's frame, the world by default. The scene is in W.
    """
    T_WV = np.eye(4) if T_WV is None else T_WV
    grid, origin = grid_points(workspace, margin, cell)
    table = float(scene.table_height)
    height = table_slope(grid.shape[:2], origin, cell, table, T_WV).astype(float)
    label = np.full(grid.shape[:2], -1)
    scene = scene.transformed(inverse_pose(T_WV))
    bodies = [(number, item.solids) for number, item in enumerate(scene.objects)]
    for number, solids in [*bodies, (WALL_LABEL, scene.walls)]:
        for window, top in _columns(solids, grid, origin, cell):
            label[window] = np.where(top > height[window], number, label[window])
            height[window] = np.maximum(top, height[window])
    height = height.astype(np.float32)
    fixed = _tops(scene.walls, grid, origin, cell) if scene.walls else None
    centres = np.array([item.centre_of_mass for item in scene.objects]).reshape(-1, 3)
    return HeightMap(height, height, label, centres, origin, cell, table, T_WV, fixed)


def _columns(
    solids: Iterable[ConvexSolid], grid: np.ndarray, origin: np.ndarray, cell: float
) -> Iterator[tuple[tuple[slice, slice], np.ndarray]]:
    """For each solid the window of a grid (R, C, 2) over which it lies, and its highest point there
    on the line through each cell's centre; -inf where the line misses it."""
    for solid in solids:
        low = np.ceil((solid.vertices[:, :2].min(axis=0) - origin) / cell).astype(int)
        high = np.floor((solid.vertices[:, :2].max(axis=0) - origin) / cell).astype(int) + 1
        low, high = np.maximum(low, 0), np.maximum(high, 0)
        window = np.s_[low[1] : high[1], low[0] : high[0]]
        base = grid[window]
        if base.size == 0:
            continue
        origins = np.concatenate([base.reshape(-1, 2), np.zeros((base[..., 0].size, 1))], axis=1)
        top = intersect_lines(solid, origins, (0.0, 0.0, 1.0)).leave.reshape(base.shape[:2])
        yield window, top


def _tops(
    solids: Iterable[ConvexSolid], grid: np.ndarray, origin: np.ndarray, cell: float
) -> np.ndarray:
    """(R, C) float32 highest point of solids on the line through each cell of a grid (R, C, 2);
    -inf where it misses them all."""
    tops = np.full(grid.shape[:2], -np.inf, np.float32)
    for window, top in _columns(solids, grid, origin, cell):
        tops[window] = np.maximum(tops[window], top)
    return tops


def label_pieces(
    height: np.ndarray, table: float, cell: float, step: float = 0.006, floor: float = _LABEL_FLOOR
) -> np.ndarray:
    """(R, C) labels of the pieces higher than `floor` over the table, cut where neighbouring cells
    differ by `step`, all in metres.

    Slivers (under 0.6 cm2: side walls, edge pixels) join the nearest larger piece.
    """
    above = height > table + floor
    label = np.full(height.shape, -1)
    x, y, columns, rows = cv2.boundingRect(above.astype(np.uint8))
    if rows:
        box = np.s_[y : y + rows, x : x + columns]
        label[box] = _pieces(height[box], above[box], step, 0.6e-4 / cell**2)
    return label


def label_walls(
    label: np.ndarray, grid: np.ndarray, workspace: Workspace, cell: float
) -> np.ndarray:
    """The labels (R, C) of `label_pieces`, with WALL_LABEL on walls around the workspace.

    Pieces that lie mostly outside the workspace are walls if together they are as long as one of
    its sides; what has merely been pushed over the edge never is. grid: (R, C, 2) cells in W.
    """
    rows, cols = (
        np.nonzero(np.abs(line - middle) <= workspace.size / 2)[0]
        for line, middle in zip((grid[:, 0, 1], grid[0, :, 0]), workspace.centre[::-1])
    )
    inner = label[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1]
    count = label.max() + 1
    within, everywhere = (
        np.bincount(part.ravel() + 1, minlength=count + 1)[1:] for part in (inner, label)
    )
    outside = within < everywhere / 2
    if not outside.any():
        return label
    wall = np.append(outside, False)[label]
    if cell * max(wall.any(axis=0).sum(), wall.any(axis=1).sum()) < workspace.size:
        return label
    number = np.append(np.cumsum(~outside) - 1, -1)  # of the pieces that are left
    return np.where(wall, WALL_LABEL, number[label])


def _pieces(height: np.ndarray, above: np.ndarray, step: float, smallest: float) -> np.ndarray:
    """Labels (R, C) as in `label_pieces`, of pieces of more than `smallest` cells."""
    rows, columns = height.shape
    # Every second pixel is a cell; the pixel between two cells is set where they are connected.
    linked = np.zeros((2 * rows - 1, 2 * columns - 1), np.uint8)
    linked[::2, ::2] = above
    linked[::2, 1::2] = above[:, :-1] & above[:, 1:] & (np.abs(np.diff(height, axis=1)) < step)
    linked[1::2, ::2] = above[:-1] & above[1:] & (np.abs(np.diff(height, axis=0)) < step)
    raw = cv2.connectedComponents(linked, connectivity=4)[1][::2, ::2]
    kept = np.bincount(raw.ravel()) > smallest
    kept[0] = False
    large = kept[raw]
    if not large.any():
        return np.full(height.shape, -1)
    label = (np.cumsum(kept) - 1)[raw]
    return np.where(above, nearest_values(label, large), -1)


def _column_centroids(
    rise: np.ndarray, label: np.ndarray, grid: np.ndarray, table: float
) -> np.ndarray:
    """(M, 3) centroids of the columns under each labelled piece."""
    count = _count(label)
    on = np.flatnonzero(label >= 0)
    label, rise, place = label.take(on), rise.take(on), grid.reshape(-1, 2)[on].T
    weight = np.bincount(label, rise, count)
    x, y = (np.bincount(label, rise * along, count) / weight for along in place)
    z = np.bincount(label, rise**2, count) / (2 * weight)
    return np.column_stack([x, y, table + z])


def _highest(parts: Iterable[np.ndarray], shape: tuple[int, int]) -> np.ndarray:
    """(R, C) float32 highest z of the points in each cell; -inf where there is none.

    Each part holds columns and rows, in cells, and z (metres) of points, (3, ...).
    """
    rows, cols = shape
    height = np.full((rows + 2, cols + 2), -np.inf, np.float32)  # a rim for points outside
    for col, row, z in parts:
        index = np.rint(np.clip(row, -1, rows)) + 1
        index *= cols + 2
        index += np.rint(np.clip(col, -1, cols)) + 1
        index, z = index.astype(np.intp), z.astype(np.float32)
        np.maximum.at(height.reshape(-1), index.ravel(), z.ravel())
    return height[1:-1, 1:-1]


def _surface_points(
    frame: RGBDFrame, origin: np.ndarray, cell: float, split: int = 2
) -> Iterator[tuple[np.ndarray, ...]]:
    """Columns, rows and z (H, W) of points, split x split times: each pixel stands for that many
    points of its square, because it covers about 2 mm of the table and single points would leave
    gaps in a 2 mm grid. Without a depth, z is -inf.
    """
    depth = frame.depth.astype(float)
    unknown = ~known_depth(depth)
    depth[unknown] = 0
    to_cells = np.diag([1 / cell, 1 / cell, 1.0])
    start = to_cells @ (frame.T_WC[:3, 3] - (*origin, 0.0))
    # A ray is the sum of three parts: for the pixel's column, for its row, and the optical axis.
    by_u, by_v, axis = (to_cells @ frame.T_WC[:3, :3] @ np.linalg.inv(frame.K)).T
    v, u = (np.arange(count, dtype=float) for count in depth.shape)
    sub = (np.arange(split) + 0.5) / split - 0.5
    for dv, du in itertools.product(sub, sub):
        col, row, z = (
            depth * ((a * (u + du) + c) + (b * (v + dv))[:, None]) + d
            for a, b, c, d in zip(by_u, by_v, axis, start)
        )
        z[unknown] = -np.inf
        yield col, row, z


def _grazing_points(
    frame: RGBDFrame, origin: np.ndarray, cell: float, jump: float = 0.006
) -> Iterator[np.ndarray]:
    """Columns, rows and z (3, S, N) of points on the rays between neighbouring pixels whose depths
    differ by a jump: beside each other, and one below the other."""
    for step in ((1, 0), (0, 1)):
        here = frame.depth[: frame.depth.shape[0] - step[1], : frame.depth.shape[1] - step[0]]
        there = frame.depth[step[1] :, step[0] :]
        edge = (np.abs(here - there) > jump) & (here > 0) & (there > 0)
        row, column = np.divmod(np.flatnonzero(edge), edge.shape[1])
        pixel = np.stack([column, row], axis=-1)
        if len(pixel) == 0:
            continue
        near, far = (
            deproject(at, depth[edge], frame.K, frame.T_WC).T
            for at, depth in ((pixel, here), (pixel + step, there))
        )
        for end in (near, far):
            end[:2] = (end[:2] - origin[:, None]) / cell
        cells = np.linalg.norm((far - near)[:2], axis=0).max()
        share = np.linspace(0, 1, int(np.clip(2 * cells, 2, 60)))[:, None]
        yield near[:, None] + share * (far - near)[:, None]


# --- Local maxima ---------------------------------------------------------------------------


def local_maxima(
    image: np.ndarray, radius: int, above: float, count: int | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns (N,) of the highest pixels of an `image` (H, W), in falling order.

    Each is the highest in the window of side 2 radius + 1 around it, and `above` a value; there are
    at most `count`. Of equal pixels in one window, the result has the first in reading order.
    """
    side = 2 * radius + 1
    highest = cv2.dilate(image, np.ones((side, side), np.uint8))
    rows, columns = np.nonzero((image > above) & (image >= highest))
    free = np.ones(image.shape, bool)
    chosen: list[int] = []
    for peak in np.argsort(-image[rows, columns], kind="stable"):
        if len(chosen) == count:
            break
        row, column = rows[peak], columns[peak]
        if free[row, column]:
            chosen.append(peak)
            top, left = max(row - radius, 0), max(column - radius, 0)
            free[top : row + radius + 1, left : column + radius + 1] = False
    return rows[chosen], columns[chosen]
