"""What train_graspnet.py checks before it makes data, which takes an hour."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from PIL import Image
from torch.utils.tensorboard import SummaryWriter

import train_graspnet
from models.photographs import K
from tests.helpers.real_images import write_cornell, write_jacquard
from utils.atomic_files import write_json_atomic
from utils.config import load_config
from utils.distributed import ALONE
from utils.errors import UserError
from utils.runs import begun_with, new_run_folder
from utils.table_plane import distances


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


# --- Data that have changed ------------------------------------------------------------------


def of_an_older_version(run: Path) -> None:
    """Which did not note what a run learns from."""
    facts = begun_with(run)
    del facts["data"]
    write_json_atomic(run / "environment.json", facts)


@pytest.mark.filterwarnings("ignore:data.root")
def test_folds_of_other_images_are_not_gone_on_with(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(train_graspnet, "train", lambda *_: ([], False))  # stopped in fold 0
    write_jacquard(Path("images"), objects=5)
    call = ["data.kind=jacquard", "data.root=images", "data.folds=2", "train.device=cpu"]
    assert train_graspnet.main([*call, "train.batch_size=2"]) == 130
    (run,) = Path("runs/train_graspnet").iterdir()
    (run / "fold0").mkdir(exist_ok=True)
    (run / "fold0" / "last.pt").touch()
    again = ["--resume", str(run)]
    assert train_graspnet.main(again) == 130
    write_jacquard(Path("images"), objects=15)
    changed = (
        r"other data, fold 0: \d images \(.{8}\), tested on \d images .*, and would go on with 1\d "
        "images .*; bring back what was there .* or start a new run"
    )
    with pytest.raises(UserError, match=changed):
        train_graspnet.main(again)
    of_an_older_version(run)
    assert train_graspnet.main(again) == 130
    shutil.rmtree("images")
    write_jacquard(Path("images"), objects=5)
    with pytest.raises(UserError, match="other data"):
        train_graspnet.main(again)


def test_other_photographs_and_meshes_are_not_gone_on_with(tmp_path, monkeypatch):
    """And are told of before images are made of the meshes."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(train_graspnet, "make_data", lambda *_: None)
    monkeypatch.setattr(train_graspnet, "with_target", lambda *_: None)
    monkeypatch.setattr(train_graspnet, "make_trainer", lambda *_: SimpleNamespace(step=0))
    monkeypatch.setattr(train_graspnet, "train", lambda *_: ([], False))

    def photographs(count: int) -> None:
        write_cornell(Path("photographs"), count, shape=(480, 640))
        for file in Path("photographs").glob("*d.tiff"):
            depth = np.asarray(Image.open(file))
            Image.fromarray(distances(depth, K).astype(np.float32)).save(file)

    Path("own").mkdir()
    for name in ("one", "two"):
        trimesh.creation.box((0.03, 0.04, 0.05)).export(Path("own", f"{name}.stl"))
    photographs(6)
    call = ["adaptation.target=photographs", "data.object_sets=own", "train.device=cpu"]
    assert train_graspnet.main(call) == 130
    (run,) = Path("runs/train_graspnet").iterdir()
    (run / "last.pt").touch()
    again = ["--resume", str(run)]
    assert train_graspnet.main(again) == 130
    monkeypatch.setattr(train_graspnet, "make_data", no_data)
    photographs(7)
    changed = r"data, adaptation\.target: 6 images .{10}, and would go on with 7 images"
    with pytest.raises(UserError, match=changed):
        train_graspnet.main(again)
    trimesh.creation.box((0.03, 0.04, 0.06)).export("own/one.stl")
    with pytest.raises(UserError, match=r"data, simulated images: simulated-\w{8}, and would"):
        train_graspnet.main(again)
    of_an_older_version(run)
    with pytest.raises(AssertionError, match="no data"):
        train_graspnet.main(again)


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
