"""Figures of an evaluation for people and other programs: results.json, CSV, LaTeX, aligned text.

This module formats what `utils.results` has counted. `COLUMNS` is the one list of columns of the
table that evaluate.py prints and that report.html shows.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import NamedTuple

from utils.atomic_files import write_atomic
from utils.config import Config
from utils.result_records import CLEAN, FAILURES, MOST_SLID, MOST_TURNED
from utils.results import Comparison, Row, StopReason
from utils.runs import save_results
from utils.statistics import FEW_ROUNDS, Difference


def write_results(
    path: Path,
    rows: Sequence[Row],
    comparisons: Sequence[Comparison],
    config: Config,
    device: str,
    complete: bool,
    run: Path | None = None,
) -> None:
    """Write results.json of an evaluation in the folder `run`, see `utils.runs.save_results`."""
    content = {
        "complete": complete,
        "config": config.model_dump(mode="json"),
        "device": device,
        "rows": [asdict(row) for row in rows],
        "comparisons": [asdict(pair) for pair in comparisons],
    }
    save_results(path, content, run)


def write_csv(path: Path, rows: Sequence[Row]) -> None:
    """Write a spreadsheet of the rows: intervals as two columns, each failure as one column."""
    header: list[str] = []
    for column in fields(Row):
        if column.name.endswith("_ci95"):
            header += [f"{column.name}_low", f"{column.name}_high"]
        elif column.name == "failures":
            header += [f"failures_{reason}" for reason in FAILURES]
        else:
            header.append(column.name)
    _write_csv(path, header, [_flat(row) for row in rows])


def _write_csv(path: Path, header: Sequence[str], flat: Sequence[dict[str, object]]) -> None:
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, header, lineterminator="\n")
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


def format_table(rows: Sequence[Row]) -> str:
    """The rows as aligned plain text."""
    columns = [column for column in columns_of(rows) if column.printed]
    lines = [[column.cell(row) for column in columns] for row in rows]
    to_the_right = [place for place, column in enumerate(columns) if column.number]
    return aligned([column.title for column in columns], lines, to_the_right)


TABLE_LEGEND = (
    "firm: share of grasps that succeed and whose object neither turns by more than "
    f"{math.degrees(MOST_TURNED):.0f} degrees nor slides by more than {100 * MOST_SLID:.0f} cm in "
    "the hand; plan ms: median; picks/h: in simulated time"
)

_WHY = (
    "why attempts failed or rounds ended, where more is known than the table says; "
    "numbers and scene are the first one's"
)


def format_scores(
    rows: Sequence[Row], stops: Iterable[StopReason], comparisons: Sequence[Comparison]
) -> str:
    """What evaluate.py prints: the table with its legend, why attempts failed, differences."""
    table = f"{format_table(rows)}\n{TABLE_LEGEND}"
    parts = [table, format_stop_reasons(stops), format_comparisons(comparisons)]
    return "\n\n".join(filter(None, parts))


def format_stop_reasons(stops: Iterable[StopReason]) -> str:
    """One line for each under a title; an empty text if there are none."""
    lines = [
        f"{stop.count:4d} x {stop.policy}, {stop.scenario}, {stop.objects}"
        f"{depth_in_words(stop.depth_noise)}: {stop.sentence} ({stop.place})"
        for stop in stops
    ]
    return "\n".join([_WHY, *lines]) if lines else ""


def depth_in_words(noise: str) -> str:
    """', realsense depth', or ', clean depth' of a camera without noise."""
    return f", {'clean' if noise == CLEAN else noise} depth"


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


def share_in_words(rate: float | None, interval: tuple[float, float], k: int, n: int) -> str:
    """' 50 % [19, 81] 3/6'; '-' for an undefined rate."""
    if rate is None:
        return "-"
    low, high = interval
    return f"{rate_in_percent(rate):>3} % [{100 * low:.0f}, {100 * high:.0f}] {k}/{n}"


def rate_in_percent(rate: float) -> str:
    """'97' of a rate in [0, 1]; '99.6' or '0.4' where one between would be rounded to 100 or 0."""
    percent = f"{100 * rate:.0f}"
    if percent in ("0", "100") and 0 < rate < 1:
        return f"{min(max(100 * rate, 0.1), 99.9):.1f}"
    return percent


def signed_points(difference: float) -> str:
    """'+1.5' percentage points of a difference of rates; '+0.0', never '-0.0'."""
    return f"{round(100 * difference, 1) + 0.0:+.1f}"


def _decimal(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def failures_in_words(row: Row) -> str:
    """'3 missed, 1 slipped', most frequent first; 'none' without a failure."""
    counts = sorted(row.failures.items(), key=lambda item: -item[1])
    return ", ".join(f"{count} {FAILURES[reason]}" for reason, count in counts if count) or "none"


def cleared_in_words(row: Row) -> str:
    """' 50 % [19, 81] 3/6'; '-' where one object was wanted: its round ends once it is in hand."""
    rate = None if row.targets else row.cleared_rate
    return share_in_words(rate, row.cleared_ci95, row.objects_cleared, row.objects_total)


def firm_in_words(row: Row) -> str:
    """'94 %': share of the attempts in which the object also kept its place in the hand."""
    return f"{rate_in_percent(row.firm / row.attempts)} %" if row.attempts else "-"


def graspable_in_words(row: Row) -> str:
    """'98 % 49/50, 96 % 48/50': attempts at objects that fit the gripper that succeed, and such
    objects that are cleared."""
    shares = (
        (row.graspable_successes, row.graspable_attempts),
        (row.graspable_successes, row.graspable_total),
    )
    return ", ".join(f"{rate_in_percent(k / n)} % {k}/{n}" if n else "-" for k, n in shares)


def turn_ms_in_words(row: Row) -> str:
    """'8.1, 14.2': mean and 95th percentile of a closed loop's turns, ms; '-' for an open loop."""
    known = [ms for ms in (row.turn_ms_mean, row.turn_ms_p95) if ms is not None]
    return ", ".join(f"{ms:.1f}" for ms in known) or "-"


class TableColumn(NamedTuple):
    """A column of the table that evaluate.py prints and that report.html shows.

    title: its heading. cell: the text of a row. number: whether it is aligned to the right.
    printed: whether the printed table has it, too; a terminal is narrower than a page. known:
    whether a row has a value at all; a column without any is left out.
    """

    title: str
    cell: Callable[[Row], str]
    number: bool = False
    printed: bool = True
    known: Callable[[Row], bool] | None = None


COLUMNS = (
    TableColumn("policy", lambda row: row.policy),
    TableColumn("scenario", lambda row: row.scenario),
    TableColumn("objects", lambda row: row.objects),
    TableColumn("depth", lambda row: row.depth_noise, known=lambda row: row.depth_noise != CLEAN),
    TableColumn("rounds", lambda row: str(row.rounds), number=True, printed=False),
    TableColumn(
        "target in hand",
        lambda row: share_in_words(
            row.target_in_hand_rate, row.target_in_hand_ci95, row.targets_in_hand, row.targets
        ),
        known=lambda row: row.targets > 0,
    ),
    TableColumn(
        "picks to it",
        lambda row: _decimal(row.picks_to_target, 1),
        number=True,
        known=lambda row: row.targets > 0,
    ),
    TableColumn(
        "success",
        lambda row: share_in_words(row.success_rate, row.success_ci95, row.successes, row.attempts),
    ),
    TableColumn("firm", firm_in_words, number=True),
    TableColumn("cleared", cleared_in_words, known=lambda row: row.targets == 0),
    TableColumn(
        "success, cleared of graspable",
        graspable_in_words,
        known=lambda row: row.graspable_total < row.objects_total,
    ),
    TableColumn("plan ms", lambda row: _decimal(row.plan_ms_median, 1), number=True),
    TableColumn(
        "s per pick", lambda row: _decimal(row.sim_seconds_per_pick, 1), number=True, printed=False
    ),
    TableColumn("picks/h", lambda row: _decimal(row.picks_per_hour, 0), number=True),
    TableColumn(
        "calibration error",
        lambda row: _decimal(row.calibration_error, 3),
        number=True,
        printed=False,
        known=lambda row: row.calibration_error is not None,
    ),
    TableColumn("turn ms, 95 %", turn_ms_in_words, known=lambda row: row.turn_ms_p95 is not None),
    TableColumn("failed", failures_in_words),
)


def columns_of(rows: Sequence[Row]) -> list[TableColumn]:
    """The columns of a table of these rows."""
    return [column for column in COLUMNS if column.known is None or any(map(column.known, rows))]


# --- Comparisons --------------------------------------------------------------------------------


_DIFFERENCE_LEGEND = (
    "first - second on the same scenes, in percentage points with 95 % intervals; -: undefined"
)


def format_comparisons(comparisons: Sequence[Comparison]) -> str:
    """Paired differences in percentage points as aligned text with a legend; an empty text if there
    are none."""
    if not comparisons:
        return ""
    table = aligned(*_difference_cells(comparisons, "paired difference"))
    return f"{table}\n{_DIFFERENCE_LEGEND}"


def _difference_cells(
    comparisons: Sequence[Comparison], first: str
) -> tuple[list[str], list[list[str]]]:
    """Header, which begins with `first`, and lines; the depth noise where there is any."""
    depth = ["depth"] if any(pair.depth_noise != CLEAN for pair in comparisons) else []
    lines = []
    for pair in comparisons:
        noise = [pair.depth_noise] if depth else []
        rounds = "-" if pair.success is None else str(pair.success.rounds)
        names = [f"{pair.first} - {pair.second}", pair.scenario, pair.objects, *noise]
        lines.append([*names, _points(pair.success), _points(pair.cleared), rounds])
    return [first, "scenario", "objects", *depth, "success", "cleared", "rounds"], lines


def has_interval(difference: Difference) -> bool:
    """Whether a paired difference is of enough rounds for an interval, wherever it is shown."""
    return difference.rounds >= FEW_ROUNDS


def _points(difference: Difference | None) -> str:
    """'+12.5 [+3.1, +21.9]' in percentage points; an interval of few rounds would be too narrow."""
    if difference is None:
        return "-"
    value, low, high = map(signed_points, (difference.value, difference.low, difference.high))
    if not has_interval(difference):
        return f"{value} (under {FEW_ROUNDS} rounds)"
    return f"{value} [{low}, {high}]"


def write_comparisons(
    comparisons: Sequence[Comparison], spreadsheet: Path | None, latex: Path | None
) -> None:
    """Write paired differences as CSV and as LaTeX, each where a file is named."""
    if spreadsheet is not None:
        write_comparisons_csv(spreadsheet, comparisons)
    if latex is not None:
        write_comparisons_latex(latex, comparisons)


def write_comparisons_csv(path: Path, comparisons: Sequence[Comparison]) -> None:
    """Write a spreadsheet of paired differences as shares of 1, with their 95 % intervals; of few
    rounds without, as in the table."""
    names = ["first", "second", "scenario", "objects", "depth_noise"]
    figures = [
        (measure, name)
        for measure in ("success", "cleared")
        for name in ("value", "low", "high", "rounds")
    ]
    flat = []
    for pair in comparisons:
        line: dict[str, object] = {name: getattr(pair, name) for name in names}
        for measure, name in figures:
            difference: Difference | None = getattr(pair, measure)
            hidden = difference is None or (
                name in ("low", "high") and not has_interval(difference)
            )
            line[f"{measure}_{name}"] = None if hidden else getattr(difference, name)
        flat.append(line)
    _write_csv(path, [*names, *("_".join(figure) for figure in figures)], flat)


def write_comparisons_latex(path: Path, comparisons: Sequence[Comparison]) -> None:
    """Write a LaTeX tabular (package booktabs) of paired differences in percentage points."""
    header, cells = _difference_cells(comparisons, "difference")
    lines = [" & ".join(map(_latex, line)) + r" \\" for line in cells]
    titles = " & ".join(title.capitalize() for title in header) + r" \\"
    shape = "l" * (len(header) - 3) + "rrr"
    text = [rf"\begin{{tabular}}{{{shape}}}", r"\toprule", titles, r"\midrule"]
    text += [*lines, r"\bottomrule", r"\end{tabular}"]
    write_atomic(path, "\n".join(text) + "\n")


_LATEX = str.maketrans(
    {special: "\\" + special for special in "&%#_${}"}
    | {"~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "\\": r"\textbackslash{}"}
)


def _latex(cell: str) -> str:
    return cell.translate(_LATEX).replace(" - ", " $-$ ")
