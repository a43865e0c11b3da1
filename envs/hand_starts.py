"""Where the hand is when an episode begins somewhere else than at home: poses of E in W, not yet
checked for the arm's reach. Knows no robot."""

from __future__ import annotations

import math

import numpy as np

from envs.grasp_goals import Grasp
from envs.kinematics import rotation_matrix
from utils.geometry import GripperGeometry

_MAX_OPENING = GripperGeometry().max_opening
_NEAR_SIDE, _NEAR_HEIGHT, _NEAR_TURN = 0.04, (0.01, 0.10), math.pi / 4
# Looks: heights are even in the logarithm, as what is near moves most in the image.
_LOOK_HEIGHT, _LOOK_TURN = (0.01, 0.42), math.pi / 2
_LOOK_SIDE = 0.01, 0.4  # m, and metres for a metre of height: deviations sideways
_OPEN_SHARE = 0.6  # of the looks: with open fingers, as nearly all of an episode is seen
_GRASP_SHARE = 0.4  # of the looks: on the way down to a grasp
_MOVING_SHARE, _MOST_SQUEEZE = 0.5, 0.02  # of the looks: while the fingers close; m
_GRASP_SIDE, _GRASP_TURN, _GRASP_HEIGHT = 0.008, math.radians(8), 0.06
_HALF_TURN = math.pi


def near(
    T_home: np.ndarray, object_place: np.ndarray, top: float, random: np.random.Generator
) -> np.ndarray:
    """(4, 4) a little over an object, and turned a little from how the hand is at home.

    T_home: (4, 4) the hand at home. object_place: (2,) x, y of the object and top: its highest
    point, in W, m.
    """
    side = random.uniform(-_NEAR_SIDE, _NEAR_SIDE, 2)
    height = top + random.uniform(*_NEAR_HEIGHT)
    return _hand(T_home, object_place + side, height, random.uniform(-_NEAR_TURN, _NEAR_TURN))


def look(
    T_home: np.ndarray,
    object_place: np.ndarray,
    top: float,
    grasp: Grasp | None,
    random: np.random.Generator,
) -> tuple[np.ndarray, float, float]:
    """A place to look at an object from, (4, 4), with the opening of the hand and the one that is
    commanded, in metres: wherever an episode may lead, from high above to right around a grasp.

    Arguments as of `near`; grasp: of the object, None where no looks on the way down to one are
    wanted.
    """
    if grasp is not None and random.random() < _GRASP_SHARE:
        place = grasp.position[:2] + random.normal(0, _GRASP_SIDE, 2)
        height = random.uniform(grasp.position[2], top + _GRASP_HEIGHT)
        turn = grasp.angle - math.atan2(T_home[1, 1], T_home[0, 1])
        turn -= _HALF_TURN * round(turn / _HALF_TURN)
        turn += random.normal(0, _GRASP_TURN)
        opening = random.uniform(grasp.narrow, grasp.wide)
    else:
        rise = math.exp(random.uniform(*np.log(_LOOK_HEIGHT)))
        place = object_place + random.normal(0, _LOOK_SIDE[0] + _LOOK_SIDE[1] * rise, 2)
        height, turn = top + rise, random.uniform(-_LOOK_TURN, _LOOK_TURN)
        opened = random.random() < _OPEN_SHARE
        opening = _MAX_OPENING if opened else random.uniform(0, _MAX_OPENING)
    squeeze = random.uniform(0, _MOST_SQUEEZE) if random.random() < _MOVING_SHARE else 0.0
    return _hand(T_home, place, height, turn), opening, max(opening - squeeze, 0.0)


def _hand(T_home: np.ndarray, place: np.ndarray, height: float, turn: float) -> np.ndarray:
    T = T_home.copy()
    T[:3, 3] = *place, height
    T[:3, :3] = rotation_matrix(np.array([0.0, 0.0, turn])) @ T[:3, :3]
    return T
