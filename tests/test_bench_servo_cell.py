"""The benchmark of the laws in the cell."""

from __future__ import annotations

import pytest

from benchmarks import bench_servo_cell
from benchmarks.bench_servo_cell import LAWS
from utils.servo_features import MOUNTINGS


@pytest.mark.slow
def test_quick_benchmark_reports_every_law(capfd, tmp_path):
    bench_servo_cell.main(["--quick", "--json", str(tmp_path / "bench.json")])
    lines = capfd.readouterr().out.splitlines()
    assert len(lines) >= 1 + 4 * len(MOUNTINGS) * len(LAWS)
    assert not any(line.endswith("NO") for line in lines)
