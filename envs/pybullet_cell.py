"""The robot cell in PyBullet: one physics client with table, tray, Panda, objects and camera.

Labelling, evaluation, demonstrations and the Gymnasium environment all run in this one cell.
"""

from __future__ import annotations

import math

import numpy as np
import pybullet

from envs.board import Board
from envs.cell import Cell, PhysicsError
from envs.cell_layout import CERTAIN_REST_CHECKS, Scene
from envs.floating_hand import park
from envs.panda_urdf import write_panda
from envs.pybullet_bodies import (
    SOLVER_RESIDUAL,
    add_board,
    add_table,
    add_tray,
    body_quaternion,
    bullet_quaternion,
    set_up_physics,
    settle,
    spawn,
)
from envs.pybullet_camera import PybulletCamera, load_renderer
from envs.pybullet_files import panda_meshes
from envs.pybullet_panda import PybulletFloatingHand, PybulletHand, PybulletPanda
from envs.pybullet_randomization import PybulletRandomizable
from utils.config import Config
from utils.errors import UserError
from utils.transforms import position_quaternion

# As SOLVER_RESIDUAL, while the robot touches nothing: a last correction of 1 mrad/s.
_SLEEPING_RESIDUAL = 1e-6


class PybulletCell(Cell):
    """A cell simulated by PyBullet.

    fine: loads the detailed visual meshes, for pictures; physics is the same. gui: opens a window.
    """

    robot: PybulletPanda

    def __init__(self, config: Config, gui: bool = False, fine: bool = False):
        super().__init__(config)
        self.fine = fine
        self._gui = gui
        meshes = panda_meshes() if fine else None
        self._urdf = write_panda(config.cache_folder, self.gripper, meshes, self.has_arm)
        self.client = pybullet.connect(pybullet.GUI if gui else pybullet.DIRECT)
        try:
            renderer = load_renderer(self.client, config.sim.renderer)
        except UserError:
            self.close()  # nobody else can
            raise
        self.camera = PybulletCamera(self.client, renderer)

    def _build(self, scene: Scene, board: Board | None, T_WO: np.ndarray | None) -> None:
        # Resetting states alone would leave the solver's memory behind (bullet3 #2442). A build
        # takes about 8 ms and leaks nothing.
        set_up_physics(self.client, self.config.sim)
        self.table = add_table(self.client, scene.walls)
        self.tray = add_tray(self.client)
        self.robot = self._make_robot()
        self.bodies = [
            spawn(self.client, p.model, p.position, p.quaternion, fine=self.fine)
            for p in scene.placements
        ]
        self._randomizable: PybulletRandomizable | None = None
        if board is not None:
            add_board(self.client, board, T_WO)

    def _make_robot(self) -> PybulletHand:
        known = self.client, self.dt, self._urdf, self.gripper, self.config.robot.grip_force
        if not self.has_arm:
            return park(PybulletFloatingHand(*known), self.config.workspace)
        robot = PybulletPanda(*known, self._new_gate())
        robot.place(self.home)
        return robot

    def detailed_twin(self) -> PybulletCell:
        return PybulletCell(self.config, fine=True)

    def mirror(self, cell: PybulletCell) -> None:
        """Show another cell's scene, with robot and objects where they are there now."""
        if self.scene is not cell.scene:
            self.build(cell.scene)
        self.robot.mirror(cell.robot)
        for body, copy in zip(cell.bodies, self.bodies):
            pose = pybullet.getBasePositionAndOrientation(body, physicsClientId=cell.client)
            pybullet.resetBasePositionAndOrientation(copy, *pose, physicsClientId=self.client)

    def randomizable(self) -> PybulletRandomizable:
        if self._randomizable is None:
            principal = [placed.model.principal for placed in self.scene.placements]
            self._randomizable = PybulletRandomizable(
                self.client, self.dt, self.robot, self.table, self.bodies, self.remaining, principal
            )
        return self._randomizable

    def _settle(self) -> None:
        settle(self.client, self.bodies, self.config)

    def _advance(self, count: int) -> None:
        while count > 0:
            part = self.robot.receive(count)
            self._simulate(part)
            count -= part

    def _simulate(self, count: int) -> None:
        client = self.client
        if not self._gui and _divides(self.dt, count):
            # The same steps in one call. The time step is set only for that call, because motor
            # commands and contact forces are converted by it.
            pybullet.setPhysicsEngineParameter(
                fixedTimeStep=count * self.dt, numSubSteps=count, physicsClientId=client
            )
            pybullet.stepSimulation(physicsClientId=client)
            pybullet.setPhysicsEngineParameter(
                fixedTimeStep=self.dt, numSubSteps=0, physicsClientId=client
            )
            return
        for _ in range(count):
            pybullet.stepSimulation(physicsClientId=client)

    def enable_sleeping(self) -> bool:
        """Let objects at rest sleep; False where they do not come to rest: physics has gone on,
        uncounted, for as long as `settle` waits.

        A sleeping object lies still at no cost until something hits it. The solver stops a little
        earlier as well, which moves a free arm's joints by less than 0.5 mrad.
        """
        if not settle(self.client, self.bodies, self.config, checks=CERTAIN_REST_CHECKS):
            return False
        sleep = pybullet.ACTIVATION_STATE_ENABLE_SLEEPING | pybullet.ACTIVATION_STATE_SLEEP
        self._set_activation(sleep, _SLEEPING_RESIDUAL)
        return True

    def disable_sleeping(self) -> None:
        """Undo `enable_sleeping`: an object at rest in the hand must not fall asleep and hang in
        the air."""
        awake = pybullet.ACTIVATION_STATE_DISABLE_SLEEPING | pybullet.ACTIVATION_STATE_WAKE_UP
        self._set_activation(awake, SOLVER_RESIDUAL)

    def _set_activation(self, state: int, residual: float) -> None:
        for body in self.bodies:
            pybullet.changeDynamics(body, -1, activationState=state, physicsClientId=self.client)
        pybullet.setPhysicsEngineParameter(
            solverResidualThreshold=residual, physicsClientId=self.client
        )

    def object_pose(self, index: int) -> np.ndarray:
        """(4, 4) pose in W of an object's body frame (its origin is the centre of mass). Raises
        PhysicsError when it is not finite."""
        position, quaternion = self._position_and_quaternion(index)
        a, b, c, d, e, f, g, h, i = pybullet.getMatrixFromQuaternion(quaternion)
        x, y, z = position
        # A tenth of the time that SciPy takes: the Gymnasium env asks at every step.
        return np.array([(a, b, c, x), (d, e, f, y), (g, h, i, z), (0.0, 0.0, 0.0, 1.0)])

    def object_position(self, index: int) -> np.ndarray:
        """(3,) centre of mass in W. Raises PhysicsError when it is not finite."""
        return np.array(self._position_and_quaternion(index)[0])

    def _position_and_quaternion(self, index: int) -> tuple[tuple, tuple]:
        position, quaternion = pybullet.getBasePositionAndOrientation(
            self.bodies[index], physicsClientId=self.client
        )
        if not all(map(math.isfinite, position)):
            raise PhysicsError(f"object {index} has a non-finite position: {position}")
        return position, body_quaternion(quaternion, self.scene.placements[index].model.principal)

    def speed(self, index: int) -> float:
        velocity, _ = pybullet.getBaseVelocity(self.bodies[index], physicsClientId=self.client)
        return math.hypot(*velocity)

    def carry(self, index: int, T_WO: np.ndarray, velocity: np.ndarray, turn_rate: float) -> None:
        body, client = self.bodies[index], self.client
        position, quaternion = position_quaternion(T_WO)
        quaternion = bullet_quaternion(quaternion, self.scene.placements[index].model.principal)
        pybullet.resetBasePositionAndOrientation(body, position, quaternion, physicsClientId=client)
        pybullet.resetBaseVelocity(body, velocity, [0, 0, turn_rate], physicsClientId=client)

    def touches_table(self, index: int) -> bool:
        contacts = pybullet.getContactPoints(
            self.bodies[index], self.table, physicsClientId=self.client
        )
        return bool(contacts)

    def _immobilise(self, index: int) -> None:
        body = self.bodies[index]
        # A body without mass keeps its velocity and would drift away.
        pybullet.resetBaseVelocity(body, [0, 0, 0], [0, 0, 0], physicsClientId=self.client)
        pybullet.changeDynamics(body, -1, mass=0, physicsClientId=self.client)
        pybullet.setCollisionFilterGroupMask(body, -1, 0, 0, physicsClientId=self.client)

    def close(self) -> None:
        if self.client >= 0:
            pybullet.disconnect(physicsClientId=self.client)
            self.client = -1


def _divides(dt: float, count: int) -> bool:
    """Whether Bullet cuts `count * dt` seconds into just `count` steps of just `dt`: its rounding
    may make one step fewer."""
    return count > 1 and count * dt / count == dt and int(count * dt / dt) == count
