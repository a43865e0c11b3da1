"""How far a training of PPO has come: summaries of episodes, evaluations, checkpoints, curves.

An evaluation is a row, a dict with `update`, `step` (environment steps), and the means over its
episodes: `return`, `length` (steps) and, where the environment reports it, `success` (share). The
history is the list of all rows. This module makes no environment and no network.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from torch.utils.tensorboard import SummaryWriter

from models.grasp_policy import GraspPPO, load_policy, save_policy
from models.ppo_rollouts import SIMULATION, Episode
from utils.checkpoint import reading
from utils.config_schema import Config, RLConfig
from utils.runs import Stopwatch, save_results

ProgressRow = dict[str, Any]

# Curves whose unit is not evident from their name.
UNITS = {
    "length": "length_steps",
    "success": "success_share",
    "entropy": "entropy_nats",
    "approx_kl": "approx_kl_nats",
}


def updates_of(config: Config) -> int:
    """The number of updates until rl.total_steps are reached."""
    return -(-config.rl.total_steps // (config.rl.envs * config.rl.rollout_steps))


def summary(episodes: Sequence[Episode]) -> dict[str, float]:
    """Means over episodes: return, length, and success where episodes report it; empty without
    episodes."""
    if not episodes:
        return {}
    reported = [episode.success for episode in episodes if episode.success is not None]
    means = {
        "return": float(np.mean([episode.total for episode in episodes])),
        "length": float(np.mean([episode.length for episode in episodes])),
    }
    return means | ({"success": float(np.mean(reported))} if reported else {})


def score(row: ProgressRow) -> tuple[float, float]:
    """What the best evaluation is chosen by: success first, where it is reported, then return."""
    return row.get("success", 0.0), row["return"]


def best_of(history: list[ProgressRow]) -> ProgressRow:
    """The best evaluation, the first of those that are equally good."""
    return max(history, key=score)


def reached(settings: RLConfig, row: ProgressRow) -> bool:
    """Whether an evaluation meets one of the targets of the config's section `rl`."""
    success, total = settings.target_success, settings.target_return
    return (success is not None and row.get("success", 0.0) >= success) or (
        total is not None and row["return"] >= total
    )


class Curves:
    """TensorBoard curves over environment steps, written by the main process alone.

    Their names are group/value: `training` (episodes with exploration), `evaluation` (deterministic
    episodes), `update` (losses and what an update did), `pretraining` and `time`. What lies
    beyond `first_step`, of a run that is resumed before it, is dropped.
    """

    def __init__(self, folder: Path, first_step: int, is_main: bool):
        self._writer = SummaryWriter(folder, purge_step=first_step + 1) if is_main else None

    def add(self, group: str, step: int, values: dict[str, float]) -> None:
        if self._writer is not None:
            for name, value in values.items():
                self._writer.add_scalar(f"{group}/{UNITS.get(name, name)}", value, step)

    def flush(self) -> None:
        if self._writer is not None:
            self._writer.flush()

    def close(self) -> None:
        if self._writer is not None:
            self._writer.close()


def after_not_finite(run: Path) -> str:
    """What to do after a number that is not finite."""
    last = run / "last.pt"
    if last.is_file():
        return (
            f"the weights of {last} are sound: continue from them with rl.initial, perhaps with a "
            "lower rl.lr"
        )
    return "nothing was saved before; look at the environment's rewards and observations"


def after_worker_error(run: Path) -> str:
    """What to do after an environment has failed."""
    if (run / "last.pt").is_file():
        return f"go on with --resume {run}"
    return "start a new run: nothing was saved before"


def save_evaluation(
    run: Path, config: Config, ppo: GraspPPO, history: list[ProgressRow], curves: Curves
) -> None:
    """Write last.pt, best.pt if the last row of the history is the best (the first of several that
    are equally good), and its curves."""
    if ppo.team.is_main:
        row = history[-1]
        if row is best_of(history):
            ppo.save(run / "best.pt", config, history=history)
        ppo.save(run / "last.pt", config, history=history)
        means = {name: row[name] for name in ("return", "length", "success") if name in row}
        curves.add("evaluation", row["step"], means)
        curves.flush()
    ppo.team.wait()


def load_progress(ppo: GraspPPO, last: Path) -> list[ProgressRow]:
    """Continue from a checkpoint, if there is one; returns the history so far."""
    if not last.is_file():
        return []
    extra = ppo.load(last)
    with reading(last):
        return extra["history"]


def save_training(run: Path, history: list[ProgressRow], weights: Path | None) -> ProgressRow:
    """Write results.json, and the best policy alone to `weights`; returns the best evaluation."""
    if weights is not None:
        save_policy(weights, load_policy(run / "best.pt"))
    best = best_of(history)
    save_results(run / "results.json", {"best": best, "history": history})
    return best


def row_in_words(row: ProgressRow) -> str:
    return ", ".join(f"{name} {value:.6g}" for name, value in row.items())


def time_in_words(watch: Stopwatch) -> str:
    """'12 s: 60 % simulation and rendering, 30 % network, 10 % overhead'; the choice of actions
    counts as simulation."""
    seconds = watch.seconds()
    total = sum(seconds.values())
    shares = ", ".join(f"{100 * part / total:.0f} % {name}" for name, part in seconds.items())
    return f"{total:.0f} s: {shares.replace(SIMULATION, 'simulation and rendering')}"
