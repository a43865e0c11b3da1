"""Pictures of a network's best grasps on real images beside the labelled rectangles."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from models.rectangle_scores import Judged
from utils.files import write_atomic
from utils.real_data import RealSample
from utils.rectangles import GraspRectangle

COLUMNS = 5
SHOWN = 60  # most pictures; of more images, some evenly spread ones
MARGIN = 40  # pixels around all rectangles


def draw_rectangles(
    path: Path, samples: Sequence[RealSample], judged: Sequence[Judged], shown: int = SHOWN
) -> None:
    """A grid of images: labels green, the prediction blue where correct, else red; the thick sides
    are the plates."""
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
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    plt.close(figure)
    write_atomic(path, buffer.getvalue())


def _outline(axis: plt.Axes, rectangle: GraspRectangle, colour: str, width: float) -> None:
    corners = rectangle.corners()
    u, v = corners[[0, 1, 2, 3, 0]].T
    axis.plot(u, v, color=colour, linewidth=width)
    for plate in (corners[1:3], corners[[3, 0]]):
        axis.plot(*plate.T, color=colour, linewidth=2.5 * width)
