"""Evaluations without worker processes, whose start takes longer than a few short rounds.

What would cross the boundary between two processes is pickled and read back.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable
from concurrent.futures import Executor, Future
from typing import Any


class CallingExecutor(Executor):
    """Calls what is submitted at once, in this process; takes the place of `process_pool`."""

    def __init__(
        self, workers: int, set_up: Callable[..., None] | None = None, *arguments: Any
    ) -> None:
        if set_up is not None:
            set_up(*_crossed(arguments))

    def submit(self, function: Callable, /, *arguments: Any, **options: Any) -> Future:
        future = Future()
        try:
            future.set_result(_crossed(function(*_crossed(arguments), **_crossed(options))))
        except Exception as error:  # raised where the result is asked for
            future.set_exception(_crossed(error))
        return future


def _crossed(thing: Any) -> Any:
    return pickle.loads(pickle.dumps(thing))
