"""GraspNet's planner with networks whose maps are known, and the votes of a centre head, on boxes
whose exact grasps and centres of mass are known."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from models import graspnet_objects
from models.graspnet_io import SavedGraspNet
from models.graspnet_objects import VoteSettings, labelled_by_centres, vote_centres
from models.graspnet_view import CROP_MARGIN, around_matter, quality_between
from models.planner_graspnet import (
    GraspNetDirectPlanner,
    GraspNetFanPlanner,
    GraspNetPlanner,
)
from tests.helpers.box_frames import boxes_frame
from tests.helpers.fixed_maps import FixedMaps
from utils.geometry import GripperGeometry, Workspace
from utils.height_map import height_map_from_frame
from utils.images import PixelScaling
from utils.transforms import RGBDFrame, angle_difference, look_at, project

CELL = 0.002  # m
SAME = PixelScaling(1.0, 1.0)
# Two boxes of one height, side by side without a gap: one piece to a depth image.
TOUCHING = [((0.04, 0.03, 0.05), 0.0, (0.50, 0.015)), ((0.04, 0.03, 0.05), 0.0, (0.50, -0.015))]
BOXES = [((0.04, 0.10, 0.05), np.deg2rad(25), (0.45, y)) for y in (-0.1, 0.1)]


def plan(frame: RGBDFrame, network: torch.nn.Module, planner: type = GraspNetPlanner):
    # As many metres to a pixel as the frame has, so that no image is scaled.
    scale = float(np.median(frame.depth)) / frame.K[0, 0]
    saved = SavedGraspNet(network, scale, {}, {})
    return planner(GripperGeometry(), Workspace(), network=saved)(frame)


def looked_at(boxes) -> RGBDFrame:
    """The part of a frame that planners look at, whose pixels are those of a network's maps."""
    return around_matter(boxes_frame(boxes), Workspace().table_height)


@pytest.mark.parametrize("chosen", [0, 1])
def test_the_network_chooses_between_boxes_that_fit_alike(chosen: int) -> None:
    frame = looked_at(BOXES)
    middle = np.array([*BOXES[chosen][2], 0.05])
    pixel, _ = project(middle, frame.K, frame.T_WC)
    best = plan(frame, FixedMaps(pixel))[0]
    assert np.linalg.norm(best.position[:2] - middle[:2]) < 0.004
    assert np.rad2deg(angle_difference(best.angle, np.deg2rad(25))) < 6
    assert 0.04 < best.width <= 0.08


def test_a_network_that_sees_no_grasp_leaves_the_choice_to_the_geometry() -> None:
    found = plan(boxes_frame(BOXES), FixedMaps(elsewhere=0.0, best=0.0))
    assert len(found) >= 2
    assert {round(abs(grasp.position[1]), 1) for grasp in found} == {0.1}


def test_quality_is_a_factor_on_the_measured_score() -> None:
    frame = boxes_frame(BOXES[:1])
    (full, half) = (plan(frame, FixedMaps(elsewhere=q, best=q)) for q in (0.8, 0.4))
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
        GripperGeometry(), Workspace(), network=SavedGraspNet(FixedMaps(middle), scale, {}, {})
    )
    small_best, large_best = planner(frame)[0], planner(large)[0]
    np.testing.assert_allclose(small_best.position, large_best.position, atol=0.004)
    assert small_best.quality == pytest.approx(large_best.quality, abs=0.1)


def test_quality_between_two_pixels_is_that_of_their_angle() -> None:
    """Bins 4 (40 degrees) and 5 hold 8/9 and 1/9: qualities in the ratio of 2 to 1."""
    probability = torch.full((18,), 1e-12)
    probability[4], probability[5] = 8 / 9, 1 / 9
    angle = probability.log()[None, :, None, None].expand(1, 18, 40, 60)
    quality = np.full((40, 60), 0.6)
    for degrees, expected in ((40, 0.6), (220, 0.6), (50, 0.3), (45, 0.45), (100, 0.0)):
        step = 5 * np.array([[np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))]])
        middle = np.array([[30.0, 20.0]])
        found = quality_between(quality, angle, middle - step, middle + step)
        assert found == pytest.approx([expected], abs=1e-3)


@pytest.mark.filterwarnings("error")
def test_what_the_camera_cannot_see_has_no_quality() -> None:
    """Pixels of points behind the camera are NaN (`project`)."""
    quality, angle = np.ones((40, 60)), torch.zeros(1, 18, 40, 60)
    start, end = np.array([[25.0, 20.0], [np.nan, np.nan]]), np.array([[35.0, 20.0], [30.0, 9.0]])
    assert quality_between(quality, angle, start, end) == pytest.approx([1.0, 0.0])


class FixedCentres(FixedMaps):
    """A network with one quality everywhere, and a centre head that returns `offset` (2, H, W)."""

    def __init__(self, offset: np.ndarray):
        super().__init__(best=0.9, elsewhere=0.9)
        self.offset, self.centre_head = torch.from_numpy(offset)[None], True

    def forward(self, image, centres=False):
        maps = super().forward(image)
        return (*maps, self.offset) if centres else maps


def test_two_objects_that_touch_are_not_grasped_as_one() -> None:
    """Blocks side by side, a piece of 4 cm x 6 cm by height alone: the best grasp of it is in the
    middle, half on one and half on the other."""
    frame = looked_at(TOUCHING)
    as_one = plan(frame, FixedMaps(best=0.9, elsewhere=0.9))[0]
    found = plan(frame, FixedCentres(true_offset(frame)))
    assert abs(as_one.position[1]) < 0.004, "otherwise this test shows nothing"
    assert abs(abs(found[0].position[1]) - 0.015) < 0.004
    for grasp in (g for g in found if g.quality > 0.3 * found[0].quality):
        assert np.rad2deg(angle_difference(grasp.angle, 0.0)) < 20, "along the line of contact"


def test_a_peak_between_votes_that_are_far_from_it_is_no_centre() -> None:
    """Two groups of votes, 12 pixels apart: with a wide blur they have one peak between them, from
    which each is 6 pixels away."""
    votes = np.repeat([[50.0, 50.0], [62.0, 50.0]], 200, axis=0)
    found = vote_centres(votes, (100, 120), CELL, VoteSettings(blur=9.0, apart=5))
    assert np.isfinite(found).all()
    assert len(found) == 0


# --- The network's own peaks ---------------------------------------------------------------


@pytest.mark.parametrize("chosen", [0, 1])
def test_without_a_search_the_peak_is_the_grasp(chosen: int) -> None:
    """Where the network sees one grasp, there is no other, whatever else would fit."""
    frame = boxes_frame(BOXES)
    middle = np.array([*BOXES[chosen][2], 0.05])
    seen = around_matter(frame, 0.0)
    peak, _ = project(middle + [0.004, 0, 0], seen.K, seen.T_WC)
    found = plan(frame, FixedMaps(peak, elsewhere=0.0), GraspNetDirectPlanner)
    best = found[0]
    assert all(abs(grasp.position[1] - middle[1]) < 0.05 for grasp in found)
    # Centred between the faces and turned onto them, although the peak was beside the middle.
    closing = np.array([np.cos(best.angle), np.sin(best.angle)])
    assert abs((best.position[:2] - middle[:2]) @ closing) < 0.002
    assert np.rad2deg(angle_difference(best.angle, np.deg2rad(25))) < 3
    assert 0.04 < best.width <= 0.08


@pytest.mark.parametrize("kind", [GraspNetPlanner, GraspNetDirectPlanner, GraspNetFanPlanner])
@pytest.mark.parametrize("unknown", [0.0, np.nan, np.inf])
def test_a_frame_without_any_depth_shows_nothing_to_grasp(kind, unknown: float) -> None:
    frame = boxes_frame(BOXES)
    blank = replace(frame, depth=np.full_like(frame.depth, unknown))
    assert kind(GripperGeometry(), Workspace())(blank) == []


def test_a_network_that_sees_no_grasp_plans_none_without_a_search() -> None:
    frame = boxes_frame(BOXES)
    assert plan(frame, FixedMaps(elsewhere=0.0, best=0.0), GraspNetDirectPlanner) == []


def test_no_peak_farther_than_4_cm_beside_the_workspace_is_a_grasp() -> None:
    """The shipped network sees both cubes; the second is 10 cm outside."""
    cubes = [((0.05, 0.05, 0.05), 0.0, (0.5, y)) for y in (0.0, 0.25)]
    found = GraspNetDirectPlanner(GripperGeometry(), Workspace())(boxes_frame(cubes, focal=200))
    assert found and max(abs(grasp.position[1]) for grasp in found) < 0.19


def test_a_network_that_sees_grasps_where_no_object_is_plans_none() -> None:
    """An empty table, to a network that sees a grasp in its middle."""
    middle = np.array([111.5, 111.5])
    for kind in (GraspNetPlanner, GraspNetDirectPlanner):
        assert plan(boxes_frame([]), FixedMaps(middle, elsewhere=0.0), kind) == []


def test_what_is_cut_off_is_table() -> None:
    frame = boxes_frame(BOXES[:1])
    part = around_matter(frame, 0.0)
    shift = np.rint(frame.K[:2, 2] - part.K[:2, 2]).astype(int)
    window = np.s_[
        shift[1] : shift[1] + part.depth.shape[0], shift[0] : shift[0] + part.depth.shape[1]
    ]
    np.testing.assert_allclose(part.points(), frame.points()[window], atol=1e-9)
    outside = np.ones(frame.depth.shape, bool)
    outside[window] = False
    assert np.abs(frame.points()[outside][:, 2]).max() < 1e-6
    # The box, 4 cm x 10 cm and turned by 25 degrees, with a margin on all sides; its upper rim,
    # 5 cm nearer to the camera, looks larger by a little.
    c, s = np.cos(np.deg2rad(25)), np.sin(np.deg2rad(25))
    sides = np.array([0.04 * c + 0.10 * s, 0.04 * s + 0.10 * c]) + 2 * CROP_MARGIN
    across = np.ptp(part.points().reshape(-1, 3)[:, :2], axis=0)
    np.testing.assert_allclose(across, sides, atol=0.015)


def test_a_rod_two_pixels_thick_is_not_cut_off() -> None:
    """3 mm where a pixel spans 1.8 mm; it ends 12 cm from the box beside it."""
    rod = ((0.12, 0.003, 0.02), 0.0, (0.56, -0.08))
    part = around_matter(boxes_frame([BOXES[1], rod]), 0.0)
    points = part.points().reshape(-1, 3)
    seen = points[points[:, 2] > 0.01]
    assert seen[:, 0].max() == pytest.approx(0.62, abs=0.003)


def test_single_pixels_are_noise() -> None:
    frame = boxes_frame(BOXES)
    depth = frame.depth.copy()
    depth[3:6, 3:5] -= 0.05
    noisy = around_matter(replace(frame, depth=depth), 0.0)
    assert noisy.depth.shape == around_matter(frame, 0.0).depth.shape


def test_an_empty_table_stays_whole() -> None:
    frame = boxes_frame([])
    assert around_matter(frame, 0.0) is frame


@pytest.mark.parametrize("unknown", [0.0, np.nan])
def test_what_was_not_measured_is_not_cut_off(unknown: float) -> None:
    """A black box has no depth: it may stand there."""
    frame = boxes_frame(BOXES)
    depth = frame.depth.copy()
    black = (frame.points()[..., 1] > 0.0) & (frame.points()[..., 2] > 0.001)
    depth[black] = unknown
    part = around_matter(replace(frame, depth=depth), 0.0)
    assert part.depth.shape == around_matter(frame, 0.0).depth.shape


# --- Votes for centres of mass -----------------------------------------------------------


def true_offset(frame: RGBDFrame) -> np.ndarray:
    """(2, H, W) of a perfect centre head: a pixel belongs to the box on its side of y = 0."""
    centres = np.array([item.centre_of_mass for item in frame.truth.objects])
    centres, _ = project(centres, frame.K, frame.T_WC)
    v, u = np.mgrid[: frame.depth.shape[0], : frame.depth.shape[1]]
    side = (frame.points()[..., 1] < 0).astype(int)
    return np.moveaxis(centres[side], -1, 0) - np.stack([u, v])


def centres_by_place(heights, frame: RGBDFrame) -> np.ndarray:
    """(M, 3) the centre that the height map gives to what lies at each true centre."""
    true = np.array([item.centre_of_mass for item in frame.truth.objects])
    return heights.centres[heights.label[heights.index(true[:, :2])]]


def test_boxes_that_touch_are_told_apart() -> None:
    frame = boxes_frame(TOUCHING)
    heights = height_map_from_frame(frame, Workspace())
    assert heights.label.max() == 0, "one piece by height alone"
    found = labelled_by_centres(heights, frame, SAME, true_offset(frame))
    for item, centre in zip(frame.truth.objects, centres_by_place(found, frame)):
        np.testing.assert_allclose(centre, item.centre_of_mass, atol=0.002)
    assert set(np.unique(found.label)) == {-1, 0, 1}
    assert ((found.label >= 0) == (heights.label >= 0)).all()
    assert found.height is heights.height and found.ceiling is heights.ceiling


def test_centres_rise_with_the_table() -> None:
    """The same image 10 cm higher in the world."""
    frame = boxes_frame(TOUCHING)
    T_WC = frame.T_WC.copy()
    T_WC[2, 3] += 0.1
    centres = [
        labelled_by_centres(
            height_map_from_frame(seen, table), seen, SAME, true_offset(frame)
        ).centres
        for seen, table in (
            (frame, Workspace()),
            (replace(frame, T_WC=T_WC), Workspace(table_height=0.1)),
        )
    ]
    np.testing.assert_allclose(centres[1] - centres[0], [(0, 0, 0.1)] * len(centres[0]), atol=1e-6)


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


def test_what_the_image_cuts_off_is_one_object_with_what_it_shows() -> None:
    """12 cm of a box, of which the image shows 5. Its pixels at the border name a place of their
    own each: too little surface for a centre, unless what goes on beyond the border votes, too."""
    frame = boxes_frame([((0.10, 0.12, 0.05), 0.0, (0.5, 0.15))], focal=600)
    heights = height_map_from_frame(frame, Workspace())
    centre, _ = project([[0.5, 0.15, 0.025]], frame.K, frame.T_WC)
    v, u = np.mgrid[:224, :224]
    offset = centre.reshape(2, 1, 1) - np.stack([u, v])
    offset[:, :, 0] = (
        np.random.default_rng(0).uniform(60, 180, (2, 224)) - np.stack([u, v])[:, :, 0]
    )
    found = labelled_by_centres(heights, frame, SAME, offset)
    matter = heights.label >= 0
    assert matter.sum() * heights.cell**2 > 0.10 * 0.12
    assert len(found.centres) == 2  # and what votes for no place
    np.testing.assert_allclose(found.centres[0], [0.5, 0.15, 0.025], atol=0.002)


def three_votes(frame: RGBDFrame) -> np.ndarray:
    """(2, H, W) of a head that takes a beam along y for three objects, as it does where they are
    larger than what it learned from: votes for three places, and some between them."""
    v, u = np.mgrid[:224, :224]
    along = frame.points()[..., 1]
    voted = np.interp(along, (-0.06, -0.02, 0.02, 0.06), (-0.045, 0.0, 0.0, 0.045))
    places, _ = project(
        np.stack([np.full(along.shape, 0.5), voted, np.full(along.shape, 0.02)], axis=-1),
        frame.K,
        frame.T_WC,
    )
    return np.moveaxis(places, -1, 0) - np.stack([u, v])


def test_a_long_beam_is_one_object_unless_it_has_several_colours() -> None:
    """2 x 24 x 4 cm; the middle third may be red."""
    frame = boxes_frame([((0.02, 0.24, 0.04), 0.0, (0.5, 0.0))])
    heights = height_map_from_frame(frame, Workspace())
    found = labelled_by_centres(heights, frame, SAME, three_votes(frame))
    labels = found.label[found.label >= 0]
    assert len(set(labels)) == 1
    np.testing.assert_allclose(found.centres[labels[0]], [0.5, 0.0, 0.02], atol=0.002)
    rgb = frame.rgb.copy()
    rgb[np.abs(frame.points()[..., 1]) < 0.04] = (200, 30, 30)
    found = labelled_by_centres(heights, replace(frame, rgb=rgb), SAME, three_votes(frame))
    assert len(set(found.label[found.label >= 0])) == 3


def test_hidden_cells_join_nothing() -> None:
    """The same beam; nothing was seen of it around the places where one part meets another."""
    frame = boxes_frame([((0.02, 0.24, 0.04), 0.0, (0.5, 0.0))])
    heights = height_map_from_frame(frame, Workspace())
    along = heights.origin[1] + heights.cell * np.arange(len(heights.height))
    ceiling = heights.ceiling.copy()
    ceiling[(np.abs(along) > 0.03) & (np.abs(along) < 0.055)] += 0.05
    found = labelled_by_centres(replace(heights, ceiling=ceiling), frame, SAME, three_votes(frame))
    assert ((found.label >= 0) == (heights.label >= 0)).all()
    middle, one, other = (found.label[found.index(np.array([0.5, y]))] for y in (0.0, -0.1, 0.1))
    assert len({middle, one, other}) == 3


def test_a_joined_object_rests_on_what_it_lies_on() -> None:
    """The same beam, of which the lower half is a fixture."""
    frame = boxes_frame([((0.02, 0.24, 0.04), 0.0, (0.5, 0.0))])
    heights = height_map_from_frame(frame, Workspace())
    heights = replace(heights, fixed=np.full(heights.height.shape, 0.02, np.float32))
    found = labelled_by_centres(heights, frame, SAME, three_votes(frame))
    np.testing.assert_allclose(found.centres, [[0.5, 0.0, 0.03]], atol=0.002)


def test_what_is_left_at_the_far_ends_of_two_objects_joins_them_no_more_than_they_touch() -> None:
    """Two boxes of 1.2 x 10 x 4 cm end to end. Their ends vote ever farther out, for nothing: each
    end is its own box's, and where the boxes touch their votes are 10 cm apart."""
    boxes = [((0.012, 0.10, 0.04), 0.0, (0.5, y)) for y in (-0.05, 0.05)]
    frame = boxes_frame(boxes)
    heights = height_map_from_frame(frame, Workspace())
    v, u = np.mgrid[:224, :224]
    along = frame.points()[..., 1]
    voted = np.sign(along) * (0.05 + 3 * np.maximum(np.abs(along) - 0.05, 0.0))
    places = np.stack([np.full(along.shape, 0.5), voted, np.full(along.shape, 0.02)], axis=-1)
    places, _ = project(places, frame.K, frame.T_WC)
    offset = np.moveaxis(places, -1, 0) - np.stack([u, v])
    found = labelled_by_centres(heights, frame, SAME, offset)
    assert set(found.label[found.label >= 0]) == {0, 1}
    for item, centre in zip(frame.truth.objects, centres_by_place(found, frame)):
        np.testing.assert_allclose(centre, item.centre_of_mass, atol=0.003)


def test_what_lies_behind_the_first_camera_casts_no_votes() -> None:
    """A low camera looks along the table from its middle; the second one sees a box behind it."""
    boxes = [TOUCHING[0], ((0.04, 0.04, 0.05), 0.0, (0.40, 0.0))]
    first = boxes_frame(boxes, T_WC=look_at((0.45, 0.0, 0.1), (1.5, 0.0, 0.0), (0, 0, 1)))
    second = boxes_frame(boxes)
    frame = replace(first, second=second)
    heights = height_map_from_frame(frame, Workspace())
    found = labelled_by_centres(heights, frame, SAME, np.zeros((2, 224, 224)))
    assert ((found.label >= 0) == (heights.label >= 0)).all()
    near, behind = (found.label[found.index(np.array(box[2]))] for box in boxes)
    assert near >= 0 and behind >= 0 and near != behind


def test_a_piece_without_common_votes_keeps_the_height_maps_label() -> None:
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
    for item, centre in zip(frame.truth.objects, centres_by_place(found, frame)):
        assert centre[2] == pytest.approx(item.centre_of_mass[2], abs=0.003)


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
def test_scattered_votes_leave_the_map_as_it_is(boxes) -> None:
    frame = boxes_frame(boxes)
    heights = height_map_from_frame(frame, Workspace())
    scattered = np.random.default_rng(0).uniform(-100, 100, (2, 224, 224))
    assert labelled_by_centres(heights, frame, SAME, scattered) is heights


@given(st.integers(0, 2**32 - 1), st.integers(1, 6))
@settings(max_examples=30, deadline=None)
def test_votes_go_to_the_nearest_centre_in_reach(seed: int, count: int) -> None:
    random = np.random.default_rng(seed)
    votes, centres = random.uniform(0, 100, (200, 2)), random.uniform(0, 100, (count, 2))
    miss, nearest = cKDTree(centres).query(votes)
    found = graspnet_objects._nearest(votes, centres, 12.0)
    np.testing.assert_array_equal(found, np.where(miss < 12, nearest, -1))
