"""GraspNet on any camera's image: every resolution gives the same metric peaks and grasps."""

from __future__ import annotations

import numpy as np
import pytest

from envs.cell import Intrinsics
from models import graspnet_inference
from models.graspnet import to_input
from models.graspnet_decoding import PeakSettings
from models.graspnet_io import SavedGraspNet, metres_per_pixel
from models.graspnet_view import NetworkView
from models.planner_graspnet import GraspNetPlanner
from tests.helpers.box_frames import boxes_frame
from tests.helpers.hand_made import CUBES, FOCAL, OVERHEAD, PIXEL, cell_of_cubes, hand_made
from utils.geometry import GripperGeometry, Workspace
from utils.images import PixelScaling
from utils.transforms import RGBDFrame, angle_difference, look_at


@pytest.fixture(scope="module")
def cell(config, box_set):
    with cell_of_cubes(config, box_set) as cell:
        yield cell


def check_on_cubes(frame: RGBDFrame, tolerance: float) -> None:
    """The network's peaks lie on the cubes' tops; the best grasp of each closes on its middle."""
    saved = SavedGraspNet(hand_made(), PIXEL, {}, {})
    seen = NetworkView(saved, frame, Workspace(), crop=True).peaks(PeakSettings())
    planner = GraspNetPlanner(GripperGeometry(), Workspace(), network=saved)
    grasps = planner(frame)
    assert len(seen) == len(CUBES)
    for xy, yaw in CUBES.items():
        peak = min(seen, key=lambda point: np.linalg.norm(point[:2] - xy))
        np.testing.assert_allclose(peak, (*xy, 0.06), atol=tolerance)
        grasp = next(g for g in grasps if np.linalg.norm(g.position[:2] - xy) < 0.01)
        off = grasp.position[:2] - xy  # along the face it may be a little off
        assert abs(off @ (np.cos(grasp.angle), np.sin(grasp.angle))) < 0.002
        wrong = min(angle_difference(grasp.angle, yaw + k * np.pi / 2) for k in (0, 1))
        assert np.rad2deg(wrong) < 4


@pytest.mark.parametrize("size", [(224, 224), (640, 480), (320, 240)])
def test_resolutions_and_aspect_ratios_give_the_same_metric_grasps(cell, size):
    check_on_cubes(cell.look(Intrinsics(*size, 28), OVERHEAD), 0.0015)


def test_another_distance_and_focal_length_give_the_same_metric_grasps(cell):
    farther = look_at((0.5, 0.0, 1.3), (0.5, 0.0, 0.0), (1.0, 0.0, 0.0))
    check_on_cubes(cell.look(Intrinsics(400, 300, 20), farther), 0.002)


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
    check_on_cubes(frame, 0.0015)


def test_metres_per_pixel():
    assert metres_per_pixel(np.diag([FOCAL, FOCAL, 1]), 0.8) == pytest.approx(PIXEL)


@pytest.mark.parametrize("slab", [None, (0.36, 0.36, 0.05)])
def test_the_table_enters_as_0_however_much_of_it_is_covered(slab, monkeypatch):
    """0.1 is 1 cm; a box of 8 cm on the table, alone or in a slab 5 cm high that fills more than
    half of the part that is looked at."""
    seen = []

    def recorded(*arguments):
        seen.append(to_input(*arguments))
        return seen[-1]

    monkeypatch.setattr(graspnet_inference, "to_input", recorded)
    boxes = [((0.04, 0.03, 0.08), 0.0, (0.5, 0.0))]
    frame = boxes_frame(boxes + ([] if slab is None else [(slab, 0.0, (0.5, 0.0))]))
    NetworkView(SavedGraspNet(hand_made(), PIXEL, {}, {}), frame, Workspace(), crop=True)
    heights = -seen[0][3]
    assert heights.min() == pytest.approx(0, abs=2e-3)
    assert heights.max() == pytest.approx(0.8, abs=2e-3)
    assert (heights.median() > 0.4) == (slab is not None)
