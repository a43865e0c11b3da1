"""The scores of a network on labelled images, and the curves and pictures of a training.

A score judges the network alone: the highest peak of its quality map against the dense labels of
images that it was not trained on. No planner's search takes part.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch

from models.graspnet import GraspNet, to_input
from models.graspnet_decoding import HIGHEST_PEAK, Peaks, PeakSettings, find_peaks
from utils.atomic_files import save_figure
from utils.augmentation import LabelledImage, LabelledImages
from utils.errors import UserError
from utils.grasp_labels import LabelSettings
from utils.runs import this_python
from utils.transforms import angle_difference, known_depth

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.transforms import Bbox
    from torch.utils.tensorboard import SummaryWriter

DRAWN = PeakSettings(threshold=0.3, count=5)  # the peaks in a picture
NO_CURVES = ("epoch", "step", "images")  # entries of a history row that are no curves
# Where each entry of a history row comes from, and its unit; "" has none.
TRAINING, VALIDATION = "training", "validation"
CURVES = {
    "loss": (TRAINING, ""),
    "quality_loss": (TRAINING, "nats"),
    "angle_loss": (TRAINING, "nats"),
    "width_loss": (TRAINING, "m"),
    "centre_loss": (TRAINING, "px"),
    "domain_loss": (TRAINING, "nats"),
    "domain_accuracy": (TRAINING, ""),
    "lr": (TRAINING, ""),
    "label_quality": (VALIDATION, ""),
    "precision": (VALIDATION, ""),
    "angle_error": (VALIDATION, "rad"),
    "width_error": (VALIDATION, "m"),
    "distance": (VALIDATION, "px"),
    "centre_error": (VALIDATION, "px"),
    "information": (VALIDATION, "nats"),
}
# Units of CURVES that are printed as others, of which they are so many.
PRINTED = {"rad": ("degrees", 180 / np.pi), "m": ("mm", 1000.0)}


class LabelScores(NamedTuple):
    """Scores of the best grasps on N images that show something graspable.

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
    """Raise UserError if no image shows anything graspable; reads up to the first that does."""
    if not any(shows_a_grasp(images[index]) for index in range(len(images))):
        raise UserError(
            f"none of the {len(images)} validation images shows anything that can be grasped, so "
            "no network could be chosen by them; use more images (data.validation_frames) or "
            "objects that fit the gripper (objects.scale, data.object_sets)"
        )


def shows_a_grasp(image: LabelledImage) -> bool:
    """Whether any pixel and angle bin of the image has a positive label."""
    return bool((image.quality >= LabelSettings().positive).any())


@torch.inference_mode()
def predicted_maps(
    model: GraspNet, image: LabelledImage, centres: bool = False
) -> tuple[torch.Tensor, ...]:
    """Return the network's maps (1, C, H, W) of one labelled image."""
    device = next(model.parameters()).device
    rgb = np.ascontiguousarray(image.rgb.permute(1, 2, 0).numpy())
    x = to_input(rgb, image.depth.numpy())[None].to(device, memory_format=torch.channels_last)
    return model(x, centres=centres)


def score_labels(model: GraspNet, images: LabelledImages) -> LabelScores:
    """Score the network's best grasps by dense labels; the model ends in evaluation mode."""
    model.eval()
    rows = []
    for index in range(len(images)):
        image = images[index]
        if shows_a_grasp(image):
            found = find_peaks(*predicted_maps(model, image), HIGHEST_PEAK)
            rows.append(score_peak(found, image))
    if not rows:
        return LabelScores(0.0, 0.0, np.pi / 2, float("nan"), float("nan"), 0)
    quality, angle, width, distance = np.array(rows).T
    precision = float((quality >= LabelSettings().positive).mean())
    return LabelScores(
        float(quality.mean()), precision, float(angle.mean()), float(width.mean()),
        float(distance.mean()), len(rows),
    )  # fmt: skip


def score_peak(found: Peaks, image: LabelledImage) -> tuple[float, float, float, float]:
    """Return label quality, angle error, width error and distance of the first peak."""
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


@torch.inference_mode()
def centre_error(model: GraspNet, images: LabelledImages) -> float:
    """Return the error of a centre head in pixels: the median over the pixels on objects of each
    image, averaged over the images. The images must hold centres of mass."""
    model.eval()
    errors = []
    for image in (images[index] for index in range(len(images))):
        on_object = image.centre.isfinite().all(dim=0)
        if on_object.any():
            *_, offset = predicted_maps(model, image, centres=True)
            wrong = offset[0].cpu() - offset_to(image.centre)
            errors.append(float(torch.linalg.norm(wrong[:, on_object], dim=0).median()))
    return float(np.mean(errors))


def offset_to(centre: torch.Tensor) -> torch.Tensor:
    """Return the offsets (2, H, W) from each pixel (u, v) to the places `centre` (2, H, W)."""
    rows, columns = centre.shape[1:]
    v, u = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
    return centre - torch.stack([u, v])


def describe_scores(scores: Mapping[str, float]) -> str:
    """Describe a history row's validation scores in one sentence."""
    return (
        f"the network alone, by the best grasp on each of {scores['images']:.0f} validation "
        f"images: mean label {scores['label_quality']:.2f} of 1, "
        f"{100 * scores['precision']:.0f} % positive; the nearest label is "
        f"{np.degrees(scores['angle_error']):.1f} degrees, {1000 * scores['width_error']:.1f} mm "
        f"of width and {scores['distance']:.1f} px away"
    )


def row_in_words(row: Mapping[str, float]) -> str:
    """'epoch 3, step 12, ..., angle error 6.2 degrees': a history row with its units."""
    words = []
    for name, value in row.items():
        if name in NO_CURVES:
            words.append(f"{name} {value:,.0f}")
            continue
        unit, factor = PRINTED.get(CURVES[name][1], (CURVES[name][1], 1.0))
        words.append(f"{name.replace('_', ' ')} {factor * value:.3g} {unit}".rstrip())
    return ", ".join(words)


def closing_words(scores: Mapping[str, float], network: Path) -> str:
    """Lines about the best network, whose file is `network`, and what to do with it next."""
    python = this_python()
    adapted = (
        "(of simulated images, with the batch norms' statistics of simulated ones; the file holds\n"
        "those of the photographs)\n"
    )
    return (
        f"best after epoch {scores['epoch']:.0f}: {describe_scores(scores)}\n"
        f"{adapted if 'information' in scores else ''}"
        f"the same on test objects: {python} -m benchmarks.bench_graspnet --checkpoint {network}\n"
        "with the planner's search, which makes up for much that a weak network misses:\n"
        f"  {python} evaluate.py evaluate.policies=heuristic,{network}"
    )


def curve_tag(name: str) -> str:
    """Return the TensorBoard tag of an entry of a history row: "validation/width_error_m"."""
    origin, unit = CURVES[name]
    return f"{origin}/{name}_{unit}" if unit else f"{origin}/{name}"


@contextmanager
def open_curves(folder: Path, first_step: int, is_main: bool) -> Iterator[SummaryWriter | None]:
    """TensorBoard curves of a training, closed at the end; None but for the main process. What lies
    beyond `first_step`, of a training that is resumed before it, is dropped."""
    if not is_main:
        yield None
        return
    from torch.utils.tensorboard import SummaryWriter  # slow to import, and few callers need it

    with SummaryWriter(folder, purge_step=first_step + 1) as writer:
        yield writer


def write_curves(writer: SummaryWriter, row: Mapping[str, float]) -> None:
    """Write a history row to TensorBoard at its step."""
    for name, value in row.items():
        if name not in NO_CURVES:
            writer.add_scalar(curve_tag(name), value, row["step"])
    writer.flush()


def draw_curves(
    path: Path, history: Sequence[dict[str, float]], chosen: float | None = None
) -> None:
    """Draw one small plot for every loss (training) and score (validation) over the epochs, with a
    mark at the `chosen` epoch."""
    import matplotlib.pyplot as plt  # slow to import, and few callers need it
    from matplotlib.ticker import MaxNLocator

    names = [name for name in history[-1] if name not in NO_CURVES]
    columns = 4
    rows = -(-len(names) // columns)
    figure, axes = plt.subplots(
        rows, columns, figsize=(3.2 * columns, 2.4 * rows), squeeze=False, layout="constrained"
    )
    epochs = [row["epoch"] for row in history]
    for axis, name in zip(axes.flat, names):
        origin, unit = CURVES[name]
        colour = "tab:blue" if origin == TRAINING else "tab:orange"
        axis.plot(epochs, [row[name] for row in history], marker=".", color=colour)
        axis.set_title(f"{origin}: {name.replace('_', ' ')}", fontsize=10)
        axis.set_xlabel("epoch", fontsize=8)
        axis.set_ylabel(unit, fontsize=8)
        axis.grid(alpha=0.3)
        axis.xaxis.set_major_locator(MaxNLocator(nbins=6, integer=True))
        if chosen is not None:
            axis.axvline(chosen, color="black", linestyle="--", linewidth=1)
    if chosen is not None:
        figure.suptitle(f"dashed: epoch {chosen:.0f}, whose weights were chosen", fontsize=10)
    for axis in list(axes.flat)[len(names) :]:
        axis.remove()
    save_figure(path, figure)


def draw_predictions(path: Path, model: GraspNet, images: LabelledImages, count: int = 8) -> None:
    """Draw rows of: colour with the best grasps, depth, labelled and predicted quality."""
    import matplotlib.pyplot as plt  # slow to import, and few callers need it

    chosen = np.linspace(0, len(images) - 1, min(count, len(images))).astype(int)
    titles = ("grasps", "depth", "labelled quality", "predicted quality")
    rows, columns = images[0].depth.shape
    size = 10, 2.5 * rows / columns * len(chosen) + 0.3  # inches; the last ones for the titles
    figure, axes = plt.subplots(len(chosen), 4, figsize=size, squeeze=False, layout="constrained")
    model.eval()
    for row, index in zip(axes, chosen):
        image = images[int(index)]
        quality, angle, width = predicted_maps(model, image)
        depth = image.depth.numpy()
        row[0].imshow(image.rgb.permute(1, 2, 0).numpy())
        known = depth[known_depth(depth)]
        row[1].imshow(depth, cmap="gray", vmin=known.min(), vmax=known.max())
        row[2].imshow(image.quality.amax(dim=0).numpy(), vmin=0, vmax=1)
        row[3].imshow(torch.squeeze(quality).float().cpu().numpy(), vmin=0, vmax=1)
        draw_peaks(row[0], find_peaks(quality, angle, width, DRAWN))
        for axis in row:
            axis.set_axis_off()
    for axis, title in zip(axes[0], titles):
        axis.set_title(title, fontsize=10)
    figure.draw_without_rendering()  # numbers have places only once the axes have theirs
    for axis in axes[:, 0]:
        keep_legible(axis)
    save_figure(path, figure)


def draw_peaks(axis: Axes, found: Peaks) -> None:
    """Draw grasps and their qualities on an image, whose borders stay those of the axis."""
    axis.autoscale(False)
    left, right, bottom, top = *axis.get_xlim(), *axis.get_ylim()
    for (u, v), direction, value in zip(found.pixel, found.angle, found.quality):
        du, dv = 12 * np.cos(direction), 12 * np.sin(direction)
        axis.plot([u - du, u + du], [v - dv, v + dv], color="white", linewidth=3)
        axis.plot([u - du, u + du], [v - dv, v + dv], color="tab:red", linewidth=1.5)
        # Towards the middle, so that no number crosses the border.
        across = "left" if u < (left + right) / 2 else "right"
        down = v < (bottom + top) / 2
        number = axis.annotate(
            f"{value:.2f}", (u, v), (0, -4 if down else 4), textcoords="offset points", fontsize=6,
            ha=across, va="top" if down else "bottom", color="white",
            bbox={"facecolor": "black", "alpha": 0.6, "linewidth": 0, "pad": 0.8},
        )  # fmt: skip
        number.set_in_layout(False)


def keep_legible(axis: Axes) -> None:
    """Remove the numbers that lie over those of better grasps, which are drawn first, or over the
    lines of other grasps."""
    lines = [line.get_window_extent() for line in axis.lines[::2]]  # each has a rim
    kept: list[Bbox] = []
    for place, number in enumerate(list(axis.texts)):
        box = number.get_window_extent()
        others = lines[:place] + lines[place + 1 :] if place else []  # the best has its number
        if any(box.overlaps(other) for other in (*kept, *others)):
            number.remove()
        else:
            kept.append(box)
