"""What a config may name: the keys that choose an entry of a registry, and the registries.

Each registry stands beside the code that it lists. A new entry there is all that a config needs to
name it: `utils.config_schema` takes any text for these keys, because `utils` imports neither `envs`
nor `models`, and each script calls `check_names` before it does any work. Planners and learned
policies (`evaluate.policies`), which may also be files, are checked elsewhere, by `models.planners`
and `envs.policy_approach`. The registry of depth noises stands in `utils.depth`.
"""

from __future__ import annotations

from collections.abc import Collection

from envs.cell_scenes import LAYOUTS
from envs.closed_loop import CONTROLLERS
from envs.env_actions import ACTION_ENTRIES
from envs.env_rewards import make_reward
from envs.objects import check_object_set
from envs.scenarios import SCENARIOS
from envs.simulators import SIMULATORS
from envs.transfer_plan import COLUMNS
from models.grasp_policy import ACTIVATIONS
from models.graspnet_backbones import BACKBONES
from utils.config import Config
from utils.config_types import AUTO
from utils.depth import make_depth_noise
from utils.errors import unknown_choice
from utils.real_data import FORMATS

REGISTRIES: dict[str, Collection[str]] = {
    "simulator": (AUTO, *SIMULATORS),
    "scene.simulator": SIMULATORS,
    "closed_loop.controller": CONTROLLERS,
    "data.kind": ("simulated", *FORMATS),
    "train.backbone": BACKBONES,
    "evaluate.controllers": CONTROLLERS,
    "evaluate.scenarios": SCENARIOS,
    "transfer.columns": COLUMNS,
    "env.scenario": LAYOUTS,
    "env.control": ACTION_ENTRIES,
    "rl.activation": ACTIVATIONS,
}
OBJECT_SET_KEYS = ("data.object_sets", "evaluate.object_sets", "env.objects")


def check_names(config: Config) -> None:
    """Raise UserError for a name in the config that is in none of the registries, and for a
    plug-in that cannot be loaded or refuses its parameters."""
    for key, registry in REGISTRIES.items():
        for name in _names(config, key):
            if name not in registry:
                raise unknown_choice(key, name, registry)
    for key in OBJECT_SET_KEYS:
        for name in _names(config, key):
            check_object_set(name, key)
    make_reward(config.env.reward)
    config.camera.make_noise(float(config.camera.height))
    for key in ("train.depth_noises", "evaluate.depth_noises"):
        for name in _names(config, key):
            make_depth_noise(name, float(config.camera.height), key=key)
    for row in config.transfer.policies or ():
        if row.scenes is not None:
            scenario, objects = row.scenes
            if scenario not in SCENARIOS:
                raise unknown_choice("transfer.policies", scenario, SCENARIOS)
            check_object_set(objects, "transfer.policies")


def _names(config: Config, key: str) -> tuple[str, ...]:
    section, _, name = key.rpartition(".")
    value = getattr(getattr(config, section) if section else config, name)
    if value is None:
        return ()
    return (value,) if isinstance(value, str) else value
