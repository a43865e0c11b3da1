"""What makes a scenario hard beside its layout: a disturbance, a wrong calibration, late images.

Each is drawn from the round's seed and the number of the attempt, so that every policy and every
controller meets the same.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from envs.base_cell import BaseCell
from envs.beliefs import CameraBeliefs, true_beliefs, wrong_beliefs
from envs.disturbances import Conveyor, Displacement

_STREAM = 7  # keeps these draws apart from the scene's of the same seed


@dataclass(frozen=True)
class Challenge:
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

    def motion(self, cell: BaseCell, attempt: int) -> Displacement | Conveyor | None:
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

    def beliefs(self, cell: BaseCell) -> CameraBeliefs:
        """Where the cameras are believed to be, in every attempt of a round."""
        if not self.miscalibrated:
            return true_beliefs(cell)
        off = cell.config.grasp
        rng = self._rng(cell, -1)
        return wrong_beliefs(cell, rng, off.camera_shift, np.radians(off.camera_turn_deg))

    def _rng(self, cell: BaseCell, attempt: int) -> np.random.Generator:
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


CHALLENGES = {
    "isolated": Challenge("isolated"),
    "packed": Challenge("packed"),
    "pile": Challenge("pile"),
    "static": Challenge("isolated"),
    "moved": Challenge("isolated", moved=True),
    "moving_5cm": Challenge("isolated", speed=0.05),
    "moving_10cm": Challenge("isolated", speed=0.10),
    "turning_5cm": Challenge("isolated", speed=0.05, turning=True),
    "turning_10cm": Challenge("isolated", speed=0.10, turning=True),
    "crossing_5cm": Challenge("isolated", speed=0.05, crossing=True),
    "miscalibrated": Challenge("isolated", miscalibrated=True),
    "latency": Challenge("isolated", speed=0.05, latency=0.1),
}
