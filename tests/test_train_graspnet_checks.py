"""What train_graspnet.py checks before it makes data, which takes an hour."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest
from torch.utils.tensorboard import SummaryWriter

import train_graspnet
from utils.config import load_config
from utils.distributed import ALONE
from utils.errors import UserError
from utils.runs import new_run_folder


def no_data(*_) -> Path:
    raise AssertionError("no data are to be made")


def test_a_folder_that_takes_no_run_is_told_of_before_data_are_made(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(train_graspnet, "generate", no_data)
    Path("runs").touch()
    with pytest.raises(UserError, match="runs/train_graspnet: cannot be written"):
        train_graspnet.main(["train.device=cpu"])
    Path("runs").unlink()
    with pytest.raises(AssertionError, match="no data"):
        train_graspnet.main(["train.device=cpu"])
    assert not list(tmp_path.iterdir()), "a check leaves nothing"


def test_one_object_is_refused_before_the_folder_of_its_data_is_made(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match="box holds 1 object.*give sets of two objects or more"):
        train_graspnet.main(["train.device=cpu", "data.object_sets=box"])
    assert not list(tmp_path.iterdir())


def test_the_check_of_the_network_says_nothing_of_its_widths(tmp_path, monkeypatch, capsys):
    """The network of the check is not the one that is trained."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(train_graspnet, "generate", no_data)
    shipped = Path(train_graspnet.__file__).parent / "checkpoints" / "graspnet.pt"
    with pytest.raises(AssertionError, match="no data"):
        train_graspnet.main(["train.device=cpu", f"train.initial={shipped}"])
    assert "widths" not in capsys.readouterr().out


def test_the_file_of_the_first_weights_may_be_gone_where_there_are_later_ones(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(train_graspnet, "generate", no_data)
    config = load_config(None, ["train.device=cpu", "train.initial=gone.pt"])
    run = new_run_folder("train_graspnet", None, config)
    with pytest.raises(UserError, match="gone.pt: cannot read"):
        train_graspnet.main(["train.device=cpu", "train.initial=gone.pt"])
    (run / "last.pt").touch()
    with pytest.raises(AssertionError, match="no data"):
        train_graspnet.main(["--resume", str(run)])


def test_the_curves_are_closed_where_a_training_fails(tmp_path, monkeypatch):
    """Until then the newest of them are in memory alone."""

    class Broken:
        team, step, total_steps, was_finished, save = ALONE, 0, 1, False, print

        def resume(self, path):
            return [], []

        def announcement(self, *_):
            return "training"

        def train_step(self, batch):
            raise UserError("no number")

    closed, close = [], SummaryWriter.close
    monkeypatch.setattr(SummaryWriter, "close", lambda writer: (closed.append(True), close(writer)))
    monkeypatch.setattr(train_graspnet, "epoch_loader", lambda *_: [None])
    config = load_config(None, ["train.batch_size=1"])
    data = SimpleNamespace(train=[None], metres_per_pixel=0.001)
    with pytest.raises(UserError, match="no number"):
        train_graspnet.train(config, tmp_path, data, Broken())
    assert closed == [True]
