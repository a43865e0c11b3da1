"""Devices, process groups and Ctrl-C of a training."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta

import pytest
import torch

from utils import distributed
from utils.config import load_config
from utils.distributed import ALONE, Team, choose_device, new_prefix, stop_on_interrupt, team
from utils.errors import UserError
from utils.runs import REPOSITORY


@pytest.mark.parametrize("name", ["gpu", "cpu0x", "meta", "mps", ""])
def test_names_that_are_no_device(name):
    with pytest.raises(UserError, match="expected auto, cpu, cuda"):
        choose_device(name)


def test_auto_is_the_process_s_gpu_and_a_gpu_that_is_missing_is_refused(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    assert choose_device("auto") == choose_device("cpu") == torch.device("cpu")
    with pytest.raises(UserError, match="train.device=cuda: this machine has 0 CUDA GPUs"):
        choose_device("cuda")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert choose_device("auto", local_rank=1) == torch.device("cuda", 1)
    assert choose_device("cuda:0", local_rank=1) == torch.device("cuda", 0)
    with pytest.raises(UserError, match="cuda:2: this machine has 2 CUDA GPUs"):
        choose_device("cuda:2")


@pytest.mark.parametrize("name", ["auto", "cuda"])
def test_more_processes_than_gpus_are_told_how_many_may_start(name, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    assert choose_device(name, local_rank=0) == torch.device("cuda", 0)
    told = r"^rl.device: .* has 1; .*\(--nproc_per_node=1\), or set rl.device=cpu$"
    with pytest.raises(UserError, match=told):
        choose_device(name, local_rank=1, key="rl.device")


def test_several_processes_do_not_share_one_gpu():
    with (
        pytest.raises(UserError, match="cuda:0: 2 processes cannot share one GPU.*cuda or auto"),
        team("cuda:0", {"WORLD_SIZE": "2", "LOCAL_RANK": "1"}),
    ):
        pass


def test_a_process_takes_its_gpu_before_it_talks_to_the_others(monkeypatch):
    calls = []
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "set_device", calls.append)

    def init(backend, store, rank, world_size, timeout):
        calls.append(backend)
        # One may wait for the other's shard of data, played once more after compute.timeout.
        assert timeout.total_seconds() >= 2 * load_config(None, []).compute.timeout
        store.set("address", "of this start")
        assert (rank, world_size) == (1, 2)

    kept = torch.distributed.HashStore()
    met = iter([(kept, 1, 2)])
    monkeypatch.setattr(torch.distributed, "rendezvous", lambda url: met)
    monkeypatch.setattr(distributed, "new_prefix", lambda store, rank, ranks: "third start")
    monkeypatch.setattr(torch.distributed, "init_process_group", init)
    monkeypatch.setattr(torch.distributed, "get_rank", lambda: 1)
    monkeypatch.setattr(torch.distributed, "destroy_process_group", lambda: None)
    with team("cuda", {"WORLD_SIZE": "2", "LOCAL_RANK": "1"}) as us:
        assert us == Team(1, 2, torch.device("cuda", 1))
    assert calls == [torch.device("cuda", 1), "nccl"]
    # torchrun keeps the store: what one start writes there, the next one must not read.
    assert not kept.check(["address"]) and kept.get("third start/address") == b"of this start"


def test_the_processes_of_each_start_agree_on_a_new_prefix():
    """In the one store, with fewer or more of them, in any order, and after a start that failed."""
    store = torch.distributed.HashStore()
    seen = set()
    for ranks in (3, 2, 4):
        store.set("hello 1", "of a process that was lost")
        with ThreadPoolExecutor(ranks) as threads:
            calls = [threads.submit(new_prefix, store, rank, ranks) for rank in range(ranks)]
            (prefix,) = {call.result(timeout=30) for call in calls[::-1]}
        assert prefix not in seen
        seen.add(prefix)


def test_a_process_that_does_not_come_is_an_error():
    store = torch.distributed.HashStore()
    store.set_timeout(timedelta(seconds=0.1))
    with pytest.raises(torch.distributed.DistStoreError, match="not all of 2 processes"):
        new_prefix(store, 0, 2)


TRAINING = """
import os, signal, sys, time
from pathlib import Path
from utils.distributed import team

print("start", flush=True)
with team("cpu", os.environ) as us:
    mark = Path(sys.argv[1])
    first = not mark.exists()
    us.wait()
    if first:
        if us.rank == 1:
            mark.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        time.sleep(60)  # as NCCL waits for a process that is lost
    print("sum", us.concatenate([us.rank]), flush=True)
"""


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGKILL")
def test_two_nodes_meet_again_after_one_has_lost_a_process(tmp_path):
    """torchrun counts that as a restart on the one node and not on the other."""
    (tmp_path / "training.py").write_text(TRAINING)
    command = [
        sys.executable, "-m", "torch.distributed.run", "--nnodes=2", "--max-restarts=1",
        "--rdzv-backend=c10d", f"--rdzv-endpoint={tmp_path}/store", "--rdzv-conf=store_type=file",
        "--local-addr=127.0.0.1", "training.py", "mark",
    ]  # fmt: skip
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(REPOSITORY)}
    nodes = [
        subprocess.Popen(command, cwd=tmp_path, env=environment, stdout=subprocess.PIPE, text=True)
        for _ in range(2)
    ]
    try:
        for printed in [node.communicate(timeout=120)[0] for node in nodes]:
            assert printed.split("\n") == ["start", "start", "sum [0, 1]", ""]
    finally:
        for node in nodes:
            node.terminate()  # and its processes with it
            node.wait(30)


def test_errors_name_the_key_of_the_script():
    with pytest.raises(UserError, match="^rl.device: got 'tpu'"), team("tpu", {}, "rl.device"):
        pass


def test_one_process_alone_exchanges_with_itself():
    tensor = torch.arange(3.0)
    assert ALONE.is_main and ALONE.any(True) and not ALONE.any(False)
    assert ALONE.broadcast("run") == "run" and ALONE.concatenate([1, 2]) == [1, 2]
    assert ALONE.gather(tensor).tolist() == [[0.0, 1.0, 2.0]]
    ALONE.average(tensor)
    assert tensor.tolist() == [0.0, 1.0, 2.0]


def test_ctrl_c_sets_an_event_and_is_given_back(monkeypatch):
    before = signal.getsignal(signal.SIGINT)
    with stop_on_interrupt() as interrupted:
        assert not interrupted.is_set()
        signal.raise_signal(signal.SIGINT)
        assert interrupted.is_set()
        signal.raise_signal(signal.SIGINT)  # the same one, passed on by another process
        now = time.monotonic()
        monkeypatch.setattr("utils.distributed.time.monotonic", lambda: now + 2)
        signal.getsignal(signal.SIGINT)(signal.SIGTERM, None)  # as a scheduler says it once more
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before
