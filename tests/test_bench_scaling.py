"""The benchmark of scaling: which workers it kills."""

import subprocess
import sys
from functools import partial
from types import SimpleNamespace

import psutil
import pytest

pytest.importorskip("distributed", reason="pip install distributed")

from benchmarks import bench_scaling
from benchmarks.bench_scaling import is_busy


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


def test_only_the_oldest_worker_is_killed_and_only_while_it_is_busy(monkeypatch):
    finished, kills = 0, []

    def worker_processes():
        names = ["oldest", "younger"]
        return [SimpleNamespace(pid=name, kill=partial(kills.append, finished)) for name in names]

    def rounds(workers, config, plan, after):
        nonlocal finished
        for finished in range(10):
            after(finished)
        return []

    monkeypatch.setattr(bench_scaling, "worker_processes", worker_processes)
    busy = {3, 4, 7, 8}
    monkeypatch.setattr(
        bench_scaling, "is_busy", lambda one: one.pid == "oldest" and finished in busy
    )
    monkeypatch.setattr(bench_scaling, "rounds", rounds)
    (killed, *_) = bench_scaling._survived("local", None, None, [], 3, [])
    assert killed.value == 3 and kills == [3, 4, 7]
