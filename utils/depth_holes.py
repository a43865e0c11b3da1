"""Pixels whose depth a camera did not measure: what they may show.

Depth cameras lose pixels at the edges of whatever stands up, in its shadow, and thin parts whole.
This module knows no grasps and no network.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from utils.transforms import RGBDFrame, deproject, known_depth

HOLE_REACH = 0.03  # m from a hole's rim to its middle, up to which it can be filled
TABLE_FLATNESS = 0.006  # m over the table, up to which a measured point is the table
SMEAR = 0.0036  # m by which cameras that match windows smear depth over an edge
# Colours, 0..255 in three channels: most that one may differ from the table's beside it, and so
# many times as much it has to differ from that of the nearest object.
LIKE_TABLE = 30.0
UNLIKE_OBJECT = 2.0


def fill_holes(depth: np.ndarray) -> np.ndarray:
    """(H, W) float32 depth whose unknown pixels take the value of the nearest known one."""
    depth = np.asarray(depth, np.float32)
    known = known_depth(depth)
    return depth if known.all() or not known.any() else nearest_values(depth, known)


def nearest_values(values: np.ndarray, of: np.ndarray) -> np.ndarray:
    """(H, W, ...) at each pixel the value of the nearest pixel `of` (H, W) bool, which has some."""
    _, label = cv2.distanceTransformWithLabels(
        (~of).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    value = np.zeros((label.max() + 1, *values.shape[2:]), values.dtype)
    value[label[of]] = values[of]
    return value[label]


def near_side(depth: np.ndarray, reach: int) -> np.ndarray:
    """(H, W) depth whose unknown pixels take the nearest surface around their hole, up to `reach`
    pixels away through the hole.

    Depth cameras lose pixels at the edges of whatever stands up, and thin parts whole; a finger
    that took such a hole for table would come down on them. Wider holes, whose middle is out of
    reach, stay 0: a black thing may fill them.
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


def reach_in_pixels(frame: RGBDFrame, metres: float) -> int:
    """How many pixels span so many metres at the median known depth; at least 1."""
    known = known_depth(frame.depth)
    depth = float(np.median(frame.depth[known])) if known.any() else np.inf
    return max(1, round(metres * (frame.K[0, 0] + frame.K[1, 1]) / 2 / depth))


def table_in_holes(frame: RGBDFrame, table_height: float) -> RGBDFrame:
    """The frame with the table's depth in those holes that have its colour.

    A hole beside an object is its shadow or a part of it: by depth alone nobody can tell, by colour
    often. What looks like the table beside it and unlike the nearest object becomes table; all
    else stays unknown, and so do wide holes, which may be a thing of that colour, or of glass.
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
    table, thing = (
        np.linalg.norm(colours - nearest_values(smooth, of)[holes], axis=-1) if of.any() else np.inf
        for of in (known & ~high, inside)
    )
    depth = frame.depth.copy()
    like_table = (table < LIKE_TABLE) & (UNLIKE_OBJECT * table < thing)
    depth[holes] = np.where(like_table, depth_of_plane(frame, table_height)[holes], depth[holes])
    return replace(frame, depth=depth)


def _eroded(mask: np.ndarray, radius: int) -> np.ndarray:
    """A mask (H, W) without its rim; pieces of which nothing would be left stay whole."""
    window = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    inside = cv2.erode(mask.astype(np.uint8), window) > 0
    count, piece = cv2.connectedComponents(mask.astype(np.uint8))
    left = np.zeros(count, bool)
    left[piece[inside]] = True
    return inside | (mask & ~left[piece])


def depth_of_plane(frame: RGBDFrame, height: float) -> np.ndarray:
    """(H, W) depth at which each pixel's ray meets the plane z = height; infinite or negative where
    it does not."""
    v, u = np.mgrid[: frame.depth.shape[0], : frame.depth.shape[1]]
    along = deproject(np.stack([u, v], axis=-1), np.ones(u.shape), frame.K, frame.T_WC)
    with np.errstate(divide="ignore"):
        return (height - frame.T_WC[2, 3]) / (along[..., 2] - frame.T_WC[2, 3])
