"""A script or a module of this repository in two processes that train together."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from utils.runs import REPOSITORY


def in_two_processes(folder: Path, *arguments: object) -> str:
    """What both of them print. folder: where they run; arguments: of torchrun, the script first."""
    done = subprocess.run(
        [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node=2",
         *map(str, arguments)],
        cwd=folder, timeout=300, capture_output=True, text=True,
        env=os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(REPOSITORY)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout
