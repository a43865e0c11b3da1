"""How well a moved object is found: python -m benchmarks.bench_tracking [--json FILE] [KEY=VALUE]

One test object on the table, seen once from overhead, when its grasp is planned, and then by the
wrist camera from places above the grasp, after the object has moved by an amount that the tracker
does not know. Errors are those of the grasp's frame against the simulator's truth: place in the
plane, and turn (a round object shows none). `seed` chooses the scenes, and
`camera.depth_noise=kinect` makes both cameras noisy.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from benchmarks.metrics import Metric, benchmark_parser, positive_int, report
from envs.cell import Cell
from envs.cell_scenes import make_scene
from envs.closed_loop_tracker import WristCamera
from envs.objects import load_objects
from envs.robot_kinematics import UnreachableError, choose_posture, moved
from envs.simulators import make_cell
from models.planners import make_planner
from utils.config import load_config
from utils.errors import TargetLostError
from utils.geometry import GripperGeometry
from utils.object_tracking import TemplateMatcher, grasp_frame, make_template
from utils.random_streams import Stream
from utils.runs import run_script
from utils.transforms import Grasp, inverse_pose, planar, planar_part

HEIGHTS = (0.25, 0.16, 0.10)  # m over the grasp: far, where the near stage begins, and below that
SHIFT, TURN = 0.015, np.radians(10)  # most that the object has moved from where it is expected
_BESIDE, _TILT = 0.015, np.radians(3)  # m and rad off the grasp's axis, of the hand


@dataclass
class Errors:
    """Of one object set from one height: metres, radians, and how many sightings were tried."""

    places: list[float] = field(default_factory=list)
    turns: list[float] = field(default_factory=list)
    tried: int = 0


def main(argv: Sequence[str] | None = None) -> None:
    parser = benchmark_parser(__doc__.splitlines()[0])
    parser.add_argument("overrides", nargs="*", metavar="KEY=VALUE", help="seed=3")
    parser.add_argument("--scenes", type=positive_int, default=30, help="of each object set")
    parser.add_argument(
        "--views", type=positive_int, default=4, help="of each scene from each height"
    )
    options = parser.parse_intermixed_args(argv)
    cv2.setNumThreads(1)
    scenes, views = (2, 1) if options.quick else (options.scenes, options.views)
    config = load_config(None, options.overrides)
    metrics = []
    with make_cell(config) as cell:
        for objects in config.data.object_sets:
            metrics += figures(objects, measure(cell, objects, scenes, views))
    report(metrics, options.json)


def measure(cell: Cell, objects: str, scenes: int, views: int) -> dict[float, Errors]:
    """Errors by height over the grasp, on `scenes` scenes of an object set."""
    config = cell.config
    workspace = config.workspace.geometry
    chosen = load_objects(objects, config)
    errors = {height: Errors() for height in HEIGHTS}
    for seed in range(config.seed * 100_000, config.seed * 100_000 + scenes):
        cell.load(make_scene("isolated", chosen, seed, config))
        frame = cell.frame()
        plan = make_planner("heuristic", GripperGeometry(), workspace, seed)
        grasps = plan(frame)
        if not grasps:
            continue
        try:
            template = make_template(frame, grasps[0])
        except TargetLostError:
            continue
        camera = WristCamera(cell)
        size = camera.intrinsics.width, camera.intrinsics.height
        tracker = TemplateMatcher(template, camera.intrinsics.K, size)
        rng, T_WB = np.random.default_rng([seed, Stream.TRACKED_MOTION]), cell.object_pose(0)
        for height in HEIGHTS:
            found = sightings(cell, camera, tracker, T_WB, grasps[0], height, views, rng)
            for place, turn in found:
                errors[height].tried += 1
                if place is not None:
                    errors[height].places.append(place)
                    if not tracker.round:
                        errors[height].turns.append(turn)
    return errors


def sightings(
    cell: Cell,
    camera: WristCamera,
    tracker: TemplateMatcher,
    T_WB: np.ndarray,
    grasp: Grasp,
    height: float,
    views: int,
    rng: np.random.Generator,
) -> Iterator[tuple[float | None, float | None]]:
    """Errors (m, rad) of finding the one object from `height` m over its grasp; None if lost.
    T_WB: (4, 4) the object when the grasp was planned."""
    T_WO = grasp_frame(grasp)
    for _ in range(views):
        T_WE = grasp.pose
        T_WE[2, 3] += height
        beside, tilt = rng.uniform(-_BESIDE, _BESIDE, 3), rng.uniform(-_TILT, _TILT, 3)
        motion = planar(*rng.uniform(-SHIFT, SHIFT, 2), rng.uniform(-TURN, TURN))
        about = planar(*T_WB[:2, 3], 0.0)
        motion = about @ motion @ inverse_pose(about)
        try:
            q = choose_posture(moved(T_WE, np.append(beside, tilt)), cell.home)
        except UnreachableError:
            continue
        cell.robot.place(q)
        cell.carry(0, motion @ T_WB, velocity=np.zeros(3), turn_rate=0.0)
        T_WC = cell.camera_pose("wrist")
        T_CW = inverse_pose(T_WC)
        try:
            found = tracker.find(camera().depth, T_CW @ T_WO, T_CW)
        except TargetLostError:
            yield None, None
            continue
        x, y, turn = planar_part(inverse_pose(motion @ T_WO) @ T_WC @ found.T_CO)
        yield float(np.hypot(x, y)), abs(turn)


def figures(objects: str, errors: dict[float, Errors]) -> list[Metric]:
    metrics = []
    for height, of in errors.items():
        name = f"{objects}_{round(100 * height)}cm"
        metrics.append(Metric(f"{name}_tried", of.tried, "sightings"))
        metrics.append(Metric(f"{name}_found", len(of.places), "sightings"))
        for what, values, scale, unit in (
            ("place", of.places, 1000.0, "mm"),
            ("turn", of.turns, np.degrees(1.0), "deg"),
        ):
            for share in (50, 95) if values else ():
                value = float(scale * np.percentile(values, share))
                metrics.append(Metric(f"{name}_{what}_p{share}", value, unit))
        metrics.append(Metric(f"{name}_with_a_turn", len(of.turns), "sightings"))
    return metrics


if __name__ == "__main__":
    run_script(main)
