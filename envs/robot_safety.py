"""The gates that commands to the arm pass: what of a command may be sent, and why not.

`ArmGate` stands before the motors: every command to them passes it, be it of a planned motion, an
action of the Gymnasium environment or a servo loop. It holds the workspace box and the joints'
limits, and slows a command that is too fast as a whole.

`SafetyGate` stands before that for loops that follow a camera: it holds the watchdog, the contact
stop and the servo's own lower speeds, and approaches each limit so that the arm can still stop in
front of it: a speed of at most sqrt(2 a d) where a distance d is left and a is the deceleration
that the arm is certain to reach.

Both slow the arm by one factor for all joints, which keeps its direction; where nothing may be
sent, they give the reason as text. Pure Python and numpy: they know no simulator, no camera and not
where a command comes from.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from envs.robot_kinematics import (
    CARTESIAN_ACCELERATION,
    JOINT_ACCELERATION,
    JOINT_LOWER,
    JOINT_UPPER,
    JOINT_VELOCITY,
    forward_kinematics,
    geometric_jacobian,
    tip_position,
)
from utils.config_schema import RobotConfig, SafetyConfig
from utils.errors import ServoError

_LEAST_SHARE = 0.01  # of a desired velocity: where a limit leaves less, the arm stops
_TOO_FAST = 1.0 + 1e-6  # of a speed limit: what is planned to be at the limit passes unchanged
_LEAD = 0.001  # m by which a reference may be ahead of an arm that has stopped at the box's edge
_JOINT_RANGES = list(zip(JOINT_LOWER.tolist(), JOINT_UPPER.tolist()))


class ArmStoppedError(ServoError):
    """A gate stopped the arm. contact: because something presses against it."""

    def __init__(self, reason: str, contact: bool = False):
        super().__init__(reason)
        self.contact = contact


def contact_reason(force: float, limit: float) -> str | None:
    """Why an arm on which `force` newtons press has to stop; None where it may go on."""
    return None if force <= limit else f"contact with {force:.1f} N, allowed are {limit} N"


def reaching_down(safety: SafetyConfig, floor: float) -> SafetyConfig:
    """The limits with a box that begins at `floor` m where that is lower than its own."""
    lower = (*safety.box_lower[:2], min(safety.box_lower[2], floor))
    return safety.model_copy(update={"box_lower": lower})


class ArmGate:
    """Checks every command before it reaches the motors of one arm.

    Commands are joint references; the gate keeps the one that was sent last. It refuses a reference
    outside the joints' limits, or with E outside the workspace box, unless it brings the arm back.
    In plain floats, a command takes about 4 us.
    """

    def __init__(self, safety: SafetyConfig, robot: RobotConfig, dt: float, floor: float):
        """dt: seconds of one control period. floor: m, of the box where that is lower than
        safety.box_lower: planned grasps reach down to the table."""
        safety = reaching_down(safety, floor)
        self._box = [
            (low - _LEAD, high + _LEAD) for low, high in zip(safety.box_lower, safety.box_upper)
        ]
        self.speeds = (JOINT_VELOCITY * robot.velocity_scale).tolist()  # rad/s
        self._dt = dt
        self.restart(robot.home)

    def restart(self, q: Sequence[float] | np.ndarray) -> None:
        """Take joint positions q (7,), rad, as the reference sent last, wherever they are."""
        self._q = [float(angle) for angle in q]
        self._tip = tip_position(self._q)
        self._checked = self._q, (None, self._tip)  # the last reference and the answer to it

    def refusal(self, q: np.ndarray, tip: np.ndarray | None = None) -> str | None:
        """Why joint references q (7,), rad, may not be sent; None where they may. tip: (3,) m,
        E at these references, where the caller has it already."""
        angles = q.tolist()
        self._checked = angles, self._check(angles, None if tip is None else tuple(tip.tolist()))
        return self._checked[1][0]

    def passed(self, q: np.ndarray, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The reference q (7,) and its velocity (7,), rad/s, to be sent for one control period:
        the same arrays where they are legal. Raises ArmStoppedError."""
        angles, rates = q.tolist(), velocity.tolist()
        if not math.isfinite(sum(angles) + sum(rates)):
            raise ArmStoppedError("the commanded joint positions or velocities are not finite")
        fastest = max(
            max(abs(new - old) / self._dt, abs(rate)) / limit
            for new, old, rate, limit in zip(angles, self._q, rates, self.speeds)
        )
        if fastest > _TOO_FAST:
            before = np.array(self._q)
            q, velocity = before + (q - before) / fastest, velocity / fastest
        self.admit(q)
        return q, velocity

    def admit(self, q: np.ndarray) -> None:
        """Record that joint references q (7,), rad, are sent; raises ArmStoppedError."""
        angles = q.tolist()
        if angles != self._checked[0]:  # `refusal` has not just checked them
            self._checked = angles, self._check(angles)
        reason, tip = self._checked[1]
        if reason is not None:
            raise ArmStoppedError(reason)
        self._q, self._tip = angles, tip

    def _check(
        self, q: list[float], tip: tuple | None = None
    ) -> tuple[str | None, tuple[float, float, float]]:
        """The reason to refuse, or None, and where E would be. NaN fails each comparison."""
        for number, (angle, before, (low, high)) in enumerate(zip(q, self._q, _JOINT_RANGES), 1):
            if not low <= angle <= high and not min(low, before) <= angle <= max(high, before):
                return f"joint {number} would leave its limits ({angle:.3f} rad)", self._tip
        tip = tip_position(q) if tip is None else tip
        for axis, place, before, (low, high) in zip("xyz", tip, self._tip, self._box):
            if not low <= place <= high and not min(low, before) <= place <= max(high, before):
                return f"the workspace ends here ({axis} = {place:.3f} m)", tip
        return None, tip


@dataclass(frozen=True)
class Verdict:
    """velocity: (7,) rad/s that may be sent. reason: why it is zero; None where the arm may go.
    contact: whether the reason is that something presses against the arm."""

    velocity: np.ndarray
    reason: str | None = None
    contact: bool = False


class SafetyGate:
    """Checks the desired joint velocities of a loop that follows a camera.

    Keeps the fingertips within the workspace box and under a linear speed, the hand under an
    angular speed, and the joints within their limits of position, velocity and acceleration. A stop
    is immediate: nothing is sent on contact, or when the image behind it is too old.
    """

    def __init__(self, safety: SafetyConfig, robot: RobotConfig, dt: float):
        """dt: seconds for which a velocity is sent."""
        self.safety, self.dt = safety, dt
        self._speed = JOINT_VELOCITY * robot.velocity_scale
        self._lower = JOINT_LOWER + safety.joint_margin
        self._upper = JOINT_UPPER - safety.joint_margin
        self._joint_acceleration = JOINT_ACCELERATION * robot.acceleration_scale
        self._deceleration = CARTESIAN_ACCELERATION * robot.acceleration_scale
        self._box = np.array(safety.box_lower), np.array(safety.box_upper)

    def check(
        self,
        desired: np.ndarray,
        q: np.ndarray,
        contact_force: float,
        perception_age: float,
        before: np.ndarray | None = None,
    ) -> Verdict:
        """The part of the desired joint velocities (7,), rad/s, that may be sent.

        q: (7,) rad, where the joints are. contact_force: N on the arm.
        perception_age: seconds since the image was taken from which `desired` was computed.
        before: (7,) rad/s, sent last; the change from there stays within the acceleration limits.
        None: no limit on the change.
        """
        reason = self._refusal(desired, q, perception_age)
        if reason is not None:
            return Verdict(np.zeros(7), reason)
        reason = contact_reason(contact_force, self.safety.contact_stop)
        if reason is not None:
            return Verdict(np.zeros(7), reason, contact=True)
        tip, J = forward_kinematics(q)[:3, 3], geometric_jacobian(q)
        velocity = desired * self._speed_share(desired, J @ desired)
        choices = [velocity]
        if before is not None:  # `desired` itself, where braking that gently would leave no room
            change = velocity - before
            choices.insert(0, before + change * self._change_share(change))
        for velocity in choices:
            share, reason = self._room_share(velocity, q, tip, (J @ velocity)[:3])
            if share >= _LEAST_SHARE:
                return Verdict(share * velocity)
        return Verdict(np.zeros(7), reason)

    def _refusal(self, desired, q, perception_age) -> str | None:
        """Why nothing at all may be sent. A number that is not finite fails each comparison."""
        if not (np.isfinite(desired).all() and np.isfinite(q).all()):
            return "the desired joint velocities or the joint positions are not finite"
        if not perception_age <= self.safety.watchdog:
            return (
                f"what was seen last is {1000 * perception_age:.0f} ms old, "
                f"the watchdog allows {1000 * self.safety.watchdog:.0f} ms"
            )
        return None

    def _speed_share(self, desired, twist) -> float:
        """The factor, at most 1, that brings every speed within its limit."""
        excess = max(
            float(np.max(np.abs(desired) / self._speed)),
            # With an axis, numpy rounds each square; without one, the result depends on BLAS.
            float(np.linalg.norm(twist[:3], axis=0)) / self.safety.linear_speed,
            float(np.linalg.norm(twist[3:])) / self.safety.angular_speed,
        )
        return 1.0 / max(excess, 1.0)

    def _change_share(self, change) -> float:
        """The factor, at most 1, that brings a change of velocities (7,) within one period within
        the acceleration limits."""
        excess = float(np.max(np.abs(change) / (self._joint_acceleration * self.dt)))
        return 1.0 / max(excess, 1.0)

    def _room_share(self, velocity, q, tip, tip_velocity) -> tuple[float, str]:
        """The factor, at most 1, that lets the arm stop before each limit, and the limit that sets
        it."""
        joints = self._shares(velocity, q - self._lower, self._upper - q, self._joint_acceleration)
        box = self._shares(tip_velocity, tip - self._box[0], self._box[1] - tip, self._deceleration)
        joint, axis = int(joints.argmin()), int(box.argmin())
        if joints[joint] <= box[axis]:
            return joints[joint], f"joint {joint + 1} is at its limit ({q[joint]:.3f} rad)"
        return box[axis], f"the workspace ends here ({'xyz'[axis]} = {tip[axis]:.3f} m)"

    def _shares(self, speed, room_below, room_above, deceleration) -> np.ndarray:
        """For each speed (...) the share of it that the room in its direction allows, at most 1."""
        room = np.maximum(np.where(speed < 0, room_below, room_above), 0.0)
        # The second bound: within the next period the limit is not crossed.
        allowed = np.minimum(np.sqrt(2.0 * deceleration * room), room / self.dt)
        size = np.abs(speed)
        return np.divide(allowed, size, out=np.ones_like(size), where=size > allowed)
