"""Images resampled to another pixel size, and pixels, angles and maps taken back exactly.

A `PixelScaling` is one factor for each image axis. Integer coordinates lie at pixel centres, so
pixel u becomes (u + 0.5) * factor - 0.5. This module knows neither networks nor grasps.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np


@dataclass(frozen=True)
class PixelScaling:
    """u, v: scaled pixels per original pixel along each axis, > 0."""

    u: float
    v: float

    @staticmethod
    def to_focal_length(K: np.ndarray, focal: float) -> PixelScaling:
        """Makes the camera's two focal lengths equal to `focal` pixels, and so its pixels square.

        With square pixels already, this is one factor for both axes.
        """
        return PixelScaling(focal / K[0, 0], focal / K[1, 1])

    def intrinsics(self, K: np.ndarray) -> np.ndarray:
        """The (3, 3) pinhole matrix of the scaled image."""
        centre = self.pixels(K[:2, 2])
        return np.array(
            [[K[0, 0] * self.u, 0.0, centre[0]], [0.0, K[1, 1] * self.v, centre[1]], [0, 0, 1]]
        )

    def size(self, shape: tuple[int, int]) -> tuple[int, int]:
        """(H, W) of the scaled image: the pixels that the original covers whole."""
        # Up to rounding: 0.7 * 320 must not lose a row to floating point.
        return int(shape[0] * self.v + 1e-6), int(shape[1] * self.u + 1e-6)

    def pixels(self, pixels: np.ndarray) -> np.ndarray:
        """Scaled places of original pixels (..., 2) as (u, v)."""
        return (np.asarray(pixels, float) + 0.5) * (self.u, self.v) - 0.5

    def original_pixels(self, pixels: np.ndarray) -> np.ndarray:
        """Original places of scaled pixels (..., 2). Inverse of `pixels`."""
        return (np.asarray(pixels, float) + 0.5) / (self.u, self.v) - 0.5

    def original_angles(self, angles: np.ndarray) -> np.ndarray:
        """Original directions, in [0, pi), of lines at `angles` (...) in the scaled image."""
        return np.mod(np.arctan2(np.sin(angles) / self.v, np.cos(angles) / self.u), np.pi)

    def image(self, image: np.ndarray) -> np.ndarray:
        """The scaled image of (H, W) or (H, W, C), float32 or uint8.

        Area averages where it shrinks, so that nothing aliases; linear where it grows.
        """
        rows, columns = self.size(image.shape[:2])
        for along_u, along_v in ((self.u, 1.0), (1.0, self.v)):
            method = cv2.INTER_AREA if min(along_u, along_v) < 1 else cv2.INTER_LINEAR
            # Factors, not a size: a size would round them.
            image = cv2.resize(image, None, fx=along_u, fy=along_v, interpolation=method)
        return np.ascontiguousarray(image[:rows, :columns])

    def original_map(self, values: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
        """A scaled map (h, w) float32, linearly interpolated at the original's (H, W) pixels."""
        # The matrix takes an original pixel to its scaled place, as WARP_INVERSE_MAP wants it.
        matrix = np.array(
            [[self.u, 0.0, (self.u - 1) / 2], [0.0, self.v, (self.v - 1) / 2]], dtype=float
        )
        return cv2.warpAffine(
            values,
            matrix,
            (shape[1], shape[0]),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        )
