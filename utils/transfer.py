"""The transfer report: what each policy is worth in worlds that it was not made in.

One table of success rates, policies by worlds, and how well one world foretells another's. This
module counts and draws; it runs nothing.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from utils.config_schema import TransferPolicy
from utils.results import aligned
from utils.round_records import RoundRecord
from utils.statistics import mean_maximum_rank_violation, pearson_correlation, wilson_interval

TITLES = {
    "pybullet": "PyBullet",
    "outside": "PyBullet outside the ranges",
    "mujoco": "MuJoCo",
    "cornell": "Cornell photographs",
}
NOT_TRAINED = "-"  # a row's training where the policy learns nothing
PAIRS = (("mujoco", "pybullet"), ("outside", "pybullet"))  # (taken for real, simulation of it)


@dataclass(frozen=True)
class Score:
    """Successes of so many trials: executed grasps, or photographs."""

    successes: int
    trials: int

    @property
    def rate(self) -> float | None:
        return self.successes / self.trials if self.trials else None

    @property
    def ci95(self) -> tuple[float, float]:
        return wilson_interval(self.successes, self.trials)


@dataclass(frozen=True)
class TransferLine:
    """One policy: its score by world. A world that is not there was not scored. trained: whether
    the planner's file exists."""

    who: TransferPolicy
    scores: Mapping[str, Score]
    trained: bool = True


@dataclass(frozen=True)
class Agreement:
    """How well the rates of N policies in `simulation` foretell those in `real`: Pearson's r, and
    the mean maximum rank violation (`utils.statistics`)."""

    real: str
    simulation: str
    policies: int
    pearson_r: float | None
    mmrv: float | None


def score_of(rounds: Sequence[RoundRecord], planner: str) -> Score:
    """All executed grasps of a planner's rounds together."""
    mine = [record for record in rounds if record.policy == planner]
    return Score(sum(r.successes for r in mine), sum(r.executed for r in mine))


def agreements(lines: Sequence[TransferLine]) -> list[Agreement]:
    """For each pair of worlds, over the policies that were scored in both."""
    found = []
    for real, simulation in PAIRS:
        rates = [
            (line.scores[real].rate, line.scores[simulation].rate)
            for line in lines
            if all(w in line.scores and line.scores[w].trials for w in (real, simulation))
        ]
        if rates:
            a, b = zip(*rates)
            found.append(
                Agreement(
                    real, simulation, len(rates), pearson_correlation(a, b),
                    mean_maximum_rank_violation(a, b),
                )
            )  # fmt: skip
    return found


def format_transfer(lines: Sequence[TransferLine], worlds: Sequence[str]) -> str:
    """The table as aligned text."""
    header = ("policy", "randomised in training", *(TITLES[world] for world in worlds))
    table = []
    for line in lines:
        cells = [line.who.policy, line.who.training]
        if line.trained:
            cells += [_cell(line.scores.get(world)) for world in worlds]
        else:
            cells += ["not trained", *([""] * (len(worlds) - 1))]
        table.append(cells)
    return aligned(header, table)


def _cell(score: Score | None) -> str:
    if score is None or score.rate is None:
        return "-"
    low, high = (100 * bound for bound in score.ci95)
    return f"{100 * score.rate:3.0f} % [{low:.0f}, {high:.0f}] {score.successes}/{score.trials}"


def transfer_notes(lines: Sequence[TransferLine], worlds: Sequence[str]) -> list[str]:
    """How the worlds agree, and how to get what is missing."""
    notes = []
    for one in agreements(lines):
        r = "undefined" if one.pearson_r is None else f"{one.pearson_r:.3f}"
        notes.append(
            f"{TITLES[one.simulation]} foretells {TITLES[one.real]}: Pearson r {r}, mean maximum "
            f"rank violation {one.mmrv:.3f}, {one.policies} policies"
        )
    if "cornell" in worlds and not any("cornell" in line.scores for line in lines):
        notes.append("no photographs were scored: add transfer.cornell=path/to/cornell")
    for line in lines:
        if not line.trained:
            how = line.who.train_with or f"put its weights at {line.who.planner}"
            notes.append(f"not trained: {line.who.policy}, {line.who.training}: {how}")
    return notes


def transfer_content(lines: Sequence[TransferLine]) -> dict[str, Any]:
    """Plain data for results.json."""
    return {
        "rows": [
            {
                "policy": line.who.policy,
                "training": line.who.training,
                "planner": line.who.planner,
                "trained": line.trained,
                "worlds": {
                    world: {
                        "successes": score.successes,
                        "trials": score.trials,
                        "success_rate": score.rate,
                        "success_ci95": list(score.ci95),
                    }
                    for world, score in line.scores.items()
                },
            }
            for line in lines
        ],
        "agreement": [
            {
                "real": one.real,
                "simulation": one.simulation,
                "policies": one.policies,
                "pearson_r": one.pearson_r,
                "mmrv": one.mmrv,
            }
            for one in agreements(lines)
        ],
    }


def draw_transfer(lines: Sequence[TransferLine], worlds: Sequence[str]) -> bytes:
    """A PNG file's bytes: the rates with their intervals, and one world against the other."""
    shown = [line for line in lines if line.scores]
    figure = Figure(figsize=(12.5, 1.6 + 0.62 * max(len(shown), 5)), layout="constrained")
    bars, scatter = figure.subplots(1, 2, width_ratios=(1.7, 1))
    _draw_bars(bars, shown, worlds)
    _draw_agreement(scatter, shown)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=110)
    return file.getvalue()


def _draw_bars(axes: Axes, lines: Sequence[TransferLine], worlds: Sequence[str]) -> None:
    height = 0.8 / len(worlds)
    for number, world in enumerate(worlds):
        scored = [(i, line.scores[world]) for i, line in enumerate(lines) if world in line.scores]
        scored = [(i, score) for i, score in scored if score.trials]
        rates = [100 * score.rate for _, score in scored]
        errors = [
            [100 * (score.rate - score.ci95[0]) for _, score in scored],
            [100 * (score.ci95[1] - score.rate) for _, score in scored],
        ]
        axes.barh(
            [i + (number - (len(worlds) - 1) / 2) * height for i, _ in scored], rates,
            0.9 * height, xerr=errors, label=TITLES[world], color=_colour(number),
            error_kw={"elinewidth": 1.0, "capsize": 2},
        )  # fmt: skip
    names = [_name(line, "\n") for line in lines]
    axes.set(yticks=range(len(lines)), yticklabels=names, xlim=(0, 105), xlabel="success, %")
    axes.invert_yaxis()
    axes.grid(axis="x", alpha=0.3)
    axes.legend(loc="upper center", bbox_to_anchor=(0.45, 1.12), ncols=len(worlds), frameon=False)


def _draw_agreement(axes: Axes, lines: Sequence[TransferLine]) -> None:
    (real, simulation), *_ = PAIRS
    axes.plot([0, 100], [0, 100], color="0.7", linewidth=1)
    for number, line in enumerate(lines):
        scores = [line.scores.get(world) for world in (simulation, real)]
        if not all(score is not None and score.trials for score in scores):
            continue
        x, y = (100 * score.rate for score in scores)
        spans = [[[100 * (s.rate - s.ci95[0])], [100 * (s.ci95[1] - s.rate)]] for s in scores]
        axes.errorbar(
            x, y, xerr=spans[0], yerr=spans[1], fmt="o", color=_colour(number), capsize=2,
            label=_name(line, ", "),
        )  # fmt: skip
    found = [one for one in agreements(lines) if (one.real, one.simulation) == (real, simulation)]
    if found and found[0].pearson_r is not None:
        axes.set_title(f"r = {found[0].pearson_r:.3f}, MMRV = {found[0].mmrv:.3f}", fontsize=10)
    axes.set(
        xlim=(0, 102), ylim=(0, 102), aspect="equal", xlabel=f"{TITLES[simulation]}, %",
        ylabel=f"{TITLES[real]}, %",
    )  # fmt: skip
    axes.grid(alpha=0.3)
    axes.legend(loc="upper left", fontsize=8, frameon=False)


def _name(line: TransferLine, between: str) -> str:
    training = [line.who.training] if line.who.training != NOT_TRAINED else []
    return between.join([line.who.policy, *training])


def _colour(number: int) -> Any:
    return matplotlib.colormaps["tab10"](number % 10)
