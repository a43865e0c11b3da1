"""From where a camera would see most of what a height map leaves open: the next best view.

Open is the space between the surface that was seen and the ceiling of what may be hidden
(`HeightMap.ceiling`). Points of that space are counted which a camera on a dome over the workspace
would see past all known matter (volumetric next-best-view planning: Connolly, "The determination of
next best views", ICRA 1985). Which poses a camera can take is for others to say: this module knows
neither a robot nor a simulator.
"""

from __future__ import annotations

import itertools

import numpy as np

from utils.geometry import Workspace
from utils.height_map import PIVOT_HEIGHT, HeightMap
from utils.transforms import look_at, project

_TILTS = np.deg2rad([30.0, 45.0, 60.0])  # from the vertical
_AZIMUTHS = 12  # directions around it
_DISTANCE = 0.45  # m from the middle of the workspace: at 60 degrees of view, all of it is seen
_VOXEL = 0.006  # m, side
_BLOCK = 4  # pixels of the camera, least side of one of the depth buffer


def dome(workspace: Workspace) -> list[np.ndarray]:
    """(4, 4) T_WC of cameras around the workspace that look at its middle, image up pointing up."""
    middle = np.array([*workspace.centre, workspace.table_height + PIVOT_HEIGHT])
    poses = []
    for tilt, turn in itertools.product(_TILTS, np.arange(_AZIMUTHS) * 2 * np.pi / _AZIMUTHS):
        level = np.sin(tilt)
        out = np.array([level * np.cos(turn), level * np.sin(turn), np.cos(tilt)])
        poses.append(look_at(middle + _DISTANCE * out, middle))
    return poses


class OpenSpace:
    """The space over the workspace of which a map from above does not tell whether it is empty.

    heights: the map, its T_WV the identity.
    """

    def __init__(self, heights: HeightMap, workspace: Workspace):
        stride = round(_VOXEL / heights.cell)
        coarse = heights.every(stride)
        row, column = np.indices(coarse.height.shape)
        place = coarse.origin + coarse.cell * np.stack([column, row], axis=-1)
        over = (np.abs(place - workspace.centre) <= workspace.size / 2).all(axis=-1)
        self.voxel = coarse.cell**2 * _VOXEL  # m3
        table = np.full_like(coarse.height, workspace.table_height)
        self.matter = _columns(place, table, coarse.height)
        self.points = _columns(place[over], coarse.height[over], coarse.ceiling[over])

    @property
    def volume(self) -> float:
        """m3 of it."""
        return self.voxel * len(self.points)

    def shown(self, K: np.ndarray, shape: tuple[int, int], T_WC: np.ndarray) -> float:
        """m3 of it that a camera at T_WC would see past the known matter. K: (3, 3). shape: height
        and width of its image, pixels. What is open does not hide what is behind it."""
        # Wider than a voxel at the dome's distance, so that matter leaves no gaps.
        block = max(_BLOCK, int(np.ceil(_VOXEL * max(K[0, 0], K[1, 1]) / _DISTANCE)) + 1)
        rows, columns = (side // block + 1 for side in shape)
        nearest = np.full((rows, columns), np.inf, np.float32)
        index, depth = _blocks(self.matter, K, T_WC, shape, block)
        np.minimum.at(nearest.reshape(-1), index, depth)
        index, depth = _blocks(self.points, K, T_WC, shape, block)
        return self.voxel * int((depth <= nearest.reshape(-1)[index] + _VOXEL).sum())


def _columns(place: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """(N, 3) centres of the voxels over places (..., 2) between two heights (...), m in W."""
    place, low, high = place.reshape(-1, 2), low.ravel(), high.ravel()
    count = np.maximum(np.rint((high - low) / _VOXEL), 0).astype(int)
    number = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    return np.column_stack(
        [np.repeat(place, count, axis=0), np.repeat(low, count) + _VOXEL * (number + 0.5)]
    )


def _blocks(
    points: np.ndarray, K: np.ndarray, T_WC: np.ndarray, shape: tuple[int, int], block: int
) -> tuple[np.ndarray, np.ndarray]:
    """The number (N,) in the depth buffer, whose blocks have a side of `block` pixels, on which
    each of the points in the image lies, and its depth (N,), metres."""
    pixels, depth = project(points, K, T_WC)
    rows, columns = shape
    u, v = pixels.T
    within = (u >= 0) & (u < columns) & (v >= 0) & (v < rows)
    u, v = (along[within].astype(np.intp) // block for along in (u, v))
    return v * (columns // block + 1) + u, depth[within]
