"""Small trainings of PPO: settings, rollouts and minibatches of one that counts steps."""

from __future__ import annotations

import gymnasium
import numpy as np
import torch
from gymnasium import spaces

from envs.vector_env import finished
from models.grasp_policy import (
    GraspPPO,
    policy_for,
)
from models.ppo import Batch
from models.ppo_observations import (
    ObservationLayout,
    Observations,
)
from models.ppo_rollouts import (
    Rollout,
)
from utils.config import load_config
from utils.distributed import ALONE


def settings_of(*overrides: str):
    small = ["rl.hidden_dim=16", "rl.image_feature_dim=8", "rl.conv_channels=[4,4]",
             "rl.envs=4", "rl.rollout_steps=16", "rl.batch_size=16", "rl.epochs=2"]  # fmt: skip
    return load_config(None, [*small, *overrides]).rl


class Count(gymnasium.Env):
    """Its observation counts the steps of the episode, and it says so by its reward: an episode is
    truncated or terminated after `length` steps."""

    def __init__(self, length: int, terminates: bool):
        self.length, self.terminates = length, terminates

    def reset(self, *, seed=None, options=None):
        self.count = np.zeros(1, np.float32)
        return self.count, {}

    def step(self, action):
        self.count += 1  # in place, as an environment may do
        ends = bool(self.count[0] >= self.length)
        info = {"is_success": ends and self.terminates}
        return (
            self.count, float(self.count[0]), ends and self.terminates,
            ends and not self.terminates, info,
        )  # fmt: skip


class Several:
    """Environments of this process."""

    def __init__(self, *envs: gymnasium.Env):
        self.envs, self.num_envs = envs, len(envs)

    def each(self, task):
        return [finished(task(env, index)) for index, env in enumerate(self.envs)]


def counting() -> Several:
    """Two environments: the first is truncated after 3 steps, the second terminated after 4."""
    return Several(Count(3, False), Count(4, True))


COUNTED = ObservationLayout.of(spaces.Box(-np.inf, np.inf, (1,)))


def ppo_of(
    *overrides: str, layout=COUNTED, actions: int = 1, seed: int = 0, team=ALONE
) -> GraspPPO:
    torch.manual_seed(seed)
    space = spaces.Box(-1.0, 1.0, (actions,), np.float32)
    settings = settings_of(*overrides)
    ppo = GraspPPO(policy_for(layout, space, settings), layout, settings, team)
    ppo.generator.manual_seed(seed)
    return ppo


def batch_of(size: int, actions: int = 1, seed: int = 0) -> Batch:
    rng = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=rng)

    return Batch(
        Observations((), normal(size, 1), torch.empty(size, 0)), normal(size, actions),
        normal(size) - 2, 3 * normal(size) + 1, normal(size),
    )  # fmt: skip


def rollout_of(ppo: GraspPPO, steps: int = 16, seed: int = 0) -> Rollout:
    """A made-up rollout of four environments with the actions of the policy."""
    rng = np.random.default_rng(seed)
    state = torch.from_numpy(rng.normal(2, 3, (steps + 1, 4, 1)).astype(np.float32))
    noise = torch.from_numpy(rng.normal(size=(steps, 4, 1)).astype(np.float32))
    seen = Observations((), state[:-1], torch.empty(steps, 4, 0))
    with torch.no_grad():
        latents = ppo.network(None, seen.state.flatten(0, 1)).sample(noise.flatten(0, 1))
    return Rollout(
        seen, Observations((), state[-1], torch.empty(4, 0)), latents.view(steps, 4, 1),
        rng.normal(size=(steps, 4)), rng.random((steps, 4)) < 0.1, np.zeros((steps, 4), bool),
        [], COUNTED.empty(0), [],
    )  # fmt: skip
