"""Loops over pixels, cells and joints, compiled on first use.

Numba compiles what `compiled` decorates: plain loops over NumPy arrays. The machine code is kept in
`__pycache__` beside the source, or in the user's cache where that cannot be written, for each kind
of processor, and is made again when that source file changes: so a loop uses no constant and no
other loop of another module of this project, which would stay in it as they were
(tests/test_compiled.py).
"""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numba
from numba.core.caching import FunctionCache, IndexDataCacheFile

from utils.atomic_files import locked
from utils.errors import UserError

Loop = TypeVar("Loop", bound=Callable)

OPTIONS = {"nogil": True, "error_model": "numpy"}


def compiled(loop: Loop) -> Loop:
    """The function, compiled for the types of its arguments. Other threads go on while it runs.

    Division by zero gives infinity, as in NumPy. Indices are not checked.
    """
    dispatcher = numba.njit(**OPTIONS)(loop)
    # Where there is no folder, or no source file, each process compiles again.
    with contextlib.suppress(RuntimeError, OSError):
        dispatcher._cache = LoopCache(loop)  # as `cache=True` does with Numba's own
    return dispatcher


class LoopCache(FunctionCache):
    """Numba's cache of a function's machine code, for many processes and disks that may be full.

    Numba's own names its files by number, in an index that it reads, changes and writes without a
    lock, and writes before they are there: a name could come to stand for the code of other types,
    or of an older source. Here each content of the source has a folder of its own, one process at a
    time writes to it, and what cannot be written is compiled again by the next process.
    """

    def __init__(self, loop: Callable):
        super().__init__(loop)
        content = Path(loop.__code__.co_filename).read_bytes() + repr(OPTIONS).encode()
        name = f"loops-{hashlib.sha256(content).hexdigest()[:16]}"
        self._folder = Path(self._cache_path, name)
        self._cache_file = IndexDataCacheFile(
            cache_path=str(self._folder),
            filename_base=self._impl.filename_base,
            source_stamp=self._impl.locator.get_source_stamp(),
        )

    def save_overload(self, sig: Any, data: Any) -> None:
        with contextlib.suppress(OSError, UserError):  # the code is compiled all the same
            self._folder.mkdir(parents=True, exist_ok=True)
            with locked(self._folder / "lock", "another process writes"):
                super().save_overload(sig, data)
