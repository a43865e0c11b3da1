"""Kinematics of the Franka Panda in closed form, and its limits.

At the end: `postures`, which of two joint configurations reaches a grasp. The fingers are alike, so
a gripper pose and the same pose turned by half a turn about the approach (the wrist flip) are one
grasp; the last joint turns by less than a whole turn, so the choice decides how far it can follow
an object that turns. No simulator, no cell and no object is known here. The loops over joints are
compiled (`utils.compiled`).
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from utils.compiled import compiled
from utils.errors import UserError

# Limits of the arm, from Franka's documentation of its control interface (FCI), Panda.
JOINT_LOWER = np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973])  # rad
JOINT_UPPER = np.array([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973])  # rad
JOINT_VELOCITY = np.array([2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61])  # rad/s
JOINT_ACCELERATION = np.array([15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0])  # rad/s^2
JOINT_JERK = np.array([7500.0, 3750.0, 5000.0, 6250.0, 7500.0, 10000.0, 10000.0])  # rad/s^3
JOINT_TORQUE = np.array([87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0])  # N m
HAND_VELOCITY = (1.7, 2.5)  # m/s of E, rad/s of the hand
HAND_ACCELERATION = (13.0, 25.0)  # m/s^2, rad/s^2
HAND_JERK = (6500.0, 12500.0)  # m/s^3, rad/s^3
CARTESIAN_ACCELERATION = 6.5  # m/s^2, half of the specified 13, which leaves room for tracking

# Modified (Craig) Denavit-Hartenberg parameters, same specification: a_{i-1}, alpha_{i-1}, d_i.
_A = (0.0, 0.0, 0.0, 0.0825, -0.0825, 0.0, 0.088)
_ALPHA = (0.0, -np.pi / 2, np.pi / 2, np.pi / 2, -np.pi / 2, np.pi / 2, np.pi / 2)
_D = (0.333, 0.0, 0.316, 0.0, 0.384, 0.0, 0.0)


FLANGE_LENGTH = 0.107  # m from joint 7's frame to the flange, where the hand's frame is
HAND_TURN = -np.pi / 4  # rad, of the hand about joint 7's axis
GRASP_DEPTH = 0.105  # m from the hand's frame to E
TOOL_LENGTH = FLANGE_LENGTH + GRASP_DEPTH
# Each joint's a, sin alpha, which is 0, 1 or -1, and d; the tool as one more that does not turn.
_LINKS = [
    (a, float(np.round(np.sin(alpha))), d)
    for a, alpha, d in zip((*_A, 0.0), (*_ALPHA, 0.0), (*_D, TOOL_LENGTH))
]
_LINK_TABLE = np.array(_LINKS)
_ARM_FROM_ITS_END = _LINKS[-2::-1]

_POINT_SPACING = 0.05  # m along the links
_ELBOW = 5  # of the ends of the links' parts, two for each joint, that of the elbow

# Of inverse kinematics: how near a pose counts as reached along and about each axis, in m and rad.
POSITION_TOLERANCE, ROTATION_TOLERANCE = 1e-4, 1e-3
_MOST_STEPS = 100
_DAMPING = 0.02  # of a step's least squares
_LONGEST_STEP = 0.3  # rad of a joint


class UnreachableError(UserError):
    """The arm cannot reach a pose within its joint limits."""


def joint_origin(number: int) -> tuple[tuple[float, float, float], float]:
    """Where joint 1 to 7 is in the frame of the one before it: (3,) metres, and radians about the
    x axis."""
    a, alpha, d = _A[number - 1], _ALPHA[number - 1], _D[number - 1]
    sine, cosine = (float(np.round(f(alpha))) for f in (np.sin, np.cos))  # right angles
    return (a, -sine * d, cosine * d), alpha


def forward_kinematics(q: np.ndarray) -> np.ndarray:
    """(4, 4) T_WE for joint positions q (7,), the robot's base being the world frame."""
    return _chain(q)[0]


def tip_position(q: Sequence[float]) -> tuple[float, float, float]:
    """x, y, z of E in W, metres, for seven joint positions in rad: what `forward_kinematics` has in
    its last column, from a list and without the Jacobian: each command to the arm needs it."""
    x, y, z = 0.0, 0.0, TOOL_LENGTH
    for (a, turn, d), angle in zip(_ARM_FROM_ITS_END, reversed(q)):
        cosine, sine = math.cos(angle), math.sin(angle)
        x, y, z = cosine * x - sine * y + a, sine * x + cosine * y, z + d
        if turn:  # by a right angle about x
            y, z = -turn * z, turn * y
    return x, y, z


@compiled
def _chain(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """T_WE (4, 4) and the geometric Jacobian (6, 7) of E in W, linear rows first."""
    if len(q) != 7:
        raise ValueError("expected the positions of seven joints")
    T, jacobian = np.eye(4), np.empty((6, 7))
    arm = np.empty((3, 7))  # from each joint to E
    for i in range(3):
        x, y, z, p = T[i, 0], T[i, 1], T[i, 2], T[i, 3]  # a row of the pose so far
        for k in range(8):
            angle = q[k] if k < 7 else HAND_TURN
            cosine, sine = math.cos(angle), math.sin(angle)
            a, turn, d = _LINK_TABLE[k, 0], _LINK_TABLE[k, 1], _LINK_TABLE[k, 2]
            p += a * x
            if turn != 0:  # by a right angle about x
                y, z = turn * z, -turn * y
            p += d * z
            x, y = cosine * x + sine * y, cosine * y - sine * x
            if k < 7:
                jacobian[3 + i, k] = z
                arm[i, k] = p
        T[i, 0], T[i, 1], T[i, 2], T[i, 3] = x, y, z, p
        for k in range(7):
            arm[i, k] = p - arm[i, k]
    for k in range(7):
        for i in range(3):
            j, m = (i + 1) % 3, (i + 2) % 3
            jacobian[i, k] = jacobian[3 + j, k] * arm[m, k] - jacobian[3 + m, k] * arm[j, k]
    return T, jacobian


def geometric_jacobian(q: np.ndarray) -> np.ndarray:
    """(6, 7) Jacobian of E in W: rows v then omega, for joint positions q (7,)."""
    return _chain(q)[1]


class _Link(NamedTuple):
    """A link's frame, (N, 3) each: its axes in W once its joint has turned; before and after, m, in
    front of the shift along its z axis and behind it."""

    x: np.ndarray
    y: np.ndarray
    z: np.ndarray
    before: np.ndarray
    after: np.ndarray


def _walk(q: np.ndarray) -> Iterator[_Link]:
    """The links from the base to the flange, for joint positions q (N, 7)."""
    x, y, z = (np.tile(axis, (len(q), 1)) for axis in np.eye(3))
    after = np.zeros((len(q), 3))
    for (a, turn, d), angle in zip(_LINKS, q.T[:, :, None]):
        before = after + a * x
        if turn:  # by a right angle about x
            y, z = turn * z, -turn * y
        after = before + d * z
        x, y = np.cos(angle) * x + np.sin(angle) * y, np.cos(angle) * y - np.sin(angle) * x
        yield _Link(x, y, z, before, after)


def tip_twists(q: np.ndarray, velocities: np.ndarray) -> np.ndarray:
    """(N, 6) velocities of E in W, v then omega, of joint positions and velocities, each (N, 7)."""
    links = list(_walk(q))
    turns = velocities.T[:, :, None] * np.array([link.z for link in links])
    tip = links[-1].after + TOOL_LENGTH * links[-1].z
    arms = tip - np.array([link.after for link in links])
    return np.hstack([np.cross(turns, arms).sum(axis=0), turns.sum(axis=0)])


def link_poses(q: np.ndarray) -> np.ndarray:
    """(N, 7, 4, 4) poses in W of the frames of link 1 to 7, for joint positions q (N, 7)."""
    poses = np.tile(np.eye(4), (len(q), 7, 1, 1))
    for i, link in enumerate(_walk(q)):
        poses[:, i, :3] = np.stack([link.x, link.y, link.z, link.after], axis=2)
    return poses


def arm_points(q: np.ndarray) -> np.ndarray:
    """(N, P, 3) points in W on the arm's links, at most 5 cm apart, from the elbow to the
    flange, for joint positions q (N, 7)."""
    links = list(_walk(q))
    corners = [corner for link in links for corner in (link.before, link.after)]
    corners = [*corners[_ELBOW:], links[-1].after + FLANGE_LENGTH * links[-1].z]
    points = [corners[0]]
    for start, end in zip(corners, corners[1:]):
        count = int(np.ceil(np.linalg.norm(end[0] - start[0]) / _POINT_SPACING))
        points += [start + share * (end - start) for share in (np.arange(count) + 1) / count]
    return np.stack(points, axis=1)


@compiled
def rotation_vector(R: np.ndarray) -> np.ndarray:
    """(3,) axis-angle logarithm of a (3, 3) rotation."""
    cosine = 0.5 * (R[0, 0] + R[1, 1] + R[2, 2] - 1.0)
    vector = np.array(
        [0.5 * (R[2, 1] - R[1, 2]), 0.5 * (R[0, 2] - R[2, 0]), 0.5 * (R[1, 0] - R[0, 1])]
    )
    sine = _length(vector)
    if cosine > -0.99:
        return vector * (math.atan2(sine, cosine) / sine if sine > 1e-9 else 1.0)
    # Near half a turn the sine says little of the axis; the symmetric part is
    # cosine + (1 - cosine) axis axis^T.
    k = 0
    for i in range(1, 3):
        if R[i, i] > R[k, k]:
            k = i
    axis = np.array([0.5 * (R[i, k] + R[k, i]) for i in range(3)])
    axis[k] -= cosine
    angle = math.atan2(sine, cosine) / _length(axis)
    along = axis[0] * vector[0] + axis[1] * vector[1] + axis[2] * vector[2]
    return axis * (-angle if along < 0 else angle)


@compiled
def _length(vector: np.ndarray) -> float:
    """Of a vector (3,)."""
    return math.sqrt(vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2)


@compiled
def rotation_matrix(vector: np.ndarray) -> np.ndarray:
    """(3, 3) rotation of an axis-angle vector (3,), by Rodrigues' formula."""
    x, y, z = vector[0], vector[1], vector[2]
    angle = _length(vector)
    if angle < 1e-9:
        return np.array([[1.0, -z, y], [z, 1.0, -x], [-y, x, 1.0]])
    x, y, z = x / angle, y / angle, z / angle
    s, c = math.sin(angle), math.cos(angle)
    t = 1.0 - c
    return np.array(
        [
            [c + t * x * x, t * x * y - s * z, t * x * z + s * y],
            [t * x * y + s * z, c + t * y * y, t * y * z - s * x],
            [t * x * z - s * y, t * y * z + s * x, c + t * z * z],
        ]
    )


@compiled
def _product(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """(N, M) of matrices (N, K) and (K, M) that are too small for a library."""
    product = np.zeros((left.shape[0], right.shape[1]))
    for i in range(left.shape[0]):
        for k in range(right.shape[1]):
            for j in range(left.shape[1]):
                product[i, k] += left[i, j] * right[j, k]
    return product


@compiled
def pose_error(T: np.ndarray, target: np.ndarray) -> np.ndarray:
    """(6,) small motion in W that takes pose T to the target: metres, then radians."""
    error = np.empty(6)
    error[:3] = target[:3, 3] - T[:3, 3]
    error[3:] = rotation_vector(_product(target[:3, :3], T[:3, :3].T))
    return error


@compiled
def moved(T: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """Pose T (4, 4) after a motion (6,) in W, metres then radians: `pose_error` the other way."""
    result = T.copy()
    result[:3, :3] = _product(rotation_matrix(motion[3:]), T[:3, :3])
    result[:3, 3] = T[:3, 3] + motion[:3]
    return result


@compiled
def moved_within(
    T: np.ndarray,
    move: np.ndarray,
    turn: np.ndarray,
    in_hand: bool,
    lowest: np.ndarray,
    highest: np.ndarray,
    room: tuple[float, float],
) -> np.ndarray:
    """Pose T (4, 4) after a move (3,) m and a turn (3,) rad, its position within the box from
    lowest (3,) to highest (3,) m, its turn about its own z within `room` rad. in_hand: whether
    move and turn are along the axes of T instead of W's."""
    result = T.copy()
    axes = T[:3, :3] if in_hand else np.eye(3)
    shift, spin = np.zeros(3), np.zeros(3)
    for i in range(3):
        for k in range(3):
            shift[i] += axes[i, k] * move[k]
            spin[i] += axes[i, k] * turn[k]
    result[:3, 3] = np.minimum(np.maximum(T[:3, 3] + shift, lowest), highest)
    if spin.any():
        approach = T[:3, 2]
        about = spin[0] * approach[0] + spin[1] * approach[1] + spin[2] * approach[2]
        spin += (min(max(about, room[0]), room[1]) - about) * approach
        result[:3, :3] = _product(rotation_matrix(spin), T[:3, :3])
    return result


def inverse_kinematics(
    target: np.ndarray, seed: np.ndarray, rest: np.ndarray | None = None
) -> np.ndarray:
    """Joint positions (7,) that bring E to the target pose (4, 4) in W.

    Damped least squares within the joint limits (Buss, "Introduction to inverse kinematics",
    2004), started at `seed`; the redundant joint is drawn towards `rest`. The result has been
    checked by forward kinematics: along each axis within POSITION_TOLERANCE metres, about each
    within ROTATION_TOLERANCE radians, otherwise UnreachableError.
    """
    q = np.clip(np.asarray(seed, dtype=float), JOINT_LOWER, JOINT_UPPER)
    target = np.ascontiguousarray(target, dtype=float)
    pull = np.zeros(7) if rest is None else np.ascontiguousarray(rest, dtype=float)
    q, error = _approached(target, q, pull, rest is not None)
    if _is_near(error):
        return q
    position = np.round(target[:3, 3], 3).tolist()
    raise UnreachableError(
        f"the arm cannot reach the pose at {position} m within its joint limits: inverse "
        f"kinematics stopped {1000 * np.linalg.norm(error[:3]):.1f} mm and "
        f"{np.degrees(np.linalg.norm(error[3:])):.1f} degrees away; choose a pose within 0.85 m of "
        "the base"
    )


@compiled
def _approached(
    target: np.ndarray, q: np.ndarray, rest: np.ndarray, pulled: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Joint positions (7,) after damped steps from q (7,) towards a pose, and `pose_error` (6,) as
    it was last looked at: where the steps did not get there, before the last one. pulled: whether
    `rest` counts."""
    for _ in range(_MOST_STEPS):
        T, jacobian = _chain(q)
        error = pose_error(T, target)
        if _is_near(error):
            break
        q = _within_limits(q + _damped_step(jacobian, error, q, rest, pulled))
    return q, error


@compiled
def _is_near(error: np.ndarray) -> bool:
    """Whether a pose with such a `pose_error` (6,) counts as reached."""
    return (
        np.abs(error[:3]).max() < POSITION_TOLERANCE
        and np.abs(error[3:]).max() < ROTATION_TOLERANCE
    )


@compiled
def _within_limits(q: np.ndarray) -> np.ndarray:
    """Joint positions (7,), those beyond a limit at it."""
    return np.minimum(np.maximum(q, JOINT_LOWER), JOINT_UPPER)


@compiled
def _damped_step(
    jacobian: np.ndarray, error: np.ndarray, q: np.ndarray, rest: np.ndarray, pulled: bool
) -> np.ndarray:
    """One damped-least-squares step (7,), with a pull towards `rest` in the null space."""
    pull, wanted = np.zeros(7), error.copy()
    if pulled:
        # The pull fades near the goal, where the damping would let it leak into the task.
        pull = 0.1 * min(1.0, np.abs(error).max() / 0.05) * (rest - q)
        for i in range(6):
            for k in range(7):
                wanted[i] -= jacobian[i, k] * pull[k]
    square = _product(jacobian, jacobian.T)
    for i in range(6):
        square[i, i] += _DAMPING**2
    force, step = _solved(square, wanted), pull.copy()
    for k in range(7):
        for i in range(6):
            step[k] += jacobian[i, k] * force[i]
    largest = np.abs(step).max()
    return step * (_LONGEST_STEP / largest) if largest > _LONGEST_STEP else step


@compiled
def _solved(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """The solution (N,) for a positive definite matrix (N, N), which is overwritten, by Cholesky's
    decomposition."""
    count, x = len(right), right.copy()
    for i in range(count):
        for j in range(i + 1):
            rest = matrix[i, j]
            for k in range(j):
                rest -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = math.sqrt(rest) if i == j else rest / matrix[j, j]
        for k in range(i):
            x[i] -= matrix[i, k] * x[k]
        x[i] /= matrix[i, i]
    for i in range(count - 1, -1, -1):
        for k in range(i + 1, count):
            x[i] -= matrix[k, i] * x[k]
        x[i] /= matrix[i, i]
    return x


class ServoStep:
    """One cheap step of inverse kinematics for every control period of a streamed pose command.

    The kinematic chain is walked once: `reached` is (4, 4) T_WE at `q` (7,), and `towards` gives
    the joint positions (7,) one damped step nearer to a target pose, within the joint limits.
    """

    def __init__(self, q: np.ndarray):
        self.q = q
        self.reached, self._jacobian = _chain(q)

    def towards(self, target: np.ndarray) -> np.ndarray:
        return _servo_step(self.q, self.reached, self._jacobian, target)


@compiled
def _servo_step(
    q: np.ndarray, T: np.ndarray, jacobian: np.ndarray, target: np.ndarray
) -> np.ndarray:
    """Joint positions (7,) one damped step from q (7,), where T is reached, towards a pose."""
    return _within_limits(q + _damped_step(jacobian, pose_error(T, target), q, q, False))


@compiled
def stepped_towards(q: np.ndarray, goal: np.ndarray, most: float) -> tuple[np.ndarray, float]:
    """Joint positions (7,) from q towards a goal (7,), along which no joint turns by more than
    `most` rad, and the share of the way that they are."""
    change = goal - q
    share = 1.0 / max(np.abs(change).max() / most, 1.0)
    return q + share * change, share


def wrist_room(q: np.ndarray) -> tuple[float, float]:
    """Radians (low, high) by which the last joint can still turn the hand about E's z from joint
    positions q (7,). It is exact while the other joints stay as they are."""
    return float(JOINT_LOWER[6] - q[6]), float(JOINT_UPPER[6] - q[6])


HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])  # about the approach: the wrist flip

# Three postures from which searches reach most of the poses, 60 to 85 degrees from straight above,
# that the one from home does not: measured on 288 of them, 81 % from home and 88 % with these.
STARTS = np.array([
    [0.0, -0.3, -1.5, -2.2, 1.5, 1.8, 2.3],
    [0.8, 0.2, 0.0, -2.2, -1.6, 3.0, 0.785],
    [0.0, -0.3, -1.5, -2.2, -1.5, 1.8, -0.8],
])  # fmt: skip

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


def all_postures(T_WE: np.ndarray, home: np.ndarray, more: bool = False) -> list[np.ndarray]:
    """Joint positions (7,) that reach a gripper pose (4, 4) or its flip, the nearest to `home`
    first; those found from `STARTS` where none lies near it, or where `more` are asked for. Raises
    UnreachableError."""
    unreachable = None
    try:
        found = list(postures(T_WE, home).values())
    except UnreachableError as error:
        found, unreachable = [], error
    if more or not found:
        for start in STARTS:
            for pose in (T_WE, T_WE @ HALF_TURN):
                with contextlib.suppress(UnreachableError):
                    found.append(inverse_kinematics(pose, start))
    if unreachable is not None and not found:
        raise unreachable
    return sorted(found, key=lambda q: float(abs(q - home).max()))


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
    low, high = wrist_room(q)
    return min(-low, high)
