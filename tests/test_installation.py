"""What a script says where it cannot run, and that it imports nothing else before."""

import os
import re
import subprocess
import sys
from importlib.metadata import files

import pytest

from utils.installation import PACKAGES, problem
from utils.runs import REPOSITORY

SCRIPTS = ("evaluate", "predict", "train_graspnet", "train_rl", "envs.studio")


def test_an_old_python_and_a_missing_package_are_named():
    assert problem() is None
    assert problem((3, 9, 18)).startswith("Python 3.9.18 is too old, 3.10 or newer is needed; ")
    assert " lacks no_such_package; install with `make run`" in problem(
        packages=("numpy", "no_such_package")
    )


def test_every_requirement_is_looked_for():
    """But PyBullet, without which MuJoCo suffices."""
    lines = (REPOSITORY / "requirements.txt").read_text().splitlines()
    required = {re.match(r"[\w-]+", line)[0] for line in lines if line and line[0] != "#"}
    unknown = set(PACKAGES)
    for requirement in required - {"pybullet"} | {"imageio-ffmpeg"}:
        modules = {file.parts[0].partition(".")[0] for file in files(requirement)}
        assert modules & set(PACKAGES), requirement
        unknown -= modules
    assert not unknown


@pytest.mark.parametrize("script", SCRIPTS)
def test_without_packages_a_script_ends_in_one_sentence(script):
    """-S -I: an interpreter that sees the standard library and the script's folder alone."""
    code = f"import sys; sys.path.insert(0, {str(REPOSITORY)!r}); import {script}"
    done = subprocess.run(
        [sys.executable, "-S", "-I", "-c", code], capture_output=True, text=True, cwd=REPOSITORY
    )
    (line,) = done.stderr.splitlines()
    assert done.returncode == 2 and done.stdout == ""
    assert line.startswith("error: ") and f" lacks {', '.join(PACKAGES)}; " in line


@pytest.mark.parametrize(("given", "seconds"), [(None, "30"), ("2", "2")])
def test_progress_in_a_log_is_a_line_every_half_minute(given, seconds):
    """Without a terminal, unless the user has set another interval."""
    code = "import os, utils.installation; print(os.environ['TQDM_MININTERVAL'])"
    known = {name: value for name, value in os.environ.items() if name != "TQDM_MININTERVAL"}
    known |= {} if given is None else {"TQDM_MININTERVAL": given}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=REPOSITORY, env=known, capture_output=True, text=True
    )
    assert (done.returncode, done.stdout.strip()) == (0, seconds), done.stderr
