"""Solids of meshes in any state, and convex parts that keep hollow things hollow."""

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull

from envs import object_parts
from envs.object_meshes import ObjectError, checked_mesh, decompose, load_mesh
from envs.object_parts import INSIDE_OUT, OPEN, hull_of, simplify_hull, solid_of, union
from tests.helpers.meshes import l_shape


def two_boxes(overlap: float) -> trimesh.Trimesh:
    """Two unit cubes one above the other's half, which share a volume of overlap / 2."""
    second = trimesh.creation.box()
    second.apply_translation((0.5, 0.0, 1.0 - overlap))
    return trimesh.util.concatenate([trimesh.creation.box(), second])


def cup(wall: float = 0.1, open_top: bool = True) -> trimesh.Trimesh:
    """A cylinder of radius 0.5 and height 1 whose hollow leaves walls and bottom of one thickness,
    of 64 sides."""
    outer = trimesh.creation.cylinder(0.5, 1.0, sections=64)
    hollow = trimesh.creation.cylinder(0.5 - wall, 1.0 if open_top else 1 - 2 * wall, sections=64)
    hollow.apply_translation((0, 0, wall if open_top else 0))
    return trimesh.boolean.difference([outer, hollow], engine="manifold")


def prism(radius: float, height: float) -> float:
    """The volume of a prism of 64 sides with its corners on a circle."""
    return 32 * np.sin(2 * np.pi / 64) * radius**2 * height


def inside(points: np.ndarray, part: np.ndarray) -> np.ndarray:
    planes = ConvexHull(part).equations
    return (points @ planes[:, :3].T + planes[:, 3]).max(axis=1) <= 1e-6


def volume(parts: list[np.ndarray]) -> float:
    """Of the union."""
    return union([hull_of(part) for part in parts]).volume()


# --- Parts ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("mesh", [trimesh.creation.box((1, 2, 3)), trimesh.creation.icosphere(4)])
def test_a_convex_mesh_is_one_part(tmp_path, mesh):
    (part,) = decompose(mesh, tmp_path).parts
    assert ConvexHull(part).volume == pytest.approx(mesh.volume, rel=0.1)
    assert len(part) <= object_parts.MAX_VERTICES


def test_convex_pieces_are_taken_apart_exactly(tmp_path):
    parts = decompose(two_boxes(overlap=0.2), tmp_path).parts
    assert sorted(ConvexHull(part).volume for part in parts) == pytest.approx([1.0, 1.0], rel=1e-5)


def test_an_l_is_cut_where_its_boxes_meet_however_it_is_turned(tmp_path):
    mesh = l_shape()
    mesh.apply_transform(trimesh.transformations.rotation_matrix(0.7, [1, 2, 3]))
    parts = decompose(mesh, tmp_path).parts
    assert len(parts) == 2
    assert volume(parts) == pytest.approx(5.0, rel=1e-3)
    assert sorted(ConvexHull(part).volume for part in parts) == pytest.approx([2, 3], rel=1e-3)


@pytest.mark.parametrize("wall", [0.1, 0.05])
def test_a_cup_stays_hollow(tmp_path, wall):
    """Its volume is a difference of two prisms; a ball that its hollow holds touches no part."""
    found = decompose(cup(wall), tmp_path)
    exact = prism(0.5, 1.0) - prism(0.5 - wall, 1.0 - wall)
    assert found.solid.volume == pytest.approx(exact, rel=1e-6)
    assert volume(found.parts) == pytest.approx(exact, rel=0.1)
    assert len(found.parts) <= object_parts.MAX_PARTS
    ball = trimesh.creation.icosphere(3, 0.44 - wall).vertices + (0, 0, wall)
    line = np.linspace([0, 0, wall - 0.44], [0, 0, 0.6], 20)
    for part in found.parts:
        assert not inside(ball, part).any() and not inside(line, part).any()


def test_what_lies_in_a_cavity_has_mass(tmp_path):
    """A hollow cylinder that holds a hollow box with a cube in it, off its axis."""
    boxes = [trimesh.creation.box((side,) * 3) for side in (0.4, 0.3, 0.1)]
    boxes[1].invert()
    for box in boxes:
        box.apply_translation((0.1, 0, 0))
    found = decompose(trimesh.util.concatenate([cup(0.05, open_top=False), *boxes]), tmp_path)
    hollow = prism(0.5, 1.0) - prism(0.45, 0.9)
    held = 0.4**3 - 0.3**3 + 0.1**3
    assert found.solid.volume == pytest.approx(hollow + held, rel=1e-6)
    assert found.solid.centre_of_mass[0] == pytest.approx(0.1 * held / (hollow + held), rel=1e-6)


def test_a_hollow_cylinder_has_its_closed_form(tmp_path):
    tube = trimesh.creation.annulus(0.4, 0.5, 1.0, sections=64)
    found = decompose(tube, tmp_path)
    exact = prism(0.5, 1.0) - prism(0.4, 1.0)
    assert found.solid.volume == pytest.approx(exact, rel=1e-6)
    assert volume(found.parts) == pytest.approx(exact, rel=0.1)
    # of a ring of even density: (r1^2 + r2^2) / 2
    assert found.solid.inertia[2, 2] / exact == pytest.approx((0.4**2 + 0.5**2) / 2, rel=0.01)


def test_parts_cover_the_solid(tmp_path):
    mesh = cup(0.2)
    parts = decompose(mesh, tmp_path).parts
    points = trimesh.sample.volume_mesh(mesh, 3000)
    assert np.any([inside(points, part) for part in parts], axis=0).mean() > 0.97


# --- Solids ---------------------------------------------------------------------------------------


def test_overlapping_pieces_weigh_once(tmp_path):
    solid = decompose(two_boxes(overlap=0.2), tmp_path).solid
    assert solid.volume == pytest.approx(2.0 - 0.2 * 0.5)
    assert solid.centre_of_mass[1] == pytest.approx(0.0, abs=1e-9)


def test_pieces_that_share_an_edge_are_still_two_solids(tmp_path):
    second = trimesh.creation.box()
    second.apply_translation((1.0, 1.0, 0.0))
    mesh = checked_mesh(trimesh.util.concatenate([trimesh.creation.box(), second]), "edge")
    assert not mesh.is_watertight
    found = decompose(mesh, tmp_path)
    assert len(found.parts) == 2 and not found.remark
    assert found.solid.volume == pytest.approx(2.0)


def test_a_hole_of_one_triangle_is_closed(tmp_path):
    box = trimesh.creation.box((1, 2, 3))
    box.update_faces(np.arange(len(box.faces)) != box.area_faces.argmin())
    found = decompose(box, tmp_path)
    assert len(found.parts) == 1 and not found.remark
    assert found.solid.volume == pytest.approx(6.0)
    assert np.diag(found.solid.inertia) == pytest.approx([6 / 12 * 13, 6 / 12 * 10, 6 / 12 * 5])


def test_gaps_that_are_narrow_are_closed_on_a_grid(tmp_path):
    """Six sides of a cube that do not meet."""
    sides = []
    for axis in range(3):
        for sign in (-0.5, 0.5):
            size = np.full(3, 0.97)
            size[axis] = 0.0
            side = trimesh.creation.box(size)
            side.update_faces(side.area_faces > 0)
            side.update_faces(side.face_normals[:, axis] * sign > 0)
            at = np.zeros(3)
            at[axis] = sign
            side.apply_translation(at)
            sides.append(side)
    found = decompose(trimesh.util.concatenate(sides), tmp_path)
    assert found.remark == OPEN
    added = 2 * object_parts.HALF_SHEET / object_parts.CELLS
    assert found.solid.volume == pytest.approx((1 + added) ** 3, rel=0.03)
    assert found.solid.centre_of_mass == pytest.approx(np.zeros(3), abs=0.01)


def test_a_sheet_becomes_a_plate_and_stays_open():
    """A can without a lid, of one layer of triangles."""
    can = trimesh.creation.cylinder(0.5, 1.0, sections=64)
    can.update_faces(can.face_normals[:, 2] < 0.5)
    solid = solid_of(can)
    assert solid.remark == OPEN
    plate = 2 * object_parts.HALF_SHEET / object_parts.CELLS  # less what a grid rounds off
    assert 0.8 * can.area * plate < solid.outer().volume() < can.area * plate
    hollow = hull_of(trimesh.creation.cylinder(0.5 - plate, 1.0).vertices + (0, 0, plate))
    assert (solid.outer() ^ hollow).volume() < 1e-4


def test_a_mesh_turned_inside_out_is_turned_back(tmp_path):
    box = trimesh.creation.box()
    box.invert()
    box.export(tmp_path / "box.stl")
    found = decompose(load_mesh(tmp_path / "box.stl"), tmp_path)
    assert found.remark == INSIDE_OUT
    assert found.solid.volume == pytest.approx(1.0)


def test_a_cavity_weighs_nothing_and_is_no_mistake(tmp_path):
    found = decompose(cup(0.2, open_top=False), tmp_path)
    assert not found.remark and len(found.parts) == 1
    assert found.solid.volume == pytest.approx(prism(0.5, 1.0) - prism(0.3, 0.6))


def test_a_mesh_without_volume_is_refused(tmp_path):
    """Two triangles, back to back, are closed but hold nothing; a third corner is elsewhere."""
    vertices = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1]]
    faces = [[0, 1, 2], [0, 2, 1], [3, 4, 5], [3, 5, 4]]
    with pytest.raises(ObjectError, match="flat bounds no volume"):
        decompose(trimesh.Trimesh(vertices, faces, process=False), tmp_path, "flat")


def test_a_sliver_does_not_fail_for_lack_of_digits(tmp_path):
    """Qhull finds such hulls flat, which ended a preparation with a precision error."""
    sliver = trimesh.creation.box((1, 1, 1e-13))
    mesh = trimesh.util.concatenate([trimesh.creation.box(), sliver])
    assert decompose(mesh, tmp_path).solid.volume == pytest.approx(1.0)
    assert len(simplify_hull(np.random.default_rng(0).random((100, 3)) * (1, 1, 1e-14))) >= 4


# --- Hulls ----------------------------------------------------------------------------------------


def test_simplified_hull_keeps_within_its_tolerance():
    """A ball would need more vertices than a part has. Of a cone it is the tip and 32 of the rim:
    at a radius of 0.4 they are 0.4 (1 - cos(pi / 32)) = 0.0019 off the circle, and at a radius of
    0.13, 16 would be 0.0025 off; about as much along the normal of the side."""
    ball = trimesh.creation.icosphere(3, 0.5).vertices
    assert len(simplify_hull(ball)) == object_parts.MAX_VERTICES
    for radius in (0.4, 0.13):
        cone = trimesh.creation.cone(radius, 1.0, sections=256).vertices
        few = simplify_hull(cone)
        planes = ConvexHull(few).equations
        assert (cone @ planes[:, :3].T + planes[:, 3]).max() <= 0.002 + 1e-9
        assert len(few) == 1 + 32


def test_simplifying_a_box_changes_nothing():
    corners = trimesh.creation.box((1, 2, 3)).vertices
    assert {*map(tuple, simplify_hull(corners))} == {*map(tuple, corners)}
