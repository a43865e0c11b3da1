"""What GraspNet learns from and is judged by while it learns, for each kind of data.

Knows how images become examples; not how the simulated ones are made.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch.utils.data import Dataset

from models.graspnet import GraspNet
from models.graspnet_examples import AtPixelSize, GraspExamples, LabelledImages
from models.graspnet_scores import centre_error, score_labels
from utils.augmentation import Augmentation, ColourJitter
from utils.config import Config
from utils.depth import DepthNoise, KinectNoise, make_depth_noise
from utils.grasp_data import SimulatedDataset
from utils.grasp_labels import ANGLE_BINS

CROP = 160  # pixels, side of a training example: all context that the network uses, half the work


@dataclass(frozen=True)
class TrainingData:
    """train, validation: what to learn from and what to choose the checkpoint by. score: of a
    network on the validation images, by name. chosen_by: the score of which higher is better; None:
    nothing is chosen, the last checkpoint counts. metres_per_pixel: the scale of all images.
    max_width: metres, the widest opening that a network needs to tell unless the config says.
    """

    train: Dataset
    validation: LabelledImages
    score: Callable[[GraspNet], dict[str, float]]
    chosen_by: str | None
    metres_per_pixel: float
    max_width: float

    keeps_every_epoch = False  # whether `chosen` can go back to one that was not chosen before

    def chosen(self, history: Sequence[dict[str, float]]) -> dict[str, float] | None:
        """The epoch's row whose weights to keep; of equals the last. None: always the newest."""
        if self.chosen_by is None:
            return None
        return max(history, key=lambda row: (row[self.chosen_by], row["epoch"]))

    def pictured(self) -> dict[str, LabelledImages]:
        """What a picture of the network's predictions shows, by the picture's name."""
        return {"predictions": self.validation}


def simulated_data(config: Config, folder: Path, focal: float, distance: float) -> TrainingData:
    """Simulated images as a camera of focal length `focal` pixels sees the table from `distance`
    metres; judged by the dense labels of held-out objects."""
    metres_per_pixel = distance / focal
    train, validation = (
        AtPixelSize(SimulatedDataset(folder, split, frames), metres_per_pixel)
        for split, frames in (
            ("train", config.data.frames),
            ("validation", config.data.validation_frames),
        )
    )
    camera = config.camera
    # Training meets noise even where the cell's own cameras have none.
    noise = make_depth_noise(camera.depth_noise, focal, camera.depth_noise_args)
    noise = noise or KinectNoise(image_focal=focal)
    augmentation = Augmentation(
        turn_step=np.pi / ANGLE_BINS,  # whole bins are quick; the cameras' own turns fill the gaps
        colour=ColourJitter(hue=0.0),  # the scenes have every hue
        max_shift=0.0,  # the crop shifts
        scale=(0.97, 1.03),
        depth_noise=NoisyShare(config.train.depth_noise_share, noise),
    )
    settings = config.train
    examples = GraspExamples(train, config.seed, settings.graspable_from, augmentation, CROP)
    return TrainingData(
        examples,
        validation,
        lambda model: score_simulated(model, validation),
        "label_quality",
        metres_per_pixel,
        config.gripper.max_opening,
    )


def score_simulated(model: GraspNet, validation: LabelledImages) -> dict[str, float]:
    """What the top grasps are worth by the labels, and the error of a centre head, by name."""
    scores = score_labels(model, validation)._asdict()
    if model.centre_head is not None:
        scores["centre_error"] = centre_error(model, validation)
    return scores


@dataclass(frozen=True)
class NoisyShare:
    """A camera's depth noise on a share of the images."""

    share: float
    noise: DepthNoise

    def __call__(self, depth: torch.Tensor, rng: np.random.Generator) -> torch.Tensor:
        if rng.random() >= self.share:
            return depth
        return depth.new_tensor(self.noise(depth.cpu().numpy(), rng))
