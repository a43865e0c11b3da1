"""Automatic domain randomisation: ranges that grow where the policy succeeds at their bounds.

After OpenAI et al., "Solving Rubik's cube with a robot hand" (2019), and Handa et al., "DeXtreme"
(ICRA 2023). Knows nothing of what the parameters are.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from utils.config_types import AdaptiveConfig, RandomizationConfig, Range
from utils.random_ranges import neutral, ranges_of

WIDEST = "widest"  # what an episode of the task itself is asked for, in place of `shares`


class Bound(NamedTuple):
    """One end, "low" or "high", of the range of a parameter."""

    name: str
    side: str


class AdaptiveRanges:
    """Ranges by name, each between its neutral value (share 0) and its limits (share 1).

    limits: the widest ranges. An end of a range without width never moves.
    """

    def __init__(self, limits: Mapping[str, Range], settings: AdaptiveConfig):
        self._limits, self._settings = dict(limits), settings
        self._movable = [
            Bound(name, side)
            for name, spec in self._limits.items()
            for side in ("low", "high")
            if getattr(spec, side) != neutral(spec)
        ]
        self._shares = {bound: settings.initial for bound in self._movable}
        self._results: dict[Bound, list[bool]] = {bound: [] for bound in self._movable}

    @property
    def ranges(self) -> dict[str, Range]:
        """The ranges as they are now."""
        return {
            name: spec._replace(**{side: self._end(Bound(name, side)) for side in ("low", "high")})
            for name, spec in self._limits.items()
        }

    @property
    def width(self) -> float:
        """Mean share of the way to the limits, 0 .. 1."""
        return float(np.mean(list(self._shares.values()))) if self._shares else 0.0

    def draw_bound(self, rng: np.random.Generator) -> tuple[Bound, float] | None:
        """Now and then a bound, and the value there, that this episode is to be played at."""
        if not self._movable or rng.random() >= self._settings.boundary_share:
            return None
        bound = self._movable[int(rng.integers(len(self._movable)))]
        return bound, self._end(bound)

    def record(self, bound: Bound, success: bool) -> None:
        """How an episode at a bound ended; after enough of them the bound is judged and moves."""
        self.record_all([(bound, self._end(bound), success)])

    def record_all(self, results: Iterable[tuple[Bound, float, bool]]) -> None:
        """How episodes of many environments ended, in any order: the bound, the value that it had
        when the episode began, and whether it succeeded.

        A bound moves one step at most, however many episodes were at it; those that began before it
        last moved say nothing of where it is now, and do not count.
        """
        settings = self._settings
        for bound, value, success in results:
            if value == self._end(bound):
                self._results[bound].append(bool(success))
        for bound, ends in self._results.items():
            if len(ends) < settings.episodes:
                continue
            rate = sum(ends) / len(ends)
            ends.clear()
            step = settings.step * ((rate >= settings.widen_at) - (rate <= settings.narrow_at))
            self._shares[bound] = min(max(self._shares[bound] + step, 0.0), 1.0)

    @property
    def shares(self) -> dict[str, float]:
        """By "name.side" how far each bound is on the way to its limit, 0 .. 1: what the ranges of
        others have to be told to be the same (`take_over`)."""
        return {_key(bound): share for bound, share in self._shares.items()}

    def take_over(self, shares: Mapping[str, float]) -> None:
        """Take over the ranges of `shares`. Raises ValueError if they are of other parameters."""
        self._check(shares)
        self._shares = {bound: float(shares[_key(bound)]) for bound in self._movable}

    def state(self) -> dict[str, Any]:
        """Plain data from which `load_state` goes on."""
        return {
            _key(bound): {"share": share, "results": list(self._results[bound])}
            for bound, share in self._shares.items()
        }

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Go on from `state()`. Raises ValueError if it is of other parameters."""
        self._check(state)
        for bound in self._movable:
            entry = state[_key(bound)]
            self._shares[bound] = float(entry["share"])
            self._results[bound] = [bool(result) for result in entry["results"]]

    def _check(self, by_bound: Mapping[str, Any]) -> None:
        if set(by_bound) != set(map(_key, self._movable)):
            raise ValueError("AdaptiveRanges: the state is of other parameters")

    def _end(self, bound: Bound) -> float:
        spec = self._limits[bound.name]
        start = neutral(spec)
        return start + self._shares.get(bound, 0.0) * (getattr(spec, bound.side) - start)


def adaptive_ranges(settings: RandomizationConfig) -> AdaptiveRanges | None:
    """The ranges of physics that grow with success, as they are at first; None where none do."""
    if not settings.adaptive.enabled:
        return None
    return AdaptiveRanges(ranges_of(settings.physics), settings.adaptive)


def _key(bound: Bound) -> str:
    return f"{bound.name}.{bound.side}"
