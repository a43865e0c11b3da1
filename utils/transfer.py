"""The transfer report: how well each policy does where it was not trained.

One table of success rates, rows of policies by columns such as another simulator, and how well one
column predicts another. This module counts, writes and draws; `envs.transfer_plan` has the columns'
registry and says what is played.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from utils.atomic_files import write_atomic
from utils.config import Config
from utils.config_schema import TransferPolicy
from utils.result_formats import aligned, share_in_words
from utils.result_records import RoundRecord
from utils.runs import save_results
from utils.statistics import (
    clustered_interval,
    mean_maximum_rank_violation,
    pearson_correlation,
    wilson_interval,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

NOT_TRAINED = "-"  # a row's training where the policy learns nothing


@dataclass(frozen=True)
class Column:
    """A column of the report.

    title: its heading. simulation: the column that should predict this one, which stands for
    reality; None where nothing is compared. if_empty: what the reader can do about a column
    without scores.
    """

    title: str
    simulation: str | None = None
    if_empty: str | None = None


@dataclass(frozen=True)
class Score:
    """Successes in a number of trials, which are executed grasps or photographs.

    by_group: successes and trials of each scene, or of each object that was photographed, since
        trials of one group are not independent; None where each trial is on its own.
    """

    successes: int
    trials: int
    by_group: tuple[tuple[int, int], ...] | None = None

    @property
    def rate(self) -> float | None:
        return self.successes / self.trials if self.trials else None

    @property
    def ci95(self) -> tuple[float, float]:
        if self.by_group is not None:
            return clustered_interval(self.by_group)
        return wilson_interval(self.successes, self.trials)


@dataclass(frozen=True)
class TransferLine:
    """One row with its scores by column; a column without a score was not played.

    row: of the config. scenes: what it was scored on. trained: whether the planner's file exists.
    """

    row: TransferPolicy
    scenes: str
    scores: Mapping[str, Score]
    trained: bool = True


@dataclass(frozen=True)
class Agreement:
    """How well the rates of policies in the column `simulation` predict those in the column `real`
    on the same scenes: Pearson's r, and the mean maximum rank violation (`utils.statistics`)."""

    scenes: str
    real: str
    simulation: str
    policies: int
    pearson_r: float | None
    mmrv: float | None


def score_of(rounds: Sequence[RoundRecord], planner: str) -> Score:
    """All executed grasps of a planner's rounds together."""
    mine = [record for record in rounds if record.policy == planner]
    by_scene = tuple((r.successes, r.executed) for r in mine)
    return Score(sum(r.successes for r in mine), sum(r.executed for r in mine), by_scene)


def pairs_of(columns: Mapping[str, Column]) -> list[tuple[str, str]]:
    """The columns that stand for reality, each with the one that should predict it."""
    return [
        (name, column.simulation)
        for name, column in columns.items()
        if column.simulation in columns
    ]


def agreements(lines: Sequence[TransferLine], columns: Mapping[str, Column]) -> list[Agreement]:
    """The agreement of each pair of columns on each kind of scenes, over the policies that were
    scored in both; a single policy has no order and gives none."""
    found = []
    for scenes in dict.fromkeys(line.scenes for line in lines):
        for real, simulation in pairs_of(columns):
            rates = [
                (line.scores[real].rate, line.scores[simulation].rate)
                for line in lines
                if line.scenes == scenes
                and all(_scored(line, column) for column in (real, simulation))
            ]
            if len(rates) < 2:
                continue
            a, b = zip(*rates)
            r, mmrv = pearson_correlation(a, b), mean_maximum_rank_violation(a, b)
            found.append(Agreement(scenes, real, simulation, len(rates), r, mmrv))
    return found


def _scored(line: TransferLine, column: str) -> bool:
    return column in line.scores and line.scores[column].trials > 0


def format_transfer(lines: Sequence[TransferLine], columns: Mapping[str, Column]) -> str:
    """The table as aligned text."""
    titles = [column.title for column in columns.values()]
    header = ("policy", "randomised in training", "scenes", *titles)
    table = []
    for line in lines:
        cells = [line.row.policy, line.row.training, line.scenes]
        if line.trained:
            cells += [_cell(line.scores.get(name)) for name in columns]
        else:
            cells += ["not trained", *([""] * (len(columns) - 1))]
        table.append(cells)
    return aligned(header, table)


def _cell(score: Score | None) -> str:
    if score is None:
        return "-"
    return share_in_words(score.rate, score.ci95, score.successes, score.trials)


def transfer_notes(lines: Sequence[TransferLine], columns: Mapping[str, Column]) -> list[str]:
    """Sentences on how the columns agree, and on how to get the scores that are missing."""
    notes = []
    for one in agreements(lines, columns):
        r = "undefined" if one.pearson_r is None else f"{one.pearson_r:.3f}"
        notes.append(
            f"{one.scenes}: {columns[one.simulation].title} predicts {columns[one.real].title}: "
            f"Pearson r {r}, mean maximum rank violation {one.mmrv:.3f}, {one.policies} policies"
        )
    for advice in dict.fromkeys(column.if_empty for column in columns.values()):
        names = [name for name, column in columns.items() if column.if_empty == advice]
        if advice and not any(name in line.scores for line in lines for name in names):
            notes.append(advice)
    for line in lines:
        if not line.trained:
            how = line.row.train_with or f"put its weights at {line.row.planner}"
            notes.append(f"not trained: {line.row.policy}, {line.row.training}: {how}")
    return notes


def transfer_content(
    lines: Sequence[TransferLine], columns: Mapping[str, Column]
) -> dict[str, Any]:
    """Plain data for results.json."""
    return {
        "rows": [
            {
                "policy": line.row.policy,
                "training": line.row.training,
                "scenes": line.scenes,
                "planner": line.row.planner,
                "trained": line.trained,
                "columns": {
                    column: {
                        "successes": score.successes,
                        "trials": score.trials,
                        "success_rate": score.rate,
                        "success_ci95": list(score.ci95),
                    }
                    for column, score in line.scores.items()
                },
            }
            for line in lines
        ],
        "agreement": [
            {
                "scenes": one.scenes,
                "real": one.real,
                "simulation": one.simulation,
                "policies": one.policies,
                "pearson_r": one.pearson_r,
                "mmrv": one.mmrv,
            }
            for one in agreements(lines, columns)
        ],
    }


def write_transfer(
    run: Path,
    lines: Sequence[TransferLine],
    columns: Mapping[str, Column],
    config: Config,
    device: str,
    complete: bool,
    copy: Path | None = None,
) -> None:
    """Write results.json, see `utils.runs.save_results`, and transfer.png into the run's folder.

    copy: another file for the results, None for none.
    """
    content = {"complete": complete, "device": device, "config": config.model_dump(mode="json")}
    content |= transfer_content(lines, columns)
    save_results(run / "results.json", content, run)
    write_atomic(run / "transfer.png", draw_transfer(lines, columns))
    if copy is not None:  # last: where it cannot be written, the run is whole
        save_results(copy, content, run)


def draw_transfer(lines: Sequence[TransferLine], columns: Mapping[str, Column]) -> bytes:
    """The bytes of a PNG file: one small panel for each column with the rows' rates and 95 %
    intervals, and below them one panel for each pair of columns that agree or do not."""
    from matplotlib.figure import Figure  # slow to import, and few callers need it

    shown = [line for line in lines if line.scores]
    rows = 0.27 * max(len(shown), 4)
    figure = Figure(figsize=(3.4 + 2.1 * len(columns), rows + 5.0), layout="constrained")
    above, below = figure.subfigures(2, 1, height_ratios=(rows + 1.0, 4.0))
    panels = above.subplots(1, len(columns), sharey=True, squeeze=False)[0]
    for panel, (name, column) in zip(panels, columns.items()):
        _draw_column(panel, shown, name, column.title)
    panels[0].set_yticks(range(len(shown)), [_label(line) for line in shown], fontsize=8)
    panels[0].set_ylim(len(shown) - 0.5, -0.5)  # the first row on top
    pairs = pairs_of(columns)
    panels = below.subplots(1, len(pairs), squeeze=False)[0] if pairs else ()
    for panel, (real, simulation) in zip(panels, pairs):
        _draw_agreement(panel, shown, columns, real, simulation)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=110)
    return file.getvalue()


def _draw_column(panel: Axes, lines: Sequence[TransferLine], column: str, title: str) -> None:
    """The rates of the rows that were scored in a column, with a rule between kinds of scenes."""
    colours = _colours(lines)
    for place, line in enumerate(lines):
        if place and line.scenes != lines[place - 1].scenes:
            panel.axhline(place - 0.5, color="0.6", linewidth=0.8)
        if _scored(line, column):
            rate, span = _percent(line.scores[column])
            panel.errorbar(
                rate, place, xerr=span, fmt="o", color=colours[line.row.policy], markersize=4,
                elinewidth=1.2, capsize=2,
            )  # fmt: skip
    panel.set_title(title, fontsize=9)
    panel.set(xlim=(-3, 103), xticks=(0, 50, 100))
    panel.set_xlabel("success, %", fontsize=8)
    panel.tick_params(labelsize=8, left=False)
    panel.grid(axis="x", alpha=0.4)
    panel.spines[["top", "right", "left"]].set_visible(False)


def _draw_agreement(
    panel: Axes,
    lines: Sequence[TransferLine],
    columns: Mapping[str, Column],
    real: str,
    simulation: str,
) -> None:
    """One column against another: a colour for each policy, filled on the first kind of scenes."""
    colours, kinds = _colours(lines), list(dict.fromkeys(line.scenes for line in lines))
    panel.plot([0, 100], [0, 100], color="0.7", linewidth=1)
    for line in lines:
        if _scored(line, real) and _scored(line, simulation):
            x, x_span = _percent(line.scores[simulation])
            y, y_span = _percent(line.scores[real])
            colour = colours[line.row.policy]
            panel.errorbar(
                x, y, xerr=x_span, yerr=y_span, fmt="o" if line.scenes == kinds[0] else "s",
                color=colour, mfc=colour if line.scenes == kinds[0] else "white", markersize=4,
                elinewidth=0.7, alpha=0.8,
            )  # fmt: skip
    titles = [
        f"{one.scenes}: r = {one.pearson_r:.2f}, MMRV = {one.mmrv:.3f}"
        for one in agreements(lines, columns)
        if (one.real, one.simulation) == (real, simulation) and one.pearson_r is not None
    ]
    panel.set_title("\n".join(titles), fontsize=8)
    panel.set(xlim=(0, 103), ylim=(0, 103), aspect="equal")
    panel.set_xlabel(f"{columns[simulation].title}, %", fontsize=8)
    panel.set_ylabel(f"{columns[real].title}, %", fontsize=8)
    panel.tick_params(labelsize=8)
    panel.grid(alpha=0.3)


def _percent(score: Score) -> tuple[float, list[list[float]]]:
    """The rate in percent, and how far its interval reaches to both sides."""
    rate, (low, high) = 100 * score.rate, (100 * bound for bound in score.ci95)
    return rate, [[rate - low], [high - rate]]


def _label(line: TransferLine) -> str:
    """The policy, its training if there is one, and the scenes if they are the row's own."""
    training = [line.row.training] if line.row.training != NOT_TRAINED else []
    own = [line.scenes] if line.row.scenes is not None else []
    return ", ".join([line.row.policy, *training, *own])


def _colours(lines: Sequence[TransferLine]) -> dict[str, Any]:
    """A colour for each policy."""
    import matplotlib

    names = dict.fromkeys(line.row.policy for line in lines)
    return {name: matplotlib.colormaps["tab10"](k % 10) for k, name in enumerate(names)}
