"""From an error to a velocity: inverses, gains, speed limits, and the arm behind the camera.

Twists are (v, w) in m/s and rad/s. J_W is a geometric Jacobian (6, n) of E's origin with both
halves in the axes of W. Formulas: Chaumette and Hutchinson, "Visual servo
control, part II", IEEE Robotics and Automation Magazine 14(1), 2007; the adaptive gain and smooth
start are those of ViSP (Marchand, Spindler and Chaumette, 2005).

This module knows no image.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import exp

import numpy as np

from utils.errors import PoseError, ServoError, SingularMatrixError, UserError
from utils.transforms import velocity_transform

MAX_CONDITION = 1e8  # beyond it an exact inverse only amplifies rounding


def pseudo_inverse(
    A: np.ndarray, damping: float = 0.0, truncation: float = 0.0
) -> tuple[np.ndarray, float]:
    """Pseudo-inverse (n, m) of A (m, n), and the condition number of A itself.

    damping: s / (s^2 + damping^2) for 1 / s, in the unit of the singular values s.
    truncation: singular values below this share of the largest count as zero.
    Raises SingularMatrixError where A is singular and neither of the two is given.
    """
    try:
        U, s, Vt = np.linalg.svd(A, full_matrices=False)
        largest, smallest = float(s[0]), float(s[-1])
    except np.linalg.LinAlgError:
        largest = np.nan
    if not largest < np.inf:
        raise SingularMatrixError(f"matrix: not finite: {A.tolist()}")
    condition = largest / smallest if smallest > 0.0 else np.inf
    if damping > 0.0:
        inverse = s / (s * s + damping * damping)
        if truncation > 0.0:
            inverse[s < truncation * largest] = 0.0
    elif truncation > 0.0:
        keep = s >= max(truncation * largest, np.finfo(float).tiny)
        inverse = np.where(keep, 1.0 / np.where(keep, s, 1.0), 0.0)
    elif condition < MAX_CONDITION:
        inverse = 1.0 / s
    else:
        raise SingularMatrixError(
            f"matrix: singular (condition number {condition:.3g}); choose another start, or set "
            "damping or truncation"
        )
    return (Vt.T * inverse) @ U.T, condition


@dataclass(frozen=True)
class AdaptiveGain:
    """A gain that is high near the goal and low far from it, 1/s, with ViSP's values.

    g(x) = (g0 - ginf) exp(-slope x / (g0 - ginf)) + ginf, where x is the largest component of the
    twist that would null the error in one second.
    """

    at_zero: float = 4.0
    at_infinity: float = 0.4
    slope_at_zero: float = 30.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0.0 < value < np.inf:
                raise UserError(f"AdaptiveGain: {name}: expected a positive number, got {value}")
        if not self.at_zero > self.at_infinity:
            raise UserError(f"AdaptiveGain: expected at_zero > at_infinity, got {self}")

    def __call__(self, x: float) -> float:
        span = self.at_zero - self.at_infinity
        return span * exp(-self.slope_at_zero * x / span) + self.at_infinity


@dataclass(frozen=True)
class TwistLimits:
    """Largest linear (m/s) and angular (rad/s) speed; the defaults are ViSP's."""

    linear: float = 0.2
    angular: float = 0.7

    def __post_init__(self) -> None:
        if not (self.linear > 0.0 and self.angular > 0.0):
            raise UserError(f"TwistLimits: expected positive speeds, got {self}")

    def scale(self, twist: np.ndarray) -> np.ndarray:
        """The twist (6,) times one factor that brings both speeds within their limits."""
        linear = float(twist[:3] @ twist[:3]) ** 0.5
        angular = float(twist[3:] @ twist[3:]) ** 0.5
        excess = max(linear / self.linear, angular / self.angular)
        return twist / excess if excess > 1.0 else twist


def camera_jacobian(
    mounting: str,
    T_WE: np.ndarray,
    J_W: np.ndarray,
    T_EC: np.ndarray | None = None,
    T_WC: np.ndarray | None = None,
) -> np.ndarray:
    """(6, n) J with v_C = J qdot, the camera's twist relative to the object it looks at, in C.

    eye_in_hand (needs T_EC): the camera is mounted on E and looks at a fixed object.
    eye_to_hand (needs T_WC): the camera is fixed and looks at an object that E carries. A motion of
    the object is the opposite motion of the camera relative to it, hence the minus.
    """
    T_WE, J_W = np.asarray(T_WE, dtype=float), np.asarray(J_W, dtype=float)
    if J_W.ndim != 2 or J_W.shape[0] != 6 or not np.isfinite(J_W).all():
        raise ServoError(f"jacobian: expected a finite (6, n) matrix, got shape {J_W.shape}")
    J_E = np.vstack([T_WE[:3, :3].T @ J_W[:3], T_WE[:3, :3].T @ J_W[3:]])
    if mounting == "eye_in_hand":
        if T_EC is None:
            raise PoseError("camera_config.T_EC: needed for joint velocities of an eye in hand")
        return velocity_transform(np.linalg.inv(T_EC)) @ J_E
    if T_WC is None:
        raise PoseError("camera_config.T_WC: needed for joint velocities of an eye to hand")
    return -velocity_transform(np.linalg.inv(T_WC) @ T_WE) @ J_E


def joint_velocities(
    J: np.ndarray,
    twist: np.ndarray,
    secondary: np.ndarray | None = None,
    damping: float = 0.0,
) -> np.ndarray:
    """Joint velocities (n,) with J qdot = twist, rad/s.

    secondary: (n,) desired velocities of a second task, projected into the null space of the first:
    qdot = J^+ twist + (I - J^+ J) secondary.
    """
    inverse = pseudo_inverse(J, damping)[0]
    velocities = inverse @ twist
    if secondary is not None:
        # The projector needs the exact inverse: with a damped one the second task would disturb
        # the first.
        exact = inverse if damping == 0.0 else pseudo_inverse(J, truncation=1e-6)[0]
        velocities = velocities + secondary - exact @ (J @ secondary)
    return velocities


def joint_limit_avoidance(
    q: np.ndarray, lower: np.ndarray, upper: np.ndarray, gain: float = 1.0, margin: float = 0.1
) -> np.ndarray:
    """(n,) joint velocities away from near limits, rad/s, for use as `secondary`.

    The negative gradient of a cost that is zero inside a joint's range and grows with the square of
    the distance into the outermost `margin` on either side (Chaumette and Marchand, 2001).
    q, lower, upper: (n,) rad. gain: 1/s. margin: share of each joint's range.
    """
    q, lower, upper = (np.asarray(a, dtype=float) for a in (q, lower, upper))
    if q.shape != lower.shape or q.shape != upper.shape or not (lower < upper).all():
        raise UserError("joint limits: expected as many lower < upper as there are joints")
    reserve = margin * (upper - lower)
    above = np.maximum(q - (upper - reserve), 0.0)
    below = np.maximum((lower + reserve) - q, 0.0)
    return -gain * (above - below)
