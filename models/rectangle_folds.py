"""Cornell and Jacquard as training data, in folds for cross-validation.

Protocol: each fold's images are tested by a network trained on the other folds only, for a fixed
schedule, with its last weights. No test image chooses anything, so there is no separate validation
split. `utils.real_data.FORMATS` has the data sets, their views and the sizes of their examples.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from models.graspnet import GraspNet
from models.graspnet_data import TrainingData
from models.graspnet_io import save_graspnet
from models.rectangle_examples import (
    JudgedRectangle,
    RectangleExamples,
    RectangleImages,
    draw_rectangles,
    judge,
    median_plate_length,
)
from utils.augmentation import Augmentation, ColourJitter
from utils.config import Config
from utils.errors import UserError
from utils.real_data import FORMATS, open_real_data
from utils.rectangles import RealSample, View
from utils.statistics import clustered_interval, counts_by_group

MAX_WIDTH = 0.25  # m: the widest label of Cornell's folder 01 opens 0.22 m; no Panda hand does
IN_MEMORY = 1000  # data sets of up to so many images are decoded once: all of Cornell, 2 GB
ASKED_FOR_PLATES = 500  # the labels of at most so many images give the length of the plates
METRIC = "top-1, IoU > 0.25 and angle < 30 degrees"
DEPTH_NOISE = 0.002  # m, standard deviation; real depth is noisy already


def white_noise(depth: torch.Tensor, rng: np.random.Generator, rgb: torch.Tensor) -> torch.Tensor:
    """Add normal deviates to depth (H, W) metres."""
    noise = rng.standard_normal(tuple(depth.shape), dtype=np.float32)
    return depth + DEPTH_NOISE * torch.from_numpy(noise)


AUGMENTATION = Augmentation(
    max_shift=0.0,  # the crop shifts
    scale=(1 / 1.3, 1.3),
    colour=ColourJitter(0.4, 0.4, 0.4, 0.05),
    depth_noise=white_noise,
)


# --- Samples and folds ----------------------------------------------------------------------


class Changed(Sequence[RealSample]):
    """The samples of a data set, each changed by a function whenever it is read."""

    def __init__(
        self, samples: Sequence[RealSample], change: Callable[[RealSample], RealSample]
    ):  # fmt: skip
        self.samples, self.change = samples, change

    def __len__(self) -> int:
        return len(self.samples)

    def __getitem__(self, index: int) -> RealSample:
        return self.change(self.samples[index])


class Chosen(Sequence[RealSample]):
    """Some of the samples of a data set."""

    def __init__(self, samples: Sequence[RealSample], indices: Sequence[int]):
        self.samples, self.indices = samples, tuple(indices)

    def __len__(self) -> int:
        return len(self.indices)

    def __getitem__(self, index: int) -> RealSample:
        return self.samples[self.indices[index]]


@dataclass(frozen=True)
class Split:
    """Indices into a data set, each sorted; no index is in both."""

    train: tuple[int, ...]
    test: tuple[int, ...]


def object_folds(object_ids: Sequence[str], folds: int) -> list[Split]:
    """Return k folds by object: no object of a test image is in a training image.

    The objects stay in the order in which they first appear, so each test fold is one stretch of
    them; the sizes of the folds differ by as little as whole objects in this order allow.
    """
    images: dict[str, list[int]] = {}
    for index, name in enumerate(object_ids):
        images.setdefault(name, []).append(index)
    blocks = list(images.values())
    if not 2 <= folds <= len(blocks):
        raise UserError(f"folds: got {folds}, expected 2 to {len(blocks)} (the number of objects)")
    ends = np.cumsum([len(block) for block in blocks])
    cuts = [0]
    for k in range(1, folds):  # the border nearest to k / folds of all images; no fold empty
        low, high = cuts[-1] + 1, len(blocks) - (folds - k)
        nearest = np.abs(ends[low - 1 : high] - k * len(object_ids) / folds).argmin()
        cuts.append(low + int(nearest))
    cuts.append(len(blocks))
    return [_split(len(object_ids), sum(blocks[a:b], [])) for a, b in zip(cuts, cuts[1:])]


def image_folds(count: int, folds: int, seed: int) -> list[Split]:
    """Return k folds by image, drawn at random, whose sizes differ by at most one.

    The object of a test image can be in training images.
    """
    if not 2 <= folds <= count:
        raise UserError(f"folds: got {folds}, expected 2 to {count} (the number of images)")
    order = np.random.default_rng(seed).permutation(count)
    return [_split(count, test) for test in np.array_split(order, folds)]


def _split(count: int, test: Sequence[int]) -> Split:
    chosen = {int(i) for i in test}
    return Split(tuple(i for i in range(count) if i not in chosen), tuple(sorted(chosen)))


def folds_of(object_ids: Sequence[str], split: str, folds: int, seed: int) -> list[Split]:
    """Return the folds by `object` or by `image`."""
    if split == "object":
        return object_folds(object_ids, folds)
    return image_folds(len(object_ids), folds, seed)


@dataclass(frozen=True, eq=False)
class Fold:
    """One network's part of a cross-validation: its training data and its test images.

    train, test: names of the images. plate_length: pixels, median of the training labels.
    """

    number: int
    data: TrainingData
    train: tuple[str, ...]
    test: tuple[str, ...]
    test_samples: Sequence[RealSample]
    view: View
    plate_length: float

    def judge(self, model: GraspNet) -> list[JudgedRectangle]:
        """Score a network on the test images by the rectangle metric."""
        return judge(model, self.test_samples, self.view, self.plate_length)


def real_folds(config: Config) -> list[Fold]:
    """Return the folds that `config.data` names: all, or number `data.fold`.

    Raises UserError for missing or broken files, and folds that cannot be made.
    """
    settings = config.data
    dataset = open_real_data(settings.kind, settings.root)
    splits = folds_of(dataset.object_ids, settings.split, settings.folds, config.seed)
    numbers = range(settings.folds) if settings.fold is None else [settings.fold]
    _check_size(dataset[0], settings.kind)
    view = FORMATS[settings.kind].view
    samples = Changed(dataset, view.levelled) if view.slanted else dataset
    samples = list(samples) if len(dataset) <= IN_MEMORY else samples
    return [_fold(config, number, splits[number], samples, dataset.names) for number in numbers]


def _check_size(sample: RealSample, kind: str) -> None:
    """Warn of images of another size than those of their format, of which the view sees another
    part."""
    form, (rows, columns) = FORMATS[kind], sample.depth.shape
    if (rows, columns) != form.size:
        warnings.warn(
            f"data.root: {sample.name} has {columns} x {rows} px, and data.kind={kind} means "
            f"{form.size[1]} x {form.size[0]}: the network sees the middle {form.view.side} px of "
            "each side, loses labels beside them, and takes a pixel to span what one of that size "
            "does; crop or resize the images",
            stacklevel=2,
        )


def _fold(
    config: Config, number: int, split: Split, samples: Sequence[RealSample], names: Sequence[str]
) -> Fold:
    view = FORMATS[config.data.kind].view
    train, test = Chosen(samples, split.train), Chosen(samples, split.test)
    examples = RectangleExamples(
        train, view, AUGMENTATION, seed=config.seed, repeats=config.data.repeats,
        crop=FORMATS[config.data.kind].crop, max_width=MAX_WIDTH,
        graspable_from=config.train.graspable_from,
    )  # fmt: skip
    data = TrainingData(
        train=examples,
        validation=RectangleImages(test, view),
        score=lambda model: {},
        chosen_by=None,
        metres_per_pixel=view.metres_per_pixel,
        max_width=MAX_WIDTH,
    )
    step = -(-len(train) // ASKED_FOR_PLATES)
    asked = Chosen(samples, split.train[::step])
    return Fold(
        number, data, tuple(names[i] for i in split.train), tuple(names[i] for i in split.test),
        test, view, median_plate_length(asked),
    )  # fmt: skip


# --- Results --------------------------------------------------------------------------------


def save_fold(
    config: Config, folder: Path, fold: Fold, judged: Sequence[JudgedRectangle], model: GraspNet,
    weights: Path | None,
) -> None:  # fmt: skip
    """Save a fold's network alone (to `weights`, too, if given) and pictures of its test images."""
    correct = sum(one.correct for one in judged)
    for path in filter(None, [folder / "graspnet.pt", weights]):
        save_graspnet(
            path, model, fold.data.metres_per_pixel, config.model_dump(mode="json"),
            scores={"correct": correct, "images": len(judged)},
        )  # fmt: skip
    draw_rectangles(folder / "predictions.png", fold.test_samples, judged)


def describe_fold(fold: Fold, judged: Sequence[JudgedRectangle]) -> str:
    """Describe a fold in two lines: the accuracy, and the names of its images."""
    right = sum(one.correct for one in judged)
    wrong = " ".join(one.name for one in judged if not one.correct)
    return (
        f"fold {fold.number}: {right} of {len(judged)} correct ({100 * right / len(judged):.1f} %)"
        f"{'; wrong: ' + wrong if wrong else ''}\n"
        f"  trained on the other {len(fold.train)}; tested on {' '.join(fold.test)}"
    )


def describe_folds(config: Config, judged: Mapping[int, Sequence[JudgedRectangle]]) -> str:
    """Describe all folds together in one line."""
    right, count, (low, high) = pooled(judged)
    which = f"{len(judged)} of {config.data.folds} folds by {config.data.split}"
    return (
        f"{config.data.kind}, {which}: {right} of {count} correct, {100 * right / count:.1f} % "
        f"[{100 * low:.1f}, {100 * high:.1f}] (95 %, by object; {METRIC}; "
        "fixed schedule, last weights)"
    )


def pooled(judged: Mapping[int, Sequence[JudgedRectangle]]) -> tuple[int, int, tuple[float, float]]:
    """Return the number of correct images, of all, and the 95 % interval, over all folds. Images of
    one object are not independent."""
    every = [one for fold in judged.values() for one in fold]
    right = [one.correct for one in every]
    by_object = counts_by_group([one.object_id for one in every], right)
    return sum(right), len(every), clustered_interval(by_object)


def cross_validation_results(
    folds: Sequence[Fold], judged: Mapping[int, Sequence[JudgedRectangle]]
) -> dict[str, Any]:
    """Return plain data for results.json: the accuracy of the folds tested so far, and every
    prediction."""
    right, count, interval = pooled(judged)
    return {
        "metric": METRIC,
        "complete": len(judged) == len(folds),
        "correct": right,
        "images": count,
        "accuracy": right / count,
        "accuracy_ci95": list(interval),
        "folds": [
            {
                "fold": fold.number,
                "correct": sum(one.correct for one in judged[fold.number]),
                "images": len(fold.test),
                "plate_length_px": fold.plate_length,
                "train": list(fold.train),
                "predictions": [one.as_dict() for one in judged[fold.number]],
            }
            for fold in folds
            if fold.number in judged
        ],
    }
