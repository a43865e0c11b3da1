"""The schema of the section `randomization`: what differs from episode to episode, and how much.

`utils.config_schema` has the other sections, `utils.random_ranges` draws from the ranges.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, NamedTuple

from pydantic import AfterValidator, Field, model_validator

from utils.config_types import Count, Fraction, Section, Several, Share, no_repeats


class Range(NamedTuple):
    """A parameter's range, see `utils.random_ranges`."""

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


def _unsigned(value: Range) -> Range:
    if value.low < 0:
        raise ValueError(f"low ({value.low}) must not be negative")
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
UnsignedRange = Annotated[RangeOf, AfterValidator(_unsigned)]


class PhysicsRangesConfig(Section):
    object_mass: RangeOf
    object_friction: RangeOf
    rolling_friction: RangeOf
    spinning_friction: RangeOf
    table_friction: RangeOf
    finger_friction: RangeOf
    restitution: UnsignedRange
    contact_stiffness: RangeOf
    contact_damping: RangeOf
    robot_mass: RangeOf
    joint_damping: UnsignedRange
    arm_position_gain: RangeOf
    arm_velocity_gain: RangeOf
    gripper_gain: RangeOf
    gravity: RangeOf
    action_noise: UnsignedRange
    action_bias: RangeOf
    latency: UnsignedRange


class VisionRangesConfig(Section):
    light_tilt: UnsignedRange
    light_heading: RangeOf
    light_colour: UnsignedRange
    light_ambient: UnsignedRange
    light_diffuse: UnsignedRange
    light_specular: UnsignedRange
    camera_shift: RangeOf
    camera_turn: RangeOf
    camera_fov: RangeOf
    brightness: RangeOf
    contrast: RangeOf
    saturation: RangeOf
    white_balance: RangeOf
    colour_noise: UnsignedRange
    depth_shift: RangeOf
    depth_jitter: RangeOf
    depth_step: RangeOf


class AdaptiveConfig(Section):
    enabled: bool
    initial: Fraction
    step: Share
    boundary_share: Share
    episodes: Count
    widen_at: Share
    narrow_at: Fraction

    @model_validator(mode="after")
    def _narrow_below_widen(self) -> AdaptiveConfig:
        if self.narrow_at >= self.widen_at:
            raise ValueError(
                f"narrow_at ({self.narrow_at}) must be smaller than widen_at ({self.widen_at})"
            )
        return self


class RandomizationConfig(Section):
    parts: Annotated[tuple[Literal["physics", "vision"], ...], Several, AfterValidator(no_repeats)]
    physics: PhysicsRangesConfig
    vision: VisionRangesConfig
    colour_share: Fraction
    texture_share: Fraction
    texture_folder: Annotated[Path, Field(strict=False)] | None
    shadow_share: Fraction
    depth_noise_share: Fraction
    adaptive: AdaptiveConfig

    @model_validator(mode="after")
    def _adaptive_ranges_are_of_physics(self) -> RandomizationConfig:
        if self.adaptive.enabled and "physics" not in self.parts:
            raise ValueError("adaptive ranges are those of physics: add it to parts")
        return self
