"""Local maxima of an image, some distance apart: non-maximum suppression by a sliding window.

This module knows neither what the image means nor what becomes of its peaks.
"""

from __future__ import annotations

import cv2
import numpy as np


def local_maxima(
    image: np.ndarray, radius: int, above: float, count: int | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns (N,) of the highest pixels of their windows of side 2 radius + 1 in an
    `image` (H, W), highest first; only those `above` a value, and no more than `count`.

    Of equal pixels less than a window apart, the first in reading order stands for all.
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
