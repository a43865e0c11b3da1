"""Building blocks of the configuration: the base of sections, shared types, randomised ranges.

`utils.config_schema` has the sections that are made of them, apart from `randomization`, which
stands here together with its ranges: what they allow, how a value is drawn from one, and how it
changes a nominal value.
"""

from __future__ import annotations

import importlib.util
import json
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from utils.depth import KinectNoise

Change = tuple[str, Any]  # operation, and a value or a list of them
_DEVIATIONS = 2.0  # a normal range ends so many standard deviations from its mean
_GRAVITY = -9.81  # m/s^2 along z, of a nominal cell


def no_repeats(values: tuple) -> tuple:
    """A validator of lists in which every entry stands once."""
    if len(set(values)) != len(values):
        raise ValueError("an entry is repeated")
    return values


class Arguments(dict):
    """A mapping of any keys from YAML, hashable as all that a config holds; nothing changes it."""

    def __hash__(self) -> int:
        return hash(json.dumps(self, sort_keys=True, default=str))


KeywordArguments = Annotated[dict[str, Any], AfterValidator(Arguments)]
TermScales = Annotated[dict[str, float], Field(min_length=1), AfterValidator(Arguments)]
Count = Annotated[int, Field(ge=1)]
Positive = Annotated[float, Field(gt=0)]
Timeout = Annotated[float, Field(gt=0, le=604_800)]  # s, a week: systems have limits
# s of simulated time for which something is waited, so that a typing error hangs no worker.
MOST_SECONDS = 60
Wait = Annotated[float, Field(ge=0, le=MOST_SECONDS)]
PositiveWait = Annotated[float, Field(gt=0, le=MOST_SECONDS)]
Share = Annotated[float, Field(gt=0, le=1)]
Fraction = Annotated[float, Field(ge=0, le=1)]
Pixels = Annotated[int, Field(ge=16, le=4096)]


def _without_nul(value: Any) -> Any:
    """No system has files with this character in their names."""
    if "\0" in str(value):
        raise ValueError("a name has no character \\0")
    return value


Name = Annotated[str, Field(min_length=1), AfterValidator(_without_nul)]
File = Annotated[Path, Field(strict=False), AfterValidator(_without_nul)]  # or folder
Mount = Literal["overhead", "wrist"]
# YAML has lists where frozen objects hold tuples, hence strict=False; the items stay strict.
Vector2 = Annotated[tuple[float, float], Field(strict=False)]
Vector3 = Annotated[tuple[float, float, float], Field(strict=False)]
JointVector = Annotated[tuple[float, float, float, float, float, float, float], Field(strict=False)]
Several = Field(min_length=1, strict=False)
Names = Annotated[tuple[Name, ...], Several, AfterValidator(no_repeats)]


AUTO = "auto"


def _installed_simulator(name: str) -> str:
    """`auto` is PyBullet where it is installed, and else MuJoCo: a config holds the answer, so that
    a resumed run stays in the simulator it began in."""
    if name != AUTO:
        return name
    return "mujoco" if importlib.util.find_spec("pybullet") is None else "pybullet"


def _offered_sets(names: tuple[str, ...], sets: tuple[str, ...]) -> tuple[str, ...]:
    """`auto`, alone or among others, is `sets`; without random_urdfs, or else primitives, where
    pybullet_data, which brings the former, is not installed."""
    if importlib.util.find_spec("pybullet_data") is None:
        sets = tuple(name for name in sets if name != "random_urdfs")
    offered = sets or ("primitives",)
    every = (one for name in names for one in (offered if name == AUTO else (name,)))
    return tuple(dict.fromkeys(every))


def _plain_name(name: str) -> str:
    """Names of runs become names of folders."""
    if not re.fullmatch(r"\w[\w.+-]*", name):
        raise ValueError(
            "a run's name has letters, digits and . _ + -, and starts with a letter, digit or _"
        )
    return name


RunName = Annotated[Name, AfterValidator(_plain_name)]
SimulatorName = Annotated[Name, AfterValidator(_installed_simulator)]
TrainingSets = Annotated[
    Names,
    AfterValidator(lambda names: _offered_sets(names, ("random_urdfs", "primitives", "thin"))),
]
TestSets = Annotated[Names, AfterValidator(lambda names: _offered_sets(names, ("random_urdfs",)))]


class Section(BaseModel):
    """Base of every section: no unknown keys, no silent conversions, no changes, no NaN."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class Range(NamedTuple):
    """A parameter's range, how a value is drawn from it, what the value does to the nominal one
    (scale, add or set), and how often it is drawn (episode or step)."""

    low: float
    high: float
    distribution: str
    operation: str
    every: str


def _range(values: tuple) -> Range:
    value = Range(*values)
    if value.low > value.high:
        raise ValueError(f"low ({value.low}) must not be greater than high ({value.high})")
    if value.low <= 0 and value.distribution == "log_uniform":
        raise ValueError(f"log_uniform needs low > 0, got {value.low}")
    if value.low <= 0 and value.operation == "scale":
        raise ValueError(f"a factor (scale) needs low > 0, got {value.low}")
    return value


def unsigned(nominal: float = 0.0, zero: bool = True) -> AfterValidator:
    """A validator of ranges of what cannot be negative.

    nominal: the least value that a cell has there; 0 where that is not known. zero: whether it may
    be 0.
    """

    def check(value: Range) -> Range:
        own = nominal if value.operation == "add" else 0.0
        least = own + value.low  # a factor is positive
        unknown = value.operation == "add" and not nominal
        if least < 0 or (least == 0 and not (zero or unknown)):
            added = f" + {own:g}, the nominal value," if own else ""
            rule = "not be negative" if zero else "be positive"
            raise ValueError(f"low ({value.low}){added} must {rule}")
        return value

    return AfterValidator(check)


def _of_zero(value: Range) -> Range:
    """A validator of ranges of what is 0 in a nominal cell."""
    if value.operation == "scale":
        raise ValueError("its nominal value is 0, which no factor changes; use add or set")
    return value


def _at_most_a_second(value: Range) -> Range:
    """A validator of ranges of delays in seconds."""
    if value.high > 1:
        raise ValueError(f"high ({value.high:g}) must be at most 1 s")
    return value


def _downwards(value: Range) -> Range:
    """A validator of the range of gravity, which has to keep objects on the table."""
    highest = changed(value.operation, _GRAVITY, value.high)
    if value.operation != "scale" and highest >= 0:
        raise ValueError(
            f"high ({value.high:g}) makes it {highest:g} m/s^2 along z, and it must stay below 0"
        )
    return value


RangeOf = Annotated[
    tuple[
        float,
        float,
        Literal["uniform", "log_uniform", "normal"],
        Literal["scale", "add", "set"],
        Literal["episode", "step"],
    ],
    Field(
        strict=False,
        description="a list of low, high, uniform | log_uniform | normal, scale | add | set, "
        "episode | step",
    ),
    AfterValidator(_range),
]
UnsignedRange = Annotated[RangeOf, unsigned()]
PositiveRange = Annotated[RangeOf, unsigned(zero=False)]
FactorRange = Annotated[RangeOf, unsigned(nominal=1.0)]  # of what is 1 in a nominal cell
PositiveFactorRange = Annotated[RangeOf, unsigned(nominal=1.0, zero=False)]
RangeFromZero = Annotated[RangeOf, AfterValidator(_of_zero)]
UnsignedRangeFromZero = Annotated[UnsignedRange, AfterValidator(_of_zero)]


class PhysicsRangesConfig(Section):
    object_mass: Annotated[RangeOf, unsigned(nominal=0.02, zero=False)]
    object_friction: UnsignedRange
    rolling_friction: UnsignedRange
    spinning_friction: UnsignedRange
    table_friction: FactorRange
    finger_friction: FactorRange
    restitution: UnsignedRange
    contact_stiffness: UnsignedRange
    contact_damping: UnsignedRange
    robot_mass: PositiveRange
    joint_damping: UnsignedRangeFromZero
    arm_position_gain: PositiveFactorRange
    arm_velocity_gain: FactorRange
    gripper_gain: FactorRange
    gravity: Annotated[RangeOf, AfterValidator(_downwards)]
    action_noise: UnsignedRangeFromZero
    action_bias: RangeFromZero
    latency: Annotated[UnsignedRangeFromZero, AfterValidator(_at_most_a_second)]


class VisionRangesConfig(Section):
    light_tilt: UnsignedRange
    light_heading: RangeOf
    light_colour: UnsignedRange
    light_ambient: UnsignedRange
    light_diffuse: UnsignedRange
    light_specular: UnsignedRange
    camera_shift: RangeFromZero
    camera_turn: RangeFromZero
    camera_fov: PositiveFactorRange
    brightness: RangeOf
    contrast: RangeOf
    saturation: RangeOf
    white_balance: RangeOf
    colour_noise: UnsignedRangeFromZero
    depth_shift: Annotated[RangeOf, unsigned(nominal=KinectNoise.shift)]
    depth_jitter: Annotated[RangeOf, unsigned(nominal=KinectNoise.noise)]
    depth_step: Annotated[RangeOf, unsigned(nominal=KinectNoise.step, zero=False)]


class RandomizationConfig(Section):
    parts: Annotated[tuple[Literal["physics", "vision"], ...], Several, AfterValidator(no_repeats)]
    physics: PhysicsRangesConfig
    vision: VisionRangesConfig
    colour_share: Fraction
    texture_share: Fraction
    texture_folder: File | None
    shadow_share: Fraction
    depth_noise_share: Fraction


# --- Values of ranges ---------------------------------------------------------------------------


def ranges_of(section: Any) -> dict[str, Range]:
    """The ranges of a section of the config, by name."""
    return {name: getattr(section, name) for name in type(section).model_fields}


def draw(spec: Range, rng: np.random.Generator, size: int | None = None):
    """A float, or a list of `size` floats, within [low, high] of the range.

    normal: truncated at two standard deviations (Robert, "Simulation of truncated normal
    variables", 1995: by drawing again), so its variance is 0.774 of the untruncated one's.
    """
    values = [_draw_one(spec, rng) for _ in range(1 if size is None else size)]
    return values[0] if size is None else values


def changed(operation: str, nominal: float, value: float) -> float:
    """A nominal value after `scale` (a factor), `add` or `set`."""
    if operation == "scale":
        return nominal * value
    return nominal + value if operation == "add" else value


def changed_in(
    changes: Mapping[str, Change], name: str, nominal: Any, index: int | None = None
) -> Any:
    """A nominal value, or an array of them, after the change of that name, if there is one.

    index: of the entry to take, where the change has a value for each object."""
    if name not in changes:
        return nominal
    operation, value = changes[name]
    return changed(operation, nominal, value if index is None else value[index])


def _draw_one(spec: Range, rng: np.random.Generator) -> float:
    # Plain floats: arrays of one take ten times as long, and a reset draws fifty.
    low, high = spec.low, spec.high
    if spec.distribution == "normal":
        while abs(deviations := rng.standard_normal()) > _DEVIATIONS:
            pass
        value = (low + high) / 2 + (high - low) / (2 * _DEVIATIONS) * deviations
    elif spec.distribution == "log_uniform":
        value = low * math.exp(rng.random() * math.log(high / low))
    else:
        value = low + (high - low) * rng.random()
    return min(max(value, low), high)  # rounding may leave the range by the last bit
