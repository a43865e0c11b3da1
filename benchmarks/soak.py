"""Faults by the thousand, and what is lost by them: make soak, or python -m benchmarks.soak

    make soak                                  # all parts, many hours; writes docs/reliability.md
    make soak PARTS=actions_mujoco SCALE=0.1   # some of them, a tenth of the tries
    python -m benchmarks.soak --list           # the parts

Each part does harm many times and counts how often the program survived and what was lost. The
table is printed. `--json FILE` keeps it: parts that FILE holds from earlier calls stay. Ctrl-C and
SIGTERM end a part early; what was tried until then counts.
"""

from __future__ import annotations

import argparse
import json
import math
import platform
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from datetime import date
from functools import partial
from pathlib import Path
from threading import Event
from typing import Any

from benchmarks.soak_arm import soak_actions, soak_memory
from benchmarks.soak_files import soak_files
from benchmarks.soak_processes import small_disk, soak_disk, soak_stopped, soak_workers
from benchmarks.soak_tally import Tally
from envs.simulators import SIMULATORS
from utils.atomic_files import check_writable, write_json_atomic
from utils.distributed import stop_on_interrupt
from utils.errors import UserError
from utils.runs import environment, run_script

SEED = 2027


@dataclass(frozen=True)
class Part:
    """run: is called with the scale, the seed and an event that ends it; yields its rows, each
    before it is filled. minutes: on one core of a quiet machine."""

    about: str
    minutes: int
    run: Callable[[float, int, Event], Iterator[Tally]]


INSTALLED = [name for name, simulator in SIMULATORS.items() if simulator.installed]
PARTS = {
    f"{part}_{simulator}": Part(about, minutes, partial(run, simulator))
    for part, about, minutes, run in (
        ("actions", "random and extreme actions in every mode, limits checked", 15, soak_actions),
        ("memory", "a million steps and ten thousand resets", 40, soak_memory),
    )
    for simulator in INSTALLED
} | {
    "files": Part("damaged files of every kind that is read", 10, soak_files),
    "disk": Part("full disks and read-only folders; has to run as root", 2, soak_disk),
    "workers": Part(
        "workers that hang, freeze or are slow, here and on a cluster", 5, soak_workers
    ),
    "stopped": Part("scripts that are stopped by SIGTERM and SIGKILL", 30, soak_stopped),
}


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--parts", help="names with commas between; default: all")
    parser.add_argument("--scale", type=float, default=1.0, help="of the tries; 0.01 for a trial")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also keep the table there")
    parser.add_argument("--list", action="store_true", help="print the parts and try nothing")
    options = parser.parse_args(argv)
    wanted = PARTS if options.parts is None else options.parts.split(",")
    names = [name.strip() for name in wanted]
    for name in names:
        if name not in PARTS:
            raise UserError(f"--parts: {name!r} is no part; choose among {', '.join(PARTS)}")
    if not 0 < options.scale < math.inf:
        raise UserError(f"--scale: got {options.scale:g}, expected a positive number such as 0.01")
    if options.list:
        for name in names:
            minutes = max(1, round(PARTS[name].minutes * options.scale))
            print(f"{name}: {PARTS[name].about}; about {minutes} minutes")
        return 0
    kept_in(options.json)  # a file that cannot be added to is found out now
    if "disk" in names:  # and so is a user who may mount none
        with small_disk():
            pass
    lost = 0
    with stop_on_interrupt("stopping: what was tried until now counts") as stop:
        for name in names:
            if stop.is_set():
                return 130
            begun, tallies = time.perf_counter(), []
            for tally in PARTS[name].run(options.scale, SEED, stop):
                tallies.append(tally)
            print(*map(in_words, tallies), sep="\n", flush=True)
            lost += sum(tally.lost for tally in tallies)
            if options.json is not None:
                minutes = round((time.perf_counter() - begun) / 60, 1)
                keep(options.json, name, options.scale, minutes, tallies)
    if stop.is_set():
        return 130
    return 1 if lost else 0


def in_words(tally: Tally) -> str:
    return (
        f"{tally.fault}: {tally.tried:,} tried, {tally.survived:,} survived, {tally.lost:,} lost"
        f"{f' ({tally.note})' if tally.note else ''}"
    )


def kept_in(path: Path | None) -> dict[str, Any]:
    """The rows of other parts in a file, which need not exist. Raises UserError."""
    check_writable("--json", path)
    if path is None or not path.exists():
        return {}
    try:
        kept = json.loads(path.read_text())
    except ValueError as error:
        raise UserError(f"--json {path}: holds no JSON ({error}); choose another file") from None
    if not isinstance(kept, dict):
        raise UserError(f"--json {path}: holds no table of this command; choose another file")
    return kept


def keep(path: Path, part: str, scale: float, minutes: float, tallies: Sequence[Tally]) -> None:
    """Write a part's rows to a file, beside those of other parts."""
    kept, facts = kept_in(path), environment()
    kept[part] = {
        "command": f"python -m benchmarks.soak --parts {part} --scale {scale:g}",
        "commit": facts["commit"],
        "dirty": facts["dirty"],
        "date": str(date.today()),
        "seed": SEED,
        "minutes": minutes,
        "device": f"{platform.machine()}, {facts['cpu_count']} cores",
        "versions": {"python": facts["python"]} | facts["packages"],
        "rows": [asdict(tally) for tally in tallies],
    }
    write_json_atomic(path, kept)


if __name__ == "__main__":
    run_script(main)
