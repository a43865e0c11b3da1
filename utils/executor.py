"""Scenes played in worker processes; what is measured is kept at once, so that an end is an end.

Ctrl-C finishes the scenes under way; so does a scene that cannot be made. What is done with a scene
is given: this module knows neither cells nor planners.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterable
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

import cv2
from tqdm import tqdm

from utils.config import Config
from utils.errors import UserError
from utils.report import GalleryItem
from utils.result_records import RoundRecord, append_round, read_rounds
from utils.results import Task, in_order, planned_rounds, tasks


@dataclass
class Played:
    """What came of one task or of many. films: (file, caption)."""

    rounds: list[RoundRecord] = field(default_factory=list)
    gallery: list[GalleryItem] = field(default_factory=list)
    films: list[tuple[Path, str]] = field(default_factory=list)


@dataclass
class Outcome(Played):
    """interrupted: by Ctrl-C. error: what ended the work early, to be raised once the rest has been
    written."""

    interrupted: bool = False
    error: UserError | None = None


def worker_count(config: Config) -> int:
    return config.evaluate.workers or os.cpu_count() or 1


def play_scenes(
    config: Config, run: Path, work: Callable[[Task], Played], set_up: Callable[[Config], None]
) -> Outcome:
    """Play every round that rounds.jsonl in `run` does not hold yet, and add it there.

    work: plays one task. set_up: called first, once in each process.
    """
    journal = run / "rounds.jsonl"
    outcome = Outcome(rounds=read_rounds(journal))
    pool = ProcessPoolExecutor(
        worker_count(config),
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_start_worker,
        initargs=(config, set_up),
    )
    progress = tqdm(total=planned_rounds(config), initial=len(outcome.rounds), unit="round")
    todo, pending = tasks(config, outcome.rounds, run), set()
    try:
        with pool:
            try:
                while True:
                    # No more than one scene a worker is under way, so that an end is soon an end.
                    more = islice(todo, worker_count(config) - len(pending))
                    pending |= {pool.submit(work, task) for task in more}
                    if not pending:
                        break
                    finished, pending = wait(pending, return_when=FIRST_COMPLETED)
                    _collect(finished, outcome, journal, progress)
            except KeyboardInterrupt:
                outcome.interrupted = True
                progress.write("interrupted: finishing the scenes under way")
                _collect(wait(pending).done, outcome, journal, progress)
    except BrokenProcessPool:
        outcome.error = UserError(
            f"a worker process died (out of memory?); {len(outcome.rounds)} rounds are safe in "
            f"{journal}: go on with --resume {run}, perhaps with evaluate.workers=1"
        )
    except UserError as error:  # a scene that cannot be made, an object that cannot be used
        outcome.error = error
    finally:
        progress.close()
    outcome.rounds = in_order(outcome.rounds, config)
    outcome.gallery.sort(key=lambda item: item.caption)  # not in the order of the workers' speed
    outcome.films.sort()
    return outcome


def _collect(finished: Iterable[Future], outcome: Outcome, journal: Path, progress: tqdm) -> None:
    for future in finished:
        played: Played = future.result()
        for record in played.rounds:
            append_round(journal, record)
        outcome.rounds += played.rounds
        outcome.gallery += played.gallery
        outcome.films += played.films
        progress.update(len(played.rounds))


def _start_worker(config: Config, set_up: Callable[[Config], None]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    cv2.setNumThreads(1)  # the workers fill the cores
    set_up(config)
