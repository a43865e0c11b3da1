"""The robot cell in MuJoCo: the same scenes, cameras and robot as in PyBullet, other physics."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from envs.board import Board
from envs.cell import Cell, PhysicsError
from envs.cell_layout import REST_CHECK_STEPS, REST_SPEED
from envs.cell_scenes import Scene
from envs.mujoco_bodies import add_board, scene_spec
from envs.mujoco_camera import MujocoCamera
from envs.mujoco_panda import MujocoPanda, load_mujoco
from utils.config import Config
from utils.transforms import pose_matrix, position_quaternion

if TYPE_CHECKING:
    import mujoco

# MuJoCo's steps in one of the cell's steps: a grip lasts through about one millisecond.
SUBSTEPS = 4


class MujocoCell(Cell):
    """A cell simulated by MuJoCo. Raises UserError where MuJoCo is not installed."""

    robot: MujocoPanda

    def __init__(self, config: Config):
        super().__init__(config)
        self._mujoco = load_mujoco()
        self._camera: MujocoCamera | None = None

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

    def _make_robot(self, spec: mujoco.MjSpec) -> MujocoPanda:
        grip_force = self.config.robot.grip_force
        return MujocoPanda(spec, self.dt, SUBSTEPS, self.gripper, grip_force, self._new_gate())

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
        self.robot.step(count)

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
        model.geom_contype[model.geom_bodyid == body] = 0
        model.geom_conaffinity[model.geom_bodyid == body] = 0
        model.body_gravcomp[body] = 1.0  # with nothing that pulls or touches, it stays
        self.robot.data.qvel[self._speeds[index] : self._speeds[index] + 6] = 0.0

    def _free_camera(self) -> None:
        if self._camera is not None:
            self._camera.close()
            self._camera = None

    def close(self) -> None:
        self._free_camera()
