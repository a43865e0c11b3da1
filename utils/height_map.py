"""Orthographic height maps from a depth image or from the true geometry.

A height map answers "how high is the scene above (x, y)?", which is all that a straight descent
has to know. Its frame V is the world, or the world turned so that a hand which comes from another
side comes down along -z of V (`tilted_view`); the table is a slope there. `local_maxima` finds the
peaks of such a map, or of any image. This module knows no simulator and no network.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from utils.depth_holes import nearest_values
from utils.geometry import ConvexSolid, SceneGeometry, Workspace, intersect_lines
from utils.seen_heights import (
    FARTHEST,
    MARGIN,
    outside,
    seen_heights,
    table_slope,
    without_holes,
)
from utils.transforms import (
    RGBDFrame,
    inverse_pose,
    tilt_rotation,
    transform_points,
)

WALL_LABEL = -2
OTHER_LABEL = -3  # of objects that are not the target (`utils.target`)
CELL = 0.002  # m, of a map from a frame
LABEL_FLOOR = 0.004  # m over the table, from which matter belongs to an object
LABEL_STEP = 0.006  # m between neighbouring cells, at which a piece ends
# Pieces of which more than this share is so near a fixture's edge, and no higher over it, are its.
_RIM_REACH, _RIM_RISE, _RIM_SHARE = 0.012, 0.015, 0.7  # m, m
HUNG = 0.015  # m beside and under what hangs over the table, which counts as part of it
SLIVER = 0.02  # m from an object, within which what is too small for one is part of it
_LEAST_RISE = 0.001  # m of a labelled surface over what it rests on
RIM = 3  # cells from a label, in which a tilted view takes it for unlabelled matter
PIVOT_HEIGHT = 0.05  # m over the table, of the point about which a view is tilted


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
    beyond: (R, C) bool, cells that the image does not show: what its border cuts off is thought to
        go on there (`with_surroundings`), and no grasp has its middle there; None where nothing is
        cut off.
    noise: m, standard deviation of flat surfaces: the larger `noise` of the frame and its second
        one; 0 for exact heights.
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
    beyond: np.ndarray | None = None
    noise: float = 0.0
    _highest: dict = field(default_factory=dict, init=False, repr=False, compare=False)

    def index(self, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Row and column (...) of the cells of points (..., 2); the nearest cell if outside."""
        col, row = (self.nearest(xy[..., k], k).astype(np.intp) for k in (0, 1))
        return row, col

    def nearest(self, place: np.ndarray, axis: int) -> np.ndarray:
        """(...) whole floats: the cells along an axis, 0 of columns and 1 of rows, of places (...)
        in metres; the nearest cell if outside."""
        cells = np.asarray(place - self.origin[axis])
        cells /= self.cell
        np.rint(cells, out=cells)
        np.maximum(cells, 0, out=cells)
        return np.minimum(cells, self.height.shape[1 - axis] - 1, out=cells)

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
        fixed, beyond = (
            None if part is None else part[::stride, ::stride] for part in (self.fixed, self.beyond)
        )
        return replace(
            self, height=height, ceiling=ceiling, label=label, cell=stride * self.cell, fixed=fixed,
            beyond=beyond,
        )  # fmt: skip

    def highest_around(self, surface: str, radius: int, shape: int) -> np.ndarray:
        """(R, C) highest `surface` (height or ceiling) within `radius` cells of each one, in a
        window of one of OpenCV's `shape`s. The result is kept."""
        if (surface, radius, shape) not in self._highest:
            window = cv2.getStructuringElement(shape, (2 * radius + 1, 2 * radius + 1))
            self._highest[surface, radius, shape] = cv2.dilate(getattr(self, surface), window)
        return self._highest[surface, radius, shape]


def grid_points(workspace: Workspace, margin: float, cell: float) -> tuple[np.ndarray, np.ndarray]:
    """Centres (R, C, 2) of the cells over the workspace widened by `margin`, and the first one."""
    points = _grid(*map(float, workspace.centre), workspace.size / 2 + margin, cell)
    return points, points[0, 0].copy()


@functools.lru_cache(maxsize=8)  # the same for each frame of a cell
def _grid(x: float, y: float, half: float, cell: float) -> np.ndarray:
    """(R, C, 2) read-only centres of the cells of a square around (x, y); all in metres."""
    count = int(np.floor(2 * half / cell)) + 1
    steps = (np.arange(count) - (count - 1) / 2) * cell
    points = np.stack(np.meshgrid(x + steps, y + steps), axis=-1)
    points.setflags(write=False)
    return points


def tilted_view(approach: np.ndarray, workspace: Workspace) -> np.ndarray:
    """(4, 4) T_WV of the frame in which a hand that comes along `approach` (3,) comes straight
    down: the world, turned about a point over the middle of the workspace."""
    pivot = np.array([*workspace.centre, workspace.table_height + PIVOT_HEIGHT])
    T = np.eye(4)
    T[:3, :3] = tilt_rotation(approach)
    T[:3, 3] = pivot - T[:3, :3] @ pivot
    return T


def height_map_from_frame(
    frame: RGBDFrame,
    workspace: Workspace,
    below: bool = False,
    holeless: tuple[RGBDFrame, np.ndarray] | None = None,
) -> HeightMap:
    """The height map of a depth image from above; uses nothing of the frame but depth, K, T_WC and
    fixtures.

    Unknown pixels count as the nearest surface beside them (`near_side`); the ceiling over those
    that are not `at_edges` is a little higher. Labels are the pieces between height
    discontinuities; their centres are volume centroids of the columns between the table and the
    visible surface. below: whether fixtures that hang over the table are left out, so that what a
    camera at the side sees below them is an object of the map; no hand can come down to it from
    above. holeless: the frame `without_holes`, where that is known.
    """
    grid, origin = grid_points(workspace, MARGIN, CELL)
    table, noise = float(workspace.table_height), _noise(frame)
    filled, hiding = holeless or without_holes(frame, workspace)
    if below:
        filled, hiding = _uncovered(filled, hiding, table)
    seen = seen_heights(filled, hiding, np.eye(4), grid.shape[:2], origin, CELL, table)
    surface = seen.height
    if len(filled.fixtures) < len(frame.fixtures):  # the back of a shelf is no object's shadow
        surface = np.where(seen.hidden, table, surface)
    if not filled.fixtures:
        label = label_walls(label_pieces(surface, table, CELL), grid, workspace, CELL)
        centres = _column_centroids(seen.height - table, label, grid, table)
        beyond = None
        if _goes_on(filled, frame):
            points = np.concatenate([grid, seen.height[..., None]], axis=-1)
            beyond = outside(frame, points)
        return HeightMap(
            *seen.walled(), label, centres, origin, CELL, table, beyond=beyond, noise=noise
        )
    fixed = _tops(filled.fixtures, grid, origin, CELL)
    bare = _bare(seen.height, fixed)
    label = label_pieces(np.where(bare, table, surface), table, CELL)
    label = without_rims(np.where(bare, WALL_LABEL, label), seen.height, fixed, CELL)
    base = base_heights(label, fixed, table)
    on = np.append(base, (table, table))[label]  # the last two are of walls and of the table
    centres = _column_centroids(np.maximum(seen.height - on, _LEAST_RISE), label, grid, 0.0)
    centres[:, 2] += base
    height, ceiling = (np.maximum(surface, fixed) for surface in seen.walled())
    return HeightMap(height, ceiling, label, centres, origin, CELL, table, fixed=fixed, noise=noise)


def _noise(frame: RGBDFrame) -> float:
    """Metres, of the noisier of the images that a map is drawn from."""
    return frame.noise if frame.second is None else max(frame.noise, frame.second.noise)


def _goes_on(filled: RGBDFrame, frame: RGBDFrame) -> bool:
    """Whether a frame `without_holes` has pixels beyond the border of what was taken."""
    before = filled.K[:2, 2] - frame.K[:2, 2]
    rows, columns = np.subtract(filled.depth.shape, frame.depth.shape)
    return bool((before > 0).any() or columns > before[0] or rows > before[1])


def _uncovered(filled: RGBDFrame, hiding: np.ndarray, table: float) -> tuple[RGBDFrame, np.ndarray]:
    """A frame `without_holes` and without what hangs over the table: its pixels are unknown."""
    hanging = [solid for solid in filled.fixtures if solid.hangs(table)]
    if not hanging:
        return filled, hiding
    hung = _hung(filled.points(), hanging)
    standing = tuple(solid for solid in filled.fixtures if not solid.hangs(table))
    depth, second = np.where(hung, 0, filled.depth).astype(np.float32), filled.second
    if second is not None:
        board = _hung(second.points(), hanging)
        second = replace(second, depth=np.where(board, 0, second.depth).astype(np.float32))
    return replace(filled, depth=depth, fixtures=standing, second=second), hiding & ~hung


def _hung(points: np.ndarray, hanging: Sequence[ConvexSolid]) -> np.ndarray:
    """(...) bool: points (..., 3) in W that belong to solids which hang over the table, or to what
    lies on them. NaN belongs to none."""
    found = np.zeros(points.shape[:-1], bool)
    for solid in hanging:
        low, high = solid.vertices.min(axis=0) - HUNG, solid.vertices.max(axis=0) + HUNG
        inside = (points[..., :2] > low[:2]) & (points[..., :2] < high[:2])
        found |= inside.all(axis=-1) & (points[..., 2] > low[2])
    return found


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
    fixed = np.maximum(fixed, height.min() - FARTHEST)  # so that heights can be subtracted
    near = cv2.dilate(fixed, window)
    edge = near - cv2.erode(fixed, window) > LABEL_FLOOR
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
    return height < cv2.dilate(fixed, np.ones((5, 5))) + LABEL_FLOOR


def tilted_height_map(
    overhead: HeightMap,
    filled: RGBDFrame,
    hiding: np.ndarray,
    T_WV: np.ndarray,
) -> HeightMap:
    """The map of the same scene in another frame, on a grid like that of the map from above.

    filled, hiding: the frame `without_holes`. Objects are those of the map from above: a surface
    belongs to the object over its place on the table, unless a fixture that hangs over the table
    is there.
    """
    shape, origin, cell = overhead.height.shape, overhead.origin, overhead.cell
    seen = seen_heights(filled, hiding, T_WV, shape, origin, cell, overhead.table_height)
    row, column = np.indices(shape, sparse=True)
    surface = np.broadcast_arrays(origin[0] + cell * column, origin[1] + cell * row, seen.height)
    points = transform_points(T_WV, np.stack(surface, axis=-1))
    place = (points[..., :2] - origin) / cell
    matter = points[..., 2] > overhead.table_height + LABEL_FLOOR
    matter &= ((place >= 0) & (place <= (shape[1] - 1, shape[0] - 1))).all(axis=-1)
    label = np.where(matter, overhead.label[overhead.index(points[..., :2])], -1)
    hanging = [solid for solid in filled.fixtures if solid.hangs(overhead.table_height)]
    label = np.where(_hung(points, hanging), WALL_LABEL, label)
    # At the rim of an object its surface may lie beside its label.
    known = label != -1
    rim = cv2.dilate(known.astype(np.uint8), np.ones((2 * RIM + 1, 2 * RIM + 1))) > 0
    rim &= matter & ~known
    if rim.any():
        label = np.where(rim, nearest_values(label, known), label)
    centres = transform_points(inverse_pose(T_WV), overhead.centres)
    height, ceiling = seen.walled()
    beyond = overhead.beyond
    if beyond is not None:
        beyond = beyond[overhead.index(points[..., :2])]
    if filled.fixtures:
        grid = np.stack(surface[:2], axis=-1)
        turned = [solid.transformed(inverse_pose(T_WV)) for solid in filled.fixtures]
        fixed = _tops(turned, grid, origin, cell)
        label = np.where(_bare(height, fixed), WALL_LABEL, label)
        height, ceiling = np.maximum(height, fixed), np.maximum(ceiling, fixed)
    else:
        fixed = None
    table = overhead.table_height
    return HeightMap(
        height, ceiling, label, centres, origin, cell, table, T_WV, fixed, beyond, overhead.noise
    )  # fmt: skip


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


def label_pieces(height: np.ndarray, table: float, cell: float) -> np.ndarray:
    """(R, C) labels of the pieces higher than LABEL_FLOOR over the table, cut where neighbouring
    cells differ by LABEL_STEP, all in metres.

    Slivers (under 0.6 cm2: side walls, edge pixels) join the nearest larger piece within SLIVER;
    others stay without a label.
    """
    above = height > table + LABEL_FLOOR
    label = np.full(height.shape, -1)
    x, y, columns, rows = cv2.boundingRect(above.astype(np.uint8))
    if rows:
        box = np.s_[y : y + rows, x : x + columns]
        smallest, reach = 0.6e-4 / cell**2, int(SLIVER / cell)
        label[box] = _pieces(height[box], above[box], LABEL_STEP, smallest, reach)
    return label


def label_walls(
    label: np.ndarray, grid: np.ndarray, workspace: Workspace, cell: float
) -> np.ndarray:
    """The labels (R, C) of `label_pieces`, with WALL_LABEL on walls around the workspace.

    Pieces that lie mostly outside the workspace are walls if together, beyond one of its sides,
    they are as long as this side; what has merely been pushed over the edge is not. grid: (R, C, 2)
    cells in W.
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
    beyond = (
        wall[: rows[0]].any(axis=0), wall[rows[-1] + 1 :].any(axis=0),
        wall[:, : cols[0]].any(axis=1), wall[:, cols[-1] + 1 :].any(axis=1),
    )  # fmt: skip
    if cell * max(side.sum() for side in beyond) < workspace.size:
        return label
    number = np.append(np.cumsum(~outside) - 1, -1)  # of the pieces that are left
    return np.where(wall, WALL_LABEL, number[label])


def _pieces(
    height: np.ndarray, above: np.ndarray, step: float, smallest: float, reach: int
) -> np.ndarray:
    """Labels (R, C) as in `label_pieces`, of pieces of more than `smallest` cells; slivers have one
    at most `reach` cells from such a piece."""
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
    near = cv2.dilate(large.astype(np.uint8), np.ones((2 * reach + 1, 2 * reach + 1))) > 0
    joined = np.unique(raw[near & above])  # slivers join as a whole
    return np.where(above & np.isin(raw, joined), nearest_values(label, large), -1)


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
