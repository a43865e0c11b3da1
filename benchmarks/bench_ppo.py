"""Our PPO against Stable-Baselines3's: python -m benchmarks.bench_ppo [--json FILE]

Same environments and number of them, same network and hyper-parameters, no normalising; every seed
of both in a process of its own, one after the other and in turn. The final return is the mean over
deterministic episodes of the last policy, from seeds that both are given. Those of the cell are not
at full difficulty: as in its training, half of them begin with the hand near the object, for both
alike. How fast the environments take our training's actions again, with nobody learning, bounds
what any trainer can reach.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Generator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import psutil
from gymnasium.wrappers import FilterObservation, FlattenObservation
from scipy.stats import t as student

from benchmarks.metrics import (
    Metric,
    benchmark_parser,
    check_installed,
    positive_int,
    report,
)
from utils.config import Config, load_config
from utils.runs import REPOSITORY, run_script

CONFIGS = REPOSITORY / "configs"
EPISODES = 100  # deterministic ones at the end
FIRST_SEED = 900_000  # of these
ENVS = 4


@dataclass(frozen=True)
class Task:
    """An environment, the module that registers it (None for this project's), and settings that
    suit it (Pendulum's are those of RL Baselines3 Zoo without its state-dependent exploration).

    config: under the settings; None for the defaults.
    """

    module: str | None
    steps: int
    settings: tuple[str, ...]
    config: Path | None = None


COMMON = (
    f"rl.envs={ENVS}", "rl.hidden_dim=64", "rl.hidden_layers=2", "rl.activation=tanh",
    "rl.initial_log_std=0", "rl.target_kl=null", "rl.anneal_lr=false", "rl.value_coef=0.5",
    "rl.entropy_coef=0", "rl.max_gradient_norm=0.5", "rl.clip_epsilon=0.2", "rl.gae_lambda=0.95",
    "rl.normalise_observations=false", "rl.normalise_rewards=false", "rl.device=cpu",
)  # fmt: skip
TASKS = {
    "Pendulum-v1": Task(
        "gymnasium", 100_000,
        ("rl.lr=1e-3", "rl.gamma=0.9", "rl.epochs=10", "rl.rollout_steps=256",
         "rl.batch_size=64", "rl.parallel=false"),
    ),
    "PandaReachDense-v3": Task(
        "panda_gym", 100_000,
        ("rl.lr=1e-3", "rl.gamma=0.95", "rl.epochs=10", "rl.rollout_steps=512",
         "rl.batch_size=64", "rl.parallel=true"),
    ),
    # The cell as the policy without images sees it; a process for each core of a small machine.
    "RobotGrasping-v0": Task(
        None, 16_384,
        ("rl.envs=2", "rl.lr=1e-3", "rl.gamma=0.9", "rl.epochs=8", "rl.rollout_steps=256",
         "rl.batch_size=128", "rl.parallel=true"),
        CONFIGS / "ppo_state.yaml",
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Result:
    """Of one training. seconds: from the first step to the last update; cpu_seconds: in this time,
    of the process and its workers, which a busy machine lengthens less; megabytes: what the
    process and its workers held together at the end; replay_seconds: of the same actions again, in
    all environments at once, with no policy and nobody learning; None where that was not tried."""

    final_return: float
    steps: int
    seconds: float
    cpu_seconds: float
    megabytes: float
    replay_seconds: float | None = None


def main(argv: Sequence[str] | None = None) -> None:
    parser = benchmark_parser(__doc__.splitlines()[0])
    parser.add_argument("--env", nargs="+", choices=TASKS, default=list(TASKS))
    parser.add_argument("--seeds", type=positive_int, default=5, help="trainings of either")
    parser.add_argument(
        "--steps", type=positive_int, help="env steps of each; default: the task's own"
    )
    parser.add_argument("--run", nargs=2, metavar=("WHO", "SEED"), help="one training, as JSON")
    options = parser.parse_args(argv)
    check_installed("stable_baselines3")
    if options.run:
        who, seed = options.run
        if who not in RUN or not seed.isdecimal():
            parser.error(f"--run {who} {seed}: expected {' or '.join(RUN)}, and a seed from 0 on")
        print(json.dumps(RUN[who](options.env[0], int(seed), options.steps)))
        return
    seeds = 2 if options.quick else options.seeds
    metrics = []
    for env in options.env:
        steps = options.steps or (4096 if options.quick else TASKS[env].steps)
        metrics += compare(env, seeds, steps)
    report(metrics, options.json)


def compare(env: str, seeds: int, steps: int) -> list[Metric]:
    """The figures of one environment, and a line for every training."""
    results: dict[str, list[Result]] = {who: [] for who in TRAIN}
    for seed in range(seeds):
        for who in list(TRAIN)[:: 1 if seed % 2 else -1]:  # who is first alternates
            results[who].append(Result(**in_own_process(env, who, seed, steps)))
            print(f"{env} {who} seed {seed}: {results[who][-1]}", file=sys.stderr, flush=True)
    returns = {who: [r.final_return for r in results[who]] for who in TRAIN}
    rate = {who: np.array([r.steps / r.seconds for r in results[who]]) for who in TRAIN}
    cpu = {who: np.array([r.cpu_seconds / r.steps for r in results[who]]) for who in TRAIN}
    floor = np.array([r.steps / r.replay_seconds for r in results["ours"]])
    megabytes = {who: max(r.megabytes for r in results[who]) for who in TRAIN}
    low, high = interval(returns["sb3"])
    ours_low, ours_high = interval(returns["ours"])
    return [
        Metric(f"{env}_return", float(np.mean(returns["ours"])), "", at_least=low),
        Metric(f"{env}_return_low", ours_low, ""),
        Metric(f"{env}_return_high", ours_high, ""),
        Metric(f"{env}_return_sb3", float(np.mean(returns["sb3"])), ""),
        Metric(f"{env}_return_sb3_low", low, ""),
        Metric(f"{env}_return_sb3_high", high, ""),
        Metric(f"{env}_speed_vs_sb3", float(np.median(rate["ours"] / rate["sb3"])), "x",
               at_least=1.3),
        Metric(f"{env}_steps_per_second", float(np.median(rate["ours"])), "1/s"),
        Metric(f"{env}_steps_per_second_replayed", float(np.median(floor)), "1/s"),
        Metric(f"{env}_speed_vs_replay", float(np.median(rate["ours"] / floor)), "x"),
        Metric(f"{env}_sb3_speed_vs_replay", float(np.median(rate["sb3"] / floor)), "x"),
        Metric(f"{env}_cpu_vs_sb3", float(np.median(cpu["ours"] / cpu["sb3"])), "x"),
        Metric(f"{env}_memory", megabytes["ours"], "MB"),
        Metric(f"{env}_memory_vs_sb3", megabytes["ours"] / megabytes["sb3"], "x"),
    ]  # fmt: skip


def interval(values: Sequence[float]) -> tuple[float, float]:
    """95 % interval of the mean by Student's t; of no width for a single value."""
    mean, n = float(np.mean(values)), len(values)
    if n < 2:
        return mean, mean
    half = float(student.ppf(0.975, n - 1) * np.std(values, ddof=1) / np.sqrt(n))
    return mean - half, mean + half


def in_own_process(env: str, who: str, seed: int, steps: int) -> Any:
    """A run with one thread a process, so that memory is its own and nothing is warm."""
    command = [sys.executable, "-m", "benchmarks.bench_ppo", "--env", env, "--steps", str(steps)]
    done = subprocess.run(
        [*command, "--run", who, str(seed)], stdout=subprocess.PIPE, text=True, check=True,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    return json.loads(done.stdout.splitlines()[-1])


def memory() -> float:
    """Megabytes of this process and its children, shared pages counted once (PSS)."""
    return sum(process.memory_full_info().pss for process in family()) / 2**20


def cpu_seconds() -> float:
    """What this process and its children have used so far."""
    return sum(sum(process.cpu_times()[:2]) for process in family())


def family() -> list[psutil.Process]:
    return [psutil.Process(), *psutil.Process().children(recursive=True)]


# --- The two ------------------------------------------------------------------------------------


def config_of(env: str, seed: int) -> Config:
    task = TASKS[env]
    name = env if task.module is None else f"{task.module}:{env}"
    return load_config(task.config, [*COMMON, *task.settings, f"seed={seed}", f"rl.env_id={name}"])


def whole_updates(config: Config, steps: int) -> int:
    return max(1, round(steps / (config.rl.envs * config.rl.rollout_steps)))


def train_ours(env: str, seed: int, steps: int) -> Result:
    from envs.vector_env import training_envs
    from models.grasp_policy import make_ppo
    from models.ppo_rollouts import RolloutCollector, derived_seeds, evaluate_policy
    from utils.runs import Stopwatch

    config = config_of(env, seed)
    count, watch = whole_updates(config, steps), Stopwatch()
    with training_envs(config, config.rl.envs) as envs:
        ppo = make_ppo(envs.observation_space, envs.action_space, config)
        collector = RolloutCollector(envs, ppo.layout, config.rl.rollout_steps, watch)
        first_seeds = derived_seeds(envs.num_envs, seed)
        collector.restart(first_seeds)
        ppo.generator.manual_seed(seed)
        start, cpu = time.perf_counter(), cpu_seconds()
        actions = []
        for _ in range(count):
            rollout = collector.collect(ppo.network, ppo.generator)
            ppo.update(rollout)
            actions.append(ppo.network.action(rollout.latents).numpy())
        spent = time.perf_counter() - start, cpu_seconds() - cpu, memory()
        seeds = range(FIRST_SEED, FIRST_SEED + EPISODES)
        episodes = evaluate_policy(ppo.network, envs, ppo.layout, seeds, watch)
        start = time.perf_counter()
        again = partial(replay, seeds=first_seeds, actions=np.concatenate(actions))
        envs.each(again)
        replayed = time.perf_counter() - start
    final = float(np.mean([episode.total for episode in episodes]))
    return Result(final, count * envs.num_envs * config.rl.rollout_steps, *spent, replayed)


def replay(
    env: gymnasium.Env, index: int, seeds: Sequence[int], actions: np.ndarray
) -> Generator[None, None, None]:
    """A task of `TrainingEnvs.each`: take the actions (T, N, A) of a training again."""
    env.reset(seed=seeds[index])
    for action in actions[:, index]:
        _, _, terminated, truncated, _ = env.step(action)
        yield
        if terminated or truncated:
            env.reset()
            yield


def train_sb3(env: str, seed: int, steps: int) -> Result:
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

    config = config_of(env, seed)
    rl = config.rl
    kind = SubprocVecEnv if rl.parallel else DummyVecEnv
    envs = make_vec_env(partial(as_sb3_sees_it, config), rl.envs, seed, vec_env_cls=kind)
    widths = [rl.hidden_dim] * rl.hidden_layers
    dict_observation = hasattr(envs.observation_space, "spaces")
    model = PPO(
        "MultiInputPolicy" if dict_observation else "MlpPolicy", envs, seed=seed, device="cpu",
        learning_rate=rl.lr, n_steps=rl.rollout_steps, batch_size=rl.batch_size,
        n_epochs=rl.epochs, gamma=rl.gamma, gae_lambda=rl.gae_lambda, clip_range=rl.clip_epsilon,
        ent_coef=rl.entropy_coef, vf_coef=rl.value_coef, max_grad_norm=rl.max_gradient_norm,
        policy_kwargs={"net_arch": {"pi": widths, "vf": widths}, "activation_fn": torch.nn.Tanh},
    )  # fmt: skip
    steps = whole_updates(config, steps) * rl.envs * rl.rollout_steps
    start, cpu = time.perf_counter(), cpu_seconds()
    model.learn(steps)
    spent = time.perf_counter() - start, cpu_seconds() - cpu, memory()
    envs.close()
    judge, seeds = as_sb3_sees_it(config), range(FIRST_SEED, FIRST_SEED + EPISODES)
    final = float(np.mean([deterministic_return(model, judge, number) for number in seeds]))
    return Result(final, steps, *spent)


def as_sb3_sees_it(config: Config, **arguments: Any) -> gymnasium.Env:
    """The environment; of its observation as one vector the entries that the policy sees."""
    from envs.vector_env import make_env

    seen = config.rl.policy_observations
    if seen is None:
        return gymnasium.make(config.rl.env_id, **arguments)
    return FlattenObservation(FilterObservation(make_env(config, **arguments), seen))


def deterministic_return(model: Any, env: gymnasium.Env, seed: int) -> float:
    """Of one episode by SB3's policy."""
    observation, _ = env.reset(seed=seed)
    total, done = 0.0, False
    while not done:
        action, _ = model.predict(observation, deterministic=True)
        observation, reward, terminated, truncated, _ = env.step(action)
        total, done = total + float(reward), terminated or truncated
    return total


TRAIN = {"ours": train_ours, "sb3": train_sb3}
RUN = {who: lambda *task, train=train: vars(train(*task)) for who, train in TRAIN.items()}


if __name__ == "__main__":
    run_script(main)
