"""Whether a hand can take an object: boxes, balls and cylinders of known size."""

import numpy as np
import pytest
import trimesh

from envs.object_primitives import make_primitive
from envs.object_shapes import NativeShape
from models.graspable import is_graspable, resting_poses
from utils.geometry import ConvexSolid, GripperGeometry

HAND = GripperGeometry()


def solids(kind: str, *size: float) -> tuple[ConvexSolid, ...]:
    return (ConvexSolid.from_vertices(NativeShape(kind, size).mesh().vertices),)


@pytest.mark.parametrize(
    ("sides", "fits"),
    [((0.07, 0.07, 0.07), True), ((0.05, 0.12, 0.20), True), ((0.073, 0.15, 0.15), True),
     ((0.076, 0.15, 0.15), False), ((0.09, 0.09, 0.03), True), ((0.09, 0.09, 0.09), False)],
)  # fmt: skip
def test_a_box_fits_whose_smallest_side_leaves_3_mm_beside_each_finger(sides, fits):
    assert is_graspable(solids("box", *sides), 0.7, HAND) == fits
    assert is_graspable(solids("box", *sides), 0.7, GripperGeometry(max_opening=0.10))


@pytest.mark.parametrize(("radius", "fits"), [(0.03, True), (0.036, True), (0.06, False)])
def test_a_ball_fits_up_to_its_diameter(radius, fits):
    """Over the equator of a ball of 12 cm, a rough one of 80 facets, the hand finds 74 mm, but its
    pads would slide off: they are 52 degrees from vertical there, and the friction cone has 35."""
    ball = trimesh.creation.icosphere(1, radius).vertices
    assert is_graspable([ConvexSolid.from_vertices(ball)], 0.7, HAND) == fits


def test_a_wide_ring_fits_by_its_wall():
    """14 cm wide, its wall of 12 boxes is 2 cm thick."""
    around = np.arange(12) * np.pi / 6
    box = NativeShape("box", (0.02, 0.036, 0.04)).mesh().vertices + (0.06, 0, 0)
    turns = [
        np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) for c, s in zip(np.cos(around), np.sin(around))
    ]
    assert is_graspable([ConvexSolid.from_vertices(box @ R.T) for R in turns], 0.7, HAND)
    assert not is_graspable(solids("cylinder", 0.07, 0.09), 0.7, HAND)


@pytest.mark.parametrize("index", [900, 907, 933, 934])
def test_a_primitive_fits_as_all_of_them_do(index):
    """Two bowls, whose sloping walls leave few grasps, a T and a mug."""
    shape = make_primitive(index)
    parts = [ConvexSolid.from_vertices(part) for part in shape.parts]
    middle = np.concatenate(shape.parts).mean(axis=0)
    T = np.eye(4)
    T[:3, 3] = -middle
    centred = [part.transformed(T) for part in parts]
    assert is_graspable(centred, shape.friction, HAND), shape.name


def test_a_box_rests_on_each_of_its_faces_and_a_toppling_one_does_not():
    sides = np.array([0.03, 0.05, 0.08])
    poses = list(resting_poses(solids("box", *sides)))
    heights = [T[2, 3] for T in poses]
    assert heights == pytest.approx(sorted([*(sides / 2), *(sides / 2)]))
    corners = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * sides / 2
    for T in poses:
        assert (corners @ T[:3, :3].T + T[:3, 3])[:, 2].min() == pytest.approx(0.0, abs=1e-12)
    # A wedge that overhangs its small face: the centre of mass is not over it.
    leaning = corners + [[0.06 * (z > 0), 0, 0] for z in corners[:, 2]]
    centred = leaning - leaning.mean(axis=0)
    undersides = [T[2, :3] for T in resting_poses([ConvexSolid.from_vertices(centred)])]
    assert not any(abs(down @ (0, 0, 1)) > 0.99 for down in undersides)
