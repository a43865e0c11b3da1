"""Scenes laid out in MuJoCo: an empty table on which objects come to rest.

`envs.cell_scenes` decides what is put where. This module knows no cell, robot or camera.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from typing_extensions import Self

from envs.cell_layout import (
    REST_CHECK_STEPS,
    REST_SPEED,
    TABLE_COLOUR,
    WALL_COLOUR,
    Box,
    LayoutTable,
    ObjectModel,
    table_box,
)
from envs.mujoco_cell import SUBSTEPS, add_box, add_object, set_up_physics
from envs.mujoco_panda import load_mujoco
from utils.config import Config

_PARKED = (0.0, 0.0, -10.0)  # m in W, where an object is that is not on the table


class MujocoTable(LayoutTable):
    """A `LayoutTable` in MuJoCo. Raises UserError where MuJoCo is not installed.

    MuJoCo compiles a model as a whole, which takes tens of milliseconds. So the model holds all
    objects from the start; those that are not on the table are parked: nothing pulls or touches
    them. A body's number is that of its object, or after these that of a wall.
    """

    def __init__(self, config: Config, models: Sequence[ObjectModel]):
        self._config, self._models = config, list(models)
        self._mujoco = load_mujoco()

    def __enter__(self) -> Self:
        self._spec = set_up_physics(self._mujoco.MjSpec())
        self._spec.option.timestep = 1.0 / self._config.sim.frequency / SUBSTEPS
        add_box(self._spec, "table", table_box(), TABLE_COLOUR)
        for number, model in enumerate(self._models):
            body = add_object(self._spec, _name(number), model, _PARKED, (0.0, 0.0, 0.0, 1.0))
            body.gravcomp = 1.0  # else the compiled model would never compensate gravity
        self._model = self._spec.compile()
        self._data = self._mujoco.MjData(self._model)
        self._walls = 0
        self._free = list(range(len(self._models)))  # numbers of the objects that are parked
        for number in self._free:
            self._collide(number, False)
        return self

    def __exit__(self, *exception: object) -> None:
        del self._model, self._data, self._spec

    def put(self, model: ObjectModel, position: np.ndarray, quaternion: np.ndarray) -> int:
        number = next(number for number in self._free if self._models[number] is model)
        self._free.remove(number)
        self._place(number, position, quaternion)
        self._collide(number, True)
        return number

    def put_walls(self, walls: Iterable[Box]) -> list[int]:
        first = len(self._models) + self._walls
        for number, wall in enumerate(walls, first):
            add_box(self._spec, _name(number), wall, WALL_COLOUR)
            self._walls += 1
        self._model, self._data = self._spec.recompile(self._model, self._data)
        for number in range(len(self._models)):  # a compiled model is as the specification says
            self._collide(number, number not in self._free)
        return list(range(first, len(self._models) + self._walls))

    def remove(self, body: int) -> None:
        self._collide(body, False)
        if body < len(self._models):
            self._place(body, _PARKED, (0.0, 0.0, 0.0, 1.0))
            self._free.append(body)

    def settle(self, bodies: Sequence[int]) -> bool:
        checks = int(
            self._config.scene.settle_seconds * self._config.sim.frequency / REST_CHECK_STEPS
        )
        for _ in range(checks):
            self._mujoco.mj_step(self._model, self._data, REST_CHECK_STEPS * SUBSTEPS)
            if all(map(self._resting, bodies)):
                return True
        return False

    def _resting(self, body: int) -> bool:
        start = self._joint(body).dofadr[0]
        linear, angular = np.abs(self._data.qvel[start : start + 6]).reshape(2, 3).max(axis=1)
        return bool(linear < REST_SPEED and angular < 10 * REST_SPEED)

    def pose(self, body: int) -> tuple[np.ndarray, np.ndarray]:
        start = self._joint(body).qposadr[0]
        w, x, y, z = self._data.qpos[start + 3 : start + 7]
        return self._data.qpos[start : start + 3].copy(), np.array([x, y, z, w])

    def is_near(self, body: int, others: Sequence[int], distance: float) -> bool:
        mujoco = self._mujoco
        mujoco.mj_kinematics(self._model, self._data)  # a step leaves poses one step behind
        return any(
            mujoco.mj_geomDistance(self._model, self._data, one, two, distance, None) < distance
            for other in others
            for one in self._shapes(body)
            for two in self._shapes(other)
        )

    def _place(self, number: int, position, quaternion) -> None:
        """Put an object down, at rest."""
        place, speed = self._joint(number).qposadr[0], self._joint(number).dofadr[0]
        self._data.qpos[place : place + 7] = [*position, *np.roll(quaternion, 1)]
        self._data.qvel[speed : speed + 6] = 0.0

    def _collide(self, number: int, whether: bool) -> None:
        """Let everything, or nothing, touch a body, and gravity pull it."""
        shapes = self._shapes(number)
        self._model.geom_contype[shapes] = self._model.geom_conaffinity[shapes] = whether
        self._model.body_gravcomp[self._model.body(_name(number)).id] = not whether

    def _joint(self, number: int):
        return self._model.joint(_name(number))

    def _shapes(self, number: int) -> list[int]:
        """MuJoCo's numbers of a body's shapes."""
        found = self._model.body(_name(number))
        first = int(found.geomadr[0])
        return list(range(first, first + int(found.geomnum[0])))


def _name(number: int) -> str:
    return f"body{number}"
