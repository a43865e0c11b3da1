"""From a planner's score to the chance that executing the grasp succeeds, and how good that is.

Beta calibration (Kull, Silva Filho and Flach, AISTATS 2017) of scores between 0 and 1, with a
penalty for rough depth and a doubt for what failed just before: P = 1 / (1 + exp(-line)),
line = slope log(score) - upper log(1 - score) + offset - penalty roughness - doubt failed, fitted
to executed grasps. With slope = upper = 1 and no offset, a score is its own chance; with upper = 0,
as for scores that may exceed 1, it is Platt's method (1999) on the score's logarithm, which hardly
tells scores near 1 apart.
The chance rises with the score, so that the order of grasps stays. The roughness is that of
the table in the frame (`utils.depth_correction`): scores hardly tell a noisy frame, in which more
grasps fail. `failed` is 1 where the attempt before failed, and 0 otherwise: what is left then is
often what the planner misjudges. How far chances and frequencies are apart is the
expected calibration error (Guo et al., "On calibration of modern neural networks", ICML 2017).

This module knows neither planners nor simulators.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import minimize
from scipy.special import expit, log_expit, logit

from utils.errors import UserError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from utils.transforms import Grasp

LEAST_CHANCE = 0.5  # of success, below which a robot does not try a grasp: it rather fails
LEAST_SCORE = 1e-6  # scores below it count as it
MOST_SCORE = 0.999  # in log(1 - score), scores above it count as it
LEAST_SLOPE = 0.01  # keeps the order of grasps where the score tells nothing
# Standard deviation of slopes that are expected: so few grasps do not make a step of the line.
SLOPE_SPREAD = 10.0
DOUBT_SPREAD = 2.0  # and of doubts
PENALTY_SPREAD = 2.0  # and of penalties, 1 / mm
_NEVER, _ALWAYS = np.finfo(float).tiny, 1 - np.finfo(float).epsneg  # chances that have a score
_LONGEST = 700.0  # logarithm of a number that floats hold
_HALVINGS = 60
ROUNDING = 1e-6  # by which a score of 1 may come back from its chance
BINS = 10  # of equal width in [0, 1]
_DRAWS = 4000  # of the outcomes of all grasps


@dataclass(frozen=True)
class Calibration:
    """Chance of success of a score: slope > 0, offset, penalty >= 0 in 1 / m, doubt >= 0 and
    upper >= 0 of the module's formula. Raises ValueError for other numbers."""

    slope: float
    offset: float
    penalty: float = 0.0
    doubt: float = 0.0
    upper: float = 0.0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, bool) or not isinstance(value, Real) or not math.isfinite(value):
                raise ValueError(f"{field.name} is {value!r}, expected a finite number")
            if value < 0 and field.name != "offset":
                raise ValueError(f"{field.name} is {value:g}, expected a number of 0 or more")
        if self.slope == 0:
            raise ValueError("slope is 0, expected a number over 0: it keeps the order of grasps")

    def __call__(
        self, score: ArrayLike, roughness: ArrayLike = 0.0, failed: ArrayLike = False
    ) -> np.ndarray:
        """(...) chances in (0, 1) of scores (...) in frames of this roughness (...), m; failed:
        (...) bool, whether the attempt before failed."""
        return expit(self._line(score) - self._deduction(roughness, failed))

    def _line(self, score: ArrayLike) -> np.ndarray:
        return self.slope * _low(score) + self.upper * _high(score) + self.offset

    def _deduction(self, roughness: ArrayLike, failed: ArrayLike) -> np.ndarray:
        return self.penalty * np.asarray(roughness, float) + self.doubt * np.asarray(failed, float)

    def after_failure(self, chance: float) -> float:
        """The chance, where the attempt before failed, of what has this one where it did not."""
        return float(expit(logit(np.clip(chance, _NEVER, _ALWAYS)) - self.doubt))

    def scores(
        self, chances: ArrayLike, roughness: ArrayLike = 0.0, failed: ArrayLike = False
    ) -> np.ndarray:
        """(...) scores that have these chances (...) in frames of this roughness (...), m; failed:
        (...) bool, whether the attempt before failed. Scores over 1 may come back, also where a
        planner has none: above MOST_SCORE the line is straight in log(score)."""
        line = logit(np.clip(chances, _NEVER, _ALWAYS)) + self._deduction(roughness, failed)
        # Below MOST_SCORE, the score is found by bisection.
        straight = self.offset + self.upper * _high(1.0)
        above = np.exp(np.minimum((line - straight) / self.slope, _LONGEST))
        if self.upper == 0.0:
            return above
        low, high = np.full(np.shape(line), LEAST_SCORE), np.full(np.shape(line), MOST_SCORE)
        for _ in range(_HALVINGS):
            # In steps of the odds, so that scores near both ends are as exact as others.
            middle = expit((logit(low) + logit(high)) / 2)
            under = ~(self._line(middle) >= line)  # no score belongs to NaN, see below
            low, high = np.where(under, middle, low), np.where(under, high, middle)
        return np.where(line <= self._line(MOST_SCORE), high, above)

    def of_share(self, chance: float, share: float, roughness: float = 0.0) -> float:
        """The chance of a score that is this share of the one with that chance, both in a frame of
        this roughness, m."""
        return float(self(share * self.scores(chance, roughness), roughness))

    @staticmethod
    def fit(
        scores: ArrayLike,
        successes: ArrayLike,
        roughness: ArrayLike = 0.0,
        failed: ArrayLike = False,
        bounded: bool = True,
    ) -> Calibration:
        """The most likely calibration of executed grasps: scores (N,), successes (N,) bool, the
        roughness (N,) of their frames, m, and whether the attempts before failed (N,) bool.
        bounded: whether no score of this planner exceeds 1, in these grasps or others; where some
        may, upper is 0. Raises ValueError for no grasps, for scores that are no numbers, and for
        bounded ones over 1.

        A logistic regression with Platt's targets, which are nearer to each other than 0 and 1
        where there are few grasps, and Gaussian priors of standard deviations SLOPE_SPREAD on both
        slopes, DOUBT_SPREAD on the doubt and PENALTY_SPREAD on the penalty.
        """
        own = _Sample.of(scores, successes, roughness, failed, bounded)
        most = None if bounded else 0.0  # of the upper slope
        bounds = [(LEAST_SLOPE, None), (None, None), (0.0, None), (0.0, most), (0.0, None)]
        best = minimize(
            lambda numbers: own.loss(*numbers) / len(own.low), [1.0, 0.0, 0.0, 0.0, 0.0],
            method="L-BFGS-B", bounds=bounds,
        )  # fmt: skip
        slope, offset, doubt, upper, penalty = best.x.tolist()
        return Calibration(slope, offset, 1000 * penalty, doubt, upper)


class _Sample(NamedTuple):
    """N executed grasps as a fit sees them, (N,) each: what tells poor and good scores apart,
    Platt's targets, the roughness in mm, as large as the logarithms, and 1 after a failure."""

    low: np.ndarray
    high: np.ndarray
    target: np.ndarray
    rough: np.ndarray
    failed: np.ndarray

    @staticmethod
    def of(
        scores: ArrayLike,
        successes: ArrayLike,
        roughness: ArrayLike,
        failed: ArrayLike,
        bounded: bool,
    ) -> _Sample:
        scores, won = np.asarray(scores, dtype=float), np.asarray(successes, dtype=bool)
        if scores.size == 0 or not np.isfinite(scores).all():
            raise ValueError("a fit needs at least one grasp, and scores that are finite numbers")
        if not np.isfinite(np.asarray(roughness, dtype=float)).all():
            raise ValueError("the roughness of a frame has to be a finite number")
        if bounded and scores.max() > 1.0 + ROUNDING:
            raise ValueError(f"a score is {scores.max():g}: give bounded=False where some exceed 1")
        target = np.where(won, (won.sum() + 1) / (won.sum() + 2), 1 / ((~won).sum() + 2))
        rough, after_failure = 1000 * np.asarray(roughness, float), np.asarray(failed, float)
        return _Sample(_low(scores), _high(scores), target, rough, after_failure)

    def loss(
        self, slope: float, offset: float, doubt: float, upper: float, penalty: float
    ) -> float:
        """Minus the logarithm of the likelihood and the priors; penalty: in 1 / mm."""
        line = slope * self.low + upper * self.high + offset
        z = line - penalty * self.rough - doubt * self.failed
        likelihood = np.sum(self.target * log_expit(z) + (1 - self.target) * log_expit(-z))
        slopes = (slope**2 + upper**2) / SLOPE_SPREAD**2
        others = (doubt / DOUBT_SPREAD) ** 2 + (penalty / PENALTY_SPREAD) ** 2
        return float((slopes + others) / 2 - likelihood)


def _low(scores: ArrayLike) -> np.ndarray:
    """What tells poor scores (...) apart."""
    return np.log(np.maximum(scores, LEAST_SCORE))


def _high(scores: ArrayLike) -> np.ndarray:
    """What tells scores (...) near 1 apart."""
    return -np.log1p(-np.clip(scores, 0.0, MOST_SCORE))


def load_calibrations(path: Path) -> dict[str, Calibration]:
    """Those of a file by planner. Raises UserError for a file that is missing or is none."""
    try:
        planners: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))["planners"]
        return {
            name: Calibration(
                one["slope"],
                one["offset"],
                one.get("penalty", 0.0),
                one.get("doubt", 0.0),
                one.get("upper", 0.0),
            )
            for name, one in planners.items()
        }
    except FileNotFoundError:
        raise UserError(
            f"{path} does not exist, without which no planner states chances of success; the "
            "shipped one comes back by git checkout checkpoints, one of your own by "
            "python -m benchmarks.calibrate"
        ) from None
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(f"{path} holds no chances of success by planner: {error!r}") from None


def unlikely_ones(grasps: Sequence[Grasp], named: str = "grasps") -> list[str]:
    """A remark on grasps that are more likely to fail than to succeed. named: what they are."""
    count = sum(grasp.quality < LEAST_CHANCE for grasp in grasps)
    if count == 0:
        return []
    have = "has" if count == 1 else "have"
    return [
        f"{count} of the {len(grasps)} {named} {have} a chance under {LEAST_CHANCE:g}, more likely "
        "to fail than to succeed"
    ]


class ReliabilityBin(NamedTuple):
    """The grasps whose chances lie in one bin: their number, mean chance, share of successes."""

    count: int
    chance: float
    success: float


def reliability(chances: ArrayLike, successes: ArrayLike) -> list[ReliabilityBin]:
    """The bins of [0, 1] that hold grasps, lowest first; a chance of 1 belongs to the last."""
    chances, successes = np.asarray(chances, dtype=float), np.asarray(successes, dtype=float)
    place = _bins_of(chances)
    return [
        ReliabilityBin(int(here.sum()), float(chances[here].mean()), float(successes[here].mean()))
        for here in (place == number for number in range(BINS))
        if here.any()
    ]


def _bins_of(chances: np.ndarray) -> np.ndarray:
    """(N,) numbers of the bins that hold chances (N,)."""
    return np.minimum((chances * BINS).astype(int), BINS - 1)


def calibration_error(chances: ArrayLike, successes: ArrayLike) -> float:
    """The expected calibration error: the mean over the grasps of |share of successes - mean
    chance| of their bin."""
    found = reliability(chances, successes)
    total = sum(one.count for one in found)
    return sum(one.count * abs(one.success - one.chance) for one in found) / total


def error_by_chance(chances: ArrayLike) -> tuple[float, float]:
    """The mean and the 95th percentile of the calibration error of a planner that knows its chances
    (N,) exactly: few grasps leave an error to it, too. By outcomes drawn from these chances."""
    chances = np.asarray(chances, dtype=float)
    belongs = (_bins_of(chances)[:, None] == np.arange(BINS)).astype(float)  # (N, BINS)
    outcomes = np.random.default_rng(0).random((_DRAWS, len(chances))) < chances
    errors = np.abs((outcomes - chances) @ belongs).sum(axis=1) / len(chances)
    return float(errors.mean()), float(np.quantile(errors, 0.95))


def risk_coverage(chances: ArrayLike, successes: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """(N,) share of the grasps that are tried, and (N,) share of failures among them, when the
    surest 1, 2, ..., N are."""
    order = np.argsort(-np.asarray(chances, dtype=float), kind="stable")
    tried = np.arange(1, len(order) + 1)
    failures = np.cumsum(~np.asarray(successes, dtype=bool)[order])
    return tried / len(order), failures / tried


def draw_reliability(grasps: dict[str, tuple[Sequence[float], Sequence[bool]]]) -> Figure:
    """Reliability diagram, and risk against coverage, of each name's chances and successes."""
    from matplotlib.figure import Figure  # slow to import, and few callers need it

    figure = Figure(figsize=(10, 4.2), layout="constrained")
    diagram, risks = figure.subplots(1, 2)
    diagram.plot([0, 1], [0, 1], color="0.7", linewidth=1)
    # A later line is thinner, so that one which it runs along can be seen.
    for (name, (chances, successes)), width in zip(grasps.items(), _widths(len(grasps))):
        bins = reliability(chances, successes)
        error = calibration_error(chances, successes)
        chance, success = [one.chance for one in bins], [one.success for one in bins]
        (line,) = diagram.plot(chance, success, linewidth=width, label=f"{name}: error {error:.3f}")
        area = [20 + 300 * one.count / len(chances) for one in bins]  # bins of few grasps are small
        diagram.scatter(chance, success, s=area, color=line.get_color(), alpha=0.7, clip_on=False)
        risks.plot(*risk_coverage(chances, successes), linewidth=width, label=name)
    diagram.set(
        xlim=(0, 1), ylim=(0, 1.02), xlabel="quality: chance that the planner states",
        ylabel="share of grasps that succeeded",
    )  # fmt: skip
    risks.set(xlim=(0, 1), xlabel="coverage: share of grasps tried, the surest first",
              ylabel="risk: share of failures among them")  # fmt: skip
    risks.set_ylim(bottom=0)
    diagram.legend(fontsize=8)
    risks.legend(fontsize=8)
    return figure


def _widths(count: int) -> np.ndarray:
    """Widths of so many lines, in points, from thick to thin."""
    return np.linspace(1.0 + min(2.0 * (count - 1), 6.0), 1.0, count)
