"""What an evaluation is asked for: who plays which scenes, in which order, and what is left to do.

A policy here is a planner's name and a controller's. This module knows neither cells nor planners.

Why attempts were stopped: the cell's sentences on it, those alike counted together.

Reads `utils.result_records`; what stops the arm is for `envs.robot_safety` and the loops to say.

The figures of an evaluation, drawn from its records, and the files and tables that tell them.

This module only counts (`utils.result_records` has what is counted). Success rate and cleared rate
are VGN's (Breyer et al., CoRL 2020): successes / executed grasps, and objects removed / objects
placed, both over all rounds.
"""

from __future__ import annotations

import csv
import io
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median

from utils.config import Config, load_config
from utils.errors import UserError
from utils.result_records import FAILURES, OPEN_LOOP, RoundRecord, contestant
from utils.runs import save_results, write_atomic
from utils.statistics import Difference, paired_difference_interval, wilson_interval

# Keys that may change when an evaluation is resumed: its scenes and scores stay what they are.
FREE_TO_CHANGE = tuple(
    f"evaluate.{key}" for key in ("rounds", "workers", "name", "videos", "gallery", "film_format")
)


@dataclass(frozen=True)
class Task:
    """One scene, on which every policy that is still to be scored works in turn."""

    objects: str
    scenario: str
    seed: int
    policies: tuple[tuple[str, str], ...]
    keep_pictures: bool
    film_folder: Path | None


def contestants(config: Config) -> list[tuple[str, str]]:
    """Every planner with every controller."""
    controllers = config.evaluate.controllers or (config.closed_loop.controller,)
    return [
        (planner, controller) for planner in config.evaluate.policies for controller in controllers
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


def in_order(rounds: Sequence[RoundRecord], config: Config) -> list[RoundRecord]:
    """The rounds as the plan names them, whichever was finished first."""
    plan = config.evaluate
    policies = [contestant(*pair) for pair in contestants(config)]

    def place(record: RoundRecord) -> tuple[int, ...]:
        known = record.policy in policies  # a resumed report may have lost the weights of one
        return (
            plan.object_sets.index(record.objects),
            plan.scenarios.index(record.scenario),
            policies.index(record.policy) if known else len(policies),
            record.seed,
        )

    return sorted(rounds, key=place)


def planned_rounds(config: Config) -> int:
    """How many rounds the whole evaluation has."""
    plan = config.evaluate
    return plan.rounds * len(contestants(config)) * len(plan.scenarios) * len(plan.object_sets)


def interruption(rounds_done: int, config: Config) -> str | None:
    """'interrupted: N of M rounds', or None for a complete evaluation."""
    planned = planned_rounds(config)
    return f"interrupted: {rounds_done} of {planned} rounds" if rounds_done < planned else None


def check_controllers(config: Config, overrides: Sequence[str] = ()) -> None:
    """Raise UserError for a closed_loop.controller that evaluate.controllers would leave unheard."""
    several, one = config.evaluate.controllers, config.closed_loop.controller
    asked = any(change.split("=")[0].strip() == "closed_loop.controller" for change in overrides)
    if several is not None and (asked or one != OPEN_LOOP):
        raise UserError(
            f"closed_loop.controller={one} would be ignored: evaluate.controllers is "
            f"[{', '.join(several)}] and says which controllers are scored; write "
            f"evaluate.controllers={one} or, to have closed_loop.controller count, "
            "evaluate.controllers=null"
        )


def check_rounds(config: Config, run: Path | None) -> None:
    """Raise UserError if a resumed evaluation asks for fewer rounds than it began with."""
    before = config if run is None else load_config(run / "config.yaml")
    if config.evaluate.rounds < before.evaluate.rounds:
        raise UserError(
            f"--resume {run}: evaluate.rounds is {config.evaluate.rounds}, the run began with "
            f"{before.evaluate.rounds}; it can only grow"
        )


_NUMBER = re.compile(r"-?\d+(\.\d+)?|\b(inf|nan)\b")


@dataclass(frozen=True)
class StopReason:
    """count: attempts that one policy ended so on a scenario and object set. reason: a key of
    `utils.result_records.FAILURES`. sentence: the first attempt's; the others differ in their
    numbers only. seed: of that attempt's scene. held: the object in the hand then, if any."""

    policy: str
    scenario: str
    objects: str
    reason: str
    count: int
    sentence: str
    seed: int
    held: str | None = None

    @property
    def place(self) -> str:
        """Where the first one was: 'scene 7' or 'scene 7, mug_0012 in the hand'."""
        return f"scene {self.seed}" + (f", {self.held} in the hand" if self.held else "")


def stop_reasons(rounds: Iterable[RoundRecord]) -> list[StopReason]:
    """Every failure on which there is a sentence, in the order of the rounds, the most frequent
    kinds of a cell first."""
    kinds: dict[tuple[str, str, str], dict[tuple[str, str], list[tuple[str, int, str | None]]]] = {}
    for record in rounds:
        cell = kinds.setdefault((record.policy, record.scenario, record.objects), {})
        for attempt in record.attempts:
            if attempt.detail and not attempt.success:
                kind = attempt.reason, _NUMBER.sub("#", attempt.detail)
                cell.setdefault(kind, []).append((attempt.detail, record.seed, attempt.held))
    return [
        StopReason(*where, reason, len(told), *told[0])
        for where, cell in kinds.items()
        for (reason, _), told in sorted(cell.items(), key=lambda item: -len(item[1]))
    ]


def print_stop_reasons(stops: Iterable[StopReason]) -> None:
    """One line each on stdout; nothing if there are none."""
    lines = [
        f"{stop.count:4d} x {stop.policy}, {stop.scenario}, {stop.objects}: {stop.sentence} "
        f"({stop.place})"
        for stop in stops
    ]
    if lines:
        print("\n".join(["\nwhat stopped the arm", *lines]))


@dataclass(frozen=True)
class Row:
    """The figures of one policy on one scenario and object set. None: undefined.

    attempts: executed grasps. Intervals: Wilson, 95 %, each attempt (object) taken as independent.
    plan_ms_median: over every call of the planner, those that found nothing included.
    sim_seconds_per_pick: simulated time of all attempts, failed ones too, for each success.
    turn_ms_mean, turn_ms_p95: mean and 95th percentile of a closed loop's turns, the median of all
    attempts.
    """

    policy: str
    scenario: str
    objects: str
    seed: int
    rounds: int
    attempts: int
    successes: int
    objects_total: int
    objects_cleared: int
    success_rate: float | None
    success_ci95: tuple[float, float]
    cleared_rate: float | None
    cleared_ci95: tuple[float, float]
    plan_ms_median: float | None
    sim_seconds_per_pick: float | None
    picks_per_hour: float | None
    failures: dict[str, int]
    controller: str = OPEN_LOOP
    turn_ms_p95: float | None = None
    turn_ms_mean: float | None = None


def summarise(rounds: Iterable[RoundRecord], seed: int) -> list[Row]:
    """One row for each (policy, scenario, objects), in the order of their first round."""
    groups: dict[tuple[str, str, str], list[RoundRecord]] = {}
    for record in rounds:
        groups.setdefault((record.policy, record.scenario, record.objects), []).append(record)
    return [_row(key, records, seed) for key, records in groups.items()]


def _row(key: tuple[str, str, str], rounds: Sequence[RoundRecord], seed: int) -> Row:
    calls = [attempt for record in rounds for attempt in record.attempts]
    attempts = sum(call.executed for call in calls)
    successes = sum(call.success for call in calls)
    total = sum(record.objects_total for record in rounds)
    cleared = sum(record.objects_cleared for record in rounds)
    reasons = Counter(call.reason for call in calls)
    seconds = sum(call.sim_seconds for call in calls)
    per_pick = seconds / successes if successes else None
    turns = [call.turn_ms for call in calls if call.turn_ms is not None]
    means = [call.turn_ms_mean for call in calls if call.turn_ms_mean is not None]
    return Row(
        *key,
        seed=seed,
        rounds=len(rounds),
        attempts=attempts,
        successes=successes,
        objects_total=total,
        objects_cleared=cleared,
        success_rate=successes / attempts if attempts else None,
        success_ci95=wilson_interval(successes, attempts),
        cleared_rate=cleared / total if total else None,
        cleared_ci95=wilson_interval(cleared, total),
        plan_ms_median=1000 * median(call.plan_seconds for call in calls) if calls else None,
        sim_seconds_per_pick=per_pick,
        picks_per_hour=3600 / per_pick if per_pick else None,
        failures={reason: reasons[reason] for reason in FAILURES},
        controller=rounds[0].controller,
        turn_ms_p95=median(turns) if turns else None,
        turn_ms_mean=median(means) if means else None,
    )


@dataclass(frozen=True)
class Comparison:
    """Two policies on the rounds that both have worked on; a difference is first - second."""

    first: str
    second: str
    scenario: str
    objects: str
    success: Difference | None
    cleared: Difference | None


CLUTTER = ("packed", "pile")


def compare(rounds: Iterable[RoundRecord], seed: int) -> list[Comparison]:
    """Every pair of policies, the later one first, on each scenario and object set they share, and
    at last on all their rounds in clutter together, where these are of several kinds."""
    cells: dict[tuple[str, str], dict[str, dict[tuple, RoundRecord]]] = {}
    clutter: dict[str, dict[tuple, RoundRecord]] = {}
    for record in rounds:
        scene = (record.scenario, record.objects, record.seed)
        policies = cells.setdefault((record.scenario, record.objects), {})
        policies.setdefault(record.policy, {})[scene] = record
        if record.scenario in CLUTTER:
            clutter.setdefault(record.policy, {})[scene] = record
    kinds = [kind for kind in cells if kind[0] in CLUTTER]
    if len(kinds) > 1:
        scenarios, sets = (list(dict.fromkeys(names)) for names in zip(*kinds))
        cells[" + ".join(scenarios), " + ".join(sets)] = clutter
    comparisons = []
    for (scenario, objects), policies in cells.items():
        names = list(policies)
        for i, second in enumerate(names):
            for first in names[i + 1 :]:
                shared = [s for s in policies[first] if s in policies[second]]
                a, b = ([policies[name][s] for s in shared] for name in (first, second))
                success = _difference(a, b, "successes", "executed", seed)
                cleared = _difference(a, b, "objects_cleared", "objects_total", seed)
                comparisons.append(Comparison(first, second, scenario, objects, success, cleared))
    return comparisons


def _difference(
    a: Sequence[RoundRecord], b: Sequence[RoundRecord], top: str, bottom: str, seed: int
) -> Difference | None:
    counts = [[(getattr(r, top), getattr(r, bottom)) for r in side] or [(0, 0)] for side in (a, b)]
    return paired_difference_interval(*counts, seed=seed)


# --- Writing --------------------------------------------------------------------------------


def write_results(
    path: Path, rows: Sequence[Row], config: Config, device: str, complete: bool
) -> None:
    """Write results.json of an evaluation, see `utils.runs.save_results`."""
    content = {
        "complete": complete,
        "config": config.model_dump(mode="json"),
        "device": device,
        "rows": [asdict(row) for row in rows],
    }
    save_results(path, content)


def write_csv(path: Path, rows: Sequence[Row]) -> None:
    """A spreadsheet of the rows: intervals as two columns, failures as one column a reason."""
    flat = [_flat(row) for row in rows]
    text = io.StringIO(newline="")
    if flat:
        writer = csv.DictWriter(text, flat[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(flat)
    write_atomic(path, text.getvalue())


def _flat(row: Row) -> dict[str, object]:
    flat: dict[str, object] = {}
    for name, value in asdict(row).items():
        if name.endswith("_ci95"):
            flat[f"{name}_low"], flat[f"{name}_high"] = value
        elif name == "failures":
            flat |= {f"failures_{reason}": count for reason, count in value.items()}
        else:
            flat[name] = value
    return flat


def print_table(rows: Sequence[Row]) -> None:
    """The rows as aligned text on stdout."""
    print(format_table(rows))


def format_table(rows: Sequence[Row]) -> str:
    """The rows as aligned plain text."""
    header = ["policy", "scenario", "objects", "success", "cleared", "plan ms", "picks/h", "failed"]
    lines = [list(_cells(row)) for row in rows]
    if any(row.turn_ms_p95 is not None for row in rows):  # of a closed loop
        for line, cell in zip([header, *lines], ["turn ms, 95 %", *map(turn_ms_in_words, rows)]):
            line.insert(-1, cell)
    return aligned(header, lines, to_the_right=(5, 6))


def print_comparisons(comparisons: Sequence[Comparison]) -> None:
    """Paired differences in points as aligned text on stdout; nothing if there are none."""
    if comparisons:
        header = ("paired difference", "scenario", "objects", "success", "cleared", "rounds")
        print("\n" + aligned(header, [_difference_cells(pair) for pair in comparisons]))


def _difference_cells(pair: Comparison) -> tuple[str, ...]:
    def points(difference: Difference | None) -> str:
        if difference is None:
            return "-"
        value, low, high = (100 * x for x in (difference.value, difference.low, difference.high))
        return f"{value:+.1f} [{low:+.1f}, {high:+.1f}]"

    names = (f"{pair.first} - {pair.second}", pair.scenario, pair.objects)
    rounds = "-" if pair.success is None else str(pair.success.rounds)
    return (*names, points(pair.success), points(pair.cleared), rounds)


def aligned(
    header: Sequence[str], lines: Sequence[Sequence[str]], to_the_right: Sequence[int] = ()
) -> str:
    """Lines of cells under a header, as text in columns of even width."""
    lines = [header, *lines]
    widths = [max(len(line[i]) for line in lines) for i in range(len(header))]
    lines.insert(1, ["-" * width for width in widths])
    return "\n".join(
        "  ".join(
            cell.rjust(width) if i in to_the_right else cell.ljust(width)
            for i, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )


def _cells(row: Row) -> tuple[str, ...]:
    def share(rate: float | None, interval: tuple[float, float], k: int, n: int) -> str:
        if rate is None:
            return "-"
        low, high = interval
        return f"{100 * rate:3.0f} % [{100 * low:.0f}, {100 * high:.0f}] {k}/{n}"

    return (
        row.policy,
        row.scenario,
        row.objects,
        share(row.success_rate, row.success_ci95, row.successes, row.attempts),
        share(row.cleared_rate, row.cleared_ci95, row.objects_cleared, row.objects_total),
        "-" if row.plan_ms_median is None else f"{row.plan_ms_median:.1f}",
        "-" if row.picks_per_hour is None else f"{row.picks_per_hour:.0f}",
        failures_in_words(row),
    )


def failures_in_words(row: Row) -> str:
    """'3 missed, 1 slipped', most frequent first; 'none' without a failure."""
    counts = sorted(row.failures.items(), key=lambda item: -item[1])
    return ", ".join(f"{count} {FAILURES[reason]}" for reason, count in counts if count) or "none"


def turn_ms_in_words(row: Row) -> str:
    """'8.1, 14.2': mean and 95th percentile of a closed loop's turns, ms; '-' of an open loop."""
    known = [ms for ms in (row.turn_ms_mean, row.turn_ms_p95) if ms is not None]
    return ", ".join(f"{ms:.1f}" for ms in known) or "-"
