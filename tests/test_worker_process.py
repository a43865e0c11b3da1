"""What a worker process keeps, and what it must have in common with the main process."""

import os
import subprocess
import sys
import time
from importlib.metadata import version

import pytest

from utils import worker_process
from utils.errors import UserError
from utils.runs import REPOSITORY
from utils.worker_process import Job, check, facts_of, kept, work

MAIN = """
import multiprocessing, sys
from tests.test_worker_process import wait_without_end

if __name__ == "__main__":
    here, there = multiprocessing.Pipe()
    multiprocessing.Process(target=wait_without_end, args=(there,), daemon=True).start()
    here.recv()
    sys.exit(3)
"""


def wait_without_end(pipe):
    worker_process.leave_signals()
    pipe.send(None)
    time.sleep(300)


def test_a_main_process_ends_with_workers_that_ignore_its_sigterm(tmp_path):
    """Such as after an error while images are loaded."""
    (tmp_path / "script.py").write_text(MAIN)
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY)}
    command = [sys.executable, tmp_path / "script.py"]
    assert subprocess.run(command, env=environment, timeout=60).returncode == 3


def test_a_process_carries_out_one_call_at_a_time():
    job = Job("a", 60.0)
    with pytest.raises(UserError, match="start it with --nthreads 1"):
        work(job, lambda: work(job, lambda: 1))
    assert work(job, lambda: 1) == 1


class Cell:
    open = 0

    def __init__(self, name):
        self.name = name
        Cell.open += 1

    def close(self):
        Cell.open -= 1


cell_of = kept(Cell)


@pytest.fixture(autouse=True)
def new_process(monkeypatch):
    monkeypatch.setattr(worker_process, "_begun", None)
    monkeypatch.setattr(worker_process, "_kept", {})


def test_what_is_kept_is_made_once_for_a_job_and_closed_after_it():
    cells = [work(Job("a", 60.0), lambda: cell_of("x")) for _ in range(2)]
    assert cells[0] is cells[1] and Cell.open == 1
    other = work(Job("a", 60.0), lambda: cell_of("y"))
    assert other.name == "y" and Cell.open == 2
    assert work(Job("b", 60.0), lambda: cell_of("x")) is not cells[0]
    assert Cell.open == 1


def test_packages_that_make_the_bits_are_compared():
    """Images, meshes and shards; the names are those of requirements.txt."""
    makers = {"opencv-python-headless", "pillow", "trimesh", "manifold3d", "h5py"}
    facts = facts_of([])
    assert makers <= set(facts)
    assert all(facts[name] == version(name) for name in makers)


def test_a_worker_with_other_weights_is_refused(tmp_path, monkeypatch):
    """Those that the project's planners load; other files there do not matter."""
    (tmp_path / "checkpoints").mkdir()
    weights = tmp_path / "checkpoints" / "critic.pt"
    weights.write_bytes(b"one")
    monkeypatch.setattr(worker_process, "REPOSITORY", tmp_path)
    facts = facts_of([])
    worker_process._content.cache_clear()  # as in a process that starts now
    (tmp_path / "checkpoints" / "mine.pt").write_bytes(b"mine")
    check(facts)
    worker_process._content.cache_clear()
    weights.write_bytes(b"another")
    with pytest.raises(
        UserError, match="the content of checkpoints/critic.pt is .* there and .* here"
    ):
        check(facts)


def test_a_worker_that_does_not_know_a_fact_is_refused():
    with pytest.raises(UserError, match="a package of tomorrow is missing there and 1.0 here"):
        check({"a package of tomorrow": "1.0"})


def test_a_plug_in_is_known_by_the_content_of_its_module(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "planner_of_mine.py").write_text("def plan(frame): return []\n")
    names = ["utils", "planner_of_mine", "no_such.module"]
    facts = facts_of(names)
    assert facts["the source of no_such.module"] == "missing"
    assert work(Job("a", 60.0, facts), lambda: 3) == 3
    worker_process._digest.cache_clear()  # as in a process that starts now
    (tmp_path / "planner_of_mine.py").write_text("def plan(frame): return None\n")
    with pytest.raises(UserError, match="the source of planner_of_mine is .* there and .* here"):
        work(Job("b", 60.0, facts), lambda: 3)
