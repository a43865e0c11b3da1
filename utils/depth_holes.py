"""What unmeasured pixels of a depth image may show.

Holes (pixels without a depth) lie at the edges of whatever stands up, in its shadow, and cover thin
parts. `near_side`, `table_in_holes`, `surfaces_in_holes` and `fill_holes` fill them, each for
another purpose. `check_rgbd` refuses images whose depth cannot be meant. This module knows no
simulator, no network and no grasps.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from utils.compiled import compiled
from utils.depth import farthest_first
from utils.errors import UserError
from utils.transforms import RGBDFrame, check_images, known_depth, ray_component

PLAUSIBLE_DEPTH = (0.05, 10.0)  # metres; millimetres read as metres lie far above, from 50 up
HOLE_REACH = 0.03  # m from a hole's rim to its middle, up to which it can be filled
TABLE_FLATNESS = 0.006  # m over the table, up to which a measured point is the table
SMEAR = 0.0036  # m by which cameras that match windows smear depth over an edge
# What differs from the table's colour by less than LIKE_TABLE (three channels, 0..255) may be it; a
# hole is, if its colour differs UNLIKE_OBJECT times as much from the nearest object's.
LIKE_TABLE = 30.0
UNLIKE_OBJECT = 2.0
# A hole is at an edge where measured depths around it, EDGE_REACH metres and EDGE_PIXELS at least
# away, differ by EDGE_STEP metres. In other holes may stand a thin part that was lost whole.
EDGE_REACH, EDGE_PIXELS = 0.0035, 3
EDGE_STEP = 0.012
SURFACE_REACH = 0.012  # m around a hole's pixel in which a surface of its colour is looked for
LIKE_SURFACE = 20.0  # by less than this differ the colours of one surface, three channels together


def fill_holes(depth: np.ndarray) -> np.ndarray:
    """(H, W) float32 depth whose unknown pixels take the value of the nearest known one."""
    depth = np.asarray(depth, np.float32)
    known = known_depth(depth)
    return depth if known.all() or not known.any() else nearest_values(depth, known)


def nearest_values(values: np.ndarray, of: np.ndarray, at: np.ndarray | None = None) -> np.ndarray:
    """(H, W, ...) at each pixel the value of the nearest pixel in the mask `of` (H, W) bool.

    at: (H, W) bool, the N pixels for which alone it is asked; the result is (N, ...) then. The mask
    `of` has to hold at least one pixel.
    """
    _, label = cv2.distanceTransformWithLabels(
        (~of).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    value = np.zeros((label.max() + 1, *values.shape[2:]), values.dtype)
    value[label[of]] = values[of]
    return value[label if at is None else label[at]]


def near_side(depth: np.ndarray, reach: int) -> np.ndarray:
    """(H, W) depth whose unknown pixels take the nearest surface around their hole, up to `reach`
    pixels away through the hole.

    Depth cameras lose pixels at the edges of whatever stands up, and thin parts whole; a finger
    that took such a hole for table would collide with them. Wider holes, whose middle is out of
    reach, stay 0: a black object may fill them.
    """
    unknown = ~known_depth(depth)
    if not unknown.any():
        return depth
    far = np.float32(np.finfo(np.float32).max)
    known = nearest = np.where(unknown, far, depth).astype(np.float32)
    for _ in range(reach):
        nearest = np.where(unknown, cv2.erode(nearest, np.ones((3, 3), np.uint8)), known)
    return np.where((nearest < far) & ~_wide(unknown, reach), nearest, np.float32(0))


def _wide(unknown: np.ndarray, reach: int) -> np.ndarray:
    """(H, W) bool: holes that hold a square of 2 reach + 1 pixels."""
    square = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    return cv2.morphologyEx(unknown.astype(np.uint8), cv2.MORPH_OPEN, square) > 0


def at_edges(frame: RGBDFrame) -> np.ndarray:
    """(H, W) bool: pixels within EDGE_REACH metres, or EDGE_PIXELS where that is more, of measured
    depths that differ by more than EDGE_STEP."""
    known = known_depth(frame.depth)
    reach = max(reach_in_pixels(frame, EDGE_REACH), EDGE_PIXELS)
    square = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    farthest = cv2.dilate(np.where(known, frame.depth, 0).astype(np.float32), square)
    nearest = cv2.erode(np.where(known, frame.depth, np.inf).astype(np.float32), square)
    return farthest - nearest > EDGE_STEP


def sampled(values: np.ndarray, most: int = 10_000) -> np.ndarray:
    """At most so many of values (N, ...), evenly spread: enough for statistics, and quicker."""
    if len(values) <= most:
        return values
    return values[np.linspace(0, len(values) - 1, most).astype(int)]


def check_rgbd(rgb: np.ndarray, depth: np.ndarray) -> float:
    """Return the median of the known depths, in metres.

    Raises UserError for wrong shapes or types, for an image without known depth, and for a median
    outside `PLAUSIBLE_DEPTH`.
    """
    check_images(rgb, depth)
    known = depth[known_depth(depth)]
    if len(known) == 0:
        raise UserError("depth: no pixel is known; all are zero, negative or NaN")
    typical, (low, high) = float(np.median(known)), PLAUSIBLE_DEPTH
    if not low <= typical <= high:
        raise UserError(
            f"depth: the median is {typical:.4g} m, expected {low:g} to {high:g} m; check its unit "
            "(predict.py: --depth-scale is the metres for 1 in the file, 0.001 for millimetres, 1 "
            "for metres)"
        )
    return typical


def middle_depth(frame: RGBDFrame) -> float:
    """The median known depth, m, of a sample of the pixels; infinite where none is known."""
    known = sampled(frame.depth[known_depth(frame.depth)])
    return float(np.median(known)) if len(known) else np.inf


def reach_in_pixels(frame: RGBDFrame, metres: float) -> int:
    """The number of pixels that span `metres` at the median known depth; at least 1."""
    return max(1, round(metres * (frame.K[0, 0] + frame.K[1, 1]) / 2 / middle_depth(frame)))


def table_in_holes(frame: RGBDFrame, table_height: float) -> RGBDFrame:
    """The frame with the table's depth in those holes that have its colour.

    A hole beside an object is its shadow or a part of it: depth alone cannot tell, colour often
    can. A pixel that has the colour of the table beside it and not that of the nearest object
    becomes table. All others stay unknown, and so do wide holes, which an object of the table's
    colour, or of glass, may fill.
    """
    known = known_depth(frame.depth)
    if known.all() or not known.any():
        return frame
    high = known & (frame.depth < depth_of_plane(frame, table_height + TABLE_FLATNESS))
    # Smeared pixels have the colour of what lies behind.
    inside = _eroded(high, reach_in_pixels(frame, SMEAR))
    smooth = cv2.medianBlur(frame.rgb, 3)
    holes = ~known & ~_wide(~known, reach_in_pixels(frame, HOLE_REACH))
    colours = frame.rgb[holes].astype(float)
    table, item = (
        np.linalg.norm(colours - nearest_values(smooth, of, holes), axis=-1) if of.any() else np.inf
        for of in (known & ~high, inside)
    )
    depth = frame.depth.copy()
    like_table = (table < LIKE_TABLE) & (UNLIKE_OBJECT * table < item)
    depth[holes] = np.where(like_table, depth_of_plane(frame, table_height)[holes], depth[holes])
    return replace(frame, depth=depth)


def surfaces_in_holes(frame: RGBDFrame) -> RGBDFrame:
    """The frame with the depth of the surfaces beside them in those holes that have their colour.

    The lost rim of an object has the object's colour, and the shadow beside it that of what lies
    below. Each pixel takes the depth of the nearest measured pixel within SURFACE_REACH whose
    colour differs by less than LIKE_SURFACE; where there is none it stays unknown. So do holes
    that are not `at_edges`.
    """
    known = known_depth(frame.depth)
    if known.all() or not known.any():
        return frame
    reach = reach_in_pixels(frame, SURFACE_REACH)
    nearest_first = np.array(farthest_first(reach)[::-1])
    depth = _from_alike(frame.depth, frame.rgb, known, ~known & at_edges(frame), nearest_first)
    return replace(frame, depth=depth)


@compiled
def _from_alike(
    depth: np.ndarray, rgb: np.ndarray, known: np.ndarray, holes: np.ndarray, steps: np.ndarray
) -> np.ndarray:
    """The depth (H, W) with that of the first known pixel, steps (K, 2) down and right away, whose
    colour is like their own in the holes (H, W); 0 in other pixels that are not known."""
    filled = np.where(known, depth, depth.dtype.type(0))
    rows, columns = depth.shape
    for v in range(rows):
        for u in range(columns):
            if not holes[v, u]:
                continue
            for k in range(len(steps)):
                y, x = v + steps[k, 0], u + steps[k, 1]
                if not (0 <= y < rows and 0 <= x < columns and known[y, x]):
                    continue
                difference = 0
                for channel in range(3):
                    apart = int(rgb[y, x, channel]) - int(rgb[v, u, channel])
                    difference += apart * apart
                if difference < LIKE_SURFACE**2:
                    filled[v, u] = depth[y, x]
                    break
    return filled


def _eroded(mask: np.ndarray, radius: int) -> np.ndarray:
    """A mask (H, W) without its rim; pieces that would vanish stay whole."""
    window = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    inside = cv2.erode(mask.astype(np.uint8), window) > 0
    count, piece = cv2.connectedComponents(mask.astype(np.uint8))
    left = np.zeros(count, bool)
    left[piece[inside]] = True
    return inside | (mask & ~left[piece])


def depth_of_plane(frame: RGBDFrame, height: float) -> np.ndarray:
    """(H, W) depth at which each pixel's ray meets the plane z = height in W; infinite or negative
    where it does not."""
    down = ray_component(2, frame.depth.shape, frame.K, frame.T_WC)
    with np.errstate(divide="ignore"):
        return (height - frame.T_WC[2, 3]) / down
