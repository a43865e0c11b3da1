"""Meshes: convex parts that cover the solid, mass properties, and a cache that can be trusted."""

import coacd
import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull

from envs import object_meshes
from envs.object_meshes import (
    ObjectError,
    checked_mesh,
    decompose,
    load_mesh,
    mass_properties,
    parse_xml,
    simplify_hull,
)


@pytest.fixture
def l_shape() -> trimesh.Trimesh:
    """One clean, concave surface: a 3 x 3 x 1 slab without its upper right 2 x 2 quarter."""
    slab = trimesh.creation.box(bounds=[[0, 0, 0], [3, 3, 1]])
    quarter = trimesh.creation.box(bounds=[[1, 1, -1], [4, 4, 2]])
    return trimesh.boolean.difference([slab, quarter], engine="manifold")


def two_boxes(overlap: float) -> trimesh.Trimesh:
    """Two unit cubes one above the other's half, which share a volume of overlap / 2."""
    second = trimesh.creation.box()
    second.apply_translation((0.5, 0.0, 1.0 - overlap))
    return trimesh.util.concatenate([trimesh.creation.box(), second])


def inside(points: np.ndarray, part: np.ndarray) -> np.ndarray:
    planes = ConvexHull(part).equations
    return (points @ planes[:, :3].T + planes[:, 3]).max(axis=1) <= 1e-6


def test_convex_pieces_are_taken_apart_exactly(tmp_path):
    parts = decompose(two_boxes(overlap=0.2), tmp_path)
    assert sorted(ConvexHull(part).volume for part in parts) == pytest.approx([1.0, 1.0], rel=1e-5)


def test_overlapping_pieces_weigh_once(tmp_path):
    mesh = two_boxes(overlap=0.2)
    solid = mass_properties(mesh, decompose(mesh, tmp_path))
    assert solid.volume == pytest.approx(2.0 - 0.2 * 0.5)
    assert solid.centre_of_mass[1] == pytest.approx(0.0, abs=1e-9)


def test_pieces_that_share_an_edge_are_still_two_solids(tmp_path):
    second = trimesh.creation.box()
    second.apply_translation((1.0, 1.0, 0.0))
    mesh = object_meshes.checked_mesh(
        trimesh.util.concatenate([trimesh.creation.box(), second]), "edge"
    )
    assert not mesh.is_watertight
    parts = decompose(mesh, tmp_path)
    assert len(parts) == 2
    assert mass_properties(mesh, parts).volume == pytest.approx(2.0)


def test_mass_properties_of_an_open_mesh_come_from_its_parts(tmp_path):
    box = trimesh.creation.box((1, 2, 3))
    box.update_faces(np.arange(len(box.faces)) > 0)
    solid = mass_properties(box, [box.vertices])
    assert solid.volume == pytest.approx(6.0)
    assert np.diag(solid.inertia) == pytest.approx([6 / 12 * 13, 6 / 12 * 10, 6 / 12 * 5])


def test_a_concave_surface_is_cut_and_stays_concave(tmp_path, l_shape):
    parts = decompose(l_shape, tmp_path)
    assert 2 <= len(parts) <= object_meshes.MAX_PARTS
    assert max(map(len, parts)) <= object_meshes.MAX_VERTICES
    surface = trimesh.sample.sample_surface(l_shape, 500, seed=0)[0]
    centre = l_shape.bounds.mean(axis=0)
    within = centre + 0.97 * (surface - centre)
    assert np.any([inside(within, part) for part in parts], axis=0).all()
    missing_quarter = np.array([[2.0, 2.0, 0.5], [1.5, 1.5, 0.5]])
    assert not np.any([inside(missing_quarter, part) for part in parts])


def test_decomposition_runs_once_for_a_shape_whatever_its_units(tmp_path, l_shape, monkeypatch):
    calls = []
    run_coacd = coacd.run_coacd
    monkeypatch.setattr(coacd, "run_coacd", lambda *a, **k: calls.append(1) or run_coacd(*a, **k))
    first = decompose(l_shape, tmp_path)
    millimetres = l_shape.copy()
    millimetres.apply_scale(1000)
    second = decompose(millimetres, tmp_path)
    assert len(calls) == 1
    for a, b in zip(first, second, strict=True):
        assert b == pytest.approx(1000 * a, rel=1e-9, abs=1e-6)


def test_a_corrupt_cache_file_is_named(tmp_path):
    mesh = trimesh.creation.box()
    decompose(mesh, tmp_path)
    (file,) = tmp_path.glob("parts-*.npz")
    file.write_bytes(file.read_bytes()[:40])
    with pytest.raises(ObjectError, match=f"{file.name} is corrupt .*; delete it and run again"):
        decompose(mesh, tmp_path)


def test_a_corrupt_hull_file_is_named(tmp_path):
    file = object_meshes.write_parts_obj([trimesh.creation.box().vertices], tmp_path)
    file.write_text("o nothing\n")
    with pytest.raises(ObjectError, match="delete it and run again"):
        object_meshes.write_parts_obj([trimesh.creation.box().vertices], tmp_path)


def test_writing_leaves_no_temporary_file(tmp_path):
    decompose(trimesh.creation.box(), tmp_path)
    assert [file.suffix for file in tmp_path.iterdir()] == [".npz"]


def test_simplified_hull_keeps_within_its_tolerance():
    ball = trimesh.creation.icosphere(3, 0.5).vertices
    assert len(simplify_hull(ball, max_vertices=32)) == 32
    few = simplify_hull(ball, max_vertices=1000, tolerance=0.01)
    planes = ConvexHull(few).equations
    assert (ball @ planes[:, :3].T + planes[:, 3]).max() <= 0.01 + 1e-9
    assert len(few) < len(ball) / 2


def test_simplifying_a_box_changes_nothing():
    corners = trimesh.creation.box((1, 2, 3)).vertices
    assert {*map(tuple, simplify_hull(corners))} == {*map(tuple, corners)}


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        ("", "cannot be read|no triangles"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "is flat"),
        ("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "degenerate"),
        ("v nan 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\n", "1 of 4 vertices .* finite"),
    ],
)
def test_broken_meshes_are_named_with_their_reason(tmp_path, content, reason):
    path = tmp_path / "broken.obj"
    path.write_text(content)
    with pytest.raises(ObjectError, match=f"broken.obj .*({reason})"):
        load_mesh(path)


def test_a_missing_mesh_is_named(tmp_path):
    with pytest.raises(ObjectError, match="none.stl does not exist"):
        load_mesh(tmp_path / "none.stl")


def test_a_mesh_turned_inside_out_is_turned_back(tmp_path):
    box = trimesh.creation.box()
    box.invert()
    box.export(tmp_path / "box.stl")
    assert load_mesh(tmp_path / "box.stl").volume == pytest.approx(1.0)


def test_a_damaged_byte_anywhere_in_the_cache_is_refused_or_harmless(tmp_path):
    bracket = trimesh.util.concatenate(
        [trimesh.creation.box([1, 1, 4]), trimesh.creation.box([3, 1, 1])]
    )
    decompose(bracket, tmp_path)
    (path,) = tmp_path.glob("parts-*.npz")
    whole = path.read_bytes()
    compared = 0
    for place in range(0, len(whole), 7):
        damaged = bytearray(whole)
        damaged[place] ^= 0xFF
        path.write_bytes(bytes(damaged))
        try:
            decompose(bracket, tmp_path)
        except ObjectError as error:
            assert path.name in str(error)
            compared += 1
    assert compared > len(whole) / 7 / 2


# --- Hostile files --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "corner", ["nan 0 0", "inf 0 0", "1e300 0 0", "1e8 0 0", "0 0 1e-30"], ids=str
)
def test_corners_that_make_no_body_are_one_sentence(tmp_path, corner):
    path = tmp_path / "bad.obj"
    others = "v 0 0 0\nv 1e-9 0 0\nv 0 1e-9 0\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n"
    path.write_text(f"v {corner}\n{others}")
    with pytest.raises(ObjectError, match="bad.obj"):
        load_mesh(path)


def test_triangles_without_corners_are_one_sentence():
    mesh = trimesh.Trimesh(np.eye(3), [[0, 1, 9]], process=False)
    with pytest.raises(ObjectError, match="bad has triangles without corners"):
        checked_mesh(mesh, "bad")


@pytest.mark.parametrize(
    "declared",
    [
        '<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;&a;&a;">',  # doubled often, it fills the memory
        '<!ENTITY a SYSTEM "file:///etc/passwd">',
        "",
    ],
)
def test_xml_with_a_document_type_is_refused(tmp_path, declared):
    path = tmp_path / "bad.urdf"
    path.write_text(f'<?xml version="1.0"?><!DOCTYPE robot [{declared}]><robot name="x"></robot>')
    with pytest.raises(ObjectError, match="bad.urdf cannot be read .it has a document type"):
        parse_xml(path)


def test_only_mesh_files_are_read(tmp_path):
    path = tmp_path / "passwd"
    path.write_text("root:x:0:0")
    with pytest.raises(ObjectError, match="passwd is none of .obj"):
        load_mesh(path)
