"""The scoreboard: policies x scenarios x object sets on the same seeded scenes, with the full arm.

    python evaluate.py
    python evaluate.py evaluate.policies=heuristic evaluate.scenarios=pile evaluate.rounds=50
    python evaluate.py evaluate.object_sets=path/to/meshes objects.fit=0.06
    python evaluate.py --config configs/servo.yaml     # closed loops on what moves
    python evaluate.py world=mujoco                    # in another simulator
    python evaluate.py --config configs/sim_to_real.yaml  # what is lost from world to world

Prints a table and leaves results.json, results.csv, rounds.jsonl, report.html and failures.png in
runs/evaluate/<time>/. Ctrl-C stops early and still writes what was measured; --resume goes on.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # one thread a worker; the workers fill the cores

import argparse
import functools
import multiprocessing
import platform
import signal
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

import cv2
from tqdm import tqdm

from envs.base_cell import BaseCell
from envs.challenges import CHALLENGES
from envs.execution import GraspOutcome
from envs.learned_policies import approach_by, check_learned, is_learned
from envs.objects import ObjectSet, load_object_set, prepare
from envs.policy_approach import nowhere_yet
from envs.rounds import run_round
from envs.scenes import make_scene
from envs.studio import Film
from envs.worlds import in_world, make_cell
from models.photographs import judge_photographs, photographs, sees_photographs
from models.planners import make_planner
from models.rectangle_pictures import draw_rectangles
from utils.config import (
    OBJECT_SETS,
    Config,
    TransferPolicy,
    load_config,
    parse_args,
    run_script,
    with_settings,
)
from utils.errors import UserError
from utils.files import write_atomic, write_json_atomic
from utils.gallery import balanced, write_failures
from utils.geometry import GripperGeometry, Workspace
from utils.overlay import draw_grasp
from utils.report import GalleryItem, write_report
from utils.results import (
    OPEN_LOOP,
    RoundRecord,
    append_round,
    compare,
    contestant,
    interruption,
    planned_rounds,
    print_comparisons,
    print_table,
    read_rounds,
    summarise,
    write_csv,
    write_results,
)
from utils.runs import check_writable, git_state, new_run_folder
from utils.stop_reasons import print_stop_reasons, stop_reasons
from utils.transfer import (
    Score,
    TransferLine,
    draw_transfer,
    format_transfer,
    score_of,
    transfer_content,
    transfer_notes,
)
from utils.transforms import Grasp, RGBDFrame, grasp_to_image

PHOTOGRAPHS = "cornell"  # the one world of the transfer report that is not simulated


def main(argv: Sequence[str] | None = None) -> int:
    config, options = parse_args(argv, "Score grasp policies on the same scenes.", _add_options)
    if config.transfer.policies is not None:
        return report_transfer(config, options.resume, options.results)
    check_policies(config)
    check_controllers(config, options.overrides)
    check_resume(config, options.resume)
    check_writable("--results", options.results)
    make_cell(config).close()  # what cannot be had is named here, not by a dying worker
    check_objects(config)
    run = options.resume or new_run_folder("evaluate", config.evaluate.name, config)
    device = f"{platform.machine()} CPU, {worker_count(config)} workers"
    announce(config, run, device)

    outcome = evaluate(config, run)

    rows = summarise(outcome.rounds, config.seed)
    print_table(rows)
    print_stop_reasons(stop_reasons(outcome.rounds))
    print_comparisons(compare(outcome.rounds, config.seed))
    complete = interruption(len(outcome.rounds), config) is None
    for path in filter(None, [run / "results.json", options.results]):
        write_results(path, rows, config, git_state().commit, device, complete)
    write_csv(run / "results.csv", rows)
    gallery = balanced(outcome.gallery, config.evaluate.gallery)
    write_report(run / "report.html", rows, outcome.rounds, config, gallery, outcome.films, device)
    write_failures(run / "failures.png", outcome.gallery)
    print(f"report: {run / 'report.html'}")
    if not complete:
        print(f"{interruption(len(outcome.rounds), config)}; go on with --resume {run}")
    if outcome.error is not None:
        raise outcome.error
    return 130 if outcome.interrupted else 0


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--results", type=Path, metavar="FILE", help="also write results.json here")


def check_policies(config: Config) -> None:
    """Raise UserError for a policy that does not exist or a network that cannot be loaded."""
    for name in config.evaluate.policies:
        if is_learned(name):
            controllers = [controller for _, controller in contestants(config)]
            check_learned(name, config.evaluate.scenarios, controllers)
        else:
            make_planner(name, GripperGeometry(), workspace_of(config), config.seed)


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


def workspace_of(config: Config) -> Workspace:
    return Workspace(tuple(config.workspace.center), config.workspace.size)


def check_resume(config: Config, run: Path | None) -> None:
    """Raise UserError if a resumed run would mix rounds of different experiments."""
    if run is None:
        return
    free = {"rounds", "workers", "name", "videos", "gallery", "film_format"}
    before = load_config(run / "config.yaml").model_dump()
    now = config.model_dump()
    if now["evaluate"]["rounds"] < before["evaluate"]["rounds"]:
        raise UserError(
            f"--resume {run}: evaluate.rounds is {now['evaluate']['rounds']}, the run began with "
            f"{before['evaluate']['rounds']}; it can only grow"
        )
    for plan in (before["evaluate"], now["evaluate"]):
        for key in free:
            plan.pop(key)
    if before != now:
        raise UserError(
            f"--resume {run}: only evaluate.{', evaluate.'.join(sorted(free))} may differ from the "
            "run that is resumed; start a new run for anything else"
        )


def check_objects(config: Config) -> None:
    """Raise UserError for an unusable object set. Someone's own meshes are read and cut into
    convex parts here, so that a broken one is named before any work is done."""
    for name in config.evaluate.object_sets:
        objects = load_objects(name, config)
        if name not in OBJECT_SETS:
            prepare(objects, min(worker_count(config), len(objects)))


@functools.cache
def load_objects(name: str, config: Config) -> ObjectSet:
    return load_object_set(name, cache_dir=config.cache_folder, **config.objects.model_dump())


def worker_count(config: Config) -> int:
    return config.evaluate.workers or os.cpu_count() or 1


def announce(config: Config, run: Path, device: str) -> None:
    plan = config.evaluate
    print(
        f"{', '.join(contestant(*pair) for pair in contestants(config))} on "
        f"{', '.join(plan.scenarios)} scenes of "
        f"{', '.join(plan.object_sets)} ({config.objects.split}), {plan.rounds} rounds each, "
        f"seed {config.seed}, in {config.world}, on {device}; results in {run}",
        flush=True,
    )


# --- From one world to another --------------------------------------------------------------


def report_transfer(config: Config, resume: Path | None, results: Path | None) -> int:
    """The same policies on the same scenes in every world, and how well one foretells another."""
    worlds, policies = config.transfer.worlds, config.transfer.policies
    if any(controller != OPEN_LOOP for _, controller in contestants(config)):
        raise UserError(
            "transfer.policies: the report compares open loops; leave evaluate.controllers null "
            "and grasp.controller open_loop"
        )
    planners = list(dict.fromkeys(who.planner for who in policies if is_trained(who)))
    config_of = {
        world: with_settings(in_world(config, world), "evaluate", {"policies": planners})
        for world in worlds
        if world != PHOTOGRAPHS
    }
    for there in config_of.values():
        check_policies(there)
        make_cell(there).close()
    check_resume(config, resume)
    check_writable("--results", results)
    check_objects(config)
    samples = photographs(config.transfer.cornell) if config.transfer.cornell else []
    run = resume or new_run_folder("evaluate", config.evaluate.name, config)
    device = f"{platform.machine()} CPU, {worker_count(config)} workers"

    scores: dict[str, dict[str, Score]] = {planner: {} for planner in planners}
    error, interrupted = None, False
    for world, there in config_of.items():
        (run / world).mkdir(exist_ok=True)
        announce(there, run / world, device)
        outcome = evaluate(there, run / world)
        write_failures(run / world / "failures.png", outcome.gallery)
        for planner in planners:
            scores[planner][world] = score_of(outcome.rounds, planner)
        error, interrupted = outcome.error, outcome.interrupted
        if error is not None or interrupted:
            break
    for planner in planners if samples and PHOTOGRAPHS in worlds else []:
        if is_learned(planner) or not sees_photographs(planner, config.seed):
            continue
        judged = judge_photographs(planner, samples, config.seed)
        shown = [(sample, one) for sample, one in zip(samples, judged) if one is not None]
        scores[planner][PHOTOGRAPHS] = Score(sum(one.correct for _, one in shown), len(samples))
        if shown:
            draw_rectangles(run / f"{Path(planner).stem}-{PHOTOGRAPHS}.png", *zip(*shown))

    lines = [TransferLine(who, scores.get(who.planner, {}), is_trained(who)) for who in policies]
    print(format_transfer(lines, worlds), *transfer_notes(lines, worlds), sep="\n")
    complete = error is None and not interrupted
    content = {"schema": 1, "complete": complete, "commit": git_state().commit, "device": device}
    content |= {"config": config.model_dump(mode="json"), **transfer_content(lines)}
    for path in filter(None, [run / "results.json", results]):
        write_json_atomic(path, content)
    write_atomic(run / "transfer.png", draw_transfer(lines, worlds))
    print(f"picture: {run / 'transfer.png'}")
    if not complete:
        print(f"interrupted; go on with --resume {run}")
    if error is not None:
        raise error
    return 130 if interrupted else 0


def is_trained(who: TransferPolicy) -> bool:
    """Whether a row of the report can be scored: what is no file needs no training."""
    file = Path(who.planner.partition(":")[2] if is_learned(who.planner) else who.planner)
    return file.suffix != ".pt" or file.exists()


# --- Running rounds in worker processes -----------------------------------------------------


@dataclass(frozen=True)
class Task:
    """One scene, on which every policy that is still to be scored works in turn, a policy being a
    planner's name and a controller's."""

    objects: str
    scenario: str
    seed: int
    policies: tuple[tuple[str, str], ...]
    keep_pictures: bool
    film_folder: Path | None


@dataclass
class Outcome:
    """rounds: what was measured; films: (file, caption); interrupted: by Ctrl-C; error: what ended
    the work early, to be raised once the rest has been written."""

    rounds: list[RoundRecord] = field(default_factory=list)
    gallery: list[GalleryItem] = field(default_factory=list)
    films: list[tuple[Path, str]] = field(default_factory=list)
    interrupted: bool = False
    error: UserError | None = None


def contestants(config: Config) -> list[tuple[str, str]]:
    """Every policy with every controller."""
    controllers = config.evaluate.controllers or (config.grasp.controller,)
    return [
        (policy, controller) for policy in config.evaluate.policies for controller in controllers
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


def evaluate(config: Config, run: Path) -> Outcome:
    """Run every round that rounds.jsonl in `run` does not hold yet, and add it there."""
    journal = run / "rounds.jsonl"
    outcome = Outcome(rounds=read_rounds(journal))
    pool = ProcessPoolExecutor(
        worker_count(config),
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_start_worker,
        initargs=(config,),
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
    outcome.rounds.sort(key=lambda r: _rank(r, config))
    outcome.gallery.sort(key=lambda item: item.caption)  # not in the order of the workers' speed
    outcome.films.sort()
    return outcome


def _collect(finished: Iterable[Future], outcome: Outcome, journal: Path, progress: tqdm) -> None:
    for future in finished:
        rounds, pictures, films = future.result()
        for record in rounds:
            append_round(journal, record)
        outcome.rounds += rounds
        outcome.gallery += pictures
        outcome.films += films
        progress.update(len(rounds))


def _rank(record: RoundRecord, config: Config) -> tuple[int, ...]:
    plan = config.evaluate
    policies = [contestant(*pair) for pair in contestants(config)]
    known = record.policy in policies  # a resumed report may have lost the weights of one
    return (
        plan.object_sets.index(record.objects),
        plan.scenarios.index(record.scenario),
        policies.index(record.policy) if known else len(policies),
        record.seed,
    )


_worker_config: Config
_worker_cell: BaseCell


def _start_worker(config: Config) -> None:
    global _worker_config, _worker_cell
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    cv2.setNumThreads(1)  # as with OMP_NUM_THREADS
    _worker_config, _worker_cell = config, make_cell(config)


def work(task: Task) -> tuple[list[RoundRecord], list[GalleryItem], list[tuple[Path, str]]]:
    """Let each policy of a task work on its scene. Runs in a worker process."""
    config, cell = _worker_config, _worker_cell
    scene = make_scene(
        CHALLENGES[task.scenario].layout, load_objects(task.objects, config), task.seed, config,
        cell.client,
    )  # fmt: skip
    workspace = workspace_of(config)
    rounds, pictures, films = [], [], []
    for planner_name, controller in task.policies:
        policy, approach = contestant(planner_name, controller), None
        if is_learned(planner_name):
            approach, planner = approach_by(planner_name, cell), nowhere_yet
        else:
            planner = make_planner(planner_name, GripperGeometry(), workspace, task.seed)
        privileged = getattr(planner, "needs_truth", False)

        def keep(frame: RGBDFrame, grasp: Grasp, outcome: GraspOutcome, policy=policy) -> None:
            if task.keep_pictures or not outcome.success:
                pictures.append(picture(frame, grasp, outcome, policy, task.scenario))

        film = Film(cell) if task.film_folder is not None else None
        rounds.append(
            run_round(
                cell, scene, planner, policy=planner_name, objects=task.objects,
                max_failures=config.evaluate.max_failures, scenario=task.scenario,
                controller=controller, with_truth=privileged, on_attempt=keep,
                approach_by=approach,
            )
        )  # fmt: skip
        if film is not None:
            who = policy.replace(os.sep, "_")  # a checkpoint's path
            name = f"{task.scenario}-{Path(task.objects).name}-{who}-{task.seed}"
            path = task.film_folder / f"{name}.{config.evaluate.film_format}"
            film.write(path)
            films.append((path, f"{policy} on {task.scenario}"))
    return rounds, pictures, films


def picture(
    frame: RGBDFrame, grasp: Grasp, outcome: GraspOutcome, policy: str, scenario: str
) -> GalleryItem:
    """The frame with the grasp drawn in, and how it went."""
    on_image = grasp_to_image(grasp, frame.K, frame.T_WC)
    image = draw_grasp(frame.rgb, on_image, frame.K, success=outcome.success)
    return GalleryItem(image, f"{policy}, {scenario}: {outcome.reason}", outcome.success, policy)


if __name__ == "__main__":
    run_script(main)
