"""`RobotGraspingEnv`: the Gymnasium face of the robot cell, registered as `RobotGrasping-v0`.

A policy moves the Panda a little at a time and is rewarded for lifting an object. A demonstration
that needs no display is `python -m envs.scripted_pick`.
"""

from __future__ import annotations

import functools
import math
import os
import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.error import ClosedEnvironmentError, InvalidAction, ResetNeeded

from envs import env_actions
from envs.camera import camera_intrinsics, wrist_mount
from envs.cell import PhysicsError
from envs.cell_layout import on_table
from envs.cell_scenes import make_scene
from envs.env_actions import HandCommands
from envs.env_rewards import Outline
from envs.grasp_goals import GraspGoals
from envs.objects import ObjectSet, load_object_set
from envs.pybullet_cell import PybulletCell
from envs.robot_kinematics import (
    JOINT_LOWER,
    JOINT_UPPER,
    JOINT_VELOCITY,
    UnreachableError,
    forward_kinematics,
    inverse_kinematics,
)
from envs.studio import Studio
from utils.config import Config, load_config, with_settings
from utils.config_schema import ObjectsConfig
from utils.errors import UserError

_SHORTEST_LIFT = 0.05  # m, for the reward of objects that rest near the lift height already
_LOOKS = 16  # from as many places at each scene: a place is quicker to reach than a scene to make
_NEAR = 0.03  # m, see `object_offset`
# An object that has tipped over, which offers other grasps: leaning this much, and this slow.
_LEANING, _STILL = 0.2, 0.05  # rad, m/s


class RobotGraspingEnv(gymnasium.Env):
    """Lift an object from the table.

    Observation: a Dict with any of `rgb` (H, W, 3) uint8; `depth` (H, W, 1) float32 metres, 0 where
    unknown; `state` (15,) float32: joint positions (7, rad), joint velocities (7, rad/s), gripper
    opening (m).

    Action: a Box in [-1, 1]. Its last entry is the gripper's: with `gripper` "opening" the target
    opening itself (-1 closed, 1 open); with "change" a change of the commanded opening in units of
    `gripper_step` metres, so that what the hand does lasts and noise does not make it flutter. The
    command is held within 20 mm of the true opening. The other entries are the arm's.
    `ee`: dx, dy, dz in units of `position_step` metres, and a rotation vector in units of
    `rotation_step` radians, both along the axes of W, or with `frame` "hand" along those of the
    commanded E, whose z is the approach. `ee_planar`: dx, dy, dz, dyaw. `joint`: seven changes in
    units of `joint_step` radians. Changes add up on the *commanded* pose, are held within the
    workspace and the joint limits, and are scaled down as a whole where a joint would have to
    exceed its velocity limit. The command stays where it is when the arm cannot reach the new
    one, is held up by something on its way, or would leave the workspace box (`safety`).
    No joint is faster than the Panda's lowest joint speed limit, 2.175 rad/s, at any physics step;
    the torque limits alone bound its acceleration.

    Reward (`dense`): 1 at success, plus the change of a progress measure, r = [success] + Phi(s')
    - Phi(s), with the stages of ManiSkill's PickCube. An episode's sum telescopes to [success] +
    Phi(end) - Phi(start), so that lingering half-way earns nothing. (It has the form of Ng, Harada
    and Russell's shaping, ICML 1999, but without their discount and with Phi(end) paid out, so
    their proof of policy invariance does not apply.)

        Phi = (1 - tanh(3 w) / 2 - tanh(20 w) / 2) / 4    while nothing is gripped
        Phi = (1 + h) / 2                                 while both fingers grip the object

    where w is the way in metres that the hand has to go: with `goal` "object" to be around the
    nearest object, see `envs.env_rewards`; with "grasp" to the nearest grasp that the only object
    offers, see `envs.grasp_goals`; and h in [0, 1] is how far the object has risen from where it
    rested at reset towards `lift_height`. The two tanh pay for coming near from afar, and for the
    last centimetre.

    `sparse`: 1 at success, else 0.

    Success: an object gripped by both fingers, off the table, its centre above `lift_height` for
    `hold_seconds` in a row. Termination: success; or failure, when every object has left the table
    (`off_table`) or the physics has blown up (`physics`). Truncation: `max_steps` actions.

    info: `is_success`, `reason` (why the episode ended, or None), `end_effector_position` (3,),
    `gripper` (2,), its opening and what is commanded (m), `squeeze` (1,), by how much it is wider
    than commanded: it moves, or holds something (m), `reachable` (False where the action was
    refused), `scene_seed`; and what no robot is told: `grasped`, `object_position` (3,), and of the
    same nearest object `object_offset` (6,), from E to its centre along E's axes, in metres and as
    tanh(metres / 0.03), which tells the last centimetres finely, and `object_outline` (9,), see
    `envs.env_rewards`; with `goal` "grasp" also `grasp_goal` (11,), see `envs.grasp_goals`.

    Parameters: `render_mode`: None, "human" (a window) or "rgb_array". `config`: a Config, a YAML
    file, or None for the defaults. Any key of the config's `env` section can be given by name:
    `gymnasium.make("RobotGrasping-v0", observations=["state"], control="ee_planar")`. `cell`: play
    in this one, which others load scenes into and close, by `take_over` instead of `reset`.
    `reset(options={"scene_seed": n})` asks for one scene; the option "start" says where the hand
    begins: "home"; "near" an object, 1 to 10 cm over it and up to 4 cm beside it, which is easier;
    or "look", anywhere that an episode may lead to, to learn to see from: up to 16 looks one after
    the other, without a seed, are at the same scene. Without it a share `near_share` of the
    episodes begins near. The attribute `start` is the option that begins there again.
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 12}

    def __init__(
        self,
        render_mode: str | None = None,
        config: Config | Path | str | None = None,
        cell: PybulletCell | None = None,
        **settings: Any,
    ):
        self._closed = True  # until everything below has been built
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise UserError(
                f"render_mode {render_mode!r} is unknown; allowed are None, 'human', 'rgb_array'"
            )
        config = config if isinstance(config, Config) else load_config(config)
        self.config = _camera_of_env(with_settings(config, "env", settings))
        self.settings = self.config.env
        self.render_mode = render_mode
        self.metadata = self.metadata | {
            "render_fps": round(self.config.sim.frequency / self.settings.substeps)
        }
        self.objects = _object_set(
            self.settings.objects, self.config.gripper.max_opening, self.config.cache_folder,
            self.config.objects,
        )  # fmt: skip
        if render_mode == "human" and sys.platform == "linux" and not os.environ.get("DISPLAY"):
            raise UserError(
                "render_mode='human' opens a window and there is no display here; "
                "use render_mode='rgb_array'"
            )
        self._borrowed = cell is not None
        self.cell = cell or PybulletCell(self.config, gui=render_mode == "human")
        self._studio: Studio | None = None
        self._running = False
        self._looks_left = 0
        self.start: str | dict[str, Any] = "home"
        self._closed = False
        self._intrinsics = camera_intrinsics(self.config.camera)
        self._T_EC = wrist_mount(self.config.camera)
        self.observation_space = spaces.Dict(self._observation_spaces())
        size = {"ee": 7, "ee_planar": 5, "joint": 8}[self.settings.control]
        self.action_space = spaces.Box(-1.0, 1.0, (size,), np.float32)
        self._hold_steps = max(
            1,
            round(self.settings.hold_seconds * self.config.sim.frequency / self.settings.substeps),
        )
        self._hand = HandCommands(self.config)

    def _observation_spaces(self) -> dict[str, spaces.Space]:
        side = self.settings.resolution
        slack = 0.1  # rad: the motors may overshoot a limit a little
        low = np.concatenate([JOINT_LOWER - slack, -2 * JOINT_VELOCITY, [-0.01]])
        high = np.concatenate([JOINT_UPPER + slack, 2 * JOINT_VELOCITY, [self.config.gripper.max_opening + 0.01]])
        self._state_low, self._state_high = low.astype(np.float32), high.astype(np.float32)
        everything = {
            "rgb": spaces.Box(0, 255, (side, side, 3), np.uint8),
            "depth": spaces.Box(0.0, self.config.camera.far, (side, side, 1), np.float32),
            "state": spaces.Box(self._state_low, self._state_high, dtype=np.float32),
        }
        return {name: everything[name] for name in self.settings.observations}

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Start an episode on a new scene. See the class for observation and info."""
        if self._closed:
            raise ClosedEnvironmentError("reset() after close(): make a new environment")
        self._running = False
        super().reset(seed=seed)
        drawn = int(self.np_random.integers(2**31))
        asked, start = _checked_options(options)
        if start is None:
            share = self.settings.near_share
            start = "near" if share > 0 and self.np_random.random() < share else "home"
        again = start == "look" and seed is None and asked is None
        self._looks_left = self._looks_left - 1 if again else 0
        if self._looks_left <= 0:
            self._make_scene(drawn if asked is None else asked)
            self._looks_left = _LOOKS if start == "look" else 0
        self.start = start
        if start == "home":
            return self._begin(self.cell.home.copy())
        if isinstance(start, str):
            q, opening, command = self._start_hand(start)
            self.start = {"q": q.tolist(), "opening": float(opening), "command": float(command)}
        else:
            q, opening, command = np.array(start["q"]), start["opening"], start["command"]
        self.cell.robot.place(q, opening)
        return self._begin(q, command)

    def _make_scene(self, seed: int) -> None:
        self._scene_seed = seed
        scene = make_scene(self.settings.scenario, self.objects, seed, self.config)
        self.cell.load(scene)
        self._know_the_objects()
        self._sleeping = self.cell.enable_sleeping()  # until the robot touches something, `_look`

    def take_over(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begin an episode in the cell as it is, the arm at rest; `hand_over` gives it back."""
        self._scene_seed, self._sleeping = self.cell.scene.seed, False
        self._know_the_objects()
        return self._begin(self.cell.robot.q)

    def hand_over(self) -> None:
        """Let others move the arm again, as fast as it can."""
        self._running = False
        self.cell.robot.limit_speed(JOINT_VELOCITY.max())

    def _know_the_objects(self) -> None:
        placements = self.cell.scene.placements
        self._outlines = [Outline(placement.model.parts) for placement in placements]
        self._goals = self._goals_now() if self.settings.goal == "grasp" else None

    def _begin(
        self, q: np.ndarray, command: float | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begin an episode with the arm at joint positions q (7,) and the gripper commanded to open
        by so many metres; None: as wide as it gets."""
        self._hand.begin(self.cell.robot, q, command)
        self._steps = 0
        self._held_steps = 0
        self._running = True
        self._look()
        self._resting_heights = [position[2] for position in self._object_positions]
        self._potential = self._progress()
        if self.render_mode == "human":
            self.render()
        return self._observation(), self._info(None)

    def _start_hand(self, start: str) -> tuple[np.ndarray, float, float]:
        """Joint positions (7,), opening and commanded opening to begin with: "near" one of the
        objects, or to "look" at one from; at home where the arm does not reach what was drawn."""
        T_home = forward_kinematics(self.cell.home)
        index = int(self.np_random.integers(len(self._outlines)))
        T_WO = self.cell.object_pose(index)
        top = self._outlines[index].seen_from(T_WO, T_home).top + T_home[2, 3]
        if start == "near":
            T = env_actions.near(T_home, T_WO[:2, 3], top, self.np_random)
            opening = command = self.config.gripper.max_opening
        else:
            grasp = None
            if self._goals is not None:
                grasp = self._goals.grasp(self.np_random.integers(len(self._goals)), T_WO)
            T, opening, command = env_actions.look(
                T_home, T_WO[:2, 3], top, grasp, self.config.gripper.max_opening, self.np_random
            )
            T[:3, 3] = np.clip(T[:3, 3], self._hand.lowest, self._hand.highest)
        try:
            return inverse_kinematics(T, self.cell.home, self.cell.home), opening, command
        except UnreachableError:
            return self.cell.home.copy(), opening, command

    def _goals_now(self) -> GraspGoals:
        return GraspGoals(self.cell.truth(), self.cell.object_pose(0), self.cell.gripper)

    def step(
        self, action: np.ndarray
    ) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Carry out one action for `substeps` physics steps. See the class for what comes back."""
        if self._closed:
            raise ClosedEnvironmentError("step() after close(): make a new environment")
        if not self._running:
            raise ResetNeeded("step() needs a running episode: call reset() first")
        self._looks_left = 0  # an action may change the scene
        action = self._checked(action)
        if self.cell.on_action is not None:
            action = self.cell.on_action(action)
        self._hand.command(action, self._state)
        self.cell.step(self.settings.substeps)
        self._steps += 1
        try:
            self._look()
        except PhysicsError:
            self._running = False
            return self._blown_up(), 0.0, True, False, self._info("physics")
        lifted = self._grasped and self.cell.is_lifted(self._nearest, self.settings.lift_height)
        self._held_steps = self._held_steps + 1 if lifted else 0
        success = self._held_steps >= self._hold_steps
        reward = float(success)
        if self.settings.reward == "dense":
            before, self._potential = self._potential, self._progress()
            reward += self._potential - before
        reason = "success" if success else None if self._any_on_table() else "off_table"
        terminated = reason is not None
        truncated = not terminated and self._steps >= self.settings.max_steps
        if truncated:
            reason = "max_steps"
        self._running = not (terminated or truncated)
        if self.render_mode == "human":
            self.render()
        return self._observation(), reward, terminated, truncated, self._info(reason)

    def render(self) -> np.ndarray | None:
        """A (480, 640, 3) uint8 picture with detailed meshes in "rgb_array" mode, else None (the
        window of "human" mode shows the physics as it runs)."""
        if self.render_mode != "rgb_array":
            return None
        if self._closed:
            raise ClosedEnvironmentError("render() after close(): make a new environment")
        if self.cell.scene is None:
            raise ResetNeeded("render() needs a scene: call reset() first")
        if self._studio is None:
            self._studio = Studio(self.cell)
        return self._studio.picture()

    def close(self) -> None:
        """Disconnect from the physics. Calling it again does nothing."""
        if not self._closed:
            self._closed = True
            if self._studio is not None:
                self._studio.close()
            if not self._borrowed:
                self.cell.close()

    def get_gripper_width(self) -> float:
        """Distance between the fingertips in metres."""
        if self._closed:
            raise ClosedEnvironmentError("get_gripper_width() after close()")
        if self.cell.scene is None:
            raise ResetNeeded("get_gripper_width() needs a robot: call reset() first")
        return self.cell.robot.opening

    # --- Action -----------------------------------------------------------------------------

    def _checked(self, action: np.ndarray) -> np.ndarray:
        try:
            action = np.asarray(action, dtype=float)
        except (TypeError, ValueError) as error:
            raise InvalidAction(f"action {action!r} is not an array of numbers") from error
        if action.shape != self.action_space.shape:
            raise InvalidAction(
                f"action has shape {action.shape}; control={self.settings.control!r} takes "
                f"{self.action_space.shape}, each entry in [-1, 1]"
            )
        if abs(action).max() <= 1.0:
            return action
        if not np.isfinite(action).all():
            raise InvalidAction(f"action holds a non-finite number: {action.tolist()}")
        return np.minimum(np.maximum(action, -1.0), 1.0)

    # --- What happened ----------------------------------------------------------------------

    def _look(self) -> None:
        """Read the robot and the nearest object. Raises PhysicsError on a non-finite number."""
        cell = self.cell
        state = cell.robot.state()
        self._state = np.array(state, np.float32)
        if not math.isfinite(sum(state)):
            raise PhysicsError("the robot's state is not finite")
        self._T_WE = cell.robot.tip_pose()
        self._tip = self._T_WE[:3, 3]
        poses = [cell.object_pose(i) for i in range(len(cell.bodies))]
        positions = [T_WO[:3, 3] for T_WO in poses]
        distances = [math.dist(position, self._tip) for position in positions]
        self._nearest = nearest = distances.index(min(distances))
        self._object_positions, self._object_position = positions, positions[nearest]
        T_WO = poses[nearest]
        self._view = self._outlines[nearest].seen_from(T_WO, self._T_WE)
        touches = cell.robot.touches()
        if touches and self._sleeping:
            cell.disable_sleeping()
            self._sleeping = False
        self._grasped = touches and cell.robot.holds(cell.bodies[nearest])
        if self._goals is not None:
            leaning = not self._grasped and self._goals.tilt(T_WO) > _LEANING
            if leaning and cell.speed(nearest) < _STILL:
                self._goals = self._goals_now()
            self._goal_view = self._goals.seen_from(T_WO, self._T_WE)

    def _progress(self) -> float:
        """The potential Phi in [0, 1]; see the class."""
        if not self._grasped:
            view = self._view if self._goals is None else self._goal_view
            way = view.way_to_grasp(float(self._state[14]))
            return 0.25 - (math.tanh(3.0 * way) + math.tanh(20.0 * way)) / 8
        rest = self._resting_heights[self._nearest]
        way = max(self.settings.lift_height - rest, _SHORTEST_LIFT)
        lift = min(max((self._object_position[2] - rest) / way, 0.0), 1.0)
        return float((1.0 + lift) / 2)

    def _any_on_table(self) -> bool:
        return any(on_table(position) for position in self._object_positions)

    def _observation(self) -> dict[str, np.ndarray]:
        observation = {}
        if "rgb" in self.settings.observations or "depth" in self.settings.observations:
            wrist = self.settings.camera == "wrist"
            T_WC = self._T_WE @ self._T_EC if wrist else self.cell.camera_pose()
            image = self.cell.image(self._intrinsics, T_WC)
            observation = {"rgb": image.rgb, "depth": image.depth[..., None]}
        observation["state"] = np.minimum(
            np.maximum(self._state, self._state_low), self._state_high
        )
        return {name: observation[name] for name in self.settings.observations}

    def _blown_up(self) -> dict[str, np.ndarray]:
        """An observation within its space for the end of an episode whose physics failed."""
        return {
            name: np.zeros(space.shape, space.dtype).clip(space.low, space.high)
            for name, space in self.observation_space.items()
        }

    def _info(self, reason: str | None) -> dict[str, Any]:
        offset = np.empty(6)
        offset[:3] = self._view.offset
        np.tanh(self._view.offset / _NEAR, out=offset[3:])
        info = {
            "is_success": reason == "success",
            "reason": reason,
            "object_position": self._object_position,
            "object_offset": offset,
            "object_outline": self._view.outline(),
            "gripper": np.array([self._state[14], self._hand.opening]),
            "squeeze": np.array([self._state[14] - self._hand.opening]),
            "end_effector_position": self._tip,
            "grasped": self._grasped,
            "reachable": self._hand.reachable,
            "scene_seed": self._scene_seed,
        }
        if self._goals is not None:
            info["grasp_goal"] = self._goal_view.told()
        return info


def _checked_options(
    options: dict[str, Any] | None,
) -> tuple[int | None, str | dict[str, Any] | None]:
    """The scene's seed that reset's options ask for, and where to start; None for what they leave
    open. Raises UserError."""
    options = dict(options or {})
    seed, start = options.pop("scene_seed", None), options.pop("start", None)
    if options:
        raise UserError(
            f"reset: unknown option {next(iter(options))!r}; allowed are 'scene_seed' and 'start', "
            "and for RandomizedGrasping-v0 'randomization' and 'ranges'"
        )
    known = set(start) == {"q", "opening", "command"} if isinstance(start, dict) else False
    if not known and start not in (None, "home", "near", "look"):
        raise UserError(
            f"reset: start must be 'home', 'near', 'look' or an episode's own (q, opening and "
            f"command), got {start!r}"
        )
    if seed is None:
        return None, start
    if not isinstance(seed, (int, np.integer)) or isinstance(seed, bool) or seed < 0:
        raise UserError(f"reset: scene_seed must be a whole number of at least 0, got {seed!r}")
    return int(seed), start


@functools.lru_cache(maxsize=4)
def _object_set(
    name: str, max_opening: float, cache_dir: Path, settings: ObjectsConfig
) -> ObjectSet:
    """One for all environments of a process: each object is made once, which takes a while."""
    return load_object_set(
        name, max_opening=max_opening, cache_dir=cache_dir, **settings.model_dump()
    )


def _camera_of_env(config: Config) -> Config:
    """The config with the cell's camera set to what the env observes with."""
    side = config.env.resolution
    return with_settings(
        config, "camera", {"mount": config.env.camera, "width": side, "height": side}
    )
