"""What a GPU adds: python -m benchmarks.bench_gpu [--json FILE]

GraspNet's training step, its maps of a batch of images, and the plans of those planners that have
networks, on the GPU and on all cores of the same machine; and MuJoCo's pictures by the OpenGL that
this machine offers. Of a plan with six degrees of freedom the search in the fan, too, runs on the
GPU where all views are searched at once, of others the networks alone; by default such a plan looks
from straight above first, and needs the fan in some scenes. Without a GPU only the figures of the
CPU appear. Images and targets are random, but for the piles that are planned: their content does
not change the speed.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from time import perf_counter

import numpy as np
import torch

from benchmarks.bench_planning import frames_of, median_ms
from benchmarks.metrics import Metric, benchmark_parser, report
from envs.cell_scenes import make_scene
from envs.mujoco_camera import opengl_renderer
from envs.objects import load_object_set
from envs.simulators import make_cell
from models.grasp_critic import SHIPPED as CRITIC
from models.grasp_critic import load_critic
from models.graspnet import GraspTargets
from models.graspnet_data import Example
from models.graspnet_io import SHIPPED, for_inference, load_graspnet
from models.graspnet_training import Trainer, make_network
from models.planner_graspnet import GraspNetFanPlanner, GraspNetPlanner
from utils.config import Config, load_config
from utils.distributed import Team
from utils.geometry import GripperGeometry, Workspace
from utils.grasp_labels import ANGLE_BINS
from utils.runs import run_script
from utils.transforms import RGBDFrame

PLANNED = (1, 8, 64)  # images of a batch whose maps are predicted
PILE = 5  # objects of the piles that are planned
CPU = torch.device("cpu")


def main(argv: Sequence[str] | None = None) -> None:
    parser = benchmark_parser(__doc__.splitlines()[0])
    options = parser.parse_args(argv)
    repeats = 2 if options.quick else 20
    config = load_config()
    torch.set_num_threads(os.cpu_count() or 1)
    devices = [CPU]
    if torch.cuda.is_available():
        devices.append(torch.device("cuda", 0))
        print(f"GPU: {torch.cuda.get_device_name(0)}")
    seen = frames_of(load_config(None, [f"scene.count={PILE}"]), repeats, "primitives")
    rates = {device: speeds(config, device, repeats) | plans(seen, device) for device in devices}
    metrics = [Metric("threads of the CPU", torch.get_num_threads(), "")]
    for device, values in rates.items():
        metrics += [Metric(f"{name}, {device.type}", rate, "/s") for name, rate in values.items()]
    for device in devices[1:]:
        metrics += [
            Metric(f"{name}, GPU over CPU", rates[device][name] / rate, "x")
            for name, rate in rates[CPU].items()
        ]
    print(f"OpenGL of MuJoCo's camera: {opengl_renderer()}")
    report([*metrics, *pictures(repeats)], options.json)


def speeds(config: Config, device: torch.device, repeats: int) -> dict[str, float]:
    """Images a second of training and of prediction on a device."""
    trainer = Trainer(
        make_network(config, GripperGeometry().max_opening), config.train, 1000, Team(0, 1, device)
    )
    size = (config.camera.height, config.camera.width)
    batch = random_examples(config.train.batch_size, *size)
    rates = {
        "images trained": config.train.batch_size
        / median_seconds(lambda: trainer.train_step(batch), device, repeats)
    }
    model, precision = trainer.model.eval(), trainer.precision
    lower = precision != torch.float32
    with torch.inference_mode(), torch.autocast(device.type, precision, enabled=lower):
        for count in PLANNED:
            images = torch.randn(count, 4, *size, device=device)
            images = images.to(memory_format=torch.channels_last)
            taken = median_seconds(lambda images=images: model(images), device, repeats)
            rates[f"images predicted, batch of {count}"] = count / taken
    return rates


def plans(frames: Sequence[RGBDFrame], device: torch.device) -> dict[str, float]:
    """Plans a second with the networks on a device."""
    saved = load_graspnet(SHIPPED)
    network = saved._replace(model=for_inference(saved.model).to(device))
    hand_and_table, critic = (GripperGeometry(), Workspace()), load_critic(CRITIC).to(device)
    planar = GraspNetPlanner(*hand_and_table, network=network, critic=critic)
    fan = GraspNetFanPlanner(*hand_and_table, network=network, critic=critic)
    likely = fan.likely
    rates = {f"plans of graspnet, pile of {PILE}": 1000 / median_ms(planar, frames)}
    for way, at_once, fan.likely in (
        ("view by view", False, np.inf),
        ("all views at once", True, np.inf),
        ("from straight above first", device.type == "cuda", likely),
    ):
        fan.at_once = at_once
        rates[f"plans of graspnet6d, pile of {PILE}, {way}"] = 1000 / median_ms(fan, frames)
    return rates


def random_examples(count: int, height: int, width: int) -> Example:
    generator = torch.Generator().manual_seed(0)

    def even(channels: int) -> torch.Tensor:
        return torch.rand(count, channels, height, width, generator=generator)

    angle = even(ANGLE_BINS)
    targets = GraspTargets(
        quality=even(1),
        angle=angle / angle.sum(1, keepdim=True),
        width=0.08 * even(1),
        valid=torch.ones(count, 1, height, width),
        graspable=even(1).round(),
        offset=even(2),
        on_object=even(1).round(),
    )
    return Example(even(4), targets)


def median_seconds(work: Callable[[], object], device: torch.device, repeats: int) -> float:
    """The median time of a call, with all that it leaves to the GPU."""
    times = []
    for number in range(repeats + 3):  # kernels are chosen and caches fill up in the first three
        start = perf_counter()
        work()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        if number >= 3:
            times.append(perf_counter() - start)
    return float(np.median(times))


def pictures(repeats: int) -> list[Metric]:
    """The time of an RGB-D image with segmentation in MuJoCo."""
    metrics = []
    for size in (64, 224):
        config = load_config(
            None, ["simulator=mujoco", f"camera.width={size}", f"camera.height={size}"]
        )
        objects = load_object_set("primitives", cache_dir=config.cache_folder)
        with make_cell(config) as cell:
            cell.load(make_scene("pile", objects, 0, config))
            taken = median_seconds(cell.frame, CPU, repeats)
        metrics.append(Metric(f"MuJoCo image of {size} pixels", 1e3 * taken, "ms"))
    return metrics


if __name__ == "__main__":
    run_script(main)
