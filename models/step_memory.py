"""StepMemory: the latest steps that were observed, to learn to see from more than once."""

from __future__ import annotations

import torch

from models.observations import Observations


class StepMemory:
    """Holds the last `size` steps; the oldest make room for new ones."""

    def __init__(self, size: int):
        self.size = size
        self.clear()

    def __len__(self) -> int:
        return self._held

    def clear(self) -> None:
        self._room: Observations | None = None
        self._held = self._next = 0

    def add(self, steps: Observations) -> None:
        """Remember steps (B, ...); of more than `size` the last ones."""
        count = min(len(steps.state), self.size)
        if count == 0:
            return
        steps = steps.rows(slice(len(steps.state) - count, None))
        if self._room is None:
            self._room = steps.map(lambda part: part.new_empty(self.size, *part.shape[1:]))
        places = (torch.arange(count, device=steps.state.device) + self._next) % self.size
        for rooms, parts in ((self._room.images, steps.images), (self._room[1:], steps[1:])):
            for room, part in zip(rooms, parts):
                room[places] = part
        self._next = (self._next + count) % self.size
        self._held = min(self._held + count, self.size)

    def draw(self, count: int, generator: torch.Generator) -> Observations:
        """Steps (count, ...) drawn with repetition from those held, of which there must be some."""
        index = torch.randint(self._held, (count,), generator=generator)
        return self._room.map(lambda part: part[index.to(part.device)])
