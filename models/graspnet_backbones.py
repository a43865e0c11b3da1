"""Backbones of GraspNet: from an image to a feature map of the same resolution.

A backbone is a module with `stride` (image sides must be multiples of it), `out_channels` and
`forward(x)` from (B, C, H, W) to (B, out_channels, H, W); it is made with the number of input
channels and knows nothing of grasps. A new one is a class in this file and an entry in `BACKBONES`,
whose names `train.backbone` accepts. All code is our own; the layer sizes of the last two backbones
come from the papers named in their docstrings.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import nn


def convolution(inputs: int, outputs: int, kernel: int, stride: int = 1) -> list[nn.Module]:
    """Convolution, batch normalisation, ReLU; with stride 2, an even kernel halves the image."""
    padding = (kernel - 1) // 2
    return [
        nn.Conv2d(inputs, outputs, kernel, stride, padding),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
    ]


def doubling(inputs: int, outputs: int) -> nn.Sequential:
    """Transposed convolution that doubles the image, batch normalisation, ReLU."""
    return nn.Sequential(
        nn.ConvTranspose2d(inputs, outputs, kernel_size=4, stride=2, padding=1),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
    )


class TutorialBackbone(nn.Module):
    """The tutorial's encoder of four blocks and its decoder (chapter 3.1).

    skips: add each encoder block's output to the decoder's feature map of the same size, as in
        LinkNet (Chaurasia and Culurciello 2017, arXiv 1707.03718); costs no parameter.
    """

    stride = 16
    out_channels = 32

    def __init__(self, input_channels: int, skips: bool = False):
        super().__init__()
        self.skips = skips
        channels = (input_channels, 32, 64, 128, 256)
        self.encoder = nn.ModuleList(
            nn.Sequential(
                *convolution(inputs, outputs, 3, stride=2),
                *(layer for _ in range(3) for layer in convolution(outputs, outputs, 3)),
            )
            for inputs, outputs in zip(channels, channels[1:])
        )
        self.decoder = nn.ModuleList(
            doubling(inputs, outputs)
            for inputs, outputs in ((256, 128), (128, 64), (64, 32), (32, 32))
        )

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        levels = []
        for block in self.encoder:
            x = block(x)
            levels.append(x)
        skipped = [*levels[-2::-1], None]  # 1/8, 1/4, 1/2 of the image; none at full size
        for block, level in zip(self.decoder, skipped):
            x = block(x)
            if self.skips and level is not None:
                x = x + level
        return x


class GGCNNBackbone(nn.Module):
    """Layers of GG-CNN (Morrison, Corke and Leitner 2018, arXiv 1804.05172): small and fast.

    Filters 32, 16, 8, 8, 16, 32 of 9, 5, 3, 3, 5, 9 pixels, strides 3, 2, 2 down and up again,
    without normalisation.
    """

    stride = 12
    out_channels = 32

    def __init__(self, input_channels: int):
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv2d(input_channels, 32, 9, stride=3, padding=3),
            nn.ReLU(inplace=True),
            nn.Conv2d(32, 16, 5, stride=2, padding=2),
            nn.ReLU(inplace=True),
            nn.Conv2d(16, 8, 3, stride=2, padding=1),
            nn.ReLU(inplace=True),
            nn.ConvTranspose2d(8, 8, 3, stride=2, padding=1, output_padding=1),
            nn.ReLU(inplace=True),
            nn.ConvTranspose2d(8, 16, 5, stride=2, padding=2, output_padding=1),
            nn.ReLU(inplace=True),
            nn.ConvTranspose2d(16, 32, 9, stride=3, padding=3),
            nn.ReLU(inplace=True),
        )

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.layers(x)


class ResidualBlock(nn.Module):
    """Two 3x3 convolutions around an identity (He et al. 2016); no ReLU after the sum."""

    def __init__(self, channels: int):
        super().__init__()
        self.layers = nn.Sequential(
            *convolution(channels, channels, 3),
            nn.Conv2d(channels, channels, 3, padding=1),
            nn.BatchNorm2d(channels),
        )

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x + self.layers(x)


class GRConvNetBackbone(nn.Module):
    """Layers of GR-ConvNet (Kumra, Joshi and Sahin 2020, arXiv 1909.04810): accurate and larger.

    Three convolutions down to a quarter of the image, five residual blocks of 128 channels, three
    transposed convolutions up again.
    """

    stride = 4
    out_channels = 32

    def __init__(self, input_channels: int):
        super().__init__()
        self.layers = nn.Sequential(
            *convolution(input_channels, 32, 9),
            *convolution(32, 64, 4, stride=2),
            *convolution(64, 128, 4, stride=2),
            *(ResidualBlock(128) for _ in range(5)),
            doubling(128, 64),
            doubling(64, 32),
            nn.ConvTranspose2d(32, 32, 9, padding=4),
        )

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.layers(x)


BACKBONES: dict[str, Callable[[int], nn.Module]] = {
    "tutorial": TutorialBackbone,
    "tutorial_skip": partial(TutorialBackbone, skips=True),
    "ggcnn": GGCNNBackbone,
    "grconvnet": GRConvNetBackbone,
}
