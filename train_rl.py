"""Train a policy by PPO: any Gymnasium environment with continuous actions, first of all the cell.

    python train_rl.py --config configs/ppo_state.yaml
    python train_rl.py rl.env_id=Pendulum-v1 rl.gamma=0.9 rl.total_steps=200000
    torchrun --nproc_per_node=2 train_rl.py --config configs/ppo.yaml

Leaves best.pt (chosen by evaluations), last.pt, results.json, TensorBoard events and, with
rl.films=N, films of N episodes in runs/train_rl/<time>/; --weights FILE is the best policy alone.
RandomizedGrasping-v0 adds episodes/STEP/env*.jsonl: the worlds of all episodes of training, in a
folder for the steps from one checkpoint to the next.
Ctrl-C stops early; --resume RUN goes on from last.pt, bit for bit on the same device and number of
processes. The first is written after the looks (rl.pretraining_images); until then Ctrl-C ends all.

No simulator can be stored in a file. So at every evaluation, which is when a checkpoint is written,
all environments begin new episodes from seeds that follow from the run's seed and the number of
updates: a run that goes on from there meets the same episodes as one that was never stopped.
"""

from __future__ import annotations

import os

# The processes that simulate need the cores while a thread waits for another one.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import argparse
import sys
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

from envs.registries import check_names
from envs.studio import film_episode
from envs.vector_env import VectorEnvs, WorkerError, full_difficulty, make_env, vector_envs
from models.grasp_policy import GraspPPO, load_policy, policy_for, save_policy
from models.ppo import KIND
from models.ppo_observations import ObservationLayout
from models.ppo_rollouts import (
    NETWORK,
    SIMULATION,
    Episode,
    NotFinite,
    RolloutCollector,
    act,
    collect_looks,
    derived_seeds,
    evaluate_policy,
)
from utils.checkpoint import load_checkpoint, load_weights
from utils.config import Config, parse_args, run_script
from utils.distributed import Team, stop_on_interrupt, team
from utils.errors import UserError
from utils.runs import Stopwatch, check_resume, check_writable, new_run_folder, save_results

FREE_TO_CHANGE = (
    "rl.name",
    "rl.films",
    "rl.device",
    "rl.parallel",
    "rl.worker_timeout",
    "rl.target_success",
    "rl.target_return",
)
# Purposes of seeds, which never share any; 3 is FRESH of benchmarks.bench_policy.
TRAINING, EVALUATION, LEARNING, LOOKING = 0, 1, 2, 4
WEIGHTS_HELP = "also write the best policy here, once the training has reached its end"
LOOKS = 32  # of an environment, before they are learned from: two scenes


def main(argv: Sequence[str] | None = None) -> int:
    config, options = parse_args(argv, "Train a policy by PPO.", _add_options)
    check_names(config)
    check_writable("--weights", options.weights)
    check_resume(config, options.resume, FREE_TO_CHANGE, ["last.pt"])
    with (
        team(config.rl.device, os.environ, "rl.device") as us,
        vector_envs(config, envs_of(config, us)) as envs,
    ):
        ppo = make_ppo(config, envs, us)
        run = options.resume or Path(us.broadcast(us.is_main and open_run(config)))
        history = load_progress(ppo, envs, run / "last.pt")
        announce(config, run, envs, ppo)

        finished = train(config, run, envs, ppo, history)

        if us.is_main:
            # A policy that is half trained must not replace one that is not.
            save_training(run, history, options.weights if finished else None)
            film(config, run, ppo)
            if not finished:
                more = "" if options.weights is None else f" --weights {options.weights}"
                done = history[-1]["step"]
                print(f"stopped; go on after {done:,} steps with --resume {run}{more}")
    return 0 if finished else 130


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--weights", type=Path, metavar="FILE", help=WEIGHTS_HELP)


def envs_of(config: Config, us: Team) -> int:
    """How many environments this process steps."""
    if config.rl.envs % us.ranks:
        raise UserError(f"rl.envs is {config.rl.envs}; {us.ranks} processes cannot share it")
    return config.rl.envs // us.ranks


def make_ppo(config: Config, envs: VectorEnvs, us: Team) -> GraspPPO:
    """A new policy, or one with the weights of rl.initial, fitted to the environments."""
    settings = config.rl
    hidden = (
        *(settings.estimated_observations or ()),  # first: this is how the network knows them
        *(settings.privileged_observations or ()),
    )
    layout = ObservationLayout.of(envs.observation_space, settings.policy_observations, hidden)
    torch.manual_seed(config.seed)
    network = policy_for(layout, envs.action_space, settings)
    if settings.initial is not None:
        load_weights(network, load_checkpoint(settings.initial, KIND), settings.initial)
    return GraspPPO(network, layout, settings, us)


def open_run(config: Config) -> str:
    return str(new_run_folder("train_rl", config.rl.name, config))


def load_progress(ppo: GraspPPO, envs: VectorEnvs, last: Path) -> list[dict]:
    """Go on from a checkpoint, if there is one; the evaluations so far."""
    if not last.is_file():
        return []
    return ppo.load(last)["history"]


def announce(config: Config, run: Path, envs: VectorEnvs, ppo: GraspPPO) -> None:
    us, settings = ppo.team, config.rl
    if us.is_main:
        layout = ppo.layout
        seen = ", ".join(part.key for part in (*layout.images, *layout.state))
        hidden = ", ".join(part.key for part in layout.privileged)
        estimated = ", ".join(settings.estimated_observations or ())
        print(
            f"PPO on {settings.env_id}: {settings.envs} environments, {updates(config)} updates of "
            f"{settings.envs * settings.rollout_steps:,} steps each, "
            f"{sum(p.numel() for p in ppo.network.parameters()):,} parameters, "
            f"{us.ranks} process(es), "
            f"{us.device}, seed {config.seed}; the policy sees {seen}"
            f"{f', only the critic {hidden}' if hidden else ''}"
            f"{f'; it estimates {estimated}' if estimated else ''}; results in {run}",
            flush=True,
        )


def updates(config: Config) -> int:
    """Updates until rl.total_steps are reached."""
    return -(-config.rl.total_steps // (config.rl.envs * config.rl.rollout_steps))


def train(config: Config, run: Path, envs: VectorEnvs, ppo: GraspPPO, history: list[dict]) -> bool:
    """Train to the end, to a target, or until Ctrl-C (False). history gets a row an evaluation."""
    us, settings, watch = ppo.team, config.rl, Stopwatch()
    collector = RolloutCollector(envs, ppo.layout, settings.rollout_steps, us.device, watch)
    per_update, total = settings.envs * settings.rollout_steps, updates(config)
    step = ppo.updates * per_update
    writer = SummaryWriter(run / "tensorboard", purge_step=step) if us.is_main else None
    try:
        if config.rl.pretraining_images and not history:
            learn_to_see(config, envs, ppo, watch, writer)
        bar = tqdm(total=total * per_update, initial=step, unit="step", disable=not us.is_main)
        with stop_on_interrupt() as interrupted, bar:
            while True:
                if ppo.updates % settings.evaluate_every == 0 or ppo.updates == total:
                    envs.keep_episodes(None)
                    if not history or history[-1]["update"] < ppo.updates:
                        row = evaluate(config, envs, ppo, watch, step)
                        history.append(row)
                        save_evaluation(run, config, ppo, envs, history, writer, bar)
                    if reached(config, history[-1]) or ppo.updates == total:
                        break
                    envs.keep_episodes(run / "episodes" / f"{step:09}", us.rank * envs.num_envs)
                    place = (config.seed, TRAINING, us.rank, ppo.updates)
                    collector.restart(derived_seeds(envs.num_envs, *place))
                    ppo.rewards.restart()
                    ppo.memory.clear()
                place = (config.seed, LEARNING, us.rank, ppo.updates)
                ppo.generator.manual_seed(derived_seeds(1, *place)[0])
                begun = time.perf_counter()
                rollout = collector.collect(ppo.network, ppo.generator, step)
                with watch(NETWORK):
                    losses = ppo.update(rollout, ppo.updates / total)
                step += per_update
                episodes = summary(all_episodes(us, rollout.episodes))
                bar.update(per_update)
                bar.set_postfix({k: f"{v:.3g}" for k, v in episodes.items() if k != "length"})
                if us.is_main:
                    log(writer, step, "rollout", episodes)
                    log(writer, step, "update", losses)
                    rate = per_update / (time.perf_counter() - begun)
                    log(writer, step, "time", {"steps_per_second": rate})
                if us.any(interrupted.is_set()):
                    return False
    except NotFinite as error:
        raise UserError(
            f"{error}; the weights of {run / 'last.pt'} are sound: go on from there with "
            "rl.initial, perhaps with a lower rl.lr"
        ) from error
    except WorkerError:
        print(f"after this error, go on with --resume {run}", file=sys.stderr)
        raise
    finally:
        if us.is_main:
            writer.close()
            print(shares_in_words(watch), flush=True)
    return True


def learn_to_see(
    config: Config, envs: VectorEnvs, ppo: GraspPPO, watch: Stopwatch, writer: SummaryWriter | None
) -> None:
    """Before anything is done, learn to estimate from rl.pretraining_images images of many scenes."""
    us, settings = ppo.team, config.rl
    chunks = -(-settings.pretraining_images // (settings.envs * LOOKS))
    seeds: Sequence[int | None] = derived_seeds(envs.num_envs, config.seed, LOOKING, us.rank)
    ppo.generator.manual_seed(derived_seeds(1, config.seed, LOOKING, us.rank)[0])
    with envs.looking(), tqdm(
        total=chunks * settings.envs * LOOKS, unit="look", disable=not us.is_main
    ) as bar:  # fmt: skip
        for chunk in range(chunks):
            with watch(SIMULATION):
                looks = collect_looks(envs, ppo.layout, LOOKS, seeds)
                looks = looks.map(lambda part: part.to(us.device))
            with watch(NETWORK):
                ppo.network.observe(looks, us)
                new = ppo.estimate_loss(looks)  # before it learns from them
                ppo.learn_to_see(looks, settings.pretraining_lr * (1 - chunk / chunks))
            seeds = [None] * envs.num_envs
            bar.update(settings.envs * LOOKS)
            bar.set_postfix(loss=f"{new:.3g}")
            if us.is_main:
                # Before step 0, so that resuming leaves them where they are.
                log(
                    writer,
                    (chunk + 1 - chunks) * settings.envs * LOOKS,
                    "pretraining",
                    {"loss": new},
                )
    ppo.memory.clear()


def evaluate(
    config: Config, envs: VectorEnvs, ppo: GraspPPO, watch: Stopwatch, step: int
) -> dict[str, Any]:
    """Deterministic episodes on seeds that stay the same and are never trained on."""
    seeds = derived_seeds(config.rl.evaluation_episodes, config.seed, EVALUATION)
    own = seeds[ppo.team.rank :: ppo.team.ranks]
    with envs.at_full_difficulty():
        episodes = (
            evaluate_policy(ppo.network, envs, ppo.layout, own, ppo.team.device, watch)
            if own
            else []
        )
    return {"update": ppo.updates, "step": step, **summary(all_episodes(ppo.team, episodes))}


def film(config: Config, run: Path, ppo: GraspPPO) -> None:
    """The first `rl.films` episodes of the evaluations, played by the policy as it is now."""
    if config.rl.films:
        env = make_env(config, render_mode="rgb_array")
        seeds = derived_seeds(config.rl.evaluation_episodes, config.seed, EVALUATION)
        for number, seed in enumerate(seeds[: config.rl.films]):
            path = run / "films" / f"{number}.mp4"
            options = full_difficulty(config.rl.env_id)
            reason = film_episode(env, partial(act_on_one, ppo), seed, path, options)
            print(f"{path}: {reason}")
        env.close()


def act_on_one(ppo: GraspPPO, observation: Any) -> np.ndarray:
    """(A,) the deterministic action for one observation of one environment."""
    seen = ppo.layout.read_one(observation)
    latent = act(ppo.network, seen, None, ppo.team.device).to(ppo.team.device)
    return ppo.network.action(latent)[0].cpu().numpy()


def all_episodes(us: Team, episodes: list[Episode]) -> list[Episode]:
    """The episodes of all processes."""
    return [Episode(*episode) for episode in us.concatenate(episodes)]


def summary(episodes: Sequence[Episode]) -> dict[str, float]:
    """Means over episodes, as far as there are some: return, length, success."""
    if not episodes:
        return {}
    told = [episode.success for episode in episodes if episode.success is not None]
    means = {
        "return": float(np.mean([episode.total for episode in episodes])),
        "length": float(np.mean([episode.length for episode in episodes])),
    }
    return means | ({"success": float(np.mean(told))} if told else {})


def score(row: dict[str, Any]) -> tuple[float, float]:
    """What the best evaluation is chosen by: success first, where it is told, then the return."""
    return row.get("success", 0.0), row["return"]


def reached(config: Config, row: dict[str, Any]) -> bool:
    """Whether an evaluation meets one of the targets."""
    success, total = config.rl.target_success, config.rl.target_return
    return (success is not None and row.get("success", 0.0) >= success) or (
        total is not None and row["return"] >= total
    )


def save_evaluation(
    run: Path, config: Config, ppo: GraspPPO, envs: VectorEnvs, history: list[dict],
    writer: SummaryWriter, bar: tqdm,
) -> None:  # fmt: skip
    """Checkpoints, TensorBoard and a line for the last row of history."""
    if ppo.team.is_main:
        row = history[-1]
        progress = {"history": history}
        if score(row) == max(map(score, history)):
            ppo.save(run / "best.pt", config, **progress)
        ppo.save(run / "last.pt", config, **progress)
        scores = {name: row[name] for name in ("return", "length", "success") if name in row}
        log(writer, row["step"], "evaluation", scores)
        writer.flush()
        bar.write(", ".join(f"{name} {value:.6g}" for name, value in row.items()))
    ppo.team.wait()


def log(writer: SummaryWriter, step: int, group: str, values: dict[str, float]) -> None:
    for name, value in values.items():
        writer.add_scalar(f"{group}/{name}", value, step)


def shares_in_words(watch: Stopwatch) -> str:
    seconds = watch.seconds()
    total = sum(seconds.values())
    shares = ", ".join(f"{100 * part / total:.0f} % {name}" for name, part in seconds.items())
    return f"{total:.0f} s: {shares.replace(SIMULATION, 'simulation and rendering')}"


def save_training(run: Path, history: list[dict], weights: Path | None) -> None:
    if weights is not None:
        save_policy(weights, load_policy(run / "best.pt"))
    best = max(history, key=score)
    save_results(run / "results.json", {"best": best, "history": history})
    print(", ".join(["best evaluation:", *(f"{name} {value:.6g}" for name, value in best.items())]))


if __name__ == "__main__":
    run_script(main)
