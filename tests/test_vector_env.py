"""The environments of a training: their observations, and how their episodes begin."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time

import numpy as np
import pytest

from envs import vector_env
from envs.vector_env import make_env, make_objects, start_method, training_envs
from models.grasp_policy import make_ppo
from tests.helpers.object_files import box_moments, urdf_box, urdf_inertia
from tests.helpers.quick_envs import POINT
from utils.config import load_config
from utils.errors import UserError


def first_observation(env, index):
    observation, _ = env.reset(seed=index + 1)
    yield
    return observation


def height_at_reset(env, index):
    observation = yield from first_observation(env, index)
    return float(observation["end_effector_position"][2])


def test_evaluations_are_at_full_difficulty():
    seen = "rl.policy_observations=[state,end_effector_position]"
    settings = ["rl.parallel=false", "env.near_share=1", "env.observations=[state]", seen]
    config = load_config(None, settings)
    with training_envs(config, 2) as envs:
        training = envs.each(height_at_reset)
        with envs.at_full_difficulty():
            evaluated = envs.each(height_at_reset)
            assert envs.each(height_at_reset) == evaluated
        after = envs.each(height_at_reset)
    assert max(training) < 0.2 < 0.4 < min(evaluated) and after == training


def test_env_kwargs_and_info_reach_the_environment():
    config = load_config(None, [*POINT, "rl.env_kwargs=images=true",
                                "rl.policy_observations=rgb,state",
                                "rl.privileged_observations=goal"])  # fmt: skip
    with training_envs(config, 2) as envs:
        layout = make_ppo(envs.observation_space, envs.action_space, config).layout
        first, _ = envs.each(first_observation)
    assert [part.key for part in (*layout.images, *layout.state)] == ["rgb", "state"]
    assert [(part.key, part.shape) for part in layout.privileged] == [("goal", (2,))]
    rng = np.random.default_rng(1)  # Gymnasium seeds its environments' generators like this
    np.testing.assert_allclose(first["goal"], rng.uniform(-1, 1, 2), rtol=1e-6)


def test_the_critic_alone_can_see_the_state():
    config = load_config(None, ["rl.parallel=false", "env.observations=[rgb]",
                                "rl.policy_observations=[gripper]",
                                "rl.privileged_observations=[state]"])  # fmt: skip
    with training_envs(config, 1) as envs:
        layout = make_ppo(envs.observation_space, envs.action_space, config).layout
        (first,) = envs.each(first_observation)
    assert [part.key for part in layout.state] == ["gripper"]
    assert [(part.key, part.shape) for part in layout.privileged] == [("state", (15,))]
    assert first["state"][14] == first["gripper"][0]


@pytest.mark.parametrize("other", ["RobotGrasping", "envs:RobotGrasping-v0"])
def test_the_own_environment_by_another_name_is_refused(other):
    """Gymnasium knows it by these, too, but it would be made without the config."""
    said = f"rl.env_id {other}: write rl.env_id=RobotGrasping-v0, so that the config counts"
    with pytest.raises(UserError, match=said):
        make_env(load_config(None, [f"rl.env_id={other}", "env.control=joint"]))


@pytest.mark.parametrize("env_id", ["RobotGrasping-v0", "RandomizedGrasping-v0"])
def test_env_kwargs_set_no_key_of_section_env(env_id):
    """evaluate.py scores the policy by the section."""
    config = load_config(
        None, [f"rl.env_id={env_id}", "rl.env_kwargs=[position_step=0.02,max_steps=7]"]
    )
    message = "rl.env_kwargs: position_step is a key of section env; set env.position_step instead"
    with pytest.raises(UserError, match=message):
        make_env(config)


def processes_of(env, index):
    """The worker's and its parent's, after three resets that outlast the time for one answer."""
    for _ in range(3):
        env.reset(seed=index)
        time.sleep(0.02)
        yield
    return os.getpid(), os.getppid()


def sent_sigterm(env, index):
    yield
    os.kill(os.getpid(), signal.SIGTERM)
    yield
    return index


@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGTERM to ignore")
def test_workers_leave_sigterm_to_the_main_process():
    """Batch systems send it to all processes of a job."""
    config = load_config(None, [*POINT, "rl.parallel=true"])
    with training_envs(config, 2) as envs:
        assert envs.each(sent_sigterm) == [0, 1]


def broken(env, index):
    yield
    raise UserError("the table is gone")


def test_an_error_in_an_evaluation_is_told_as_it_is():
    """Its workers are gone, and cannot be set back to the resets of a training."""
    config = load_config(None, [*POINT, "rl.parallel=true"])
    with (
        pytest.raises(UserError, match="the table is gone"),
        training_envs(config, 2) as envs,
        envs.at_full_difficulty(),
    ):
        envs.each(broken)


def test_a_broken_object_is_told_of_before_the_training(tmp_path, monkeypatch):
    inertia = urdf_inertia(box_moments(0.1))
    urdf_box(tmp_path, "0.1", inertia).rename(tmp_path / "a.urdf")
    urdf_box(tmp_path, "-0.1", inertia).rename(tmp_path / "b.urdf")
    with pytest.raises(UserError, match="b.urdf.*mass"):
        make_objects(load_config(None, [f"env.objects={tmp_path}"]))
    monkeypatch.setenv("HOME", str(tmp_path.parent))
    with pytest.raises(UserError, match="b.urdf.*mass"):
        make_objects(load_config(None, [f"env.objects=~/{tmp_path.name}"]))


@pytest.mark.slow
@pytest.mark.parametrize("methods", [["fork", "spawn", "forkserver"], ["spawn"]])
def test_workers_carry_out_tasks_where_there_is_no_fork_server_too(monkeypatch, methods):
    """Windows knows `spawn` alone."""
    monkeypatch.setattr(vector_env, "ANSWERS", 2000)  # one each 10 ms
    monkeypatch.setattr(multiprocessing, "get_all_start_methods", lambda: methods)
    assert start_method() == methods[-1]
    config = load_config(None, [*POINT, "rl.parallel=true", "rl.worker_timeout=20"])
    with training_envs(config, 2) as envs:
        first = envs.each(processes_of)
        assert envs.each(processes_of) == first
    assert len({os.getpid(), *(own for own, _ in first)}) == 3
    assert all((parent == os.getpid()) == (methods[-1] == "spawn") for _, parent in first)
