"""Candidate grasps in all views of a fan, as tensors: what `Candidates` is for one map with NumPy.

This module knows neither maps nor the search.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch


@dataclass
class FanCandidates:
    """N candidate grasps of several views: view (N,) int64; value (N,) the factor that a
    network gave them; the others as of `Candidates`."""

    view: torch.Tensor
    xy: torch.Tensor
    angle: torch.Tensor
    tip: torch.Tensor
    width: torch.Tensor
    opening: torch.Tensor
    turn: torch.Tensor
    label: torch.Tensor
    score: torch.Tensor
    facts: torch.Tensor
    value: torch.Tensor

    def __len__(self) -> int:
        return len(self.angle)

    @staticmethod
    def joined(parts: Sequence[FanCandidates]) -> FanCandidates:
        """All candidates of several lists."""
        return FanCandidates(
            *(
                torch.cat([getattr(part, field.name) for part in parts])
                for field in fields(FanCandidates)
            )
        )

    def take(self, index: torch.Tensor) -> FanCandidates:
        """Those with the numbers `index` (M,)."""
        return FanCandidates(*(getattr(self, field.name)[index] for field in fields(self)))

    def axes(self) -> tuple[torch.Tensor, torch.Tensor]:
        """(N, 2) unit vectors along the closing line and across it."""
        return closing_axes(self.angle)

    def best(self, count: int | None = None) -> FanCandidates:
        """The `count` best feasible candidates of each view, view by view, best first."""
        some = torch.nonzero(self.score > 0)[:, 0]
        some = some[(-self.score[some]).argsort(stable=True)]
        some = some[self.view[some].argsort(stable=True)]
        if count is not None:
            some = some[_place(self.view[some]) < count]
        return self.take(some)

    def distinct(self, count: int, distance: float, angle: float) -> FanCandidates:
        """Non-maximum suppression in each view of candidates that lie as `best` leaves them."""
        if len(self) == 0:
            return self
        view, place = self.view, _place(self.view)
        shape = int(view.max()) + 1, int(place.max()) + 1
        number = torch.full(shape, -1, device=view.device)
        number[view, place] = torch.arange(len(self), device=view.device)
        xy, turned = self.xy[number], self.angle[number]
        apart = (xy[:, :, None] - xy[:, None]).norm(dim=3) >= distance
        between = (turned[:, :, None] - turned[:, None]).abs() % np.pi
        apart |= torch.minimum(between, np.pi - between) >= angle
        free, kept = number >= 0, torch.zeros_like(number, dtype=torch.bool)
        every = torch.arange(len(free), device=view.device)
        for _ in range(count):
            first, some = free.int().argmax(dim=1), free.any(dim=1)
            kept[every, first] |= some
            free &= apart[every, first]
            free[every, first] = False
        return self.take(number[kept])


def closing_axes(angle: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """(..., 2) unit vectors along closing lines at angles (...) and across them."""
    cosine, sine = angle.cos(), angle.sin()
    return torch.stack([cosine, sine], dim=-1), torch.stack([-sine, cosine], dim=-1)


def _place(view: torch.Tensor) -> torch.Tensor:
    """(N,) the number of each candidate in its view; they lie view by view."""
    number = torch.arange(len(view), device=view.device)
    if len(view) == 0:
        return number
    first = torch.cat([view.new_ones(1, dtype=torch.bool), view[1:] != view[:-1]])
    return number - torch.where(first, number, 0).cummax(dim=0).values
