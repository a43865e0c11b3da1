"""Procedural solids: known volumes, hollow ones that are hollow, and sides that the hand spans."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from envs.object_bodies import MIN_MASS
from envs.object_primitives import (
    FAMILIES,
    FLAT_FAMILIES,
    HOUSEHOLD_FAMILIES,
    ROUNDED_DENSITIES,
    ROUNDED_FAMILIES,
    TALL_FAMILIES,
    THIN_FAMILIES,
    UNSEEN_FAMILIES,
    make_primitive,
)
from envs.objects import fits, load_object_set
from tests.helpers.simulators import pybullet
from utils.geometry import GripperGeometry

if pybullet is not None:
    from envs.pybullet_bodies import spawn

IDENTITY = (0, 0, 0, 1)


def primitive(family: str, cache_dir: Path):
    return load_object_set("primitives", split="train", cache_dir=cache_dir)[FAMILIES.index(family)]


def step(client: int, count: int) -> None:
    for _ in range(count):
        pybullet.stepSimulation(physicsClientId=client)


def ball(client: int, radius: float, position) -> int:
    shape = pybullet.createCollisionShape(
        pybullet.GEOM_SPHERE, radius=radius, physicsClientId=client
    )
    return pybullet.createMultiBody(0.01, shape, basePosition=position, physicsClientId=client)


def height(client: int, body: int) -> float:
    return pybullet.getBasePositionAndOrientation(body, physicsClientId=client)[0][2]


@pytest.mark.parametrize("family", ["sphere", "cylinder", "capsule"])
def test_round_natives_have_the_closed_form_volume(tmp_path, family):
    shape = make_primitive(FAMILIES.index(family))
    radius, length = (*shape.native.size, 0.0)[:2]
    closed_form = {
        "sphere": 4 / 3 * np.pi * radius**3,
        "cylinder": np.pi * radius**2 * length,
        "capsule": np.pi * radius**2 * length + 4 / 3 * np.pi * radius**3,
    }
    model = primitive(family, tmp_path)
    assert model.mass / shape.density == pytest.approx(closed_form[family], rel=2e-3)


def test_pybullet_gets_what_the_model_says(tmp_path, client):
    for model in (primitive("mug", tmp_path), primitive("sphere", tmp_path)):
        body = spawn(client, model, (0.1, 0.2, 0.3), IDENTITY)
        info = pybullet.getDynamicsInfo(body, -1, physicsClientId=client)
        assert info[0] == pytest.approx(model.mass)
        assert info[1] == pytest.approx(model.friction)
        assert info[2] == pytest.approx(model.inertia)
        position, _ = pybullet.getBasePositionAndOrientation(body, physicsClientId=client)
        assert position == pytest.approx((0.1, 0.2, 0.3))


@pytest.mark.parametrize("family", ["mug", "bowl"])
def test_hollow_things_hold_a_ball(tmp_path, client, family):
    model = primitive(family, tmp_path)
    low, high = (f(np.concatenate(model.parts)[:, 2]) for f in (np.min, np.max))
    axis = -np.array([part.mean(axis=0) for part in model.parts[:17]]).mean(axis=0)
    body = spawn(client, model, (0, 0, -low), IDENTITY)
    marble = ball(client, 0.01, (-axis[0], -axis[1], high - low + 0.02))
    step(client, 480)
    assert height(client, marble) < height(client, body) + high - 0.02


def test_a_rod_passes_through_the_ring_and_a_ray_does(tmp_path, client):
    ring = primitive("ring", tmp_path)
    top = ring.extents[2] / 2
    body = spawn(client, ring, (0, 0, top), IDENTITY)
    rod_shape = pybullet.createCollisionShape(
        pybullet.GEOM_CYLINDER, radius=0.01, height=0.2, physicsClientId=client
    )
    rod = pybullet.createMultiBody(0, rod_shape, basePosition=(0, 0, 0.11), physicsClientId=client)
    pybullet.performCollisionDetection(physicsClientId=client)
    assert not pybullet.getContactPoints(body, rod, physicsClientId=client)
    wall = np.concatenate(ring.parts)[:, 0].max() - 0.004
    ends = [(0.0, 0.0), (wall, 0.0)]
    assert [_line_meets(ring, x, y) for x, y in ends] == [False, True]


def _line_meets(model, x: float, y: float) -> bool:
    """Whether the vertical line through (x, y) meets the model's geometry."""
    for solid in model.geometry():
        slope = solid.normals[:, 2]
        gap = solid.offsets - solid.normals[:, :2] @ (x, y)
        upper = (gap[slope > 1e-9] / slope[slope > 1e-9]).min()
        lower = (gap[slope < -1e-9] / slope[slope < -1e-9]).max()
        if (gap[abs(slope) <= 1e-9] >= 0).all() and lower < upper:
            return True
    return False


@pytest.mark.parametrize("index", range(len(FAMILIES)))
def test_an_object_rests_on_the_plane_where_its_geometry_ends(tmp_path, client, index):
    """So that the camera, the labels and the physics agree about the surface."""
    model = load_object_set("primitives", split="train", cache_dir=tmp_path)[index]
    low = np.concatenate(model.parts)[:, 2].min()
    body = spawn(client, model, (0, 0, 0.0005 - low), IDENTITY)
    step(client, 120)
    assert height(client, body) == pytest.approx(-low, abs=3e-4)


def test_every_family_has_a_side_that_the_hand_can_span():
    for index in range(900, 1000):
        shape = make_primitive(index)
        if len(shape.parts) == 1:
            sides = np.sort(np.ptp(shape.parts[0], axis=0))
            assert sides[1] <= 0.065
        else:  # a bar or a wall: a part whose thinner side fits
            assert min(np.ptp(part, axis=0).min() for part in shape.parts) <= 0.065


def test_parts_of_primitives_touch_but_do_not_overlap():
    hollow = [(FAMILIES, FAMILIES.index(family))
              for family in ("L", "T", "U", "cross", "ring", "bowl", "mug")]  # fmt: skip
    for families, index in (*hollow, *((HOUSEHOLD_FAMILIES, index) for index in range(40))):
        parts = make_primitive(index, families=families).parts
        hulls = [trimesh.convex.convex_hull(part) for part in parts]
        union = trimesh.boolean.union(hulls, engine="manifold")
        assert union.volume == pytest.approx(sum(hull.volume for hull in hulls), rel=1e-3)
        # one body, but for slivers of rounding where two surfaces touch
        assert max(piece.volume for piece in union.split()) > 0.999 * union.volume


def test_unseen_families_have_the_closed_form_volume_and_fit_the_hand():
    """Round parts are prisms and frusta over a regular 16-gon, 8 r^2 sin(pi / 8)."""

    def gon(r0: float, r1: float, height: float) -> float:
        return 8 * np.sin(np.pi / 8) * height / 3 * (r0**2 + r0 * r1 + r1**2)

    for index in range(40):
        shape = make_primitive(index, families=UNSEEN_FAMILIES)
        family, part = UNSEEN_FAMILIES[index % 4], shape.parts[0]
        assert shape.name == f"{family}_{index:04d}"
        volumes = [trimesh.convex.convex_hull(part).volume for part in shape.parts]
        low, high = part[:16], part[16:]
        if family == "frustum":
            expected = [gon(low[0, 0], high[0, 0], high[0, 2])]
            assert np.ptp(part[:, 0]) <= 0.06
        elif family == "wedge":
            x, y, z = part.max(axis=0)
            expected = [x * y * z / 2]
            assert y <= 0.06  # between its two parallel triangles
        elif family == "Z":
            expected = [np.prod(np.ptp(box, axis=0)) for box in shape.parts]
            assert max(np.ptp(box, axis=0).min() for box in shape.parts) <= 0.06
        else:
            expected = [gon(p[0, 0], p[0, 0], np.ptp(p[:, 2])) for p in shape.parts]
            assert np.ptp(part[:, 0]) <= 0.06
        assert volumes == pytest.approx(expected, rel=1e-6)
        assert 0.03 - 1e-6 <= shape.density * sum(volumes) <= 0.3 + 1e-6
        hulls = [trimesh.convex.convex_hull(part) for part in shape.parts]
        if len(hulls) > 1:  # the parts touch but do not overlap
            union = trimesh.boolean.union(hulls, engine="manifold")
            assert union.volume == pytest.approx(sum(volumes), rel=1e-3)


@pytest.mark.parametrize("index", range(12))
def test_thin_things_are_one_body_that_the_hand_can_span(tmp_path, index):
    shape = make_primitive(index, families=THIN_FAMILIES)
    hulls = [trimesh.convex.convex_hull(part) for part in shape.parts]
    volume, union = sum(hull.volume for hull in hulls), trimesh.boolean.union(hulls, "manifold")
    assert 0.985 * volume < union.volume < 1.001 * volume
    assert max(piece.volume for piece in union.split()) > 0.99 * union.volume
    assert min(np.ptp(part, axis=0).min() for part in shape.parts) <= 0.031
    assert np.ptp(np.concatenate(shape.parts), axis=0).max() < 0.2
    model = load_object_set("thin", split="train", cache_dir=tmp_path)[index]
    assert model.mass == pytest.approx(shape.density * volume)
    assert 0.03 - 1e-6 <= model.mass <= 0.3 + 1e-6


@pytest.mark.parametrize("index", range(6))
def test_tall_things_are_higher_than_the_hand_is_long_and_narrow(index):
    for number in (index, index + 30):
        shape = make_primitive(number, families=TALL_FAMILIES)
        sides = np.ptp(np.concatenate(shape.parts), axis=0)
        assert 0.12 <= sides[2] <= 0.25 and sides[:2].min() <= 0.067
        heights = sorted((part[:, 2].min(), part[:, 2].max()) for part in shape.parts)
        assert all(
            below[1] == pytest.approx(above[0]) for below, above in zip(heights, heights[1:])
        )


@pytest.mark.parametrize("index", range(6))
def test_flat_things_are_too_wide_for_the_hand_and_too_low_for_it_on_a_table(tmp_path, index):
    """The tips keep 4 mm over the table, and 6 mm of an object have to rise between them."""
    shape = make_primitive(index, families=FLAT_FAMILIES)
    sides = np.ptp(np.concatenate(shape.parts), axis=0)
    assert sides[:2].min() > 0.085 and 0.005 <= sides[2] <= 0.015
    model = load_object_set("flat", split="train", cache_dir=tmp_path)[index]
    assert 0.03 - 1e-6 <= model.mass <= 0.3 + 1e-6
    # From the side the hand spans it.
    assert fits(model, GripperGeometry())


@pytest.mark.parametrize(("family", "sides"), [
    ("package", (0.075, 0.13, 0.2)), ("tin", (0.104, 0.104, 0.13)), ("fruit", (0.078,) * 3),
    ("basin", (0.17, 0.17, 0.075)), ("cup", (0.125, 0.095, 0.11)),
    ("cutlery", (0.22, 0.042, 0.011)), ("board", (0.18, 0.17, 0.09)),
    ("tool", (0.296, 0.13, 0.036)), ("toy", (0.18, 0.185, 0.08)), ("banana", (0.2, 0.2, 0.04)),
])  # fmt: skip
def test_household_things_are_as_large_as_such_things(family, sides):
    for k in range(5):
        index = HOUSEHOLD_FAMILIES.index(family) + k * len(HOUSEHOLD_FAMILIES)
        shape = make_primitive(index, families=HOUSEHOLD_FAMILIES)
        assert shape.name == f"{family}_{index:04d}"
        own = np.ptp(np.concatenate(shape.parts), axis=0)
        assert (own <= np.array(sides) + 1e-9).all() and (own > 0.15 * np.array(sides)).all()


@pytest.mark.parametrize(("family", "sides"), [
    ("soap", (0.11, 0.072, 0.044)), ("loaf", (0.18, 0.11, 0.08)), ("cushion", (0.15, 0.11, 0.04)),
    ("pebble", (0.12, 0.084, 0.07)),
])  # fmt: skip
def test_rounded_things_are_superellipsoids_as_large_as_such_things(tmp_path, family, sides):
    """Barr's two exponents from three corners of the grid; then all corners fulfil his equation."""
    for k in range(5):
        index = ROUNDED_FAMILIES.index(family) + k * len(ROUNDED_FAMILIES)
        shape = make_primitive(index, families=ROUNDED_FAMILIES)
        assert shape.name == f"{family}_{index:04d}"
        (corners,) = shape.parts
        half = np.abs(corners).max(axis=0)
        assert (2 * half <= np.array(sides) + 1e-9).all() and (
            2 * half > 0.25 * np.array(sides)
        ).all()
        part = np.abs(corners) / half
        middle, side = part[:, 2] < 1e-9, part[:, 1] < 1e-9
        # At 45 degrees around the middle, and at 45 degrees over it, both coordinates are
        # sqrt(1/2) to the power of the exponent.
        around = part[middle & np.isclose(part[:, 0], part[:, 1], rtol=1e-6)][0, 0]
        upright = part[side & np.isclose(part[:, 0], part[:, 2], rtol=1e-6)][0, 0]
        n, e = (np.log(value) / np.log(np.sqrt(0.5)) for value in (around, upright))
        x, y, z = part.T
        value = (x ** (2 / n) + y ** (2 / n)) ** (n / e) + z ** (2 / e)
        np.testing.assert_allclose(value, 1.0, atol=1e-6)
        hull = trimesh.convex.convex_hull(corners)
        assert hull.is_volume
        low, high = ROUNDED_DENSITIES[family]
        assert low <= shape.density <= high
        model = load_object_set("rounded", split="train", cache_dir=tmp_path)[index]
        assert model.mass == pytest.approx(max(shape.density * hull.volume, MIN_MASS))


def test_a_band_has_the_volume_of_its_line():
    """Cut at half the angle, a bend adds outside what it takes inside."""
    ring = make_primitive(THIN_FAMILIES.index("loop"), families=THIN_FAMILIES).parts
    corners = np.array([(part[:4, :2].mean(axis=0)) for part in ring])
    length = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1).sum()
    width = np.linalg.norm(ring[0][0, :2] - ring[0][2, :2])  # along the cut at a corner
    outline = np.roll(corners, -1, axis=0) - corners
    turns = outline[-1, 0] * outline[0, 1] - outline[-1, 1] * outline[0, 0]
    sides = np.linalg.norm(outline[-1]) * np.linalg.norm(outline[0])
    width *= np.cos(np.arcsin(turns / sides) / 2)
    height = np.ptp(ring[0][:, 2])
    volume = sum(trimesh.convex.convex_hull(part).volume for part in ring)
    assert volume == pytest.approx(width * length * height, rel=1e-6)


def test_a_primitive_depends_on_its_index_alone():
    for index in (0, 10, 905):
        first, second = make_primitive(index), make_primitive(index)
        assert first.color == second.color and first.density == second.density
        for a, b in zip(first.parts, second.parts, strict=True):
            assert np.array_equal(a, b)
    assert make_primitive(0).color != make_primitive(11).color
