"""Pretraining of the state estimator, before PPO begins.

The environments show states that episodes may reach; no policy plays. From each image the network
learns to estimate the observations of `rl.estimated_observations`, which only a simulator knows.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from functools import partial
from typing import TYPE_CHECKING

import gymnasium
from tqdm import tqdm

from models.ppo_observations import ObservationLayout, Observations
from models.ppo_rollouts import (
    NETWORK,
    PRETRAINING,
    SIMULATION,
    Envs,
    NotFinite,
    beside,
    derived_seeds,
)
from utils.runs import Stopwatch

if TYPE_CHECKING:
    from models.ppo import GraspPPO
    from models.ppo_progress import Curves

IMAGES = 32  # that each environment shows before the estimator learns from them: two scenes


def pretrain_estimator(
    ppo: GraspPPO, envs: Envs, images: int, seed: int, watch: Stopwatch, curves: Curves
) -> None:
    """Teach the estimator from at least `images` images of the environments of all processes.

    The curve is the loss on images that the estimator has not learned from yet. The learning rate
    falls in a line from rl.pretraining_lr to 0.
    """
    team, settings = ppo.team, ppo.settings
    per_chunk = settings.envs * IMAGES
    chunks = -(-images // per_chunk)
    seeds: Sequence[int | None] = derived_seeds(envs.num_envs, seed, PRETRAINING, team.rank)
    ppo.generator.manual_seed(derived_seeds(1, seed, PRETRAINING, team.rank)[0])
    with tqdm(total=chunks * per_chunk, unit="image", disable=not team.is_main) as bar:
        for chunk in range(chunks):
            with watch(SIMULATION):
                columns = envs.each(partial(show, layout=ppo.layout, count=IMAGES, seeds=seeds))
                shown = beside(columns).map(lambda part: part.flatten(0, 1).to(team.device))
            with watch(NETWORK):
                ppo.network.observe(shown, team)
                loss = ppo.estimate_loss(shown)
                ppo.update_estimator(shown, settings.pretraining_lr * (1 - chunk / chunks))
            seeds = [None] * envs.num_envs
            bar.update(per_chunk)
            bar.set_postfix(loss=f"{loss:.3g}")
            # Steps up to 0, so that a resumed run keeps the curve.
            curves.add("pretraining", (chunk + 1 - chunks) * per_chunk, {"estimate_loss": loss})
    ppo.memory.clear()


def show(
    env: gymnasium.Env, index: int, layout: ObservationLayout, count: int,
    seeds: Sequence[int | None],
) -> Generator[None, None, Observations]:  # fmt: skip
    """A task of `Envs.each`: (count, ...) the first observations of `count` episodes; the first
    episode begins from this environment's seed. Raises NotFinite."""
    shown = layout.empty(count)
    for number in range(count):
        observation, _ = env.reset(seed=seeds[index] if number == 0 else None)
        yield
        bad = layout.bad_number(observation)
        if bad is not None:
            raise NotFinite(f"the observation {bad!r} of environment {index} is not finite")
        layout.write(observation, shown.rows(slice(number, number + 1)))
    return shown
