"""A network made by hand, and two cubes under a camera: what it should predict is known.

Its quality is the blurred height, its angle an oriented line filter.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
import torch
from torch import nn

from envs.cell import Cell
from envs.cell_layout import Placement, Scene
from envs.simulators import make_cell
from models import graspnet_backbones
from models.graspnet import GraspNet
from utils.transforms import look_at

FOCAL = 112 / np.tan(np.radians(14))  # of the training's images: 224 pixels, 28 degrees
PIXEL = 0.8 / FOCAL
BINS = 18
OVERHEAD = look_at((0.5, 0.0, 0.8), (0.5, 0.0, 0.0), (1.0, 0.0, 0.0))
CUBES = {(0.45, -0.06): 0.3, (0.55, 0.06): 1.1}  # x, y: yaw of 6 cm cubes


class HandMade(nn.Module):
    """Features: 18 line filters on the depth, one for each closing direction, and its blur."""

    stride = 8
    out_channels = BINS + 1

    def __init__(self, input_channels: int):
        super().__init__()
        radius = 24
        self.filters = nn.Conv2d(
            1, BINS + 1, 2 * radius + 1, padding=radius, padding_mode="replicate", bias=False
        )
        v, u = np.mgrid[-radius : radius + 1, -radius : radius + 1]
        kernels = []
        for angle in np.arange(BINS) * np.pi / BINS:
            along = u * np.cos(angle) + v * np.sin(angle)
            across = -u * np.sin(angle) + v * np.cos(angle)
            plates = np.exp(-((np.abs(along) - 20) ** 2) / 8 - across**2 / 50)
            kernels.append(plates / plates.sum())  # far: high where the fingers go is free
        blur = np.exp(-(u**2 + v**2) / 2 / 8**2)
        kernels.append(blur / blur.sum())
        with torch.no_grad():
            self.filters.weight.copy_(torch.tensor(np.array(kernels))[:, None])

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.filters(x[:, 3:])


@contextmanager
def hand_made_backbone() -> Iterator[None]:
    """The registry of backbones with the hand-made one in it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(graspnet_backbones.BACKBONES, "hand_made", HandMade)
        yield


def hand_made(max_width: float = 0.08) -> GraspNet:
    """Depth falls by 0.6 units over a cube; half of that, blurred, is quality 0.5."""
    with hand_made_backbone():
        model = GraspNet(max_width=max_width, backbone="hand_made").eval()
    with torch.no_grad():
        for head in (model.quality_head, model.angle_head, model.width_head):
            head.weight.zero_()
            head.bias.zero_()
        model.quality_head.weight[0, BINS] = -12.0
        model.quality_head.bias[0] = -3.0
        model.angle_head.weight[range(BINS), range(BINS)] = 20.0
        model.width_head.weight[0, BINS] = -4.0
    return model


def cell_of_cubes(config, box_set) -> Cell:
    """A cell with the cubes on its table; the caller closes it."""
    placements = tuple(
        Placement(box_set[0], np.array([*xy, 0.03]), np.array([0, 0, np.sin(a / 2), np.cos(a / 2)]))
        for xy, a in CUBES.items()
    )
    cell = make_cell(config)
    cell.load(Scene("isolated", 0, placements))
    return cell
