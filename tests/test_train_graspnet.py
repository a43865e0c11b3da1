"""Training of GraspNet: batches, schedule, exact resume, several processes, scores, the script."""

from __future__ import annotations

import json
import math
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
import torch
from models.graspnet_examples import AtPixelSize, EpochBatches, GraspExamples
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch import nn

import train_graspnet
from models.graspnet import create_model
from models.graspnet_decoding import Peaks
from models.graspnet_io import KIND, load_graspnet, save_graspnet
from models.graspnet_scores import LabelScores, check_graspable, score_labels, score_peak
from models.graspnet_training import Trainer, choose_precision, warm_up_and_cosine
from tests.helpers.compare import same
from tests.helpers.one_step import joint_batch, part_of, take_steps
from utils.augmentation import Augmentation, LabelledImage
from utils.checkpoint import load_checkpoint
from utils.config import load_config
from utils.distributed import ALONE, Team
from utils.errors import UserError
from utils.grasp_data import shard_path

REPOSITORY = Path(__file__).resolve().parent.parent
BINS = 18


# --- Batches ---------------------------------------------------------------------------------


def test_processes_share_every_batch():
    whole = list(EpochBatches(23, 6, seed=4, epoch=2))
    assert len(whole) == len(EpochBatches(23, 6, seed=4, epoch=2)) == 3  # 5 images are left out
    indices = [index for batch in whole for _, index in batch]
    assert len(set(indices)) == 18 and set(indices) <= set(range(23))
    assert {epoch for batch in whole for epoch, _ in batch} == {2}
    parts = [list(EpochBatches(23, 6, seed=4, epoch=2, rank=rank, ranks=3)) for rank in range(3)]
    for number, batch in enumerate(whole):
        shares = [part[number] for part in parts]
        assert [len(share) for share in shares] == [2, 2, 2]
        assert sorted(sum(shares, [])) == sorted(batch)


def test_epochs_are_shuffled_anew_and_can_be_entered_midway():
    whole = list(EpochBatches(40, 8, seed=1, epoch=0))
    assert whole == list(EpochBatches(40, 8, seed=1, epoch=0))
    assert whole[3:] == list(EpochBatches(40, 8, seed=1, epoch=0, skip=3))
    orders = [
        [index for batch in EpochBatches(40, 8, seed, epoch) for _, index in batch]
        for seed, epoch in ((1, 0), (1, 1), (2, 0))
    ]
    assert all(sorted(order) == list(range(40)) != order for order in orders)
    assert orders[0] != orders[1] != orders[2] != orders[0]


def blocks(seed: int, side: int = 64) -> LabelledImage:
    """Blocks up to 10 cm high on a table 0.8 m away, whose quality is their height in decimetres,
    in all bins, and whose red says the same."""
    rng = np.random.default_rng(seed)
    height = np.zeros((side, side), np.float32)
    for _ in range(6):
        row, column = rng.integers(8, side - 14, 2)
        height[row : row + 6, column : column + 6] = rng.integers(1, 11) / 100
    quality = torch.from_numpy(height * 10)
    rgb = torch.zeros(3, side, side, dtype=torch.uint8)
    rgb[0] = (quality * 250).round().to(torch.uint8)
    return LabelledImage(
        rgb,
        torch.from_numpy(0.8 - height),
        quality.expand(BINS, -1, -1).clone(),
        torch.full((BINS, side, side), 0.03),
        torch.ones(side, side, dtype=torch.bool),
    )


IMAGES = [blocks(seed) for seed in range(3)]
CHANGES = Augmentation(turn_step=np.pi / BINS, scale=(0.9, 1.1), max_shift=0.05, colour=None)


@pytest.mark.parametrize("augmentation", [None, CHANGES])
def test_cropped_examples_keep_labels_on_their_pixels(augmentation):
    examples = GraspExamples(IMAGES, 0, 0.3, augmentation, crop=24)
    corners = set()
    for epoch in range(10):
        image, targets = examples[epoch, epoch % 3]
        assert image.shape == (4, 24, 24)
        assert targets.quality.shape == targets.width.shape == (1, 24, 24)
        assert targets.angle.shape == (BINS, 24, 24)
        valid = targets.valid[0] > 0
        # Depth is counted in decimetres from the table's, height in the label's unit.
        torch.testing.assert_close(-image[3][valid], targets.quality[0][valid], atol=1e-5, rtol=0)
        if augmentation is None:  # colours are interpolated when an image is turned
            torch.testing.assert_close(
                (image[0] + 0.5) * 255 / 250, targets.quality[0], atol=1e-5, rtol=0
            )
            assert valid.all()
        assert targets.quality.max() > 0, "a crop shows something to grasp"
        graspable = valid & (targets.quality[0] >= 0.3)
        assert torch.equal(targets.graspable[0] > 0, graspable)
        torch.testing.assert_close(targets.angle, torch.full_like(targets.angle, 1 / BINS))
        assert np.allclose(targets.width[0][graspable], 0.03)
        corners.add(image[3].numpy().tobytes())
    assert len(corners) > 3, "other windows of an image in other epochs"


def test_a_crop_larger_than_the_image_is_the_image():
    image, _ = GraspExamples(IMAGES, 0, 0.3, crop=160)[0, 1]
    whole, _ = GraspExamples(IMAGES, 0, 0.3)[0, 1]
    assert torch.equal(image, whole) and whole.shape == (4, 64, 64)


def test_an_example_is_a_function_of_seed_epoch_and_index():
    def example(seed: int, epoch: int, index: int) -> tuple:
        image, targets = GraspExamples(IMAGES, seed, 0.3, CHANGES, crop=24)[epoch, index]
        return image, *targets

    first = example(3, 1, 2)
    assert same(first, example(3, 1, 2))
    examples = GraspExamples(IMAGES, 3, 0.3, CHANGES, crop=24)
    examples[0, 0], examples[5, 1]  # whatever was asked before
    assert torch.equal(examples[1, 2].image, first[0])
    for other in ((4, 1, 2), (3, 2, 2), (3, 1, 1)):
        assert not torch.equal(example(*other)[0], first[0])


class OneFrame(list):
    """An image of a camera with focal length 100 px, 0.8 m above the table."""

    cameras = ((np.array([[100.0, 0, 31.5], [0, 100.0, 31.5], [0, 0, 1]]), np.eye(4)),)

    def table_distance(self, index: int) -> float:
        return 0.8


def test_images_are_scaled_to_the_pixel_size_of_training():
    flat = blocks(0)
    depth = torch.full((64, 64), 0.8)
    depth[28:36, 28:36] = 0.7  # 8 px of 8 mm
    frame = LabelledImage(flat.rgb, depth, flat.quality, flat.width, flat.mask)
    scaled = AtPixelSize(OneFrame([frame]), metres_per_pixel=0.004)
    assert len(scaled) == 1 and scaled.zoom(0) == pytest.approx(2.0)  # 0.8 / 100 = 8 mm
    near = scaled[0].depth < 0.75
    assert near.sum() == 16 * 16 and near[24:40, 24:40].all()
    assert scaled[0].depth.unique().tolist() == pytest.approx([0.7, 0.8])  # never scaled itself
    # In training the scale goes into the augmentation's own resampling.
    none = Augmentation(
        max_turn=0, max_shift=0, scale=(1, 1), mirror=0, colour=None, depth_noise=None
    )
    plain, changed = (GraspExamples(scaled, 0, 0.3, change)[0, 0] for change in (None, none))
    assert same((plain.image, *plain.targets), (changed.image, *changed.targets))
    half = AtPixelSize(OneFrame([frame]), metres_per_pixel=0.016)
    assert half.zoom(0) == pytest.approx(0.5)
    assert (half[0].depth == 0).sum() == 64 * 64 - 32 * 32  # outside is unknown
    assert not half[0].mask[:16].any()


# --- Steps -----------------------------------------------------------------------------------


def test_warm_up_and_cosine():
    factor = [warm_up_and_cosine(step, 100, 0.1) for step in range(101)]
    np.testing.assert_allclose(factor[:10], np.arange(1, 11) / 11)
    assert factor[10] == 1.0
    assert factor[55] == pytest.approx(0.5) and factor[100] == pytest.approx(0.0)
    assert factor[40] == pytest.approx(0.75)  # a third of the way: (1 + cos 60 degrees) / 2
    assert warm_up_and_cosine(0, 100, 0.0) == 1.0
    assert warm_up_and_cosine(0, 1, 0.0) == 1.0  # no division by 0


def trainer_of(*overrides: str, backbone: str = "ggcnn", team: Team = ALONE) -> Trainer:
    torch.manual_seed(0)
    settings = load_config(None, ["train.precision=float32", "train.batch_size=4", *overrides])
    return Trainer(create_model(name=backbone, max_width=0.08), settings.train, 20, team)


def test_the_learning_rate_follows_the_schedule():
    trainer = trainer_of("train.lr=0.01", "train.warmup_share=0.1")
    rates = []
    for step in range(4):
        rates.append(trainer.optimizer.param_groups[0]["lr"])
        trainer.train_step(joint_batch(step))
    cosine = 0.5 * (1 + math.cos(math.pi / 18))
    assert rates == pytest.approx([0.01 / 3, 0.02 / 3, 0.01, 0.01 * cosine])


@pytest.mark.parametrize("backbone", ["ggcnn", "tutorial_skip"])
@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_resumed_training_is_the_same_bit_for_bit(tmp_path, config, backbone, precision):
    chosen = f"train.precision={precision}"
    straight = trainer_of(chosen, backbone=backbone)
    losses = [straight.train_step(joint_batch(step)) for step in range(6)]

    first = trainer_of(chosen, backbone=backbone)
    again = [first.train_step(joint_batch(step)) for step in range(3)]
    first.save(tmp_path / "last.pt", config, 0.002, history=[{"epoch": 1}])
    torch.rand(7)  # another program's use of torch's generator
    second = trainer_of(chosen, "train.lr=0.5", backbone=backbone)  # the rate is the checkpoint's
    second.train_step(joint_batch(99))
    extra = second.load(tmp_path / "last.pt")
    assert extra["history"] == [{"epoch": 1}] and extra["metres_per_pixel"] == 0.002
    assert second.step == 3
    again += [second.train_step(joint_batch(step)) for step in range(3, 6)]

    assert again == losses and len({row["loss"] for row in losses}) == 6
    assert second.step == straight.step == 6
    for part in ("model", "optimizer", "scheduler", "scaler"):
        ours, theirs = (getattr(t, part).state_dict() for t in (second, straight))
        assert same(ours, theirs), part


def test_a_checkpoint_of_a_device_without_a_scaler_goes_on_where_there_is_one(tmp_path, config):
    trainer_of().save(tmp_path / "last.pt", config, 0.002)
    other = trainer_of()
    other.scaler = torch.amp.GradScaler("cpu", init_scale=8.0)  # as a GPU's float16 has
    other.load(tmp_path / "last.pt")
    other.train_step(joint_batch(0))
    assert other.scaler.get_scale() == 8.0


def test_float32_is_float32_and_bfloat16_is_near():
    loss = {}
    for precision in ("float32", "bfloat16"):
        trainer = trainer_of(f"train.precision={precision}")
        loss[precision], _ = trainer.losses(joint_batch(0))
    batch, trainer = joint_batch(0), trainer_of()
    exact, _ = trainer.loss(*trainer.model(batch.image, logits=True), batch.targets)
    torch.testing.assert_close(loss["float32"], exact, rtol=1e-5, atol=0)
    assert loss["bfloat16"] != exact
    torch.testing.assert_close(loss["bfloat16"], exact, rtol=1e-2, atol=0)


def test_a_loss_that_is_no_number_changes_no_weight():
    trainer = trainer_of()
    trainer.train_step(joint_batch(0))
    before = [p.clone() for p in trainer.model.parameters()]
    moments = {k: v["exp_avg"].clone() for k, v in trainer.optimizer.state_dict()["state"].items()}
    broken = joint_batch(1)
    broken.image[0, 0, 0, 0] = float("nan")
    with pytest.raises(UserError, match="loss is nan at step 1.*train.lr"):
        trainer.train_step(broken)
    assert same(before, list(trainer.model.parameters())) and trainer.step == 1
    after = trainer.optimizer.state_dict()["state"]
    assert same(moments, {k: v["exp_avg"] for k, v in after.items()})


def test_checkpoints_that_do_not_fit_are_told(tmp_path, config):
    trainer = trainer_of()
    save_graspnet(tmp_path / "graspnet.pt", trainer.model, 0.002)
    with pytest.raises(UserError, match="weights only"):
        trainer.load(tmp_path / "graspnet.pt")
    trainer.save(tmp_path / "last.pt", config, 0.002)
    with pytest.raises(UserError, match="another architecture.*backbone"):
        trainer_of(backbone="tutorial").load(tmp_path / "last.pt")


@pytest.mark.slow
def test_two_processes_take_the_step_of_the_joint_batch(tmp_path):
    run = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node=2"]
    done = subprocess.run(
        [*run, "-m", "tests.helpers.one_step", str(tmp_path)], cwd=REPOSITORY, timeout=300,
        capture_output=True, text=True, env=os.environ | {"OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    first, second = (torch.load(tmp_path / f"{rank}.pt", weights_only=True) for rank in range(2))
    assert same(first, second), "the processes stay together"
    joint = take_steps(ALONE)["gradients"]
    half = trainer_of()
    half.train_step(part_of(joint_batch(0), 0, 2))
    halves = {name: p.grad for name, p in half.model.named_parameters()}
    largest = max(gradient.abs().max() for gradient in joint.values())
    for name, gradient in first["gradients"].items():
        torch.testing.assert_close(gradient, joint[name], rtol=1e-4, atol=1e-6 * float(largest))
    assert any(not torch.allclose(halves[name], joint[name], rtol=0.01) for name in joint)


def test_a_batch_that_cannot_be_shared_equally_is_refused():
    with pytest.raises(UserError, match="batch_size is 4, but 3 processes"):
        trainer_of(team=Team(0, 3, torch.device("cpu")))


def test_precisions():
    cpu, gpu = torch.device("cpu"), torch.device("cuda", 0)
    assert choose_precision("auto", gpu) == torch.float16
    assert choose_precision("auto", cpu) in (torch.float32, torch.bfloat16)
    assert choose_precision("bfloat16", cpu) == torch.bfloat16
    assert choose_precision("float32", gpu) == torch.float32


# --- Scores ----------------------------------------------------------------------------------


def labelled(*labels: tuple[int, int, int, float, float], side: int = 20) -> LabelledImage:
    """An image without pattern and with labels (bin, row, column, quality, width)."""
    quality, width = torch.zeros(BINS, side, side), torch.zeros(BINS, side, side)
    for k, row, column, q, w in labels:
        quality[k, row, column], width[k, row, column] = q, w
    return LabelledImage(
        torch.full((3, side, side), 128, dtype=torch.uint8),
        torch.full((side, side), 0.8),
        quality,
        width,
        torch.ones(side, side, dtype=torch.bool),
    )


def peak(u: float, v: float, degrees: float, width: float) -> Peaks:
    return Peaks(
        np.array([[u, v]]), np.radians([degrees]), np.array([width], np.float32), np.array([0.9])
    )


@pytest.mark.parametrize(
    ("found", "expected"),
    [
        # Nearest bin 0 has no label; 170 and 2 degrees are 12 apart, over the seam.
        (peak(6.0, 4.0, 2.0, 0.05), (0.0, 12.0, 0.02, 0.0)),
        (peak(6.0, 4.0, 172.0, 0.03), (0.9, 2.0, 0.0, 0.0)),
        # Between 176 and 180 the nearest bin is 0 again.
        (peak(6.0, 4.0, 177.0, 0.03), (0.0, 7.0, 0.0, 0.0)),
        # One pixel beside: no label there, but the labels of the neighbour count.
        (peak(7.0, 4.0, 170.0, 0.03), (0.0, 0.0, 0.0, 1.0)),
        # 3 right and 4 down: the nearest label, not the one of the nearest angle farther away.
        (peak(9.0, 8.0, 90.0, 0.03), (0.0, 80.0, 0.0, 5.0)),
        # A subpixel place belongs to the rounded pixel.
        (peak(6.3, 4.4, 170.0, 0.04), (0.9, 0.0, 0.01, 0.5)),
    ],
)
def test_a_peak_against_labels(found, expected):
    image = labelled((17, 4, 6, 0.9, 0.03), (9, 15, 15, 0.8, 0.06), (0, 5, 6, 0.5, 0.01))
    label, angle, width, distance = score_peak(found, image)
    assert (label, np.degrees(angle), width, distance) == pytest.approx(expected, abs=1e-5)


def test_of_several_good_angles_the_nearest_counts():
    image = labelled((3, 4, 6, 0.7, 0.02), (6, 4, 6, 0.9, 0.05))
    label, angle, width, distance = score_peak(peak(6, 4, 58, 0.05), image)
    assert (label, np.degrees(angle), width, distance) == pytest.approx((0.9, 2, 0, 0), abs=1e-5)
    label, angle, width, _ = score_peak(peak(6, 4, 36, 0.05), image)
    assert (label, np.degrees(angle), width) == pytest.approx((0.0, 6, 0.03), abs=1e-5)


class Always(nn.Module):
    """A network that sees a bump of quality at row 10, column 12, bin 4 and width 0.04 m."""

    def __init__(self):
        super().__init__()
        self.unused = nn.Parameter(torch.zeros(1))

    def forward(self, x: torch.Tensor, centres: bool = False):
        rows, columns = torch.meshgrid(torch.arange(20), torch.arange(20), indexing="ij")
        quality = torch.exp(-((rows - 10) ** 2 + (columns - 12) ** 2) / 8.0)[None, None]
        circle = 2 * np.pi * (torch.arange(BINS) - 4) / BINS
        angle = (4 * torch.cos(circle))[None, :, None, None].expand(1, BINS, 20, 20)
        return quality, angle, torch.full_like(quality, 0.04)


def test_scores_are_means_over_images_with_something_to_grasp():
    scores = score_labels(
        Always(),
        [
            labelled((4, 10, 12, 0.9, 0.05)),
            labelled((4, 10, 12, 0.3, 0.05), (5, 10, 16, 0.8, 0.01)),
            labelled((4, 10, 12, 0.5, 0.05)),  # nothing that counts as a grasp
            labelled(),
        ],
    )
    assert scores.images == 2
    assert scores.label_quality == pytest.approx(0.6)
    assert scores.precision == pytest.approx(0.5)
    assert np.degrees(scores.angle_error) == pytest.approx(5.0, abs=1e-3)  # 0 and 10 degrees
    assert scores.width_error == pytest.approx(0.02)  # 1 and 3 cm
    assert scores.distance == pytest.approx(2.0, abs=1e-4)  # 0 and 4 pixels
    nothing = score_labels(Always(), [labelled()])
    assert (nothing.images, nothing.label_quality, nothing.precision) == (0, 0.0, 0.0)


def test_one_image_with_something_to_grasp_is_enough():
    poor = labelled((4, 10, 12, 0.5, 0.05))
    check_graspable([poor, labelled((4, 10, 12, 0.9, 0.05))])
    with pytest.raises(UserError, match="none of the 2 validation images.*validation_frames"):
        check_graspable([poor, labelled()])


# --- The script ------------------------------------------------------------------------------

SMALL = [
    "train.backbone=tutorial_skip", "train.batch_size=8", "train.epochs=3", "train.lr=0.01",
    "train.workers=0", "train.device=cpu", "train.precision=float32",
]  # fmt: skip


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
    assert same(saved.model.state_dict(), best.model.state_dict())
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
    assert train_graspnet.main([*tiny_data[1], *SMALL]) == 0
    (run,) = Path("runs/train_graspnet").iterdir()
    best, last = (load_checkpoint(run / f"{name}.pt", KIND) for name in ("best", "last"))
    assert (best["step"], last["step"]) == (8, 12)
    weights = dict(load_graspnet(run / "graspnet.pt").model.state_dict())
    assert same(weights, dict(load_graspnet(run / "best.pt").model.state_dict()))
    assert not same(weights, dict(load_graspnet(run / "last.pt").model.state_dict()))
    results = json.loads((run / "results.json").read_text())
    assert results["best"] == results["history"][1] and results["best"]["label_quality"] == 0.5


def test_tensorboard_holds_the_history(finished):
    run, _ = finished
    events = EventAccumulator(str(run / "tensorboard")).Reload()
    history = json.loads((run / "results.json").read_text())["history"]
    for name in ("loss", "quality_loss", "angle_loss", "width_loss", "label_quality", "precision"):
        scalars = events.Scalars(name)
        assert [s.step for s in scalars] == [4, 8, 12]
        assert [s.value for s in scalars] == pytest.approx([row[name] for row in history])
    rate = [s.value for s in events.Scalars("lr")]
    # Of 12 steps 5 % (0.6) are warm-up; a 13th would have the rate 0.
    expected = [0.005 * (1 + math.cos(math.pi * (step - 0.6) / 11.4)) for step in (4, 8, 12)]
    assert rate == pytest.approx(expected, abs=1e-8)


@pytest.mark.parametrize("stop", [3, 4])
def test_ctrl_c_and_resume_end_as_if_nothing_had_happened(
    finished, tmp_path, monkeypatch, capfd, stop
):
    """A real Ctrl-C, within an epoch or in its last step; then it goes on with worker processes."""
    straight, arguments = finished
    monkeypatch.chdir(tmp_path)
    take_step = Trainer.train_step

    def interrupted(trainer, batch):
        done = take_step(trainer, batch)
        if trainer.step == stop:
            signal.raise_signal(signal.SIGINT)
        return done

    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "train_step", interrupted)
        assert train_graspnet.main(arguments) == 130
    (run,) = Path("runs/train_graspnet").iterdir()
    assert f"stopped after {stop} steps; go on with --resume {run}" in capfd.readouterr().out
    assert load_checkpoint(run / "last.pt", KIND)["step"] == stop
    assert not (run / "results.json").exists()

    assert train_graspnet.main(["--resume", str(run), "train.workers=2"]) == 0
    for name in ("last.pt", "best.pt"):
        ours, theirs = (load_checkpoint(folder / name, KIND) for folder in (run, straight))
        for part in ("step", "model", "optimizer", "scheduler", "extra"):
            assert same(ours[part], theirs[part]), (name, part)
    ours, theirs = (json.loads((f / "results.json").read_text()) for f in (run, straight))
    assert ours == theirs


def test_only_a_finished_training_replaces_the_weights(finished, tmp_path, monkeypatch):
    arguments = [*finished[1], "--weights", str(tmp_path / "shipped.pt")]
    (tmp_path / "shipped.pt").write_text("the good old ones")
    monkeypatch.chdir(tmp_path)
    take_step = Trainer.train_step

    def interrupted(trainer, batch):
        if trainer.step == 4:  # after the first epoch
            signal.raise_signal(signal.SIGINT)
        return take_step(trainer, batch)

    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "train_step", interrupted)
        assert train_graspnet.main(arguments) == 130
    (run,) = Path("runs/train_graspnet").iterdir()
    assert (run / "graspnet.pt").exists()
    assert (tmp_path / "shipped.pt").read_text() == "the good old ones"
    assert train_graspnet.main(["--resume", str(run), *arguments[-2:]]) == 0
    assert (tmp_path / "shipped.pt").read_bytes() == (run / "graspnet.pt").read_bytes()


def test_resuming_a_finished_run_changes_nothing(finished, tmp_path, monkeypatch):
    run, _ = finished
    copy = tmp_path / "copy"
    shutil.copytree(run, copy)
    monkeypatch.chdir(tmp_path)
    assert train_graspnet.main(["--resume", str(copy)]) == 0
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


def test_mistakes_are_told_before_a_run_folder_is_made(tiny_data, finished, tmp_path, monkeypatch):
    run, _ = finished
    monkeypatch.chdir(tmp_path)
    empty = tmp_path / "empty"
    empty.mkdir()
    shutil.copy(run / "config.yaml", empty)
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
    initial = f"train.initial={run / 'graspnet.pt'}"
    assert train_graspnet.main([*arguments, initial, "train.lr=1e-12", "train.epochs=1"]) == 0
    (new,) = Path("runs/train_graspnet").iterdir()
    ours, theirs = (load_graspnet(f / "graspnet.pt").model.parameters() for f in (new, run))
    for value, initial in zip(ours, theirs):  # no learning rate to speak of
        torch.testing.assert_close(value, initial, rtol=0, atol=1e-8)


@pytest.mark.slow
def test_the_script_under_torchrun_leaves_one_run(tiny_data, tmp_path):
    run = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node=2"]
    done = subprocess.run(
        [*run, REPOSITORY / "train_graspnet.py", *tiny_data[1], *SMALL, "train.epochs=1"],
        cwd=tmp_path, timeout=300, capture_output=True, text=True,
        env=os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(REPOSITORY)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "2 process(es)" in done.stdout and done.stdout.count("best after epoch 1") == 1
    (folder,) = (tmp_path / "runs" / "train_graspnet").iterdir()
    assert json.loads((folder / "results.json").read_text())["best"]["step"] == 4
