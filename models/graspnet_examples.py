"""From labelled images to batches: resampled, changed at random, cropped, as input and targets.

Every example is a pure function of (seed, epoch, index), and every epoch's order of (seed, epoch):
a run that is resumed sees what the uninterrupted one would have seen, with any number of workers.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple, Protocol

import numpy as np
import torch
from torch.utils.data import Dataset, Sampler

from models.graspnet import GraspTargets, targets_from_labels, to_input
from models.graspnet_io import metres_per_pixel
from utils.augmentation import Augmentation, LabelledImage, Similarity, apply_similarity
from utils.grasp_data import SimulatedDataset


class LabelledImages(Protocol):
    """What GraspExamples takes: a sequence of labelled images."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> LabelledImage: ...


class AtPixelSize:
    """The frames of a SimulatedDataset, scaled so that a pixel spans `metres_per_pixel` of table.

    Convolutions know no other scale, and cameras differ. Kept apart: the scale of each frame, which
    augmentation takes in the same resampling as its own.
    """

    def __init__(self, images: SimulatedDataset, metres_per_pixel: float):
        self.images, self.metres_per_pixel = images, metres_per_pixel

    def __len__(self) -> int:
        return len(self.images)

    def __getitem__(self, index: int) -> LabelledImage:
        return apply_similarity(self.images[index], Similarity(scale=self.zoom(index)))

    def zoom(self, index: int) -> float:
        """What frame `index` has to be scaled by."""
        K, _ = self.images.cameras[index]
        return metres_per_pixel(K, self.images.table_distance(index)) / self.metres_per_pixel


class Example(NamedTuple):
    """image: (4, h, w), see `to_input`. targets: of the same size, without a batch dimension."""

    image: torch.Tensor
    targets: GraspTargets


class GraspExamples(Dataset):
    """Examples of a set of labelled images, for training (with `augmentation`) or without.

    crop: side in pixels of the square that is cut out around something graspable; None leaves the
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
        rng = np.random.default_rng([self.seed, epoch, index])
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
        """Slices of a square that holds a random graspable pixel, or just any where none is."""
        if self.crop is None:
            return (slice(None),)
        shape = np.array(image.depth.shape)
        side = np.minimum(self.crop, shape)
        pixels = (image.quality.amax(dim=0) > 0).nonzero().numpy()
        centre = pixels[rng.integers(len(pixels))] if len(pixels) else rng.integers(shape)
        corner = centre - side // 2 + rng.integers(-side // 4, side // 4 + 1)
        row, column = np.clip(corner, 0, shape - side)
        return (slice(None), slice(row, row + side[0]), slice(column, column + side[1]))


def offset_to(centre: torch.Tensor) -> torch.Tensor:
    """(2, H, W) what leads from each pixel (u, v) to a place `centre` (2, H, W) in the image."""
    rows, columns = centre.shape[1:]
    v, u = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
    return centre - torch.stack([u, v])


class EpochBatches(Sampler):
    """One process's share of every batch of one epoch, shuffled by (seed, epoch).

    Yields lists of (epoch, index), `batch_size / ranks` long. What does not fill a batch is left
    out; another epoch's order brings it. skip: batches already done.
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
