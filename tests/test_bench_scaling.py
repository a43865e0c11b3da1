"""The benchmark of scaling: which workers it kills."""

import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import psutil
import pytest

pytest.importorskip("distributed", reason="pip install distributed")

from benchmarks import bench_scaling
from benchmarks.bench_scaling import EACH, is_busy


def started(code):
    """A process that runs the code once Python has started there."""
    code = f"import time; print(flush=True)\n{code}"
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
    process.stdout.readline()
    return process


@pytest.mark.parametrize(("code", "busy"), [("while True: pass", True), ("time.sleep(60)", False)])
def test_a_process_that_computes_is_busy(code, busy):
    with started(code) as process:
        try:
            assert is_busy(psutil.Process(process.pid)) is busy
        finally:
            process.kill()


def test_only_busy_workers_are_killed_some_scenes_apart(monkeypatch):
    finished, kills = 0, []

    def worker_processes():
        return [SimpleNamespace(kill=lambda: kills.append(finished))]

    def rounds(workers, config, plan, after):
        nonlocal finished
        for finished in range(1, 5 * EACH):
            after(finished)
        return []

    monkeypatch.setattr(bench_scaling, "worker_processes", worker_processes)
    monkeypatch.setattr(bench_scaling, "is_busy", lambda process: finished % 2 == 0)
    monkeypatch.setattr(bench_scaling, "rounds", rounds)
    metrics = bench_scaling._survived("local", None, None, [], 3, [])
    assert metrics[0].value == len(kills) == 3
    assert all(moment % 2 == 0 for moment in kills)
    assert kills[0] >= EACH and np.diff(kills).min() >= EACH
