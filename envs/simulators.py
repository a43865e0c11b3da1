"""The simulators that a cell can be built in, chosen by the config's key `world`."""

from __future__ import annotations

from envs.cell import Cell
from envs.mujoco_cell import MujocoCell
from envs.pybullet_cell import PybulletCell
from utils.config import Config
from utils.domain_randomization import DomainRandomizer
from utils.errors import UserError

SIMULATORS = {"pybullet": PybulletCell, "mujoco": MujocoCell}


def make_cell(config: Config) -> Cell:
    """A cell in the configured world; with evaluate.randomise, one that differs from scene to scene
    by what the section `randomization` says, the same way for the same scene. Noise and bias of
    actions are a policy's that acts in turns; a planner's trajectories are no actions."""
    check_simulator(config)
    cell = SIMULATORS[config.simulator](config)
    if config.evaluate.randomise:
        randomizer = DomainRandomizer(cell, config.randomization)
        cell.on_build = lambda cell: randomizer.randomize(cell.scene.seed)
        cell.on_action = randomizer.act
    return cell


def check_simulator(config: Config) -> None:
    """Raise UserError for what is to be evaluated and cannot be had in the configured world."""
    if config.simulator != "pybullet" and config.evaluate.randomise:
        raise UserError(
            "evaluate.randomise=true changes PyBullet's physics; use simulator=pybullet"
        )
