"""How good a network's grasps are by the dense labels of images that it was not trained on.

Pictures of a training: loss and score curves, and what the network says of some images.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np
import torch

from models.graspnet import GraspNet, to_input
from models.graspnet_decoding import Peaks, PeakSettings, find_peaks
from models.graspnet_examples import LabelledImages, offset_to
from utils.augmentation import LabelledImage
from utils.errors import UserError
from utils.grasp_labels import LabelSettings
from utils.runs import write_atomic
from utils.transforms import angle_difference, known_depth

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


SHOWN = PeakSettings(threshold=0.3, count=5)


def draw_curves(path: Path, history: Sequence[dict[str, float]]) -> None:
    """One small plot for every loss and score over the epochs."""
    names = [name for name in history[-1] if name not in ("epoch", "step", "images")]
    columns = 4
    rows = -(-len(names) // columns)
    figure, axes = plt.subplots(
        rows, columns, figsize=(3.2 * columns, 2.4 * rows), squeeze=False, layout="constrained"
    )
    epochs = [row["epoch"] for row in history]
    for axis, name in zip(axes.flat, names):
        axis.plot(epochs, [row[name] for row in history], marker=".")
        axis.set_title(name.replace("_", " "), fontsize=10)
        axis.set_xlabel("epoch", fontsize=8)
        axis.grid(alpha=0.3)
    for axis in list(axes.flat)[len(names) :]:
        axis.remove()
    _save(figure, path)


def draw_predictions(path: Path, model: GraspNet, images: LabelledImages, count: int = 8) -> None:
    """Rows of: colour with the best grasps, depth, labelled quality, the network's quality."""
    chosen = np.linspace(0, len(images) - 1, min(count, len(images))).astype(int)
    titles = ("grasps", "depth", "labelled quality", "predicted quality")
    figure, axes = plt.subplots(
        len(chosen), 4, figsize=(10, 2.5 * len(chosen)), squeeze=False, layout="constrained"
    )
    model.eval()
    for row, index in zip(axes, chosen):
        image = images[int(index)]
        quality, angle, width = predict(model, image)
        depth = image.depth.numpy()
        row[0].imshow(image.rgb.permute(1, 2, 0))
        known = depth[known_depth(depth)]
        row[1].imshow(depth, cmap="gray", vmin=known.min(), vmax=known.max())
        row[2].imshow(image.quality.amax(dim=0), vmin=0, vmax=1)
        row[3].imshow(torch.squeeze(quality).float().cpu(), vmin=0, vmax=1)
        found = find_peaks(quality, angle, width, SHOWN)
        for (u, v), direction, value in zip(found.pixel, found.angle, found.quality):
            du, dv = 12 * np.cos(direction), 12 * np.sin(direction)
            row[0].plot([u - du, u + du], [v - dv, v + dv], color="white", linewidth=3)
            row[0].plot([u - du, u + du], [v - dv, v + dv], color="tab:red", linewidth=1.5)
            row[0].text(u, v, f"{value:.2f}", fontsize=6, color="white")
        for axis in row:
            axis.set_axis_off()
    for axis, title in zip(axes[0], titles):
        axis.set_title(title, fontsize=10)
    _save(figure, path)


def _save(figure: plt.Figure, path: Path) -> None:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    plt.close(figure)
    write_atomic(path, buffer.getvalue())
