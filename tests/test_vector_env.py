"""The environments of a training: their observations, and how their episodes begin."""

from __future__ import annotations

import numpy as np

from envs.vector_env import training_envs
from models.grasp_policy import make_ppo
from tests.helpers.quick_envs import POINT
from utils.config import load_config


def test_evaluations_are_at_full_difficulty():
    seen = "rl.policy_observations=[state,end_effector_position]"
    settings = ["rl.parallel=false", "env.near_share=1", "env.observations=[state]", seen]
    config = load_config(None, settings)
    with training_envs(config, 2) as envs:
        training = envs.restart([1, 2])["end_effector_position"][:, 2].copy()
        with envs.at_full_difficulty():
            evaluated = envs.restart([1, 2])["end_effector_position"][:, 2].copy()
            again = envs.restart([1, 2], np.array([True, True]))["end_effector_position"][:, 2]
            assert again.tolist() == evaluated.tolist()
        after = envs.restart([1, 2])["end_effector_position"][:, 2]
    assert max(training) < 0.2 < 0.4 < min(evaluated) and after.tolist() == training.tolist()


def test_env_kwargs_and_info_reach_the_environment():
    config = load_config(None, [*POINT, "rl.env_kwargs=images=true",
                                "rl.policy_observations=rgb,state",
                                "rl.privileged_observations=goal"])  # fmt: skip
    with training_envs(config, 2) as envs:
        layout = make_ppo(envs.observation_space, envs.action_space, config).layout
        observation = envs.restart([3, 4])
    assert [part.key for part in (*layout.images, *layout.state)] == ["rgb", "state"]
    assert [(part.key, part.shape) for part in layout.privileged] == [("goal", (2,))]
    rng = np.random.default_rng(3)  # Gymnasium seeds its environments' generators like this
    np.testing.assert_allclose(observation["goal"][0], rng.uniform(-1, 1, 2), rtol=1e-6)
