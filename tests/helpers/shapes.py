"""Shapes whose geometry is known by hand."""

from __future__ import annotations

import itertools

import numpy as np


def cube_corners() -> tuple[np.ndarray]:
    """The one convex part of a cube of 6 cm."""
    return (np.array(list(itertools.product([-0.03, 0.03], repeat=3))),)
