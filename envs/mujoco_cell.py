"""The robot cell in MuJoCo: the same scenes, cameras and robot as in PyBullet, other physics.

`scene_spec` and `add_board` write MuJoCo's model of table, bin, objects and Panda, placed as in
PyBullet's cell; `MujocoCell` runs it. Sizes, masses, inertias, and friction with table and fingers
are PyBullet's; contacts are MuJoCo's own (between two objects MuJoCo takes the larger coefficient,
PyBullet the product).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from envs.board import BLACK, WHITE, Board
from envs.cell import Cell, PhysicsError
from envs.cell_layout import (
    BIN_COLOUR,
    GRAVITY,
    REST_CHECK_STEPS,
    REST_SPEED,
    TABLE_COLOUR,
    Box,
    ObjectModel,
    Scene,
    bin_walls,
    table_box,
)
from envs.mujoco_camera import MujocoCamera, Window, add_view
from envs.mujoco_panda import FINGERS, MujocoPanda, load_mujoco, panda_spec
from envs.mujoco_randomization import MujocoRandomizable
from utils.config import Config
from utils.geometry import GripperGeometry
from utils.transforms import pose_matrix, position_quaternion

if TYPE_CHECKING:
    import mujoco


# MuJoCo takes the larger friction of two that touch, PyBullet the product, with 1 on table and
# fingers: with nothing on these here, the object's own coefficient counts in both.
_NO_FRICTION = 1e-5
# m and dimensionless lengths of torsional and rolling friction, MuJoCo's defaults.
_TORSION, _ROLLING = 0.005, 1e-4
# s, in which a contact gets rid of a penetration. MuJoCo's default, 20 ms, is so soft that objects
# of 30 g creep and turn in a grip of 10 N (by 1.6 mm in half a second, with this by 0.5 mm).
_CONTACT_TIME = 0.005


def scene_spec(scene: Scene, gripper: GripperGeometry) -> mujoco.MjSpec:
    """A model of Panda, table, bin and the scene's objects at their resting poses, with a camera.

    Bodies are called `table`, `bin0` to `bin3` and `object0` on. Raises UserError without MuJoCo.
    """
    mujoco = load_mujoco()
    spec = panda_spec(gripper)
    spec.option.gravity = [0, 0, -GRAVITY]
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 100  # of friction's stiffness: grasped objects creep less
    for name in FINGERS:
        for geom in spec.body(name).geoms:
            geom.friction = [_NO_FRICTION, _TORSION, _ROLLING]
    _add_box(mujoco, spec, "table", table_box(), TABLE_COLOUR)
    for i, wall in enumerate(bin_walls()):
        _add_box(mujoco, spec, f"bin{i}", wall, BIN_COLOUR)
    for i, placed in enumerate(scene.placements):
        _add_object(mujoco, spec, f"object{i}", placed.model, placed.position, placed.quaternion)
    # The base stands on the table.
    exclude = spec.add_exclude()
    exclude.bodyname1, exclude.bodyname2 = "table", "panda_link1"
    for geom in spec.geoms:
        geom.solref[0] = _CONTACT_TIME
    _add_pairs(spec, len(scene.placements))
    add_view(spec)
    return spec


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


def _add_box(mujoco, spec: mujoco.MjSpec, name: str, box: Box, colour) -> None:
    body = spec.worldbody.add_body(name=name, pos=list(box.position))
    geom = body.add_geom(
        name=name, type=mujoco.mjtGeom.mjGEOM_BOX, size=list(box.half_size), rgba=list(colour)
    )
    geom.friction = [_NO_FRICTION, _TORSION, _ROLLING]


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


def _add_pairs(spec: mujoco.MjSpec, count: int) -> None:
    """Give the contacts of the objects with table and fingers parameters of their own.

    They are those that MuJoCo would take from the two shapes, and the physics is the same to the
    last bit; `envs.mujoco_randomization` changes them.
    """
    touched = [
        geom for name in ("table", *FINGERS) for geom in spec.body(name).geoms if geom.contype
    ]
    for number, geom in enumerate(touched):
        geom.name = geom.name or f"touched{number}"
    for i in range(count):
        for number, shape in enumerate(spec.body(f"object{i}").geoms):
            shape.name = f"object{i}_{number}"
            for other in touched:
                sliding, torsion, rolling = np.maximum(shape.friction, other.friction)
                pair = spec.add_pair(geomname1=shape.name, geomname2=other.name)
                pair.friction = [sliding, sliding, torsion, rolling, rolling]
                pair.condim = max(shape.condim, other.condim)
                pair.solref, pair.solimp = shape.solref, shape.solimp


# MuJoCo's steps in one of the cell's steps: a grip lasts through about one millisecond.
SUBSTEPS = 4


class MujocoCell(Cell):
    """A cell simulated by MuJoCo.

    gui: opens a window. Raises UserError where MuJoCo is not installed, or no window can be opened.
    """

    robot: MujocoPanda

    def __init__(self, config: Config, gui: bool = False):
        super().__init__(config)
        self._mujoco = load_mujoco()
        self._camera: MujocoCamera | None = None
        self._window = Window() if gui else None

    def _build(self, scene: Scene, board: Board | None, T_WO: np.ndarray | None) -> None:
        self._free_camera()
        spec = scene_spec(scene, self.gripper)
        if board is not None:
            add_board(spec, board, T_WO)
        self.robot = self._make_robot(spec)
        model = self.robot.model
        # `check_physics` reports a diverged simulation, which MuJoCo would silently reset.
        model.opt.disableflags |= self._mujoco.mjtDisableBit.mjDSBL_AUTORESET
        self.robot.place(self.home)
        names = [f"object{i}" for i in range(len(scene.placements))]
        self.bodies = [model.body(name).id for name in names]
        self._places = [model.joint(name).qposadr[0] for name in names]
        self._speeds = [model.joint(name).dofadr[0] for name in names]
        self._table = model.body("table").id
        self._randomizable: MujocoRandomizable | None = None
        if self._window is not None:
            self._window.show(model, self.robot.data)

    def _make_robot(self, spec: mujoco.MjSpec) -> MujocoPanda:
        grip_force = self.config.robot.grip_force
        return MujocoPanda(spec, self.dt, SUBSTEPS, self.gripper, grip_force, self._new_gate())

    def randomizable(self) -> MujocoRandomizable:
        if self._randomizable is None:
            self._randomizable = MujocoRandomizable(self.robot, self._table, self.bodies)
        return self._randomizable

    def _settle(self) -> None:
        for _ in range(int(self.config.scene.settle_seconds / self.dt / REST_CHECK_STEPS)):
            self.robot.step(REST_CHECK_STEPS)
            if all(map(self._resting, self.remaining)):
                break

    def _resting(self, index: int) -> bool:
        start = self._speeds[index]
        linear, angular = np.abs(self.robot.data.qvel[start : start + 6]).reshape(2, 3).max(axis=1)
        return bool(linear < REST_SPEED and angular < 10 * REST_SPEED)

    def _advance(self, count: int) -> None:
        if self._window is None:
            self.robot.step(count)
            return
        for _ in range(count):
            self.robot.step()
            self._window.update()

    @property
    def camera(self) -> MujocoCamera:
        if self._camera is None:
            self._camera = MujocoCamera(self.robot.model, self.robot.data)
        return self._camera

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

    def _immobilise(self, index: int) -> None:
        model, body = self.robot.model, self.bodies[index]
        shapes = model.geom_bodyid == body
        model.geom_contype[shapes] = model.geom_conaffinity[shapes] = 0
        # A pair collides whatever these say; without its bounding spheres it does not.
        one, other = model.pair_geom1, model.pair_geom2
        pairs = shapes[one] | shapes[other]
        spheres = model.geom_rbound[one] + model.geom_rbound[other]
        model.pair_margin[pairs] = -spheres[pairs]
        model.body_gravcomp[body] = 1.0  # with nothing that pulls or touches, it stays
        self.robot.data.qvel[self._speeds[index] : self._speeds[index] + 6] = 0.0

    def _free_camera(self) -> None:
        if self._camera is not None:
            self._camera.close()
            self._camera = None

    def close(self) -> None:
        self._free_camera()
        if self._window is not None:
            self._window.close()
