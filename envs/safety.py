"""The gate that every velocity of a servo loop passes: what of a wish may be sent, and why not.

The arm is slowed by one factor for all joints, so that its direction is kept; where nothing may be
sent the answer is zero and a reason in words. Each limit is approached so that the arm can still
stop in front of it: a speed of at most sqrt(2 a d) where a room d is left and a is the deceleration
that the arm has for certain.

Pure numpy: it knows neither PyBullet nor cameras nor where a wish comes from.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from envs.kinematics import (
    CARTESIAN_ACCELERATION,
    JOINT_ACCELERATION,
    JOINT_LOWER,
    JOINT_UPPER,
    JOINT_VELOCITY,
    forward_kinematics,
    geometric_jacobian,
)
from utils.config import RobotConfig, SafetyConfig
from utils.errors import UserError

_LEAST_SHARE = 0.01  # of a wish: where a limit leaves less, the arm stops and says so
_FINGERTIPS = ((0.0, 0.0, 0.0),)


@dataclass(frozen=True)
class Verdict:
    """velocity: (7,) rad/s that may be sent. reason: why it is zero; None where the arm may go.
    contact: whether the reason is that something presses against the arm."""

    velocity: np.ndarray
    reason: str | None = None
    contact: bool = False


class SafetyGate:
    """Judges every wish for joint velocities before it reaches the motors.

    Keeps the guarded points within the workspace box and under a linear speed, the hand under an
    angular speed, and the joints within their limits of position and velocity. Nothing is sent on
    contact, or when what the wish was computed from is too old.
    """

    def __init__(self, safety: SafetyConfig, robot: RobotConfig, dt: float, guarded_E=_FINGERTIPS):
        """dt: seconds for which a velocity is sent. guarded_E: (n, 3) points in E, metres, such as
        the corners of something carried."""
        self.safety, self.dt = safety, dt
        self.guarded_E = np.asarray(guarded_E, dtype=float)
        if self.guarded_E.ndim != 2 or self.guarded_E.shape[1] != 3 or not len(self.guarded_E):
            raise UserError(f"guarded_E: expected (n, 3) points, got {self.guarded_E.shape}")
        self._speed = JOINT_VELOCITY * robot.velocity_scale
        self._lower = JOINT_LOWER + safety.joint_margin
        self._upper = JOINT_UPPER - safety.joint_margin
        self._joint_deceleration = JOINT_ACCELERATION * robot.acceleration_scale
        self._deceleration = CARTESIAN_ACCELERATION * robot.acceleration_scale
        self._box = np.array(safety.box_lower), np.array(safety.box_upper)

    def check(
        self, wish: np.ndarray, q: np.ndarray, contact_force: float, perception_age: float
    ) -> Verdict:
        """What may be sent of the wished joint velocities (7,), rad/s.

        q: (7,) rad, where the joints are. contact_force: N on the arm and what it carries.
        perception_age: seconds since the image was taken from which the wish was computed.
        """
        reason = self._refusal(wish, q, perception_age)
        if reason is not None:
            return Verdict(np.zeros(7), reason)
        if not contact_force <= self.safety.contact_stop:
            limit = self.safety.contact_stop
            reason = f"contact with {contact_force:.1f} N, allowed are {limit} N"
            return Verdict(np.zeros(7), reason, contact=True)
        points, speeds, turn = self._motion(q, wish)
        slower = self._speed_share(wish, speeds, turn)
        velocity = slower * wish
        share, reason = self._room_share(velocity, q, points, slower * speeds)
        if share < _LEAST_SHARE:
            return Verdict(np.zeros(7), reason)
        return Verdict(share * velocity)

    def _refusal(self, wish, q, perception_age) -> str | None:
        """Why nothing at all may be sent. A number that is not finite fails each comparison."""
        if not (np.isfinite(wish).all() and np.isfinite(q).all()):
            return "the wished joint velocities or the joint positions are not finite"
        if not perception_age <= self.safety.watchdog:
            return (
                f"what was seen last is {1000 * perception_age:.0f} ms old, "
                f"the watchdog allows {1000 * self.safety.watchdog:.0f} ms"
            )
        return None

    def _motion(self, q, wish) -> tuple[np.ndarray, np.ndarray, float]:
        """The guarded points (n, 3) in W, their velocities (n, 3), and the hand's turning rate."""
        T_WE, twist = forward_kinematics(q), geometric_jacobian(q) @ wish
        arms = self.guarded_E @ T_WE[:3, :3].T
        speeds = twist[:3] + np.cross(twist[3:], arms)
        return T_WE[:3, 3] + arms, speeds, float(np.linalg.norm(twist[3:]))

    def _speed_share(self, wish, speeds, turn: float) -> float:
        """The factor, at most 1, that brings every speed within its limit."""
        excess = max(
            float(np.max(np.abs(wish) / self._speed)),
            float(np.linalg.norm(speeds, axis=1).max()) / self.safety.linear_speed,
            turn / self.safety.angular_speed,
        )
        return 1.0 / max(excess, 1.0)

    def _room_share(self, velocity, q, points, speeds) -> tuple[float, str]:
        """The factor, at most 1, that lets the arm stop before each limit; who sets it."""
        joints = self._shares(velocity, q - self._lower, self._upper - q, self._joint_deceleration)
        box = self._shares(speeds, points - self._box[0], self._box[1] - points, self._deceleration)
        joint, place = int(joints.argmin()), np.unravel_index(box.argmin(), box.shape)
        if joints[joint] <= box[place]:
            return joints[joint], f"joint {joint + 1} is at its limit ({q[joint]:.3f} rad)"
        axis = "xyz"[place[1]]
        return box[place], f"the workspace ends here ({axis} = {points[place]:.3f} m)"

    def _shares(self, speed, room_below, room_above, deceleration) -> np.ndarray:
        """For each speed (...) the share of it that the room in its direction allows, at most 1."""
        room = np.maximum(np.where(speed < 0, room_below, room_above), 0.0)
        # The second bound: within the next period the limit is not crossed.
        allowed = np.minimum(np.sqrt(2.0 * deceleration * room), room / self.dt)
        size = np.abs(speed)
        return np.divide(allowed, size, out=np.ones_like(size), where=size > allowed)
