"""Scenarios: what makes a scene harder than its layout, such as a disturbance or late images.

A scenario may displace the objects while the arm is on its way, carry them on a conveyor, assume a
wrong calibration, or delay the images. Each draws from the round's seed and the attempt's number,
so that every policy and every controller meets the same. SCENARIOS lists them by name; a new entry
is a new name for `evaluate.scenarios`.

Calibration: images come from the cameras' true poses; planners and loops know the poses of a
`CameraCalibration` only. In a miscalibrated cell both cameras are off, each in a direction of its
own. What a camera has seen itself is free of that error: `teach` lets the wrist camera look at a
board on a jig at a known place before the fingers (teaching by showing).

Motion: all remaining objects move in the plane, as on a tray: in every physics step each body is
set to the motion's pose and velocity. When the robot touches one of them, or the motion is over,
physics alone moves them from there on. This module knows no control law.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from envs.board import Board
from envs.cell import Cell, Intrinsics, require_arm, wrist_mount
from envs.cell_layout import EMPTY, Scene
from envs.cell_scenes import LAYOUTS
from envs.robot_kinematics import forward_kinematics
from utils.errors import TargetLostError
from utils.random_streams import Stream
from utils.table_plane import fit_table_plane
from utils.transforms import RGBDFrame, inverse_pose, planar

_BOARD_DEPTH = 0.25  # m from the camera to the board on the jig
_BOARD_TURN = np.diag([1.0, -1.0, -1.0])  # its face towards the camera


@dataclass(frozen=True)
class CameraCalibration:
    """The poses of the cameras that the program assumes.

    T_WC: (4, 4) overhead camera. T_EC: (4, 4) wrist camera in the gripper. levelled: whether frames
    are turned and lifted until their table lies at its known height.
    """

    T_WC: np.ndarray
    T_EC: np.ndarray
    levelled: bool = False

    def frame(self, frame: RGBDFrame, mount: str, T_WE: np.ndarray) -> RGBDFrame:
        """A frame with the assumed camera pose. mount: overhead or wrist. T_WE: (4, 4) the gripper
        by its encoders."""
        T_WC = self.T_WC if mount == "overhead" else T_WE @ self.T_EC
        frame = replace(frame, T_WC=T_WC)
        return level(frame) if self.levelled else frame


def true_calibration(cell: Cell) -> CameraCalibration:
    return CameraCalibration(cell.camera_pose("overhead"), wrist_mount(cell.config.camera))


def wrong_calibration(
    cell: Cell, rng: np.random.Generator, distance: float, angle: float
) -> CameraCalibration:
    """A calibration in which both cameras are `distance` metres and `angle` radians off, each in
    random directions."""
    true = true_calibration(cell)
    T_WC, T_EC = (displaced(T, rng, distance, angle) for T in (true.T_WC, true.T_EC))
    return CameraCalibration(T_WC, T_EC, levelled=True)


def displaced(T: np.ndarray, rng: np.random.Generator, distance: float, angle: float) -> np.ndarray:
    """A pose (4, 4) shifted and turned on the spot, each in a direction uniform on the sphere."""
    shift, axis = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    wrong = T.copy()
    wrong[:3, :3] = Rotation.from_rotvec(angle * axis).as_matrix() @ T[:3, :3]
    wrong[:3, 3] += distance * shift
    return wrong


def level(frame: RGBDFrame) -> RGBDFrame:
    """The frame with its camera turned in place and lifted, so that its table is level at z = 0.
    Horizontal position and heading keep their errors. Without this a planner finds the table two
    centimetres in the air and plans nothing."""
    normal, offset = fit_table_plane(frame.depth, frame.K, inverse_pose(frame.T_WC))
    up = frame.T_WC[:3, :3] @ normal
    turn, _ = Rotation.align_vectors([[0.0, 0.0, 1.0]], [up])
    T_WC = frame.T_WC.copy()
    T_WC[:3, :3] = turn.as_matrix() @ T_WC[:3, :3]
    T_WC[2, 3] = offset
    return replace(frame, T_WC=T_WC)


def teach(cell: Cell, scene: Scene = EMPTY) -> np.ndarray:
    """(4, 4) T_CE as the wrist camera itself shows it: from the board's pose in one image, taken
    while the jig holds the board at a known pose in E. The first call with a cell empties it and
    keeps the pose as `cell.taught`; later calls return that. A cell that differs from scene to
    scene (`evaluate.randomise`) is built each time as for `scene`, with the camera that it has
    there; the jig holds the board over the objects. Where its light or its noise hides the board,
    the pose is the one that the config states."""
    require_arm(cell.config, "a closed loop")
    if cell.on_build is not None:
        try:
            return _measure_mount(cell, scene)
        except TargetLostError:
            return inverse_pose(wrist_mount(cell.config.camera))
    if cell.taught is None:
        cell.taught = _measure_mount(cell, EMPTY)
    return cell.taught


def _measure_mount(cell: Cell, scene: Scene) -> np.ndarray:
    servo, camera = cell.config.servo, cell.config.camera
    intrinsics = Intrinsics(
        servo.width, servo.height, camera.wrist_fov_deg, camera.near, camera.far
    )
    T_EB = np.eye(4)  # the jig: the board's middle lies before the camera's nominal place
    T_EB[:3, :3] = wrist_mount(camera)[:3, :3] @ _BOARD_TURN
    T_EB[:3, 3] = np.add(camera.wrist_position, [0.0, 0.0, _BOARD_DEPTH])
    board = Board(cell=0.009)
    cell.show_board(board, forward_kinematics(cell.home) @ T_EB, scene)
    rgb = cell.look(intrinsics, cell.camera_pose("wrist")).rgb
    T_CB = board.pose(board.find(rgb), intrinsics.K)
    return T_CB @ inverse_pose(T_EB)


_START_SECONDS = 0.2  # in which a conveyor gets up to speed, so that objects do not topple


@dataclass(frozen=True)
class Displacement:
    """A motion by `shift` (2,) metres and `turn` rad about the object's centre, `duration` seconds
    long from `start` seconds on; a quintic in time (smooth, at rest before and after)."""

    shift: np.ndarray
    turn: float
    start: float
    duration: float = 0.4

    @property
    def end(self) -> float:
        return self.start + self.duration

    def __call__(self, seconds: float) -> tuple[float, float, float]:
        u = np.clip((seconds - self.start) / self.duration, 0.0, 1.0)
        share = u**3 * (10 - 15 * u + 6 * u**2)
        return (*(share * self.shift), share * self.turn)


@dataclass(frozen=True)
class Conveyor:
    """A motion at `speed` m/s, first in the direction `heading` rad about +z from +x, on a path
    that turns by `turn_rate` rad/s; the object turns with it."""

    speed: float
    heading: float
    turn_rate: float = 0.0

    @property
    def end(self) -> float:
        return np.inf

    def __call__(self, seconds: float) -> tuple[float, float, float]:
        # The belt's distance over its speed: the speed grows linearly over the start.
        ramp = min(seconds, _START_SECONDS)
        time = max(ramp**2 / (2 * _START_SECONDS) + max(seconds - _START_SECONDS, 0.0), 0.0)
        turn = self.turn_rate * time
        if abs(turn) < 1e-6:
            along, across = self.speed * time, 0.0
        else:
            radius = self.speed / self.turn_rate
            along, across = radius * np.sin(turn), radius * (1 - np.cos(turn))
        c, s = np.cos(self.heading), np.sin(self.heading)
        return c * along - s * across, s * along + c * across, turn


@contextlib.contextmanager
def disturbed(cell: Cell, motion: Displacement | Conveyor | None) -> Iterator[None]:
    """Within the block `motion` moves the objects of the cell, from now on; None moves nothing."""
    if motion is None or not cell.remaining:
        yield
        return
    before, cell.before_step = cell.before_step, _Carrier(cell, motion)
    try:
        yield
    finally:
        cell.before_step = before


class _Carrier:
    """Moves all bodies along one motion, until it is over or the robot touches one of them."""

    def __init__(self, cell: Cell, motion: Displacement | Conveyor):
        self.motion, self.start = motion, cell.seconds
        self.poses = {index: cell.object_pose(index) for index in cell.remaining}
        first = self.poses[min(self.poses)]
        self.pivot = planar(*first[:2, 3], 0.0)
        self.over = False

    def __call__(self, cell: Cell) -> None:
        if self.over:
            return
        now = cell.seconds - self.start
        touched = (cell.robot.touches_body(cell.bodies[index]) for index in self.poses)
        if now > self.motion.end or any(touched):
            self.over = True
            return
        T, ahead = self._planar(now), self._planar(now + cell.dt)
        turn_rate = (self.motion(now + cell.dt)[2] - self.motion(now)[2]) / cell.dt
        for index, pose in self.poses.items():
            velocity = ((ahead - T) @ pose)[:3, 3] / cell.dt
            cell.carry(index, T @ pose, velocity, turn_rate)

    def _planar(self, seconds: float) -> np.ndarray:
        """(4, 4) motion in W, about the first object's centre."""
        return self.pivot @ planar(*self.motion(seconds)) @ inverse_pose(self.pivot)


@dataclass(frozen=True)
class Scenario:
    """The conditions of a round.

    layout: of the scene (`envs.cell_scenes`). moved: whether objects are displaced during the
    approach. speed: m/s of a conveyor, 0: none. turning: whether the conveyor's path turns.
    miscalibrated: whether the calibration is wrong. latency: seconds by which images arrive late.
    """

    layout: str
    moved: bool = False
    speed: float = 0.0
    turning: bool = False
    miscalibrated: bool = False
    latency: float = 0.0

    def motion(self, cell: Cell, attempt: int) -> Displacement | Conveyor | None:
        """The motion of the objects during an attempt, counted from 0; None: they rest."""
        rng = self._rng(cell, attempt)
        if not cell.remaining:
            return None
        centre = np.array(cell.config.workspace.center)
        place = cell.object_position(min(cell.remaining))[:2]
        if self.moved:
            return displacement(rng, place, centre, cell.config.workspace.size / 2)
        if self.speed > 0.0:
            return conveyor(rng, place, centre, self.speed, self.turning)
        return None

    def calibration(self, cell: Cell) -> CameraCalibration:
        """The calibration that the round assumes, the same in each of its attempts."""
        if not self.miscalibrated:
            return true_calibration(cell)
        settings, rng = cell.config.closed_loop, self._rng(cell, -1)
        turn = np.radians(settings.camera_turn_deg)
        return wrong_calibration(cell, rng, settings.camera_shift, turn)

    def _rng(self, cell: Cell, attempt: int) -> np.random.Generator:
        return np.random.default_rng([cell.scene.seed, attempt + 1, Stream.MOTION])


def displacement(
    rng: np.random.Generator, place: np.ndarray, centre: np.ndarray, reach: float
) -> Displacement:
    """A displacement of 3 to 8 cm in a direction that stays in the workspace, or towards its centre
    where none is found, and of up to 45 degrees, which begins 0.2 to 0.8 s after the arm has set
    out."""
    for _ in range(100):
        angle, distance = rng.uniform(-np.pi, np.pi), rng.uniform(0.03, 0.08)
        shift = distance * np.array([np.cos(angle), np.sin(angle)])
        if np.abs(place + shift - centre).max() < reach:
            break
    else:  # the object has left the workspace, or the workspace is small
        angle = np.arctan2(*(centre - place)[::-1])
        shift = distance * np.array([np.cos(angle), np.sin(angle)])
    return Displacement(shift, rng.uniform(-1, 1) * np.pi / 4, rng.uniform(0.2, 0.8))


def conveyor(
    rng: np.random.Generator, place: np.ndarray, centre: np.ndarray, speed: float, turning: bool
) -> Conveyor:
    """A conveyor sideways past the robot, away from the tray (whose walls the hand would hit), up
    to 30 degrees askew towards the middle of the workspace; `turning` so by 0.2 to 0.4 rad/s."""
    inwards = 1.0 if place[0] > centre[0] else -1.0  # left of +y lies -x
    heading = np.pi / 2 + inwards * rng.uniform(0, np.pi / 6)
    turn_rate = inwards * rng.uniform(0.2, 0.4) if turning else 0.0
    return Conveyor(speed, heading, turn_rate)


SCENARIOS = {
    **{layout: Scenario(layout) for layout in LAYOUTS},
    "static": Scenario("isolated"),
    "moved": Scenario("isolated", moved=True),
    "moving_5cm": Scenario("isolated", speed=0.05),
    "moving_10cm": Scenario("isolated", speed=0.10),
    "turning_5cm": Scenario("isolated", speed=0.05, turning=True),
    "turning_10cm": Scenario("isolated", speed=0.10, turning=True),
    "miscalibrated": Scenario("isolated", miscalibrated=True),
    "latency": Scenario("isolated", speed=0.05, latency=0.1),
}
