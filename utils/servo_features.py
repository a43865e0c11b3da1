"""Image features of a servo: points and depths, checked, and how they move with the camera.

Pixels are (u, v); normalised coordinates are x = (u - u0) / fx, y = (v - v0) / fy, without a unit.
Depths are metres along the optical axis. v_C is the twist (v, w) of the camera in its own frame.
Formulas: Chaumette and Hutchinson, "Visual servo control, parts I and II", IEEE Robotics and
Automation Magazine 13(4) 2006 and 14(1) 2007; Corke, Robotics, Vision and Control, chapter 15.

This module knows no control law and no robot.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import isfinite, sqrt

import numpy as np

from utils.errors import (
    CameraMatrixError,
    CollinearPointsError,
    DepthError,
    FeatureCountError,
    PointError,
    PoseError,
    UserError,
    unknown_choice,
)
from utils.transforms import skew

MIN_POINTS = 3  # six unknowns and two equations a point; from four on no singular cylinder
COLLINEAR = 1e-3  # points in a strip narrower than this share of its length count as a line
RIGID = 1e-6  # tolerance on the orthonormality of a rotation

MOUNTINGS = ("eye_in_hand", "eye_to_hand")
CAMERA_KEYS = ("intrinsics", "width", "height", "mounting", "T_EC", "T_WC")


@dataclass(frozen=True)
class ServoCamera:
    """A pinhole camera and where it is mounted.

    K: (3, 3) matrix in pixels, without skew. size: (width, height) pixels, or None for an image
    without borders. mounting: eye_in_hand with T_EC (4, 4), or eye_to_hand with T_WC (4, 4); only
    joint velocities need it.
    """

    K: np.ndarray
    size: tuple[int, int] | None
    mounting: str
    T_EC: np.ndarray | None
    T_WC: np.ndarray | None

    def __post_init__(self) -> None:
        # Read many times in each step.
        object.__setattr__(self, "_focal", np.array([self.K[0, 0], self.K[1, 1]]))
        object.__setattr__(self, "_centre", self.K[:2, 2].copy())

    @classmethod
    def from_config(cls, config: Mapping) -> ServoCamera:
        """From {"intrinsics": K, "width", "height", "mounting", "T_EC", "T_WC"}, of which only
        the first is required. Raises CameraMatrixError, PoseError, or UserError for unknown keys.
        """
        if not isinstance(config, Mapping) or "intrinsics" not in config:
            raise CameraMatrixError(
                f"camera_config: expected a mapping with 'intrinsics', got {config!r}"
            )
        for key in config:
            if key not in CAMERA_KEYS:
                raise unknown_choice("camera_config", key, CAMERA_KEYS)
        mounting = config.get("mounting", MOUNTINGS[0])
        if mounting not in MOUNTINGS:
            raise unknown_choice("camera_config.mounting", mounting, MOUNTINGS)
        size = config.get("width"), config.get("height")
        if (size[0] is None) != (size[1] is None):
            raise CameraMatrixError(f"camera_config: width and height go together, got {size}")
        poses = {
            key: None
            if config.get(key) is None
            else check_pose(f"camera_config.{key}", config[key])
            for key in ("T_EC", "T_WC")
        }
        K = check_camera_matrix(config["intrinsics"])
        return cls(K, None if size[0] is None else size, mounting, **poses)

    def normalise(self, pixels) -> np.ndarray:
        """Normalised coordinates (n, 2) of pixels (n, 2).

        Checks them: raises FeatureCountError, PointError or CollinearPointsError.
        """
        pixels = np.asarray(pixels, dtype=float)
        if pixels.ndim != 2 or pixels.shape[1] != 2:
            raise PointError(f"points: expected an (n, 2) array of pixels, got {pixels.shape}")
        if len(pixels) < MIN_POINTS:
            raise FeatureCountError(f"points: got {len(pixels)}, needed are at least {MIN_POINTS}")
        xy = self.normalise_unchecked(pixels)
        x, y = xy[:, 0], xy[:, 1]
        # Second moments about the mean: everything that is not finite shows up in the sum too.
        n = len(xy)
        sum_x, sum_y = float(np.add.reduce(x)), float(np.add.reduce(y))
        xx, yy = float(x @ x) - sum_x * sum_x / n, float(y @ y) - sum_y * sum_y / n
        x_y = float(x @ y) - sum_x * sum_y / n
        if not isfinite(xx + yy):
            raise PointError(f"points: not finite: {pixels.tolist()}")
        if self.size is not None:
            self._check_inside(pixels)
        if xx * yy - x_y * x_y <= (COLLINEAR * (xx + yy)) ** 2:
            raise CollinearPointsError(f"points: all on one line: {pixels.round(2).tolist()}")
        return xy

    def normalise_unchecked(self, pixels: np.ndarray) -> np.ndarray:
        """Normalised coordinates (..., 2) of pixels (..., 2)."""
        return (pixels - self._centre) / self._focal

    def to_pixels(self, xy: np.ndarray) -> np.ndarray:
        """Pixels (..., 2) of normalised coordinates (..., 2)."""
        return xy * self._focal + self._centre

    def _check_inside(self, pixels: np.ndarray) -> None:
        low, high = pixels.min(axis=0), pixels.max(axis=0)
        # Integer coordinates are pixel centres, so the image reaches half a pixel further.
        if low.min() < -0.5 or high[0] > self.size[0] - 0.5 or high[1] > self.size[1] - 0.5:
            raise PointError(
                f"points: outside the image of {self.size[0]} x {self.size[1]} pixels: "
                f"{pixels.round(1).tolist()}"
            )


def check_camera_matrix(K) -> np.ndarray:
    """K as a float array; raises CameraMatrixError."""
    try:
        K = np.asarray(K, dtype=float)
    except (TypeError, ValueError):
        raise CameraMatrixError(f"K: expected a (3, 3) matrix of numbers, got {K!r}") from None
    if K.shape != (3, 3) or not np.isfinite(K).all():
        raise CameraMatrixError(f"K: expected a finite (3, 3) matrix, got {K.tolist()}")
    wrong = (
        "focal lengths must be positive" if min(K[0, 0], K[1, 1]) <= 0
        else "the last row must be 0, 0, 1" if K[2].tolist() != [0.0, 0.0, 1.0]
        else "skew is not supported; undistort the image first" if K[0, 1] or K[1, 0]
        else None
    )  # fmt: skip
    if wrong:
        raise CameraMatrixError(f"K: {wrong}, got {K.tolist()}")
    return K


def check_pose(name: str, T) -> np.ndarray:
    """T as a (4, 4) float array; raises PoseError where it is missing or not a rigid transform."""
    if T is None:
        raise PoseError(f"{name}: a pose is needed here, got None")
    T = np.asarray(T, dtype=float)
    if T.shape != (4, 4):
        raise PoseError(f"{name}: expected a (4, 4) transform, got shape {T.shape}")
    (a, b, c, x), (d, e, f, y), (g, h, i, z), last = T.tolist()
    # Rows of unit length, at right angles, right-handed; scalars, as this is checked in every step.
    off = max(
        abs(a * a + b * b + c * c - 1), abs(d * d + e * e + f * f - 1),
        abs(g - (b * f - c * e)), abs(h - (c * d - a * f)), abs(i - (a * e - b * d)),
        abs(a * d + b * e + c * f),
    )  # fmt: skip
    if not isfinite(a + b + c + d + e + f + g + h + i + x + y + z) or off > RIGID:
        raise PoseError(f"{name}: not a rigid transform: {T.tolist()}")
    if last != [0.0, 0.0, 0.0, 1.0]:
        raise PoseError(f"{name}: the last row must be 0, 0, 0, 1, got {last}")
    return T


def check_depths(depths, count: int) -> np.ndarray:
    """(count,) depths in metres, from one depth for all points or one for each.

    Raises FeatureCountError, or DepthError where one is zero, not finite or behind the camera.
    """
    depths = np.asarray(depths, dtype=float)
    if depths.ndim == 0:
        depths = np.full(count, float(depths))
    if depths.shape != (count,):
        raise FeatureCountError(f"depths: got shape {depths.shape} for {count} points")
    # NaN and infinity fail both comparisons of their sum.
    if not (depths.min() > 0.0 and isfinite(float(np.add.reduce(depths)))):
        raise DepthError(
            f"depths: expected metres in front of the camera, got {depths.round(4).tolist()}"
        )
    return depths


def depths_from_image(pixels, depth_map: np.ndarray) -> np.ndarray:
    """Depths (n,) at the nearest pixels of a depth image (H, W), metres, 0 where unknown.

    Raises PointError outside the image (no index wraps around), DepthError for an unknown depth.
    """
    pixels = np.atleast_2d(np.asarray(pixels, dtype=float))
    depth_map = np.asarray(depth_map)
    if depth_map.ndim != 2:
        raise DepthError(f"depth_map: expected an (H, W) image, got shape {depth_map.shape}")
    height, width = depth_map.shape
    inside = (pixels >= -0.5) & (pixels < (width - 0.5, height - 0.5))
    if not inside.all():
        raise PointError(
            f"points: outside the depth image of {width} x {height}: {pixels.round(1).tolist()}"
        )
    columns, rows = np.floor(pixels + 0.5).astype(int).T
    return check_depths(depth_map[rows, columns].astype(float), len(pixels))


def interaction_matrix(xy: np.ndarray, depths: np.ndarray) -> np.ndarray:
    """(2n, 6) L with d(x0, y0, x1, ...)/dt = L v_C for fixed points at xy (n, 2), depths (n,)."""
    x, y = xy[:, 0], xy[:, 1]
    inverse = 1.0 / depths
    L = np.zeros((len(xy), 2, 6))
    L[:, 0, 0] = L[:, 1, 1] = -inverse
    L[:, :, 2] = xy * inverse[:, None]
    product = x * y
    L[:, 0, 3] = product
    L[:, 0, 4] = -1.0 - x * x
    L[:, 0, 5] = y
    L[:, 1, 3] = 1.0 + y * y
    L[:, 1, 4] = -product
    L[:, 1, 5] = -x
    return L.reshape(-1, 6)


def rotation_interaction(rotation_vector: np.ndarray) -> np.ndarray:
    """(3, 3) L_w with d(theta u)/dt = L_w w_C for the rotation theta u = log(R_GC) of the camera
    relative to its goal G (Malis, Chaumette and Boudet, "2 1/2 D visual servoing", 1999).

    L_w = I + theta/2 [u]x + (1 - sinc(theta) / sinc^2(theta/2)) [u]x^2; L_w u = u.
    """
    theta = sqrt(rotation_vector @ rotation_vector)
    if theta < 1e-8:
        return np.eye(3)
    U = skew(rotation_vector / theta)
    half = 0.5 * theta
    # sinc(theta) / sinc^2(theta / 2) = (theta / 2) / tan(theta / 2)
    return np.eye(3) + half * U + (1.0 - half / np.tan(half)) * U @ U


def extended_interaction(point: np.ndarray) -> np.ndarray:
    """(3, 6) L with d(x, y, log Z)/dt = L v_C for a fixed point (X, Y, Z) in C, metres."""
    x, y, Z = point[0] / point[2], point[1] / point[2], point[2]
    return np.array(
        [
            [-1 / Z, 0, x / Z, x * y, -(1 + x * x), y],
            [0, -1 / Z, y / Z, 1 + y * y, -x * y, -x],
            [0, 0, -1 / Z, -y, x, 0],
        ]
    )


def points_from_depths(xy: np.ndarray, depths: np.ndarray) -> np.ndarray:
    """(n, 3) points in C of normalised coordinates (n, 2) at depths (n,), metres."""
    return np.column_stack([xy, np.ones(len(xy))]) * depths[:, None]


def pose_from_points(points_C: np.ndarray, points_O: np.ndarray) -> np.ndarray:
    """(4, 4) T_CO that best maps points of the object, points_O (n, 3), to points_C (n, 3).

    Least squares in closed form (Kabsch 1976; Umeyama 1991). Raises FeatureCountError or
    CollinearPointsError where the points do not determine the rotation.
    """
    points_C, points_O = np.asarray(points_C, dtype=float), np.asarray(points_O, dtype=float)
    if points_C.shape != points_O.shape or points_C.ndim != 2 or len(points_C) < MIN_POINTS:
        raise FeatureCountError(
            f"points: got {points_C.shape} and {points_O.shape}, needed are two times (n, 3) "
            f"with n at least {MIN_POINTS}"
        )
    if not (np.isfinite(points_C).all() and np.isfinite(points_O).all()):
        raise PointError("points: not finite")
    centre_C, centre_O = points_C.mean(axis=0), points_O.mean(axis=0)
    U, s, Vt = np.linalg.svd((points_C - centre_C).T @ (points_O - centre_O))
    if s[1] <= COLLINEAR**2 * s[0]:
        raise CollinearPointsError(f"points: all on one line: {points_C.round(4).tolist()}")
    U[:, 2] *= np.sign(np.linalg.det(U @ Vt))  # a rotation, never a mirror image
    T_CO = np.eye(4)
    T_CO[:3, :3] = U @ Vt
    T_CO[:3, 3] = centre_C - T_CO[:3, :3] @ centre_O
    return T_CO


class DepthFromMotion:
    """Depths of points from their motion in the image while the camera moves with a known twist.

    The flow of a point is linear in its inverse depth, so each step gives one estimate by least
    squares (Corke, section 15.2.3). A Kalman filter on the inverse depth weighs it by the step's
    parallax: a camera that only turns gives no information.
    """

    def __init__(self, initial: float, noise: float = 1e-3):
        """initial: first guess for all points, metres. noise: standard deviation of a normalised
        coordinate between two images; parallax below it hardly counts. Raises DepthError, or
        UserError for the noise."""
        self.initial = float(check_depths(initial, 1)[0])
        if not 0.0 < noise < np.inf:
            raise UserError(f"noise: expected a positive standard deviation, got {noise}")
        self.noise = noise
        self.reset()

    def reset(self) -> None:
        """Go back to the first guess."""
        self._xy: np.ndarray | None = None
        self._inverse: np.ndarray | None = None
        self._variance: np.ndarray | None = None

    def update(self, xy: np.ndarray, v_C: np.ndarray, dt: float) -> np.ndarray:
        """Depths (n,) at normalised coordinates xy (n, 2) after a motion with v_C for dt s."""
        if self._xy is None or self._xy.shape != xy.shape:
            self._inverse = np.full(len(xy), 1 / self.initial)
            self._variance = self._inverse**2  # the guess may well be wrong by as much as itself
        else:
            # The mean of both ends makes the flow's formula exact to second order in dt.
            x, y = (0.5 * (xy + self._xy)).T
            unit = interaction_matrix(np.column_stack([x, y]), np.ones(len(xy))).reshape(-1, 2, 6)
            parallax = unit[:, :, :3] @ v_C[:3] * dt
            flow = xy - self._xy - unit[:, :, 3:] @ v_C[3:] * dt
            seen = (parallax * parallax).sum(axis=1)
            # A scalar Kalman filter on 1 / Z, in the middle of the step.
            half = 0.5 * dt
            before = self._carry(self._inverse, x, y, v_C, half)
            gain = self._variance / (self._variance * seen + self.noise**2)
            inverse = before + gain * ((parallax * flow).sum(axis=1) - seen * before)
            self._variance = self._variance * (1 - gain * seen)
            inverse = np.where(inverse > 0, inverse, before)  # no point is behind the camera
            self._inverse = self._carry(inverse, x, y, v_C, half)
        self._xy = xy
        return 1 / self._inverse

    @staticmethod
    def _carry(inverse, x, y, v_C, dt):
        # dZ/dt = -vz - Z (y wx - x wy) for a fixed point.
        Z = 1 / inverse
        moved = Z - dt * (v_C[2] + Z * (y * v_C[3] - x * v_C[4]))
        return np.where(moved > 0, 1 / np.where(moved > 0, moved, 1.0), inverse)
