"""`RobotGrasping-v0`: Gymnasium's contract, physics limits, reward, success and its endings."""

import gc
import os
import subprocess
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path

import gymnasium
import numpy as np
import psutil
import pytest
import torch
from gymnasium.error import ClosedEnvironmentError, InvalidAction, ResetNeeded
from gymnasium.utils.env_checker import check_env

from envs.cell import PhysicsError
from envs.env_observations import INFO_OBSERVATIONS
from envs.env_rewards import Outline
from envs.grasping_env import RobotGraspingEnv
from envs.robot_kinematics import forward_kinematics
from envs.scripted_pick import scripted_pick
from tests.helpers.shapes import cube_corners
from tests.helpers.simulators import is_pybullet, move, needs_pybullet, pybullet
from utils.config import with_settings
from utils.errors import UserError

SIDE = 32  # pixels
CONTROLS = {"ee": 7, "ee_planar": 5, "joint": 8}  # and the sizes of their actions
ALL = "rgb+depth+state"


@pytest.fixture
def picked(make_env):
    """An env whose object is in the hand, one step before success, and the last info."""
    env = make_env(control="ee_planar", hold_seconds=10.0, max_steps=200)
    _, info = env.reset(seed=0)
    while not (info["grasped"] and info["object_position"][2] > env.settings.lift_height):
        *_, info = env.step(scripted_pick(env, info)[1])
    return env, info


def run(env, seed: int, steps: int) -> Iterator[tuple]:
    """What a reset and then `steps` random actions give back, one by one."""
    rng = np.random.default_rng(seed)
    observation, info = env.reset(seed=seed)
    yield observation, info
    for _ in range(steps):
        action = rng.uniform(-1, 1, env.action_space.shape).astype(np.float32)
        yield env.step(action)


def assert_identical(a, b) -> None:
    """Bit-identical nested tuples, dicts, arrays and scalars."""
    assert type(a) is type(b)
    if isinstance(a, dict):
        assert a.keys() == b.keys()
        for key in a:
            assert_identical(a[key], b[key])
    elif isinstance(a, (tuple, list)):
        assert len(a) == len(b)
        for x, y in zip(a, b):
            assert_identical(x, y)
    else:
        np.testing.assert_array_equal(a, b)


# --- Gymnasium's contract ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("control", "observed", "camera"),
    [
        *((control, ALL, "overhead") for control in CONTROLS),
        *(("ee", alone, "wrist") for alone in ("rgb", "depth", "state")),
        ("joint", ALL, "wrist"),
    ],
)
def test_gymnasiums_checker_finds_nothing(make_env, control, observed, camera):
    """Each control, each observation alone and with the others, each camera."""
    observations = observed.split("+")
    env = make_env(control=control, observations=observations, camera=camera)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(env, skip_render_check=True)  # it would open a window
    assert env.action_space.shape == (CONTROLS[control],)
    assert list(env.observation_space) == sorted(observations)


def test_observations_carry_the_documented_units(make_env):
    env = make_env(observations=["rgb", "depth", "state"])
    observation, info = env.reset(seed=1)
    rgb, depth, state = (observation[name] for name in ("rgb", "depth", "state"))
    assert (rgb.shape, rgb.dtype) == ((SIDE, SIDE, 3), np.uint8)
    assert (depth.shape, depth.dtype) == ((SIDE, SIDE, 1), np.float32)
    assert (state.shape, state.dtype) == ((15,), np.float32)
    # The camera is 0.8 m above the table and looks straight down; the cube is 6 cm high.
    assert np.median(depth) == pytest.approx(0.8, abs=1e-3)
    # Dropped with a random rotation, it settles on a face.
    assert depth.min() == pytest.approx(0.8 - 0.06, abs=3e-3)
    np.testing.assert_allclose(state[:7], env.config.robot.home, atol=0.01)
    np.testing.assert_allclose(state[7:14], 0.0, atol=0.01)
    assert state[14] == pytest.approx(0.08, abs=1e-3) == env.get_gripper_width()
    assert info["object_position"][2] == pytest.approx(0.03, abs=1e-3)
    assert (rgb[..., 0].astype(int) - rgb[..., 1]).max() > 100, "the cube is red"


def test_settings_by_name_through_gymnasium_make():
    env = gymnasium.make("RobotGrasping-v0", observations=["state"], control="ee_planar")
    assert env.action_space.shape == (5,) and env.unwrapped.settings.control == "ee_planar"
    env.reset(seed=0)
    env.step(env.action_space.sample())
    env.close()


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_vector_environments(mode):
    envs = gymnasium.make_vec(
        "RobotGrasping-v0", num_envs=2, vectorization_mode=mode, observations=["state"]
    )
    observations, _ = envs.reset(seed=0)
    assert observations["state"].shape == (2, 15)
    observations, rewards, *_, infos = envs.step(np.zeros((2, 7), np.float32))
    assert rewards.shape == (2,)
    objects = infos["object_position"]
    assert (objects[0] != objects[1]).any(), "seeds 0 and 1 are two scenes"
    envs.close()


@pytest.mark.slow
def test_demonstration_runs_without_a_display(tmp_path):
    """The tutorial's command, from any folder: a line on each phase, a picture and a film."""
    repository = str(Path(__file__).resolve().parents[1])
    environment = {k: v for k, v in os.environ.items() if k != "DISPLAY"}
    # Moves along the hand's axes are what the trainings' configs ask for.
    changes = ["env.resolution=32", "env.frame=hand"]
    command = [sys.executable, "-m", "envs.grasping_env", *changes]
    result = subprocess.run(
        command, cwd=tmp_path, env=environment | {"PYTHONPATH": repository},
        capture_output=True, text=True, timeout=100,
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    for words in ("moves over", "goes down", "fingers close", "lifts it", "ended by success"):
        assert words in result.stdout
    (folder,) = (tmp_path / "runs" / "grasping_env").iterdir()
    assert str(folder.relative_to(tmp_path) / "film.mp4") in result.stdout
    assert (folder / "picture.png").stat().st_size > 10_000 < (folder / "film.mp4").stat().st_size


# --- What is observed -------------------------------------------------------------------------


def test_numbers_of_info_can_be_observed(make_env):
    names = [name for name in INFO_OBSERVATIONS if name != "grasp_goal"]
    env = make_env(observations=names)
    for observation, *_, info in run(env, 0, 3):
        assert env.observation_space.contains(observation)
        for name in names:
            np.testing.assert_array_equal(observation[name], np.float32(info[name]).reshape(-1))
    goals = make_env(observations=["grasp_goal"], goal="grasp")
    observation, info = goals.reset(seed=0)
    np.testing.assert_array_equal(observation["grasp_goal"], np.float32(info["grasp_goal"]))


def test_a_config_s_policy_observations_are_those_of_the_environment(tmp_path):
    """So that any library trains on what the config's policy sees."""
    file = Path(__file__).resolve().parents[1] / "configs" / "ppo.yaml"
    env = gymnasium.make("RobotGrasping-v0", config=file)
    observation, info = env.reset(seed=0)
    assert set(observation) == {"rgb", "depth", "end_effector_position", "gripper"}
    assert observation["gripper"].tolist() == np.float32(info["gripper"]).tolist()
    assert observation["rgb"].shape == (64, 64, 3) and env.action_space.shape == (5,)
    env.close()
    chosen = gymnasium.make("RobotGrasping-v0", config=file, observations=["state"])
    assert set(chosen.observation_space) == {"state"}, "given by name"
    chosen.close()


def test_depth_noise_reaches_the_environment(make_env, config):
    """It is a function of the scene and the number of images, and changes the depth alone."""
    settings = {"observations": ["rgb", "depth"]}
    noisy = RobotGraspingEnv(config=with_settings(config, "camera", {"depth_noise": "kinect"}),
                             resolution=64, **settings)  # fmt: skip
    clean = make_env(resolution=64, **settings)
    seen, plain = list(run(noisy, 4, 2)), list(run(clean, 4, 2))
    again = list(run(noisy, 4, 2))
    noisy.close()
    assert_identical(seen, again)
    for (observation, *_), (without, *_) in zip(seen, plain):
        np.testing.assert_array_equal(observation["rgb"], without["rgb"])
        known = observation["depth"] > 0
        error = (observation["depth"] - without["depth"])[known]
        assert np.abs(error).max() > 1e-3 and np.abs(error).mean() < 0.01 < known.mean()


# --- Rendering --------------------------------------------------------------------------------


def test_render_mode_none_gives_none(make_env):
    env = make_env()
    env.reset(seed=0)
    assert env.render() is None


def test_rgb_array_shows_the_robot(make_env):
    env = make_env("rgb_array", control="joint")
    with pytest.raises(ResetNeeded):
        env.render()
    env.reset(seed=0)
    before = env.render()
    assert (before.shape, before.dtype) == ((480, 640, 3), np.uint8)
    swing = np.zeros(8, np.float32)
    swing[0] = 1.0
    for _ in range(5):
        env.step(swing)
    # Camera, table and cube stay where they are: only the robot can change the picture.
    changed = (abs(env.render().astype(int) - before) > 30).any(axis=-1)
    assert changed.mean() > 0.02


def test_render_modes_that_cannot_be_are_refused(make_env, monkeypatch):
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(UserError, match="rgb_array"):
        make_env("human")
    with pytest.raises(UserError, match="'movie'.*human.*rgb_array"):
        make_env("movie")


# --- Determinism ------------------------------------------------------------------------------


def test_same_seed_same_episode(make_env):
    settings = {"observations": ["rgb", "depth", "state"]}
    env, other = make_env(**settings), make_env(**settings)
    first = list(run(env, 5, 15))
    list(run(env, 6, 7))  # other work in between
    assert_identical(first, list(run(env, 5, 15)))
    assert_identical(first, list(run(other, 5, 15)))


def test_interleaved_environments_do_not_touch_each_other(make_env):
    settings = [{"control": "ee"}, {"control": "joint", "observations": ["rgb", "depth"]}]
    alone = [list(run(make_env(**s), seed, 15)) for seed, s in enumerate(settings)]
    a, b = (run(make_env(**s), seed, 15) for seed, s in enumerate(settings))
    together = list(zip(a, b, strict=True))
    assert_identical(alone[0], [pair[0] for pair in together])
    assert_identical(alone[1], [pair[1] for pair in together])


def test_scene_seed_asks_for_one_scene(make_env):
    env = make_env()
    _, info = env.reset(seed=0)
    _, again = env.reset(seed=1, options={"scene_seed": info["scene_seed"]})
    assert again["scene_seed"] == info["scene_seed"]
    np.testing.assert_array_equal(again["object_position"], info["object_position"])
    _, other = env.reset()
    assert other["scene_seed"] != info["scene_seed"]


# --- Sparing the solver until the first touch ---------------------------------------------------


@pytest.fixture
def make_awake(make_env, monkeypatch):
    """Makes environments whose objects never sleep and whose solver never spares itself."""

    def make_one(**settings) -> RobotGraspingEnv:
        env = make_env(**settings)
        monkeypatch.setattr(env.cell, "enable_sleeping", lambda: settle_only(env.cell))
        return env

    return make_one


def settle_only(cell) -> bool:
    """What `PybulletCell.enable_sleeping` does before it decides; MuJoCo's does nothing before."""
    if is_pybullet(cell):
        from envs.pybullet_bodies import settle

        settle(cell.client, cell.bodies, cell.config, checks=5)
    return False


@needs_pybullet
@pytest.mark.parametrize("control", CONTROLS)
def test_a_free_arm_moves_as_with_full_precision(make_env, make_awake, control):
    """Up to 0.5 mrad, 5 mrad/s and 0.2 mm of the gripper's opening, all in full motion. Against
    3,000 iterations the solver at full precision is off by as much, the gripper's 0.05 mm apart."""
    states = []
    for env in (make_env(control=control), make_awake(control=control)):
        env.reset(seed=0)
        rng = np.random.default_rng(0)
        for _ in range(25):
            action = rng.uniform(-1, 1, env.action_space.shape)
            action[2] = action[2] if control == "joint" else abs(action[2])
            observation, *_, info = env.step(action)
            states.append(observation["state"])
        assert not env.cell.robot.touches()
    spared, full = np.reshape(states, (2, 25, 15))
    np.testing.assert_allclose(spared[:, :7], full[:, :7], atol=5e-4)
    np.testing.assert_allclose(spared[:, 7:14], full[:, 7:14], atol=5e-3)
    np.testing.assert_allclose(spared[:, 14], full[:, 14], atol=2e-4)


@pytest.mark.parametrize("scenario", ["isolated", "pile"])
def test_untouched_objects_lie_still(make_env, scenario):
    env = make_env(objects="primitives", scenario=scenario)
    _, info = env.reset(seed=2)
    *_, begun = env.step(np.array([0, 0, 1, 0, 0, 0, 1.0]))
    np.testing.assert_allclose(begun["object_position"], info["object_position"], atol=1e-5)
    before = [env.cell.object_pose(i) for i in range(len(env.cell.bodies))]
    for _ in range(40):
        env.step(np.array([0, 0, 1, 0, 0, 0, 1.0]))
    for i, pose in enumerate(before):
        np.testing.assert_array_equal(env.cell.object_pose(i), pose)


def test_a_sleeping_object_is_pushed_like_one_awake(make_env, make_awake):
    ends = []
    for env in (make_env(control="ee_planar"), make_awake(control="ee_planar")):
        _, info = env.reset(seed=0)
        start = info["object_position"]
        # Down beside the cube with closed fingers, then through it.
        # Only the first hit counts: each further one amplifies differences.
        beside = start + [0.0, 0.09, 0.0]
        for goal, steps in (
            (beside + [0.0, 0.0, 0.1], 12),
            (beside, 12),
            (start - [0.0, 0.04, 0.0], 4),
        ):
            for _ in range(steps):
                offset = np.clip((goal - info["end_effector_position"]) / 0.05, -0.4, 0.4)
                *_, info = env.step(np.array([*offset, 0.0, -1.0]))
        ends.append(info["object_position"] - start)
    assert ends[1][1] < -0.03, "the cube has not been pushed"
    np.testing.assert_allclose(ends[0], ends[1], atol=2e-3)


def test_what_is_let_go_falls_however_long_it_was_held(picked):
    env, _ = picked
    for _ in range(40):  # 3.3 s: Bullet lets sleep what has lain still for 2 s
        *_, info = env.step(np.array([0, 0, 0, 0, -1.0]))
    assert info["grasped"] and info["object_position"][2] > env.settings.lift_height
    for _ in range(8):
        *_, info = env.step(np.array([0, 0, 0, 0, 1.0]))
    assert not info["grasped"] and info["object_position"][2] < 0.05


@needs_pybullet
def test_objects_on_the_move_are_not_put_to_sleep(make_env, monkeypatch):
    env = make_env()
    load = env.cell.load

    def load_and_spin(scene):
        load(scene)
        for body in env.cell.bodies:  # a top, on a table without friction
            pybullet.changeDynamics(body, -1, lateralFriction=0, angularDamping=0,
                                    physicsClientId=env.cell.client)  # fmt: skip
            pybullet.resetBaseVelocity(
                body, [0, 0, 0], [0, 0, 3.0], physicsClientId=env.cell.client
            )

    monkeypatch.setattr(env.cell, "load", load_and_spin)
    env.reset(seed=0)
    before = env.cell.object_pose(0)
    env.step(np.zeros(7))
    turn = env.cell.object_pose(0)[:3, :3] @ before[:3, :3].T
    assert np.arctan2(turn[1, 0], turn[0, 0]) == pytest.approx(3.0 * 20 / 240, rel=0.1)


def scripted_episode(env) -> Iterator[tuple]:
    """What a scripted pick gives back, step by step."""
    _, info = env.reset(seed=1)
    done = False
    while not done:
        result = env.step(scripted_pick(env, info)[1])
        *_, terminated, truncated, info = result
        done = terminated or truncated
        yield result


def test_picks_are_deterministic_interleaved_or_not(make_env):
    settings = {"control": "ee_planar"}
    alone = list(scripted_episode(make_env(**settings)))
    assert alone[-1][-1]["is_success"]
    other = run(make_env(objects="primitives", scenario="pile"), 3, len(alone) - 1)
    together = list(zip(scripted_episode(make_env(**settings)), other, strict=True))
    assert_identical(alone, [pair[0] for pair in together])


# --- How episodes end -------------------------------------------------------------------------


def test_truncation_comes_exactly_at_max_steps(make_env):
    env = make_env(max_steps=4)
    env.reset(seed=0)
    steps = [env.step(np.zeros(7)) for _ in range(4)]
    assert [truncated for *_, truncated, _ in steps] == [False, False, False, True]
    assert not any(terminated for _, _, terminated, _, _ in steps)
    assert steps[-1][-1]["reason"] == "max_steps"
    with pytest.raises(ResetNeeded):
        env.step(np.zeros(7))


@pytest.mark.parametrize("reward", ["dense", "sparse"])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_scripted_pick_succeeds(make_env, seed, reward):
    env = make_env(control="ee_planar", reward=reward)
    _, info = env.reset(seed=seed)
    start, rewards, terminated, truncated = potential(env, info), [], False, False
    while not (terminated or truncated):
        _, r, terminated, truncated, info = env.step(scripted_pick(env, info)[1])
        rewards.append(r)
    assert terminated and not truncated and info["is_success"] and info["reason"] == "success"
    assert info["grasped"] and info["object_position"][2] > env.settings.lift_height
    if reward == "sparse":
        assert rewards[-1] == 1.0 and not any(rewards[:-1])
    else:
        assert sum(rewards) == pytest.approx(1.0 + potential(env, info) - start, abs=1e-5)


def potential(env, info, rest: float = 0.03, lift_height: float = 0.15) -> float:
    """Phi as the class documents it, for the tutorial's cube, which rests 0.03 m over the table."""
    if info["grasped"]:
        h = (info["object_position"][2] - rest) / (lift_height - rest)
        return (1 + min(max(h, 0.0), 1.0)) / 2
    T_WE = forward_kinematics(env.cell.robot.q)
    view = Outline(cube_corners()).seen_from(env.cell.object_pose(0), T_WE)
    w = view.way(env.get_gripper_width())
    return (1 - np.tanh(3 * w) / 2 - np.tanh(20 * w) / 2) / 4


def test_dense_rewards_telescope_over_random_actions(make_env):
    env = make_env()
    steps = run(env, 3, 40)
    _, info = next(steps)
    start, total = potential(env, info), 0.0
    for step in steps:
        total += step[1]
    info = step[-1]
    assert total == pytest.approx(potential(env, info) - start, abs=1e-5)


def test_success_needs_the_object_held_up_for_a_while(picked):
    env, info = picked  # must stay up for 10 s = 120 actions
    for _ in range(20):
        _, _, terminated, _, info = env.step(np.array([0, 0, 0, 0, -1.0]))
        assert not terminated and info["grasped"]


@pytest.mark.parametrize(("substeps", "held"), [(20, 4), (24, 3), (40, 3)])
def test_the_object_is_held_for_as_long_as_hold_seconds(make_env, substeps, held):
    """0.2 s of 240 steps each are 48 steps: between the first and the last of so many observations,
    (held - 1) * substeps lie."""
    env = make_env(control="ee_planar", hold_seconds=0.2, substeps=substeps)
    _, info = env.reset(seed=0)
    lifted, terminated = 0, False
    while not terminated:
        _, _, terminated, truncated, info = env.step(scripted_pick(env, info)[1])
        up = info["grasped"] and info["object_position"][2] > env.settings.lift_height
        lifted = lifted + 1 if up else 0
        assert not truncated
    assert info["is_success"] and lifted == held


def test_a_flung_object_is_no_success(make_env):
    env = make_env(hold_seconds=0.0)
    env.reset(seed=0)
    move(env.cell, 0, velocity=(0, 0, 2.5))
    highest, succeeded = 0.0, False
    for _ in range(8):
        _, _, terminated, _, info = env.step(np.zeros(7))
        highest, succeeded = max(highest, info["object_position"][2]), succeeded or terminated
    assert highest > env.settings.lift_height and not succeeded


def test_an_object_off_the_table_ends_the_episode(make_env):
    env = make_env()
    env.reset(seed=0)
    move(env.cell, 0, [0.5, 2.0, 0.1])
    _, reward, terminated, truncated, info = env.step(np.zeros(7))
    assert terminated and not truncated and info["reason"] == "off_table"
    assert not info["is_success"] and reward < 0


def blow_up_the_object(env, monkeypatch):
    move(env.cell, 0, [np.nan] * 3)


def blow_up_the_robot(env, monkeypatch):
    monkeypatch.setattr(env.cell.robot, "state", lambda: [np.nan] * 15)


def blow_up_the_judge(env, monkeypatch):
    def fail(index):
        raise PhysicsError("as if")

    monkeypatch.setattr(env.cell, "object_pose", fail)


@pytest.mark.parametrize("blow_up", [blow_up_the_object, blow_up_the_robot, blow_up_the_judge])
def test_a_physics_blow_up_ends_the_episode(make_env, blow_up, monkeypatch):
    env = make_env(observations=["rgb", "depth", "state"])
    env.reset(seed=0)
    blow_up(env, monkeypatch)
    observation, reward, terminated, _, info = env.step(np.zeros(7))
    assert terminated and info["reason"] == "physics" and reward == 0.0
    assert env.observation_space.contains(observation)
    assert np.isfinite([*info["object_position"], *info["end_effector_position"]]).all()
    monkeypatch.undo()
    env.reset(seed=0)  # and the next episode is sound again
    assert env.step(np.zeros(7))[-1]["reason"] is None


def test_what_mujoco_warns_of_ends_the_episode(config, monkeypatch, tmp_path):
    """A speed beyond MuJoCo's limit, 1e10, while all numbers are finite. It leaves no file."""
    pytest.importorskip("mujoco")
    monkeypatch.chdir(tmp_path)
    env = RobotGraspingEnv(
        config=config.model_copy(update={"simulator": "mujoco"}), observations=["state"]
    )
    env.reset(seed=0)
    move(env.cell, 0, velocity=(0, 0, 1e11))
    *_, terminated, _, info = env.step(np.zeros(7))
    env.close()
    assert terminated and info["reason"] == "physics"
    assert not list(tmp_path.iterdir())


# --- Wrong use --------------------------------------------------------------------------------


@pytest.mark.parametrize("control", CONTROLS)
def test_bad_actions_are_refused(make_env, control):
    env, size = make_env(control=control), CONTROLS[control]
    env.reset(seed=0)
    for shape in [(size + 1,), (1, size), ()]:
        with pytest.raises(InvalidAction, match=rf"{control}.*\({size},\): .*gripper, each in"):
            env.step(np.zeros(shape))
    for bad in (np.nan, np.inf, -np.inf):
        with pytest.raises(InvalidAction, match="non-finite"):
            env.step(np.full(size, bad))
    env.step(np.zeros(size))  # none of them has done harm


def test_life_cycle_errors(make_env):
    env = make_env("rgb_array")
    with pytest.raises(ResetNeeded):
        env.step(np.zeros(7))
    with pytest.raises(ResetNeeded):
        env.get_gripper_width()
    env.close()
    env.close()
    for call in (env.reset, env.render, env.get_gripper_width, lambda: env.step(np.zeros(7))):
        with pytest.raises(ClosedEnvironmentError):
            call()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"contrl": "ee"}, r"env\.contrl.*control"),
        ({"control": "cartesian"}, r"env\.control.*cartesian"),
        ({"observations": []}, r"env\.observations"),
        ({"observations": ["state", "state"]}, r"env\.observations.*repeated"),
        ({"observations": ["stat"]}, r"env\.observations.*did you mean state"),
        ({"observations": ["grasp_goal"]}, r"env\.observations.*'grasp_goal'"),
        ({"reward": "dence"}, r"env\.reward: got 'dence'.*did you mean dense"),
        ({"reward": "no_such_module:reward"}, r"env\.reward.*no_such_module"),
        ({"resolution": 8}, r"env\.resolution.*16"),
        ({"max_steps": 0}, r"env\.max_steps"),
        ({"objects": "no_such_set"}, r"env\.objects.*random_urdfs"),
        ({"position_step": float("nan")}, r"env\.position_step"),
        ({"lift_height": "high"}, r"env\.lift_height"),
        ({"hold_seconds": 20.0}, r"env\.max_steps \(100\) ends .*, which takes 241 actions; set"),
    ],
)
def test_wrong_settings_name_their_key(make_env, settings, message):
    with pytest.raises(UserError, match=message):
        make_env(**settings)


def test_a_side_view_is_no_view_of_the_wrists_camera(config):
    side = with_settings(config, "camera", {"view": "side"})
    with pytest.raises(UserError, match=r"set camera\.view=fixed or env\.camera=overhead"):
        RobotGraspingEnv(config=side, camera="wrist")


def double_noise(image_focal: float):
    return lambda depth, rng: depth + rng.normal(0, 0.01, depth.shape)


def test_depth_stays_within_its_space_whatever_a_noise_returns(config):
    """The table is 0.8 m away, half a standard deviation before the far plane."""
    noise = {"depth_noise": "tests.test_grasping_env:double_noise", "far": 0.805}
    noisy = with_settings(config, "camera", noise)
    env = RobotGraspingEnv(config=noisy, observations=["depth"], resolution=32)
    observation, _ = env.reset(seed=0)
    env.close()
    assert observation in env.observation_space
    assert 0.2 < (observation["depth"] == 0).mean() < 0.4  # a normal law has 0.31 beyond half sigma


# --- The long run -----------------------------------------------------------------------------


@pytest.mark.slow
def test_resets_leak_no_memory(make_env):
    """Under 10 kB each. A leak goes on and on: pools of allocators, which grow by leaps, do so in
    the first half, or in few of the second half's parts."""
    env, process = make_env(), psutil.Process()
    resident = []
    for seed in range(1001):
        if seed >= 500 and seed % 100 == 0:
            gc.collect()
            resident.append(process.memory_info().rss)
        env.reset(seed=seed)
    assert np.median(np.diff(resident)) < 1e6


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning")  # SB3 remarks on the platform
@pytest.mark.parametrize("algorithm", ["PPO", "SAC"])
def test_stable_baselines3_trains_on_it_unmodified(config, algorithm):
    stable_baselines3 = pytest.importorskip("stable_baselines3")
    torch.set_num_threads(1)  # on a busy machine more threads than free cores wait for each other
    env = gymnasium.make("RobotGrasping-v0", config=config, resolution=64)
    if algorithm == "PPO":
        steps, settings = 64, {"n_steps": 32, "batch_size": 16, "n_epochs": 1}
    else:
        steps = 48
        settings = {"buffer_size": 2000, "learning_starts": 16, "batch_size": 8, "train_freq": 16,
                    "gradient_steps": 2}  # fmt: skip
    learner = getattr(stable_baselines3, algorithm)("MultiInputPolicy", env, seed=0, **settings)
    learner.learn(steps)
    assert learner.num_timesteps >= steps
    observation, _ = env.reset(seed=0)
    action, _ = learner.predict(observation, deterministic=True)
    assert env.action_space.contains(action)
    env.close()
