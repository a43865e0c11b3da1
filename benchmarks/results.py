"""Every table of README and docs/results.md, measured and written there: make results

    make results                                  # all parts, ten hours: --list says how long
    make results PARTS=scoreboard,servo           # some of them
    make results PARTS=servo SCALE=0.05           # a trial: a twentieth of the rounds, other scenes
    make results PARTS=clutter15 SCALE=0.5 WRITE=1  # half of the rounds, in the docs
    make results PARTS=cornell,ycb,clutter CORNELL=path/to/cornell YCB=... CLUTTER=...
    python -m benchmarks.results --list           # the parts, their commands and how long they take
    python -m benchmarks.results --write          # only write the tables from docs/results/*.json
    python -m benchmarks.results --commit HASH    # what was measured at another commit, from runs/

A part is a list of commands that anyone can run alone. The parts that stop early (Ctrl-C) go on
with the next call: finished commands lie in runs/results/<commit>/, unfinished ones are resumed.
A finished part leaves its figures in docs/results/<part>.json and the first rounds of each row in
docs/results/<part>-<command>.jsonl; the tables are written from these files alone and say how many
rounds each row has. Each part has a file of its own, so that parts may have different scales.
docs/results/looks.json keeps each measurement, a look at the sealed scenes (`benchmarks.looks`).

Seed and objects are those of configs/sealed.yaml, on which no choice is made; docs/choices.md tells
on which seeds choices were made. A trial, whose figures no page shows, plays none of these scenes.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import os
import platform
import shlex
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict, replace
from datetime import date
from pathlib import Path
from typing import Any

from benchmarks.looks import add_look, begin_look
from benchmarks.result_parts import (
    NOWHERE,
    PARTS,
    SEED,
    SOURCES,
    TRIAL_SEED,
    Command,
    Folders,
    Part,
)
from benchmarks.result_tables import write_tables
from benchmarks.table_cells import weights_of
from utils.atomic_files import write_json_atomic
from utils.calibration import calibration_error, error_by_chance
from utils.config import load_config
from utils.errors import UserError
from utils.evaluation import in_order
from utils.result_records import RoundRecord, read_rounds, write_sample
from utils.results import compare, stated_chances
from utils.runs import REPOSITORY, environment, run_script

FIGURES = Path("docs/results")  # what the tables are written from
RUNS = Path("runs/results")
# Files on which a figure depends: a commit that touches none of them changes no table.
CODE = ("envs", "models", "utils", "configs", "checkpoints", ":(glob)*.py",
        "benchmarks/bench_*.py",
        "benchmarks/bowls.py", "benchmarks/metrics.py", "requirements.txt")  # fmt: skip


def main(argv: Sequence[str] | None = None) -> int:
    options = _parser().parse_args(argv)
    if not FIGURES.parent.is_dir():
        raise UserError(f"results: no {FIGURES.parent} here; start it in {REPOSITORY}")
    parts = chosen_parts(options.parts)
    if not 0 < options.scale < math.inf:
        raise UserError(f"--scale: got {options.scale:g}, expected a positive number such as 0.05")
    folders = {name: getattr(options, name) for name in SOURCES if getattr(options, name)}
    if not writes_docs(options):
        parts = [
            replace(part, commands=tuple(one.trial() for one in part.commands)) for part in parts
        ]
    if options.list:
        print_parts(parts, options.scale)
        return 0
    if not options.write:
        if options.commit is None:
            check_sources(parts, folders)
        commit = code_commit() if options.commit is None else commit_named(options.commit)
        for part in parts:
            if options.commit is not None and not is_finished(part, commit, options.scale):
                print(f"{part.name}: skipped, because {RUNS / commit} does not hold all of it")
            elif options.commit is None and (
                missing := [name for name in part.needs if name not in folders]
            ):
                for name in missing:
                    print(f"{part.name}: skipped, because no --{name} names {SOURCES[name]}")
            else:
                measure(part, commit, options.scale, folders, noted=writes_docs(options))
                if writes_docs(options):
                    publish(part, commit, options.scale)
                    write_tables(FIGURES)
        if not writes_docs(options):
            print(
                f"the figures are in {RUNS / commit}; they are of scenes with seed {TRIAL_SEED}, "
                "because --scale is below 1: --write-docs (make results WRITE=1) plays the sealed "
                "ones and writes the docs"
            )
            return 0
    print(f"wrote {', '.join(map(str, write_tables(FIGURES)))}", flush=True)
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description="Measure and write the tables of the docs.")
    parser.add_argument("--parts", help="names with commas between; default: all")
    parser.add_argument("--scale", type=float, default=1.0, help="of the rounds; 0.05 for a trial")
    parser.add_argument(
        "--write-docs",
        action="store_true",
        help="with a scale below 1, too, play the sealed scenes and write the docs",
    )
    for name, what in SOURCES.items():
        parser.add_argument(f"--{name}", type=_folder, help=f"folder of {what}")
    parser.add_argument("--list", action="store_true", help="print the parts and measure nothing")
    parser.add_argument("--write", action="store_true", help="only write the tables again")
    parser.add_argument("--commit", metavar="HASH", help="write what runs/ holds of that commit")
    return parser


def _folder(text: str) -> Path:
    return Path(os.path.expanduser(text))  # as make gives it: NAME=~/folder


def writes_docs(options: argparse.Namespace) -> bool:
    """Whether figures go to the docs: not those of a trial, but all that --commit asks for."""
    return options.scale >= 1 or options.write_docs or options.commit is not None


def chosen_parts(names: str | None) -> list[Part]:
    """The parts of a list such as 'scoreboard,servo'. Raises UserError for an unknown name."""
    known = {part.name: part for part in PARTS}
    wanted = list(known) if not names else [name.strip() for name in names.split(",")]
    for name in wanted:
        if name not in known:
            raise UserError(f"--parts: {name!r} is no part; choose among {', '.join(known)}")
    return [known[name] for name in wanted]


def print_parts(parts: Sequence[Part], scale: float) -> None:
    for part in parts:
        print(f"{part.name}: {part.about}; about {max(1, round(part.minutes * scale))} minutes")
        for command in part.commands:
            print(f"    {command.line(command.scaled(scale))}")
    total = sum(part.minutes for part in parts) * scale
    print(f"about {total / 60:.1f} hours on two cores")


def code_commit() -> str:
    """The last commit that changed what figures depend on. Raises UserError where files differ
    from it: a table names the commit that it was measured at."""
    changed = _git("status", "--porcelain", "--untracked-files=no", "--", *CODE)
    if changed:
        raise UserError(f"results: commit these first, tables name their commit: {changed.split()}")
    return _git("log", "-1", "--format=%H", "--", *CODE)


def commit_named(name: str) -> str:
    """The whole hash of a commit. Raises UserError where there is none of that name."""
    try:
        return _git("rev-parse", "--verify", f"{name}^{{commit}}")
    except UserError:
        raise UserError(f"--commit {name}: no commit of this repository; see git log") from None


def _git(*arguments: str) -> str:
    try:
        command = ["git", "-C", str(REPOSITORY), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError) as error:
        raise UserError(f"results: needs git and the repository's history ({error})") from None


# --- Measuring --------------------------------------------------------------------------------


def measure(
    part: Part, commit: str, scale: float, folders: Folders = NOWHERE, noted: bool = False
) -> None:
    """Run a part's commands that are not finished yet. noted: as a look, before the first of them.
    Raises UserError where one was measured, or begun, with another folder of SOURCES, and where the
    code changes while one runs."""
    for command in part.commands:
        check_folders(command, finished_file(part, command, commit, scale), folders)
    if noted and not is_finished(part, commit, scale):
        note_look(part, commit, scale)
    for command in part.commands:
        file = finished_file(part, command, commit, scale)
        if not file.exists():
            figures = run_command(part, command, scale, commit, folders)
            check_code(part, command, commit, file.stem)
            write_json_atomic(file, figures | {"folders": folders_of(command, folders)})


def check_code(part: Part, command: Command, commit: str, name: str) -> None:
    """Set a run aside, and raise UserError, where the code has changed since it began."""
    try:
        now = code_commit()
        if now == commit:
            return
        change = f"went from commit {commit[:10]} to {now[:10]}"
    except UserError as error:
        change = f"was changed ({error})"
    set_aside(command, name)
    raise UserError(
        f"results: the code {change} while {part.name} was measured, so that its figures are of "
        "no commit; start again"
    )


def folders_of(command: Command, folders: Folders) -> dict[str, str]:
    """The folders of SOURCES that a command reads, as absolute paths."""
    return {
        name: str(folder.resolve())
        for name, folder in folders.items()
        if name.upper() in command.arguments
    }


def set_aside(command: Command, name: str) -> None:
    """Rename a run of code that changed, so that no later call goes on with it."""
    run = latest_run(Path(command.program).stem, name)
    if run is not None:
        run.rename(run.with_name(f"{run.name}-of-changed-code"))


def note_look(part: Part, commit: str, scale: float) -> None:
    """Note, also in the docs, that a part's scenes are going to be played, if it has any."""
    if any(command.rounds is not None for command in part.commands):
        facts = {"part": part.name, "commit": commit, "scale": scale, "date": str(date.today())}
        begin_look(FIGURES, facts)
        write_tables(FIGURES)


def publish(part: Part, commit: str, scale: float) -> None:
    """Write the figures of a measured part, and the first rounds of each row, to docs/results."""
    measured: dict[str, Any] = {}
    for command in part.commands:
        file = finished_file(part, command, commit, scale)
        figures = json.loads(file.read_text(encoding="utf-8"))
        figures.pop("folders", None)
        # Files of older versions hold no date: the day on which they were written.
        figures.setdefault("date", str(date.fromtimestamp(file.stat().st_mtime)))
        if "run" in figures:
            run = Path(figures.pop("run"))
            if command.kept and not (run / "environment.json").is_file():
                raise UserError(
                    f"results: {run} is gone, whose first rounds belong to the docs; delete "
                    f"{file} and measure {part.name} again"
                )
            if command.kept:
                keep_rounds(part, command, run, commit)
        measured[command.name] = figures
    content = {
        "part": part.name, "commit": commit, "seed": SEED, "scale": scale,
        "date": max(figures["date"] for figures in measured.values()),
        "weights": weights_at(commit), "commands": measured,
    }  # fmt: skip
    write_json_atomic(FIGURES / f"{part.name}.json", content)
    add_look(FIGURES, content)


def weights_at(commit: str) -> dict[str, Any]:
    """`weights_of` the files of a commit."""

    def read(name: str) -> bytes | None:
        command = ["git", "-C", str(REPOSITORY), "show", f"{commit}:checkpoints/{name}"]
        done = subprocess.run(command, capture_output=True)
        return done.stdout if done.returncode == 0 else None

    return weights_of(read)


def is_finished(part: Part, commit: str, scale: float) -> bool:
    return all(finished_file(part, one, commit, scale).exists() for one in part.commands)


def finished_file(part: Part, command: Command, commit: str, scale: float) -> Path:
    return RUNS / commit / f"{run_name(part, command, command.scaled(scale), commit)}.json"


def run_name(part: Part, command: Command, rounds: int | None, commit: str) -> str:
    """Other arguments have another name, so that no run is taken for one of theirs. The folders of
    SOURCES are no part of it: `check_folders` refuses a run of another one."""
    digest = hashlib.sha256(command.line(rounds).encode()).hexdigest()[:6]
    return "-".join(["results", part.name, command.name, str(rounds or "all"), commit[:10], digest])


def run_command(
    part: Part, command: Command, scale: float, commit: str, folders: Folders
) -> dict[str, Any]:
    """Run a command to its end, going on where an earlier call stopped; its figures."""
    rounds = command.scaled(scale)
    name = run_name(part, command, rounds, commit)
    line = command.line(rounds, folders)
    if not command.program.endswith(".py"):
        output = RUNS / commit / f"{name}.metrics.json"
        run_program([*shlex.split(line), "--json", str(output)])
        figures: dict[str, Any] = {"metrics": json.loads(output.read_text(encoding="utf-8"))}
    else:
        script = Path(command.program).stem
        run = latest_run(script, name)
        if run is not None:
            run_program(["python", command.program, "--resume", str(run)])
        else:
            key = "evaluate" if script == "evaluate" else "train"
            run_program([*shlex.split(line), f"{key}.name={name}"])
            run = latest_run(script, name)
        if run is None:
            raise UserError(f"results: {line} left no folder runs/{script}/*-{name}")
        figures = without_places(figures_of(run), folders)
    environment_of = environment()
    return {
        "command": command.line(rounds),
        "rounds": rounds,
        "date": str(date.today()),
        "device": f"{platform.machine()}, {environment_of['cpu_count']} cores",
        "versions": {"python": environment_of["python"]} | environment_of["packages"],
    } | figures


def places_of(command: Command, folders: Folders) -> dict[str, Path]:
    """The places in folders of SOURCES that a command reads, by the config's key."""
    places = {}
    for word in shlex.split(command.line(None)):
        key, _, place = word.partition("=")
        for source, folder in folders.items():
            if Path(place).is_relative_to(Path("path/to", source)):
                places[key] = folder / Path(place).relative_to(Path("path/to", source))
    return places


def check_sources(parts: Sequence[Part], folders: Folders) -> None:
    """Raise UserError where a folder that one of the parts reads does not exist."""
    for command in (command for part in parts for command in part.commands):
        for place in places_of(command, folders).values():
            if not place.is_dir():
                options = ", ".join(f"--{name}" for name in folders_of(command, folders))
                raise UserError(f"{options}: there is no folder {place}; give the right one")


def check_folders(command: Command, finished: Path, folders: Folders) -> None:
    """Raise UserError where a command was begun, or finished in the file `finished`, with another
    folder of SOURCES than is given now."""
    run = latest_run(Path(command.program).stem, finished.stem)
    if run is not None:
        config = load_config(run / "config.yaml")
        for key, place in places_of(command, folders).items():
            section, name = key.split(".")
            begun = getattr(getattr(config, section), name)
            begun = Path(begun[0] if isinstance(begun, tuple) else begun)
            if begun.resolve() != place.resolve():
                raise UserError(
                    f"results: {run} has {key}={begun} and does not go on with {place}; give the "
                    f"folder of before, or delete {run} and {finished}"
                )
    if finished.exists():
        used = folders_of(command, folders)
        before = json.loads(finished.read_text(encoding="utf-8")).get("folders", used)
        if before != used:
            raise UserError(
                f"results: {finished} holds figures with {', '.join(before.values())}, not with "
                f"{', '.join(used.values())}; give the folder of before, or delete the file"
            )


def latest_run(script: str, name: str) -> Path | None:
    """The newest run folder with that name that can be gone on with."""
    runs = sorted(Path("runs", script).glob(f"*-{name}/config.yaml"))
    return runs[-1].parent if runs else None


def run_program(arguments: Sequence[str]) -> None:
    """Run a Python program and wait for it, after Ctrl-C too: it saves what it has.
    Raises KeyboardInterrupt where it was interrupted, UserError where it failed."""
    print(f"$ {shlex.join(arguments)}", flush=True)
    process = subprocess.Popen([sys.executable, *arguments[1:]])
    try:
        status = process.wait()
    except KeyboardInterrupt:
        process.wait()
        raise
    if status == 130:
        raise KeyboardInterrupt
    if status != 0:
        raise UserError(f"results: {shlex.join(arguments)} ended with status {status}")


def figures_of(run: Path) -> dict[str, Any]:
    """What a table needs of a run's results.json, and paired differences of its policies."""
    results = json.loads((run / "results.json").read_text(encoding="utf-8"))
    if "folds" in results:
        return {key: results[key] for key in ("correct", "images", "accuracy_ci95")}
    figures: dict[str, Any] = {"rows": results["rows"]}
    if (run / "rounds.jsonl").exists():
        # In the order of the plan: an interval by resampling depends on the order of the rounds.
        config = load_config(run / "config.yaml")
        rounds = in_order(read_rounds(run / "rounds.jsonl", config.camera.depth_noise), config)
        comparisons = compare(rounds, SEED)
        figures |= {"comparisons": [asdict(pair) for pair in comparisons], "run": str(run)}
        figures["calibration"] = calibration_of(rounds)
    return figures


def without_places(figures: dict[str, Any], folders: Folders) -> dict[str, Any]:
    """Figures whose object sets are path/to/NAME instead of places on this machine."""

    def told(objects: str) -> str:
        place = Path(objects).resolve()
        for name, folder in folders.items():
            if place.is_relative_to(folder.resolve()):
                return str(Path("path/to") / name / place.relative_to(folder.resolve()))
        return objects

    for one in (*figures.get("rows", ()), *figures.get("comparisons", ())):
        if "objects" in one:  # rows of a transfer report have none
            one["objects"] = " + ".join(map(told, one["objects"].split(" + ")))
    return figures


def calibration_of(rounds: Sequence[RoundRecord]) -> list[dict[str, Any]]:
    """The calibration error of each policy with each depth noise, over all its rounds."""
    found = []
    for policy, noise in dict.fromkeys((one.policy, one.depth_noise) for one in rounds):
        stated = stated_chances(
            one for one in rounds if (one.policy, one.depth_noise) == (policy, noise)
        )
        if stated is not None:
            chances, successes = stated
            found.append({
                "policy": policy, "depth_noise": noise, "grasps": len(chances),
                "chance": sum(chances) / len(chances), "success": sum(successes) / len(successes),
                "error": calibration_error(chances, successes),
                "error_by_chance": error_by_chance(chances),
            })  # fmt: skip
    return found


def keep_rounds(part: Part, command: Command, run: Path, commit: str) -> None:
    """Copy the first rounds of each row of a run's journal to docs/results, where
    `python evaluate.py --replay FILE` plays them again. They name the commit that the table
    names."""
    write_sample(run, FIGURES / f"{part.name}-{command.name}.jsonl", command.kept, commit)


if __name__ == "__main__":
    run_script(main)
