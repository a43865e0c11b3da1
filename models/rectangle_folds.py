"""Cornell and Jacquard as training data, in folds for cross-validation.

Protocol: each fold's images are tested by a network trained on the other folds only, for a fixed
schedule, with its last weights. No test image chooses anything, so there is no validation split
besides. This module knows the data sets' cameras; not how the files are read.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from models.graspnet import GraspNet
from models.graspnet_data import TrainingData
from models.rectangle_examples import (
    Judged,
    RectangleExamples,
    RectangleImages,
    View,
    judge,
    median_plate_length,
)
from utils.augmentation import Augmentation, ColourJitter
from utils.config import Config
from utils.real_data import RealSample, Split, image_folds, object_folds, open_real_data
from utils.statistics import wilson_interval

VIEWS = {
    # The table, which fills the middle of the image, seen 45 degrees from above. A first Kinect
    # (525 px focal length) at a median 1.2 m; at three fifths of its resolution the network sees
    # all of a cereal box at once.
    "cornell": View(side=400, size=240, metres_per_pixel=1.2 / 525 * 400 / 240, slanted=True),
    # The whole image, as small as GG-CNN and GR-ConvNet take it. Its objects have no true size
    # (ShapeNet's are scaled at random): a pixel is taken to span what one of Cornell does.
    "jacquard": View(side=1024, size=300, metres_per_pixel=1.2 / 525 * 400 / 300),
}
MAX_WIDTH = 0.25  # m: the widest label of Cornell's folder 01 opens 0.22 m; no Panda hand does
CROPS = {"cornell": 128, "jacquard": 160}  # pixels of the view, side of a training example
IN_MEMORY = 1000  # images that are decoded once: all of Cornell, 2 GB
ASKED_FOR_PLATES = 500  # most images whose labels tell the plates' length
DEPTH_NOISE = 0.002  # m, standard deviation; real depth is noisy already


def white_noise(depth: torch.Tensor, rng: np.random.Generator) -> torch.Tensor:
    """depth (H, W) metres with normal deviates added."""
    noise = rng.standard_normal(tuple(depth.shape), dtype=np.float32)
    return depth + DEPTH_NOISE * torch.from_numpy(noise)


AUGMENTATION = Augmentation(
    max_shift=0.0,  # the crop shifts
    scale=(1 / 1.3, 1.3),
    colour=ColourJitter(0.4, 0.4, 0.4, 0.05),
    depth_noise=white_noise,
)


class Changed(Sequence[RealSample]):
    """The samples of a data set, each changed by a function whenever it is asked for."""

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


@dataclass(frozen=True, eq=False)
class Fold:
    """One network's share of a cross-validation: what it learns from, what it is tested on.

    train, test: names of the images. plate_length: pixels, median of the training labels.
    """

    number: int
    data: TrainingData
    train: tuple[str, ...]
    test: tuple[str, ...]
    test_samples: Sequence[RealSample]
    view: View
    plate_length: float

    def judge(self, model: GraspNet) -> list[Judged]:
        """The rectangle metric on the test images."""
        return judge(model, self.test_samples, self.view, self.plate_length)


def real_folds(config: Config) -> list[Fold]:
    """The folds that `config.data` names: all, or number `data.fold`.

    Raises UserError for missing or broken files, and folds that cannot be made.
    """
    settings = config.data
    dataset = open_real_data(settings.kind, settings.root)
    splits = folds_of(dataset.object_ids, settings.split, settings.folds, config.seed)
    numbers = range(settings.folds) if settings.fold is None else [settings.fold]
    view = VIEWS[settings.kind]
    samples = Changed(dataset, view.levelled) if view.slanted else dataset
    samples = list(samples) if len(dataset) <= IN_MEMORY else samples
    return [_fold(config, number, splits[number], samples, dataset.names) for number in numbers]


def folds_of(object_ids: Sequence[str], split: str, folds: int, seed: int) -> list[Split]:
    """Folds by `object` (those of a test image are never trained on) or by `image`."""
    if split == "object":
        return object_folds(object_ids, folds)
    return image_folds(len(object_ids), folds, seed)


def _fold(
    config: Config, number: int, split: Split, samples: Sequence[RealSample], names: Sequence[str]
) -> Fold:
    view = VIEWS[config.data.kind]
    train, test = Chosen(samples, split.train), Chosen(samples, split.test)
    examples = RectangleExamples(
        train, view, AUGMENTATION, seed=config.seed, repeats=config.data.repeats,
        crop=CROPS[config.data.kind], max_width=MAX_WIDTH,
        graspable_from=config.train.graspable_from,
    )  # fmt: skip
    data = TrainingData(
        examples, RectangleImages(test, view), lambda model: {}, None, view.metres_per_pixel,
        MAX_WIDTH,
    )  # fmt: skip
    step = -(-len(train) // ASKED_FOR_PLATES)
    asked = Chosen(samples, split.train[::step])
    return Fold(
        number, data, tuple(names[i] for i in split.train), tuple(names[i] for i in split.test),
        test, view, median_plate_length(asked),
    )  # fmt: skip


# --- What came out of it --------------------------------------------------------------------

METRIC = "top-1, IoU > 0.25 and angle < 30 degrees"


def describe_fold(fold: Fold, judged: Sequence[Judged]) -> str:
    """Two lines: the accuracy, and which images it is of."""
    right = sum(one.correct for one in judged)
    wrong = " ".join(one.name for one in judged if not one.correct)
    return (
        f"fold {fold.number}: {right} of {len(judged)} correct ({100 * right / len(judged):.1f} %)"
        f"{'; wrong: ' + wrong if wrong else ''}\n"
        f"  trained on the other {len(fold.train)}; tested on {' '.join(fold.test)}"
    )


def describe_folds(config: Config, judged: Mapping[int, Sequence[Judged]]) -> str:
    """One line for all folds together."""
    right, count, (low, high) = pooled(judged)
    which = f"{len(judged)} of {config.data.folds} folds by {config.data.split}"
    return (
        f"{config.data.kind}, {which}: {right} of {count} correct, {100 * right / count:.1f} % "
        f"[{100 * low:.1f}, {100 * high:.1f}] (95 % Wilson; {METRIC}; fixed schedule, last weights)"
    )


def pooled(judged: Mapping[int, Sequence[Judged]]) -> tuple[int, int, tuple[float, float]]:
    """How many are correct, of how many, and the Wilson interval, over all folds."""
    every = [one for fold in judged.values() for one in fold]
    right = sum(one.correct for one in every)
    return right, len(every), wilson_interval(right, len(every))


def cross_validation_results(
    folds: Sequence[Fold], judged: Mapping[int, Sequence[Judged]]
) -> dict[str, Any]:
    """Plain data for results.json: accuracy of the folds tested so far and every prediction."""
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
