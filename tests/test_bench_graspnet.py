"""The benchmark runs and reports; what it measures depends on the machine and is not tested."""

from __future__ import annotations

import json
import mmap
from pathlib import Path

import numpy as np
import psutil
import pytest
import torch

from benchmarks import bench_graspnet
from models.graspnet import create_model
from models.graspnet_backbones import BACKBONES
from models.graspnet_io import save_graspnet
from tests.helpers.systems import needs_proc
from utils.transforms import RGBDFrame, look_at


@pytest.mark.slow
def test_quick_benchmark_writes_every_metric(tmp_path):
    checkpoint, path = tmp_path / "net.pt", tmp_path / "bench.json"
    save_graspnet(checkpoint, create_model(name="ggcnn"), 0.002)
    threads = torch.get_num_threads()
    bench_graspnet.main(["--quick", "--json", str(path), "--checkpoint", str(checkpoint)])
    assert torch.get_num_threads() == threads, "later work is not touched"
    content = json.loads(path.read_text())
    for name in BACKBONES:
        assert content[f"{name}_network_ms"]["value"] > 0
        assert content[f"{name}_frame_to_grasps_ms"]["value"] > 0
    # Parameters from tests/test_graspnet.py: the papers' and the tutorial's, with our heads.
    heads = 20 * 33
    assert content["ggcnn_parameters"]["value"] == 62_420 - 4 * 129 + heads + 3 * 32 * 81
    targets = {name: metric["target"] for name, metric in content.items() if metric["target"]}
    assert targets == {
        "post_processing_ms": "<= 4",
        "frame_to_grasps_ms": "<= 25",
        "planner_ms": "<= 25",
        "planner_post_processing_ms": "<= 4",
        "angle_error_deg": "<= 10",
    }
    assert 1 <= content["labelled_test_images"]["value"] <= 6
    assert 1 <= content["grasps_post_processed"]["value"] <= 20
    if Path("/proc/self/status").exists():
        peak, imports = (content[f"peak_memory{part}_mib"]["value"] for part in ("", "_of_imports"))
        # At least the weights come on top of the imports.
        assert peak > imports + content["tutorial_parameters"]["value"] * 4 / 2**20


def test_peaks_are_put_where_a_network_finds_none():
    depth = np.full((60, 60), 0.8, np.float32)
    segmentation = np.full((60, 60), -1, np.int32)
    depth[10:50, 10:50], segmentation[10:50, 10:50] = 0.75, 0
    K = np.array([[120.0, 0, 29.5], [0, 120.0, 29.5], [0, 0, 1]])
    frame = RGBDFrame(
        np.zeros((60, 60, 3), np.uint8), depth, K,
        look_at((0.5, 0, 0.8), (0.5, 0, 0), (1, 0, 0)), segmentation,
    )  # fmt: skip
    flat = torch.full((1, 1, 60, 60), 0.1)
    others = torch.zeros(1, 18, 60, 60), torch.full((1, 1, 60, 60), 0.04)
    maps = bench_graspnet.maps_with_peaks((flat, *others), frame)
    grasps = bench_graspnet.post_process(maps, frame)
    assert len(grasps) >= 5
    # 5 cm above the table, and sideways within the block's 20 pixels and a peak's own step.
    for grasp in grasps:
        assert np.abs(grasp.position[:2] - (0.5, 0.0)).max() < 21 * 0.75 / 120
        assert grasp.position[2] < 0.05
    assert bench_graspnet.maps_with_peaks(maps, frame) is maps


@needs_proc
def test_the_peak_of_memory_stays_after_it_was_given_back():
    # Of the system, not of the heap, which may have as much left over from other tests.
    with mmap.mmap(-1, 2**28) as held:  # 256 MiB
        np.frombuffer(held, np.uint8)[:] = 1
        resident = psutil.Process().memory_info().rss / 2**20
        assert resident > 256
    assert psutil.Process().memory_info().rss / 2**20 < resident - 200
    # The kernel counts in batches of pages, for every processor.
    assert bench_graspnet.peak_mib() > resident - 64
