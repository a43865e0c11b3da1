"""Calls in local processes and on a cluster: results, errors, workers that are lost or hang."""

import gc
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from itertools import count, repeat
from threading import Event, Timer
from types import SimpleNamespace

import psutil
import pytest

from tests.helpers.cluster import local_cluster
from utils import executor
from utils.config import load_config
from utils.errors import UserError
from utils.executor import LostWorkerError, completed, open_executor
from utils.runs import REPOSITORY
from utils.worker_process import kept

# --- In threads, which have the same interface --------------------------------------------------


def wait_for(condition):
    deadline = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.1)


class Threads(ThreadPoolExecutor):
    def size(self):
        return self._max_workers

    def waits(self):
        return False


def test_no_more_items_are_read_than_there_are_workers():
    """Of an endless supply, until the work is stopped."""
    read, stop = count(), Event()
    with Threads(2) as workers:
        results = []
        for result in completed(workers, abs, read, stop):
            results.append(result)
            if len(results) == 5:
                stop.set()
    assert sorted(results) == list(range(len(results))) and len(results) <= 7
    assert next(read) == len(results)


def test_results_arrive_as_they_are_finished():
    """The first call ends once the result of the second has arrived."""
    arrived, results = Event(), []

    def second_first(number):
        assert number == 2 or arrived.wait(60)
        return number

    with Threads(2) as workers:
        for result in completed(workers, second_first, [1, 2]):
            results.append(result)
            arrived.set()
    assert results == [2, 1]


def test_an_error_of_a_call_is_raised():
    with Threads(1) as workers, pytest.raises(ZeroDivisionError):
        list(completed(workers, lambda x: 1 / x, [0]))


def test_what_is_under_way_when_a_call_fails_is_not_lost():
    """The first three calls are under way, and two of them end after the third has failed."""
    failed, results = Event(), []

    class Telling(Threads):
        def submit(self, *call):
            future = super().submit(*call)
            future.add_done_callback(lambda one: one.exception() and failed.set())
            return future

    def divide(number):
        assert number == 0 or failed.wait(60)
        return 1 / number

    with Telling(3) as workers, pytest.raises(ZeroDivisionError):
        for result in completed(workers, divide, [2, 0, 4, 8, 16]):
            results.append(result)
    assert sorted(results) == [0.25, 0.5]  # no more are submitted


# --- In processes -------------------------------------------------------------------------------


@pytest.fixture(scope="module", params=["local", "cluster"])
def compute(request):
    """The section `compute` of each engine; the cluster has two workers."""
    if request.param == "local":
        yield load_config(None, ["compute.timeout=20"]).compute
        return
    with local_cluster(2) as cluster:
        overrides = [f"compute.scheduler={cluster.scheduler_address}", "compute.timeout=20"]
        yield load_config(None, overrides).compute


@kept
def slowly_made(value):
    return [value]


def plus_kept(number):
    """Counts in what the process keeps how often it was called."""
    slowly_made(100).append(number)
    return os.getpid(), len(slowly_made(100)) - 1, number + slowly_made(100)[0]


def first_time(folder, then, number):
    """Do something terrible in the first call with this number, and square it in the next."""
    begun = folder / str(number)
    if not begun.exists():
        begun.touch()
        then()
    return number**2


def die():
    os.kill(os.getpid(), signal.SIGKILL)


def refuse(path):
    raise UserError(f"{path} does not exist")


def test_a_process_keeps_what_it_has_made_for_one_executor(compute):
    for _ in range(2):
        with open_executor(compute, 2) as workers:
            calls = list(completed(workers, plus_kept, range(6)))
        assert sorted(result for _, _, result in calls) == list(range(100, 106))
        processes = {process for process, _, _ in calls}
        assert os.getpid() not in processes and len(processes) <= 2
        for process in processes:  # each counts from 1, in both executors
            counts = [count for one, count, _ in calls if one == process]
            assert counts == list(range(1, len(counts) + 1))


def test_calls_of_workers_that_die_are_repeated(compute, tmp_path):
    with open_executor(compute, 2) as workers:
        function = partial(first_time, tmp_path, die)
        assert sorted(completed(workers, function, range(3))) == [0, 1, 4]


def sent(number):
    os.kill(os.getpid(), number)
    return number


@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGTERM to ignore")
def test_processes_leave_signals_to_the_main_process():
    """Batch systems send SIGTERM to all processes of a job."""
    with open_executor(load_config().compute, 1) as workers:
        numbers = [signal.SIGINT, signal.SIGTERM]
        assert list(completed(workers, sent, numbers)) == numbers


def test_nobody_waits_for_calls_after_a_second_ctrl_c():
    """`utils.distributed.stop_on_interrupt` raises then, while calls are under way."""
    begun = time.monotonic()
    with pytest.raises(KeyboardInterrupt), open_executor(load_config().compute, 2) as workers:
        assert workers.submit(abs, -1).result() == 1
        calls = [workers.submit(time.sleep, 120) for _ in range(2)]
        wait_for(lambda: all(call.running() for call in calls))
        raise KeyboardInterrupt
    assert time.monotonic() - begun < 60 and all(call.exception() is not None for call in calls)


def test_a_call_that_hangs_is_repeated(compute, tmp_path):
    hurried = compute.model_copy(update={"timeout": 5.0})
    with open_executor(hurried, 2) as workers:
        function = partial(first_time, tmp_path, partial(time.sleep, 60))
        assert sorted(completed(workers, function, range(2))) == [0, 1]


def nap(seconds):
    time.sleep(seconds)
    return seconds


def test_slow_calls_within_their_time_are_left_alone(compute):
    hurried = compute.model_copy(update={"timeout": 4.0})
    with open_executor(hurried, 2) as workers:
        assert sorted(completed(workers, nap, [1.0, 1.5, 0.0])) == [0.0, 1.0, 1.5]


def freeze():
    """Stop the whole process, its timers included, as a machine that swaps does."""
    os.kill(os.getpid(), signal.SIGSTOP)


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGSTOP")
def test_a_process_that_freezes_is_replaced(tmp_path, monkeypatch):
    monkeypatch.setattr(executor, "FREEZE_SECONDS", 3.0)
    compute = load_config(None, ["compute.timeout=3"]).compute
    with open_executor(compute, 2) as workers:
        function = partial(first_time, tmp_path, freeze)
        assert sorted(completed(workers, function, range(3))) == [0, 1, 4]


def test_a_process_that_starts_late_and_freezes_is_ended(monkeypatch):
    """A busy machine needs longer to start it than a call may take; only then does it freeze."""
    monkeypatch.setattr(executor, "FREEZE_SECONDS", 0.05)
    began, call, ended = Future(), Future(), []
    process = process_of_futures(began, call, ended)
    Timer(0.4, began.set_result, [4711]).start()
    with pytest.raises(BrokenProcessPool):
        process.run(executor.Job("late", 0.05), print)
    assert ended[0] > 0.4


def test_a_process_that_never_starts_is_ended(monkeypatch):
    """Without the time that a call may take, which would be eleven days."""
    monkeypatch.setattr(executor, "START_SECONDS", 0.2)
    ended = []
    process = process_of_futures(Future(), Future(), ended)
    with pytest.raises(BrokenProcessPool):
        process.run(executor.Job("never", 1e6), print)
    assert ended[0] > 0.2


def process_of_futures(began, call, ended):
    """A process that has started once `began` has a result; when it is killed, `call` is lost, and
    `ended` is told after how many seconds."""
    start = time.monotonic()

    def kill():
        ended.append(time.monotonic() - start)
        if not call.done():
            call.set_exception(BrokenProcessPool())

    process = object.__new__(executor._Process)
    children = {4711: SimpleNamespace(kill=kill)}
    process._pool = SimpleNamespace(submit=lambda *_: call, _processes=children)
    process._began = began
    return process


def test_a_call_that_ends_every_worker_is_an_error(compute):
    with (
        pytest.raises(LostWorkerError, match=r"4 worker processes in a row died.*compute\.timeout"),
        open_executor(compute, 2) as workers,
    ):
        workers.submit(die).result()


class OddError(Exception):
    """Can be pickled but not read again, as errors of many libraries."""

    def __init__(self, part, reason):
        super().__init__(f"{part} {reason}")


def fail(part):
    raise OddError(part, "is dirty")


def test_an_error_that_cannot_be_read_again_arrives_as_its_traceback():
    with (
        pytest.raises(RuntimeError, match=r"(?s)in fail.*OddError: the lens is dirty"),
        open_executor(load_config().compute, 1) as workers,
    ):
        workers.submit(fail, "the lens").result()


MAIN = """
import os, sys, time
from utils.config import load_config
from utils.executor import open_executor

def report(_):
    print(os.getpid(), flush=True)
    time.sleep(60)

if __name__ == "__main__":
    with open_executor(load_config().compute, 1) as workers:
        workers.submit(report, 0).result()
"""


def test_processes_end_when_the_main_process_is_killed(tmp_path):
    (tmp_path / "script.py").write_text(MAIN)
    main = subprocess.Popen(
        [sys.executable, tmp_path / "script.py"], stdout=subprocess.PIPE, text=True,
        env=os.environ | {"PYTHONPATH": str(REPOSITORY)},
    )  # fmt: skip
    worker = psutil.Process(int(main.stdout.readline()))
    main.kill()
    wait_for(lambda: not worker.is_running() or worker.status() == psutil.STATUS_ZOMBIE)
    main.communicate()


def test_an_error_for_the_user_says_where(compute):
    with (
        pytest.raises(UserError, match=r"^weights.pt does not exist") as raised,
        open_executor(compute, 1) as workers,
    ):
        list(completed(workers, refuse, ["weights.pt"]))
    assert ("worker's machine" in str(raised.value)) is (compute.scheduler is not None)


# --- Order --------------------------------------------------------------------------------------


class Done(Threads):
    """Of which every call has ended as soon as it is submitted."""

    def submit(self, function, item):
        future = Future()
        try:
            future.set_result(function(item))
        except ZeroDivisionError as error:
            future.set_exception(error)
        return future


def test_calls_that_have_ended_together_are_in_the_order_of_submission():
    assert list(completed(Done(20), abs, range(50))) == list(range(50))


def divide(number):
    raise ZeroDivisionError(number)


def test_of_errors_that_are_there_together_the_first_submitted_is_raised():
    with pytest.raises(ZeroDivisionError, match="^0$"):
        list(completed(Done(20), divide, range(50)))


def test_workers_that_have_left_together_are_named_in_order(monkeypatch, capfd):
    threads = dict.fromkeys((f"tcp://10.0.0.{i}:4000" for i in range(9, 0, -1)), 1)
    client = SimpleNamespace(
        get_executor=lambda **_: None, run=lambda *_: None, nthreads=lambda: threads
    )
    monkeypatch.setattr(executor, "COUNT_SECONDS", 0.0)
    cluster = executor._Cluster(client, None, executor.Job("job", 60.0))
    assert cluster.size() == 9
    threads = {}
    assert cluster.waits()
    said = capfd.readouterr().err.split("\n\n")
    assert [line.split()[2] for line in said] == [f"tcp://10.0.0.{i}:4000" for i in range(1, 10)]


# --- A cluster without workers ------------------------------------------------------------------


@pytest.mark.slow
def test_calls_wait_for_workers_until_they_are_stopped(monkeypatch, capfd):
    """After all workers have vanished, together with the nannies that replace them."""
    monkeypatch.setattr(executor, "WAIT_SECONDS", 0.5)
    results, said, stop = [], [], Event()

    def it_says_so():
        said.append(capfd.readouterr().err)
        return "waiting for workers: tcp://127.0.0.1" in said[-1]

    with local_cluster(1) as cluster, ThreadPoolExecutor(1) as thread:
        compute = load_config(None, [f"compute.scheduler={cluster.scheduler_address}"]).compute
        with open_executor(compute) as workers:
            rest = thread.submit(results.extend, completed(workers, nap, repeat(0.1), stop))
            wait_for(lambda: results)
            cluster.scale(0)
            wait_for(it_says_so)
            before = len(results)
            cluster.scale(1)
            wait_for(lambda: len(results) > before + 1)
            cluster.scale(0)
            wait_for(it_says_so)
            assert not rest.done()
            stop.set()
            rest.result(timeout=10)
    # A nanny may have replaced one just before it went itself.
    assert "".join(said).count("has left; what it was computing is computed again") >= 2


# --- A cluster that cannot be used --------------------------------------------------------------


@pytest.fixture
def collected():
    """Dask's client, if its start has failed, is closed when it is collected, for which it takes a
    lock. If this happens where a later test starts a cluster, both wait for ever."""
    yield
    gc.collect()


@pytest.mark.parametrize(
    "address", ["tcp://127.0.0.1:1", "tls://127.0.0.1:1", "no address", "127.0.0.1"]
)
def test_an_unreachable_scheduler_is_one_sentence(address, monkeypatch, collected, capfd):
    pytest.importorskip("distributed", reason="pip install distributed")
    monkeypatch.setattr(executor, "CONNECT_SECONDS", 3.0)
    compute = load_config(None, [f"compute.scheduler={address}"]).compute
    with (
        pytest.raises(UserError, match=f"compute.scheduler={address}: cannot reach a scheduler"),
        open_executor(compute),
    ):
        pass
    gc.collect()
    assert "Traceback" not in capfd.readouterr().err


def test_workers_with_several_threads_are_refused():
    """They would share a cell."""
    with local_cluster(1, threads=2) as cluster:
        compute = load_config(None, [f"compute.scheduler={cluster.scheduler_address}"]).compute
        with (
            pytest.raises(UserError, match="has 2 threads.*start it with --nthreads 1"),
            open_executor(compute),
        ):
            pass


@pytest.mark.parametrize("fact", ["Python", "numpy", "the source of utils"])
def test_a_worker_that_would_compute_otherwise_is_refused(compute, fact, monkeypatch):
    if compute.scheduler is None:
        pytest.skip("local processes are of this installation")
    actual = executor.facts_of
    monkeypatch.setattr(executor, "facts_of", lambda names: actual(names) | {fact: "2.0"})
    with (
        pytest.raises(UserError, match=f"{fact} is .* there and 2.0 here; bring both to the same"),
        open_executor(compute),
    ):
        pass


@pytest.mark.slow
def test_a_worker_without_the_project_is_refused(tmp_path):
    """Dask's own commands, started elsewhere; the scheduler needs no more than that."""
    distributed = pytest.importorskip("distributed", reason="pip install distributed")
    commands = [sys.executable, "-m", "dask"]
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    file = tmp_path / "scheduler.json"
    scheduler = subprocess.Popen(
        [*commands, "scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard",
         "--scheduler-file", file], cwd=tmp_path, env=environment,
    )  # fmt: skip
    worker = subprocess.Popen(
        [*commands, "worker", "--scheduler-file", file, "--nthreads", "1", "--no-dashboard"],
        cwd=tmp_path, env=environment,
    )  # fmt: skip
    try:
        with distributed.Client(scheduler_file=str(file), timeout=30) as client:
            client.wait_for_workers(1, timeout=60)
            compute = load_config(None, [f"compute.scheduler={client.scheduler.address}"]).compute
            with (
                pytest.raises(UserError, match="a worker does not find this project.*PYTHONPATH"),
                open_executor(compute),
            ):
                pass
    finally:
        for process in (worker, scheduler):
            process.terminate()
        for process in (worker, scheduler):
            process.wait(30)
