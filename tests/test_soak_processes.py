"""Disks that are full or read-only, where this process may mount one; workers and scripts."""

import signal
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from threading import Event

import numpy as np
import pytest

from benchmarks import soak_processes
from benchmarks.soak_files import KINDS, Kind
from benchmarks.soak_processes import (
    FAULTS,
    JOURNAL,
    WRITTEN,
    _disturb,
    _stopped,
    _try_to_write,
    small_disk,
    soak_disk,
)
from benchmarks.soak_tally import Tally
from utils.config import load_config
from utils.errors import UserError

# --- Disks ----------------------------------------------------------------------------------------


def test_what_is_written_to_a_full_or_read_only_disk_is_not_lost():
    with ExitStack() as stack:
        try:
            stack.enter_context(small_disk())
        except UserError as error:
            pytest.skip(str(error))
    tallies = list(soak_disk(0.01, 0, Event()))
    assert len(tallies) == 2 * len(WRITTEN)
    for tally in tallies:
        assert tally.tried == tally.survived == 5 and tally.lost == 0, tally


@pytest.mark.parametrize("name", WRITTEN)
def test_a_written_file_that_is_not_whole_is_lost(tmp_path, name):
    (kind,) = [one for one in KINDS if one.name == name]
    path = tmp_path / name
    kind.write(path)
    whole = path.read_bytes()
    assert _try_to_write(kind, path, whole, whole) == (True, 0, True)

    cut = len(whole) * 4 // 5
    if path.suffix == ".yaml":  # in a key: a cut number may be a number
        cut = whole.rfind(b"\n", 0, cut) + 4

    def write_most(path):
        with path.open("ab" if name == JOURNAL else "wb") as file:
            file.write(whole[:cut])

    path.write_bytes(whole)
    most = Kind(name, write_most, kind.read)
    assert _try_to_write(most, path, whole, whole) == (True, 1, True)


# --- Workers --------------------------------------------------------------------------------------


class Threads(ThreadPoolExecutor):
    """In place of processes, which take seconds to start."""

    def __init__(self, compute, workers):
        super().__init__(workers)

    def size(self):
        return self._max_workers


@pytest.mark.parametrize(("times", "survived"), [(1, 2), (2, 0)])
def test_a_fault_counts_only_with_the_expected_number_of_calls(monkeypatch, times, survived):
    """What is slow has to be made once, what hangs once more."""
    monkeypatch.setattr(soak_processes, "open_executor", Threads)
    monkeypatch.setitem(FAULTS, "are slow", (bool, times))
    tally = Tally("workers are slow")
    _disturb(load_config().compute, "are slow", 2, tally, Event())
    assert (tally.tried, tally.survived, tally.lost) == (2, survived, 0)


# --- Scripts that are stopped ---------------------------------------------------------------------

SCRIPT = """
import pathlib, signal, sys, time
if HANDLES:
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
run = pathlib.Path("runs/evaluate/one")
run.mkdir(parents=True, exist_ok=True)
for name in ("config.yaml", "environment.json"):
    (run / name).touch()
print("results in", run, flush=True)
turns = run / "turns"
with turns.open("a") as file:
    file.write(".")
time.sleep(60 if turns.stat().st_size < 3 else 0)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="has no SIGTERM that a script can handle")
@pytest.mark.parametrize("handles", [True, False])
def test_sigterm_without_a_handler_is_noticed(tmp_path, handles):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT.replace("HANDLES", str(handles)))
    results = iter([["unfinished"], ["unfinished"], ["whole"]][2 * handles :])
    sound, lost, stops = _stopped(
        [str(script)], tmp_path / "place", signal.SIGTERM, 2.0, np.random.default_rng(0),
        lambda run: next(results), ["whole"],
    )  # fmt: skip
    assert (sound, lost, stops) == (handles, 0, 2)
