"""Devices, process groups and Ctrl-C of a training."""

from __future__ import annotations

import signal

import pytest
import torch

from utils.distributed import ALONE, Team, choose_device, stop_on_interrupt, team
from utils.errors import UserError


@pytest.mark.parametrize("name", ["gpu", "cpu0x", "meta", "mps", ""])
def test_names_that_are_no_device(name):
    with pytest.raises(UserError, match="expected auto, cpu, cuda"):
        choose_device(name)


def test_devices(monkeypatch):
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

    def init(backend, store, rank, world_size):
        calls.append(backend)
        store.set("address", "of this attempt")
        assert (rank, world_size) == (1, 2)

    kept = torch.distributed.HashStore()
    met = iter([(kept, 1, 2)])
    monkeypatch.setattr(torch.distributed, "rendezvous", lambda url: met)
    monkeypatch.setattr(torch.distributed, "init_process_group", init)
    monkeypatch.setattr(torch.distributed, "get_rank", lambda: 1)
    monkeypatch.setattr(torch.distributed, "destroy_process_group", lambda: None)
    started_again = {"WORLD_SIZE": "2", "LOCAL_RANK": "1", "TORCHELASTIC_RESTART_COUNT": "3"}
    with team("cuda", started_again) as us:
        assert us == Team(1, 2, torch.device("cuda", 1))
    assert calls == [torch.device("cuda", 1), "nccl"]
    # torchrun keeps the store: what one attempt writes there, the next one must not read.
    assert not kept.check(["address"]) and kept.get("attempt 3/address") == b"of this attempt"


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


def test_ctrl_c_sets_an_event_and_is_given_back():
    before = signal.getsignal(signal.SIGINT)
    with stop_on_interrupt() as interrupted:
        assert not interrupted.is_set()
        signal.raise_signal(signal.SIGINT)
        assert interrupted.is_set()
    assert signal.getsignal(signal.SIGINT) is before
