"""A policy as it acts in PPO's rollouts and evaluations: one observation at a time.

An actor goes to the process in which its environment lives, so that environments do not wait for
each other between two steps. This module never sees an environment.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch
from torch import nn

from models.ppo_observations import Observations

ACTIVATIONS = {
    nn.Tanh: np.tanh,
    nn.ReLU: lambda x: np.maximum(x, 0),
    nn.ELU: lambda x: np.where(x > 0, x, np.expm1(np.minimum(x, 0))),
}


class Actor:
    """A copy of a GraspPolicyNetwork's policy, on the CPU.

    NumPy computes the layers after `features`: PyTorch takes several times as long for one row.
    The bits of a latent do not depend on how many environments there are, nor on the process.
    """

    def __init__(self, network: nn.Module):
        network = copy.deepcopy(network).cpu()
        self._features, self._squash = network.features, network.squash
        self._layers = [_plain(layer) for layer in network.actor[::2]]
        self._activation = type(network.actor[1])
        self._mean = _plain(network.mean_head)
        self._deviation = network.log_std.detach().exp().numpy()
        self._low, self._high = network.action_low.numpy(), network.action_high.numpy()

    def latent(self, seen: Observations, noise: np.ndarray | None = None) -> np.ndarray:
        """(A,) a latent for an observation (1, ...), see `models.grasp_policy.ActionDistribution`;
        noise: (A,) standard normal, None for the policy's mean."""
        with torch.inference_mode():
            x = self._features(seen.image(), seen.state)[0].numpy()
        activation = ACTIVATIONS[self._activation]
        for weight, bias in self._layers:
            x = activation(x @ weight + bias)
        mean = x @ self._mean[0] + self._mean[1]
        return mean if noise is None else mean + self._deviation * noise

    def action(self, latent: np.ndarray) -> np.ndarray:
        """(A,) the action of a latent, as `GraspPolicyNetwork.action` defines it."""
        if self._squash:
            latent = self._low + (self._high - self._low) / 2 * (np.tanh(latent) + 1)
        return np.minimum(np.maximum(latent, self._low), self._high)


def _plain(layer: nn.Linear) -> tuple[np.ndarray, np.ndarray]:
    """Weight (in, out) and bias (out,)."""
    return layer.weight.detach().numpy().T.copy(), layer.bias.detach().numpy()


@contextmanager
def one_thread() -> Iterator[None]:
    """Within this context PyTorch computes with one thread, as it does in a worker process, so that
    an actor computes the same bits here."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
