"""The scoreboard: policies x scenarios x object sets x depth noises on the same seeded scenes, with
the full arm.

    python evaluate.py
    python evaluate.py evaluate.policies=heuristic evaluate.scenarios=pile evaluate.rounds=50
    python evaluate.py evaluate.policies=heuristic,my_module:plan      # a planner of your own
    python evaluate.py evaluate.object_sets=path/to/meshes objects.fit=0.06
    python evaluate.py simulator=mujoco                   # in another simulator
    python evaluate.py --config configs/servo.yaml        # closed loops on moving objects
    python evaluate.py --config configs/sim_to_real.yaml  # the transfer report
    python evaluate.py --compare RUN RUN --csv FILE       # paired differences of two runs
    python evaluate.py --replay docs/results/FILE.jsonl   # play published rounds again

Prints a table and leaves results.json, results.csv, rounds.jsonl, report.html and failures.png in
runs/evaluate/<time>/. Ctrl-C stops early and keeps what was measured; --resume RUN goes on.
"""

from __future__ import annotations

import os

import utils.installation  # noqa: F401 - ends in one sentence where a package is missing

os.environ.setdefault("OMP_NUM_THREADS", "1")  # one thread a worker; the workers fill the cores

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from envs.evaluation_worker import check_everything, privileged_policies, work
from envs.objects import OBJECT_SETS
from envs.registries import check_names
from envs.transfer_plan import columns_of, evaluations_of, score_photographs, transfer_lines
from models.photographs import photographs
from utils.atomic_files import check_copies
from utils.config import Config, load_foreign, values_of
from utils.errors import RecurringError, UserError
from utils.evaluation import (
    FREE_TO_CHANGE,
    check_controllers,
    check_depth_noises,
    check_rounds,
    depth_noises_of,
    describe_workers,
    going_on,
    interruption,
    play,
    policies_of,
    replay,
)
from utils.report import balanced, write_failures, write_report
from utils.result_formats import (
    format_comparisons,
    format_scores,
    write_comparisons,
    write_csv,
    write_results,
)
from utils.result_records import differing_rounds, ending, policy_name, read_sample, versions_of
from utils.results import compare, compare_runs, stop_reasons, summarise
from utils.runs import check_resume, environment, open_run, parse_args, run_script, save_results
from utils.transfer import format_transfer, score_of, transfer_notes, write_transfer


def main(argv: Sequence[str] | None = None) -> int:
    config, options = parse_args(argv, "Score grasp policies on the same scenes.", _add_options)
    check_options(options)
    check_names(config)
    check_copies(copies(options))
    if options.compare is not None:
        return report_comparison(options)
    if options.replay is not None:
        return report_replay(options.replay, options.overrides)
    check_resume(config, options.resume, FREE_TO_CHANGE)
    check_rounds(config, options.resume)
    check_depth_noises(config, options.overrides)
    if config.transfer.policies is not None:
        return report_transfer(config, options)
    check_controllers(config, options.overrides)
    check_everything(config)
    with open_run(options.resume, "evaluate", config.evaluate.name, config) as run:
        return report_scores(config, options, run)


def report_scores(config: Config, options: argparse.Namespace, run: Path) -> int:
    """Play the rounds that are missing, and write table and report; returns the exit code."""
    announce(config, run)
    outcome = play(config, run, work, going_on(run, copies(options)))
    if outcome.error is not None and not outcome.rounds:
        raise outcome.error

    rows = summarise(outcome.rounds, config.seed)
    comparisons = compare(outcome.rounds, config.seed)
    print(format_scores(rows, stop_reasons(outcome.rounds), comparisons))
    unfinished, device = interruption(len(outcome.rounds), config), describe_workers(config)
    results = rows, comparisons, config, device, unfinished is None, run
    write_results(run / "results.json", *results)
    write_csv(run / "results.csv", rows)
    gallery = balanced(outcome.gallery, config.evaluate.gallery)
    write_report(
        run / "report.html", rows, outcome.rounds, comparisons, config, gallery, outcome.films,
        device, unfinished, privileged_policies(config),
    )  # fmt: skip
    write_failures(run / "failures.png", outcome.gallery)
    print(f"report: {run / 'report.html'}")
    if unfinished is not None:
        recurs = isinstance(outcome.error, RecurringError)
        print(unfinished + f"; go on with {going_on(run, copies(options))}" * (not recurs))
    # Last, so that the run's own files are there even where these cannot be written.
    if options.results is not None:
        write_results(options.results, *results)
    write_comparisons(comparisons, options.csv, options.latex)
    if outcome.error is not None:
        raise outcome.error
    return 130 if outcome.interrupted else 0


def _add_options(parser: argparse.ArgumentParser) -> None:
    def add(name: str, **settings) -> None:
        parser.add_argument(name, type=Path, **settings)

    add("--results", metavar="FILE", help="also write results.json here")
    add("--compare", metavar="RUN", nargs=2, help="paired differences of two runs, nothing else")
    add("--csv", metavar="FILE", help="also write the paired differences here")
    add("--latex", metavar="FILE", help="also write them here as a LaTeX table")
    add("--replay", metavar="FILE", help="play rounds of docs/results/*.jsonl again and compare")


def copies(options: argparse.Namespace) -> dict[str, Path | None]:
    """The files that are written besides the run's folder, by option."""
    return {f"--{name}": getattr(options, name) for name in ("results", "csv", "latex")}


# What plays no rounds of a config, or plays them with a config of its own, and the arguments that
# would have no effect with it.
IGNORED = {
    "compare": ("replay", "config", "resume", "overrides"),
    "replay": (
        "config", "resume", "results", "csv", "latex",
        *(f"evaluate.{key}" for key in ("rounds", "name", "videos", "gallery", "film_format")),
    ),
}  # fmt: skip


def check_options(options: argparse.Namespace) -> None:
    """Raise UserError for an argument that another one leaves without effect."""
    keys = [change.partition("=")[0].strip() for change in options.overrides]
    for mode, others in IGNORED.items():
        ignored = [name for name in others if getattr(options, name, None) or name in keys]
        if getattr(options, mode) is not None and ignored:
            told = {"overrides": "KEY=VALUE", **{key: key for key in keys}}
            words = [told.get(name, f"--{name}") for name in ignored]
            raise UserError(f"--{mode}: {', '.join(words)} would have no effect with it; omit them")


def announce(config: Config, run: Path) -> None:
    plan, split = config.evaluate, config.objects.split
    rounds = "1 round" if plan.rounds == 1 else f"{plan.rounds} rounds"
    sets = [f"{name} ({split})" if name in OBJECT_SETS else name for name in plan.object_sets]
    print(
        f"{', '.join(policy_name(*pair) for pair in policies_of(config))} on "
        f"{', '.join(plan.scenarios)} scenes of {', '.join(sets)} with depth noise "
        f"{', '.join(depth_noises_of(config))}, {rounds} each, seed {config.seed}, in "
        f"{config.simulator}, on {describe_workers(config)}; results in {run}",
        flush=True,
    )


# --- Two runs, and published rounds ---------------------------------------------------------


def report_comparison(options: argparse.Namespace) -> int:
    """Print the paired differences of two runs, first - second."""
    comparisons = compare_runs(*options.compare)
    print(format_comparisons(comparisons))
    write_comparisons(comparisons, options.csv, options.latex)
    if options.results is not None:
        content = {"runs": [str(run) for run in options.compare]}
        content["comparisons"] = [asdict(pair) for pair in comparisons]
        save_results(options.results, content, None)
    return 0


def report_replay(file: Path, overrides: Sequence[str]) -> int:
    """Play the rounds of a sample again; the status is 1 where one of them ends otherwise."""
    sample = read_sample(file)
    config = load_foreign(values_of(sample.overrides), str(file), overrides)
    check_names(config)
    print(f"{len(sample.rounds)} rounds of commit {sample.commit}, played again", flush=True)
    ours = versions_of(environment())
    for name, there in sample.versions.items():
        if there != ours.get(name):
            print(f"{name} is {ours.get(name)} here, the rounds were played with {there}")
    different = differing_rounds(sample.rounds, played := replay(sample, config, work, overrides))
    otherwise = differing_rounds(different, played, ending)
    for record in otherwise:
        print(f"ends otherwise: {record.policy}, {record.scenario}, scene {record.seed}")
    same = len(sample.rounds) - len(different)
    alike = len(different) - len(otherwise)
    print(f"{same} of {len(sample.rounds)} rounds are the same, {alike} others end alike")
    if different:
        why = "another processor, changed code or a KEY=VALUE given here plays other rounds"
        print(f"{why}: `git checkout {sample.commit}` has their code")
    return 1 if otherwise else 0


# --- The transfer report: the same rows in every column -------------------------------------


def report_transfer(config: Config, options: argparse.Namespace) -> int:
    """Score each row on the same scenes in every column, and report how the columns agree."""
    rows, columns = config.transfer.policies, columns_of(config)
    if options.csv is not None or options.latex is not None:
        raise UserError("--csv, --latex: the transfer report has no paired differences; omit them")
    evaluations = evaluations_of(config, options.overrides)
    for evaluation in evaluations:
        check_everything(evaluation.config, "transfer.policies")
    samples = photographs(config.transfer.cornell) if config.transfer.cornell else []
    with open_run(options.resume, "evaluate", config.evaluate.name, config) as run:
        scores, error, interrupted = {row: {} for row in rows}, None, False
        for evaluation in evaluations:
            folder = run / evaluation.column / evaluation.scenes.folder
            folder.mkdir(parents=True, exist_ok=True)
            announce(evaluation.config, folder)
            outcome = play(evaluation.config, folder, work, going_on(run, copies(options)))
            write_failures(folder / "failures.png", outcome.gallery)
            for row in evaluation.rows:
                scores[row][evaluation.column] = score_of(outcome.rounds, row.planner)
            error, interrupted = outcome.error, outcome.interrupted
            if error is not None or interrupted:
                break
        complete = error is None and not interrupted
        for row in rows if samples and complete else []:
            scores[row] |= score_photographs(row, samples, config, run)

        lines = transfer_lines(config, scores)
        print(format_transfer(lines, columns), *transfer_notes(lines, columns), sep="\n")
        device = describe_workers(config)
        write_transfer(run, lines, columns, config, device, complete, options.results)
        print(f"picture: {run / 'transfer.png'}")
        if not complete:
            print(f"interrupted; go on with {going_on(run, copies(options))}")
        if error is not None:
            raise error
        return 130 if interrupted else 0


if __name__ == "__main__":
    run_script(main)
