"""Overrides of a small training of GraspNet, and labelled images for its scores."""

from __future__ import annotations

import torch

from utils.augmentation import LabelledImage

BINS = 18
SMALL = [
    "train.backbone=tutorial_skip", "train.batch_size=8", "train.epochs=3", "train.lr=0.01",
    "train.workers=0", "train.device=cpu", "train.precision=float32",
]  # fmt: skip


def labelled(*labels: tuple[int, int, int, float, float], side: int = 20) -> LabelledImage:
    """An image without pattern and with labels (bin, row, column, quality, width)."""
    quality, width = torch.zeros(BINS, side, side), torch.zeros(BINS, side, side)
    for k, row, column, q, w in labels:
        quality[k, row, column], width[k, row, column] = q, w
    return LabelledImage(
        torch.full((3, side, side), 128, dtype=torch.uint8),
        torch.full((side, side), 0.8),
        quality,
        width,
        torch.ones(side, side, dtype=torch.bool),
    )
