"""Which way round to grasp: the fingers are alike, so every grasp is two, half a turn apart.

The way round is chosen by the wrist, the last joint: it may turn by less than a whole turn, and an
object that turns takes it along.
"""

from __future__ import annotations

import numpy as np

from envs.base_cell import BaseCell
from envs.execution import HALF_TURN
from envs.kinematics import JOINT_LOWER, JOINT_UPPER, UnreachableError, inverse_kinematics

_ROOM = 0.6  # rad to the wrist's limits that a way round should leave
_LITTLE_ROOM = 0.3  # rad of it at which the other way round is looked at
_LONGEST_TURN = 2.8  # rad of the wrist, less than half a turn


def turned_is_better(cell: BaseCell, T_WE: np.ndarray) -> bool:
    """Whether to turn a gripper pose (4, 4) round before setting out for it: the smaller turn of
    the wrist that leaves it room to turn with the object. Raises UnreachableError if neither way
    is in reach."""
    ways, now = _ways(cell, T_WE), cell.robot.q[-1]
    roomy = [turned for turned, q in ways.items() if _wrist_room(q) > _ROOM] or list(ways)
    return min(roomy, key=lambda turned: abs(ways[turned][-1] - now))


def must_turn(cell: BaseCell, T_WE: np.ndarray) -> bool:
    """Whether to turn round on the way to a gripper pose (4, 4), where the wrist, following the
    object, is about to meet its limit."""
    try:
        ways, now = _ways(cell, T_WE), cell.robot.q[-1]
    except UnreachableError:  # at this moment, which is no reason to change anything
        return False
    kept, other = (_wrist_room(ways[turned]) if turned in ways else 0.0 for turned in (0, 1))
    # A law takes the shorter turn; a longer one than half a turn would be the wrong way.
    return kept < _LITTLE_ROOM < other and abs(ways[True][-1] - now) < _LONGEST_TURN


def _ways(cell: BaseCell, T_WE: np.ndarray) -> dict[bool, np.ndarray]:
    """Joint positions (7,) at a pose as it is (False) and turned by half a turn (True), those that
    can be reached; raises UnreachableError if there are none."""
    ways, error = {}, None
    for turned, pose in ((False, T_WE), (True, T_WE @ HALF_TURN)):
        try:
            ways[turned] = inverse_kinematics(pose, cell.home, cell.home)
        except UnreachableError as unreachable:
            error = unreachable
    if not ways:
        raise error
    return ways


def _wrist_room(q: np.ndarray) -> float:
    """Radians from the last joint to the nearer one of its limits."""
    return float(min(q[-1] - JOINT_LOWER[-1], JOINT_UPPER[-1] - q[-1]))
