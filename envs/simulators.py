"""The simulators, by the names that the config's keys `simulator` and `scene.simulator` take.

A new simulator brings a `Cell` and a `Camera` (`envs.cell`), a `Robot` (`envs.robot`), a
`LayoutTable` (`envs.cell_layout`), and an entry here. Its modules are imported when they are first
asked for, so that a machine needs the package of the simulator that it uses, and of no other.
"""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from envs.cell import Cell, require_arm
from envs.cell_layout import Box, LayoutTable, ObjectModel
from utils.config import Config
from utils.domain_randomization import DomainRandomizer
from utils.errors import UserError, unknown_choice
from utils.random_streams import Stream


@dataclass(frozen=True)
class Simulator:
    """package: the Python package of the simulator. cell, layout_table: the classes that implement
    `Cell` and `LayoutTable`, as `module:name`. install: how a user gets the package."""

    package: str
    cell: str
    layout_table: str
    install: str

    @property
    def installed(self) -> bool:
        return importlib.util.find_spec(self.package) is not None

    def check_installed(self, name: str, key: str) -> None:
        """Raise UserError where the package is not. name, key: as in the config."""
        if not self.installed:
            ways = [self.install]
            ways += [f"use {key}={other}" for other, one in SIMULATORS.items() if one.installed]
            raise UserError(
                f"{key}={name}: the package {self.package} is not installed; " + ", or ".join(ways)
            )

    def load(self, path: str, name: str, key: str) -> type:
        """The class that `path` names. Raises UserError where the package is not installed."""
        self.check_installed(name, key)
        module, _, attribute = path.partition(":")
        return getattr(importlib.import_module(module), attribute)


SIMULATORS: dict[str, Simulator] = {
    "pybullet": Simulator(
        "pybullet",
        "envs.pybullet_cell:PybulletCell",
        "envs.pybullet_bodies:PybulletTable",
        "pip install pybullet, which has wheels for Python 3.10 and 3.11 on Linux x86-64",
    ),
    "mujoco": Simulator(
        "mujoco",
        "envs.mujoco_cell:MujocoCell",
        "envs.mujoco_bodies:MujocoTable",
        'pip install "mujoco>=3.12,<4" (4.0.0 is another package)',
    ),
}


def cell_class(name: str) -> type[Cell]:
    """The class of a simulator's cells. Raises UserError for a simulator that does not exist or is
    not installed."""
    simulator = _simulator(name, "simulator")
    return simulator.load(simulator.cell, name, "simulator")


def make_cell(config: Config) -> Cell:
    """A cell in the configured simulator.

    With evaluate.randomise the cell differs from scene to scene by what the section `randomization`
    says, in the same way for the same scene. Noise and bias of actions apply to learned policies
    that act step by step; a planner's trajectories are no actions. Raises UserError for an unknown
    simulator, and where the cell cannot be had in it.
    """
    check_simulator(config)
    cell = cell_class(config.simulator)(config)
    if config.evaluate.randomise:
        try:
            randomizer = DomainRandomizer(cell, config.randomization)
        except UserError:
            cell.close()  # nobody else can
            raise
        cell.on_build = lambda cell: randomizer.randomize(_seed_of_sample(cell.scene.seed))
        cell.on_action = randomizer.act
    return cell


def _seed_of_sample(scene_seed: int) -> int:
    """A seed apart from the scene's: with that itself, colours would be the numbers that placed an
    isolated object, and a policy could see from them where it is."""
    return int(np.random.default_rng([scene_seed, Stream.APPEARANCE]).integers(2**31))


def make_layout_table(
    config: Config, models: Sequence[ObjectModel], walls: Sequence[Box] = ()
) -> LayoutTable:
    """A table on which a scene of these objects is laid out, in the simulator `scene.simulator`."""
    name = config.scene.simulator
    simulator = _simulator(name, "scene.simulator")
    return simulator.load(simulator.layout_table, name, "scene.simulator")(config, models, walls)


def check_simulator(config: Config) -> None:
    """Raise UserError for a simulator that does not exist or is not installed, and for settings
    that the robot's form rules out."""
    cell_class(config.simulator)
    layouts = config.scene.simulator
    _simulator(layouts, "scene.simulator").check_installed(layouts, "scene.simulator")
    if config.evaluate.randomise:
        require_arm(config, "evaluate.randomise=true")
    if config.camera.mount == "wrist":
        require_arm(config, "camera.mount=wrist")
    if config.execution.on_contact == "grip" and config.robot.arm != "none":
        raise UserError(
            "execution.on_contact=grip: an arm that meets something stops and fails; set "
            "robot.arm=none, or execution.on_contact=fail"
        )


def _simulator(name: str, key: str) -> Simulator:
    if name not in SIMULATORS:
        raise unknown_choice(key, name, SIMULATORS)
    return SIMULATORS[name]
