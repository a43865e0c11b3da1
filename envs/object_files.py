"""Object files: the URDF, MJCF and mesh files of a folder, their shape, colour, friction and mass.

Lengths and axes stay those of the file. `envs.mujoco_files` reads MJCF, and is imported where there
is any. This module knows no simulator and no object set.
"""

from __future__ import annotations

import importlib
import math
import os
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType

import numpy as np
import trimesh
import yourdfpy
from scipy.spatial.transform import Rotation

from envs.object_meshes import (
    MESH_SUFFIXES,
    ObjectError,
    checked_mesh,
    load_mesh,
    parse_xml,
    stated_unit,
    surface_colour,
    write_mesh_obj,
)
from envs.urdf_check import check_urdf

SUFFIXES = (".urdf", ".xml", *MESH_SUFFIXES)
# For files that state none. The density, kg/m3, is the median of 26 of the YCB household objects,
# mass over the volume of their convex parts.
DEFAULT_FRICTION, DEFAULT_DENSITY = 0.7, 700.0
MOST_GEOMETRIES = 300  # of a URDF, which yourdfpy reads in some ten seconds
# How the names of the materials and textures of a mesh end, in whatever format it states them.
_MATERIAL = re.compile(rb"\.[mpjbtgw][a-z]{2,3}\b", re.IGNORECASE)  # .mtl, .png, ... .webp
_LONGEST_NAME = 200  # bytes, of such a file


@dataclass(frozen=True)
class FineVisual:
    """The original mesh of an object, for pictures. A vertex v of the file lies at
    rotation(quaternion) @ (scale * v) + position in the body frame (metres; quaternion x, y, z, w).
    """

    path: Path
    scale: tuple[float, float, float]
    position: tuple[float, float, float]
    quaternion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True)
class Inertial:
    """What a file states of all its links or bodies together, in the file's axes.

    mass: kg. centre_of_mass: (3,) m. inertia: (3, 3) kg m2 about the centre of mass.
    states_inertia: whether all that has a mass has an inertia, too. from_density: whether the mass
    is that of the file's volume, in its unit of length, and no number of kilograms.
    """

    mass: float
    centre_of_mass: np.ndarray
    inertia: np.ndarray
    states_inertia: bool = True
    from_density: bool = False


@dataclass(frozen=True)
class ObjectSource:
    """The content of an object file.

    mesh: the solid geometry. inertial: None where the file states no mass. visual: (mesh file,
    scale (3,), T (4, 4)) of a file that has a single visual mesh. visual_mesh: all visual geometry
    of a URDF or MJCF as one mesh. Pictures show the first of visual, visual_mesh and the file
    itself that exists.
    """

    mesh: trimesh.Trimesh
    friction: float = DEFAULT_FRICTION
    inertial: Inertial | None = None
    color: tuple[float, float, float, float] | None = None
    visual: tuple[Path, np.ndarray, np.ndarray] | None = None
    visual_mesh: trimesh.Trimesh | None = None


def object_files(folder: Path, skip_broken: bool = False) -> list[Path]:
    """List the URDF, MJCF and mesh files below a folder, sorted, without those that others of them
    refer to, and without XML files that are no MJCF.

    Raises ObjectError for a folder that holds none, and for a URDF or MJCF that is not XML; the
    latter is listed with `skip_broken`, so that whoever reads it can say so.
    """
    below = _files_below(folder)
    files = sorted(path for path in below if path.suffix.lower() in SUFFIXES and path.is_file())
    referred: set[Path] = set()
    for path in files:
        try:
            referred |= {file.resolve() for file in _referred_files(path)}
        except ObjectError:
            if not skip_broken:
                raise
    files = [path for path in files if path.resolve() not in referred]
    if not files:
        is_sdf = any(path.suffix == ".sdf" for path in below)
        raise ObjectError(
            f"objects: folder {folder} holds no object; "
            f"put in files ending in {', '.join(SUFFIXES)}"
            + (" (SDF becomes MJCF by sdf2mjcf of the package sdformat-mjcf)" if is_sdf else "")
        )
    return files


def _files_below(folder: Path) -> list[Path]:
    """What is no folder below a folder, also behind links to folders; behind each folder once, and
    behind the links last, so that links in a circle end and what they double keeps its name."""
    found: list[Path] = []
    waiting, seen = [folder], set()
    while waiting:
        for place, folders, names in os.walk(waiting.pop(0)):
            if os.path.realpath(place) in seen:
                folders.clear()
                continue
            seen.add(os.path.realpath(place))
            folders.sort()
            found += [Path(place, name) for name in names]
            waiting += [Path(place, name) for name in folders if Path(place, name).is_symlink()]
    return found


def files_of(path: Path) -> set[Path]:
    """The files that an object is read from, resolved, as far as there are any: its own, those that
    it refers to, wherever they lie, and the materials and textures of them all."""
    found: set[Path] = set()
    named = {path}
    while named:
        # os.path.isfile says no where the name is too long.
        new = [file for file in named if os.path.isfile(file) and file.resolve() not in found]
        found |= {file.resolve() for file in new}
        named = {other for file in new for other in (*_references(file), *_materials(file))}
    return found


def _references(path: Path) -> set[Path]:
    try:
        return _referred_files(path)
    except ObjectError:  # to be named when the object is asked for
        return set()


def _materials(path: Path) -> set[Path]:
    """The files of materials and textures that a mesh or a material may name."""
    if path.suffix.lower() not in (*MESH_SUFFIXES, ".mtl"):
        return set()
    data = path.read_bytes()
    ends = (match.end() for match in _MATERIAL.finditer(data))
    names = {re.split(rb"[\s\"'<>=]", data[max(end - _LONGEST_NAME, 0) : end])[-1] for end in ends}
    return {path.parent / os.fsdecode(name) for name in names}


def _referred_files(path: Path) -> set[Path]:
    """The files of which an object file takes a part; of an XML file that is no MJCF, itself."""
    suffix = path.suffix.lower()
    if suffix == ".urdf":
        names = [mesh.get("filename", "") for mesh in parse_xml(path).iter("mesh")]
        return {Path(_resolve_mesh(name, path)) for name in names}
    if suffix == ".xml":
        return _mjcf().referred_files(path) if parse_xml(path).tag == "mujoco" else {path}
    return set()


def read_object(path: Path, density: float = DEFAULT_DENSITY) -> ObjectSource:
    """Read a mesh file, a file in MJCF, or a URDF with all its links at zero joint angles as one
    body.

    density: kg/m3 of the geoms of an MJCF that state neither mass nor density where others do.
    Raises ObjectError, which names the file.
    """
    try:
        if path.suffix.lower() == ".xml":
            return _mjcf().read_mjcf(path, density)
        return _read_urdf(path) if path.suffix.lower() == ".urdf" else ObjectSource(load_mesh(path))
    except ObjectError as error:
        if str(path) in str(error):
            raise
        raise ObjectError(f"{path}: {error}") from error  # of a mesh that the file names


def _mjcf() -> ModuleType:
    return importlib.import_module("envs.mujoco_files")


def fine_visual(
    path: Path, source: ObjectSource, scale: float, centre: np.ndarray, cache_dir: Path
) -> FineVisual:
    """Return the original mesh of an object file in a format that PyBullet reads; meshes of other
    formats are written to `cache_dir`.

    path: the file that `source` was read from. scale: the body's size over the file's. centre: (3,)
    the origin of the body frame in the file's axes, before scaling.
    """
    if source.visual is not None:
        file, file_scale, T = source.visual
    elif source.visual_mesh is not None:
        file, file_scale, T = write_mesh_obj(source.visual_mesh, cache_dir), np.ones(3), np.eye(4)
    else:
        file, file_scale, T = path, np.ones(3), np.eye(4)
    if file.suffix.lower() != ".obj":  # PyBullet reads the other formats unlike trimesh
        file = write_mesh_obj(load_mesh(file), cache_dir)
    return FineVisual(
        path=file,
        scale=tuple((scale * file_scale).tolist()),
        position=tuple((scale * (T[:3, 3] - centre)).tolist()),
        quaternion=tuple(Rotation.from_matrix(T[:3, :3]).as_quat().tolist()),
    )


def colour(path: Path, source: ObjectSource) -> tuple[float, float, float, float] | None:
    """RGBA in 0..1 of an object: of the one mesh that its picture has, or as its file states; None
    where neither says. path: the file that `source` was read from."""
    picture = path if path.suffix.lower() in MESH_SUFFIXES else None
    if source.visual is not None:
        picture = source.visual[0]
    found = None if picture is None else surface_colour(picture)
    return found or source.color


def _resolve_mesh(filename: str, urdf: Path) -> str:
    """Return the file that a URDF's mesh element names, relative to the URDF or in a package that
    contains it."""
    if filename.startswith("package://"):
        inside = Path(filename.removeprefix("package://"))
        for base in urdf.resolve().parents:
            for candidate in (base / inside, base / Path(*inside.parts[1:])):
                if os.path.isfile(candidate):  # which says no where the name is too long
                    return str(candidate)
    return str(urdf.parent / filename.removeprefix("file://"))


def _read_urdf(path: Path) -> ObjectSource:
    xml = parse_xml(path)
    count = sum(1 for _ in xml.iter("geometry"))
    if count > MOST_GEOMETRIES:
        raise ObjectError(
            f"URDF {path} has {count:,} geometries, expected at most {MOST_GEOMETRIES}; simplify it"
        )
    check_urdf(xml, path)
    for element in xml.iterfind("link/*/geometry/mesh"):
        # Reading the mesh first gives an error that names it, which yourdfpy's error may not.
        load_mesh(_resolve_mesh(element.get("filename", ""), path))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of textures whose coordinates are no numbers, say
            stated = yourdfpy.URDF.load(str(path), build_scene_graph=False, load_meshes=False)
            robot = yourdfpy.URDF(
                _in_metres(stated.robot, path),
                build_collision_scene_graph=True,
                load_collision_meshes=True,
                filename_handler=lambda fname: _resolve_mesh(fname, path),
            )
        # Collision geometry is solid; a URDF without any is solid where its visual geometry is.
        scene = robot.collision_scene if robot.collision_scene.geometry else robot.scene
        mesh, visual = scene.to_mesh(), robot.scene.to_mesh()
        friction = xml.find(".//contact/lateral_friction")  # yourdfpy does not read <contact>
        friction = DEFAULT_FRICTION if friction is None else float(friction.get("value"))
        if not 0 <= friction < math.inf:
            raise ValueError(f"its lateral_friction is {friction}")
        inertial = _inertial(robot)
        shown = [(link, item) for link in robot.robot.links for item in link.visuals]
        color, single = _urdf_color(shown, robot), _single_visual(shown, robot, path)
    except Exception as error:  # yourdfpy passes on whatever lxml, NumPy and trimesh raise
        raise ObjectError(f"URDF {path} cannot be read ({error}); repair or remove it") from error
    if len(mesh.faces) == 0:
        raise ObjectError(
            f"URDF {path} has neither collision nor visual geometry of any size; add some"
        )
    return ObjectSource(
        mesh=checked_mesh(mesh, str(path)),
        friction=friction,
        inertial=inertial,
        color=color,
        visual=single,
        visual_mesh=visual if len(visual.faces) else mesh,
    )


def _in_metres(robot: yourdfpy.Robot, path: Path) -> yourdfpy.Robot:
    """The robot, with meshes in a unit of their own scaled by it, which yourdfpy leaves out."""
    for item in (item for link in robot.links for item in (*link.collisions, *link.visuals)):
        mesh = item.geometry and item.geometry.mesh
        unit = 1.0 if mesh is None else stated_unit(Path(_resolve_mesh(mesh.filename, path)))
        if unit != 1.0:
            mesh.scale = unit * (1.0 if mesh.scale is None else mesh.scale)
    return robot


def _inertial(robot: yourdfpy.URDF) -> Inertial | None:
    """The sum over all links. Raises ValueError for a mass below 0."""
    stated, states_inertia = [], True
    for link in robot.robot.links:
        if link.inertial is None or link.inertial.mass is None:
            continue
        mass, T = float(link.inertial.mass), robot.get_transform(link.name)
        if not 0 <= mass < math.inf:
            raise ValueError(f"the mass of its link {link.name} is {mass}, expected 0 kg or more")
        if link.inertial.origin is not None:
            T = T @ link.inertial.origin
        own = np.zeros((3, 3)) if link.inertial.inertia is None else link.inertial.inertia
        states_inertia &= mass == 0 or link.inertial.inertia is not None
        stated.append((mass, T[:3, 3], T[:3, :3] @ np.asarray(own, float) @ T[:3, :3].T))
    return replace(combined(stated), states_inertia=states_inertia) if stated else None


def combined(stated: Sequence[tuple[float, np.ndarray, np.ndarray]]) -> Inertial:
    """The sum of bodies that are one: of each the mass, the centre of mass (3,), and the inertia
    (3, 3) about it. Raises ValueError where it is none that a body can have."""
    total = sum(mass for mass, _, _ in stated)
    if not 0 < total < math.inf:
        raise ValueError(f"it states {total:g} kg in all: state another, or leave masses out")
    centre = sum(mass * at for mass, at, _ in stated) / total
    inertia = np.zeros((3, 3))
    for mass, at, own in stated:  # the parallel axis theorem
        off = at - centre
        inertia += own + mass * (off @ off * np.eye(3) - np.outer(off, off))
    if not (np.isfinite(centre).all() and np.isfinite(inertia).all()):
        raise ValueError("its centre of mass or its inertia is not finite")
    return Inertial(total, centre, inertia)


def _urdf_color(shown, robot: yourdfpy.URDF) -> tuple[float, float, float, float] | None:
    """Of the first visual with a colour that can be seen."""
    named = {material.name: material for material in robot.robot.materials}
    for _, item in shown:
        material = item.material and named.get(item.material.name, item.material)
        color = (item.material and item.material.color) or (material and material.color)
        if color is not None and color.rgba[3] > 0:
            red, green, blue, _ = map(float, color.rgba)
            return red, green, blue, 1.0
    return None


def _single_visual(shown, robot: yourdfpy.URDF, path: Path):
    if len(shown) != 1 or shown[0][1].geometry.mesh is None:
        return None
    link, item = shown[0]
    file = Path(_resolve_mesh(item.geometry.mesh.filename, path))
    scale = item.geometry.mesh.scale
    scale = np.broadcast_to(1.0 if scale is None else scale, 3) / stated_unit(file)
    origin = np.eye(4) if item.origin is None else item.origin
    return file, scale, robot.get_transform(link.name) @ origin
