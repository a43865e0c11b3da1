"""Train a policy by PPO: any Gymnasium environment with continuous actions, first of all the cell.

    python train_rl.py --config configs/ppo_state.yaml
    python train_rl.py rl.env_id=Pendulum-v1 rl.gamma=0.9 rl.total_steps=200000
    torchrun --nproc_per_node=2 train_rl.py --config configs/ppo.yaml

A run leaves best.pt (chosen by evaluations), last.pt, results.json, TensorBoard events and, with
rl.films=N, films of N episodes in runs/train_rl/<time>/; --weights FILE is the best policy alone.
RandomizedGrasping-v0 adds episodes/STEP/env*.jsonl: the randomisation of every finished episode of
the training, one folder for the steps from one checkpoint to the next.
Ctrl-C stops a run early; --resume RUN continues from last.pt, bit for bit on the same device and
number of processes. The first last.pt follows the pretraining (rl.pretraining_images); until then
Ctrl-C ends the run for good.

No simulator can be stored in a file. Therefore all environments begin new episodes at every
evaluation, which is when a checkpoint is written, from seeds that follow from the run's seed and
the number of updates: a resumed run meets the same episodes as one that was never stopped.
"""

from __future__ import annotations

import os

import utils.installation  # noqa: F401 - ends in one sentence where a package is missing

# The processes that simulate need the cores while a thread waits for another one.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
# NumPy multiplies with one thread here as in a worker: the same bits, with or without workers.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import sys
import time
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

from tqdm import tqdm

from envs.policy_approach import KNOWN_TO_A_ROBOT
from envs.registries import check_names
from envs.studio import film_episode
from envs.vector_env import (
    OWN_ENVS,
    TrainingEnvs,
    WorkerError,
    full_difficulty,
    make_env,
    make_objects,
    training_envs,
)
from models.grasp_policy import KIND, GraspPPO, load_policy, make_ppo
from models.ppo_pretraining import pretrain_estimator
from models.ppo_progress import (
    Curves,
    ProgressRow,
    after_worker_error,
    announcement,
    evaluate,
    evaluation_due,
    load_progress,
    not_finite,
    reached,
    row_in_words,
    save_evaluation,
    save_training,
    save_unevaluated,
    scoring_command,
    stopped_in_words,
    summary,
    time_in_words,
    updates_of,
    warn_of_short_episodes,
)
from models.ppo_rollouts import (
    EVALUATION,
    LEARNING,
    NETWORK,
    TRAINING,
    NotFinite,
    RolloutCollector,
    derived_seeds,
)
from utils.checkpoint import check_weights_file
from utils.config import Config
from utils.distributed import Team, run_folder, stop_on_interrupt, team, without_initial
from utils.errors import UserError
from utils.runs import Stopwatch, check_resume, parse_args, run_script, this_python

FREE_TO_CHANGE = (
    "rl.name",
    "rl.films",
    "rl.device",
    "rl.parallel",
    "rl.worker_timeout",
    "rl.target_success",
    "rl.target_return",
)
WEIGHTS_HELP = "also write the best policy here, once the training has reached its end"
STOPPING = "interrupted: stopping after the update under way, or within the evaluation"


def main(argv: Sequence[str] | None = None) -> int:
    config, options = parse_args(argv, "Train a policy by PPO.", _add_options)
    check_names(config)
    check_weights_file("--weights", options.weights, KIND)
    check_resume(config, options.resume, FREE_TO_CHANGE, ["last.pt"])
    if config.rl.films:  # one that draws no pictures is told of now
        make_env(config, render_mode="rgb_array").close()
    if os.environ.get("LOCAL_RANK", "0") == "0":
        make_objects(config)
        if config.rl.env_id in OWN_ENVS and options.resume is None:
            warn_of_short_episodes(config)
    with (
        team(config.rl.device, os.environ, "rl.device") as processes,
        training_envs(config, envs_of_each(config, processes)) as envs,
    ):
        initial = without_initial(config, "rl", options.resume)
        ppo = make_ppo(envs.observation_space, envs.action_space, initial, processes)
        with run_folder("train_rl", config.rl.name, config, options.resume, processes) as run:
            history = load_progress(ppo, run / "last.pt")
            if processes.is_main:
                print(announcement(config, run, ppo), flush=True)

            finished = train(config, run, envs, ppo, history)

            if processes.is_main and history:  # else stopped in the first evaluation
                # A policy that is half trained must not replace one that is not.
                best = save_training(run, history, options.weights if finished else None)
                print(f"best evaluation: {row_in_words(best)}; its policy: {run / 'best.pt'}")
                print(f"curves: {this_python()} -m tensorboard.main --logdir {run / 'tensorboard'}")
                if config.rl.env_id in OWN_ENVS:
                    print("its score on other scenes:")
                    print(f"  {scoring_command(config, run, ppo.layout, KNOWN_TO_A_ROBOT)}")
                if finished:
                    film(config, run)
            if processes.is_main and not finished:
                print(stopped_in_words(run, config, ppo.updates, history, options.weights))
    return 0 if finished else 130


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--weights", type=Path, metavar="FILE", help=WEIGHTS_HELP)


def envs_of_each(config: Config, processes: Team) -> int:
    """The number of environments that each process steps."""
    if config.rl.envs % processes.ranks:
        raise UserError(
            f"rl.envs is {config.rl.envs}; {processes.ranks} processes cannot share it equally; "
            "make it a multiple"
        )
    return config.rl.envs // processes.ranks


def train(
    config: Config, run: Path, envs: TrainingEnvs, ppo: GraspPPO, history: list[ProgressRow]
) -> bool:
    """Train to the end, to a target, or until Ctrl-C (False); each evaluation adds a row to
    history."""
    processes, settings, watch = ppo.team, config.rl, Stopwatch()
    collector = RolloutCollector(envs, ppo.layout, settings.rollout_steps, watch)
    per_update, total = settings.envs * settings.rollout_steps, updates_of(config)
    step = ppo.updates * per_update
    curves = Curves(run / "tensorboard", step, processes.is_main)
    try:
        if settings.pretraining_images and not (run / "last.pt").is_file():
            with envs.pretraining():
                pretrain_estimator(
                    ppo, envs, settings.pretraining_images, config.seed, watch, curves
                )
        bar = tqdm(
            total=total * per_update, initial=step, unit="step", disable=not processes.is_main
        )
        told = STOPPING if processes.is_main else None
        with stop_on_interrupt(told) as interrupted, bar:
            while True:
                due = evaluation_due(config, ppo.updates)
                if due:
                    envs.record_episodes(None)
                    if not history or history[-1]["update"] < ppo.updates:
                        with envs.at_full_difficulty():
                            row = evaluate(config, envs, ppo, watch, bar, interrupted)
                        if row is None:
                            save_unevaluated(run, config, ppo, history)
                            return False
                        history.append(row)
                        save_evaluation(run, config, ppo, history, curves)
                        if processes.is_main:
                            bar.write(row_in_words(row))
                    if reached(settings, history[-1]) or ppo.updates == total:
                        break
                if processes.any(interrupted.is_set()):
                    return False
                if due:
                    begin_episodes(config, run, envs, collector, ppo, step)
                begun = time.perf_counter()
                seeds = derived_seeds(1, config.seed, LEARNING, processes.rank, ppo.updates)
                ppo.generator.manual_seed(seeds[0])
                rollout = collector.collect(ppo.network, ppo.generator, step)
                with watch(NETWORK):
                    losses = ppo.update(rollout, ppo.updates / total)
                step += per_update
                episodes = summary(processes.concatenate(rollout.episodes))
                bar.update(per_update)
                bar.set_postfix({k: f"{v:.3g}" for k, v in episodes.items() if k != "length"})
                curves.add("training", step, episodes)
                curves.add("update", step, losses)
                rate = per_update / (time.perf_counter() - begun)
                curves.add("time", step, {"steps_per_second": rate})
    except NotFinite as error:
        raise not_finite(error, run, processes) from error
    except WorkerError:
        print(f"after this error, {after_worker_error(run)}", file=sys.stderr)
        raise
    finally:
        curves.close()
        if processes.is_main:
            print(time_in_words(watch), flush=True)
    return True


def begin_episodes(
    config: Config, run: Path, envs: TrainingEnvs, collector: RolloutCollector, ppo: GraspPPO,
    step: int,
) -> None:  # fmt: skip
    """Begin new episodes after a checkpoint, as a run that is resumed from it does."""
    rank = ppo.team.rank
    envs.record_episodes(run / "episodes" / f"{step:09}", rank * envs.num_envs)
    seeds = derived_seeds(envs.num_envs, config.seed, TRAINING, rank, ppo.updates)
    collector.restart(seeds)
    ppo.rewards.restart()
    ppo.memory.clear()


def film(config: Config, run: Path) -> None:
    """Film the first `rl.films` episodes of the evaluations, played by the policy of the best."""
    if not config.rl.films:
        return
    policy = load_policy(run / "best.pt")
    seeds = derived_seeds(config.rl.evaluation_episodes, config.seed, EVALUATION)
    with closing(make_env(config, render_mode="rgb_array")) as env:
        for number, seed in enumerate(seeds[: config.rl.films]):
            path = run / "films" / f"{number}.mp4"
            reason = film_episode(env, policy, seed, path, full_difficulty(config.rl.env_id))
            print(f"{path}: {reason}")


if __name__ == "__main__":
    run_script(main)
