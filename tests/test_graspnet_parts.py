"""Parts of one object put together, and parts of two objects left apart."""

import numpy as np
import pytest

from models.graspnet_parts import PartSettings, joined_parts

CELL = 0.002
BROWN, GREEN = (150, 100, 60), (60, 150, 100)
USUAL = PartSettings()


def halves(columns=20, rows=20, gap=0):
    """Labels of two parts side by side, `gap` columns of neither between them."""
    label = np.full((rows, 2 * columns + gap), -1)
    label[:, :columns], label[:, columns + gap :] = 0, 1
    return label


def joined(label, votes=1.0, step=0.0, colours=(BROWN, BROWN), settings=USUAL):
    """What becomes of two parts whose votes (pixels) and heights (m) differ by so much; both may be
    given for each row."""
    rows = np.ones(len(label))
    right = (label == 1).astype(float)
    votes, step = (
        x[label >= 0] for x in ((votes * rows)[:, None] * right, (step * rows)[:, None] * right)
    )
    colour = np.array(colours, np.uint8)[label[label >= 0]]
    votes = np.column_stack([votes, np.zeros(len(votes))])
    return joined_parts(label, votes, step.astype(np.float32), colour, 2, CELL, settings).tolist()


def cielab(colour):
    """(3,) L*, a*, b* of an sRGB colour (IEC 61966-2-1; CIE 15, white point D65)."""
    linear = np.array(colour) / 255
    linear = np.where(linear <= 0.04045, linear / 12.92, ((linear + 0.055) / 1.055) ** 2.4)
    to_xyz = [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
    x, y, z = np.cbrt(to_xyz @ linear / (0.9505, 1.0, 1.089))  # of colours that are not dark
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


@pytest.mark.parametrize("turns", range(4))
def test_parts_of_one_surface_and_colour_are_one_object(turns):
    assert joined(np.rot90(halves(), turns).copy()) == [0, 0]


@pytest.mark.parametrize(
    "unlike",
    [{"votes": 5.0}, {"step": 0.012}, {"colours": (BROWN, GREEN)}, {"label": halves(gap=1)}],
    ids=["votes for two places", "a step", "two colours", "not in touch"],
)
def test_what_breaks_off_is_another_object(unlike):
    assert joined(**{"label": halves()} | unlike) == [0, 1]


@pytest.mark.parametrize("name, least, most", [("votes", 3.9, 4.1), ("step", 0.0099, 0.0101)])
@pytest.mark.parametrize("alike, expected", [(11, [0, 0]), (9, [0, 1])])
def test_the_median_along_the_border_counts(name, least, most, alike, expected):
    """Of 20 rows."""
    values = np.where(np.arange(20) < alike, least, most)
    assert joined(halves(), **{name: values}) == expected


def test_the_difference_of_tints_is_cielabs():
    """Three greys with more and more blue, all of some 50 in lightness."""
    colours = np.array([(120, 120, 120), (119, 120, 130), (118, 120, 140)])
    near, far = (np.linalg.norm((cielab(colours[0]) - cielab(other))[1:]) for other in colours[1:])
    assert USUAL.tint - 1 < near < far / 1.8
    for other, apart in zip(colours[1:], (near, far)):
        for limit, expected in ((apart + 1, [0, 0]), (apart - 1, [0, 1])):
            pair = (colours[0], other)
            assert joined(halves(), colours=pair, settings=PartSettings(tint=limit)) == expected


def test_light_and_shadow_are_no_border():
    assert cielab((200, 200, 200))[0] - cielab((70, 70, 70))[0] > 45
    assert joined(halves(), colours=((200, 200, 200), (70, 70, 70))) == [0, 0]


def test_a_step_that_pixels_of_both_parts_blur_is_one():
    """A camera's edge of two cells, over which 2 cm of height change by 5 mm a cell."""
    label = halves()
    height = np.interp(np.arange(label.shape[1]), (18, 22), (0.0, 0.02)) + 0 * label
    votes, colour = np.zeros((label.size, 2)), np.full((label.size, 3), 90, np.uint8)
    assert joined_parts(label, votes, height.ravel(), colour, 2, CELL).tolist() == [0, 1]
    touching = PartSettings(inside=0)
    assert joined_parts(label, votes, height.ravel(), colour, 2, CELL, touching).tolist() == [0, 0]


@pytest.mark.parametrize("cells, expected", [(4, [0, 1]), (5, [0, 0])])
def test_a_border_has_some_length(cells, expected):
    label = halves(gap=1)
    label[:cells, 20] = 0
    assert joined(label) == expected


@pytest.mark.parametrize("columns, expected", [(4, [0, 1]), (6, [0, 0])])
def test_small_parts_are_left_alone(columns, expected):
    """4 cm2 are 100 cells; a column has 20."""
    assert joined(halves(columns)) == expected


def test_parts_in_a_row_are_one_and_keep_no_gap_in_their_numbers():
    """0 and 2 touch only 1; 3 stands alone; of 4 nothing is seen."""
    label = np.repeat(np.array([0, 1, 2, -1, 3]), 10)[None].repeat(20, axis=0)
    seen = (label >= 0).sum()
    colour = np.full((seen, 3), 90, np.uint8)
    whole = joined_parts(label, np.zeros((seen, 2)), np.zeros(seen), colour, 5, CELL)
    assert whole[0] == whole[1] == whole[2]
    assert sorted({*whole.tolist()}) == [0, 1, 2] and whole[3] != whole[4]


def test_nothing_seen_joins_nothing():
    empty = np.full((5, 5), -1)
    whole = joined_parts(empty, np.empty((0, 2)), np.empty(0), np.empty((0, 3), np.uint8), 3, CELL)
    assert whole.tolist() == [0, 1, 2]
