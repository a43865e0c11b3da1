"""Time from a frame to ranked grasps: python -m benchmarks.bench_planning [--json FILE]

The median over frames of fresh piles for the planners of the scoreboard and for those that grasp
from any side, with all cores of this machine and nothing else running. An unmeasured pass over all
frames comes first.
"""

from __future__ import annotations

from collections.abc import Sequence
from time import perf_counter

import numpy as np

from benchmarks.metrics import Metric, benchmark_parser, report
from envs.cell_scenes import make_scene
from envs.evaluation_worker import new_planner
from envs.objects import load_object_set
from envs.simulators import make_cell
from models.planner_graspnet import GraspNetFanPlanner
from models.planners import Planner
from utils.config import Config, load_config
from utils.runs import run_script
from utils.transforms import RGBDFrame

FAN = "graspnet6d, always from all sides"
PLANNERS = (
    "random", "heuristic", "graspnet_direct", "graspnet", "oracle", "heuristic6d", "graspnet6d",
    FAN,
)  # fmt: skip
AIMS = {"graspnet_direct": 20.0, "graspnet": 25.0, FAN: 500.0}  # ms, for piles of AIMED_AT
AIMED_AT = 5
COUNTS = (5, 15)  # objects in a pile
FIRST_SEED = 710_000  # of the scenes
FRAMES = 20


def main(argv: Sequence[str] | None = None) -> None:
    parser = benchmark_parser(__doc__.splitlines()[0])
    options = parser.parse_args(argv)
    frames = 2 if options.quick else FRAMES
    metrics = []
    for count in COUNTS:
        config = load_config(None, ["sim.renderer=tiny", f"scene.count={count}"])
        seen = frames_of(config, frames)
        metrics += [
            Metric(
                f"{name}, pile of {count}",
                median_ms(planner_of(name, config), seen),
                "ms",
                at_most=AIMS.get(name) if count == AIMED_AT else None,
            )
            for name in PLANNERS
        ]
    report(metrics, options.json)


def frames_of(config: Config, count: int, object_set: str = "random_urdfs") -> list[RGBDFrame]:
    """Frames, with the truth that the oracle needs, of piles of unseen objects."""
    objects = load_object_set(object_set, cache_dir=config.cache_folder)
    frames = []
    with make_cell(config) as cell:
        for seed in range(FIRST_SEED, FIRST_SEED + count):
            cell.load(make_scene("pile", objects, seed, config))
            frames.append(cell.frame(with_truth=True))
    return frames


def planner_of(name: str, config: Config) -> Planner:
    if name == FAN:
        workspace = config.workspace.geometry
        return GraspNetFanPlanner(config.gripper.geometry, workspace, config.seed, likely=np.inf)
    return new_planner(name, config)


def median_ms(plan: Planner, frames: Sequence[RGBDFrame]) -> float:
    """The median time of plans in milliseconds, after a pass over all frames that is not timed."""
    times = []
    for frame in [*frames, *frames]:
        start = perf_counter()
        plan(frame)
        times.append(1000 * (perf_counter() - start))
    return float(np.median(times[len(frames) :]))


if __name__ == "__main__":
    run_script(main)
