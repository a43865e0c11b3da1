"""The first import of every script: one sentence where Python is too old or a package is missing.

It is written for every Python 3, and imports nothing that has to be installed.
"""

import importlib.util
import os
import sys

# The packages of requirements.txt, under the names by which they are imported. PyBullet is not
# among them: where it is missing, MuJoCo does its work.
PACKAGES = (
    "PIL", "collada", "cv2", "gymnasium", "h5py", "imageio", "imageio_ffmpeg", "jinja2",
    "manifold3d", "matplotlib", "mujoco", "numba", "numpy", "onnx", "onnxscript", "pydantic",
    "scipy", "tensorboard", "torch", "torchvision", "tqdm", "trimesh", "typing_extensions", "yaml",
    "yourdfpy",
)  # fmt: skip


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


# Progress bars, where no terminal redraws them, are a line every half minute of a log. tqdm reads
# this when it is imported.
if sys.stderr is None or not sys.stderr.isatty():
    os.environ.setdefault("TQDM_MININTERVAL", "30")

_problem = problem()
if _problem is not None:
    sys.stderr.write(f"error: {_problem}\n")
    sys.exit(2)
