"""Triangle meshes: reading, cutting into few convex parts, mass properties, OBJ files.

Bullet collides convex shapes only, and its cost grows with their number and their vertices.
`decompose` therefore turns every mesh into a few small hulls and caches them under a hash of the
mesh. This module calls no simulator and knows no object set.
"""

from __future__ import annotations

import hashlib
import io
import struct
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from xml.etree import ElementTree
from xml.parsers import expat

import coacd
import manifold3d
import numpy as np
import trimesh
from scipy.spatial import ConvexHull, QhullError

from utils.errors import UserError
from utils.runs import write_atomic

MESH_SUFFIXES = (".obj", ".stl", ".ply", ".glb", ".dae")
MOST_FACES = 2_000_000
SMALLEST_SIDE, LARGEST_SIDE = (
    1e-9,
    1e9,
)  # in the file's units: beyond them numbers lose their digits
MAX_PARTS = 8
MAX_VERTICES = 32
# The lengths below are fractions of the largest side of the mesh's bounding box.
VERTEX_TOLERANCE = 0.004  # a hull may cut its own corners by this much: 0.3 mm on an 8 cm object
MERGE_TOLERANCE = 0.03  # two parts become one if that adds less than this part of the volume
CONVEX_RATIO = 0.95  # a mesh whose volume is this share of its hull's counts as convex
MAX_PAIRWISE = 24  # with more parts only the smallest is paired with the others: n pairs, not n^2
# These settings were chosen for their time: 4 to 10 s for a scanned object on one core. CoACD takes
# up to minutes without its remeshing ("off", and "auto" when the mesh is clean) and with a
# shallower search, whose many cuts have to be merged again (50 s for a ring). Its own decimation
# shrinks hulls by up to a sixth.
COACD_SETTINGS = {
    "threshold": 0.08,
    "max_convex_hull": MAX_PARTS,
    "preprocess_mode": "on",
    "preprocess_resolution": 30,
    "resolution": 300,
    "mcts_iterations": 60,
    "mcts_nodes": 10,
    "mcts_max_depth": 2,
    "decimate": False,
}
_CACHE_VERSION = 1


class ObjectError(UserError):
    """An object, mesh or object set that cannot be used; the message says why and what to do."""


@dataclass(frozen=True)
class MassProperties:
    """Mass properties of a solid of uniform density 1 kg/m3: volume m3, centre of mass (3,) m,
    inertia (3, 3) about the centre of mass in the mesh's axes, kg m2."""

    volume: float
    centre_of_mass: np.ndarray
    inertia: np.ndarray


def load_mesh(path: str | Path) -> trimesh.Trimesh:
    """Read all geometry of a mesh file as one mesh, in the file's own units and axes.

    Raises ObjectError for a file that is missing, unreadable, empty, flat or non-finite.
    """
    path = Path(path)
    if not path.is_file():
        raise ObjectError(f"mesh {path} does not exist")
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise ObjectError(f"mesh {path} is none of {', '.join(MESH_SUFFIXES)}; convert it")
    if path.suffix.lower() == ".dae":
        parse_xml(path)
    try:
        # Materials name other files, which nothing here needs.
        mesh = trimesh.load_scene(path, process=False, skip_materials=True).to_mesh()
    except Exception as error:  # each of trimesh's readers raises errors of its own kind
        reason = f"mesh {path} cannot be read ({error}); re-export or remove it"
        raise ObjectError(reason) from error
    return checked_mesh(mesh, str(path))


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
    if bare.is_watertight and bare.volume < 0:
        bare.invert()
    return bare


def decompose(mesh: trimesh.Trimesh, cache_dir: str | Path, name: str = "mesh") -> list[np.ndarray]:
    """Cut a mesh into convex parts that cover it: at most 8 vertex arrays (V <= 32, 3), in its
    frame.

    A mesh of convex pieces, as many procedural sets have, is taken apart exactly, a convex mesh is
    its own hull, and CoACD (Wei et al., SIGGRAPH 2022) cuts every other one. The parts are cached
    in `cache_dir` by the mesh's content; its scale and position do not matter.
    Raises ObjectError for a corrupt cache file or a mesh that cannot be cut.
    """
    low, high = mesh.bounds
    centre, size = (low + high) / 2, float((high - low).max())
    # Rounding gives the same mesh in other units the same name; + 0.0 turns -0 into 0.
    unit = trimesh.Trimesh(
        np.round((mesh.vertices - centre) / size, 6) + 0.0, mesh.faces, process=False
    )
    path = Path(cache_dir) / f"parts-{_content_hash(unit)}.npz"
    if path.exists():
        parts = _read_parts(path)
    else:
        try:
            parts = [simplify_hull(part) for part in _convex_parts(unit)]
        except (RuntimeError, QhullError) as error:
            raise ObjectError(f"mesh {name} cannot be cut into convex parts ({error})") from error
        if not parts:
            raise ObjectError(f"mesh {name} cannot be cut into convex parts: no part has a volume")
        _write_parts(path, parts)
    return [part * size + centre for part in parts]


def simplify_hull(
    vertices: np.ndarray, max_vertices: int = MAX_VERTICES, tolerance: float = VERTEX_TOLERANCE
) -> np.ndarray:
    """Return the few vertices (V, 3) of a convex hull that span nearly all of it.

    The choice starts from a tetrahedron and keeps adding the vertex that lies farthest outside, as
    quickhull does, until none is farther than `tolerance` or there are `max_vertices`.
    """
    points = np.asarray(vertices, dtype=float)
    points = points[ConvexHull(points).vertices]
    chosen = _tetrahedron(points)
    hull = ConvexHull(points[chosen], incremental=True)
    while len(chosen) < min(max_vertices, len(points)):
        outside = (points @ hull.equations[:, :3].T + hull.equations[:, 3]).max(axis=1)
        farthest = int(outside.argmax())
        if outside[farthest] <= tolerance:
            break
        chosen.append(farthest)
        hull.add_points(points[[farthest]])
    # An early choice may have come to lie inside the final hull.
    return points[chosen][ConvexHull(points[chosen]).vertices]


def mass_properties(mesh: trimesh.Trimesh, parts: Sequence[np.ndarray]) -> MassProperties:
    """Compute the mass properties of the solid that the mesh bounds, overlaps counted once, or of
    its convex parts if it bounds none."""
    pieces = _solid_pieces(mesh)
    if len(pieces) > 1:
        solid = _to_trimesh(_union([_from_trimesh(piece) for piece in pieces]))
    elif mesh.is_volume:
        solid = mesh
    else:
        solid = _to_trimesh(_union([_hull(part) for part in parts]))
    return MassProperties(float(solid.volume), solid.center_mass.copy(), solid.moment_inertia)


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


# --- convex parts ---------------------------------------------------------------------------


def _convex_parts(mesh: trimesh.Trimesh) -> list[np.ndarray]:
    """Return vertex arrays of the convex parts of a mesh of unit size, not yet simplified."""
    pieces = _solid_pieces(mesh)
    if pieces and all(_is_convex(piece) for piece in pieces):
        return _merged([_hull(piece.vertices) for piece in pieces])
    coacd.set_log_level("error")
    parts = coacd.run_coacd(coacd.Mesh(mesh.vertices, mesh.faces), **COACD_SETTINGS)
    return [np.asarray(vertices) for vertices, _ in parts]


def _solid_pieces(mesh: trimesh.Trimesh) -> list[trimesh.Trimesh]:
    """Return the connected pieces of a mesh if each bounds a solid of its own, otherwise none.

    The mesh itself need not be watertight: pieces that touch along an edge share its vertices. A
    piece that is turned inside out is a cavity of another piece and no solid.
    """
    pieces = list(mesh.split(only_watertight=False))
    return pieces if all(piece.is_volume for piece in pieces) else []


def _is_convex(mesh: trimesh.Trimesh) -> bool:
    return mesh.volume > CONVEX_RATIO * mesh.convex_hull.volume


def _merged(parts: list[manifold3d.Manifold]) -> list[np.ndarray]:
    """Join the pair whose common hull adds the least volume, as long as there are too many parts or
    joining adds next to nothing."""
    parts = [part for part in parts if part.volume() > 0]
    parts = _without_dust(parts)
    allowance = MERGE_TOLERANCE * sum(part.volume() for part in parts)

    def joined(a: manifold3d.Manifold, b: manifold3d.Manifold):
        hull = manifold3d.Manifold.batch_hull([a, b])
        return hull.volume() - (a + b).volume(), hull

    alive = dict(enumerate(parts))
    costs = {(i, j): joined(alive[i], alive[j]) for i, j in combinations(alive, 2)}
    while costs:
        (i, j), (cost, hull) = min(costs.items(), key=lambda item: item[1][0])
        if len(alive) <= MAX_PARTS and cost > allowance:
            break
        new = max(alive) + 1
        del alive[i], alive[j]
        costs = {pair: value for pair, value in costs.items() if not {i, j} & set(pair)}
        costs |= {(other, new): joined(part, hull) for other, part in alive.items()}
        alive[new] = hull
    return [_to_trimesh(part).vertices for part in alive.values()]


def _without_dust(parts: list[manifold3d.Manifold]) -> list[manifold3d.Manifold]:
    """Reduce the parts to MAX_PAIRWISE: the smallest joins the partner whose hull grows least."""
    parts = sorted(parts, key=lambda part: part.volume())
    while len(parts) > MAX_PAIRWISE:
        smallest, rest = parts[0], parts[1:]
        hulls = [manifold3d.Manifold.batch_hull([smallest, part]) for part in rest]
        best = int(np.argmin([hull.volume() - part.volume() for hull, part in zip(hulls, rest)]))
        rest[best] = hulls[best]
        parts = sorted(rest, key=lambda part: part.volume())
    return parts


def _tetrahedron(points: np.ndarray) -> list[int]:
    """Return the indices of four points that span a volume: each is the farthest from those
    before."""
    first = int(points[:, 0].argmin())
    offsets = points - points[first]
    second = int(np.linalg.norm(offsets, axis=1).argmax())
    axis = offsets[second] / np.linalg.norm(offsets[second])
    off_line = offsets - np.outer(offsets @ axis, axis)
    third = int(np.linalg.norm(off_line, axis=1).argmax())
    normal = np.cross(axis, off_line[third])
    fourth = int(np.abs(offsets @ normal).argmax())
    return [first, second, third, fourth]


def _hull(points: np.ndarray) -> manifold3d.Manifold:
    return manifold3d.Manifold.hull_points(np.ascontiguousarray(points, dtype=float))


def _union(solids: list[manifold3d.Manifold]) -> manifold3d.Manifold:
    return manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Add)


def _from_trimesh(mesh: trimesh.Trimesh) -> manifold3d.Manifold:
    return manifold3d.Manifold(
        manifold3d.Mesh64(
            np.ascontiguousarray(mesh.vertices, dtype=float),
            np.ascontiguousarray(mesh.faces, dtype=np.uint64),
        )
    )


def _to_trimesh(solid: manifold3d.Manifold) -> trimesh.Trimesh:
    mesh = solid.to_mesh64()
    return trimesh.Trimesh(mesh.vert_properties[:, :3], mesh.tri_verts.astype(np.int64))


# --- cache ----------------------------------------------------------------------------------


def _content_hash(mesh: trimesh.Trimesh) -> str:
    settings = (
        _CACHE_VERSION, MAX_PARTS, MAX_VERTICES, VERTEX_TOLERANCE, MERGE_TOLERANCE, CONVEX_RATIO,
        MAX_PAIRWISE, sorted(COACD_SETTINGS.items()),
    )  # fmt: skip
    digest = hashlib.sha256(repr(settings).encode())
    digest.update(np.ascontiguousarray(mesh.vertices, dtype="<f8").tobytes())
    digest.update(np.ascontiguousarray(mesh.faces, dtype="<i8").tobytes())
    return digest.hexdigest()[:20]


# What numpy and zipfile raise on a damaged file, depending on where the damage is.
_UNREADABLE = (
    OSError, EOFError, KeyError, ValueError, TypeError, IndexError, MemoryError, OverflowError,
    NotImplementedError, SyntaxError, struct.error, zipfile.BadZipFile, zlib.error,
)  # fmt: skip


def _read_parts(path: Path) -> list[np.ndarray]:
    try:
        with np.load(path, allow_pickle=False) as data:
            vertices, counts = data["vertices"], data["counts"]
        fit = vertices.ndim == 2 and vertices.shape[1] == 3 and counts.ndim == 1
        if not (fit and len(counts) and counts.min() > 0 and counts.sum() == len(vertices)):
            raise ValueError("its shapes contradict each other")
        if not np.isfinite(vertices).all():
            raise ValueError("its numbers contradict each other")
    except _UNREADABLE as error:
        raise _corrupt(path, str(error)) from error
    return np.split(vertices, np.cumsum(counts)[:-1])


def _write_parts(path: Path, parts: list[np.ndarray]) -> None:
    buffer = io.BytesIO()
    counts = [len(part) for part in parts]
    np.savez_compressed(buffer, vertices=np.concatenate(parts), counts=counts)
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
