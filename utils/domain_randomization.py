"""Domain randomisation: every episode in a slightly different world, on record.

After Tobin et al., "Domain randomization for transferring deep neural networks from simulation to
the real world" (IROS 2017). What varies, how much and how often is the config's section
`randomization`. This module draws, records and replays; `utils.random_physics` and
`utils.random_view` apply. It knows the cell only as far as `World` says.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np
import pybullet

from utils.config_types import RandomizationConfig, Range
from utils.errors import UserError
from utils.random_physics import RandomPhysics
from utils.random_physics import World as PhysicsWorld
from utils.random_ranges import changed, draw, ranges_of
from utils.random_view import RandomView, TextureRandomizer, random_colour
from utils.transforms import pose_matrix

__all__ = ["DomainRandomizer", "TextureRandomizer", "World"]

_VERSION = 2  # of a sample
_PHYSICS_STREAM, _VISION_STREAM, _ACTION_STREAM = 0, 1, 3
_EACH_AXIS = ("light_colour", "camera_shift", "camera_turn", "white_balance")  # three values


class World(PhysicsWorld, Protocol):
    """A cell: physics, the view that its cameras look through (None: as it is), and the sample that
    made it what it is (None: nominal)."""

    view: RandomView | None
    sample: dict[str, Any] | None


class DomainRandomizer:
    """Draws a world for each episode, applies it to a cell, and takes it back.

    Call `randomize` when the cell's scene has been built (`PybulletCell.on_build`); in between, `act` gives
    what becomes of each action (`PybulletCell.on_action`). A sample is a plain dict of text, numbers, lists
    and dicts, the same after a journey through JSON; with the same scene and actions,
    `replay(sample)` gives the same episode bit for bit. It holds:

        version, seed: the seed is of all that is drawn anew at each action and image
        physics, vision: by parameter [operation, value or list of values]
        each_step: by parameter its Range, where it is drawn anew
        colours: RGB for the table and each object, or None. textures: likewise, each None or a
            description by `TextureRandomizer.draw`. shadow: 0 or 1. depth_noise: true or false

    world: of PyBullet; UserError for another. arm, fingers: link numbers of the robot. seed: of
    what `randomize` draws when it is given none.
    """

    def __init__(
        self,
        world: World,
        settings: RandomizationConfig,
        arm: Sequence[int] = range(7),
        fingers: Sequence[int] = (7, 8),
        seed: int = 0,
    ):
        if world.client is None:
            raise UserError(
                "DomainRandomizer changes PyBullet's physics: it needs a cell of PyBullet"
            )
        self._world, self._settings = world, settings
        self._arm, self._fingers = tuple(arm), tuple(fingers)
        self._seeds = np.random.default_rng(seed)
        self.textures = TextureRandomizer(settings.texture_folder)
        self._varies_view = "vision" in settings.parts
        self._physics_ranges = ranges_of(settings.physics) if "physics" in settings.parts else {}
        self._vision = ranges_of(settings.vision) if self._varies_view else {}
        self._built: object = None  # the robot of the build that `_physics` belongs to

    @property
    def sample(self) -> dict[str, Any] | None:
        """What was applied to the cell last; None for a nominal one."""
        return self._world.sample

    def randomize(self, seed: int | None = None) -> dict[str, Any]:
        """Draw a world, apply it to the scene as built, and return the sample.

        The same seed, scene and ranges give the same sample.
        """
        self._remember_nominal()
        seed = int(self._seeds.integers(2**31)) if seed is None else int(seed)
        sample = self._draw(seed)
        self._apply(sample)
        return sample

    def replay(self, sample: Mapping[str, Any]) -> None:
        """Apply a recorded sample. Raises UserError where it is of another version or scene."""
        self._remember_nominal()
        count = len(self._world.bodies)
        if sample.get("version") != _VERSION:
            raise UserError(
                f"randomisation sample: version {sample.get('version')!r}, expected {_VERSION}"
            )
        recorded = len(sample["textures"]) - 1
        if recorded != count:
            raise UserError(
                f"randomisation sample: recorded with {recorded} objects, the scene has {count}"
            )
        self._apply(sample)

    def restore(self) -> None:
        """Bring the nominal cell back; objects stay where they are. Without a sample, nothing."""
        if self.sample is None or self._built is not self._world.robot:
            self._world.sample, self._world.view = None, None  # a new build is nominal
            return
        self._physics.restore()
        self._paint(self._colours)
        self._world.view = None
        self._world.sample = None

    def act(self, action: np.ndarray) -> np.ndarray:
        """(n,) what becomes of an action (n,) in [-1, 1]: biased, noisy and still in [-1, 1].

        Begins a new step: what is drawn at each step changes now.
        """
        if self.sample is None:
            return action
        changes = self._physics_at(self._steps)
        if self._each_step_physics:
            self._physics.apply(changes)
        rng = np.random.default_rng([self.sample["seed"], _ACTION_STREAM, self._steps])
        self._steps += 1
        deviation = _plain(changes, "action_noise")
        # The bias is as long as the longest action there is; a shorter one takes its beginning.
        bias = np.asarray(_plain(changes, "action_bias", [0.0]))
        bias = np.resize(bias, len(action))
        noisy = action + bias + deviation * rng.standard_normal(len(action))
        return np.clip(noisy, -1.0, 1.0).astype(np.asarray(action).dtype)

    # --- Drawing ------------------------------------------------------------------------------

    def _draw(self, seed: int) -> dict[str, Any]:
        settings, rng = self._settings, np.random.default_rng(seed)
        physics = self._physics_ranges
        sizes = self._sizes()
        count = len(self._world.bodies)
        coloured = bool(rng.random() < settings.colour_share)
        colours = [random_colour(rng).tolist() for _ in range(count + 1)]
        textures = [
            self.textures.draw(rng) if coloured and rng.random() < settings.texture_share else None
            for _ in range(count + 1)
        ]
        shadow, noisy = rng.random(2) < (settings.shadow_share, settings.depth_noise_share)
        if not self._varies_view:
            coloured, textures, shadow, noisy = False, [None] * (count + 1), False, False
        return {
            "version": _VERSION,
            "seed": seed,
            "colours": colours if coloured else None,
            "textures": textures,
            "shadow": int(shadow),
            "depth_noise": bool(noisy),
            "physics": _draws(physics, rng, sizes, "episode"),
            "vision": _draws(self._vision, rng, sizes, "episode"),
            "each_step": {
                part: {name: list(spec) for name, spec in ranges.items() if spec.every == "step"}
                for part, ranges in (("physics", physics), ("vision", self._vision))
            },
        }

    def _sizes(self) -> dict[str, int | None]:
        sizes = self._physics.sizes() | dict.fromkeys(_EACH_AXIS, 3)
        return sizes | {"action_bias": _LONGEST_ACTION}

    def _physics_at(self, step: int) -> dict[str, Any]:
        return self._at("physics", step, _PHYSICS_STREAM)

    def _at(self, part: str, step: int, stream: int) -> dict[str, Any]:
        """All changes of a part in a step, those of the episode and those of the step."""
        sample = self.sample
        each = sample["each_step"][part]
        if not each:
            return sample[part]
        ranges = {name: Range(*spec) for name, spec in each.items()}
        rng = np.random.default_rng([sample["seed"], stream, step])
        return sample[part] | _draws(ranges, rng, self._sizes(), "step")

    # --- Applying -----------------------------------------------------------------------------

    def _remember_nominal(self) -> None:
        """Take what is nominal from a scene that was just built; once for each build."""
        world = self._world
        if self._built is world.robot:
            return
        self._built = world.robot
        self._physics = RandomPhysics(world, self._arm, self._fingers)
        self._colours = [
            pybullet.getVisualShapeData(body, physicsClientId=world.client)[0][7]
            for body in self._surfaces()
        ]

    def _apply(self, sample: Mapping[str, Any]) -> None:
        world = self._world
        world.sample, self._steps = dict(sample), 0
        self._each_step_physics = bool(sample["each_step"]["physics"])
        self._physics.apply(self._physics_at(0))
        colours = sample["colours"]
        self._paint(self._colours if colours is None else [(*rgb, 1.0) for rgb in colours])
        textures = {
            body: self.textures.make(description)
            for body, description in zip(self._surfaces(), sample["textures"])
            if description is not None
        }
        world.view = RandomView(
            lambda frame: self._at("vision", frame, _VISION_STREAM),
            sample["seed"],
            sample["shadow"],
            sample["depth_noise"],
            textures,
            self._pose,
        )

    def _surfaces(self) -> list[int]:
        return [self._world.table, *self._world.bodies]

    def _paint(self, colours: Sequence[Sequence[float]]) -> None:
        for body, colour in zip(self._surfaces(), colours):
            pybullet.changeVisualShape(
                body, -1, rgbaColor=list(colour), physicsClientId=self._world.client
            )

    def _pose(self, body: int) -> np.ndarray:
        return pose_matrix(
            *pybullet.getBasePositionAndOrientation(body, physicsClientId=self._world.client)
        )


_LONGEST_ACTION = 8  # entries


def _draws(
    ranges: Mapping[str, Range], rng: np.random.Generator, sizes: Mapping[str, Any], every: str
) -> dict[str, Any]:
    return {
        name: [spec.operation, draw(spec, rng, sizes.get(name))]
        for name, spec in ranges.items()
        if spec.every == every
    }


def _plain(changes: Mapping[str, Any], name: str, nominal: Any = 0.0) -> Any:
    """The value of a parameter whose nominal value is 0."""
    if name not in changes:
        return nominal
    operation, value = changes[name]
    if isinstance(value, list):
        return [changed(operation, 0.0, part) for part in value]
    return changed(operation, 0.0, value)
