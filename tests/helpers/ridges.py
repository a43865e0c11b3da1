"""Ridges of known height on a slab, and the grasp across one."""

from __future__ import annotations

import numpy as np
import pytest

from models.planner_candidates import Candidates, SearchSettings
from models.planner_measure import measure
from utils.geometry import GripperGeometry
from utils.height_map import HeightMap

HAND = GripperGeometry()
CELL, SLAB = 0.002, 0.05  # m, of the map and from the table to the slab's top


def ridge_on_a_slab(rise: float, noise: float, label: int) -> HeightMap:
    """A ridge 2 cm wide along y, of object 0, in the middle of a slab with this label on the right;
    on the left it is a part of the object."""
    height, labels = np.full((101, 101), SLAB), np.zeros((101, 101), int)
    height[20:81, 45:56] += rise
    labels[:, 56:] = label
    centres = np.array([[0.0, 0.0, SLAB]])
    origin = np.array([-0.1, -0.1])
    return HeightMap(height, height, labels, centres, origin, CELL, 0.0, noise=noise)


def across(heights: HeightMap, depth: float) -> Candidates:
    """The measured grasp across the ridge, its fingertips this far below the ridge's top."""
    one = Candidates.rough(
        np.zeros((1, 2)), np.zeros(1), np.array([heights.height.max() - depth]),
        np.full(1, 0.03), np.ones(1),
    )  # fmt: skip
    found = measure(one, heights, HAND, SearchSettings().relaxed())
    assert found.width[0] == pytest.approx(0.022, abs=1e-6)  # eleven cells
    return found
