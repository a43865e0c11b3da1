"""The simulators, by the names that the config's key `simulator` takes, and `make_cell`.

A new simulator brings a `Cell` and a `Camera` (`envs.cell`), a `Robot` (`envs.robot`), and an entry
here. It can be randomised if its cell implements `randomizable`.
"""

from __future__ import annotations

from envs.cell import Cell, not_randomizable
from envs.mujoco_cell import MujocoCell
from envs.pybullet_cell import PybulletCell
from utils.config import Config
from utils.domain_randomization import DomainRandomizer
from utils.errors import unknown_choice

SIMULATORS: dict[str, type[Cell]] = {"pybullet": PybulletCell, "mujoco": MujocoCell}


def make_cell(config: Config) -> Cell:
    """A cell in the configured simulator.

    With evaluate.randomise the cell differs from scene to scene by what the section `randomization`
    says, in the same way for the same scene. Noise and bias of actions apply to learned policies
    that act step by step; a planner's trajectories are no actions. Raises UserError for an unknown
    simulator, and where the cell cannot be had in it.
    """
    check_simulator(config)
    cell = SIMULATORS[config.simulator](config)
    if config.evaluate.randomise:
        randomizer = DomainRandomizer(cell, config.randomization)
        cell.on_build = lambda cell: randomizer.randomize(cell.scene.seed)
        cell.on_action = randomizer.act
    return cell


def check_simulator(config: Config) -> None:
    """Raise UserError for an unknown simulator, and for one that cannot be randomised."""
    if config.simulator not in SIMULATORS:
        raise unknown_choice("simulator", config.simulator, SIMULATORS)
    if config.evaluate.randomise and not SIMULATORS[config.simulator].can_be_randomized():
        raise not_randomizable(config)
