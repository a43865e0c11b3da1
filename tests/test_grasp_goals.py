"""Grasps that an object offers, and the way to them, against shapes whose grasps are known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from envs.grasp_goals import GoalView, GraspGoals
from tests.test_geometry import CORNERS
from utils.geometry import ConvexSolid, GripperGeometry, SceneGeometry, SolidObject

YAW = math.radians(30)
PLACE = np.array([0.5, 0.1, 0.025])


def pose(position=PLACE, yaw: float = YAW) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", yaw).as_matrix()
    T[:3, 3] = position
    return T


def hand(position, yaw: float) -> np.ndarray:
    """(4, 4) a hand that looks down, its closing line turned by `yaw` from the x axis of W."""
    T = np.eye(4)
    y = np.array([math.cos(yaw), math.sin(yaw), 0.0])
    z = np.array([0.0, 0.0, -1.0])
    T[:3, :3] = np.column_stack([np.cross(y, z), y, z])
    T[:3, 3] = position
    return T


def goals_of(parts, T_WO: np.ndarray) -> GraspGoals:
    """Of an object of convex parts (V, 3) in its own frame."""
    solids = tuple(ConvexSolid.from_vertices(part).transformed(T_WO) for part in parts)
    return GraspGoals(SceneGeometry((SolidObject(solids, T_WO[:3, 3], 0.8),)), T_WO, GripperGeometry())


def brick() -> GraspGoals:
    """4 x 10 x 5 cm, its short side turned by 30 degrees: only that one fits the hand."""
    return goals_of([CORNERS * (0.02, 0.05, 0.025)], pose())


def test_a_brick_is_taken_across_its_short_side():
    goals = brick()
    assert len(goals) >= 1
    short = np.array([math.cos(YAW), math.sin(YAW)])
    for along in np.linspace(-0.05, 0.05, 5):
        place = PLACE[:2] + along * np.array([-short[1], short[0]])
        T_WE = hand([*place, 0.2], YAW + 0.25)
        view = goals.seen_from(pose(), T_WE)
        # About the hand's z, which points down, the way back to the brick's side is +0.25.
        assert view.turn == pytest.approx(0.25, abs=0.02)
        at = T_WE[:3, :3] @ view.offset + T_WE[:3, 3]
        assert abs((at[:2] - PLACE[:2]) @ short) < 0.002, "in the middle of the short side"
        # The fingertips go 2 cm below the top, and 7.2 mm below E.
        assert at[2] == pytest.approx(0.05 - 0.02 + 0.0072, abs=5e-4)
        assert view.narrow == pytest.approx(0.04 + 2 * 0.005, abs=0.004)
        assert 0.07 < view.wide <= 0.08
        assert view.top == pytest.approx(0.05, abs=1e-9) and view.hand == pytest.approx(0.2)


def test_goals_go_with_their_object():
    goals = brick()
    before = goals.seen_from(pose(), hand([0.52, 0.07, 0.2], 0.4))
    moved = pose(PLACE + [0.03, -0.02, 0.01], YAW + 0.7)
    motion = moved @ np.linalg.inv(pose())
    after = goals.seen_from(moved, motion @ hand([0.52, 0.07, 0.2], 0.4))
    np.testing.assert_allclose(after.told()[:9], before.told()[:9], atol=1e-9)
    np.testing.assert_allclose(after.told()[9:], before.told()[9:] + 0.01, atol=1e-9)


def test_leaning():
    goals = brick()
    T = pose()
    T[:3, :3] = Rotation.from_euler("x", 0.3).as_matrix() @ T[:3, :3]
    assert goals.tilt(pose()) == pytest.approx(0.0, abs=1e-6)
    assert goals.tilt(pose(yaw=2.0)) == pytest.approx(0.0, abs=1e-6), "turned, not leaning"
    assert goals.tilt(T) == pytest.approx(0.3)


def test_a_square_tube_is_taken_by_its_walls():
    """12 cm wide with walls of 1 cm: nothing but a wall fits between the fingers."""
    half, wall = 0.06, 0.01
    beam = CORNERS * (wall / 2, half, 0.03)
    across = CORNERS * (half - wall, wall / 2, 0.03)
    shift = half - wall / 2
    parts = [beam + (s * shift, 0, 0) for s in (-1, 1)]
    parts += [across + (0, s * shift, 0) for s in (-1, 1)]
    T_WO = pose([0.5, 0.0, 0.03], 0.0)
    goals = goals_of(parts, T_WO)
    for angle in np.linspace(0, 2 * np.pi, 8, endpoint=False):
        T_WE = hand([0.5 + 0.1 * math.cos(angle), 0.1 * math.sin(angle), 0.2], 0.0)
        view = goals.seen_from(T_WO, T_WE)
        at = T_WE[:3, :3] @ view.offset + T_WE[:3, 3] - T_WO[:3, 3]
        assert abs(at[:2]).max() == pytest.approx(shift, abs=0.002)
        assert view.narrow == pytest.approx(wall + 0.01, abs=0.004)


def test_what_offers_no_good_grasp_is_taken_through_the_middle():
    """A drum of 20 cm fits in no direction and has no corners."""
    T_WO = pose([0.5, 0.0, 0.05], 0.0)
    angle = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    rim = [np.column_stack([np.cos(angle), np.sin(angle), 0 * angle + s]) for s in (-0.5, 0.5)]
    goals = goals_of([0.1 * np.concatenate(rim)], T_WO)
    view = goals.seen_from(T_WO, hand([0.5, 0.0, 0.3], 0.0))
    np.testing.assert_allclose(view.offset[:2], 0.0, atol=1e-9)
    assert len(goals) == 1 and view.wide == pytest.approx(0.08)


def test_the_way_to_a_goal_by_hand():
    """A grasp of openings from 5 to 8 cm, at 3 cm over the table on an object of 5 cm."""

    def way(x=0.0, y=0.0, up=0.0, turn=0.0, opening=0.07, wide=0.08) -> float:
        offset = np.array([x, y, up])
        return GoalView(offset, turn, 0.05, wide, 0.05, 0.03 + up).way_to_grasp(opening)

    assert way() == pytest.approx(0.0)
    assert way(up=0.1) == pytest.approx(0.1), "straight down"
    assert way(x=0.05) == pytest.approx(0.05 + 0.04), "over the top first: 2 cm over 5, from 3"
    assert way(y=0.05, up=0.04) == pytest.approx(0.05), "there already"
    assert way(turn=0.1, up=0.1) == pytest.approx(0.1 + 0.006)
    assert way(turn=1.0) == pytest.approx(0.04 + 0.06), "not down without having turned"
    assert way(opening=0.08, wide=0.03) == pytest.approx(0.04 + 0.05), "nor into the other wall"
    assert way(opening=0.02) == pytest.approx(0.04 + 0.03), "nor onto the object, half shut"
