"""Where scenes are laid out before any cell is built: an empty table in a PyBullet client.

Scenes are laid out here for every simulator, so that all of them start from the same poses.
`envs.cell_scenes` decides what is put where.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable, Sequence

import numpy as np
import pybullet

from envs.cell_layout import Box
from envs.objects import ObjectModel
from envs.pybullet_bodies import add_table, add_walls, set_up_physics, settle, spawn
from utils.config import Config

# A client takes 25 ms to connect, an isolated scene 5 ms to lay out: each thread keeps one client.
_CLIENTS = threading.local()


class LayoutTable:
    """A table alone, on which objects are put down and come to rest.

    A thread has one such table at a time: a new one takes everything off it.
    """

    def __init__(self, config: Config):
        if not hasattr(_CLIENTS, "number"):
            _CLIENTS.number = pybullet.connect(pybullet.DIRECT)
        self._client, self._config = _CLIENTS.number, config
        set_up_physics(self._client, self._config.sim)
        add_table(self._client)

    def put(self, model: ObjectModel, position: np.ndarray, quaternion: np.ndarray) -> int:
        """Add an object with its centre of mass at position (3,); its body number."""
        return spawn(self._client, model, position, quaternion)

    def put_walls(self, walls: Iterable[Box]) -> list[int]:
        """Add immovable walls; their body numbers."""
        return add_walls(self._client, walls)

    def remove(self, body: int) -> None:
        pybullet.removeBody(body, physicsClientId=self._client)

    def settle(self, bodies: Sequence[int]) -> bool:
        """Simulate until the bodies rest; False if they still move after scene.settle_seconds."""
        return settle(self._client, bodies, self._config)

    def pose(self, body: int) -> tuple[np.ndarray, np.ndarray]:
        """Position (3,) of a body's centre of mass in W and its quaternion (4,)."""
        position, quaternion = pybullet.getBasePositionAndOrientation(
            body, physicsClientId=self._client
        )
        return np.array(position), np.array(quaternion)

    def is_near(self, body: int, others: Sequence[int], distance: float) -> bool:
        """Whether a body comes closer than `distance` metres to one of the others."""
        return any(
            pybullet.getClosestPoints(body, other, distance, physicsClientId=self._client)
            for other in others
        )
