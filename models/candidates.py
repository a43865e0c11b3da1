"""Many grasps in the making, held column by column so that they are judged all at once.

This module knows neither how grasps are found nor what makes one good.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from utils.geometry import GripperGeometry
from utils.transforms import Grasp, angle_difference


@dataclass
class Candidates:
    """N grasps in the making.

    xy: (N, 2) fingertips' centre in W. angle: (N,). tip: (N,) height of the fingertips' lowest
    point in W. width: (N,) of what is between the fingers. opening: (N,) before closing.
    turn: (N,) rotation that would bring the pads flat onto the faces. label: (N,) the object in
    the height map. score: (N,), 0 = not feasible.
    """

    xy: np.ndarray
    angle: np.ndarray
    tip: np.ndarray
    width: np.ndarray
    opening: np.ndarray
    turn: np.ndarray
    label: np.ndarray
    score: np.ndarray

    @staticmethod
    def rough(xy, angle, tip, width, score) -> Candidates:
        """Candidates of the dense stage, not measured yet."""
        return Candidates(
            xy, angle, tip, width, width, np.zeros(len(tip)), np.full(len(tip), -1), score
        )

    def __len__(self) -> int:
        return len(self.angle)

    def take(self, index) -> Candidates:
        return Candidates(*(getattr(self, field.name)[index] for field in fields(self)))

    def best(self, count: int) -> Candidates:
        """The `count` best feasible ones, best first."""
        order = np.argsort(-self.score, kind="stable")[:count]
        return self.take(order[self.score[order] > 0])

    def replaced(self, index: np.ndarray, others: Candidates) -> Candidates:
        """All of them, but `others` in the places `index`."""
        result = self.take(np.arange(len(self)))
        for field in fields(self):
            getattr(result, field.name)[index] = getattr(others, field.name)
        return result

    def axes(self) -> tuple[np.ndarray, np.ndarray]:
        """(N, 2) unit vectors along the closing line and across it."""
        along = np.stack([np.cos(self.angle), np.sin(self.angle)], axis=-1)
        return along, np.stack([-along[:, 1], along[:, 0]], axis=-1)

    def distinct(self, count: int, distance: float, angle: float) -> Candidates:
        """Non-maximum suppression: at most `count`, no two closer than both distance and angle."""
        apart = np.linalg.norm(self.xy[:, None] - self.xy, axis=2) >= distance
        apart |= angle_difference(self.angle[:, None], self.angle) >= angle
        kept, free = [], np.ones(len(self), bool)
        while free.any() and len(kept) < count:
            kept.append(int(free.argmax()))
            free &= apart[kept[-1]]
            free[kept[-1]] = False
        return self.take(kept)

    def grasps(self, gripper: GripperGeometry) -> list[Grasp]:
        height = self.tip + gripper.tip_below_centre
        return [
            Grasp(np.array([x, y, z]), angle, opening, score)
            for (x, y), z, angle, opening, score in zip(
                self.xy, height, self.angle, self.opening.tolist(), self.score.tolist()
            )
        ]
