"""`utils.compiled`: loops that are compiled wherever the code lies."""

from __future__ import annotations

import numba
import numpy as np

from utils.compiled import compiled


def total(values):
    result = 0.0
    for value in values:
        result += 1 / value
    return result


def test_a_loop_gives_what_python_gives():
    assert compiled(total)(np.array([1.0, 2.0, 4.0])) == 1.75
    assert compiled(total)(np.zeros(1)) == np.inf  # as NumPy divides


def test_without_a_folder_for_it_nothing_is_kept(monkeypatch):
    """As in a read-only installation without a home, where Numba refuses to cache."""
    asked, njit = [], numba.njit

    def refusing(loop, cache=False, **options):
        asked.append(cache)
        if cache:
            raise RuntimeError("cannot cache function: no locator available")
        return njit(loop, **options)

    monkeypatch.setattr(numba, "njit", refusing)
    assert compiled(total)(np.array([0.5])) == 2.0
    assert asked == [True, False]
