"""The benchmark of scaling: which workers it kills."""

from functools import partial
from types import SimpleNamespace

import pytest

pytest.importorskip("distributed", reason="pip install distributed")

from benchmarks import bench_scaling
from benchmarks.bench_scaling import is_busy


@pytest.mark.parametrize(("percent", "busy"), [(100.0, True), (0.0, False)])
def test_a_process_that_computes_is_busy(percent, busy):
    """By its share of a core over some time, without which psutil's first answer is always 0."""
    process = SimpleNamespace(cpu_percent=lambda interval=None: percent if interval else 0.0)
    assert is_busy(process) is busy


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
