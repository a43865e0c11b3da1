"""Grasp rectangles, the rectangle metric and dense targets against hand computations."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from utils.rectangles import (
    GraspRectangle,
    intersection_over_union,
    rasterise,
    rectangle_match,
    rectangles_from_corners,
)
from utils.transforms import angle_difference

rectangles = st.builds(
    lambda u, v, a, w, h: GraspRectangle(np.array([u, v]), a, w, h),
    st.floats(0, 640), st.floats(0, 480), st.floats(0, np.pi),
    st.floats(5, 100), st.floats(5, 60),
)  # fmt: skip


def rectangle(u=50.0, v=50.0, degrees=0.0, width=40.0, height=20.0) -> GraspRectangle:
    return GraspRectangle(np.array([u, v]), np.radians(degrees), width, height)


def test_corners_in_cornell_order():
    """The first edge is the opening: here 40 px to the right and 30 px down, 50 px long."""
    corners = np.array([(10, 20), (50, 50), (44, 58), (4, 28)])
    found = GraspRectangle.from_corners(corners)
    assert found.centre == pytest.approx((27, 39))
    assert found.angle == pytest.approx(np.arctan2(30, 40))
    assert (found.width, found.height) == pytest.approx((50, 10))
    assert found.corners() == pytest.approx(corners)


def test_either_way_round_and_either_start_is_the_same_rectangle():
    corners = rectangle(degrees=30).corners()
    for order in ([3, 2, 1, 0], [2, 3, 0, 1], [1, 0, 3, 2]):
        found = GraspRectangle.from_corners(corners[order])
        assert found.angle == pytest.approx(np.pi / 6)
        assert (found.width, found.height) == pytest.approx((40, 20))


@given(rectangles)
def test_corner_round_trip(original):
    back = GraspRectangle.from_corners(original.corners())
    assert back.centre == pytest.approx(original.centre)
    assert angle_difference(back.angle, original.angle) == pytest.approx(0, abs=1e-9)
    assert (back.width, back.height) == pytest.approx((original.width, original.height))


def test_nan_corners_are_skipped():
    corners = np.stack([rectangle().corners()] * 3)
    corners[1, 2, 0] = np.nan
    assert len(rectangles_from_corners(corners)) == 2


@pytest.mark.parametrize("fields", [dict(width=0), dict(height=-1), dict(u=np.nan)])
def test_impossible_rectangles_are_refused(fields):
    with pytest.raises(ValueError, match="GraspRectangle"):
        rectangle(**fields)


SQUARES_AT_45 = 1 / np.sqrt(2)  # octagon 8 (sqrt 2 - 1) a^2 over 8 a^2 less the octagon, side 2a


@pytest.mark.parametrize(
    "a, b, expected",
    [
        (rectangle(), rectangle(), 1),
        (rectangle(), rectangle(degrees=180), 1),
        (rectangle(), rectangle(u=70), 1 / 3),  # half of each shared: 0.5 / 1.5
        (rectangle(), rectangle(v=60), 1 / 3),
        (rectangle(), rectangle(u=90), 0),  # one edge shared
        (rectangle(), rectangle(u=300), 0),
        (rectangle(), rectangle(degrees=90), 400 / 1200),  # a cross: the 20 x 20 middle
        (rectangle(), rectangle(degrees=90, width=20, height=40), 1),
        (rectangle(), rectangle(width=20, height=10), 0.25),  # one inside the other
        (rectangle(width=20), rectangle(width=20, degrees=45), SQUARES_AT_45),
    ],
)
def test_iou_by_hand(a, b, expected):
    assert intersection_over_union(a, b) == pytest.approx(expected, abs=1e-12)
    assert intersection_over_union(b, a) == pytest.approx(expected, abs=1e-12)


@settings(max_examples=300)
@given(rectangles, st.floats(-40, 40), st.floats(-40, 40), rectangles)
def test_iou_agrees_with_shapely(a, du, dv, shape):
    shapely = pytest.importorskip("shapely")
    b = GraspRectangle(a.centre + (du, dv), shape.angle, shape.width, shape.height)
    p, q = shapely.Polygon(a.corners()), shapely.Polygon(b.corners())
    peer = p.intersection(q).area / p.union(q).area
    assert intersection_over_union(a, b) == pytest.approx(peer, abs=1e-6)


@pytest.mark.parametrize(
    "predicted, expected",
    [
        (rectangle(), True),
        (rectangle(degrees=29.9), True),
        (rectangle(degrees=30), False),  # "less than 30 degrees"
        (rectangle(degrees=-29.9), True),
        (rectangle(degrees=179), True),  # one degree over the seam
        (rectangle(degrees=150), False),  # exactly 30 over the seam
        (rectangle(degrees=90, width=20, height=40), False),  # same region, fingers across it
        (rectangle(u=50 + 24.0), False),  # IoU 16 / 64 = exactly a quarter
        (rectangle(u=50 + 23.9), True),
        (rectangle(width=20, height=10), False),  # a quarter again
    ],
)
def test_match_by_hand(predicted, expected):
    assert rectangle_match(predicted, [rectangle()]) is expected


@pytest.mark.parametrize("degrees", [0, 10, 40, 95, 163])
def test_exactly_thirty_degrees_never_matches(degrees):
    """Whatever rounding does to the difference of the two angles."""
    label = rectangle(degrees=degrees, width=30, height=30)
    assert not rectangle_match(rectangle(degrees=degrees + 30, width=30, height=30), [label])
    assert rectangle_match(rectangle(degrees=degrees + 29.99, width=30, height=30), [label])


def test_one_label_must_satisfy_both_conditions():
    right_place = rectangle(degrees=90, width=20, height=40)
    right_angle = rectangle(u=200)
    assert not rectangle_match(rectangle(), [right_place, right_angle])
    assert rectangle_match(rectangle(), [right_place, right_angle, rectangle(u=52)])
    assert not rectangle_match(rectangle(), [])


def test_transformed_follows_the_image():
    turn_and_double = np.array([[0, -2, 100], [2, 0, 7], [0, 0, 1.0]])
    moved = rectangle(10, 5, degrees=20).transformed(turn_and_double)
    assert moved.centre == pytest.approx((90, 27))
    assert moved.angle == pytest.approx(np.radians(110))
    assert (moved.width, moved.height) == pytest.approx((80, 40))
    mirrored = rectangle(10, 5, degrees=20).transformed(np.diag([-1.0, 1, 1]))
    assert mirrored.angle == pytest.approx(np.radians(160))


def test_rasterise_central_third():
    """30 x 10 px around (20, 12): |u - 20| <= 5 and |v - 12| <= 5, so 11 x 11 pixel centres. Bins
    beside the label's are half a bin beyond the half bin of quality 1."""
    quality, width = rasterise([rectangle(20, 12, width=30, height=10)], (25, 40))
    expected = np.zeros((18, 25, 40))
    expected[[17, 0, 1], 7:18, 15:26] = np.array([0.5, 1, 0.5])[:, None, None]
    assert quality.dtype == width.dtype == np.float32
    np.testing.assert_allclose(quality, expected, atol=1e-6)
    np.testing.assert_allclose(width, np.where(expected, 30, 0), atol=1e-5)


@pytest.mark.parametrize(
    "degrees, expected",
    [
        (0, {17: 0.5, 0: 1, 1: 0.5}),
        (178, {0: 1, 17: 0.7, 1: 0.3}),  # 2 degrees from bin 0, 8 from bin 17, 12 from bin 1
        (15, {1: 1, 2: 1}),  # on the border of two bins
        (92, {9: 1, 10: 0.7, 8: 0.3}),  # 8 and 12 degrees off: 3 and 7 beyond half a bin
    ],
)
def test_rasterise_angle_bins(degrees, expected):
    """Quality 1 within 5 degrees of a bin, falling to 0 at 15 degrees, across the seam too."""
    quality, _ = rasterise([rectangle(5, 5, degrees, 9, 9)], (11, 11))
    by_bin = np.zeros(18)
    by_bin[list(expected)] = list(expected.values())
    assert quality[:, 5, 5] == pytest.approx(by_bin, abs=1e-6)


def test_overlapping_labels_are_merged_whatever_their_order():
    narrow, wide = rectangle(20, 20, 0, 12, 8), rectangle(20, 20, 0, 36, 8)
    across = rectangle(20, 20, 90, 24, 8)
    one = rasterise([narrow, wide, across], (40, 40))
    other = rasterise([across, wide, narrow], (40, 40))
    assert all(np.array_equal(a, b) for a, b in zip(one, other))
    assert one.quality[[0, 9], 20, 20] == pytest.approx((1, 1))
    assert one.width[[0, 9], 20, 20] == pytest.approx((24, 24))  # (12 + 36) / 2; 24 alone
    assert one.width[0, 20, 25] == pytest.approx(36)  # beyond the narrow one's third


def test_a_label_thinner_than_a_pixel_is_not_lost():
    quality, width = rasterise([rectangle(3.4, 2.4, 0, 1.0, 0.5)], (6, 6))
    assert np.argwhere(quality[0]).tolist() == [[2, 3]]
    assert width[0, 2, 3] == 1
    outside, _ = rasterise([rectangle(-50, 2), rectangle(3, 900)], (6, 6))
    assert not outside.any()
