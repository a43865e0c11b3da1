"""The benchmark of the GPU, on the CPU: its batch is a legal one, and each rate is measured."""

import torch

from benchmarks import bench_gpu
from benchmarks.bench_planning import frames_of
from utils.config import load_config


def test_random_targets_are_legal():
    image, targets = bench_gpu.random_examples(2, 16, 24)
    assert image.shape == (2, 4, 16, 24)
    torch.testing.assert_close(targets.angle.sum(1), torch.ones(2, 16, 24))
    assert set(targets.graspable.unique().tolist()) == {0.0, 1.0}
    assert targets.width.min() >= 0 and targets.width.max() <= 0.08


def test_training_and_prediction_are_timed(monkeypatch):
    monkeypatch.setattr(bench_gpu, "PLANNED", (1, 2))
    small = load_config(None, ["camera.width=64", "camera.height=64", "train.batch_size=2"])
    rates = bench_gpu.speeds(small, bench_gpu.CPU, 1)
    assert list(rates) == [
        "images trained", "images predicted, batch of 1", "images predicted, batch of 2"
    ]  # fmt: skip
    assert min(rates.values()) > 0


def test_the_time_of_a_call_is_the_median(monkeypatch):
    clock = iter([0, 10, 20, 30, 31, 40, 42, 50, 53])  # three warm-ups, of which no time is taken
    monkeypatch.setattr(bench_gpu, "perf_counter", lambda: next(clock))
    assert bench_gpu.median_seconds(lambda: None, bench_gpu.CPU, 3) == 2


def test_plans_are_timed():
    small = load_config(None, ["camera.width=64", "camera.height=64", "scene.count=1"])
    seen = frames_of(small, 1, "primitives")
    rates = bench_gpu.plans(seen, bench_gpu.CPU)
    assert list(rates) == [
        "plans of graspnet, pile of 5", "plans of graspnet6d, pile of 5, view by view",
        "plans of graspnet6d, pile of 5, all views at once",
        "plans of graspnet6d, pile of 5, from straight above first",
    ]  # fmt: skip
    assert min(rates.values()) > 0
