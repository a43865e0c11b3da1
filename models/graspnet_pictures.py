"""Pictures of a training: loss and score curves, and what the network says of some images."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch

from models.grasp_examples import LabelledImages
from models.grasp_peaks import PeakSettings, find_peaks
from models.graspnet import GraspNet
from models.graspnet_scores import predict
from utils.files import write_atomic
from utils.transforms import known_depth

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
