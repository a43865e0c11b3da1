"""Triangle meshes: reading them, their convex parts and mass from a cache, and OBJ files.

`envs.object_parts` cuts a mesh into convex parts; `decompose` keeps what comes out under a hash of
the mesh. This module calls no simulator and knows no object set.
"""

from __future__ import annotations

import hashlib
import io
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np
import trimesh

from envs import object_parts
from envs.object_parts import MassProperties, convex_parts, solid_of
from utils.atomic_files import write_atomic
from utils.errors import UNREADABLE_NPZ, RecurringError

MESH_SUFFIXES = (".obj", ".stl", ".ply", ".glb", ".dae")
MOST_FACES, MOST_PIECES = 2_000_000, 2_000
SMALLEST_SIDE, LARGEST_SIDE = (
    1e-9,
    1e9,
)  # in the file's units: beyond them numbers lose their digits
# What the preparation of a mesh depends on; another value is another file in the cache.
_SETTINGS = (
    3,  # counts the changes of the method
    *((name, version(name)) for name in ("manifold3d", "scipy", "trimesh")),
    *sorted(
        (name, value)
        for name, value in vars(object_parts).items()
        if name.isupper() and not isinstance(value, str)
    ),
)


class ObjectError(RecurringError):
    """An object, mesh or object set that cannot be used; the message says why and what to do."""


@dataclass(frozen=True)
class Decomposition:
    """A mesh as physics takes it, in the mesh's frame and units.

    parts: vertex arrays (V, 3) of convex parts that cover the solid. solid: its mass properties.
    remark: what of the mesh had to be mended, or empty.
    """

    parts: list[np.ndarray]
    solid: MassProperties
    remark: str


def load_mesh(path: str | Path) -> trimesh.Trimesh:
    """Read all geometry of a mesh file as one mesh, in the file's own axes and units; in metres
    where it states its unit, see `stated_unit`.

    Raises ObjectError for a file that is missing, unreadable, empty, flat or non-finite.
    """
    path = Path(path)
    if not os.path.isfile(path):  # which says no where the name is too long, too
        raise ObjectError(f"mesh {path} does not exist")
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise ObjectError(f"mesh {path} is none of {', '.join(MESH_SUFFIXES)}; convert it")
    unit = stated_unit(path)
    try:
        # Materials name other files, which nothing here needs.
        scene = trimesh.load_scene(path, process=False, skip_materials=True)
        _check_size(scene)
        mesh = scene.to_mesh()
    except Exception as error:  # each of trimesh's readers raises errors of its own kind
        reason = f"mesh {path} cannot be read ({error}); re-export or remove it"
        raise ObjectError(reason) from error
    if unit != 1.0:
        mesh.apply_scale(unit)
    return checked_mesh(mesh, str(path))


def stated_unit(path: Path) -> float:
    """The unit of length that a mesh file states, m, which DAE files do; else 1.

    Raises ObjectError for a DAE that is no XML, and for a unit that is no length.
    """
    if path.suffix.lower() != ".dae":
        return 1.0
    found = parse_xml(path).find("{*}asset/{*}unit")
    text = "1" if found is None else found.get("meter", "1")
    try:
        unit = float(text)
    except ValueError:
        unit = math.nan
    if not 0 < unit < math.inf:
        raise ObjectError(
            f"mesh {path} states a unit of {text!r} metres, expected a number above 0; correct "
            "<unit meter=...> or re-export it"
        )
    return unit


def surface_colour(path: Path) -> tuple[float, float, float, float] | None:
    """RGBA in 0..1 of a mesh file that `load_mesh` reads: the mean over its surface of its textures
    or of the colours of its materials, faces or vertices; None where it has none that can be read.
    """
    try:
        scene = trimesh.load_scene(path, process=False)
        _check_size(scene)
        # Of each mesh where it stands there is a copy, whose textures do not tell their format.
        parts = [
            (mesh.area_faces, _face_colours(scene.geometry[mesh.metadata["name"]]))
            for mesh in scene.dump()
        ]
    except Exception:  # of trimesh's readers, on materials: shape and mass do not need them
        return None
    parts = [(area, colours) for area, colours in parts if colours is not None]
    area = sum(area.sum() for area, _ in parts)
    if not area > 0:
        return None
    red, green, blue = sum(area @ colours for area, colours in parts) / (255 * area)
    return float(red), float(green), float(blue), 1.0


def _face_colours(mesh: trimesh.Trimesh) -> np.ndarray | None:
    """(F, 3) in 0..255: a texture's in the middle of each face, its material's or its own; None
    where nothing is stated."""
    visual = mesh.visual
    if not isinstance(visual, trimesh.visual.TextureVisuals):
        return visual.face_colors[:, :3].astype(float) if visual.defined else None
    material = visual.material
    texture = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    # Where there is none, trimesh makes a grey one, which is no file's and has no format.
    if visual.uv is not None and texture is not None and texture.format is not None:
        colours = material.to_color(np.nan_to_num(visual.uv[mesh.faces].mean(axis=1)))
        return np.asarray(colours, float)[:, :3]
    colour = material.main_color
    if (colour == trimesh.visual.color.to_rgba(None)).all():  # stands for none
        return None
    return np.tile(np.asarray(colour, float)[:3], (len(mesh.faces), 1))


def _check_size(scene: trimesh.Scene) -> None:
    """Raise ValueError for a scene that is too large as one mesh: a small file may say of a shape
    that it stands in many places."""
    places = {name: len(nodes) for name, nodes in scene.graph.geometry_nodes.items()}
    if sum(places.values()) > MOST_PIECES:
        raise ValueError(f"it has more than {MOST_PIECES:,} pieces")
    faces = (
        count * len(getattr(scene.geometry[name], "faces", ())) for name, count in places.items()
    )
    if sum(faces) > MOST_FACES:
        raise ValueError(f"it has more than {MOST_FACES:,} triangles")


def parse_xml(path: Path) -> ElementTree.Element:
    """The root of an XML file. Raises ObjectError, also for a document type: its entities stand for
    other files, or for any amount of text."""

    def refuse(*_: object) -> None:
        raise ValueError("it has a document type, <!DOCTYPE ...>")

    try:
        data = path.read_bytes()
        parser = expat.ParserCreate()
        parser.StartDoctypeDeclHandler = refuse
        parser.Parse(data, True)
        return ElementTree.fromstring(data)
    except (OSError, ValueError, LookupError, SyntaxError, expat.ExpatError) as error:
        raise ObjectError(f"{path} cannot be read ({error}); repair or remove it") from error


def checked_mesh(mesh: trimesh.Trimesh, name: str) -> trimesh.Trimesh:
    """Return the bare geometry of a mesh with merged vertices. Raises ObjectError, which names
    `name`, if the mesh bounds no body."""
    if len(mesh.faces) == 0:
        raise ObjectError(f"mesh {name} has no triangles; re-export or remove it")
    bad = int((~np.isfinite(mesh.vertices).all(axis=1)).sum())
    if bad:
        raise ObjectError(
            f"mesh {name} has {bad} of {len(mesh.vertices)} vertices that are not finite numbers; "
            "re-export or remove it"
        )
    if mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices):
        raise ObjectError(f"mesh {name} has triangles without corners; re-export or remove it")
    if len(mesh.faces) > MOST_FACES:
        raise ObjectError(f"mesh {name} has more than {MOST_FACES:,} triangles; simplify it")
    side = float(np.ptp(mesh.vertices, axis=0).max())
    if not (SMALLEST_SIDE < side < LARGEST_SIDE and abs(mesh.vertices).max() < LARGEST_SIDE):
        raise ObjectError(
            f"mesh {name} is {side:.3g} long, or as far from its origin, expected "
            f"{SMALLEST_SIDE:g} to {LARGEST_SIDE:g}; re-export it in other units"
        )
    try:
        bare = trimesh.Trimesh(mesh.vertices, mesh.faces, process=True)
    except OverflowError as error:  # of trimesh's grid, on which vertices are merged
        raise ObjectError(f"mesh {name} is too large for its details; re-export it") from error
    # Triangles with two merged corners are removed; thin ones stay, because their removal would
    # leave holes.
    bare.update_faces((np.diff(np.sort(bare.faces, axis=1), axis=1) > 0).all(axis=1))
    if len(bare.faces) == 0 or not bare.nondegenerate_faces().any():
        raise ObjectError(f"mesh {name} has only degenerate triangles; re-export or remove it")
    centred = bare.vertices - bare.vertices.mean(axis=0)
    spread = np.linalg.svd(centred, compute_uv=False)
    if spread[2] < 1e-6 * spread[0]:
        raise ObjectError(f"mesh {name} is flat, but a body needs volume; thicken or remove it")
    return bare


def decompose(mesh: trimesh.Trimesh, cache_dir: str | Path, name: str = "mesh") -> Decomposition:
    """Cut a mesh into convex parts that cover it, and compute the mass properties of its solid.

    The result is cached in `cache_dir` by the mesh's content; its scale and position do not matter.
    Raises ObjectError for a corrupt cache file or a mesh that bounds no volume.
    """
    low, high = mesh.bounds
    centre, size = (low + high) / 2, float((high - low).max())
    unit = trimesh.Trimesh((mesh.vertices - centre) / size, mesh.faces, process=False)
    path = Path(cache_dir) / f"parts-{_content_hash(unit)}.npz"
    if path.exists():
        found = _read_parts(path)
    else:
        solid = solid_of(unit)
        parts = convex_parts(solid)
        if not parts:
            raise ObjectError(f"mesh {name} bounds no volume; re-export or remove it")
        found = Decomposition(parts, solid.mass_properties(), solid.remark)
        _write_parts(path, found)
    return Decomposition(
        [part * size + centre for part in found.parts],
        MassProperties(
            found.solid.volume * size**3,
            found.solid.centre_of_mass * size + centre,
            found.solid.inertia * size**5,
        ),
        found.remark,
    )


def write_parts_obj(parts: Sequence[np.ndarray], cache_dir: str | Path) -> Path:
    """Write an OBJ file with one `o` group for each convex part into the cache, named by its
    content.

    PyBullet turns it into a compound with one convex hull for each group.
    """
    lines: list[str] = []
    first = 1
    for index, part in enumerate(parts):
        hull = trimesh.convex.convex_hull(part)
        lines.append(f"o part_{index}")
        lines += [f"v {x:.7f} {y:.7f} {z:.7f}" for x, y, z in hull.vertices]
        lines += [f"f {a} {b} {c}" for a, b, c in hull.faces + first]
        first += len(hull.vertices)
    return _write_once("\n".join(lines) + "\n", "hulls", cache_dir)


def write_mesh_obj(mesh: trimesh.Trimesh, cache_dir: str | Path) -> Path:
    """Write the mesh as an OBJ file into the cache, because PyBullet does not read its own
    format."""
    text = trimesh.exchange.obj.export_obj(
        trimesh.Trimesh(mesh.vertices, mesh.faces, process=False), header=None
    )
    return _write_once(text, "mesh", cache_dir)


# --- cache ----------------------------------------------------------------------------------


def _content_hash(mesh: trimesh.Trimesh) -> str:
    digest = hashlib.sha256(repr(_SETTINGS).encode())
    # Rounding gives the same mesh in other units the same name; + 0.0 turns -0 into 0.
    vertices = np.round(mesh.vertices, 6) + 0.0
    digest.update(np.ascontiguousarray(vertices, dtype="<f8").tobytes())
    digest.update(np.ascontiguousarray(mesh.faces, dtype="<i8").tobytes())
    return digest.hexdigest()[:20]


def _read_parts(path: Path) -> Decomposition:
    try:
        with np.load(path, allow_pickle=False) as data:
            vertices, counts = data["vertices"], data["counts"]
            volume, centre, inertia = data["volume"], data["centre_of_mass"], data["inertia"]
            remark = str(data["remark"])
        fit = vertices.ndim == 2 and vertices.shape[1] == 3 and counts.ndim == 1
        fit &= volume.shape == () and centre.shape == (3,) and inertia.shape == (3, 3)
        if not (fit and len(counts) and counts.min() > 0 and counts.sum() == len(vertices)):
            raise ValueError("its shapes contradict each other")
        if not all(np.isfinite(one).all() for one in (vertices, volume, centre, inertia)):
            raise ValueError("its numbers contradict each other")
    except UNREADABLE_NPZ as error:
        raise _corrupt(path, str(error)) from error
    parts = np.split(vertices, np.cumsum(counts)[:-1])
    return Decomposition(parts, MassProperties(float(volume), centre, inertia), remark)


def _write_parts(path: Path, found: Decomposition) -> None:
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        vertices=np.concatenate(found.parts),
        counts=[len(part) for part in found.parts],
        volume=found.solid.volume,
        centre_of_mass=found.solid.centre_of_mass,
        inertia=found.solid.inertia,
        remark=found.remark,
    )
    write_atomic(path, buffer.getvalue())


def _write_once(text: str, kind: str, cache_dir: str | Path) -> Path:
    data = text.encode()
    path = Path(cache_dir) / f"{kind}-{hashlib.sha256(data).hexdigest()[:20]}.obj"
    if not path.exists():
        write_atomic(path, data)
    elif path.read_bytes() != data:
        raise _corrupt(path, "its content does not match its name")
    return path


def _corrupt(path: Path, reason: str) -> ObjectError:
    return ObjectError(f"cache file {path} is corrupt ({reason}); delete it and run again")
