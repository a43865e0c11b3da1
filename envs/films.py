"""Films of episodes, for any Gymnasium environment that renders "rgb_array"."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import imageio
import numpy as np

_HOLD = 6  # pictures for which the last one stays


def film_episode(
    env: gymnasium.Env, act: Callable[[Any], np.ndarray], seed: int, path: Path,
    options: dict[str, Any] | None = None,
) -> str:  # fmt: skip
    """Play an episode, write it to an MP4 or GIF in real time; how it ended, in a word. options: of
    its reset."""
    observation, info = env.reset(seed=seed, options=options)
    pictures, ended, terminated = [env.render()], False, False
    while not ended:
        observation, _, terminated, truncated, info = env.step(act(observation))
        pictures.append(env.render())
        ended = terminated or truncated
    pictures += [pictures[-1]] * _HOLD
    rate = env.metadata.get("render_fps", 30)
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".gif":
        imageio.mimwrite(path, pictures, duration=1000 / rate, loop=0)
    else:
        imageio.mimwrite(path, pictures, fps=rate, quality=6)
    return str(info.get("reason") or ("terminated" if terminated else "truncated"))
