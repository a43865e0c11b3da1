"""The compiled loops of the search against NumPy's own steps."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from models import planner_loops as loops
from utils.geometry import GripperGeometry

HAND = GripperGeometry()
OUTLINE = np.array(HAND.finger_outline)
CELL = 0.002


def scene(seed: int, rows: int = 40, columns: int = 50):
    """A map (rows, columns) of float32 heights, five places on it and their axes."""
    random = np.random.default_rng(seed)
    height = random.uniform(0, 0.1, (rows, columns)).astype(np.float32)
    xy = random.uniform(-0.02, 0.12, (5, 2))  # some outside
    angle = random.uniform(0, np.pi, 5)
    along = np.column_stack([np.cos(angle), np.sin(angle)])
    return random, height, xy, along, along[:, ::-1] * (-1, 1)


def around(height, xy, along, across, u, v):
    return loops.cells_around(xy, along, across, u, v, np.zeros(2), CELL, *height.shape)


U, V = np.linspace(-0.03, 0.03, 31), np.linspace(-0.01, 0.01, 9)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_cells_are_the_nearest_ones(seed):
    _, height, xy, along, across = scene(seed)
    where = around(height, xy, along, across, U, V)
    points = xy[:, None, None] + U[:, None] * along[:, None, None]
    points = points + V[:, None, None] * across[:, None, None]
    column, row = np.rint(points / CELL).astype(int).transpose(3, 0, 1, 2)
    expected = row.clip(0, 39) * 50 + column.clip(0, 49)
    assert where.shape == (5, 9, 31)
    # A point just between two cells may be rounded to either.
    between = np.abs((points / CELL) % 1 - 0.5).min(axis=-1) < 1e-6
    assert ((where == expected) | between).all()


def test_nan_is_no_place_outside_the_map():
    where = loops.cells_around(
        np.full((1, 2), np.nan), np.eye(2)[:1], np.eye(2)[1:], U, V, np.zeros(2), CELL, 40, 50
    )
    assert (where == 0).all()


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_first_contacts_are_the_first_cells_over_the_level(seed):
    random, height, xy, along, across = scene(seed)
    lines = height.take(around(height, xy, along, across, U, V))
    level, window = random.uniform(0.05, 0.11, 10), random.random((10, 31)) < 0.5
    found = loops.first_contacts(lines, level, window, U, CELL)
    for i in range(10):  # two heights of the fingertips at five places
        met = (lines[i % 5] > level[i]) & window[i]
        for line in range(9):
            places = U[met[line]]
            ends = (places[0] - 0.001, places[-1] + 0.001) if len(places) else (np.inf, -np.inf)
            assert tuple(found[:, i, line]) == ends


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_highest_and_lowest_and_shares(seed):
    random, height, xy, along, across = scene(seed)
    where = around(height, xy, along, across, U, V)
    some = np.array([1, 4, 6])  # the last is at the second place, too
    values = height.take(where)[some % 5]
    highest = loops.highest_across(height.ravel(), where, some)
    np.testing.assert_array_equal(highest, values.max(axis=1))
    underside = random.uniform(0.05, 0.2, 9)
    gap = (underside - height.take(where).max(axis=2)).min(axis=1)
    np.testing.assert_array_equal(loops.least_gap(height.ravel(), where, underside), gap)
    under, tip = random.uniform(0, 0.05, (3, 31)), random.uniform(0, 0.05, 3)
    share = (values - under[:, None] > tip[:, None, None]).mean(axis=(1, 2))
    found = loops.share_over(height.ravel(), where, some, under, tip)
    np.testing.assert_allclose(found, share, rtol=1e-12)


@pytest.mark.parametrize("places", [(), (0,)])
def test_no_candidate_gives_nothing(places):
    where = np.zeros((len(places), 9, 31), np.intp)
    assert loops.highest_across(np.zeros(4), where, np.empty(0, int)).shape == (0, 31)
    assert loops.least_gap(np.zeros(4), where, np.ones(9)).tolist() == [1.0] * len(places)


@given(st.floats(0, 0.04))
def test_outline_is_interpolated_as_numpy_does(place):
    expected = HAND.finger_underside(np.array([place]))[0]
    assert loops._interpolated(place, OUTLINE) == expected


@pytest.mark.parametrize("place", OUTLINE[:, 0])
def test_outline_at_its_corners(place):
    expected = HAND.finger_underside(np.array([place]))[0]
    assert loops._interpolated(place, OUTLINE) == expected


@pytest.mark.parametrize(
    "wall, opening",
    [
        # Matter 2 cm wide and 5 cm high; a wall as high, whose face is `wall` m from the middle. A
        # finger is 2.64 cm thick where it is widest, 1.43 cm at its tip; its face is half the
        # opening from the middle.
        (0.060, 0.04),  # the finger's whole width fits, with a room of 1 cm beside the contact
        (0.044, 0.03),  # of half a centimetre alone
        (0.030, 0.00),  # no room
    ],
)
def test_fingers_open_as_wide_as_a_wall_lets_them(wall, opening):
    u = np.arange(-0.07, 0.07001, 0.001)
    obstacles = np.where((np.abs(u) < 0.01) | (u > wall), 0.05, 0.0)[None]
    found = loops.widest_opening(
        obstacles, u[None], np.array([0.02]), np.array([0.005]), np.array([0.01, 0.005]), 0.0, 0.08,
        OUTLINE, 0.003, 0.002, 0.003,
    )  # fmt: skip
    assert found[0] == pytest.approx(opening)


def opening_by_numpy(obstacles, beside, width, tip, rooms, offset):
    """As `widest_opening`, on whole arrays; clearances of 2 and 3 mm and an open hand of 8 cm."""
    closing = np.abs(beside) > width[:, None] / 2 + 0.003
    sill = np.where(closing, 0.003, np.inf)
    near, half_width = np.abs(beside - offset), width / 2 + abs(offset)
    opening = np.zeros(len(width))
    for room in rooms:
        half = np.minimum(half_width + room, 0.04)
        outward = near - half[:, None]
        under = np.where(outward < -0.003, sill, HAND.finger_underside(np.maximum(outward, 0)))
        fits = (obstacles - under).max(axis=1) <= tip - 0.002
        fits &= half >= half_width + 0.003 - 1e-9
        opening = np.where(fits & (opening == 0), 2 * half, opening)
    return opening


@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from([0.0, 0.01, -0.02]),
    st.sampled_from([(np.inf,), (0.012, 0.006, 0.003)]),
)
@settings(max_examples=60, deadline=None)
def test_openings_are_those_of_whole_arrays(seed, offset, rooms):
    random = np.random.default_rng(seed)
    u = np.arange(-36, 37) * CELL
    beside = u - random.uniform(-0.005, 0.005, (40, 1))
    width, tip = random.uniform(0.005, 0.07, 40), random.uniform(0.0, 0.02, 40)
    obstacles = np.where(random.random((40, 73)) < 0.05, random.uniform(0, 0.06, (40, 73)), 0.0)
    obstacles[np.abs(beside) < width[:, None] / 2] = 0.05
    found = loops.widest_opening(
        obstacles, beside, width, tip, np.array(rooms), offset, 0.08, OUTLINE, 0.003, 0.002, 0.003
    )
    expected = opening_by_numpy(obstacles, beside, width, tip, rooms, offset)
    np.testing.assert_array_equal(found, expected)
