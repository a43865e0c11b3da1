"""A scene of the cell in MuJoCo: table, bin, objects and Panda where PyBullet's cell has them.

Same sizes, masses, inertias, and friction with table and fingers (between two objects MuJoCo takes
the larger coefficient, PyBullet the product); contacts are MuJoCo's own. What happens in it is for
`envs.mujoco_cell`.

The robot cell in MuJoCo: the same scenes, cameras and robot as in PyBullet, other physics.

What PyBullet's cell can do beyond `envs.cell`, which is to be randomised and to spare its
solver, is not to be had here.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from envs.board import BLACK, WHITE, Board
from envs.cell import ROBOT, TABLE_OR_BACKGROUND, Cell, PhysicsError
from envs.cell_layout import (
    BIN_CENTRE,
    BIN_HALF_SIZE,
    BIN_HEIGHT,
    GRAVITY,
    TABLE_CENTRE,
    TABLE_SIZE,
)
from envs.cell_scenes import EMPTY, LOOK_EVERY, REST_SPEED, Scene
from envs.mujoco_camera import MujocoCamera, add_view
from envs.mujoco_panda import MujocoPanda, load_mujoco, panda_spec
from envs.objects import ObjectModel
from envs.pybullet_camera import Image, Intrinsics
from utils.config import Config
from utils.transforms import pose_matrix, position_quaternion

if TYPE_CHECKING:
    import mujoco


_TABLE_THICKNESS, _WALL = 0.04, 0.005  # m
_TABLE_COLOUR, _BIN_COLOUR = (0.62, 0.60, 0.57, 1.0), (0.25, 0.35, 0.45, 1.0)
# MuJoCo takes the larger friction of two that touch, PyBullet the product, with 1 on table and
# fingers: with nothing on these here, the object's own coefficient counts in both.
_NO_FRICTION = 1e-5
# m and dimensionless lengths of torsional and rolling friction, MuJoCo's defaults.
_TORSION, _ROLLING = 0.005, 1e-4
# s, in which a contact gets rid of a penetration. MuJoCo's default, 20 ms, is so soft that objects
# of 30 g creep and turn in a grip of 10 N (by 1.6 mm in half a second, with this by 0.5 mm).
_CONTACT_TIME = 0.005


def scene_spec(scene: Scene) -> mujoco.MjSpec:
    """A model of Panda, table, bin and the scene's objects at their resting poses, with a camera.

    Bodies are called `table`, `bin0` to `bin3` and `object0` on. Raises UserError without MuJoCo.
    """
    mujoco = load_mujoco()
    spec = panda_spec()
    spec.option.gravity = [0, 0, -GRAVITY]
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 100  # of friction's stiffness: grasped objects creep less
    for name in ("panda_leftfinger", "panda_rightfinger"):
        for geom in spec.body(name).geoms:
            geom.friction = [_NO_FRICTION, _TORSION, _ROLLING]
    _box(
        mujoco, spec, "table", [*(TABLE_SIZE / 2), _TABLE_THICKNESS / 2],
        [*TABLE_CENTRE, -_TABLE_THICKNESS / 2], _TABLE_COLOUR,
    )  # fmt: skip
    for i, (size, position) in enumerate(_bin_walls()):
        _box(mujoco, spec, f"bin{i}", size, position, _BIN_COLOUR)
    for i, placed in enumerate(scene.placements):
        _add_object(mujoco, spec, f"object{i}", placed.model, placed.position, placed.quaternion)
    # The base stands on the table.
    exclude = spec.add_exclude()
    exclude.bodyname1, exclude.bodyname2 = "table", "panda_link1"
    for geom in spec.geoms:
        geom.solref[0] = _CONTACT_TIME
    add_view(spec)
    return spec


def add_board(spec: mujoco.MjSpec, board: Board, T_WO: np.ndarray) -> None:
    """Add a board to a model that is only looked at: it stays at T_WO (4, 4) and collides with
    nothing."""
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


def _box(mujoco, spec: mujoco.MjSpec, name: str, half_size, position, colour) -> None:
    body = spec.worldbody.add_body(name=name, pos=list(position))
    geom = body.add_geom(
        name=name, type=mujoco.mjtGeom.mjGEOM_BOX, size=list(half_size), rgba=list(colour)
    )
    geom.friction = [_NO_FRICTION, _TORSION, _ROLLING]


def _bin_walls():
    """Half sizes and positions (3,) of the bin's walls, as `envs.cell_layout.add_walls` puts them."""
    outer = BIN_HALF_SIZE + _WALL / 2
    for sign in (-1, 1):
        for axis in (0, 1):
            size = np.array([BIN_HALF_SIZE + _WALL, BIN_HALF_SIZE + _WALL, BIN_HEIGHT / 2])
            size[axis] = _WALL / 2
            position = np.array([*BIN_CENTRE, BIN_HEIGHT / 2])
            position[axis] += sign * outer
            yield size, position


def _add_object(mujoco, spec, name: str, model: ObjectModel, position, quaternion) -> None:
    body = spec.worldbody.add_body(
        name=name, pos=list(position), quat=np.roll(quaternion, 1).tolist()
    )
    body.add_freejoint(name=name)
    body.mass, body.inertia, body.ipos = model.mass, model.inertia, [0, 0, 0]
    body.explicitinertial = True
    for i, part in enumerate(model.parts):
        mesh = spec.add_mesh(name=f"{name}_{i}")
        mesh.uservert = np.asarray(part, dtype=np.float32).ravel()
        geom = body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh.name)
        geom.rgba = list(model.color)
        geom.friction = [model.friction, _TORSION, max(model.rolling_friction, _ROLLING)]
        geom.condim = 6 if model.rolling_friction else 4


SUBSTEPS = 4  # of MuJoCo in one of the cell's steps: a grip lasts through about one millisecond


class MujocoCell(Cell):
    """A cell simulated by MuJoCo. Raises UserError where MuJoCo is not installed."""

    def __init__(self, config: Config):
        super().__init__(config)
        self._mujoco = load_mujoco()
        self._camera: MujocoCamera | None = None

    def load(self, scene: Scene) -> None:
        self.build(scene)
        for _ in range(int(self.config.scene.settle_seconds / self.dt / LOOK_EVERY)):
            self.robot.step(LOOK_EVERY)
            if all(map(self._resting, self.remaining)):
                break

    def build(self, scene: Scene) -> None:
        self._build(scene, scene_spec(scene))

    def show_board(self, board: Board, T_WO: np.ndarray) -> None:
        spec = scene_spec(EMPTY)
        add_board(spec, board, T_WO)
        self._build(EMPTY, spec)

    def _build(self, scene: Scene, spec: mujoco.MjSpec) -> None:
        self._free_camera()
        self.scene = scene
        grip_force = self.config.robot.grip_force
        self.robot = MujocoPanda(self._new_gate(), spec, self.dt, SUBSTEPS, grip_force)
        model = self.robot.model
        # A blown-up world is for `check_physics` to tell; MuJoCo would quietly start it again.
        model.opt.disableflags |= self._mujoco.mjtDisableBit.mjDSBL_AUTORESET
        self.robot.place(self.home)
        names = [f"object{i}" for i in range(len(scene.placements))]
        self.bodies = [model.body(name).id for name in names]
        self._places = [model.joint(name).qposadr[0] for name in names]
        self._speeds = [model.joint(name).dofadr[0] for name in names]
        self._table = model.body("table").id
        self.remaining = set(range(len(names)))
        self.steps = self.frames = 0

    def _resting(self, index: int) -> bool:
        start = self._speeds[index]
        linear, angular = np.abs(self.robot.data.qvel[start : start + 6]).reshape(2, 3).max(axis=1)
        return bool(linear < REST_SPEED and angular < 10 * REST_SPEED)

    def step(self, count: int = 1) -> None:
        if self.on_step is None and self.before_step is None:
            self.robot.step(count)
            self.steps += count
            return
        for _ in range(count):
            if self.before_step is not None:
                self.before_step(self)
            self.robot.step()
            self.steps += 1
            if self.on_step is not None:
                self.on_step(self)

    def check_physics(self) -> None:
        super().check_physics()
        kinds = self._mujoco.mjtWarning
        for kind in (kinds.mjWARN_BADQPOS, kinds.mjWARN_BADQVEL, kinds.mjWARN_BADQACC):
            if self.robot.data.warning[kind].number:
                raise PhysicsError(f"MuJoCo warns of {kind.name}")

    def object_pose(self, index: int) -> np.ndarray:
        start = self._places[index]
        w, x, y, z = self.robot.data.qpos[start + 3 : start + 7]
        return pose_matrix(self.robot.data.qpos[start : start + 3], (x, y, z, w))

    def object_position(self, index: int) -> np.ndarray:
        start = self._places[index]
        position = self.robot.data.qpos[start : start + 3].copy()
        if not all(map(math.isfinite, position)):
            raise PhysicsError(f"object {index} has a non-finite position: {position}")
        return position

    def speed(self, index: int) -> float:
        start = self._speeds[index]
        return math.hypot(*self.robot.data.qvel[start : start + 3])

    def carry(self, index: int, T_WO: np.ndarray, velocity: np.ndarray, turn_rate: float) -> None:
        place, speed, data = self._places[index], self._speeds[index], self.robot.data
        position, quaternion = position_quaternion(T_WO)
        data.qpos[place : place + 7] = [*position, *np.roll(quaternion, 1)]
        # A free joint turns about the body's own axes, along which +z of W is this row.
        data.qvel[speed : speed + 6] = [*velocity, *(turn_rate * T_WO[2, :3])]

    def touches_table(self, index: int) -> bool:
        return self.robot.meet(self.bodies[index], self._table)

    def retire(self, index: int) -> None:
        model, body = self.robot.model, self.bodies[index]
        self.remaining.discard(index)
        model.geom_contype[model.geom_bodyid == body] = 0
        model.geom_conaffinity[model.geom_bodyid == body] = 0
        model.body_gravcomp[body] = 1.0  # with nothing that pulls or touches, it stays
        self.robot.data.qvel[self._speeds[index] : self._speeds[index] + 6] = 0.0

    def image(self, intrinsics: Intrinsics, T_WC: np.ndarray, light: dict | None = None) -> Image:
        if self._camera is None:
            self._camera = MujocoCamera(self.robot.model, self.robot.data)
        return self._camera.render(intrinsics, T_WC, light)

    def _segmentation(self, image: Image) -> np.ndarray:
        number_of = np.full(self.robot.model.nbody + 1, TABLE_OR_BACKGROUND, dtype=np.int32)
        number_of[self.robot.links] = ROBOT
        number_of[self.bodies] = range(len(self.bodies))
        return number_of[image.bodies]  # -1, nothing, is the extra last one

    def _free_camera(self) -> None:
        if self._camera is not None:
            self._camera.close()
            self._camera = None

    def close(self) -> None:
        self._free_camera()
