"""Train the critic of graspnet6d: python -m benchmarks.train_critic --output FILE.pt [key=value]

Draws scenes of training objects, lets the fan's search find its candidates, and fits the critic
(`models.grasp_critic`) to which of them are sound (`envs.critic_examples`). Every tenth scene is
held out; on these it prints how often the candidate that is ranked first is sound, by the search
alone and by the critic, and how far the stated chances are from frequencies. Written to
checkpoints/critic.pt, the critic is what graspnet6d ranks by from then on; its chances of success
are then fitted again (`benchmarks.calibrate`).
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch.nn import functional
from tqdm import tqdm

from envs.critic_examples import examples_of
from models.grasp_critic import KIND, GraspCritic
from utils.calibration import calibration_error
from utils.checkpoint import save_checkpoint
from utils.config import Config
from utils.errors import UserError
from utils.executor import completed, open_executor
from utils.runs import check_writable, git_state, parse_args, run_script

HELD_OUT = 10  # every tenth scene
EPOCHS, BATCH, RATE, DECAY = 40, 256, 2e-3, 1e-3


class Examples(NamedTuple):
    """Candidates of some scenes: the critic's inputs (N, K), sound (N,) bool, the search's scores
    (N,) and the number of the scene (N,)."""

    inputs: np.ndarray
    sound: np.ndarray
    score: np.ndarray
    scene: np.ndarray

    def where(self, mask: np.ndarray) -> Examples:
        return Examples(*(column[mask] for column in self))


def main(argv: Sequence[str] | None = None) -> int:
    def options(parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--output", type=Path, required=True, help="file for the weights")
        parser.add_argument("--scenes", type=int, default=800, help="how many, ten or more")

    config, chosen = parse_args(argv, "Train the critic of graspnet6d.", options)
    check_writable("--output", chosen.output)
    if chosen.scenes < HELD_OUT:
        raise UserError(f"--scenes {chosen.scenes}: give {HELD_OUT} or more, a tenth is held out")
    examples = collect(config, chosen.scenes)
    held_out = examples.scene % HELD_OUT == 0
    critic = fit(examples.where(~held_out), config.seed)
    scores = judged(critic, examples.where(held_out))
    print(
        f"{len(examples.sound)} candidates of {chosen.scenes} scenes, "
        f"{100 * examples.sound.mean():.0f} % of them sound"
    )
    print(", ".join(f"{name} {value:.3g}" for name, value in scores.items()))
    save_checkpoint(
        chosen.output, kind=KIND, model_args=critic.model_args, model=critic,
        config=config.model_dump(mode="json"),
        extra={"scores": scores, "scenes": chosen.scenes, "commit": git_state().commit},
    )  # fmt: skip
    print(f"wrote {chosen.output}")
    return 0


def collect(config: Config, scenes: int) -> Examples:
    """The candidates of so many scenes."""
    found = []
    with open_executor(config.compute, config.data.workers) as workers:
        results = completed(workers, partial(_numbered, config), range(scenes))
        for number, (inputs, sound, score) in tqdm(results, total=scenes, unit="scene"):
            found.append(Examples(inputs, sound, score, np.full(len(sound), number)))
    found.sort(key=lambda one: one.scene[:1].tolist())  # they come in any order
    return Examples(*(np.concatenate(column) for column in zip(*found)))


def _numbered(config: Config, number: int) -> tuple[int, tuple[np.ndarray, ...]]:
    return number, examples_of(config, number)


def fit(examples: Examples, seed: int) -> GraspCritic:
    """A critic of these candidates, by cross-entropy."""
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    critic = GraspCritic()
    x, y = torch.from_numpy(examples.inputs), torch.from_numpy(examples.sound.astype(np.float32))
    critic.mean.copy_(x.mean(dim=0))
    critic.scale.copy_(x.std(dim=0).clamp_min(1e-3))
    optimizer = torch.optim.AdamW(critic.parameters(), lr=RATE, weight_decay=DECAY)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, EPOCHS)
    for _ in range(EPOCHS):
        order = torch.from_numpy(rng.permutation(len(y)))
        for batch in order.split(BATCH):
            loss = functional.binary_cross_entropy_with_logits(critic(x[batch]), y[batch])
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            optimizer.step()
        schedule.step()
    return critic.eval()


def judged(critic: GraspCritic, examples: Examples) -> dict[str, float]:
    """Share of scenes whose first candidate is sound, by the search's score and by the critic's
    chance, and the expected calibration error of the chances."""
    chance = critic.chance(examples.inputs)
    first = {"first by search": examples.score, "first by critic": chance}
    return {
        **{name: _first_sound(examples, score) for name, score in first.items()},
        "calibration error": calibration_error(chance, examples.sound),
    }


def _first_sound(examples: Examples, score: np.ndarray) -> float:
    scenes = (np.flatnonzero(examples.scene == one) for one in np.unique(examples.scene))
    return float(np.mean([examples.sound[some[score[some].argmax()]] for some in scenes]))


if __name__ == "__main__":
    run_script(main)
