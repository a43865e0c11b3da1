"""How often the sealed scenes of each part were played, and what they gave each time.

Whenever `benchmarks.results` publishes the figures of a part, it adds a look to
docs/results/looks.json, so that no table can be measured again until it pleases without a trace. A
look holds the counts of each planner with a network, summed over the rows of a part that have the
same depth noise:

    {"scoreboard": [{"commit": ..., "date": ..., "scale": 1.0, "noises": {"realsense": {
        "graspnet": {"successes": 97, "attempts": 100, "cleared": 97, "objects": 100}}}}]}

Of rows with a target, `cleared` counts the targets in hand, and `objects` the targets. Policies of
PPO and closed loops are not kept; docs/results.md tells how often their scenes were played.
"""

from __future__ import annotations

import json
from pathlib import Path

from benchmarks.table_cells import Figures, Say, noise_of, percent, table
from utils.atomic_files import write_json_atomic
from utils.result_records import CLEAN

FILE = "looks.json"
PLANNERS = ("graspnet", "graspnet_direct", "graspnet6d")
_COUNTS = {"successes": "successes", "attempts": "attempts",
           "cleared": "objects_cleared", "objects": "objects_total"}  # fmt: skip
_OF_TARGETS = {"cleared": "targets_in_hand", "objects": "targets"}


def add_look(folder: Path, part: Figures) -> None:
    """Add a part's figures to the looks of a folder. The same figures, published again, are no new
    look; those without a planner of PLANNERS are none."""
    look, file = look_of(part), folder / FILE
    if not look["noises"]:
        return
    looks: dict[str, list[Figures]] = json.loads(file.read_text()) if file.exists() else {}
    earlier = looks.setdefault(part["part"], [])
    if look not in earlier:
        earlier.append(look)
    write_json_atomic(file, looks)


def look_of(part: Figures) -> Figures:
    """The look that a part's figures are, as the file holds it."""
    noises: dict[str, dict[str, dict[str, int]]] = {}
    rows = [row for command in part["commands"].values() for row in command.get("rows", ())]
    for row in rows:
        if row.get("policy") in PLANNERS:
            planners = noises.setdefault(noise_of(row), {})
            sums = planners.setdefault(row["policy"], dict.fromkeys(_COUNTS, 0))
            for name, key in (_COUNTS | (_OF_TARGETS if row.get("targets") else {})).items():
                sums[name] += row[key]
    return {key: part[key] for key in ("commit", "date", "scale")} | {"noises": noises}


def looks_table(say: Say, looks: dict[str, list[Figures]]) -> str:
    """A line for each look and depth noise: success and cleared of each planner. Clean rows stand
    there only where a look has no noisy ones."""
    lines = []
    for part, own in looks.items():
        for number, look in enumerate(own, start=1):
            noisy = {name: of for name, of in look["noises"].items() if name != CLEAN}
            for noise, planners in (noisy or look["noises"]).items():
                counts = [planners.get(planner) for planner in PLANNERS]
                objects = max(one["objects"] for one in planners.values())
                lines.append([
                    f"`{part}`", number, look["date"], f"`{look['commit'][:7]}`", f"`{noise}`",
                    objects, *map(_shares, counts),
                ])  # fmt: skip
    header = ["part", "look", "date", "commit", "depth", "objects"]
    return table(list(map(say, [*header, *(f"`{name}`" for name in PLANNERS)])), lines)


def _shares(counts: dict[str, int] | None) -> str:
    """'97 %, 95 %': success and cleared; '-' without attempts."""
    if counts is None or counts["attempts"] == 0:
        return "-"
    success = percent(counts["successes"], counts["attempts"])
    return f"{success} %, {percent(counts['cleared'], counts['objects'])} %"
