"""Solids from triangle meshes, and the few convex parts that physics collides in their place.

Simulators collide convex shapes only, and their cost grows with the number of parts and vertices.
`solid_of` makes closed solids of a mesh, whatever state it is in; `convex_parts` cuts them. Every
length is a fraction of the largest side of the mesh's bounding box, which callers scale to 1 and
centre on the origin. This module reads no files and calls no simulator.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, count
from typing import NamedTuple

import manifold3d
import numpy as np
import trimesh
from manifold3d import Manifold
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError, cKDTree

MAX_PARTS = 64
MAX_VERTICES = 64  # of a part: those of a ball hold 0.91 of it, 32 would 0.81
# A hull may cut its own corners by the smaller one: 0.16 mm on an 8 cm object, or so much of its
# own thickness.
VERTEX_TOLERANCE, THICKNESS_TOLERANCE = 0.002, 0.02
SURFACE_TOLERANCE = 0.002  # details smaller than this are left out before cutting
COARSE_TOLERANCE = 0.005  # and before trying planes
# Shares of the solid's volume.
CUT_TOLERANCE = 0.03  # cutting ends when the hulls of the pieces hold no more than this beyond it
JOIN_TOLERANCE = 0.06  # joining ends when the parts hold this much beyond it
LEAST_JOIN = 0.01  # but it may always add this much
DUST = 1e-5  # a piece below this is left out
MAX_PIECES = 80  # of cutting: more than the parts, because joining mends what cuts did in vain
PLANES_PER_AXIS = 4
REFLEX_PLANES = 8
BALANCE = 0.05  # weight of an even cut against what it saves: no first cut of a cup saves anything
MAX_PAIRWISE = 128  # of more pieces only the smallest is paired with the others
NEAR = 0.01  # parts whose bounding boxes are farther apart than this are not joined
# Of closing an open mesh: cells along its largest side, and what is added to a surface, in cells.
CELLS = 40
HALF_SHEET = 0.6
HOLE = 0.1  # a hole of at most this share of a surface's area is simply filled

INSIDE_OUT = "its mesh is inside out; it is turned back"
OPEN = "its mesh is open; narrow gaps are closed, and sheets become plates"


@dataclass(frozen=True)
class MassProperties:
    """Mass properties of a solid of uniform density 1 kg/m3: volume m3, centre of mass (3,) m,
    inertia (3, 3) about the centre of mass in the mesh's axes, kg m2."""

    volume: float
    centre_of_mass: np.ndarray
    inertia: np.ndarray


class Plane(NamedTuple):
    """The points p with normal @ p = offset; the normal (3,) has length 1."""

    normal: np.ndarray
    offset: float

    def is_like(self, other: Plane) -> bool:
        """Whether both cut a piece nearly alike."""
        cosine = float(self.normal @ other.normal)
        return abs(cosine) > 0.98 and abs(self.offset - np.sign(cosine) * other.offset) < 0.03


@dataclass(frozen=True)
class Solid:
    """What a mesh bounds.

    pieces: closed, perhaps overlapping. cavities: voids inside of them, which have no mass, but
    which nothing can touch. remark: what had to be mended, or empty.
    """

    pieces: list[Manifold]
    cavities: list[Manifold]
    remark: str = ""

    def outer(self) -> Manifold:
        """The solid with its cavities filled."""
        return union(self.pieces)

    def mass_properties(self) -> MassProperties:
        """Overlaps count once, and what lies within a cavity, such as a ball in a bell, counts."""
        solid = to_trimesh(self.outer() - union([self._void(cavity) for cavity in self.cavities]))
        return MassProperties(
            float(solid.volume), solid.center_mass.copy(), np.array(solid.moment_inertia)
        )

    def _void(self, cavity: Manifold) -> Manifold:
        """A cavity without the pieces within it."""
        within = [piece for piece in self.pieces if _lies_in(piece, cavity)]
        return cavity - union(within) if within else cavity


# --- Solids ---------------------------------------------------------------------------------------


def solid_of(mesh: trimesh.Trimesh) -> Solid:
    """Make a solid of a mesh. Pieces that are inside out are turned, unless they are the cavity of
    another piece; a mesh that is open, even after trimesh has closed its small holes, is closed
    on a grid. A mesh that bounds no volume gives a solid without pieces.
    """
    shells = mesh.split(only_watertight=False)
    closed = [_closed_shell(shell) for shell in shells]
    if not all(_is_closed(shell) for shell in closed):
        # Where surfaces touch along an edge, they are closed together, but not each for itself.
        whole = _closed_shell(mesh)
        if not _is_closed(whole):
            return Solid([_closed_on_a_grid(mesh)], [], OPEN)
        closed = whole.decompose()
    pieces = [shell for shell in closed if shell.volume() > 0]
    turned = [from_trimesh(to_trimesh(s), turned=True) for s in closed if s.volume() < 0]
    positive, cavities, remark = union(pieces), [], ""
    for shell in turned:
        if _lies_in(shell, positive):
            cavities.append(shell)
        else:
            pieces.append(shell)
            remark = INSIDE_OUT
    return Solid(pieces, cavities, remark)


def _lies_in(shell: Manifold, other: Manifold) -> bool:
    return (shell - other).volume() < 0.01 * shell.volume()


def _is_closed(shell: Manifold) -> bool:
    return shell.status() == manifold3d.Error.NoError


def _closed_shell(shell: trimesh.Trimesh) -> Manifold:
    """A surface of a mesh, with its small holes filled if it has any."""
    closed = from_trimesh(shell)
    if not _is_closed(closed):
        shell = shell.copy()
        trimesh.repair.fix_winding(shell)
        area = shell.area
        trimesh.repair.fill_holes(shell)
        if shell.area < (1 + HOLE) * area:  # no crate loses its opening, and no sheet becomes two
            closed = from_trimesh(shell)
    return closed


def _closed_on_a_grid(mesh: trimesh.Trimesh) -> Manifold:
    """The solid that a mesh with holes bounds.

    What cannot be reached from outside, through gaps of two cells or more, is inside; the surface
    is moved outwards by HALF_SHEET cells, so that a sheet becomes a plate.
    """
    step = float(np.ptp(mesh.vertices, axis=0).max()) / CELLS
    lower = mesh.bounds[0] - 3 * step
    counts = np.ceil((mesh.bounds[1] + 3 * step - lower) / step).astype(int) + 1
    samples = int(mesh.area / (step / 6) ** 2) + 1
    surface = trimesh.sample.sample_surface(mesh, samples, seed=0)[0]
    cells = np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1)
    tree = cKDTree(np.concatenate([surface, mesh.vertices]))
    # Farther than two cells nothing changes, and the middle of a tube is equally far from all.
    distance = tree.query(lower + step * cells, distance_upper_bound=2 * step)[0] / step
    distance = np.minimum(distance, 2.0)
    regions, _ = ndimage.label(distance > 1)
    outside, wall = regions == regions[0, 0, 0], regions == 0
    inside = ~outside & ~wall
    if inside.any():  # of a wall, its inner half is inside, too
        nearer = ndimage.distance_transform_edt(~inside) < ndimage.distance_transform_edt(~outside)
        inside |= wall & nearer
    values = np.where(inside, distance, HALF_SHEET - distance)
    (_, ny, nz), flat = counts.tolist(), values.ravel().tolist()
    (x0, y0, z0), (mx, my, mz) = lower.tolist(), (counts - 2).tolist()

    def value(x: float, y: float, z: float) -> float:
        """Linear between the cells."""
        x, y, z = (x - x0) / step, (y - y0) / step, (z - z0) / step
        i, j, k = (min(max(int(x), 0), mx), min(max(int(y), 0), my), min(max(int(z), 0), mz))
        x, y, z, at = x - i, y - j, z - k, (i * ny + j) * nz + k
        near = [
            (1 - z) * flat[n] + z * flat[n + 1]
            for n in (at, at + nz, at + ny * nz, at + ny * nz + nz)
        ]
        return (1 - x) * ((1 - y) * near[0] + y * near[1]) + x * ((1 - y) * near[2] + y * near[3])

    bounds = [*lower.tolist(), *(lower + step * (counts - 1)).tolist()]
    return Manifold.level_set(value, bounds, step).simplify(step / 3)


# --- Convex parts ---------------------------------------------------------------------------------


def convex_parts(solid: Solid) -> list[np.ndarray]:
    """Cut a solid into at most MAX_PARTS convex parts that cover nearly all of it: the vertices
    (V <= MAX_VERTICES, 3) of each.

    The piece whose convex hull holds most beyond it is cut by the plane that saves most of that,
    until the hulls together hold hardly more than the solid. Convex pieces, of which many
    procedural objects consist, are therefore taken as they are.
    """
    pieces = [part for piece in solid.pieces for part in piece.decompose()]
    parts = [piece.hull() for piece in _cut(pieces)]
    return [simplify_hull(_arrays(part)[0]) for part in joined_parts(parts, _volume(pieces))]


def _cut(pieces: Sequence[Manifold]) -> Iterator[Manifold]:
    total = _volume(pieces)
    queue: list[tuple[float, int, Manifold]] = []  # the number settles ties
    numbers = count()

    def put(piece: Manifold) -> None:
        excess = piece.hull().volume() - piece.volume()
        heapq.heappush(queue, (-excess, next(numbers), piece))

    for piece in pieces:
        put(piece.simplify(SURFACE_TOLERANCE) if _is_concave(piece) else piece)
    done = 0
    while queue:
        excess = -sum(item[0] for item in queue)
        if excess <= CUT_TOLERANCE * total or len(queue) + done >= MAX_PIECES:
            break
        piece = heapq.heappop(queue)[2]
        halves = _best_cut(piece, DUST * total)
        if len(halves) < 2:
            done += 1
            yield piece
        else:
            for half in halves:
                put(half)
    yield from (item[2] for item in queue)


def _is_concave(piece: Manifold) -> bool:
    return piece.hull().volume() > (1 + CUT_TOLERANCE) * piece.volume()


def _best_cut(piece: Manifold, dust: float) -> list[Manifold]:
    """The connected pieces of the cut that saves the most of the hull's volume for each piece that
    it adds; where all save alike, of the most even one. Empty if no cut gives two pieces."""
    best, found = -np.inf, None
    coarse = piece.simplify(COARSE_TOLERANCE)
    whole, volume = coarse.hull().volume(), coarse.volume()
    for plane in _planes(coarse):
        parts = _halves(coarse, plane, dust)
        if len(parts) < 2:
            continue
        saved = 1 - _volume([part.hull() for part in parts]) / whole
        largest = max(part.volume() for part in parts) / volume
        score = saved / (len(parts) - 1) - BALANCE * largest
        if score > best:
            best, found = score, plane
    return _halves(piece, found, dust) if found else []


def _halves(piece: Manifold, plane: Plane, dust: float) -> list[Manifold]:
    """The connected pieces on both sides of a plane."""
    halves = piece.split_by_plane(tuple(plane.normal), plane.offset)
    return [part for half in halves for part in half.decompose() if part.volume() > dust]


def _planes(piece: Manifold) -> list[Plane]:
    """Planes that may cut a piece well: evenly across its principal axes, and along the faces
    beside its deepest reflex edges, where the boxes of an L meet."""
    vertices, faces = _arrays(piece)
    planes = []
    for normal in principal_axes(vertices):
        heights = vertices @ normal
        inner = np.linspace(heights.min(), heights.max(), PLANES_PER_AXIS + 2)[1:-1]
        planes += [Plane(normal, float(offset)) for offset in inner]
    return planes + _reflex_planes(vertices, faces)


def _reflex_planes(vertices: np.ndarray, faces: np.ndarray) -> list[Plane]:
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normals, axis=1)
    normals /= np.maximum(area, 1e-30)[:, None]
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    order = np.lexsort(np.sort(edges, axis=1).T)  # both copies of an edge are neighbours
    one, two = order[0::2], order[1::2]
    side_one, side_two = one % len(faces), two % len(faces)
    start, end = vertices[edges[one, 0]], vertices[edges[one, 1]]
    bend = np.cross(normals[side_one], normals[side_two])
    depth = -np.einsum("ij,ij->i", bend, end - start)  # length times sine; positive where reflex
    depth[(area[side_one] < 1e-12) | (area[side_two] < 1e-12)] = 0.0
    found: list[Plane] = []
    for edge in np.argsort(-depth, kind="stable")[: 10 * REFLEX_PLANES]:
        if depth[edge] <= 1e-6 or len(found) >= REFLEX_PLANES:
            break
        for face in (side_one[edge], side_two[edge]):
            plane = Plane(normals[face], float(normals[face] @ start[edge]))
            if not any(plane.is_like(other) for other in found):
                found.append(plane)
    return found


def joined_parts(parts: list[Manifold], volume: float) -> list[Manifold]:
    """Join the pair of convex parts whose common hull adds the least volume, as long as there are
    more than MAX_PARTS or all of them hold hardly more than the solid's volume."""
    parts = _without_dust([part for part in parts if part.volume() > 0])
    left = max((1 + JOIN_TOLERANCE) * volume - _volume(parts), LEAST_JOIN * volume)

    def joined(a: Manifold, b: Manifold) -> tuple[float, Manifold]:
        hull = Manifold.batch_hull([a, b])
        cost = hull.volume() - a.volume() - b.volume()
        if cost < left:  # it may look cheap because they overlap
            cost = hull.volume() - (a + b).volume()
        return cost, hull

    alive, boxes = dict(enumerate(parts)), {i: _box(part) for i, part in enumerate(parts)}
    costs = {
        (i, j): joined(alive[i], alive[j])
        for i, j in combinations(alive, 2)
        if _touch(boxes[i], boxes[j])
    }
    while costs:
        (i, j), (cost, hull) = min(costs.items(), key=lambda item: item[1][0])
        if len(alive) <= MAX_PARTS and cost > left:
            break
        left -= cost
        new = max(alive) + 1
        del alive[i], alive[j]
        costs = {pair: value for pair, value in costs.items() if not {i, j} & set(pair)}
        boxes[new] = _box(hull)
        costs |= {
            (other, new): joined(part, hull)
            for other, part in alive.items()
            if _touch(boxes[other], boxes[new])
        }
        alive[new] = hull
    return list(alive.values())


def _box(part: Manifold) -> np.ndarray:
    """Lower and upper corner (2, 3)."""
    return np.array(part.bounding_box()).reshape(2, 3)


def _touch(one: np.ndarray, two: np.ndarray) -> bool:
    return bool((one[0] <= two[1] + NEAR).all() and (two[0] <= one[1] + NEAR).all())


def _without_dust(parts: list[Manifold]) -> list[Manifold]:
    """Reduce the parts to MAX_PAIRWISE: the smallest joins the partner whose hull grows least."""
    parts = sorted(parts, key=lambda part: part.volume())
    while len(parts) > MAX_PAIRWISE:
        smallest, rest = parts[0], parts[1:]
        hulls = [Manifold.batch_hull([smallest, part]) for part in rest]
        best = int(np.argmin([hull.volume() - part.volume() for hull, part in zip(hulls, rest)]))
        rest[best] = hulls[best]
        parts = sorted(rest, key=lambda part: part.volume())
    return parts


def simplify_hull(vertices: np.ndarray) -> np.ndarray:
    """Return the few vertices (V, 3) of a convex hull that span nearly all of it.

    The choice starts from a tetrahedron and keeps adding the vertex that lies farthest outside, as
    quickhull does, until none is farther than VERTEX_TOLERANCE and THICKNESS_TOLERANCE admit or
    there are MAX_VERTICES.
    """
    points = _arrays(hull_of(vertices))[0]
    thickness = np.ptp(points @ principal_axes(points).T, axis=0).min()
    tolerance = min(VERTEX_TOLERANCE, THICKNESS_TOLERANCE * float(thickness))
    most = min(MAX_VERTICES, len(points))
    chosen = _tetrahedron(points)
    try:
        hull = ConvexHull(points[chosen], incremental=True)
        while len(chosen) < most:
            outside = (points @ hull.equations[:, :3].T + hull.equations[:, 3]).max(axis=1)
            farthest = int(outside.argmax())
            if outside[farthest] <= tolerance:
                break
            chosen.append(farthest)
            hull.add_points(points[[farthest]])
        # An early choice may have come to lie inside the final hull.
        return points[chosen][ConvexHull(points[chosen]).vertices]
    except QhullError:  # a plate too thin for its arithmetic
        return points[np.linspace(0, len(points) - 1, most, dtype=int)]


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


def principal_axes(points: np.ndarray) -> np.ndarray:
    """The axes (3, 3), one a row, along which points (N, 3) spread least, more, and most."""
    centred = points - points.mean(axis=0)
    return np.linalg.eigh(centred.T @ centred)[1].T


# --- Between the libraries ------------------------------------------------------------------------


def _volume(solids: Sequence[Manifold]) -> float:
    """Overlaps count as often as there are."""
    return sum(solid.volume() for solid in solids)


def union(solids: list[Manifold]) -> Manifold:
    return Manifold.batch_boolean(solids, manifold3d.OpType.Add)


def hull_of(points: np.ndarray) -> Manifold:
    return Manifold.hull_points(np.ascontiguousarray(points, dtype=float))


def from_trimesh(mesh: trimesh.Trimesh, turned: bool = False) -> Manifold:
    """turned: whether inside and outside change places."""
    faces = mesh.faces[:, ::-1] if turned else mesh.faces
    return Manifold(
        manifold3d.Mesh64(
            np.array(mesh.vertices, dtype=float, order="C"),
            np.array(faces, dtype=np.uint64, order="C"),
        )
    )


def to_trimesh(solid: Manifold) -> trimesh.Trimesh:
    return trimesh.Trimesh(*_arrays(solid), process=False)


def _arrays(solid: Manifold) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and faces (F, 3)."""
    mesh = solid.to_mesh64()
    return mesh.vert_properties[:, :3], mesh.tri_verts.astype(np.int64)
