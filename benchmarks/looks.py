"""How often the sealed scenes of each part were played, and what they gave each time.

`benchmarks.results` adds a look to docs/results/looks.json whenever it publishes the figures of a
part, so that no table can be measured again until it pleases without a trace. A look holds the
successes, attempts, removed objects and objects of each planner that learns, summed over the rows
of a part with the same depth noise; of rows with a target, the targets in hand and the targets.
"""

from __future__ import annotations

import json
from pathlib import Path

from benchmarks.table_cells import Figures, noise_of
from utils.result_records import CLEAN
from utils.runs import write_json_atomic

NAME = "looks"
LEARNED = ("graspnet", "graspnet_direct", "graspnet6d")
COUNTS = ("successes", "attempts", "objects_cleared", "objects_total")
TARGET_COUNTS = ("successes", "attempts", "targets_in_hand", "targets")


def look_of(part: Figures) -> Figures:
    """The look that a part's figures are."""
    noises: dict[str, dict[str, list[int]]] = {}
    rows = [row for command in part["commands"].values() for row in command.get("rows", ())]
    for row in rows:
        if row.get("policy") in LEARNED:
            sums = noises.setdefault(noise_of(row), {}).setdefault(row["policy"], [0] * len(COUNTS))
            for place, name in enumerate(TARGET_COUNTS if row.get("targets") else COUNTS):
                sums[place] += row[name]
    return {key: part[key] for key in ("commit", "date", "scale")} | {"noises": noises}


def add_look(folder: Path, part: Figures) -> None:
    """Add a part's figures to the looks of a folder. The same commit at the same scale, which gives
    the same figures, is no new look; nor are figures without a planner that learns kept."""
    look, file = look_of(part), folder / f"{NAME}.json"
    if not look["noises"]:
        return
    looks: dict[str, list[Figures]] = json.loads(file.read_text()) if file.exists() else {}
    own = looks.setdefault(part["part"], [])
    if all((one["commit"], one["scale"]) != (look["commit"], look["scale"]) for one in own):
        own.append(look)
    write_json_atomic(file, looks)


def shown_noises(look: Figures) -> dict[str, dict[str, list[int]]]:
    """The counts of a look by depth noise: those with noise, where there are any."""
    noises: dict[str, dict[str, list[int]]] = look["noises"]
    return {name: of for name, of in noises.items() if name != CLEAN} or noises
