"""GraspNet on any camera's image: every resolution gives the same metric grasps."""

from __future__ import annotations

import numpy as np
import pytest

from envs.cell import Intrinsics
from models import graspnet_inference
from models.graspnet_io import metres_per_pixel
from tests.helpers.hand_made import CUBES, FOCAL, OVERHEAD, PIXEL, cell_of_cubes, hand_made
from utils.geometry import GripperGeometry
from utils.images import PixelScaling
from utils.transforms import RGBDFrame, angle_difference, grasp_to_image, look_at

HAND = GripperGeometry()


@pytest.fixture(scope="module")
def cell(config, box_set):
    with cell_of_cubes(config, box_set) as cell:
        yield cell


def sorted_by_place(grasps):
    return sorted(grasps, key=lambda grasp: grasp.in_world.position[0])


def check_on_cubes(grasps, tolerance: float) -> None:
    assert len(grasps) == len(CUBES)
    for grasp, (xy, yaw) in zip(sorted_by_place(grasps), CUBES.items()):
        position = grasp.in_world.position
        np.testing.assert_allclose(position[:2], xy, atol=tolerance)
        # 2 cm below the top of 6 cm, and E above the lowest point of the fingertips.
        assert position[2] == pytest.approx(0.04 + 0.0072, abs=0.002)
        wrong = min(angle_difference(grasp.in_world.angle, yaw + k * np.pi / 2) for k in (0, 1))
        assert np.rad2deg(wrong) < 3


def test_resolutions_and_aspect_ratios_give_the_same_metric_grasps(cell):
    model, found = hand_made(), []
    for width, height in ((224, 224), (640, 480), (320, 240)):
        frame = cell.look(Intrinsics(width, height, 28), OVERHEAD)
        result = graspnet_inference.predict(model, PIXEL, frame, 0.0, HAND)
        check_on_cubes(result.grasps, 0.0015)
        assert result.quality.shape == result.angle.shape == result.width.shape == (height, width)
        for grasp in result.grasps:  # the maps lie where the grasps do
            u, v = np.rint(grasp.on_image.pixel).astype(int)
            assert result.quality[v, u] == pytest.approx(grasp.on_image.quality, abs=0.03)
            assert result.width[v, u] == pytest.approx(grasp.on_image.width, abs=0.001)
            assert angle_difference(result.angle[v, u], grasp.on_image.angle) < np.radians(8)
        found.append(sorted_by_place(result.grasps))
    for other in found[1:]:
        for ours, theirs in zip(found[0], other):
            np.testing.assert_allclose(ours.in_world.position, theirs.in_world.position, atol=0.001)
            assert angle_difference(ours.in_world.angle, theirs.in_world.angle) < np.radians(1.5)
            assert ours.in_world.width == pytest.approx(theirs.in_world.width, abs=0.0005)


def test_another_distance_and_focal_length_give_the_same_metric_grasps(cell):
    farther = look_at((0.5, 0.0, 1.3), (0.5, 0.0, 0.0), (1.0, 0.0, 0.0))
    frame = cell.look(Intrinsics(400, 300, 20), farther)
    check_on_cubes(graspnet_inference.predict(hand_made(), PIXEL, frame, 0.0, HAND).grasps, 0.002)


@pytest.mark.parametrize("unknown", [0.0, -1.0, np.inf, np.nan])
def test_unknown_depth_has_no_part_in_the_scale(unknown):
    depth = np.full((64, 64), 0.8, np.float32)
    depth[:, :30] = 0.6
    depth[:60, 34:] = unknown  # infinite ones would make most of the image's depths
    frame = RGBDFrame(
        np.zeros((64, 64, 3), np.uint8), depth, np.diag([400.0, 400.0, 1.0]), OVERHEAD
    )
    scaling = graspnet_inference.training_scale(frame, 0.0015)
    assert (scaling.u, scaling.v) == pytest.approx((1.0, 1.0))  # 0.6 / 400 = 1.5 mm


def test_pixels_that_are_not_square(cell):
    square = cell.look(Intrinsics(320, 240, 28), OVERHEAD)
    wider = PixelScaling(1.25, 1.0)
    frame = RGBDFrame(
        wider.image(square.rgb), wider.image(square.depth), wider.intrinsics(square.K), OVERHEAD
    )
    assert frame.depth.shape == (240, 400)
    result = graspnet_inference.predict(hand_made(), PIXEL, frame, 0.0, HAND)
    check_on_cubes(result.grasps, 0.0015)
    for grasp in result.grasps:  # the angle is that of the picture as it is
        shown = grasp_to_image(grasp.in_world, frame.K, OVERHEAD)
        assert angle_difference(shown.angle, grasp.on_image.angle) < np.radians(1)


def test_metres_per_pixel():
    assert metres_per_pixel(np.diag([FOCAL, FOCAL, 1]), 0.8) == pytest.approx(PIXEL)
