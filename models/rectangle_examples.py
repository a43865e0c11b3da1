"""Real images with labelled rectangles: the network's view, training examples, scores, pictures.

Rectangles move with the image and are drawn as dense targets last, so turned labels are exact and
an example costs as much as its crop. Every example is a pure function of (seed, epoch, index). A
network's best grasp is scored by the rectangle metric of Cornell and Jacquard: the network predicts
centre, angle and width; the length of the plates is the median of its training labels. This module
knows no file format.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch.utils.data import Dataset

from models.graspnet import GraspNet, GraspTargets, targets_from_labels, to_input
from models.graspnet_data import Example
from models.graspnet_decoding import HIGHEST_PEAK, find_peaks
from utils.atomic_files import save_figure
from utils.augmentation import Augmentation, LabelledImage
from utils.rectangles import (
    GraspRectangle,
    RealSample,
    View,
    intersection_over_union,
    rasterise,
    rectangle_match,
)
from utils.transforms import angle_difference

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ANYWHERE = 0.5  # of the examples show any part of the view: its corners hold nothing to grasp
COLUMNS = 5  # of a picture's grid
SHOWN = 60  # images in a picture at most; of more images, some evenly spread ones
MARGIN = 40  # pixels around all rectangles


class RectangleImages:
    """Real samples as `LabelledImage`s seen through a view; their widths are pixels of the view."""

    def __init__(self, samples: Sequence[RealSample], view: View):
        self.samples, self.view = samples, view

    def __len__(self) -> int:
        return len(self.samples)

    def __getitem__(self, index: int) -> LabelledImage:
        rgb, depth, rectangles = self.view.warp(self.samples[index])
        quality, width = map(torch.from_numpy, rasterise(rectangles, depth.shape))
        return LabelledImage(
            torch.from_numpy(np.moveaxis(rgb, -1, 0).copy()), torch.from_numpy(depth), quality,
            width, torch.ones(depth.shape, dtype=torch.bool), width_in_pixels=True,
        )  # fmt: skip


class RectangleExamples(Dataset):
    """Training examples of real samples, each changed at random and cropped around a label.

    repeats: the number of examples of each sample in an epoch. crop: side of an example, pixels of
    the view. max_width: metres, the limit of the labels' widths. Indices are pairs (epoch, index).
    """

    def __init__(
        self, samples: Sequence[RealSample], view: View, augmentation: Augmentation, *,
        seed: int, repeats: int, crop: int, max_width: float, graspable_from: float,
    ):  # fmt: skip
        self.samples, self.view, self.augmentation = samples, view, augmentation
        self.seed, self.repeats, self.crop = seed, repeats, min(crop, view.size)
        self.max_width, self.graspable_from = max_width, graspable_from

    def __len__(self) -> int:
        return self.repeats * len(self.samples)

    def __getitem__(self, place: tuple[int, int]) -> Example:
        epoch, index = place
        rng = np.random.default_rng([self.seed, epoch, index + 1])  # 0: the epoch's order
        change = self.augmentation.draw(rng, (self.view.size, self.view.size))
        rgb, depth, rectangles = self.view.warp(
            self.samples[index % len(self.samples)], change.matrix((self.view.size, self.view.size))
        )
        rgb, depth = self._disturb(rgb, depth, rng)
        row, column = self._corner(rectangles, rng)
        # The whole view is normalised, then cut: at test time the median is the whole view's too.
        x = to_input(rgb, depth)[:, row : row + self.crop, column : column + self.crop]
        cut = np.array([[1.0, 0.0, -column], [0.0, 1.0, -row], [0.0, 0.0, 1.0]])
        return Example(x, self._targets([rectangle.transformed(cut) for rectangle in rectangles]))

    def _disturb(
        self, rgb: np.ndarray, depth: np.ndarray, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        if self.augmentation.colour is not None:
            changed = self.augmentation.colour(torch.from_numpy(np.moveaxis(rgb, -1, 0)), rng)
            rgb = np.ascontiguousarray(changed.permute(1, 2, 0).numpy())
        if self.augmentation.depth_noise is not None:
            colours = torch.from_numpy(np.moveaxis(rgb, -1, 0))
            depth = self.augmentation.depth_noise(torch.from_numpy(depth), rng, colours).numpy()
        return rgb, depth

    def _corner(
        self, rectangles: Sequence[GraspRectangle], rng: np.random.Generator
    ) -> tuple[int, int]:
        """Return the row and column of a crop: anywhere, or so that it holds a random label."""
        if rng.random() < ANYWHERE:
            middle = rng.uniform(0, self.view.size, size=2)
        else:
            u, v = rectangles[rng.integers(len(rectangles))].centre
            middle = np.array([v, u]) + rng.uniform(-0.4, 0.4, size=2) * self.crop
        corner = np.rint(middle - self.crop / 2).astype(int)
        row, column = np.clip(corner, 0, self.view.size - self.crop)
        return int(row), int(column)

    def _targets(self, rectangles: Sequence[GraspRectangle]) -> GraspTargets:
        """Return targets (C, crop, crop) of rectangles in the crop's pixels."""
        quality, width = map(torch.from_numpy, rasterise(rectangles, (self.crop, self.crop)))
        metres = (width * self.view.metres_per_pixel).clamp(max=self.max_width)
        targets = targets_from_labels(
            quality[None], metres[None], graspable_from=self.graspable_from
        )
        return GraspTargets(*(target[0] for target in targets))


# --- Scores ---------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class JudgedRectangle:
    """The score of a network's best grasp on one image.

    rectangle: in pixels of the data set's image. iou, angle_error: to the label with the largest
    IoU, the error in radians. correct: by the rectangle metric.
    """

    name: str
    object_id: str
    rectangle: GraspRectangle
    quality: float
    correct: bool
    iou: float
    angle_error: float

    def as_dict(self) -> dict:
        """Return plain numbers for a JSON file; angles in degrees."""
        return {
            "name": self.name,
            "object": self.object_id,
            "correct": self.correct,
            "quality": round(self.quality, 4),
            "u": round(float(self.rectangle.centre[0]), 2),
            "v": round(float(self.rectangle.centre[1]), 2),
            "angle_deg": round(float(np.degrees(self.rectangle.angle)), 2),
            "width_px": round(self.rectangle.width, 2),
            "height_px": round(self.rectangle.height, 2),
            "iou": round(self.iou, 4),
            "angle_error_deg": round(float(np.degrees(self.angle_error)), 2),
        }


def median_plate_length(samples: Sequence[RealSample]) -> float:
    """Return the median length of the plates in all labels of some images, in pixels."""
    return float(np.median([r.height for sample in samples for r in sample.positives]))


@torch.inference_mode()
def best_rectangle(
    model: GraspNet, sample: RealSample, view: View, plate_length: float
) -> tuple[GraspRectangle, float]:
    """Return the network's best grasp on an image, in that image's pixels, and its quality.

    plate_length: pixels of the image, the rectangle's size across the closing line. The model has
    to be in evaluation mode.
    """
    rgb, depth, _ = view.warp(sample)
    device = next(model.parameters()).device
    x = to_input(rgb, depth)[None].to(device, memory_format=torch.channels_last)
    found = find_peaks(*model(x), HIGHEST_PEAK)
    zoom = view.size / view.side
    opening = max(float(found.width[0]) / view.metres_per_pixel, 1e-3)
    there = GraspRectangle(found.pixel[0], float(found.angle[0]), opening, plate_length * zoom)
    back = np.linalg.inv(view.matrix(sample.depth.shape))
    return there.transformed(back), float(found.quality[0])


def judge(
    model: GraspNet, samples: Sequence[RealSample], view: View, plate_length: float
) -> list[JudgedRectangle]:
    """Score the best grasp on every image; the model ends in evaluation mode."""
    model.eval()
    return [
        judged(sample, *best_rectangle(model, sample, view, plate_length)) for sample in samples
    ]


def judged(sample: RealSample, rectangle: GraspRectangle, quality: float) -> JudgedRectangle:
    """Score a grasp on an image, in that image's pixels, by the rectangle metric."""
    overlaps = [intersection_over_union(rectangle, label) for label in sample.positives]
    nearest = int(np.argmax(overlaps))
    error = angle_difference(rectangle.angle, sample.positives[nearest].angle)
    return JudgedRectangle(
        sample.name, sample.object_id, rectangle, quality,
        rectangle_match(rectangle, sample.positives), overlaps[nearest], float(error),
    )  # fmt: skip


# --- Pictures -------------------------------------------------------------------------------


def draw_rectangles(
    path: Path, samples: Sequence[RealSample], judged: Sequence[JudgedRectangle], shown: int = SHOWN
) -> None:
    """Draw a grid of images with their labels (green) and the prediction (blue if correct, else
    red); the thick sides are the plates."""
    import matplotlib.pyplot as plt  # slow to import, and few callers need it

    chosen = np.unique(np.linspace(0, len(judged) - 1, min(shown, len(judged))).astype(int))
    rows = -(-len(chosen) // COLUMNS)
    figure, axes = plt.subplots(
        rows, COLUMNS, figsize=(2.6 * COLUMNS, 2.8 * rows), squeeze=False, layout="constrained"
    )
    for axis in axes.flat:
        axis.set_axis_off()
    for axis, index in zip(axes.flat, chosen):
        sample, one = samples[int(index)], judged[int(index)]
        axis.imshow(sample.rgb)
        for label in sample.positives:
            _outline(axis, label, "limegreen", 0.8)
        _outline(axis, one.rectangle, "blue" if one.correct else "red", 1.6)
        corners = np.concatenate([r.corners() for r in (*sample.positives, one.rectangle)])
        (left, top), (right, bottom) = corners.min(axis=0) - MARGIN, corners.max(axis=0) + MARGIN
        axis.set_xlim(max(left, 0), min(right, sample.rgb.shape[1]))
        axis.set_ylim(min(bottom, sample.rgb.shape[0]), max(top, 0))
        axis.set_title(
            f"{'' if one.correct else 'WRONG '}{one.name} IoU {one.iou:.2f}, "
            f"{np.degrees(one.angle_error):.0f}°",
            fontsize=7,
        )
    save_figure(path, figure)


def _outline(axis: Axes, rectangle: GraspRectangle, colour: str, width: float) -> None:
    corners = rectangle.corners()
    u, v = corners[[0, 1, 2, 3, 0]].T
    axis.plot(u, v, color=colour, linewidth=width)
    for plate in (corners[1:3], corners[[3, 0]]):
        axis.plot(*plate.T, color=colour, linewidth=2.5 * width)
