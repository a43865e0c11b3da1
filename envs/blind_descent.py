"""The last centimetres of a closed-loop grasp, in which the camera sees the object no more.

The hand goes straight on along the grasp's axis and along with the object's motion as it was
foreseen, and follows it while the fingers close. Images go on being taken: the watchdog stops the
arm here too when they stop coming. All velocities pass the safety gate (`GuardedArm`).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from envs.kinematics import (
    JOINT_LOWER,
    JOINT_UPPER,
    forward_kinematics,
    geometric_jacobian,
    pose_error,
)
from envs.safety import ArmStoppedError
from envs.servoing import GuardedArm, servo_period
from envs.sighted_object import SightedObject
from envs.wrist_camera import DepthSight
from utils.servo_errors import ServoError, TargetLostError
from utils.servo_laws import joint_limit_avoidance, joint_velocities

DAMPING = 0.02  # of the arm's Jacobian
AVOIDANCE_GAIN = 0.5  # 1/s, of the redundant joint's flight from limits
_GAIN = 8.0  # 1/s, towards the foreseen path
_REACHED = 0.0015  # m from the end of the path that count as there
_NEAR_ENOUGH = 0.005  # m that do when the time is over
_BRAKE, _SLOWEST = 6.0, 0.02  # 1/s and m/s: the descent slows towards its end, down to this
_SLACK_SECONDS = 0.35  # beyond what the path takes, for its end


class BlindDescent:
    """A path that is fixed now, in the object's motion: from `start`, down by `height` metres.

    start: (4, 4) T_WE above the grasp. camera: gives a sight, or None where no new image has come.
    """

    def __init__(
        self,
        arm: GuardedArm,
        camera: Callable[[], DepthSight | None],
        target: SightedObject,
        start: np.ndarray,
        height: float,
    ):
        self.arm, self.cell, self.camera, self.target = arm, arm.cell, camera, target
        self.settings = arm.cell.config.grasp
        self.start, self.start_seconds, self.height = start, arm.cell.seconds, height
        self.gone = 0.0  # m of the height
        self._steps_to_image = 0  # physics steps
        self._holds = False  # something is gripped, or in the way of the closing hand

    def go(self) -> None:
        """Down to the grasp; raises ServoError where the arm is stopped, or does not get there in
        time."""
        speed = self.settings.descend_speed
        end = self.cell.seconds + self.height / speed + _SLACK_SECONDS
        while True:
            rest = self.height - self.gone
            off = self._step(min(speed, max(_BRAKE * rest, _SLOWEST)) if rest > 0 else 0.0)
            if rest <= 0 and off < _REACHED:
                return
            if self.cell.seconds > end:
                if off < _NEAR_ENOUGH:
                    return
                raise ServoError(f"{1000 * off:.0f} mm off the foreseen path at its end")

    def follow(self, steps: int) -> None:
        """Let physics steps pass while the fingers close, along with the object; hold still once
        something presses harder than the gate allows, which is what a grip does."""
        for _ in range(steps):
            try:
                if not self._holds:
                    self._step(0.0)
                    continue
            except ArmStoppedError as stop:
                if not stop.contact:
                    raise
                self._holds = True
            self.arm.wait()

    def _step(self, sink: float) -> float:
        """Follow the path for one physics step, sinking at `sink` m/s; metres off it before."""
        self._keep_watch()
        dt, now = self.cell.dt, self.cell.seconds
        if now - self.target.found_seconds > self.settings.blind_seconds:
            raise TargetLostError(f"not seen for {self.settings.blind_seconds} s")
        self.gone = min(self.gone + sink * dt, self.height)
        path = self.target.motion.motion(self.start_seconds, now) @ self.start
        path[:3, 3] += self.gone * path[:3, 2]
        q = self.cell.robot.q
        T_WE = forward_kinematics(q)
        error = pose_error(T_WE, path)
        twist = self.target.twist(path[:3, 3], now) + _GAIN * error
        twist[:3] += sink * path[:3, 2] * (self.gone < self.height)
        away = joint_limit_avoidance(q, JOINT_LOWER, JOINT_UPPER, AVOIDANCE_GAIN)
        wish = joint_velocities(geometric_jacobian(q), twist, away, DAMPING)[0]
        # The object is too near to be seen: by design the wish is based on what was foreseen, for
        # no longer than blind_seconds, and as long as the camera shows that it lives.
        self.arm.move(wish, now - self.target.image_seconds)
        return float(np.linalg.norm(error[:3]))

    def _keep_watch(self) -> None:
        """Take the image that is due, only to know that the camera lives."""
        if self._steps_to_image == 0:
            self._steps_to_image = servo_period(self.cell)
            sight = self.camera()
            if sight is not None:
                self.target.image_seconds = sight.seconds
        self._steps_to_image -= 1
