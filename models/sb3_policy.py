"""Policies of Stable-Baselines3, which are trained on `gymnasium.make("RobotGrasping-v0", ...)`.

The package is optional. Stable-Baselines3 itself unpickles most of a policy's file, which may run
any code. Here only what a policy needs to act is unpickled, and of that only spaces, arrays and the
classes of networks (`_NetworkUnpickler`). This module knows no simulator.
"""

from __future__ import annotations

import base64
import io
import json
import pickle
import re
import warnings
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces

from utils.errors import UserError

_VEC_NORMALIZE = (
    "VecNormalize, whose statistics model.save leaves out; train without it, or put the "
    "normalisation into the policy"
)


class Sb3Policy:
    """A deterministic policy: a callable from an observation, a dict of arrays, to an action (A,).

    observation_space, action_space: those of its training; images may be stored as (C, H, W).
    last: what it saw last in its training, (N, ...) of each entry; empty where that is not known.
    under_vec_normalize: whether the file tells that its training was; only those of PPO and A2C do.
    """

    def __init__(
        self, path: Path, model: Any, last: dict[str, np.ndarray], under_vec_normalize: bool
    ):
        self.path, self.model, self.last = path, model, last
        self.under_vec_normalize = under_vec_normalize
        self.observation_space, self.action_space = model.observation_space, model.action_space

    @property
    def observations(self) -> list[str]:
        """The keys of what it sees."""
        return list(self.observation_space.spaces)

    def __call__(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        seen = {key: np.asarray(observation[key]) for key in self.observation_space.spaces}
        action, _ = self.model.predict(seen, deterministic=True)
        return action

    def check_spaces(self, observations: spaces.Dict, actions: spaces.Box) -> None:
        """Raise UserError unless the policy can act in an environment with these spaces, on
        observations like those of its training; warn where these were perhaps normalised."""
        theirs = self.observation_space
        if not isinstance(theirs, spaces.Dict):
            raise UserError(
                f"{self.path}: the policy observes {theirs}, expected a Dict of "
                f"{_described(observations)}; train it with MultiInputPolicy on the environment "
                "without a wrapper that changes its observations"
            )
        for key, box in observations.spaces.items():
            if key in self.last and _leaves(self.last[key], box):
                raise UserError(
                    f"{self.path}: what the policy last saw of {key!r} in its training is beyond "
                    f"the bounds that the section env gives, as under {_VEC_NORMALIZE}"
                )
        if self.under_vec_normalize:
            warnings.warn(
                f"{self.path}: unless it normalised rewards alone, the policy is scored on other "
                f"observations than it was trained on, under {_VEC_NORMALIZE}",
                stacklevel=2,
            )
        fits = all(
            key in observations.spaces and _same_box(box, observations[key])
            for key, box in theirs.spaces.items()
        )
        if not fits:
            raise UserError(
                f"{self.path}: the policy observes {_described(theirs)}, but the section env gives "
                f"{_described(observations)}; set env.observations, env.resolution and env.camera "
                "as in its training"
            )
        if self.action_space.shape != actions.shape:
            raise UserError(
                f"{self.path}: the policy has actions of shape {self.action_space.shape}, but "
                f"env.control expects {actions.shape}; set env.control as in its training"
            )


def load_sb3(path: Path) -> Sb3Policy:
    """Load the file that `model.save` of PPO, A2C, SAC, TD3 or DDPG has written, on the CPU.

    Raises UserError where Stable-Baselines3 is missing, where the file cannot be loaded, and for
    a policy of another algorithm, such as DQN, whose actions are discrete.
    """
    try:
        import stable_baselines3
    except ImportError as error:
        raise UserError(
            f"sb3:{path}: Stable-Baselines3 is not installed; pip install stable-baselines3"
        ) from error
    # The file does not name its algorithm, but the module of its policy does.
    algorithms = {"sac": "SAC", "td3": "TD3", "common": "PPO"}
    try:
        with zipfile.ZipFile(path) as archive:
            data = json.loads(archive.read("data"))
        module = data["policy_class"]["__module__"]
        package, kind = [*module.split("."), ""][:2]
        if package != "stable_baselines3":
            raise UserError(
                f"sb3:{path}: the policy is of {package}, which is not supported; train with PPO, "
                "A2C, SAC, TD3 or DDPG of stable_baselines3, and their own policies"
            )
        if kind not in algorithms:
            raise UserError(
                f"sb3:{path}: the policy is of {module}, which has no continuous actions; train "
                "with PPO, A2C, SAC, TD3 or DDPG"
            )
        algorithm = getattr(stable_baselines3, algorithms[kind])
        model = algorithm.load(path, device="cpu", custom_objects=_replaced(data))
        last = _unpickled(data["_last_obs"]) if data.get("_last_obs") else None
        # Which algorithms of kind "common" keep for VecNormalize alone.
        normalised = kind == "common" and bool(data.get("_last_original_obs"))
        return Sb3Policy(path, model, last if isinstance(last, dict) else {}, normalised)
    except OSError as error:
        raise UserError(f"sb3:{path}: cannot read this file: {error.strerror}") from error
    except UserError:
        raise
    except Exception as error:  # Stable-Baselines3 raises errors of many kinds for other files
        raise UserError(
            f"sb3:{path}: not a policy of Stable-Baselines3 ({type(error).__name__}: {error}); "
            "give a file that model.save has written"
        ) from error


# --- Without running the file's code --------------------------------------------------------------

# Entries that a policy needs to act; all other objects belong to its training.
_NEEDED = ("policy_class", "policy_kwargs", "observation_space", "action_space")
# Plain values for entries of the training that an algorithm sets itself up with, each the least.
_LEAST = {
    "learning_rate": 0.0, "clip_range": 0.2, "train_freq": 1, "n_envs": 1, "n_steps": 1,
    "buffer_size": 1,
}  # fmt: skip
# Classes, and the functions by which numpy rebuilds arrays, types and generators.
_CLASSES = re.compile(
    r"(gymnasium\.spaces\.\w+|numpy\.(dtypes|random\.\w+)|torch\.(nn\.modules|optim)\.\w+"
    r"|stable_baselines3\.(\w+\.policies|common\.torch_layers))\.\w+"
    r"|collections\.OrderedDict|numpy\.(ndarray|dtype|bool|bool_|u?int\d+|float\d+)"
)
_FUNCTIONS = re.compile(
    r"numpy\.(_core|core)\.(multiarray\.(_reconstruct|scalar)|numeric\._frombuffer)"
    r"|numpy\.random\.(_pickle\.__\w+_ctor|bit_generator\.__pyx_unpickle_\w+)"
)


def _replaced(data: dict[str, Any]) -> dict[str, Any]:
    """What stands for the objects that a file holds as pickles, so that Stable-Baselines3 unpickles
    none of them."""
    pickled = [k for k, v in data.items() if isinstance(v, dict) and ":serialized:" in v]
    replaced = {key: _unpickled(data[key]) if key in _NEEDED else None for key in pickled}
    return replaced | {key: value for key, value in _LEAST.items() if key in data}


def _unpickled(entry: dict[str, Any]) -> Any:
    return _NetworkUnpickler(io.BytesIO(base64.b64decode(entry[":serialized:"]))).load()


class _NetworkUnpickler(pickle.Unpickler):
    """Refuses every class and function that no space, array or network is made of."""

    def find_class(self, module: str, name: str) -> Any:
        place = f"{module}.{name}"
        is_function = _FUNCTIONS.fullmatch(place) is not None
        if is_function or _CLASSES.fullmatch(place):
            found = super().find_class(module, name)
            # A module also has what it has imported, such as `functools.partial`.
            own = isinstance(found, type) and found.__module__.split(".")[0] == module.split(".")[0]
            if is_function or own:
                return found
        raise pickle.UnpicklingError(f"it holds {place}, which no policy needs")


def _leaves(seen: np.ndarray, box: spaces.Box) -> bool:
    """Whether a batch of observations leaves a box; not where their shapes differ."""
    inside = (box.low <= seen) & (seen <= box.high) if seen.shape[1:] == box.shape else True
    return not np.all(inside)


def _same_box(theirs: spaces.Box, ours: spaces.Box) -> bool:
    """Whether two boxes have the same shape and type; Stable-Baselines3 turns (H, W, C) images to
    (C, H, W)."""
    shapes = {ours.shape, (ours.shape[-1], *ours.shape[:-1])}
    return theirs.shape in shapes and theirs.dtype == ours.dtype


def _described(space: spaces.Dict) -> str:
    return ", ".join(f"{key} {box.shape} {box.dtype}" for key, box in space.spaces.items())
