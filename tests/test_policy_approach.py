"""The shipped policies at work in the cell."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import torch

from benchmarks.bench_policy import config_of, run_episodes
from envs.cell_scenes import make_scene
from envs.env_actions import ActionDecoder
from envs.execution import execute_grasp
from envs.grasping_env import RobotGraspingEnv
from envs.objects import load_object_set
from envs.policy_approach import PolicyApproach, foreign_objects, learned_approach, placeholder
from envs.simulators import make_cell
from envs.vector_env import make_env
from models.grasp_policy import load_policy, make_ppo
from tests.helpers.simulators import move, needs_pybullet
from utils.config import load_config
from utils.errors import UserError
from utils.runs import REPOSITORY

CHECKPOINTS = REPOSITORY / "checkpoints"
ANYWHERE = ["sim.renderer=tiny", "simulator=auto", "scene.simulator=auto"]  # not as it was trained


@pytest.fixture(scope="module")
def box():
    return CHECKPOINTS / "ppo_box.pt"


def test_a_policy_sees_through_the_camera_that_it_was_trained_with():
    """0.8 m above the table; that of the cell looks from a side, and nearer."""
    trained = load_config(None, ["sim.renderer=tiny", "env.camera=overhead"])
    other = load_config(None, ["sim.renderer=tiny", "camera.position=[0.5, -0.4, 0.5]"])
    objects = load_object_set("box", cache_dir=trained.cache_folder)
    with make_cell(other) as cell:
        cell.load(make_scene("isolated", objects, 0, other))
        env = RobotGraspingEnv(config=trained, cell=cell, observations=["depth"])
        observation, _ = env.take_over()
        assert np.median(observation["depth"]) == pytest.approx(0.8, abs=1e-3)
        assert np.median(cell.frame().depth) < 0.7


def test_noise_goes_on_in_a_second_attempt():
    """A policy's second attempt in a scene sees other noise than the first, and the same scene
    loaded again the same."""
    config = load_config(None, ["sim.renderer=tiny", "env.camera=overhead",
                                "camera.depth_noise=realsense"])  # fmt: skip
    objects = load_object_set("box", cache_dir=config.cache_folder)
    seen = []
    with make_cell(config) as cell:
        env = RobotGraspingEnv(config=config, cell=cell, observations=["depth"])
        for attempts in (2, 1):
            cell.load(make_scene("isolated", objects, 0, config))
            seen += [env.take_over()[0]["depth"] for _ in range(attempts)]
    first, second, again = seen
    assert (first == again).all() and (first != second).mean() > 0.5


def test_a_policy_of_an_environment_that_tells_no_reason_is_refused():
    config = load_config(None, ["rl.env_id=Pendulum-v1"])
    with pytest.raises(UserError, match="Pendulum-v1 do not say why they end .*RobotGrasping-v0"):
        run_episodes(lambda observation: np.zeros(1, np.float32), config, 1)


@needs_pybullet  # where the policy has learned; on scenes laid out in MuJoCo it is less certain
def test_the_policy_of_the_box_lifts_it(box):
    """200 of 200 in docs/ppo.md: by far not each in ten would fail by chance."""
    config = config_of(box, ["sim.renderer=tiny"])
    ends = run_episodes(load_policy(box), config, 10)
    assert sum(reason == "success" for reason, _ in ends) >= 9


@pytest.mark.slow
@pytest.mark.parametrize("objects", ["random_urdfs", "primitives"])
def test_policies_lift_what_they_have_never_seen(objects):
    """96 and 93 of 100 attempts in docs/ppo.md: fewer than 6 of 10 would not be chance."""
    path = CHECKPOINTS / f"ppo_{objects}.pt"
    config = config_of(path, ["sim.renderer=tiny", "objects.split=test"])
    assert config.env.objects == objects
    policy = load_policy(path)
    seen = {part.key for part in (*policy.layout.images, *policy.layout.state)}
    assert seen == {"rgb", "depth", "end_effector_position", "gripper", "opening_error"}
    ends = run_episodes(policy, config, 10)
    assert sum(reason == "success" for reason, _ in ends) >= 6


def test_fresh_episodes_are_at_full_difficulty(box, monkeypatch):
    """Though half of those of its training began near the box."""
    config = config_of(box, ["env.max_steps=1", "env.hold_seconds=0", *ANYWHERE])
    assert config.env.near_share == 0.5
    starts, reset = [], RobotGraspingEnv.reset

    def spied(env, **arguments):
        result = reset(env, **arguments)
        starts.append((arguments.get("options"), env.start))
        return result

    monkeypatch.setattr(RobotGraspingEnv, "reset", spied)
    run_episodes(load_policy(box), config, 4)
    assert starts[-4:] == [({"start": "home"}, "home")] * 4


def test_the_policy_does_not_observe_the_box_s_pose(box):
    policy = load_policy(box)
    assert {part.key for part in policy.layout.images} == {"rgb", "depth"}
    assert {part.key for part in policy.layout.state} == {"end_effector_position", "gripper"}


def test_moving_the_hidden_box_changes_nothing_but_the_image(box):
    policy, env = load_policy(box), make_env(config_of(box, ANYWHERE))
    observation, _ = env.reset(seed=1)
    before = policy.layout.read_one(observation)
    cell, inner = env.unwrapped.cell, env.unwrapped
    elsewhere = cell.object_position(0) + [0.06, -0.05, 0.0]
    move(cell, 0, elsewhere)
    inner._seen.read()
    info = inner._info(None)
    seen = {**info, **inner._seen.observation(info)}
    assert seen["object_position"] == pytest.approx(elsewhere), "the simulator knows"
    after = policy.layout.read_one(seen)
    assert torch.equal(before.state, after.state)
    assert all(not torch.equal(a, b) for a, b in zip(before.images, after.images))
    env.close()


@pytest.mark.parametrize(
    ("seen", "images"),
    [(["state", "reachable"], 0), (["depth", "gripper"], 3)],
)
def test_in_a_cell_a_policy_observes_what_it_did_in_training(tmp_path, config, seen, images):
    """Whatever env.observations says; a cell renders no image that the policy does not see."""
    trained = load_config(
        None,
        [*ANYWHERE, "env.observations=[state]", f"rl.policy_observations=[{','.join(seen)}]",
         "rl.privileged_observations=[grasped]", "env.max_steps=2", "env.hold_seconds=0"],
    )  # fmt: skip
    env = make_env(trained)
    make_ppo(env.observation_space, env.action_space, trained).save(tmp_path / "new.pt", trained)
    env.close()
    observed = []
    with make_cell(config) as cell:
        approach = learned_approach(f"ppo:{tmp_path / 'new.pt'}", cell)
        policy = approach.policy
        approach.policy = lambda observation: observed.append(observation) or policy(observation)
        objects = load_object_set("box", cache_dir=config.cache_folder)
        cell.load(make_scene("isolated", objects, 0, config))
        assert execute_grasp(cell, placeholder(None)[0], approach).reason == "stopped"
        assert cell.observations == images, "at the start and after each of two actions"
    own = {name: env.observation_space[name] for name in seen}
    assert [set(one) for one in observed] == [set(seen)] * 2
    assert all(own[name].contains(value) for one in observed for name, value in one.items())


@needs_pybullet
def test_the_policy_grasps_for_the_judge_of_planned_grasps(box, config):
    """In the cell of evaluate.py, whose own camera hangs overhead."""
    policy = load_policy(box)
    objects = load_object_set("box", cache_dir=config.cache_folder, **config.objects.model_dump())
    with make_cell(config) as cell:
        approach = PolicyApproach(cell, policy, policy.config, policy.observations)
        outcomes = []
        for seed in range(3):
            cell.load(make_scene("isolated", objects, seed, config))
            (grasp,) = placeholder(cell.frame())
            place = cell.object_position(0)
            outcomes.append(execute_grasp(cell, grasp, approach))
            assert np.linalg.norm(approach.closed_at.position - place) < 0.06
        assert sum(outcome.success for outcome in outcomes) >= 2


def test_a_policy_that_grips_nothing_is_stopped(box, config):
    policy = load_policy(box)
    objects = load_object_set("box", cache_dir=config.cache_folder, **config.objects.model_dump())
    with make_cell(config) as cell:
        approach = PolicyApproach(cell, lambda observation: np.zeros(5), policy.config, ["state"])
        cell.load(make_scene("isolated", objects, 0, config))
        outcome = execute_grasp(cell, placeholder(cell.frame())[0], approach)
        assert (outcome.reason, approach.closed_at) == ("stopped", None)
        assert "gripped nothing" in outcome.detail
        assert np.abs(cell.robot.q - cell.home).max() < 0.02, "home again"


def test_a_grip_at_the_last_action_counts(box, config, monkeypatch):
    """Even of fingers that still move, by 3 mm an action here: the judge finds out what they
    hold. The motor is said to press, though there is nothing."""
    policy = load_policy(box)
    objects = load_object_set("box", cache_dir=config.cache_folder, **config.objects.model_dump())
    with make_cell(config) as cell:
        trained = policy.config | {"env": policy.config["env"] | {"max_steps": 12}}
        approach = PolicyApproach(
            cell, lambda observation: np.array([0, 0, 1.0, 0, -0.15]), trained, ["state"]
        )
        cell.load(make_scene("isolated", objects, 0, config))
        monkeypatch.setattr(cell.robot, "grips", lambda: cell.robot.encoder_pose()[2, 3] < 0.2)
        assert execute_grasp(cell, placeholder(cell.frame())[0], approach).reason == "missed"
        assert approach.closed_at is not None and 0.01 < approach.closed_at.width < 0.08


def recorded(decoder: ActionDecoder) -> list[np.ndarray]:
    """The actions that reach the decoder from now on."""
    sent, command = [], decoder.command
    decoder.command = lambda action, state: (sent.append(action.copy()), command(action, state))
    return sent


def driven(cell, actions, seed=0):
    """The actions that reach the hand when a policy plays `actions` whatever it observes, and the
    joint positions at the end."""
    objects = load_object_set("box", cache_dir=cell.config.cache_folder)
    trained = {
        "env": cell.config.env.model_dump() | {"control": "ee_planar"},
        "camera": cell.config.camera.model_dump(),
    }
    trained["env"]["max_steps"] = len(actions)
    left = iter(actions)
    approach = PolicyApproach(cell, lambda observation: next(left), trained, ["state"])
    sent = recorded(approach.env._actions)
    cell.load(make_scene("isolated", objects, seed, cell.config))
    execute_grasp(cell, placeholder(None)[0], approach)
    return np.array(sent), cell.robot.q


def randomised(*changes):
    """A cell of evaluate.py in which `changes` alone are randomised."""
    still = [
        f"randomization.physics.{name}={'1,1' if spec.operation == 'scale' else '0,0'},uniform,"
        f"{'scale' if spec.operation == 'scale' else 'add'},episode"
        for name, spec in load_config().randomization.physics
    ]
    return make_cell(
        load_config(None, ["sim.renderer=tiny", "evaluate.randomise=true",
                           "randomization.parts=physics", *still, *changes])
    )  # fmt: skip


BIAS, NOISE = (f"randomization.physics.action_{name}=" for name in ("bias", "noise"))
ACTIONS = np.random.default_rng(0).uniform(-0.6, 0.6, (12, 5))


def test_an_evaluated_policy_s_actions_get_the_bias_and_noise_of_the_sample():
    """Action + bias + noise by hand: NumPy's normal numbers of (the sample's seed, 3, turn)."""
    with randomised(
        BIAS + "0.1,0.1,uniform,set,episode", NOISE + "0.05,0.05,uniform,set,episode"
    ) as cell:
        sent, q = driven(cell, ACTIONS)
        seed = cell.sample["seed"]
        noise = [np.random.default_rng([seed, 3, turn]).standard_normal(5) for turn in range(12)]
        np.testing.assert_allclose(sent, ACTIONS + 0.1 + 0.05 * np.array(noise), atol=1e-12)
        again, q_again = driven(cell, ACTIONS)
        other, _ = driven(cell, ACTIONS, seed=1)
    assert sent.tolist() == again.tolist() and q.tolist() == q_again.tolist(), "bit for bit"
    assert not np.allclose(sent, other), "another scene, another noise"


def test_without_noise_an_evaluated_policy_s_actions_are_its_own(config):
    with randomised() as cell, make_cell(config) as plain:
        sent, q = driven(cell, ACTIONS)
        assert cell.on_action is not None and plain.on_action is None
        expected, q_plain = driven(plain, ACTIONS)
    assert sent.tolist() == expected.tolist() == ACTIONS.tolist() and q.tolist() == q_plain.tolist()


def test_randomised_actions_are_those_of_the_environment():
    """What evaluate.py does to a policy's actions is what training did to them."""
    changes = [NOISE + "0.05,0.05,uniform,set,episode", "env.max_steps=12"]
    with randomised(*changes) as cell:
        sent, _ = driven(cell, ACTIONS)
        config, seed = cell.config, cell.sample["seed"]
    settings = {"config": config, "control": "ee_planar", "observations": ("state",)}
    env = gymnasium.make("RandomizedGrasping-v0", **settings).unwrapped
    _, info = env.reset(options={"scene_seed": 0})
    env.reset(options={"scene_seed": 0, "randomization": info["randomization"] | {"seed": seed}})
    reached, command = [], env._actions.command
    env._actions.command = lambda action, state: (
        reached.append(action.copy()),
        command(action, state),
    )
    for action in ACTIONS:
        env.step(action)
    env.close()
    assert np.array(reached).tolist() == sent.tolist()


def test_objects_that_a_policy_was_not_trained_on_are_named():
    sets = ["box", "primitives", "path/to/mine"]
    assert (
        foreign_objects("ppo", sets)
        == "ppo was trained on box, and not on primitives, path/to/mine; "
        "ppo:checkpoints/ppo_primitives.pt was"
    )
    assert foreign_objects("ppo", ["primitives", "random_urdfs"]).endswith(
        "; ppo:checkpoints/ppo_primitives.pt, ppo:checkpoints/ppo_random_urdfs.pt were"
    )
    assert foreign_objects("ppo", ["path/to/mine"]).endswith("not on path/to/mine")
    assert foreign_objects("ppo", ["box"]) == ""
