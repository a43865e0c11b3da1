"""One evaluation: its plan of rounds, and playing the plan in worker processes.

A policy is a planner's name and a controller's here. Every finished round is written to the
journal at once, so that an interrupted evaluation can be resumed. The function that plays a task
is an argument: this module knows neither cells nor planners.
"""

from __future__ import annotations

import platform
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import NamedTuple

from tqdm import tqdm

from utils.atomic_files import write_atomic
from utils.config import COMPUTE_KEYS, Config, load_config
from utils.config_types import Arguments
from utils.distributed import stop_on_interrupt
from utils.errors import UserError
from utils.executor import LostWorkerError, completed, open_executor
from utils.report import VIDEO_TYPES, GalleryItem, read_gallery, thinned, write_gallery
from utils.result_records import (
    CLEAN,
    OPEN_LOOP,
    RoundRecord,
    Sample,
    append_round,
    cut_torn_line,
    policy_name,
    read_rounds,
    writing,
)
from utils.runs import note_code, resume_command, usable_cpus

GALLERY_SECONDS = 60  # between two times that the pictures are written: it takes some tenths of one

# Keys that may change when an evaluation is resumed: its scenes and scores stay what they are.
FREE_TO_CHANGE = (
    *COMPUTE_KEYS,
    *(f"evaluate.{key}" for key in ("rounds", "workers", "name", "videos", "gallery")),
    "evaluate.film_format",
)


@dataclass(frozen=True)
class Task:
    """One scene, on which every policy that is still to be scored works in turn.

    policies: planner, controller and depth noise of each. keep_pictures: whether pictures of
    successes are kept as well as those of failures. filmed: the depth noise with which each policy
    is filmed; None films nothing.
    """

    objects: str
    scenario: str
    seed: int
    policies: tuple[tuple[str, str, str], ...]
    keep_pictures: bool = False
    filmed: str | None = None


class FilmFile(NamedTuple):
    """A film: the name and the bytes of its file, and its caption."""

    name: str
    content: bytes
    caption: str


@dataclass
class TaskResult:
    """The rounds, pictures and films of one task."""

    rounds: list[RoundRecord] = field(default_factory=list)
    gallery: list[GalleryItem] = field(default_factory=list)
    films: list[FilmFile] = field(default_factory=list)


@dataclass
class Outcome:
    """What an evaluation has played. films: file and caption of each. interrupted: by Ctrl-C.
    error: what ended the work early, to be raised once the results have been written."""

    rounds: list[RoundRecord]
    gallery: list[GalleryItem] = field(default_factory=list)
    films: list[tuple[Path, str]] = field(default_factory=list)
    interrupted: bool = False
    error: UserError | None = None


# --- The plan -----------------------------------------------------------------------------------


def policies_of(config: Config) -> list[tuple[str, str]]:
    """Every planner of the evaluation with every controller."""
    controllers = config.evaluate.controllers or (config.closed_loop.controller,)
    return [
        (planner, controller) for planner in config.evaluate.policies for controller in controllers
    ]


def depth_noises_of(config: Config) -> tuple[str, ...]:
    """The depth noises with which every policy of the evaluation is scored."""
    return config.evaluate.depth_noises or (config.camera.depth_noise,)


def with_depth_noise(config: Config, noise: str) -> Config:
    """The config of a cell whose cameras have one of the depth noises of the evaluation.
    `camera.depth_noise_args` belong to `camera.depth_noise`, the others have their own defaults."""
    if noise == config.camera.depth_noise:
        return config
    changes = {"depth_noise": noise, "depth_noise_args": Arguments()}
    return config.model_copy(update={"camera": config.camera.model_copy(update=changes)})


def tasks(config: Config, done: Sequence[RoundRecord]) -> Iterator[Task]:
    """The tasks that are not in `done` yet; every policy gets the same seeds."""
    plan = config.evaluate
    noises = depth_noises_of(config)
    known = {record.identity for record in done}
    for number in range(plan.rounds):
        seed = config.seed * 100_000 + number
        for objects in plan.object_sets:
            for scenario in plan.scenarios:
                policies = tuple(
                    (*pair, noise)
                    for noise in noises
                    for pair in policies_of(config)
                    if (policy_name(*pair), scenario, objects, noise, seed) not in known
                )
                if policies:
                    filmed = number < plan.videos and scenario == plan.scenarios[-1]
                    film = noises[0] if filmed else None
                    yield Task(objects, scenario, seed, policies, number < plan.gallery, film)


def in_order(rounds: Sequence[RoundRecord], config: Config) -> list[RoundRecord]:
    """The rounds in the order of the plan, whichever was finished first."""
    plan = config.evaluate
    policies = [policy_name(*pair) for pair in policies_of(config)]
    noises = depth_noises_of(config)

    def place(record: RoundRecord) -> tuple[int, ...]:
        known = record.policy in policies  # a resumed report may have lost the weights of one
        return (
            plan.object_sets.index(record.objects),
            plan.scenarios.index(record.scenario),
            noises.index(record.depth_noise),
            policies.index(record.policy) if known else len(policies),
            record.seed,
        )

    return sorted(rounds, key=place)


def planned_rounds(config: Config) -> int:
    """The number of rounds of the whole evaluation."""
    plan = config.evaluate
    policies, scenes = policies_of(config), len(plan.scenarios) * len(plan.object_sets)
    return plan.rounds * scenes * len(policies) * len(depth_noises_of(config))


def check_recorded(
    rounds: Sequence[RoundRecord],
    config: Config,
    source: str,
    whose: str = "its config",
    advice: str = "it was changed by hand, start a new run",
) -> None:
    """Raise UserError for a round on a scene, or with a depth noise, that this config does not
    play."""
    plan = config.evaluate
    known = plan.scenarios, plan.object_sets, depth_noises_of(config)
    for record in rounds:
        if not all(name in names for name, names in zip(record.kind, known)):
            raise UserError(
                f"{source}: holds a round of {record.objects} in the scenario {record.scenario} "
                f"with the depth noise {record.depth_noise}, which {whose} does not "
                f"play; {advice}"
            )


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


def check_depth_noises(config: Config, overrides: Sequence[str] = ()) -> None:
    """Raise UserError for a camera.depth_noise that evaluate.depth_noises leaves out."""
    several, camera = config.evaluate.depth_noises, config.camera
    if several is None:
        return
    asked = any(change.split("=")[0].strip() == "camera.depth_noise" for change in overrides)
    if camera.depth_noise not in several and (asked or camera.depth_noise != CLEAN):
        raise UserError(
            f"camera.depth_noise={camera.depth_noise} would be ignored: evaluate.depth_noises is "
            f"[{', '.join(several)}] and says with which noises policies are scored; set one of "
            "the two keys"
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


def describe_workers(config: Config) -> str:
    """Where the rounds are played, such as 'x86_64 CPU, 8 workers'."""
    scheduler, count = config.compute.scheduler, config.evaluate.workers
    if scheduler is None:
        count = count or usable_cpus()
    where = f"{platform.machine()} CPU" if scheduler is None else f"the cluster of {scheduler}"
    return f"{where}, {count or 'all'} worker{'' if count == 1 else 's'}"


def going_on(run: Path, files: Mapping[str, Path | None] | None = None) -> str:
    """The command that goes on with an evaluation and writes the files of the same options."""
    return resume_command("evaluate.py", run, files)


def play(
    config: Config,
    run: Path,
    work: Callable[[Config, Task], TaskResult],
    resume: str | None = None,
) -> Outcome:
    """Play every round that rounds.jsonl in `run` does not hold yet, and add it there.

    work: plays one task, in a worker process. resume: the command that goes on, for messages; None
    for that of `run` alone.
    Ctrl-C, a scene that cannot be made and a task that no process survives end the work early; the
    tasks under way are finished after Ctrl-C, and the outcome holds everything that was played.
    Raises UserError where another process plays the same run, or has played a round twice.
    """
    journal = run / "rounds.jsonl"
    with writing(journal):
        return _play(config, run, journal, work, resume or going_on(run))


def _play(
    config: Config, run: Path, journal: Path, work: Callable[[Config, Task], TaskResult],
    resume: str,
) -> Outcome:  # fmt: skip
    cut_torn_line(journal)
    outcome = Outcome(rounds=read_rounds(journal, config.camera.depth_noise))
    check_recorded(outcome.rounds, config, str(journal))
    films, gallery, shown = run / "films", run / "gallery.npz", config.evaluate.gallery
    outcome.gallery, written = read_gallery(gallery), time.monotonic()
    todo = list(tasks(config, outcome.rounds))
    if todo:
        note_code(run)
    progress = tqdm(total=planned_rounds(config), initial=len(outcome.rounds), unit="round")
    try:
        with (
            progress,
            open_executor(config.compute, config.evaluate.workers) as workers,
            stop_on_interrupt(
                "interrupted: finishing the scenes under way, each with all of its policies; "
                f"the rest will go on with {resume}"
            ) as stop,
        ):
            for result in completed(workers, partial(work, config), todo, stop):
                # Before the rounds: what stands in the journal is not filmed again.
                for film in result.films:
                    write_atomic(films / film.name, film.content)
                    outcome.films.append((films / film.name, film.caption))
                for record in result.rounds:
                    append_round(journal, record)
                outcome.rounds += result.rounds
                outcome.gallery = thinned([*outcome.gallery, *result.gallery], shown)
                if time.monotonic() > written + GALLERY_SECONDS:
                    write_gallery(gallery, outcome.gallery, shown)
                    written = time.monotonic()
                progress.update(len(result.rounds))
            outcome.interrupted = stop.is_set()
    except LostWorkerError as error:
        outcome.error = UserError(
            f"{error}; {len(outcome.rounds)} rounds are safe in {journal}: go on with {resume}, "
            "perhaps with evaluate.workers=1"
        )
    except UserError as error:  # a scene that cannot be made, an object that cannot be used
        outcome.error = error
    outcome.rounds = in_order(outcome.rounds, config)
    outcome.gallery.sort(key=lambda item: item.caption)  # not in the order of the workers' speed
    write_gallery(gallery, outcome.gallery, shown)
    told = dict(outcome.films)  # films of an earlier part have their file's name as caption
    outcome.films = [
        (file, told.get(file, file.stem))
        for file in sorted(films.glob("*"))
        if file.suffix in VIDEO_TYPES
    ]
    return outcome


def replay(
    sample: Sample,
    config: Config,
    work: Callable[[Config, Task], TaskResult],
    overrides: Sequence[str] = (),
) -> list[RoundRecord]:
    """Play the rounds of a sample again; `config` is made of the sample's overrides and of others
    over these.

    Raises UserError for a round that is not of this config: its policy would be loaded unchecked.
    """
    whose, advice = "its own config", "it was changed by hand, choose another"
    if overrides:
        whose = f"its own config with {' '.join(overrides)}"
        advice = "omit what leaves it out there, or choose another sample"
    check_recorded(sample.rounds, config, "--replay", whose, advice)
    for record in sample.rounds:
        if (record.planner, record.controller) not in policies_of(config):
            raise UserError(
                f"--replay: the sample holds a round of {record.policy}, which {whose} does not "
                f"score; {advice}"
            )
    todo = [
        Task(
            record.objects, record.scenario, record.seed,
            ((record.planner, record.controller, record.depth_noise),),
        )
        for record in sample.rounds
    ]  # fmt: skip
    with open_executor(config.compute, config.evaluate.workers) as workers:
        results = completed(workers, partial(work, config), todo)
        return [
            record
            for result in tqdm(results, total=len(todo), unit="round")
            for record in result.rounds
        ]
