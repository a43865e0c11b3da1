"""Time and accuracy of the convex parts of meshes: python -m benchmarks.bench_meshes FOLDER

For every URDF and mesh file of a folder (`--visual`: for the visual meshes of its URDFs): its
triangles, seconds of CPU on one core, parts and their vertices, the volume of the parts' union over
that of the solid, both by exact booleans of manifold3d, and the Hausdorff distance of both bodies
in percent of the largest side. `--peers`: CoACD and V-HACD, where installed, too.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time
from typing import NamedTuple

import numpy as np
import trimesh
from manifold3d import Manifold
from scipy.spatial import cKDTree

from benchmarks.metrics import Metric, benchmark_parser, report
from envs.object_files import object_files, read_object
from envs.object_meshes import decompose, load_mesh
from envs.object_parts import MAX_PARTS, hull_of, solid_of, to_trimesh, union
from utils.errors import UserError
from utils.runs import run_script

# Points on what one body has beyond the other, and on the surface of the latter: a distance comes
# out too large by up to 0.6 %, the widest gap between these.
SAMPLES, DENSE_SAMPLES = 20_000, 300_000
COACD_PARTS = 8  # its time grows with them: this many take longer than 64 here
Parts = list[np.ndarray]


class Measured(NamedTuple):
    """seconds: on one core. vertices: of all parts. ratio: volume of the parts' union over the
    solid's. hausdorff: of both bodies, in percent of the largest side. remark: on the mesh.
    """

    name: str
    method: str
    triangles: int
    seconds: float
    parts: int
    vertices: int
    ratio: float
    hausdorff: float
    remark: str


def main(argv: Sequence[str] | None = None) -> None:
    parser = benchmark_parser(__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="of URDF and mesh files")
    parser.add_argument("--visual", action="store_true", help="measure the URDFs' visual meshes")
    parser.add_argument("--peers", action="store_true", help="measure CoACD and V-HACD, too")
    options = parser.parse_args(argv)
    files = object_files(options.folder)[: 2 if options.quick else None]
    methods = {"here": _here}
    if options.peers:
        methods |= {name: peer for name, peer in PEERS.items() if _installed(name)}
    found: list[Measured] = []
    print(f"{'mesh':32}{'method':10}{'triangles':>10}{'s':>8}{'parts':>7}{'vertices':>9}"
          f"{'volume':>8}{'Hausdorff':>11}")  # fmt: skip
    for file in files:
        for name, mesh in _meshes(file, options.visual):
            for method, cut in methods.items():
                found.append(measure(name, method, mesh, cut))
                m = found[-1]
                print(f"{m.name:32}{m.method:10}{m.triangles:10,}{m.seconds:8.2f}{m.parts:7}"
                      f"{m.vertices:9}{m.ratio:8.3f}{m.hausdorff:9.2f} %  {m.remark}",
                      flush=True)  # fmt: skip
    if not found:
        raise UserError(f"{options.folder}: no URDF there has a visual mesh; leave out --visual")
    report([one for method in methods for one in _summary(method, found)], options.json)


def _summary(method: str, found: Sequence[Measured]) -> Iterator[Metric]:
    own = [one for one in found if one.method == method]
    seconds, ratios = [m.seconds for m in own], [m.ratio for m in own]
    yield Metric(f"{method}: time, median", float(np.median(seconds)), "s")
    yield Metric(f"{method}: time, longest", max(seconds), "s")
    yield Metric(f"{method}: volume ratio, median", float(np.median(ratios)), "")
    yield Metric(f"{method}: volume ratio, largest", max(ratios), "")
    within = float(np.mean([abs(ratio - 1) <= 0.1 for ratio in ratios]))
    yield Metric(f"{method}: volume within 10 %", 100 * within, "% of meshes")
    yield Metric(f"{method}: parts, median", float(np.median([m.parts for m in own])), "")
    yield Metric(
        f"{method}: Hausdorff, median", float(np.median([m.hausdorff for m in own])), "% of size"
    )


def _meshes(file: Path, visual: bool) -> Iterator[tuple[str, trimesh.Trimesh]]:
    source = read_object(file)
    if not visual:
        yield file.stem, source.mesh
    elif source.visual is not None:
        yield file.stem, load_mesh(source.visual[0])


def measure(
    name: str, method: str, mesh: trimesh.Trimesh, cut: Callable[[trimesh.Trimesh], Parts]
) -> Measured:
    """Cut a mesh, scaled to a largest side of 1, and compare the parts with its solid."""
    low, high = mesh.bounds
    unit = trimesh.Trimesh(
        (mesh.vertices - (low + high) / 2) / (high - low).max(), mesh.faces, process=False
    )
    begun = process_time()
    parts = cut(unit)
    seconds = process_time() - begun
    solid, whole = solid_of(unit), union([hull_of(part) for part in parts])
    outer = solid.outer()
    return Measured(
        name, method, len(mesh.faces), seconds, len(parts), sum(map(len, parts)),
        whole.volume() / outer.volume(), 100 * hausdorff(whole, outer),
        solid.remark,
    )  # fmt: skip


def hausdorff(one: Manifold, two: Manifold) -> float:
    """The largest distance of a point of either body from the other one."""
    return max(_farthest(one - two, two), _farthest(two - one, one))


def _farthest(rest: Manifold, body: Manifold) -> float:
    if rest.is_empty():
        return 0.0
    points, _ = trimesh.sample.sample_surface(to_trimesh(rest), SAMPLES, seed=0)
    surface, _ = trimesh.sample.sample_surface(to_trimesh(body), DENSE_SAMPLES, seed=1)
    return float(cKDTree(surface).query(points)[0].max())


# --- The methods --------------------------------------------------------------------------------


def _here(mesh: trimesh.Trimesh) -> Parts:
    with TemporaryDirectory() as folder:
        return decompose(mesh, folder).parts


def _coacd(mesh: trimesh.Trimesh) -> Parts:
    """With its own remeshing, and few search steps: with more it takes minutes."""
    import coacd

    coacd.set_log_level("error")
    found = coacd.run_coacd(
        coacd.Mesh(mesh.vertices, mesh.faces), threshold=0.08, max_convex_hull=COACD_PARTS,
        preprocess_mode="on", preprocess_resolution=30, resolution=300, mcts_iterations=60,
        mcts_nodes=10, mcts_max_depth=2,
    )  # fmt: skip
    return [np.asarray(vertices) for vertices, _ in found]


def _coacd_off(mesh: trimesh.Trimesh) -> Parts:
    """On the closed, simplified solid, without its own remeshing."""
    import coacd

    coacd.set_log_level("error")
    solid = to_trimesh(solid_of(mesh).outer().simplify(0.002))
    found = coacd.run_coacd(
        coacd.Mesh(solid.vertices, solid.faces), threshold=0.08, max_convex_hull=COACD_PARTS,
        preprocess_mode="off", resolution=300, mcts_iterations=20, mcts_nodes=10,
        mcts_max_depth=2,
    )  # fmt: skip
    return [np.asarray(vertices) for vertices, _ in found]


def _vhacd(mesh: trimesh.Trimesh) -> Parts:
    import vhacdx

    found = vhacdx.compute_vhacd(
        mesh.vertices, np.insert(mesh.faces, 0, 3, axis=1).astype(np.uint32).ravel(),
        maxConvexHulls=MAX_PARTS, resolution=400_000, maxNumVerticesPerCH=64, asyncACD=False,
    )  # fmt: skip
    return [np.asarray(vertices) for vertices, _ in found]


PEERS = {"coacd": _coacd, "coacd off": _coacd_off, "vhacdx": _vhacd}


def _installed(name: str) -> bool:
    return importlib.util.find_spec(name.split()[0]) is not None


if __name__ == "__main__":
    run_script(main)
