"""Cells, Markdown and origins, of which `benchmarks.result_tables` makes the tables of the pages.

Figures are plain data, as docs/results/*.json hold them. This module knows no single table.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from typing import Any

from utils.result_formats import rate_in_percent, signed_points
from utils.result_records import CLEAN
from utils.runs import REPOSITORY
from utils.statistics import FEW_ROUNDS, wilson_interval

Figures = dict[str, Any]  # of one part, as docs/results/<part>.json holds them
Say = Callable[[str], str]  # a word in the page's language
WEIGHTS, FITS = ("graspnet.pt", "critic.pt"), "calibration.json"  # in checkpoints/, of planners


# --- Cells ------------------------------------------------------------------------------------


def percent(successes: int, trials: int) -> str:
    return rate_in_percent(successes / trials)


def rate(successes: int, trials: int, interval: Sequence[float] | None = None) -> str:
    """'97 % [95, 98] (488/502)', with the given 95 % interval, or Wilson's; '-' of nothing."""
    if trials == 0:
        return "-"
    low, high = (100 * bound for bound in interval or wilson_interval(successes, trials))
    return f"{percent(successes, trials)} % [{low:.0f}, {high:.0f}] ({successes}/{trials})"


def success(row: Figures) -> str:
    return rate(row["successes"], row["attempts"], row["success_ci95"])


def cleared(row: Figures) -> str:
    return rate(row["objects_cleared"], row["objects_total"], row["cleared_ci95"])


def points(difference: Figures | None) -> str:
    """'+1.5 [+0.7, +2.2]' percentage points; an interval of few rounds would be too narrow."""
    if difference is None:
        return "-"
    bounds = [difference[key] for key in ("value", "low", "high")]
    if not any(bounds):
        return "0 (in every resample)"
    value, low, high = map(signed_points, bounds)
    if difference["rounds"] < FEW_ROUNDS:
        return f"{value} (under {FEW_ROUNDS} rounds)"
    return f"{value} [{low}, {high}]"


def decimal(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"


def planner_cells(row: Figures) -> list[str]:
    an_hour = row["picks_per_hour"]
    picks = "-" if an_hour is None else f"{an_hour:.0f}"
    return [f"`{row['policy']}`", success(row), cleared(row), picks]


def policy_file(policy: str) -> str:
    """A policy's name in tables: of a learned one its file, of which the folder is known."""
    return policy.removeprefix("ppo:checkpoints/")


def noise_of(row: Figures) -> str:
    """The depth noise of a row or a pair; older figures do not name it."""
    return row.get("depth_noise", CLEAN)


def noises_of(rows: Sequence[Figures]) -> list[str]:
    return [noise_of(row) for row in rows]


# --- Markdown ---------------------------------------------------------------------------------


def table(header: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    rows = [header, ["---"] * len(header), *lines]
    return "\n".join("| " + " | ".join(map(str, row)) + " |" for row in rows)


def with_depths(
    header: Sequence[str],
    lines: Sequence[Sequence[str]],
    noises: Sequence[str],
    place: int,
    say: Say = str,
) -> str:
    """A Markdown table whose first rows have these depth noises, in column number `place`; the
    column is left out where there is no noise."""
    if set(noises) <= {CLEAN}:
        return table(header, lines)
    column = [say("depth"), *(f"`{noise}`" for noise in noises), *["-"] * len(lines)]
    wider = [[*line[:place], cell, *line[place:]] for line, cell in zip([header, *lines], column)]
    return table(wider[0], wider[1:])


def metrics_table(metrics: Figures) -> str:
    """What a benchmark reports, as a Markdown table."""
    lines = [
        [f"`{name}`", f"{one['value']:.3g} {one['unit']}", one["target"] or "-",
         {True: "yes", False: "no", None: "-"}[one["holds"]]]
        for name, one in metrics.items()
    ]  # fmt: skip
    return table(["what", "measured", "aim", "reached"], lines)


# --- Origin -----------------------------------------------------------------------------------


def origin(say: Say, *parts: Figures) -> str:
    """The line under a table: commit, date, seed, and each command with the rounds of its rows."""
    said = []
    for part in parts:
        commands = "; ".join(
            f"`{one['command']}`{rounds_in_words(say, one)}" for one in part["commands"].values()
        )
        said.append(
            f"<sub>{say('measured at commit')} `{part['commit'][:10]}` ({part['date']})"
            f"{weights_in_words(say, part)}, {_seed(say, part)}{commands}</sub>"
        )
    return "\n".join(said)


def blob(content: bytes) -> str:
    """The name that git gives a file with this content."""
    return hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest()


def weights_of(read: Callable[[str], bytes | None]) -> Figures:
    """What the planners of a commit are: the names that git gives their weights, and the fits of
    their chances by planner. read: the content of a file of checkpoints/; None for one that is
    missing there, which is null in the result."""
    found: Figures = {}
    for name in WEIGHTS:
        content = read(name)
        found[name] = None if content is None else blob(content)
    fits = read(FITS)
    return found | {FITS: None if fits is None else json.loads(fits)["planners"]}


def shipped_weights() -> Figures:
    """`weights_of` the files as they are now."""
    folder = REPOSITORY / "checkpoints"
    return weights_of(
        lambda name: (folder / name).read_bytes() if (folder / name).exists() else None
    )


def weights_in_words(say: Say, part: Figures) -> str:
    """' with an earlier `critic.pt`', where planners of a part have other weights or chances now
    than when it was measured; else nothing."""
    was, now = part.get("weights"), shipped_weights()
    rows = [row for one in part["commands"].values() for row in one.get("rows", ())]
    planners = {str(row.get("policy")).partition("+")[0] for row in rows}
    learned = {name for name in planners if name.startswith("graspnet")}
    if was is None or not planners:
        return ""
    names = [name for name in WEIGHTS if learned and was[name] != now[name]]
    if "critic.pt" not in names and "oracle" in planners and was["critic.pt"] != now["critic.pt"]:
        names.append("critic.pt")
    then, fits = was[FITS] or {}, now[FITS] or {}
    known = planners & fits.keys()
    refitted = sorted(name for name in known if then.get(name) != fits[name])
    names += [FITS] if refitted else []
    of = {FITS: f" ({', '.join(f'`{name}`' for name in refitted)})"} if known - {*refitted} else {}
    words = ""
    for how, missing in (("with an earlier", False), ("without", True)):
        listed = [f"`{name}`{of.get(name, '')}" for name in names if (was[name] is None) is missing]
        words += f" {say(how)} {', '.join(listed)}" if listed else ""
    return words


def _seed(say: Say, part: Figures) -> str:
    """'seed 2027: ', or nothing for benchmarks, whose scenes have seeds of their own."""
    seeded = any("seed=" in one["command"] for one in part["commands"].values())
    return f"{say('seed')} {part['seed']}: " if seeded else ""


def rounds_in_words(say: Say, command: Figures) -> str:
    """' (30 rounds a row)', or nothing for what has no rounds."""
    counts = sorted({row["rounds"] for row in command.get("rows", ()) if "rounds" in row})
    return f" ({say('{} rounds a row').format(' / '.join(map(str, counts)))})" if counts else ""


def rows_of(part: Figures, command: str | None = None) -> list[Figures]:
    """The rows of a part's command, the first one by default."""
    commands = part["commands"]
    return commands[command or next(iter(commands))]["rows"]
