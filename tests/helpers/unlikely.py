"""Planners with one grasp, whose quality is 0.05: as a chance of success, and as a score."""

from __future__ import annotations

from dataclasses import replace

from tests.helpers.cubes import cube_grasp
from utils.calibration import Calibration
from utils.transforms import Grasp, RGBDFrame


def score(frame: RGBDFrame) -> list[Grasp]:
    return [replace(cube_grasp(), quality=0.05)]


def chance(frame: RGBDFrame) -> list[Grasp]:
    return score(frame)


chance.calibration = Calibration(1.0, 0.0)
