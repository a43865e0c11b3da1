"""Photographs as frames: a box on a table seen from the side, whose geometry is known exactly."""

import numpy as np
import pytest

from models import photographs
from models.graspnet_io import SavedGraspNet
from models.photographs import HAND, SHRUNK, WORKSPACE, frame_of, judge_photographs
from models.planner_graspnet import GraspNetPlanner
from tests.helpers.fixed_maps import FixedMaps
from tests.helpers.photographs import BOX, T_WC, photographed
from tests.helpers.real_images import write_cornell
from utils.errors import UserError
from utils.rectangles import GraspRectangle
from utils.transforms import Grasp, RGBDFrame, project

METRES_PER_PIXEL = 0.0018

# --- Grasps and rectangles -------------------------------------------------------------------


def test_a_rectangle_is_the_projected_opening():
    _, frame = photographed()
    across = photographs.rectangle_of(Grasp(np.zeros(3), 0.0, 0.08, 1.0), frame)
    away = np.linalg.norm(T_WC[:3, 3])
    assert across.centre == pytest.approx((319.5, 239.5))
    assert (across.angle, across.width) == pytest.approx((0.0, 525 * 0.08 / away))
    assert across.height == across.width / 2
    along = photographs.rectangle_of(Grasp(np.zeros(3), np.pi / 2, 0.08, 1.0), frame)
    assert along.angle == pytest.approx(np.pi / 2)
    # Foreshortened by the sine of the camera's elevation.
    assert along.width == pytest.approx(525 * 0.08 / away * 0.73 / away, rel=0.01)


def test_a_shrunk_world_looks_the_same():
    sample, _ = photographed()
    whole, small = frame_of(sample, 1.0), frame_of(sample, 2.0)
    point = np.array([0.03, -0.05, 0.04])
    at, far = project(point, whole.K, whole.T_WC)
    there, near = project(point / 2, small.K, small.T_WC)
    assert at == pytest.approx(there) and far == pytest.approx(2 * near)
    np.testing.assert_allclose(whole.depth, 2 * small.depth, rtol=1e-6)


def truth(sample_frame: RGBDFrame, grasp: Grasp) -> tuple[GraspRectangle, ...]:
    return (photographs.rectangle_of(grasp, sample_frame),)


def test_the_heuristic_grasps_a_photographed_box_across():
    _, frame = photographed()
    label = truth(frame, Grasp(np.array([0.0, 0.0, BOX[2]]), 0.0, 0.09, 1.0))
    sample, _ = photographed(noise=0.001, labels=label)
    (found,) = judge_photographs("heuristic", [sample], seed=0)
    assert found.correct and found.iou > 0.5
    assert np.degrees(found.angle_error) < 5


def test_nothing_on_the_table_is_nothing_to_grasp():
    sample, _ = photographed(box=None)
    assert judge_photographs("heuristic", [sample], seed=0) == [None]


def test_a_network_s_best_pixel_becomes_a_grasp_of_the_photograph():
    sample, frame = photographed()
    middle = 8 * round(0.30 / METRES_PER_PIXEL / 8) / 2 - 0.5
    # 27 pixels of 1.8 mm to the right of the middle; 0.8 m away, where the table is.
    network = FixedMaps((middle + 27.5, middle - 0.5), radius=0.1)
    grasp = photographs.network_grasp(
        SavedGraspNet(network, METRES_PER_PIXEL, {}, {}), frame_of(sample)
    )
    right = 27.5 * METRES_PER_PIXEL
    assert grasp.position == pytest.approx((right, 0.5 * METRES_PER_PIXEL, 0.0), abs=2e-3)
    assert (grasp.angle, grasp.width) == pytest.approx((0.0, 0.05))
    rectangle = photographs.rectangle_of(grasp, frame_of(sample))
    (true,) = truth(frame, Grasp(SHRUNK * grasp.position, 0.0, SHRUNK * 0.05, 1.0))
    assert rectangle.centre == pytest.approx(true.centre, abs=1.0)
    assert rectangle.width == pytest.approx(true.width, rel=0.01)


def test_the_hand_opens_as_wide_as_the_tutorial_s_network_can_tell():
    assert SHRUNK * HAND.max_opening == pytest.approx(0.15)


def test_as_taken_a_network_s_best_pixel_lies_on_the_photograph_s_own_grid(monkeypatch):
    """Of the middle 400 pixels of a photograph, each 1.2 m / 525 wide, a network of 2 mm a pixel
    sees 8 round(400 * 1.2 / 525 / 0.002 / 8) = 456."""
    label = GraspRectangle(np.array([320.0, 240.0]), 0.0, 40.0, 20.0)
    sample, _ = photographed(labels=(label,))
    network = SavedGraspNet(FixedMaps((285, 227), radius=0.5), 0.002, {}, {})
    monkeypatch.setattr(
        photographs,
        "make_planner",
        lambda *_: GraspNetPlanner(HAND, WORKSPACE, network=network),
    )
    (found,) = photographs.judge_as_taken("network.pt", [sample], seed=0)
    right, down = 400 / 456 * (np.array([285, 227]) - 455 / 2)
    assert found.rectangle.centre == pytest.approx((319.5 + right, 239.5 + down), abs=1e-3)
    assert found.rectangle.width == pytest.approx(0.05 / (1.2 / 525), rel=0.01)
    assert found.rectangle.height == pytest.approx(found.rectangle.width / 2)


def test_a_planner_that_cannot_see_photographs_is_not_judged_by_them():
    sample, _ = photographed()
    assert judge_photographs("oracle", [sample], seed=0) is None
    assert judge_photographs("heuristic", [], seed=0) == []
    assert photographs.judge_as_taken("heuristic", [sample], seed=0) is None


def test_images_of_another_size_are_refused(tmp_path):
    with pytest.raises(UserError, match="640 x 480"):
        photographs.photographs(write_cornell(tmp_path, 1))
