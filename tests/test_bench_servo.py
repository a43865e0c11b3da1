"""The benchmark of the laws beside machinevision-toolbox-python."""

from __future__ import annotations

import json
import sys

import numpy as np
import pytest

from benchmarks import bench_servo
from utils.servo_reference import GOAL, START


@pytest.mark.slow
def test_same_iterations_as_the_toolbox():
    pytest.importorskip("machinevisiontoolbox", reason=bench_servo.HOW_TO_INSTALL)
    ours, theirs = bench_servo.our_run(START, GOAL), bench_servo.peer_run(START, GOAL)
    assert ours[0] == theirs[0] == 534
    # Both stop within a hundredth of a millimetre, and of each other's pose.
    np.testing.assert_allclose(ours[1], theirs[1], atol=2e-6)


def test_benchmark_says_how_to_install_the_toolbox(monkeypatch):
    monkeypatch.setitem(sys.modules, "machinevisiontoolbox", None)  # as if it were not there
    with pytest.raises(SystemExit, match="pip install --no-deps machinevision-toolbox-python"):
        bench_servo.main([])


@pytest.mark.slow
def test_benchmark_writes_its_metrics(tmp_path, capsys):
    pytest.importorskip("machinevisiontoolbox", reason=bench_servo.HOW_TO_INSTALL)
    bench_servo.main(["--quick", "--json", str(tmp_path / "servo.json")])
    metrics = json.loads((tmp_path / "servo.json").read_text())
    assert metrics["iterations_A_ours"]["value"] == 534
    assert metrics["converged_hybrid_2.5d"]["holds"]
    assert "step_time_toolbox_over_ours" in capsys.readouterr().out
