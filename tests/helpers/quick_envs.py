"""Small environments for tests of reinforcement learning: some to learn, some that misbehave."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import gymnasium
import numpy as np
from gymnasium import spaces

# Settings of a short training on PointEnv.
POINT = [
    "rl.env_id=tests.helpers.quick_envs:QuickPoint-v0", "rl.envs=2", "rl.rollout_steps=16",
    "rl.batch_size=16", "rl.total_steps=192", "rl.evaluate_every=2", "rl.evaluation_episodes=3",
    "rl.hidden_dim=8", "rl.device=cpu", "rl.parallel=false", "rl.epochs=2",
]  # fmt: skip


class PointEnv(gymnasium.Env):
    """Move a point in the plane to a goal: an episode is ten steps long, or ends within 0.1 of it.

    images: show the goal as a bright pixel in 16 x 16 `rgb` and `depth` instead, and be content
    with 0.2. `goal` is in info. trouble: what happens at step 3 of the third episode; "lost" kills
    one process, once, as soon as there is a checkpoint.
    """

    def __init__(self, images: bool = False, trouble: str | None = None):
        boxes = {"state": spaces.Box(-np.inf, np.inf, (4,), np.float32)}
        if images:
            boxes = {
                "rgb": spaces.Box(0, 255, (16, 16, 3), np.uint8),
                "depth": spaces.Box(0.0, 2.0, (16, 16, 1), np.float32),
                "state": spaces.Box(-np.inf, np.inf, (2,), np.float32),
            }
        self.observation_space = spaces.Dict(boxes)
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self._images, self._trouble, self._episodes = images, trouble, 0
        self._near = 0.2 if images else 0.1

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._position = np.zeros(2)
        self._goal = self.np_random.uniform(-1, 1, 2)
        self._steps = 0
        self._episodes += 1
        return self._observation(), self._info()

    def step(self, action):
        before = self._distance()
        self._position = self._position + 0.3 * np.clip(action, -1, 1)
        self._steps += 1
        reward, observation = before - self._distance(), self._observation()
        if self._episodes == 3 and self._steps == 3:
            if self._trouble == "raise":
                raise OddError("the table is gone", lambda: None)
            if self._trouble == "die":
                os._exit(7)
            if self._trouble == "hang":
                time.sleep(600)
            if self._trouble == "reward":
                reward = float("nan")
            if self._trouble == "observation":
                observation["state"][1] = np.inf
            if self._trouble == "keys":
                observation["velocity"] = observation.pop("state")
            if self._trouble == "shape":
                observation["state"] = observation["state"][:1]
        if self._trouble == "lost" and any(Path().glob("runs/*/*/last.pt")):
            self._lose_one_process()
        terminated = self._distance() < self._near
        return observation, reward, terminated, self._steps >= 10, self._info()

    def _lose_one_process(self) -> None:
        try:
            Path("lost").touch(exist_ok=False)
        except FileExistsError:
            return
        os.kill(os.getpid(), signal.SIGKILL)

    def _distance(self) -> float:
        return float(np.linalg.norm(self._goal - self._position))

    def _info(self):
        return {
            "is_success": self._distance() < self._near,
            "goal": self._goal.copy(),
            "name": "point",
        }

    def _observation(self):
        if not self._images:
            return {"state": np.concatenate([self._position, self._goal]).astype(np.float32)}
        rgb, depth = np.zeros((16, 16, 3), np.uint8), np.ones((16, 16, 1), np.float32)
        row, column = ((self._goal + 1) / 2 * 15.999).astype(int)
        rgb[row, column] = 200, 100, 50
        depth[row, column] = 0.5
        return {"rgb": rgb, "depth": depth, "state": self._position.astype(np.float32)}


class OddError(Exception):
    """It cannot be pickled, as errors of simulators may not be."""


class FlatEnv(gymnasium.Wrapper):
    """PointEnv with a plain Box of observations."""

    def __init__(self):
        super().__init__(PointEnv())
        self.observation_space = self.env.observation_space["state"]

    def reset(self, **arguments):
        observation, info = self.env.reset(**arguments)
        return observation["state"], info

    def step(self, action):
        observation, *rest = self.env.step(action)
        return observation["state"], *rest


class Discrete(gymnasium.Env):
    """Has actions that no Gaussian can choose."""

    observation_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
    action_space = spaces.Discrete(3)


class Unbounded(PointEnv):
    """Takes any action."""

    def __init__(self):
        super().__init__()
        self.action_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)


for name, env in (
    ("Point", PointEnv), ("Flat", FlatEnv), ("Discrete", Discrete), ("Unbounded", Unbounded),
):  # fmt: skip
    gymnasium.register(id=f"Quick{name}-v0", entry_point=env)
