"""Reward of `RobotGraspingEnv`: named terms, the way that the hand has to go, and what it leads to.

Read from the end: `make_reward` adds `TERMS` with the scales of `REWARDS`; `progress` says how far
an episode has come; `way_to_grasp` measures the distance to a grasp in metres. That distance is
taken to the middle of the nearest object (`Outline`, config `env.goal=object`) or to the nearest
grasp that the object offers (`GraspGoals`, `env.goal=grasp`).

Everything here is ground truth of the simulator: it serves rewards, critics and the training of a
state estimator, never a policy at work. This module knows no robot and no simulator.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from scipy.spatial import ConvexHull

from utils.compiled import compiled
from utils.errors import unknown_choice
from utils.geometry import GripperGeometry, SceneGeometry, Workspace
from utils.grasp_quality import LabelSettings, grasp_depth, grasp_quality, undersides
from utils.height_map import height_map_from_scene
from utils.plugins import is_import_path, load_plugin

_OVER = 0.02  # m over an object's highest point at which the fingertips pass freely
_EDGE = 0.01  # m beyond a slack over which the way down closes gradually


def way_to_grasp(
    x: float, y: float, down: float, over: float, blocked: float, turn: float, opening: float
) -> float:
    """Metres that the hand has to go until it is at a grasp: sideways, vertically, in turning and
    in opening, added up.

    x, y: m sideways, along E's axes. down: m straight to the grasp. over: m to a point over the
    object's top. blocked: share in [0, 1] of the way down that is closed, because the hand is not
    above the grasp, or not turned or opened for it: a blocked hand has to go over the top first, so
    that a hand that came down beside an object is farther away than one above it. turn, opening: m
    that turning and opening count for.
    """
    height = (1 - blocked) * down + blocked * over
    return math.hypot(x, y) + abs(height) + turn + opening


# --- The middle of an object --------------------------------------------------------------------

DIRECTIONS = 36  # over half a turn, from the closing line on: every 5 degrees
OUTLINE_WIDTHS = 8  # of these that an outline vector holds: every 25 degrees

_FINGERS = 0.035  # m, the hand would hit what reaches farther up between the fingers than this
_SIDE_SLACK, _LENGTH_SLACK = 0.008, 0.015  # m off the middle from where the hand may come down
_OPENING_SLACK = 0.01  # m by which the fingers should be wider apart than the object

_TURNS = math.pi / DIRECTIONS * np.arange(DIRECTIONS)
_COSINES, _SINES = np.cos(_TURNS), np.sin(_TURNS)


class Outline:
    """The outer points of one object.

    parts: arrays (V, 3) of its convex parts' vertices in the body frame, metres.
    """

    def __init__(self, parts: tuple[np.ndarray, ...]):
        points = np.concatenate(parts)
        self._points = points[ConvexHull(points).vertices]

    def seen_from(self, T_WO: np.ndarray, T_WE: np.ndarray) -> OutlineView:
        """The object at T_WO (4, 4) relative to a hand at T_WE (4, 4)."""
        widths, top = _shadow(self._points, T_WO, T_WE)
        between = T_WO[:3, 3] - T_WE[:3, 3]
        height = float(between[2])
        return OutlineView(between @ T_WE[:3, :3], widths, top + height, height)


@compiled
def _shadow(points: np.ndarray, T_WO: np.ndarray, T_WE: np.ndarray) -> tuple[np.ndarray, float]:
    """Widths as of `OutlineView`, and metres from the object's centre up to its highest point.
    points: (V, 3) of the object at T_WO (4, 4). T_WE: (4, 4) of the hand."""
    x, y = T_WE[0, 1], T_WE[1, 1]  # of the closing line
    length = math.hypot(x, y)
    x, y = x / length, y / length
    along, across = x * _COSINES - y * _SINES, y * _COSINES + x * _SINES  # directions in W
    least, most = np.full(DIRECTIONS, np.inf), np.full(DIRECTIONS, -np.inf)
    top = -np.inf
    for i in range(len(points)):
        a, b, c = points[i, 0], points[i, 1], points[i, 2]
        px = T_WO[0, 0] * a + T_WO[0, 1] * b + T_WO[0, 2] * c
        py = T_WO[1, 0] * a + T_WO[1, 1] * b + T_WO[1, 2] * c
        pz = T_WO[2, 0] * a + T_WO[2, 1] * b + T_WO[2, 2] * c
        top = max(top, pz)
        for k in range(DIRECTIONS):
            place = along[k] * px + across[k] * py
            least[k], most[k] = min(least[k], place), max(most[k], place)
    return most - least, top


class OutlineView:
    """An object relative to the hand.

    offset: (3,) m from E to the object's centre, along E's axes. widths: (DIRECTIONS,) m of the
    object's shadow from straight above, along lines turned about +z of W from the fingers' closing
    line by multiples of 180 / DIRECTIONS degrees. top: m, height of its highest point over E.
    centre: m, height of its centre over E.
    """

    def __init__(self, offset: np.ndarray, widths: np.ndarray, top: float, centre: float):
        self.offset, self.widths, self.top, self.centre = offset, widths, top, centre

    def vector(self) -> np.ndarray:
        """(OUTLINE_WIDTHS + 1,) m: some of the widths, and the top. The widths distinguish a
        cylinder from a box and give the direction of a box's sides without naming an angle, of
        which a symmetric object has several."""
        vector = np.empty(OUTLINE_WIDTHS + 1)
        vector[:OUTLINE_WIDTHS] = self.widths[:: -(-DIRECTIONS // OUTLINE_WIDTHS)][:OUTLINE_WIDTHS]
        vector[OUTLINE_WIDTHS] = self.top
        return vector

    def way(self, opening: float) -> float:
        """`way_to_grasp` of a hand open by `opening` metres to around the object's middle, its
        closing line across the narrowest width."""
        x, y = abs(float(self.offset[0])), abs(float(self.offset[1]))
        off = max(x - _LENGTH_SLACK, y - _SIDE_SLACK, 0.0)
        narrowest = float(self.widths.min())
        return way_to_grasp(
            x, y,
            down=max(self.centre, self.top - _FINGERS),
            over=self.top + _OVER,
            blocked=min(off / _EDGE, 1.0),
            turn=float(self.widths[0]) - narrowest,
            opening=max(narrowest + _OPENING_SLACK - opening, 0.0),
        )  # fmt: skip


# --- The grasps that an object offers -----------------------------------------------------------

ANGLES = 12  # closing lines that are tried, over half a turn
MOST = 64  # goals of one object

_STRICT = LabelSettings()
# Relaxed settings, for an object that offers nothing better, such as a bowl upside down.
_RELAXED = _STRICT.relaxed()
_GOOD = 0.85  # quality from which on every grasp is a goal
_CELL = 0.002  # m, of the height map; a goal is tried for every second cell along and across
_AROUND = 0.12  # m of map around the object: half the palm, at any angle
_ROOM = 0.005  # m between each open finger and the object
_LEAST_ROOM = 0.003
_DISTINCT, _DISTINCT_TURN = 0.006, math.radians(15)  # no two goals are both closer than this
LOWEST_TIP = 0.012  # m over the table that E keeps: the fingertips reach 7 mm below E

# What makes one goal nearer to the hand than another: metres sideways, and so many for a radian of
# turning, for a quality of 0 instead of 1, and for each metre that the hand has to close for it.
_TURN, _QUALITY, _NARROW = 0.06, 0.3, 0.3
_GOAL_SIDE_SLACK, _GOAL_LENGTH_SLACK = 0.006, 0.010  # m off a goal from where to come down
_TURN_SLACK, _TURN_EDGE = math.radians(12), math.radians(12)
_GOAL_OPENING_SLACK = 0.012  # m of opening that may be missing: the fingers' room on both sides


class GraspGoal(NamedTuple):
    """One grasp that an object offers. position: (3,) of E in W, m. angle: rad, of the closing line
    in W from its x axis. narrow, wide: m, the openings between which the hand can come down."""

    position: np.ndarray
    angle: float
    narrow: float
    wide: float


class GraspGoals:
    """Some grasps from above of one object, fixed to it.

    scene: the object alone in W, at rest at T_WO (4, 4). The search takes some 20 ms.
    """

    def __init__(self, scene: SceneGeometry, T_WO: np.ndarray, gripper: GripperGeometry):
        self._points = np.concatenate([solid.vertices for solid in scene.objects[0].solids])
        self._points = (self._points - T_WO[:3, 3]) @ T_WO[:3, :3]
        found = _search(scene, _STRICT, gripper)
        if len(found) == 0:
            found = _search(scene, _RELAXED, gripper)
        if len(found) == 0:
            found = _through_the_middle(scene, gripper)
        x, y, z, angle, *others = found[_distinct(found)].T
        R, t = T_WO[:3, :3], T_WO[:3, 3]
        self.quality, self._narrow, self._wide = others
        self._upright = R[2].copy()
        self._positions = (np.column_stack([x, y, z]) - t) @ R
        self._lines = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle]) @ R
        self._price = _QUALITY * (1 - self.quality) + _NARROW * (gripper.max_opening - self._wide)

    def __len__(self) -> int:
        return len(self.quality)

    def tilt(self, T_WO: np.ndarray) -> float:
        """Radians by which the object at T_WO leans away from how it rested: beyond some degrees
        the goals are no grasps from above any more."""
        return math.acos(min(max(float(self._upright @ T_WO[2, :3]), -1.0), 1.0))

    def goal(self, index: int, T_WO: np.ndarray) -> GraspGoal:
        """One of the goals, for the object at T_WO (4, 4)."""
        position = T_WO[:3, :3] @ self._positions[index] + T_WO[:3, 3]
        line = T_WO[:3, :3] @ self._lines[index]
        openings = float(self._narrow[index]), float(self._wide[index])
        return GraspGoal(position, math.atan2(line[1], line[0]), *openings)

    def seen_from(self, T_WO: np.ndarray, T_WE: np.ndarray) -> GoalView:
        """The goal nearest to a hand at T_WE (4, 4), for the object at T_WO (4, 4)."""
        T_EO_R = T_WE[:3, :3].T @ T_WO[:3, :3]
        offset = self._positions @ T_EO_R.T + T_WE[:3, :3].T @ (T_WO[:3, 3] - T_WE[:3, 3])
        lines = self._lines @ T_EO_R[:2].T
        turn = np.arctan2(-lines[:, 0], lines[:, 1])  # about z of E, from y of E
        turn -= math.pi * np.rint(turn / math.pi)
        price = np.hypot(offset[:, 0], offset[:, 1]) + _TURN * abs(turn) + self._price
        best = int(price.argmin())
        up = T_WO[2]
        top = float((self._points @ up[:3]).max() + up[3])
        narrow, wide = float(self._narrow[best]), float(self._wide[best])
        rise = float(T_WE[2, :3] @ offset[best])
        return GoalView(offset[best], float(turn[best]), narrow, wide, top, float(T_WE[2, 3]), rise)


class GoalView:
    """A goal relative to the hand.

    offset: (3,) m from E to the goal along E's axes. turn: rad in (-pi/2, pi/2] about E's z from
    the closing line to the goal's. narrow, wide: m, the openings between which the hand can come
    down. top, hand: m, heights in W of the object's highest point and of E. rise: m in W, of the
    goal over E.
    """

    def __init__(
        self, offset: np.ndarray, turn: float, narrow: float, wide: float, top: float, hand: float,
        rise: float,
    ):  # fmt: skip
        self.offset, self.turn, self.narrow, self.wide = offset, turn, narrow, wide
        self.top, self.hand, self.rise = top, hand, rise

    def vector(self) -> np.ndarray:
        """(11,): the offset sideways in metres (2); the whole offset as tanh(metres / 0.03), which
        resolves the last centimetres finely (3); sine and cosine of twice the turn, as half a turn
        changes nothing (2); narrowest and widest opening (2); heights of goal and top in W, m (2).
        Heights are given over the table, because an estimator learns more quickly what does not
        depend on the hand."""
        near = np.tanh(self.offset / 0.03)
        turn = math.sin(2 * self.turn), math.cos(2 * self.turn)
        height = self.hand + self.rise
        return np.array([*self.offset[:2], *near, *turn, self.narrow, self.wide, height, self.top])

    def way(self, opening: float) -> float:
        """`way_to_grasp` of a hand open by `opening` metres to the goal."""
        x, y = abs(float(self.offset[0])), abs(float(self.offset[1]))
        blocked = max(
            (x - _GOAL_LENGTH_SLACK) / _EDGE,
            (y - _GOAL_SIDE_SLACK) / _EDGE,
            (abs(self.turn) - _TURN_SLACK) / _TURN_EDGE,
            (self.narrow - _GOAL_OPENING_SLACK - opening) / _EDGE,
            (opening - self.wide) / _EDGE,
        )
        return way_to_grasp(
            x, y,
            down=self.rise,
            over=self.top - self.hand + _OVER,
            blocked=min(max(blocked, 0.0), 1.0),
            turn=_TURN * abs(self.turn),
            opening=max(self.narrow - opening, opening - self.wide, 0.0),
        )  # fmt: skip


def _search(scene: SceneGeometry, settings: LabelSettings, gripper: GripperGeometry) -> np.ndarray:
    """(N, 7) grasps, N may be 0: x, y, z of E in W, the closing line's angle, the quality, and the
    narrowest and widest opening with which the hand can come down."""
    corners = np.concatenate([solid.vertices[:, :2] for solid in scene.objects[0].solids])
    low, high = corners.min(axis=0), corners.max(axis=0)
    around = Workspace(tuple((low + high) / 2), float((high - low).max()), scene.table_height)
    heights = height_map_from_scene(scene, around, _CELL, _AROUND)
    under = undersides(scene, heights)
    row, column = np.nonzero(heights.label[::2, ::2] >= 0)
    row, column = 2 * row, 2 * column
    surface = np.column_stack(
        [
            heights.origin + heights.cell * np.stack([column, row], axis=-1),
            heights.height[row, column],
        ]
    )
    rise = surface[:, 2] - scene.table_height
    surface = surface[rise > settings.table_clearance + settings.min_engagement]
    if len(surface) == 0:
        return np.empty((0, 7))
    # From the narrowest shadow on, so that what has parallel sides is met squarely.
    angles = _narrowest(corners) + math.pi / ANGLES * np.arange(ANGLES)
    found = []
    for angle in angles:
        judged = grasp_quality(surface, angle, heights, under, scene, gripper, settings)
        some = np.flatnonzero(judged.quality > 0)
        middle, reach = judged.middle[some], judged.reach[some]
        narrow = 2 * (reach + _ROOM)
        wide = 2 * (judged.widest[some] - abs(middle))
        narrow = np.minimum(narrow, wide)
        fits = narrow > 2 * (reach + _LEAST_ROOM)
        x, y = (surface[some, :2] + middle[:, None] * (math.cos(angle), math.sin(angle))).T
        depth = grasp_depth(surface[some, 2], scene.table_height, settings)
        z = surface[some, 2] - depth + gripper.tip_below_centre
        z = np.maximum(z, scene.table_height + LOWEST_TIP)
        quality = np.cbrt(judged.quality[some])
        found.append(
            np.column_stack([x, y, z, np.full(len(x), angle), quality, narrow, wide])[fits]
        )
    found = np.concatenate(found)
    if len(found) == 0:
        return found
    best = found[:, 4].max()
    return found[found[:, 4] >= min(_GOOD, 0.95 * best)]


def _narrowest(corners: np.ndarray) -> float:
    """The direction, rad, along which points (V, 2) spread least."""
    angles = np.arange(90) * math.pi / 90
    spread = np.ptp(corners @ np.stack([np.cos(angles), np.sin(angles)]), axis=0)
    return float(angles[spread.argmin()])


def _through_the_middle(scene: SceneGeometry, gripper: GripperGeometry) -> np.ndarray:
    """(1, 7) as of `_search`: across the narrowest side through the centre, the hand wide open."""
    thing = scene.objects[0]
    corners = np.concatenate([solid.vertices for solid in thing.solids])
    x, y, z = thing.centre_of_mass
    z = max(z, corners[:, 2].max() - _FINGERS, scene.table_height + LOWEST_TIP)
    wide = gripper.max_opening
    return np.array([[x, y, z, _narrowest(corners[:, :2]), 0.0, wide, wide]])


def _distinct(found: np.ndarray) -> np.ndarray:
    """Indices of the best grasps of (N, 7) that differ from one another, `MOST` at most."""
    left = np.argsort(-found[:, 4], kind="stable")
    kept = []
    while len(left) and len(kept) < MOST:
        best = left[0]
        kept.append(best)
        turn = abs(found[left, 3] - found[best, 3])
        turn = np.minimum(turn, math.pi - turn)
        away = np.hypot(*(found[left, :2] - found[best, :2]).T)
        left = left[(away > _DISTINCT) | (turn > _DISTINCT_TURN)]
    return np.array(kept)


# --- The reward ---------------------------------------------------------------------------------

SHORTEST_LIFT = 0.05  # m, for objects that rest near the lift height already


class RewardState(NamedTuple):
    """What a reward is computed from, after one action.

    success: the object has been held up for long enough. grasped: both fingers grip the nearest
    object. way: m that the hand has to go to a grasp (`way_to_grasp`), 0 while grasped. lift: share
    in [0, 1] of the way from where the nearest object rested to `env.lift_height`. progress,
    progress_before: `progress` of this state and of the one before the action. action: (A,) in [-1,
    1] as carried out. reachable: whether the arm could follow the action. opening: m between the
    fingertips. hand_position, object_position: (3,) m in W, of E and of the nearest object.
    """

    success: bool
    grasped: bool
    way: float
    lift: float
    progress: float
    progress_before: float
    action: np.ndarray
    reachable: bool
    opening: float
    hand_position: np.ndarray
    object_position: np.ndarray


Reward = Callable[[RewardState], float]


def progress(grasped: bool, way: float, lift: float) -> float:
    """How far an episode has come, in [0, 1], with the stages of ManiSkill's PickCube: up to 0.25
    for coming near, from 0.5 on for gripping and up to 1 for lifting. The two tanh pay for coming
    near from afar, and for the last centimetre."""
    if not grasped:
        return 0.25 - (math.tanh(3.0 * way) + math.tanh(20.0 * way)) / 8
    return float((1.0 + lift) / 2)


def success_term(state: RewardState) -> float:
    """1 at success."""
    return float(state.success)


def progress_term(state: RewardState) -> float:
    """Change of `progress`. Over an episode it telescopes to progress(end) - progress(start), so
    that lingering half-way earns nothing. (It has the form of Ng, Harada and Russell's shaping,
    ICML 1999, but without their discount and with progress(end) paid out, so their proof of policy
    invariance does not apply.)"""
    return state.progress - state.progress_before


TERMS: dict[str, Reward] = {"success": success_term, "progress": progress_term}
# The rewards that env.reward chooses from, each as scales of terms.
REWARDS: dict[str, dict[str, float]] = {
    "dense": {"success": 1.0, "progress": 1.0},
    "sparse": {"success": 1.0},
}


def make_reward(chosen: str | Mapping[str, float]) -> Reward:
    """The reward of `env.reward`: a name from REWARDS; an import path `module:function`, which is
    the whole reward; or scales of terms, each a name from TERMS or an import path. The terms, each
    times its scale, are added up in that order.

    A function takes a `RewardState` and returns a number. Raises UserError.
    """
    if isinstance(chosen, str) and is_import_path(chosen):
        return load_plugin(chosen, "env.reward")
    if isinstance(chosen, str):
        if chosen not in REWARDS:
            others = ("module:function", "scales of terms {success: 1, my_module:term: 0.1}")
            raise unknown_choice("env.reward", chosen, [*REWARDS, *others])
        chosen = REWARDS[chosen]
    terms = [(scale, _term(name)) for name, scale in chosen.items()]
    return lambda state: sum(scale * term(state) for scale, term in terms)


def _term(name: str) -> Reward:
    if is_import_path(name):
        return load_plugin(name, "env.reward")
    if name not in TERMS:
        raise unknown_choice("env.reward, a term", name, [*TERMS, "module:function"])
    return TERMS[name]
