"""Which object every part of a height map belongs to, by votes for the objects' centres of mass.

A network's centre head says at each pixel what leads to the centre of mass of the object seen
there. All parts of one object point at one place, whatever touches it, so the places where many
votes meet are the objects (a Hough vote with learnt offsets: Kendall, Gal and Cipolla, CVPR 2018;
Cheng et al., Panoptic-DeepLab, CVPR 2020).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from utils.height_map import HeightMap
from utils.pixel_scaling import PixelScaling
from utils.transforms import RGBDFrame, deproject, project


@dataclass(frozen=True)
class VoteSettings:
    """In pixels of the network's image, unless said."""

    floor: float = 0.004  # m over the table, from which a cell is matter
    blur: float = 2.0  # standard deviation of the Gaussian over the votes
    apart: int = 5  # two objects' centres are farther apart in u or v
    least: int = 20  # votes within the blur that make an object


def labelled_by_centres(
    heights: HeightMap,
    frame: RGBDFrame,
    scaling: PixelScaling,
    offset: np.ndarray,
    settings: VoteSettings = VoteSettings(),
) -> HeightMap:
    """The height map with a network's objects: their labels and their centres of mass.

    offset: (2, h, w) pixels to the centre of mass, at the network's scale; scaling leads there from
    the frame's pixels. A centre's height is that of the columns under the visible surface.
    """
    rise = heights.height - heights.table_height
    row, column = np.nonzero(rise > settings.floor)
    xy = heights.origin + heights.cell * np.column_stack([column, row])
    surface = np.column_stack([xy, heights.height[row, column]])
    place = scaling.pixels(project(surface, frame.K, frame.T_WC)[0])
    limits = offset.shape[2] - 1, offset.shape[1] - 1
    u, v = np.clip(np.rint(place).astype(int), 0, limits).T
    votes = place + offset[:, v, u].T
    centres = vote_centres(votes, offset.shape[1:], settings)
    if len(centres) == 0:
        return heights
    owner = np.linalg.norm(votes[:, None] - centres, axis=2).argmin(axis=1)
    label = np.full(heights.label.shape, -1)
    label[row, column] = owner

    rise, count = rise[row, column], len(centres)
    total = np.maximum(np.bincount(owner, rise, count), 1e-9)
    z = heights.table_height + np.bincount(owner, rise**2, count) / (2 * total)
    ahead = deproject(scaling.original_pixels(centres), np.ones(count), frame.K, frame.T_WC)
    eye = frame.T_WC[:3, 3]
    share = (z - eye[2]) / (ahead[:, 2] - eye[2])
    return replace(heights, label=label, centres=eye + share[:, None] * (ahead - eye))


def vote_centres(
    votes: np.ndarray, shape: tuple[int, int], settings: VoteSettings = VoteSettings()
) -> np.ndarray:
    """(M, 2) places (u, v) in an image of `shape` where many of the votes (N, 2) meet."""
    rows, columns = shape
    u, v = np.clip(np.rint(votes).astype(int), 0, (columns - 1, rows - 1)).T
    count = np.bincount(v * columns + u, minlength=rows * columns).reshape(shape)
    density = cv2.GaussianBlur(count.astype(np.float32), (0, 0), settings.blur)
    window = np.ones((2 * settings.apart + 1,) * 2, np.uint8)
    least = settings.least / (2 * np.pi * settings.blur**2)  # votes at one point, blurred
    peaks = (density >= cv2.dilate(density, window)) & (density > least)
    # Equal neighbours are one peak, in their middle. The first component is the background.
    return cv2.connectedComponentsWithStats(peaks.astype(np.uint8))[3][1:]
