"""How evaluation scales: python -m benchmarks.bench_scaling [--json FILE] [KEY=VALUE]

Plays the same scenes in 1 and 2 processes of this machine, with 1 and 2 workers of a Dask cluster,
and on two nodes, and measures scenes an hour, bytes a scene, what a call costs without a scene, and
the scheduler's load. The nodes are network namespaces where this process may make them (root on
Linux), else two loopback addresses. A model of these figures says what 8, 64 and 512 workers give,
where it breaks, and what a million scenes cost. Then busy worker processes are killed (--kills, in
both engines), and every round must be the same as without. Overrides change the scenes:
evaluate.policies=oracle.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from benchmarks.metrics import Metric, benchmark_parser, positive_int, report
from envs.evaluation_worker import work
from utils.config import Config, load_config, with_settings
from utils.evaluation import Task, tasks
from utils.executor import Workers, completed, open_executor
from utils.result_records import RoundRecord, append_round, differing_rounds
from utils.runs import run_script
from utils.worker_process import worker_environment

try:
    import psutil
    from distributed import Client
except ModuleNotFoundError as error:
    raise SystemExit(
        f"error: {error.name} is not installed; pip install -r requirements-dev.txt"
    ) from None

SCENES = ("evaluate.policies=heuristic", "evaluate.scenarios=pile",
          "evaluate.object_sets=primitives", "evaluate.depth_noises=none",
          "evaluate.videos=0")  # fmt: skip
SHORT = ("evaluate.scenarios=isolated",)  # of the evaluations in which workers are killed
QUICK = ("evaluate.scenarios=isolated", "evaluate.object_sets=box")
SIZES = (8, 64, 512)  # workers of the model
FULL = 0.8  # share of a core from which a scheduler or a main process is late with its answers
EACH = 7  # scenes for each kill: most results find the oldest worker idle or beginning
BUSY, LOOK = 25, 0.2  # % of a core that a process takes in the middle of a scene, s to measure it
DASK = {"DASK_LOGGING__DISTRIBUTED": "error", "DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "False"}
BRIDGE, NETWORK = "robotgrasp", "10.77.0"  # of the two namespaces


class Measured(NamedTuple):
    """Per scene: seconds of wall time, bytes that are sent, and seconds of CPU of the main process
    and of the scheduler (0 without one)."""

    seconds: float
    sent: float
    main: float
    scheduler: float

    @property
    def an_hour(self) -> float:
        return 3600 / self.seconds


def main(argv: Sequence[str] | None = None) -> None:
    parser = benchmark_parser(__doc__.splitlines()[0])
    parser.add_argument(
        "overrides", nargs="*", metavar="KEY=VALUE", help="evaluate.policies=oracle"
    )
    parser.add_argument("--scenes", type=positive_int, default=16, help="of each set-up")
    parser.add_argument(
        "--kills", type=positive_int, default=20, help="worker processes to kill, each engine"
    )
    options = parser.parse_intermixed_args(argv)
    scenes, kills, calls, repeats = options.scenes, options.kills, 500, 3
    if options.quick:
        scenes, kills, calls, repeats = 2, 1, 100, 1
    quick = QUICK if options.quick else ()
    metrics = rates(*plan_of(scenes, [*quick, *options.overrides]), calls, repeats)
    rounds = EACH * kills
    metrics += killed(*plan_of(rounds, [*SHORT, *quick, *options.overrides]), kills)
    report(metrics, options.json)


def plan_of(rounds: int, overrides: Sequence[str]) -> tuple[Config, list[Task]]:
    config = load_config(None, [*SCENES, f"evaluate.rounds={rounds}", *overrides])
    return config, list(tasks(config, []))


# --- What is measured -------------------------------------------------------------------------


def rates(config: Config, plan: Sequence[Task], calls: int, repeats: int) -> list[Metric]:
    """Rates and costs of every set-up, and the model of more workers."""
    found: dict[str, Measured] = {}
    idle: dict[str, Measured] = {}
    metrics = []
    for count in (1, 2):
        with ExitStack() as stack:
            address, scheduler = stack.enter_context(local_cluster(count))
            there = with_settings(config, "compute", {"scheduler": address})
            local = stack.enter_context(open_executor(config.compute, count))
            cluster = stack.enter_context(open_executor(there.compute))
            engines = {"local": (local, None), "dask": (cluster, scheduler)}
            for workers, _ in engines.values():  # every process makes its cell
                play(workers, config, plan[: 2 * count])
            runs: dict[str, list[Measured]] = {name: [] for name in engines}
            for repeat in range(repeats if count == 2 else 1):
                for name in list(engines)[:: 1 if repeat % 2 else -1]:  # who is first alternates
                    workers, of = engines[name]
                    runs[name].append(measure(partial(play, workers, config, plan), of))
            size = round(runs["dask"][0].sent)
            for name, (workers, of) in engines.items():
                found[f"{name}_{count}"] = Measured(*np.mean(runs[name], axis=0).tolist())
                idle[f"{name}_{count}"] = measure(partial(call, workers, config, size, calls), of)
            pairs = zip(runs["dask"], runs["local"])
            ratio = float(np.median([dask.an_hour / local.an_hour for dask, local in pairs]))
            aim = 0.95 if count == 2 else None
            metrics.append(Metric(f"dask_{count}_of_local_{count}", ratio, "of the rate", aim))
    with two_nodes() as (address, scheduler, received):
        there = with_settings(config, "compute", {"scheduler": address})
        with open_executor(there.compute) as workers:
            play(workers, config, plan[:4])
            before = received() if received is not None else 0
            found["nodes_2"] = measure(partial(play, workers, config, plan), scheduler)
            if received is not None:
                sent = (received() - before) / len(plan)
                metrics.append(Metric("nodes_2_network_per_scene", sent / 1e3, "kB"))
    for name, one in found.items():
        metrics.append(Metric(f"{name}_rate", one.an_hour, "scenes/h"))
    scene, two = found["dask_1"], found["dask_2"]
    for name, one in idle.items():
        metrics.append(Metric(f"{name}_empty_call", 1e3 * one.seconds, "ms"))
    share = 100 * idle["dask_1"].seconds / scene.seconds
    metrics += [
        Metric("scene", scene.seconds, "s of a worker"),
        Metric("dask_1_empty_call_share", share, "% of a scene", at_most=2.0),
        Metric("bytes_per_scene", scene.sent / 1e3, "kB"),
        Metric("scheduler_per_scene", 1e3 * idle["dask_2"].scheduler, "ms of CPU"),
        Metric("main_process_per_scene", 1e3 * idle["dask_2"].main, "ms of CPU"),
        Metric("scheduler_load", 100 * two.scheduler / two.seconds, "% CPU"),
    ]  # fmt: skip
    return metrics + model(scene.seconds, scene.sent, idle["dask_2"])


def model(seconds: float, sent: float, idle: Measured) -> list[Metric]:
    """More workers: each plays a scene in `seconds`, until the scheduler or the main process has no
    more time for the calls. Both are one thread of Python."""
    metrics, busiest = [], max(idle.scheduler, idle.main)
    for workers in SIZES:
        rate = min(workers / seconds, FULL / busiest)
        name = f"model_{workers}_workers"
        metrics += [
            Metric(f"{name}_rate", 3600 * rate, "scenes/h"),
            Metric(f"{name}_scheduler_load", 100 * rate * idle.scheduler, "% CPU"),
            Metric(f"{name}_main_load", 100 * rate * idle.main, "% CPU"),
            Metric(f"{name}_network", 8e-6 * rate * sent, "Mbit/s"),
            Metric(f"{name}_million", 1e6 / rate / 3600, "h"),
        ]
    return [
        *metrics,
        Metric("model_scheduler_full", FULL * seconds / idle.scheduler, "workers"),
        Metric("model_main_full", FULL * seconds / idle.main, "workers"),
        Metric("model_million_core_hours", 1e6 * seconds / 3600, "core-hours"),
        Metric("model_million_sent", 1e6 * sent / 1e9, "GB"),
    ]


def play(workers: Workers, config: Config, plan: Sequence[Task]) -> tuple[int, int]:
    """Play the tasks as an evaluation does; returns their number and the bytes that are sent."""
    sent = 0
    with TemporaryDirectory() as folder:
        for result in completed(workers, partial(work, config), plan):
            sent += len(pickle.dumps(result))
            for record in result.rounds:
                append_round(Path(folder) / "rounds.jsonl", record)
    return len(plan), sent + sum(len(pickle.dumps((config, task))) for task in plan)


def call(workers: Workers, config: Config, size: int, count: int) -> tuple[int, int]:
    """The same without a scene: empty calls, whose results have `size` bytes."""
    answers = completed(workers, partial(empty, config, size), range(count))
    return count, sum(len(answer) for answer in answers)


def empty(config: Config, size: int, number: int) -> bytes:
    return bytes(size)


def measure(
    what: Callable[[], tuple[int, int]], scheduler: psutil.Process | None = None
) -> Measured:
    def cpu() -> float:
        return sum(scheduler.cpu_times()[:2]) if scheduler is not None else 0.0

    start, main_start, cpu_start = time.perf_counter(), time.process_time(), cpu()
    count, sent = what()
    spent = time.perf_counter() - start, time.process_time() - main_start, cpu() - cpu_start
    seconds, main_cpu, scheduler_cpu = (one / count for one in spent)
    return Measured(seconds, sent / count, main_cpu, scheduler_cpu)


# --- Killed workers -----------------------------------------------------------------------------


def killed(config: Config, plan: Sequence[Task], kills: int) -> list[Metric]:
    """The plan's rounds while `kills` busy workers die, against those that nothing disturbs."""
    with open_executor(config.compute, 2) as workers:
        expected = rounds(workers, config, plan)
        metrics = _survived("local", workers, config, plan, kills, expected)
    with local_cluster(2) as (address, scheduler):
        there = with_settings(config, "compute", {"scheduler": address})
        with open_executor(there.compute) as workers:
            metrics += _survived("dask", workers, config, plan, kills, expected)
    return metrics


def _survived(
    name: str,
    workers: Workers,
    config: Config,
    plan: Sequence[Task],
    kills: int,
    expected: Sequence[RoundRecord],
) -> list[Metric]:
    dead: list[int] = []

    def kill(finished: int) -> None:
        # Where the oldest one is busy, a younger one has ended a scene: they die in turn, and no
        # scene is killed as often as an executor allows.
        oldest = worker_processes()[0]
        if len(dead) < kills and is_busy(oldest):
            oldest.kill()
            dead.append(oldest.pid)

    got = rounds(workers, config, plan, kill)
    different = len(differing_rounds(expected, got)) + abs(len(expected) - len(got))
    return [
        Metric(f"{name}_workers_killed", len(dead), "workers", at_least=kills),
        Metric(f"{name}_rounds_played", len(got), "rounds"),
        Metric(f"{name}_rounds_different", different, "rounds", at_most=0),
    ]


def rounds(
    workers: Workers,
    config: Config,
    plan: Sequence[Task],
    after: Callable[[int], None] = lambda finished: None,
) -> list[RoundRecord]:
    """The rounds in order of their seeds; `after` is called with the number of finished tasks."""
    found: list[RoundRecord] = []
    for number, result in enumerate(completed(workers, partial(work, config), plan), 1):
        found += result.rounds
        after(number)
    return sorted(found, key=lambda record: record.seed)


def worker_processes() -> list[psutil.Process]:
    """The processes below this one that carry out calls, oldest first; multiprocessing has spawned
    them, for either engine."""
    below = psutil.Process().children(recursive=True)
    return sorted(filter(_is_spawned, below), key=lambda one: one.create_time())


def is_busy(process: psutil.Process) -> bool:
    """Whether a worker process carries out a call, by its CPU time in the next moment."""
    return process.cpu_percent(LOOK) > BUSY


def _is_spawned(process: psutil.Process) -> bool:
    try:
        return any("spawn_main" in word for word in process.cmdline())
    except psutil.NoSuchProcess:
        return False


# --- Clusters of this machine, by Dask's own commands -------------------------------------------


@contextmanager
def dask(
    host: str, count: int, commands: Sequence[tuple[Sequence[str], Sequence[str]]]
) -> Iterator[tuple[str, psutil.Process]]:
    """Start a scheduler and `count` workers; gives the scheduler's address and process.

    host: the scheduler's. commands: of the workers, each what stands before `dask worker` and the
    options behind it.
    """
    python = [sys.executable, "-m", "dask"]
    with TemporaryDirectory() as folder, worker_environment(), ExitStack() as stack:
        file = Path(folder) / "scheduler.json"
        common = ["--scheduler-file", str(file), "--no-dashboard"]
        scheduler = _start(stack, [*python, "scheduler", "--host", host, "--port", "0", *common])
        for before, options in commands:
            _start(stack, [*before, *python, "worker", "--nthreads", "1", *common, *options])
        with Client(scheduler_file=str(file), timeout=60, set_as_default=False) as client:
            client.wait_for_workers(count, timeout=120)
            address = client.scheduler.address
        yield address, psutil.Process(scheduler.pid)


def _start(stack: ExitStack, command: Sequence[str]) -> subprocess.Popen:
    process = subprocess.Popen(command, env=os.environ | DASK, stdin=subprocess.DEVNULL)
    stack.callback(process.wait)
    stack.callback(process.terminate)
    return process


def local_cluster(count: int) -> AbstractContextManager[tuple[str, psutil.Process]]:
    return dask("127.0.0.1", count, [((), ("--nworkers", str(count), "--host", "127.0.0.1"))])


@contextmanager
def two_nodes() -> Iterator[tuple[str, psutil.Process, Callable[[], int] | None]]:
    """A cluster whose two workers stand in networks of their own; gives the scheduler's address and
    process, and what counts the bytes between them, where that is possible."""
    namespaces = [f"{BRIDGE}{number}" for number in (1, 2)]
    with ExitStack() as stack:
        try:
            _make_network(stack, namespaces)
        except (OSError, subprocess.CalledProcessError):  # not Linux, or not root
            stack.close()
            hosts = ("127.0.0.2", "127.0.0.3")
            with dask("127.0.0.1", 2, [((), ("--host", host)) for host in hosts]) as cluster:
                yield *cluster, None
            return
        commands = [
            (("ip", "netns", "exec", name), ("--host", f"{NETWORK}.{number}"))
            for number, name in enumerate(namespaces, 2)
        ]

        def count() -> int:
            links = psutil.net_io_counters(pernic=True)
            return sum(links[name].bytes_sent + links[name].bytes_recv for name in namespaces)

        yield *stack.enter_context(dask(f"{NETWORK}.1", 2, commands)), count


def _make_network(stack: ExitStack, namespaces: Sequence[str]) -> None:
    """A bridge, and namespaces that are joined to it by a pair of virtual devices each."""

    def ip(command: str) -> None:
        subprocess.run(["ip", *command.split()], check=True, capture_output=True)

    ip(f"link add {BRIDGE} type bridge")
    stack.callback(ip, f"link del {BRIDGE}")
    ip(f"addr add {NETWORK}.1/24 dev {BRIDGE}")
    ip(f"link set {BRIDGE} up")
    for number, name in enumerate(namespaces, 2):
        ip(f"netns add {name}")
        stack.callback(ip, f"netns del {name}")
        ip(f"link add {name} type veth peer name eth0 netns {name}")
        ip(f"link set {name} master {BRIDGE} up")
        for what in (
            "link set lo up",
            f"addr add {NETWORK}.{number}/24 dev eth0",
            "link set eth0 up",
        ):
            ip(f"-n {name} {what}")


if __name__ == "__main__":
    from benchmarks import bench_scaling  # under which name a worker finds its functions

    run_script(bench_scaling.main)
