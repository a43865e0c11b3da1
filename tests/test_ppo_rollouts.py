"""Rollouts, evaluations and the memory of steps, on an environment that counts."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from models.ppo_observations import (
    Observations,
)
from models.ppo_rollouts import (
    NotFinite,
    RolloutCollector,
    StepMemory,
    derived_seeds,
    evaluate_policy,
)
from tests.helpers.ppo_parts import (
    COUNTED,
    Count,
    Several,
    counting,
    ppo_of,
)
from utils.errors import UserError
from utils.runs import Stopwatch


def test_a_rollout_keeps_final_observations():
    ppo = ppo_of()
    collector = RolloutCollector(counting(), COUNTED, 5, Stopwatch())
    collector.restart([0, 1])
    rollout = collector.collect(ppo.network, ppo.generator)
    assert rollout.observations.state[..., 0].T.tolist() == [[0, 1, 2, 0, 1], [0, 1, 2, 3, 0]]
    assert rollout.last.state[:, 0].tolist() == [2, 1]
    assert rollout.rewards.T.tolist() == [[1, 2, 3, 1, 2], [1, 2, 3, 4, 1]]
    assert rollout.cut == [(2, 0)] and rollout.cut_final.state.tolist() == [[3]]
    assert [tuple(episode[:3]) for episode in rollout.episodes] == [(6, 3, False), (10, 4, True)]
    going_on = collector.collect(ppo.network, ppo.generator)
    assert going_on.observations.state[0, :, 0].tolist() == [2, 1]
    assert going_on.episodes[0].total == 6


def test_each_environment_explores_with_noise_of_its_own():
    """The first action of each: its mean and its own column of a generator's draws."""
    ppo = ppo_of("rl.normalise_observations=false")
    collector = RolloutCollector(counting(), COUNTED, 5, Stopwatch())
    collector.restart([0, 1])
    rollout = collector.collect(ppo.network, torch.Generator().manual_seed(3))
    noise = torch.randn((5, 2, 1), generator=torch.Generator().manual_seed(3))
    with torch.no_grad():
        mean = ppo.network(None, rollout.observations.state.flatten(0, 1)).mean.reshape(5, 2, 1)
    expected = mean + ppo.network.log_std.detach().exp() * noise
    torch.testing.assert_close(rollout.latents, expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("bad", ["observation", "reward"])
def test_numbers_that_are_not_finite_are_refused(bad):
    class Broken(Count):
        def step(self, action):
            observation, reward, *rest = super().step(action)
            if observation == 2:
                observation[:], reward = (
                    (np.nan, reward) if bad == "observation" else (observation, np.nan)
                )
            return observation, reward, *rest

    ppo = ppo_of()
    envs = Several(Count(3, False), Broken(4, True))
    collector = RolloutCollector(envs, COUNTED, 5, Stopwatch())
    collector.restart([0, 1])
    with pytest.raises(NotFinite, match=f"{bad}.*of environment 1 .*step 102"):
        collector.collect(ppo.network, ppo.generator, first_step=100)


@pytest.mark.parametrize("bad", ["observation", "reward"])
def test_numbers_of_an_evaluation_that_are_not_finite_are_refused(bad):
    class Broken(Count):
        def step(self, action):
            observation, reward, *rest = super().step(action)
            if bad == "observation":
                observation[:] = np.nan
            return observation, np.inf if bad == "reward" else reward, *rest

    envs = Several(Broken(3, True))
    with pytest.raises(NotFinite, match=f"{bad}.* in an evaluation, of the episode with seed 7"):
        evaluate_policy(ppo_of().network, envs, COUNTED, [7], Stopwatch())


def test_an_evaluation_does_not_wait_for_an_episode_without_an_end(monkeypatch):
    monkeypatch.setattr("models.ppo_rollouts.LONGEST_EPISODE", 20)
    evaluate_policy(ppo_of().network, Several(Count(20, False)), COUNTED, [7], Stopwatch())
    with pytest.raises(UserError, match="not ended in 20 steps.*max_episode_steps"):
        evaluate_policy(ppo_of().network, Several(Count(21, False)), COUNTED, [7], Stopwatch())


def test_evaluation_gives_each_seed_its_episode():
    class Seeded(Count):
        """The reward is the seed, the length differs between environments."""

        def reset(self, *, seed=None, options=None):
            self.seed = seed
            return super().reset()

        def step(self, action):
            observation, _, *rest = super().step(action)
            return observation, self.seed, *rest

    envs = Several(Seeded(3, False), Seeded(4, True))
    seeds = [10, 20, 30, 40, 50]
    episodes = evaluate_policy(ppo_of().network, envs, COUNTED, seeds, Stopwatch())
    assert [e.total / e.length for e in episodes] == [10, 20, 30, 40, 50]


def test_an_evaluation_in_slices_of_one_step_is_the_same(monkeypatch):
    ppo, seeds = ppo_of(), [10, 20, 30, 40, 50]
    whole = evaluate_policy(ppo.network, counting(), COUNTED, seeds, Stopwatch())
    monkeypatch.setattr("models.ppo_rollouts.SLICE_SECONDS", 0.0)
    told = []
    sliced = evaluate_policy(
        ppo.network, counting(), COUNTED, seeds, Stopwatch(), lambda n: told.append(n) or True
    )
    assert [episode.length for episode in whole] == [3, 4, 3, 4, 3]
    assert sliced == whole
    assert told == [0, 0, 0, 1, 2, 2, 3, 3, 4], "before each step: episodes end at 3, 6, 9; 4, 8"


def test_an_evaluation_is_broken_off_between_two_slices(monkeypatch):
    monkeypatch.setattr("models.ppo_rollouts.SLICE_SECONDS", 0.0)
    envs = counting()
    episodes = evaluate_policy(
        ppo_of().network, envs, COUNTED, [10, 20, 30, 40], Stopwatch(), lambda n: n == 0
    )
    assert episodes == [] and [int(env.count[0]) for env in envs.envs] == [3, 3]


def test_derived_seeds_are_unrelated_and_repeatable():
    assert derived_seeds(3, 1, 2) == derived_seeds(3, 1, 2)
    places = [(0, 0), (0, 1), (1, 0), (0, 0, 1)]
    assert len({seed for place in places for seed in derived_seeds(50, *place)}) == 200


def test_the_memory_holds_the_latest_steps():
    memory, generator = StepMemory(5), torch.Generator().manual_seed(0)

    def steps(*numbers: float) -> Observations:
        column = torch.tensor(numbers)[:, None]
        return Observations((column[:, None, None].byte(),), column, -column)

    for part in (steps(0, 1, 2), steps(3, 4, 5, 6)):
        memory.add(part)
    drawn = memory.draw(200, generator)
    assert len(memory) == 5 and set(drawn.state.flatten().tolist()) == {2, 3, 4, 5, 6}
    assert torch.equal(drawn.images[0].flatten().float(), drawn.state.flatten())
    assert torch.equal(drawn.privileged, -drawn.state)
    memory.add(steps(*range(10, 20)))
    assert set(memory.draw(200, generator).state.flatten().tolist()) == set(range(15, 20))
    memory.clear()
    memory.add(steps(7))
    assert memory.draw(3, generator).state.flatten().tolist() == [7, 7, 7]
    none = StepMemory(0)
    none.add(steps(1, 2))
    assert not none
