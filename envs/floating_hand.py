"""A Panda hand without an arm, which floats: the form in which most of the field scores grasps.

A carriage of three straight joints carries the hand along the axes of the pose at which it was put.
Putting it somewhere takes no time; from there it moves through the physics, along straight lines at
legal speeds. `envs.pybullet_panda` and `envs.mujoco_panda` implement it, `envs.floating_execution`
judges its grasps. This module knows no simulator, object or camera.
"""

from __future__ import annotations

import functools
from abc import abstractmethod
from typing import TypeVar

import numpy as np
from scipy.optimize import linprog

from envs.cell_layout import Box
from envs.panda_model import FINGERS, floating_links
from envs.robot import Hand
from envs.robot_kinematics import HAND_ACCELERATION, HAND_JERK
from envs.robot_motion import SCurve
from utils.config_schema import WorkspaceConfig
from utils.geometry import ConvexSolid, GripperGeometry
from utils.transforms import inverse_pose, top_down_pose, transform_points

PARKED_HEIGHT = 1.2  # m over the workspace: above every camera that looks down at it
YIELDING_FORCE = 2.0  # N, about the friction of a light object on the table
_FASTEST = HAND_ACCELERATION[0], HAND_JERK[0]  # m/s^2, m/s^3


class FloatingHand(Hand):
    """The hand on its carriage, in one cell."""

    _placed = np.eye(4)

    def encoder_pose(self) -> np.ndarray:
        """(4, 4) T_WE by the carriage's positions."""
        T = self._placed.copy()
        T[:3, 3] += T[:3, :3] @ self.q
        return T

    def tip_pose(self) -> np.ndarray:
        """(4, 4) T_WE."""
        return self.encoder_pose()

    def put(self, T_WE: np.ndarray, opening: float | None = None) -> None:
        """Put the hand at T_WE (4, 4) with the fingers `opening` metres apart, None for as far as
        they get, at rest. Nothing is in its way; what was commanded before never arrives."""
        opening = self.max_opening if opening is None else opening
        self._underway.clear()
        self._placed = T_WE.copy()
        self._put(T_WE, opening)
        latency, self.latency = self.latency, 0
        self._send_carriage(np.zeros(3), np.zeros(3))
        self.command_gripper(opening)
        self.latency = latency

    def line(self, goal: np.ndarray, speed: float) -> tuple[np.ndarray, np.ndarray]:
        """A straight motion from rest to rest, at up to `speed` m/s and the hand's own limits of
        acceleration and jerk, from where E is to `goal` (3,) m in W: the carriage's references of
        each control period, (N, 3) m and (N, 3) m/s."""
        start, end = self.q, transform_points(inverse_pose(self._placed), goal)
        distance = float(np.linalg.norm(end - start))
        if distance < 1e-6:
            return start[None], np.zeros((1, 3))
        curve = SCurve(speed / distance, *(limit / distance for limit in _FASTEST))
        periods = int(np.ceil(curve.duration / self.dt))
        shares = curve(np.arange(periods + 2) * self.dt)
        velocities = (shares[2:] - shares[:-2]) / (2 * self.dt)
        velocities[-1] = 0.0
        return (
            start + shares[1:-1, None] * (end - start),
            velocities[:, None] * (end - start),
        )

    def command(self, q: np.ndarray, velocity: np.ndarray) -> None:
        """References of one control period: q (3,) m and velocity (3,) m/s of the carriage."""
        self._send_carriage(q, velocity)

    def hold(self) -> None:
        """Command the hand to stay where it is."""
        self._send_carriage(self.q, np.zeros(3))

    @abstractmethod
    def yield_to_fingers(self) -> None:
        """From now until the next command to the carriage, let the hand give way along its closing
        line to more than YIELDING_FORCE.

        The fingers move together, and the object is seldom in their middle. One that comes first
        then pulls the hand along until the other one comes, too, instead of jamming the object
        against the table. So do the fingers of VGN's hand, each of which has a motor of its own.
        """

    @abstractmethod
    def overlaps(self) -> bool:
        """Whether the hand, as it was put, is inside or on something; nothing moves."""

    @abstractmethod
    def _put(self, T_WE: np.ndarray, opening: float) -> None:
        """Set the carriage's base to T_WE, its joints to 0 and the fingers apart, at rest."""

    @abstractmethod
    def _send_carriage(self, q: np.ndarray, velocity: np.ndarray) -> None:
        """Give the carriage's motors one period's references, m and m/s, each (3,)."""


AnyFloatingHand = TypeVar("AnyFloatingHand", bound=FloatingHand)


def park(hand: AnyFloatingHand, workspace: WorkspaceConfig) -> AnyFloatingHand:
    """The hand, put over the workspace, where no camera sees it."""
    hand.put(top_down_pose(np.array([*workspace.center, PARKED_HEIGHT]), 0.0))
    return hand


def meets_box(gripper: GripperGeometry, T_WE: np.ndarray, opening: float, box: Box) -> bool:
    """Whether a hand at T_WE (4, 4), fingers `opening` metres apart, has a point in common with a
    box."""
    low, high = box.position - box.half_size, box.position + box.half_size
    for part, shift in zip(_solids(gripper), (0.0, opening / 2, -opening / 2)):
        place = T_WE.copy()
        place[:3, 3] += shift * T_WE[:3, 1]
        solid = part.transformed(place)
        if (solid.vertices.min(axis=0) > high).any() or (solid.vertices.max(axis=0) < low).any():
            continue
        common = linprog(
            np.zeros(3), A_ub=solid.normals, b_ub=solid.offsets, bounds=np.column_stack([low, high])
        )
        if common.status == 0:
            return True
    return False


@functools.cache
def _solids(gripper: GripperGeometry) -> tuple[ConvexSolid, ...]:
    """Hand, left and right finger in E, the fingers closed."""
    *_, hand, left, right = floating_links(gripper)
    assert (left.name, right.name) == FINGERS
    return tuple(
        ConvexSolid.from_vertices(transform_points(hand.T @ T, hull))
        for link, T in ((hand, np.eye(4)), (left, left.T), (right, right.T))
        for hull in link.hulls()
    )
