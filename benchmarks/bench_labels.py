"""Dense grasp labels against clock and physics: python -m benchmarks.bench_labels [--json FILE]

Speed: labelled (pixel, angle) pairs a second of one core, the height map included. Truth: pairs of
fresh training scenes, drawn by quality, each executed with the whole arm on the scene just loaded.
Pairs of quality 0 are drawn from the objects' pixels and executed with the hand wide open.
"""

from __future__ import annotations

from collections.abc import Sequence
from time import process_time

import cv2
import numpy as np

from benchmarks.metrics import (
    Metric,
    benchmark_parser,
    natural_number,
    positive_int,
    report,
)
from envs.cell import Cell
from envs.cell_layout import Scene
from envs.cell_scenes import make_scene
from envs.data_generation import execute_pairs
from envs.objects import load_objects
from envs.simulators import make_cell
from utils.config import Config, load_config
from utils.geometry import GripperGeometry, Workspace
from utils.grasp_labels import GraspLabels, Trial, dense_labels, label_truth
from utils.random_streams import Stream
from utils.runs import run_script
from utils.transforms import RGBDFrame

LAYOUTS = ("pile", "packed", "isolated", "pile", "packed")
FIRST_SEED = 500_000  # of the training scenes


def main(argv: Sequence[str] | None = None) -> None:
    parser = benchmark_parser(__doc__.splitlines()[0])
    parser.add_argument(
        "--scenes", type=positive_int, default=15, help="scenes labelled and executed"
    )
    parser.add_argument(
        "--seed", type=natural_number, default=FIRST_SEED, help="of the first scene"
    )
    options = parser.parse_args(argv)
    cv2.setNumThreads(1)
    config = load_config(None, ["sim.renderer=tiny", "objects.split=train"])
    workspace = config.workspace.geometry
    count = 2 if options.quick else options.scenes
    with make_cell(config) as cell:
        scenes = training_scenes(config, count, options.seed)
        frames = [frame_of(cell, scene) for scene in scenes]
        labels, rates = zip(*(timed_labels(frame, workspace) for frame in frames))
        trials = [execute(cell, *job) for job in zip(scenes, frames, labels)]
    report([*speed_metrics(rates), *truth_metrics(trials)], options.json)


def training_scenes(config: Config, count: int, first_seed: int) -> list[Scene]:
    sets = [load_objects(name, config) for name in ("primitives", "random_urdfs")]
    return [
        make_scene(LAYOUTS[i % len(LAYOUTS)], sets[i % 2], first_seed + i, config)
        for i in range(count)
    ]


def frame_of(cell: Cell, scene: Scene) -> RGBDFrame:
    cell.load(scene)
    return cell.frame(with_truth=True)


def timed_labels(frame: RGBDFrame, workspace: Workspace) -> tuple[GraspLabels, float]:
    """A frame's labels and the (pixel, angle) pairs a second of processor time, best of three."""
    best = np.inf
    for _ in range(3):
        start = process_time()
        labels = dense_labels(frame, GripperGeometry(), workspace)
        best = min(best, process_time() - start)
    return labels, labels.quality.size / best


def execute(cell: Cell, scene: Scene, frame: RGBDFrame, labels: GraspLabels) -> list[Trial]:
    rng = np.random.default_rng([scene.seed, Stream.LABEL_TRIALS])
    return execute_pairs(cell, scene, frame, labels, rng)


def speed_metrics(rates: Sequence[float]) -> list[Metric]:
    return [
        Metric("label_pairs_per_second_median", float(np.median(rates)), "1/s", at_least=1e6),
        Metric("label_pairs_per_second_slowest", float(np.min(rates)), "1/s", at_least=1e6),
    ]


def truth_metrics(trials: Sequence[Sequence[Trial]]) -> list[Metric]:
    """Precision and recall of positive labels, from the trials of each scene; weighted: over all
    pairs instead of those drawn."""
    truth = label_truth(trials)
    metrics = [
        Metric("positives_executed", truth.positives, ""),
        Metric("precision_of_positives", truth.precision, "", at_least=0.95),
        Metric("precision_ci95_low", truth.precision_ci95[0], ""),
        Metric("precision_weighted", truth.precision_weighted, "", at_least=0.95),
        Metric("recall_weighted", truth.recall_weighted, ""),
    ]
    for low, high, executed, rate in truth.by_stratum:
        quality = f"{low:.1f}_{high:.1f}" if low else "0"
        metrics.append(Metric(f"success_at_quality_{quality}_of_{executed}", rate, ""))
    return metrics


if __name__ == "__main__":
    run_script(main)
