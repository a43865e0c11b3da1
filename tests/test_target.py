"""One object among others: its cells in a height map, its grasps, and how a user marks it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from models.planner_antipodal import SearchPlanner
from models.planners import PLANNERS, HeuristicPlanner, make_planner, takes_targets
from tests.helpers.box_frames import boxes_frame
from utils import depth_correction
from utils.errors import UserError
from utils.geometry import GripperGeometry, Workspace
from utils.height_map import OTHER_LABEL, height_map_from_frame
from utils.target import (
    check_target,
    marked_pixels,
    object_of_target,
    only_object,
    only_target,
    pixel_labels,
    target_at,
    target_in_box,
)
from utils.transforms import RGBDFrame, look_at, project

SEARCHING = [name for name in PLANNERS if name != "random"]
LEFT, RIGHT = (0.46, -0.07), (0.54, 0.07)  # x, y of two boxes with room for fingers around each
BOX = (0.04, 0.09, 0.05)


def two_boxes() -> RGBDFrame:
    return boxes_frame([(BOX, 0.0, LEFT), (BOX, 0.0, RIGHT)])


def aimed(frame: RGBDFrame, low: tuple[float, float], high: tuple[float, float]) -> RGBDFrame:
    """The frame whose target is what stands on the table between two corners (x, y)."""
    points = frame.points()
    inside = (points[..., :2] > low) & (points[..., :2] < high)
    return replace(frame, target=inside.all(axis=-1) & (points[..., 2] > 0.004))


def heights_of(frame: RGBDFrame):
    return height_map_from_frame(frame, Workspace())


def area(heights, cells: np.ndarray) -> float:
    return float(cells.sum()) * heights.cell**2


# --- The height map -------------------------------------------------------------------------


def test_a_mask_cuts_what_the_height_map_cannot() -> None:
    """Two boxes of 3 cm x 9 cm, side by side and equally high, are one piece of the height map."""
    size = (0.03, 0.09, 0.05)
    frame = boxes_frame([(size, 0.0, (0.485, 0.0)), (size, 0.0, (0.515, 0.0))])
    heights = heights_of(frame)
    assert heights.label.max() == 0
    frame = aimed(frame, (0.4, -0.1), (0.5, 0.1))
    mine = only_target(heights, frame)
    cells = mine.label >= 0
    assert area(mine, cells) == pytest.approx(0.03 * 0.09, rel=0.15)
    centre = mine.centres[mine.label[cells][0]]
    np.testing.assert_allclose(centre, (0.485, 0.0, 0.025), atol=0.003)
    assert area(mine, mine.label == OTHER_LABEL) == pytest.approx(0.03 * 0.09, rel=0.15)
    # Together they are 6 cm wide, and the hand would take both; no finger fits between them.
    plan = make_planner("heuristic", GripperGeometry(), Workspace(), 0)
    assert plan(replace(frame, target=None)) and plan(frame) == []


def test_a_target_in_pieces_is_one_object_with_one_centre() -> None:
    """A step of 2 cm cuts the map; the mask holds both parts, 5 and 4 cm long."""
    low, high = (0.05, 0.04, 0.03), (0.04, 0.04, 0.05)
    frame = boxes_frame([(low, 0.0, (0.475, 0.0)), (high, 0.0, (0.52, 0.0))])
    heights = heights_of(frame)
    assert heights.label.max() == 1
    mine = only_target(heights, aimed(frame, (0.4, -0.1), (0.6, 0.1)))
    numbers = np.unique(mine.label[mine.label >= 0])
    assert len(numbers) == 1
    # Columns of 3 cm and 5 cm: the mean of x, weighted by height, and of half the height.
    x = (3 * 5 * 0.475 + 5 * 4 * 0.52) / 35
    z = (3 * 5 * 0.015 + 5 * 4 * 0.025) / 35
    np.testing.assert_allclose(mine.centres[numbers[0]], (x, 0.0, z), atol=0.002)


def test_the_centre_of_a_target_in_pieces_counts_from_what_it_stands_on() -> None:
    """The same two parts on a block 10 cm high."""
    low, high = (0.05, 0.04, 0.03), (0.04, 0.04, 0.05)
    block = ((0.2, 0.2, 0.1), 0.0, (0.5, 0.0))
    parts = [(low, 0.0, (0.475, 0.0, 0.1)), (high, 0.0, (0.52, 0.0, 0.1))]
    frame = boxes_frame([*parts, block], walls=1)
    frame = replace(frame, fixtures=frame.truth.walls)
    points = frame.points()
    target = (points[..., 2] > 0.12) & (np.abs(points[..., :2] - 0.5) < (0.06, 0.6)).all(axis=-1)
    mine = only_target(heights_of(frame), replace(frame, target=target))
    (number,) = np.unique(mine.label[mine.label >= 0])
    x = (3 * 5 * 0.475 + 5 * 4 * 0.52) / 35
    z = 0.1 + (3 * 5 * 0.015 + 5 * 4 * 0.025) / 35
    np.testing.assert_allclose(mine.centres[number], (x, 0.0, z), atol=0.002)


@pytest.mark.parametrize("name", ["heuristic", "graspnet"])
def test_a_thin_target_is_one_all_the_same(name: str) -> None:
    """A plate of 6 mm, all of which lies near the mask's outline, beside a box."""
    plate = ((0.006, 0.08, 0.05), 0.0, (0.52, 0.03))
    frame = boxes_frame([plate, (BOX, 0.0, (0.44, -0.06))])
    plan = make_planner(name, GripperGeometry(), Workspace(), 0)
    at_plate = np.abs(frame.points()[..., :2] - plate[2]).max(axis=-1) < 0.042
    segments = plan.segments(frame)
    numbers = np.unique(segments[at_plate & (segments >= 0)])
    grasps = plan(replace(frame, target=np.isin(segments, numbers)))
    assert grasps
    for grasp in grasps:
        np.testing.assert_allclose(grasp.position[:2], plate[2], atol=0.04)


def test_without_a_target_nothing_changes_and_a_hidden_one_leaves_no_object() -> None:
    frame = two_boxes()
    heights = heights_of(frame)
    assert only_target(heights, frame) is heights
    hidden = replace(frame, target=np.zeros(frame.depth.shape, bool))
    assert only_target(heights, hidden).label.max() == -1
    assert object_of_target(heights, hidden) is None
    assert only_object(heights, None).label.max() == -1


def test_an_edge_that_the_depth_camera_has_widened_belongs_to_the_object() -> None:
    """Stereo cameras make objects wider than they are: here the mask ends 3 mm inside."""
    frame = two_boxes()
    points = frame.points()
    inside = (np.abs(points[..., :2] - LEFT) < np.array(BOX[:2]) / 2 - 0.003).all(axis=-1)
    heights = heights_of(frame)
    mine = only_target(heights, replace(frame, target=inside & (points[..., 2] > 0.004)))
    number = heights.label[heights.index(np.array(LEFT))]
    np.testing.assert_array_equal(mine.label == number, heights.label == number)


# --- Planners -------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SEARCHING)
@pytest.mark.parametrize("place", [LEFT, RIGHT])
def test_all_grasps_are_of_the_target(name: str, place: tuple[float, float]) -> None:
    frame = aimed(two_boxes(), np.subtract(place, 0.06), np.add(place, 0.06))
    plan = make_planner(name, GripperGeometry(), Workspace(), 0)
    grasps = plan(frame)
    assert grasps and takes_targets(plan)
    for grasp in grasps:
        beside = np.abs(grasp.position[:2] - place) - np.array(BOX[:2]) / 2
        assert beside.max() < 0.005
    assert plan(replace(frame, target=np.zeros_like(frame.target))) == []


@pytest.mark.parametrize("name", ["heuristic", "oracle"])
def test_nothing_else_is_between_the_fingers(name: str) -> None:
    """A bar of 1.2 cm stands across the middle of a box, 1 cm higher. Fingers beside the box would
    close on both where they hold the middle."""
    box, bar = ((0.10, 0.04, 0.04), 0.0, (0.5, 0.0)), ((0.012, 0.036, 0.05), 0.0, (0.5, 0.0))
    frame = boxes_frame([box, bar])
    points = frame.points()
    over = (np.abs(points[..., 0] - 0.5) < 0.007) & (points[..., 2] > 0.042)
    frame = aimed(frame, (0.4, -0.1), (0.6, 0.1))
    frame = replace(frame, target=frame.target & ~over)
    plan = make_planner(name, GripperGeometry(), Workspace(), 0)
    grasps = plan(frame)
    assert grasps
    for grasp in grasps:
        if abs(grasp.closing_direction[1]) > 0.9:  # across the box; pads are 2 cm wide
            assert abs(grasp.position[0] - 0.5) > 0.010


@pytest.mark.parametrize("name", [name for name in SEARCHING if not name.startswith("oracle")])
def test_a_rough_frame_is_smoothed_once(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Depth with 6 mm of noise at each pixel is still rough after a filter that does nothing."""
    calls = []

    def smoothed(frame: RGBDFrame) -> np.ndarray:
        calls.append(name)
        return frame.depth

    monkeypatch.setattr(depth_correction, "smoothed_by_colour", smoothed)
    frame = two_boxes()
    noise = np.random.default_rng(0).normal(0.0, 0.006, frame.depth.shape)
    frame = replace(frame, depth=(frame.depth + noise).astype(np.float32))
    plan = make_planner(name, GripperGeometry(), Workspace(), 0)
    plan.segments(frame)
    assert len(calls) == 1
    plan(frame)
    assert len(calls) == 2


def test_the_random_planner_takes_no_targets() -> None:
    assert not takes_targets(make_planner("random", GripperGeometry(), Workspace(), 0))


def test_a_search_without_maps_of_its_own_takes_no_targets() -> None:
    """As docs/planner.md has it: a SearchPlanner of a user's, which knows nothing of targets."""

    class Own(SearchPlanner):
        def __call__(self, frame: RGBDFrame) -> list:
            return []

    assert not takes_targets(Own) and not takes_targets(Own(GripperGeometry(), Workspace()))
    assert takes_targets(HeuristicPlanner)


# --- What a user marks ----------------------------------------------------------------------


@pytest.fixture(scope="module")
def frame() -> RGBDFrame:
    return two_boxes()


@pytest.fixture(scope="module")
def labels(frame) -> np.ndarray:
    return pixel_labels(heights_of(frame), frame)


def pixel_of(frame: RGBDFrame, place: tuple[float, float]) -> tuple[float, float]:
    (u, v), _ = project(np.array([*place, BOX[2]]), frame.K, frame.T_WC)
    return float(u), float(v)


def test_a_point_takes_the_object_it_lies_on(frame, labels) -> None:
    for place in (LEFT, RIGHT):
        target = target_at(labels, frame, pixel_of(frame, place))
        seen = frame.points()[target]
        assert (np.abs(seen[:, :2] - place) < np.array(BOX[:2]) / 2 + 0.004).all()
        # Of the top, 0.75 m below the camera, a pixel shows 0.75^2 / 390.6^2 m2.
        assert target.sum() * 0.75**2 / 390.6**2 == pytest.approx(0.04 * 0.09, rel=0.15)


def test_the_board_over_an_object_is_no_part_of_it() -> None:
    """Seen from higher than the shelf's board, on whose top many of its pixels lie over the box."""
    shelf = [((0.40, 0.26, 0.02), 0.0, (0.5, -0.06, 0.30)), ((0.40, 0.02, 0.30), 0.0, (0.5, -0.18))]
    view = look_at((0.5, 0.45, 0.75), (0.5, 0.0, 0.15), (0, 0, 1))
    frame = boxes_frame([((0.05, 0.05, 0.12), 0.3, (0.5, 0.03)), *shelf], walls=2, T_WC=view)
    frame = replace(frame, fixtures=frame.truth.walls)
    planner = make_planner("heuristic6d", GripperGeometry(), Workspace(), 0)
    labels, height = planner.segments(frame), frame.points()[..., 2]
    assert (labels[height > 0.29] == -1).all() and (height > 0.29).sum() > 1000
    assert (labels[(height > 0.02) & (height < 0.13)] == 0).sum() > 100


def test_a_point_in_a_hole_of_the_depth_takes_the_object_around(frame, labels) -> None:
    u, v = np.rint(pixel_of(frame, LEFT)).astype(int)
    depth = frame.depth.copy()
    depth[v - 1 : v + 2, u - 1 : u + 2] = 0
    holed = replace(frame, depth=depth)
    target = target_at(pixel_labels(heights_of(holed), holed), holed, (u, v))
    assert abs(int(target.sum()) + 9 - int(target_at(labels, frame, (u, v)).sum())) <= 9


def test_a_box_takes_the_object_that_lies_in_it(frame, labels) -> None:
    u, v = pixel_of(frame, RIGHT)
    expected = target_at(labels, frame, (u, v))
    for box in ((u - 40, v - 30, u + 40, v + 30), (u + 40, v + 30, u - 40, v - 30)):
        np.testing.assert_array_equal(target_in_box(labels, box), expected)
    np.testing.assert_array_equal(target_in_box(labels, (u - 5, v - 5, u + 5, v + 5)), expected)


def test_a_box_that_cuts_its_object_does_not_take_a_small_one_inside() -> None:
    """94 of 100 columns of the large object, and all of one a tenth of its size."""
    labels = np.full((120, 200), -1, np.int32)
    labels[10:110, 10:110] = 0
    labels[40:75, 112:142] = 1
    for box in ((16, 5, 145, 115), (5, 5, 145, 104)):
        np.testing.assert_array_equal(target_in_box(labels, box), labels == 0)
    np.testing.assert_array_equal(target_in_box(labels, (100, 35, 145, 80)), labels == 1)


def test_marked_pixels() -> None:
    assert marked_pixels((20, 30), None, None, None) is None
    assert marked_pixels((20, 30), (10, 10), None, None).sum() == 9 * 9
    assert marked_pixels((20, 30), None, (28, -5, 40, 1), None).sum() == 2 * 2
    assert marked_pixels((20, 30), (900, 10), None, None).sum() == 0


@pytest.mark.parametrize(
    ("point", "message"),
    [
        ((2, 2), "on the table"),
        ((224, 10), "outside the image of 224x224"),
        ((-1, 10), "outside the image"),
        ((np.nan, 10), "outside the image"),
    ],
)
def test_a_point_on_no_object_is_one_sentence(frame, labels, point, message) -> None:
    with pytest.raises(UserError, match=message):
        target_at(labels, frame, point)


def test_the_nearest_pixel_of_an_object_is_named_beside_a_point_on_none(frame) -> None:
    alone = np.full(frame.depth.shape, -1)
    with pytest.raises(UserError, match="no object is seen"):
        target_at(alone, frame, (2, 2))
    alone[5:9, 10:20] = 0
    with pytest.raises(UserError, match="nearest pixel of an object is 10 5"):
        target_at(alone, frame, (2, 2))


def test_a_point_without_depth_is_one_sentence(frame, labels) -> None:
    nothing = replace(frame, depth=np.zeros_like(frame.depth))
    with pytest.raises(UserError, match="the depth is unknown there"):
        target_at(np.full_like(labels, -1), nothing, (50, 50))


@pytest.mark.parametrize(
    ("box", "message"),
    [
        ((0, 0, 20, 20), "no object in it"),
        ((300, 0, 400, 20), "holds no pixel"),
        ((np.nan, 0, 40, 20), "expected pixels"),
    ],
)
def test_a_box_around_nothing_is_one_sentence(labels, box, message) -> None:
    with pytest.raises(UserError, match=message):
        target_in_box(labels, box)


def test_a_mask_of_the_table_is_one_sentence(frame) -> None:
    mask = np.zeros(frame.depth.shape, bool)
    mask[:20, :20] = True
    with pytest.raises(UserError, match="shows only the table"):
        check_target(mask, frame, Workspace())
    with pytest.raises(UserError, match="depth is unknown"):
        check_target(mask, replace(frame, depth=np.zeros_like(frame.depth)), Workspace())
