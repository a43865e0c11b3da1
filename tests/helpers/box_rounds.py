"""Rounds with one box whose grasp is known exactly, in the cell of either simulator."""

from __future__ import annotations

import numpy as np

from envs.closed_loop import ClosedLoop
from envs.rounds import run_round
from envs.scenarios import teach, true_calibration
from utils.config import load_config
from utils.result_records import RoundRecord
from utils.transforms import Grasp


def grasp_of_box(cell):
    """A grasp through the middle of the one box in the cell, along one of its sides."""
    T = cell.object_pose(0)
    side = int(np.argmin(np.abs(T[2, :3])))  # an axis of the box that lies level
    angle = np.arctan2(T[1, side], T[0, side])
    return Grasp(np.array([*T[:2, 3], 0.03]), angle, 0.07, 1.0)


def loop(cell, controller, latency=0.0, camera=None) -> ClosedLoop:
    """A closed loop of the cell, taught and with the true calibration."""
    calibration = true_calibration(cell)
    return ClosedLoop(cell, controller, cell.frame(), calibration, teach(cell), latency, camera)


def round_with_a_box(cell, scene, scenario: str, controller: str, monkeypatch) -> RoundRecord:
    """One attempt at the box, planned on its true pose."""
    # Images that are 100 ms late are older than the default watchdog allows.
    allowed = load_config(None, ["sim.renderer=tiny", "safety.watchdog=0.2"])
    monkeypatch.setattr(cell, "config", allowed)
    return run_round(
        cell, scene, lambda frame: [grasp_of_box(cell)], policy="exact", objects="box",
        max_failures=1, scenario=scenario, controller=controller,
    )  # fmt: skip
