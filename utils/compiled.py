"""Loops over the cells of a map or the pixels of an image, compiled on first use.

Numba compiles what `compiled` decorates: plain loops over NumPy arrays, with the arithmetic of
NumPy, to the last bit. The machine code is kept beside the source (or in the user's cache where
that cannot be written), for each kind of processor, and is made again when the source changes: a
loop uses no constant of another module, which it would keep as it was.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numba

Loop = TypeVar("Loop", bound=Callable)


def compiled(loop: Loop) -> Loop:
    """The function, compiled for the types of its arguments. Other threads go on while it runs.

    Division by zero gives infinity, as in NumPy. Indices are not checked.
    """
    try:
        return numba.njit(loop, cache=True, nogil=True, error_model="numpy")
    except RuntimeError:  # no folder can be written: compile again in each process
        return numba.njit(loop, nogil=True, error_model="numpy")
