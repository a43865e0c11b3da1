"""A trained policy on fresh scenes: python -m benchmarks.bench_policy CHECKPOINT [--json FILE]

Deterministic episodes at full difficulty (every one begins at home, whatever made training easier)
from seeds that no training and none of its evaluations has met; the environment is the one that the
checkpoint was trained in, up to the overrides that are given.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.metrics import Metric, benchmark_parser, positive_int, report
from envs.vector_env import OWN_ENVS, full_difficulty, make_env
from models.grasp_policy import SavedPolicy, load_policy
from models.ppo_rollouts import FRESH, derived_seeds
from utils.config import Config, load_foreign
from utils.errors import UserError
from utils.runs import run_script
from utils.statistics import wilson_interval


def main(argv: Sequence[str] | None = None) -> None:
    parser = benchmark_parser(__doc__.splitlines()[0])
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("overrides", nargs="*", metavar="KEY=VALUE", help="e.g. objects.split=test")
    parser.add_argument("--episodes", type=positive_int, default=200)
    options = parser.parse_args(argv)
    count = min(options.episodes, 5) if options.quick else options.episodes
    config = config_of(options.checkpoint, options.overrides)
    episodes = run_episodes(load_policy(options.checkpoint), config, count)
    reasons = Counter(reason for reason, _ in episodes)
    print(", ".join(f"{number} {reason}" for reason, number in reasons.most_common()))
    low, high = wilson_interval(reasons["success"], count)
    name = config.env.objects
    report(
        [
            Metric(f"{name}_success", reasons["success"] / count, ""),
            Metric(f"{name}_success_low", low, ""),
            Metric(f"{name}_success_high", high, ""),
            Metric(f"{name}_steps", float(np.mean([length for _, length in episodes])), "steps"),
        ],
        options.json,
    )


def config_of(checkpoint: Path, overrides: Sequence[str] = ()) -> Config:
    """The config that a checkpoint was trained with, changed by overrides, which alone may name
    plug-ins or an environment of another module."""
    return load_foreign(load_policy(checkpoint).config, str(checkpoint), overrides)


def run_episodes(policy: SavedPolicy, config: Config, count: int) -> list[tuple[str, int]]:
    """Why each of so many deterministic episodes at full difficulty ended, and after how many
    steps. Raises UserError for an environment whose episodes do not say why they end."""
    env, ends = make_env(config), []
    for seed in derived_seeds(count, config.seed, FRESH):
        observation, _ = env.reset(seed=seed, options=full_difficulty(config.rl.env_id))
        ended, length = False, 0
        while not ended:
            observation, _, terminated, truncated, info = env.step(policy(observation))
            ended, length = terminated or truncated, length + 1
        if "reason" not in info:
            raise UserError(
                f"bench_policy: episodes of {config.rl.env_id} do not say why they end "
                f"(info['reason']); give a policy of {' or '.join(OWN_ENVS)}"
            )
        ends.append((info["reason"], length))
    env.close()
    return ends


if __name__ == "__main__":
    run_script(main)
