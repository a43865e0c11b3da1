"""Rigid motion: twists, exponential and logarithm of SE(3), velocities seen from another frame.

A twist is (v, w), linear first, in metres and radians (a displacement) or per second (a velocity).
Formulas: Lynch and Park, Modern Robotics (2017), chapter 3; Chaumette and Hutchinson, "Visual
servo control, part I", IEEE Robotics and Automation Magazine 13(4), 2006.

Written with scalars because a control loop calls these thousands of times a second and arrays of
three numbers cost more to create than to compute. Knows no camera and no robot.
"""

from __future__ import annotations

from math import atan2, cos, sin, sqrt

import numpy as np

SMALL_ANGLE = 1e-4  # below it the series to second order are exact to the last digit


def skew(vector) -> np.ndarray:
    """(3, 3) matrix [a]x such that [a]x b = a x b."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def rotation_exp(rotation_vector) -> np.ndarray:
    """(3, 3) rotation of the axis-angle vector theta u (3,), radians (Rodrigues)."""
    return _exp(0.0, 0.0, 0.0, *map(float, rotation_vector))[:3, :3].copy()


def rotation_log(R: np.ndarray) -> np.ndarray:
    """Axis-angle vector theta u (3,) of a rotation (3, 3), theta in [0, pi].

    By way of the quaternion whose largest component is found first (Shepperd, 1978): right at pi
    about every axis, where the usual (R - R^T) / (2 sin theta) is 0 / 0.
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


def pose_exp(twist) -> np.ndarray:
    """(4, 4) displacement of a body that moves with a constant twist (6,) for one unit of time.

    A frame A that moves with v_A (expressed in A) for dt has T_WA <- T_WA @ pose_exp(v_A * dt).
    """
    return _exp(*map(float, twist))


def pose_log(T: np.ndarray) -> np.ndarray:
    """Twist (6,) with pose_exp(twist) = T and a rotation angle in [0, pi]."""
    w = rotation_log(T[:3, :3])
    theta = sqrt(w @ w)
    if theta < SMALL_ANGLE:
        factor = 1 / 12
    else:
        half = 0.5 * theta
        factor = (1.0 - half * cos(half) / sin(half)) / theta**2
    W = skew(w)
    inverse_v = np.eye(3) - 0.5 * W + factor * W @ W
    return np.concatenate([inverse_v @ T[:3, 3], w])


def velocity_transform(T_AB: np.ndarray) -> np.ndarray:
    """(6, 6) V with v_A = V v_B: one body's twist, told in frame A instead of in frame B.

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
