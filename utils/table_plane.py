"""The table as the dominant plane of a depth image: RANSAC, then least squares on its points.

"Dominant" is all that a depth image can tell: a wall that fills more of the image than the table
would be taken for it. This module knows no network and no simulator.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from utils.errors import UserError
from utils.transforms import inverse_pose, transform_points

TOLERANCE = 0.01  # of the median distance: depth noise, and tables that are not quite flat
SMALLEST_SHARE = 0.2  # of the known points that the table has to hold
TRIALS = 300  # with a fifth of the points on the plane, 91 % to draw it; with a third, 99.999 %
POINTS = 4000  # that are looked at; they are spread over the image
REFITS = 5
SPREADS = 2.5  # robust standard deviations within which a point belongs to the refitted plane


@dataclass(frozen=True)
class Plane:
    """normal: (3,) unit vector towards the camera; distance: metres from the camera's centre,
    >= 0; centre: (3,) mean of the points on it; share: of the known points that lie on it. All in
    the frame of the points, whose origin is the camera."""

    normal: np.ndarray
    distance: float
    centre: np.ndarray
    share: float

    def height(self, points: np.ndarray) -> np.ndarray:
        """(...) metres of points (..., 3) above the plane, on the camera's side."""
        return points @ self.normal + self.distance

    def camera_pose(self) -> np.ndarray:
        """(4, 4) T_WC in the world that the plane defines.

        Its z axis is the plane's normal, its origin the foot of the perpendicular from the
        camera, its x axis the image's right-hand direction laid into the plane (down, should right
        be nearly the normal).
        """
        axis = np.eye(3)[0 if abs(self.normal[0]) < 0.9 else 1]
        x = axis - axis @ self.normal * self.normal
        x /= np.linalg.norm(x)
        T_CW = np.eye(4)
        T_CW[:3, :3] = np.column_stack([x, np.cross(self.normal, x), self.normal])
        T_CW[:3, 3] = -self.distance * self.normal
        return inverse_pose(T_CW)


def dominant_plane(points: np.ndarray, seed: int = 0) -> Plane:
    """The plane that most points (..., 3) in the camera's frame lie on; rows of NaN are unknown.

    Raises UserError where no plane holds a fifth of the points.
    """
    known = points.reshape(-1, 3)
    known = known[np.isfinite(known).all(axis=1)]
    random = np.random.default_rng(seed)
    if len(known) < 3:
        raise UserError("depth: too few known pixels to find the table")
    tolerance = TOLERANCE * float(np.median(np.linalg.norm(known, axis=1)))
    sample = known[random.permutation(len(known))[:POINTS]]
    best = _ransac(sample, tolerance, random)
    near = sample[np.abs(sample @ best[:3] + best[3]) < tolerance]
    for _ in range(REFITS):  # nearer and nearer points, so that low objects do not tilt it
        if len(near) < 3:
            break
        best = _least_squares(near)
        residual = sample @ best[:3] + best[3]
        spread = 1.4826 * np.median(np.abs(residual[np.abs(residual) < tolerance]))
        near = sample[np.abs(residual) < min(SPREADS * spread + 1e-4, tolerance)]
    share = float(np.mean(np.abs(known @ best[:3] + best[3]) < tolerance))
    if share < SMALLEST_SHARE:
        raise UserError(
            f"depth: no table found: the largest plane holds {share:.0%} of the known pixels; "
            "give --camera-pose and --table-height"
        )
    if best[3] < 0:
        best = -best
    return Plane(best[:3], float(best[3]), near.mean(axis=0), share)


def _ransac(points: np.ndarray, tolerance: float, random: np.random.Generator) -> np.ndarray:
    """(4,) normal and offset of the triple's plane with the smallest truncated squared distances
    (MSAC, Torr and Zisserman 2000)."""
    corners = points[random.integers(len(points), size=(TRIALS, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    usable = length > 1e-12
    if not usable.any():
        raise UserError("depth: the known pixels lie on one line; the table cannot be found")
    normals = normals[usable] / length[usable, None]
    offsets = -np.einsum("ij,ij->i", normals, corners[usable, 0])
    squared = (points @ normals.T + offsets) ** 2
    chosen = np.minimum(squared, tolerance**2).sum(axis=0).argmin()
    return np.append(normals[chosen], offsets[chosen])


def _least_squares(points: np.ndarray) -> np.ndarray:
    """(4,) the plane with the least sum of squared distances."""
    centre = points.mean(axis=0)
    normal = np.linalg.svd(points - centre, full_matrices=False)[2][-1]
    return np.append(normal, -normal @ centre)


# --- The table in a world -------------------------------------------------------------------

LARGEST_TILT = 15.0  # degrees between the plane found and the world's horizontal
DEEPEST = 0.05  # m that the typical point of a scene may lie below its table


@dataclass(frozen=True)
class Table:
    """T_WC: (4, 4) the camera in the world. height: z of the table in it, metres. share: of the
    known points that lie on the table, or None if the height was told."""

    T_WC: np.ndarray
    height: float
    share: float | None

    def describe(self) -> str:
        """One line for the user."""
        below = self.T_WC[2, 3] - self.height
        tilt = np.rad2deg(np.arccos(np.clip(-self.T_WC[2, 2], -1, 1)))
        source = "as told" if self.share is None else f"found, {self.share:.0%} of the depth image"
        return (
            f"{source}; {below:.3f} m below the camera, whose view is {tilt:.0f} degrees "
            "from straight down"
        )


def find_table(points: np.ndarray, T_WC: np.ndarray | None = None) -> Table:
    """The table that points (..., 3) in the camera's frame show; rows of NaN are unknown.

    Without T_WC (4, 4) the plane itself is the world, at height 0. With it, the plane has to be
    level there; UserError otherwise, which is what a pose in another convention gives.
    """
    plane = dominant_plane(points)
    if T_WC is None:
        return Table(plane.camera_pose(), 0.0, plane.share)
    up = T_WC[:3, :3] @ plane.normal
    tilt = np.rad2deg(np.arccos(np.clip(up[2], -1, 1)))
    if tilt > LARGEST_TILT:
        raise UserError(
            f"--camera-pose: the largest plane seen would be tilted by {tilt:.0f} degrees in the "
            "world; is the pose T_WC of the optical frame (x right, y down, z forward)? If the "
            "plane is not the table, give --table-height"
        )
    return Table(T_WC, float(transform_points(T_WC, plane.centre)[2]), plane.share)


def table_at_height(height: float, points: np.ndarray, T_WC: np.ndarray) -> Table:
    """The table that the user tells; UserError if most of the scene would lie under it."""
    above = np.nanmedian(transform_points(T_WC, points)[..., 2]) - height
    if above < -DEEPEST:
        raise UserError(
            f"--table-height: the typical point seen lies {-above:.2f} m below the table at "
            f"{height:g} m; check the height and the camera pose"
        )
    return Table(T_WC, height, None)
