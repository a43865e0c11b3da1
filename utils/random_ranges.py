"""Parameters drawn from a range: distributions, and how a drawn value changes a nominal one.

Knows nothing of what the parameters are.
"""

from __future__ import annotations

import math

import numpy as np

from utils.config_schema import Range

_DEVIATIONS = 2.0  # a normal range ends so many standard deviations from its mean
NEUTRAL = {"scale": 1.0, "add": 0.0}  # changes nothing


def draw(spec: Range, rng: np.random.Generator, size: int | None = None):
    """A float, or a list of `size` floats, within [low, high] of the range.

    normal: truncated at two standard deviations (Robert, "Simulation of truncated normal
    variables", 1995: by drawing again), so its variance is 0.774 of the untruncated one's.
    """
    count = 1 if size is None else size
    if spec.distribution == "normal":
        values = _truncated(rng, count)
        values = (spec.low + spec.high) / 2 + (spec.high - spec.low) / (2 * _DEVIATIONS) * values
    elif spec.distribution == "log_uniform":
        values = np.exp(rng.uniform(math.log(spec.low), math.log(spec.high), count))
    else:
        values = rng.uniform(spec.low, spec.high, count)
    # Rounding in the logarithm may leave the range by the last bit.
    values = np.clip(values, spec.low, spec.high).tolist()
    return values[0] if size is None else values


def changed(operation: str, nominal: float, value: float) -> float:
    """A nominal value after `scale` (a factor), `add` or `set`."""
    if operation == "scale":
        return nominal * value
    return nominal + value if operation == "add" else value


def neutral(spec: Range) -> float:
    """The value within the range that changes least; for `set` its middle."""
    middle = (spec.low + spec.high) / 2
    return min(max(NEUTRAL.get(spec.operation, middle), spec.low), spec.high)


def _truncated(rng: np.random.Generator, count: int) -> np.ndarray:
    values = rng.standard_normal(count)
    while (outside := abs(values) > _DEVIATIONS).any():
        values[outside] = rng.standard_normal(int(outside.sum()))
    return values
