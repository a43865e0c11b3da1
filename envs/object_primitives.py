"""Procedural solids: eleven families, four that no training sees, four of thin and dark things,
three of tall, three of flat, ten of household and four of rounded ones, each object determined by
its index alone.

A hand that opens 0.08 m can grasp every one of them, but for flat, household and rounded ones, in
every resting pose: across the whole, across a bar, or across a wall with one finger inside. Flat
ones are wider than the hand and too thin to be gripped from above where they lie on a table. Of the
others, which have sizes and masses of what lies in kitchens and on workbenches, some are wider than
the hand as they lie, and some household ones however they lie. This module knows no simulator.
"""

from __future__ import annotations

import colorsys
from dataclasses import dataclass

import numpy as np
import trimesh

from envs.object_shapes import SHAPES, NativeShape

FAMILIES = (
    "box", "cylinder", "sphere", "capsule", "L", "T", "U", "cross", "ring", "bowl", "mug",
)  # fmt: skip
UNSEEN_FAMILIES = ("frustum", "wedge", "Z", "dumbbell")
# What a depth camera sees worst, and photographs of household things are full of.
THIN_FAMILIES = ("strap", "cable", "loop", "goggles")
TALL_FAMILIES = ("bottle", "can", "carton")  # 12 to 25 cm high where they stand
FLAT_FAMILIES = ("plate", "book", "lid")  # 5 to 15 mm high where they lie, wider than the hand
# Masses in kg, of household things, which are full or empty.
HOUSEHOLD_MASSES = {
    "package": (0.04, 0.9), "tin": (0.1, 0.6), "fruit": (0.02, 0.25), "basin": (0.1, 0.4),
    "cup": (0.02, 0.35), "cutlery": (0.02, 0.08), "tool": (0.05, 0.8), "board": (0.1, 1.4),
    "toy": (0.03, 0.2), "banana": (0.05, 0.2),
}  # fmt: skip
HOUSEHOLD_FAMILIES = tuple(HOUSEHOLD_MASSES)
# Densities in kg/m3 of things without edges, whose sides lean, so that fingers slip off them: from
# foam and bread to what floats just so, and stones.
ROUNDED_DENSITIES = {
    "soap": (850, 1150), "loaf": (150, 700), "cushion": (50, 700), "pebble": (900, 2600),
}  # fmt: skip
ROUNDED_FAMILIES = tuple(ROUNDED_DENSITIES)
_STREAMS = {
    FAMILIES: (), UNSEEN_FAMILIES: (1,), THIN_FAMILIES: (2,), TALL_FAMILIES: (3,),
    FLAT_FAMILIES: (4,), HOUSEHOLD_FAMILIES: (5,), ROUNDED_FAMILIES: (6,),
}  # fmt: skip
_SEED = 20240501
_DENSITIES, _MASS_RANGE = (300, 1500), (0.03, 0.3)  # of the other families
_HOUSEHOLD_DENSITIES = (100, 2500)  # kg/m3
_DARK_SHARE, _DARKENED = 0.6, 0.12  # of the thin things, and their colours


@dataclass(frozen=True)
class Primitive:
    """One procedural object: its shape (native, or convex parts (V, 3) in metres) and matter.

    density kg/m3, friction against a surface of friction 1, colour RGBA in 0..1.
    """

    name: str
    native: NativeShape | None
    parts: tuple[np.ndarray, ...]
    density: float
    friction: float
    color: tuple[float, float, float, float]


def make_primitive(
    index: int, scale: float = 1.0, families: tuple[str, ...] = FAMILIES
) -> Primitive:
    """The object of this index; families take turns, so any run of indices is balanced. families:
    one of the module's groups, which count each by themselves."""
    rng = np.random.default_rng([_SEED, index, *_STREAMS[families]])
    family = families[index % len(families)]
    shape = SHAPES[family](rng)
    native = None
    if isinstance(shape, NativeShape):
        native = NativeShape(shape.kind, tuple(float(scale * side) for side in shape.size))
        parts = (np.asarray(native.mesh().vertices),)
        volume = native.mesh("fine").volume
    else:
        parts = tuple(scale * part for part in shape)
        volume = sum(trimesh.convex.convex_hull(part).volume for part in parts)
    if family in ROUNDED_DENSITIES:
        density = float(rng.uniform(*ROUNDED_DENSITIES[family]))
    elif family in HOUSEHOLD_MASSES:
        mass = rng.uniform(*HOUSEHOLD_MASSES[family])
        density = float(np.clip(mass / volume, *_HOUSEHOLD_DENSITIES))
    else:
        masses = (mass / volume for mass in _MASS_RANGE)
        density = float(np.clip(rng.uniform(*_DENSITIES), *masses))
    friction = float(rng.uniform(0.4, 1.0))
    color = random_color(rng)
    if families == THIN_FAMILIES and rng.random() < _DARK_SHARE:
        color = (*(_DARKENED * channel for channel in color[:3]), 1.0)
    return Primitive(f"{family}_{index:04d}", native, parts, density, friction, color)


def random_color(rng: np.random.Generator) -> tuple[float, float, float, float]:
    """A saturated, rather bright colour of any hue."""
    hue, saturation, value = rng.uniform((0, 0.4, 0.5), (1, 0.9, 0.95))
    return (*map(float, colorsys.hsv_to_rgb(hue, saturation, value)), 1.0)
