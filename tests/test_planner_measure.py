"""What noise has raised on a height map is nothing to hold: ridges of known height on a slab."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from models.planner_candidates import Candidates, SearchSettings
from models.planner_measure import measure, without_bumps
from models.planners import make_planner
from tests.helpers.box_frames import boxes_frame
from utils.depth import RealSenseNoise
from utils.geometry import GripperGeometry, Workspace
from utils.height_map import HeightMap

HAND = GripperGeometry()
CELL, SLAB = 0.002, 0.05  # m, of the map and from the table to the slab's top


def ridge_on_a_slab(rise: float, roughness: float, beside: int) -> HeightMap:
    """A ridge 2 cm wide along y in the middle of a slab. beside: the slab's label; -1 makes a table
    of it on the right of the ridge."""
    height, label = np.full((101, 101), SLAB), np.zeros((101, 101), int)
    height[20:81, 45:56] += rise
    label[:, 56:] = beside
    centres = np.array([[0.0, 0.0, SLAB]])
    origin = np.array([-0.1, -0.1])
    return HeightMap(height, height, label, centres, origin, CELL, 0.0, roughness=roughness)


def across(heights: HeightMap, depth: float) -> Candidates:
    """The measured grasp across the ridge, its fingertips this far below the ridge's top."""
    one = Candidates.rough(
        np.zeros((1, 2)), np.zeros(1), np.array([heights.height.max() - depth]),
        np.full(1, 0.03), np.ones(1),
    )  # fmt: skip
    found = measure(one, heights, HAND, SearchSettings().relaxed())
    assert found.width[0] == pytest.approx(0.022, abs=1e-6)  # eleven cells
    return found


@given(st.floats(0.006, 0.03), st.floats(0.0001, 0.004), st.floats(0.3, 0.9))
def test_a_ridge_counts_from_five_times_the_roughness_and_15_mm(rise, roughness, share) -> None:
    bumps, depth = min(5 * roughness, 0.015), share * rise
    assume(abs(rise - bumps) > 1e-6 and abs(depth - 2 * roughness) > 1e-6)
    deep = depth > 2 * roughness
    for beside in (0, -1):
        heights = ridge_on_a_slab(rise, roughness, beside)
        found = across(heights, depth)
        # On the left there is the slab in either case.
        assert len(without_bumps(found, heights, HAND)) == (deep and rise > bumps)
        exact = replace(heights, roughness=0.0)
        assert len(without_bumps(found, exact, HAND)) == 1
        on_table = replace(heights, label=np.where(heights.height > SLAB, 0, -1))
        assert len(without_bumps(found, on_table, HAND)) == deep


@pytest.mark.parametrize("name", ["heuristic", "graspnet", "graspnet_direct"])
@pytest.mark.parametrize("height", [0.05, 0.10])
def test_a_noisy_box_wider_than_the_hand_is_left_alone(name, height) -> None:
    """Without the check, `graspnet` gives ridges of noise chances of up to 0.68 and 0.94."""
    frame = boxes_frame([((0.12, 0.12, height), 0.3, (0.5, 0.0))])
    frame.rgb[:] = 120
    frame.rgb[frame.depth < 0.79] = (60, 100, 180)
    noise = RealSenseNoise(image_focal=frame.K[0, 0])
    plan = make_planner(name, HAND, Workspace(), 0)
    for seed in range(12):
        depth = noise(frame.depth, np.random.default_rng(seed)).astype(np.float32)
        assert [grasp for grasp in plan(replace(frame, depth=depth)) if grasp.quality > 0.3] == []
