"""The packages are found from outside the repository: `pip install -e .` and PYTHONPATH."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys

import pytest

from utils.runs import REPOSITORY

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pytest brings it


OUTSIDE = """
import gymnasium, envs, models, utils
from utils.runs import REPOSITORY
from models.graspnet_io import load_graspnet
from utils.config import DEFAULTS, load_config
load_config()
env = gymnasium.make("RobotGrasping-v0", observations=["state"])
print(DEFAULTS, sorted(env.reset(seed=0)[0]))
"""


def test_an_environment_is_made_from_another_folder(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", OUTSIDE], cwd=tmp_path, capture_output=True, text=True,
        env={**os.environ, "PYTHONPATH": str(REPOSITORY)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == f"{REPOSITORY / 'configs' / 'default.yaml'} ['state']"


@pytest.mark.skipif(
    not (REPOSITORY / ".git").exists() or shutil.which("git") is None,
    reason="git lists the files, and this is no repository or a machine without git",
)
def test_what_pip_installs_is_there():
    """What setuptools would miss: a package that is not listed, or data without a pattern."""
    settings = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["tool"]["setuptools"]
    code = {path.parent.name for path in REPOSITORY.glob("*/__init__.py")} - {"benchmarks", "tests"}
    assert set(settings["packages"]) == code | {"checkpoints", "configs"}
    data = {
        file
        for package, patterns in settings["package-data"].items()
        for pattern in patterns
        for file in (REPOSITORY / package).glob(pattern)
    }
    command = ["git", "ls-files", *settings["packages"]]
    listed = subprocess.run(
        command, cwd=REPOSITORY, capture_output=True, text=True, check=True
    ).stdout.split()
    assert "configs/default.yaml" in listed
    assert {REPOSITORY / name for name in listed if not name.endswith(".py")} <= data
    for file in settings["dynamic"]["dependencies"]["file"]:
        assert (REPOSITORY / file).is_file()


@pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")
def test_make_installs_again_where_the_python_of_its_environment_is_gone(tmp_path):
    """As after an upgrade of the system's Python; `make -n` tells what it would do."""
    for name in ("requirements.txt", "Makefile"):
        shutil.copy(REPOSITORY / name, tmp_path)
    (tmp_path / ".venv" / "bin").mkdir(parents=True)
    (tmp_path / ".venv" / "bin" / "python").symlink_to(tmp_path / "gone")
    (tmp_path / ".venv" / ".installed").touch()
    # A make above this test, as in `make LOCKED=1 test`, hands its flags and variables down.
    environment = {
        name: value
        for name, value in os.environ.items()
        if "MAKE" not in name and name not in ("LOCKED", "PYTHON", "ARGS")
    }
    done = subprocess.run(
        ["make", "-n", "run"], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    told = done.stdout
    assert "-m venv --clear .venv" in told
    assert "pip install --no-compile -r requirements.txt" in told
