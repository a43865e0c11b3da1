"""The plan of the transfer report: its columns, the scenes of its rows, and what each row scores.

`COLUMNS` is the registry of the columns: a new entry is a new name for the config's key
`transfer.columns`. A simulated column says in which cell the rows are played, a column of
photographs how a planner is scored on them. evaluate.py plays the evaluations that are planned
here; `utils.transfer` writes and draws the table.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from envs.policy_approach import check_learned, is_learned
from models.photographs import HAND, judge_as_taken, judge_photographs
from models.rectangle_examples import JudgedRectangle, draw_rectangles
from utils.config import Config, with_settings
from utils.config_schema import TransferPolicy
from utils.errors import UserError, unknown_choice
from utils.evaluation import depth_noises_of, policies_of
from utils.rectangles import RealSample
from utils.result_records import OPEN_LOOP
from utils.runs import portable_name
from utils.statistics import counts_by_group
from utils.transfer import Column, Score, TransferLine

# --- The columns ----------------------------------------------------------------------------------


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

    judge: Callable[[str, Sequence[RealSample], int], list[JudgedRectangle | None] | None]
    if_empty: str | None = (
        "no photographs were scored: these need transfer.cornell=path/to/cornell, and all rounds"
    )


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
    """The report's columns by their names. Raises UserError for an unknown name, and
    for photographs if the hand is not the default one."""
    for name in config.transfer.columns:
        if name not in COLUMNS:
            raise unknown_choice("transfer.columns", name, COLUMNS)
        if isinstance(COLUMNS[name], PhotographColumn) and config.gripper.geometry != HAND:
            raise UserError(
                f"transfer.columns: {name} judges photographs for the default hand alone; leave "
                "gripper.* as it is, or the column out"
            )
    return {name: COLUMNS[name] for name in config.transfer.columns}


# --- The rows and their scenes --------------------------------------------------------------------


class Scenes(NamedTuple):
    """The scenarios and object sets on which a row of the report is scored."""

    scenarios: tuple[str, ...]
    objects: tuple[str, ...]

    def __str__(self) -> str:
        return f"{', '.join(self.scenarios)} of {', '.join(self.objects)}"

    @property
    def folder(self) -> str:
        """A name for a folder; it holds the whole path of a folder of objects, or MODULE:NAME."""
        return portable_name(str(self).replace(", ", "-"))


@dataclass(frozen=True)
class TransferEvaluation:
    """The rows of the report that are scored on the same scenes in one column, and the config of
    their evaluation."""

    column: str
    scenes: Scenes
    rows: tuple[TransferPolicy, ...]
    config: Config


# Keys of an evaluation that the report ignores, and what says it instead.
IGNORED = {
    "simulator": "transfer.columns says in which simulators rows are scored",
    "evaluate.policies": "transfer.policies says which planners are scored",
    "evaluate.randomise": "transfer.columns says where scenes are changed, as in outside",
}


def check_overrides(config: Config, overrides: Sequence[str]) -> None:
    """Raise UserError for a key that is set although the report ignores it."""
    asked = [change.split("=")[0].strip() for change in overrides]
    ignored = dict(IGNORED)
    if not any(isinstance(column, PhotographColumn) for column in columns_of(config).values()):
        ignored["transfer.cornell"] = "no column of transfer.columns is of photographs"
    for key in asked:
        if key in ignored:
            raise UserError(f"{key} would be ignored: {ignored[key]}; omit it")


def evaluations_of(config: Config, overrides: Sequence[str] = ()) -> list[TransferEvaluation]:
    """The evaluations of the transfer report; rows that are not trained are left out. overrides: of
    the command line.

    Raises UserError where the report would have to compare closed loops, for a key that it would
    ignore, and for a row that cannot be scored on its scenes.
    """
    check_overrides(config, overrides)
    if any(controller != OPEN_LOOP for _, controller in policies_of(config)):
        raise UserError(
            "transfer.policies: the report compares open loops; leave evaluate.controllers null "
            "and closed_loop.controller open_loop"
        )
    if len(depth_noises_of(config)) > 1:
        raise UserError(
            "transfer.policies: the report compares columns with one depth noise; set "
            "evaluate.depth_noises=null, and camera.depth_noise for another one than none"
        )
    trained = [row for row in config.transfer.policies if is_trained(row)]
    found = []
    for scenes in dict.fromkeys(scenes_of(row, config) for row in trained):
        rows = tuple(row for row in trained if scenes_of(row, config) == scenes)
        plan = {"policies": list(dict.fromkeys(row.planner for row in rows))}
        plan |= {"scenarios": list(scenes.scenarios), "object_sets": list(scenes.objects)}
        here = with_settings(config, "evaluate", plan)
        for name, column in columns_of(config).items():
            if isinstance(column, SimulatedColumn):
                found.append(TransferEvaluation(name, scenes, rows, config_of(here, column)))
                _check_rows(found[-1])
    return found


def config_of(config: Config, column: SimulatedColumn) -> Config:
    """The config of an evaluation in a simulated column of the report."""
    config = with_settings(config, "evaluate", {"randomise": column.randomise})
    return config.model_copy(update={"simulator": column.simulator})


def scenes_of(row: TransferPolicy, config: Config) -> Scenes:
    """A row's own scenes, or those of the section evaluate."""
    if row.scenes is None:
        return Scenes(config.evaluate.scenarios, config.evaluate.object_sets)
    scenario, objects = row.scenes
    return Scenes((scenario,), (objects,))


def is_trained(row: TransferPolicy) -> bool:
    """Whether a row can be scored: its planner needs no file, or the file exists."""
    file = Path(row.planner.partition(":")[2] if is_learned(row.planner) else row.planner)
    return file.suffix not in (".pt", ".zip") or file.exists()


def _check_rows(evaluation: TransferEvaluation) -> None:
    """Raise UserError for a row that cannot be scored on its scenes."""
    for row in evaluation.rows:
        if is_learned(row.planner):
            try:
                scenarios = evaluation.scenes.scenarios
                check_learned(row.planner, scenarios, [OPEN_LOOP], evaluation.config)
            except UserError as error:
                raise UserError(
                    f"transfer.policies: the row {row.policy}, {row.training} is scored on "
                    f"{evaluation.scenes}; give it scenes that it can play, such as [isolated, "
                    f"box] ({error})"
                ) from None


def score_photographs(
    row: TransferPolicy, samples: Sequence[RealSample], config: Config, pictures: Path
) -> dict[str, Score]:
    """The score of a row's planner in each column of photographs; the best rectangles are drawn in
    the folder `pictures`. Empty for a row that has scenes of its own, because it is compared on
    these alone, and for one that is not trained or plans no grasps."""
    scores: dict[str, Score] = {}
    if row.scenes is not None or not is_trained(row) or is_learned(row.planner):
        return scores
    for name, column in columns_of(config).items():
        if not isinstance(column, PhotographColumn):
            continue
        judged = column.judge(row.planner, samples, config.seed)
        if judged is None:
            continue
        shown = [(sample, one) for sample, one in zip(samples, judged) if one is not None]
        right = [one is not None and one.correct for one in judged]
        by_object = counts_by_group([sample.object_id for sample in samples], right)
        scores[name] = Score(sum(right), len(samples), tuple(by_object))
        if shown:
            picture = pictures / f"{portable_name(row.planner)}-{name}.png"
            draw_rectangles(picture, *zip(*shown))
    return scores


def transfer_lines(
    config: Config, scores: Mapping[TransferPolicy, Mapping[str, Score]]
) -> list[TransferLine]:
    """The rows of the report with their scores by column."""
    return [
        TransferLine(row, str(scenes_of(row, config)), scores[row], is_trained(row))
        for row in config.transfer.policies
    ]
