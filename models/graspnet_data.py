"""Simulated images as GraspNet's training data: examples, batches, and the score of a network.

Every example is a pure function of (seed, epoch, index), and every epoch's order of (seed, epoch):
a resumed run sees the examples that the uninterrupted one would have seen, with any number of
workers. This module does not know how the images are made.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset, Sampler

from models.graspnet import GraspNet, GraspTargets, targets_from_labels, to_input
from models.graspnet_io import metres_per_pixel
from models.graspnet_scores import centre_error, offset_to, score_labels
from utils.augmentation import (
    Augmentation,
    ColourJitter,
    LabelledImage,
    LabelledImages,
    Similarity,
    apply_similarity,
)
from utils.config import Config
from utils.depth import DepthNoise, make_depth_noise, measure
from utils.distributed import Team
from utils.errors import UserError
from utils.grasp_data import SimulatedDataset
from utils.grasp_labels import ANGLE_BINS
from utils.runs import usable_cpus
from utils.worker_process import leave_signals

CROP = 160  # pixels, side of a training example: all context that the network uses, half the work


class AtPixelSize:
    """The frames of a SimulatedDataset, scaled so that a pixel spans `metres_per_pixel` of table.

    Convolutions know no other scale, and cameras differ. The scale of each frame is kept apart, so
    that the augmentation can apply it in the same resampling as its own.
    """

    def __init__(self, images: SimulatedDataset, metres_per_pixel: float):
        self.images, self.metres_per_pixel = images, metres_per_pixel

    def __len__(self) -> int:
        return len(self.images)

    def __getitem__(self, index: int) -> LabelledImage:
        return apply_similarity(self.images[index], Similarity(scale=self.zoom(index)))

    def zoom(self, index: int) -> float:
        """Return the factor by which frame `index` has to be scaled."""
        K, _ = self.images.cameras[index]
        return metres_per_pixel(K, self.images.table_distance(index)) / self.metres_per_pixel


class Example(NamedTuple):
    """image: (4, h, w), see `to_input`. targets: of the same size, without a batch dimension."""

    image: torch.Tensor
    targets: GraspTargets


class GraspExamples(Dataset):
    """Examples of a set of labelled images, for training (with `augmentation`) or without.

    crop: side in pixels of the square that is cut out around a graspable pixel; None leaves the
    image whole. Indices are pairs (epoch, index).
    """

    def __init__(
        self,
        images: LabelledImages,
        seed: int,
        graspable_from: float,
        augmentation: Augmentation | None = None,
        crop: int | None = None,
    ):
        self.images, self.seed, self.graspable_from = images, seed, graspable_from
        self.augmentation, self.crop = augmentation, crop

    def __len__(self) -> int:
        return len(self.images)

    def __getitem__(self, place: tuple[int, int]) -> Example:
        epoch, index = place
        rng = np.random.default_rng([self.seed, epoch, index + 1])  # 0: the epoch's order
        if self.augmentation is None:
            image = self.images[index]
        elif isinstance(self.images, AtPixelSize):
            raw, zoom = self.images.images[index], self.images.zoom(index)
            image = self.augmentation(raw, rng, zoom)
        else:
            image = self.augmentation(self.images[index], rng)
        window = self._window(image, rng)
        # The whole image is normalised, then cut: the median of its depth is the table's.
        rgb = image.rgb.permute(1, 2, 0).numpy()
        x = to_input(np.ascontiguousarray(rgb), image.depth.numpy())[window]
        mask = image.mask if image.mask.ndim == 3 else image.mask[None]
        quality, width = image.quality[window], image.width[window]
        valid = mask[window].all(dim=0, keepdim=True)
        offset = None if image.centre is None else offset_to(image.centre)[window][None]
        targets = targets_from_labels(
            quality[None], width[None], valid[None].float(), self.graspable_from, offset
        )
        return Example(x, GraspTargets(*(t[0] for t in targets)))

    def _window(self, image: LabelledImage, rng: np.random.Generator) -> tuple:
        """Slices of a square that holds a random graspable pixel, or of any square if none is."""
        if self.crop is None:
            return (slice(None),)
        shape = np.array(image.depth.shape)
        side = np.minimum(self.crop, shape)
        pixels = (image.quality.amax(dim=0) > 0).nonzero().numpy()
        centre = pixels[rng.integers(len(pixels))] if len(pixels) else rng.integers(shape)
        corner = centre - side // 2 + rng.integers(-side // 4, side // 4 + 1)
        row, column = np.clip(corner, 0, shape - side)
        return (slice(None), slice(row, row + side[0]), slice(column, column + side[1]))


class EpochBatches(Sampler):
    """One process's share of every batch of one epoch, shuffled by (seed, epoch).

    Yields lists of (epoch, index) of length `batch_size / ranks`. Images that do not fill a batch
    are left out; the order of another epoch brings them. skip: number of batches already done.
    """

    def __init__(
        self, length: int, batch_size: int, seed: int, epoch: int, skip: int = 0,
        rank: int = 0, ranks: int = 1,
    ):  # fmt: skip
        order = np.random.default_rng([seed, epoch]).permutation(length)
        count = length // batch_size
        batches = order[: count * batch_size].reshape(count, batch_size)[skip:, rank::ranks]
        self._batches = [[(epoch, int(i)) for i in batch] for batch in batches]

    def __len__(self) -> int:
        return len(self._batches)

    def __iter__(self) -> Iterator[list[tuple[int, int]]]:
        return iter(self._batches)


def steps_per_epoch(config: Config, images: int) -> int:
    """Return how many whole batches an epoch has; raises UserError if there is none."""
    batch = config.train.batch_size
    if images < batch:
        raise UserError(
            f"train.batch_size is {batch}, but there are only {images} images; raise "
            f"{'data.frames' if config.data.kind == 'simulated' else 'data.repeats'} or lower "
            "train.batch_size"
        )
    return images // batch


def epoch_loader(
    config: Config, data: TrainingData, team: Team, epoch: int, skip: int
) -> DataLoader:
    """Return this process's part of the batches of one epoch, without the first `skip`. Raises
    UserError where the epoch has not so many."""
    steps = steps_per_epoch(config, len(data.train))
    if not 0 <= skip <= steps:  # of a checkpoint that was saved with another number of images
        raise UserError(
            f"the checkpoint lies {skip} steps from the beginning of epoch {epoch + 1}, expected 0 "
            f"to {steps}: the number of images has changed since; bring back those of then, or "
            "start a new run"
        )
    # Imported before the workers are forked: each would import it in every epoch.
    import torchvision.transforms.v2  # noqa: F401

    sampler = EpochBatches(
        len(data.train), config.train.batch_size, config.seed, epoch, skip, team.rank, team.ranks
    )
    workers = config.train.workers
    workers = usable_cpus() if workers is None else workers
    return DataLoader(
        data.train,
        batch_sampler=sampler,
        num_workers=workers,
        worker_init_fn=leave_signals,
        pin_memory=team.device.type == "cuda",
    )


@dataclass(frozen=True)
class TrainingData:
    """The data of one training, simulated or real, and how it judges a network.

    train, validation: what to learn from, and what to choose the checkpoint by. score: returns the
    scores of a network on the validation images, by name. chosen_by: the score that chooses the
    checkpoint, higher is better; None: the last checkpoint counts. metres_per_pixel: the scale of
    all images. max_width: metres, the widest opening in the labels.
    """

    train: Dataset
    validation: LabelledImages
    score: Callable[[GraspNet], dict[str, float]]
    chosen_by: str | None
    metres_per_pixel: float
    max_width: float

    def chosen(self, history: Sequence[dict[str, float]]) -> dict[str, float] | None:
        """Return the row of the epoch whose weights to keep (of equal ones the last), or None if
        always the newest weights count."""
        if self.chosen_by is None:
            return None
        return max(history, key=lambda row: (row[self.chosen_by], row["epoch"]))

    def keep_best(
        self, run: Path, history: Sequence[dict[str, float]], save: Callable[[Path], None]
    ) -> None:
        """Write best.pt into the run folder with `save` if the newest epoch is the chosen one."""
        if self.chosen(history) is history[-1]:
            save(run / "best.pt")

    def pictured(self) -> dict[str, LabelledImages]:
        """Return the images to draw the network's predictions on, by the picture's name."""
        return {"predictions": self.validation}


def simulated_data(config: Config, folder: Path, focal: float) -> TrainingData:
    """Return the simulated images in `folder` at the scale of the config's camera.

    focal: pixels, the camera's focal length. Networks are judged by the dense labels of objects
    that are held out of the training images.
    """
    metres_per_pixel = math.dist(config.camera.position, config.camera.target) / focal
    train, validation = (
        AtPixelSize(SimulatedDataset(folder, split, frames), metres_per_pixel)
        for split, frames in (
            ("train", config.data.frames),
            ("validation", config.data.validation_frames),
        )
    )
    noises = [
        make_depth_noise(name, focal, key="train.depth_noises")
        for name in config.train.depth_noises
    ]
    augmentation = Augmentation(
        turn_step=np.pi / ANGLE_BINS,  # whole bins are quick; the cameras' own turns fill the gaps
        colour=ColourJitter(hue=0.0),  # the scenes have every hue
        max_shift=0.0,  # the crop shifts
        scale=(0.97, 1.03),
        depth_noise=NoisyShare(config.train.depth_noise_share, tuple(filter(None, noises))),
    )
    settings = config.train
    return TrainingData(
        train=GraspExamples(train, config.seed, settings.graspable_from, augmentation, CROP),
        validation=validation,
        score=lambda model: score_simulated(model, validation),
        chosen_by="label_quality",
        metres_per_pixel=metres_per_pixel,
        max_width=config.gripper.max_opening,
    )


def score_simulated(model: GraspNet, validation: LabelledImages) -> dict[str, float]:
    """Return the `LabelScores` of a network and the error of its centre head, by name."""
    scores = score_labels(model, validation)._asdict()
    if model.centre_head is not None:
        scores["centre_error"] = centre_error(model, validation)
    return scores


@dataclass(frozen=True)
class NoisyShare:
    """Depth cameras' noises on a share of the images, one of them on each."""

    share: float
    noises: tuple[DepthNoise, ...]

    def __call__(
        self, depth: torch.Tensor, rng: np.random.Generator, rgb: torch.Tensor
    ) -> torch.Tensor:
        if not self.noises or rng.random() >= self.share:
            return depth
        noise = self.noises[rng.integers(len(self.noises))]
        colours = rgb.permute(1, 2, 0).cpu().numpy()
        return depth.new_tensor(measure(noise, depth.cpu().numpy(), rng, colours))
