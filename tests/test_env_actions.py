"""Actions and initial states: where episodes begin, how the hand moves, and the arm's limits."""

import math

import numpy as np
import pytest

from envs.robot_kinematics import JOINT_LOWER, JOINT_UPPER, JOINT_VELOCITY, forward_kinematics
from tests.helpers.simulators import needs_pybullet
from utils.errors import UserError

CONTROLS = {"ee": 7, "ee_planar": 5, "joint": 8}  # and the sizes of their actions


def test_episodes_can_begin_near_an_object(make_env):
    env = make_env(control="ee_planar", near_share=1.0)
    for seed in range(4):
        _, info = env.reset(seed=seed)
        x, y, z = info["end_effector_position"] - info["object_position"]
        # The cube's top is 0.03 m over its centre.
        assert max(abs(x), abs(y)) < 0.041 and 0.035 < z < 0.135
        assert not info["grasped"] and info["gripper"][0] == pytest.approx(0.08, abs=1e-3)
        before = env.cell.robot.q
        env.step(np.array([0, 0, 0, 0, 1.0]))
        np.testing.assert_allclose(env.cell.robot.q, before, atol=0.02)
    _, at_home = env.reset(seed=0, options={"start": "home"})
    assert at_home["end_effector_position"][2] > 0.4
    with pytest.raises(
        UserError, match="start must be 'home', 'near', 'pretraining' or .*, got 'here'"
    ):
        env.reset(options={"start": "here"})
    mine = {"q": env.cell.home.tolist(), "opening": 0.04, "command": 0.05}
    env.reset(seed=0, options={"start": mine})
    for wrong in ({"q": [0.0] * 3}, {"q": "x"}, {"q": [math.nan] * 7}, {"opening": -1.0}):
        with pytest.raises(UserError, match="start must have seven joint positions q in .* m; got"):
            env.reset(seed=0, options={"start": mine | wrong})


@needs_pybullet
def test_the_hand_begins_over_all_that_stands_in_a_scene(make_env):
    """The board of the layout shelf, 2 cm thick and 0.3 m over the table, is over all objects."""
    env = make_env(scenario="shelf", objects="tall", near_share=1.0)
    _, info = env.reset(seed=0)
    assert 0.32 + 0.009 < info["end_effector_position"][2] < 0.32 + 0.101


def test_pretraining_states_are_many_at_each_scene(make_env):
    env = make_env(control="ee_planar", goal="grasp")
    pretraining = {"start": "pretraining"}
    infos = [env.reset(seed=3 if n == 0 else None, options=pretraining)[1] for n in range(33)]
    scenes = [info["scene_seed"] for info in infos]
    assert scenes == [scenes[0]] * 16 + [scenes[16]] * 16 + [scenes[32]]
    assert len(set(scenes)) == 3
    for first in (0, 16):
        objects = np.array([info["object_position"] for info in infos[first : first + 16]])
        assert np.ptp(objects, axis=0).max() == 0, "the scene as it was"
    hands = np.array([info["end_effector_position"] for info in infos[:32]])
    assert (np.ptp(hands, axis=0) > 0.1).all()
    assert np.ptp([info["gripper"][0] for info in infos]) > 0.04
    errors = np.array([info["opening_error"][0] for info in infos])
    commands = np.array([info["gripper"] for info in infos])
    np.testing.assert_allclose(errors, commands[:, 0] - commands[:, 1], atol=1e-6)
    assert 0.25 < np.mean(errors > 1e-3) < 0.75, "about half of them while the fingers close"
    again = [env.reset(seed=3 if n == 0 else None, options=pretraining)[1] for n in range(2)]
    for info, before in zip(again, infos):
        np.testing.assert_array_equal(info["grasp_goal"], before["grasp_goal"])


def test_an_action_or_a_chosen_scene_ends_the_pretraining_at_a_scene(make_env):
    env = make_env(control="ee_planar")
    _, first = env.reset(seed=3, options={"start": "pretraining"})
    _, second = env.reset(options={"start": "pretraining"})
    assert second["scene_seed"] == first["scene_seed"]
    env.step(np.array([0, 0, 0, 0, 1.0]))
    _, third = env.reset(options={"start": "pretraining"})
    assert third["scene_seed"] != first["scene_seed"]
    _, asked = env.reset(options={"start": "pretraining", "scene_seed": 7})
    assert asked["scene_seed"] == 7


def test_moves_along_the_axes_of_the_hand(make_env):
    """At home x of the hand is x of the world, the other two are turned over."""
    ends = []
    for frame, signs in (("world", [1, 1, 1, 1]), ("hand", [1, -1, -1, -1])):
        env = make_env(control="ee_planar", frame=frame)
        env.reset(seed=0)
        for action in ([0, 0, -1, 0, 1], [0.5, 0.2, -0.3, 0, 1]):
            env.step(np.array([*np.array(action[:4]) * signs, action[4]]))
        ends.append(env.cell.robot.q)
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-3)  # home is so near to straight
    env.reset(seed=0)
    for turn in (0.5, 0.5, 0.0, 0.0):  # 0.15 rad each: no faster than the joints can
        env.step(np.array([0, 0, 0, turn, 1]))
    turned = [env.step(np.array([1.0, 0, 0, 0, 1]))[-1] for _ in range(4)]
    way = turned[-1]["end_effector_position"] - turned[0]["end_effector_position"]
    assert math.atan2(way[1], way[0]) == pytest.approx(-0.3, abs=0.03), "x turns with the hand"


def test_the_gripper_accepts_changes(make_env):
    env = make_env(control="ee_planar", gripper="change", gripper_step=0.01)
    _, info = env.reset(seed=0)
    np.testing.assert_allclose(info["gripper"], 0.08, atol=1e-3)
    *_, info = env.step(np.array([0, 0, 0, 0, -0.5]))
    assert info["gripper"][1] == pytest.approx(0.075)
    *_, info = env.step(np.array([0, 0, 0, 0, 0.0]))
    assert info["gripper"][1] == pytest.approx(0.075), "what is not changed stays"
    for _ in range(3):
        *_, info = env.step(np.array([0, 0, 0, 0, 1.0]))
    assert info["gripper"][1] == 0.08, "no wider than the hand"
    for _ in range(10):  # the fingers take 8.3 mm a step
        before = env.get_gripper_width()
        *_, info = env.step(np.array([0, 0, 0, 0, -1.0]))
        assert info["gripper"][1] >= before - 0.02 - 1e-6


# --- Limits -----------------------------------------------------------------------------------


def extreme_actions(size: int) -> list[np.ndarray]:
    """Each direction at full throttle, both ways, then everything at once."""
    corners = [sign * np.eye(size)[i] for i in range(size - 1) for sign in (1, -1)]
    return [*corners, np.ones(size), -np.ones(size)]


@pytest.mark.parametrize("manner", ["random", "random again", "extreme"])
@pytest.mark.parametrize("control", CONTROLS)
def test_joint_and_velocity_limits_hold_at_every_physics_step(make_env, control, manner):
    env, size = make_env(control=control, max_steps=10**6), CONTROLS[control]
    env.reset(seed=0)
    positions, velocities = [], []

    def watch(cell):
        q, velocity, _ = cell.robot.joint_state()
        positions.append(q)
        velocities.append(velocity)

    env.cell.on_step = watch
    if manner != "extreme":
        actions = np.random.default_rng(len(manner)).uniform(-1, 1, (200, size))
    else:
        actions = np.repeat(extreme_actions(size), 200 // len(extreme_actions(size)), axis=0)
    for action in actions:
        _, _, terminated, _, _ = env.step(action)
        if terminated:
            env.reset(seed=0)
    # A joint is stopped in the physics step after the one that took it over its limit.
    assert (np.min(positions, axis=0) >= JOINT_LOWER - 5e-3).all()
    assert (np.max(positions, axis=0) <= JOINT_UPPER + 5e-3).all()
    assert (np.abs(velocities) <= JOINT_VELOCITY + 1e-6).all()


def test_the_command_does_not_wind_up_at_the_workspace_wall(make_env):
    env = make_env()
    env.reset(seed=0)
    away = np.eye(7)[1]
    for _ in range(25):
        *_, info = env.step(away)
    wall = env.config.workspace.center[1] + env.config.workspace.size / 2 + 0.08
    assert info["reachable"]
    assert info["end_effector_position"][1] == pytest.approx(wall, abs=0.01)
    for _ in range(4):
        *_, back = env.step(-away)
    # Four times 5 cm, less what the arm lags behind. Wound up by 1 m, it would not have moved.
    assert back["end_effector_position"][1] < wall - 0.15


@pytest.mark.parametrize("control", ["ee", "ee_planar"])
def test_what_the_arm_cannot_reach_is_refused_and_reported(make_env, control):
    """An upright hand at the far upper wall is beyond the Panda's reach."""
    env, size = make_env(control=control), CONTROLS[control]
    _, info = env.reset(seed=0)
    assert info["reachable"]
    far = np.eye(size)[0]
    for action in [far] * 25 + [-far] * 10:
        observation, *_, info = env.step(action)
        R = forward_kinematics(observation["state"][:7])[:3, :3]
        tilt = np.degrees(np.arccos(min(-R[2, 2], 1.0)))
        assert tilt < 10, "the hand tilts without a command"
        if action is far:
            farthest = info
    assert not farthest["reachable"] and farthest["end_effector_position"][0] < 0.73
    assert info["reachable"]
    gone_back = farthest["end_effector_position"][0] - info["end_effector_position"][0]
    assert gone_back > 0.2


@pytest.mark.parametrize("control", ["ee", "ee_planar"])
@pytest.mark.parametrize("frame", ["hand", "world"])
@pytest.mark.parametrize("way", [1, -1])
def test_a_hand_at_the_limit_of_its_wrist_still_moves(make_env, control, frame, way):
    """It turns as far as the last joint, which turns E about its z, and comes down while it is told
    to turn on: 2.5 cm an action."""
    env, size = make_env(control=control, frame=frame), CONTROLS[control]
    env.reset(seed=0)
    turn, down = np.zeros(size), np.zeros(size)
    upright = 1 if frame == "hand" else -1  # E's z points down
    turn[5 if control == "ee" else 3] = way * upright
    down[2] = 0.5 * upright
    for _ in range(30):
        observation, *_, info = env.step(turn)
    limit = JOINT_UPPER[6] if way > 0 else JOINT_LOWER[6]
    assert observation["state"][6] == pytest.approx(limit, abs=0.02)
    high = info["end_effector_position"][2]
    for _ in range(6):
        observation, *_, info = env.step(turn + down)
        assert info["reachable"]
    assert high - info["end_effector_position"][2] > 5 * 0.025
    assert observation["state"][6] == pytest.approx(limit, abs=0.02)
    for _ in range(4):
        observation, *_ = env.step(-turn)
    assert abs(observation["state"][6] - limit) > 0.5, "and turns back"


def test_an_arm_held_up_by_the_table_does_not_wind_up(make_env):
    env = make_env(control="joint")
    env.reset(seed=0)
    down = np.eye(8)[1]  # the shoulder leans forward
    for _ in range(30):
        observation, *_, info = env.step(down)
    stuck = observation["state"][1]
    assert not info["reachable"] and stuck < JOINT_UPPER[1] - 0.3
    for _ in range(10):
        observation, *_, info = env.step(-down)
    assert info["reachable"] and observation["state"][1] < stuck - 0.4
