"""How good a network's grasps are by the dense labels of images that it was not trained on."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch

from models.grasp_examples import LabelledImages, offset_to
from models.grasp_peaks import Peaks, PeakSettings, find_peaks
from models.graspnet import GraspNet, to_input
from utils.augmentation import LabelledImage
from utils.errors import UserError
from utils.grasp_labels import LabelSettings
from utils.transforms import angle_difference

BEST = PeakSettings(threshold=0.0, count=1)


class LabelScores(NamedTuple):
    """Of the top grasps of N images that have something to grasp.

    label_quality: mean label of the grasp's pixel and angle bin, 0 where none is feasible.
    precision: share whose label counts as positive. angle_error: mean, radians, to the nearest
    positive label (nearest in the image; of its angles the nearest). width_error: mean, metres, to
    the width of that label. distance: mean, pixels, to it. images: N.
    """

    label_quality: float
    precision: float
    angle_error: float
    width_error: float
    distance: float
    images: int


def check_graspable(images: LabelledImages) -> None:
    """Raise UserError if no image shows anything to grasp; looks no further than the first that
    does."""
    if not any(shows_a_grasp(images[index]) for index in range(len(images))):
        raise UserError(
            f"none of the {len(images)} validation images shows anything that can be grasped, so "
            "no network could be chosen by them; use more images (data.validation_frames) or "
            "objects that fit the gripper (objects.scale, data.object_sets)"
        )


def shows_a_grasp(image: LabelledImage) -> bool:
    return bool((image.quality >= LabelSettings().positive).any())


@torch.inference_mode()
def predict(
    model: GraspNet, image: LabelledImage, centres: bool = False
) -> tuple[torch.Tensor, ...]:
    """The network's maps (1, C, H, W) of one labelled image."""
    device = next(model.parameters()).device
    rgb = np.ascontiguousarray(image.rgb.permute(1, 2, 0).numpy())
    x = to_input(rgb, image.depth.numpy())[None].to(device, memory_format=torch.channels_last)
    return model(x, centres=centres)


def score_labels(model: GraspNet, images: LabelledImages) -> LabelScores:
    """Top grasps against dense labels; the model is left in evaluation mode."""
    model.eval()
    rows = []
    for index in range(len(images)):
        image = images[index]
        if shows_a_grasp(image):
            found = find_peaks(*predict(model, image), BEST)
            rows.append(score_peak(found, image))
    if not rows:
        return LabelScores(0.0, 0.0, np.pi / 2, float("nan"), float("nan"), 0)
    quality, angle, width, distance = np.array(rows).T
    precision = float((quality >= LabelSettings().positive).mean())
    return LabelScores(
        float(quality.mean()), precision, float(angle.mean()), float(width.mean()),
        float(distance.mean()), len(rows),
    )  # fmt: skip


@torch.inference_mode()
def centre_error(model: GraspNet, images: LabelledImages) -> float:
    """How far from their object's centre of mass the pixels of objects point, in pixels: the median
    in each image, averaged. The model needs a centre head, the images centres."""
    model.eval()
    errors = []
    for image in (images[index] for index in range(len(images))):
        on_object = image.centre.isfinite().all(dim=0)
        if on_object.any():
            *_, offset = predict(model, image, centres=True)
            wrong = offset[0].cpu() - offset_to(image.centre)
            errors.append(float(torch.linalg.norm(wrong[:, on_object], dim=0).median()))
    return float(np.mean(errors))


def score_peak(found: Peaks, image: LabelledImage) -> tuple[float, float, float, float]:
    """Label quality, angle error, width error and distance of the first peak."""
    bins = image.quality.shape[0]
    centres = np.arange(bins) * np.pi / bins
    (u, v), angle, width = found.pixel[0], found.angle[0], found.width[0]
    row, column = (int(np.clip(round(x), 0, n - 1)) for x, n in zip((v, u), image.depth.shape))
    nearest_bin = int(angle_difference(centres, angle).argmin())
    label = float(image.quality[nearest_bin, row, column])

    k, rows, columns = np.nonzero(image.quality.numpy() >= LabelSettings().positive)
    distance = np.hypot(rows - v, columns - u)
    beside = np.flatnonzero(distance <= max(distance.min(), 1.0))  # within one pixel: all angles
    turn = angle_difference(centres[k[beside]], angle)
    best = beside[turn.argmin()]
    labelled_width = float(image.width[k[best], rows[best], columns[best]])
    return label, float(turn.min()), abs(float(width) - labelled_width), float(distance.min())
