"""Rough grasps on boxes, whose exact grasp is known by construction."""

import numpy as np
import pytest

from models.grasp_refinement import RefinementSettings, refine
from tests.test_geometry import boxes_frame
from utils.geometry import GripperGeometry, Workspace
from utils.height_map import height_map_from_frame
from utils.transforms import Grasp, angle_difference

GRIPPER = GripperGeometry()
BOX = ((0.04, 0.10, 0.05), np.deg2rad(25), (0.52, -0.04))


def heights_of(*boxes):
    return height_map_from_frame(boxes_frame(list(boxes)), Workspace())


def rough(x, y, degrees, width=0.045, quality=0.8):
    return Grasp(np.array([x, y, 0.03]), np.deg2rad(degrees), width, quality)


def test_a_tall_thing_is_held_as_near_to_its_centre_as_is_tried() -> None:
    tall = ((0.04, 0.05, 0.12), 0.0, (0.5, 0.0))
    start = Grasp(np.array([0.5, 0.0, 0.10 + GRIPPER.tip_below_centre]), 0.0, 0.045, 0.8)
    (exact,) = refine([start], heights_of(tall), GRIPPER)
    assert exact.position[2] == pytest.approx(start.position[2] - 0.016)


def test_nothing_is_put_lower_than_the_table_allows() -> None:
    flat = ((0.04, 0.10, 0.016), 0.0, (0.5, 0.0))
    start = Grasp(np.array([0.5, 0.0, 0.006 + GRIPPER.tip_below_centre]), 0.0, 0.045, 0.8)
    (exact,) = refine([start], heights_of(flat), GRIPPER)
    assert exact.position[2] - GRIPPER.tip_below_centre >= 0.004 - 1e-9


@pytest.mark.parametrize("off", [(-0.006, 0.0), (0.006, 0.0), (0.0, 0.004)])
@pytest.mark.parametrize("turn", [-8, 0, 8])
def test_a_rough_grasp_is_centred_turned_and_opened(off, turn) -> None:
    """Off by 6 mm and 8 degrees, and opened too little to go past the faces 4 cm apart."""
    yaw = BOX[1]
    along = np.array([np.cos(yaw), np.sin(yaw)])
    xy = np.array(BOX[2]) + off[0] * along + off[1] * np.array([-along[1], along[0]])
    (exact,) = refine([rough(*xy, 25 + turn)], heights_of(BOX), GRIPPER)
    beside = (exact.position[:2] - BOX[2]) @ along
    assert abs(beside) < 0.002  # one cell of the map
    # The map cannot tell a turn that moves the pad's ends by less than a cell.
    seen = np.arctan2(heights_of(BOX).cell, 2 * GRIPPER.pad_half_width)
    assert angle_difference(exact.angle, yaw) < seen
    assert 0.04 + 2 * 0.003 < exact.width <= GRIPPER.max_opening
    # The pads' middle is 6.6 mm above the box's centre, or 1.4 or 9.4 mm below it if put lower.
    assert exact.position[2] in (pytest.approx(0.03), pytest.approx(0.022))


def test_a_finger_in_a_neighbour_is_never_proposed() -> None:
    """5 mm beside the box stands another one of the same height: no finger fits between."""
    left = ((0.04, 0.06, 0.05), 0.0, (0.4775, 0.0))
    right = ((0.04, 0.06, 0.05), 0.0, (0.5225, 0.0))
    across_the_gap, along_the_gap = rough(0.4775, 0.0, 0), rough(0.4775, 0.0, 90, width=0.065)
    heights = heights_of(left, right)
    assert refine([across_the_gap], heights, GRIPPER) == []
    (kept,) = refine([across_the_gap, along_the_gap], heights, GRIPPER)
    assert np.rad2deg(angle_difference(kept.angle, np.pi / 2)) < 3


def test_the_networks_quality_ranks_equal_contacts() -> None:
    boxes = [((0.04, 0.04, 0.05), 0.0, (0.45, y)) for y in (-0.08, 0.0, 0.08)]
    grasps = [rough(0.45, y, 0, quality=q) for y, q in ((-0.08, 0.5), (0.0, 0.9), (0.08, 0.7))]
    ranked = refine(grasps, heights_of(*boxes), GRIPPER, RefinementSettings(geometry=0.0))
    assert [round(g.position[1], 2) for g in ranked] == [0.0, 0.08, -0.08]
    assert [g.quality for g in ranked] == [0.9, 0.7, 0.5]


def test_the_same_place_twice_is_one_grasp() -> None:
    twice = [rough(0.52, -0.04, 25), rough(0.521, -0.04, 28, quality=0.6)]
    assert len(refine(twice, heights_of(BOX), GRIPPER)) == 1
    assert refine([], heights_of(BOX), GRIPPER) == []
