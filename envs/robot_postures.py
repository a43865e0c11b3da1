"""Which of two postures: a parallel gripper grasps the same when the wrist is flipped.

The fingers are alike, so a gripper pose and the same pose turned by half a turn about the approach
are one grasp. The wrist, the last joint, turns by less than a whole turn: the choice decides how
far it can follow an object that turns. Knows kinematics only, no cell and no simulator.
"""

from __future__ import annotations

import numpy as np

from envs.robot_kinematics import JOINT_LOWER, JOINT_UPPER, UnreachableError, inverse_kinematics

HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])  # about the approach: the wrist flip

_ROOM = 0.6  # rad between the wrist and its limits that a posture should leave
_LITTLE_ROOM = 0.3  # rad of it below which a flip is considered
_LONGEST_TURN = 2.8  # rad of the wrist, less than half a turn


def postures(T_WE: np.ndarray, home: np.ndarray) -> dict[bool, np.ndarray]:
    """Joint positions (7,), rad, that reach a gripper pose (4, 4) as it is (False) and flipped
    (True), each near `home` (7,). Raises UnreachableError where neither is reachable."""
    found, error = {}, None
    for flipped, pose in ((False, T_WE), (True, T_WE @ HALF_TURN)):
        try:
            found[flipped] = inverse_kinematics(pose, home, home)
        except UnreachableError as unreachable:
            error = unreachable
    if not found:
        raise error
    return found


def choose_posture(T_WE: np.ndarray, home: np.ndarray) -> np.ndarray:
    """The posture (7,) for a grasp that is nearer to `home`. Raises UnreachableError."""
    return min(postures(T_WE, home).values(), key=lambda q: float(abs(q - home).max()))


def should_flip(T_WE: np.ndarray, home: np.ndarray, q: np.ndarray) -> bool:
    """Whether an arm at q (7,) should flip a gripper pose (4, 4) before it sets out for it.

    Of the postures that leave the wrist room to turn with the object, the one with the smaller turn
    of the wrist wins. Raises UnreachableError.
    """
    found = postures(T_WE, home)
    roomy = [flipped for flipped, there in found.items() if _wrist_room(there) > _ROOM]
    return min(roomy or list(found), key=lambda flipped: abs(found[flipped][-1] - q[-1]))


def must_flip(T_WE: np.ndarray, home: np.ndarray, q: np.ndarray) -> bool:
    """Whether an arm at q (7,) on its way to a gripper pose (4, 4) must flip it, because the wrist
    would meet its limit while it follows the object."""
    try:
        found = postures(T_WE, home)
    except UnreachableError:  # for the moment, which is no reason to change anything
        return False
    kept, other = (_wrist_room(found[flip]) if flip in found else 0.0 for flip in (False, True))
    # A law takes the shorter turn; one of more than half a turn would go the other way.
    return kept < _LITTLE_ROOM < other and abs(found[True][-1] - q[-1]) < _LONGEST_TURN


def _wrist_room(q: np.ndarray) -> float:
    """Radians from the last joint to the nearer one of its limits."""
    return float(min(q[-1] - JOINT_LOWER[-1], JOINT_UPPER[-1] - q[-1]))
