"""Depth as a structured-light camera such as the first Kinect measures it, from a clean rendering.

Four effects, after Handa et al., "A benchmark for RGB-D visual odometry, 3D reconstruction and
SLAM" (ICRA 2014), Barron and Malik, "Intrinsic scene properties from a single RGB-D image" (CVPR
2013), and Bohg et al., "Robot arm pose estimation through pixel-wise part classification" (ICRA
2014), whose window of projected dots makes the holes. Knows no camera but what its parameters say,
no simulator and no network.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

if TYPE_CHECKING:
    import torch

_PATTERN_SEED = 1975  # the projector's pattern is the same for ever; any number would do
_DOT_CELL = 3  # sensor pixels: the pattern has one dot in each square of this side
_INLIER_GROWTH = 1.2**2  # Bohg et al.: far from the centre, disparities may differ by this x r^2


@dataclass(frozen=True)
class KinectNoise:
    """A noisy measurement of a clean depth image: `noise(depth, rng)`.

    image_focal: pixels, focal length of the images that are given. focal, baseline: pixels and
    metres, of the sensor (480 px at 640 x 480). Lengths below are the sensor's pixels, and become
    image_focal / focal as many of the image's, so that the same sensor can be seen at any
    resolution.
    shift: standard deviation, pixels, by which each pixel looks beside its place.
    step: pixels, in which disparities are counted. noise: standard deviation of a disparity in
    steps. Barron and Malik's formula 35130 / round(35130 / z + N(0, 1/6) + 0.5), z in centimetres,
    counts 35130 cm = 585.5 px x 7.5 cm x 8, hence eighths of a pixel: their 1/6 is 1/6 of a step.
    (Of a pixel, it would be 3 mm at 0.8 m, three times what Khoshelham and Elberink, Sensors 2012,
    measured.) Their 0.5 undoes a truncation that is not made here.
    window: pixels, odd; side of the square in which dots are matched. tolerance: pixels, by which a
    dot one pixel from the centre may differ from the window's mean. support: a match needs more
    than this share of the window's dots.
    """

    image_focal: float = 480.0
    focal: float = 480.0
    baseline: float = 0.075
    shift: float = 0.5
    noise: float = 1 / 6
    step: float = 1 / 8
    window: int = 9
    tolerance: float = 0.1
    support: float = 1 / 1.2

    def __post_init__(self) -> None:
        for name in ("image_focal", "focal", "baseline", "step", "tolerance"):
            if not getattr(self, name) > 0:
                raise ValueError(f"KinectNoise.{name} must be > 0, got {getattr(self, name)}")
        for name in ("shift", "noise"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"KinectNoise.{name} must be >= 0, got {getattr(self, name)}")
        if self.window < 3 or self.window % 2 == 0:
            raise ValueError(f"KinectNoise.window must be odd and >= 3, got {self.window}")

    def __call__(self, depth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """(H, W) float32 metres as measured; 0 where there is no measurement.

        depth: (H, W) metres along the optical axis, 0 (or NaN) where unknown. Always draws
        3 x H x W normal deviates. Raises ValueError for an image smaller than the window.
        """
        depth = np.asarray(depth, dtype=np.float32)
        if depth.ndim != 2 or min(depth.shape) < self.matching.window:
            raise ValueError(
                f"KinectNoise: depth must be (H, W) and at least {self.matching.window} pixels "
                f"either way, got {depth.shape}"
            )
        draws = rng.standard_normal((3, *depth.shape), dtype=np.float32)
        disparity = self._matched(self._looked_up(depth, draws[0], draws[1]))
        steps = np.rint(disparity / self.step + self.noise * draws[2])
        with np.errstate(divide="ignore"):
            measured = np.float32(self.focal * self.baseline / self.step) / steps
        return np.where((disparity > 0) & (steps > 0), measured, np.float32(0))

    def on_tensor(self, depth: torch.Tensor, rng: np.random.Generator) -> torch.Tensor:
        """The same for a tensor (H, W): `Augmentation(depth_noise=KinectNoise().on_tensor)`."""
        return depth.new_tensor(self(depth.cpu().numpy(), rng))

    @cached_property
    def matching(self) -> Matching:
        """The window and its tolerances, in pixels of the image."""
        scale = self.image_focal / self.focal
        half = max(1, round((self.window - 1) / 2 * scale))
        across = np.arange(-half, half + 1)
        squared = across[:, None] ** 2 + across**2
        allowed = self.tolerance * np.maximum(1, _INLIER_GROWTH * squared / scale**2)
        return Matching(
            window=2 * half + 1,
            cell=max(1, round(_DOT_CELL * scale)),
            reach=max(1, round(self.window / 3 * scale)),
            allowed=allowed.astype(np.float32),
        )

    def _looked_up(self, depth: np.ndarray, du: np.ndarray, dv: np.ndarray) -> np.ndarray:
        """(H, W) disparities a little beside each pixel; 0 where one that is needed is unknown.

        Disparities, not depths, are interpolated: those of a plane are linear in the image.
        """
        height, width = depth.shape
        known = depth > 0
        disparity = np.full_like(depth, np.nan)
        np.divide(np.float32(self.focal * self.baseline), depth, out=disparity, where=known)
        sigma = np.float32(self.shift * self.image_focal / self.focal)
        u = sigma * du + np.arange(width, dtype=np.float32)
        v = sigma * dv + np.arange(height, dtype=np.float32)[:, None]
        found = cv2.remap(disparity, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.nan_to_num(found, copy=False, nan=0.0)

    def _matched(self, disparity: np.ndarray) -> np.ndarray:
        """(H, W) disparities where the pattern is recognised, 0 elsewhere.

        A dot is recognised if enough of the dots around it have its window's mean disparity. A
        pixel takes over the nearest recognised dot within reach; of equally near ones the upper,
        then the left one.
        """
        matching = self.matching
        size = (matching.window, matching.window)
        pattern = dot_pattern(*disparity.shape, matching.cell)
        rows, cols, dots_around = _whole_windows(*disparity.shape, matching.cell, matching.window)
        kernel = np.ones(size, np.uint8)
        spread = cv2.dilate(disparity, kernel) - cv2.erode(disparity, kernel)
        recognised = disparity[rows, cols] > 0
        # Where nothing differs by the least tolerance every dot agrees; look at the others only.
        doubtful = np.flatnonzero(recognised & (spread[rows, cols] >= self.tolerance))
        centre = rows[doubtful], cols[doubtful]
        total, count = (
            cv2.boxFilter(image, cv2.CV_64F, size, normalize=False)[centre]
            for image in (disparity, (disparity > 0).astype(np.float32))
        )
        mean = (total / count).astype(np.float32)
        corner = tuple(index - matching.window // 2 for index in centre)
        around = sliding_window_view(disparity, size)[corner]
        agree = np.abs(around - mean[:, None, None]) < matching.allowed
        agree &= around > 0
        agree &= sliding_window_view(pattern, size)[corner]
        agreeing = agree.sum(axis=(1, 2), dtype=np.uint16)
        recognised[doubtful] = agreeing > self.support * dots_around[doubtful]
        rows, cols = rows[recognised], cols[recognised]
        matched = np.zeros_like(disparity)
        flat, stride = matched.reshape(-1), matched.shape[1]
        index, value = rows * stride + cols, disparity[rows, cols]
        for dv, du in _farthest_first(matching.reach):  # the nearest is written last
            flat[index + (dv * stride + du)] = value
        return matched


class Matching(NamedTuple):
    """window: pixels, odd. cell: pixels, side of the square with one dot. reach: pixels, radius
    that a dot speaks for. allowed: (window, window) pixels of disparity."""

    window: int
    cell: int
    reach: int
    allowed: np.ndarray


@lru_cache(maxsize=32)
def dot_pattern(height: int, width: int, cell: int) -> np.ndarray:
    """(H, W) bool, the projector's dots: one at a random place in each square of `cell` pixels."""
    rng = np.random.default_rng(_PATTERN_SEED)
    corners = np.mgrid[0:height:cell, 0:width:cell]
    rows, cols = corners + rng.integers(cell, size=corners.shape)
    inside = (rows < height) & (cols < width)
    pattern = np.zeros((height, width), dtype=bool)
    pattern[rows[inside], cols[inside]] = True
    pattern.flags.writeable = False
    return pattern


@lru_cache(maxsize=32)
def _whole_windows(
    height: int, width: int, cell: int, window: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows and columns (N,) of the dots whose window lies in the image, and the dots in each."""
    pattern, margin = dot_pattern(height, width, cell), window // 2
    inside = np.zeros_like(pattern)
    inside[margin : height - margin, margin : width - margin] = True
    rows, cols = np.nonzero(pattern & inside)
    windows = sliding_window_view(pattern, (window, window))[rows - margin, cols - margin]
    return rows, cols, windows.sum(axis=(1, 2))


@lru_cache(maxsize=32)
def _farthest_first(reach: int) -> tuple[tuple[int, int], ...]:
    """Offsets (dv, du) of a disc's pixels; among equally far ones in reading order."""
    across = range(-reach, reach + 1)
    disc = [(dv, du) for dv in across for du in across if dv**2 + du**2 <= reach**2]
    return tuple(sorted(disc, key=lambda offset: (-(offset[0] ** 2) - offset[1] ** 2, *offset)))
