"""Motions of the Panda along paths, within every limit that its controller checks.

Franka's controller stops the arm where a command exceeds a limit of velocity, acceleration or jerk,
of a joint or of the hand. A motion is a path of the joints, a function of the share s in [0, 1] of
the way, and an `SCurve` that says when which share is reached: the quickest one from rest to rest
(Biagiotti and Melchiorri, "Trajectory Planning for Automatic Machines and Robots", 2008, section
3.4). Where two motions follow each other, `blended` starts the second one before the first has
ended. Pure numpy: no simulator, no cell, no object.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from envs.robot_kinematics import (
    HAND_ACCELERATION,
    HAND_JERK,
    HAND_VELOCITY,
    JOINT_ACCELERATION,
    JOINT_JERK,
    JOINT_LOWER,
    JOINT_UPPER,
    JOINT_VELOCITY,
    tip_twists,
)

_SAMPLES = 65  # of a path, at which its derivatives are measured
_CURVES_SHARE = 0.5  # of an acceleration or jerk that a path's curvature may take for itself
_ROUNDING = 1.0 + 1e-6  # of a limit


@dataclass(frozen=True)
class Trajectory:
    """Joint references at the control rate: positions (N, 7) rad and velocities (N, 7) rad/s."""

    positions: np.ndarray
    velocities: np.ndarray

    def __len__(self) -> int:
        return len(self.positions)

    def __getitem__(self, part: slice) -> Trajectory:
        return Trajectory(self.positions[part], self.velocities[part])


class SCurve:
    """The quickest motion from rest to rest over the distance 1, with bounded derivatives.

    Its jerk is +-jerk or 0 in seven phases, some of which may be empty. duration: s.
    """

    def __init__(self, velocity: float, acceleration: float, jerk: float):
        """velocity, acceleration, jerk: the bounds, in 1/s, 1/s^2 and 1/s^3."""
        ramp = min(acceleration / jerk, math.sqrt(velocity / jerk))  # s, of the acceleration
        speeding = ramp + velocity / (jerk * ramp)  # s, until the velocity is reached
        cruise = 1.0 / velocity - speeding
        if cruise < 0.0:  # the velocity is not reached
            cruise = 0.0
            ramp = min(acceleration / jerk, (0.5 / jerk) ** (1 / 3))
            speeding = 0.5 * ramp + math.sqrt(0.25 * ramp**2 + 1.0 / (jerk * ramp))
        even = max(speeding - 2.0 * ramp, 0.0)
        phases = np.array([ramp, even, ramp, cruise, ramp, even, ramp])
        self._jerks = jerk * np.array([1.0, 0.0, -1.0, 0.0, -1.0, 0.0, 1.0])
        self._starts = np.concatenate([[0.0], np.cumsum(phases)])
        self.duration = float(self._starts[-1])
        states = [np.zeros(3)]  # share, velocity and acceleration at the start of each phase
        for span, slope in zip(phases, self._jerks):
            s, v, a = states[-1]
            states.append(
                np.array(
                    [
                        s + v * span + a * span**2 / 2 + slope * span**3 / 6,
                        v + a * span + slope * span**2 / 2,
                        a + slope * span,
                    ]
                )
            )
        self._states = np.array(states)

    def __call__(self, seconds: np.ndarray) -> np.ndarray:
        """The shares (N,) of the way at times (N,) s from the start; 0 before and 1 after it."""
        t = np.clip(seconds, 0.0, self.duration)
        phase = np.clip(np.searchsorted(self._starts, t, side="right") - 1, 0, 6)
        t = t - self._starts[phase]
        s, v, a = self._states[phase].T
        return np.clip(s + v * t + a * t**2 / 2 + self._jerks[phase] * t**3 / 6, 0.0, 1.0)


class Limits:
    """The limits of joints and hand, times the config's scales; jerks are scaled as accelerations
    are."""

    def __init__(self, velocity_scale: float = 1.0, acceleration_scale: float = 1.0):
        scales = (velocity_scale, acceleration_scale, acceleration_scale)
        self._joints = [
            scale * limit
            for scale, limit in zip(scales, (JOINT_VELOCITY, JOINT_ACCELERATION, JOINT_JERK))
        ]
        self._hand = [
            scale * np.array(limit)
            for scale, limit in zip(scales, (HAND_VELOCITY, HAND_ACCELERATION, HAND_JERK))
        ]

    def used(self, order: int, joints: np.ndarray, twists: np.ndarray) -> float:
        """The largest share of a limit. order: 0, 1 or 2 for velocities, accelerations, jerks.
        joints: (N, 7). twists: (N, 6) of the hand, metres then radians."""
        hand = np.linalg.norm(twists.reshape(-1, 2, 3), axis=2) / self._hand[order]
        return max(float(np.max(abs(joints) / self._joints[order])), float(hand.max()))

    def excess(self, start: np.ndarray, positions: np.ndarray, dt: float) -> float:
        """By what factor references (N, 7), a period of `dt` s after another, are too fast, when
        the arm is at rest at `start` (7,) before and at rest after them: at most 1 where they are
        legal. Taking this times as long makes them legal."""
        before = np.vstack([start, positions])
        change = np.diff(before, axis=0) / dt
        twist = tip_twists((before[1:] + before[:-1]) / 2, change)
        excess = 0.0
        for order in range(3):
            excess = max(excess, self.used(order, change, twist) ** (1.0 / (order + 1)))
            change, twist = (
                np.diff(rows, axis=0, prepend=0.0 * rows[:1], append=0.0 * rows[:1]) / dt
                for rows in (change, twist)
            )
        return excess

    def curve(self, path: Callable[..., np.ndarray], fastest: float) -> SCurve:
        """The S-curve of a path, as quick as its derivatives allow, and at most `fastest` 1/s."""
        s = np.linspace(0.0, 1.0, _SAMPLES)
        joints = path(s, 1)
        twists = tip_twists(path(s), joints)
        velocity = min(fastest, 1.0 / self.used(0, joints, twists))
        acceleration = 1.0 / self.used(1, joints, twists)
        jerk = 1.0 / self.used(2, joints, twists)
        for order in (1, 2):
            joints, twists = path(s, order + 1), np.gradient(twists, s, axis=0)
            bent = max(self.used(order, joints, twists), 1e-9)
            velocity = min(velocity, (_CURVES_SHARE / bent) ** (1.0 / (order + 1)))
        return SCurve(velocity, acceleration, jerk)


def timed(
    path: Callable[..., np.ndarray], dt: float, limits: Limits, fastest: float = np.inf
) -> Trajectory:
    """The references of a motion from rest to rest along a path, every `dt` s.

    path: as scipy's CubicSpline: (N,) shares and the order of a derivative to (N, 7) rad.
    fastest: 1/s, of the share.
    """
    start = path(np.zeros(1))[0]
    if abs(path(np.ones(1))[0] - start).max() < 1e-9:
        return Trajectory(start[None], np.zeros((1, 7)))
    curve = limits.curve(path, fastest)
    periods = math.ceil(curve.duration / dt)
    while True:
        positions = path(curve(np.arange(1, periods + 1) / periods * curve.duration))
        excess = limits.excess(start, positions, dt)
        if excess <= _ROUNDING:
            return _trajectory(start, positions, dt)
        periods = max(math.ceil(periods * excess), periods + 1)


def blended(
    start: np.ndarray, first: Trajectory, second: Trajectory, dt: float, limits: Limits, most: int
) -> Trajectory:
    """Two motions, the second one starting up to `most` periods before the first has ended, as
    early as the limits allow.

    start: (7,) rad, where the first motion starts at rest. The second one starts where the first
    ends. Where both are under way their changes add up, so that the corner between them is cut, by
    what the limits leave room for.
    """
    change = second.positions - first.positions[-1]
    waiting = np.broadcast_to(first.positions[-1], change.shape)

    def together(early: int) -> np.ndarray:
        positions = np.vstack([first.positions, waiting[early:]])
        positions[len(first) - early :] += change
        return positions

    def illegal(early: int) -> bool:
        positions = together(early)
        within = (positions >= JOINT_LOWER).all() and (positions <= JOINT_UPPER).all()
        return not within or limits.excess(start, positions, dt) > _ROUNDING

    early = min(most, len(first), len(second))
    if illegal(early):  # the earlier, the faster both are together: a few halvings find the limit
        early = bisect_left(range(1, early), True, key=illegal)
    return _trajectory(start, together(early), dt)


def _trajectory(start: np.ndarray, positions: np.ndarray, dt: float) -> Trajectory:
    velocities = np.zeros_like(positions)  # at rest at the end
    velocities[:-1] = (positions[1:] - np.vstack([start, positions[:-2]])) / (2 * dt)
    return Trajectory(positions, velocities)
