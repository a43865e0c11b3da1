"""The processes of one training: devices, what they exchange, their folder, and a clean Ctrl-C.

`torchrun` starts the processes; without it a training is a team of one. Collective operations give
the same result bit for bit in every process, so that all processes take the same steps. Where it
starts them again after a loss, they find their run's folder and so its last checkpoint. This module
knows no network and no data.
"""

from __future__ import annotations

import math
import signal
import sys
import time
import uuid
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from datetime import timedelta
from pathlib import Path
from threading import Event
from types import FrameType
from typing import Any, NamedTuple

import torch
import torch.distributed as dist
from torch import nn

from utils.config import Config, with_settings
from utils.errors import UserError
from utils.run_checks import check_data, keep_data
from utils.runs import note_code, open_run, run_of_job

# For which processes wait for each other: one may play its last shard of data once more after
# compute.timeout, of half an hour by default. torchrun itself ends those whose partner is gone.
_PATIENCE = timedelta(hours=2)
MEETING_SECONDS = 0.05  # between two looks of the main process at who has come
# A terminal and torchrun may both pass on one Ctrl-C.
SAME_INTERRUPT = 1.0  # s


class Team(NamedTuple):
    """This process among those that train together: its rank, the number of processes (`ranks`)
    and its device."""

    rank: int
    ranks: int
    device: torch.device

    @property
    def is_main(self) -> bool:
        """Whether this is the main process, which alone writes files and prints."""
        return self.rank == 0

    def wait(self) -> None:
        """Block until every process has reached this call."""
        if self.ranks > 1:
            dist.barrier()

    def any(self, flag: bool) -> bool:
        """Whether the flag is set in at least one process."""
        if self.ranks == 1:
            return flag
        found = torch.tensor(float(flag), device=self.device)
        dist.all_reduce(found, dist.ReduceOp.MAX)
        return bool(found)

    def broadcast(self, value: Any) -> Any:
        """Return the main process's value in every process."""
        holder = [value]
        if self.ranks > 1:
            dist.broadcast_object_list(holder, src=0)
        return holder[0]

    def concatenate(self, own: list) -> list:
        """Return the lists of all processes behind one another, in the order of the ranks."""
        if self.ranks == 1:
            return own
        lists: list[Any] = [None] * self.ranks
        dist.all_gather_object(lists, own)
        return [item for part in lists for item in part]

    def gather(self, tensor: torch.Tensor) -> torch.Tensor:
        """(ranks, ...) the tensor of every process; all have the same shape."""
        if self.ranks == 1:
            return tensor[None]
        parts = [torch.empty_like(tensor) for _ in range(self.ranks)]
        dist.all_gather(parts, tensor.contiguous())
        return torch.stack(parts)

    def average(self, tensor: torch.Tensor) -> None:
        """Replace a tensor in place by its mean over the processes."""
        if self.ranks > 1:
            dist.all_reduce(tensor)
            tensor /= self.ranks

    def share_weights(self, module: nn.Module) -> None:
        """Copy the main process's weights and buffers into every process."""
        if self.ranks > 1:
            for value in module.state_dict().values():
                dist.broadcast(value, src=0)


ALONE = Team(0, 1, torch.device("cpu"))


@contextmanager
def team(device: str, environment: Mapping[str, str], key: str = "train.device") -> Iterator[Team]:
    """Join the process group that `torchrun` describes in `environment`, or train alone.

    device: auto | cpu | cuda | cuda:N; auto takes a GPU where there is one. key: the config key
    that error messages name. Raises UserError for a device that this machine lacks, or for one GPU
    that several processes would have to share.
    """
    ranks = int(environment.get("WORLD_SIZE", 1))
    local = int(environment.get("LOCAL_RANK", 0))
    if ranks > 1 and device.startswith("cuda:"):
        raise UserError(
            f"{key}={device}: {ranks} processes cannot share one GPU; choose cuda or auto, and "
            "each takes its own"
        )
    chosen = choose_device(device, local, key)
    if ranks == 1:
        yield Team(0, 1, chosen)
        return
    if chosen.type == "cuda":  # objects are broadcast by way of the current device
        torch.cuda.set_device(chosen)
    # torchrun keeps its store when it starts the processes again: without a prefix they would find
    # the addresses of those that are gone, and fail or wait for ever.
    store, rank, _ = next(dist.rendezvous("env://"))
    dist.init_process_group(
        "nccl" if chosen.type == "cuda" else "gloo",
        store=dist.PrefixStore(new_prefix(store, rank, ranks), store), rank=rank, world_size=ranks,
        timeout=_PATIENCE,
    )  # fmt: skip
    try:
        yield Team(dist.get_rank(), ranks, chosen)
    finally:
        dist.destroy_process_group()


def new_prefix(store: dist.Store, rank: int, ranks: int) -> str:
    """A prefix for keys that all processes of this start agree on, and none of an earlier start.

    torchrun gives them none: each machine counts its own restarts. So every process leaves a random
    name in the store, and the main process answers each name that it reads with its own, which is
    the prefix, until all have come. Names that earlier processes left are answered too, but nobody
    reads that. Raises DistStoreError if a process does not come within the store's timeout.
    """
    own = uuid.uuid4().hex
    if rank > 0:
        store.set(f"hello {rank}", own)
        prefix = store.get(f"answer to {own}").decode()
        store.add(f"arrived at {prefix}", 1)
        return prefix
    deadline = time.monotonic() + store.timeout.total_seconds()
    while store.add(f"arrived at {own}", 0) < ranks - 1:
        if time.monotonic() > deadline:
            raise dist.DistStoreError(f"not all of {ranks} processes have started")
        for other in range(1, ranks):
            if store.check([f"hello {other}"]):
                store.set(f"answer to {store.get(f'hello {other}').decode()}", own)
        time.sleep(MEETING_SECONDS)
    return own


def choose_device(name: str, local_rank: int = 0, key: str = "train.device") -> torch.device:
    """Return the torch device of that name for the process `local_rank` of this machine; raise
    UserError if the machine does not have it."""
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
    except RuntimeError:
        device = None
    if device is None or device.type not in ("cpu", "cuda"):
        raise UserError(f"{key}: got {name!r}, expected auto, cpu, cuda or cuda:N")
    if device.type == "cuda":
        count = torch.cuda.device_count()
        index = local_rank if device.index is None else device.index
        if device.index is None and 0 < count <= local_rank:
            raise UserError(
                f"{key}: each process needs a GPU of its own, and this machine has {count}; start "
                f"at most {count} processes (--nproc_per_node={count}), or set {key}=cpu"
            )
        if index >= count:
            raise UserError(f"{key}={name}: this machine has {count} CUDA GPUs; use {key}=auto")
        device = torch.device("cuda", index)
    return device


@contextmanager
def run_folder(
    script: str, name: str | None, config: Config, resume: Path | None, processes: Team,
    data: Mapping[str, str] | None = None,
) -> Iterator[Path]:  # fmt: skip
    """The folder of a training's run, in every process of it; no other training works there within
    this context, see `utils.runs.open_run`.

    resume: the folder to go on with; None for a new one, or the one that the processes have made
    before `torchrun` started them again, because one was lost or others joined. data: what the
    training learns from, which must be what the run was begun with (`utils.run_checks`).
    """
    with ExitStack() as opened:
        folder = resume
        if processes.is_main:
            # torchrun has ended those before; a machine that was lost may hold its lock for long.
            again = run_of_job(script, config) if resume is None else None
            folder = again or opened.enter_context(open_run(resume, script, name, config))
            if data is not None:
                check_data(folder, data)
                keep_data(folder, data)
            note_code(folder)
        yield Path(processes.broadcast(str(folder)))


def without_initial(config: Config, section: str, run: Path | None) -> Config:
    """The config with which the training in a run's folder makes its network: without the weights
    of SECTION.initial, whose file may be gone, where a last.pt holds later ones. run: None for a
    new one."""
    if run is None or not any(run.rglob("last.pt")):
        return config
    return with_settings(config, section, {"initial": None})


@contextmanager
def stop_on_interrupt(message: str | None = None) -> Iterator[Event]:
    """Yield an event that Ctrl-C sets, or SIGTERM within `utils.runs.run_script`, so that the work
    stops between two whole steps; `message` is then printed at once. Where such a step does not
    end, another Ctrl-C raises KeyboardInterrupt; another SIGTERM, as schedulers repeat it, does
    not."""
    interrupted, first = Event(), math.inf

    def stop(number: int, frame: FrameType | None) -> None:
        nonlocal first
        if not interrupted.is_set():
            first = time.monotonic()
            if message is not None:
                print(f"\n{message}\nCtrl-C again stops at once", file=sys.stderr, flush=True)
        elif number == signal.SIGINT and time.monotonic() - first > SAME_INTERRUPT:
            raise KeyboardInterrupt
        interrupted.set()

    before = signal.signal(signal.SIGINT, stop)
    try:
        yield interrupted
    finally:
        signal.signal(signal.SIGINT, before)
