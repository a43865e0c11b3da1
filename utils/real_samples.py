"""A real image with its labels, and the part of it that a network sees.

`utils.real_data` reads samples from disk and has the view of each format's camera. This module
knows no file format, no network and no simulator.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from utils.rectangles import GraspRectangle
from utils.table_plane import robust_fit

FLAT = 0.005  # of the table's distance: noise, below which a pixel belongs to the table
TABLE_STEP = 8  # pixels between those to which the table is fitted


@dataclass(frozen=True, eq=False)
class RealSample:
    """One real image with its labels.

    name: the image's id. object_id: images with the same id show the same object.
    rgb: (H, W, 3) uint8. depth: (H, W) float32 metres along the optical axis, holes filled.
    positives, negatives: rectangles in pixels of this image; Jacquard has no negatives.
    skipped: rectangles left out because a corner is NaN.
    """

    name: str
    object_id: str
    rgb: np.ndarray
    depth: np.ndarray
    positives: tuple[GraspRectangle, ...]
    negatives: tuple[GraspRectangle, ...] = ()
    skipped: int = 0


@dataclass(frozen=True)
class View:
    """The central square of a camera's images, resampled for the network.

    side: pixels of the image that the square measures; it never depends on the labels. size: pixels
    that it measures for the network. metres_per_pixel: the length that one of these spans at the
    image's typical depth; it converts widths between pixels and metres. slanted: whether the camera
    sees the table from the side, so that its samples need `levelled`.
    """

    side: int
    size: int
    metres_per_pixel: float
    slanted: bool = False

    def matrix(self, shape: tuple[int, int]) -> np.ndarray:
        """Return the (3, 3) matrix from a pixel (u, v, 1) of an image (H, W) to the view's."""
        zoom = self.size / self.side
        height, width = shape
        matrix = np.diag([zoom, zoom, 1.0])
        matrix[:2, 2] = (self.size - 1) / 2 - zoom * np.array([width - 1, height - 1]) / 2
        return matrix

    def warp(
        self, sample: RealSample, change: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray, list[GraspRectangle]]:
        """Return rgb (size, size, 3) uint8, depth (size, size) metres and the labelled rectangles
        in the view, after a `change` (3, 3) of the view's pixels. The image's border is repeated
        beyond it."""
        matrix = self.matrix(sample.depth.shape)
        matrix = matrix if change is None else change @ matrix
        rgb, depth = (
            cv2.warpAffine(
                image, matrix[:2], (self.size, self.size), flags=method,
                borderMode=cv2.BORDER_REPLICATE,
            )
            for image, method in ((sample.rgb, cv2.INTER_LINEAR), (sample.depth, cv2.INTER_NEAREST))
        )  # fmt: skip
        return rgb, depth, [rectangle.transformed(matrix) for rectangle in sample.positives]

    def levelled(self, sample: RealSample) -> RealSample:
        """Return the sample with depth as if every ray met the table at the same distance.

        In a slanted view depth depends mostly on the place on the table; levelled, it depends on
        the height above the table, as in images from above. The square has to show mostly table.
        """
        inverse = _inverse_table(sample.depth, self.side)
        middle = float(np.median(_central(inverse, self.side)))
        return replace(sample, depth=(sample.depth * (inverse / middle)).astype(np.float32))


def _inverse_table(depth: np.ndarray, side: int) -> np.ndarray:
    """Return one over the table's depth, (H, W) in 1/m: a quadratic of the pixel.

    For a plane it is linear; the squares absorb lens distortion, and ranges in place of depths. The
    fit over the central square is robust: objects and walls are far off the table and hardly count.
    """
    height, width = depth.shape
    v, u = (np.mgrid[:height, :width] - np.reshape([height / 2, width / 2], (2, 1, 1))) / side
    terms = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1)
    seen = _central(terms * depth[..., None], side)[::TABLE_STEP, ::TABLE_STEP].reshape(-1, 6)
    start = np.linalg.lstsq(seen, np.ones(len(seen)), rcond=None)[0]
    found, _ = robust_fit(lambda x: seen @ x - 1, start, FLAT, jac=lambda x: seen)
    return terms @ found


def _central(image: np.ndarray, side: int) -> np.ndarray:
    """Return the square of `side` pixels in the middle of (H, W, ...), or less in small images."""
    top, left = (max(0, (length - side) // 2) for length in image.shape[:2])
    return image[top : top + side, left : left + side]
