"""One evaluation: its plan of rounds, and playing the plan in worker processes.

A policy is a planner's name and a controller's here. Every finished round is written to the
journal at once, so that an interrupted evaluation can be resumed. The function that plays a task
is an argument: this module knows neither cells nor planners.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from itertools import takewhile
from pathlib import Path

from tqdm import tqdm

from utils.config import Config, load_config
from utils.distributed import stop_on_interrupt
from utils.errors import UserError
from utils.executor import completed, process_pool
from utils.report import GalleryItem
from utils.result_records import (
    OPEN_LOOP,
    RoundRecord,
    Sample,
    append_round,
    policy_name,
    read_rounds,
)

# Keys that may change when an evaluation is resumed: its scenes and scores stay what they are.
FREE_TO_CHANGE = tuple(
    f"evaluate.{key}" for key in ("rounds", "workers", "name", "videos", "gallery", "film_format")
)


@dataclass(frozen=True)
class Task:
    """One scene, on which every policy that is still to be scored works in turn.

    policies: planner and controller of each. keep_pictures: whether pictures of successes are kept
    as well as those of failures. film_folder: where a film of each policy goes, None for no films.
    """

    objects: str
    scenario: str
    seed: int
    policies: tuple[tuple[str, str], ...]
    keep_pictures: bool = False
    film_folder: Path | None = None


@dataclass
class TaskResult:
    """The rounds, pictures and films (file, caption) of one task or of many."""

    rounds: list[RoundRecord] = field(default_factory=list)
    gallery: list[GalleryItem] = field(default_factory=list)
    films: list[tuple[Path, str]] = field(default_factory=list)

    def add(self, other: TaskResult) -> None:
        self.rounds += other.rounds
        self.gallery += other.gallery
        self.films += other.films


@dataclass
class Outcome(TaskResult):
    """What an evaluation has played. interrupted: by Ctrl-C. error: what ended the work early, to
    be raised once the results have been written."""

    interrupted: bool = False
    error: UserError | None = None


# --- The plan -----------------------------------------------------------------------------------


def policies_of(config: Config) -> list[tuple[str, str]]:
    """Every planner of the evaluation with every controller."""
    controllers = config.evaluate.controllers or (config.closed_loop.controller,)
    return [
        (planner, controller) for planner in config.evaluate.policies for controller in controllers
    ]


def tasks(config: Config, done: Sequence[RoundRecord], run: Path) -> Iterator[Task]:
    """The tasks that are not in `done` yet; every policy gets the same seeds."""
    plan = config.evaluate
    known = {(r.policy, r.scenario, r.objects, r.seed) for r in done}
    for number in range(plan.rounds):
        seed = config.seed * 100_000 + number
        for objects in plan.object_sets:
            for scenario in plan.scenarios:
                policies = tuple(
                    pair
                    for pair in policies_of(config)
                    if (policy_name(*pair), scenario, objects, seed) not in known
                )
                if policies:
                    filmed = number < plan.videos and scenario == plan.scenarios[-1]
                    film = run / "films" if filmed else None
                    yield Task(objects, scenario, seed, policies, number < plan.gallery, film)


def in_order(rounds: Sequence[RoundRecord], config: Config) -> list[RoundRecord]:
    """The rounds in the order of the plan, whichever was finished first."""
    plan = config.evaluate
    policies = [policy_name(*pair) for pair in policies_of(config)]

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
    """The number of rounds of the whole evaluation."""
    plan = config.evaluate
    return plan.rounds * len(policies_of(config)) * len(plan.scenarios) * len(plan.object_sets)


def interruption(rounds_done: int, config: Config) -> str | None:
    """'interrupted: N of M rounds', or None for a complete evaluation."""
    planned = planned_rounds(config)
    return f"interrupted: {rounds_done} of {planned} rounds" if rounds_done < planned else None


def check_controllers(config: Config, overrides: Sequence[str] = ()) -> None:
    """Raise UserError for a closed_loop.controller that evaluate.controllers would override."""
    several, one = config.evaluate.controllers, config.closed_loop.controller
    asked = any(change.split("=")[0].strip() == "closed_loop.controller" for change in overrides)
    if several is not None and (asked or one != OPEN_LOOP):
        raise UserError(
            f"closed_loop.controller={one} would be ignored: evaluate.controllers is "
            f"[{', '.join(several)}] and says which controllers are scored; write "
            f"evaluate.controllers={one} or, to have closed_loop.controller count, "
            "evaluate.controllers=null"
        )


def check_rounds(config: Config, run: Path | None) -> None:
    """Raise UserError if a resumed evaluation asks for fewer rounds than it began with."""
    before = config if run is None else load_config(run / "config.yaml")
    if config.evaluate.rounds < before.evaluate.rounds:
        raise UserError(
            f"--resume {run}: evaluate.rounds is {config.evaluate.rounds}, the run began with "
            f"{before.evaluate.rounds}; it can only grow"
        )


# --- Running it ---------------------------------------------------------------------------------


def worker_count(config: Config) -> int:
    return config.evaluate.workers or os.cpu_count() or 1


def play(
    config: Config, run: Path, work: Callable[[Task], TaskResult], set_up: Callable[[Config], None]
) -> Outcome:
    """Play every round that rounds.jsonl in `run` does not hold yet, and add it there.

    work: plays one task. set_up: called with the config first, once in each process.
    Ctrl-C, a scene that cannot be made and a process that dies end the work early; the tasks under
    way are finished after Ctrl-C, and the outcome holds everything that was played.
    """
    journal = run / "rounds.jsonl"
    outcome = Outcome(rounds=read_rounds(journal))
    todo = tasks(config, outcome.rounds, run)
    workers = worker_count(config)
    pool = process_pool(workers, set_up, config)
    progress = tqdm(total=planned_rounds(config), initial=len(outcome.rounds), unit="round")
    try:
        with (
            progress,
            pool,
            stop_on_interrupt("interrupted: finishing the tasks under way") as stop,
        ):
            # No more than one scene a worker is under way, so that the work ends soon.
            wanted = takewhile(lambda _: not stop.is_set(), todo)
            for result in completed(pool, work, wanted, limit=workers):
                for record in result.rounds:
                    append_round(journal, record)
                outcome.add(result)
                progress.update(len(result.rounds))
            outcome.interrupted = stop.is_set()
    except BrokenProcessPool:
        outcome.error = UserError(
            f"a worker process died (out of memory?); {len(outcome.rounds)} rounds are safe in "
            f"{journal}: go on with --resume {run}, perhaps with evaluate.workers=1"
        )
    except UserError as error:  # a scene that cannot be made, an object that cannot be used
        outcome.error = error
    outcome.rounds = in_order(outcome.rounds, config)
    outcome.gallery.sort(key=lambda item: item.caption)  # not in the order of the workers' speed
    outcome.films.sort()
    return outcome


def replay(
    sample: Sample,
    config: Config,
    work: Callable[[Task], TaskResult],
    set_up: Callable[[Config], None],
) -> list[RoundRecord]:
    """Play the rounds of a sample again; `config` is made of the sample's overrides."""
    todo = [
        Task(record.objects, record.scenario, record.seed, ((record.planner, record.controller),))
        for record in sample.rounds
    ]
    workers = min(worker_count(config), max(len(todo), 1))
    with process_pool(workers, set_up, config) as pool:
        results = completed(pool, work, todo, limit=workers)
        return [
            record
            for result in tqdm(results, total=len(todo), unit="round")
            for record in result.rounds
        ]
