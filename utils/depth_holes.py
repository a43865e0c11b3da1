"""Pixels whose depth a camera did not measure: what they may show.

Depth cameras lose pixels at the edges of whatever stands up, in its shadow, and thin parts whole.
This module knows no grasps and no network.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from utils.transforms import RGBDFrame, deproject, known_depth

TABLE_FLATNESS = 0.006  # m over the table, up to which a measured point is the table
LIKE_TABLE = (
    30.0  # most that a colour, 0..255 in three channels, differs from the table's beside it
)
UNLIKE_OBJECT = 2.0  # and so many times as much it differs from that of the nearest object


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
    square = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    wide = cv2.morphologyEx(unknown.astype(np.uint8), cv2.MORPH_OPEN, square) > 0
    return np.where((nearest < far) & ~wide, nearest, np.float32(0))


def table_in_holes(frame: RGBDFrame, table_height: float) -> RGBDFrame:
    """The frame with the table's depth in those holes that have its colour.

    A hole beside an object is its shadow or a part of it: by depth alone nobody can tell, by colour
    often. What looks like the table beside it and unlike the nearest object becomes table; all
    else stays unknown.
    """
    known = known_depth(frame.depth)
    if known.all() or not known.any():
        return frame
    plane = depth_of_plane(frame, table_height)
    high = known & (frame.depth < depth_of_plane(frame, table_height + TABLE_FLATNESS))
    # Cameras that match windows smear depth over edges: colours are taken from farther inside.
    inside = cv2.erode(high.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    table, thing = (_colour_distance(frame.rgb, ~known, of) for of in (known & ~high, inside))
    depth = frame.depth.copy()
    like_table = (table < LIKE_TABLE) & (UNLIKE_OBJECT * table < thing)
    depth[~known] = np.where(like_table, plane[~known], 0)
    return replace(frame, depth=depth)


def _colour_distance(rgb: np.ndarray, where: np.ndarray, of: np.ndarray) -> np.ndarray:
    """(N,) how much the colours of the N pixels `where` differ from that of the nearest pixel `of`;
    both (H, W) bool."""
    if not of.any():
        return np.full(where.sum(), np.inf)
    _, label = cv2.distanceTransformWithLabels(
        (~of).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    nearest = np.zeros((label.max() + 1, 3))
    nearest[label[of]] = rgb[of]
    return np.linalg.norm(rgb[where] - nearest[label[where]], axis=-1)


def depth_of_plane(frame: RGBDFrame, height: float) -> np.ndarray:
    """(H, W) depth at which each pixel's ray meets the plane z = height; infinite or negative where
    it does not."""
    v, u = np.mgrid[: frame.depth.shape[0], : frame.depth.shape[1]]
    along = deproject(np.stack([u, v], axis=-1), np.ones(u.shape), frame.K, frame.T_WC)
    with np.errstate(divide="ignore"):
        return (height - frame.T_WC[2, 3]) / (along[..., 2] - frame.T_WC[2, 3])
