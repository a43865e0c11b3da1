"""What is the same in every world's cell: cameras, frames, truth, which objects are in the game.

`envs.pybullet_cell` builds the cell in PyBullet, `envs.mujoco_cell` in MuJoCo. Execution, closed loops,
disturbances, rounds and planners know a cell only as far as it is described here.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from envs.board import Board
from envs.cell_layout import on_table
from envs.cell_scenes import Scene
from envs.pybullet_camera import Image, Intrinsics
from envs.robot_kinematics import JOINT_LOWER, JOINT_UPPER, forward_kinematics, tip_position
from envs.robot_safety import ArmGate
from utils.config import CameraConfig, Config
from utils.depth import make_depth_noise
from utils.errors import UserError
from utils.geometry import SceneGeometry, SolidObject
from utils.transforms import RGBDFrame, look_at

TABLE_OR_BACKGROUND, ROBOT = -1, -2  # in RGBDFrame.segmentation
# An object farther than this share of the workspace's side from its centre is out of the game.
_REACH = 0.63
# Keeps the depth noise of a seed apart from the scene of the same seed.
_DEPTH_NOISE_STREAM = 1


class PhysicsError(RuntimeError):
    """The simulation left the realm of finite numbers."""


class Cell(ABC):
    """A simulated robot cell, whatever simulates it. Close it, or use it in a `with` block.

    dt: s, a physics step. home: (7,) rad. client: PyBullet's number, None in another world. robot:
    has the interface of `envs.pybullet_panda.Panda`. bodies: the simulator's numbers of the objects.
    remaining: numbers of the objects still in the game. steps, frames: taken since the scene was
    built. on_step is called after every physics step with the cell (used to film), before_step
    before it (used to disturb the objects). sample: what was drawn for this scene alone
    (`utils.domain_randomization`), None for a nominal cell. on_action: what becomes of each action
    of a policy that moves the hand in turns; None: it is carried out as it is.
    """

    client: int | None = None

    def __init__(self, config: Config):
        self.config = config
        self.dt = 1.0 / config.sim.frequency
        self.home = np.array(config.robot.home)
        if (self.home < JOINT_LOWER).any() or (self.home > JOINT_UPPER).any():
            raise UserError(
                f"robot.home {list(config.robot.home)} is outside the Panda's joint limits, "
                f"{JOINT_LOWER.tolist()} to {JOINT_UPPER.tolist()} rad"
            )
        tip, lower, upper = tip_position(config.robot.home), *_box(config)
        if not all(low <= place <= high for place, low, high in zip(tip, lower, upper)):
            raise UserError(
                f"robot.home has the fingertips at {[round(at, 3) for at in tip]} m, outside the "
                f"box from safety.box_lower {lower} to safety.box_upper {upper}: the arm could not "
                "come back there; widen the box"
            )
        config.make_cache_folder()
        self.scene: Scene | None = None
        self.remaining: set[int] = set()
        self.steps = self.frames = 0
        self.on_step: Callable[[Cell], None] | None = None
        self.before_step: Callable[[Cell], None] | None = None
        self.sample: dict[str, Any] | None = None
        self.on_action: Callable[[np.ndarray], np.ndarray] | None = None

    def _new_gate(self) -> ArmGate:
        config = self.config
        return ArmGate(config.safety, config.robot, self.dt, config.closed_loop.floor)

    @abstractmethod
    def load(self, scene: Scene) -> None:
        """Build the scene and let its objects come to rest."""

    @abstractmethod
    def build(self, scene: Scene) -> None:
        """Rebuild the world from nothing and put the scene's objects at their poses."""

    @abstractmethod
    def show_board(self, board: Board, T_WO: np.ndarray) -> None:
        """Rebuild the world with nothing in it but what every scene has and a board that stays at
        T_WO (4, 4)."""

    @abstractmethod
    def step(self, count: int = 1) -> None:
        """Advance the physics by `count` steps of 1 / sim.frequency seconds."""

    def calm(self) -> bool:
        """Spare the simulator until the robot touches something, if it knows how; whether it does.
        `wake` has to be called at the first touch."""
        return False

    def wake(self) -> None:  # noqa: B027 - there is nothing to undo where nothing was spared
        """Undo `calm`."""

    @abstractmethod
    def object_pose(self, index: int) -> np.ndarray:
        """(4, 4) pose in W of an object's body frame (its origin is the centre of mass)."""

    @abstractmethod
    def object_position(self, index: int) -> np.ndarray:
        """(3,) centre of mass in W. Raises PhysicsError when it is not finite."""

    @abstractmethod
    def speed(self, index: int) -> float:
        """m/s of an object's centre of mass."""

    @abstractmethod
    def carry(self, index: int, T_WO: np.ndarray, velocity: np.ndarray, turn_rate: float) -> None:
        """Put an object's body frame at T_WO (4, 4), on its way at `velocity` (3,) m/s and turning
        at `turn_rate` rad/s about +z of W; physics has it from there."""

    @abstractmethod
    def touches_table(self, index: int) -> bool:
        """Whether an object and the table are in contact."""

    def held_object(self) -> int | None:
        """The object that both fingers grip, or None."""
        return next((i for i in sorted(self.remaining) if self.robot.holds(self.bodies[i])), None)

    def is_lifted(self, index: int, height: float) -> bool:
        """Whether an object is gripped, off the table, and its centre of mass above `height` m."""
        return bool(
            self.object_position(index)[2] > height
            and self.robot.holds(self.bodies[index])
            and not self.touches_table(index)
        )

    @abstractmethod
    def retire(self, index: int) -> None:
        """Take an object out of the game: it stays visible where it is but collides no more."""

    @abstractmethod
    def image(self, intrinsics: Intrinsics, T_WC: np.ndarray, light: dict | None = None) -> Image:
        """What `look` sees, without a frame around it."""

    @abstractmethod
    def close(self) -> None:
        """Free what the simulator holds; may be called again."""

    @abstractmethod
    def _segmentation(self, image: Image) -> np.ndarray:
        """(H, W) int32 numbers of objects, TABLE_OR_BACKGROUND or ROBOT."""

    @property
    def seconds(self) -> float:
        """Simulated seconds since the scene was loaded."""
        return self.steps * self.dt

    def check_physics(self) -> None:
        """Raise PhysicsError if the robot or an object has left the realm of finite numbers."""
        if not np.isfinite(self.robot.q).all():
            raise PhysicsError("the robot's joint positions are not finite")
        for index in self.remaining:
            self.object_position(index)

    def retire_lost_objects(self) -> list[int]:
        """Retire the objects that fell off the table or left the camera's reach; their numbers."""
        lost = [i for i in sorted(self.remaining) if not self._within_reach(i)]
        for index in lost:
            self.retire(index)
        return lost

    def _within_reach(self, index: int) -> bool:
        # The camera sees a margin around the workspace, so an object that rolled a little way out
        # is still in the game; one behind the robot or off the table is not.
        position = self.object_position(index)
        margin = abs(position[:2] - self.config.workspace.center).max()
        return on_table(position) and margin <= _REACH * self.config.workspace.size

    def camera_pose(self, mount: str | None = None) -> np.ndarray:
        """(4, 4) T_WC of the overhead or the wrist camera."""
        camera = self.config.camera
        if (mount or camera.mount) == "overhead":
            return look_at(camera.position, camera.target, camera.up)
        return forward_kinematics(self.robot.q) @ wrist_mount(camera)

    def frame(self, with_truth: bool = False) -> RGBDFrame:
        """What the configured camera sees now; `with_truth` adds the true geometry.

        `camera.depth_noise` changes the depth alone. It is a function of the scene's seed and the
        number of frames since it was loaded, so that every policy meets the same.
        """
        camera = self.config.camera
        frame = self.look(camera_intrinsics(camera), self.camera_pose(), with_truth)
        focal = float(frame.K[0, 0])
        noise = make_depth_noise(camera.depth_noise, focal, camera.depth_noise_args)
        if noise is not None:
            rng = np.random.default_rng([self.scene.seed, self.frames, _DEPTH_NOISE_STREAM])
            frame = replace(frame, depth=noise(frame.depth, rng))
        self.frames += 1
        return frame

    def look(
        self,
        intrinsics: Intrinsics,
        T_WC: np.ndarray,
        with_truth: bool = False,
        light: dict | None = None,
    ) -> RGBDFrame:
        """What a camera at T_WC (4, 4) sees now, without noise; `light` as in
        `envs.pybullet_camera.render`."""
        image = self.image(intrinsics, T_WC, light)
        truth = self.truth() if with_truth else None
        return RGBDFrame(
            image.rgb, image.depth, intrinsics.K, T_WC, self._segmentation(image), truth
        )

    def truth(self) -> SceneGeometry:
        """The true geometry of the objects still in the game."""
        solids = []
        for index in sorted(self.remaining):
            model, T = self.scene.placements[index].model, self.object_pose(index)
            solids.append(
                SolidObject(
                    tuple(solid.transformed(T) for solid in model.geometry()),
                    T[:3, 3],
                    model.friction,
                )
            )
        return SceneGeometry(tuple(solids))

    def __enter__(self):
        return self

    def __exit__(self, *exception) -> None:
        self.close()


def camera_intrinsics(camera: CameraConfig) -> Intrinsics:
    """The configured camera's intrinsics; the wrist camera has a field of view of its own."""
    fov = camera.fov_deg if camera.mount == "overhead" else camera.wrist_fov_deg
    return Intrinsics(camera.width, camera.height, fov, camera.near, camera.far)


def wrist_mount(camera: CameraConfig) -> np.ndarray:
    """(4, 4) T_EC: the wrist camera beside the hand, looking along the approach."""
    T = np.eye(4)
    # Image right is E's +y, the closing line; at home image up points away from the robot.
    T[:3, :3] = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    T[:3, 3] = camera.wrist_position
    return T


def _box(config: Config) -> tuple[list[float], list[float]]:
    return list(config.safety.box_lower), list(config.safety.box_upper)
