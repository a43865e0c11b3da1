"""Frames, poses, grasps and rigid motions: the conventions that every other module relies on.

Frames: W world (robot base, z up, x away from the robot), C camera optical frame (x right,
y down, z forward), E the grasp's frame in the hand (z along the approach, y along the closing
line). The origin of E is the middle between the two finger pads, 7.2 mm above the lowest point of
the fingertips (`GripperGeometry.tip_below_centre`). `T_AB` is the 4x4 matrix that takes a point in
B to A. Quaternions are (x, y, z, w). Lengths are metres, angles radians. Pixels are (u, v) =
(column, row); integer coordinates lie at pixel centres.

A twist is (v, w), linear first, in metres and radians (a displacement) or per second (a velocity).
Formulas of rigid motion: Lynch and Park, Modern Robotics (2017), chapter 3; Chaumette and
Hutchinson, "Visual servo control, part I", IEEE Robotics and Automation Magazine 13(4), 2006.

This module knows no simulator and no network.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from math import atan2, sin, sqrt

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from utils.errors import UserError

WIDEST = 1.0  # m, no hand opens farther: a larger width is one in other units
DOWN = (0.0, 0.0, -1.0)  # the approach of a planar grasp
PLANAR = np.deg2rad(1)  # least tilt of a grasp that is not from straight above


@dataclass(frozen=True)
class Grasp:
    """A grasp in the world frame: a planar one, from straight above, unless `approach` says else.

    position: (3,) metres in W, the origin of E at the moment of closing: the middle between the two
        finger pads, 7.2 mm above the lowest point of the fingertips.
    angle: direction of the closing line about +z from the x axis, radians, modulo pi; of a grasp
        from another side, before the least rotation that takes DOWN to its approach.
    width: opening between the finger pads before closing, metres.
    quality: of the project's planners the chance that executing the grasp succeeds; of others a
        score, higher is better, which is only comparable within one planner.
    approach: (3,) unit vector in W along which the hand comes, at most a right angle from DOWN.
    """

    position: np.ndarray
    angle: float
    width: float
    quality: float
    approach: np.ndarray = DOWN  # type: ignore[assignment]

    def __post_init__(self) -> None:
        position = np.asarray(self.position, dtype=float)
        if position.shape != (3,):
            raise ValueError(f"Grasp.position must have shape (3,), got {position.shape}")
        approach = np.asarray(self.approach, dtype=float)
        if approach.shape != (3,):
            raise ValueError(f"Grasp.approach must have shape (3,), got {approach.shape}")
        numbers = np.concatenate([position, approach, (self.angle, self.width, self.quality)])
        if not np.isfinite(numbers).all():
            raise ValueError(f"Grasp holds a non-finite number: {self!r}")
        if not 0 <= self.width <= WIDEST:
            raise ValueError(f"Grasp.width is in metres, 0 to {WIDEST:g}, got {self.width:g}")
        check_approach(approach)
        object.__setattr__(self, "position", position)
        object.__setattr__(self, "approach", approach)
        object.__setattr__(self, "angle", wrap_to_pi_range(float(self.angle)))
        # A planner may compute in float32 or in tensors, which no JSON file takes.
        object.__setattr__(self, "width", float(self.width))
        object.__setattr__(self, "quality", float(self.quality))

    @staticmethod
    def from_pose(T_WE: np.ndarray, width: float, quality: float) -> Grasp:
        """The grasp of a hand at T_WE (4, 4), which may be flipped: half a turn about the approach
        makes the same grasp."""
        approach = T_WE[:3, 2] / np.linalg.norm(T_WE[:3, 2])
        check_approach(approach)
        closing = tilt_rotation(approach).T @ T_WE[:3, 1]
        angle = np.arctan2(closing[1], closing[0])
        return Grasp(T_WE[:3, 3].copy(), angle, width, quality, approach)

    @property
    def tilt(self) -> float:
        """Radians between the approach and DOWN; 0 for a planar grasp."""
        x, y, z = self.approach
        return float(np.arctan2(np.hypot(x, y), -z))

    @property
    def closing_direction(self) -> np.ndarray:
        """(3,) unit vector in W along which the fingers close."""
        return tilt_rotation(self.approach) @ (np.cos(self.angle), np.sin(self.angle), 0.0)

    @property
    def pose(self) -> np.ndarray:
        """(4, 4) T_WE at the moment of closing: z along the approach, y along the closing line."""
        T = top_down_pose(self.position, self.angle)
        T[:3, :3] = tilt_rotation(self.approach) @ T[:3, :3]
        return T


def check_approach(approach: np.ndarray) -> None:
    """Raise ValueError for anything but a unit vector (3,) that does not point up."""
    if abs(np.linalg.norm(approach) - 1.0) > 1e-6 or approach[2] > 1e-6:
        raise ValueError(
            "the approach of a grasp, the hand's z axis, must be a unit vector that does not point "
            f"up in the world, got {approach.round(3).tolist()}"
        )


def tilt_rotation(approach: ArrayLike) -> np.ndarray:
    """(3, 3) least rotation that takes DOWN to a unit vector (3,), which may not point straight up.

    Rodrigues' formula about the horizontal axis DOWN x approach, whose length is the sine.
    """
    x, y, z = np.asarray(approach, dtype=float).tolist()
    k = 1.0 / (1.0 - z)
    return np.array(
        [[1.0 - k * x * x, -k * x * y, -x], [-k * x * y, 1.0 - k * y * y, -y], [x, y, -z]]
    )


@dataclass(frozen=True)
class ImageGrasp:
    """A planar grasp on an image.

    pixel: (2,) centre (u, v), may be fractional.
    angle: direction of the closing line in the image, from +u (right) towards +v (down),
        radians, modulo pi.
    depth: of the grasp's position along the optical axis, metres; or that of the visible surface at
        the pixel, where a function says so.
    width: opening between the finger pads, metres (not pixels).
    """

    pixel: np.ndarray
    angle: float
    depth: float
    width: float
    quality: float


@dataclass(frozen=True)
class RGBDFrame:
    """An RGB-D image and all that is needed to turn its pixels into points.

    rgb: (H, W, 3) uint8. depth: (H, W) float32 (or float64; others become float32) metres along
        the optical axis; 0, negative or not finite where it is unknown (`known_depth`).
    K: (3, 3) pinhole matrix in pixels. T_WC: (4, 4) camera pose in the world.
    segmentation: (H, W) int32, the index of the object seen at each pixel in scene order, -1 for
        table and background, -2 for the robot; or None. Labels and pictures use it; planners that
        see only the depth image must not.
    truth: the scene's true geometry for planners that need it; otherwise None.
    fixtures: solids in W that stand in the cell for good and whose place every planner may know,
        such as shelves.
    target: (H, W) bool, the visible pixels of the one object that is wanted, as a click or a
        segmenter gives them; None: any object.
    second: another frame of the same still scene, from another side, which adds to what this one
        shows; None: there is none. Its own fixtures, target and second count for nothing.
    roughness: m, how rough the table is in the depth that the camera measured, as
        `utils.depth_correction.corrected` found it; 0 before.
    noise: m, how rough the table still was once the depth was smoothed; 0 before.
    """

    rgb: np.ndarray
    depth: np.ndarray
    K: np.ndarray
    T_WC: np.ndarray
    segmentation: np.ndarray | None = None
    truth: SceneGeometry | None = None  # type: ignore[name-defined]  # noqa: F821 - utils.geometry
    fixtures: tuple[ConvexSolid, ...] = ()  # type: ignore[name-defined]  # noqa: F821 - as above
    target: np.ndarray | None = None
    second: RGBDFrame | None = None
    roughness: float = 0.0
    noise: float = 0.0

    def __post_init__(self) -> None:
        """Raises UserError where an image, K, T_WC or a target is none, and where the images
        differ in size. A target of numbers is True where it is not 0."""
        check_images(self.rgb, self.depth)
        if self.depth.dtype not in (np.float32, np.float64):  # other sizes, or another byte order
            object.__setattr__(self, "depth", self.depth.astype(np.float32))
        K, T = np.asarray(self.K, dtype=float), np.asarray(self.T_WC, dtype=float)
        if K.shape != (3, 3):
            raise UserError(f"K: got an array of shape {K.shape}, expected (3, 3) pixels")
        fx, fy, *others = K[0, 0], K[1, 1], K[0, 1], K[1, 0], *K[2, :2], K[2, 2] - 1
        if any(others) or not (np.isfinite(K).all() and fx > 0 and fy > 0):
            raise UserError(
                f"K: got {K.tolist()}, expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels, "
                "with positive focal lengths"
            )
        if T.shape != (4, 4):
            raise UserError(f"T_WC: got an array of shape {T.shape}, expected a pose (4, 4)")
        if not np.isfinite(T).all():
            raise UserError("T_WC: the camera's pose holds a number that is not finite")
        if np.abs(T[3] - (0, 0, 0, 1)).max() > 1e-6:
            raise UserError(
                f"T_WC: its last row is {T[3].tolist()}, expected 0 0 0 1; is it transposed?"
            )
        turn = T[:3, :3]
        if not (np.abs(turn @ turn.T - np.eye(3)).max() < 1e-3 and np.linalg.det(turn) > 0):
            raise UserError(
                "T_WC: its upper left (3, 3) is no rotation; give the camera's pose in the world"
            )
        object.__setattr__(self, "K", K)
        object.__setattr__(self, "T_WC", T)
        if self.target is not None:
            target = np.asarray(self.target)
            if target.shape != self.depth.shape:
                raise UserError(
                    f"target: got an array of shape {target.shape}, expected that of the depth "
                    f"image, {self.depth.shape}"
                )
            object.__setattr__(self, "target", target != 0)

    def points(self) -> np.ndarray:
        """(H, W, 3) points in W; rows of NaN where the depth is unknown."""
        height, width = self.depth.shape
        v, u = np.mgrid[0:height, 0:width]
        depth = np.where(known_depth(self.depth), self.depth, np.nan).astype(float)
        return deproject(np.stack([u, v], axis=-1), depth, self.K, self.T_WC)

    def without_truth(self) -> RGBDFrame:
        """The same frame as an unprivileged planner may see it."""
        second = None if self.second is None else self.second.without_truth()
        return replace(self, segmentation=None, truth=None, second=second)

    def part(self, rows: slice, columns: slice) -> RGBDFrame:
        """Some rows and columns of the image, both without a step, as a frame of its own. What
        else is known of its pixels (segmentation, target) stays behind; the second frame stays
        whole."""
        K = self.K.copy()
        K[:2, 2] -= columns.start, rows.start
        rgb, depth = self.rgb[rows, columns], self.depth[rows, columns]
        return replace(self, rgb=rgb, depth=depth, K=K, segmentation=None, target=None)


def check_images(rgb: np.ndarray, depth: np.ndarray) -> None:
    """Raise UserError for anything but rgb (H, W, 3) uint8 and depth (H, W) of floats."""
    if rgb.ndim != 3 or rgb.shape[2] != 3:
        raise UserError(f"rgb: got an array of shape {rgb.shape}, expected (H, W, 3) channels")
    if rgb.dtype != np.uint8:
        raise UserError(f"rgb: got {rgb.dtype}, expected uint8 from 0 to 255")
    if depth.ndim != 2:
        raise UserError(f"depth: got an array of shape {depth.shape}, expected one channel, (H, W)")
    if not np.issubdtype(depth.dtype, np.floating):
        raise UserError(
            f"depth: got {depth.dtype}, expected metres as floats; divide millimetres by 1000"
        )
    if rgb.shape[:2] != depth.shape:
        raise UserError(
            f"rgb and depth differ in size: {rgb.shape[1]}x{rgb.shape[0]} and "
            f"{depth.shape[1]}x{depth.shape[0]} pixels; register the depth to the colour image"
        )


def known_depth(depth: np.ndarray) -> np.ndarray:
    """(...) bool, True where a depth is known: 0, negative and not finite mean unknown."""
    return np.isfinite(depth) & (depth > 0)


def wrap_to_pi_range(angle: float) -> float:
    """The representative of an undirected line's angle in [0, pi)."""
    wrapped = float(np.mod(angle, np.pi))
    return 0.0 if wrapped >= np.pi else wrapped


def angle_difference(a: ArrayLike, b: ArrayLike) -> np.ndarray:
    """Smallest difference of two undirected lines' angles, in [0, pi/2]. Accepts arrays."""
    difference = np.mod(np.asarray(a) - np.asarray(b), np.pi)
    return np.minimum(difference, np.pi - difference)


def pose_matrix(position: ArrayLike, quaternion: ArrayLike) -> np.ndarray:
    """(4, 4) transform from a position (3,) and a quaternion (x, y, z, w)."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
    T[:3, 3] = position
    return T


def position_quaternion(T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Position (3,) and quaternion (x, y, z, w) of a (4, 4) transform."""
    return T[:3, 3].copy(), Rotation.from_matrix(T[:3, :3]).as_quat()


def inverse_pose(T: np.ndarray) -> np.ndarray:
    """Inverse of a rigid (4, 4) transform."""
    inverse = np.eye(4)
    inverse[:3, :3] = T[:3, :3].T
    inverse[:3, 3] = -T[:3, :3].T @ T[:3, 3]
    return inverse


def transform_points(T: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Apply a (4, 4) transform to points (..., 3)."""
    return points @ T[:3, :3].T + T[:3, 3]


def top_down_pose(position: ArrayLike, angle: ArrayLike) -> np.ndarray:
    """(..., 4, 4) T_WE of a gripper pointing straight down at positions (..., 3), whose fingers
    close along angles (...)."""
    c, s = np.cos(angle), np.sin(angle)
    T = np.zeros((*np.shape(angle), 4, 4))
    T[..., 0, 0], T[..., 0, 1], T[..., 1, 0], T[..., 1, 1] = -s, c, c, s
    T[..., 2, 2], T[..., 3, 3] = -1.0, 1.0
    T[..., :3, 3] = position
    return T


def look_at(eye: ArrayLike, target: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)) -> np.ndarray:
    """(4, 4) T_WC of a camera at `eye` whose optical axis passes through `target`.

    `up` is the world direction that points up in the image; it may not be parallel to the view.
    """
    eye, target, up = (np.asarray(x, dtype=float) for x in (eye, target, up))
    forward = target - eye
    distance = np.linalg.norm(forward)
    if distance < 1e-9:
        raise ValueError("look_at: eye and target are the same point")
    forward = forward / distance
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-6 * max(float(np.linalg.norm(up)), 1e-12):
        raise ValueError("look_at: `up` is parallel to the line of sight")
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.column_stack([right, np.cross(forward, right), forward])
    T[:3, 3] = eye
    return T


def deproject(pixels: ArrayLike, depth: ArrayLike, K: np.ndarray, T_WC: np.ndarray) -> np.ndarray:
    """Points in W (..., 3) of pixels (..., 2) at depths (...) along the optical axis."""
    pixels, depth = np.asarray(pixels, dtype=float), np.asarray(depth, dtype=float)
    x = (pixels[..., 0] - K[0, 2]) / K[0, 0] * depth
    y = (pixels[..., 1] - K[1, 2]) / K[1, 1] * depth
    return transform_points(T_WC, np.stack([x, y, depth], axis=-1))


def ray_component(axis: int, shape: tuple[int, ...], K: np.ndarray, T_WC: np.ndarray) -> np.ndarray:
    """(H, W) by how much each pixel's ray advances along an axis of W (0, 1, 2) for each metre of
    depth: `deproject` of all pixels of an image of this shape is the camera's place plus depth
    times it."""
    x = (np.arange(shape[1]) - K[0, 2]) / K[0, 0]
    y = (np.arange(shape[0]) - K[1, 2]) / K[1, 1]
    right, down, ahead = T_WC[axis, :3]
    return right * x + (down * y + ahead)[:, None]


def project(points: ArrayLike, K: np.ndarray, T_WC: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (..., 2) and depths (...) of points in W (..., 3); NaN pixels behind the camera."""
    in_camera = transform_points(inverse_pose(T_WC), np.asarray(points, dtype=float))
    depth = in_camera[..., 2]
    safe = np.where(depth > 1e-9, depth, np.nan)
    u = K[0, 0] * in_camera[..., 0] / safe + K[0, 2]
    v = K[1, 1] * in_camera[..., 1] / safe + K[1, 2]
    return np.stack([u, v], axis=-1), depth


def grasp_to_image(grasp: Grasp, K: np.ndarray, T_WC: np.ndarray) -> ImageGrasp:
    """A world grasp as it appears in the image. Inverse of `image_to_grasp`.

    The image angle is that of the closing line's projection at the grasp's centre.
    """
    pixel, depth = project(grasp.position, K, T_WC)
    direction = inverse_pose(T_WC)[:3, :3] @ grasp.closing_direction
    x, y = (pixel - (K[0, 2], K[1, 2])) / (K[0, 0], K[1, 1])
    # Derivative of the projection along the closing line (up to the positive factor 1 / depth).
    du = K[0, 0] * (direction[0] - x * direction[2])
    dv = K[1, 1] * (direction[1] - y * direction[2])
    angle = wrap_to_pi_range(np.arctan2(dv, du))
    return ImageGrasp(pixel, angle, float(depth), grasp.width, grasp.quality)


def image_to_grasp(grasp: ImageGrasp, K: np.ndarray, T_WC: np.ndarray) -> Grasp:
    """The top-down world grasp whose closing line projects to the image grasp's line."""
    position = deproject(grasp.pixel, grasp.depth, K, T_WC)
    # The plane through the optical centre and the image line, cut with the horizontal plane.
    centre = np.array([*((grasp.pixel - (K[0, 2], K[1, 2])) / (K[0, 0], K[1, 1])), 1.0])
    along = np.array([np.cos(grasp.angle) / K[0, 0], np.sin(grasp.angle) / K[1, 1], 0.0])
    normal = T_WC[:3, :3] @ np.cross(centre, along)
    closing = np.cross(normal, (0.0, 0.0, 1.0))
    return Grasp(position, np.arctan2(closing[1], closing[0]), grasp.width, grasp.quality)


def planar(x: float, y: float, turn: float) -> np.ndarray:
    """(4, 4) motion in the plane: a turn about z, then a shift."""
    T = np.eye(4)
    c, s = np.cos(turn), np.sin(turn)
    T[:2, :2], T[:2, 3] = [[c, -s], [s, c]], (x, y)
    return T


def planar_part(T: np.ndarray) -> tuple[float, float, float]:
    """x, y and turn about z of a (4, 4) pose whose z axis is nearly that of its parent."""
    return float(T[0, 3]), float(T[1, 3]), float(np.arctan2(T[1, 0] - T[0, 1], T[0, 0] + T[1, 1]))


# --- Rigid motion ---------------------------------------------------------------------------
# Written with scalars: a control loop calls these functions thousands of times a second, and small
# arrays take longer to create than their numbers to compute.

SMALL_ANGLE = 1e-4  # below it the series to second order are exact to the last digit


def skew(vector: np.ndarray) -> np.ndarray:
    """(3, 3) matrix [a]x such that [a]x b = a x b."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def rotation_exp(rotation_vector: Iterable[float]) -> np.ndarray:
    """(3, 3) rotation of the axis-angle vector theta u (3,), radians (Rodrigues)."""
    return _exp(0.0, 0.0, 0.0, *map(float, rotation_vector))[:3, :3].copy()


def rotation_log(R: np.ndarray) -> np.ndarray:
    """Axis-angle vector theta u (3,) of a rotation (3, 3), theta in [0, pi].

    The quaternion's largest component is computed first (Shepperd, 1978). So the result is right at
    theta = pi about every axis, where the usual (R - R^T) / (2 sin theta) is 0 / 0.
    """
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()
    trace = a + e + i
    if trace >= max(a, e, i):
        x, y, z, w = h - f, c - g, d - b, 1.0 + trace
    elif a >= e and a >= i:
        x, y, z, w = 1.0 + a - e - i, b + d, c + g, h - f
    elif e >= i:
        x, y, z, w = b + d, 1.0 - a + e - i, f + h, c - g
    else:
        x, y, z, w = c + g, f + h, 1.0 - a - e + i, d - b
    # (x, y, z, w) is the quaternion up to a factor, which cancels.
    length = sqrt(x * x + y * y + z * z)
    if length == 0.0:
        return np.zeros(3)
    if w < 0.0:
        x, y, z, w = -x, -y, -z, -w
    scale = 2.0 * atan2(length, w) / length
    return np.array([x * scale, y * scale, z * scale])


def pose_exp(twist: Iterable[float]) -> np.ndarray:
    """(4, 4) displacement of a body that moves with a constant twist (6,) for one unit of time.

    A frame A that moves with v_A (expressed in A) for dt has T_WA <- T_WA @ pose_exp(v_A * dt).
    """
    return _exp(*map(float, twist))


def velocity_transform(T_AB: np.ndarray) -> np.ndarray:
    """(6, 6) V with v_A = V v_B: one body's twist, expressed in frame A instead of frame B.

    V = [R, [t]x R; 0, R]; the upper right block is the lever arm between the two origins.
    """
    R = T_AB[:3, :3]
    V = np.zeros((6, 6))
    V[:3, :3] = V[3:, 3:] = R
    V[:3, 3:] = skew(T_AB[:3, 3]) @ R
    return V


def _exp(vx: float, vy: float, vz: float, wx: float, wy: float, wz: float) -> np.ndarray:
    square = wx * wx + wy * wy + wz * wz
    theta = sqrt(square)
    if theta < SMALL_ANGLE:
        a, b, c = 1.0 - square / 6, 0.5 - square / 24, 1 / 6 - square / 120
    else:
        a = sin(theta) / theta
        b = 2.0 * (sin(0.5 * theta) / theta) ** 2  # (1 - cos) / theta^2 without its cancellation
        c = (1.0 - a) / square
    # R = I + a [w]x + b [w]x^2, t = (I + b [w]x + c [w]x^2) v, and [w]x^2 = w w^T - theta^2 I.
    dot = wx * vx + wy * vy + wz * vz
    keep = 1.0 - c * square
    return np.array(
        [
            [
                1.0 - b * (wy * wy + wz * wz), b * wx * wy - a * wz, b * wx * wz + a * wy,
                keep * vx + b * (wy * vz - wz * vy) + c * dot * wx,
            ],
            [
                b * wx * wy + a * wz, 1.0 - b * (wx * wx + wz * wz), b * wy * wz - a * wx,
                keep * vy + b * (wz * vx - wx * vz) + c * dot * wy,
            ],
            [
                b * wx * wz - a * wy, b * wy * wz + a * wx, 1.0 - b * (wx * wx + wy * wy),
                keep * vz + b * (wx * vy - wy * vx) + c * dot * wz,
            ],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )  # fmt: skip
