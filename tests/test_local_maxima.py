"""Local maxima against a definition that looks at every pair of pixels."""

from __future__ import annotations

import hypothesis.extra.numpy as arrays
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from utils.height_map import local_maxima

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
