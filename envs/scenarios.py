"""What happens to objects while the arm is on its way to them.

Everything that is still on the table is carried along one motion in the plane, as if on a tray: in
every physics step each body is put where the motion has it by then, with the motion's velocity.
That ends for good, and the body is left to the physics with the velocity that it had, as soon as
the robot touches one of the bodies, or when the motion is over. Knows no camera and no controller.

What makes a scenario hard beside its layout: a disturbance, a wrong calibration, late images.

Each is drawn from the round's seed and the number of the attempt, so that every policy and every
controller meets the same.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from envs.camera_calibration import CameraCalibration, true_calibration, wrong_calibration
from envs.cell import Cell
from utils.transforms import inverse_pose, planar

_START_SECONDS = 0.2  # in which a conveyor gets up to speed: what stands must not topple


@dataclass(frozen=True)
class Displacement:
    """Moved by `shift` (2,) metres and `turn` rad about its centre, within `duration` seconds from
    `start` seconds on; a quintic in time (smooth, at rest before and after)."""

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
    """Carried at `speed` m/s, first in the direction `heading` rad about +z from +x, on a path that
    turns by `turn_rate` rad/s; the object turns with it."""

    speed: float
    heading: float
    turn_rate: float = 0.0

    @property
    def end(self) -> float:
        return np.inf

    def __call__(self, seconds: float) -> tuple[float, float, float]:
        # Time as the belt counts it: its speed grows in a line over the start.
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
    """Within the block a motion carries the objects of the cell, from now on, unless it is None."""
    if motion is None or not cell.remaining:
        yield
        return
    before, cell.before_step = cell.before_step, _Carrier(cell, motion)
    try:
        yield
    finally:
        cell.before_step = before


class _Carrier:
    """Carries all bodies along one motion, until something ends it."""

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


_STREAM = 7  # keeps these draws apart from the scene's of the same seed


@dataclass(frozen=True)
class Scenario:
    """moved: objects are displaced during the approach. speed: m/s of a conveyor. turning: whether
    it goes round a corner. crossing: whether it goes through the middle of the workspace, in
    whatever direction that is, instead of sideways. miscalibrated: whether the cameras' believed
    poses are off. latency: seconds by which images arrive late. Scenes are laid out as `layout`."""

    layout: str
    moved: bool = False
    speed: float = 0.0
    turning: bool = False
    crossing: bool = False
    miscalibrated: bool = False
    latency: float = 0.0

    def motion(self, cell: Cell, attempt: int) -> Displacement | Conveyor | None:
        """What happens to the objects during an attempt, 0 being the first."""
        rng = self._rng(cell, attempt)
        if not cell.remaining:
            return None
        centre = np.array(cell.config.workspace.center)
        place = cell.object_position(min(cell.remaining))[:2]
        if self.moved:
            return displacement(rng, place, centre, cell.config.workspace.size / 2)
        if self.crossing:
            return crossing(rng, place, centre, self.speed)
        if self.speed > 0.0:
            return conveyor(rng, place, centre, self.speed, self.turning)
        return None

    def calibration(self, cell: Cell) -> CameraCalibration:
        """The calibration that the round assumes, the same in each of its attempts."""
        if not self.miscalibrated:
            return true_calibration(cell)
        off = cell.config.closed_loop
        rng = self._rng(cell, -1)
        return wrong_calibration(cell, rng, off.camera_shift, np.radians(off.camera_turn_deg))

    def _rng(self, cell: Cell, attempt: int) -> np.random.Generator:
        return np.random.default_rng([cell.scene.seed, attempt + 1, _STREAM])


def displacement(
    rng: np.random.Generator, place: np.ndarray, centre: np.ndarray, reach: float
) -> Displacement:
    """3 to 8 cm in a direction that stays in the workspace, and up to 45 degrees, begun 0.2 to
    0.8 s after the arm has set out."""
    for _ in range(100):
        angle, distance = rng.uniform(-np.pi, np.pi), rng.uniform(0.03, 0.08)
        shift = distance * np.array([np.cos(angle), np.sin(angle)])
        if np.abs(place + shift - centre).max() < reach:
            break
    return Displacement(shift, rng.uniform(-1, 1) * np.pi / 4, rng.uniform(0.2, 0.8))


def conveyor(
    rng: np.random.Generator, place: np.ndarray, centre: np.ndarray, speed: float, turning: bool
) -> Conveyor:
    """Sideways past the robot, away from the bin (whose walls the hand would hit), up to 30 degrees
    askew towards the middle of the workspace; turning by 0.2 to 0.4 rad/s that way, too."""
    inwards = 1.0 if place[0] > centre[0] else -1.0  # left of +y lies -x
    heading = np.pi / 2 + inwards * rng.uniform(0, np.pi / 6)
    turn_rate = inwards * rng.uniform(0.2, 0.4) if turning else 0.0
    return Conveyor(speed, heading, turn_rate)


def crossing(
    rng: np.random.Generator, place: np.ndarray, centre: np.ndarray, speed: float
) -> Conveyor:
    """Straight towards the middle of the workspace and on, up to 30 degrees askew: from where the
    object lies that can be towards the robot, away from it, or sideways."""
    x, y = centre - place
    return Conveyor(speed, float(np.arctan2(y, x)) + rng.uniform(-np.pi / 6, np.pi / 6))


SCENARIOS = {
    "isolated": Scenario("isolated"),
    "packed": Scenario("packed"),
    "pile": Scenario("pile"),
    "static": Scenario("isolated"),
    "moved": Scenario("isolated", moved=True),
    "moving_5cm": Scenario("isolated", speed=0.05),
    "moving_10cm": Scenario("isolated", speed=0.10),
    "turning_5cm": Scenario("isolated", speed=0.05, turning=True),
    "turning_10cm": Scenario("isolated", speed=0.10, turning=True),
    "crossing_5cm": Scenario("isolated", speed=0.05, crossing=True),
    "miscalibrated": Scenario("isolated", miscalibrated=True),
    "latency": Scenario("isolated", speed=0.05, latency=0.1),
}
