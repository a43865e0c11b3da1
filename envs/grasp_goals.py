"""The grasps from above that one object offers, and how far the hand still has to go to one.

Ground truth from the simulator: for rewards, for critics, and for teaching a network to see it;
never for a policy that is to work without it. Knows nothing of robots or of PyBullet.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from utils.geometry import GripperGeometry, SceneGeometry, Workspace
from utils.grasp_quality import LabelSettings, grasp_quality, undersides
from utils.height_map import height_map_from_scene

ANGLES = 12  # closing lines that are tried, over half a turn
MOST = 64  # goals of one object

_STRICT = LabelSettings()
# For what offers nothing better, such as a bowl upside down.
_RELAXED = _STRICT.relaxed()
_GOOD = 0.85
_CELL = 0.002  # m, of the height map; a goal is tried for every second cell along and across
_AROUND = 0.12  # m of map around the object: half the palm, at any angle
_ROOM = 0.005  # m between each open finger and the object
_LEAST_ROOM = 0.003
_DISTINCT, _DISTINCT_TURN = 0.006, math.radians(15)  # no two goals are both closer than this
_LOWEST = 0.012  # m over the table that E should keep

# What makes one goal nearer to the hand than another: metres sideways, and so many for a radian of
# turning, for a quality of 0 instead of 1, and for each metre that the hand has to close for it.
_TURN, _QUALITY, _NARROW = 0.06, 0.3, 0.3
_OVER = 0.02  # m over an object's highest point at which the fingertips pass freely
_SIDE_SLACK, _LENGTH_SLACK = 0.006, 0.010  # m off a goal from where the hand may come down
_EDGE = 0.01  # m beyond that slack over which the way down is closed
_TURN_SLACK, _TURN_EDGE = math.radians(12), math.radians(12)
_OPENING_SLACK = 0.012  # m of opening that may be missing: the fingers' room on both sides


class Grasp(NamedTuple):
    """position: (3,) of E in W, m. angle: rad, of the closing line in W from its x axis. narrow,
    wide: m, the openings between which the hand can come down."""

    position: np.ndarray
    angle: float
    narrow: float
    wide: float


class GraspGoals:
    """Some grasps of one object, fixed to it.

    scene: the object alone in W, at rest at T_WO (4, 4). Takes some 20 ms.
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

    def grasp(self, index: int, T_WO: np.ndarray) -> Grasp:
        """One of them, of the object at T_WO (4, 4)."""
        position = T_WO[:3, :3] @ self._positions[index] + T_WO[:3, 3]
        line = T_WO[:3, :3] @ self._lines[index]
        openings = float(self._narrow[index]), float(self._wide[index])
        return Grasp(position, math.atan2(line[1], line[0]), *openings)

    def seen_from(self, T_WO: np.ndarray, T_WE: np.ndarray) -> GoalView:
        """The goal nearest to a hand at T_WE (4, 4), of the object at T_WO (4, 4)."""
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
        return GoalView(offset[best], float(turn[best]), narrow, wide, top, float(T_WE[2, 3]))


class GoalView:
    """A grasp as seen from the hand. offset: (3,) m from E to it along E's axes. turn: rad in
    (-pi/2, pi/2] about E's z from the closing line to the grasp's. narrow, wide: m, the openings
    between which the hand can come down. top, hand: m, heights in W of the object's highest point
    and of E."""

    def __init__(
        self, offset: np.ndarray, turn: float, narrow: float, wide: float, top: float, hand: float
    ):
        self.offset, self.turn, self.narrow, self.wide = offset, turn, narrow, wide
        self.top, self.hand = top, hand

    def told(self) -> np.ndarray:
        """(11,): the offset sideways in metres, and all of it as tanh(metres / 0.03), which tells
        the last centimetres finely; sine and cosine of twice the turn, as half a turn changes
        nothing; the openings between which to come down, and the heights in W of grasp and top, m.
        Over the table, as what does not depend on the hand is quicker to learn to see."""
        near = np.tanh(self.offset / 0.03)
        turn = math.sin(2 * self.turn), math.cos(2 * self.turn)
        height = self.hand - self.offset[2]
        return np.array([*self.offset[:2], *near, *turn, self.narrow, self.wide, height, self.top])

    def way_to_grasp(self, opening: float) -> float:
        """Metres that the hand, open by `opening` metres, has yet to go until it is at the grasp:
        sideways, up or down, in turning, and in opening or closing, added up.

        The way down is open only from right above, turned, and opened so that the fingers fit;
        elsewhere it goes by a point over the object's top.
        """
        x, y = abs(float(self.offset[0])), abs(float(self.offset[1]))
        missing = max(self.narrow - opening, opening - self.wide, 0.0)
        closed = max(
            (x - _LENGTH_SLACK) / _EDGE,
            (y - _SIDE_SLACK) / _EDGE,
            (abs(self.turn) - _TURN_SLACK) / _TURN_EDGE,
            (self.narrow - _OPENING_SLACK - opening) / _EDGE,
            (opening - self.wide) / _EDGE,
        )
        closed = min(max(closed, 0.0), 1.0)
        height = (1 - closed) * -float(self.offset[2]) + closed * (self.top - self.hand + _OVER)
        return math.hypot(x, y) + abs(height) + _TURN * abs(self.turn) + missing


# --- Finding them -------------------------------------------------------------------------------


def _search(
    scene: SceneGeometry, settings: LabelSettings, gripper: GripperGeometry
) -> np.ndarray:
    """(N, 7) grasps: E's x, y, z in W, the closing line's angle, quality, and the openings between
    which the hand can come down. N may be 0."""
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
        depth = np.minimum(
            settings.depth, surface[some, 2] - scene.table_height - settings.table_clearance
        )
        z = surface[some, 2] - depth + gripper.tip_below_centre
        z = np.maximum(z, scene.table_height + _LOWEST)
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
    z = max(z, corners[:, 2].max() - 0.035, scene.table_height + _LOWEST)
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
