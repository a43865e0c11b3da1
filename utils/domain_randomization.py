"""Domain randomisation: every episode in a slightly different cell, drawn, recorded and replayed.

After Tobin et al., "Domain randomization for transferring deep neural networks from simulation to
the real world" (IROS 2017). The config's section `randomization` says what varies, how much and how
often. This module draws samples and knows no simulator: a cell applies them, each simulator's in
its own way (`Randomizable`; `envs.pybullet_randomization` implements it). `utils.random_view`
changes what the cameras see.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal, Protocol

import numpy as np
from pydantic import BaseModel, Field, ValidationError

from utils.config import Config
from utils.config_types import (
    Change,
    Fraction,
    RandomizationConfig,
    Range,
    RangeOf,
    changed,
    draw,
    ranges_of,
)
from utils.errors import UserError
from utils.random_view import RandomView, TextureRandomizer, random_colour

__all__ = ["DomainRandomizer", "Randomizable", "RandomizableCell", "TextureRandomizer"]

_VERSION = 3  # of a sample
# [seed, 0, 0] would be the key of the sample itself (`utils.random_streams`).
_PHYSICS_STREAM, _VISION_STREAM, _ACTION_STREAM = 5, 1, 3
_EACH_AXIS = ("light_colour", "camera_shift", "camera_turn", "white_balance")  # three values
_LONGEST_ACTION = 8  # entries


class Randomizable(Protocol):
    """One scene as built, whose physics and colours a simulator can change and bring back exactly.

    surfaces: the simulator's numbers of the table and then each object, as in a rendered image.
    """

    surfaces: Sequence[int]

    def sizes(self) -> dict[str, int | None]:
        """How many values a parameter takes: one an object or joint, None for a single one."""

    def apply(self, changes: Mapping[str, Change]) -> None:
        """Make all physics nominal but for the changes; their names are the keys of the config's
        section randomization.physics. The cell ignores those of actions."""

    def paint(self, colours: Sequence[Sequence[float]] | None) -> None:
        """Colour the surfaces: RGBA in 0..1 for each, None for the nominal colours."""

    def pose(self, body: int) -> np.ndarray:
        """(4, 4) pose in W of a surface's body."""


class RandomizableCell(Protocol):
    """A cell as far as randomisation needs it. view: the change of what its cameras see, None for
    none. sample: what was applied to the scene, None for a nominal one."""

    config: Config
    view: RandomView | None
    sample: dict[str, Any] | None

    def randomizable(self) -> Randomizable:
        """The scene as built: the same object until the cell is built again."""


_Parameters = dict[str, tuple[Literal["scale", "add", "set"], float | list[float]]]


class _Ranges(BaseModel):
    physics: dict[str, RangeOf]
    vision: dict[str, RangeOf]


class _Sample(BaseModel):
    """The types of a sample's entries, of which a given one may have others."""

    seed: Annotated[int, Field(ge=0)]
    physics: _Parameters
    vision: _Parameters
    each_step: _Ranges
    colours: list[tuple[Fraction, Fraction, Fraction]] | None
    textures: list[dict[str, Any] | None]
    shadow: Literal[0, 1]
    depth_noise: bool


class DomainRandomizer:
    """Draws a sample for each episode, applies it to a cell, and brings the nominal cell back.

    Call `randomize` when the cell's scene has been built (`Cell.on_build`) and pass every action of
    a policy through `act` (`Cell.on_action`). A sample is plain data of text, numbers, lists and
    dicts and survives JSON; with the same scene and actions, `replay(sample)` gives the same
    episode bit for bit. It holds:

        version, seed: the seed is of all that is drawn anew at each action and image
        physics, vision: by parameter [operation, value or list of values]
        each_step: by parameter its Range, where it is drawn anew
        colours: RGB for the table and each object, or None. textures: likewise, each None or a
            description by `TextureRandomizer.draw`. shadow: 0 or 1. depth_noise: whether the depth
            has the noise of a Kinect whose parameters vary; never where `camera.depth_noise` gives
            the cell a noise of its own

    settings: None for those of the cell's config. seed: of what `randomize` draws when it is given
    none. Raises UserError for PyBullet's client number, which the tutorial passes.
    """

    def __init__(
        self, cell: RandomizableCell, settings: RandomizationConfig | None = None, seed: int = 0
    ):
        if not hasattr(cell, "randomizable"):
            raise UserError(
                f"DomainRandomizer: got {cell!r:.60}, expected a cell such as "
                "envs.pybullet_cell.PybulletCell: a physics client alone does not say which of its "
                "bodies are objects, and what is nominal"
            )
        settings = settings or cell.config.randomization
        self._cell, self._settings = cell, settings
        self._seeds = np.random.default_rng(seed)
        self.textures = TextureRandomizer(settings.texture_folder)
        self._varies_view = "vision" in settings.parts
        self._varies_depth = self._varies_view and cell.config.camera.depth_noise == "none"
        self._physics = ranges_of(settings.physics) if "physics" in settings.parts else {}
        self._vision = ranges_of(settings.vision) if self._varies_view else {}
        self._scene: Randomizable | None = None  # the build that was randomised last

    @property
    def sample(self) -> dict[str, Any] | None:
        """The sample that was applied to the cell last; None for a nominal cell."""
        return self._cell.sample

    def randomize(self, seed: int | None = None) -> dict[str, Any]:
        """Draw a sample, apply it to the scene as built, and return it.

        The same seed, scene and ranges give the same sample.
        """
        self._scene = self._cell.randomizable()
        seed = int(self._seeds.integers(2**31)) if seed is None else int(seed)
        sample = self._draw(seed)
        self._apply(sample)
        return sample

    def replay(self, sample: Mapping[str, Any]) -> None:
        """Apply a recorded sample. Raises UserError for one of another version or scene, and for
        what is no sample."""
        self._scene = self._cell.randomizable()
        self._check(sample)
        self._apply(sample)

    def _check(self, sample: Mapping[str, Any]) -> None:
        give = "give one as reset returned it in info['randomization']"
        if not isinstance(sample, Mapping):
            raise UserError(f"randomisation sample: got {sample!r:.60}, expected a dict; {give}")
        if sample.get("version") != _VERSION:
            raise UserError(
                f"randomisation sample: version {sample.get('version')!r}, expected {_VERSION}"
            )
        try:
            _Sample.model_validate(dict(sample))
        except ValidationError as error:
            first = error.errors()[0]
            place = ".".join(map(str, first["loc"]))
            raise UserError(f"randomisation sample: {place}: {first['msg']}; {give}") from None
        count = len(self._scene.surfaces) - 1
        for surfaces in (sample["textures"], sample["colours"] or sample["textures"]):
            if len(surfaces) - 1 != count:
                raise UserError(
                    f"randomisation sample: recorded with {len(surfaces) - 1} objects, the scene "
                    f"has {count}"
                )
        sizes = self._sizes()
        for name, (_, value) in (*sample["physics"].items(), *sample["vision"].items()):
            size = sizes.get(name)
            if np.shape(value) != (() if size is None else (size,)):
                expected = "one number" if size is None else f"a list of {size} numbers"
                raise UserError(
                    f"randomisation sample: {name} has {value!r:.60}, expected {expected}; {give}"
                )

    def restore(self) -> None:
        """Bring the nominal cell back; the objects stay where they are. A scene that was built
        since is nominal already."""
        if self._scene is None:  # what another randomizer changed is its own to restore
            return
        if self.sample is not None and self._scene is self._cell.randomizable():
            self._scene.apply({})
            self._scene.paint(None)
        self._cell.sample, self._cell.view = None, None

    def act(self, action: np.ndarray) -> np.ndarray:
        """(n,) the action that the cell carries out for an action (n,) in [-1, 1]: with bias and
        noise, and still in [-1, 1].

        Begins a new step: what is drawn at each step changes now.
        """
        if self.sample is None or self._scene is None:
            return action
        changes = self._changes("physics", self._steps, _PHYSICS_STREAM)
        if self.sample["each_step"]["physics"]:
            self._scene.apply(changes)
        rng = np.random.default_rng([self.sample["seed"], _ACTION_STREAM, self._steps])
        self._steps += 1
        deviation = _from_zero(changes, "action_noise")
        # The bias is as long as the longest action there is; a shorter one takes its beginning.
        bias = np.asarray(_from_zero(changes, "action_bias", [0.0]))
        bias = np.resize(bias, len(action))
        noisy = action + bias + deviation * rng.standard_normal(len(action))
        return np.clip(noisy, -1.0, 1.0).astype(np.asarray(action).dtype)

    # --- Drawing ------------------------------------------------------------------------------

    def _draw(self, seed: int) -> dict[str, Any]:
        settings, rng = self._settings, np.random.default_rng(seed)
        sizes = self._sizes()
        count = len(self._scene.surfaces)
        coloured = bool(rng.random() < settings.colour_share)
        colours = [random_colour(rng).tolist() for _ in range(count)]
        textures = [
            self.textures.draw(rng) if coloured and rng.random() < settings.texture_share else None
            for _ in range(count)
        ]
        shadow, noisy = rng.random(2) < (settings.shadow_share, settings.depth_noise_share)
        if not self._varies_view:
            coloured, textures, shadow = False, [None] * count, False
        return {
            "version": _VERSION,
            "seed": seed,
            "colours": colours if coloured else None,
            "textures": textures,
            "shadow": int(shadow),
            "depth_noise": bool(noisy) and self._varies_depth,
            "physics": _draws(self._physics, rng, sizes, "episode"),
            "vision": _draws(self._vision, rng, sizes, "episode"),
            "each_step": {
                part: {name: list(spec) for name, spec in ranges.items() if spec.every == "step"}
                for part, ranges in (("physics", self._physics), ("vision", self._vision))
            },
        }

    def _sizes(self) -> dict[str, int | None]:
        sizes = self._scene.sizes() | dict.fromkeys(_EACH_AXIS, 3)
        return sizes | {"action_bias": _LONGEST_ACTION}

    def _changes(self, part: str, step: int, stream: int) -> dict[str, Change]:
        """All changes of a part in a step, those of the episode and those of the step."""
        sample = self.sample
        each = sample["each_step"][part]
        if not each:
            return sample[part]
        ranges = {name: Range(*spec) for name, spec in each.items()}
        rng = np.random.default_rng([sample["seed"], stream, step])
        return sample[part] | _draws(ranges, rng, self._sizes(), "step")

    # --- Applying -----------------------------------------------------------------------------

    def _apply(self, sample: Mapping[str, Any]) -> None:
        cell, scene = self._cell, self._scene
        cell.sample, self._steps = dict(sample), 0
        scene.apply(self._changes("physics", 0, _PHYSICS_STREAM))
        colours = sample["colours"]
        scene.paint(None if colours is None else [(*rgb, 1.0) for rgb in colours])
        textures = {
            body: self.textures.make(description)
            for body, description in zip(scene.surfaces, sample["textures"])
            if description is not None
        }
        cell.view = RandomView(
            lambda frame: self._changes("vision", frame, _VISION_STREAM),
            sample["seed"],
            sample["shadow"],
            sample["depth_noise"],
            textures,
            scene.pose,
        )


def _draws(
    ranges: Mapping[str, Range], rng: np.random.Generator, sizes: Mapping[str, Any], every: str
) -> dict[str, Any]:
    return {
        name: [spec.operation, draw(spec, rng, sizes.get(name))]
        for name, spec in ranges.items()
        if spec.every == every
    }


def _from_zero(changes: Mapping[str, Change], name: str, nominal: Any = 0.0) -> Any:
    """The value of a parameter whose nominal value is 0."""
    if name not in changes:
        return nominal
    operation, value = changes[name]
    if isinstance(value, list):
        return [changed(operation, 0.0, part) for part in value]
    return changed(operation, 0.0, value)
