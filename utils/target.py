"""The one object that the user wants: its pixels in the image, and its cells in a height map.

`RGBDFrame.target` holds its visible pixels. Planners take the target's own height map from
`only_target`, in which all other objects are obstacles; `target_at` and `target_in_box` make the
pixels of a click or a box on an image that a planner has cut into objects. This module knows no
planner and no file.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from utils.depth_holes import nearest_values
from utils.errors import UserError
from utils.geometry import Workspace
from utils.height_map import HUNG, OTHER_LABEL, HeightMap, base_heights
from utils.transforms import RGBDFrame, known_depth, project, transform_points

# Depth cameras and hand-drawn masks are off by some pixels at an edge: nearer to a mask's outline
# than this, the height map's own labels decide.
RIM = 0.004  # m
# Of an object's cells in the mask: above it all of the object is the target. Of the target's cells
# in one object: above it the object's centre is the target's.
MOSTLY = 0.8
LEAST_PIXELS = 12  # of a target: fewer are the noise of an edge
CLICK_REACH = 4  # pixels around a click in which an object counts as hit where depth is missing


def only_target(heights: HeightMap, frame: RGBDFrame) -> HeightMap:
    """The map in which only the frame's target is an object: all others are OTHER_LABEL.

    The target's cells have one label and one centre of mass, also where the map cuts the target
    into pieces; the centre is the map's own where one piece is nearly the target. A frame without a
    target leaves the map as it is; in a map where the target is not seen, nothing is an object.
    """
    if frame.target is None:
        return heights
    mine = _target_cells(heights, frame)
    label = np.where(heights.label >= 0, OTHER_LABEL, heights.label)
    if not mine.any():
        return replace(heights, label=label)
    pieces = np.bincount(heights.label[mine])
    main = int(pieces.argmax())
    whole = int((heights.label == main).sum())
    if pieces[main] > MOSTLY * max(mine.sum(), whole):
        return replace(heights, label=np.where(mine, main, label))
    label = np.where(mine, len(heights.centres), label)
    return replace(
        heights, label=label, centres=np.vstack([heights.centres, _centroid(heights, mine)])
    )


def only_object(heights: HeightMap, number: int | None) -> HeightMap:
    """The map in which only one of its objects is an object; with None, none is."""
    others = (heights.label >= 0) & (heights.label != (-1 if number is None else number))
    return replace(heights, label=np.where(others, OTHER_LABEL, heights.label))


def object_of_target(heights: HeightMap, frame: RGBDFrame) -> int | None:
    """The label of the object that has most of the target's cells; None where the map has none."""
    row, column = np.nonzero(heights.label >= 0)
    inside, _ = _in_mask(heights, frame, row, column)
    counts = np.bincount(heights.label[row, column][inside])
    return int(counts.argmax()) if counts.any() else None


def _target_cells(heights: HeightMap, frame: RGBDFrame) -> np.ndarray:
    """(R, C) bool, the cells of the target: those that its pixels show; near the mask's outline,
    and where the camera sees nothing, those of the objects that mostly lie in the mask."""
    row, column = np.nonzero(heights.label >= 0)
    label = heights.label[row, column]
    inside, certain = _in_mask(heights, frame, row, column)
    visible = heights.ceiling[row, column] <= heights.height[row, column]
    certain &= visible
    count = len(heights.centres)
    # An object as thin as that has no other cells.
    certain |= visible & (np.bincount(label[certain], minlength=count) == 0)[label]
    share = np.bincount(label[certain & inside], minlength=count) / np.maximum(
        np.bincount(label[certain], minlength=count), 1
    )
    mine = np.zeros(heights.label.shape, bool)
    known = np.zeros(heights.label.shape, bool)
    mine[row, column], known[row, column] = inside, certain
    if known.any():
        mine = nearest_values(mine.astype(np.int32), known).astype(bool)
    cells = np.zeros(heights.label.shape, bool)
    cells[row, column] = np.where(
        share[label] > MOSTLY, True, (share[label] > 0) & mine[row, column]
    )
    return cells


def _in_mask(
    heights: HeightMap, frame: RGBDFrame, row: np.ndarray, column: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(N,) bool twice: whether the surface in cells of the map is seen in the target's pixels, and
    whether it is farther from their outline than RIM."""
    assert frame.target is not None
    xy = heights.origin + heights.cell * np.column_stack([column, row])
    surface = np.column_stack([xy, heights.height[row, column]])
    place, depth = project(transform_points(heights.T_WV, surface), frame.K, frame.T_WC)
    limits = frame.target.shape[1] - 1, frame.target.shape[0] - 1
    pixel = np.rint(np.nan_to_num(place, nan=-1.0))
    seen = (pixel >= 0).all(axis=1) & (pixel <= limits).all(axis=1)
    u, v = np.clip(pixel, 0, limits).astype(int).T
    mask = frame.target.astype(np.uint8)
    middle = float(np.median(depth)) if len(depth) else 1.0
    radius = max(1, round(RIM * frame.K[0, 0] / max(middle, 1e-3)))
    window = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    rim = cv2.dilate(mask, window) != cv2.erode(mask, window)
    return seen & (mask[v, u] > 0), seen & ~rim[v, u]


def _centroid(heights: HeightMap, cells: np.ndarray) -> np.ndarray:
    """(3,) centroid of the columns between what the cells of a map from above rest on and their
    surface."""
    row, column = np.nonzero(cells)
    base = heights.table_height
    if heights.fixed is not None:
        base = float(base_heights(np.where(cells, 0, -1), heights.fixed, base)[0])
    rise = np.maximum(heights.height[row, column] - base, 1e-6)
    xy = heights.origin + heights.cell * np.column_stack([column, row])
    middle = (rise[:, None] * xy).sum(axis=0) / rise.sum()
    return np.array([*middle, base + (rise**2).sum() / (2 * rise.sum())])


# --- Pixels ---------------------------------------------------------------------------------


def pixel_labels(heights: HeightMap, frame: RGBDFrame) -> np.ndarray:
    """(H, W) int32 labels of a map from above at the pixels of its frame: the object over the
    pixel's place on the table; -1 for the table, beside the map, where depth is unknown, and for
    what hangs over the map's surface, such as a board that the map leaves out."""
    points = frame.points()
    known = np.isfinite(points[..., 2])
    place = (np.nan_to_num(points[..., :2]) - heights.origin) / heights.cell
    rows, columns = heights.label.shape
    on_map = known & ((place > -0.5) & (place < (columns - 0.5, rows - 0.5))).all(axis=-1)
    cell = heights.index(np.nan_to_num(points[..., :2]))
    on_map &= ~(points[..., 2] > heights.height[cell] + HUNG)
    return np.where(on_map, np.maximum(heights.label[cell], -1), -1).astype(np.int32)


def target_at(labels: np.ndarray, frame: RGBDFrame, point: Sequence[float]) -> np.ndarray:
    """(H, W) bool: the pixels of the object on which a point (u, v) of the image lies.

    labels: (H, W) as of `pixel_labels`. Raises UserError where the point lies outside the image, on
    the table, or on nothing.
    """
    u, v = (int(round(x)) if np.isfinite(x) else -1 for x in point)
    height, width = labels.shape
    name = f"point {point[0]:g} {point[1]:g}"
    if not (0 <= u < width and 0 <= v < height):
        raise UserError(f"{name}: outside the image of {width}x{height} pixels")
    label = labels[v, u]
    if label < 0 and not known_depth(frame.depth)[v, u]:
        near = labels[marked_pixels(labels.shape, (u, v), None, None)]
        near = near[near >= 0]
        if len(near) == 0:
            raise UserError(
                f"{name}: the depth is unknown there and around; choose a pixel of the object "
                "whose depth is known"
            )
        label = np.bincount(near).argmax()
    if label < 0:
        rows, columns = np.nonzero(labels >= 0)
        if len(rows) == 0:
            raise UserError(f"{name}: no object is seen in the workspace")
        nearest = np.argmin(np.hypot(columns - u, rows - v))
        raise UserError(
            f"{name}: not on an object, but on the table or outside the workspace; the nearest "
            f"pixel of an object is {columns[nearest]} {rows[nearest]}"
        )
    return labels == label


def target_in_box(labels: np.ndarray, box: Sequence[float]) -> np.ndarray:
    """(H, W) bool: the pixels of the object that a box (u0, v0, u1, v1), its corners in any order,
    is drawn around: the one with the largest share that is both in the object and among the raised
    pixels of the box (intersection over union). Raises UserError for a box that holds no object."""
    name = "box " + " ".join(f"{x:g}" for x in box)
    height, width = labels.shape
    if not np.isfinite(box).all():
        raise UserError(f"{name}: expected pixels U0 V0 U1 V1")
    within = labels[_within(box)]
    if within.size == 0:
        raise UserError(f"{name}: holds no pixel of the image of {width}x{height} pixels")
    inside = np.bincount(within[within >= 0], minlength=int(labels.max()) + 1)
    if inside.sum() < LEAST_PIXELS:
        raise UserError(f"{name}: no object in it, only the table or nothing; draw it around one")
    whole = np.bincount(labels[labels >= 0], minlength=len(inside))
    best = (inside / (whole + inside.sum() - inside)).argmax()
    return labels == best


def check_target(target: np.ndarray, frame: RGBDFrame, workspace: Workspace) -> None:
    """Raise UserError for a mask (H, W) in which next to nothing is above the table."""
    points = frame.points()[target]
    points = points[np.isfinite(points[:, 2])]
    if len(points) == 0:
        raise UserError("--mask: the depth is unknown at all pixels of the mask")
    beside = np.abs(points[:, :2] - workspace.centre).max(axis=1) > workspace.size / 2
    above = points[:, 2] > workspace.table_height + 0.004
    if (above & ~beside).sum() < LEAST_PIXELS:
        raise UserError(
            "--mask: shows only the table, or what is outside the workspace; mark an object"
        )


def marked_pixels(
    shape: tuple[int, ...],
    point: Sequence[float] | None,
    box: Sequence[float] | None,
    mask: np.ndarray | None,
) -> np.ndarray | None:
    """(H, W) bool, the pixels of an image of `shape` that a user has marked by a point, a box or a
    mask; None without any."""
    if point is not None:
        u, v = point
        box = u - CLICK_REACH, v - CLICK_REACH, u + CLICK_REACH, v + CLICK_REACH
    if box is not None:
        mask = np.zeros(shape, bool)
        mask[_within(box)] = True
    return mask


def _within(box: Sequence[float]) -> tuple[slice, slice]:
    """Rows and columns of a box (u0, v0, u1, v1), its corners in any order."""
    columns, rows = (
        slice(max(int(np.ceil(low)), 0), max(int(np.floor(high)) + 1, 0))
        for low, high in (sorted(box[::2]), sorted(box[1::2]))
    )
    return rows, columns
