"""Stepping many environments with a policy: rollouts to learn from, and deterministic evaluation.

`VectorEnvs` is the interface of the environments; this module makes none. `RolloutCollector`
collects rollouts, `evaluate_policy` plays whole episodes, `StepMemory` keeps past steps for the
state estimator.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch

from models.ppo_observations import ObservationLayout, Observations
from utils.errors import UserError
from utils.runs import Stopwatch

SIMULATION, NETWORK = "simulation", "network"  # parts of the time that the stopwatch separates
# Purposes of seeds (`derived_seeds`), no two of which share a seed: FRESH scores a trained policy.
TRAINING, EVALUATION, LEARNING, FRESH, PRETRAINING = range(5)
SUCCESS = "is_success"  # entry of an environment's info, by Gymnasium's convention for robots


class VectorEnvs(Protocol):
    """N environments stepped together, which never reset on their own."""

    num_envs: int

    def restart(self, seeds: Sequence[int | None], which: np.ndarray | None = None) -> Any:
        """Begin new episodes, in all or in those where `which` (N,) is true; returns observations
        of all. A seed of None goes on with the environment's own random numbers."""

    def step(
        self, actions: np.ndarray
    ) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Gymnasium's (observations, rewards, terminated, truncated, infos); the observations are
        those after the step also where an episode ended with it. They may be overwritten by the
        next call."""


class NotFinite(UserError):
    """An environment or an update produced NaN or infinity; no weight has been changed by it."""


class Episode(NamedTuple):
    """total: undiscounted sum of rewards. success: None where the environment does not say."""

    total: float
    length: int
    success: bool | None


@dataclass
class Rollout:
    """T steps of N environments.

    observations: (T, N, ...) before each step; last: (N, ...) after the last one. latents: (T, N,
    A). rewards, terminated, truncated: (T, N). cut: (C, 2) index of the truncated steps, cut_final:
    (C, ...) the observations after them. episodes: those that ended.
    """

    observations: Observations
    last: Observations
    latents: torch.Tensor
    rewards: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    cut: list[tuple[int, int]]
    cut_final: Observations
    episodes: list[Episode]


class RolloutCollector:
    """Collects rollouts of `steps` steps of each environment; each rollout continues the one before
    it."""

    def __init__(
        self, envs: VectorEnvs, layout: ObservationLayout, steps: int, device: torch.device,
        watch: Stopwatch,
    ):  # fmt: skip
        self.envs, self.layout, self.steps = envs, layout, steps
        self.device, self.watch = device, watch
        self._tally = Tally(envs.num_envs)

    def restart(self, seeds: Sequence[int]) -> None:
        """Begin new episodes in all environments; those under way do not count."""
        with self.watch(SIMULATION):
            self._observation = self.envs.restart(seeds)
        self._tally = Tally(self.envs.num_envs)

    def collect(self, network, generator: torch.Generator, first_step: int = 0) -> Rollout:
        """A rollout with actions drawn from the policy.

        first_step: how many environment steps have gone before, for messages.
        Raises NotFinite on an observation or a reward that is no number.
        """
        steps, envs = self.steps, self.envs.num_envs
        noise = torch.randn(steps, envs, len(network.log_std), generator=generator)
        seen, latents = self.layout.empty(steps, envs), torch.empty_like(noise)
        rewards = np.empty((steps, envs))
        terminated, truncated = np.empty((2, steps, envs), bool)
        cut, cut_final, episodes = [], [], []
        for t in range(steps):
            now = seen.map(lambda part: part[t])  # noqa: B023, used at once
            self._read(now, first_step + t * envs)
            with self.watch(NETWORK):
                latents[t] = act(network, now, noise[t], self.device)
                actions = network.action(latents[t].to(self.device)).cpu().numpy()
            with self.watch(SIMULATION):
                step = self.envs.step(actions)
            self._observation, rewards[t], terminated[t], truncated[t], infos = step
            if not np.isfinite(rewards[t]).all():
                env = int(np.flatnonzero(~np.isfinite(rewards[t]))[0])
                raise self._not_finite("reward", env, first_step + t * envs)
            ended = terminated[t] | truncated[t]
            episodes += self._tally.add(rewards[t], ended, infos)
            if ended.any():
                timeouts = np.flatnonzero(truncated[t] & ~terminated[t])
                if len(timeouts):  # before the reset overwrites what they are to be judged by
                    after = self.layout.empty(envs)
                    self._read(after, first_step + t * envs)
                    cut += [(t, int(env)) for env in timeouts]
                    cut_final.append(after.map(lambda part: part[timeouts]))  # noqa: B023
                with self.watch(SIMULATION):
                    self._observation = self.envs.restart([None] * envs, ended)
        last = self.layout.empty(envs)
        self._read(last, first_step + steps * envs)
        return Rollout(
            seen, last, latents, rewards, terminated, truncated, cut,
            joined(cut_final) if cut else self.layout.empty(0), episodes,
        )  # fmt: skip

    def _read(self, room: Observations, step: int) -> None:
        bad = self.layout.bad_number(self._observation)
        if bad is not None:
            raise self._not_finite(f"observation {bad[0]!r}", bad[1], step)
        self.layout.write(self._observation, room)

    def _not_finite(self, what: str, env: int, step: int) -> NotFinite:
        return NotFinite(f"the {what} of environment {env} is not finite at step {step}")


def act(
    network, seen: Observations, noise: torch.Tensor | None, device: torch.device
) -> torch.Tensor:
    """(N, A) latents for observations (N, ...), on the CPU; the policy's mean without noise."""
    with torch.inference_mode():
        if device.type != "cpu":
            seen = seen.map(lambda part: part.to(device))
            noise = None if noise is None else noise.to(device)
        distribution = network(seen.image(), seen.state)
        latent = distribution.mean if noise is None else distribution.sample(noise)
        return latent.cpu()


def joined(parts: Sequence[Observations]) -> Observations:
    """Batches (B, ...) as one."""
    return Observations(
        tuple(torch.cat(images) for images in zip(*(part.images for part in parts))),
        torch.cat([part.state for part in parts]),
        torch.cat([part.privileged for part in parts]),
    )


class Tally:
    """Return and length of the episode under way in each of n environments."""

    def __init__(self, n: int):
        self._totals, self._lengths = np.zeros(n), np.zeros(n, int)

    def add(self, rewards: np.ndarray, ended: np.ndarray, infos: dict[str, Any]) -> list[Episode]:
        """Count a step; the episodes that ended with it, in the order of the environments."""
        self._totals += rewards
        self._lengths += 1
        if not ended.any():
            return []
        reported = infos.get(f"_{SUCCESS}", np.zeros(len(ended), bool))
        done = [
            Episode(
                float(self._totals[i]),
                int(self._lengths[i]),
                bool(infos[SUCCESS][i]) if reported[i] else None,
            )
            for i in np.flatnonzero(ended)
        ]
        self._totals[ended] = 0
        self._lengths[ended] = 0
        return done


def evaluate_policy(
    network, envs: VectorEnvs, layout: ObservationLayout, seeds: Sequence[int],
    device: torch.device, watch: Stopwatch,
) -> list[Episode]:  # fmt: skip
    """Deterministic episodes, one from each seed and in that order, whatever the number of
    environments. Episodes under way are dropped: restart all environments afterwards."""
    count = envs.num_envs
    episodes: list[Episode | None] = [None] * len(seeds)
    at = np.arange(count)  # index of each environment's seed; beyond the last seed it idles
    tally, room = Tally(count), layout.empty(count)

    def seed(env: int) -> int:
        return int(seeds[at[env]] if at[env] < len(seeds) else seeds[-1])

    with watch(SIMULATION):
        observation = envs.restart([seed(env) for env in range(count)])
    waiting = len(seeds)
    while waiting:
        bad = layout.bad_number(observation)
        if bad is not None:
            raise NotFinite(
                f"in an evaluation, the observation {bad[0]!r} of the episode with seed "
                f"{seed(bad[1])} is not finite"
            )
        layout.write(observation, room)
        with watch(NETWORK):
            latents = act(network, room, None, device)
            actions = network.action(latents.to(device)).cpu().numpy()
        with watch(SIMULATION):
            observation, rewards, terminated, truncated, infos = envs.step(actions)
        ended = terminated | truncated
        for env, episode in zip(np.flatnonzero(ended), tally.add(rewards, ended, infos)):
            if at[env] < len(seeds):
                episodes[at[env]] = episode
                waiting -= 1
            at[env] = max(at) + 1
        if ended.any() and waiting:
            with watch(SIMULATION):
                observation = envs.restart([seed(env) for env in range(count)], ended)
    return episodes


def derived_seeds(count: int, *place: int) -> list[int]:
    """`count` seeds for a place such as (run's seed, purpose, rank, update), unrelated to those of
    any other place."""
    return np.random.SeedSequence(place).generate_state(count).tolist()


class StepMemory:
    """The last `size` steps that were observed; new steps replace the oldest."""

    def __init__(self, size: int):
        self.size = size
        self.clear()

    def __len__(self) -> int:
        return self._held

    def clear(self) -> None:
        """Forget all steps."""
        self._room: Observations | None = None
        self._held = self._next = 0

    def add(self, steps: Observations) -> None:
        """Remember steps (B, ...); of more than `size` the last ones."""
        count = min(len(steps.state), self.size)
        if count == 0:
            return
        steps = steps.rows(slice(len(steps.state) - count, None))
        if self._room is None:
            self._room = steps.map(lambda part: part.new_empty(self.size, *part.shape[1:]))
        places = (torch.arange(count, device=steps.state.device) + self._next) % self.size
        for rooms, parts in ((self._room.images, steps.images), (self._room[1:], steps[1:])):
            for room, part in zip(rooms, parts):
                room[places] = part
        self._next = (self._next + count) % self.size
        self._held = min(self._held + count, self.size)

    def draw(self, count: int, generator: torch.Generator) -> Observations:
        """Steps (count, ...) drawn with repetition from those held, of which there must be some."""
        index = torch.randint(self._held, (count,), generator=generator)
        return self._room.map(lambda part: part[index.to(part.device)])
