"""The benchmark runs and reports; what it measures depends on the machine and is not tested."""

import json
import operator

import pytest

pytest.importorskip("panda_gym")

from benchmarks import bench_env
from benchmarks.metrics import Metric, format_metrics, median_ratio


@pytest.mark.slow
def test_quick_benchmark_writes_every_metric(tmp_path, capfd):
    path = tmp_path / "bench.json"
    bench_env.main(["--quick", "--json", str(path)])
    content = json.loads(path.read_text())
    assert {name: metric["target"] for name, metric in content.items()} == {
        "step_vs_panda_gym": ">= 1.6",
        "step_vs_bare_physics": "<= 1.2",
        "steps_per_second": None,
        "held_step_vs_panda_gym": ">= 1.6",
        "held_step_vs_bare_physics": "<= 1.2",
        "held_steps_per_second": None,
        "frame_64_vs_stock": ">= 8",
        "frame_224_vs_stock": ">= 2.2",
        "physics_5_objects_vs_stock": ">= 2",
        "physics_5_objects_and_robot_vs_stock": None,
        "two_processes_vs_one": ">= 1.8",
    }
    compare = {">=": operator.ge, "<=": operator.le}
    for metric in content.values():
        assert set(metric) == {"value", "unit", "target", "holds"} and metric["value"] > 0
        if metric["target"] is None:
            assert metric["holds"] is None
        else:
            sign, bound = metric["target"].split()
            assert metric["holds"] is compare[sign](metric["value"], float(bound))
    assert all(name in capfd.readouterr().out for name in ["step_vs_panda_gym"])


def test_median_ratio_and_table():
    a, b = iter([9.0, 2.0, 8.0, 30.0]), iter([9.0, 1.0, 2.0, 3.0])
    assert median_ratio(lambda: next(a), lambda: next(b), 3) == 4.0  # of 2, 4 and 10, warm-up aside
    table = format_metrics([Metric("speed", 1.0, "x", at_least=2), Metric("size", 3.0, "m")])
    assert table.splitlines()[1].split() == ["speed", "1", "x", ">=", "2", "NO"]
    assert table.splitlines()[2].split() == ["size", "3", "m", "-", "-"]
