"""What a depth image tells about the heights of a scene along any direction, and what it hides.

The image's points are drawn again on a grid in a frame V whose -z is the direction of a hand's
approach. A cell then has a surface that was seen, or none; and the rays that graze an edge bound
the matter in its shadow. A second frame of the same scene raises surfaces and carves ceilings.
This module knows neither objects nor networks.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace

import cv2
import numpy as np

from utils.compiled import compiled
from utils.depth_holes import (
    HOLE_REACH,
    at_edges,
    depth_of_plane,
    near_side,
    reach_in_pixels,
)
from utils.geometry import Workspace
from utils.transforms import (
    RGBDFrame,
    deproject,
    inverse_pose,
    known_depth,
    project,
    ray_component,
)

# Depth cameras lose thin parts whole, such as the mast of a toy ship. So matter in a hole that is
# not at an edge may be this much higher than the surface beside it.
HOLE_RISE = 0.015  # m
WALL = 0.05  # m over all that is known: height assumed in holes that are too wide to fill
MARGIN = 0.08  # m, by which the grid reaches beyond the workspace
# What stands as near as this around the workspace is in the way of a hand that comes from a side:
# the hand is 0.2 m long and starts 0.1 m before the grasp.
_HAND_REACH, _STANDS = 0.30, 0.02  # m, and m over the table
# What rises as much over the table is an object that the image may cut off; beyond the border it
# goes on for more than a hand spans.
_CUT_OFF, _GOES_ON = 0.008, 0.1  # m
# A surface this much behind a point is seen through it: more than two cameras disagree, less than
# the least step that separates objects.
_SEEN_THROUGH = 0.004  # m
_HIDDEN_BEHIND = 0.01  # m, by which a point has to lie behind a surface to be hidden for certain
_CARVED = 2  # cells of height that are carved from a ceiling at once
STEEPEST = 0.02  # least cosine between a view and the vertical: a table seen along itself is a wall
FARTHEST = 1.0  # m, a table in a tilted view is no farther from the place about which it is tilted
BORROWED_WITHIN = 0.02  # m, within which a hidden cell takes the lowest surface
ABOVE_RAYS = 0.002  # m, by which that surface may be above the rays that graze an edge
GRAZING_JUMP = 0.006  # m of depth between neighbouring pixels, at which a ray grazes an edge
# Points on such rays, two for each cell of the longest: as many as 30 cells need at most, and again
# as many as they need on the longer ones, which a camera at the side sees graze what is high.
GRAZING_SHARES, MOST_SHARES = 60, 1000
SUBPIXELS = 2  # points along each side of the square that a pixel stands for, at least


@dataclass(frozen=True)
class SeenHeights:
    """What a frame tells about the cells (R, C) of a grid in V; metres in V, without walls.

    height: the highest surface seen; hidden cells hold the lowest one nearby, or the table where no
    matter can reach up to it. ceiling: the highest that matter could reach which was hidden or not
    measured; equals `height` where there is none.
    hidden: bool, cells in which no surface was seen. unknown: bool, cells of which not even the
    surroundings are known. slope: the table. origin, cell: the grid, as of `HeightMap`. T_WV:
    (4, 4) the grid's frame in W.
    """

    height: np.ndarray
    ceiling: np.ndarray
    hidden: np.ndarray
    unknown: np.ndarray
    slope: np.ndarray
    origin: np.ndarray
    cell: float
    T_WV: np.ndarray

    def walled(self) -> tuple[np.ndarray, np.ndarray]:
        """Height and ceiling, with walls where any matter is possible."""
        height = np.where(self.unknown, self.height.max() + WALL, self.height)
        return height, np.maximum(self.ceiling, height)


def seen_heights(
    frame: RGBDFrame,
    hiding: np.ndarray,
    T_WV: np.ndarray,
    shape: tuple[int, int],
    origin: np.ndarray,
    cell: float,
    table: float,
) -> SeenHeights:
    """What a frame, and its second one if it has any, tell about the cells of a grid in V.

    frame, hiding: the frame `without_holes`. shape, origin, cell: as of `HeightMap`. table: metres
    in W.
    """
    slope = table_slope(shape, origin, cell, table, T_WV)
    unknown = ~known_depth(frame.depth)
    to_table = np.where(unknown, depth_of_plane(frame, table), 0) if unknown.any() else None
    frame = replace(frame, T_WC=inverse_pose(T_WV) @ frame.T_WC)
    split = subpixels(frame, cell)
    seen = _surface(frame, origin, cell, split, shape)
    hidden = ~np.isfinite(seen)
    # The rays that graze an edge bound the matter in its shadow.
    grazed = _grazed(frame, origin, cell, shape)
    height = _filled(seen, slope, cell)
    # What was borrowed a short way behind an object may be the top of the object itself.
    height = np.where(hidden & np.isfinite(grazed) & (height > grazed + ABOVE_RAYS), slope, height)
    ceiling = np.maximum(grazed, height)
    if T_WV[2, 2] == 1.0:  # a camera above has seen what is over a surface that it sees
        ceiling = np.where(hidden, ceiling, height)
    if hiding.any():
        nearer = replace(frame, depth=np.where(hiding, frame.depth - HOLE_RISE, 0))
        risen = _surface(nearer, origin, cell, split, shape)
        ceiling = np.maximum(ceiling, risen)
    unknown = np.zeros(shape, bool)
    if to_table is not None:
        below = _surface(replace(frame, depth=to_table), origin, cell, split, shape)
        unknown = hidden & np.isfinite(below)
    first = SeenHeights(height, ceiling, hidden, unknown, slope, origin, cell, T_WV)
    if frame.second is None or not known_depth(frame.second.depth).any():
        return first
    return with_second(first, frame.second)


def with_second(first: SeenHeights, second: RGBDFrame) -> SeenHeights:
    """What is known once a second frame of the same still scene is added; pixels without a depth
    add nothing.

    Its surfaces raise the heights. What was possible under a ceiling is none where the second
    camera sees through it: from the top down, as long as each point of a cell's column lies before
    the surface at its pixel (space carving: Kutulakos and Seitz, IJCV 2000). A cell is hidden, or
    unknown, only where neither frame saw a surface.
    """
    shape, cell = first.height.shape, first.cell
    second = replace(second, T_WC=inverse_pose(first.T_WV) @ second.T_WC)
    split = subpixels(second, cell)
    also = _surface(second, first.origin, cell, split, shape)
    seen = np.maximum(np.where(first.hidden, -np.inf, first.height), also)
    hidden = ~np.isfinite(seen)
    height = _filled(seen, first.slope, cell)
    # A second surface nearby is no reason for more matter in what both cameras leave hidden.
    height = np.where(hidden, np.minimum(height, first.height), height)
    ceiling = _carved(np.maximum(first.ceiling, height), height, second, first.origin, cell)
    # As near a surface as this, the cameras' disagreement is all that is left of it.
    just = ~hidden & (ceiling < height + 2 * _SEEN_THROUGH + _CARVED * cell)
    ceiling = np.where(just, height, ceiling)
    unknown = first.unknown & hidden
    return replace(first, height=height, ceiling=ceiling, hidden=hidden, unknown=unknown)


def sees_through(frame: RGBDFrame, points: np.ndarray) -> np.ndarray:
    """(N,) bool, whether the surface at the pixel of each point (N, 3) in W was measured, and lies
    behind the point."""
    depth, surface = _on_its_ray(frame, points)
    return surface > depth + _SEEN_THROUGH


def hides(frame: RGBDFrame, points: np.ndarray) -> np.ndarray:
    """(N,) bool, whether a frame leaves each point (N, 3) in W unseen: it shows something nearer at
    the point's pixel, measured nothing there, or the point lies outside its image."""
    depth, surface = _on_its_ray(frame, points)
    return ~(surface > depth - _HIDDEN_BEHIND)


def outside(frame: RGBDFrame, points: np.ndarray) -> np.ndarray:
    """(...) bool, whether points (..., 3) in W lie outside a frame's image."""
    return ~_pixels(frame, points)[2]


def _pixels(frame: RGBDFrame, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nearest pixels (..., 2) of points (..., 3) in W, NaN behind the camera, the points' depths
    (...), and whether the image has these pixels (...)."""
    pixels, depth = project(points, frame.K, frame.T_WC)
    pixels = np.rint(pixels)
    rows, columns = frame.depth.shape
    return pixels, depth, ((pixels >= 0) & (pixels < (columns, rows))).all(axis=-1)


def _on_its_ray(frame: RGBDFrame, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depths (N,) of points and of the surfaces at their pixels, NaN where none was measured."""
    pixels, depth, within = _pixels(frame, points)
    u, v = (np.where(within, along, 0).astype(np.intp) for along in pixels.T)
    surface = frame.depth[v, u]
    return depth, np.where(within & known_depth(surface), surface, np.nan)


def _carved(
    ceiling: np.ndarray, height: np.ndarray, second: RGBDFrame, origin: np.ndarray, cell: float
) -> np.ndarray:
    """(R, C) float32 ceilings, lowered as far as a frame in V sees through what is under them, and
    to `height` at the lowest."""
    at = np.flatnonzero(ceiling > height)
    row, column = np.divmod(at, ceiling.shape[1])
    place = origin + cell * np.stack([column, row], axis=-1)
    lowest, level = height.take(at), ceiling.take(at)
    result, left = ceiling.copy(), np.arange(len(at))
    while len(left):
        free = sees_through(second, np.column_stack([place[left], level[left]]))
        left = left[free]
        # A point is free, and so is what is over it: matter begins below.
        result.flat[at[left]] = level[left]
        level[left] -= _CARVED * cell
        below = level[left] <= lowest[left]
        result.flat[at[left[below]]] = lowest[left[below]]
        left = left[~below]
    return result


def _filled(seen: np.ndarray, slope: np.ndarray, cell: float) -> np.ndarray:
    """(R, C) heights over the table of the surfaces `seen`, -inf where there is none: there it is
    the lowest surface within 2 cm, so that an occluded flank does not widen the object."""
    hidden = ~np.isfinite(seen)
    # OpenCV pads with the largest float, which a cell far outside the view would inherit.
    lowest = cv2.erode(
        np.where(hidden, np.inf, seen), np.ones((3, 3)), iterations=int(BORROWED_WITHIN / cell)
    )
    return np.maximum(np.where(hidden, np.where(lowest < 1e3, lowest, slope), seen), slope)


def table_slope(
    shape: tuple[int, int], origin: np.ndarray, cell: float, table: float, T_WV: np.ndarray
) -> np.ndarray:
    """(R, C) float32 metres in V: the table, `table` m high in W, in each cell of a grid."""
    steep_x, steep_y, up = T_WV[2, :3]
    rows, columns = (np.arange(count) for count in shape)
    # Where the hand comes along the table, the table is a wall on one side.
    level = (table - T_WV[2, 3]) - steep_x * (origin[0] + cell * columns)
    slope = (level - steep_y * (origin[1] + cell * rows)[:, None]) / max(up, STEEPEST)
    return np.clip(slope, table - FARTHEST, table + FARTHEST).astype(np.float32)


def without_holes(frame: RGBDFrame, workspace: Workspace) -> tuple[RGBDFrame, np.ndarray]:
    """The frame, its unknown pixels filled with the nearest surface beside them (`near_side`), and
    which of them (H, W) may hide matter: those that are not `at_edges`. Both go on where the image
    cuts something off (`with_surroundings`), and are without the rows and columns in which nothing
    lies over the workspace or stands around it."""
    measured = known_depth(frame.depth)
    hiding = ~measured & ~at_edges(frame)
    if not measured.all():
        reach = reach_in_pixels(frame, HOLE_REACH)
        frame = replace(frame, depth=near_side(frame.depth, reach))
    frame, added = with_surroundings(frame, workspace.table_height)
    hiding = np.pad(hiding, added)
    rows, columns = _around(frame, workspace)
    return frame.part(rows, columns), hiding[rows, columns]


def with_surroundings(
    frame: RGBDFrame, table_height: float
) -> tuple[RGBDFrame, tuple[tuple[int, int], tuple[int, int]]]:
    """The frame with more rows and columns at those borders of its image that cut off what stands
    on the table, and how many: (before, after) of rows and of columns. Each surface goes on beyond
    the border at its height in W, in black.

    A camera does not see where an object ends that its image cuts off: it does not end at the
    border, where fingers would find nothing to close on. A frame with fixtures stays as it is:
    a board or a wall, whose place is known, may be all that stands there. So does one with a second
    frame, which shows where the object ends.
    """
    none = ((0, 0), (0, 0))
    known = known_depth(frame.depth)
    rise = frame.depth * ray_component(2, known.shape, frame.K, frame.T_WC) + frame.T_WC[2, 3]
    stands = known & (rise > table_height + _CUT_OFF)
    cuts = [[stands[0], stands[-1]], [stands[:, 0], stands[:, -1]]]
    if (
        frame.fixtures
        or frame.second is not None
        or not any(border.any() for ends in cuts for border in ends)
    ):
        return frame, none
    more = reach_in_pixels(frame, _GOES_ON)
    top, bottom, left, right = (more * int(border.any()) for ends in cuts for border in ends)
    added = (top, bottom), (left, right)
    K = frame.K.copy()
    K[:2, 2] += left, top
    rise = np.pad(np.where(known, rise, np.nan), added, mode="edge")
    with np.errstate(divide="ignore"):
        depth = (rise - frame.T_WC[2, 3]) / ray_component(2, rise.shape, K, frame.T_WC)
    depth = np.where(known_depth(depth), depth, 0).astype(np.float32)
    rows, columns = known.shape
    depth[top : top + rows, left : left + columns] = frame.depth
    rgb = np.pad(frame.rgb, (*added, (0, 0)))
    return replace(frame, rgb=rgb, depth=depth, K=K, segmentation=None, target=None), added


def _around(frame: RGBDFrame, workspace: Workspace) -> tuple[slice, slice]:
    """The rows and the columns whose points lie over the grid, or stand where they are in the way
    of a hand that comes from a side; what has no depth counts as table."""
    known = known_depth(frame.depth)
    depth = np.where(known, frame.depth, depth_of_plane(frame, workspace.table_height))
    ahead = np.isfinite(depth) & (depth > 0)
    depth = np.where(ahead, depth, 0)
    x, y, z = (
        depth * ray_component(axis, depth.shape, frame.K, frame.T_WC) + frame.T_WC[axis, 3]
        for axis in range(3)
    )
    apart = np.maximum(np.abs(x - workspace.centre[0]), np.abs(y - workspace.centre[1]))
    near = ahead & (apart <= workspace.size / 2 + MARGIN)
    stands = z > workspace.table_height + _STANDS
    near |= ahead & stands & (apart <= workspace.size / 2 + _HAND_REACH)
    if not near.any():
        warnings.warn(
            f"no point of the image lies over the workspace, a square of {workspace.size:g} m at "
            f"({workspace.centre[0]:g}, {workspace.centre[1]:g}) in the world; "
            "utils.user_view.workspace_of finds one that the camera sees",
            stacklevel=2,
        )
        return slice(0, depth.shape[0]), slice(0, depth.shape[1])
    # Two pixels more: the rays that graze an edge pass between a pixel and the next.
    rows, columns = (
        slice(max(int(found[0]) - 2, 0), min(int(found[-1]) + 3, side))
        for found, side in zip((np.flatnonzero(near.any(axis=k)) for k in (1, 0)), depth.shape)
    )
    return rows, columns


def _surface(
    frame: RGBDFrame, origin: np.ndarray, cell: float, split: int, shape: tuple[int, int]
) -> np.ndarray:
    """(R, C) float32 highest z of the frame's points in each cell; -inf where there is none.

    Each pixel with a depth stands for split x split points of its square (`subpixels`).
    """
    to_cells = np.diag([1 / cell, 1 / cell, 1.0])
    start = to_cells @ (frame.T_WC[:3, 3] - (*origin, 0.0))
    # A ray is the sum of three parts: for the pixel's column, for its row, and the optical axis.
    rays = to_cells @ frame.T_WC[:3, :3] @ np.linalg.inv(frame.K)
    sub = (np.arange(split) + 0.5) / split - 0.5
    height = np.full(shape, -np.inf, np.float32)
    _raise_to_surface(height, frame.depth, known_depth(frame.depth), rays, start, sub)
    return height


@compiled
def _raise_to_surface(
    height: np.ndarray,
    depth: np.ndarray,
    known: np.ndarray,
    rays: np.ndarray,
    start: np.ndarray,
    sub: np.ndarray,
) -> None:
    """Raise heights (R, C), cells of a grid, to the points of an image's pixels, each spread over
    the places `sub` along both sides. rays: (3, 3) from pixels to cells, cells and metres at a
    depth of 1 m. start: (3,) the camera, likewise."""
    rows, columns = height.shape
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            if not known[v, u]:
                continue
            far = float(depth[v, u])
            for dv in sub:
                for du in sub:
                    at_u, at_v = u + du, v + dv
                    x = ((rays[0, 0] * at_u + rays[0, 2]) + rays[0, 1] * at_v) * far + start[0]
                    y = ((rays[1, 0] * at_u + rays[1, 2]) + rays[1, 1] * at_v) * far + start[1]
                    column, row = np.rint(x), np.rint(y)
                    if 0 <= column < columns and 0 <= row < rows:
                        z = ((rays[2, 0] * at_u + rays[2, 2]) + rays[2, 1] * at_v) * far + start[2]
                        place = int(row), int(column)
                        height[place] = max(height[place], np.float32(z))


def _grazed(
    frame: RGBDFrame, origin: np.ndarray, cell: float, shape: tuple[int, int]
) -> np.ndarray:
    """(R, C) float32 highest z, in each cell, of the rays between neighbouring pixels whose depths
    differ by GRAZING_JUMP, beside each other and one below the other; -inf where there is none."""
    height = np.full(shape, -np.inf, np.float32)
    for step in ((1, 0), (0, 1)):
        here = frame.depth[: frame.depth.shape[0] - step[1], : frame.depth.shape[1] - step[0]]
        there = frame.depth[step[1] :, step[0] :]
        edge = (np.abs(here - there) > GRAZING_JUMP) & (here > 0) & (there > 0)
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
        cells = np.linalg.norm((far - near)[:2], axis=0)
        share = np.linspace(0, 1, int(np.clip(2 * cells.max(), 2, GRAZING_SHARES)))
        _raise_to_rays(height, near, far - near, share)
        if (2 * cells > GRAZING_SHARES).any():
            near, far = (end[:, 2 * cells > GRAZING_SHARES] for end in (near, far))
            share = np.linspace(0, 1, int(min(2 * cells.max(), MOST_SHARES)))
            _raise_to_rays(height, near, far - near, share)
    return height


@compiled
def _raise_to_rays(
    height: np.ndarray, near: np.ndarray, along: np.ndarray, share: np.ndarray
) -> None:
    """Raise heights (R, C) to points at shares (S,) of the way from near (3, N) `along` (3, N):
    columns and rows, in cells, and metres."""
    rows, columns = height.shape
    for k in range(near.shape[1]):
        for part in share:
            column = np.rint(near[0, k] + part * along[0, k])
            row = np.rint(near[1, k] + part * along[1, k])
            if 0 <= column < columns and 0 <= row < rows:
                place = int(row), int(column)
                height[place] = max(height[place], np.float32(near[2, k] + part * along[2, k]))


def subpixels(frame: RGBDFrame, cell: float) -> int:
    """Points along each side of the square that a pixel stands for, so that on a surface at the
    middle depth, which faces the camera, the next one is no farther than a cell: none stays empty.
    """
    known = frame.depth[known_depth(frame.depth)]
    if len(known) == 0:
        return SUBPIXELS
    pixel = float(np.median(known)) / min(frame.K[0, 0], frame.K[1, 1])  # m
    return max(SUBPIXELS, int(np.ceil(pixel / cell)))
