"""Meshes: what is read and refused, and a cache of convex parts that can be trusted."""

import importlib.metadata
import importlib.util
import re
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
import trimesh

from envs import object_meshes, object_parts
from envs.object_meshes import ObjectError, checked_mesh, decompose, load_mesh, parse_xml
from tests.helpers.meshes import l_shape


def test_decomposition_runs_once_for_a_shape_whatever_its_units(tmp_path, monkeypatch):
    calls = []
    cut = object_meshes.convex_parts
    monkeypatch.setattr(object_meshes, "convex_parts", lambda *a: calls.append(1) or cut(*a))
    mesh = l_shape()
    first = decompose(mesh, tmp_path)
    mesh.apply_scale(1000)
    second = decompose(mesh, tmp_path)
    assert len(calls) == 1
    for a, b in zip(first.parts, second.parts, strict=True):
        assert b == pytest.approx(1000 * a, rel=1e-9, abs=1e-6)
    assert second.solid.volume == pytest.approx(1e9 * 5)
    assert second.solid.centre_of_mass == pytest.approx(1000 * first.solid.centre_of_mass)
    assert second.solid.inertia == pytest.approx(1e15 * first.solid.inertia)


def names_after(monkeypatch, change=None) -> list[str]:
    """Of the cache's files for a cube, by a module that is loaded after a change."""
    if change is not None:
        monkeypatch.setattr(*change)
    spec = importlib.util.spec_from_file_location("loaded_again", object_meshes.__file__)
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "loaded_again", module)
    spec.loader.exec_module(module)
    with tempfile.TemporaryDirectory() as folder:
        module.decompose(trimesh.creation.box(), Path(folder))
        return [file.name for file in Path(folder).iterdir()]


CONSTANTS = re.findall(r"^([A-Z_]+) = [\d.]", Path(object_parts.__file__).read_text(), re.MULTILINE)


@pytest.mark.parametrize("name", CONSTANTS)
def test_a_changed_constant_is_another_file_of_the_cache(name, tmp_path, monkeypatch):
    decompose(trimesh.creation.box(), tmp_path)
    before = [file.name for file in tmp_path.iterdir()]
    assert len(before) == 1 and names_after(monkeypatch) == before
    change = object_parts, name, getattr(object_parts, name) * 1.001
    assert names_after(monkeypatch, change) != before


@pytest.mark.parametrize("package", ["manifold3d", "scipy", "trimesh"])
def test_another_version_of_what_cuts_is_another_file_of_the_cache(package, monkeypatch):
    other = {package: "0.0"}
    installed = importlib.metadata.version
    change = importlib.metadata, "version", lambda name: other.get(name) or installed(name)
    assert names_after(monkeypatch) != names_after(monkeypatch, change)


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


@pytest.mark.parametrize(("pieces", "message"), [(3, "2,000,000 triang"), (2001, "2,000 pieces")])
def test_a_small_file_of_a_large_scene_is_refused(tmp_path, monkeypatch, pieces, message):
    """Whose pieces are one shape that stands in many places."""
    monkeypatch.setattr("envs.object_meshes.MOST_FACES", 2_000_000 if pieces > 3 else 25)
    message = message if pieces > 3 else "25 triangles"
    scene, box = trimesh.Scene(), trimesh.creation.box((0.1, 0.1, 0.1))
    for number in range(pieces):
        place = trimesh.transformations.translation_matrix((0.2 * number, 0, 0))
        scene.add_geometry(box, geom_name="box", transform=place)
    scene.export(tmp_path / "many.glb")
    with pytest.raises(ObjectError, match=f"many.glb cannot be read .it has more than {message}"):
        load_mesh(tmp_path / "many.glb")


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
