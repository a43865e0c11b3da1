"""The motion of an object on a table, filtered: where it is, how fast it moves, where it will be.

`PlanarMotion` is an extended Kalman filter with the model of constant speed and turning rate
(Bar-Shalom, Li and Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001,
chapter 11): the velocity turns with the body, as on a belt round a bend. A single sighting that the
model cannot explain is a false match and changes nothing; a second one after it, near the first,
means that the object was pushed, and the filter forgets its velocities.

This module knows no image, no robot and no control law; `utils.object_tracking` makes sightings.
"""

from __future__ import annotations

import numpy as np

from utils.transforms import planar

_ACCELERATION = 0.03  # m/s^2 by root hertz: random change of the velocities without a push
_ANGULAR_ACCELERATION = 0.06  # rad/s^2 by root hertz
# m/s, m/s, rad/s: standard deviations of the rates after a first sighting
_FIRST_RATES = (0.15, 0.15, 0.5)
_SURPRISE = 16.0  # squared Mahalanobis distance of 3 numbers; chance gives more once in 900 times
# Two surprises in a row are one push where they are no farther apart than this: 8 cm and 45 degrees
# within 0.4 s, smoothly, are up to 0.4 m/s and 3.7 rad/s.
_PUSH_SPEED, _PUSH_TURN = 0.8, 8.0  # m/s, rad/s


class PlanarMotion:
    """The filter. Its state: x, y (m), turn (rad) and their rates vx, vy (m/s), omega (rad/s).

    Times are seconds of one clock; sightings arrive in their order.
    """

    def __init__(self, pose: tuple[float, float, float], seconds: float, turns: bool = True):
        """pose: x, y, turn at the first sighting. turns: False for a round object, whose turning
        cannot be seen; the filter takes it to go straight on."""
        self.state = np.array([*pose, 0.0, 0.0, 0.0])
        self._turns = 1.0 if turns else 1e-3
        self._rates = np.array(_FIRST_RATES) * [1, 1, self._turns]
        rates = self._rates
        self.covariance = np.diag(np.concatenate([[0.003, 0.003, 0.05], rates]) ** 2)
        self.seconds = seconds
        # The last sighting, if the model could not explain it.
        self._surprise: tuple[np.ndarray, float] | None = None

    @property
    def velocity(self) -> np.ndarray:
        """(3,) m/s, m/s, rad/s, at the last sighting."""
        return self.state[3:].copy()

    def at(self, seconds: float) -> np.ndarray:
        """(6,) the state predicted for a time; does not change the filter."""
        return _advance(self.state, seconds - self.seconds)

    def motion(self, start: float, end: float) -> np.ndarray:
        """(4, 4) motion in W of the body from one time to another."""
        (x0, y0, a0), (x1, y1, a1) = self.at(start)[:3], self.at(end)[:3]
        return planar(x1, y1, a1) @ np.linalg.inv(planar(x0, y0, a0))

    def see(self, pose: tuple[float, float, float], covariance: np.ndarray, seconds: float) -> bool:
        """Update with a sighting of x, y and turn, with a covariance (3, 3) in W's axes. False
        where the filter rejects it and predicts on as if there had been no sighting."""
        dt = seconds - self.seconds
        F = _transition(self.state, dt)
        self.state = _advance(self.state, dt)
        self.covariance = F @ self.covariance @ F.T + _noise(dt, self._turns)
        self.seconds = seconds
        innovation = _difference(np.asarray(pose), self.state[:3])
        S = self.covariance[:3, :3] + covariance
        before, self._surprise = self._surprise, None
        if innovation @ np.linalg.solve(S, innovation) > _SURPRISE:
            self._surprise = np.asarray(pose), seconds
            if before is None or not _near(before, self._surprise):
                return False
            forget = np.diag(np.concatenate([[0.02, 0.02, 0.2], self._rates]) ** 2)
            self.covariance = self.covariance + forget
            S = self.covariance[:3, :3] + covariance
            self._surprise = None  # the next one has to be confirmed, too
        gain = np.linalg.solve(S, self.covariance[:3]).T
        self.state = self.state + gain @ innovation
        self.covariance = self.covariance - gain @ self.covariance[:3]
        self.covariance = 0.5 * (self.covariance + self.covariance.T)
        return True


def _difference(pose: np.ndarray, other: np.ndarray) -> np.ndarray:
    """(3,) from `other` to `pose`, the turn the shorter way round."""
    difference = pose - other
    difference[2] = (difference[2] + np.pi) % (2 * np.pi) - np.pi
    return difference


def _near(first: tuple[np.ndarray, float], second: tuple[np.ndarray, float]) -> bool:
    """Whether a push can explain the motion between two sightings, each a pose and seconds."""
    x, y, turn = _difference(second[0], first[0])
    dt = second[1] - first[1]
    return bool(np.hypot(x, y) < _PUSH_SPEED * dt and abs(turn) < _PUSH_TURN * dt)


def _advance(state: np.ndarray, dt: float) -> np.ndarray:
    x, y, turn, vx, vy, omega = state
    angle = omega * dt
    # The chord of the arc: integral of the turning velocity.
    a, b = (1 - angle**2 / 6, angle / 2 - angle**3 / 24) if abs(angle) < 0.1 else (
        np.sin(angle) / angle, (1 - np.cos(angle)) / angle
    )  # fmt: skip
    c, s = np.cos(angle), np.sin(angle)
    return np.array([
        x + dt * (a * vx - b * vy), y + dt * (b * vx + a * vy), turn + angle,
        c * vx - s * vy, s * vx + c * vy, omega,
    ])  # fmt: skip


def _transition(state: np.ndarray, dt: float) -> np.ndarray:
    """(6, 6) derivative of `_advance` for short times."""
    _, _, _, vx, vy, omega = state
    F = np.eye(6)
    F[:3, 3:] = dt * np.eye(3)
    F[0, 4], F[1, 3] = -0.5 * omega * dt**2, 0.5 * omega * dt**2
    F[0, 5], F[1, 5] = -0.5 * vy * dt**2, 0.5 * vx * dt**2
    F[3, 4], F[4, 3] = -omega * dt, omega * dt
    F[3, 5], F[4, 5] = -vy * dt, vx * dt
    return F


def _noise(dt: float, turns: float) -> np.ndarray:
    """(6, 6) process noise of white accelerations; turns: factor on the angular one."""
    Q = np.zeros((6, 6))
    strength = np.array([_ACCELERATION, _ACCELERATION, turns * _ANGULAR_ACCELERATION]) ** 2
    dt = max(dt, 0.0)
    for k in range(3):
        Q[k, k] = strength[k] * dt**3 / 3
        Q[k, k + 3] = Q[k + 3, k] = strength[k] * dt**2 / 2
        Q[k + 3, k + 3] = strength[k] * dt
    return Q
