"""The script train_graspnet.py: files, exact resume, chosen epoch, bad input."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path

import cv2
import h5py
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import train_graspnet
from models.graspnet import create_model
from models.graspnet_io import KIND, SHIPPED, load_graspnet, save_graspnet
from models.graspnet_scores import LabelScores
from models.graspnet_training import Trainer
from tests.helpers.compare import halved, same
from tests.helpers.interruption import interrupt_after
from tests.helpers.torchrun import in_two_processes
from tests.helpers.trainings import SMALL
from utils.checkpoint import load_checkpoint
from utils.errors import UserError
from utils.grasp_data import shard_path
from utils.grasp_labels import Trial, label_truth
from utils.runs import REPOSITORY, this_python

pytestmark = pytest.mark.slow  # all share one training, which takes most of a minute


@pytest.fixture(scope="module")
def finished(tiny_data, tmp_path_factory):
    """A training of three epochs of four steps: its run folder and its arguments."""
    folder, arguments = tmp_path_factory.mktemp("training"), [*tiny_data[1], *SMALL]
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert train_graspnet.main(arguments) == 0
    (run,) = (folder / "runs" / "train_graspnet").iterdir()
    return run, arguments


def test_a_training_leaves_all_its_files(finished):
    run, _ = finished
    results = json.loads((run / "results.json").read_text())
    history = results["history"]
    assert [(row["epoch"], row["step"]) for row in history] == [(1, 4), (2, 8), (3, 12)]
    scores = [row["label_quality"] for row in history]
    assert results["best"]["label_quality"] == max(scores) and results["best"] in history
    assert all(row["images"] > 20 and row["loss"] > 0 for row in history)
    for picture in ("curves.png", "predictions.png"):
        assert cv2.imread(str(run / picture)).std() > 10, "not a blank sheet"
    last = load_checkpoint(run / "last.pt", KIND)
    assert last["step"] == 12 and last["extra"]["history"] == history
    saved, best = load_graspnet(run / "graspnet.pt"), load_graspnet(run / "best.pt")
    assert same(dict(saved.model.state_dict()), halved(best.model.state_dict()))
    # 0.8 m away, 64 pixels in 28 degrees: what a pixel spans in the middle.
    assert saved.metres_per_pixel == pytest.approx(0.8 * math.tan(math.radians(14)) / 32)
    assert saved.extra["scores"] == results["best"]
    assert saved.model.max_width == pytest.approx(0.08)


def test_the_best_epoch_is_kept(tiny_data, tmp_path, monkeypatch):
    """With made-up scores: real ones of so short a training may all be the same."""
    monkeypatch.chdir(tmp_path)
    qualities = iter([0.2, 0.5, 0.1])
    monkeypatch.setattr(
        "models.graspnet_data.score_labels",
        lambda model, images: LabelScores(next(qualities), 0.5, 0.1, 0.01, 1.0, 32),
    )
    # The quickest network: which of its weights are kept does not depend on it.
    assert train_graspnet.main([*tiny_data[1], *SMALL, "train.backbone=ggcnn"]) == 0
    (run,) = Path("runs/train_graspnet").iterdir()
    best, last = (load_checkpoint(run / f"{name}.pt", KIND) for name in ("best", "last"))
    assert (best["step"], last["step"]) == (8, 12)
    weights = dict(load_graspnet(run / "graspnet.pt").model.state_dict())
    kept, newest = (load_graspnet(run / f"{name}.pt").model for name in ("best", "last"))
    assert same(weights, halved(kept.state_dict()))
    assert not same(weights, halved(newest.state_dict()))
    results = json.loads((run / "results.json").read_text())
    assert results["best"] == results["history"][1] and results["best"]["label_quality"] == 0.5


def test_tensorboard_tells_training_from_validation_with_units(finished):
    run, _ = finished
    events = EventAccumulator(str(run / "tensorboard")).Reload()
    history = json.loads((run / "results.json").read_text())["history"]
    tags = {
        "loss": "training/loss",
        "quality_loss": "training/quality_loss_nats",
        "angle_loss": "training/angle_loss_nats",
        "width_loss": "training/width_loss_m",
        "label_quality": "validation/label_quality",
        "precision": "validation/precision",
        "width_error": "validation/width_error_m",
    }
    for name, tag in tags.items():
        scalars = events.Scalars(tag)
        assert [s.step for s in scalars] == [4, 8, 12]
        assert [s.value for s in scalars] == pytest.approx([row[name] for row in history])
    rate = [s.value for s in events.Scalars("training/lr")]
    # Of 12 steps 5 % (0.6) are warm-up; a 13th would have the rate 0.
    expected = [0.005 * (1 + math.cos(math.pi * (step - 0.6) / 11.4)) for step in (4, 8, 12)]
    assert rate == pytest.approx(expected, abs=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("stop", [4, 5])
def test_ctrl_c_and_resume_end_as_if_nothing_had_happened(
    finished, tmp_path, monkeypatch, capfd, stop
):
    """In the last step of an epoch or within one; the training continues with worker processes.

    Only a finished training replaces the file of --weights.
    """
    straight, arguments = finished
    shipped = tmp_path / "shipped.pt"
    shipped.write_bytes(SHIPPED.read_bytes())
    monkeypatch.chdir(tmp_path)
    with monkeypatch.context() as patch:
        interrupt_after(patch, Trainer, "train_step", lambda trainer: trainer.step == stop)
        assert train_graspnet.main([*arguments, f"--weights={shipped}"]) == 130
    (run,) = Path("runs/train_graspnet").iterdir()
    command = f"{this_python()} train_graspnet.py --resume {run} --weights {shipped}\n"
    assert f"stopped after {stop} steps; go on with {command}" in capfd.readouterr().out
    assert load_checkpoint(run / "last.pt", KIND)["step"] == stop
    first_epoch_is_over = stop > 4
    for name in ("results.json", "graspnet.pt"):
        assert (run / name).exists() == first_epoch_is_over
    assert shipped.read_bytes() == SHIPPED.read_bytes()

    assert (
        train_graspnet.main(["--resume", str(run), "train.workers=2", f"--weights={shipped}"]) == 0
    )
    for name in ("last.pt", "best.pt"):
        ours, theirs = (load_checkpoint(folder / name, KIND) for folder in (run, straight))
        for part in ("step", "model", "optimizer", "scheduler", "extra"):
            assert same(ours[part], theirs[part]), (name, part)
    ours, theirs = (json.loads((f / "results.json").read_text()) for f in (run, straight))
    assert ours == theirs
    assert shipped.read_bytes() == (run / "graspnet.pt").read_bytes()


def test_resuming_a_finished_run_changes_nothing(finished, tmp_path, monkeypatch, capsys):
    run, _ = finished
    copy = tmp_path / "copy"
    shutil.copytree(run, copy)
    monkeypatch.chdir(tmp_path)
    sure = label_truth([[Trial(1.0, 1.0, True)]])
    monkeypatch.setattr(train_graspnet, "label_truth", lambda trials: sure)
    assert train_graspnet.main(["--resume", str(copy)]) == 0
    printed = capsys.readouterr().out
    assert f"{copy} was finished before, after 3 epochs" in printed
    assert "labels against physics" not in printed  # the run's beginning has told
    assert "best after epoch" not in printed and "evaluate.py" not in printed
    assert (copy / "last.pt").read_bytes() == (run / "last.pt").read_bytes()
    assert json.loads((copy / "results.json").read_text()) == json.loads(
        (run / "results.json").read_text()
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (["train.lr=0.1"], "only .*train.workers.* may differ"),
        (["seed=9"], "only .*train.workers.* may differ"),
        (["camera.width=128"], "only .*train.workers.* may differ"),
    ],
)
def test_another_config_is_not_resumed(finished, changes, message):
    with pytest.raises(UserError, match=message):
        train_graspnet.main(["--resume", str(finished[0]), *changes])


def test_mistakes_are_refused_before_a_run_folder_is_made(
    tiny_data, finished, tmp_path, monkeypatch
):
    run, _ = finished
    monkeypatch.chdir(tmp_path)
    empty = tmp_path / "empty"
    empty.mkdir()
    for name in ("config.yaml", "environment.json"):
        shutil.copy(run / name, empty)
    diverged = create_model(name="tutorial_skip", max_width=0.08)
    next(diverged.parameters()).data.fill_(float("nan"))
    save_graspnet(tmp_path / "diverged.pt", diverged, 0.002)
    ungraspable = tmp_path / "ungraspable"
    shutil.copytree(tiny_data[0], ungraspable)
    with h5py.File(shard_path(ungraspable, "validation", 0), "a") as file:
        file["quality"][:] = 0
    for arguments, message in (
        (["--resume", str(empty)], "no last.pt"),
        ([*tiny_data[1], "train.batch_size=33"], "only 32 images"),
        ([*tiny_data[1], "train.device=tpu"], "train.device"),
        ([*tiny_data[1], "train.backbone=resnet"], "'resnet', expected"),
        ([*tiny_data[1], "train.initial=nowhere.pt"], "nowhere.pt"),
        ([*tiny_data[1], "train.initial=diverged.pt"], "diverged.pt: .*not finite"),
        ([*tiny_data[1], f"data.root={ungraspable}"], "none of the 32 validation images"),
    ):
        with pytest.raises(UserError, match=message):
            train_graspnet.main(arguments)
        assert not (tmp_path / "runs").exists(), arguments


def test_training_can_start_from_weights(finished, tmp_path, monkeypatch):
    run, arguments = finished
    monkeypatch.chdir(tmp_path)
    file = Path(shutil.copy(run / "graspnet.pt", "initial.pt"))
    initial = f"train.initial={file}"
    assert train_graspnet.main([*arguments, initial, "train.lr=1e-12", "train.epochs=1"]) == 0
    (new,) = Path("runs/train_graspnet").iterdir()
    ours, theirs = (load_graspnet(f / "graspnet.pt").model.parameters() for f in (new, run))
    for value, initial in zip(ours, theirs):  # no learning rate to speak of
        torch.testing.assert_close(value, initial, rtol=0, atol=1e-8)
    file.unlink()
    assert train_graspnet.main(["--resume", str(new)]) == 0, "its last.pt holds later weights"


# --- Several processes -------------------------------------------------------------------------


@pytest.fixture(scope="module")
def two_processes(tiny_data, tmp_path_factory):
    """A training of two epochs by two processes: its run folder, its arguments, what it printed."""
    folder, arguments = tmp_path_factory.mktemp("two"), [*tiny_data[1], *SMALL, "train.epochs=2"]
    printed = in_two_processes(folder, REPOSITORY / "train_graspnet.py", *arguments)
    (run,) = (folder / "runs" / "train_graspnet").iterdir()
    return run, arguments, printed


@pytest.mark.slow
def test_the_script_under_torchrun_leaves_one_run(two_processes):
    run, _, printed = two_processes
    assert "2 process(es)" in printed and printed.count("best after epoch") == 1
    assert [row["step"] for row in history_of(run)] == [4, 8]


@pytest.mark.slow
def test_torchrun_replaces_a_lost_process_and_the_training_goes_on(two_processes, tmp_path):
    """From the last checkpoint, in the run's folder, to the bits of an undisturbed training."""
    undisturbed, arguments, _ = two_processes
    module = "tests.helpers.lost_training"
    printed = in_two_processes(tmp_path, "--max-restarts=1", "-m", module, *arguments)
    assert (tmp_path / "lost").exists() and printed.count("2 process(es)") == 2
    (run,) = (tmp_path / "runs" / "train_graspnet").iterdir()
    assert history_of(run) == history_of(undisturbed)
    ours, theirs = (load_checkpoint(folder / "last.pt", KIND) for folder in (run, undisturbed))
    for part in ("step", "model", "optimizer", "scheduler", "extra"):
        assert same(ours[part], theirs[part]), part


def history_of(run: Path) -> list[dict[str, float]]:
    return json.loads((run / "results.json").read_text())["history"]
