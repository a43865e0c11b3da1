"""What an evaluation is asked for: who plays which scenes, in which order, and what is left to do.

A policy here is a planner's name and a controller's. This module knows neither cells nor planners.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from utils.config import Config, load_config
from utils.errors import UserError
from utils.round_records import OPEN_LOOP, RoundRecord, contestant

# Keys of `evaluate` that may change when a run goes on: its scenes and scores stay what they are.
_FREE = {"rounds", "workers", "name", "videos", "gallery", "film_format"}


@dataclass(frozen=True)
class Task:
    """One scene, on which every policy that is still to be scored works in turn."""

    objects: str
    scenario: str
    seed: int
    policies: tuple[tuple[str, str], ...]
    keep_pictures: bool
    film_folder: Path | None


def contestants(config: Config) -> list[tuple[str, str]]:
    """Every planner with every controller."""
    controllers = config.evaluate.controllers or (config.grasp.controller,)
    return [
        (planner, controller) for planner in config.evaluate.policies for controller in controllers
    ]


def tasks(config: Config, done: Sequence[RoundRecord], run: Path) -> Iterator[Task]:
    """What is left to do; every policy gets the same seeds."""
    plan = config.evaluate
    known = {(r.policy, r.scenario, r.objects, r.seed) for r in done}
    for number in range(plan.rounds):
        seed = config.seed * 100_000 + number
        for objects in plan.object_sets:
            for scenario in plan.scenarios:
                policies = tuple(
                    pair
                    for pair in contestants(config)
                    if (contestant(*pair), scenario, objects, seed) not in known
                )
                if policies:
                    filmed = number < plan.videos and scenario == plan.scenarios[-1]
                    film = run / "films" if filmed else None
                    yield Task(objects, scenario, seed, policies, number < plan.gallery, film)


def in_order(rounds: Sequence[RoundRecord], config: Config) -> list[RoundRecord]:
    """The rounds as the plan names them, whichever was finished first."""
    plan = config.evaluate
    policies = [contestant(*pair) for pair in contestants(config)]

    def place(record: RoundRecord) -> tuple[int, ...]:
        known = record.policy in policies  # a resumed report may have lost the weights of one
        return (
            plan.object_sets.index(record.objects),
            plan.scenarios.index(record.scenario),
            policies.index(record.policy) if known else len(policies),
            record.seed,
        )

    return sorted(rounds, key=place)


def planned_rounds(config: Config) -> int:
    """How many rounds the whole evaluation has."""
    plan = config.evaluate
    return plan.rounds * len(contestants(config)) * len(plan.scenarios) * len(plan.object_sets)


def interruption(rounds_done: int, config: Config) -> str | None:
    """'interrupted: N of M rounds', or None for a complete evaluation."""
    planned = planned_rounds(config)
    return f"interrupted: {rounds_done} of {planned} rounds" if rounds_done < planned else None


def check_controllers(config: Config, overrides: Sequence[str] = ()) -> None:
    """Raise UserError for a grasp.controller that evaluate.controllers would leave unheard."""
    several, one = config.evaluate.controllers, config.grasp.controller
    asked = any(change.split("=")[0].strip() == "grasp.controller" for change in overrides)
    if several is not None and (asked or one != OPEN_LOOP):
        raise UserError(
            f"grasp.controller={one} would be ignored: evaluate.controllers is "
            f"[{', '.join(several)}] and says which controllers are scored; write "
            f"evaluate.controllers={one} or, to have grasp.controller count, "
            "evaluate.controllers=null"
        )


def check_resume(config: Config, run: Path | None) -> None:
    """Raise UserError if a resumed run would mix rounds of different experiments."""
    if run is None:
        return
    before = load_config(run / "config.yaml").model_dump()
    now = config.model_dump()
    if now["evaluate"]["rounds"] < before["evaluate"]["rounds"]:
        raise UserError(
            f"--resume {run}: evaluate.rounds is {now['evaluate']['rounds']}, the run began with "
            f"{before['evaluate']['rounds']}; it can only grow"
        )
    for plan in (before["evaluate"], now["evaluate"]):
        for key in _FREE:
            plan.pop(key)
    if before != now:
        raise UserError(
            f"--resume {run}: only evaluate.{', evaluate.'.join(sorted(_FREE))} may differ from "
            "the run that is resumed; start a new run for anything else"
        )
