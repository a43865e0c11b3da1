"""Motions of the arm between postures and along straight lines, sampled at the control rate.

The same plans for every simulator: pure numpy, no state but the control period.

Commands to the arm, each of which passes its gate, whatever simulates the arm.

`envs.pybullet_panda` drives PyBullet's motors, `envs.mujoco_panda` MuJoCo's; no other way leads to them.
"""

from __future__ import annotations

from abc import abstractmethod

import numpy as np
from scipy.spatial.transform import Rotation

from envs.robot_kinematics import (
    CARTESIAN_ACCELERATION,
    Trajectory,
    UnreachableError,
    forward_kinematics,
    inverse_kinematics,
    rotation_vector,
    time_path,
)
from envs.robot_safety import ArmGate, ArmStoppedError, contact_reason

_WAYPOINT_SPACING = 0.01  # m
_MAX_JUMP = 0.3  # rad between neighbouring waypoints


class MotionPlanner:
    """dt: control period in seconds."""

    dt: float

    def joint_move(self, start: np.ndarray, goal: np.ndarray, **scales: float) -> Trajectory:
        """The quickest synchronous motion between joint positions (7,) within all limits."""
        waypoints = np.linspace(start, goal, 2)
        return time_path(
            waypoints, np.array([0.0, 1.0]), dt=self.dt,
            max_speed=np.inf, max_acceleration=np.inf, **scales,
        )  # fmt: skip

    def straight_move(
        self, start: np.ndarray, goal: np.ndarray, speed: float, rest: np.ndarray, **scales: float
    ) -> Trajectory:
        """E moves on a straight line from FK(start) to the pose `goal` (4, 4), turning evenly.

        start: joint positions (7,). speed: peak Cartesian speed in m/s. Raises UnreachableError if
        any point of the line cannot be reached or the arm would have to jump between postures.
        """
        T = forward_kinematics(start)
        distance = float(np.linalg.norm(goal[:3, 3] - T[:3, 3]))
        turn = rotation_vector(T[:3, :3].T @ goal[:3, :3])
        # A radian counts as 0.2 m, so that a turn on the spot gets waypoints and time as well.
        length = max(distance, 0.2 * float(np.linalg.norm(turn)), 1e-6)
        count = max(2, int(np.ceil(length / _WAYPOINT_SPACING)) + 1)
        waypoints = [np.asarray(start, dtype=float)]
        for share in np.linspace(0, 1, count)[1:]:
            pose = np.eye(4)
            pose[:3, :3] = T[:3, :3] @ Rotation.from_rotvec(share * turn).as_matrix()
            pose[:3, 3] = (1 - share) * T[:3, 3] + share * goal[:3, 3]
            q = inverse_kinematics(pose, waypoints[-1], rest)
            if abs(q - waypoints[-1]).max() > _MAX_JUMP:
                raise UnreachableError(
                    f"the straight line to {np.round(goal[:3, 3], 3).tolist()} m passes too near a "
                    "singular posture of the arm; choose another approach"
                )
            waypoints.append(q)
        return time_path(
            np.array(waypoints), np.linspace(0, length, count), dt=self.dt,
            max_speed=speed, max_acceleration=CARTESIAN_ACCELERATION, **scales,
        )  # fmt: skip


class Robot(MotionPlanner):
    """gate: what every command to the arm passes. q: (7,) rad, where its joints are."""

    gate: ArmGate
    q: np.ndarray

    def command_arm(self, q: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Motor targets of one control period of a trajectory: q (7,) rad, velocity (7,) rad/s.
        Gives the q that was sent: another one where the gate has slowed the arm. Raises
        ArmStoppedError, the arm being told to stay where it is, where the gate lets nothing pass.
        """
        try:
            q, velocity = self.gate.passed(q, velocity)
        except ArmStoppedError:
            self.hold()
            raise
        self._send_arm(q, velocity)
        return q

    def drive_arm_to(self, q: np.ndarray, speed: float = np.inf) -> None:
        """Motor targets for several periods: the motors go to q (7,) no faster than the limits,
        nor than `speed` rad/s. Raises ArmStoppedError, and sends nothing, where the gate refuses
        q."""
        self.gate.admit(q)
        self._drive_arm(q, [min(limit, speed) for limit in self.gate.speeds])

    def hold(self) -> None:
        """Tell the arm to stay where it is, which is allowed everywhere."""
        self._stay(self.q)

    def stop_on_contact(self, limit: float) -> None:
        """Hold the arm and raise ArmStoppedError if more than `limit` newtons press against it."""
        reason = contact_reason(self.contact_force(), limit)
        if reason is not None:
            self.hold()
            raise ArmStoppedError(reason, contact=True)

    def _stay(self, q: np.ndarray) -> None:
        self.gate.restart(q)
        self._send_arm(q, np.zeros(7))

    @abstractmethod
    def contact_force(self) -> float:
        """Sum of the normal forces in newtons on the whole robot."""

    @abstractmethod
    def _send_arm(self, q: np.ndarray, velocity: np.ndarray) -> None:
        """Give the motors one period's references, rad and rad/s, each (7,)."""

    @abstractmethod
    def _drive_arm(self, q: np.ndarray, speeds: list[float]) -> None:
        """Let the motors go to q (7,), rad, at up to `speeds`, seven in rad/s."""
