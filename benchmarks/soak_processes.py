"""Faults of disks, processes and machines: parts `disk`, `workers` and `stopped` of the soak.

A disk is a small file system in memory, which only root may mount. Workers hang, freeze or are slow
in the local pool and in a Dask cluster. Scripts are stopped at any moment, by SIGTERM as schedulers
do or by SIGKILL as a lack of memory does, and have to end with the results of a run that nobody
disturbed.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event

import numpy as np

from benchmarks.soak_files import KINDS, Kind
from benchmarks.soak_tally import Tally
from models.ppo import KIND as POLICY
from utils import executor
from utils.checkpoint import load_checkpoint
from utils.config import load_config, with_settings
from utils.config_schema import ComputeConfig
from utils.errors import UserError
from utils.executor import completed, open_executor
from utils.result_records import read_rounds, without_times
from utils.runs import REPOSITORY, TERMINATED

WRITES, CALLS, STOPS = 500, 20, 10  # of each kind
DISK = 4 * 1024**2  # bytes
JOURNAL = "rounds.jsonl"
WRITTEN = (JOURNAL, "network.pt", "shard.h5", "parts.npz", "config.yaml")
TIMEOUT = 3.0  # s of a call


# --- Disks ----------------------------------------------------------------------------------------


@contextmanager
def small_disk() -> Iterator[Path]:
    """A file system of DISK bytes. Raises UserError where this process may not mount one."""
    with TemporaryDirectory() as folder:
        options = ["-t", "tmpfs", "-o", f"size={DISK}", "tmpfs", folder]
        done = subprocess.run(["mount", *options], capture_output=True, text=True)
        if done.returncode:
            raise UserError(f"part disk: cannot mount a file system ({done.stderr.strip()})")
        try:
            yield Path(folder)
        finally:
            subprocess.run(["umount", folder], check=True)


def fill(disk: Path, left: int) -> None:
    """Leave `left` bytes, in whole pages, on a disk."""
    free = os.statvfs(disk).f_bavail * os.statvfs(disk).f_frsize
    (disk / "filler").write_bytes(bytes(max(free - left, 0)))


def make_read_only(disk: Path, read_only: bool) -> None:
    mode = "ro" if read_only else "rw"
    subprocess.run(["mount", "-o", f"remount,{mode}", str(disk)], check=True)


def soak_disk(scale: float, seed: int, stop: Event) -> Iterator[Tally]:
    """Files are written to a disk that is full or read-only: one sentence, and what was there
    stays; where there is room, the new file is whole."""
    random = np.random.default_rng(seed)
    kinds = [kind for kind in KINDS if kind.name in WRITTEN]
    for kind in kinds:
        full, locked = Tally(f"full disk: {kind.name}"), Tally(f"read-only folder: {kind.name}")
        yield full
        yield locked
        with small_disk() as disk:
            path = disk / kind.name
            kind.write(path)
            whole, refused = path.read_bytes(), 0
            for _ in range(round(WRITES * scale)):
                if stop.is_set():
                    break
                # A journal grows: it needs room only where it comes to the end of a page.
                times = int(random.integers(1, 20)) if kind.name == JOURNAL else 1
                before = times * whole
                path.write_bytes(before)
                fill(disk, int(random.integers(2 * len(before))) if times == 1 else 0)
                sound, lost, written = _try_to_write(kind, path, before, whole)
                full.add(sound, lost)
                refused += not written
                (disk / "filler").unlink()
                path.write_bytes(before)
                make_read_only(disk, True)
                sound, lost, written = _try_to_write(kind, path, before, whole)
                locked.add(sound and not written, lost)
                make_read_only(disk, False)
            full.note = f"{refused} of the writes found no room"


def _try_to_write(kind: Kind, path: Path, before: bytes, whole: bytes) -> tuple[bool, int, bool]:
    """Whether a write ended as it should, the number of files that are lost by it, and whether it
    was done.

    before: what the file holds. whole: what a write adds to a journal.
    """
    try:
        kind.write(path)
        sound = written = True
    except UserError:
        strays = [one for one in path.parent.iterdir() if one.name.startswith(f".{path.name}.")]
        sound, written = not strays, False
    except OSError:
        sound = written = False
    after = path.read_bytes()
    if kind.name == JOURNAL:
        kept = after.startswith(before) and after.endswith(b"\n")
        kept &= not written or after == before + whole
    else:
        kept = _is_read(kind, after) if written else after == before
    return sound, int(not kept), written


def _is_read(kind: Kind, content: bytes) -> bool:
    """Whether the program reads a file with this content."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "written" / kind.name
        path.parent.mkdir()
        path.write_bytes(content)
        try:
            kind.read(path)
        except Exception:  # whatever it raises, what was written is lost
            return False
    return True


# --- Workers --------------------------------------------------------------------------------------


def soak_workers(scale: float, seed: int, stop: Event) -> Iterator[Tally]:
    """Calls whose worker hangs, freezes or is slow, in both engines: the results have to be those
    of calls that nobody disturbed."""
    from benchmarks.bench_scaling import local_cluster  # Dask is optional

    executor.FREEZE_SECONDS = TIMEOUT
    local = with_settings(load_config(), "compute", {"timeout": TIMEOUT}).compute
    for name in FAULTS:
        tally = Tally(f"local workers {name}")
        yield tally
        _disturb(local, name, round(CALLS * scale), tally, stop)
    with local_cluster(2) as (address, _):
        cluster = local.model_copy(update={"scheduler": address})
        for name in ("hang", "are slow"):  # one that freezes costs five minutes
            tally = Tally(f"cluster's workers {name}")
            yield tally
            _disturb(cluster, name, round(CALLS * scale), tally, stop)


def _disturb(compute: ComputeConfig, fault: str, count: int, tally: Tally, stop: Event) -> None:
    """Make `count` calls, each of which is disturbed when it is made for the first time."""
    if stop.is_set():
        return
    disturb, times = FAULTS[fault]
    with TemporaryDirectory() as folder, open_executor(compute, 2) as workers:
        calls = partial(first_time, Path(folder), disturb)
        for number, square in completed(workers, calls, range(max(count, 1))):
            made = (Path(folder) / str(number)).stat().st_size
            tally.add(made == times, lost=square != number**2)


def first_time(folder: Path, fault: Callable[[], object], number: int) -> tuple[int, int]:
    """A number and its square; the first call for a number is disturbed. The number's file in the
    folder has a byte for each call."""
    with (folder / str(number)).open("ab") as calls:
        calls.write(b".")
        first = calls.tell() == 1
    if first:
        fault()
    return number, number**2


def _hang() -> None:
    time.sleep(3600)


def _freeze() -> None:
    os.kill(os.getpid(), signal.SIGSTOP)


def _nap() -> None:
    time.sleep(0.6 * TIMEOUT)


# What is done to a call, and how often it is made until there is a result: what is slow counts.
FAULTS = {"hang": (_hang, 2), "freeze": (_freeze, 2), "are slow": (_nap, 1)}


# --- Scripts that are stopped ---------------------------------------------------------------------

EVALUATION = (
    "evaluate.py", "evaluate.policies=heuristic", "evaluate.scenarios=isolated",
    "evaluate.object_sets=box", "evaluate.rounds=8", "evaluate.workers=1", "evaluate.videos=0",
    "evaluate.depth_noises=none", "evaluate.gallery=1", "sim.renderer=tiny",
)  # fmt: skip
TRAINING = (
    "train_rl.py", "rl.env_id=Pendulum-v1", "rl.parallel=false", "rl.envs=4", "rl.device=cpu",
    "rl.rollout_steps=64", "rl.batch_size=64", "rl.total_steps=8192", "rl.evaluate_every=4",
    "rl.evaluation_episodes=2",
)  # fmt: skip
ANNOUNCED = b"results in "  # of what the scripts print when they begin


def soak_stopped(scale: float, seed: int, stop: Event) -> Iterator[Tally]:
    """An evaluation and a training are stopped at random moments and resumed, until they end."""
    random = np.random.default_rng(seed)
    for name, command, result in (
        ("evaluation", EVALUATION, _rounds),
        ("training of PPO", TRAINING, _weights),
    ):
        with TemporaryDirectory() as folder:
            begun = time.perf_counter()
            _run(command, Path(folder) / "undisturbed")
            seconds = time.perf_counter() - begun
            expected = result(_run_folder(Path(folder) / "undisturbed"))
            for number, how in ((signal.SIGTERM, "SIGTERM"), (signal.SIGKILL, "SIGKILL")):
                tally = Tally(f"{how}: {name}")
                yield tally
                stops = ended = 0
                for turn in range(max(1, round(STOPS * scale))):
                    if stop.is_set():
                        break
                    place = Path(folder) / f"{how}{turn}"
                    sound, lost, count = _stopped(
                        command, place, number, seconds, random, result, expected
                    )
                    if count == 0 and sound and lost == 0:  # it ended before it was stopped
                        ended += 1
                        continue
                    tally.add(sound, lost)
                    stops += count
                tally.note = (
                    f"stopped {stops} times, then gone on with --resume, or begun anew where "
                    f"nothing was kept yet; {ended} more runs ended before they were stopped"
                )


def _stopped(
    command: Sequence[str],
    place: Path,
    number: int,
    seconds: float,
    random: np.random.Generator,
    result: Callable[[Path], list],
    expected: list,
) -> tuple[bool, int, int]:
    """Stop a script twice and then let it end: whether its exit statuses were right, how many of
    its results differ, and how often it was stopped."""
    sound, count = True, 0
    for _ in range(2):
        status, announced = _run(command, place, number, random.uniform(0.3, 0.9) * seconds)
        count += status != 0
        if number == signal.SIGTERM and status == -number:
            # Python itself is still starting or already ending where SIGTERM finds no handler.
            sound &= not announced or result(_run_folder(place)) == expected
        else:
            sound &= status in (0, TERMINATED, -signal.SIGKILL)
    sound &= _run(command, place)[0] == 0
    got = result(_run_folder(place))
    return sound, sum(a != b for a, b in zip(expected, got)) + abs(len(expected) - len(got)), count


def _run(
    command: Sequence[str], place: Path, number: int | None = None, after: float | None = None
) -> tuple[int, bool]:
    """Run a script in a folder, or go on there, and send it a signal after so many seconds; its
    exit status, and whether it has announced what it does, as a script does once it has begun."""
    place.mkdir(exist_ok=True)
    run, script = _run_folder(place), [sys.executable, str(REPOSITORY / command[0])]
    arguments = list(command[1:]) if run is None else ["--resume", str(run)]
    with (place / "log").open("w+b") as log:
        process = subprocess.Popen([*script, *arguments], cwd=place, stdout=log, stderr=log)
        try:
            status = process.wait(after)
        except subprocess.TimeoutExpired:
            process.send_signal(number)
            status = process.wait()
        log.seek(0)
        return status, ANNOUNCED in log.read()


def _run_folder(place: Path) -> Path | None:
    """The run that can be resumed in a folder."""
    for run in sorted(place.glob("runs/*/*")):
        held = (run / "config.yaml").is_file() and (run / "environment.json").is_file()
        if held and (run.parent.name == "evaluate" or (run / "last.pt").is_file()):
            return run
    return None


def _rounds(run: Path) -> list:
    rounds = sorted(read_rounds(run / "rounds.jsonl"), key=lambda record: record.seed)
    return [without_times(record) for record in rounds]


def _weights(run: Path) -> list:
    weights = load_checkpoint(run / "last.pt", POLICY)["model"]
    return [(name, weights[name].numpy().tobytes()) for name in sorted(weights)]
