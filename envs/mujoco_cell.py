"""The robot cell in MuJoCo: the same scenes, cameras and robot as in PyBullet, other physics.

`scene_spec` writes MuJoCo's model of table, tray, objects and Panda, placed as in PyBullet's cell;
`MujocoCell` runs it. Sizes, masses, inertias, and friction of objects with all else are PyBullet's;
contacts are MuJoCo's own. Between two objects MuJoCo takes the larger coefficient of two, PyBullet
the product: they agree where both objects have the same.
"""

from __future__ import annotations

import math
import re
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from envs.board import Board
from envs.cell import Cell, PhysicsError
from envs.cell_layout import (
    TABLE_COLOUR,
    TRAY_COLOUR,
    Scene,
    table_box,
    tray_walls,
)
from envs.floating_hand import park
from envs.mujoco_bodies import (
    CONTACT_TIME,
    NO_FRICTION,
    OF_OTHER_BODIES,
    ROLLING,
    SUBSTEPS,
    Touched,
    add_board,
    add_boxes,
    add_object,
    add_pairs,
    set_up_physics,
    settle,
    wake,
)
from envs.mujoco_camera import MujocoCamera, Window, add_view
from envs.mujoco_panda import (
    FINGERS,
    MujocoFloatingHand,
    MujocoHand,
    MujocoPanda,
    floating_spec,
    load_mujoco,
    panda_spec,
)
from envs.mujoco_randomization import MujocoRandomizable
from envs.panda_model import FINGER_SURFACE
from utils.config import Config
from utils.geometry import GripperGeometry
from utils.transforms import pose_matrix, position_quaternion

if TYPE_CHECKING:
    import mujoco

_OBJECT = re.compile(r"object\d+")  # names of the objects' bodies


def scene_spec(scene: Scene, gripper: GripperGeometry, arm: bool = True) -> mujoco.MjSpec:
    """A model of Panda, table, tray and the scene's objects at their resting poses, with a camera.

    arm: False for the hand alone. Bodies are called `table`, `tray0` to `tray3` and `object0` on.
    Raises UserError without MuJoCo.
    """
    spec = set_up_physics(panda_spec(gripper) if arm else floating_spec(gripper))
    for name in FINGERS:
        for geom in spec.body(name).geoms:
            geom.friction = [NO_FRICTION, 0.0, ROLLING]
    add_boxes(spec, "table", [table_box(), *scene.walls], TABLE_COLOUR)
    for i, wall in enumerate(tray_walls()):
        add_boxes(spec, f"tray{i}", [wall], TRAY_COLOUR)
    for i, placed in enumerate(scene.placements):
        add_object(spec, f"object{i}", placed.model, placed.position, placed.quaternion)
    for geom in spec.geoms:
        geom.solref[0] = CONTACT_TIME
    bodies = [body for body in spec.bodies if not _OBJECT.fullmatch(body.name)]
    objects = [f"object{i}" for i in range(len(scene.placements))]
    add_pairs(spec, objects, [shape for body in bodies for shape in _touched(body)])
    add_view(spec)
    return spec


def _touched(body: mujoco.MjsBody) -> list[Touched]:
    """The shapes of a body that is no object, with the shares of friction that PyBullet's have;
    fingertips alone hold a torque. `envs.mujoco_randomization` changes all of them."""
    share = 1.0 if body.name in ("table", *FINGERS) else OF_OTHER_BODIES
    patch = FINGER_SURFACE.spinning if body.name in FINGERS else 0.0
    return [Touched(geom, share, patch) for geom in body.geoms if geom.contype]


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
        spec = scene_spec(scene, self.gripper, self.has_arm)
        if board is not None:
            add_board(spec, board, T_WO)
        self.robot = self._make_robot(spec)
        model = self.robot.model
        # `check_physics` reports a diverged simulation, which MuJoCo would silently reset.
        model.opt.disableflags |= self._mujoco.mjtDisableBit.mjDSBL_AUTORESET
        if self.has_arm:
            self.robot.place(self.home)
        else:
            park(self.robot, self.config.workspace)
        names = [f"object{i}" for i in range(len(scene.placements))]
        self.bodies = [model.body(name).id for name in names]
        self._places = [model.joint(name).qposadr[0] for name in names]
        self._speeds = [model.joint(name).dofadr[0] for name in names]
        self._table = model.body("table").id
        self._randomizable: MujocoRandomizable | None = None
        if self._window is not None:
            self._window.show(model, self.robot.data)

    def _make_robot(self, spec: mujoco.MjSpec) -> MujocoHand:
        known = spec, self.dt, SUBSTEPS, self.gripper, self.config.robot.grip_force
        if not self.has_arm:
            return MujocoFloatingHand(*known)
        return MujocoPanda(*known, self._new_gate())

    def randomizable(self) -> MujocoRandomizable:
        if self._randomizable is None:
            self._randomizable = MujocoRandomizable(self.robot, self._table, self.bodies)
        return self._randomizable

    def _settle(self) -> None:
        speeds = [self._speeds[index] for index in self.remaining]
        settle(self.robot.data, speeds, self.config, self.robot.step)

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

    def check_solver(self) -> None:
        kinds = self._mujoco.mjtWarning
        for kind in (kinds.mjWARN_BADQPOS, kinds.mjWARN_BADQVEL, kinds.mjWARN_BADQACC):
            if self.robot.data.warning[kind].number:
                raise PhysicsError(f"MuJoCo warns of {kind.name}")

    def object_pose(self, index: int) -> np.ndarray:
        start = self._places[index]
        place = self.robot.data.qpos[start : start + 7]
        if not np.isfinite(place).all():
            raise PhysicsError(f"object {index} has a non-finite pose: {place}")
        w, x, y, z = place[3:]
        return pose_matrix(place[:3], (x, y, z, w))

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
        body, data = self.bodies[index], self.robot.data
        return self.robot.meet(body, self._table) or (
            not data.body_awake[body] and self._overlap(body, self._table)
        )

    def _overlap(self, one: int, other: int) -> bool:
        """Whether two bodies overlap: MuJoCo has no contacts of what sleeps."""
        model, data, places = self.robot.model, self.robot.data, np.zeros(6)
        pairs = product(*(np.flatnonzero(model.geom_bodyid == body) for body in (one, other)))
        return any(
            self._mujoco.mj_geomDistance(model, data, first, second, 0.01, places) <= 0
            for first, second in pairs
        )

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
        # What leaned on it must not go on sleeping.
        wake(model, self.robot.data, [self.bodies[other] for other in self.remaining])

    def _free_camera(self) -> None:
        if self._camera is not None:
            self._camera.close()
            self._camera = None

    def close(self) -> None:
        self._free_camera()
        if self._window is not None:
            self._window.close()
