"""The robot cell in MuJoCo: the same scenes, cameras and robot as in PyBullet, other physics.

What PyBullet's cell can do beyond `envs.base_cell`, which is to be randomised and to spare its
solver, is not to be had here.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from envs.base_cell import ROBOT, TABLE_OR_BACKGROUND, BaseCell, PhysicsError
from envs.camera import Image, Intrinsics
from envs.mujoco_camera import MujocoCamera
from envs.mujoco_panda import MujocoPanda, load_mujoco
from envs.mujoco_scene import add_board, scene_spec
from envs.scenes import EMPTY, LOOK_EVERY, REST_SPEED, Scene
from envs.servo_target import Board
from utils.config import Config
from utils.transforms import pose_matrix, position_quaternion

if TYPE_CHECKING:
    import mujoco

SUBSTEPS = 4  # of MuJoCo in one of the cell's steps: a grip lasts through about one millisecond


class MujocoCell(BaseCell):
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
