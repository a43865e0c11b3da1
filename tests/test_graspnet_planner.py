"""The planner with networks whose opinion is known, on boxes whose exact grasps are known."""

import numpy as np
import pytest
import torch

from models.graspnet_io import SavedGraspNet
from models.planner_graspnet import GraspNetPlanner, quality_between
from tests.helpers.box_frames import boxes_frame
from tests.test_instances import TOUCHING, true_offset
from utils.geometry import GripperGeometry, Workspace
from utils.transforms import RGBDFrame, angle_difference, project

METRES_PER_PIXEL = 0.0018
BOXES = [((0.04, 0.10, 0.05), np.deg2rad(25), (0.45, y)) for y in (-0.1, 0.1)]


class Opinion(torch.nn.Module):
    """A network that says the same of every image of a size: quality `best` in a disc around one
    pixel and `elsewhere` otherwise."""

    input_channels, num_angle_bins, centre_head = 4, 18, None

    def __init__(self, pixel=(0.0, 0.0), best=0.9, elsewhere=0.0, radius=12):
        super().__init__()
        self.pixel, self.best, self.elsewhere, self.radius = pixel, best, elsewhere, radius
        self.device = torch.nn.Parameter(torch.zeros(1))  # parameters tell where a network is

    def forward(self, image, centres=False):
        height, width = image.shape[-2:]
        v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        near = (u - self.pixel[0]) ** 2 + (v - self.pixel[1]) ** 2 < self.radius**2
        quality = torch.where(near, self.best, self.elsewhere)[None, None]
        return quality, torch.zeros(1, 18, height, width), torch.full_like(quality, 0.05)


def plan(frame: RGBDFrame, network: torch.nn.Module):
    # As many metres to a pixel as the frame has, so that no image is scaled.
    scale = float(np.median(frame.depth)) / frame.K[0, 0]
    saved = SavedGraspNet(network, scale, {}, {})
    return GraspNetPlanner(GripperGeometry(), Workspace(), network=saved)(frame)


@pytest.mark.parametrize("chosen", [0, 1])
def test_the_network_chooses_between_boxes_that_fit_alike(chosen: int) -> None:
    frame = boxes_frame(BOXES)
    middle = np.array([*BOXES[chosen][2], 0.05])
    pixel, _ = project(middle, frame.K, frame.T_WC)
    best = plan(frame, Opinion(pixel))[0]
    assert np.linalg.norm(best.position[:2] - middle[:2]) < 0.004
    assert np.rad2deg(angle_difference(best.angle, np.deg2rad(25))) < 6
    assert 0.04 < best.width <= 0.08


def test_a_network_without_hope_leaves_the_choice_to_the_geometry() -> None:
    found = plan(boxes_frame(BOXES), Opinion(elsewhere=0.0, best=0.0))
    assert len(found) >= 2
    assert {round(abs(grasp.position[1]), 1) for grasp in found} == {0.1}


def test_quality_is_a_factor_on_the_measured_score() -> None:
    frame = boxes_frame(BOXES[:1])
    (full, half) = (plan(frame, Opinion(elsewhere=q, best=q)) for q in (0.8, 0.4))
    assert [g.quality for g in full] == pytest.approx([2 * g.quality for g in half])


def test_an_image_at_twice_the_resolution_gives_the_same_grasp() -> None:
    frame = boxes_frame(BOXES[:1])
    zoom = np.diag([2.0, 2.0, 1.0])
    zoom[:2, 2] = 0.5
    large = RGBDFrame(
        frame.rgb.repeat(2, 0).repeat(2, 1),
        frame.depth.repeat(2, 0).repeat(2, 1),
        zoom @ frame.K,
        frame.T_WC,
    )
    scale = float(np.median(frame.depth)) / frame.K[0, 0]
    middle, _ = project(np.array([0.45, -0.1, 0.05]), frame.K, frame.T_WC)
    planner = GraspNetPlanner(
        GripperGeometry(), Workspace(), network=SavedGraspNet(Opinion(middle), scale, {}, {})
    )
    small_best, large_best = planner(frame)[0], planner(large)[0]
    np.testing.assert_allclose(small_best.position, large_best.position, atol=0.004)
    assert small_best.quality == pytest.approx(large_best.quality, abs=0.1)


def test_quality_between_two_pixels_is_that_of_their_angle() -> None:
    """Bins 4 (40 degrees) and 5 hold 8/9 and 1/9: qualities in the ratio of 2 to 1."""
    probability = torch.full((18,), 1e-12)
    probability[4], probability[5] = 8 / 9, 1 / 9
    angle = probability.log()[None, :, None, None].expand(1, 18, 40, 60)
    maps = (torch.full((1, 1, 40, 60), 0.6), angle, torch.zeros(1, 1, 40, 60))
    for degrees, expected in ((40, 0.6), (220, 0.6), (50, 0.3), (45, 0.45), (100, 0.0)):
        step = 5 * np.array([[np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))]])
        middle = np.array([[30.0, 20.0]])
        found = quality_between(maps, middle - step, middle + step)
        assert found == pytest.approx([expected], abs=1e-3)


class KnowsCentres(Opinion):
    """An opinion that is the same everywhere, and a centre head that says `offset` (2, H, W)."""

    def __init__(self, offset: np.ndarray):
        super().__init__(best=0.9, elsewhere=0.9)
        self.offset, self.centre_head = torch.from_numpy(offset)[None], True

    def forward(self, image, centres=False):
        maps = super().forward(image)
        return (*maps, self.offset) if centres else maps


def test_two_things_that_touch_are_not_grasped_as_one() -> None:
    """Blocks side by side, a piece of 4 cm x 6 cm by height alone: the best grasp of it is in the
    middle, half on one and half on the other."""
    frame = boxes_frame(TOUCHING)
    as_one = plan(frame, Opinion(best=0.9, elsewhere=0.9))[0]
    found = plan(frame, KnowsCentres(true_offset(frame)))
    assert abs(as_one.position[1]) < 0.004, "otherwise this test shows nothing"
    assert abs(abs(found[0].position[1]) - 0.015) < 0.004
    for grasp in (g for g in found if g.quality > 0.3 * found[0].quality):
        assert np.rad2deg(angle_difference(grasp.angle, 0.0)) < 20, "along the line of contact"
