"""A run of a script: its command line and exit status, and its folder.

`parse_args` and `run_script` frame every script. A run owns a folder runs/<script>/<time>-<name>/
with its config, the commit and the versions of the packages, so that it can be repeated.
`Stopwatch` measures where a program spends its time. This module knows nothing of what a run
computes.
"""

from __future__ import annotations

import argparse
import errno
import hashlib
import json
import math
import os
import platform
import re
import signal
import subprocess
import sys
import time
import warnings
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from datetime import datetime
from importlib.machinery import PathFinder
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any, NamedTuple, NoReturn, TextIO

from tqdm import tqdm

from utils.atomic_files import (
    DISK_ERRORS,
    command_line,
    locked,
    resumption,
    write_atomic,
    write_json_atomic,
)
from utils.config import DEFAULTS, Config, ConfigError, dump_config, load_config
from utils.errors import UserError, one_line
from utils.plugins import is_import_path

REPOSITORY = Path(__file__).resolve().parent.parent
PACKAGES = (  # whose versions may change a result
    "numpy", "scipy", "torch", "torchvision", "pybullet", "mujoco", "gymnasium", "pydantic",
    "opencv-python-headless", "pillow", "trimesh", "manifold3d", "pycollada", "yourdfpy",
    "h5py", "numba", "llvmlite",
)  # fmt: skip
SCHEMA = 1  # version of results.json
CONTINUED = "continued"  # of environment.json
CPU_QUOTA = Path("/sys/fs/cgroup/cpu.max")  # of the container, where it has one
INTERRUPTED, TERMINATED = 128 + signal.SIGINT, 128 + signal.SIGTERM  # exit statuses
UNREAD = 128 + 13  # as of SIGPIPE, which Windows has not
NO_MEMORY = re.compile("can't allocate memory|CUDA out of memory")  # torch's RuntimeErrors


class GitState(NamedTuple):
    """The commit's hash (None outside a repository) and whether tracked files differ from it."""

    commit: str | None
    dirty: bool | None


_LONGEST_NAME = 150  # bytes; systems allow 255, and names get endings


def portable_name(text: str) -> str:
    """A name of a file or folder on every system, of text that may hold paths or MODULE:NAME. A
    long one ends in a hash."""
    name = re.sub(r"[^\w.+-]", "_", text)
    if len(name.encode()) <= _LONGEST_NAME:
        return name
    ending = "-" + hashlib.sha256(text.encode()).hexdigest()[:8]
    return name.encode()[: _LONGEST_NAME - len(ending)].decode(errors="ignore") + ending


# --- Command line and exit status -------------------------------------------------------------


def parse_args(
    argv: Sequence[str] | None,
    description: str,
    extra: Callable[[argparse.ArgumentParser], None] | None = None,
    resumes: bool = True,
) -> tuple[Config, argparse.Namespace]:
    """A script's command line: --config FILE, --resume RUN and dotted overrides.

    argv: arguments without the program's name; None takes those of the process.
    extra: adds the script's own options to the parser. resumes: False for a script without runs.
    With --resume the config of that run is taken (its config.yaml), overrides still apply.
    Returns the config and the parsed options (config, resume: Path or None, and the extra ones).
    Raises ConfigError; an unknown option ends the program with status 2, as argparse does.
    """
    parser = _Parser(
        description=description, epilog=f"All keys, their units and defaults: {DEFAULTS}"
    )
    source = parser.add_mutually_exclusive_group()
    source.add_argument("--config", type=Path, metavar="FILE", help="YAML laid over the defaults")
    if resumes:
        source.add_argument("--resume", type=Path, metavar="RUN", help="a run's folder, to go on")
    parser.add_argument(
        "overrides", nargs="*", metavar="KEY=VALUE", help="any key of the configuration"
    )
    if extra is not None:
        extra(parser)
    options = parser.parse_intermixed_args(argv)
    path = options.config
    if resumes and options.resume is not None:
        path = options.resume / "config.yaml"
        missing = [
            file for file in (path, options.resume / "environment.json") if not file.is_file()
        ]
        if missing:
            there = options.resume.is_dir()
            lack = f"no {missing[0].name} in there" if there else "no such folder"
            raise ConfigError(
                f"--resume {options.resume}: {lack}; give the folder of a run, such as "
                f"runs/{Path(parser.prog).stem}/20250131-120000"
            )
    return load_config(path, options.overrides), options


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        if message.startswith("unrecognized"):
            message += "; a setting is written KEY=VALUE, such as evaluate.rounds=50"
        super().error(message)


def this_python() -> str:
    """The interpreter as a command line of the current folder names it: '.venv/bin/python'."""
    here, interpreter = Path.cwd(), Path(sys.executable)
    if interpreter.is_relative_to(here):
        interpreter = interpreter.relative_to(here)
    return command_line([str(interpreter)])


def resume_command(script: str, run: Path, files: Mapping[str, Path | None] | None = None) -> str:
    """The command that goes on with a run of 'SCRIPT.py' and writes the files of the same options:
    '.venv/bin/python SCRIPT.py --resume RUN --csv FILE', by torchrun where that started this."""
    ranks = os.environ.get("LOCAL_WORLD_SIZE", "1")
    launch = "" if ranks == "1" else f"-m torch.distributed.run --nproc_per_node={ranks} "
    return f"{this_python()} {launch}{script} {resumption(run, files or {})}"


@contextmanager
def collected_remarks() -> Iterator[list[str]]:
    """A list to which this project's remarks go at the end, which are `UserWarning`s, instead of
    stderr."""
    texts: list[str] = []
    told: list[warnings.WarningMessage] = []
    failed = True
    try:
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always", UserWarning)
            yield texts
        failed = False
    finally:
        for one in told:
            # After an error nobody prints the list, and it may be what a remark explains.
            if failed or one.category is not UserWarning:
                warnings.showwarning(one.message, one.category, one.filename, one.lineno)
            else:
                texts.append(" ".join(str(one.message).split()))


def plain_remarks(in_a_worker: bool = False) -> None:
    """Print this project's remarks, which are `UserWarning`s, as one plain line each: above the
    progress bars of a terminal, and in a file, or from a worker, below what they have written."""
    whole = warnings.formatwarning

    def plain(
        message: Warning | str,
        category: type[Warning],
        filename: str,
        lineno: int,
        line: str | None = None,
    ) -> str:
        if category is UserWarning:
            return f"note: {' '.join(str(message).split())}\n"
        return whole(message, category, filename, lineno, line)

    def show(
        message: Warning | str,
        category: type[Warning],
        filename: str,
        lineno: int,
        file: TextIO | None = None,
        line: str | None = None,
    ) -> None:
        stream = sys.stderr if file is None else file
        if stream is None:  # as of a program without a console
            return
        text = warnings.formatwarning(message, category, filename, lineno, line)
        bars = in_a_worker or bool(getattr(tqdm, "_instances", ()))
        if stream.isatty() and not in_a_worker:
            tqdm.write(text, file=stream, end="")
        else:  # nothing wipes the bars out, and their line lacks its end
            stream.write("\n" * bars + text)

    warnings.formatwarning, warnings.showwarning = plain, show


def run_script(main: Callable[[Sequence[str]], int | None]) -> NoReturn:
    """Run `main(argv)` and exit with its status (None is 0).

    The current folder becomes importable for plug-ins (`utils.plugins`), here and in the processes
    that the script starts: by itself Python adds the script's own folder only.
    A user error becomes one line on stderr and status 2, and so do a disk that is full, a folder
    that cannot be written, a name that is too long and memory that does not suffice. Ctrl-C ends
    with status 130; SIGTERM, by which schedulers end a job, does the same as Ctrl-C and ends with
    status 143. Where whoever reads the output has ended before, as `head` does, nothing is said and
    the status is 141. Any other exception is a bug and keeps its traceback.
    """
    if str(Path.cwd()) not in sys.path:
        sys.path.append(str(Path.cwd()))
    plain_remarks()
    terminated = []

    def terminate(number: int, frame: FrameType | None) -> None:
        terminated.append(True)
        handler = signal.getsignal(signal.SIGINT)  # whoever handles Ctrl-C now
        if not callable(handler):  # it is ignored, as by a shell's background jobs
            raise KeyboardInterrupt
        handler(number, frame)

    before = signal.signal(signal.SIGTERM, terminate)
    try:
        status = main(sys.argv[1:])
        sys.stdout.flush()  # here, where an error can still be handled
    except UserError as error:
        # A process that loads images sends an error as a traceback, with the sentence at its end.
        sentence = one_line(error).rpartition(f".{UserError.__name__}: ")[2]
        print(f"error: {sentence}", file=sys.stderr)
        status = 2
    except BrokenPipeError:
        if not _drop_unread():
            raise
        status = UNREAD
    except OSError as error:
        if error.errno not in (*DISK_ERRORS, errno.ENAMETOOLONG):
            raise
        too_long = error.errno == errno.ENAMETOOLONG
        advice = "give a shorter name" if too_long else "make room or choose another folder"
        print(f"error: {one_line(error)}; {advice}", file=sys.stderr)
        status = 2
    except (MemoryError, RuntimeError) as error:
        if not (isinstance(error, MemoryError) or NO_MEMORY.search(str(error))):
            raise
        print(f"error: out of memory ({one_line(error)}); ask for less at a time", file=sys.stderr)
        status = 2
    except KeyboardInterrupt:
        print("terminated" if terminated else "interrupted", file=sys.stderr)
        status = INTERRUPTED
    finally:
        signal.signal(signal.SIGTERM, before)
    sys.exit(TERMINATED if terminated and status == INTERRUPTED else status or 0)


def _drop_unread() -> bool:
    """Whether nobody reads stdout or stderr any more: what is left of both then goes nowhere, or
    Python's own flush at the end would fail once more."""
    for stream in (sys.stdout, sys.stderr):
        try:
            print(file=stream, flush=True)  # a flush alone has nothing to write where none buffers
        except BrokenPipeError:
            nowhere = os.open(os.devnull, os.O_WRONLY)
            for dropped in (sys.stdout, sys.stderr):
                os.dup2(nowhere, dropped.fileno())
            return True
    return False


# --- Run folders ---------------------------------------------------------------------------


@contextmanager
def open_run(
    resumed: Path | None, script: str, name: str | None, config: Config, root: Path = Path("runs")
) -> Iterator[Path]:
    """The folder of a run, in which no other process works within this context: a new one, or the
    one that is `resumed`, whose config.yaml gets the keys that have changed, so that it can be
    resumed again as it is. Raises UserError where another process works there, or another script
    made it."""
    run = new_run_folder(script, name, config, root) if resumed is None else resumed
    made_by = begun_with(run).get("script", script)
    if made_by != script:
        raise UserError(
            f"--resume {run}: it is a run of {made_by}.py; go on with {made_by}.py, or give the "
            f"folder of a run of {script}.py"
        )
    refusal = "another process works in this run; wait until it has ended, or start a new run"
    with locked(run / ".lock", f"{run}: {refusal}"):
        if resumed is not None:
            write_atomic(run / "config.yaml", dump_config(config))
        yield run


def new_run_folder(
    script: str, name: str | None, config: Config, root: Path = Path("runs")
) -> Path:
    """Make root/<script>/<time>-<name>/ with config.yaml and environment.json; returns its path.

    The time is local, to the second; a number is added where that folder already exists.
    """
    folder = timed_folder(root / script, name)
    write_atomic(folder / "config.yaml", dump_config(config))
    write_json_atomic(
        folder / "environment.json",
        environment() | {"script": script, "files": named_files(config)},
    )
    return folder


def timed_folder(parent: Path, name: str | None = None) -> Path:
    """Make parent/<time>-<name>/, which no other run has; returns its path. Raises UserError where
    that cannot be done."""
    stem = datetime.now().strftime("%Y%m%d-%H%M%S") + (f"-{name}" if name else "")
    return _make_new(parent, stem)


def run_of_job(script: str, config: Config, root: Path = Path("runs")) -> Path | None:
    """The folder that this job of `torchrun` (its --rdzv-id) has made for the same config, before
    it was started again; None outside a job, or where there is none."""
    job = torchrun_job()
    for folder in sorted((root / script).glob("*/"), reverse=True) if job is not None else ():
        try:
            facts = json.loads((folder / "environment.json").read_text(encoding="utf-8"))
            same = (folder / "config.yaml").read_text(encoding="utf-8") == dump_config(config)
        except (OSError, ValueError):  # no run of this version, or one that is being made
            continue
        if same and facts.get("torchrun_job") == job:
            return folder
    return None


def torchrun_job() -> str | None:
    """The name of the job of `torchrun` that started this process, which its restarts share."""
    job = os.environ.get("TORCHELASTIC_RUN_ID")
    return None if job == "none" else job  # what torchrun calls every job without a name


def check_resume(
    config: Config, run: Path | None, free_keys: Collection[str], checkpoints: Collection[str] = ()
) -> None:
    """Raise UserError if `run` cannot be resumed with this config, which must be that of the run
    but for the dotted keys in `free_keys`.

    checkpoints: patterns of files such as "last.pt", of which the run must hold at least one.
    run: None where a new run is started, which is always allowed. Warns where the run was begun
    with other code, packages or files than it goes on with, which results.json will not name.
    """
    if run is None:
        return
    if checkpoints and not any(any(run.glob(pattern)) for pattern in checkpoints):
        raise UserError(f"--resume {run}: no {' or '.join(checkpoints)} in there; start a new run")
    before, now = load_config(run / "config.yaml").model_dump(), config.model_dump()
    for key in free_keys:
        section, _, name = key.partition(".")
        del before[section][name], now[section][name]
    if before != now:
        raise UserError(
            f"--resume {run}: only {', '.join(sorted(free_keys))} may differ from the run that is "
            "resumed; start a new run for anything else"
        )
    changed = _changed_since(run, config)
    if changed:
        warnings.warn(
            f"--resume {run}: it was begun {', '.join(changed)}; where the two compute otherwise, "
            "its figures are of neither",
            stacklevel=2,
        )


def begun_with(run: Path) -> dict[str, Any]:
    """The environment.json of a run folder; empty where that is not known."""
    try:
        return dict(json.loads((run / "environment.json").read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return {}


def code_of(run: Path) -> list[str]:
    """With which code a run was begun and continued, one entry for each change: 'commit 0123456789'
    or 'commit 0123456789 with changes 01234567'; empty where that is not known."""
    return [
        f"commit {facts['commit'][:10]}"
        + (f" with changes {facts['changes'][:8]}" if facts.get("changes") else "")
        for facts in code_states(run)
        if facts.get("commit")
    ]


def code_states(run: Path) -> list[dict[str, Any]]:
    """The facts with which a run began, and commit and changes of the code whenever it was
    continued with other ones."""
    begun = begun_with(run)
    states = [begun, *begun.get(CONTINUED, [])]
    # Earlier versions noted so that nothing but pages and tables had been changed.
    nothing = hashlib.sha256(b"").hexdigest()
    return [{**one, "changes": None} if one.get("changes") == nothing else one for one in states]


def note_code(run: Path) -> None:
    """Add the present code to the environment.json of a run that goes on, where it is known and
    another than the last. run: its folder, or the one of a part of it, as of a column."""
    run = next((one for one in (run, *run.parents) if (one / "environment.json").exists()), run)
    begun, *later = code_states(run)
    now = {name: value for name, value in environment().items() if name in ("commit", "changes")}
    last = later[-1] if later else begun
    if begun and now["commit"] and any(last.get(name) != value for name, value in now.items()):
        write_json_atomic(run / "environment.json", begun | {CONTINUED: [*later, now]})


def _changed_since(run: Path, config: Config) -> list[str]:
    """What is not as it was when a run began, in words; what was not noted counts as the same."""
    (begun, *_), now = code_states(run), environment()
    changed = []
    if None not in (begun.get("commit"), now["commit"]) and begun["commit"] != now["commit"]:
        changed.append(f"at commit {begun['commit'][:10]} and goes on at {now['commit'][:10]}")
    elif begun.get("changes", now["changes"]) != now["changes"]:
        changed.append("with other changes to the code since the last commit")
    for name, version_then in begun.get("packages", {}).items():
        version_now = now["packages"].get(name, version_then)
        if version_now != version_then:
            changed.append(f"with {name} {version_then} and goes on with {version_now}")
    files = named_files(config)
    for name, digest in begun.get("files", {}).items():
        if files.get(name, digest) != digest:
            changed.append(f"with another content of {name}")
    return changed


def named_files(config: Config) -> dict[str, str]:
    """SHA-256 of each file that a config names, and of the module of each plug-in, by their names
    there. Folders are left out: `object_sets` and data may be large."""
    found = {}
    for text in _texts(config.model_dump(mode="json")):
        with suppress(OSError, ValueError):  # no path of this system
            file = _file_named(text)
            if file is not None:
                found[text] = hashlib.sha256(file.read_bytes()).hexdigest()
    return found


def _texts(values: Any) -> Iterator[str]:
    """All texts in the plain data of a config."""
    if isinstance(values, str):
        yield values
    elif isinstance(values, Mapping):
        for value in values.values():
            yield from _texts(value)
    elif isinstance(values, list | tuple):
        for value in values:
            yield from _texts(value)


def _file_named(text: str) -> Path | None:
    """The file that FILE, KIND:FILE or MODULE:NAME names, if there is one."""
    if is_import_path(text) and (module := _file_of_module(text.partition(":")[0])) is not None:
        return module
    files = (Path(name) for name in (text, text.partition(":")[2]))
    return next((file for file in files if file.is_file()), None)


def _file_of_module(name: str) -> Path | None:
    """The file that a dotted module would be loaded from; no code of it or its packages runs."""
    folders, spec = None, None
    for depth in range(1, name.count(".") + 2):
        spec = PathFinder.find_spec(".".join(name.split(".")[:depth]), folders)
        if spec is None:
            return None
        folders = spec.submodule_search_locations
    return Path(spec.origin) if spec is not None and spec.has_location and spec.origin else None


def save_results(path: Path, content: Mapping[str, Any], run: Path | None) -> None:
    """Write results.json: `content` with `origin_of` the run; None for what is no run's.

    Raises ValueError on NaN or infinity before touching the file.
    """
    write_json_atomic(path, {"schema": SCHEMA} | origin_of(run) | dict(content))


def origin_of(run: Path | None) -> dict[str, Any]:
    """The commit, whether code was changed since then, and the versions of Python and of the
    packages, with which a run began; `written_at`, the present commit, where that is another."""
    now = environment()
    begun = now if run is None else now | begun_with(run)
    origin = {"commit": begun["commit"], "dirty": begun["dirty"] or now["dirty"]}
    if now["commit"] not in (None, begun["commit"]):
        origin["written_at"] = now["commit"]
    return origin | {"versions": {"python": begun["python"], **begun["packages"]}}


def _make_new(parent: Path, stem: str) -> Path:
    """mkdir decides who owns a name, so two runs started together cannot share a folder."""
    try:
        parent.mkdir(parents=True, exist_ok=True)
        number = 1
        while True:
            folder = parent / (stem if number == 1 else f"{stem}-{number}")
            try:
                folder.mkdir()
                return folder
            except FileExistsError:
                number += 1
    except OSError as error:
        raise UserError(f"{parent}: cannot make a run folder here: {error.strerror}") from error


def environment() -> dict[str, Any]:
    """What the run ran on, ready for JSON."""
    commit, dirty = git_state()
    return {
        "commit": commit,
        "dirty": dirty,
        "changes": _changes() if dirty else None,
        "command": sys.argv,
        "torchrun_job": torchrun_job(),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "processor": _processor(),
        "cpu_count": os.cpu_count(),
        "packages": {name: package_version(name) for name in PACKAGES},
    }


def _processor() -> str:
    """Its name: Bullet's solver and linear algebra compute other last digits on another one."""
    with suppress(OSError):  # Linux has it; Python's own answer there is empty
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor()


def usable_cpus() -> int:
    """The CPUs for the workers of this process: those that the system lets it use, as a scheduler's
    job, a container or `taskset` may limit them, shared with the other processes of `torchrun` on
    this machine; at least 1."""
    affinity = getattr(os, "sched_getaffinity", None)  # Linux alone has it
    count = len(affinity(0)) if affinity is not None else os.cpu_count() or 1
    with suppress(OSError, ValueError):  # Linux has it: "250000 100000", or "max 100000"
        quota, period = CPU_QUOTA.read_text().split()
        count = min(count, math.ceil(int(quota) / int(period)))
    return max(1, count // int(os.environ.get("LOCAL_WORLD_SIZE", 1)))


def git_state(folder: Path = REPOSITORY) -> GitState:
    """The commit of the repository whose top is `folder`, and none of one around it, which knows
    nothing of our files; never raises."""
    at_top = _git(folder, "rev-parse", "--show-prefix") == ""
    commit = _git(folder, "rev-parse", "--verify", "HEAD") if at_top else None
    changes = _git(folder, "status", "--porcelain", "--untracked-files=no") if commit else None
    return GitState(commit, None if changes is None else bool(changes))


def _changes() -> str | None:
    """A digest of the repository's uncommitted changes, but for those of pages and tables; None
    where there are no others."""
    changes = _git(REPOSITORY, "diff", "HEAD", "--", ".", ":(exclude)docs", ":(exclude)*.md")
    return hashlib.sha256(changes.encode()).hexdigest() if changes else None


def _git(folder: Path, *arguments: str) -> str | None:
    try:
        done = subprocess.run(
            ["git", "-C", str(folder), *arguments], capture_output=True, text=True, timeout=10
        )
    except (OSError, subprocess.TimeoutExpired):  # no git on this machine, or a stuck disk
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def package_version(package: str) -> str | None:
    """The version of an installed package, None where it is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


# --- Time -------------------------------------------------------------------------------------


class Stopwatch:
    """Sums up the seconds spent in `with watch("simulation"): ...` by name; blocks do not nest.

    All the time since `start` that is outside such blocks counts as overhead.
    """

    OVERHEAD = "overhead"

    def __init__(self) -> None:
        self.start()

    def start(self) -> None:
        """Forget everything and begin anew."""
        self._spent: defaultdict[str, float] = defaultdict(float)
        self._begun = time.perf_counter()

    def __call__(self, name: str) -> Stopwatch:
        self._name = name
        return self

    def __enter__(self) -> None:
        self._since = time.perf_counter()

    def __exit__(
        self, kind: type | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._spent[self._name] += time.perf_counter() - self._since

    def seconds(self) -> dict[str, float]:
        """Seconds by name, the overhead last; they sum up to the time since `start`."""
        total = time.perf_counter() - self._begun
        return dict(self._spent) | {self.OVERHEAD: total - sum(self._spent.values())}
