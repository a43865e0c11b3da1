"""Automatic domain randomisation: ranges that grow where the policy succeeds at their bounds.

After OpenAI et al., "Solving Rubik's cube with a robot hand" (2019), and Handa et al., "DeXtreme"
(ICRA 2023). Knows nothing of what the parameters are.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from utils.config_ranges import AdaptiveConfig, Range
from utils.random_ranges import neutral


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
        settings, results = self._settings, self._results[bound]
        results.append(bool(success))
        if len(results) < settings.episodes:
            return
        rate = sum(results) / len(results)
        results.clear()
        step = settings.step * ((rate >= settings.widen_at) - (rate <= settings.narrow_at))
        self._shares[bound] = min(max(self._shares[bound] + step, 0.0), 1.0)

    def state(self) -> dict[str, Any]:
        """Plain data from which `load_state` goes on."""
        return {
            f"{bound.name}.{bound.side}": {"share": share, "results": list(self._results[bound])}
            for bound, share in self._shares.items()
        }

    def load_state(self, state: Mapping[str, Any]) -> None:
        """Go on from `state()`. Raises ValueError if it is of other parameters."""
        if set(state) != {f"{bound.name}.{bound.side}" for bound in self._movable}:
            raise ValueError("AdaptiveRanges: the state is of other parameters")
        for bound in self._movable:
            entry = state[f"{bound.name}.{bound.side}"]
            self._shares[bound] = float(entry["share"])
            self._results[bound] = [bool(result) for result in entry["results"]]

    def _end(self, bound: Bound) -> float:
        spec = self._limits[bound.name]
        start = neutral(spec)
        return start + self._shares.get(bound, 0.0) * (getattr(spec, bound.side) - start)
