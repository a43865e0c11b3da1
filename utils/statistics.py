"""Intervals of rates, paired differences of policies, and how well a simulation predicts reality.

This module knows numbers only, nothing of grasps or simulators.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import ndtri

CONFIDENCE = 0.95  # of every interval
RESAMPLES = 10_000  # of a bootstrap interval
_MOST_DRAWS = 1_000_000  # of a bootstrap that are in memory at a time
FEW_ROUNDS = 20  # below it a bootstrap interval is too narrow to be trusted


def wilson_interval(successes: int, n: int) -> tuple[float, float]:
    """Wilson's score interval of a success rate, (low, high) in [0, 1]; n = 0 gives (0, 1).

    It assumes independent trials. E. B. Wilson, "Probable inference, the law of succession, and
    statistical inference", JASA 22 (1927); equation as in Newcombe, Stat. Med. 17 (1998), method 3.
    Raises ValueError unless 0 <= successes <= n.
    """
    if not 0 <= successes <= n:
        raise ValueError(f"wilson_interval: need 0 <= successes <= n, got {successes} of {n}")
    return _score_interval(successes / n, n) if n else (0.0, 1.0)


def clustered_interval(outcomes: ArrayLike) -> tuple[float, float]:
    """Interval of the rate sum(successes) / sum(trials) of rounds, (low, high) in [0, 1].

    outcomes: (R, 2) successes and trials of each round, or (R,) 0/1 as in
        `paired_difference_interval`. Photographs of one object count as a round.

    Trials of one round share a scene, and a round may end early, so that they are not independent:
    rounds are. Wilson's interval is taken of as many independent trials as tell as much, n divided
    by the design effect (L. Kish, "Survey Sampling", 1965, section 8.2; for Wilson's interval
    C. Franco et al., J. Survey Stat. Methodol. 7, 2019): the variance of the rate as a ratio of
    sums over whole rounds, by that of n independent trials. A design effect below 1 counts as 1, as
    does that of a single round, or of none or only successes, which show no variance. No trial
    gives (0, 1). Raises ValueError on shapes and counts that make no sense.
    """
    counts = _counts(outcomes)
    successes, n = counts.sum(axis=0)
    if n == 0:
        return 0.0, 1.0
    rate, rounds, effect = successes / n, len(counts), 1.0
    if rounds > 1 and 0 < successes < n:
        off = counts[:, 0] - rate * counts[:, 1]
        effect = max(rounds / (rounds - 1) * (off @ off) / (n * rate * (1 - rate)), 1.0)
    return _score_interval(rate, n / effect)


def counts_by_group(groups: Iterable[Hashable], right: Iterable[bool]) -> list[tuple[int, int]]:
    """Successes and trials of each group, for `clustered_interval`: trials that share an object or
    a scene are one group. groups, right: of each trial. Raises ValueError for unequal lengths."""
    counts: dict[Hashable, tuple[int, int]] = {}
    for group, success in zip(groups, right, strict=True):
        successes, trials = counts.get(group, (0, 0))
        counts[group] = (successes + bool(success), trials + 1)
    return list(counts.values())


def _score_interval(rate: float, n: float) -> tuple[float, float]:
    """Wilson's interval of a rate that was seen in n trials, which need not be a whole number."""
    z = float(ndtri(0.5 + CONFIDENCE / 2))  # the normal distribution's quantile
    centre = rate + z**2 / (2 * n)
    spread = z * np.sqrt(rate * (1 - rate) / n + z**2 / (4 * n**2))
    low, high = (centre - spread) / (1 + z**2 / n), (centre + spread) / (1 + z**2 / n)
    # At no or only successes the bound is 0 or 1 exactly; rounding must not say otherwise.
    return (0.0 if rate == 0 else float(low)), (1.0 if rate == 1 else float(high))


@dataclass(frozen=True)
class Difference:
    """A difference of two rates, `value` = a - b, and its bootstrap interval [low, high]."""

    value: float
    low: float
    high: float
    rounds: int


def paired_difference_interval(a: ArrayLike, b: ArrayLike, seed: int = 0) -> Difference | None:
    """Difference of two policies' rates over the same rounds, a - b, with a bootstrap interval.

    a, b: row i of both belongs to the same scene. Shape (R, 2) holds (successes, attempts) of each
        round; shape (R,) holds 0/1 outcomes, short for one attempt in each round.

    A policy's rate is sum(successes) / sum(attempts), a ratio of sums, because rounds differ in
    their number of attempts and the mean of per-round rates would be another quantity. Whole
    rounds are drawn with replacement, the same ones for both policies: attempts within a round
    share a scene and are not independent, and what a hard scene does to both cancels.
    The interval is the percentile interval (Efron and Tibshirani, 1993, chapter 13). It is too
    narrow for few rounds (below about 20), and has no width where every round agrees.

    Returns None where a rate is undefined (no round, or no attempt by one of the policies).
    Raises ValueError on shapes that do not pair up.
    """
    a, b = _counts(a), _counts(b)
    if a.shape != b.shape:
        raise ValueError(f"paired_difference_interval: a has {len(a)} rounds, b has {len(b)}")
    if not (a[:, 1].sum() > 0 and b[:, 1].sum() > 0):
        return None
    value = a[:, 0].sum() / a[:, 1].sum() - b[:, 0].sum() / b[:, 1].sum()
    rng = np.random.default_rng(seed)
    both, share = np.hstack([a, b]), np.full(len(a), 1 / len(a))
    sums = np.empty((RESAMPLES, 4))
    block = max(1, _MOST_DRAWS // len(a))
    for start in range(0, RESAMPLES, block):
        stop = min(start + block, RESAMPLES)
        # How often each round was drawn; a resample's sums are then matrix products.
        sums[start:stop] = rng.multinomial(len(a), share, size=stop - start) @ both
    sums_a, sums_b = sums[:, :2], sums[:, 2:]
    defined = (sums_a[:, 1] > 0) & (sums_b[:, 1] > 0)  # a resample may hold no attempt at all
    rates_a = sums_a[defined, 0] / sums_a[defined, 1]
    rates_b = sums_b[defined, 0] / sums_b[defined, 1]
    tail = (1 - CONFIDENCE) / 2
    low, high = np.quantile(rates_a - rates_b, [tail, 1 - tail])
    return Difference(float(value), float(low), float(high), len(a))


def pearson_correlation(a: ArrayLike, b: ArrayLike) -> float | None:
    """Pearson's r of two lists of numbers (N,): 1 where one is a growing linear function of the
    other.

    None where it is undefined: fewer than two numbers, or a list that never changes. Raises
    ValueError on lists that do not pair up.
    """
    first, second = _paired("pearson_correlation", a, b)
    if len(first) < 2:
        return None
    first, second = first - first.mean(), second - second.mean()
    size = float(np.linalg.norm(first) * np.linalg.norm(second))
    return float(np.clip(first @ second / size, -1.0, 1.0)) if size > 1e-12 else None


def mean_maximum_rank_violation(real: ArrayLike, simulated: ArrayLike) -> float | None:
    """How badly a simulation mixes up the order of policies, 0 (not at all) to 1.

    real, simulated: (N,) success rates of N policies in reality and in simulation. Where the
    simulation orders two policies differently, the violation is the real difference of their rates;
    the result is the mean over the policies of each one's worst violation. Li et al., "Evaluating
    real-world robot manipulation policies in simulation" (SIMPLER, CoRL 2024), section 3.2. None
    for no policy. Raises ValueError on lists that do not pair up.
    """
    real, simulated = _paired("mean_maximum_rank_violation", real, simulated)
    if len(real) == 0:
        return None
    behind = real[:, None] < real[None, :]
    mixed_up = (simulated[:, None] < simulated[None, :]) != behind
    return float((np.abs(real[:, None] - real[None, :]) * mixed_up).max(axis=1).mean())


def _paired(name: str, a: ArrayLike, b: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    a, b = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    if a.ndim != 1 or a.shape != b.shape:
        raise ValueError(f"{name}: need two lists of one length, got shapes {a.shape}, {b.shape}")
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        raise ValueError(f"{name}: the numbers must be finite")
    return a, b


def _counts(outcomes: ArrayLike) -> np.ndarray:
    """(R, 2) successes and attempts of each round."""
    outcomes = np.asarray(outcomes, dtype=float)
    if outcomes.ndim == 1:
        outcomes = np.stack([outcomes, np.ones_like(outcomes)], axis=1)
    if outcomes.ndim != 2 or outcomes.shape[1] != 2:
        raise ValueError(f"outcomes must have shape (R,) or (R, 2), got {outcomes.shape}")
    if not (np.isfinite(outcomes).all() and (outcomes >= 0).all()):
        raise ValueError("outcomes must be finite and not negative")
    if (outcomes[:, 0] > outcomes[:, 1]).any():
        raise ValueError("a round has more successes than attempts")
    return outcomes
