"""What a worker process does with a call: its environment, a time limit, what it keeps, and checks.

`utils.executor` sends the calls. This module knows neither its engines nor what the calls compute.
"""

from __future__ import annotations

import atexit
import ctypes
import faulthandler
import functools
import hashlib
import importlib.util
import multiprocessing.util
import os
import pickle
import platform
import signal
import sys
import traceback
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Any, TypeVar

import cv2

from utils.errors import UserError
from utils.runs import PACKAGES, REPOSITORY, package_version

# What the project's planners load.
WEIGHTS = tuple(f"checkpoints/{name}" for name in ("graspnet.pt", "critic.pt", "calibration.json"))
SOURCES = ("envs", "models", "utils")  # this project's packages
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # of glibc's malloc.h

Result = TypeVar("Result")
_busy = Lock()


@dataclass(frozen=True)
class Job:
    """What comes with each call of one executor.

    name: differs from that of any other executor. seconds: after which a call counts as hung.
    facts: `facts_of` the main process, if the worker has to share them.
    """

    name: str
    seconds: float
    facts: Mapping[str, str] | None = None


def work(job: Job, call: Callable[[], Result]) -> Result:
    """Carry out a call.

    A process in which the call takes too long is ended, even if it hangs outside Python.
    Raises UserError where the process would not compute what the main process computes or has
    another call under way, and RuntimeError with the traceback of an error that cannot be pickled.
    """
    if not _busy.acquire(blocking=False):  # what is kept, and the timer, are the process's
        raise UserError(
            f"a worker of the cluster on {platform.node()} computes in several threads; start it "
            "with --nthreads 1"
        )
    try:
        _begin(job)
        faulthandler.dump_traceback_later(job.seconds, exit=True)
        return call()
    except UserError as error:
        if job.facts is not None:  # such as a file that is missing there
            error.args = (f"{error} (on the worker's machine, {platform.node()})",)
        raise
    except Exception as error:
        try:
            pickle.loads(pickle.dumps(error))
        except Exception:  # the main process could not read it, and would take us for dead
            text = "".join(traceback.format_exception(error))
            raise RuntimeError(f"a call has raised an error:\n{text}") from None
        raise
    finally:
        faulthandler.cancel_dump_traceback_later()
        _busy.release()


@contextmanager
def worker_environment() -> Iterator[None]:
    """Processes started within this context find this project, and compute with one thread each,
    because there are as many of them as cores."""
    path = os.pathsep.join(filter(None, [str(REPOSITORY), os.environ.get("PYTHONPATH")]))
    changes = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": path}
    before = {name: os.environ.get(name) for name in changes}
    os.environ.update(changes)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def leave_signals(*_: object) -> None:
    """In a worker process: leave Ctrl-C and SIGTERM, which batch systems send to every process of a
    job, to the main process, which finishes the tasks under way and then ends its workers."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)


@atexit.register  # after multiprocessing.util's own function, and so called before that
def _kill_workers() -> None:
    """End the daemons that are left: multiprocessing would send them SIGTERM and wait."""
    for process in multiprocessing.active_children():
        if process.daemon:
            process.kill()


# --- What a process keeps -------------------------------------------------------------------------

_begun: Job | None = None
_kept: dict[tuple[Any, ...], Any] = {}


def kept(make: Callable[..., Result]) -> Callable[..., Result]:
    """Call `make` once for the same arguments, as functools.cache does, until the process works for
    another executor: by then a file that was read may have changed. What has a method `close` is
    closed then."""

    @functools.wraps(make)
    def known(*arguments: Any) -> Result:
        key = (make, *arguments)
        if key not in _kept:
            _kept[key] = make(*arguments)
        return _kept[key]

    return known


def forget() -> None:
    """Close and forget what the process keeps."""
    for made in _kept.values():
        if hasattr(made, "close"):
            made.close()
    _kept.clear()


def _begin(job: Job) -> None:
    """Forget the job before, and check that this process can work for the new one."""
    global _begun
    if job == _begun:
        return
    forget()
    cv2.setNumThreads(1)  # the workers fill the cores
    if job.facts is not None:
        check(job.facts)
        _keep_memory()
    _begun = job


def _keep_memory() -> None:
    """Let malloc keep what is freed, as it does by itself. Dask's nanny has it give back every 64
    KiB, so that each image that a scene computes would be paged in anew."""
    library = ctypes.CDLL(None) if sys.platform == "linux" else None
    if hasattr(library, "mallopt"):  # glibc
        library.mallopt(M_MMAP_THRESHOLD, 2**25)
        library.mallopt(M_TRIM_THRESHOLD, 2**28)


# --- The same bits on another machine -------------------------------------------------------------


def facts_of(modules: Sequence[str]) -> dict[str, str]:
    """What two processes must have in common to compute the same bits: the versions of Python and
    of the packages, the shipped weights and chances, and the sources of `modules`, the project's
    packages or plug-ins."""
    facts = {"Python": ".".join(platform.python_version_tuple()[:2])}
    facts |= {name: package_version(name) or "missing" for name in PACKAGES}
    facts |= {f"the content of {name}": _content(REPOSITORY / name) for name in WEIGHTS}
    return facts | {f"the source of {name}": _digest(name) for name in modules}


def check(expected: Mapping[str, str]) -> None:
    """Raise UserError where this process would not compute what one with the facts `expected` does.
    Changes nothing, so that it may be called while a call of another job is under way."""
    modules = [name.rpartition(" ")[2] for name in expected if name.startswith("the source of")]
    # A worker of an older commit does not know every package that ours names.
    ours = defaultdict(lambda: "missing", facts_of(modules))
    different = [name for name in expected if expected[name] != ours[name]]
    if different:
        name = different[0]
        raise UserError(
            f"a worker of the cluster on {platform.node()} would not compute the same: {name} is "
            f"{ours[name]} there and {expected[name]} here; bring both to the same commit, "
            "packages and weights, and restart the workers"
        )


@functools.cache  # a process keeps the modules that it has imported, whatever is edited later
def _digest(module: str) -> str:
    try:
        found = importlib.util.find_spec(module)
    except ModuleNotFoundError:  # of the package that should hold it
        found = None
    if found is None:
        return "missing"
    files = [Path(found.origin)] if found.origin else []
    for folder in found.submodule_search_locations or ():
        files += sorted(Path(folder).glob("*.py"))
    return _digest_of(files)


@functools.cache  # the planners of a process keep the weights that they have loaded
def _content(file: Path) -> str:
    return _digest_of([file]) if file.is_file() else "missing"


def _digest_of(files: Sequence[Path]) -> str:
    digest = hashlib.sha256()
    for file in files:
        digest.update(file.name.encode() + file.read_bytes())
    return digest.hexdigest()[:10]
