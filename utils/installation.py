"""The first import of every script: one sentence where Python is too old or a package is missing.

It is written for every Python 3, and imports nothing that has to be installed.
"""

import importlib.util
import sys

# Packages of requirements.txt that the first imports of the scripts need.
PACKAGES = ("gymnasium", "mujoco", "numpy", "pydantic", "torch", "tqdm")


def problem(version=sys.version_info, packages=PACKAGES):
    """Why the project cannot run, with what to do; None where it can."""
    if version < (3, 10):
        found = ".".join(map(str, version[:3]))
        return f"Python {found} is too old, 3.10 or newer is needed; README.md says how to install"
    missing = [name for name in packages if importlib.util.find_spec(name) is None]
    if missing:
        lacking = ", ".join(missing)
        return (
            f"{sys.executable} lacks {lacking}; install with `make run`, or as README.md "
            "says for systems without make, and start .venv/bin/python"
        )
    return None


_problem = problem()
if _problem is not None:
    sys.stderr.write(f"error: {_problem}\n")
    sys.exit(2)
