"""GraspNet's speed from a frame to ranked grasps: python -m benchmarks.bench_graspnet [--json FILE]

For every backbone on all cores of this machine, at the default camera's 224 pixels; everything is
the median of many runs. Weights do not change the speed, peaks do: without a checkpoint that finds
some, as many as are ever returned are put on the objects. Memory is that of a process of its own.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from time import perf_counter

import numpy as np
import torch

from benchmarks.metrics import Metric, benchmark_parser, median_ratio, report
from envs.cell_scenes import make_scene
from envs.objects import load_object_set, load_objects
from envs.simulators import make_cell
from models.graspnet import GraspNet, create_model, to_input
from models.graspnet_backbones import BACKBONES
from models.graspnet_decoding import PeakSettings, decode_grasps, find_peaks
from models.graspnet_io import (
    SHIPPED,
    SavedGraspNet,
    fastest_dtype,
    for_inference,
    load_graspnet,
    metres_per_pixel,
)
from models.graspnet_scores import score_labels
from models.planner_graspnet import GraspNetPlanner
from utils.augmentation import LabelledImage
from utils.config import load_config
from utils.geometry import GripperGeometry, Workspace
from utils.grasp_labels import GraspLabels, dense_labels
from utils.runs import REPOSITORY, run_script
from utils.transforms import RGBDFrame

LABELLED = 120  # scenes of test objects, both sets and all layouts in turn
FIRST_SEED = 700_000  # of these scenes
MEMORY_RUN = "--measure-memory"  # how the benchmark starts itself to measure memory
Maps = tuple[torch.Tensor, torch.Tensor, torch.Tensor]


def main(argv: Sequence[str] | None = None) -> None:
    parser = benchmark_parser(__doc__.splitlines()[0])
    parser.add_argument("--checkpoint", type=Path, metavar="FILE", help="weights; default: shipped")
    options = parser.parse_args(argv)
    repeats = 3 if options.quick else 100
    default = load_config().train.backbone
    trained = trained_network(options.checkpoint)
    frame = example_frame()
    metrics = [Metric("threads", os.cpu_count(), "")]
    with all_cores():
        for name in BACKBONES:
            is_trained = trained is not None and trained.model_args["backbone"] == name
            model = trained if is_trained else create_model(name=name)
            metrics += bench_backbone(name, model.eval(), frame, repeats, name == default)
        if trained is not None:
            metrics += label_metrics(trained, 6 if options.quick else LABELLED)
    report([*metrics, *memory_metrics(default)], options.json)


def trained_network(path: Path | None) -> GraspNet | None:
    """The network of a checkpoint, else the shipped one, else None."""
    if path is None and not SHIPPED.exists():
        return None
    return load_graspnet(path or SHIPPED).model


def example_frame() -> RGBDFrame:
    """A pile of five objects on the table."""
    config = load_config(None, ["sim.renderer=tiny"])
    objects = load_object_set("primitives", cache_dir=config.cache_folder)
    with make_cell(config) as cell:
        cell.load(make_scene("pile", objects, 0, config))
        return cell.frame()


@contextmanager
def all_cores() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(os.cpu_count() or 1)
    try:
        with torch.inference_mode():
            yield
    finally:
        torch.set_num_threads(before)


# --- Speed ----------------------------------------------------------------------------------


def bench_backbone(
    name: str, model: GraspNet, frame: RGBDFrame, repeats: int, is_default: bool
) -> list[Metric]:
    """Size and speed of one network; of the default one also of each part."""
    fast = for_inference(model, fastest_dtype())  # as the planners have it
    image = prepare(frame)
    maps = maps_with_peaks(fast(image), frame)

    def whole() -> None:
        fast(prepare(frame))
        post_process(maps, frame)

    network_ms = median_ms(lambda: fast(image), repeats)
    whole_ms = median_ms(whole, repeats)
    metrics = [
        Metric(f"{name}_parameters", sum(p.numel() for p in model.parameters()), ""),
        Metric(f"{name}_network_ms", network_ms, "ms"),
        Metric(f"{name}_frame_to_grasps_ms", whole_ms, "ms"),
    ]
    if not is_default:
        return metrics
    scale = metres_per_pixel(frame.K, float(np.median(frame.depth)))
    faster = median_ratio(
        lambda: seconds(lambda: model(image)), lambda: seconds(lambda: fast(image)), repeats
    )
    exact = for_inference(model)
    over_float32 = median_ratio(
        lambda: seconds(lambda: exact(image)), lambda: seconds(lambda: fast(image)), repeats
    )
    over_network = median_ratio(
        lambda: seconds(whole), lambda: seconds(lambda: fast(image)), repeats
    )
    plan = planner_of(fast, scale)
    planned = median_ms(lambda: plan(frame), repeats)
    prepared = median_ms(lambda: prepare(frame), repeats)
    decoded = median_ms(lambda: post_process(maps, frame), repeats)
    return [
        *metrics,
        Metric("preparation_ms", prepared, "ms"),
        Metric("post_processing_ms", decoded, "ms", at_most=4),
        Metric("grasps_post_processed", len(post_process(maps, frame)), ""),
        Metric("frame_to_grasps_ms", whole_ms, "ms", at_most=25),
        Metric("frame_to_grasps_vs_network", over_network, "x"),
        Metric("for_inference_speedup", faster, "x"),
        Metric("fastest_dtype_speedup", over_float32, "x"),  # 1 where it is float32
        # As evaluate.py plans with a network of one's own, which has no critic: by a search.
        Metric("planner_ms", planned, "ms", at_most=25),
        Metric("planner_post_processing_ms", planned - prepared - network_ms, "ms", at_most=4),
    ]


def planner_of(model: GraspNet, metres_per_pixel: float) -> GraspNetPlanner:
    """The planner with this network, trained or not."""
    network = SavedGraspNet(model, metres_per_pixel, {}, {})
    return GraspNetPlanner(GripperGeometry(), Workspace(), network=network)


def prepare(frame: RGBDFrame) -> torch.Tensor:
    image = to_input(frame.rgb, frame.depth)[None]
    return image.contiguous(memory_format=torch.channels_last)


def post_process(maps: Maps, frame: RGBDFrame) -> list:
    return decode_grasps(*maps, frame.K, frame.T_WC, frame.depth, GripperGeometry())


def maps_with_peaks(maps: Maps, frame: RGBDFrame) -> Maps:
    """A network's maps if they hold a peak; else its angles and widths with peaks on objects."""
    if len(find_peaks(*maps).pixel):
        return maps
    rng, most = np.random.default_rng(0), PeakSettings()
    objects = np.argwhere(frame.segmentation >= 0)
    v, u = np.mgrid[: frame.depth.shape[0], : frame.depth.shape[1]]
    quality = np.zeros(frame.depth.shape, np.float32)
    for row, column in objects[rng.permutation(len(objects))[: 3 * most.count]]:
        bump = np.exp(-((v - row) ** 2 + (u - column) ** 2) / 8)
        quality = np.maximum(quality, rng.uniform(0.7, 0.95) * bump)
    return torch.from_numpy(quality.astype(np.float32))[None, None], *maps[1:]


def median_ms(work: Callable[[], object], repeats: int) -> float:
    work()  # caches fill up
    return 1e3 * float(np.median([seconds(work) for _ in range(repeats)]))


def seconds(work: Callable[[], object]) -> float:
    start = perf_counter()
    work()
    return perf_counter() - start


# --- Truth ----------------------------------------------------------------------------------


def label_metrics(model: GraspNet, count: int) -> list[Metric]:
    """The network's top grasps against the dense labels of scenes of test objects."""
    config = load_config(None, ["sim.renderer=tiny"])
    sets = [load_objects(name, config) for name in ("random_urdfs", "primitives")]
    workspace = config.workspace.geometry
    images = []
    with make_cell(config) as cell:
        for number in range(count):
            layout = ("isolated", "packed", "pile")[number // 2 % 3]
            cell.load(make_scene(layout, sets[number % 2], FIRST_SEED + number, config))
            frame = cell.frame(with_truth=True)
            images.append(labelled(frame, dense_labels(frame, GripperGeometry(), workspace)))
    scores = score_labels(model, images)
    return [
        Metric("labelled_test_images", scores.images, ""),
        Metric("angle_error_deg", float(np.degrees(scores.angle_error)), "deg", at_most=10),
        Metric("width_error_mm", 1e3 * scores.width_error, "mm"),
        Metric("top_grasp_label_quality", scores.label_quality, ""),
        Metric("top_grasp_label_positive", scores.precision, ""),
    ]


def labelled(frame: RGBDFrame, labels: GraspLabels) -> LabelledImage:
    return LabelledImage(
        rgb=torch.from_numpy(np.moveaxis(frame.rgb, -1, 0).copy()),
        depth=torch.from_numpy(frame.depth),
        quality=torch.from_numpy(labels.quality),
        width=torch.from_numpy(labels.width),
        mask=torch.from_numpy(labels.valid),
    )


# --- Memory ---------------------------------------------------------------------------------


def memory_metrics(backbone: str) -> list[Metric]:
    """Highest memory of a new process that loads a network and looks at three images, and how much
    of it was there when all modules had been imported. Nothing where Linux does not say."""
    if not Path("/proc/self/status").exists():
        return []
    arguments = [sys.executable, "-m", "benchmarks.bench_graspnet", MEMORY_RUN, backbone]
    done = subprocess.run(arguments, cwd=REPOSITORY, capture_output=True, text=True, check=True)
    imports, peak = map(float, done.stdout.split()[-2:])
    return [
        Metric("peak_memory_mib", peak, "MiB"),
        Metric("peak_memory_of_imports_mib", imports, "MiB"),
    ]


def measure_memory(backbone: str) -> None:
    """Print the peaks after the imports and at the end, MiB."""
    imports = peak_mib()
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 256, (224, 224, 3), dtype=np.uint8)
    depth = rng.uniform(0.7, 0.8, (224, 224)).astype(np.float32)
    with all_cores():
        fast = for_inference(create_model(name=backbone))
        for _ in range(3):
            find_peaks(*fast(to_input(rgb, depth)[None]))
    print(imports, peak_mib())


def peak_mib() -> float:
    """Highest resident memory of this process so far. Not getrusage, whose figure begins with what
    the parent held."""
    status = Path("/proc/self/status").read_text()
    (line,) = (line for line in status.splitlines() if line.startswith("VmHWM:"))
    return int(line.split()[1]) / 1024


if __name__ == "__main__":
    if sys.argv[1:2] == [MEMORY_RUN]:
        measure_memory(sys.argv[2])
    else:
        run_script(main)
