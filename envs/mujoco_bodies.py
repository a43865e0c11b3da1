"""Bodies in a MuJoCo model: table, walls, objects and boards, and the physics that they share.

`MujocoTable` is the empty table on which scenes are laid out before any cell is built;
`envs.cell_scenes` decides what is put where. MuJoCo describes a model by an `MjSpec`, which is then
compiled. This module knows no cell, robot or camera.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from typing_extensions import Self

from envs.board import BLACK, WHITE, Board
from envs.cell_layout import (
    CERTAIN_REST_CHECKS,
    GRAVITY,
    REST_SPEED,
    TABLE_COLOUR,
    WALL_COLOUR,
    Box,
    LayoutTable,
    ObjectModel,
    rest_check_steps,
    table_box,
)
from envs.mujoco_panda import load_mujoco
from envs.object_shapes import NativeShape
from utils.config import Config
from utils.transforms import position_quaternion

if TYPE_CHECKING:
    import mujoco

_PARKED = (0.0, 0.0, -10.0)  # m in W, where an object is that is not on the table


# --- Physics and shapes -----------------------------------------------------------------------

# MuJoCo takes the larger friction of two that touch, PyBullet the product, with 1 on table and
# fingers: these have none here, and `add_pairs` states what counts.
NO_FRICTION = 1e-5
# Of an object's friction on tray, palm and arm: Bullet's coefficient where none is stated, which is
# theirs there, and by which Bullet multiplies the object's.
OF_OTHER_BODIES = 0.5
ROLLING = 1e-4  # m, MuJoCo's default
# s, in which a contact gets rid of a penetration. MuJoCo's default, 20 ms, is so soft that objects
# of 30 g creep and turn in a grip of 10 N (by 1.6 mm in half a second, with this by 0.5 mm).
CONTACT_TIME = 0.005


# MuJoCo's steps in one of the cell's steps: a grip lasts through about one millisecond.
SUBSTEPS = 4
_PUSH = 1e-12  # m/s


def set_up_physics(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """Set gravity and the friction solver of a model, and let what lies still sleep; returns it.

    What sleeps costs nothing and has no contacts. MuJoCo wakes what is touched by something awake,
    and the robot never sleeps; `wake` does it where a support disappears.
    """
    mujoco = load_mujoco()
    spec.option.gravity = [0, 0, -GRAVITY]
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 100  # of friction's stiffness: grasped objects creep less
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP
    return spec


def wake(model: mujoco.MjModel, data: mujoco.MjData, bodies: Iterable[int]) -> None:
    """Wake free bodies, by MuJoCo's numbers, that sleep.

    MuJoCo takes any speed of a sleeping body for a push, however small it is.
    """
    for body in bodies:
        if not data.body_awake[body]:
            data.qvel[model.body_dofadr[body]] = _PUSH


def settle(
    data: mujoco.MjData,
    speeds: Sequence[int],
    config: Config,
    step: Callable[[int], None],
    checks: int = CERTAIN_REST_CHECKS,
) -> bool:
    """Step until free bodies rest; False if they still move after scene.settle_seconds.

    speeds: where the velocity of each begins in `data.qvel`. step: takes so many of the cell's
    steps. checks: as of `LayoutTable.settle`. Rings and crosses rock for seconds on the edges of
    their pieces, and a single check would find them at rest where they turn round.
    """
    found, steps = 0, rest_check_steps(config.sim.frequency)
    for _ in range(int(config.scene.settle_seconds * config.sim.frequency / steps)):
        step(steps)
        found = found + 1 if all(_resting(data.qvel[at : at + 6]) for at in speeds) else 0
        if found == checks:
            return True
    return False


def _resting(velocity: np.ndarray) -> bool:
    linear, angular = np.abs(velocity).reshape(2, 3).max(axis=1)
    return bool(linear < REST_SPEED and angular < 10 * REST_SPEED)


def add_boxes(spec: mujoco.MjSpec, name: str, boxes: Sequence[Box], colour) -> None:
    """Add boxes as one immovable body, which stands where the first one is."""
    mujoco = load_mujoco()
    body = spec.worldbody.add_body(name=name, pos=list(boxes[0].position))
    for box in boxes:
        geom = body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX, size=list(box.half_size), rgba=list(colour),
            pos=list(box.position - boxes[0].position),
        )  # fmt: skip
        geom.friction = [NO_FRICTION, 0.0, ROLLING]
        geom.solref[0] = CONTACT_TIME


def add_object(
    spec: mujoco.MjSpec, name: str, model: ObjectModel, position, quaternion
) -> mujoco.MjsBody:
    """Add an object with its centre of mass at position (3,) in W, turned by a quaternion (4,);
    returns MuJoCo's specification of its body."""
    body = spec.worldbody.add_body(
        name=name, pos=list(position), quat=np.roll(quaternion, 1).tolist()
    )
    body.add_freejoint(name=name)
    # MuJoCo compares exactly, and of a thin plate one moment is the sum of the others, rounded.
    most = (model.inertia.sum() - model.inertia) * (1 - 1e-9)
    body.mass, body.inertia, body.ipos = model.mass, np.minimum(model.inertia, most), [0, 0, 0]
    if model.principal is not None:
        body.iquat = np.roll(model.principal, 1).tolist()
    body.explicitinertial = True
    for geom in _add_shapes(spec, body, name, model):
        geom.rgba = list(model.color)
        geom.friction = [model.friction, 0.0, max(model.rolling_friction, ROLLING)]
        geom.condim = 6 if model.rolling_friction else 3
        geom.solref[0] = CONTACT_TIME
    return body


class Touched(NamedTuple):
    """A shape that objects touch. share: of an object's sliding friction, on it. patch: m, torque
    about the normal over the friction force, where it holds one."""

    geom: mujoco.MjsGeom
    share: float = 1.0
    patch: float = 0.0


def add_pairs(spec: mujoco.MjSpec, objects: Sequence[str], touched: Sequence[Touched]) -> None:
    """Give the contacts of objects, which are bodies' names, parameters of their own.

    Sliding friction is the object's times what each shape of `touched` has of it. What is left to
    the object's shapes is contact with other objects: they get the square of its coefficient.
    Rolling friction is what MuJoCo would take from the two shapes.
    """
    for number, other in enumerate(touched):
        other.geom.name = other.geom.name or f"touched{number}"
    for name in objects:
        for number, shape in enumerate(spec.body(name).geoms):
            shape.name = f"{name}_{number}"
            for geom, share, patch in touched:
                sliding = share * shape.friction[0]
                rolling = max(shape.friction[2], geom.friction[2])
                pair = spec.add_pair(geomname1=shape.name, geomname2=geom.name)
                pair.friction = [sliding, sliding, patch * sliding, rolling, rolling]
                pair.condim = max(shape.condim, 4 if patch else 3)
                pair.solref, pair.solimp = shape.solref, shape.solimp
            shape.friction[0] **= 2


def _add_shapes(spec: mujoco.MjSpec, body, name: str, model: ObjectModel) -> list:
    """Give a body its object's shape: a native one, or a mesh for each convex part."""
    mujoco = load_mujoco()
    if isinstance(model.collision, NativeShape):
        kind, size = _native(mujoco, model.collision)
        return [body.add_geom(type=kind, size=size)]
    geoms = []
    for i, part in enumerate(model.parts):
        mesh = spec.add_mesh(name=f"{name}_{i}")
        mesh.uservert = np.asarray(part, dtype=np.float32).ravel()
        geoms.append(body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh.name))
    return geoms


def _native(mujoco, shape: NativeShape) -> tuple[Any, list[float]]:
    """MuJoCo's type and size, in half lengths, of a native shape."""
    kinds = mujoco.mjtGeom
    if shape.kind == "box":
        return kinds.mjGEOM_BOX, [side / 2 for side in shape.size]
    if shape.kind == "sphere":
        return kinds.mjGEOM_SPHERE, [shape.size[0], 0, 0]
    radius, length = shape.size
    kind = kinds.mjGEOM_CYLINDER if shape.kind == "cylinder" else kinds.mjGEOM_CAPSULE
    return kind, [radius, length / 2, 0]


def add_board(spec: mujoco.MjSpec, board: Board, T_WO: np.ndarray) -> None:
    """Add a board that stays at T_WO (4, 4) and collides with nothing."""
    mujoco = load_mujoco()
    position, quaternion = position_quaternion(T_WO)
    body = spec.worldbody.add_body(
        name="board", pos=list(position), quat=np.roll(quaternion, 1).tolist()
    )
    half, middle = board.white()
    white = body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=half, pos=middle, rgba=list(WHITE))
    vertices, triangles = board.black()
    mesh = spec.add_mesh(name="board", uservert=np.ravel(vertices), userface=triangles)
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL  # a plane has no volume
    black = body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh.name, rgba=list(BLACK))
    for geom in (white, black):
        geom.contype = geom.conaffinity = 0


# --- The table on which scenes are laid out ---------------------------------------------------


class MujocoTable(LayoutTable):
    """A `LayoutTable` in MuJoCo. Raises UserError where MuJoCo is not installed.

    MuJoCo compiles a model as a whole, which takes tens of milliseconds. So the model holds all
    objects from the start; those that are not on the table are parked: nothing pulls or touches
    them. A body's number is that of its object, or after these that of a wall.
    """

    least_checks = CERTAIN_REST_CHECKS

    def __init__(self, config: Config, models: Sequence[ObjectModel], walls: Sequence[Box] = ()):
        self._config, self._models, self._standing = config, list(models), walls
        self._mujoco = load_mujoco()

    def __enter__(self) -> Self:
        self._spec = set_up_physics(self._mujoco.MjSpec())
        self._spec.option.timestep = 1.0 / self._config.sim.frequency / SUBSTEPS
        add_boxes(self._spec, "table", [table_box(), *self._standing], TABLE_COLOUR)
        for number, model in enumerate(self._models):
            body = add_object(self._spec, _name(number), model, _PARKED, (0.0, 0.0, 0.0, 1.0))
            body.gravcomp = 1.0  # else the compiled model would never compensate gravity
        # Walls that come and go are left out: half of the usual coefficient of 0.5 is its square.
        table = [Touched(geom) for geom in self._spec.body("table").geoms]
        add_pairs(self._spec, [_name(number) for number in range(len(self._models))], table)
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
            add_boxes(self._spec, _name(number), [wall], WALL_COLOUR)
            self._walls += 1
        self._model, self._data = self._spec.recompile(self._model, self._data)
        for number in range(len(self._models)):  # a compiled model is as the specification says
            self._collide(number, number not in self._free)
        return list(range(first, len(self._models) + self._walls))

    def remove(self, body: int) -> None:
        self._collide(body, False)
        wake(self._model, self._data, [self._model.body(_name(used)).id for used in self._used()])
        if body < len(self._models):
            self._place(body, _PARKED, (0.0, 0.0, 0.0, 1.0))
            self._free.append(body)
        else:  # a wall, which the next compiled model must not bring back
            for geom in self._spec.body(_name(body)).geoms:
                geom.contype = geom.conaffinity = 0

    def settle(self, bodies: Sequence[int], checks: int = 1) -> bool:
        def step(count: int) -> None:
            self._mujoco.mj_step(self._model, self._data, count * SUBSTEPS)

        speeds = [self._joint(body).dofadr[0] for body in bodies]
        checks = max(checks, self.least_checks)
        return settle(self._data, speeds, self._config, step, checks)

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

    def _used(self) -> list[int]:
        """Numbers of the objects on the table."""
        return [number for number in range(len(self._models)) if number not in self._free]

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
