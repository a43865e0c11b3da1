"""The columns of the transfer report: the registry `COLUMNS`, and what is scored in each.

A new entry is a new name for the config's key `transfer.columns`. A simulated column says in which
cell the report's rows are played (`envs.transfer_scenes` plans their evaluations), a column of
photographs how a planner is scored on them. `utils.transfer` writes and draws the table.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from models.photographs import judge_as_taken, judge_photographs
from models.rectangle_examples import Judged
from utils.config import Config, with_settings
from utils.errors import unknown_choice
from utils.rectangles import RealSample
from utils.transfer import Column


@dataclass(frozen=True, kw_only=True)
class SimulatedColumn(Column):
    """A column that is played. simulator: a key of `SIMULATORS`. randomise: whether the section
    `randomization` changes every scene, as evaluate.randomise does."""

    simulator: str
    randomise: bool = False


@dataclass(frozen=True, kw_only=True)
class PhotographColumn(Column):
    """A column of photographs. judge: scores a planner, given by its name, on samples with a seed:
    an entry for each sample, or None for a planner that photographs do not suffice for."""

    judge: Callable[[str, Sequence[RealSample], int], list[Judged | None] | None]
    if_empty: str | None = "no photographs were scored: add transfer.cornell=path/to/cornell"


COLUMNS: dict[str, SimulatedColumn | PhotographColumn] = {
    "pybullet": SimulatedColumn("PyBullet", simulator="pybullet"),
    "mujoco": SimulatedColumn("MuJoCo", simulation="pybullet", simulator="mujoco"),
    "outside": SimulatedColumn(
        "PyBullet outside the ranges", simulation="pybullet", simulator="pybullet", randomise=True
    ),
    "cornell": PhotographColumn("Cornell photographs", judge=judge_photographs),
    "cornell_as_taken": PhotographColumn("Cornell as taken", judge=judge_as_taken),
}


def columns_of(config: Config) -> dict[str, SimulatedColumn | PhotographColumn]:
    """The report's columns by their names. Raises UserError for an unknown name."""
    for name in config.transfer.columns:
        if name not in COLUMNS:
            raise unknown_choice("transfer.columns", name, COLUMNS)
    return {name: COLUMNS[name] for name in config.transfer.columns}


def config_of(config: Config, column: SimulatedColumn) -> Config:
    """The config of an evaluation in a simulated column of the report."""
    config = with_settings(config, "evaluate", {"randomise": column.randomise})
    return config.model_copy(update={"simulator": column.simulator})
