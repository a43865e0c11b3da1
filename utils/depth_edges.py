"""Depth beside edges, told by colour.

A camera that matches windows smears an edge over its window, and loses pixels there; the colour
image has the same edge sharp. This module knows no grasps and no network.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from utils.depth_holes import reach_in_pixels
from utils.transforms import RGBDFrame, known_depth

STEP = 0.008  # m between neighbouring pixels: an edge
SMEARED = 0.0054  # m beside an edge or a hole, within which measured depth is not to be relied on
REACH = 0.016  # m, how far away a pixel looks for one that is
LIKE = 12.0  # standard deviation of the colours of one surface, 0..255, over three channels
LEAST = 0.05  # likeness under which a pixel keeps what was measured


def depth_by_colour(frame: RGBDFrame) -> RGBDFrame:
    """The frame with the depth beside edges and holes taken from the pixel that is most like it.

    A joint bilateral filter (Petschnigg et al. and Eisemann and Durand, SIGGRAPH 2004) that takes
    the best match instead of the mean, which would put points between two surfaces. Pixels that
    nothing reliable resembles, such as those of thin parts, stay as they are.
    """
    depth = frame.depth.astype(np.float32)
    reliable = known_depth(depth)
    unsure = ~reliable | _steps(depth, reliable)
    radius = reach_in_pixels(frame, SMEARED)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    unsure = cv2.dilate(unsure.astype(np.uint8), disc) > 0
    reliable &= ~unsure
    if not unsure.any() or not reliable.any():
        return frame

    reach = reach_in_pixels(frame, REACH)
    smooth = _framed(cv2.medianBlur(frame.rgb, 3), reach).reshape(-1, 3).astype(np.float32)
    known = _framed(np.where(reliable, depth, np.float32(0)), reach).ravel()
    row, column = np.nonzero(unsure)
    stride = frame.depth.shape[1] + 2 * reach
    here, own = (row + reach) * stride + column + reach, frame.rgb[row, column].astype(np.float32)
    likeness = np.full(len(here), LEAST, np.float32)
    found = np.zeros(len(here), np.float32)
    for shift, squared in _around(reach, stride):
        there = np.flatnonzero(known[here + shift])
        at = here[there] + shift
        far = np.sum((smooth[at] - own[there]) ** 2, axis=-1) / (2 * LIKE**2)
        like = np.exp(-far - 2 * squared / reach**2)
        better = like > likeness[there]
        likeness[there[better]] = like[better]
        found[there[better]] = known[at[better]]
    told = found > 0
    depth[row[told], column[told]] = found[told]
    return replace(frame, depth=depth)


def _steps(depth: np.ndarray, known: np.ndarray) -> np.ndarray:
    """(H, W) bool: known depths differ by more than STEP around the pixel."""
    window, none = np.ones((3, 3), np.uint8), np.float32(1e6)
    farthest = cv2.dilate(np.where(known, depth, -none), window)
    return farthest - cv2.erode(np.where(known, depth, none), window) > STEP


def _framed(image: np.ndarray, width: int) -> np.ndarray:
    return cv2.copyMakeBorder(image, width, width, width, width, cv2.BORDER_CONSTANT, value=0)


def _around(reach: int, stride: int) -> list[tuple[int, int]]:
    """Flat shift and squared length of every offset within reach, of every second one far away."""
    across = range(-reach, reach + 1)
    return [
        (dv * stride + du, dv**2 + du**2)
        for dv in across
        for du in across
        if 0 < dv**2 + du**2 <= reach**2 and (dv**2 + du**2 <= 16 or (dv % 2 == 0 and du % 2 == 0))
    ]
