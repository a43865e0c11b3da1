"""Which object every part of a height map belongs to, by votes for the objects' centres of mass.

A network's centre head says at each pixel what leads to the centre of mass of the object seen
there. All parts of one object point at one place, whatever touches it, so the places where many
votes meet are the objects (a Hough vote with learnt offsets: Kendall, Gal and Cipolla, CVPR 2018;
Cheng et al., Panoptic-DeepLab, CVPR 2020). Parts whose votes lead nowhere stay what the height map
takes them for.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from utils.height_map import HeightMap
from utils.local_maxima import local_maxima
from utils.pixel_scaling import PixelScaling
from utils.transforms import RGBDFrame, deproject, project


@dataclass(frozen=True)
class VoteSettings:
    """In pixels of the network's image, unless said."""

    blur: float = 2.0  # standard deviation of the Gaussian over the votes
    apart: int = 5  # two objects' centres are farther apart in u or v
    least: float = 8e-5  # m2 of surface whose votes meet within the blur make an object
    reach: float = 12.0  # a vote that misses every centre by more belongs to none
    margin: int = 40  # how far outside the image a centre may lie


def labelled_by_centres(
    heights: HeightMap,
    frame: RGBDFrame,
    scaling: PixelScaling,
    offset: np.ndarray,
    settings: VoteSettings = VoteSettings(),
) -> HeightMap:
    """The height map with a network's objects: their labels and their centres of mass.

    offset: (2, h, w) pixels to the centre of mass, at the network's scale; scaling leads there from
    the frame's pixels. What has a label keeps one. The network says where in the image a centre
    is; its height is that of the columns under the object's visible surface, an estimate that is
    too low where the object rests on others.
    """
    row, column = np.nonzero(heights.label >= 0)
    height = heights.height[row, column]
    surface = np.column_stack(
        [heights.origin + heights.cell * np.column_stack([column, row]), height]
    )
    place = scaling.pixels(project(surface, frame.K, frame.T_WC)[0])
    limits = offset.shape[2] - 1, offset.shape[1] - 1
    u, v = np.clip(np.rint(place).astype(int), 0, limits).T
    votes = place + offset[:, v, u].T
    # A hidden cell's height is borrowed, and its pixel shows something else: it has no vote.
    seen = heights.ceiling[row, column] <= height
    centres = vote_centres(votes[seen], offset.shape[1:], heights.cell, settings)
    if len(centres) == 0:
        return heights
    miss = np.linalg.norm(votes[:, None] - centres, axis=2)
    count, owner = len(centres), miss.argmin(axis=1)
    owner = np.where(miss.min(axis=1) < settings.reach, owner, count + heights.label[row, column])
    label = np.full(heights.label.shape, -1)
    label[row, column] = owner

    rise = height - heights.table_height
    total = np.bincount(owner, rise, count)[:count]
    mean = np.bincount(owner, rise**2, count)[:count] / (2 * np.maximum(total, 1e-9))
    ahead = deproject(scaling.original_pixels(centres), np.ones(count), frame.K, frame.T_WC)
    eye = frame.T_WC[:3, 3]
    share = (heights.table_height + mean - eye[2]) / (ahead[:, 2] - eye[2])
    found = eye + share[:, None] * (ahead - eye)
    return replace(heights, label=label, centres=np.concatenate([found, heights.centres]))


def vote_centres(
    votes: np.ndarray,
    shape: tuple[int, int],
    cell: float,
    settings: VoteSettings = VoteSettings(),
) -> np.ndarray:
    """(M, 2) places (u, v) in or near an image of `shape` where many of the votes (N, 2) meet, most
    first; each vote stands for cell x cell metres of surface."""
    rows, columns = np.array(shape) + 2 * settings.margin
    place = np.rint(votes + settings.margin).astype(int)
    u, v = place[((place >= 0) & (place < (columns, rows))).all(axis=1)].T
    count = np.bincount(v * columns + u, minlength=rows * columns).reshape(rows, columns)
    density = cv2.GaussianBlur(count.astype(np.float32), (0, 0), settings.blur)
    least = settings.least / cell**2 / (2 * np.pi * settings.blur**2)  # all at one point, blurred
    peaks = local_maxima(density, settings.apart, least)
    found = np.column_stack(peaks[::-1]) - settings.margin
    near = [np.abs(votes - place).max(axis=1) <= settings.apart for place in found]
    return np.array([votes[around].mean(axis=0) for around in near]).reshape(-1, 2)
