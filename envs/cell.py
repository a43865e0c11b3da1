"""The abstract robot cell and its cameras, whatever simulates them.

`envs.pybullet_cell` and `envs.mujoco_cell` implement `Cell`, `envs.pybullet_camera` and
`envs.mujoco_camera` implement `Camera`; the abstract robot is in `envs.robot`. Execution, closed
loops, scenarios, rounds and planners know a cell only as far as it is described here.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from typing_extensions import Self

from envs.board import Board
from envs.cell_layout import EMPTY, TRAY_HEIGHT, Box, Scene, on_table, side_view
from envs.robot import Robot
from envs.robot_kinematics import JOINT_LOWER, JOINT_UPPER, tip_position
from envs.robot_safety import ArmGate
from utils.config import Config
from utils.config_schema import CameraConfig
from utils.config_types import changed_in
from utils.depth import seeded_noise
from utils.domain_randomization import Randomizable
from utils.errors import UserError
from utils.geometry import (
    HANGS_FROM,
    TRAY_CENTRE,
    TRAY_HALF_SIZE,
    TRAY_WALL,
    SceneGeometry,
    SolidObject,
)
from utils.random_streams import Stream
from utils.random_view import RandomView
from utils.transforms import RGBDFrame, look_at, transform_points

# The light of every picture that names no other. The keys are those of PyBullet's getCameraImage:
# lightDirection points towards the light, lightDistance is in metres, shadow is 0 or 1.
DEFAULT_LIGHT = {
    "lightDirection": (0.3, -0.4, 1.0),
    "lightColor": (1.0, 1.0, 1.0),
    "lightDistance": 2.0,
    "lightAmbientCoeff": 0.55,
    "lightDiffuseCoeff": 0.45,
    "lightSpecularCoeff": 0.05,
    "shadow": 0,
}


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera without distortion. width, height in pixels; fov_deg is vertical;
    near and far bound the depths that are seen, in metres."""

    width: int
    height: int
    fov_deg: float
    near: float = 0.1
    far: float = 2.0

    @property
    def K(self) -> np.ndarray:
        """(3, 3) pinhole matrix; square pixels; integer coordinates at pixel centres."""
        focal = self.height / 2 / np.tan(np.radians(self.fov_deg) / 2)
        return np.array(
            [
                [focal, 0.0, (self.width - 1) / 2],
                [0.0, focal, (self.height - 1) / 2],
                [0.0, 0.0, 1.0],
            ]
        )


@dataclass(frozen=True)
class Image:
    """rgb (H, W, 3) uint8; depth (H, W) float32 metres along the optical axis, 0 where nothing is
    nearer than the far plane; bodies (H, W) int32 the simulator's body numbers, -1 for none."""

    rgb: np.ndarray
    depth: np.ndarray
    bodies: np.ndarray


class Camera(ABC):
    """Renders one simulated cell from any pose."""

    @abstractmethod
    def render(self, intrinsics: Intrinsics, T_WC: np.ndarray, light: dict | None = None) -> Image:
        """The image of a camera at T_WC (4, 4); `light` changes entries of DEFAULT_LIGHT."""

    def render_rgb(
        self, intrinsics: Intrinsics, T_WC: np.ndarray, light: dict | None = None
    ) -> np.ndarray:
        """(H, W, 3) uint8 colours of that image alone, which may take less time."""
        return self.render(intrinsics, T_WC, light).rgb

    def close(self) -> None:  # noqa: B027 - not every renderer holds resources
        """Free what the renderer holds; may be called again."""


def camera_intrinsics(camera: CameraConfig) -> Intrinsics:
    """The configured camera's intrinsics; the wrist camera has a field of view of its own."""
    fov = camera.fov_deg if camera.mount == "overhead" else camera.wrist_fov_deg
    return Intrinsics(camera.width, camera.height, fov, camera.near, camera.far)


def wrist_mount(camera: CameraConfig) -> np.ndarray:
    """(4, 4) T_EC: the wrist camera beside the hand, its optical axis along the approach."""
    T = np.eye(4)
    # Image right is E's +y, the closing line; at home image up points away from the robot.
    T[:3, :3] = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    T[:3, 3] = camera.wrist_position
    return T


TABLE_OR_BACKGROUND, ROBOT = -1, -2  # in RGBDFrame.segmentation
# An object farther than this share of the workspace's side from its centre is out of the round.
_REACH = 0.63
_HIDDEN_DEPTH = 0.5  # m under the table, where no camera sees an object


class PhysicsError(RuntimeError):
    """The simulation has diverged: a position is not finite."""


class Cell(ABC):
    """A simulated robot cell. Close it, or use it in a `with` block.

    gui: show the cell in a window. dt: s, a physics step. home: (7,) rad. gripper: the robot's
    hand. has_arm: whether an arm carries it. robot, camera: see `envs.robot.Robot`, in whose place
    a cell without an arm has an `envs.floating_hand.FloatingHand`, and `envs.cell.Camera`. bodies:
    the simulator's numbers of the objects. remaining: numbers of the objects still in the round.
    steps, frames, observations: taken since the scene was built; planners see frames, policies
    observations. Callbacks, each called with the cell: on_build when a scene has been built and
    nothing has moved yet, before_step before every physics step (to disturb the objects), on_step
    after it (to film). view: changes what cameras see; None changes nothing.
    sample: the randomisation drawn for this scene alone (`utils.domain_randomization`), None for a
    nominal cell. on_action: changes each action of a policy that moves the hand step by step; None
    leaves it as it is. taught: (4, 4) T_CE that `envs.scenarios.teach` has measured with this
    cell's wrist camera; None before.
    """

    robot: Robot
    camera: Camera
    bodies: list[int]

    def __init__(self, config: Config, gui: bool = False):
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
        self.gripper = config.gripper.geometry
        self.has_arm = config.robot.arm != "none"
        self.scene: Scene | None = None
        self.remaining: set[int] = set()
        self.steps = self.frames = self.observations = 0
        self.on_build: Callable[[Any], object] | None = None
        self.before_step: Callable[[Any], None] | None = None
        self.on_step: Callable[[Any], None] | None = None
        self.view: RandomView | None = None
        self.sample: dict[str, Any] | None = None
        self.on_action: Callable[[np.ndarray], np.ndarray] | None = None
        self.taught: np.ndarray | None = None

    # --- Scene --------------------------------------------------------------------------------

    def load(self, scene: Scene) -> None:
        """Build the scene and let its objects come to rest."""
        self.build(scene)
        self._settle()

    def build(self, scene: Scene) -> None:
        """Rebuild the cell from nothing and put the scene's objects at their poses.

        Rebuilding makes a round independent of the ones before it.
        """
        self._rebuild(scene)

    def show_board(self, board: Board, T_WO: np.ndarray, scene: Scene = EMPTY) -> None:
        """Rebuild the cell with a board that stays at T_WO (4, 4), and no objects but a scene's."""
        self._rebuild(scene, board, T_WO)

    def _rebuild(
        self, scene: Scene, board: Board | None = None, T_WO: np.ndarray | None = None
    ) -> None:
        self.scene = scene
        self._build(scene, board, T_WO)
        self.remaining = set(range(len(self.bodies)))
        self.steps = self.frames = self.observations = 0
        if self.on_build is not None:
            self.on_build(self)

    @abstractmethod
    def _build(self, scene: Scene, board: Board | None, T_WO: np.ndarray | None) -> None:
        """Make table, tray, robot (at home, wide open), objects and perhaps a board at T_WO (4, 4);
        sets `robot` and `bodies`."""

    @abstractmethod
    def _settle(self) -> None:
        """Simulate until the objects rest, for at most scene.settle_seconds; counts no steps."""

    def _new_gate(self) -> ArmGate:
        config = self.config
        return ArmGate(config.safety, config.robot, self.dt, config.closed_loop.floor)

    def detailed_twin(self) -> Cell | None:
        """A new cell with detailed visual meshes, for pictures; None in a simulator whose cell
        shows all that there is. `mirror` has it show the state of another cell. Close it."""
        return None

    @abstractmethod
    def randomizable(self) -> Randomizable:
        """The scene as built, whose physics and colours can be changed: the same object until the
        next build."""

    @abstractmethod
    def close(self) -> None:
        """Free what the simulator holds; may be called again."""

    # --- Physics ------------------------------------------------------------------------------

    @property
    def hanging(self) -> list[Box]:
        """What hangs over the table in the scene."""
        walls = self.scene.walls if self.scene else ()
        return [wall for wall in walls if wall.position[2] - wall.half_size[2] > HANGS_FROM]

    @property
    def seconds(self) -> float:
        """Simulated seconds since the scene was loaded."""
        return self.steps * self.dt

    def step(self, count: int = 1) -> None:
        """Advance the physics by `count` steps of 1 / sim.frequency seconds."""
        if self.on_step is None and self.before_step is None:
            self._advance(count)
            self.steps += count
            return
        for _ in range(count):
            if self.before_step is not None:
                self.before_step(self)
            self._advance(1)
            self.steps += 1
            if self.on_step is not None:
                self.on_step(self)

    @abstractmethod
    def _advance(self, count: int) -> None:
        """Simulate `count` physics steps."""

    def enable_sleeping(self) -> bool:
        """Let objects at rest sleep, which saves the solver's time until the robot touches
        something; returns whether they do. `disable_sleeping` has to be called at the first touch.
        MuJoCo's cell lets them sleep always, and needs neither.
        """
        return False

    def disable_sleeping(self) -> None:  # noqa: B027 - MuJoCo wakes by itself
        """Undo `enable_sleeping`."""

    def check_physics(self) -> None:
        """Raise PhysicsError if a position of the robot or of an object is not finite, and as
        `check_solver` does."""
        if not np.isfinite(self.robot.q).all():
            raise PhysicsError("the robot's joint positions are not finite")
        for index in self.remaining:
            self.object_position(index)
        self.check_solver()

    def check_solver(self) -> None:  # noqa: B027 - most have nothing to say
        """Raise PhysicsError where the solver warns of numbers that are still finite."""

    # --- Objects ------------------------------------------------------------------------------

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
        """Put an object's body frame at T_WO (4, 4), moving at `velocity` (3,) m/s and turning at
        `turn_rate` rad/s about +z of W."""

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

    def retire(self, index: int) -> None:
        """Take an object out of the round: it collides no more. It stays visible where all of it
        lies in the tray; else it is put out of sight, under the table, as a camera would show a
        planner what no hand can touch."""
        self.remaining.discard(index)
        T = self.object_pose(index)
        if not self._in_tray(index, T):
            T[:3, 3] = *self.config.workspace.center, -_HIDDEN_DEPTH
            self.carry(index, T, np.zeros(3), 0.0)
        self._immobilise(index)

    def _in_tray(self, index: int, T_WO: np.ndarray) -> bool:
        """Whether an object at T_WO (4, 4) lies within the tray's sides, not in the air."""
        assert self.scene is not None  # there is an object
        corners = np.concatenate(self.scene.placements[index].model.parts)
        corners = transform_points(T_WO, corners)
        away, low = np.abs(corners[:, :2] - TRAY_CENTRE).max(), corners[:, 2].min()
        return bool(away <= TRAY_HALF_SIZE + TRAY_WALL and abs(low) <= TRAY_HEIGHT)

    @abstractmethod
    def _immobilise(self, index: int) -> None:
        """Fix an object where it is; nothing collides with it any more."""

    def retire_lost_objects(self) -> list[int]:
        """Retire the objects that fell off the table or left the camera's reach; their numbers."""
        lost = [i for i in sorted(self.remaining) if not self._within_reach(i)]
        for index in lost:
            self.retire(index)
        return lost

    def _within_reach(self, index: int) -> bool:
        # The camera sees a margin around the workspace, so an object that rolled a little way out
        # is still in the round; one behind the robot or off the table is not.
        position = self.object_position(index)
        margin = abs(position[:2] - self.config.workspace.center).max()
        return on_table(position) and margin <= _REACH * self.config.workspace.size

    def truth(self) -> SceneGeometry:
        """The true geometry of the objects still in the round, and of the scene's walls; frictions
        are those of the fingertips on each object, as the cell may have been randomised."""
        if self.scene is None:
            raise ValueError("There is no scene; build or load one first")
        solids, changes = [], {} if self.sample is None else self.sample["physics"]
        fingers = changed_in(changes, "finger_friction", 1.0)
        for index in sorted(self.remaining):
            model, T = self.scene.placements[index].model, self.object_pose(index)
            solids.append(
                SolidObject(
                    tuple(solid.transformed(T) for solid in model.geometry()),
                    T[:3, 3],
                    fingers * changed_in(changes, "object_friction", model.friction, index),
                )
            )
        return SceneGeometry(tuple(solids), walls=tuple(wall.solid() for wall in self.scene.walls))

    # --- Camera -------------------------------------------------------------------------------

    def camera_pose(
        self, mount: str | None = None, camera: CameraConfig | None = None
    ) -> np.ndarray:
        """(4, 4) T_WC of the overhead or the wrist camera; a scene may place the overhead one.
        camera: another one than the config's."""
        camera = camera or self.config.camera
        if (mount or camera.mount) == "overhead":
            if camera.view == "side":
                if self.scene is None:
                    raise ValueError(
                        "A side view follows the scene's seed; build or load a scene first"
                    )
                return side_view(camera, self.config.workspace, self.scene.seed)
            fixed = (self.scene and self.scene.viewpoint) or camera
            return look_at(fixed.position, fixed.target, fixed.up)
        return self.robot.encoder_pose() @ wrist_mount(camera)

    def frame(self, with_truth: bool = False) -> RGBDFrame:
        """The configured camera's frame; `with_truth` adds the true geometry.

        `camera.depth_noise` changes the depth alone. It is a function of the scene's seed and the
        number of frames since it was loaded, so that every policy meets the same.
        """
        camera = self.config.camera
        frame = self.look(camera_intrinsics(camera), self.camera_pose(), with_truth)
        noise = camera.make_noise(float(frame.K[0, 0]))
        if noise is not None:
            if self.scene is None:
                raise ValueError(
                    "Depth noise follows the scene's seed; build or load a scene first"
                )
            measure = seeded_noise(noise, Stream.PLANNING_NOISE, self.scene.seed, self.frames)
            frame = replace(frame, depth=measure(frame.depth, frame.rgb))
        self.frames += 1
        return frame

    def look(
        self,
        intrinsics: Intrinsics,
        T_WC: np.ndarray,
        with_truth: bool = False,
        light: dict | None = None,
    ) -> RGBDFrame:
        """The frame of a camera at T_WC (4, 4), without noise; `light` changes entries of
        `envs.cell.DEFAULT_LIGHT`."""
        image = self.image(intrinsics, T_WC, light)
        truth = self.truth() if with_truth else None
        fixtures = () if self.scene is None else self.scene.fixtures
        return RGBDFrame(
            image.rgb, image.depth, intrinsics.K, T_WC, self._segmentation(image), truth, fixtures
        )

    def image(self, intrinsics: Intrinsics, T_WC: np.ndarray, light: dict | None = None) -> Image:
        """The image of `look`, without a frame around it.

        With a `view`, the image is taken with changed intrinsics, pose and light, while the frame
        reports the unchanged ones, as a camera does that has moved since its calibration.
        """
        view = self.view
        if view is None:
            return self.camera.render(intrinsics, T_WC, light)
        view.begin_frame()
        intrinsics = replace(intrinsics, fov_deg=intrinsics.fov_deg * view.fov_scale)
        T_WC = T_WC @ view.T_CC
        light = DEFAULT_LIGHT | (light or {})
        image = self.camera.render(intrinsics, T_WC, view.lit(light))
        rgb, depth = view.develop(image.rgb, image.depth, image.bodies, intrinsics.K, T_WC)
        return replace(image, rgb=rgb, depth=depth)

    def _segmentation(self, image: Image) -> np.ndarray:
        """(H, W) int32 numbers of objects, TABLE_OR_BACKGROUND or ROBOT."""
        most = max(*self.robot.links, *self.bodies, int(image.bodies.max()))
        number_of = np.full(most + 2, TABLE_OR_BACKGROUND, dtype=np.int32)
        number_of[self.robot.links] = ROBOT
        number_of[self.bodies] = range(len(self.bodies))
        return number_of[image.bodies]  # -1, no body, is the extra last one

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


def require_arm(config: Config, what: str) -> None:
    """Raise UserError where the cell has a hand without an arm."""
    if config.robot.arm == "none":
        raise UserError(f"robot.arm=none: {what} needs the whole arm; set robot.arm=panda")


def _box(config: Config) -> tuple[list[float], list[float]]:
    return list(config.safety.box_lower), list(config.safety.box_upper)
