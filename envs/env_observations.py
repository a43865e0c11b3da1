"""What `RobotGraspingEnv` measures after every action: observations and the numbers of info.

`Observer` reads the robot, the nearest object and the camera of a cell. `OBSERVATIONS` lists the
entries that an observation may hold; the environment's docstring gives their units and frames. This
module knows neither actions nor rewards.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from gymnasium import spaces

from envs.cell import Cell, PhysicsError, camera_intrinsics, wrist_mount
from envs.env_rewards import GraspGoals, Outline
from envs.robot_kinematics import JOINT_LOWER, JOINT_UPPER, JOINT_VELOCITY
from utils.config import Config
from utils.depth import seeded_noise
from utils.errors import unknown_choice
from utils.random_streams import Stream
from utils.transforms import known_depth

# Entries of info that can be observed, and their sizes.
INFO_OBSERVATIONS = {
    "state": 15, "end_effector_position": 3, "gripper": 2, "opening_error": 1, "reachable": 1,
    "grasped": 1,
    "object_position": 3, "object_offset": 6, "object_outline": 9, "grasp_goal": 11,
}  # fmt: skip
OBSERVATIONS = ("rgb", "depth", *INFO_OBSERVATIONS)

_NEAR = 0.03  # m, the scale of the tanh in `object_offset`
_JOINT_SLACK = 0.1  # rad: the motors may overshoot a limit a little
_OPENING_SLACK = 0.01  # m
# An object that has tipped over offers other grasps: it leans this much, and moves this slowly.
_LEANING, _STILL = 0.2, 0.05  # rad, m/s


def observed_names(config: Config, by_name: bool) -> tuple[str, ...]:
    """The entries of an observation: those of rl.policy_observations where the config has some,
    else those of env.observations, which count in any case if `by_name`. Raises UserError."""
    policy = config.rl.policy_observations
    if by_name or policy is None:
        key, names = "env.observations", config.env.observations
    else:
        key, names = "rl.policy_observations", policy
    known = [name for name in OBSERVATIONS if config.env.goal == "grasp" or name != "grasp_goal"]
    for name in names:
        if name not in known:
            raise unknown_choice(key, name, known)
    return tuple(names)


class Observer:
    """Reads a cell for an environment of this config, whose observations have the entries `names`.

    Until `read` has been called there is nothing to know. Then: state: (15,) float32, as in the
    observation. T_WE: (4, 4); tip: (3,) m, E in W. positions: of all objects, (3,) m in W each.
    nearest: index of the object nearest to E, object_position its place. view: its outline, and
    goal_view the nearest grasp that it offers, both relative to the hand. touches: whether the
    robot touches anything. grasped: whether both fingers grip the nearest object.
    """

    def __init__(self, cell: Cell, config: Config, names: tuple[str, ...]):
        self._cell, self._names = cell, names
        self._wrist, self._with_goals = config.env.camera == "wrist", config.env.goal == "grasp"
        self._intrinsics = camera_intrinsics(config.camera)
        self._T_EC = wrist_mount(config.camera)
        self._camera = config.camera
        self._depth_noise = config.camera.make_noise(float(self._intrinsics.K[0, 0]))
        widest = config.gripper.max_opening + _OPENING_SLACK
        low = np.concatenate([JOINT_LOWER - _JOINT_SLACK, -2 * JOINT_VELOCITY, [-_OPENING_SLACK]])
        high = np.concatenate([JOINT_UPPER + _JOINT_SLACK, 2 * JOINT_VELOCITY, [widest]])
        self._low, self._high = low.astype(np.float32), high.astype(np.float32)
        side = config.env.resolution
        boxes = {
            "rgb": spaces.Box(0, 255, (side, side, 3), np.uint8),
            "depth": spaces.Box(0.0, config.camera.far, (side, side, 1), np.float32),
        }
        for name, size in INFO_OBSERVATIONS.items():
            boxes[name] = spaces.Box(-np.inf, np.inf, (size,), np.float32)
        boxes["state"] = spaces.Box(self._low, self._high, dtype=np.float32)
        self.space = spaces.Dict({name: boxes[name] for name in names})

    def begin_scene(self) -> None:
        """Measure the objects of the scene that the cell now holds."""
        placements = self._cell.scene.placements
        self.outlines = [Outline(placement.model.parts) for placement in placements]
        self.goals = self._find_goals() if self._with_goals else None

    def _find_goals(self) -> GraspGoals:
        return GraspGoals(self._cell.truth(), self._cell.object_pose(0), self._cell.gripper)

    def read(self) -> None:
        """Read the robot and the nearest object. Raises PhysicsError on a non-finite number."""
        cell = self._cell
        state = cell.robot.state()
        if not math.isfinite(sum(state)):
            raise PhysicsError("the robot's state is not finite")
        self.state = np.array(state, np.float32)
        self.T_WE = cell.robot.tip_pose()
        self.tip = self.T_WE[:3, 3]
        poses = [cell.object_pose(i) for i in range(len(cell.bodies))]
        positions = [T_WO[:3, 3] for T_WO in poses]
        distances = [math.dist(position, self.tip) for position in positions]
        if not math.isfinite(sum(distances)):
            raise PhysicsError("an object's position is not finite")
        self.nearest = nearest = distances.index(min(distances))
        self.positions, self.object_position = positions, positions[nearest]
        T_WO = poses[nearest]
        self.view = self.outlines[nearest].seen_from(T_WO, self.T_WE)
        self.touches = cell.robot.touches()
        self.grasped = self.touches and cell.robot.holds(cell.bodies[nearest])
        if self.goals is not None:
            leaning = not self.grasped and self.goals.tilt(T_WO) > _LEANING
            if leaning and cell.speed(nearest) < _STILL:
                self.goals = self._find_goals()
            self.goal_view = self.goals.seen_from(T_WO, self.T_WE)

    @property
    def opening(self) -> float:
        """Distance between the fingertips in metres."""
        return float(self.state[14])

    def way(self) -> float:
        """Metres that the hand has to go to a grasp, see `envs.env_rewards.way_to_grasp`."""
        view = self.view if self.goals is None else self.goal_view
        return view.way(self.opening)

    def info(self, commanded_opening: float, reachable: bool) -> dict[str, Any]:
        """The numbers of info. commanded_opening: m. reachable: of the last action."""
        offset = np.empty(6)
        offset[:3] = self.view.offset
        np.tanh(self.view.offset / _NEAR, out=offset[3:])
        info = {
            "state": np.minimum(np.maximum(self.state, self._low), self._high),
            "object_position": self.object_position,
            "object_offset": offset,
            "object_outline": self.view.vector(),
            "gripper": np.array([self.state[14], commanded_opening]),
            "opening_error": np.array([self.state[14] - commanded_opening]),
            "end_effector_position": self.tip,
            "grasped": self.grasped,
            "reachable": reachable,
        }
        if self.goals is not None:
            info["grasp_goal"] = self.goal_view.vector()
        return info

    def observation(self, info: dict[str, Any]) -> dict[str, np.ndarray]:
        """What a policy sees; its numbers come from `info`, its images from the camera now."""
        found: dict[str, np.ndarray] = {}
        if "rgb" in self._names or "depth" in self._names:
            found["rgb"], found["depth"] = self._images()
        for name in self._names:
            if name in INFO_OBSERVATIONS:
                found[name] = np.atleast_1d(np.asarray(info[name], np.float32))
        return {name: found[name] for name in self._names}

    def _images(self) -> tuple[np.ndarray, np.ndarray]:
        """(H, W, 3) colours and (H, W, 1) metres, 0 where a noise leaves none or one beyond
        camera.far. The depth noise is a function of the scene's seed and the number of images since
        the scene was built."""
        if self._wrist:
            T_WC = self.T_WE @ self._T_EC
        else:
            T_WC = self._cell.camera_pose(camera=self._camera)
        image = self._cell.image(self._intrinsics, T_WC)
        seed, stream = self._cell.scene.seed, Stream.OBSERVATION_NOISE
        measure = seeded_noise(self._depth_noise, stream, seed, self._cell.observations)
        self._cell.observations += 1
        depth = np.asarray(measure(image.depth, image.rgb), np.float32)
        within = known_depth(depth) & (depth <= self._camera.far)
        return image.rgb, np.where(within, depth, np.float32(0))[..., None]

    def placeholder(self) -> dict[str, np.ndarray]:
        """An observation within its space for the end of an episode whose physics failed."""
        return {
            name: np.zeros(space.shape, space.dtype).clip(space.low, space.high)
            for name, space in self.space.items()
        }
