"""The abstract robot: a Panda arm with a gripper and contacts, whatever simulates it.

`Hand` is what the arm's hand and a hand without an arm (`envs.floating_hand`) have in common,
`Robot` is the whole arm. `envs.pybullet_panda` and `envs.mujoco_panda` implement them. A simulator
brings the state, the motors and the contacts; motions, grips and the gate that every command to the
arm passes are the same for all. This module knows no simulator, object, camera or task.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from envs.robot_kinematics import (
    UnreachableError,
    forward_kinematics,
    geometric_jacobian,
    inverse_kinematics,
    rotation_vector,
)
from envs.robot_motion import Limits, Trajectory, blended, timed
from envs.robot_safety import ArmGate, ArmStoppedError, contact_reason
from utils.geometry import GripperGeometry

FINGER_SPEED = 0.05  # m/s a finger, from the Franka Hand's product manual
DRIVE_GAIN = 0.1  # share of the way left that the arm covers in a period near the end of a drive
GRIPPED_OPENING = 0.001  # m by which something between closed fingers has to part them
GRIPPED_SHARE = 0.5  # of the commanded force with which the motor has to press on it
_LEAST_GRIP = 0.1  # N of each finger on what the hand holds
GRIP_COSINE = np.cos(np.radians(70))  # of the steepest contact normal that counts as a grip
LEFT, RIGHT = 0, 1  # fingers; the left one is on the side of E's +y axis

_WAYPOINT_SPACING = 0.01  # m
_MAX_JUMP = 0.3  # rad between neighbouring waypoints
_NEARLY_SINGULAR = 1e-9  # added to J J^T, whose least eigenvalue is 0.02 around home

Contact = tuple[tuple[float, float, float], float]  # normal in W, and newtons along it


class Hand(ABC):
    """A Panda hand in one cell, on an arm or without one. Bodies are the simulator's numbers.

    dt: s, a control period. grip_force: N a finger, unless a command names another force. gripper:
    its shape. links: the numbers under which the hand, and the arm if it has one, appear in an
    `Image`. latency: physics steps after which a motor command arrives, 0 unless changed.
    """

    links: list[int]

    def __init__(self, dt: float, gripper: GripperGeometry, grip_force: float):
        self.dt, self.gripper, self.grip_force = dt, gripper, grip_force
        self.latency = 0
        self._clock = 0  # physics steps
        self._told_force = grip_force  # N a finger, of the last command to the gripper
        self._underway: deque[tuple[int, Callable[[], object]]] = deque()  # by time of arrival

    # --- State --------------------------------------------------------------------------------

    @property
    @abstractmethod
    def q(self) -> np.ndarray:
        """(N,) positions of the joints that carry the hand, rad or m."""

    @property
    @abstractmethod
    def opening(self) -> float:
        """Distance between the fingertips in metres."""

    @property
    def max_opening(self) -> float:
        """Widest distance between the fingertips in metres."""
        return self.gripper.max_opening

    @abstractmethod
    def tip_pose(self) -> np.ndarray:
        """(4, 4) T_WE."""

    @abstractmethod
    def encoder_pose(self) -> np.ndarray:
        """(4, 4) T_WE by the joints' positions."""

    def closing_direction(self) -> np.ndarray:
        """(3,) unit vector in W along E's y axis, from the right finger to the left one."""
        return self.tip_pose()[:3, 1]

    # --- Latency ------------------------------------------------------------------------------

    def receive(self, count: int) -> int:
        """Carry out the commands that have arrived, and advance the motors' clock by up to `count`
        physics steps; returns by how many, because no command arrives in between."""
        while self._underway and self._underway[0][0] <= self._clock:
            self._underway.popleft()[1]()
        if self._underway:
            count = min(count, self._underway[0][0] - self._clock)
        self._clock += count
        return count

    def _send(self, command: Callable[..., object], *args: Any, **kwargs: Any) -> None:
        """Give a motor command, or delay it by the latency; commands arrive in the order given."""
        if self.latency or self._underway:
            due = self._clock + self.latency
            self._underway.append((due, partial(command, *args, **kwargs)))
        else:
            command(*args, **kwargs)

    # --- Gripper ------------------------------------------------------------------------------

    def command_gripper(self, opening: float, force: float | None = None) -> None:
        """Drive both fingers towards `opening` metres with at most `force` newtons a finger."""
        opening = min(max(float(opening), 0.0), self.max_opening)
        self._told_force = self.grip_force if force is None else force
        self._send_gripper(opening, self._told_force)

    def open_gripper(self) -> None:
        """Drive both fingers apart as far as they get."""
        self.command_gripper(self.max_opening)

    @abstractmethod
    def _send_gripper(self, opening: float, force: float) -> None:
        """Give the fingers' motor its goal in metres, FINGER_SPEED a finger being the fastest."""

    def grip_forces(self, body: int) -> tuple[float, float]:
        """Newtons with which the left and the right finger press a body towards each other; zero
        where one of them does not touch the body.

        A contact counts only where its normal lies within 70 degrees of the closing line and points
        inwards: a body that lies on the fingers, or is pushed down by a fist, is not gripped.
        """
        contacts = [list(self._finger_contacts(finger, body)) for finger in (LEFT, RIGHT)]
        if not (contacts[LEFT] and contacts[RIGHT]):
            return 0.0, 0.0
        x, y, z = self.closing_direction().tolist()
        inwards = []
        # The left finger is on the side of E's +y axis, so its contacts push the body along -y.
        for sign, touching in zip((-1.0, 1.0), contacts):
            force = 0.0
            for normal, newtons in touching:
                share = sign * (normal[0] * x + normal[1] * y + normal[2] * z)
                if share > GRIP_COSINE:
                    force += share * newtons
            inwards.append(force)
        return inwards[LEFT], inwards[RIGHT]

    def holds(self, body: int) -> bool:
        """Whether both fingers grip the body, with at least 0.1 N each."""
        return min(self.grip_forces(body)) >= _LEAST_GRIP

    def carrying(self) -> AbstractContextManager[None]:
        """While the hand lifts and carries something: a simulator whose solver is too coarse for
        that computes finer inside this context."""
        return nullcontext()

    @abstractmethod
    def renew_contacts(self) -> None:
        """Ask now and then while the hand carries something: a simulator that keeps contacts as it
        found them finds the fingers' anew, in its next step, where the hand has turned since."""

    @abstractmethod
    def _finger_contacts(self, finger: int, body: int) -> Iterable[Contact]:
        """Contacts of a finger, LEFT or RIGHT, with a body; their normals point into the body."""

    def grips(self) -> bool:
        """Whether the fingers feel something between them: they are apart, by more than the
        gripper's `least_held`, and their motor presses with half of what it was told at least. True
        contacts are not asked."""
        pressing = self.finger_force() >= GRIPPED_SHARE * self._told_force
        return pressing and self.opening > max(GRIPPED_OPENING, self.gripper.least_held)

    @abstractmethod
    def finger_force(self) -> float:
        """Newtons a finger with which the hand's motor closes it; negative where it opens it."""

    # --- Contacts -----------------------------------------------------------------------------

    @abstractmethod
    def contact_force(self) -> float:
        """Sum of the normal forces in newtons on the whole robot, by the true contacts."""

    @abstractmethod
    def touches(self) -> bool:
        """Whether anything touches the robot, or is so near that contact is looked for."""

    @abstractmethod
    def touches_body(self, body: int) -> bool:
        """Whether the robot and a body are in contact."""

    @abstractmethod
    def palm_touches(self) -> bool:
        """Whether anything presses on the hand itself, not only on its fingers."""


class Robot(Hand):
    """A robot in one cell: the hand on the arm. gate: every command to the arm passes it."""

    def __init__(self, dt: float, gripper: GripperGeometry, grip_force: float, gate: ArmGate):
        super().__init__(dt, gripper, grip_force)
        self.gate = gate

    # --- State --------------------------------------------------------------------------------

    @abstractmethod
    def state(self) -> list[float]:
        """Joint positions (7, rad), joint velocities (7, rad/s) and the gripper's opening (m)."""

    def joint_state(self) -> tuple[np.ndarray, np.ndarray, float]:
        """Joint positions (7,) rad, velocities (7,) rad/s and the gripper's opening in metres."""
        state = self.state()
        return np.array(state[:7]), np.array(state[7:14]), state[14]

    @property
    def q(self) -> np.ndarray:
        """Joint positions (7,) in radians."""
        return self.joint_state()[0]

    @property
    def opening(self) -> float:
        """Distance between the fingertips in metres."""
        return self.joint_state()[2]

    @abstractmethod
    def place(self, q: np.ndarray, opening: float | None = None) -> None:
        """Put the robot at joint positions q (7,), rad, with the gripper at `opening` metres, at
        rest; None opens it as wide as it gets."""

    def encoder_pose(self) -> np.ndarray:
        """(4, 4) T_WE by forward kinematics of the joints' positions."""
        return forward_kinematics(self.q)

    # --- Commands to the arm ------------------------------------------------------------------

    def command_arm(self, q: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Motor targets of one control period of a trajectory: q (7,) rad, velocity (7,) rad/s.

        Returns the q that was sent: another one where the gate has slowed the arm. Where the gate
        lets nothing pass, the arm is commanded to stay where it is and ArmStoppedError is raised.
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
        nor than `speed` rad/s, and ever slower near the end (DRIVE_GAIN). Raises ArmStoppedError,
        and sends nothing, where the gate refuses q."""
        self.gate.admit(q)
        self._drive_arm(q, [min(limit, speed) for limit in self.gate.speeds])

    def hold(self) -> None:
        """Command the arm to stay where it is, which is allowed everywhere."""
        self._stay(self.q)

    def stop_on_contact(self, limit: float) -> None:
        """Hold the arm and raise ArmStoppedError if more than `limit` newtons press against it."""
        reason = contact_reason(self.external_force(), limit)
        if reason is not None:
            self.hold()
            raise ArmStoppedError(reason, contact=True)

    @abstractmethod
    def limit_speed(self, speed: float) -> None:
        """Limit every joint to `speed` rad/s while `drive_arm_to` moves the arm; a trajectory keeps
        its own limits."""

    def _stay(self, q: np.ndarray) -> None:
        self.gate.restart(q)
        self._send_arm(q, np.zeros(7))

    @abstractmethod
    def _send_arm(self, q: np.ndarray, velocity: np.ndarray) -> None:
        """Give the motors one period's references, rad and rad/s, each (7,)."""

    @abstractmethod
    def _drive_arm(self, q: np.ndarray, speeds: list[float]) -> None:
        """Let the motors go to q (7,), rad, at up to `speeds`, seven in rad/s."""

    def _stay_placed(self, q: np.ndarray, opening: float) -> None:
        """Have the motors stay where `place` has put the robot, at once whatever the latency; what
        was underway never arrives."""
        self._underway.clear()
        latency, self.latency = self.latency, 0
        self._stay(q)
        self.command_gripper(opening)
        self.latency = latency

    # --- What the robot feels -----------------------------------------------------------------

    def external_push(self) -> np.ndarray:
        """(3,) newtons in W with which things press on the hand, by the torques that the joints
        feel.

        The force of the wrench at E that explains the external torques best, as libfranka's
        O_F_ext_hat_K. Forces on the hand that cancel are not felt, nor are an object's weight and
        what presses on the arm told apart. Ask after every physics step: the first time, and after
        a pause, nothing is felt.
        """
        torques = self.external_torques()
        if not torques.any():
            return np.zeros(3)
        J = geometric_jacobian(self.q)
        return np.linalg.solve(J @ J.T + _NEARLY_SINGULAR * np.eye(6), J @ torques)[:3]

    def external_force(self) -> float:
        """Newtons: how hard `external_push` is."""
        return math.hypot(*self.external_push())

    @abstractmethod
    def external_torques(self) -> np.ndarray:
        """(7,) N m on the arm's joints in the last physics step that neither the motors nor the
        robot's own motion explain, with the masses and the joint damping that it has, randomised
        ones, too; zero where there is no step to compare with."""

    # --- Motions ------------------------------------------------------------------------------

    def joint_move(self, start: np.ndarray, goal: np.ndarray, **scales: float) -> Trajectory:
        """The quickest synchronous motion between joint positions (7,) within all limits."""
        return timed(CubicSpline([0.0, 1.0], [start, goal]), self.dt, Limits(**scales))

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
        path = CubicSpline(np.linspace(0, 1, count), waypoints)
        return timed(path, self.dt, Limits(**scales), fastest=speed / length)

    def blended_moves(
        self, start: np.ndarray, first: Trajectory, second: Trajectory, most: int, **scales: float
    ) -> Trajectory:
        """Two moves, the corner between them cut by up to `most` control periods, see
        `envs.robot_motion.blended`."""
        return blended(start, first, second, self.dt, Limits(**scales), most)
