"""Which simulators the tests of every simulator run in, and PyBullet where it is installed."""

import numpy as np
import pytest

from envs.cell import Cell
from envs.simulators import SIMULATORS

INSTALLED = [name for name, simulator in SIMULATORS.items() if simulator.installed]

if "pybullet" in INSTALLED:
    import pybullet
else:
    pybullet = None
needs_pybullet = pytest.mark.skipif(pybullet is None, reason="PyBullet is not installed")


def is_pybullet(cell: Cell) -> bool:
    return type(cell).__module__ == "envs.pybullet_cell"


def move(cell: Cell, index: int, position=None, velocity=(0.0, 0.0, 0.0), turn_rate=0.0) -> None:
    """Put an object's centre at position (3,) in W, None for where it is, with a velocity (3,) in
    m/s and a turn rate in rad/s about +z."""
    T = cell.object_pose(index)
    if position is not None:
        T[:3, 3] = position
    cell.carry(index, T, np.array(velocity), turn_rate)
