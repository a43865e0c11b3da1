"""Height maps of known boxes; local maxima against a definition over every pair of pixels."""

from __future__ import annotations

from dataclasses import replace

import cv2
import hypothesis.extra.numpy as arrays
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models.planners import HeuristicPlanner
from tests.helpers.box_frames import bin_walls, boxes_frame, shelf_frame
from utils.geometry import GripperGeometry, Workspace
from utils.height_map import (
    WALL_LABEL,
    base_heights,
    height_map_from_frame,
    height_map_from_scene,
    local_maxima,
    tilted_height_map,
    tilted_view,
    without_rims,
)
from utils.seen_heights import HOLE_RISE, without_holes
from utils.transforms import inverse_pose, project, transform_points

IMAGES = arrays.arrays(
    np.float32,
    arrays.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=9),
    elements=st.integers(0, 5).map(float),
)


@given(IMAGES, st.integers(1, 3))
def test_maxima_are_the_highest_of_their_windows_apart_and_ranked(image, radius) -> None:
    rows, columns = local_maxima(image, radius, above=0.5)
    places = list(zip(rows, columns))
    values = [image[place] for place in places]
    assert values == sorted(values, reverse=True)
    for row, column in places:
        window = image[max(row - radius, 0) : row + radius + 1]
        window = window[:, max(column - radius, 0) : column + radius + 1]
        assert image[row, column] == window.max() > 0.5
    for i, (row, column) in enumerate(places):
        assert all(max(abs(row - r), abs(column - c)) > radius for r, c in places[:i])
    # Every highest pixel is one of them, or within reach of one that is as high.
    for row, column in np.argwhere(image == image.max()):
        if image.max() > 0.5:
            assert any(
                max(abs(row - r), abs(column - c)) <= radius and image[r, c] == image.max()
                for r, c in places
            )


def test_a_plateau_counts_once_and_the_count_ends_the_list() -> None:
    image = np.zeros((9, 20), np.float32)
    image[4, 3:5] = 2.0  # two equal pixels side by side
    image[4, 10], image[4, 16] = 3.0, 1.0
    rows, columns = local_maxima(image, 2, above=0.5)
    assert list(zip(rows, columns)) == [(4, 10), (4, 3), (4, 16)]
    assert len(local_maxima(image, 2, above=0.5, count=2)[0]) == 2
    assert len(local_maxima(image, 2, above=3.0)[0]) == 0


def test_height_maps_of_a_known_box() -> None:
    frame = boxes_frame([((0.06, 0.08, 0.05), 0.4, (0.47, 0.03))])
    for heights in (
        height_map_from_frame(frame, Workspace()),
        height_map_from_scene(frame.truth, Workspace()),
    ):
        box = frame.truth.objects[0].centre_of_mass[:2]
        c, s = np.cos(0.4), np.sin(0.4)
        rows, cols = np.mgrid[0 : heights.height.shape[0], 0 : heights.height.shape[1]]
        xy = heights.origin + heights.cell * np.stack([cols, rows], axis=-1) - box
        excess = np.abs(xy @ np.array([[c, -s], [s, c]])) - (0.03, 0.04)
        inside, outside = (excess < -0.002).all(axis=-1), (excess > 0.003).any(axis=-1)
        np.testing.assert_allclose(heights.height[inside], 0.05, atol=1e-4)
        np.testing.assert_allclose(heights.height[outside], 0.0, atol=1e-4)
        assert set(heights.label[inside]) == {0} and set(heights.label[outside]) == {-1}
        np.testing.assert_allclose(heights.centres, [[0.47, 0.03, 0.025]], atol=0.0015)


@pytest.mark.parametrize("tops", [(0.10, 0.04), (0.04, 0.10)])
def test_the_highest_of_several_objects_counts_in_whatever_order(tops) -> None:
    """A tower within the outline of a flat box: its top is seen, in its own label."""
    boxes = [((0.03 if top > 0.05 else 0.08,) * 2 + (top,), 0.0, (0.5, 0.0)) for top in tops]
    heights = height_map_from_scene(boxes_frame(boxes).truth, Workspace())
    tower, beside = (heights.index(np.array(place)) for place in ((0.5, 0.0), (0.53, 0.0)))
    assert heights.height[tower] == pytest.approx(0.10) and heights.label[tower] == np.argmax(tops)
    assert heights.height[beside] == pytest.approx(0.04)


def test_pieces_keep_numbers_without_gaps_where_a_rim_is_dropped() -> None:
    """A strip along a block's edge, 5 mm over it, is part of the block; a box far away is not."""
    cell, fixed = 0.002, np.full((60, 60), -np.inf)
    fixed[20:40, 20:40] = 0.05
    label, height = np.full((60, 60), -1), np.where(fixed > 0, fixed, 0.0)
    label[20:40, 39], height[20:40, 39] = 0, 0.055
    label[2:8, 50:56], height[2:8, 50:56] = 1, 0.04
    left = without_rims(label, height, fixed, cell)
    assert (left[20:40, 39] == WALL_LABEL).all() and (left[2:8, 50:56] == 0).all()
    assert sorted(np.unique(left)) == [WALL_LABEL, -1, 0]


def test_walls_around_the_workspace_are_obstacles_and_no_objects() -> None:
    box, walls = ((0.06, 0.08, 0.05), 0.0, (0.47, 0.03)), bin_walls()
    frame = boxes_frame([box, *walls], walls=4)
    for heights in (
        height_map_from_frame(frame, Workspace()),
        height_map_from_scene(frame.truth, Workspace()),
    ):
        for size, _, place in walls:
            along = np.linspace(-0.4, 0.4, 31)[:, None] * size[:2]
            at = heights.index(np.array(place) + along)
            np.testing.assert_allclose(heights.height[at], 0.10, atol=1e-4)
            assert (heights.label[at] == WALL_LABEL).all()
        assert heights.label[heights.index(np.array([0.47, 0.03]))] == 0
        assert len(heights.centres) == 1
        np.testing.assert_allclose(heights.centres, [[0.47, 0.03, 0.025]], atol=0.0015)


def test_what_lies_on_a_known_block_is_an_object_and_the_block_is_none() -> None:
    """A plate, 1 cm thick, on a block of 10 cm, whose edge it overhangs by 3 of its 12 cm. From
    above it looks like a tower that goes down to the table."""
    block, plate = ((0.2, 0.16, 0.10), 0.0, (0.5, 0.0)), ((0.09, 0.12, 0.11), 0.0, (0.5, 0.05))
    frame = boxes_frame([plate, block], walls=1)
    blind, knowing = (
        height_map_from_frame(replace(frame, fixtures=fixtures), Workspace())
        for fixtures in ((), frame.truth.walls)
    )
    assert len(blind.centres) == 2 and blind.centres[:, 2].max() < 0.06
    np.testing.assert_allclose(knowing.centres, [[0.5, 0.05, 0.105]], atol=0.003)
    on_plate, on_block, beside = (
        knowing.index(np.array(place)) for place in ((0.5, 0.10), (0.42, -0.04), (0.5, -0.12))
    )
    assert [knowing.label[at] for at in (on_plate, on_block, beside)] == [0, WALL_LABEL, -1]
    assert knowing.fixed[on_block] == pytest.approx(0.1) and knowing.fixed[beside] == -np.inf
    assert knowing.every(2).fixed.shape == knowing.every(2).height.shape
    # So it is for a hand that comes level: plate before block, none of the block's face its matter.
    T_WV = tilted_view(np.array([0.0, -0.98, -0.2]) / np.hypot(0.98, 0.2), Workspace())
    knows = replace(frame, fixtures=frame.truth.walls)
    seen = tilted_height_map(knowing, *without_holes(knows, Workspace()), T_WV)
    for place, label in (((0.5, 0.11, 0.11), 0), ((0.5, 0.08, 0.05), WALL_LABEL)):
        at = seen.index(transform_points(inverse_pose(T_WV), np.array(place))[:2])
        assert seen.label[at] == label


@pytest.mark.parametrize("things", [[], [((0.04, 0.06, 0.08), 0.0, (0.5, 0.0))]])
def test_a_known_board_that_covers_everything_is_no_object(things) -> None:
    """A board of 3 cm, larger than the whole map: what stands on it is all that there is."""
    frame = boxes_frame([*things, ((1.0, 1.0, 0.03), 0.0, (0.5, 0.0))], walls=1)
    heights = height_map_from_frame(replace(frame, fixtures=frame.truth.walls), Workspace())
    assert len(heights.centres) == len(things)
    assert set(np.unique(heights.label)) == {WALL_LABEL, *range(len(things))}
    for centre in heights.centres:
        np.testing.assert_allclose(centre, (0.5, 0.0, 0.055), atol=0.002)


def test_what_stands_below_a_board_is_an_object_of_the_map_below_it_alone() -> None:
    """A carton, 16 cm high, under the board of a shelf: from above there is only the board."""
    frame, workspace = shelf_frame([((0.05, 0.06, 0.16), 0.0, (0.5, -0.02))]), Workspace()
    above = height_map_from_frame(frame, workspace)
    middle = above.index(np.array([0.5, -0.02]))
    assert not (above.label >= 0).any() and above.height[middle] == pytest.approx(0.32)
    below = height_map_from_frame(frame, workspace, below=True)
    assert below.height[middle] == pytest.approx(0.16, abs=1e-3)
    # The strip before its upper edge may be a piece of its own; behind it nothing is seen.
    row, column = np.nonzero(below.label >= 0)
    x, y = (below.origin + below.cell * np.column_stack([column, row])).T
    assert 0.048 < np.ptp(x) < 0.056 and y.min() > -0.053 and y.max() < 0.014
    centre = below.centres[below.label[middle]]
    np.testing.assert_allclose(centre, [0.5, -0.025, 0.08], atol=0.006)
    # A hand that comes level sees the carton's face, and the back beside it.
    T_WV = tilted_view(np.array([0.0, -np.sin(1.48), -np.cos(1.48)]), workspace)
    seen = tilted_height_map(below, *without_holes(frame, workspace), T_WV)
    for place, is_object in (((0.5, 0.01, 0.08), True), ((0.58, -0.17, 0.2), False)):
        x, y, z = transform_points(inverse_pose(T_WV), np.array(place))
        at = seen.index(np.array([x, y]))
        assert (seen.label[at] >= 0) == is_object
        assert seen.height[at] == pytest.approx(z, abs=2e-3)


def test_what_a_label_without_cells_rests_on_is_the_table() -> None:
    label, fixed = np.full((4, 4), 1), np.full((4, 4), 0.1, np.float32)
    np.testing.assert_allclose(base_heights(label, fixed, 0.02), [0.02, 0.1])


def test_what_lies_beyond_the_workspace_without_surrounding_it_is_an_object() -> None:
    """Two long boxes pushed over two edges, 28 cm together."""
    boxes = [((0.03, 0.14, 0.05), 0.0, (0.5 + side * 0.17, 0.0)) for side in (-1, 1)]
    heights = height_map_from_frame(boxes_frame(boxes), Workspace())
    assert set(np.unique(heights.label)) == {-1, 0, 1}


def test_objects_on_all_sides_are_no_walls() -> None:
    """Five boxes with their middles outside the workspace, 38 cm together, 16 on one side."""
    edge = 0.165
    places = [(edge, -0.1), (edge, 0.1), (-edge, 0.0), (-0.05, edge), (0.0, -edge)]
    boxes = [((0.04, 0.08, 0.05), 0.0, (0.5 + x, y)) for x, y in places]
    heights = height_map_from_frame(boxes_frame(boxes), Workspace())
    assert heights.label.max() >= 4 and WALL_LABEL not in heights.label


def test_a_stick_far_from_an_object_is_no_part_of_it() -> None:
    """It stands 4 x 4 mm wide, 11 cm from a token; 1 cm from it, it may be what was seen of its
    rim."""
    token = ((0.03, 0.04, 0.012), 0.0, (0.42, 0.0))
    alone = height_map_from_frame(boxes_frame([token]), Workspace())
    for place, count in ((0.53, 0), (0.445, 1)):
        both = boxes_frame([token, ((0.004, 0.004, 0.10), 0.0, (place, 0.0))])
        heights = height_map_from_frame(both, Workspace())
        stick = heights.height > 0.05
        assert stick.sum() >= 4 and set(np.unique(heights.label[stick])) == {count - 1}
        if not count:
            np.testing.assert_allclose(heights.centres, alone.centres, atol=1e-3)


def test_only_the_hidden_strip_behind_a_box_may_hold_more_than_is_seen() -> None:
    # Outer face at x = 0.62, 0.05 high: the camera, 0.75 over its edge, hides
    # 0.12 * 0.05 / 0.75 = 8 mm of the table behind it.
    frame = boxes_frame([((0.04, 0.10, 0.05), 0.0, (0.60, 0.0))])
    heights = height_map_from_frame(frame, Workspace())
    rows, cols = np.nonzero(heights.ceiling > heights.height + 0.003)
    x = heights.origin[0] + heights.cell * cols
    assert len(x) and x.min() > 0.579 and x.max() < 0.631
    centre_row = heights.index(np.array([0.6, 0.0]))[0]
    assert x[rows == centre_row].min() > 0.618 and x[rows == centre_row].max() > 0.624


def test_a_hole_at_an_edge_does_not_lower_the_map() -> None:
    """A box 5 cm high, the pixels around its outline lost as a depth camera loses them."""
    frame = boxes_frame([((0.04, 0.06, 0.05), 0.0, (0.5, 0.0))])
    on_box = frame.depth < frame.depth.max() - 0.02
    edge = cv2.dilate(on_box.astype(np.uint8), np.ones((5, 5))) > cv2.erode(
        on_box.astype(np.uint8), np.ones((5, 5))
    )
    lossy = replace(frame, depth=np.where(edge, 0, frame.depth).astype(np.float32))
    whole, holed = (height_map_from_frame(f, Workspace()).height for f in (frame, lossy))
    assert edge.sum() > 200
    assert (holed >= whole - 1e-3).all()


def test_what_is_in_a_hole_may_be_higher_than_what_is_beside_it() -> None:
    frame = boxes_frame([((0.06, 0.06, 0.05), 0.0, (0.5, 0.0))])
    depth = frame.depth.copy()
    (u, v), _ = project(np.array([0.5, 0.0, 0.05]), frame.K, frame.T_WC)
    rows, columns = np.s_[int(v) - 3 : int(v) + 4], np.s_[int(u) - 3 : int(u) + 4]
    depth[rows, columns] = 0
    clean = height_map_from_frame(frame, Workspace())
    holed = height_map_from_frame(replace(frame, depth=depth), Workspace())
    np.testing.assert_allclose(holed.height, clean.height, atol=1e-4)
    raised = holed.ceiling - clean.ceiling
    assert raised.max() == pytest.approx(HOLE_RISE, abs=1e-4)
    at = np.argwhere(raised > 1e-3) * holed.cell + holed.origin[::-1]
    assert np.abs(at - (0.0, 0.5)).max() < 0.012


def test_holes_along_an_edge_do_not_raise_the_ceiling() -> None:
    """A box 5 cm high without the pixels on both sides of its outline: nothing is lost there."""
    frame = boxes_frame([((0.06, 0.06, 0.05), 0.0, (0.5, 0.0))])
    on_box = (frame.depth < frame.depth.max() - 0.02).astype(np.uint8)
    square = np.ones((3, 3), np.uint8)
    edge = cv2.dilate(on_box, square) > cv2.erode(on_box, square)
    lossy = replace(frame, depth=np.where(edge, 0, frame.depth).astype(np.float32))
    ceiling = height_map_from_frame(lossy, Workspace()).ceiling
    assert ceiling.max() == pytest.approx(0.05, abs=1e-3)


def test_an_object_that_the_camera_did_not_measure_is_a_wall() -> None:
    """A black box, say: all of its pixels are holes."""
    small, black = ((0.03, 0.03, 0.04), 0.0, (0.45, 0.0)), ((0.10, 0.16, 0.10), 0.0, (0.56, 0.0))
    frame = boxes_frame([small, black])
    depth = np.where(frame.depth < boxes_frame([small]).depth - 1e-4, 0, frame.depth)
    heights = height_map_from_frame(replace(frame, depth=depth), Workspace())
    x, y = np.meshgrid(np.arange(0.53, 0.59, 0.01), np.arange(-0.05, 0.06, 0.01))
    inside = heights.index(np.stack([x, y], axis=-1))
    assert heights.height[inside].min() > 0.08 and set(heights.label[inside].ravel()) == {-1}
    for grasp in HeuristicPlanner(GripperGeometry(), Workspace())(replace(frame, depth=depth)):
        for side in (-1, 1):
            finger = grasp.position + side * (grasp.width / 2 + 0.007) * grasp.closing_direction
            assert not (abs(finger[0] - 0.56) < 0.04 and abs(finger[1]) < 0.07)


def test_a_second_frame_does_not_put_a_board_back() -> None:
    """A carton 12 cm high under a board; a second camera from 60 degrees sees the board, too."""
    carton = [((0.05, 0.05, 0.12), 0.0, (0.5, 0.0))]
    frame = shelf_frame(carton)
    alone = height_map_from_frame(frame, Workspace(), below=True)
    both = height_map_from_frame(replace(frame, second=frame), Workspace(), below=True)
    for heights in (alone, both):
        assert heights.height[heights.label >= 0].max() < 0.13
