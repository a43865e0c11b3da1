"""The robot cell in PyBullet: one physics client with table, bin, Panda, objects and camera.

Labelling, evaluation, demos and the Gymnasium env all run in this one cell. It knows how to
build and observe the world; what to do in it is for others to say.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pybullet

from envs.board import Board
from envs.cell import (
    ROBOT,
    TABLE_OR_BACKGROUND,
    Cell,
    PhysicsError,
    camera_intrinsics,
    wrist_mount,
)
from envs.cell_layout import SOLVER_RESIDUAL, add_bin, add_table, set_up_physics
from envs.cell_scenes import EMPTY, Scene, settle
from envs.objects import spawn
from envs.pybullet_camera import DEFAULT_LIGHT, Image, Intrinsics, load_renderer, render
from envs.pybullet_panda import Panda, panda_urdf
from utils.config import Config
from utils.errors import UserError
from utils.random_view import RandomView
from utils.transforms import position_quaternion

__all__ = [
    "ROBOT", "TABLE_OR_BACKGROUND", "PybulletCell", "PhysicsError", "camera_intrinsics", "wrist_mount",
]  # fmt: skip

# As SOLVER_RESIDUAL, while the robot touches nothing: a last correction of 1 mrad/s.
_CALM_RESIDUAL = 1e-6
_CALM_LOOKS = 5  # 0.2 s, in which a body that topples gets ten times as fast


class PybulletCell(Cell):
    """A simulated robot cell.

    `fine` loads the detailed visual meshes, for pictures; physics is the same. `on_build` is called
    with the cell when a scene has been built and nothing has moved yet; `view` changes what cameras
    see. Close it, or use it in a `with` block.
    """

    def __init__(self, config: Config, fine: bool = False, gui: bool = False):
        super().__init__(config)
        if config.simulator != "pybullet":
            raise UserError(
                f"simulator={config.simulator}: only evaluate.py can score policies there; leave it out, "
                "or set simulator=pybullet"
            )
        self.fine = fine
        self.on_build: Callable[[PybulletCell], None] | None = None
        self.view: RandomView | None = None
        self._gui = gui
        self.client = pybullet.connect(pybullet.GUI if gui else pybullet.DIRECT)
        self.renderer = load_renderer(self.client, config.sim.renderer)
        self._urdf = panda_urdf(config.cache_folder, fine)

    def load(self, scene: Scene) -> None:
        """Build the scene and let its objects come to rest."""
        self.build(scene)
        settle(self.client, self.bodies, self.config)

    def build(self, scene: Scene) -> None:
        """Rebuild the world from nothing and put the scene's objects at their poses.

        Rebuilding is what makes a round independent of the ones before it: resetting states alone
        leaves the solver's memory behind (bullet3 #2442). It takes about 8 ms and leaks nothing.
        """
        self.scene = scene
        set_up_physics(self.client, self.config.sim)
        self.table = add_table(self.client)
        self.bin = add_bin(self.client)
        grip_force = self.config.robot.grip_force
        self.robot = Panda(self.client, self.dt, self._urdf, grip_force, self._new_gate())
        self.robot.place(self.home)
        self.bodies = [
            spawn(self.client, p.model, p.position, p.quaternion, fine=self.fine)
            for p in scene.placements
        ]
        self._index_of_body = {body: i for i, body in enumerate(self.bodies)}
        self.remaining = set(range(len(self.bodies)))
        self.steps = 0
        self.frames = 0
        if self.on_build is not None:
            self.on_build(self)

    def show_board(self, board: Board, T_WO: np.ndarray) -> None:
        self.build(EMPTY)
        board.add(self.client, T_WO)

    def step(self, count: int = 1) -> None:
        """Advance the physics by `count` steps of 1 / sim.frequency seconds."""
        while count > 0:
            part = self.robot.receive(count)
            self._advance(part)
            count -= part

    def _advance(self, count: int) -> None:
        client, on_step, before_step = self.client, self.on_step, self.before_step
        watched = on_step is not None or before_step is not None or self._gui
        if not watched and _divides(self.dt, count):
            # The same steps in one call. The time step is set only for that call, because motor
            # commands and contact forces are converted by it.
            pybullet.setPhysicsEngineParameter(
                fixedTimeStep=count * self.dt, numSubSteps=count, physicsClientId=client
            )
            pybullet.stepSimulation(physicsClientId=client)
            pybullet.setPhysicsEngineParameter(
                fixedTimeStep=self.dt, numSubSteps=0, physicsClientId=client
            )
            self.steps += count
            return
        for _ in range(count):
            if before_step is not None:
                before_step(self)
            pybullet.stepSimulation(physicsClientId=client)
            self.steps += 1
            if on_step is not None:
                on_step(self)

    def calm(self) -> bool:
        """Spare the solver until the robot touches something; whether the objects are at rest,
        without which nothing is done. `wake` has to be called at the first touch.

        The objects sleep, which is to lie still at no cost until something hits them; and the
        solver stops a little earlier, which moves a free arm's joints by less than 0.5 mrad.
        """
        if not settle(self.client, self.bodies, self.config, looks=_CALM_LOOKS):
            return False
        sleep = pybullet.ACTIVATION_STATE_ENABLE_SLEEPING | pybullet.ACTIVATION_STATE_SLEEP
        self._set_activation(sleep, _CALM_RESIDUAL)
        return True

    def wake(self) -> None:
        """Undo `calm`: an object at rest in the hand must not fall asleep and hang in the air."""
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
        return position, quaternion

    def speed(self, index: int) -> float:
        velocity, _ = pybullet.getBaseVelocity(self.bodies[index], physicsClientId=self.client)
        return math.hypot(*velocity)

    def carry(self, index: int, T_WO: np.ndarray, velocity: np.ndarray, turn_rate: float) -> None:
        body, client = self.bodies[index], self.client
        position, quaternion = position_quaternion(T_WO)
        pybullet.resetBasePositionAndOrientation(body, position, quaternion, physicsClientId=client)
        pybullet.resetBaseVelocity(body, velocity, [0, 0, turn_rate], physicsClientId=client)

    def touches_table(self, index: int) -> bool:
        contacts = pybullet.getContactPoints(
            self.bodies[index], self.table, physicsClientId=self.client
        )
        return bool(contacts)

    def retire(self, index: int) -> None:
        """Take an object out of the game: it stays visible where it is but collides no more."""
        body = self.bodies[index]
        self.remaining.discard(index)
        # A body without mass keeps its velocity and would drift away.
        pybullet.resetBaseVelocity(body, [0, 0, 0], [0, 0, 0], physicsClientId=self.client)
        pybullet.changeDynamics(body, -1, mass=0, physicsClientId=self.client)
        pybullet.setCollisionFilterGroupMask(body, -1, 0, 0, physicsClientId=self.client)

    def image(self, intrinsics: Intrinsics, T_WC: np.ndarray, light: dict | None = None) -> Image:
        """What `look` sees, without a frame around it. With a `view`, the camera is really where
        that has it, and what is reported of it stays as it is here: it was calibrated so."""
        view = self.view
        if view is None:
            return render(self.client, intrinsics, T_WC, self.renderer, light)
        view.begin_frame()
        intrinsics = replace(intrinsics, fov_deg=intrinsics.fov_deg * view.fov_scale)
        T_WC = T_WC @ view.T_CC
        light = DEFAULT_LIGHT | (light or {})
        image = render(self.client, intrinsics, T_WC, self.renderer, view.lit(light))
        rgb, depth = view.develop(image.rgb, image.depth, image.bodies, intrinsics.K, T_WC)
        return replace(image, rgb=rgb, depth=depth)

    def _segmentation(self, image: Image) -> np.ndarray:
        segmentation = np.full(image.bodies.shape, TABLE_OR_BACKGROUND, dtype=np.int32)
        segmentation[image.bodies == self.robot.body] = ROBOT
        for body, index in self._index_of_body.items():
            segmentation[image.bodies == body] = index
        return segmentation

    def close(self) -> None:
        if self.client >= 0:
            pybullet.disconnect(physicsClientId=self.client)
            self.client = -1


def _divides(dt: float, count: int) -> bool:
    """Whether Bullet, told to cut `count * dt` seconds into `count` steps, makes just that many of
    just `dt`: where rounding is against it, it makes one fewer."""
    return count > 1 and count * dt / count == dt and int(count * dt / dt) == count
