"""`RandomizedGraspingEnv`: the grasping task in a cell that changes with every episode.

Registered as `RandomizedGrasping-v0`. `utils.domain_randomization` draws the changes from the
config's section `randomization`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from envs.grasping_env import RobotGraspingEnv
from utils.atomic_files import append_line
from utils.domain_randomization import DomainRandomizer
from utils.errors import UserError


class RandomizedGraspingEnv(RobotGraspingEnv):
    """`RobotGraspingEnv` whose every episode has physics and an appearance of its own.

    info at reset has the episode's sample as `randomization`.
    `reset(options={"randomization": sample})` replays it; together with the scene's seed, the
    `start` and the same actions that gives the same episode bit for bit. That holds for episodes
    that began with a new scene: the starts "pretraining" share some, and noise depends on how many
    images of a scene were taken before.

    journal: file to which every finished episode appends a line of JSON, None for none. A line
    holds `is_success` and the options that repeat the episode: `scene_seed`, `start` and
    `randomization`. Environments may share one (`utils.atomic_files.append_line`). A step raises
    UserError where the line cannot be written, as on a full disk.
    """

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        try:
            self.randomizer = DomainRandomizer(self.cell, self.config.randomization)
        except UserError:
            super().close()  # nobody else can
            raise
        self._callbacks = self.cell.on_build, self.cell.on_action  # of a borrowed cell's owner
        self._recorded: Mapping[str, Any] | None = None
        self.journal: Path | None = None
        self.cell.on_build = self._randomize
        self.cell.on_action = self.randomizer.act

    def _randomize(self, cell: Any) -> None:
        if self._recorded is None:
            self.randomizer.randomize(int(self.np_random.integers(2**31)))
        else:
            self.randomizer.replay(self._recorded)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        options = dict(options or {})
        self._recorded = options.pop("randomization", None)
        if self._recorded is not None:
            self._states_left = 0  # a sample is put into effect as a scene is built
        observation, info = super().reset(seed=seed, options=options)
        return observation, info | {"randomization": self.randomizer.sample}

    def step(
        self, action: np.ndarray
    ) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = super().step(action)
        if (terminated or truncated) and self.journal is not None:
            self._append_to_journal(info)
        return observation, reward, terminated, truncated, info

    def close(self) -> None:
        """As `RobotGraspingEnv.close`. A borrowed cell, which has to be open still, becomes nominal
        and gets back the callbacks that it had before."""
        if self._borrowed and not self._closed:
            self.randomizer.restore()
            self.cell.on_build, self.cell.on_action = self._callbacks
        super().close()

    def _append_to_journal(self, info: Mapping[str, Any]) -> None:
        line = {name: info[name] for name in ("is_success", "scene_seed")}
        line |= {"start": self.start, "randomization": self.randomizer.sample}
        append_line(self.journal, json.dumps(line, allow_nan=False) + "\n")
