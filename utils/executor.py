"""Executors with the interface of `concurrent.futures`: processes of this machine, or a cluster.

Evaluation, data generation and the preparation of objects submit their calls to what
`open_executor` gives. A call is repeated if its worker process dies, so that it must be a pure
function of its arguments. What a process needs for many calls, it makes once
(`utils.worker_process.kept`). Only this module knows Dask, the cluster's engine. It does not know
what the calls compute.
"""

from __future__ import annotations

import asyncio
import logging
import math
import multiprocessing
import os
import pickle
import sys
import time
import uuid
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import (
    FIRST_COMPLETED,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    wait,
)
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import cache, partial
from itertools import islice
from threading import Event, Thread
from typing import Any, TypeVar

from utils.config_schema import ComputeConfig
from utils.errors import UserError
from utils.plugins import loaded_modules
from utils.runs import plain_remarks, usable_cpus
from utils.worker_process import (
    SOURCES,
    Job,
    check,
    facts_of,
    leave_signals,
    work,
    worker_environment,
)

MOST_LOSSES = 4  # worker processes that one call may lose; as many as Dask allows by default
CONNECT_SECONDS = 10.0
START_SECONDS = 300.0  # in which a process has to start, which a busy machine may delay
FREEZE_SECONDS = 60.0  # after compute.timeout, by when a process that runs has ended itself
COUNT_SECONDS = 1.0  # between two looks at how many workers a cluster has
WAIT_SECONDS = 60.0  # between two messages that it has none

Item = TypeVar("Item")
Result = TypeVar("Result")
Call = Callable[[], Any]


class LostWorkerError(UserError):
    """A call has lost its worker process each time that it was tried."""


class Workers(Executor):
    """An executor that knows how many calls may be under way at a time, and whether any is."""

    def submit(self, function: Callable, /, *arguments: Any, **keywords: Any) -> Future:
        return self._submit(partial(function, *arguments, **keywords))

    @abstractmethod
    def _submit(self, call: Call) -> Future: ...

    @abstractmethod
    def size(self) -> int:
        """Calls that may be under way at a time, which may change; at least 1."""

    def waits(self) -> bool:
        """Whether no call makes progress, because there is no worker at this moment."""
        return False


@contextmanager
def open_executor(compute: ComputeConfig, workers: int | None = None) -> Iterator[Workers]:
    """Give an executor: the scheduler's cluster, or local processes where no scheduler is named.

    workers: calls under way at a time; None for all workers of the cluster, or one for each CPU
    that this process may use.
    At the end of the context local processes finish the calls under way, but for one that
    KeyboardInterrupt has brought about; a cluster forgets them.
    Raises UserError for a scheduler that cannot be reached or is lost, and for a worker that would
    not compute what this process computes; LostWorkerError for a call that ends every worker.
    """
    job = Job(uuid.uuid4().hex, compute.timeout)
    if compute.scheduler is None:
        with worker_environment(), _Processes(workers or usable_cpus(), job) as processes:
            try:
                yield processes
            except KeyboardInterrupt:
                processes.abandon()
                raise
    else:
        with _cluster(compute.scheduler, workers, job) as cluster:
            yield cluster


def completed(
    workers: Workers,
    function: Callable[[Item], Result],
    items: Iterable[Item],
    stop: Event | None = None,
) -> Iterator[Result]:
    """Yield function(item) of every item as soon as it is there, whatever the order.

    No more items are submitted at a time than there are workers, and `items` is read only as far as
    that. stop: once it is set, no more items are submitted, and the calls under way are finished
    unless there is no worker for them. Raises what a call has raised, once the calls
    under way are finished and what they return has been yielded. Of several calls the first to end
    counts, and of those found ended together the first to be submitted.
    """
    waiting = iter(items)
    pending: list[Future] = []  # in the order of submission, as `finished`
    failed: Exception | None = None
    while True:
        if stop is not None and stop.is_set():
            waiting = iter(())
            if workers.waits():
                break
        more = islice(waiting, max(0, workers.size() - len(pending)))
        pending += [workers.submit(function, item) for item in more]
        if not pending:
            break
        # Not for ever: workers may have joined or left, or `stop` may have been set.
        done = wait(pending, COUNT_SECONDS, FIRST_COMPLETED).done
        finished = deque(future for future in pending if future in done)
        pending = [future for future in pending if future not in done]
        done.clear()  # forgotten at once, or a cluster would compute lost results again
        while finished:
            try:
                result = finished.popleft().result()
            except Exception as error:  # whatever it is, it is raised in the end
                failed, waiting = failed or error, iter(())
                continue
            yield result
    if failed is not None:
        raise failed


def _lost(job: Job) -> LostWorkerError:
    return LostWorkerError(
        f"{MOST_LOSSES} worker processes in a row died of the same task, killed, out of memory or "
        f"after {job.seconds:g} s without a result (compute.timeout)"
    )


# --- Processes of this machine --------------------------------------------------------------------


class _Processes(Workers):
    """Local processes. Each stands in a pool of its own, so that one that dies is replaced alone
    and only its call is repeated. A thread waits for each of them, and ends one that is frozen as a
    whole, which could not end itself."""

    def __init__(self, count: int, job: Job) -> None:
        self._count, self._job = count, job
        self._threads = ThreadPoolExecutor(count)
        self._idle: deque[_Process] = deque()
        self._begun: list[_Process] = []
        self._abandoned = False

    def size(self) -> int:
        return self._count

    def _submit(self, call: Call) -> Future:
        return self._threads.submit(self._try, call)

    def _try(self, call: Call) -> Any:
        cause = None
        for _ in range(MOST_LOSSES):
            try:
                process = self._idle.pop()
            except IndexError:
                process = _Process()
                self._begun.append(process)
            if self._abandoned:  # since its process began
                process.kill()
            try:
                return process.run(self._job, call)
            except BrokenProcessPool as error:
                process.shutdown()
                self._begun.remove(process)
                process, cause = None, error
                if self._abandoned:
                    break
            finally:
                if process is not None:
                    self._idle.append(process)
        raise _lost(self._job) from cause

    def abandon(self) -> None:
        """End all processes, whose calls nobody waits for any more."""
        self._abandoned = True
        for process in list(self._begun):
            process.kill()

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        self._threads.shutdown(wait, cancel_futures=cancel_futures)
        while self._idle:
            self._idle.pop().shutdown(wait)


class _Process:
    """One process, which is spawned, because a forked copy of a process that runs physics or
    threads of torch may hang."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self._pool = ProcessPoolExecutor(1, mp_context=context, initializer=_begin_process)
        self._began = self._pool.submit(os.getpid)

    def run(self, job: Job, call: Call) -> Any:
        """The result of a call. Raises BrokenProcessPool where the process has died."""
        future = self._pool.submit(work, job, call)
        started = wait([self._began], START_SECONDS).done  # which does not count
        if not started or not wait([future], job.seconds + FREEZE_SECONDS).done:
            self.kill()
        try:
            return future.result()
        except BrokenProcessPool:
            self.kill()  # if it lives, the pool sends it SIGTERM and waits
            raise

    def kill(self) -> None:
        # Before Python 3.14 a pool has no public way to end a process that does not answer.
        for process in list((self._pool._processes or {}).values()):
            process.kill()

    def shutdown(self, wait: bool = True) -> None:
        self._pool.shutdown(wait)


def _begin_process() -> None:
    """In a new process: leave signals to the main process, and end with it, even if it is killed;
    it would be waited for without an end."""
    leave_signals()
    plain_remarks(in_a_worker=True)
    Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


# --- A cluster ------------------------------------------------------------------------------------


class _Cluster(Workers):
    """The workers of a Dask scheduler, which repeats the calls of a worker that is lost."""

    def __init__(self, client: Any, most: int | None, job: Job) -> None:
        self._client, self._most, self._job = client, most, job
        self._executor = client.get_executor(pure=False)
        self._names: set[str] = set()
        self._counted = -math.inf
        self._told = time.monotonic()
        self._look()
        client.run(pickle.loads, _packed(partial(check, job.facts)))

    def size(self) -> int:
        self._look()
        return self._most or max(1, len(self._names))

    def waits(self) -> bool:
        self._look()
        return not self._names

    def _look(self) -> None:
        """List the workers from time to time, and say so when one has left or there is none."""
        now = time.monotonic()
        if now < self._counted + COUNT_SECONDS:
            return
        threads = self._client.nthreads()
        for worker, count in threads.items():
            if count > 1:
                raise UserError(
                    f"the worker {worker} has {count} threads, but a process computes one call at "
                    "a time; start it with --nthreads 1"
                )
        for name in sorted(self._names - set(threads)):
            _say(f"the worker {name} has left; what it was computing is computed again")
        self._names, self._counted = set(threads), now
        if self._names:
            self._told = now
        elif now > self._told + WAIT_SECONDS:
            self._told = now
            _say(
                f"waiting for workers: {self._client.scheduler.address} has none; start some by "
                "`dask worker`, or stop with Ctrl-C and go on later"
            )

    def _submit(self, call: Call) -> Future:
        return self._executor.submit(pickle.loads, _packed(partial(work, self._job, call)))

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Cancel the calls under way: after an error there may be no worker that ends them."""
        self._executor.shutdown(wait=False)


def _say(text: str) -> None:
    print(f"\n{text}", file=sys.stderr, flush=True)  # not behind a progress bar


def _packed(call: Call) -> bytes:
    """A pickle whose loading is the call. The scheduler hands the bytes on as they are; it would
    load a function, and so would have to know this project."""
    return pickle.dumps(_Packed(call))


class _Packed:
    def __init__(self, call: Call) -> None:
        self._call = call

    def __reduce__(self) -> tuple[Call, tuple[()]]:
        return self._call, ()


@cache
def event_loop() -> Any:
    """A Tornado loop that runs in a thread until the process ends. Dask would start one itself, and
    fails if it does not run within ten seconds, which a busy machine may need."""
    from tornado.ioloop import IOLoop

    async def current() -> IOLoop:
        return IOLoop.current()

    loop = asyncio.new_event_loop()
    Thread(target=loop.run_forever, daemon=True).start()
    return asyncio.run_coroutine_threadsafe(current(), loop).result()


@contextmanager
def _cluster(address: str, most: int | None, job: Job) -> Iterator[Workers]:
    """Connect to a scheduler, and put Dask's errors in this project's words."""
    where = f"compute.scheduler={address}"
    try:
        from distributed import Client, KilledWorker
        from distributed.comm import CommClosedError, get_address_host_port
    except ModuleNotFoundError as error:
        install = 'pip install "distributed>=2025.1"'
        raise UserError(f"{where}: a cluster needs Dask: {install}") from error
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # errors are raised here
    facts = facts_of((*SOURCES, *loaded_modules()))
    try:
        get_address_host_port(address)  # a client that fails at it prints a traceback
        client = Client(address, timeout=CONNECT_SECONDS, set_as_default=False, loop=event_loop())
    except (OSError, ValueError, TypeError) as error:  # TypeError: tls:// without a certificate
        raise UserError(
            f"{where}: cannot reach a scheduler there ({error}); start one with `make cluster`, or "
            "set the key to null for processes of this machine"
        ) from error
    try:
        with client, _Cluster(client, most, Job(job.name, job.seconds, facts)) as cluster:
            yield cluster
    except KilledWorker as error:
        raise _lost(job) from error
    except (CancelledError, CommClosedError) as error:
        raise UserError(
            f"{where}: the scheduler or a worker was lost; start it again and go on, or go on with "
            "compute.scheduler=null on this machine"
        ) from error
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] not in SOURCES:
            raise
        raise UserError(
            f"{where}: a worker does not find this project (no module {error.name!r}); install it "
            "there with `pip install -e .`, or start the workers with its folder in PYTHONPATH"
        ) from error
