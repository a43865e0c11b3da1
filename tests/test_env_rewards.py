"""Rewards: the way to an object and to its grasps, against shapes whose grasps are known."""

from __future__ import annotations

import itertools
import math
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from envs.env_rewards import (
    GoalView,
    GraspGoals,
    Outline,
    OutlineView,
    RewardState,
    make_reward,
    progress,
)
from tests.helpers.box_frames import CORNERS
from tests.helpers.shapes import cube_corners
from utils.config import ConfigError, changed_keys, load_config, with_settings
from utils.errors import UserError
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
    return GraspGoals(
        SceneGeometry((SolidObject(solids, T_WO[:3, 3], 0.8),)), T_WO, GripperGeometry()
    )


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
    np.testing.assert_allclose(after.vector()[:9], before.vector()[:9], atol=1e-9)
    np.testing.assert_allclose(after.vector()[9:], before.vector()[9:] + 0.01, atol=1e-9)


def test_goals_lie_on_the_object_however_it_is_turned():
    """On the long axis of a brick of 4 x 10 x 5 cm; and where the brick goes, they go."""
    goals, moved = brick(), pose((0.3, -0.2, 0.4), yaw=1.2)
    assert len(goals) > 1
    along = []
    for index in range(len(goals)):
        (x, y, _), angle, *_ = goals.goal(index, pose())
        in_brick = Rotation.from_euler("z", -YAW).apply([x - PLACE[0], y - PLACE[1], 0])
        assert abs(in_brick[0]) < 0.003 and abs(in_brick[1]) < 0.05
        assert math.sin(angle - YAW) == pytest.approx(0, abs=0.05)
        along.append(in_brick[1])
        there = goals.goal(index, moved)
        back = (np.array(there.position) - (0.3, -0.2, 0.4)) @ moved[:3, :3]
        here = (np.array(goals.goal(index, pose()).position) - PLACE) @ pose()[:3, :3]
        np.testing.assert_allclose(back, here, atol=1e-12)
    assert np.ptp(along) > 0.02


def judged_everywhere(monkeypatch, quality: float) -> None:
    """Every grasp alike: the hand, 4 cm wide on either side of a pixel, moves 5 mm to the middle of
    what it grips, 2 cm on either side."""

    def judged(surface, *_):
        columns = {"quality": quality, "middle": 0.005, "reach": 0.02, "widest": 0.04}
        return SimpleNamespace(
            **{name: np.full(len(surface), one) for name, one in columns.items()}
        )

    monkeypatch.setattr("envs.env_rewards.grasp_quality", judged)


def test_what_a_goal_costs_by_hand(monkeypatch):
    """A quality of 0.729 counts by its cube root, 0.9, and a hand of 8 cm has to close by 1 cm:
    0.1 of the 0.3 m for a quality of 0 instead of 1, and 0.01 of 0.3 for each metre."""
    judged_everywhere(monkeypatch, 0.729)
    np.testing.assert_allclose(brick()._price, 0.030 + 0.003)


def test_a_goal_off_the_middle_leaves_less_room(monkeypatch):
    """It may be open from 2 (2 + 0.5) to 2 (4 - 0.5) cm."""
    judged_everywhere(monkeypatch, 1.0)
    goals = brick()
    np.testing.assert_allclose([goals._narrow, goals._wide], [[0.05], [0.07]] * np.ones(len(goals)))


def test_the_tilt_is_the_angle_by_which_the_hand_leans():
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


@pytest.mark.parametrize("roll", [0.0, 0.5])
def test_heights_are_those_in_the_world_however_the_hand_leans(roll):
    """The middle of a beam of 10 x 2 x 3 cm is gripped 2 cm deep or to 8 mm over the table."""
    beam = CORNERS * (0.05, 0.01, 0.015)
    T_WO, T_WE = pose([0.5, 0.0, 0.015], 0.0), hand([0.52, 0.03, 0.2], 0.0)
    T_WE[:3, :3] = Rotation.from_euler("x", roll).as_matrix() @ T_WE[:3, :3]
    view = goals_of([beam], T_WO).seen_from(T_WO, T_WE)
    height = (T_WE[:3, :3] @ view.offset + T_WE[:3, 3])[2]
    *_, told, top = view.vector()
    assert told == pytest.approx(height, abs=1e-9) and 0.012 <= height < 0.03
    assert top == pytest.approx(0.03, abs=1e-9)


def test_the_way_to_a_goal_by_hand():
    """A grasp of openings from 5 to 8 cm, at 3 cm over the table on an object of 5 cm."""

    def way(x=0.0, y=0.0, up=0.0, turn=0.0, opening=0.07, wide=0.08) -> float:
        offset = np.array([x, y, up])
        return GoalView(offset, turn, 0.05, wide, 0.05, 0.03 + up, -up).way(opening)

    assert way() == pytest.approx(0.0)
    assert way(up=0.1) == pytest.approx(0.1), "straight down"
    assert way(x=0.05) == pytest.approx(0.05 + 0.04), "over the top first: 2 cm over 5, from 3"
    assert way(y=0.05, up=0.04) == pytest.approx(0.05), "there already"
    assert way(turn=0.1, up=0.1) == pytest.approx(0.1 + 0.006)
    assert way(turn=1.0) == pytest.approx(0.04 + 0.06), "not down without having turned"
    assert way(opening=0.08, wide=0.03) == pytest.approx(0.04 + 0.05), "nor into the other wall"
    assert way(opening=0.02) == pytest.approx(0.04 + 0.03), "nor onto the object, half shut"


# --- The way to an object -----------------------------------------------------------------------


def test_the_way_to_a_grasp_by_hand():
    """Of a cube of 6 cm whose centre is E's origin: around it, 10 cm over it, turned by half a
    right angle, shut, and 10 cm beside it, from where the way goes by a point 2 cm over its top."""
    cube, here = Outline(cube_corners()), np.diag([1.0, -1.0, -1.0, 1.0])  # E looks down

    def way(x=0.0, z=0.0, yaw=0.0, opening=0.08) -> float:
        T_WE = here.copy()
        T_WE[:3, :3] = Rotation.from_euler("z", yaw).as_matrix() @ T_WE[:3, :3]
        T_WE[0, 3], T_WE[2, 3] = x, z
        return cube.seen_from(np.eye(4), T_WE).way(opening)

    assert way() == pytest.approx(0.0, abs=1e-12)
    assert way(z=0.1) == pytest.approx(0.1)
    assert way(yaw=np.pi / 4) == pytest.approx(0.06 * (np.sqrt(2) - 1))
    assert way(opening=0.0) == pytest.approx(0.07)
    assert way(x=0.1) == pytest.approx(0.1 + 0.05)
    assert way(x=0.1, z=0.05) == pytest.approx(0.1)


def test_when_the_way_down_is_blocked_by_hand(monkeypatch):
    """From 1.5 cm off the middle along the pads, 8 mm along the closing line, over another 1 cm.
    What reaches 6 cm up between fingers of 3.5 cm keeps them 2.5 cm higher."""
    monkeypatch.setattr("envs.env_rewards.way_to_grasp", lambda *place, **more: more)

    def way(x: float, y: float, top: float = 0.03) -> dict:
        return OutlineView(np.array([x, y, 0.0]), np.full(8, 0.06), top, 0.0).way(0.08)

    blocked = [way(*place)["blocked"] for place in ((0.012, 0), (0, 0.012), (0.019, 0), (0, 0.03))]
    assert blocked == pytest.approx([0.0, 0.4, 0.4, 1.0])
    assert way(0, 0, top=0.06)["down"] == pytest.approx(0.025)
    assert way(0, 0, top=0.03)["down"] == 0.0 and way(0, 0, top=0.03)["over"] == 0.05


def test_an_outline_by_hand():
    """A plate of 4 x 2 x 1 cm turned by 30 degrees from the closing line, its centre 5 cm under E:
    along a line turned by t its shadow is 4 |cos (30 - t)| + 2 |sin (30 - t)| cm wide."""
    corners = itertools.product([-0.02, 0.02], [-0.01, 0.01], [-0.005, 0.005])
    plate = Outline((np.array(list(corners)),))
    T_WO = np.eye(4)
    T_WO[:3, :3] = Rotation.from_euler("z", 30, degrees=True).as_matrix()
    T_WE = np.eye(4)  # upright hand whose closing line is x
    T_WE[:3, :3] = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]]).T
    T_WE[2, 3] = 0.05
    view = plate.seen_from(T_WO, T_WE)
    t = np.radians(30 - 25 * np.arange(8))
    widths = 0.04 * abs(np.cos(t)) + 0.02 * abs(np.sin(t))
    np.testing.assert_allclose(view.vector(), [*widths, 0.005 - 0.05], atol=1e-12)
    np.testing.assert_allclose(view.offset, [0, 0, 0.05], atol=1e-12)


# --- Terms --------------------------------------------------------------------------------------


def state_of(**changes) -> RewardState:
    """Nothing gripped, 10 cm away, no progress."""
    return RewardState(
        **{
            "success": False, "grasped": False, "way": 0.1, "lift": 0.0, "progress": 0.1,
            "progress_before": 0.1, "action": np.zeros(5), "reachable": True, "opening": 0.08,
            "hand_position": np.zeros(3), "object_position": np.zeros(3), **changes,
        }
    )  # fmt: skip


def test_progress_by_hand():
    assert progress(False, 0.0, 0.0) == 0.25, "at the grasp"
    assert progress(False, 100.0, 0.0) == pytest.approx(0.0), "far away"
    near = 0.25 - (math.tanh(0.3) + math.tanh(2.0)) / 8
    assert progress(False, 0.1, 0.9) == pytest.approx(near)
    assert (progress(True, 0.0, 0.0), progress(True, 0.0, 0.4)) == (0.5, 0.7)


def test_rewards_add_their_terms():
    state = state_of(success=True, progress=0.9, progress_before=0.5)
    assert make_reward("dense")(state) == pytest.approx(1.0 + 0.4)
    assert make_reward("sparse")(state) == 1.0
    assert make_reward("dense")(state_of()) == make_reward("sparse")(state_of()) == 0.0


def test_a_reward_by_import_path(tmp_path, monkeypatch):
    (tmp_path / "far_reward.py").write_text(
        "def by_height(state):\n    return state.lift - state.way\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    own, state = "far_reward:by_height", state_of(lift=0.5)
    assert make_reward(own)(state) == pytest.approx(0.4)
    mixed = make_reward({"success": 2.0, "progress": 1, own: 0.5})
    done = state._replace(success=True, progress=0.9, progress_before=0.5)
    assert mixed(done) == 2.0 * 1.0 + 1 * (0.9 - 0.5) + 0.5 * (done.lift - done.way)


def test_scales_of_the_named_rewards_give_the_same_bits():
    rng = np.random.default_rng(0)
    for before, after in rng.random((100, 2)):
        state = state_of(success=after > 0.5, progress=after, progress_before=before)
        dense = make_reward({"success": 1.0, "progress": 1.0})(state)
        assert dense == make_reward("dense")(state) == float(after > 0.5) + (after - before)


def test_scales_of_terms_are_a_value_of_the_config():
    chosen = ["env.reward={success: 1, progress: 0.5, my_module:term: -0.1}"]
    config = load_config(None, chosen)
    scales = {"success": 1.0, "progress": 0.5, "my_module:term": -0.1}
    assert config.env.reward == scales and hash(config)
    assert load_config(None, changed_keys(config)) == config
    assert with_settings(config, "env", {"reward": "sparse"}).env.reward == "sparse"
    fewer = {"success": 2.0}  # scales are replaced as one: a term that is not named counts nothing
    assert with_settings(config, "env", {"reward": fewer}).env.reward == fewer
    assert load_config(None, [*chosen, "env.reward={success: 2}"]).env.reward == fewer
    for wrong in ("{}", "{success: a}", "[success]"):
        with pytest.raises(ConfigError, match="env.reward: got .*; expected one of dense, sparse"):
            load_config(None, [f"env.reward={wrong}"])


@pytest.mark.parametrize(
    ("chosen", "message"),
    [
        ("dence", "env.reward: got 'dence', .*did you mean dense"),
        ({"progres": 1.0}, "env.reward, a term: got 'progres', .*did you mean progress"),
        ({"no_module:term": 1.0}, "env.reward: .*there is no module 'no_module'"),
    ],
)
def test_an_unknown_reward_or_term_is_refused(chosen, message):
    with pytest.raises(UserError, match=message):
        make_reward(chosen)
