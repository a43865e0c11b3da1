"""What one frame, and what two frames of a scene, show and hide, on boxes of known shape."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from models.planners import make_planner
from tests.helpers.box_frames import BOX, boxes_frame, from_side, seen_from
from utils import seen_heights
from utils.geometry import GripperGeometry, Workspace
from utils.height_map import (
    HeightMap,
    height_map_from_frame,
    height_map_from_scene,
    tilted_height_map,
    tilted_view,
)
from utils.seen_heights import hides, sees_through, with_surroundings, without_holes
from utils.transforms import RGBDFrame, deproject, look_at, project


def map_along(frame: RGBDFrame, approach: np.ndarray) -> HeightMap:
    filled, hiding = without_holes(frame, Workspace())
    overhead = height_map_from_frame(frame, Workspace())
    return tilted_height_map(overhead, filled, hiding, tilted_view(approach, Workspace()))


def open_volume(heights: HeightMap) -> float:
    """cm3 between what was seen and what may be there."""
    return 1e6 * heights.cell**2 * float((heights.ceiling - heights.height).sum())


def test_a_box_seen_from_two_opposite_sides_casts_no_shadow() -> None:
    """The shadow of the box measures 700 cm3 by a sum over rays. Neither map takes any of it for
    more of the box, the lowest surface that is seen near by."""
    one, both = (height_map_from_frame(f, Workspace()) for f in (seen_from(0), seen_from(0, 180)))
    assert open_volume(one) == pytest.approx(700, rel=0.03)
    assert open_volume(both) < 0.08 * open_volume(one)
    exact = height_map_from_scene(seen_from(0).truth, Workspace(), cell=both.cell)
    rim = 2 * (0.06 + 0.08) / both.cell  # cells
    for seen in (one, both):
        assert (np.abs(seen.height - exact.height) > 0.003).sum() < rim


@pytest.mark.parametrize("height", [0.05, 0.10, 0.20])
def test_matter_may_reach_up_to_the_rays_that_graze_the_edge(height: float) -> None:
    """Behind the box, up to the plane through the camera and the box's far edge at x = 0.47 m, in
    every cell: there is no gap between the rays, however long the shadow is."""
    camera = from_side(0, distance=1.0)
    box = ((0.06, 0.08, height), 0.0, (0.5, 0.0))
    heights = height_map_from_frame(boxes_frame([box], T_WC=camera), Workspace())
    steep = (camera[2, 3] - height) / (camera[0, 3] - 0.47)
    x = heights.origin[0] + heights.cell * np.arange(heights.ceiling.shape[1])
    expected = height + (x - 0.47) * steep
    behind = (expected > 0.01) & (x < 0.466)
    assert behind.sum() >= 10
    ceiling = heights.ceiling[int(np.rint(-heights.origin[1] / heights.cell))]
    np.testing.assert_allclose(ceiling[behind], expected[behind], atol=0.004)


@pytest.mark.parametrize("pixel", [2, 5, 7])
def test_cells_are_full_where_a_pixel_is_wider_than_they_are(pixel: int) -> None:
    """A pixel of a few mm tells the heights of all cells of 2 mm that it covers."""
    frame = boxes_frame([BOX], focal=800.0 / pixel)  # seen from 0.8 m over the table
    heights = height_map_from_frame(frame, Workspace())
    exact = height_map_from_scene(frame.truth, Workspace(), cell=heights.cell)
    wrong = np.abs(heights.height - exact.height) > 0.01
    rims = 2 * (0.06 + 0.08) / heights.cell  # cells
    assert wrong.sum() < rims * pixel / 2


@pytest.mark.parametrize("azimuth", [0, 180])
def test_both_flanks_of_a_box_are_known_to_a_hand_that_comes_from_either_side(azimuth) -> None:
    turn, lean = np.deg2rad(azimuth), np.deg2rad(60)
    approach = np.array([-np.sin(lean) * np.cos(turn), -np.sin(lean) * np.sin(turn), -np.cos(lean)])
    one, both = (map_along(frame, approach) for frame in (seen_from(0), seen_from(0, 180)))
    exact = height_map_from_scene(seen_from(0).truth, Workspace(), both.cell, T_WV=both.T_WV)
    on_box = exact.label == 0
    error = np.abs(both.height - exact.height)[on_box]
    assert np.mean(error < 0.004) > 0.97
    assert np.mean((both.ceiling - both.height)[on_box] < 0.004) > 0.9
    if azimuth == 180:  # which the first frame alone does not see
        assert np.mean(np.abs(one.height - exact.height)[on_box] < 0.004) < 0.7


@pytest.mark.parametrize("seed", range(6))
def test_a_second_frame_never_denies_what_is_there(seed: int) -> None:
    rng = np.random.default_rng(seed)
    boxes = [
        (tuple(rng.uniform(0.02, (0.08, 0.08, 0.15))), rng.uniform(0, 3.1), place)
        for place in rng.uniform((0.4, -0.1), (0.6, 0.1), (rng.integers(1, 5), 2))
    ]
    azimuth, other = rng.uniform(0, 360, 2)
    frame = seen_from(azimuth, other, boxes=boxes)
    both = height_map_from_frame(frame, Workspace())
    blind = replace(frame.second, depth=np.zeros_like(frame.second.depth))
    one = height_map_from_frame(replace(frame, second=blind), Workspace())
    exact = height_map_from_scene(frame.truth, Workspace(), cell=both.cell)
    denied = [(exact.height > heights.ceiling + 0.006).sum() for heights in (both, one)]
    assert denied[0] <= denied[1] + 5  # cells at edges, where a pixel is wider than they are
    assert (both.ceiling <= np.maximum(one.ceiling, both.height) + 1e-6).all()
    assert (both.ceiling >= both.height).all()


def test_a_second_frame_without_a_depth_adds_nothing() -> None:
    frame = seen_from(0, 180)
    blind = replace(frame.second, depth=np.zeros_like(frame.second.depth))
    one = height_map_from_frame(seen_from(0), Workspace())
    both = height_map_from_frame(replace(frame, second=blind), Workspace())
    for name in ("height", "ceiling", "label"):
        np.testing.assert_array_equal(getattr(one, name), getattr(both, name))


@pytest.mark.parametrize("name", ["heuristic6d", "graspnet", "graspnet6d"])
def test_planners_plan_without_a_second_frame_that_shows_nothing(name) -> None:
    plan = make_planner(name, GripperGeometry(), Workspace(), 0)
    frame = seen_from(0, 180).without_truth()
    blind = replace(frame.second, depth=np.zeros_like(frame.second.depth))
    grasps, alone = plan(replace(frame, second=blind)), plan(replace(frame, second=None))
    qualities = [grasp.quality for grasp in alone]
    assert qualities
    assert [grasp.quality for grasp in grasps] == pytest.approx(qualities)


def test_what_a_frame_sees_through_and_what_it_hides() -> None:
    """From straight above: over a box, in it, under it, beside it, under the table, out of sight;
    and where nothing was measured."""
    frame = boxes_frame([BOX])
    box, beside = (0.5, 0.0), (0.5, 0.1)
    points = np.array([(*box, 0.12), (*box, 0.05), (*beside, 0.05), (*beside, -0.05), (2, 2, 0.1)])
    assert sees_through(frame, points).tolist() == [True, False, True, False, False]
    assert hides(frame, points).tolist() == [False, True, False, True, True]
    blind = replace(frame, depth=np.zeros_like(frame.depth))
    assert not sees_through(blind, points).any() and hides(blind, points).all()


def test_a_point_is_seen_through_at_its_own_pixel() -> None:
    """A step from 0.5 to 0.8 m between pixels 9 and 10; the surface's last 4 mm may be noise."""
    depth = np.full((20, 20), 0.8, np.float32)
    depth[:, :10] = 0.5
    K = np.array([[100.0, 0, 10], [0, 100, 10], [0, 0, 1]])
    frame = RGBDFrame(np.zeros((20, 20, 3), np.uint8), depth, K, np.eye(4))
    pixels = np.array([(9, 5), (10, 5), (5, 10), (15, 10), (15, 10)])
    z = np.array([0.7, 0.7, 0.49, 0.798, 0.79])
    points = np.column_stack([(pixels - 10) / 100 * z[:, None], z])
    assert sees_through(frame, points).tolist() == [False, True, True, False, True]


def test_only_the_first_frame_tells_a_privileged_planner_the_truth() -> None:
    frame = seen_from(0, 180).without_truth()
    assert frame.truth is None and frame.second.truth is None


@pytest.mark.parametrize("name", ["heuristic", "heuristic6d", "graspnet", "graspnet6d"])
def test_planners_take_two_frames(name) -> None:
    plan = make_planner(name, GripperGeometry(), Workspace(), 0)
    best = plan(seen_from(0, 180).without_truth())[0]
    beyond = np.abs(best.position - (0.5, 0, 0.05)) - (0.03, 0.04, 0.05)
    assert (beyond < 0.005).all()  # the point between the fingertips is in the box


# Seen from 0.8 m, 0.149 m at the level of the table lie between the optical axis and the border of
# the image, and 0.139 m at the top of this box, which spans 0.09 to 0.21 m.
CUT = ((0.10, 0.12, 0.05), 0.0, (0.5, 0.15))


def test_a_box_that_the_image_cuts_off_goes_on_beyond_the_border() -> None:
    """At its own height, beside a table that stays one; the far half of the image is as it was."""
    frame = boxes_frame([CUT], focal=600)
    heights = height_map_from_frame(frame, Workspace())

    def height(x: float, y: float) -> float:
        return float(heights.height[heights.index(np.array([x, y]))])

    for y in (0.10, 0.13, 0.16, 0.20):
        assert height(0.5, y) == pytest.approx(0.05, abs=1e-3)
        assert height(0.6, y) == pytest.approx(0.0, abs=1e-3)
    assert height(0.5, -0.2) == height(0.5, 0.0) == pytest.approx(0.0, abs=1e-3)


def test_no_grasp_closes_where_the_image_ends() -> None:
    """The 49 mm of the box that are seen would fit the hand; it is 120 mm long, and 100 mm wide."""
    plan = make_planner("heuristic", GripperGeometry(), Workspace(), 0)
    assert plan(boxes_frame([CUT], focal=600)) == []
    whole = ((0.10, 0.049, 0.05), 0.0, (0.5, 0.10))
    assert plan(boxes_frame([whole], focal=600))


@pytest.mark.parametrize("name", ["heuristic", "heuristic6d"])  # networks keep away by themselves
def test_no_grasp_has_its_middle_where_the_image_shows_nothing(name: str) -> None:
    """A bar of 12 cm, 5 cm wide, of which 49 mm are seen: it may end at the border."""
    frame = boxes_frame([((0.05, 0.12, 0.05), 0.0, (0.5, 0.15))], focal=600)
    grasps = make_planner(name, GripperGeometry(), Workspace(), 0)(frame)
    assert grasps
    pixels, _ = project([grasp.position for grasp in grasps], frame.K, frame.T_WC)
    assert (pixels > -1).all() and (pixels < 224).all()


def test_a_second_frame_shows_where_an_object_ends_that_the_first_one_cuts_off() -> None:
    """The box ends at y = 0.16; the first image at 0.139, as above."""
    box = [((0.10, 0.06, 0.05), 0.0, (0.5, 0.13))]
    target = np.array([0.5, 0.13, 0.0])
    other = boxes_frame(box, T_WC=look_at(target + (0.3, 0.3, 0.6), target, (0, 0, 1)))
    frame = replace(boxes_frame(box, focal=600), second=other)
    heights = height_map_from_frame(frame, Workspace())
    for y, height in ((0.12, 0.05), (0.15, 0.05), (0.17, 0.0), (0.2, 0.0)):
        at = heights.index(np.array([0.5, y]))
        assert heights.height[at] == pytest.approx(height, abs=2e-3)


def test_an_image_that_cuts_nothing_off_stays_as_it_is() -> None:
    frame = boxes_frame([BOX])
    same, added = with_surroundings(frame, 0.0)
    assert same is frame and added == ((0, 0), (0, 0))


def test_only_the_borders_that_cut_something_off_are_widened() -> None:
    """0.1 m at the median depth of 0.8 m and 600 px; its pixels keep their points."""
    frame = boxes_frame([CUT], focal=600)
    wider, added = with_surroundings(frame, 0.0)
    assert sorted(np.ravel(added)) == [0, 0, 0, 75]
    (top, bottom), (left, right) = added
    points = wider.points()[top : 224 + top, left : 224 + left]
    np.testing.assert_allclose(points, frame.points(), atol=1e-6)
    rise = wider.points()[..., 2]
    assert rise.min() == pytest.approx(0, abs=1e-5) and rise.max() == pytest.approx(0.05, abs=1e-5)


def test_a_workspace_out_of_sight_is_told() -> None:
    frame, far = boxes_frame([BOX]), Workspace((-2.0, 0.0))
    plan = make_planner("heuristic", GripperGeometry(), far, 0)
    with pytest.warns(UserWarning, match=r"no point .* 0.3 m at \(-2, 0\).*workspace_of"):
        assert plan(frame) == []


def highest(points: np.ndarray, shape: tuple[int, int], origin: np.ndarray, cell: float):
    """(R, C) float32 highest z of points (..., 3) in each cell, as NumPy finds it."""
    column, row = np.rint((points[..., :2] - origin) / cell).reshape(-1, 2).T
    inside = (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])
    height = np.full(shape, -np.inf, np.float32)
    at = row[inside].astype(int), column[inside].astype(int)
    np.maximum.at(height, at, points[..., 2].ravel()[inside].astype(np.float32))
    return height


@pytest.mark.parametrize("seed", range(5))
def test_each_cell_has_the_highest_of_the_pixels_that_fall_on_it(seed: int) -> None:
    """A map smaller than the view, pixels without a depth, four points for each other one."""
    random = np.random.default_rng(seed)
    depth = random.uniform(0.5, 0.6, (40, 60)).astype(np.float32)
    depth[random.random(depth.shape) < 0.2] = 0
    K = np.array([[120.0, 0, 29.5], [0, 120.0, 19.5], [0, 0, 1]])
    T_WC = look_at([0.5, 0.02, 0.6], [0.5, 0, 0], up=(1, 0, 0))
    frame = RGBDFrame(np.zeros((40, 60, 3), np.uint8), depth, K, T_WC)
    origin, cell, shape = np.array([0.45, -0.06]), 0.004, (30, 20)
    found = seen_heights._surface(frame, origin, cell, 2, shape)
    v, u = np.mgrid[:40, :60]
    parts = [
        deproject(np.stack([u + du, v + dv], axis=-1), depth, K, T_WC)[depth > 0]
        for du in (-0.25, 0.25)
        for dv in (-0.25, 0.25)
    ]
    expected = highest(np.concatenate(parts), shape, origin, cell)
    # A point just between two cells may be rounded to either.
    alike = np.isclose(found, expected, atol=1e-6) | (found == expected)
    assert np.isfinite(expected).mean() > 0.5 and alike.mean() > 0.995


def test_rays_raise_all_cells_that_they_pass() -> None:
    near, far = np.array([[0.0], [2.0], [0.1]]), np.array([[4.0], [2.0], [0.3]])
    height = np.full((5, 5), -np.inf, np.float32)
    seen_heights._raise_to_rays(height, near, far - near, np.linspace(0, 1, 5))
    np.testing.assert_allclose(height[2], [0.1, 0.15, 0.2, 0.25, 0.3], atol=1e-7)
    assert np.isinf(np.delete(height, 2, axis=0)).all()


@pytest.mark.parametrize("dtype", [np.float16, ">f4", np.longdouble, np.float64])
def test_depth_of_any_float_type_is_mapped(dtype) -> None:
    frame = boxes_frame([BOX])
    other = replace(frame, depth=frame.depth.astype(dtype))
    expected, found = (height_map_from_frame(f, Workspace()).height for f in (frame, other))
    # Half floats have 0.5 mm at this distance, and edges move with them.
    assert (np.abs(found - expected) < 1e-3).mean() > (0.97 if dtype is np.float16 else 0.9999)
