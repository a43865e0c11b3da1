"""The scoreboard: policies x scenarios x object sets on the same seeded scenes, with the full arm.

    python evaluate.py
    python evaluate.py evaluate.policies=heuristic evaluate.scenarios=pile evaluate.rounds=50
    python evaluate.py evaluate.object_sets=path/to/meshes objects.fit=0.06
    python evaluate.py --config configs/servo.yaml     # closed loops on what moves
    python evaluate.py simulator=mujoco                    # in another simulator, closed loops too
    python evaluate.py --config configs/sim_to_real.yaml  # what is lost from world to world

Prints a table and leaves results.json, results.csv, rounds.jsonl, report.html and failures.png in
runs/evaluate/<time>/. Ctrl-C stops early and still writes what was measured; --resume goes on.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # one thread a worker; the workers fill the cores

import argparse
import functools
import platform
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from envs.cell import Cell
from envs.cell_scenes import make_scene
from envs.execution import GraspOutcome, check_bin
from envs.objects import OBJECT_SETS, ObjectSet, load_object_set, prepare
from envs.policy_approach import approach_by, check_learned, is_learned, nowhere_yet
from envs.registries import check_names
from envs.rounds import run_round
from envs.scenarios import SCENARIOS
from envs.simulators import in_world, make_cell
from envs.studio import Film
from models.photographs import judge_as_taken, judge_photographs, photographs
from models.planners import make_planner, needs_truth
from models.rectangle_examples import draw_rectangles
from utils.config import (
    Config,
    TransferPolicy,
    parse_args,
    run_script,
    with_settings,
)
from utils.errors import UserError
from utils.executor import Outcome, Played, play_scenes, worker_count
from utils.geometry import Workspace
from utils.report import balanced, picture, write_failures, write_report
from utils.result_records import OPEN_LOOP, contestant
from utils.results import (
    FREE_TO_CHANGE,
    Task,
    check_controllers,
    check_rounds,
    compare,
    contestants,
    interruption,
    print_comparisons,
    print_stop_reasons,
    print_table,
    stop_reasons,
    summarise,
    write_csv,
    write_results,
)
from utils.runs import check_resume, check_writable, new_run_folder, save_results, write_atomic
from utils.transfer import (
    Score,
    TransferLine,
    draw_transfer,
    format_transfer,
    score_of,
    transfer_content,
    transfer_notes,
)
from utils.transforms import Grasp, RGBDFrame

# The worlds of the transfer report that are not simulated.
PHOTOGRAPHS = {"cornell": judge_photographs, "cornell_as_taken": judge_as_taken}


def main(argv: Sequence[str] | None = None) -> int:
    config, options = parse_args(argv, "Score grasp policies on the same scenes.", _add_options)
    check_names(config)
    if config.transfer.policies is not None:
        return report_transfer(config, options.resume, options.results)
    check_policies(config)
    check_controllers(config, options.overrides)
    check_resume(config, options.resume, FREE_TO_CHANGE)
    check_rounds(config, options.resume)
    check_writable("--results", options.results)
    check_cell(config)
    check_objects(config)
    run = options.resume or new_run_folder("evaluate", config.evaluate.name, config)
    announce(config, run)

    outcome = evaluate(config, run)

    rows = summarise(outcome.rounds, config.seed)
    print_table(rows)
    print_stop_reasons(stop_reasons(outcome.rounds))
    print_comparisons(compare(outcome.rounds, config.seed))
    unfinished, device = interruption(len(outcome.rounds), config), device_of(config)
    for path in filter(None, [run / "results.json", options.results]):
        write_results(path, rows, config, device, unfinished is None)
    write_csv(run / "results.csv", rows)
    gallery = balanced(outcome.gallery, config.evaluate.gallery)
    write_report(run / "report.html", rows, outcome.rounds, config, gallery, outcome.films, device)
    write_failures(run / "failures.png", outcome.gallery)
    print(f"report: {run / 'report.html'}")
    if unfinished is not None:
        print(f"{unfinished}; go on with --resume {run}")
    if outcome.error is not None:
        raise outcome.error
    return 130 if outcome.interrupted else 0


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--results", type=Path, metavar="FILE", help="also write results.json here")


# --- What is wrong is told before any work is done ------------------------------------------


def check_policies(config: Config) -> None:
    """Raise UserError for a policy that does not exist or a network that cannot be loaded."""
    for name in config.evaluate.policies:
        if is_learned(name):
            controllers = [controller for _, controller in contestants(config)]
            check_learned(name, config.evaluate.scenarios, controllers)
        else:
            make_planner(name, config.gripper.geometry, workspace_of(config), config.seed)


def check_cell(config: Config) -> None:
    """Raise UserError for a cell that cannot be had, or that keeps the arm from the bin."""
    make_cell(config).close()
    check_bin(config)


def check_objects(config: Config) -> None:
    """Raise UserError for an unusable object set. Someone's own meshes are read and cut into
    convex parts here, so that a broken one is named before any work is done."""
    for name in config.evaluate.object_sets:
        objects = load_objects(name, config)
        if name not in OBJECT_SETS:
            prepare(objects, min(worker_count(config), len(objects)))


@functools.cache
def load_objects(name: str, config: Config) -> ObjectSet:
    return load_object_set(
        name, max_opening=config.gripper.max_opening, cache_dir=config.cache_folder,
        **config.objects.model_dump(),
    )  # fmt: skip


def workspace_of(config: Config) -> Workspace:
    return Workspace(tuple(config.workspace.center), config.workspace.size)


def announce(config: Config, run: Path) -> None:
    plan = config.evaluate
    print(
        f"{', '.join(contestant(*pair) for pair in contestants(config))} on "
        f"{', '.join(plan.scenarios)} scenes of "
        f"{', '.join(plan.object_sets)} ({config.objects.split}), {plan.rounds} rounds each, "
        f"seed {config.seed}, in {config.simulator}, on {device_of(config)}; results in {run}",
        flush=True,
    )


def device_of(config: Config) -> str:
    return f"{platform.machine()} CPU, {worker_count(config)} workers"


# --- Every policy on every scene ------------------------------------------------------------

_config: Config  # of this worker process, as the cell is
_cell: Cell


def evaluate(config: Config, run: Path) -> Outcome:
    """Play what rounds.jsonl in `run` does not hold yet, in worker processes, and add it there."""
    return play_scenes(config, run, work, set_up=_set_up)


def _set_up(config: Config) -> None:
    global _config, _cell
    _config, _cell = config, make_cell(config)


def work(task: Task) -> Played:
    """Let each policy of a task work on its scene. Runs in a worker process."""
    objects, layout = load_objects(task.objects, _config), SCENARIOS[task.scenario].layout
    scene = make_scene(layout, objects, task.seed, _config)
    played = Played()
    for planner_name, controller in task.policies:
        policy, approach = contestant(planner_name, controller), None
        if is_learned(planner_name):
            approach, planner = approach_by(planner_name, _cell), nowhere_yet
        else:
            workspace = workspace_of(_config)
            planner = make_planner(planner_name, _cell.gripper, workspace, task.seed)
        privileged = needs_truth(planner)

        def keep(frame: RGBDFrame, grasp: Grasp, outcome: GraspOutcome, policy=policy) -> None:
            if task.keep_pictures or not outcome.success:
                shown = picture(frame, grasp, policy, task.scenario, outcome.reason)
                played.gallery.append(shown)

        film = Film(_cell) if task.film_folder is not None else None
        played.rounds.append(
            run_round(
                _cell, scene, planner, policy=planner_name, objects=task.objects,
                max_failures=_config.evaluate.max_failures, scenario=task.scenario,
                controller=controller, with_truth=privileged, on_attempt=keep,
                approach_by=approach,
            )
        )  # fmt: skip
        if film is not None:
            path = task.film_folder / _film_name(task, policy)
            film.write(path)
            played.films.append((path, f"{policy} on {task.scenario}"))
    return played


def _film_name(task: Task, policy: str) -> str:
    who = policy.replace(os.sep, "_")  # a checkpoint's path
    name = f"{task.scenario}-{Path(task.objects).name}-{who}-{task.seed}"
    return f"{name}.{_config.evaluate.film_format}"


# --- From one world to another --------------------------------------------------------------


class Scenes(NamedTuple):
    """What a row of the report is scored on."""

    scenarios: tuple[str, ...]
    objects: tuple[str, ...]

    def __str__(self) -> str:
        return f"{', '.join(self.scenarios)} of {', '.join(self.objects)}"


@dataclass(frozen=True)
class Contest:
    """Rows of the report that are scored on the same scenes in one world, and how."""

    world: str
    scenes: Scenes
    rows: tuple[TransferPolicy, ...]
    config: Config


def contests(config: Config) -> list[Contest]:
    """What there is to play for the transfer report; rows that are not trained are left out."""
    trained = [who for who in config.transfer.policies if is_trained(who)]
    found = []
    for scenes in dict.fromkeys(scenes_of(who, config) for who in trained):
        rows = tuple(who for who in trained if scenes_of(who, config) == scenes)
        plan = {"policies": list(dict.fromkeys(who.planner for who in rows))}
        plan |= {"scenarios": list(scenes.scenarios), "object_sets": list(scenes.objects)}
        here = with_settings(config, "evaluate", plan)
        for world in config.transfer.columns:
            if world not in PHOTOGRAPHS:
                found.append(Contest(world, scenes, rows, in_world(here, world)))
    return found


def scenes_of(who: TransferPolicy, config: Config) -> Scenes:
    """A row's own scenes, or those of the section evaluate."""
    if who.scenes is None:
        return Scenes(config.evaluate.scenarios, config.evaluate.object_sets)
    scenario, objects = who.scenes
    return Scenes((scenario,), (objects,))


def folder_name(scenes: Scenes) -> str:
    return str(scenes).replace(", ", "-").replace(" ", "_").replace(os.sep, "_")


def check_contest(contest: Contest) -> None:
    """Raise UserError for what cannot be played."""
    for who in contest.rows:
        if is_learned(who.planner):
            try:
                check_learned(who.planner, contest.scenes.scenarios, [OPEN_LOOP])
            except UserError as error:
                raise UserError(
                    f"transfer.policies: the row {who.policy}, {who.training} is scored on "
                    f"{contest.scenes}; give it scenes that it can play, such as [isolated, box] "
                    f"({error})"
                ) from None
    check_policies(contest.config)
    check_cell(contest.config)
    check_objects(contest.config)


def report_transfer(config: Config, resume: Path | None, results: Path | None) -> int:
    """Each policy on the same scenes in every world, and how well one foretells another."""
    worlds, policies = config.transfer.columns, config.transfer.policies
    if any(controller != OPEN_LOOP for _, controller in contestants(config)):
        raise UserError(
            "transfer.policies: the report compares open loops; leave evaluate.controllers null "
            "and closed_loop.controller open_loop"
        )
    to_play = contests(config)
    for contest in to_play:
        check_contest(contest)
    check_resume(config, resume, FREE_TO_CHANGE)
    check_rounds(config, resume)
    check_writable("--results", results)
    samples = photographs(config.transfer.cornell) if config.transfer.cornell else []
    run = resume or new_run_folder("evaluate", config.evaluate.name, config)

    scores: dict[TransferPolicy, dict[str, Score]] = {who: {} for who in policies}
    error, interrupted = None, False
    for contest in to_play:
        folder = run / contest.world / folder_name(contest.scenes)
        folder.mkdir(parents=True, exist_ok=True)
        announce(contest.config, folder)
        outcome = evaluate(contest.config, folder)
        write_failures(folder / "failures.png", outcome.gallery)
        for who in contest.rows:
            scores[who][contest.world] = score_of(outcome.rounds, who.planner)
        error, interrupted = outcome.error, outcome.interrupted
        if error is not None or interrupted:
            break
    for who in policies if samples else []:
        # A row with scenes of its own is there to be compared on these.
        if who.scenes is not None or not is_trained(who) or is_learned(who.planner):
            continue
        for world in (world for world in worlds if world in PHOTOGRAPHS):
            judged = PHOTOGRAPHS[world](who.planner, samples, config.seed)
            if judged is None:
                continue
            shown = [(sample, one) for sample, one in zip(samples, judged) if one is not None]
            scores[who][world] = Score(sum(one.correct for _, one in shown), len(samples))
            if shown:
                draw_rectangles(run / f"{Path(who.planner).stem}-{world}.png", *zip(*shown))

    lines = [
        TransferLine(who, str(scenes_of(who, config)), scores[who], is_trained(who))
        for who in policies
    ]
    print(format_transfer(lines, worlds), *transfer_notes(lines, worlds), sep="\n")
    complete = error is None and not interrupted
    content = {"complete": complete}
    content |= {"device": device_of(config), "config": config.model_dump(mode="json")}
    content |= transfer_content(lines)
    for path in filter(None, [run / "results.json", results]):
        save_results(path, content)
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


if __name__ == "__main__":
    run_script(main)
