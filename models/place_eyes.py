"""PlaceEyes: estimates of numbers that belong to one place that the hand's camera sees.

Where several places are as good, such as all around a ring, the mean of them is none. So the eyes
do not regress: every cell of a grid over the image says how likely the place is there, and what the
numbers would be if it were; the likeliest cell is taken at its word. (As anchor-free detectors find
objects: Zhou et al., "Objects as points", 2019.)
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import nn

from models.layers import initialised

CELL = 4  # pixels, side of a cell
DILATIONS = (1, 2, 4, 1)  # of the convolutions that let cells see what is around them
NEAR = 0.03  # m, at which places are told a second time, finely
PLACE_WEIGHT = 0.2  # of the cross entropy in nats beside the estimates' loss
BETA = 0.1  # of a normalised error, from which on the estimates' loss is linear


class PlaceEyes(nn.Module):
    """Image and state in, an estimate (E,) out.

    seen_channels: of the image and of what else is made of it. state_dim: of the state.
    estimated_dim: E; the first two of the numbers are the place, x and y along the hand's axes.
    camera: {"K": (3, 3) pixels, "T_EC": (4, 4)} as lists, of the camera that the hand carries.
    """

    def __init__(
        self, seen_channels: int, state_dim: int, estimated_dim: int, camera: dict,
        channels: Sequence[int] = (24, 48), hidden: int = 64,
    ):  # fmt: skip
        super().__init__()
        K, T_EC = torch.tensor(camera["K"]), torch.tensor(camera["T_EC"])
        self.register_buffer("K_inverse", torch.linalg.inv(K.double()).float(), persistent=False)
        self.register_buffer("T_EC", T_EC.float(), persistent=False)
        first, width = channels
        self.stem = nn.Sequential(
            _conv(seen_channels + 2, first, stride=2), nn.ReLU(),
            _conv(first, width, stride=2), nn.ReLU(),
        )  # fmt: skip
        self.state = initialised(nn.Linear(state_dim, width), 1.0)
        self.around = nn.ModuleList(_conv(width, width, dilation=d) for d in DILATIONS)
        self.hidden = initialised(nn.Conv2d(width + 4, hidden, 1), 2**0.5)
        self.likelihood = initialised(nn.Conv2d(hidden, 1, 1), 0.1)
        self.numbers = initialised(nn.Conv2d(hidden + 4, estimated_dim, 1), 0.5)

    def forward(self, seen: torch.Tensor, depth: torch.Tensor, state: torch.Tensor) -> torch.Tensor:
        """(B, E) estimates, of normalised numbers.

        seen: (B, C, H, W) normalised. depth: (B, H, W) metres. state: (B, S) normalised.
        """
        likelihood, numbers, _ = self._cells(seen, depth, state)
        return _at(numbers, likelihood.argmax(1))

    def loss(
        self,
        seen: torch.Tensor, depth: torch.Tensor, state: torch.Tensor,
        place: torch.Tensor, truth: torch.Tensor,
    ) -> torch.Tensor:  # fmt: skip
        """Scalar. place: (B, 2) m, where it is; truth: (B, E), the normalised numbers."""
        likelihood, numbers, places = self._cells(seen, depth, state)
        cell = (places - place[..., None]).square().sum(1).argmin(1)
        found = F.smooth_l1_loss(_at(numbers, cell), truth, beta=BETA)
        return found + PLACE_WEIGHT * F.cross_entropy(likelihood, cell)

    def places(self, depth: torch.Tensor) -> torch.Tensor:
        """(B, 2, H, W) where on the hand's x and y axes, in metres, pixels of depths (B, H, W)
        lie. Integer pixel coordinates are the pixels' middles."""
        rows, columns = (torch.arange(n, device=depth.device) for n in depth.shape[-2:])
        v, u = torch.meshgrid(rows, columns, indexing="ij")
        pixels = torch.stack([u, v, torch.ones_like(u)]).to(depth.dtype)
        rays = torch.einsum("ij,jhw->ihw", self.T_EC[:2, :3] @ self.K_inverse, pixels)
        return rays * depth[:, None] + self.T_EC[:2, 3, None, None]

    def _cells(
        self, seen: torch.Tensor, depth: torch.Tensor, state: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Of N cells: (B, N) logits of the place being there, (B, E, N) the numbers if it is, and
        (B, 2, N) where they are, m."""
        places = self.places(depth)
        features = self.stem(torch.cat([seen, places / NEAR / 10], 1))
        features = features + self.state(state)[..., None, None]
        for conv in self.around:
            features = features + F.relu(conv(features))
        cells = F.avg_pool2d(places, CELL)
        told = torch.cat([cells / NEAR / 10, torch.tanh(cells / NEAR)], 1)
        hidden = F.relu(self.hidden(torch.cat([features, told], 1)))
        numbers = self.numbers(torch.cat([hidden, told], 1))
        return self.likelihood(hidden).flatten(1), numbers.flatten(2), cells.flatten(2)


def _conv(before: int, after: int, stride: int = 1, dilation: int = 1) -> nn.Conv2d:
    return initialised(
        nn.Conv2d(before, after, 3, stride=stride, padding=dilation, dilation=dilation), 2**0.5
    )


def _at(numbers: torch.Tensor, cell: torch.Tensor) -> torch.Tensor:
    """(B, E) the numbers (B, E, N) of cells (B,)."""
    return numbers.gather(2, cell[:, None, None].expand(-1, numbers.shape[1], 1)).squeeze(2)
