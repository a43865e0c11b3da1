"""Votes for centres of mass: boxes that touch, whose centres are known."""

import numpy as np
import pytest

from models.instances import VoteSettings, labelled_by_centres, vote_centres
from tests.test_geometry import boxes_frame
from utils.geometry import Workspace
from utils.height_map import height_map_from_frame
from utils.pixel_scaling import PixelScaling
from utils.transforms import RGBDFrame, project

# Two boxes of one height, side by side without a gap: one piece to a depth image.
TOUCHING = [((0.04, 0.03, 0.05), 0.0, (0.50, 0.015)), ((0.04, 0.03, 0.05), 0.0, (0.50, -0.015))]


def true_offset(frame: RGBDFrame) -> np.ndarray:
    """(2, H, W) of a perfect centre head: a pixel belongs to the box on its side of y = 0."""
    centres = np.array([thing.centre_of_mass for thing in frame.truth.objects])
    centres, _ = project(centres, frame.K, frame.T_WC)
    v, u = np.mgrid[: frame.depth.shape[0], : frame.depth.shape[1]]
    side = (frame.points()[..., 1] < 0).astype(int)
    return np.moveaxis(centres[side], -1, 0) - np.stack([u, v])


def test_boxes_that_touch_are_told_apart() -> None:
    frame = boxes_frame(TOUCHING)
    heights = height_map_from_frame(frame, Workspace())
    assert heights.label.max() == 0, "one piece by height alone"
    found = labelled_by_centres(heights, frame, PixelScaling(1.0, 1.0), true_offset(frame))
    assert len(found.centres) == 2
    for thing in frame.truth.objects:
        label = found.label[found.index(thing.centre_of_mass[:2])]
        np.testing.assert_allclose(found.centres[label], thing.centre_of_mass, atol=0.002)
    matter = heights.height > VoteSettings().floor
    assert ((found.label >= 0) == matter).all()
    assert found.height is heights.height and found.ceiling is heights.ceiling


def test_votes_at_another_resolution_lead_to_the_same_centres() -> None:
    frame = boxes_frame(TOUCHING)
    heights = height_map_from_frame(frame, Workspace())
    once = labelled_by_centres(heights, frame, PixelScaling(1.0, 1.0), true_offset(frame))
    # A network at twice the scale sees every pixel twice and says twice the offset.
    v, u = np.mgrid[:448, :448]
    scaling = PixelScaling(2.0, 2.0)
    at = true_offset(frame) + np.stack(np.mgrid[:224, :224][::-1])
    doubled = scaling.pixels(np.moveaxis(at, 0, -1)).repeat(2, 0).repeat(2, 1)
    twice = labelled_by_centres(
        heights, frame, scaling, np.moveaxis(doubled, -1, 0) - np.stack([u, v])
    )
    for a, b in zip(*(np.sort(found.centres, axis=0) for found in (once, twice))):
        np.testing.assert_allclose(a, b, atol=0.002)


def test_centres_are_where_enough_votes_meet() -> None:
    rng = np.random.default_rng(0)
    meant = np.array([[30.0, 20.0], [60.0, 44.0]])
    votes = np.concatenate([centre + rng.normal(0, 1.0, (200, 2)) for centre in meant])
    astray = rng.uniform(0, 80, (30, 2))
    found = vote_centres(np.concatenate([votes, astray]), (80, 100))
    assert len(found) == 2
    np.testing.assert_allclose(found[np.argsort(found[:, 0])], meant, atol=1.0)


def test_votes_outside_the_image_count_at_its_rim() -> None:
    assert vote_centres(np.full((100, 2), (-7.0, 300.0)), (80, 100)).tolist() == [[0.0, 79.0]]


@pytest.mark.parametrize("boxes", [[], TOUCHING])
def test_where_nothing_is_agreed_on_the_map_stays_as_it_is(boxes) -> None:
    frame = boxes_frame(boxes)
    heights = height_map_from_frame(frame, Workspace())
    scattered = np.random.default_rng(0).uniform(-100, 100, (2, 224, 224))
    found = labelled_by_centres(heights, frame, PixelScaling(1.0, 1.0), scattered)
    assert found is heights
