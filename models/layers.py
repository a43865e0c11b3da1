"""Layers of the policy's networks, with the weights that they start from."""

from __future__ import annotations

import math
from collections.abc import Sequence

from torch import nn

POOLED = 7  # rows and columns that an encoder's last convolution is pooled to


def encoder(channels: int, conv_channels: Sequence[int], features: int) -> nn.Sequential:
    """(B, channels, H, W) to (B, features), for images of any size."""
    parts: list[nn.Module] = []
    for before, after in zip([channels, *conv_channels], conv_channels):
        parts += [initialised(nn.Conv2d(before, after, 3, stride=2), math.sqrt(2)), nn.ReLU()]
    parts += [nn.AdaptiveAvgPool2d(POOLED), nn.Flatten()]
    return nn.Sequential(*parts, *layers([conv_channels[-1] * POOLED**2, features], nn.ReLU))


def layers(widths: Sequence[int], activation: type[nn.Module]) -> nn.Sequential:
    """Fully connected layers, each with its activation."""
    parts: list[nn.Module] = []
    for before, after in zip(widths, widths[1:]):
        parts += [initialised(nn.Linear(before, after), math.sqrt(2)), activation()]
    return nn.Sequential(*parts)


def initialised(layer: nn.Linear | nn.Conv2d, gain: float) -> nn.Linear | nn.Conv2d:
    nn.init.orthogonal_(layer.weight, gain)
    nn.init.zeros_(layer.bias)
    return layer
