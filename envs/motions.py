"""Motions of the arm between postures and along straight lines, sampled at the control rate.

The same plans for every simulator: pure numpy, no state but the control period.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from envs.kinematics import (
    CARTESIAN_ACCELERATION,
    Trajectory,
    UnreachableError,
    forward_kinematics,
    inverse_kinematics,
    rotation_vector,
    time_path,
)

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
