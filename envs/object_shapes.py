"""The shapes of the procedural families: closed forms that a simulator knows, or convex parts.

Each family's shape is drawn by a function of a generator of random numbers, listed in SHAPES. All
lengths are metres. This module knows no simulator.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import trimesh

_SEGMENTS = 16  # convex pieces of a round wall
_DETAILS = {"coarse": (2, 32), "drawn": (3, 64), "fine": (5, 512)}  # of a ball, of a cylinder


@dataclass(frozen=True)
class NativeShape:
    """A shape that Bullet collides in closed form, centred at the origin.

    size in metres: box (x, y, z); cylinder (radius, length along z); sphere (radius,);
    capsule (radius, length along z between the centres of its caps).
    """

    kind: str
    size: tuple[float, ...]

    def mesh(self, detail: Literal["coarse", "drawn", "fine"] = "coarse") -> trimesh.Trimesh:
        """A tessellation. detail: "coarse", a union of few planes; "drawn", within 1 % of the
        radius, for pictures; "fine", for mass properties."""
        subdivisions, sections = _DETAILS[detail]
        if self.kind == "box":
            return trimesh.creation.box(self.size)
        if self.kind == "sphere":
            return trimesh.creation.icosphere(subdivisions, self.size[0])
        radius, length = self.size
        if self.kind == "cylinder":
            return trimesh.creation.cylinder(radius, length, sections=sections)
        # As the hull of two balls: its centre is then ours to choose.
        ball = trimesh.creation.icosphere(subdivisions, radius).vertices
        shift = np.array([0.0, 0.0, length / 2])
        return trimesh.convex.convex_hull(np.concatenate([ball + shift, ball - shift]))


def _box(low, high) -> np.ndarray:
    """(8, 3) corners of an axis-aligned box."""
    corners = np.stack([low, high]).astype(float)
    return np.stack(np.meshgrid(*corners.T, indexing="ij"), axis=-1).reshape(-1, 3)


def _bars(rng: np.random.Generator) -> tuple[float, float, float, float]:
    """Long side, short side, thickness of the bars, and height; metres."""
    return tuple(rng.uniform((0.06, 0.045, 0.014, 0.02), (0.11, 0.08, 0.024, 0.045)))


def _l_shape(rng) -> list[np.ndarray]:
    a, b, w, h = _bars(rng)
    return [_box((0, 0, 0), (a, w, h)), _box((0, w, 0), (w, b, h))]


def _t_shape(rng) -> list[np.ndarray]:
    a, b, w, h = _bars(rng)
    return [_box((-a / 2, 0, 0), (a / 2, w, h)), _box((-w / 2, w, 0), (w / 2, b, h))]


def _u_shape(rng) -> list[np.ndarray]:
    a, b, w, h = _bars(rng)
    a = max(a, 2 * w + 0.035)  # a finger must fit between the legs
    return [
        _box((-a / 2, 0, 0), (a / 2, w, h)),
        _box((-a / 2, w, 0), (-a / 2 + w, b, h)),
        _box((a / 2 - w, w, 0), (a / 2, b, h)),
    ]


def _cross(rng) -> list[np.ndarray]:
    a, b, w, h = _bars(rng)
    return [
        _box((-a / 2, -w / 2, 0), (a / 2, w / 2, h)),
        _box((-w / 2, w / 2, 0), (w / 2, b / 2, h)),
        _box((-w / 2, -b / 2, 0), (w / 2, -w / 2, h)),
    ]


def _z_shape(rng) -> list[np.ndarray]:
    a, b, w, h = _bars(rng)
    return [
        _box((-w / 2, -b / 2, 0), (w / 2, b / 2, h)),
        _box((-a / 2, b / 2, 0), (w / 2, b / 2 + w, h)),
        _box((-w / 2, -b / 2 - w, 0), (a / 2, -b / 2, h)),
    ]


def _frustum(rng) -> list[np.ndarray]:
    bottom, top, height = rng.uniform((0.022, 0.012, 0.04), (0.03, 0.02, 0.1))
    return [_disc(bottom, top, 0, height)]


def _wedge(rng) -> list[np.ndarray]:
    """A right triangle's prism, which the hand spans along its axis."""
    a, b, length = rng.uniform((0.04, 0.03, 0.025), (0.09, 0.06, 0.055))
    triangle = np.array([(0, 0), (a, 0), (0, b)])
    return [np.array([(x, y, z) for x, z in triangle for y in (0.0, length)])]


def _dumbbell(rng) -> list[np.ndarray]:
    radius, weight, bar, reach = rng.uniform(
        (0.018, 0.012, 0.007, 0.03), (0.028, 0.025, 0.012, 0.06)
    )
    return [
        _disc(radius, radius, 0, weight),
        _disc(bar, bar, weight, weight + reach),
        _disc(radius, radius, weight + reach, 2 * weight + reach),
    ]


def _wall(inner, outer, heights) -> list[np.ndarray]:
    """A round wall as convex segments.

    inner, outer: radii at the bottom and at the top; heights: of bottom and top. Metres.
    """
    angles = np.linspace(0, 2 * np.pi, _SEGMENTS + 1)
    circle = np.column_stack([np.cos(angles), np.sin(angles)])

    def corner(radius: float, z: float, k: int) -> np.ndarray:
        return np.append(radius * circle[k], z)

    return [
        np.array([
            corner(radii[end], heights[end], k)
            for radii in (inner, outer) for end in (0, 1) for k in (segment, segment + 1)
        ])
        for segment in range(_SEGMENTS)
    ]  # fmt: skip


def _disc(bottom_radius: float, top_radius: float, z0: float, z1: float) -> np.ndarray:
    angles = np.arange(_SEGMENTS) * 2 * np.pi / _SEGMENTS
    circle = np.column_stack([np.cos(angles), np.sin(angles)])
    return np.concatenate([
        np.column_stack([radius * circle, np.full(_SEGMENTS, z)])
        for radius, z in ((bottom_radius, z0), (top_radius, z1))
    ])  # fmt: skip


def _ring(rng) -> list[np.ndarray]:
    wall, height = rng.uniform((0.008, 0.015), (0.016, 0.035))
    inner = rng.uniform(0.022, 0.035)  # room for a finger
    return _wall((inner, inner), (inner + wall, inner + wall), (0, height))


def _bowl(rng) -> list[np.ndarray]:
    return _open_bowl(*rng.uniform((0.004, 0.02, 0.04, 0.03), (0.007, 0.026, 0.06, 0.055)))


def _open_bowl(wall: float, base: float, rim: float, height: float) -> list[np.ndarray]:
    # The base spans the wall's foot, so that wall and base only touch.
    foot = base + wall
    return [
        _disc(foot, foot, 0, wall),
        *_wall((base, rim - wall), (foot, rim), (wall, height)),
    ]


def _mug(rng) -> list[np.ndarray]:
    wall, radius, height = rng.uniform((0.003, 0.025, 0.055), (0.006, 0.032, 0.09))
    return [*_tumbler(wall, radius, height), *_handle(rng, radius, height)]


def _tumbler(wall: float, radius: float, height: float) -> list[np.ndarray]:
    """A floor and a round wall on it."""
    inner = radius - wall
    floor = _disc(radius, radius, 0, wall)
    return [floor, *_wall((inner, inner), (radius, radius), (wall, height))]


def _handle(rng, radius: float, height: float) -> list[np.ndarray]:
    """The three bars of a mug's handle."""
    bar = rng.uniform(0.006, 0.009)
    reach = rng.uniform(0.02, 0.028)
    low, high = 0.2 * height, 0.85 * height
    # The wall is flat between its corners: the handle starts at the middle of a flat.
    flat = radius * np.cos(np.pi / _SEGMENTS)
    turn = np.pi / _SEGMENTS
    handle = [
        _box((flat, -bar / 2, low), (flat + reach, bar / 2, low + bar)),
        _box((flat, -bar / 2, high - bar), (flat + reach, bar / 2, high)),
        _box((flat + reach - bar, -bar / 2, low + bar), (flat + reach, bar / 2, high - bar)),
    ]
    rotation = np.array([
        [np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]
    ])  # fmt: skip
    return [part @ rotation.T for part in handle]


def _ribbon(points: np.ndarray, width: float, heights, closed: bool = False) -> list[np.ndarray]:
    """A band of `width` along a planar polyline (N, 2), cut at half the angle where it bends, as
    convex segments; its volume is width x length of the line x height. Metres."""
    ends = np.vstack([points[-1:], points, points[:1]]) if closed else points
    along = np.diff(ends, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    if not closed:
        along = np.vstack([along[:1], along, along[-1:]])
    across = np.column_stack([-along[:, 1], along[:, 0]])
    cut = across[:-1] + across[1:]  # at each point; as long as needed for the width on both sides
    cut *= (width / 2) / np.einsum("ij,ij->i", cut, across[1:])[:, None]
    sides = np.stack([points - cut, points + cut], axis=1)  # (N, 2, 2)
    starts = range(len(points) if closed else len(points) - 1)
    return [
        np.array([
            (*sides[k % len(points), side], z)
            for k in (start, start + 1) for side in (0, 1) for z in heights
        ])
        for start in starts
    ]  # fmt: skip


def _arc(length: float, turn: float, count: int) -> np.ndarray:
    """(count + 1, 2) points of a line of `length` that turns evenly by `turn` rad."""
    headings = turn * (np.arange(count) + 0.5) / count
    steps = length / count * np.column_stack([np.cos(headings), np.sin(headings)])
    return np.vstack([np.zeros(2), np.cumsum(steps, axis=0)])


def _ellipse(a: float, b: float, count: int, share: float = 1.0) -> np.ndarray:
    """(count, 2) points of an ellipse, or of the first `share` of its way round."""
    angles = 2 * np.pi * share * np.arange(count) / (count if share == 1.0 else count - 1)
    return np.column_stack([a * np.cos(angles), b * np.sin(angles)])


def _strap(rng) -> list[np.ndarray]:
    """A band that lies flat, or stands on its edge and is bent more."""
    length, side, thick = rng.uniform((0.09, 0.014, 0.005), (0.17, 0.03, 0.008))
    if rng.random() < 0.5:
        return _ribbon(_arc(length, rng.uniform(0, 1.5), 8), side, (0, thick))
    return _ribbon(_arc(length, rng.uniform(0.6, 3.5), 10), thick, (0, side))


def _cable(rng) -> list[np.ndarray]:
    """Two bends, one to either side or both to the same."""
    side, *lengths = rng.uniform((0.008, 0.05, 0.05), (0.012, 0.09, 0.09))
    first, second = rng.uniform((0.3, -2.0), (2.0, 2.0))
    start, end = _arc(lengths[0], first, 6), _arc(lengths[1], second, 6)
    turned = np.array([[np.cos(first), np.sin(first)], [-np.sin(first), np.cos(first)]])
    return _ribbon(np.vstack([start, start[-1] + end[1:] @ turned]), side, (0, side))


def _loop(rng) -> list[np.ndarray]:
    a, b, thick, height = rng.uniform((0.032, 0.022, 0.004, 0.015), (0.065, 0.032, 0.007, 0.04))
    return _ribbon(_ellipse(a, b, 16), thick, (0, height), closed=True)


def _goggles(rng) -> list[np.ndarray]:
    """Two frames, the bridge between them, and a strap behind."""
    radius, wall, depth, bridge, strap = rng.uniform(
        (0.022, 0.004, 0.015, 0.008, 0.004), (0.027, 0.006, 0.025, 0.014, 0.006)
    )
    middle = bridge / 2 + radius + wall / 2  # of a frame
    frame = _ellipse(radius, radius, 12) @ np.array([[0, 1], [-1, 0]])
    # The polygon's outer side, where the bridge and the strap begin.
    edge = radius * np.cos(np.pi / 12) + wall / 2
    frame = frame @ np.array([
        [np.cos(np.pi / 12), np.sin(np.pi / 12)], [-np.sin(np.pi / 12), np.cos(np.pi / 12)]
    ])  # fmt: skip
    gap, outer = middle - edge, middle + edge + strap / 2
    behind = _ellipse(outer, rng.uniform(0.05, 0.08), 10, share=0.5)
    return [
        *_ribbon(frame - [middle, 0], wall, (0, depth), closed=True),
        *_ribbon(frame + [middle, 0], wall, (0, depth), closed=True),
        _box((-gap, -wall / 2, 0), (gap, wall / 2, depth)),
        *_ribbon(behind, strap, (0, depth)),
    ]


def _bottle(rng) -> list[np.ndarray]:
    """Body, shoulder and neck, standing."""
    radius, neck, body, shoulder, top = rng.uniform(
        (0.024, 0.011, 0.08, 0.02, 0.025), (0.033, 0.016, 0.16, 0.04, 0.05)
    )
    return [
        _disc(radius, radius, 0, body),
        _disc(radius, neck, body, body + shoulder),
        _disc(neck, neck, body + shoulder, body + shoulder + top),
    ]


def _plate(rng) -> list[np.ndarray]:
    """A wide rim on a foot, each as thick."""
    radius, thick = rng.uniform((0.065, 0.004), (0.10, 0.007))
    foot = rng.uniform(0.55, 0.7) * radius
    inner = foot - 0.01
    return [
        _disc(foot, foot, 0, thick),
        *_wall((inner, inner), (radius, radius), (thick, 2 * thick)),
    ]


def _cup(rng) -> list[np.ndarray]:
    """Wider than a mug, often than the hand; half of them have a handle."""
    wall, radius, height = rng.uniform((0.003, 0.032, 0.05), (0.006, 0.047, 0.11))
    handle = _handle(rng, radius, height) if rng.random() < 0.5 else []
    return [*_tumbler(wall, radius, height), *handle]


def _cutlery(rng) -> list[np.ndarray]:
    """A thin handle, and a flat blade or head that is mostly wider."""
    length, width, thick = rng.uniform((0.08, 0.009, 0.004), (0.11, 0.02, 0.011))
    long, wide, thin = rng.uniform((0.05, 0.016, 0.003), (0.11, 0.042, 0.007))
    return [
        _box((0, -width / 2, 0), (length, width / 2, thick)),
        _box((length, -wide / 2, 0), (length + long, wide / 2, thin)),
    ]


def _tool(rng) -> list[np.ndarray]:
    """A long handle, in two of three with a thicker head across its end."""
    length, side, thick = rng.uniform((0.13, 0.018, 0.015), (0.26, 0.036, 0.034))
    wide, long, high = rng.uniform((0.05, 0.02, 0.02), (0.13, 0.036, 0.036))
    handle = _box((0, -side / 2, -thick / 2), (length, side / 2, thick / 2))
    if rng.random() < 1 / 3:
        return [handle]
    shift = rng.uniform(-0.3, 0.3) * wide
    low, upper = (length, shift - wide / 2, -high / 2), (length + long, shift + wide / 2, high / 2)
    return [handle, _box(low, upper)]


def _board(rng) -> list[np.ndarray]:
    """Wider than the hand both ways; in two of three something sticks out of a side or the top."""
    a, b, thick = rng.uniform((0.09, 0.1, 0.015), (0.14, 0.17, 0.05))
    slab, kind = _box((0, 0, 0), (a, b, thick)), rng.integers(3)
    place = rng.uniform(0.1, 0.7) * b
    reach, wide = rng.uniform((0.012, 0.01), (0.04, 0.03))
    if kind == 0:
        return [slab]
    if kind == 1:
        low = rng.uniform(0, 0.3) * thick
        return [slab, _box((a, place, low), (a + reach, place + wide, 0.8 * thick))]
    left = rng.uniform(0.1, 0.6) * a
    return [slab, _box((left, place, thick), (left + wide, place + wide, thick + reach))]


def _toy(rng) -> list[np.ndarray]:
    """A body with wings to both sides and a fin on it."""
    length, side, high = rng.uniform((0.07, 0.02, 0.02), (0.18, 0.045, 0.045))
    span, chord, thick = rng.uniform((0.02, 0.02, 0.006), (0.07, 0.05, 0.018))
    start = rng.uniform(0.2, 0.5) * length
    level = rng.uniform(0, 1) * (high - thick)
    wings = [
        _box((start, y, level), (start + min(chord, length - start), y + span, level + thick))
        for y in (-side / 2 - span, side / 2)
    ]
    fin = _box((0, -thick / 2, high), (0.25 * length, thick / 2, high + 0.5 * span))
    return [_box((0, -side / 2, 0), (length, side / 2, high)), *wings, fin]


def _banana(rng) -> list[np.ndarray]:
    length, side = rng.uniform((0.12, 0.026), (0.2, 0.04))
    return _ribbon(_arc(length, rng.uniform(0.4, 1.6), 6), side, (0, side))


def _superellipsoid(half: np.ndarray, upright: float, around: float) -> list[np.ndarray]:
    """One convex solid (|x/a|^(2/n) + |y/b|^(2/n))^(n/e) + |z/c|^(2/e) <= 1 (Barr, IEEE Computer
    Graphics and Applications 1981): a box where both exponents e, `upright`, and n, `around`, are
    small, an ellipsoid where they are 1. half: (3,) a, b and c, metres."""
    height = np.linspace(-np.pi / 2, np.pi / 2, 9)[:, None]
    turn = np.arange(_SEGMENTS) * 2 * np.pi / _SEGMENTS

    def power(value: np.ndarray, exponent: float) -> np.ndarray:
        value = value.round(12)  # the cosine of a right angle is 0
        return np.sign(value) * np.abs(value) ** exponent

    out = power(np.cos(height), upright)
    x, y = out * power(np.cos(turn), around), out * power(np.sin(turn), around)
    z = power(np.sin(height), upright) + 0 * x
    corners = half * np.stack([x, y, z], axis=-1).reshape(-1, 3)
    return [np.asarray(trimesh.convex.convex_hull(corners).vertices)]


def _rounded(rng, least: tuple, most: tuple, boxy: tuple, oval: tuple) -> list[np.ndarray]:
    """A superellipsoid of half sides (3,) between `least` and `most`, m, and of exponents (2,),
    `upright` and `around`, between `boxy` and `oval`."""
    half, exponents = rng.uniform(least, most), rng.uniform(boxy, oval)
    return _superellipsoid(half, *exponents)


# Bounds in metres. Of a convex solid of the first families the two smaller sides stay below 0.06:
# one of them is always across when it lies on a face.
SHAPES = {
    "box": lambda rng: NativeShape(
        "box", tuple(rng.uniform((0.025, 0.025, 0.03), (0.06, 0.06, 0.12)))
    ),
    "cylinder": lambda rng: NativeShape(
        "cylinder", tuple(rng.uniform((0.0125, 0.03), (0.03, 0.12)))
    ),
    "sphere": lambda rng: NativeShape("sphere", (rng.uniform(0.018, 0.03),)),
    "capsule": lambda rng: NativeShape(
        "capsule", tuple(rng.uniform((0.0125, 0.02), (0.028, 0.08)))
    ),
    "L": _l_shape,
    "T": _t_shape,
    "U": _u_shape,
    "cross": _cross,
    "ring": _ring,
    "bowl": _bowl,
    "mug": _mug,
    "frustum": _frustum,
    "wedge": _wedge,
    "Z": _z_shape,
    "dumbbell": _dumbbell,
    "strap": _strap,
    "cable": _cable,
    "loop": _loop,
    "goggles": _goggles,
    "bottle": _bottle,
    "can": lambda rng: NativeShape("cylinder", tuple(rng.uniform((0.024, 0.12), (0.033, 0.18)))),
    "carton": lambda rng: NativeShape(
        "box", tuple(rng.uniform((0.035, 0.045, 0.12), (0.06, 0.08, 0.24)))
    ),
    "plate": _plate,
    "book": lambda rng: NativeShape(
        "box", tuple(rng.uniform((0.09, 0.12, 0.006), (0.13, 0.19, 0.015)))
    ),
    "lid": lambda rng: NativeShape("cylinder", tuple(rng.uniform((0.05, 0.005), (0.085, 0.01)))),
    "package": lambda rng: NativeShape(
        "box", tuple(rng.uniform((0.02, 0.045, 0.07), (0.075, 0.13, 0.2)))
    ),
    "tin": lambda rng: NativeShape("cylinder", tuple(rng.uniform((0.025, 0.03), (0.052, 0.13)))),
    "fruit": lambda rng: NativeShape("sphere", (rng.uniform(0.016, 0.039),)),
    "basin": lambda rng: _open_bowl(
        *rng.uniform((0.004, 0.025, 0.05, 0.035), (0.008, 0.045, 0.085, 0.075))
    ),
    "cup": _cup,
    "cutlery": _cutlery,
    "tool": _tool,
    "board": _board,
    "toy": _toy,
    "banana": _banana,
    "soap": lambda rng: _rounded(
        rng, (0.025, 0.018, 0.01), (0.055, 0.036, 0.022), (0.3, 0.3), (0.9, 1.0)
    ),
    # Bread, or a box whose edges are worn; half of them are wider than the hand.
    "loaf": lambda rng: _rounded(
        rng, (0.04, 0.025, 0.02), (0.09, 0.055, 0.04), (0.15, 0.15), (0.6, 0.7)
    ),
    # A sponge or a filled pouch: its sides lean from the middle of its height on.
    "cushion": lambda rng: _rounded(
        rng, (0.035, 0.022, 0.006), (0.075, 0.055, 0.02), (0.6, 0.15), (1.5, 0.7)
    ),
    # A potato or a stone.
    "pebble": lambda rng: _rounded(
        rng, (0.02, 0.015, 0.01), (0.06, 0.042, 0.035), (0.8, 0.8), (1.2, 1.2)
    ),
}
