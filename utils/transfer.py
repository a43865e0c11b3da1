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
from utils.result_records import RoundRecord
from utils.results import aligned
from utils.statistics import mean_maximum_rank_violation, pearson_correlation, wilson_interval

TITLES = {
    "pybullet": "PyBullet",
    "outside": "PyBullet outside the ranges",
    "mujoco": "MuJoCo",
    "cornell": "Cornell photographs",
    "cornell_as_taken": "Cornell as taken",
}
NOT_TRAINED = "-"  # a row's training where the policy learns nothing
_SHAPES = "osD^v"
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
    """One policy: its score by world. A world that is not there was not scored. scenes: what it was
    scored on. trained: whether the planner's file exists."""

    who: TransferPolicy
    scenes: str
    scores: Mapping[str, Score]
    trained: bool = True


@dataclass(frozen=True)
class Agreement:
    """How well the rates of N policies in `simulation` foretell those in `real`, on the same
    scenes: Pearson's r, and the mean maximum rank violation (`utils.statistics`)."""

    scenes: str
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
    """For each kind of scenes and each pair of worlds, over the policies that were scored in both;
    one policy alone has no order."""
    found = []
    for scenes in dict.fromkeys(line.scenes for line in lines):
        for real, simulation in PAIRS:
            rates = [
                (line.scores[real].rate, line.scores[simulation].rate)
                for line in lines
                if line.scenes == scenes
                and all(w in line.scores and line.scores[w].trials for w in (real, simulation))
            ]
            if len(rates) < 2:
                continue
            a, b = zip(*rates)
            r, mmrv = pearson_correlation(a, b), mean_maximum_rank_violation(a, b)
            found.append(Agreement(scenes, real, simulation, len(rates), r, mmrv))
    return found


def format_transfer(lines: Sequence[TransferLine], worlds: Sequence[str]) -> str:
    """The table as aligned text."""
    header = ("policy", "randomised in training", "scenes", *(TITLES[world] for world in worlds))
    table = []
    for line in lines:
        cells = [line.who.policy, line.who.training, line.scenes]
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
            f"{one.scenes}: {TITLES[one.simulation]} foretells {TITLES[one.real]}: Pearson r {r}, "
            f"mean maximum rank violation {one.mmrv:.3f}, {one.policies} policies"
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
                "scenes": line.scenes,
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
                "scenes": one.scenes,
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
    figure = Figure(figsize=(13.5, 1.6 + 0.62 * max(len(shown), 5)), layout="constrained")
    bars, scatter = figure.subplots(1, 2, width_ratios=(1.6, 1))
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
        if not scored:
            continue
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
    several = len({line.scenes for line in lines}) > 1
    names = ["\n".join(_parts(line, several)) for line in lines]
    axes.set(yticks=range(len(lines)), yticklabels=names, xlim=(0, 105), xlabel="success, %")
    axes.set_ylim(len(lines) - 0.5, -0.5)  # the first row on top
    axes.grid(axis="x", alpha=0.3)
    axes.legend(loc="lower center", bbox_to_anchor=(0.45, 1.0), ncols=len(worlds), frameon=False)


def _draw_agreement(axes: Axes, lines: Sequence[TransferLine]) -> None:
    """A colour for each row, a shape for each kind of scenes."""
    (real, simulation), *_ = PAIRS
    axes.plot([0, 100], [0, 100], color="0.7", linewidth=1)
    kinds = list(dict.fromkeys(line.scenes for line in lines))
    told = False
    for number, line in enumerate(lines):
        scores = [line.scores.get(world) for world in (simulation, real)]
        if not all(score is not None and score.trials for score in scores):
            continue
        x, y = (100 * score.rate for score in scores)
        spans = [[[100 * (s.rate - s.ci95[0])], [100 * (s.ci95[1] - s.rate)]] for s in scores]
        axes.errorbar(
            x, y, xerr=spans[0], yerr=spans[1], color=matplotlib.colormaps["tab20"](number % 20),
            fmt=_SHAPES[kinds.index(line.scenes) % len(_SHAPES)], capsize=2, alpha=0.7,
            elinewidth=0.8, label=", ".join(_parts(line, len(kinds) > 1)),
        )  # fmt: skip
        told = True
    titles = [
        f"{one.scenes}: r = {one.pearson_r:.3f}, MMRV = {one.mmrv:.3f}"
        for one in agreements(lines)
        if (one.real, one.simulation) == (real, simulation) and one.pearson_r is not None
    ]
    axes.set_title("\n".join(titles), fontsize=10)
    axes.set(
        xlim=(0, 102), ylim=(0, 102), aspect="equal", xlabel=f"{TITLES[simulation]}, %",
        ylabel=f"{TITLES[real]}, %",
    )  # fmt: skip
    axes.grid(alpha=0.3)
    if told:
        axes.legend(loc="upper left", bbox_to_anchor=(0.0, -0.12), fontsize=8, frameon=False)


def _parts(line: TransferLine, with_scenes: bool) -> list[str]:
    """What tells a row from the others."""
    training = [line.who.training] if line.who.training != NOT_TRAINED else []
    return [line.who.policy, *training, *([line.scenes] if with_scenes else [])]


def _colour(number: int) -> Any:
    return matplotlib.colormaps["tab10"](number % 10)
