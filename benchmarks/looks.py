"""How often the sealed scenes of each part were played, and what they gave each time.

Before `benchmarks.results` plays sealed scenes, it adds a look to docs/results/looks.json, so that
no table can be measured again until it pleases without a trace; one that was broken off stays
there without counts. As the figures are published, the look gets the counts of each planner with a
network, summed over the rows of a part that have the same depth noise:

    {"scoreboard": [{"commit": ..., "date": ..., "scale": 1.0, "noises": {"realsense": {
        "graspnet": {"successes": 97, "attempts": 100, "cleared": 97, "objects": 100}}}}]}

Of rows with a target, `cleared` counts the targets in hand, and `objects` the targets. Finished
looks of policies of PPO and of closed loops are not kept; the pages tell how often their scenes
were played.
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
_FACTS = ("commit", "date", "scale")
_OF_TARGETS = {"cleared": "targets_in_hand", "objects": "targets"}


def begin_look(folder: Path, part: Figures) -> None:
    """Note in a folder that a part is going to be played at a commit, on a date, with a scale. One
    that goes on is no new look."""
    looks = _looks(folder)
    earlier = looks.setdefault(part["part"], [])
    if not any(_is_begun(look, part) for look in earlier):
        earlier.append({key: part[key] for key in _FACTS} | {"noises": {}})
    write_json_atomic(folder / FILE, looks)


def add_look(folder: Path, part: Figures) -> None:
    """Add a part's figures to the looks of a folder, in place of the look that was begun. The same
    figures, published again, are no new look; those without a planner of PLANNERS are none."""
    looks = _looks(folder)
    earlier = [look for look in looks.get(part["part"], []) if not _is_begun(look, part)]
    look = look_of(part)
    if look["noises"] and look not in earlier:
        earlier.append(look)
    after = {name: own for name, own in (looks | {part["part"]: earlier}).items() if own}
    if after != looks:
        write_json_atomic(folder / FILE, after)


def _looks(folder: Path) -> dict[str, list[Figures]]:
    file = folder / FILE
    return json.loads(file.read_text(encoding="utf-8")) if file.exists() else {}


def _is_begun(look: Figures, part: Figures) -> bool:
    """Whether it is the unfinished look of a part, which may have begun on another day."""
    return not look["noises"] and all(look[key] == part[key] for key in ("commit", "scale"))


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
    return {key: part[key] for key in _FACTS} | {"noises": noises}


def looks_table(say: Say, looks: dict[str, list[Figures]]) -> str:
    """A line for each look and depth noise: success and cleared of each planner. Clean rows stand
    there only where a look has no noisy ones. A look that was broken off has no counts."""
    lines = []
    for part, own in looks.items():
        for number, look in enumerate(own, start=1):
            noisy = {name: of for name, of in look["noises"].items() if name != CLEAN}
            facts = [f"`{part}`", number, look["date"], f"`{look['commit'][:7]}`"]
            for noise, planners in (noisy or look["noises"]).items():
                counts = [planners.get(planner) for planner in PLANNERS]
                objects = max(one["objects"] for one in planners.values())
                lines.append([*facts, f"`{noise}`", objects, *map(_shares, counts)])
            if not look["noises"]:
                lines.append([*facts, "not finished", 0, "-", "-", "-"])
    header = ["part", "look", "date", "commit", "depth", "objects"]
    return table(list(map(say, [*header, *(f"`{name}`" for name in PLANNERS)])), lines)


def _shares(counts: dict[str, int] | None) -> str:
    """'97 %, 95 %': success and cleared; '-' without attempts."""
    if counts is None or counts["attempts"] == 0:
        return "-"
    success = percent(counts["successes"], counts["attempts"])
    return f"{success} %, {percent(counts['cleared'], counts['objects'])} %"
