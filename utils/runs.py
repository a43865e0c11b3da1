"""Run folders: runs/<script>/<time>-<name>/, each with what is needed to repeat the run.

This module knows nothing of what a run computes.
"""

from __future__ import annotations

import os
import platform
import re
import subprocess
import sys
from datetime import datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple

from utils.config import Config, dump_config
from utils.errors import UserError
from utils.files import write_atomic, write_json_atomic

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
