"""Writing files so that a crash never leaves half of one.

Where a program's time goes: seconds by name, and the rest as overhead.

Run folders: runs/<script>/<time>-<name>/, each with what is needed to repeat the run.

This module knows nothing of what a run computes.
"""

from __future__ import annotations

import json
import os
import platform
import re
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Mapping
from datetime import datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

from utils.config import Config, dump_config
from utils.errors import UserError


def write_atomic(path: Path, content: str | bytes) -> None:
    """Write a whole file or nothing: into a temporary neighbour, then renamed into place."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    data = content.encode() if isinstance(content, str) else content
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise


def write_json_atomic(path: Path, content: Mapping) -> None:
    """Indented strict JSON; raises ValueError on NaN or infinity before touching the file."""
    text = json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False)
    write_atomic(path, text + "\n")


class Stopwatch:
    """Sums up seconds spent in `with watch("simulation"): ...`, by name; not to be nested.

    Everything since `start` that is not inside such a block counts as overhead.
    """

    OVERHEAD = "overhead"

    def __init__(self):
        self.start()

    def start(self) -> None:
        """Forget everything and begin anew."""
        self._spent: defaultdict[str, float] = defaultdict(float)
        self._begun = time.perf_counter()

    def __call__(self, name: str) -> Stopwatch:
        self._name = name
        return self

    def __enter__(self) -> None:
        self._since = time.perf_counter()

    def __exit__(
        self, kind: type | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._spent[self._name] += time.perf_counter() - self._since

    def seconds(self) -> dict[str, float]:
        """Seconds by name, the overhead last; they sum up to the time since `start`."""
        total = time.perf_counter() - self._begun
        return dict(self._spent) | {self.OVERHEAD: total - sum(self._spent.values())}


__all__ = [
    "GitState",
    "check_writable",
    "environment",
    "git_state",
    "new_run_folder",
]

REPOSITORY = Path(__file__).resolve().parent.parent
PACKAGES = ("numpy", "scipy", "torch", "torchvision", "pybullet", "gymnasium", "pydantic")


class GitState(NamedTuple):
    """The commit's hash (None outside a repository) and whether tracked files differ from it."""

    commit: str | None
    dirty: bool | None


def new_run_folder(
    script: str, name: str | None, config: Config, root: Path = Path("runs")
) -> Path:
    """Make root/<script>/<time>-<name>/ with config.yaml and environment.json; returns its path.

    The time is local, to the second; a number is added where that folder already exists.
    Raises UserError where the name would not be a plain folder name.
    """
    if name is not None and not re.fullmatch(r"\w[\w.+-]*", name):
        raise UserError(
            f"run name: got {name!r}, expected letters, digits and . _ + - starting with a letter, "
            "digit or _; choose another name"
        )
    stem = datetime.now().strftime("%Y%m%d-%H%M%S") + (f"-{name}" if name else "")
    folder = _make_new(root / script, stem)
    write_atomic(folder / "config.yaml", dump_config(config))
    write_json_atomic(folder / "environment.json", environment())
    return folder


def check_writable(option: str, path: Path | None) -> None:
    """Raise UserError if a file that an option names could not be written at the end."""
    if path is not None and (path.is_dir() or not path.parent.is_dir()):
        raise UserError(f"{option} {path}: not a file in an existing folder; choose another")


def _make_new(parent: Path, stem: str) -> Path:
    """mkdir decides who owns a name, so two runs started together cannot share a folder."""
    try:
        parent.mkdir(parents=True, exist_ok=True)
        number = 1
        while True:
            folder = parent / (stem if number == 1 else f"{stem}-{number}")
            try:
                folder.mkdir()
                return folder
            except FileExistsError:
                number += 1
    except OSError as error:
        raise UserError(f"{parent}: cannot make a run folder here: {error.strerror}") from error


def environment() -> dict[str, Any]:
    """What the run ran on, ready for JSON."""
    commit, dirty = git_state()
    return {
        "commit": commit,
        "dirty": dirty,
        "command": sys.argv,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "cpu_count": os.cpu_count(),
        "packages": {name: _version(name) for name in PACKAGES},
    }


def git_state(folder: Path = REPOSITORY) -> GitState:
    """The commit of the repository that holds `folder`; never raises."""
    commit = _git(folder, "rev-parse", "--verify", "HEAD")
    changes = _git(folder, "status", "--porcelain", "--untracked-files=no") if commit else None
    return GitState(commit, None if changes is None else bool(changes))


def _git(folder: Path, *arguments: str) -> str | None:
    try:
        done = subprocess.run(
            ["git", "-C", str(folder), *arguments], capture_output=True, text=True, timeout=10
        )
    except (OSError, subprocess.TimeoutExpired):  # no git on this machine, or a stuck disk
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None
