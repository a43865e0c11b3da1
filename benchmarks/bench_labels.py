"""Dense grasp labels against clock and physics: python -m benchmarks.bench_labels [--json FILE]

Speed: labelled (pixel, angle) pairs a second of one core, the height map included. Truth: pairs of
fresh training scenes, drawn by quality, each executed with the whole arm on the scene just loaded.
Pairs of quality 0 are drawn from the objects' pixels and executed with the hand wide open.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from time import process_time

import cv2
import numpy as np

from benchmarks.metrics import Metric, benchmark_parser, report
from envs.cell import Cell
from envs.execution import execute_grasp
from envs.objects import load_object_set
from envs.scenes import Scene, make_scene
from utils.config import Config, load_config
from utils.geometry import GripperGeometry, Workspace
from utils.grasp_labels import (
    GraspLabels,
    LabelSettings,
    bin_angles,
    dense_labels,
    grasp_below_surface,
)
from utils.statistics import wilson_interval
from utils.transforms import ImageGrasp, RGBDFrame

LAYOUTS = ("pile", "packed", "isolated", "pile", "packed")
FIRST_SEED = 500_000  # of the training scenes
STRATA = (0.0, 1e-6, 0.3, 0.5, 0.6, 0.7, 0.8, 1.01)  # edges in quality
PER_STRATUM = 3  # pairs executed from each stratum of a scene; twice as many of quality 0


@dataclass(frozen=True)
class Trial:
    """One executed pair; it stands for `weight` pairs of its scene and stratum."""

    quality: float
    weight: float
    success: bool


def main(argv: Sequence[str] | None = None) -> None:
    parser = benchmark_parser(__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=int, default=15, help="scenes labelled and executed")
    parser.add_argument("--seed", type=int, default=FIRST_SEED, help="of the first scene")
    options = parser.parse_args(argv)
    cv2.setNumThreads(1)
    config = load_config(None, ["sim.renderer=tiny", "objects.split=train"])
    workspace = Workspace(tuple(config.workspace.center), config.workspace.size)
    count = 2 if options.quick else options.scenes
    with Cell(config) as cell:
        scenes = training_scenes(config, count, options.seed)
        frames = [frame_of(cell, scene) for scene in scenes]
        labels, rates = zip(*(timed_labels(frame, workspace) for frame in frames))
        trials = [t for job in zip(scenes, frames, labels) for t in execute(cell, *job)]
    report([*speed_metrics(rates), *truth_metrics(trials)], options.json)


def training_scenes(config: Config, count: int, first_seed: int) -> list[Scene]:
    names = ("primitives", "random_urdfs")
    given = config.objects.model_dump()
    sets = [load_object_set(name, cache_dir=config.cache_folder, **given) for name in names]
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
    """Carry out pairs drawn from every stratum of quality, each on the scene freshly loaded."""
    rng = np.random.default_rng([scene.seed, 1])
    settings, gripper = LabelSettings(), GripperGeometry()
    lowest = settings.table_clearance + settings.min_engagement
    on_object = labels.valid & (frame.segmentation >= 0) & (frame.points()[..., 2] > lowest)
    quality = np.where(on_object, labels.quality, -1)
    trials = []
    for low, high in zip(STRATA, STRATA[1:]):
        members = np.flatnonzero((quality >= low) & (quality < high))
        count = min(len(members), PER_STRATUM * (2 if low == 0 else 1))
        for flat in rng.choice(members, count, replace=False) if count else ():
            k, v, u = np.unravel_index(flat, quality.shape)
            width = float(labels.width[k, v, u]) or gripper.max_opening
            at_surface = ImageGrasp(
                np.array([u, v]), bin_angles()[k], float(frame.depth[v, u]), width, 0.0
            )
            grasp = grasp_below_surface(
                at_surface, frame.K, frame.T_WC, frame.truth.table_height, gripper, settings
            )
            cell.load(scene)
            success = execute_grasp(cell, grasp).success
            trials.append(Trial(float(quality[k, v, u]), len(members) / count, success))
    return trials


def speed_metrics(rates: Sequence[float]) -> list[Metric]:
    return [
        Metric("label_pairs_per_second_median", float(np.median(rates)), "1/s", at_least=1e6),
        Metric("label_pairs_per_second_slowest", float(np.min(rates)), "1/s", at_least=1e6),
    ]


def truth_metrics(trials: Sequence[Trial]) -> list[Metric]:
    """Precision and recall of positive labels; weighted: over all pairs instead of those drawn."""
    threshold = LabelSettings().positive
    positive = [t for t in trials if t.quality >= threshold]
    hits = sum(t.success for t in positive)
    good = sum(t.weight for t in trials if t.success)
    caught = sum(t.weight for t in positive if t.success)
    weighted = caught / max(sum(t.weight for t in positive), 1e-9)
    low, _ = wilson_interval(hits, len(positive))
    metrics = [
        Metric("positives_executed", len(positive), ""),
        Metric("precision_of_positives", hits / max(len(positive), 1), "", at_least=0.95),
        Metric("precision_ci95_low", low, ""),
        Metric("precision_weighted", weighted, "", at_least=0.95),
        Metric("recall_weighted", caught / max(good, 1e-9), ""),
    ]
    for low, high in zip(STRATA, STRATA[1:]):
        group = [t.success for t in trials if low <= t.quality < high]
        name = f"success_at_quality_{low:.1f}_{min(high, 1):.1f}" if high > 1e-3 else "zero"
        name = "success_at_quality_0" if low == 0 else name
        metrics.append(Metric(f"{name}_of_{len(group)}", float(np.mean(group or [np.nan])), ""))
    return metrics


if __name__ == "__main__":
    main()
