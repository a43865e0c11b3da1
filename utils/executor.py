"""Worker processes with the interface of `concurrent.futures`.

An evaluation plays its scenes through an `Executor`. `process_pool` makes one of local processes;
any other with the same interface, such as a cluster's, takes its place. This module knows nothing
of what the processes compute.
"""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, ProcessPoolExecutor, wait
from itertools import islice
from typing import Any, TypeVar

import cv2

Item = TypeVar("Item")
Result = TypeVar("Result")


def process_pool(
    workers: int, set_up: Callable[..., None] | None = None, *arguments: Any
) -> Executor:
    """Local processes, each of which first calls `set_up(*arguments)`, if one is given.

    The processes are spawned, because a forked copy of a process that runs physics or threads of
    torch may hang. They ignore Ctrl-C, which the main process handles.
    """
    return ProcessPoolExecutor(
        workers,
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_start_worker,
        initargs=(set_up, arguments),
    )


def _start_worker(set_up: Callable[..., None] | None, arguments: tuple[Any, ...]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    cv2.setNumThreads(1)  # the workers fill the cores
    if set_up is not None:
        set_up(*arguments)


def completed(
    executor: Executor,
    function: Callable[[Item], Result],
    items: Iterable[Item],
    limit: int,
) -> Iterator[Result]:
    """Yield function(item) of every item as soon as it is there, whatever the order.

    No more than `limit` items are submitted at a time, and `items` is read only as far as that, so
    that an iterable that ends early ends the work soon. Raises what a call has raised.
    """
    waiting, pending = iter(items), set()
    while True:
        more = islice(waiting, limit - len(pending))
        pending |= {executor.submit(function, item) for item in more}
        if not pending:
            return
        finished, pending = wait(pending, return_when=FIRST_COMPLETED)
        for future in finished:
            yield future.result()
