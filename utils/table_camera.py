"""A camera over a table, found from how far each pixel's point is from a place that is not it.

Cornell's depth images are of that kind. Its point clouds are given in the robot's frame, and the
images made from them, as `DepthImage.from_pcd` of github.com/dougsm/ggcnn does, hold the length of
each point's coordinates. Taken for depths they bend the table by centimetres; as distances from the
robot they leave it flat, and say where camera and robot are. This module knows no file format.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from utils.table_plane import Plane
from utils.transforms import known_depth

SIDE = 400  # pixels of the square in the image's middle that the table is looked for in
STEP = 8  # pixels between those that are looked at
FLAT = 0.003  # m: noise of a first Kinect at a metre, beyond which a pixel counts ever less
# Where the search starts: a camera one metre from the table that looks at it from half above, and
# the robot on the camera's side of the table.
STEEP = np.array([0.0, 0.8, 1.0])
ROBOT = np.array([0.0, 0.8, 0.2])
# Beside and behind a camera that sees less than 50 degrees: no ray comes nearer to it than at its
# start. It is above any table 0.4 m away or more, unless the camera is tilted by 60 degrees.
BEHIND = np.array([0.0, 0.6, -0.1])
# What an image of distances in metres may hold.
FROM_BASE = "distances from a robot's base"
DEPTHS = "depths along the optical axis"
FROM_CAMERA = "distances from the camera"


@dataclass(frozen=True)
class TableCamera:
    """In the camera's optical frame, metres. table: (3,) normal of the table's plane over its
    distance, so that points on it are those with table @ point = 1. origin: (3,) from where the
    distances are measured."""

    table: np.ndarray
    origin: np.ndarray

    @property
    def T_WC(self) -> np.ndarray:
        """(4, 4) in the world whose z = 0 is the table, with the origin where the optical axis
        meets it."""
        length = np.linalg.norm(self.table)
        foot = np.array([0.0, 0.0, 1 / self.table[2]])
        T_WC = Plane(-self.table / length, 1 / length, foot, 1.0).camera_pose()
        T_WC[:2, 3] -= (T_WC[:3, :3] @ foot + T_WC[:3, 3])[:2]
        return T_WC

    def depth(self, distance: np.ndarray, K: np.ndarray) -> np.ndarray:
        """(H, W) float32 metres along the optical axis of points at `distance` (H, W) from the
        origin: where each pixel's ray leaves the sphere of that radius around it. 0 where the
        distance is unknown (see `known_depth`).

        Points nearer than `least_depth` come back mirrored in it.
        """
        rays = _rays(distance.shape, K)
        along, squared = rays @ self.origin, (rays**2).sum(axis=-1)
        beside = self.origin @ self.origin - distance.astype(float) ** 2
        # A pixel that is off by its noise may have a sphere that its ray only just misses.
        root = np.sqrt(np.maximum(along**2 - squared * beside, 0))
        depth = (along + root) / squared
        return np.where(known_depth(distance), depth, 0).astype(np.float32)

    def least_depth(self, rays: np.ndarray) -> np.ndarray:
        """(...) metres along the optical axis where rays (..., 3) are nearest to the origin: their
        points are as far from it before as behind, and the distance tells least there."""
        return rays @ self.origin / (rays**2).sum(axis=-1)

    def sees(self, shape: tuple[int, int], K: np.ndarray, height: float) -> bool:
        """Whether whatever lies on the table or up to `height` metres above it is farther than
        `least_depth` in the middle of an image of `shape`."""
        rays = _middle_rays(shape, K)
        over = (1 - height * np.linalg.norm(self.table)) / (rays @ self.table)
        return bool((over > self.least_depth(rays)).all())


def find_table_camera(distance: np.ndarray, K: np.ndarray) -> TableCamera:
    """The camera of an image of distances (H, W) metres, most of whose middle shows a table.

    A robust fit (Cauchy's loss), for which objects and walls hardly count. An origin and its mirror
    image in the table explain it alike, for every point of the table is as far from either; of the
    two the one on the camera's side is given, as a robot's base is there.
    """
    found, _ = _fit_distances(*_middle(distance, K))
    table, origin = found[:3], found[3:]
    behind = max(table @ origin - 1, 0)
    return TableCamera(table, origin - 2 * behind * table / (table @ table))


def table_misses(image: np.ndarray, K: np.ndarray) -> dict[str, float]:
    """By what an image (H, W) of metres may hold: how far, in metres, the typical pixel of its
    middle is from the table that explains it best as that (the median of the absolute values).

    Six numbers explain an image of distances from a base, three one of depths or of distances from
    the camera; so the former can be no worse by much even where one of the latter is the truth.
    """
    rays, seen = _middle(image, K)
    slant = np.linalg.norm(rays, axis=1)

    def off(guess: np.ndarray, stretch: np.ndarray) -> np.ndarray:
        return stretch / (rays @ guess) - seen

    misses = {FROM_BASE: _fit_distances(rays, seen)[1]}
    for reading, stretch in ((DEPTHS, np.ones_like(slant)), (FROM_CAMERA, slant)):
        misses[reading] = _robust(off, STEEP, stretch)[1]
    return misses


def distances(depth: np.ndarray, K: np.ndarray, origin: np.ndarray = BEHIND) -> np.ndarray:
    """(H, W) float32 metres from an origin (3,) in the optical frame, not the camera itself, of
    what is seen at depths (H, W); 0 where the depth is unknown (see `known_depth`).

    The inverse of `TableCamera.depth`, beyond its `least_depth`; so the origin has to be on the
    camera's side of the table, and is best behind the camera.
    """
    known = known_depth(depth)
    points = _rays(depth.shape, K) * np.where(known, depth, 0)[..., None]
    return np.where(known, np.linalg.norm(points - origin, axis=-1), 0).astype(np.float32)


def _fit_distances(rays: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, float]:
    """(6,) table and origin, and how far the typical pixel is from them."""

    def off(guess: np.ndarray) -> np.ndarray:
        points = rays / (rays @ guess[:3])[:, None]
        return np.linalg.norm(points - guess[3:], axis=1) - seen

    return _robust(off, np.concatenate([STEEP, ROBOT]))


def _robust(off: Callable[..., np.ndarray], start: np.ndarray, *given) -> tuple[np.ndarray, float]:
    """What makes most of the errors `off` small, and the median of their absolute values there."""
    found = least_squares(off, start, loss="cauchy", f_scale=FLAT, args=given)
    return found.x, float(np.median(np.abs(found.fun)))


def _middle(image: np.ndarray, K: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n, 3) rays of pixels in the middle of an image, and what it holds there (n,)."""
    return _middle_rays(image.shape, K), image[_middle_of(image.shape)].ravel().astype(float)


def _middle_rays(shape: tuple[int, ...], K: np.ndarray) -> np.ndarray:
    return _rays(shape, K)[_middle_of(shape)].reshape(-1, 3)


def _middle_of(shape: tuple[int, ...]) -> tuple[slice, ...]:
    return tuple(
        slice(max(0, (length - SIDE) // 2), (length + SIDE) // 2, STEP) for length in shape
    )


def _rays(shape: tuple[int, ...], K: np.ndarray) -> np.ndarray:
    """(H, W, 3) what leads from the camera to the points that the pixels show at depth 1."""
    v, u = np.mgrid[: shape[0], : shape[1]]
    return np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(K).T
