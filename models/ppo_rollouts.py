"""Playing many environments with a policy: rollouts to learn from, and deterministic evaluation.

`Envs` is the interface of the environments; this module makes none. `RolloutCollector` collects
rollouts, `evaluate_policy` plays whole episodes, `StepMemory` keeps past steps for the state
estimator. Each environment is played by an actor where it lives, so that it waits for no other one
before a rollout or an evaluation has ended. What it does does not depend on the others' timing.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, Protocol

import gymnasium
import numpy as np
import torch

from models.ppo_actor import Actor, one_thread
from models.ppo_observations import ObservationLayout, Observations
from utils.errors import UserError
from utils.runs import Stopwatch

SIMULATION, NETWORK = "simulation", "network"  # parts of the time that the stopwatch separates
# Purposes of seeds (`derived_seeds`), no two of which share a seed: FRESH scores a trained policy.
TRAINING, EVALUATION, LEARNING, FRESH, PRETRAINING = range(5)
SLICE_SECONDS = 2.0  # of an evaluation, between two of which it can be broken off
LONGEST_EPISODE = 100_000  # steps of an episode in an evaluation, which would never end otherwise
SUCCESS = "is_success"  # entry of an environment's info, by Gymnasium's convention for robots

Task = Callable[[gymnasium.Env, int], Generator[None, None, Any]]


class Envs(Protocol):
    """N environments, which never reset on their own."""

    num_envs: int

    def each(self, task: Task) -> list[Any]:
        """What task(env, index) returns for each environment, in their order.

        A task is a generator that yields after every step and reset, so that one that hangs is
        noticed. It may be sent to other processes, and its result back: both can be pickled.
        """


class NotFinite(UserError):
    """An environment produced NaN or infinity; no weight has been changed by it."""


class Diverged(NotFinite):
    """A gradient is not finite; no weight has been changed by it."""


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


class Underway(NamedTuple):
    """An episode under way. seen: (1, ...) its last observation; of what has gone before, total:
    sum of rewards, length: steps."""

    seen: Observations
    total: float = 0.0
    length: int = 0


class Column(NamedTuple):
    """A rollout's steps of one environment, all without the dimension N; observations: (T + 1,
    ...), the last one too."""

    observations: Observations
    latents: np.ndarray
    rewards: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    cut: list[int]
    cut_final: Observations
    episodes: list[Episode]
    underway: Underway


class RolloutCollector:
    """Collects rollouts of `steps` steps of each environment; each rollout continues the one before
    it."""

    def __init__(self, envs: Envs, layout: ObservationLayout, steps: int, watch: Stopwatch):
        self.envs, self.layout, self.steps, self.watch = envs, layout, steps, watch

    def restart(self, seeds: Sequence[int]) -> None:
        """Begin new episodes in all environments; those under way do not count."""
        with self.watch(SIMULATION):
            self._underway = self.envs.each(partial(begin, layout=self.layout, seeds=seeds))

    def collect(self, network, generator: torch.Generator, first_step: int = 0) -> Rollout:
        """A rollout with actions drawn from the policy.

        first_step: how many environment steps have gone before, for messages.
        Raises NotFinite on an observation or a reward that is no number.
        """
        size = self.steps, self.envs.num_envs, len(network.log_std)
        noise = torch.randn(size, generator=generator).numpy()
        with self.watch(NETWORK):
            actor = Actor(network)
        task = partial(
            play, actor=actor, layout=self.layout, noise=noise, underway=self._underway,
            first_step=first_step,
        )  # fmt: skip
        with self.watch(SIMULATION), one_thread():
            columns: list[Column] = self.envs.each(task)
        self._underway = [column.underway for column in columns]
        seen = beside([column.observations for column in columns])
        return Rollout(
            seen.rows(slice(self.steps)), seen.rows(self.steps),
            torch.from_numpy(np.stack([column.latents for column in columns], 1)),
            np.stack([column.rewards for column in columns], 1),
            np.stack([column.terminated for column in columns], 1),
            np.stack([column.truncated for column in columns], 1),
            [(t, env) for env, column in enumerate(columns) for t in column.cut],
            joined([column.cut_final for column in columns]),
            [episode for column in columns for episode in column.episodes],
        )  # fmt: skip


def begin(
    env: gymnasium.Env, index: int, layout: ObservationLayout, seeds: Sequence[int]
) -> Generator[None, None, Underway]:
    """A task: begin an episode from this environment's seed."""
    observation, _ = env.reset(seed=seeds[index])
    yield
    room = layout.empty(1)
    _read(observation, layout, room, f"of environment {index} is not finite at its first step")
    return Underway(room)


def play(
    env: gymnasium.Env, index: int, actor: Actor, layout: ObservationLayout, noise: np.ndarray,
    underway: Sequence[Underway], first_step: int,
) -> Generator[None, None, Column]:  # fmt: skip
    """A task: play T steps with actions drawn by noise (T, N, A) from episodes under way."""
    steps, envs, size = noise.shape
    observations, latents = layout.empty(steps + 1), np.empty((steps, size), np.float32)
    rewards, (terminated, truncated) = np.empty(steps), np.empty((2, steps), bool)
    cut, cut_final, episodes = [], [layout.empty(0)], []
    now, total, length = underway[index]
    observations.rows(slice(1)).copy_(now)
    for t in range(steps):
        latents[t] = actor.latent(observations.rows(slice(t, t + 1)), noise[t, index])
        observation, reward, terminated[t], truncated[t], info = env.step(actor.action(latents[t]))
        yield
        place = f"of environment {index} is not finite at step {first_step + t * envs}"
        if not math.isfinite(reward):
            raise NotFinite(f"the reward {place}")
        rewards[t], total, length = reward, total + float(reward), length + 1
        after = observations.rows(slice(t + 1, t + 2))
        if truncated[t] and not terminated[t]:
            _read(observation, layout, after, place)
            cut.append(t)
            cut_final.append(after.map(torch.clone))  # before the next episode overwrites it
        if terminated[t] or truncated[t]:
            episodes.append(Episode(total, length, _success(info)))
            total, length = 0.0, 0
            observation, _ = env.reset()
            yield
        _read(observation, layout, after, place)
    last = Underway(observations.rows(slice(steps, None)).map(torch.clone), total, length)
    return Column(
        observations, latents, rewards, terminated, truncated, cut, joined(cut_final), episodes,
        last,
    )  # fmt: skip


class Share(NamedTuple):
    """What one environment has yet to play of an evaluation. seeds: of its episodes. now: that of
    the first seed, None where it has not begun."""

    seeds: Sequence[int]
    now: Underway | None = None


def evaluate_policy(
    network, envs: Envs, layout: ObservationLayout, seeds: Sequence[int], watch: Stopwatch,
    goes_on: Callable[[int], bool] | None = None,
) -> list[Episode]:  # fmt: skip
    """Deterministic episodes, one from each seed and in that order, whatever the number of
    environments. Episodes under way are dropped: restart all environments afterwards.

    goes_on: is told now and then how many episodes have been played; where it returns False, the
    evaluation is broken off and its result empty.
    """
    count = envs.num_envs
    shares = [Share(seeds[index::count]) for index in range(count)]
    played: list[list[Episode]] = [[] for _ in range(count)]
    with watch(NETWORK):
        actor = Actor(network)
    while any(len(share.seeds) for share in shares):
        if goes_on is not None and not goes_on(sum(map(len, played))):
            return []
        until = time.monotonic() + SLICE_SECONDS
        task = partial(play_episodes, actor=actor, layout=layout, shares=shares, until=until)
        with watch(SIMULATION), one_thread():
            slices = envs.each(task)
        shares = [share for _, share in slices]
        for episodes, (ended, _) in zip(played, slices):
            episodes += ended
    return [played[number % count][number // count] for number in range(len(seeds))]


def play_episodes(
    env: gymnasium.Env, index: int, actor: Actor, layout: ObservationLayout,
    shares: Sequence[Share], until: float,
) -> Generator[None, None, tuple[list[Episode], Share]]:  # fmt: skip
    """A task: play episodes without noise, one from each seed of this environment's share, until a
    time of the monotonic clock, which all processes share, but one step at least. Returns those
    that have ended, and what is left of the share. Raises NotFinite, and UserError where an
    episode does not end."""
    (seeds, now), episodes = shares[index], []
    while len(seeds):
        place = f"in an evaluation, of the episode with seed {seeds[0]}, is not finite"
        if now is None:
            observation, _ = env.reset(seed=int(seeds[0]))
            yield
            now = Underway(layout.empty(1))
            _read(observation, layout, now.seen, place)
        action = actor.action(actor.latent(now.seen))
        observation, reward, terminated, truncated, info = env.step(action)
        yield
        if not math.isfinite(reward):
            raise NotFinite(f"the reward {place}")
        total, length = now.total + float(reward), now.length + 1
        if terminated or truncated:
            episodes.append(Episode(total, length, _success(info)))
            seeds, now = seeds[1:], None
        elif length >= LONGEST_EPISODE:
            raise UserError(
                f"an episode of an evaluation has not ended in {LONGEST_EPISODE} steps; give the "
                "environment a limit (max_episode_steps where it is registered)"
            )
        else:
            _read(observation, layout, now.seen, place)
            now = Underway(now.seen, total, length)
        if time.monotonic() >= until:
            break
    return episodes, Share(seeds, now)


def _read(observation: Any, layout: ObservationLayout, room: Observations, place: str) -> None:
    """Put an observation in room (1, ...) for it, if all of its numbers are finite."""
    bad = layout.bad_number(observation)
    if bad is not None:
        raise NotFinite(f"the observation {bad!r} {place}")
    layout.write(observation, room)


def _success(info: dict[str, Any]) -> bool | None:
    return bool(info[SUCCESS]) if SUCCESS in info else None


def joined(parts: Sequence[Observations]) -> Observations:
    """Batches (B, ...) as one."""
    return _together(torch.cat, parts, 0)


def beside(columns: Sequence[Observations]) -> Observations:
    """N columns (T, ...) side by side: (T, N, ...)."""
    return _together(torch.stack, columns, 1)


def _together(function: Callable, parts: Sequence[Observations], dim: int) -> Observations:
    return Observations(
        tuple(function(images, dim) for images in zip(*(part.images for part in parts))),
        function([part.state for part in parts], dim),
        function([part.privileged for part in parts], dim),
    )


def derived_seeds(count: int, *place: int) -> list[int]:
    """`count` seeds for a place such as (run's seed, purpose, rank, update), unrelated to those of
    any other place, but for one that differs in zeros at its end (`utils.random_streams`)."""
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
