"""How well GraspNet's votes tell objects apart: python -m benchmarks.bench_objects [--json FILE]

Frames of training objects with `realsense` noise; the objects of the height map that the planners
get, beside the true ones. `cut`: share of the objects of which no part of the map has 70 % of their
labelled cells. `joined`: of which the part that has most is less than 70 % theirs. With
`--one-colour`, objects are told apart as if all had the same colour.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from unittest import mock

import numpy as np
from tqdm import tqdm

from benchmarks.metrics import Metric, benchmark_parser, natural_number, positive_int, report
from envs.cell_scenes import make_scene
from envs.objects import load_objects
from envs.simulators import make_cell
from models import graspnet_objects
from models.graspnet_io import SHIPPED
from models.graspnet_view import NetworkView
from models.planner_graspnet import loaded
from utils.config import Config, load_config
from utils.depth_correction import corrected
from utils.height_map import CELL, height_map_from_scene
from utils.runs import run_script

# Layouts, object sets and settings of the config.
SCENES = {
    "household": ("household", "household"),
    "household_from_a_side": ("household", "household", "camera.view=side"),
    "pile": ("pile", "random_urdfs"),
    "pile_of_primitives": ("pile", "primitives"),
    "pile_of_15": ("pile", "random_urdfs", "scene.count=15"),
    "packed": ("packed", "random_urdfs"),
    "bin": ("bin", "primitives"),
    "flat": ("flat", "flat"),
}
FIRST_SEED = 97_910_000
LEAST_CELLS = 100  # 4 cm2, of an object that counts
SHARE = 0.7


def main(argv: Sequence[str] | None = None) -> None:
    parser = benchmark_parser(__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=positive_int, default=12, help="of each kind")
    parser.add_argument("--seed", type=natural_number, default=FIRST_SEED, help="of the first one")
    parser.add_argument("--one-colour", action="store_true", help="colours tell nothing apart")
    options = parser.parse_args(argv)
    seeds = range(options.seed, options.seed + (1 if options.quick else options.scenes))
    blind = mock.patch.object(graspnet_objects, "colours_at", _grey)
    metrics = []
    with blind if options.one_colour else nullcontext():
        for kind, (layout, objects, *settings) in tqdm(SCENES.items(), unit="set"):
            settings = ["sim.renderer=tiny", "camera.depth_noise=realsense", *settings]
            config = load_config(None, ["objects.split=train", *settings])
            found = np.concatenate(list(told_apart(config, layout, objects, seeds)))
            metrics += [
                Metric(f"{kind}_objects", len(found), ""),
                Metric(f"{kind}_cut", share(found[:, 0]), "%"),
                Metric(f"{kind}_joined", share(found[:, 1]), "%"),
            ]
    report(metrics, options.json)


def share(which: np.ndarray) -> float:
    """Percent of (M,) bool, 0 of none."""
    return 100 * float(which.mean()) if len(which) else 0.0


def told_apart(
    config: Config, layout: str, name: str, seeds: Sequence[int]
) -> Iterator[np.ndarray]:
    """(M, 2) bool of each scene: which of its objects are cut, and which are joined."""
    objects = load_objects(name, config)
    workspace, network = config.workspace.geometry, loaded(SHIPPED)
    with make_cell(config) as cell:
        for seed in seeds:
            cell.load(make_scene(layout, objects, seed, config))
            frame = corrected(cell.frame(), workspace.table_height)
            label = NetworkView(network, frame, workspace, crop=True).heights.label
            truth = height_map_from_scene(cell.truth(), workspace, cell=CELL).label
            yield faults(label, truth)


def faults(label: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """(M, 2) bool, cut and joined, of the M objects of which enough is seen. label, truth: (R, C)
    int, negative where there is no object."""
    found = []
    for own in np.unique(truth[truth >= 0]):
        there = truth == own
        parts, cells = np.unique(label[there & (label >= 0)], return_counts=True)
        if cells.sum() < LEAST_CELLS:
            continue
        matter = (label == parts[cells.argmax()]) & (truth >= 0)
        found.append((cells.max() < SHARE * cells.sum(), cells.max() < SHARE * matter.sum()))
    return np.array(found, bool).reshape(-1, 2)


def _grey(rgb: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    return np.full((len(pixels), 3), 128, np.uint8)


if __name__ == "__main__":
    run_script(main)
