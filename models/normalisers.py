"""Running statistics that bring observations and rewards to a scale that networks like.

They are modules whose buffers travel with the weights, so no checkpoint can lose them. Statistics
change between rollouts only: within one, and in the update from it, a number always means the same.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import nn

from models.graspnet_training import Team
from models.ranks import ALONE, gather

LARGEST = 10.0  # normalised numbers are clipped to it, on either side
SMALLEST_VARIANCE = 1e-8


class RunningMoments(nn.Module):
    """Count, mean and variance (of the population) of all samples seen, for `size` features.

    Batches are merged as in Chan, Golub and LeVeque, "Updating formulae and a pairwise algorithm
    for computing sample variances" (1979), in float64.
    """

    def __init__(self, size: int):
        super().__init__()
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("variance", torch.ones(size, dtype=torch.float64))

    def update(self, samples: torch.Tensor, team: Team = ALONE) -> None:
        """Take in samples (B, size) of this process and those of the others."""
        samples = samples.to(torch.float64)
        own = torch.stack([samples.mean(0), samples.var(0, correction=0)])
        size = torch.full_like(own[:1], len(samples))
        for count, mean, variance in gather(team, torch.cat([size, own])):
            self._merge(count[0], mean, variance)

    def _merge(self, count: torch.Tensor, mean: torch.Tensor, variance: torch.Tensor) -> None:
        total = self.count + count
        gap = mean - self.mean
        sum_of_squares = (
            self.variance * self.count + variance * count + gap**2 * self.count * count / total
        )
        self.mean += gap * count / total
        self.variance.copy_(sum_of_squares / total)
        self.count.copy_(total)


class ObservationNormaliser(RunningMoments):
    """Features (..., size) to zero mean and unit variance, clipped; unchanged until `update`."""

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        scale = (self.variance + SMALLEST_VARIANCE).rsqrt()
        centred = features - self.mean.to(features.dtype)
        return centred.mul_(scale.to(features.dtype)).clamp_(-LARGEST, LARGEST)


class RewardScaler(nn.Module):
    """Divides rewards by the deviation of the discounted return so far.

    The return is the sum of the episode's past rewards, each discounted by its age; that makes the
    scale of value targets about 1 whatever the unit of the reward (Engstrom et al., "Implementation
    matters in deep policy gradients", ICLR 2020, section 3). Rewards are never centred: that would
    change what is optimal where episodes differ in length.
    """

    def __init__(self, gamma: float):
        super().__init__()
        self.gamma = gamma
        self.moments = RunningMoments(1)
        self._returns: np.ndarray | None = None

    def restart(self) -> None:
        """All environments begin new episodes."""
        self._returns = None

    def scale(self, rewards: np.ndarray, ended: np.ndarray, team: Team = ALONE) -> np.ndarray:
        """Take in the rewards (T, N) of a rollout and return them scaled and clipped.

        ended: (T, N), where an episode ended with that step.
        """
        returns = np.empty(rewards.shape)
        running = np.zeros(rewards.shape[1]) if self._returns is None else self._returns
        for t in range(len(rewards)):
            running = self.gamma * running + rewards[t]
            returns[t] = running
            running = np.where(ended[t], 0.0, running)
        self._returns = running
        device = self.moments.variance.device
        self.moments.update(torch.from_numpy(returns.reshape(-1, 1)).to(device), team)
        deviation = float(self.moments.variance[0] + SMALLEST_VARIANCE) ** 0.5
        return np.clip(rewards / deviation, -LARGEST, LARGEST)
