"""What noise has raised on a height map is nothing to hold: ridges of known height on a slab."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

from models.fan_views import fan_views
from models.planner_antipodal import search, search_once
from models.planner_candidates import SearchSettings, grip_score
from models.planner_measure import without_bumps
from models.planners import make_planner
from tests.helpers.box_frames import boxes_frame
from tests.helpers.ridges import HAND, SLAB, across, ridge_on_a_slab
from utils.depth import RealSenseNoise
from utils.depth_correction import corrected
from utils.geometry import Workspace
from utils.height_map import (
    OTHER_LABEL,
    WALL_LABEL,
    height_map_from_frame,
    height_map_from_scene,
    tilted_height_map,
    tilted_view,
)
from utils.seen_heights import without_holes
from utils.target import only_target
from utils.transforms import RGBDFrame

PERFECT = {
    "wedge": 0.0, "turn": 0.0, "tilt": 0.0, "arms": (0.0, 0.0, 0.0), "cover": 1.0,
    "engagement": 0.022, "roomy": 1.0, "covered": 0.0, "together": True, "over_table": 0.0,
}  # fmt: skip


@pytest.mark.parametrize(
    ("changed", "score"),
    [
        ({}, 1.0),
        ({"wedge": 0.25}, np.exp(-1)),
        ({"turn": 0.25}, np.exp(-1)),
        ({"tilt": 0.45}, np.exp(-1)),
        ({"arms": (0.022, 0.0, 0.0)}, np.exp(-1)),
        ({"arms": (0.0, 0.06, 0.0)}, np.exp(-1)),
        ({"arms": (0.0, 0.0, 0.05)}, np.exp(-1)),
        ({"cover": 0.0}, 0.4),
        ({"engagement": 0.011}, 0.5),
        ({"engagement": 0.0}, 0.2),
        ({"engagement": 0.05}, 1.0),
        ({"roomy": 0.4}, 0.4),
        ({"covered": 0.25}, np.exp(-1)),
        ({"together": False}, 0.5),
        ({"over_table": 0.1}, 1.2),
        ({"over_table": 0.3}, 1.3),
    ],
)
def test_each_fact_of_a_grip_has_its_factor(changed: dict, score: float) -> None:
    facts = {
        name: tuple(map(np.array, value)) if name == "arms" else np.array(value)
        for name, value in (PERFECT | changed).items()
    }
    assert grip_score(np, SearchSettings(), **facts) == pytest.approx(score)


@given(st.floats(0.007, 0.03), st.floats(0.0001, 0.006), st.floats(0.3, 0.9))
def test_a_ridge_counts_from_five_standard_deviations_and_15_mm(rise, noise, share) -> None:
    bumps, least, depth = min(5 * noise, 0.015), min(2 * noise, 0.006), share * rise
    assume(abs(rise - bumps) > 1e-6 and abs(depth - least) > 1e-6)
    for label in (0, OTHER_LABEL, -1, WALL_LABEL):
        heights = ridge_on_a_slab(rise, noise, label)
        found = across(heights, depth)
        assert len(without_bumps(found, heights, HAND)) == (depth > least and rise > bumps)
        left_too = np.where(heights.height > SLAB, 0, label)
        alone = len(without_bumps(found, replace(heights, label=left_too), HAND))
        below = label in (-1, WALL_LABEL)  # nothing else can be there
        assert alone == (depth > least and (below or rise > bumps))
        assert len(without_bumps(found, replace(heights, noise=0.0), HAND)) == 1


@pytest.mark.parametrize("noise", [0.002, 0.003])
def test_nothing_is_held_on_a_wide_slab_whose_surface_is_rough(noise: float) -> None:
    """Of 10,000 cells with normal noise, as alike as their neighbours in a smoothed image, none
    rises by five standard deviations: one of 3.5 million does."""
    settings, where, unchecked = SearchSettings().relaxed(), Workspace((0.0, 0.0), 0.3), 0
    for seed in range(5):
        rough = gaussian_filter(np.random.default_rng(seed).normal(size=(101, 101)), 1.5)
        height = (SLAB + noise * rough / rough.std()).astype(np.float32)
        heights = replace(ridge_on_a_slab(0.0, noise, 0), height=height, ceiling=height)
        unchecked += len(search_once(replace(heights, noise=0.0), HAND, where, settings))
        assert len(search_once(heights, HAND, where, settings)) == 0
    assert unchecked > 0


def seen_by_a_realsense(boxes: list, seed: int) -> RGBDFrame:
    """Blue boxes on a grey table."""
    frame = boxes_frame(boxes)
    frame.rgb[:] = 120
    frame.rgb[frame.depth < 0.79] = (60, 100, 180)
    noise = RealSenseNoise(image_focal=frame.K[0, 0])
    depth = noise(frame.depth, np.random.default_rng(seed)).astype(np.float32)
    return replace(frame, depth=depth)


WIDE = ((0.12, 0.12, 0.1), 0.3, (0.5, 0.0))  # than the hand opens


@pytest.mark.parametrize("seed", range(4))
def test_a_ridge_of_5_mm_in_noise_is_left_alone_and_a_bar_on_the_box_is_not(seed: int) -> None:
    plan = make_planner("heuristic", HAND, Workspace(), 0)

    def found(thickness: float, checked: bool) -> int:
        bar = ((0.025, 0.08, thickness), 0.3, (0.5, 0.0, WIDE[0][2]))
        heights = plan.heights(corrected(seen_by_a_realsense([WIDE, bar], seed), 0.0))
        assert 0.002 < heights.noise < 0.003
        heights = heights if checked else replace(heights, noise=0.0)
        return len(search(heights, HAND, Workspace(), plan.settings))

    assert found(0.005, checked=False) > 0 and found(0.005, checked=True) == 0
    assert found(0.02, checked=True) > 0


def test_maps_know_the_noise_of_their_frames() -> None:
    """That of the noisier frame, in each kind of map."""
    workspace, clean = Workspace(), corrected(boxes_frame([WIDE]), 0.0)
    noisy = corrected(seen_by_a_realsense([WIDE], 0), 0.0)
    assert clean.noise < 1e-4 and 0.002 < noisy.noise < 0.003
    shelf = replace(noisy, fixtures=tuple(boxes_frame([WIDE], walls=1).truth.walls))
    for frame in (noisy, replace(clean, second=noisy), shelf):
        heights = height_map_from_frame(frame, workspace)
        T_WV = tilted_view(np.array([0.5, 0.0, -np.sqrt(0.75)]), workspace)
        holeless = without_holes(frame, workspace)
        views = fan_views(heights, *holeless, T_WV[None], torch.device("cpu"))
        target = replace(frame, target=np.ones(frame.depth.shape, bool))
        for drawn in (
            heights, heights.every(2), tilted_height_map(heights, *holeless, T_WV),
            only_target(heights, target), views, views.every(2), views.part(0, 1),
        ):  # fmt: skip
            assert drawn.noise == noisy.noise
    assert height_map_from_scene(clean.truth, workspace).noise == 0


def test_the_noise_is_that_of_the_smoothed_depth() -> None:
    """A table of 5 mm is smoothed first; correcting it again changes nothing."""
    frame = boxes_frame([WIDE])
    depth = frame.depth + np.random.default_rng(0).normal(0, 0.005, frame.depth.shape)
    once = corrected(replace(frame, depth=depth.astype(np.float32)), 0.0)
    assert once.roughness == pytest.approx(0.005, rel=0.1) and once.noise < 0.002
    twice = corrected(once, 0.0)
    assert (twice.roughness, twice.noise) == (once.roughness, once.noise)
