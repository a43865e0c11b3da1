"""Objects by vote: GraspNet's centre head segments the height map.

At each pixel the head predicts the offset to the centre of mass of the object there. All parts of
one object point at one place, even where objects touch, so the places where many votes meet are the
objects (a Hough vote with learnt offsets: Kendall, Gal and Cipolla, CVPR 2018; Cheng et al.,
Panoptic-DeepLab, CVPR 2020). Parts that turn out to be one object are joined
(`models.graspnet_parts`). What is left, whose votes do not meet, is one object in each piece of the
height map.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from models.graspnet_parts import PartSettings, joined_parts
from utils.compiled import compiled
from utils.depth_holes import nearest_values
from utils.height_map import HeightMap, base_heights, local_maxima
from utils.images import PixelScaling
from utils.seen_heights import hides
from utils.transforms import RGBDFrame, deproject, project


@dataclass(frozen=True)
class VoteSettings:
    """Of the vote for centres; in pixels of the network's image unless said."""

    blur: float = 2.0  # standard deviation of the Gaussian over the votes
    apart: int = 5  # the centres of two objects are farther apart than this in u or v
    least: float = 8e-5  # m2 of surface whose votes have to meet within the blur
    reach: float = 12.0  # a vote that misses every centre by more belongs to no object
    margin: int = 40  # how far outside the image a centre may lie


def labelled_by_centres(
    heights: HeightMap,
    frame: RGBDFrame,
    scaling: PixelScaling,
    offset: np.ndarray,
    settings: VoteSettings = VoteSettings(),
) -> HeightMap:
    """The height map with the network's objects: their labels and their centres of mass.

    offset: (2, h, w) pixels to the centre of mass, at the network's scale; `scaling` takes the
    frame's pixels to it. Every labelled cell keeps a label. The votes give a centre's place in the
    image, where most of an object votes for one; else its place, and always its height, are those
    of the centroid of the columns under the object's surface, an estimate that is too low where the
    object rests on others.
    """
    row, column = np.nonzero(heights.label >= 0)
    height = heights.height[row, column]
    surface = np.column_stack(
        [heights.origin + heights.cell * np.column_stack([column, row]), height]
    )
    pixels, _ = project(surface, frame.K, frame.T_WC)
    votes, within = _votes(scaling.pixels(pixels), offset)
    behind = np.zeros(len(row), bool)
    if frame.second is not None:
        behind = hides(frame, surface)
    # Hidden cells do not vote: their height is borrowed, and their pixel shows something else. Nor
    # do those outside the image, which belong to what the border shows.
    shown = (heights.ceiling[row, column] <= height) & ~behind
    centres = vote_centres(votes[shown & within], offset.shape[1:], heights.cell, settings)
    if len(centres) == 0:
        return heights

    part = np.full(heights.label.shape, -1)
    part[row, column] = np.where(behind, -1, _nearest(votes, centres, settings.reach))
    piece_of_patch = _add_patches(part, heights.label, len(centres), heights.cell)
    own, parts = part[row, column], len(centres) + len(piece_of_patch)
    shown &= own >= 0
    known = np.full(part.shape, -1)
    known[row[shown], column[shown]] = own[shown]
    colour = colours_at(frame.rgb, pixels[shown])
    whole = joined_parts(known, votes[shown], height[shown], colour, parts, heights.cell)
    # A patch that was joined with nothing is the rest of its piece, as is what is in no part.
    first_piece, alone = int(whole.max()) + 1, np.bincount(whole)[whole] == 1
    alone[: len(centres)] = False
    whole[alone] = first_piece + piece_of_patch[alone[len(centres) :]]
    label = np.minimum(heights.label, -1)  # table and walls stay
    label[row, column] = np.where(own >= 0, whole[own], first_piece + heights.label[row, column])
    if behind.any():
        label = _as_beside(label, heights.label, row[behind], column[behind])

    kept, owner = np.unique(label[row, column], return_inverse=True)
    label[row, column] = owner
    found = _column_centres(replace(heights, label=label), len(kept), owner, surface)
    rest = kept >= first_piece
    found[rest] = heights.centres[kept[rest] - first_piece]
    # Where votes of most of an object met, that is its place, whatever hides the rest of it.
    cells = np.bincount(own[own >= 0], minlength=parts)[: len(centres)]
    there = np.minimum(np.searchsorted(kept, whole[: len(centres)]), len(kept) - 1)
    most = 2 * cells > np.bincount(owner)[there]
    there, place = there[most], scaling.original_pixels(centres[most])
    found[there] = _at_height(frame, place, found[there, 2])
    return replace(heights, label=label, centres=found)


def _votes(pixels: np.ndarray, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N, 2) pixels that those of N cells (N, 2) vote for, and which of the cells (N,) the image
    shows: others vote as the nearest pixel of its border does. offset: (2, h, w)."""
    place = np.nan_to_num(pixels, nan=-2.0)  # behind the camera, which is outside the image, too
    nearest = np.clip(place, 0, (offset.shape[2] - 1, offset.shape[1] - 1))
    u, v = np.rint(nearest).astype(int).T
    return nearest + offset[:, v, u].T, (np.abs(place - nearest) <= 1).all(axis=1)


def _at_height(frame: RGBDFrame, pixels: np.ndarray, height: np.ndarray) -> np.ndarray:
    """(M, 3) points in W, `height` (M,) m high, that a frame shows at pixels (M, 2)."""
    eye = frame.T_WC[:3, 3]
    ahead = deproject(pixels, np.ones(len(pixels)), frame.K, frame.T_WC) - eye
    return eye + ((height - eye[2]) / ahead[:, 2])[:, None] * ahead


def _add_patches(part: np.ndarray, piece: np.ndarray, count: int, cell: float) -> np.ndarray:
    """Number the patches of labelled cells that are in none of the `count` parts, from `count` on,
    in place: each is of one `piece`, goes on without a gap, and is large enough to be joined.
    part, piece: (R, C). Returns (K,) their pieces."""
    left = ((part < 0) & (piece >= 0)).astype(np.uint8)
    least = PartSettings().surface / cell**2
    pieces = []
    if left.sum() >= least:
        _, patch, stats, _ = cv2.connectedComponentsWithStats(left, connectivity=4)
        for number in 1 + np.flatnonzero(stats[1:, cv2.CC_STAT_AREA] >= least):
            here = patch == number
            for one in np.unique(piece[here]):
                part[here & (piece == one)] = count + len(pieces)
                pieces.append(one)
    return np.array(pieces, int)


def _column_centres(
    heights: HeightMap, count: int, owner: np.ndarray, surface: np.ndarray
) -> np.ndarray:
    """(count, 3) centroids of the columns under the surface (N, 3) of the objects `owner` (N,), on
    what each of them rests on."""
    base = np.full(count, heights.table_height)
    if heights.fixed is not None:
        base[:] = base_heights(heights.label, heights.fixed, heights.table_height)
    rise = np.maximum(surface[:, 2] - base[owner], 0.0)
    total = np.maximum(np.bincount(owner, rise, count), 1e-9)
    x, y = (np.bincount(owner, rise * along, count) / total for along in surface[:, :2].T)
    return np.column_stack([x, y, base + np.bincount(owner, rise**2, count) / (2 * total)])


def colours_at(rgb: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """(N, 3) of an image (H, W, 3) at pixels (N, 2), at the nearest one if outside."""
    rows, columns = rgb.shape[:2]
    u, v = np.rint(np.clip(np.nan_to_num(pixels), 0, (columns - 1, rows - 1))).astype(int).T
    return rgb[v, u]


@compiled
def _nearest(votes: np.ndarray, centres: np.ndarray, reach: float) -> np.ndarray:
    """(N,) which of the centres (M, 2) each vote (N, 2) is nearest to, -1 where none is nearer than
    `reach`."""
    owner = np.full(len(votes), -1)
    for i in range(len(votes)):
        least = reach
        for k in range(len(centres)):
            du, dv = votes[i, 0] - centres[k, 0], votes[i, 1] - centres[k, 1]
            miss = np.sqrt(du * du + dv * dv)
            if miss < least:
                least, owner[i] = miss, k
    return owner


def _as_beside(
    label: np.ndarray, piece: np.ndarray, row: np.ndarray, column: np.ndarray
) -> np.ndarray:
    """Labels (R, C) whose cells (N,) that only a second frame shows are those of the nearest other
    cell of the same `piece` (R, C), where there is one."""
    others = label >= 0
    others[row, column] = False
    label = label.copy()
    if others.any():
        nearest, its_piece = (nearest_values(values, others) for values in (label, piece))
        same = its_piece[row, column] == piece[row, column]
        label[row[same], column[same]] = nearest[row[same], column[same]]
    return label


def vote_centres(
    votes: np.ndarray,
    shape: tuple[int, int],
    cell: float,
    settings: VoteSettings = VoteSettings(),
) -> np.ndarray:
    """(M, 2) places (u, v) in or near an image of `shape` where many of the votes (N, 2) meet, in
    falling order of their number; each vote stands for cell x cell metres of surface."""
    rows, columns = np.array(shape) + 2 * settings.margin
    place = np.rint(votes + settings.margin).astype(int)
    u, v = place[((place >= 0) & (place < (columns, rows))).all(axis=1)].T
    count = np.bincount(v * columns + u, minlength=rows * columns).reshape(rows, columns)
    density = cv2.GaussianBlur(count.astype(np.float32), (0, 0), settings.blur)
    least = settings.least / cell**2 / (2 * np.pi * settings.blur**2)  # all at one point, blurred
    peaks = local_maxima(density, settings.apart, least)
    found = np.column_stack(peaks[::-1]) - settings.margin
    near = [
        np.maximum(*(np.abs(along - at) for along, at in zip(votes.T, place))) <= settings.apart
        for place in found
    ]
    # The blur may make a peak between votes that are all farther away.
    return np.array([votes[some].mean(axis=0) for some in near if some.any()]).reshape(-1, 2)
