"""Training steps of GraspNet: schedule, precision, exact resume, several processes."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from models.graspnet import create_model
from models.graspnet_io import save_graspnet
from models.graspnet_training import (
    GRADIENT_LIMIT,
    Trainer,
    choose_precision,
    warm_up_and_cosine,
)
from tests.helpers.compare import same
from tests.helpers.one_step import joint_batch, part_of, take_steps
from tests.helpers.torchrun import in_two_processes
from utils.config import load_config
from utils.distributed import ALONE, Team
from utils.errors import UserError
from utils.runs import REPOSITORY


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


def test_a_step_is_adamws_with_the_norm_of_the_gradient_limited():
    """The first one, by hand: a weight shrinks by lr times decay, and moves by lr g / (|g| + eps),
    Adam's moments being g and its square. The gradient keeps its direction; its norm ends at 5."""
    loud = ["train.quality_weight=1e4", "train.lr=0.01", "train.warmup_share=0"]
    trainer, twin = (trainer_of(*loud, "train.weight_decay=0.1") for _ in range(2))
    total, _ = twin.losses(joint_batch(0))
    total.backward()
    norm = torch.cat([p.grad.flatten() for p in twin.model.parameters()]).norm()
    assert norm > 50
    trainer.train_step(joint_batch(0))
    for mine, plain in zip(trainer.model.parameters(), twin.model.parameters()):
        gradient = plain.grad * GRADIENT_LIMIT / norm
        torch.testing.assert_close(mine.grad, gradient, rtol=1e-4, atol=1e-6)
        moved = gradient / (gradient.abs() + 1e-8)
        expected = plain.detach() * (1 - 0.01 * 0.1) - 0.01 * moved
        sure = gradient.abs() > 1e-5  # of smaller ones rounding decides the sign
        torch.testing.assert_close(mine[sure], expected[sure], rtol=1e-4, atol=1e-5)


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


def test_checkpoints_that_do_not_fit_are_refused(tmp_path, config):
    trainer = trainer_of()
    save_graspnet(tmp_path / "graspnet.pt", trainer.model, 0.002)
    with pytest.raises(UserError, match="weights only"):
        trainer.load(tmp_path / "graspnet.pt")
    trainer.save(tmp_path / "last.pt", config, 0.002)
    with pytest.raises(UserError, match="another architecture.*backbone"):
        trainer_of(backbone="tutorial").load(tmp_path / "last.pt")


@pytest.mark.slow
def test_two_processes_take_the_step_of_the_joint_batch(tmp_path):
    in_two_processes(REPOSITORY, "-m", "tests.helpers.one_step", tmp_path)
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


def test_auto_is_half_precision_on_a_gpu_and_what_is_named_is_taken():
    cpu, gpu = torch.device("cpu"), torch.device("cuda", 0)
    assert choose_precision("auto", gpu) == torch.float16
    assert choose_precision("auto", cpu) in (torch.float32, torch.bfloat16)
    assert choose_precision("bfloat16", cpu) == torch.bfloat16
    assert choose_precision("float32", gpu) == torch.float32
