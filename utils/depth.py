"""Depth as a structured-light camera such as the first Kinect measures it, from a clean rendering.

Four effects, after Handa et al., "A benchmark for RGB-D visual odometry, 3D reconstruction and
SLAM" (ICRA 2014), Barron and Malik, "Intrinsic scene properties from a single RGB-D image" (CVPR
2013), and Bohg et al., "Robot arm pose estimation through pixel-wise part classification" (ICRA
2014), whose window of projected dots makes the holes. Knows no camera but what its parameters say,
no simulator and no network.

Pixels whose depth a camera did not measure: what they may show.

Depth cameras lose pixels at the edges of whatever stands up, in its shadow, and thin parts whole.
This module knows no grasps and no network.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from utils.transforms import RGBDFrame, deproject, known_depth

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
