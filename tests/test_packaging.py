"""The packages are found from outside the repository: `pip install -e .` and PYTHONPATH."""

from __future__ import annotations

import os
import subprocess
import sys

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
