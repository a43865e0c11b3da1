"""`RobotGraspingEnv`: the Gymnasium interface of the robot cell, registered as `RobotGrasping-v0`.

A policy moves the Panda a little at a time and is rewarded for lifting an object. The module itself
is a demonstration: `python -m envs.grasping_env` lifts a cube and leaves a picture and a film.
"""

from __future__ import annotations

import functools
import os
import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.error import ClosedEnvironmentError, InvalidAction, ResetNeeded

from envs.cell import Cell, PhysicsError, require_arm
from envs.cell_layout import on_table
from envs.cell_scenes import make_scene
from envs.env_actions import (
    ActionDecoder,
    action_entries,
    checked_options,
    near_pose,
    pretraining_state,
)
from envs.env_observations import Observer, observed_names
from envs.env_rewards import SHORTEST_LIFT, RewardState, make_reward, progress
from envs.objects import ObjectSet, check_object_set, load_object_set
from envs.robot_kinematics import (
    JOINT_VELOCITY,
    UnreachableError,
    forward_kinematics,
    inverse_kinematics,
)
from envs.simulators import cell_class
from envs.studio import Studio
from utils.config import Config, load_config, with_settings
from utils.config_schema import ObjectsConfig
from utils.errors import UserError
from utils.plugins import is_import_path
from utils.runs import run_script

_STATES_PER_SCENE = 16  # of pretraining: a state is quicker to reach than a scene is to make


class RobotGraspingEnv(gymnasium.Env):
    """Lift an object from the table.

    **Observation**: a Dict of the entries that `observations` names.

    | entry                   | shape, dtype        | unit, frame | meaning                          |
    |-------------------------|---------------------|-------------|----------------------------------|
    | `rgb`                   | (H, W, 3) uint8     | 0..255      | colour image                     |
    | `depth`                 | (H, W, 1) float32   | m, along C z | 0 where unknown                 |
    | `state`                 | (15,) float32       | rad, rad/s, m | 7 joint positions, 7 joint velocities, gripper opening |
    | any numeric entry of `info` below | float32   |             | as a vector                      |

    With a config whose `rl.policy_observations` is set, such as configs/ppo.yaml, the entries are
    those, so that other libraries train on what the config's policy sees. Otherwise, and where
    `observations` is given by name, they are those of `env.observations`. H = W = `resolution`;
    `camera` chooses the camera, and `camera.depth_noise` of the config applies to its depth.

    **Action**: a Box in [-1, 1] whose entries depend on `control`. The default `ee` has 7 entries:
    a change of the hand's pose and the gripper, *not* seven joint angles. For joint angles use
    `control="joint"` with 8 entries.

    | `control`   | size | entries of the arm                           | unit of 1                    |
    |-------------|------|----------------------------------------------|------------------------------|
    | `ee`        | 7    | dx, dy, dz, rotation vector (3)              | `position_step` m, `rotation_step` rad |
    | `ee_planar` | 5    | dx, dy, dz, dyaw                             | `position_step` m, `rotation_step` rad |
    | `joint`     | 8    | changes of the 7 joint angles                | `joint_step` rad             |
    | all         |      | last entry, `gripper="opening"`: -1 closed, 1 open | half of the opening    |
    | all         |      | last entry, `gripper="change"`: of the opening | `gripper_step` m           |

    With `gripper="change"` the commanded opening stays within 20 mm of the true one. Directions are
    those of W, or with `frame="hand"` those of the commanded E, whose z is the approach. Changes
    add up on the *commanded* pose, stay within the workspace and the joint limits (at its limit the
    wrist turns no farther, and the hand still moves), and are scaled
    down as a whole where a joint would exceed its speed limit. The command stays where it is when
    the arm cannot reach the new one, when something holds the arm up, or when the new one lies
    outside the workspace box (`safety`). No joint exceeds 2.175 rad/s, the lowest of the Panda's
    joint speed limits; only the torque limits bound its acceleration.

    **Reward**: `reward="dense"` adds the terms below, `"sparse"` is the first one alone, and
    `"my_module:my_reward"` calls a function with an `envs.env_rewards.RewardState`. Scales of terms,
    such as `{"success": 1, "progress": 0.5, "my_module:my_term": 0.1}`, add these up.

    | term       | value                                    | scale |
    |------------|------------------------------------------|-------|
    | `success`  | 1 at success, else 0                     | 1     |
    | `progress` | Phi(after the action) - Phi(before)      | 1     |

        Phi = (1 - tanh(3 w) / 2 - tanh(20 w) / 2) / 4    while nothing is gripped
        Phi = (1 + h) / 2                                 while both fingers grip the object

    w is the way in metres that the hand has to go: with `goal="object"` to around the nearest
    object, with `"grasp"` to the nearest grasp that the only object offers. h in [0, 1] is how far
    the object has risen from where it rested at reset towards `lift_height`.

    **End**: success, when both fingers grip an object off the table, its centre above
    `lift_height`, for `hold_seconds` in a row (terminated); failure, when every object has left the
    table (`off_table`) or the physics has blown up (`physics`) (terminated); `max_steps` actions
    (truncated).

    **Info**:

    | entry                   | size | unit, frame | meaning                                          |
    |-------------------------|------|-------------|--------------------------------------------------|
    | `is_success`, `reason`  |      |             | success; why the episode ended, or None          |
    | `scene_seed`            |      |             | what the scene was made from                     |
    | `state`                 | 15   | rad, rad/s, m | as in the observation                          |
    | `end_effector_position` | 3    | m, W        | E                                                |
    | `gripper`               | 2    | m           | opening, commanded opening                       |
    | `opening_error`         | 1    | m           | opening - commanded: the fingers move or hold something |
    | `reachable`             | 1    |             | false where the arm could not follow the action  |
    |                         |      |             | *ground truth of the simulator from here on:*    |
    | `grasped`               | 1    |             | both fingers grip the nearest object             |
    | `object_position`       | 3    | m, W        | centre of the nearest object                     |
    | `object_offset`         | 6    | m, E axes   | from E to that centre; the same as tanh(m / 0.03), which resolves the last centimetres finely |
    | `object_outline`        | 9    | m           | `envs.env_rewards.OutlineView.vector`            |
    | `grasp_goal`            | 11   |             | `envs.env_rewards.GoalView.vector`, with `goal="grasp"` |

    **Parameters**: `render_mode`: None, "human" (a window, which needs a display, shows the physics
    as it runs) or "rgb_array" (`render` returns pictures). `config`: a Config, a YAML file, or None
    for the defaults. Any key of the config's section `env` can be given by name:
    `gymnasium.make("RobotGrasping-v0", observations=["state"], control="ee_planar")`. `cell`: act
    in this cell, which its owner loads scenes into and closes; `take_over` replaces `reset`.

    **Options of reset**: `scene_seed` asks for one scene. `start` says where the hand begins:
    "home"; "near" an object, up to 4 cm beside it in x and in y, and 1 to 10 cm over the highest
    thing in the scene, easier; or "pretraining", to train a state estimator: in any state that an
    episode of a single object may lead to, and in other scenes over the highest thing. Without a
    seed up to 16 such states in a row are at the same scene. Without `start` a share `near_share`
    of the episodes begins near. The attribute `start` is the option that begins there again.
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 12}

    def __init__(
        self,
        render_mode: str | None = None,
        config: Config | Path | str | None = None,
        cell: Cell | None = None,
        **settings: Any,
    ):
        self._closed = True  # until everything below has been built
        if settings.keys() & {"render", "gui"}:
            raise UserError(
                "RobotGraspingEnv: render and gui are one argument, render_mode: 'human' opens a "
                "window, 'rgb_array' makes render() return images"
            )
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise UserError(
                f"render_mode {render_mode!r} is unknown; allowed are None, 'human', 'rgb_array'"
            )
        config = config if isinstance(config, Config) else load_config(config)
        self.config = _camera_of_env(with_settings(config, "env", settings))
        self.settings = self.config.env
        require_arm(self.config, "RobotGraspingEnv")
        self.render_mode = render_mode
        self.metadata = self.metadata | {
            "render_fps": round(self.config.sim.frequency / self.settings.substeps)
        }
        names = observed_names(self.config, by_name="observations" in settings)
        self._hold_steps = self.settings.hold_steps(self.config.sim.frequency)
        # A borrowed cell is a judge's, and a reward of a user's own may need no success.
        if cell is None and not is_import_path(str(self.settings.reward)):
            self._check_time_to_hold()
        # Names and plug-ins are checked before a simulator starts.
        self._reward = make_reward(self.settings.reward)
        check_object_set(self.settings.objects, "env.objects")
        entries, camera = action_entries(self.settings.control), self.config.camera
        camera.make_noise(float(camera.height))
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
        self.cell = cell or cell_class(self.config.simulator)(
            self.config, gui=render_mode == "human"
        )
        self._studio: Studio | None = None
        self._running = False
        self._states_left = 0
        self.start: str | dict[str, Any] = "home"
        self._closed = False
        self._seen = Observer(self.cell, self.config, names)
        self.observation_space = self._seen.space
        size = len(entries)
        self.action_space = spaces.Box(-1.0, 1.0, (size,), np.float32)
        self._actions = ActionDecoder(self.config)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Start an episode on a new scene. See the class for observation and info."""
        if self._closed:
            raise ClosedEnvironmentError("reset() after close(): make a new environment")
        self._running = False
        super().reset(seed=seed)
        drawn = int(self.np_random.integers(2**31))
        asked, start = checked_options(options, self.config.gripper.max_opening)
        if start is None:
            share = self.settings.near_share
            start = "near" if share > 0 and self.np_random.random() < share else "home"
        again = start == "pretraining" and seed is None and asked is None
        self._states_left = self._states_left - 1 if again else 0
        if self._states_left <= 0:
            self._make_scene(drawn if asked is None else asked)
            self._states_left = _STATES_PER_SCENE if start == "pretraining" else 0
        self.start = start
        if start == "home":
            return self._begin(self.cell.home.copy())
        if isinstance(start, str):
            q, opening, command = self._initial_state(start)
        else:
            q, opening, command = np.array(start["q"]), start["opening"], start["command"]
        self.start = {"q": q.tolist(), "opening": float(opening), "command": float(command)}
        self.cell.robot.place(q, opening)
        return self._begin(q, command)

    def _make_scene(self, seed: int) -> None:
        self._scene_seed = seed
        scene = make_scene(self.settings.scenario, self.objects, seed, self.config)
        self.cell.load(scene)
        self._seen.begin_scene()
        self._sleeping = self.cell.enable_sleeping()  # until the robot touches something

    def take_over(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begin an episode in the cell as it is, the arm at rest; `hand_over` ends it."""
        self._scene_seed, self._sleeping = self.cell.scene.seed, False
        self._seen.begin_scene()
        return self._begin(self.cell.robot.q)

    def hand_over(self) -> None:
        """Let others move the arm again, as fast as it can."""
        self._running = False
        self.cell.robot.limit_speed(JOINT_VELOCITY.max())

    def _begin(
        self, q: np.ndarray, command: float | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begin an episode with the arm at joint positions q (7,) and a commanded opening in
        metres, None for as wide as it gets."""
        self._actions.begin(self.cell.robot, q, command)
        self._steps = 0
        self._held_steps = 0
        self._running = True
        self._read_cell()
        self._resting_heights = [position[2] for position in self._seen.positions]
        self._progress = progress(self._seen.grasped, *self._way_and_lift())
        info = self._info(None)
        return self._seen.observation(info), info

    def _initial_state(self, start: str) -> tuple[np.ndarray, float, float]:
        """Joint positions (7,), opening and commanded opening of a start "near" or "pretraining";
        the arm is at home where it does not reach the pose that was drawn."""
        T_home = forward_kinematics(self.cell.home)
        outlines, goals = self._seen.outlines, self._seen.goals
        index = int(self.np_random.integers(len(outlines)))
        T_WO = self.cell.object_pose(index)
        # Of all things: over its own object alone, the hand would be put into what is beside it.
        tops = [
            outline.seen_from(self.cell.object_pose(number), T_home).top + T_home[2, 3]
            for number, outline in enumerate(outlines)
        ]
        walls = self.cell.scene.walls
        top = max([*tops, *(wall.position[2] + wall.half_size[2] for wall in walls)])
        if start == "near":
            T = near_pose(T_home, T_WO[:2, 3], top, self.np_random)
            opening = command = self.config.gripper.max_opening
        else:
            goal = None
            if goals is not None:
                goal = goals.goal(self.np_random.integers(len(goals)), T_WO)
            T, opening, command = pretraining_state(
                T_home, T_WO[:2, 3], top, goal, self.config.gripper.max_opening, self.np_random
            )
            T[:3, 3] = np.clip(T[:3, 3], self._actions.lowest, self._actions.highest)
        try:
            return inverse_kinematics(T, self.cell.home, self.cell.home), opening, command
        except UnreachableError:
            return self.cell.home.copy(), opening, command

    def step(
        self, action: np.ndarray
    ) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Carry out one action for `substeps` physics steps. See the class for what comes back."""
        if self._closed:
            raise ClosedEnvironmentError("step() after close(): make a new environment")
        if not self._running:
            raise ResetNeeded("step() needs a running episode: call reset() first")
        self._states_left = 0  # an action may change the scene
        action = self._checked(action)
        if self.cell.on_action is not None:
            action = self.cell.on_action(action)
        self._actions.command(action, self._seen.state)
        self.cell.step(self.settings.substeps)
        self._steps += 1
        try:
            self.cell.check_solver()
            self._read_cell()
        except PhysicsError:
            self._running = False
            return self._seen.placeholder(), 0.0, True, False, self._info("physics")
        lifted = self._seen.grasped and self.cell.is_lifted(
            self._seen.nearest, self.settings.lift_height
        )
        self._held_steps = self._held_steps + 1 if lifted else 0
        success = self._held_steps >= self._hold_steps
        reward = self._reward(self._reward_state(action, success))
        reason = "success" if success else None if self._any_on_table() else "off_table"
        terminated = reason is not None
        truncated = not terminated and self._steps >= self.settings.max_steps
        if truncated:
            reason = "max_steps"
        self._running = not (terminated or truncated)
        info = self._info(reason)
        return self._seen.observation(info), reward, terminated, truncated, info

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

    def _check_time_to_hold(self) -> None:
        settings = self.settings
        if self._hold_steps > settings.max_steps:
            raise UserError(
                f"env.max_steps ({settings.max_steps}) ends every episode before an object can be "
                f"held for env.hold_seconds ({settings.hold_seconds:g}), which takes "
                f"{self._hold_steps} actions; set a larger env.max_steps or a smaller "
                "env.hold_seconds"
            )

    # --- Action -----------------------------------------------------------------------------

    def _checked(self, action: np.ndarray) -> np.ndarray:
        try:
            action = np.asarray(action, dtype=float)
        except (TypeError, ValueError) as error:
            raise InvalidAction(f"action {action!r} is not an array of numbers") from error
        if action.shape != self.action_space.shape:
            control = self.settings.control
            raise InvalidAction(
                f"action has shape {action.shape}; control={control!r} takes "
                f"{self.action_space.shape}: {', '.join(action_entries(control))}, each in [-1, 1]"
            )
        if abs(action).max() <= 1.0:
            return action
        if not np.isfinite(action).all():
            raise InvalidAction(f"action holds a non-finite number: {action.tolist()}")
        return np.minimum(np.maximum(action, -1.0), 1.0)

    # --- What happened ----------------------------------------------------------------------

    def _read_cell(self) -> None:
        self._seen.read()
        if self._seen.touches and self._sleeping:
            self.cell.disable_sleeping()
            self._sleeping = False

    def _way_and_lift(self) -> tuple[float, float]:
        """`way` and `lift` of a `RewardState`."""
        seen = self._seen
        rest = self._resting_heights[seen.nearest]
        whole = max(self.settings.lift_height - rest, SHORTEST_LIFT)
        lift = min(max((seen.object_position[2] - rest) / whole, 0.0), 1.0)
        return 0.0 if seen.grasped else seen.way(), lift

    def _reward_state(self, action: np.ndarray, success: bool) -> RewardState:
        seen, (way, lift) = self._seen, self._way_and_lift()
        before, self._progress = self._progress, progress(seen.grasped, way, lift)
        return RewardState(
            success=success,
            grasped=seen.grasped,
            way=way,
            lift=lift,
            progress=self._progress,
            progress_before=before,
            action=action,
            reachable=self._actions.reachable,
            opening=seen.opening,
            hand_position=seen.tip,
            object_position=seen.object_position,
        )

    def _any_on_table(self) -> bool:
        return any(on_table(position) for position in self._seen.positions)

    def _info(self, reason: str | None) -> dict[str, Any]:
        return {
            "is_success": reason == "success",
            "reason": reason,
            "scene_seed": self._scene_seed,
            **self._seen.info(self._actions.opening, self._actions.reachable),
        }


@functools.lru_cache(maxsize=4)
def _object_set(
    name: str, max_opening: float, cache_dir: Path, settings: ObjectsConfig
) -> ObjectSet:
    """One for all environments of a process: each object is made once, which takes a while."""
    return load_object_set(
        name, max_opening=max_opening, cache_dir=cache_dir, **settings.model_dump()
    )


def _camera_of_env(config: Config) -> Config:
    """The config with the cell's camera set to what the env observes with. Raises UserError."""
    side = config.env.resolution
    if config.env.camera == "wrist" and config.camera.view == "side":
        raise UserError(
            "camera.view=side places the overhead camera, but the environment observes with "
            "env.camera=wrist; set camera.view=fixed or env.camera=overhead"
        )
    return with_settings(
        config, "camera", {"mount": config.env.camera, "width": side, "height": side}
    )


if __name__ == "__main__":
    from envs.scripted_pick import main

    run_script(main)
