"""What the processes of a team tell each other about numbers; each alone is a team of one.

Results are the same bit for bit in all processes, so that they go on taking the same steps.
"""

from __future__ import annotations

import torch
import torch.distributed as dist
from torch import nn

from models.graspnet_training import Team

ALONE = Team(0, 1, torch.device("cpu"))


def gather(team: Team, tensor: torch.Tensor) -> torch.Tensor:
    """(ranks, ...) the same-shaped tensor of every process."""
    if team.ranks == 1:
        return tensor[None]
    parts = [torch.empty_like(tensor) for _ in range(team.ranks)]
    dist.all_gather(parts, tensor.contiguous())
    return torch.stack(parts)


def average(team: Team, tensor: torch.Tensor) -> None:
    """Replace a tensor by its mean over the processes."""
    if team.ranks > 1:
        dist.all_reduce(tensor)
        tensor /= team.ranks


def share_weights(team: Team, module: nn.Module) -> None:
    """Give every process the first one's weights and statistics."""
    if team.ranks > 1:
        for value in module.state_dict().values():
            dist.broadcast(value, src=0)
