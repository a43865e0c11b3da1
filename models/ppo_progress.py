"""How far a training of PPO has come: summaries of episodes, evaluations, checkpoints, curves.

An evaluation is a row, a dict with `update`, `step` (environment steps), and the means over its
episodes: `return`, `length` (steps) and, where the environment reports it, `success` (share). The
history is the list of all rows. This module makes no environment and no network.
"""

from __future__ import annotations

import shlex
import warnings
from collections.abc import Collection, Sequence
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

from models.grasp_policy import GraspPPO, load_policy, save_policy
from models.ppo_observations import ObservationLayout
from models.ppo_rollouts import (
    EVALUATION,
    SIMULATION,
    Diverged,
    Envs,
    Episode,
    NotFinite,
    derived_seeds,
    evaluate_policy,
)
from utils.checkpoint import reading
from utils.config import changed_keys
from utils.config_schema import Config, RLConfig
from utils.distributed import Team
from utils.errors import UserError
from utils.runs import Stopwatch, resume_command, save_results, this_python

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


def evaluation_due(config: Config, updates: int) -> bool:
    """Whether the policy is evaluated after so many updates, and a checkpoint written."""
    return updates % config.rl.evaluate_every == 0 or updates == updates_of(config)


# Sections and keys that make the cell in which a policy acts.
CELL_SECTIONS = (
    "simulator=", "sim.", "robot.", "gripper.", "workspace.", "objects.", "execution.", "safety."
)  # fmt: skip


def warn_of_short_episodes(config: Config) -> None:
    """Remark where each episode of a training ends before its time: episodes begin anew after every
    checkpoint, as those of a run that is resumed from it do."""
    settings = config.rl
    longest = settings.evaluate_every * settings.rollout_steps
    if longest < config.env.max_steps:
        warnings.warn(
            f"rl.evaluate_every={settings.evaluate_every} and "
            f"rl.rollout_steps={settings.rollout_steps}: a checkpoint, after which episodes begin "
            f"anew, comes every {longest} steps, so that none of the training reaches "
            f"env.max_steps={config.env.max_steps}; evaluate less often",
            stacklevel=2,
        )


def announcement(config: Config, run: Path, ppo: GraspPPO) -> str:
    """What is trained where, in one line."""
    processes, settings, layout = ppo.team, config.rl, ppo.layout
    seen = ", ".join(part.key for part in (*layout.images, *layout.state))
    hidden = ", ".join(part.key for part in layout.privileged)
    estimated = ", ".join(settings.estimated_observations or ())
    targets = {"success": settings.target_success, "return": settings.target_return}
    ends = " or ".join(
        f"{name} of {value:g}" for name, value in targets.items() if value is not None
    )
    return (
        f"PPO on {settings.env_id}: {settings.envs} environments, {updates_of(config)} updates of "
        f"{settings.envs * settings.rollout_steps:,} steps each"
        f"{f' at most, until an evaluation has a {ends}' if ends else ''}, "
        f"{sum(p.numel() for p in ppo.network.parameters()):,} parameters, "
        f"{processes.ranks} process(es), {processes.device}, seed {config.seed}; "
        f"the policy sees {seen}"
        f"{f', only the critic {hidden}' if hidden else ''}"
        f"{f'; the network estimates {estimated}' if estimated else ''}; results in {run}"
    )


def evaluate(
    config: Config, envs: Envs, ppo: GraspPPO, watch: Stopwatch, bar: tqdm, interrupted: Event
) -> ProgressRow | None:
    """Deterministic episodes on seeds that stay the same and that no training episode has; None
    where Ctrl-C has broken them off in any process. bar: tells how many have been played."""
    processes, settings = ppo.team, config.rl
    seeds = derived_seeds(settings.evaluation_episodes, config.seed, EVALUATION)
    own = seeds[processes.rank :: processes.ranks]

    def goes_on(played: int) -> bool:
        bar.set_postfix_str(f"evaluating: {played} of {len(own)} episodes")
        return not interrupted.is_set()

    episodes = evaluate_policy(ppo.network, envs, ppo.layout, own, watch, goes_on)
    bar.set_postfix_str("")
    if processes.any(len(episodes) < len(own)):
        return None
    step = ppo.updates * settings.envs * settings.rollout_steps
    return {"update": ppo.updates, "step": step, **summary(processes.concatenate(episodes))}


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
    """Whether an evaluation meets one of the targets of the config's section `rl`. Warns of one
    that the environment has not reported."""
    success, total = settings.target_success, settings.target_return
    if success is not None and "success" not in row:
        warnings.warn(
            f"rl.target_success={success:g}: no episode of this evaluation of {settings.env_id} "
            "reported is_success; rl.target_return is a target for any environment",
            stacklevel=2,
        )
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


def not_finite(error: NotFinite, run: Path, team: Team) -> UserError:
    """The error for a number that is not finite, with where it was and what to do."""
    last = run / "last.pt"
    saved = f"the weights of {last} are sound" if last.is_file() else "nothing was saved before"
    if not isinstance(error, Diverged):
        advice = f"{saved}; look at the environment's rewards and observations"
    elif last.is_file():
        advice = f"{saved}: continue from them with rl.initial, perhaps with a lower rl.lr"
    else:
        advice = f"{saved}; look at the environment's rewards, or lower rl.lr"
    where = f"process {team.rank} of {team.ranks}: " if team.ranks > 1 else ""
    return UserError(f"{where}{error}; {advice}")


def after_worker_error(run: Path) -> str:
    """What to do after an environment has failed."""
    if (run / "last.pt").is_file():
        return f"go on with {resume_command('train_rl.py', run)}"
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


def save_unevaluated(run: Path, config: Config, ppo: GraspPPO, history: list[ProgressRow]) -> None:
    """Write last.pt where an evaluation was broken off: a resumed run begins with it, and no update
    is lost."""
    if ppo.team.is_main:
        ppo.save(run / "last.pt", config, history=history)
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
    save_results(run / "results.json", {"best": best, "history": history}, run)
    return best


def scoring_command(
    config: Config, run: Path, layout: ObservationLayout, known: Collection[str]
) -> str:
    """The command that scores the best policy of a run in the cell on scenes that it has not met.
    known: what a robot knows; a policy that sees more is not scored beside planners."""
    best = run / "best.pt"
    if any(part.key not in known for part in layout.state):
        return f"{this_python()} -m benchmarks.bench_policy {best}"
    # The checkpoint brings section env, and of the camera all but its noise.
    all_changed = changed_keys(config)
    changed = [
        key for key in all_changed
        if key.startswith(CELL_SECTIONS) and not key.startswith("objects.split=")
    ]  # fmt: skip
    if any(key.startswith("camera.depth_noise=") for key in all_changed):
        changed.append(f"evaluate.depth_noises={config.camera.depth_noise}")
    return (
        f"{this_python()} evaluate.py evaluate.policies=ppo:{best} evaluate.scenarios=isolated "
        f"evaluate.object_sets={config.env.objects} {shlex.join(changed)}"
    ).rstrip()


def stopped_in_words(
    run: Path, config: Config, updates: int, history: list[ProgressRow], weights: Path | None
) -> str:
    """What Ctrl-C has left after so many updates, and how to go on. weights: file of --weights."""
    command = resume_command("train_rl.py", run, {"--weights": weights})
    done = updates * config.rl.envs * config.rl.rollout_steps
    # Where an evaluation is due, it has written a checkpoint, or was broken off with one.
    saved = done if evaluation_due(config, updates) else history[-1]["step"]
    if saved == done:
        return f"stopped after {done:,} steps, at a checkpoint; go on with {command}"
    return (
        f"stopped after {done:,} steps, but the last checkpoint is of {saved:,}: {command} goes on "
        f"from there and repeats the other {done - saved:,}"
    )


def row_in_words(row: ProgressRow) -> str:
    return ", ".join(f"{name} {value:.6g}" for name, value in row.items())


def time_in_words(watch: Stopwatch) -> str:
    """'12 s: 60 % simulation and rendering, 30 % network, 10 % overhead'; the choice of actions
    counts as simulation."""
    seconds = watch.seconds()
    total = sum(seconds.values())
    shares = ", ".join(f"{100 * part / total:.0f} % {name}" for name, part in seconds.items())
    return f"{total:.0f} s: {shares.replace(SIMULATION, 'simulation and rendering')}"
