"""Cross-validation on real images: folds, and the script on tiny Cornell and Jacquard folders."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import train_graspnet
from models.graspnet import create_model
from models.graspnet_io import SHIPPED, load_graspnet, save_graspnet
from models.rectangle_folds import _check_size, folds_of, image_folds, object_folds, real_folds
from tests.helpers.real_images import sample, write_cornell, write_jacquard
from utils.config import load_config
from utils.errors import UserError
from utils.real_data import FORMATS
from utils.rectangles import GraspRectangle

QUICK = ("train.backbone=ggcnn", "train.epochs=1", "train.workers=0", "train.precision=float32")


@pytest.mark.parametrize("split", ["object", "image"])
def test_folds_are_disjoint_and_cover_everything(split):
    objects = [f"o{number // 4}" for number in range(80)]
    folds = folds_of(objects, split, 5, seed=0)
    assert sorted(i for fold in folds for i in fold.test) == list(range(80))
    for fold in folds:
        assert not set(fold.train) & set(fold.test)
        assert sorted(fold.train + fold.test) == list(range(80))
    shared = [{objects[i] for i in f.train} & {objects[i] for i in f.test} for f in folds]
    assert any(shared) == (split == "image")


def test_object_folds_keep_objects_whole_and_are_as_equal_as_these_allow():
    objects = ["a"] * 3 + ["b"] * 2 + ["c"] * 4 + ["d"]
    assert [fold.test for fold in object_folds(objects, 2)] == [(0, 1, 2, 3, 4), (5, 6, 7, 8, 9)]
    assert [len(fold.test) for fold in object_folds(objects, 4)] == [3, 2, 4, 1]
    with pytest.raises(UserError, match="2 to 4"):
        object_folds(objects, 5)


def test_a_training_example_is_a_part_of_the_view():
    for kind, one in FORMATS.items():
        assert 0 < one.crop < one.view.size <= one.view.side, kind


def test_objects_that_come_again_stay_in_one_fold():
    # Jacquard's names sort by view: a, b, c, a, b, c.
    folds = object_folds(["a", "b", "c", "a", "b", "c"], 3)
    assert [fold.test for fold in folds] == [(0, 3), (1, 4), (2, 5)]


def test_image_folds_depend_on_the_seed_alone():
    assert image_folds(11, 5, seed=1) == image_folds(11, 5, seed=1) != image_folds(11, 5, seed=2)
    assert sorted(len(fold.test) for fold in image_folds(11, 5, seed=1)) == [2, 2, 2, 2, 3]


def test_a_fold_trains_on_no_test_image(tmp_path):
    root = write_cornell(tmp_path / "cornell", 14)
    config = load_config(None, ["data.kind=cornell", f"data.root={root}", "data.folds=2"])
    for fold in real_folds(config):
        trained = {one.name for one in fold.data.train.samples}
        assert trained == set(fold.train)
        assert {one.name for one in fold.test_samples} == set(fold.test)
        assert not trained & set(fold.test)


# --- The script -----------------------------------------------------------------------------


def run(monkeypatch, tmp_path, *overrides) -> Path:
    monkeypatch.chdir(tmp_path)
    assert train_graspnet.main([*QUICK, *overrides]) == 0
    return max((tmp_path / "runs" / "train_graspnet").iterdir())


def test_one_epoch_on_cornell(tmp_path, monkeypatch, capsys):
    root = write_cornell(tmp_path / "cornell", 10)
    folder = run(
        monkeypatch, tmp_path, "data.kind=cornell", f"data.root={root}", "data.folds=2",
        "data.repeats=2", "train.batch_size=4",
    )  # fmt: skip
    results = json.loads((folder / "results.json").read_text())
    assert results["complete"] and results["images"] == 10
    names = [one["name"] for fold in results["folds"] for one in fold["predictions"]]
    assert names == [f"pcd{number:04d}" for number in range(100, 110)]
    correct = sum(one["correct"] for fold in results["folds"] for one in fold["predictions"])
    assert correct == results["correct"] == sum(fold["correct"] for fold in results["folds"])
    for fold in results["folds"]:
        assert not set(fold["train"]) & {one["name"] for one in fold["predictions"]}
        for file in ("graspnet.pt", "last.pt", "curves.png", "predictions.png"):
            assert (folder / f"fold{fold['fold']}" / file).is_file()
    saved = load_graspnet(folder / "fold0" / "graspnet.pt")
    assert saved.model.max_width == 0.25
    assert saved.metres_per_pixel == FORMATS["cornell"].view.metres_per_pixel
    printed = capsys.readouterr().out
    assert f"{correct} of 10 correct" in printed and "fixed schedule, last weights" in printed

    # Everything is there: resuming only tests again, with the same outcome.
    before = (folder / "results.json").read_text()
    assert train_graspnet.main(["--resume", str(folder)]) == 0
    assert (folder / "results.json").read_text() == before


def test_one_fold_of_jacquard_with_weights_and_an_initial_network(tmp_path, monkeypatch):
    root = write_jacquard(tmp_path / "jacquard")
    initial = tmp_path / "simulated.pt"  # its widest opening is another one
    save_graspnet(initial, create_model(name="ggcnn", max_width=0.08), 0.0018)
    weights = tmp_path / "jacquard.pt"
    folder = run(
        monkeypatch, tmp_path, "data.kind=jacquard", f"data.root={root}", "data.folds=3",
        "data.fold=1", "data.repeats=1", "train.batch_size=2", f"train.initial={initial}",
        f"--weights={weights}",
    )  # fmt: skip
    results = json.loads((folder / "results.json").read_text())
    assert results["complete"] and [fold["fold"] for fold in results["folds"]] == [1]
    names = [one["name"] for one in results["folds"][0]["predictions"]]
    assert names == ["0_object1", "1_object1"]
    assert load_graspnet(weights).model.max_width == 0.25

    # Its last.pt is there: resuming it needs the initial network no more.
    initial.unlink()
    assert train_graspnet.main(["--resume", str(folder)]) == 0
    assert json.loads((folder / "results.json").read_text()) == results


@pytest.mark.slow
def test_bars_are_learned(tmp_path, monkeypatch):
    """A few steps from the shipped weights find the bars of the other fold."""
    root = write_cornell(tmp_path / "cornell", 12, shape=(480, 640))
    folder = run(
        monkeypatch, tmp_path, "data.kind=cornell", f"data.root={root}", "data.folds=2",
        "data.fold=0", "data.repeats=20", "train.batch_size=4", "train.epochs=4",
        "train.backbone=tutorial_skip", f"train.initial={SHIPPED}", "train.lr=0.001",
    )  # fmt: skip
    results = json.loads((folder / "results.json").read_text())
    assert results["accuracy"] >= 0.8


def test_images_of_another_size_are_told_of():
    middle = GraspRectangle(np.array([640.0, 360.0]), 0.0, 24.0, 12.0)
    with pytest.warns(UserWarning, match="has 1280 x 720 px, .* means 640 x 480"):
        _check_size(sample(middle, (720, 1280)), "cornell")


def test_root_has_to_be_named_and_there(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match="data.kind=cornell needs the folder"):
        train_graspnet.main(["data.kind=cornell"])
    with pytest.raises(UserError, match="no folder .*nowhere"):
        train_graspnet.main(["data.kind=cornell", f"data.root={tmp_path / 'nowhere'}"])
    assert not (tmp_path / "runs").exists()


def test_half_a_file_is_refused_by_its_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    root = write_cornell(tmp_path / "cornell", 10)
    picture = root / "pcd0103r.png"
    picture.write_bytes(picture.read_bytes()[:200])
    with pytest.raises(UserError, match="pcd0103r.png"):
        train_graspnet.main(["data.kind=cornell", f"data.root={root}", "data.folds=2"])
    picture.unlink()
    with pytest.raises(UserError, match="1 files are missing: pcd0103r.png"):
        train_graspnet.main(["data.kind=cornell", f"data.root={root}", "data.folds=2"])


def test_folds_that_cannot_be_made(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    root = write_cornell(tmp_path / "cornell", 4)
    cornell = ["data.kind=cornell", f"data.root={root}"]
    with pytest.raises(UserError, match="expected 2 to 2"):  # two objects: 100..101 and 102..
        train_graspnet.main([*cornell, "data.folds=3"])
    with pytest.raises(UserError, match="fold 5 is not below folds"):
        train_graspnet.main([*cornell, "data.fold=5"])
    with pytest.raises(UserError, match="choose one by data.fold"):
        train_graspnet.main([*cornell, "data.folds=2", f"--weights={tmp_path / 'w.pt'}"])
