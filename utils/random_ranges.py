"""Parameters drawn from a range: distributions, and how a drawn value changes a nominal one.

This module does not know what the parameters mean.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from utils.config_types import Range

Change = tuple[str, Any]  # operation, and a value or a list of them
_DEVIATIONS = 2.0  # a normal range ends so many standard deviations from its mean


def ranges_of(section: Any) -> dict[str, Range]:
    """The ranges of a section of the config, by name."""
    return {name: getattr(section, name) for name in type(section).model_fields}


def draw(spec: Range, rng: np.random.Generator, size: int | None = None):
    """A float, or a list of `size` floats, within [low, high] of the range.

    normal: truncated at two standard deviations (Robert, "Simulation of truncated normal
    variables", 1995: by drawing again), so its variance is 0.774 of the untruncated one's.
    """
    values = [_draw_one(spec, rng) for _ in range(1 if size is None else size)]
    return values[0] if size is None else values


def changed(operation: str, nominal: float, value: float) -> float:
    """A nominal value after `scale` (a factor), `add` or `set`."""
    if operation == "scale":
        return nominal * value
    return nominal + value if operation == "add" else value


def _draw_one(spec: Range, rng: np.random.Generator) -> float:
    # Plain floats: arrays of one take ten times as long, and a reset draws fifty.
    low, high = spec.low, spec.high
    if spec.distribution == "normal":
        while abs(deviations := rng.standard_normal()) > _DEVIATIONS:
            pass
        value = (low + high) / 2 + (high - low) / (2 * _DEVIATIONS) * deviations
    elif spec.distribution == "log_uniform":
        value = low * math.exp(rng.random() * math.log(high / low))
    else:
        value = low + (high - low) * rng.random()
    return min(max(value, low), high)  # rounding may leave the range by the last bit
