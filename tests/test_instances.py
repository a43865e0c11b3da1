"""Votes for centres of mass: boxes that touch, whose centres are known."""

from dataclasses import replace

import numpy as np
import pytest

from models.planner_graspnet import labelled_by_centres, vote_centres
from tests.helpers.box_frames import boxes_frame
from utils.geometry import Workspace
from utils.height_map import height_map_from_frame
from utils.images import PixelScaling
from utils.transforms import RGBDFrame, project

CELL = 0.002  # m
SAME = PixelScaling(1.0, 1.0)
# Two boxes of one height, side by side without a gap: one piece to a depth image.
TOUCHING = [((0.04, 0.03, 0.05), 0.0, (0.50, 0.015)), ((0.04, 0.03, 0.05), 0.0, (0.50, -0.015))]


def true_offset(frame: RGBDFrame) -> np.ndarray:
    """(2, H, W) of a perfect centre head: a pixel belongs to the box on its side of y = 0."""
    centres = np.array([thing.centre_of_mass for thing in frame.truth.objects])
    centres, _ = project(centres, frame.K, frame.T_WC)
    v, u = np.mgrid[: frame.depth.shape[0], : frame.depth.shape[1]]
    side = (frame.points()[..., 1] < 0).astype(int)
    return np.moveaxis(centres[side], -1, 0) - np.stack([u, v])


def centres_by_place(heights, frame: RGBDFrame) -> np.ndarray:
    """(M, 3) the centre that the height map gives to what lies at each true centre."""
    true = np.array([thing.centre_of_mass for thing in frame.truth.objects])
    return heights.centres[heights.label[heights.index(true[:, :2])]]


def test_boxes_that_touch_are_told_apart() -> None:
    frame = boxes_frame(TOUCHING)
    heights = height_map_from_frame(frame, Workspace())
    assert heights.label.max() == 0, "one piece by height alone"
    found = labelled_by_centres(heights, frame, SAME, true_offset(frame))
    for thing, centre in zip(frame.truth.objects, centres_by_place(found, frame)):
        np.testing.assert_allclose(centre, thing.centre_of_mass, atol=0.002)
    assert set(np.unique(found.label)) == {-1, 0, 1}
    assert ((found.label >= 0) == (heights.label >= 0)).all()
    assert found.height is heights.height and found.ceiling is heights.ceiling


def test_votes_at_another_resolution_lead_to_the_same_centres() -> None:
    frame = boxes_frame(TOUCHING)
    heights = height_map_from_frame(frame, Workspace())
    once = labelled_by_centres(heights, frame, SAME, true_offset(frame))
    # A network at twice the scale sees every pixel twice and says twice the offset.
    v, u = np.mgrid[:448, :448]
    scaling = PixelScaling(2.0, 2.0)
    at = true_offset(frame) + np.stack(np.mgrid[:224, :224][::-1])
    doubled = scaling.pixels(np.moveaxis(at, 0, -1)).repeat(2, 0).repeat(2, 1)
    offset = np.moveaxis(doubled, -1, 0) - np.stack([u, v])
    twice = labelled_by_centres(heights, frame, scaling, offset)
    np.testing.assert_allclose(*(centres_by_place(x, frame) for x in (once, twice)), atol=0.002)


def test_what_nobody_votes_for_stays_what_the_height_map_takes_it_for() -> None:
    """Two boxes apart; of the second one all votes lead far away and to different places."""
    apart = [TOUCHING[0], ((0.03, 0.03, 0.04), 0.3, (0.42, -0.08))]
    frame = boxes_frame(apart)
    heights = height_map_from_frame(frame, Workspace())
    offset = true_offset(frame)
    lost = frame.points()[..., 1] < -0.03
    offset[:, lost] = np.random.default_rng(0).uniform(-400, 400, (2, lost.sum()))
    found = labelled_by_centres(heights, frame, SAME, offset)
    np.testing.assert_allclose(
        centres_by_place(found, frame)[1], centres_by_place(heights, frame)[1], atol=1e-9
    )
    assert len(set(found.label[found.index(np.array([box[2] for box in apart]))])) == 2


def test_walls_around_wide_holes_belong_to_no_object() -> None:
    frame = boxes_frame(TOUCHING)
    depth = frame.depth.copy()
    depth[100:170, 130:200] = 0
    frame = replace(frame, depth=depth)
    heights = height_map_from_frame(frame, Workspace())
    wall = heights.height > 0.09
    assert wall.sum() > 1000
    found = labelled_by_centres(heights, frame, SAME, true_offset(frame))
    assert (found.label[wall] == -1).all()
    for thing, centre in zip(frame.truth.objects, centres_by_place(found, frame)):
        assert centre[2] == pytest.approx(thing.centre_of_mass[2], abs=0.003)


def test_centres_are_where_enough_votes_meet() -> None:
    rng = np.random.default_rng(0)
    meant = np.array([[30.0, 20.0], [60.0, 44.0]])
    votes = np.concatenate(
        [centre + rng.normal(0, 1.0, (n, 2)) for centre, n in zip(meant, (300, 200))]
    )
    astray = rng.uniform(0, 80, (30, 2))
    found = vote_centres(np.concatenate([votes, astray]), (80, 100), CELL)
    np.testing.assert_allclose(found, meant, atol=0.5)


def test_centres_may_lie_outside_the_image() -> None:
    votes = np.random.default_rng(0).normal((-7.0, 90.0), 0.8, (100, 2))
    found = vote_centres(votes, (80, 100), CELL)
    np.testing.assert_allclose(found, [[-7.0, 90.0]], atol=0.3)


@pytest.mark.parametrize("apart, count", [(1, 1), (3, 1), (5, 1), (9, 2)])
def test_equal_peaks_closer_than_apart_are_one(apart: int, count: int) -> None:
    votes = np.repeat([[40.0, 40.0], [40.0 + apart, 40.0]], 100, axis=0)
    assert len(vote_centres(votes, (80, 100), CELL)) == count


def test_how_much_surface_makes_an_object_does_not_depend_on_the_cell() -> None:
    """1 cm2 does and 0.6 cm2 does not, in cells of 1 mm as of 2 mm."""
    for cell in (0.001, 0.002):
        for area, expected in ((1e-4, 1), (0.6e-4, 0)):
            votes = np.full((round(area / cell**2), 2), 33.0)
            assert len(vote_centres(votes, (80, 100), cell)) == expected


@pytest.mark.parametrize("boxes", [[], TOUCHING])
def test_where_nothing_is_agreed_on_the_map_stays_as_it_is(boxes) -> None:
    frame = boxes_frame(boxes)
    heights = height_map_from_frame(frame, Workspace())
    scattered = np.random.default_rng(0).uniform(-100, 100, (2, 224, 224))
    assert labelled_by_centres(heights, frame, SAME, scattered) is heights
