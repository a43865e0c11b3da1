"""Exact contacts of the pads with solids whose faces are known by construction."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from models.planner_candidates import Candidates
from models.planner_contacts import exact_contacts, scored_by_contacts
from utils.geometry import ConvexSolid, GripperGeometry, SceneGeometry, SolidObject

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
