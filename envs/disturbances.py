"""What happens to objects while the arm is on its way to them.

Everything that is still on the table is carried along one motion in the plane, as if on a tray: in
every physics step each body is put where the motion has it by then, with the motion's velocity.
That ends for good, and the body is left to the physics with the velocity that it had, as soon as
the robot touches one of the bodies, or when the motion is over. Knows no camera and no controller.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from envs.base_cell import BaseCell
from utils.tabletop import planar
from utils.transforms import inverse_pose

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
def disturbed(cell: BaseCell, motion: Displacement | Conveyor | None) -> Iterator[None]:
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

    def __init__(self, cell: BaseCell, motion: Displacement | Conveyor):
        self.motion, self.start = motion, cell.seconds
        self.poses = {index: cell.object_pose(index) for index in cell.remaining}
        first = self.poses[min(self.poses)]
        self.pivot = planar(*first[:2, 3], 0.0)
        self.over = False

    def __call__(self, cell: BaseCell) -> None:
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
