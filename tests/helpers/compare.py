"""Comparison of checkpoints and other nested containers."""

from __future__ import annotations

import torch


def same(a, b) -> bool:
    """Whether two nested containers of tensors and plain values are equal bit for bit."""
    if isinstance(a, torch.Tensor):
        return a.dtype == b.dtype and torch.equal(a, b)
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(map(same, a, b))
    return a == b


def halved(weights: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """A network's weights as a file in half precision gives them back."""
    return {name: w.half().float() if w.dim() > 1 else w for name, w in weights.items()}
