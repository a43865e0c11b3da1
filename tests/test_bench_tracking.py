"""The benchmark of the tracking runs, and counts what it has tried."""

from __future__ import annotations

import json

import pytest

from benchmarks import bench_labels, bench_policy, bench_ppo, bench_tracking
from benchmarks.bench_tracking import HEIGHTS, main


def test_a_quick_run_counts_every_sighting(tmp_path, config):
    path = tmp_path / "tracking.json"
    main(["--quick", "--json", str(path), "sim.renderer=tiny"])
    metrics = json.loads(path.read_text())
    for objects in config.data.object_sets:
        for height in HEIGHTS:
            name = f"{objects}_{round(100 * height)}cm"
            tried, found = (metrics[f"{name}_{what}"]["value"] for what in ("tried", "found"))
            assert 0 < found <= tried <= 2, "two scenes, one sighting each"
            # The tracker's alignment is the tested part; here only that the truth is the truth.
            assert metrics[f"{name}_place_p50"]["value"] < 10.0, "mm, of up to 21 mm moved"


@pytest.mark.parametrize(
    ("benchmark", "option"),
    [
        (bench_tracking, "--scenes"), (bench_tracking, "--views"), (bench_labels, "--scenes"),
        (bench_policy, "--episodes"), (bench_ppo, "--seeds"), (bench_ppo, "--steps"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("count", ["0", "-1", "many"])
def test_benchmarks_count_from_1(benchmark, option, count, capsys):
    with pytest.raises(SystemExit, match="2"):
        benchmark.main([option, count])
    error = capsys.readouterr().err
    assert f"argument {option}: got {count}, expected a whole number of at least 1" in error
