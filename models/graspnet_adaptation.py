"""Adaptation of GraspNet from labelled simulated images to unlabelled photographs.

A domain classifier predicts from the features which domain an image is of, and the backbone is
trained against it through a gradient reversal (`utils.adaptation`), while the heads learn from the
labelled images alone. No label of a photograph is read, for the choice of a checkpoint either. This
module holds, in this order: the trainer, the check of a folder of photographs, the pairs of
examples, and the choice of the checkpoint. Every pair is a pure function of (seed, epoch, index),
so that a run can be resumed exactly.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from torch import nn
from torch.utils.data import Dataset

from models.graspnet import DEPTH_UNIT, GraspNet, to_input
from models.graspnet_data import Example, TrainingData
from models.graspnet_scores import predicted_maps
from models.graspnet_training import Trainer
from models.photographs import K, frame_of, from_above
from models.rectangle_examples import RectangleImages
from models.rectangle_folds import IN_MEMORY, Changed, Chosen
from utils.adaptation import (
    SOURCE,
    TARGET,
    Check,
    DomainAdaptationNetwork,
    choose_check,
    domain_loss,
    mutual_information,
    ordinary_norms,
    reversal_weight,
    select_domain,
)
from utils.atomic_files import write_atomic
from utils.augmentation import Augmentation, ColourJitter, LabelledImages
from utils.checkpoint import load_weights
from utils.config import Config
from utils.config_schema import AdaptationConfig, TrainConfig
from utils.distributed import Team
from utils.errors import UserError
from utils.grasp_labels import ANGLE_BINS
from utils.real_data import KEY, UnlabelledImages
from utils.rectangles import RealSample, View
from utils.table_plane import EXACT, FLAT, FROM_BASE, find_table_camera, table_misses

STATE = "adaptation"  # the entry of a checkpoint's `extra` that a resumed training needs
# The photographs change in the same ways as the simulated training images, so that no change
# reveals the domain: also turned by whole bins, and black and of unknown depth beyond the image.
AUGMENTATION = Augmentation(
    max_shift=0.0, turn_step=np.pi / ANGLE_BINS, scale=(0.97, 1.03), colour=ColourJitter(hue=0.0)
)
STANDS_OUT = (0.01, 0.15)  # m above the table: heights of the points that crops are laid around
MIDDLE = 0.25  # of the view's side, from its centre: farther out may be walls and the table's edge
CHECKED = 12  # images of a folder, spread over it, whose distances are checked
# How many times worse any other reading of an image has to explain the table for its numbers to be
# distances from a base. For each of Cornell's 80 photographs in folder 01 that is 17 to 22 (0.8 to
# 1.2 mm as distances, 16 to 22 mm as depths). For depths rendered in the cell, of cameras 0 to 37
# degrees from straight down, with a Kinect's noise, it is below 1.1, for distances made of these
# above 3. Tests hold both, and Cornell's.
DISTINCT = 2.0
INFORMATION_STEP = 4  # pixels between the predictions that count; neighbours predict the same


# --- Training -------------------------------------------------------------------------------


class Pair(NamedTuple):
    """Examples of both domains.

    source: a labelled example, or a batch of them. target: (4, h, w), or (B, 4, h, w), as many
    inputs of the other domain.
    """

    source: Example
    target: torch.Tensor


class Features(nn.Module):
    """The part of a GraspNet before its heads, whose features shall not depend on the domain."""

    def __init__(self, model: GraspNet):
        super().__init__()
        self.model = model

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        return self.model.features(images)


class Heads(nn.Module):
    """The heads of a GraspNet, which learn from labels alone; they return all its maps."""

    def __init__(self, model: GraspNet):
        super().__init__()
        self.model = model

    def forward(self, features: torch.Tensor) -> tuple[torch.Tensor, ...]:
        centres = self.model.centre_head is not None
        return self.model.heads(features, logits=True, centres=centres)


def domain_classifier(channels: int) -> nn.Module:
    """Make a classifier from features (B, channels, H, W) to logits (B, 1) of the target domain.

    The mean over the image comes last, so it judges textures and edges, not their places.
    """
    return nn.Sequential(
        nn.Conv2d(channels, 64, 4, stride=4), nn.ReLU(),
        nn.Conv2d(64, 64, 3, padding=1), nn.ReLU(),
        nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(64, 1),
    )  # fmt: skip


def check_alone(team: Team) -> None:
    """Raise UserError for more than one process."""
    if team.ranks > 1:
        raise UserError(
            f"adaptation.target: got {team.ranks} processes, but only one can adapt a network; "
            "start train_graspnet.py without torchrun"
        )


class AdaptingTrainer(Trainer):
    """A Trainer that takes batches of `Pair`.

    It gives the model's batch norms statistics for each domain; checkpoints hold an ordinary
    network with the statistics of the target. Raises UserError for more than one process.
    """

    def __init__(
        self, model: GraspNet, settings: TrainConfig, total_steps: int, team: Team,
        adaptation: AdaptationConfig,
    ):  # fmt: skip
        check_alone(team)
        network = DomainAdaptationNetwork(
            feature_extractor=Features(model), task_head=Heads(model),
            domain_classifier=domain_classifier(model.backbone.out_channels),
        )  # fmt: skip
        super().__init__(model, settings, total_steps, team, trained=network)
        self.weight = adaptation.weight

    @property
    def reversal(self) -> float:
        """The weight of the domain loss in the features at this step."""
        progress = self.step / max(self.total_steps - 1, 1)
        return self.weight * reversal_weight(min(progress, 1.0))

    def losses(self, batch: Pair) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Return the grasp loss on the source plus the domain loss, and their parts.

        `domain_accuracy` is the classifier's on this batch. With weight 0 the domain loss does not
        count: the target only updates the statistics of its batch norms.
        """
        device = self.team.device
        source, target = (
            images.to(device, memory_format=torch.channels_last, non_blocking=True)
            for images in (batch.source.image, batch.target)
        )
        labels = batch.source.targets
        targets = type(labels)(*(t.to(device, non_blocking=True) for t in labels))
        mixed = self.precision != torch.float32
        with torch.autocast(device.type, dtype=self.precision, enabled=mixed):
            on_source = self.trained(source, SOURCE, self.reversal)
            with torch.set_grad_enabled(self.weight > 0):
                on_target = self.trained(target, TARGET, self.reversal)
        quality, angle, width, *offset = on_source.task
        total, parts = self.loss(quality, angle, width, targets, *offset)
        between = domain_loss(on_source.domain.float(), on_target.domain.float())
        right = ((on_source.domain <= 0).float().mean() + (on_target.domain > 0).float().mean()) / 2
        parts |= {"domain_loss": between.detach(), "domain_accuracy": right}
        return (total + between if self.weight > 0 else total), parts

    def ordinary_model(self) -> GraspNet:
        """Return a copy with the target's statistics in ordinary batch norms."""
        return ordinary_norms(copy.deepcopy(self.model), TARGET)

    def more_state(self) -> dict[str, Any]:
        """Return the model with the statistics of both domains, and the classifier."""
        classifier = self.trained.domain_classifier
        return {STATE: {"model": self.model.state_dict(), "classifier": classifier.state_dict()}}

    def take_weights(self, checkpoint: dict[str, Any], path: Path) -> None:
        saved = checkpoint["extra"][STATE]
        load_weights(self.model, saved, path)
        self.trained.domain_classifier.load_state_dict(saved["classifier"])


# --- The photographs ------------------------------------------------------------------------


def open_target(config: Config) -> Sequence[RealSample] | None:
    """Open the photographs of `adaptation.target`; returns None if the config names no folder.

    Raises UserError for training data other than simulated, for a folder that cannot be used, and
    for images that do not hold distances from a robot's base.
    """
    folder = config.adaptation.target
    if folder is None:
        return None
    if config.data.kind != "simulated":
        raise UserError(
            f"{KEY}={folder}: data.kind is {config.data.kind}, but adaptation is from simulated "
            "images; use data.kind=simulated, or leave adaptation.target out"
        )
    images = UnlabelledImages(folder)
    check_distances(images)
    return images


def check_distances(images: UnlabelledImages) -> None:
    """Raise UserError, naming the image, unless images hold distances from a robot's base.

    `CHECKED` images are read, spread over the folder.

    Each image has to show a table that such distances explain far better than depths or distances
    from the camera do, with the base at a point from which distances determine depths.
    """
    chosen = np.linspace(0, len(images) - 1, min(len(images), CHECKED)).round().astype(int)
    for record in (images.records[i] for i in chosen):
        _check_distances(images.read(record).depth, record.files["d.tiff"])


def _check_distances(image: np.ndarray, file: Path) -> None:
    misses = table_misses(image, K)
    fits = {reading: f"{1000 * miss:.2g} mm" for reading, miss in misses.items()}
    likely = min(misses, key=misses.get)
    if misses[likely] > FLAT:
        raise UserError(
            f"{KEY}: {file} shows no flat table: the typical pixel is {fits[likely]} off the best "
            f"one, at most {1000 * FLAT:g} mm are allowed; give images whose middle shows mostly "
            "table"
        )
    needed = misses.pop(FROM_BASE)
    likely = min(misses, key=misses.get)
    if misses[likely] < DISTINCT * max(needed, EXACT):
        raise UserError(
            f"{KEY}: {file} seems to hold {likely} (a flat table fits to {fits[likely]}), expected "
            f"{FROM_BASE} (it fits to {fits[FROM_BASE]}); make these of them by "
            "utils.table_plane.distances, as docs/sim_to_real.md shows"
        )
    if not find_table_camera(image, K).sees(image.shape, K, STANDS_OUT[1]):
        raise UserError(
            f"{KEY}: {file} holds distances from a point that is too near to what is seen: some "
            f"rays of the camera are nearest to it less than {STANDS_OUT[1]:g} m above the table, "
            "or below, where distances do not determine depths; make them of the depths by "
            "utils.table_plane.distances, as docs/sim_to_real.md shows"
        )


def seen_from_above(sample: RealSample, metres_per_pixel: float) -> RealSample:
    """Return a photograph as the overhead camera would see it, at this scale."""
    view = from_above(frame_of(sample), metres_per_pixel)
    return replace(sample, rgb=view.rgb, depth=view.depth)


def split_target(
    samples: Sequence[RealSample], share: float, seed: int
) -> tuple[list[int], list[int]]:
    """Return the indices of the images to learn from, and of those that choose a checkpoint."""
    order = np.random.default_rng(seed).permutation(len(samples)).tolist()
    count = min(max(round(share * len(order)), 1), len(order) - 1)
    return sorted(order[count:]), sorted(order[:count])


class TargetPairs(Dataset):
    """Labelled examples, each with a crop of a random photograph, changed at random.

    source: a data set of `Example`s by (epoch, index). view: the view of the photographs, at the
    source's scale. Crops are as large as the source's, around a point that is above the table.
    """

    def __init__(
        self, source: Dataset, samples: Sequence[RealSample], view: View, seed: int
    ):  # fmt: skip
        self.source, self.samples, self.view, self.seed = source, samples, view, seed

    def __len__(self) -> int:
        return len(self.source)

    def __getitem__(self, place: tuple[int, int]) -> Pair:
        source = self.source[place]
        rng = np.random.default_rng([self.seed, *place, TARGET])
        sample = self.samples[rng.integers(len(self.samples))]
        shape = (self.view.size, self.view.size)
        change = AUGMENTATION.draw(rng, shape).matrix(shape)
        rgb, depth, _ = self.view.warp(sample, change, border=cv2.BORDER_CONSTANT)
        rgb = AUGMENTATION.colour(torch.from_numpy(np.moveaxis(rgb, -1, 0).copy()), rng)
        x = to_input(np.ascontiguousarray(rgb.permute(1, 2, 0).numpy()), depth)
        height, width = source.image.shape[1:]
        row, column = corner_around(x, (height, width), rng)
        return Pair(source, x[:, row : row + height, column : column + width].contiguous())


def corner_around(
    x: torch.Tensor, size: tuple[int, int], rng: np.random.Generator
) -> tuple[int, int]:
    """Return the row and column at which a crop of `size` from the input x (4, H, W) starts.

    The crop lies around a random pixel in the image's `MIDDLE` that is `STANDS_OUT` metres above
    the table, or around any pixel if there is none.
    """
    height = -DEPTH_UNIT * x[3].numpy()
    size, shape = np.array(size), np.array(height.shape)
    rows, columns = np.ogrid[: shape[0], : shape[1]]
    out = np.hypot(rows - shape[0] / 2, columns - shape[1] / 2)
    low, high = STANDS_OUT
    pixels = np.argwhere((height > low) & (height < high) & (out < MIDDLE * shape.min()))
    middle = pixels[rng.integers(len(pixels))] if len(pixels) else rng.integers(shape)
    corner = middle - size // 2 + rng.integers(-(size // 4), size // 4 + 1)
    row, column = np.clip(corner, 0, np.maximum(shape - size, 0))
    return int(row), int(column)


# --- Choosing without labels -----------------------------------------------------------------


def grasp_information(model: GraspNet, images: LabelledImages) -> float:
    """Return the mutual information of places and predictions, in nats: 0 .. log(1 + K).

    A prediction is "nothing to grasp" or a grasp in one of the K bins; see
    `utils.adaptation.mutual_information`. Places are those of the square `MIDDLE` around the
    centre; labels are not used. The model ends in evaluation mode.
    """
    model.eval()
    predicted = []
    for index in range(len(images)):
        quality, angle, _ = predicted_maps(model, images[index])
        rows, columns = (
            slice(round((0.5 - MIDDLE) * n), round((0.5 + MIDDLE) * n), INFORMATION_STEP)
            for n in quality.shape[2:]
        )
        quality, angle = (maps[..., rows, columns].double() for maps in (quality, angle))
        predicted.append(torch.cat([1 - quality, quality * angle.softmax(dim=1)], dim=1))
    p = torch.cat(predicted).clamp_min(torch.finfo(torch.double).tiny)
    return mutual_information(p.log())


@dataclass(frozen=True)
class AdaptationData(TrainingData):
    """TrainingData whose `train` yields `Pair`s and whose `score` has an entry `information`.

    target: the held-out photographs.
    """

    target: LabelledImages

    def chosen(self, history: Sequence[dict[str, float]]) -> dict[str, float]:
        """Return the row with the most information on the target, among those whose score on
        labelled images is nearly the best: `utils.adaptation.choose_check`."""
        checks = [
            Check(row["epoch"], row[self.chosen_by], row["information"], row["domain_accuracy"])
            for row in history
        ]
        return history[checks.index(choose_check(checks))]

    def keep_best(
        self, run: Path, history: Sequence[dict[str, float]], save: Callable[[Path], None]
    ) -> None:
        """Keep every epoch, because a later one can make an earlier one the choice."""
        rows = history[-1], self.chosen(history)
        newest, best = (run / f"epoch{row['epoch']}.pt" for row in rows)
        save(newest)
        write_atomic(run / "best.pt", best.read_bytes())

    def pictured(self) -> dict[str, LabelledImages]:
        return super().pictured() | {"target": self.target}


def with_target(
    config: Config, data: TrainingData, samples: Sequence[RealSample]
) -> AdaptationData:
    """Pair simulated data with the photographs of `open_target`."""
    learnt, held_out = split_target(samples, config.adaptation.held_out, config.seed)
    to_view = partial(seen_from_above, metres_per_pixel=data.metres_per_pixel)
    samples = Changed(samples, to_view)
    side = samples[0].depth.shape[0]
    view = View(side, side, data.metres_per_pixel)
    if len(samples) <= IN_MEMORY:
        samples = list(samples)
    target = RectangleImages(Chosen(samples, held_out), view)

    def score(model: GraspNet) -> dict[str, float]:
        select_domain(model, SOURCE)
        scores = data.score(model)
        select_domain(model, TARGET)
        return scores | {"information": grasp_information(model, target)}

    same = {field.name: getattr(data, field.name) for field in fields(TrainingData)}
    pairs = TargetPairs(data.train, Chosen(samples, learnt), view, config.seed)
    return AdaptationData(**same | {"train": pairs, "score": score}, target=target)
