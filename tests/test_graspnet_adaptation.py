"""GraspNet adapted to unlabelled photographs: gradients, statistics, choice, the script."""

from __future__ import annotations

import copy
import json
import math
import shutil
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch import nn

import train_graspnet
from models import graspnet_adaptation
from models.graspnet import create_model
from models.graspnet_adaptation import (
    STANDS_OUT,
    AdaptationData,
    AdaptingTrainer,
    Pair,
    check_distances,
    corner_around,
    grasp_information,
    open_target,
    split_target,
    with_target,
)
from models.graspnet_backbones import BACKBONES
from models.graspnet_data import TrainingData
from models.graspnet_io import KIND, load_graspnet
from models.photographs import K, frame_of
from tests.helpers.compare import halved, same
from tests.helpers.interruption import interrupt_after
from tests.helpers.one_step import BATCH, joint_batch
from tests.helpers.real_images import write_cornell
from tests.helpers.trainings import SMALL, labelled
from utils.adaptation import SOURCE, TARGET, ordinary_norms, per_domain_norms, select_domain
from utils.checkpoint import load_checkpoint
from utils.config import load_config
from utils.distributed import ALONE, Team
from utils.errors import UserError
from utils.real_data import UnlabelledImages
from utils.table_plane import DEPTHS, FROM_BASE, FROM_CAMERA, distances

NO_GRASPS = [f"train.{part}_weight=0" for part in ("quality", "angle", "width", "centre")]
KINECT = (480, 640)  # rows, columns


def trainer_of(*overrides: str, backbone="tutorial_skip", steps=20, team=ALONE) -> AdaptingTrainer:
    torch.manual_seed(0)
    config = load_config(None, ["train.precision=float32", "train.batch_size=4", *overrides])
    model = create_model(name=backbone, max_width=0.08, centre_head=True)
    return AdaptingTrainer(model, config.train, steps, team, config.adaptation)


def pair(step: int) -> Pair:
    """Labelled noise, and noise that is brighter and twice as coarse."""
    rng = torch.Generator().manual_seed(1000 + step)
    coarse = torch.rand(BATCH, 4, 18, 12, generator=rng).repeat_interleave(2, 2)
    return Pair(joint_batch(step), 2 * coarse.repeat_interleave(2, 3))


# --- Gradients --------------------------------------------------------------------------------


@pytest.mark.parametrize("backbone", ["ggcnn", "tutorial_skip"])
def test_the_domain_loss_reaches_the_backbone_reversed(backbone):
    """By -weight, in every layer, and reaches the classifier forwards; no head is touched."""
    trainer = trainer_of(backbone=backbone)
    network, images = trainer.trained.eval(), pair(0).target
    reversed_gradients = {}
    for weight in (0.5, 2.0):
        network.zero_grad()
        network(images, TARGET, weight).domain.sum().backward()
        reversed_gradients[weight] = gradients(network.domain_classifier, trainer.model.backbone)
        assert all(p.grad is None for p in trainer.model.quality_head.parameters())
    network.zero_grad()
    select_domain(trainer.model, TARGET)
    network.domain_classifier(trainer.model.features(images)).sum().backward()
    plain = gradients(network.domain_classifier, trainer.model.backbone)
    for weight, (of_classifier, of_backbone) in reversed_gradients.items():
        for ours, forwards in zip(of_classifier, plain[0]):
            torch.testing.assert_close(ours, forwards, rtol=1e-5, atol=1e-7)
        for ours, forwards in zip(of_backbone, plain[1]):
            torch.testing.assert_close(ours, -weight * forwards, rtol=1e-4, atol=1e-6)
    assert any(gradient.any() for gradient in plain[1])


def gradients(*modules: nn.Module) -> list[list[torch.Tensor]]:
    return [[p.grad.clone() for p in module.parameters()] for module in modules]


def test_the_classifier_learns_and_the_backbone_unlearns():
    """A step of either down its own gradient g, short enough for the first order: of 1e-4 / |g|^2
    times g, by which the one loss of both falls by 1e-4, and rises by as much."""
    trainer = trainer_of(*NO_GRASPS)
    trainer.step = trainer.total_steps - 1  # the reversal has its full weight
    total, parts = trainer.losses(pair(0))
    total.backward()
    assert total.item() == pytest.approx(parts["domain_loss"].item())
    before = copy.deepcopy(trainer.trained.state_dict())
    change = {}
    for name in ("domain_classifier", "feature_extractor"):
        moved = [p for p in getattr(trainer.trained, name).parameters() if p.grad is not None]
        length = 1e-4 / sum(float(p.grad.square().sum()) for p in moved)
        with torch.no_grad():
            for p in moved:
                p -= length * p.grad
            change[name] = (trainer.losses(pair(0))[0] - total).item()
            trainer.trained.load_state_dict(before)
    assert change["domain_classifier"] == pytest.approx(-1e-4, rel=0.1)
    assert change["feature_extractor"] == pytest.approx(1e-4, rel=0.1)


class OneLayer(nn.Module):
    """A backbone without norms: brightness stays what it is."""

    stride, out_channels = 1, 32

    def __init__(self):
        super().__init__()
        self.layers = nn.Sequential(nn.Conv2d(4, 32, 3, padding=1), nn.ReLU())

    def forward(self, x):
        return self.layers(x)


def test_domains_are_told_apart_until_the_backbone_forgets_them(monkeypatch):
    """With next to no reversal the classifier soon knows the brighter images; held fixed then, it
    is taken in by a backbone that trains against it: worse than chance, log 2."""
    monkeypatch.setitem(BACKBONES, "one_layer", lambda channels: OneLayer())
    chosen = [*NO_GRASPS, "adaptation.weight=1e-6", "train.lr=3e-3", "train.warmup_share=0"]
    trainer = trainer_of(*chosen, backbone="one_layer", steps=200)
    for step in range(100):
        row = trainer.train_step(pair(step))
        if row["domain_loss"] < 0.1:
            break
    assert row["domain_loss"] < 0.1 and row["domain_accuracy"] == 1
    trainer.weight, trainer.step = 1.0, 100
    trainer.trained.domain_classifier.requires_grad_(False)
    for step in range(60):
        row = trainer.train_step(pair(step))
    assert row["domain_loss"] > math.log(2) and row["domain_accuracy"] <= 0.5


def test_the_reversal_s_schedule():
    trainer = trainer_of("adaptation.weight=0.5", steps=11)
    assert trainer.reversal == 0
    trainer.step = 5  # 2 / (1 + exp(-10 p)) - 1 = tanh(5 p), p half-way
    assert trainer.reversal == pytest.approx(0.5 * math.tanh(2.5))
    trainer.step = 11  # saved after the last step
    assert trainer.reversal == pytest.approx(0.5 * math.tanh(5))


def test_without_weight_the_target_only_tells_its_statistics():
    """Gradients are those of the labelled images alone; the target's running means still move."""
    trainer = trainer_of("adaptation.weight=0")
    plain = copy.deepcopy(trainer.model)
    norm = trainer.model.backbone.encoder[0][1]
    before = norm.running_mean.clone()
    total, parts = trainer.losses(pair(0))
    total.backward()
    assert not torch.equal(norm.running_mean[TARGET], before[TARGET])
    assert "domain_loss" in parts and trainer.trained.domain_classifier[0].weight.grad is None
    batch = joint_batch(0)
    select_domain(plain, SOURCE)
    quality, angle, width, offset = plain(batch.image, logits=True, centres=True)
    trainer.loss(quality, angle, width, batch.targets, offset)[0].backward()
    for ours, theirs in zip(trainer.model.parameters(), plain.parameters()):
        torch.testing.assert_close(ours.grad, theirs.grad, rtol=1e-4, atol=1e-6)


# --- What a checkpoint holds ------------------------------------------------------------------


def test_ordinary_norms_undo_per_domain_norms():
    torch.manual_seed(0)
    plain = nn.Sequential(
        nn.Conv2d(3, 4, 3), nn.BatchNorm2d(4, eps=1e-3), nn.Flatten(), nn.BatchNorm1d(144)
    )
    plain(torch.randn(9, 3, 8, 8))
    back = ordinary_norms(per_domain_norms(copy.deepcopy(plain)), SOURCE)
    assert [type(a) for a in back] == [type(a) for a in plain] and back[1].eps == 1e-3
    images = torch.randn(5, 3, 8, 8)
    assert torch.equal(back.eval()(images), plain.eval()(images))


def test_a_checkpoint_is_an_ordinary_network_with_the_target_s_statistics(tmp_path, config):
    trainer = trainer_of(backbone="tutorial_skip")
    for step in range(3):
        trainer.train_step(pair(step))
    trainer.save(tmp_path / "best.pt", config, 0.002)
    saved = load_graspnet(tmp_path / "best.pt").model
    assert isinstance(saved.backbone.encoder[0][1], nn.BatchNorm2d)
    network, images = trainer.trained.eval(), pair(9).target
    with torch.no_grad():
        reloaded = saved(images, logits=True, centres=True)
        theirs, ours = (network(images, domain).task for domain in (TARGET, SOURCE))
    for a, b in zip(reloaded, theirs):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-6)
    assert not torch.allclose(reloaded[0], ours[0], rtol=1e-3), "the source has others"


@pytest.mark.parametrize("weight", [0.0, 1.0])
def test_resumed_steps_are_the_same_bit_for_bit(tmp_path, config, weight):
    chosen = f"adaptation.weight={weight}"
    straight = trainer_of(chosen)
    losses = [straight.train_step(pair(step)) for step in range(6)]
    first = trainer_of(chosen)
    again = [first.train_step(pair(step)) for step in range(3)]
    first.save(tmp_path / "last.pt", config, 0.002)
    second = trainer_of(chosen)
    second.train_step(pair(99))
    second.load(tmp_path / "last.pt")
    again += [second.train_step(pair(step)) for step in range(3, 6)]
    assert again == losses
    for part in ("trained", "optimizer", "scheduler"):
        assert same(*(dict(getattr(t, part).state_dict()) for t in (second, straight))), part


# --- Photographs ------------------------------------------------------------------------------


def rewrite_depths(folder: Path, change) -> None:
    for file in folder.glob("*d.tiff"):
        depth = np.asarray(Image.open(file))
        Image.fromarray(change(depth).astype(np.float32)).save(file)


@pytest.fixture(scope="module")
def photographs(tmp_path_factory) -> Path:
    """Six pairs in Cornell's names whose labels cannot be read."""
    folder = write_cornell(tmp_path_factory.mktemp("target"), 6, shape=KINECT)
    rewrite_depths(folder, lambda depth: distances(depth, K))
    for labels in folder.glob("*.txt"):
        labels.write_text("no label of the target is ever read")
    return folder


def target_config(photographs: Path, *overrides: str):
    return load_config(None, [f"adaptation.target={photographs}", *overrides])


def test_photographs_are_read_without_labels(photographs, tmp_path):
    samples = open_target(target_config(photographs))
    assert [s.name for s in samples] == [f"pcd0{n}" for n in range(100, 106)]
    assert all(s.rgb.shape == (*KINECT, 3) and s.positives == () for s in samples)
    # Any names will do, and no labels.
    for number, file in enumerate(sorted(photographs.glob("*r.png"))):
        shutil.copy(file, tmp_path / f"view{number}r.png")
        shutil.copy(str(file).replace("r.png", "d.tiff"), tmp_path / f"view{number}d.tiff")
    assert UnlabelledImages(tmp_path).names == [f"view{n}" for n in range(6)]
    assert open_target(load_config(None)) is None


def test_folders_that_cannot_be_a_target(photographs, tmp_path):
    def message(folder: Path, *overrides: str) -> str:
        with pytest.raises(UserError, match="adaptation.target") as caught:
            open_target(target_config(folder, *overrides))
        return str(caught.value)

    assert "no folder" in message(tmp_path / "nowhere")
    assert "NAMEr.png" in message(tmp_path)
    assert "1 image, expected at least 5" in message(write_cornell(tmp_path / "one", 1))
    other = shutil.copytree(photographs, tmp_path / "other")
    Image.open(other / "pcd0103r.png").resize((320, 240)).save(other / "pcd0103r.png")
    assert "pcd0103r.png is 320 x 240 px, expected 640 x 480" in message(other)
    real = message(photographs, "data.kind=cornell", f"data.root={photographs}")
    assert "data.kind is cornell" in real and "data.kind=simulated" in real
    (other / "pcd0101d.tiff").unlink()
    with pytest.raises(UserError, match="1 files are missing: pcd0101d.tiff"):
        UnlabelledImages(other)


@pytest.mark.parametrize("tilt", [0.0, 20.0, 37.0])
def test_depths_and_distances_from_the_camera_are_not_misread(tmp_path, tilt):
    """A table under a camera tilted so, 0.9 m along its axis, with 1 mm of noise: read as what it
    is not, a folder is refused with what it seems to hold; turned into distances it is taken."""
    rays = (np.moveaxis(np.mgrid[:480, :640], 0, -1)[..., ::-1] - [319.5, 239.5]) / 525
    slope = np.tan(np.radians(tilt))
    rng = np.random.default_rng(0)
    flat = 0.9 / (1 + slope * rays[..., 1])

    def depths(_):
        return flat + 0.001 * rng.standard_normal(flat.shape)

    folder = write_cornell(tmp_path / "target", 5, shape=KINECT)
    rewrite_depths(folder, depths)
    with pytest.raises(UserError, match="adaptation.target.*0100d.tiff seems to hold depths along"):
        open_target(target_config(folder))
    rewrite_depths(folder, lambda depth: distances(depth, K))
    sample = open_target(target_config(folder))[0]
    np.testing.assert_allclose(frame_of(sample, 1.0).depth, flat, atol=0.02)
    rewrite_depths(folder, lambda _: depths(_) * np.sqrt(1 + (rays**2).sum(axis=-1)))
    with pytest.raises(UserError, match="seems to hold distances from the camera"):
        open_target(target_config(folder))


def test_one_image_of_depths_among_distances_is_refused_by_name(photographs, tmp_path):
    folder = shutil.copytree(photographs, tmp_path / "target")
    flat = np.full(KINECT, 0.9, np.float32)
    for number in (103, 104):
        Image.fromarray(flat).save(folder / f"pcd0{number}d.tiff")
    with pytest.raises(UserError, match="adaptation.target.*pcd0103d.tiff seems to hold depths"):
        open_target(target_config(folder))


def test_depths_without_noise_are_refused_whichever_fit_is_nearer_to_zero(photographs, monkeypatch):
    """Measured of depths in the cell: each fit exact but for the camera's steps of depth."""
    exact = {FROM_BASE: 1e-5, DEPTHS: 3.2e-5, FROM_CAMERA: 0.02}
    monkeypatch.setattr(graspnet_adaptation, "table_misses", lambda *_: exact)
    with pytest.raises(UserError, match="seems to hold depths along"):
        open_target(target_config(photographs))


def test_images_are_judged_all_over_a_large_folder(photographs, tmp_path, monkeypatch):
    """Of 100 twelve, from the first to the last: every ninth."""
    for number in range(100):
        for kind in ("r.png", "d.tiff"):
            (tmp_path / f"{number:02}{kind}").symlink_to(photographs / f"pcd0100{kind}")
    looked_at = []
    monkeypatch.setattr(
        graspnet_adaptation, "_check_distances", lambda _, file: looked_at.append(file)
    )
    check_distances(UnlabelledImages(tmp_path))
    assert [int(file.name[:2]) for file in looked_at] == list(range(0, 100, 9))


def test_a_base_among_what_is_seen_is_refused(tmp_path):
    """A table 0.9 m straight below, and distances from a base on it: beside the optical axis, where
    points above and below the table are as far from it."""
    flat, base = np.full(KINECT, 0.9), np.array([0.0, 0.7, 0.8])
    folder = write_cornell(tmp_path / "target", 5, shape=KINECT)
    rewrite_depths(folder, lambda _: distances(flat, K, base))
    with pytest.raises(UserError, match="pcd0100d.tiff holds distances from a point.* too near"):
        open_target(target_config(folder))


def test_images_without_a_table_are_refused(tmp_path):
    """Waves of 10 cm instead."""
    v, u = np.mgrid[:480, :640]
    bumps = 1.0 + 0.1 * np.sin(u / 25) * np.sin(v / 25)
    folder = write_cornell(tmp_path / "target", 5, shape=KINECT)
    rewrite_depths(folder, lambda depth: distances(bumps, K))
    with pytest.raises(UserError, match="adaptation.target.*shows no flat table.* at most 3 mm"):
        open_target(target_config(folder))


def test_several_processes_cannot_adapt():
    with pytest.raises(UserError, match="2 processes.*without torchrun"):
        trainer_of(team=Team(0, 2, torch.device("cpu")))


def test_held_out_photographs_are_never_learnt_from():
    learnt, held_out = split_target(range(80), 0.2, seed=3)
    assert len(held_out) == 16 and sorted(learnt + held_out) == list(range(80))
    assert (learnt, held_out) == split_target(range(80), 0.2, seed=3)
    assert [len(part) for part in split_target(range(5), 0.01, seed=0)] == [4, 1]
    assert [len(part) for part in split_target(range(5), 0.99, seed=0)] == [1, 4]


class Sources(list):
    """Examples by (epoch, index), as GraspExamples gives them."""

    def __getitem__(self, place):
        batch = joint_batch(sum(place))
        return type(batch)(batch.image[0], type(batch.targets)(*(t[0] for t in batch.targets)))


@pytest.mark.slow
def test_pairs_are_functions_of_seed_epoch_and_index(photographs):
    config = target_config(photographs)
    plain = TrainingData(Sources([0] * 7), [], lambda model: {}, "label_quality", 0.004, 0.08)
    data = with_target(config, plain, open_target(config))
    assert len(data.train) == 7 and len(data.target) == 1
    one = data.train[2, 3]
    assert one.target.shape == one.source.image.shape == (4, 36, 24)
    assert same(one.source.image, plain.train[2, 3].image)
    data.train[0, 0]
    assert torch.equal(one.target, data.train[2, 3].target)
    assert not torch.equal(one.target, data.train[3, 2].target)
    other = with_target(config.model_copy(update={"seed": 1}), plain, open_target(config))
    assert not torch.equal(one.target, other.train[2, 3].target)


def test_crops_lie_around_what_stands_on_the_table():
    x = torch.zeros(4, 100, 120)
    x[3, 60:63, 45:49] = -0.5  # 5 cm above the table
    x[3, 40:45, 60:70] = -2.9  # too high
    x[3, :10] = -1.0  # a wall behind
    for seed in range(20):
        row, column = corner_around(x, (40, 40), np.random.default_rng(seed))
        assert row <= 60 and row + 40 >= 63 and column <= 45 and column + 40 >= 49
    assert STANDS_OUT[0] < 0.05 < STANDS_OUT[1]
    empty = corner_around(torch.zeros(4, 100, 120), (40, 40), np.random.default_rng(0))
    assert 0 <= empty[0] <= 60 and 0 <= empty[1] <= 80


# --- The choice -------------------------------------------------------------------------------


class Says(nn.Module):
    """Quality 1 in the left part of the image, all of it in one angle bin, else 0."""

    def __init__(self, share: float):
        super().__init__()
        self.share, self.unused = share, nn.Parameter(torch.zeros(1))

    def forward(self, x, centres=False):
        quality = torch.zeros(1, 1, *x.shape[2:])
        quality[..., : round(self.share * x.shape[3])] = 1
        angle = torch.full((1, 18, *x.shape[2:]), -100.0)
        angle[:, 3] = 100
        return quality, angle, quality


@pytest.mark.parametrize(
    ("share", "nats"),
    [(0.5, math.log(2)), (0.375, math.log(4) - 0.75 * math.log(3)), (0.25, 0.0), (0.75, 0.0)],
)
def test_information_of_grasps(share, nats):
    """The middle half counts: a quarter of it is left of 0.375, all of it left of 0.75."""
    images = [labelled(side=64), labelled(side=64)]
    assert grasp_information(Says(share), images) == pytest.approx(nats, abs=1e-9)


def test_the_choice_can_go_back_to_an_earlier_epoch():
    empty = {field.name: None for field in fields(AdaptationData)}
    data = AdaptationData(**empty | {"chosen_by": "label_quality"})
    rows = [
        {"epoch": n, "label_quality": q, "information": nats, "domain_accuracy": 0.5}
        for n, q, nats in ((1, 0.900, 2.0), (2, 0.915, 1.5), (3, 0.930, 1.0))
    ]
    # Within 0.02 of the best score: first 1, then 1 and 2, then 2 and 3.
    assert [data.chosen(rows[:n])["epoch"] for n in (1, 2, 3)] == [1, 1, 2]


# --- The script -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def finished(tiny_data, photographs, tmp_path_factory):
    """An adaptation of two epochs of four steps: its run folder and its arguments."""
    folder = tmp_path_factory.mktemp("adaptation")
    arguments = [*tiny_data[1], *SMALL, "train.epochs=2", f"adaptation.target={photographs}"]
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert train_graspnet.main([*arguments, "--weights", "adapted.pt"]) == 0
    (run,) = (folder / "runs" / "train_graspnet").iterdir()
    assert (folder / "adapted.pt").read_bytes() == (run / "graspnet.pt").read_bytes()
    return run, arguments


@pytest.mark.slow
def test_the_script_adapts(finished):
    run, _ = finished
    history = json.loads((run / "results.json").read_text())["history"]
    assert [row["step"] for row in history] == [4, 8]
    assert all(row["information"] >= 0 and row["domain_loss"] > 0 for row in history)
    best = load_graspnet(run / "best.pt")
    epoch = best.extra["history"][-1]["epoch"]
    assert same(
        dict(best.model.state_dict()),
        dict(load_graspnet(run / f"epoch{epoch}.pt").model.state_dict()),
    )
    network = load_graspnet(run / "graspnet.pt").model
    assert same(dict(network.state_dict()), halved(best.model.state_dict()))
    assert (run / "target.png").exists()
    x = torch.rand(1, 4, 64, 64) - 0.5
    assert all(torch.isfinite(maps).all() for maps in network(x))


@pytest.mark.slow
def test_an_interrupted_adaptation_goes_on_bit_for_bit(finished, tmp_path, monkeypatch):
    straight, arguments = finished
    monkeypatch.chdir(tmp_path)
    with monkeypatch.context() as patch:
        interrupt_after(patch, AdaptingTrainer, "train_step", lambda trainer: trainer.step == 6)
        assert train_graspnet.main(arguments) == 130
    (run,) = Path("runs/train_graspnet").iterdir()
    assert train_graspnet.main(["--resume", str(run)]) == 0
    for name in ("last.pt", "best.pt"):
        ours, theirs = (load_checkpoint(folder / name, KIND) for folder in (run, straight))
        for part in ("step", "model", "optimizer", "extra"):
            assert same(ours[part], theirs[part]), (name, part)
    with pytest.raises(UserError, match="only .* may differ"):
        train_graspnet.main(["--resume", str(run), "adaptation.weight=0.5"])


def test_mistakes_are_refused_before_any_work(tiny_data, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match="adaptation.target: no folder"):
        train_graspnet.main([*tiny_data[1], "adaptation.target=nowhere"])
    with pytest.raises(UserError, match="adaptation.weight.*>= 0"):
        train_graspnet.main([*tiny_data[1], "adaptation.weight=-1"])
    assert not (tmp_path / "runs").exists()
