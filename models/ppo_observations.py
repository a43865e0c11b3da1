"""Observations as networks see them: their layout, and running statistics that normalise them.

Observations arrive as batched NumPy arrays, one array or a dict, and keep their types (images stay
bytes) until a network needs them. The statistics of `ObservationNormaliser` and `RewardScaler` are
buffers of modules, so that they are saved with the weights; they change between rollouts only, so
that within a rollout and its update a number always has the same meaning. This module knows
Gymnasium's spaces, no environment.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium import spaces
from torch import nn

from utils.distributed import ALONE, Team
from utils.errors import UserError, unknown_choice

ALL = "observation"  # the name of an observation that is no dict


class Observations(NamedTuple):
    """A batch. images: each (B, H, W, C), uint8 or float32. state: (B, S) float32, all else that
    the policy sees. privileged: (B, P) float32, what only the critic sees."""

    images: tuple[torch.Tensor, ...]
    state: torch.Tensor
    privileged: torch.Tensor

    def image(self) -> torch.Tensor | None:
        """(B, C, H, W) float32, the channels of all images in order, bytes as 0..1; None without
        images."""
        if not self.images:
            return None
        sizes = [image.shape[-1] for image in self.images]
        whole = self.state.new_empty(*self.images[0].shape[:-1], sum(sizes))
        for image, channels in zip(self.images, whole.split(sizes, -1)):
            channels.copy_(image)  # without a copy in between: images need much memory
            if image.dtype == torch.uint8:
                channels.div_(255)
        return whole.movedim(-1, 1)

    def map(self, change) -> Observations:
        """change(tensor) of every part."""
        return Observations(
            tuple(map(change, self.images)), change(self.state), change(self.privileged)
        )

    def rows(self, index: torch.Tensor | slice | int) -> Observations:
        return self.map(lambda part: part[index])

    def copy_(self, other: Observations) -> None:
        """Take over the numbers of a batch of the same shape."""
        for room, part in zip((*self.images, *self[1:]), (*other.images, *other[1:])):
            room.copy_(part)


class Part(NamedTuple):
    """An entry of the observation: its key, the shape of one, and its NumPy dtype's name."""

    key: str
    shape: tuple[int, ...]
    dtype: str


@dataclass(frozen=True)
class ObservationLayout:
    """The entries that are images, those of the state, and those that only the critic sees."""

    images: tuple[Part, ...]
    state: tuple[Part, ...]
    privileged: tuple[Part, ...]

    @classmethod
    def of(
        cls,
        space: spaces.Space,
        policy_keys: Sequence[str] | None = None,
        privileged_keys: Sequence[str] | None = None,
    ) -> ObservationLayout:
        """For an observation space: a Box, or a Dict of Boxes.

        policy_keys: what the policy sees; None: all that is not privileged. A Box of shape (H, W,
        C) is an image, any other is flattened. Raises UserError for other spaces, unknown keys,
        images of different sizes, or a policy that would see nothing.
        """
        boxes = space.spaces if isinstance(space, spaces.Dict) else {ALL: space}
        for key, box in boxes.items():
            if not isinstance(box, spaces.Box):
                raise UserError(f"observation {key!r} is {box}; expected a Box, or a Dict of Boxes")
        privileged_keys = privileged_keys or ()
        if policy_keys is None:
            policy_keys = [key for key in boxes if key not in privileged_keys]
        for name, keys in (("policy", policy_keys), ("privileged", privileged_keys)):
            for key in keys:
                if key not in boxes:
                    raise unknown_choice(f"rl.{name}_observations", key, boxes)
                if name == "privileged" and key in policy_keys:
                    raise UserError(f"rl.privileged_observations: the policy sees {key!r} already")
        policy = [Part(key, boxes[key].shape, str(boxes[key].dtype)) for key in policy_keys]
        layout = cls(
            images=tuple(part for part in policy if len(part.shape) == 3),
            state=tuple(part for part in policy if len(part.shape) != 3),
            privileged=tuple(
                Part(key, boxes[key].shape, str(boxes[key].dtype)) for key in privileged_keys
            ),
        )
        if len({part.shape[:2] for part in layout.images}) > 1:
            sizes = ", ".join(f"{part.key} {part.shape}" for part in layout.images)
            raise UserError(f"images of one policy must have the same height and width: {sizes}")
        if not policy:
            raise UserError("rl.policy_observations: the policy would see nothing")
        return layout

    @property
    def image_channels(self) -> int:
        return sum(part.shape[2] for part in self.images)

    @property
    def state_dim(self) -> int:
        return sum(int(np.prod(part.shape)) for part in self.state)

    @property
    def privileged_dim(self) -> int:
        return sum(int(np.prod(part.shape)) for part in self.privileged)

    def parts(self) -> Iterator[Part]:
        yield from (*self.images, *self.state, *self.privileged)

    def entries(self) -> list[list[tuple[str, tuple[int, ...]]]]:
        """Key and shape of each image, of each part of the state, and of what is privileged."""
        kinds = self.images, self.state, self.privileged
        return [[(part.key, part.shape) for part in kind] for kind in kinds]

    def empty(self, *shape: int) -> Observations:
        """Room for a batch of this shape, to be filled by `write`."""
        return Observations(
            tuple(
                torch.empty(*shape, *part.shape, dtype=_image_dtype(part)) for part in self.images
            ),
            torch.empty(*shape, self.state_dim),
            torch.empty(*shape, self.privileged_dim),
        )

    def write(self, observation: Any, room: Observations) -> None:
        """Copy a batch of observations (B, ...), or a single one, into room (B, ...) for it."""
        for part, image in zip(self.images, room.images):
            image.numpy()[...] = _entry(observation, part.key)
        for parts, vector in ((self.state, room.state), (self.privileged, room.privileged)):
            at, target = 0, vector.numpy()
            for part in parts:
                values = np.reshape(_entry(observation, part.key), (len(target), -1))
                target[:, at : at + values.shape[1]] = values
                at += values.shape[1]

    def read_one(self, observation: Any) -> Observations:
        """A batch of one, of what the policy sees, checked against the layout.

        observation: of a single environment. Raises UserError for a missing key or another shape.
        """
        batch = {}
        for part in (*self.images, *self.state):
            if isinstance(observation, dict) and part.key not in observation:
                raise UserError(
                    f"the policy needs {part.key!r}, but the observation holds "
                    f"{', '.join(observation)}"
                )
            value = np.asarray(_entry(observation, part.key))
            if value.shape != tuple(part.shape):
                raise UserError(
                    f"observation {part.key!r} has shape {value.shape}, the policy needs "
                    f"{tuple(part.shape)}"
                )
            batch[part.key] = value[None]
        seen = ObservationLayout(self.images, self.state, ())
        room = seen.empty(1)
        seen.write(batch, room)
        return room

    def bad_number(self, observation: Any) -> str | None:
        """Key of an entry that is not finite, or None."""
        for part in self.parts():
            values = np.asarray(_entry(observation, part.key))
            if values.dtype.kind == "f" and not np.isfinite(values).all():
                return part.key
        return None

    def to_plain(self) -> dict[str, Any]:
        """Plain data for a checkpoint, which `from_plain` reads."""
        return {
            name: [[part.key, list(part.shape), part.dtype] for part in getattr(self, name)]
            for name in ("images", "state", "privileged")
        }

    @classmethod
    def from_plain(cls, plain: dict[str, Any]) -> ObservationLayout:
        """The layout that `to_plain` stored."""
        return cls(
            **{
                name: tuple(Part(key, tuple(shape), dtype) for key, shape, dtype in parts)
                for name, parts in plain.items()
            }
        )


def _entry(observation: Any, key: str) -> np.ndarray:
    return observation[key] if isinstance(observation, dict) else observation


def _image_dtype(part: Part) -> torch.dtype:
    return torch.uint8 if part.dtype == "uint8" else torch.float32


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
        for count, mean, variance in team.gather(torch.cat([size, own])):
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

    def continue_from(self, state: dict[str, torch.Tensor], most: int) -> None:
        """Take over the deviation of another training, in whose unit its critic states values; it
        counts as of `most` steps at most, so that it follows rewards of another kind. Raises
        ValueError where it is not finite."""
        self.load_state_dict(state)
        if not all(bool(part.isfinite().all()) for part in self.state_dict().values()):
            raise ValueError("the deviation of its rewards is not finite")
        self.moments.count.clamp_(max=most)

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
