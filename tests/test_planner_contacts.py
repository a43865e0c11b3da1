"""Exact contacts of the pads with solids whose faces are known by construction."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from models.planner_candidates import Candidates
from models.planner_contacts import (
    _pad_contacts,
    buried_share,
    exact_contacts,
    scored_by_contacts,
)
from utils.geometry import ConvexSolid, GripperGeometry, SceneGeometry, SolidObject, Workspace
from utils.height_map import height_map_from_scene

HAND = GripperGeometry()
HEIGHT = 0.05  # of the prisms


def prism(left: float, right: float, friction: float, thick: float = 0.0) -> SceneGeometry:
    """A prism along y under its upper edge, or strip of that thickness; its two faces rise towards
    the hand by these angles in degrees, and look down where they are negative."""
    ends = [(-thick / 2, HEIGHT), (thick / 2, HEIGHT)]
    reach = np.tan(np.deg2rad((left, right))) * HEIGHT
    ends += [(-thick / 2 - reach[0], 0.0), (thick / 2 + reach[1], 0.0)]
    corners = [(x, y, z) for x, z in ends for y in (-0.05, 0.05)]
    solid = ConvexSolid.from_vertices(np.array(corners))
    return SceneGeometry((SolidObject((solid,), solid.vertices.mean(axis=0), friction),))


def over_the_edge(depth: float = 0.014) -> Candidates:
    """One grasp with its fingertips this far below the prism's upper edge, closing along x."""
    one = Candidates.rough(
        np.zeros((1, 2)), np.zeros(1), np.array([HEIGHT - depth]), np.full(1, HAND.max_opening),
        np.ones(1),
    )  # fmt: skip
    one.label[:] = 0
    return one


@settings(deadline=None)
@given(st.floats(-20, 65), st.floats(-20, 65), st.floats(0.2, 1.5))
def test_pads_slip_off_a_wedge_that_opens_wider_than_the_friction_cone(
    left: float, right: float, friction: float
) -> None:
    # The fingers' own friction is 1, and a tenth of the cone is kept in reserve.
    half_angle, cone = (left + right) / 2, 0.9 * np.degrees(np.arctan(min(friction, 1.0)))
    assume(left + right > 10 and abs(half_angle - cone) > 0.5)
    quality, slips = exact_contacts(over_the_edge(), prism(left, right, friction), HAND)
    assert slips[0] == (half_angle > cone)
    assert not (slips[0] and quality[0] > 0)


def test_a_sloping_wall_with_parallel_faces_does_not_slip() -> None:
    # As a bowl's rim: it turns until it is parallel to the pads. No contact is antipodal before.
    quality, slips = exact_contacts(over_the_edge(), prism(50, -50, 0.5, thick=0.004), HAND)
    assert quality[0] == 0 and not slips[0]


@pytest.mark.parametrize("right, left_over", [(20, 1), (50, 0)])
def test_a_chance_counts_only_where_the_pads_do_not_slip_off(right: int, left_over: int) -> None:
    scene = prism(30, right, 0.6)  # in a cone of 28 degrees the contact on the left is not
    assert exact_contacts(over_the_edge(), scene, HAND)[0][0] == 0
    found = scored_by_contacts(over_the_edge(), scene, HAND, np.zeros(1), fallback=np.full(1, 0.02))
    assert len(found) == left_over


def grade(scene: SceneGeometry, y: float = 0.0, depth: float = 0.03) -> float:
    """Of one closing along x, this far from the middle of a prism and below its upper edge."""
    centre, along, across = np.array([[[0, y, HEIGHT - depth]], [[1, 0, 0]], [[0, 1, 0]]], float)
    return float(
        _pad_contacts(centre, along, across, np.array([0.04]), np.zeros(1), scene, HAND)[0][0]
    )


def box(friction: float = 1.0) -> SceneGeometry:
    """4 x 10 x 5 cm; its centre of mass is 2.5 cm high."""
    return prism(0, 0, friction, thick=0.04)


@pytest.mark.parametrize("away", [0.02, -0.02])
def test_each_pad_comes_from_where_an_open_hand_off_the_centre_has_it(away: float) -> None:
    """A box of 30 mm whose middle is 5 mm beside the centre; opened by 80 mm, 20 mm off the centre,
    the pads start at 60 mm on one side and at 20 mm on the other, where the box ends."""
    centre, along, across = np.array([[[0, 0, HEIGHT - 0.03]], [[1, 0, 0]], [[0, 1, 0]]], float)
    scene = prism(0, 0, 1.0, thick=0.03)
    values = [
        _pad_contacts(
            centre - [[shift, 0, 0]], along, across, np.array([0.04]), np.array([away]), scene, HAND
        )[0][0]
        for shift in (-0.004, 0.0, 0.004, 0.006, -0.006)
    ]
    assert min(values[:3]) == pytest.approx(max(values[:3]), rel=1e-6) and values[0] > 0.9
    # Six millimetres towards the nearer pad it stands on the box.
    assert sorted(values[3:]) == [0.0, pytest.approx(values[0], rel=1e-6)]


# Lines across a pad lie at 0.08, 0.37, 0.66 and 0.95 of its height.
ABOVE = abs(0.025 - (HEIGHT - 0.03) - 0.515 * HAND.pad_height)


def test_contacts_far_from_the_centre_of_mass_are_worse() -> None:
    over = np.exp(-((ABOVE / 0.06) ** 2))
    assert grade(box()) == pytest.approx(over, rel=1e-6)
    assert grade(box(), y=0.015) == pytest.approx(over * np.exp(-((0.015 / 0.02) ** 2)), rel=1e-6)


def test_contacts_of_a_quarter_of_the_pads_are_worse() -> None:
    """The lowest of four lines meets the box alone: 0.3 + 0.7 x 0.25 / 0.5."""
    depth = 0.2 * HAND.pad_height
    above = abs(0.025 - (HEIGHT - depth) - 0.08 * HAND.pad_height)
    expected = 0.65 * np.exp(-((above / 0.06) ** 2))
    assert grade(box(), depth=depth) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(("lean", "friction"), [(3, 1.0), (5, 1.0), (5, 0.4)])
def test_contacts_off_the_closing_line_are_worse(lean: float, friction: float) -> None:
    """Both faces lean by so many degrees; 0.7 of nine tenths of the friction cone is the scale."""
    cone = 0.9 * np.arctan(friction)
    straight, leaning = (grade(prism(angle, angle, friction, thick=0.02)) for angle in (0.0, lean))
    wedge = prism(lean, lean, friction, thick=0.02)
    higher = abs(wedge.objects[0].centre_of_mass[2] - 0.025)
    assert higher < 1e-9  # the mean of the corners
    expected = np.exp(-((np.deg2rad(lean) / (0.7 * cone)) ** 2))
    assert leaning / straight == pytest.approx(expected, rel=1e-6)


def test_a_plate_is_buried_by_as_much_as_a_box_covers() -> None:
    """3 of its 8 cm, seen from above; what lies beside it is not."""

    def block(low, high) -> SolidObject:
        corners = np.stack(np.meshgrid(*zip(low, high)), axis=-1).reshape(-1, 3)
        return SolidObject((ConvexSolid.from_vertices(corners),), corners.mean(axis=0), 0.5)

    plate = block((0.46, -0.02, 0.0), (0.54, 0.02, 0.01))
    above = block((0.44, -0.04, 0.02), (0.49, 0.04, 0.05))
    beside = block((0.60, -0.02, 0.0), (0.63, 0.02, 0.05))
    scene = SceneGeometry((plate, above, beside))
    share = buried_share(scene, height_map_from_scene(scene, Workspace()))
    assert share == pytest.approx([0.375, 0.0, 0.0], abs=0.04)  # a cell of 1.5 mm of 40 mm
