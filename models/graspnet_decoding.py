"""From a network's maps of one image to ranked grasps at the peaks of the quality map.

Angles on the image are those of the closing line from +u (right) towards +v (down), modulo pi; bin
k of K is centred at k * 180 / K degrees. Widths are metres. This module knows neither a simulator
nor the source of the maps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import torch

from utils.geometry import GripperGeometry
from utils.grasp_labels import LabelSettings, grasp_below_surface
from utils.height_map import local_maxima
from utils.transforms import Grasp, ImageGrasp, known_depth

LABELS = LabelSettings()


@dataclass(frozen=True)
class PeakSettings:
    """The conditions under which a pixel becomes a grasp."""

    threshold: float = 0.5  # the quality that a peak has to exceed
    count: int = 20  # the largest number of peaks
    radius: int = 4  # pixels; no two peaks are this close in both u and v
    blur: float = 1.0  # pixels, standard deviation of the Gaussian over the quality; 0: no blur


HIGHEST_PEAK = PeakSettings(threshold=-1.0, count=1)  # however low it is


class Peaks(NamedTuple):
    """N peaks of the quality map, best first.

    pixel: (N, 2) as (u, v), not rounded. angle: (N,) on the image, in [0, pi). width: (N,) metres.
    quality: (N,) in [0, 1].
    """

    pixel: np.ndarray
    angle: np.ndarray
    width: np.ndarray
    quality: np.ndarray


def decode_grasps(
    quality: torch.Tensor,
    angle: torch.Tensor,
    width: torch.Tensor,
    K: np.ndarray,
    T_WC: np.ndarray,
    depth: np.ndarray,
    gripper: GripperGeometry,
    table_height: float = 0.0,
    labels: LabelSettings = LABELS,
    peaks: PeakSettings = PeakSettings(),
) -> list[Grasp]:
    """Return top-down grasps in W, best first; none if no quality exceeds the threshold.

    quality, angle, width: the maps that `GraspNet` returns for one image. K: (3, 3), T_WC: (4, 4),
    depth: (H, W) metres, 0 = unknown. table_height: z of the table in W, metres. The fingertips go
    straight down from the surface point that the pixel shows, as deep as the labels assume
    (`grasp_below_surface`); the width is limited to the gripper's opening. Peaks without known
    depth beside them are left out.
    """
    found = surface_grasps(find_peaks(quality, angle, width, peaks), depth, gripper)
    return [grasp_below_surface(grasp, K, T_WC, table_height, gripper, labels) for grasp in found]


def surface_grasps(found: Peaks, depth: np.ndarray, gripper: GripperGeometry) -> list[ImageGrasp]:
    """Place peaks on the visible surface: the depth is the median around them, and the width is
    limited to the gripper's opening. Peaks without known depth beside them are left out.
    """
    return [
        ImageGrasp(
            pixel, float(angle), surface, min(float(width), gripper.max_opening), float(quality)
        )
        for pixel, angle, width, quality, surface in zip(
            *found, surface_depth(depth, found.pixel).tolist()
        )
        if not np.isnan(surface)
    ]


def find_peaks(
    quality: torch.Tensor,
    angle: torch.Tensor,
    width: torch.Tensor,
    settings: PeakSettings = PeakSettings(),
) -> Peaks:
    """Find the local maxima of one image's quality map, with the angle and width there.

    quality, width: (..., H, W) and angle: (..., K, H, W), whose leading dimensions are 1. A peak is
    the highest pixel of its window (max-pool non-maximum suppression); of equal pixels the first.
    """
    shape = quality.shape[-2:]
    score, row, column = _peak_pixels(quality, settings)
    at = (..., torch.from_numpy(row), torch.from_numpy(column))
    probability = angle.detach().reshape(-1, *shape)[at].float().softmax(dim=0).cpu().numpy()
    return Peaks(
        np.stack([column, row], axis=-1) + _subpixel(score, row, column),
        _angles(probability.T),
        width.detach().reshape(shape)[at].float().cpu().numpy(),
        score[row, column],
    )


def peak_places(quality: torch.Tensor, settings: PeakSettings = PeakSettings()) -> np.ndarray:
    """(N, 2) the pixels (u, v), not rounded, of the peaks that `find_peaks` finds."""
    score, row, column = _peak_pixels(quality, settings)
    return np.stack([column, row], axis=-1) + _subpixel(score, row, column)


def _peak_pixels(
    quality: torch.Tensor, settings: PeakSettings
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The blurred quality (H, W), and rows and columns (N,) of its peaks, the highest first."""
    score = quality.detach().reshape(quality.shape[-2:]).float().cpu().numpy()
    if settings.blur > 0:
        score = cv2.GaussianBlur(score, (0, 0), settings.blur)
    return score, *local_maxima(score, settings.radius, settings.threshold, settings.count)


def _subpixel(score: np.ndarray, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """(N, 2) offsets (u, v) of the maxima of quadratics through the 3x3 pixels around peaks.

    Newton's step with central differences (Brown and Lowe 2002) on the logarithm, which is exact
    where the peak is Gaussian. No step where the surface is not a cap, nor across the border.
    """
    rows, columns = score.shape
    log = np.log(np.maximum(score, 1e-6))
    step = np.arange(-1, 2)
    v = np.clip(row[:, None] + step, 0, rows - 1)[:, :, None]
    u = np.clip(column[:, None] + step, 0, columns - 1)[:, None, :]
    f = log[v, u].astype(float)  # (N, v, u)
    gu, gv = (f[:, 1, 2] - f[:, 1, 0]) / 2, (f[:, 2, 1] - f[:, 0, 1]) / 2
    guu = f[:, 1, 2] - 2 * f[:, 1, 1] + f[:, 1, 0]
    gvv = f[:, 2, 1] - 2 * f[:, 1, 1] + f[:, 0, 1]
    guv = (f[:, 2, 2] - f[:, 2, 0] - f[:, 0, 2] + f[:, 0, 0]) / 4
    determinant = guu * gvv - guv**2
    cap = (guu < 0) & (determinant > 1e-9)
    step_uv = np.stack([guv * gv - gvv * gu, guv * gu - guu * gv], axis=-1)
    step_uv /= np.where(cap, determinant, 1.0)[:, None]
    at_border = np.stack([np.isin(column, [0, columns - 1]), np.isin(row, [0, rows - 1])], axis=-1)
    return np.clip(np.where(cap[:, None] & ~at_border, step_uv, 0.0), -1, 1)


def _angles(probability: np.ndarray) -> np.ndarray:
    """(N,) angles in [0, pi) of distributions (N, K) over bins that wrap around.

    The cube root gives back the bins' qualities up to a factor (see `targets_from_labels`). They
    are smoothed around the circle by (1, 4, 6, 4, 1) / 16, which finds the middle of a range of
    equally good bins. A parabola through the logarithms of the highest bin and its neighbours gives
    the place between bins, exactly for Gaussian-shaped distributions.
    """
    bins, quality = probability.shape[1], np.cbrt(probability)
    smooth = sum(
        share / 16 * np.roll(quality, shift, axis=1)
        for shift, share in zip(range(-2, 3), (1, 4, 6, 4, 1))
    )
    best = smooth.argmax(axis=1)
    around = (best[:, None] + np.arange(-1, 2)) % bins
    left, middle, right = np.log(
        np.maximum(np.take_along_axis(smooth, around, axis=1), 1e-12).astype(float)
    ).T
    curvature = 2 * middle - left - right
    offset = (right - left) / 2 / np.where(curvature > 1e-9, curvature, np.inf)
    return np.mod((best + np.clip(offset, -0.5, 0.5)) * np.pi / bins, np.pi)


def surface_depth(depth: np.ndarray, pixels: np.ndarray, radius: int = 1) -> np.ndarray:
    """(N,) median of the known depths within `radius` of pixels (N, 2); NaN where none is known."""
    rows, columns = depth.shape
    u, v = np.rint(pixels).astype(int).reshape(-1, 2).T
    step = np.arange(-radius, radius + 1)
    v = np.clip(v[:, None] + step, 0, rows - 1)[:, :, None]
    u = np.clip(u[:, None] + step, 0, columns - 1)[:, None, :]
    window = depth[v, u].reshape(len(u), len(step) ** 2).astype(float)
    known = known_depth(window)
    ordered = np.sort(np.where(known, window, np.inf), axis=1)
    middle = np.maximum(known.sum(axis=1) - 1, 0) // 2
    median = ordered[np.arange(len(ordered)), middle]
    return np.where(np.isfinite(median), median, np.nan)
