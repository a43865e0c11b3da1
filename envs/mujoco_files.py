"""Object files in MJCF, MuJoCo's format, each one rigid body that MuJoCo compiles.

Only what shapes and weighs a body reaches MuJoCo, and MuJoCo opens no file: what a file includes or
refers to is read here, and lies in its folder. This module knows no object set.
"""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import mujoco
import numpy as np
import trimesh
from mujoco import mjtGeom

from envs.object_files import DEFAULT_FRICTION, Inertial, ObjectSource, combined
from envs.object_meshes import ObjectError, checked_mesh, load_mesh, parse_xml
from utils.errors import one_line

SECTIONS = ("compiler", "default", "asset", "worldbody")
ASSETS = ("material", "mesh")
SOLID = ("body", "frame", "freejoint", "geom", "inertial", "joint")
WEIGHTLESS = ("camera", "light", "site")
MOST_GEOMS = 2000  # MuJoCo takes a time that grows with their square
UNSTATED = 1e-12  # kg/m3 of a geom whose density neither it nor its class states
UNCOLOURED = (0.5, 0.5, 0.5, 1.0)  # MuJoCo's RGBA of a geom that states none


def read_mjcf(path: Path, density: float) -> ObjectSource:
    """Read one body, with bodies that no joint parts from it, in the file's world frame.

    Geoms that collide with nothing are for the eye. Mass, centre of mass and inertia are those that
    MuJoCo compiles, None where the file states neither a mass nor a density. density: kg/m3 of
    geoms that state none where others do. Raises ObjectError, which names the file.
    """
    try:
        root = _with_includes(parse_xml(path), path, set())
        with _without_warnings() as said:
            source = _source(path, root, density)
        if any("NaN" in text for text in said):  # MuJoCo takes a mass of NaN for one left open
            raise ValueError("it holds a NaN")
        return source
    except ObjectError:
        raise
    except Exception as error:  # MuJoCo raises ValueError, and it passes on NumPy's and trimesh's
        reason = re.sub(r", line \d+", "", one_line(error))  # of what was left of the file
        raise ObjectError(f"MJCF {path} cannot be read ({reason}); repair or remove it") from error


def referred_files(path: Path) -> set[Path]:
    """The files that a file in MJCF includes and the meshes that it names, as far as they can be
    found out. Raises ObjectError for a file that is no XML."""
    root, included = parse_xml(path), set()
    try:
        root = _with_includes(root, path, included)
        return included | {_mesh_file(path, root, mesh.attrib["file"]) for mesh in _meshes(root)}
    except (ObjectError, ValueError):  # to be named when the object is asked for
        return included


def _source(path: Path, root: Element, density: float) -> ObjectSource:
    spec = mujoco.MjSpec.from_string(ElementTree.tostring(_model(root), encoding="unicode"))
    _check_one_body(spec)
    files = {}
    for mesh in spec.meshes:
        if mesh.file:
            files[mesh.name] = _mesh_file(path, root, mesh.file)
            found = load_mesh(files[mesh.name])
            mesh.uservert, mesh.userface = found.vertices.ravel(), found.faces.ravel()
            mesh.file = ""
    geoms = spec.geoms
    solid = [geom for geom in geoms if geom.contype or geom.conaffinity]
    shown = [geom for geom in geoms if geom not in solid and _rgba(spec, geom)[3] > 0] or solid
    solid = solid or shown
    if not solid:
        raise ValueError("it has neither collision nor visual geometry; add some")
    stated, weighed = _fill_in_densities(spec, root, solid, density)
    for geom in geoms:
        geom.contype = geom.conaffinity = 0  # it spares MuJoCo the convex hulls
    spec.compiler.discardvisual = spec.compiler.fusestatic = False
    spec.compiler.balanceinertia = True  # what no body can have is found out by its even moments
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    shapes = {geom.id: _shape(model, data, geom) for geom in geoms}
    if not 0 <= solid[0].friction[0] < np.inf:
        raise ValueError(f"its friction is {solid[0].friction[0]}")
    return ObjectSource(
        mesh=trimesh.util.concatenate(
            [checked_mesh(shapes[geom.id], f"{path}, geom {geom.name!r}") for geom in solid]
        ),
        friction=float(solid[0].friction[0]),
        inertial=replace(_inertial(model, data), from_density=not weighed) if stated else None,
        color=_color(spec, shown),
        visual=_single_visual(spec, model, data, shown, files),
        visual_mesh=trimesh.util.concatenate([shapes[geom.id] for geom in shown]),
    )


# --- The file -------------------------------------------------------------------------------------


def _with_includes(root: Element, path: Path, included: set[Path]) -> Element:
    """The root, in which the content of each included file stands in the place of <include>.

    path: of the main file, to whose folder all names are relative. included: takes the files.
    """
    for parent in list(root.iter()):
        children: list[Element] = []
        for child in parent:
            if child.tag != "include":
                children.append(child)
                continue
            file = _inside(path, child.get("file", ""))
            if file in included:
                raise ValueError(f"it includes {file.name} twice")
            included.add(file)
            children.extend(_with_includes(parse_xml(file), path, included))
        parent[:] = children
    return root


def _inside(path: Path, name: str) -> Path:
    """The file that `path` names, which has to be below the folder of `path`."""
    file = Path(os.path.abspath(path.parent / name))
    if not file.is_relative_to(os.path.abspath(path.parent)):
        raise ValueError(f"it names {name}, which is outside its folder; put that file beside it")
    return file


def _meshes(root: Element) -> list[Element]:
    return [mesh for asset in root.iter("asset") for mesh in asset.iter("mesh") if mesh.get("file")]


def _mesh_file(path: Path, root: Element, name: str) -> Path:
    """Where a mesh of this name lies, as <compiler> says."""
    settings = {key: value for one in root.iter("compiler") for key, value in one.items()}
    if settings.get("strippath") == "true":
        name = Path(name).name
    return _inside(path, os.path.join(settings.get("meshdir", settings.get("assetdir", "")), name))


def _model(root: Element) -> Element:
    """What of a file shapes and weighs its body, with defaults that tell what it leaves open."""
    if root.tag != "mujoco":
        raise ValueError(f"its root is <{root.tag}>, expected <mujoco>")
    model = Element("mujoco")
    SubElement(
        SubElement(model, "default"), "geom",
        density=str(UNSTATED), friction=str(DEFAULT_FRICTION),
    )  # fmt: skip
    model.extend(section for section in root if section.tag in SECTIONS)
    for asset in model.findall("asset"):
        asset[:] = [one for one in asset if one.tag in ASSETS]
        for one in asset:
            one[:] = []
            if "builtin" in one.attrib:
                raise ValueError("it has a builtin mesh; write it to a file")
    for mesh in _meshes(model):
        mesh.attrib.setdefault("name", Path(mesh.attrib["file"]).stem)
    for material in model.iter("material"):
        material.attrib.pop("texture", None)
    count = sum(1 for worldbody in model.findall("worldbody") for _ in worldbody.iter("geom"))
    if count > MOST_GEOMS:
        raise ValueError(f"it has {count:,} geoms, expected at most {MOST_GEOMS:,}")
    for worldbody in model.findall("worldbody"):
        for parent in list(worldbody.iter()):
            parent[:] = [child for child in parent if child.tag not in WEIGHTLESS]
            for child in parent:
                if child.tag not in SOLID:
                    raise ValueError(f"it holds <{child.tag}>, expected {', '.join(SOLID)} alone")
    return model


@contextmanager
def _without_warnings() -> Iterator[list[str]]:
    """Collects what MuJoCo else writes to the error stream and a file in the current folder."""
    handler, said = mujoco.get_mju_user_warning(), []
    mujoco.set_mju_user_warning(said.append)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of what MuJoCo will read no more one day
            yield said
    finally:
        mujoco.set_mju_user_warning(handler)


# --- The body -------------------------------------------------------------------------------------


def _check_one_body(spec: mujoco.MjSpec) -> None:
    """Also removes the free joint, without which MuJoCo admits any inertia."""
    world = spec.worldbody
    if len(world.bodies) != 1 or world.geoms:
        raise ValueError(
            f"its worldbody holds {len(world.bodies)} bodies and {len(world.geoms)} geoms, "
            "expected one body alone: an object is one rigid body"
        )
    for joint in list(spec.joints):
        if joint.type != mujoco.mjtJoint.mjJNT_FREE:
            raise ValueError(
                f"its joint {joint.name!r} lets parts move, expected at most a free joint: an "
                "object is one rigid body"
            )
        spec.delete(joint)
    for body in spec.bodies:
        if body.explicitinertial and not 0 <= body.mass < np.inf:
            raise ValueError(f"the mass of its body {body.name!r} is {body.mass}")


def _fill_in_densities(
    spec: mujoco.MjSpec, root: Element, solid: list, density: float
) -> tuple[bool, bool]:
    """Give a density to the geoms that state none, 0 to those that collide with nothing. Returns
    whether the file states any mass or density, and whether it states kilograms."""
    lowest, highest = spec.compiler.inertiagrouprange
    from_geoms = spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    weighed = any("settotalmass" in compiler.attrib for compiler in root.iter("compiler"))
    stated = weighed
    for body in spec.bodies:
        if body.explicitinertial and not from_geoms:
            stated = weighed = True
            continue
        for geom in body.geoms:
            if np.isnan(geom.mass) and geom.density == UNSTATED:
                geom.density = density if geom in solid else 0.0
            elif lowest <= geom.group <= highest:  # what has no mass for the eye says nothing
                stated |= geom in solid or (geom.density if np.isnan(geom.mass) else geom.mass) != 0
                weighed |= not np.isnan(geom.mass) and geom.mass != 0
    return stated, weighed


def _inertial(model: mujoco.MjModel, data: mujoco.MjData) -> Inertial:
    axes = data.ximat.reshape(-1, 3, 3)
    return combined(
        [
            (model.body_mass[n], data.xipos[n], axes[n] * model.body_inertia[n] @ axes[n].T)
            for n in range(1, model.nbody)
        ]
    )


def _shape(model: mujoco.MjModel, data: mujoco.MjData, geom) -> trimesh.Trimesh:
    """A geom in the world frame."""
    kind, size = model.geom_type[geom.id], model.geom_size[geom.id]
    if kind == mjtGeom.mjGEOM_MESH:
        mesh = model.geom_dataid[geom.id]
        first, face = model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]
        vertices = model.mesh_vert[first : first + model.mesh_vertnum[mesh]].astype(float)
        faces = model.mesh_face[face : face + model.mesh_facenum[mesh]]
        shape = trimesh.Trimesh(vertices, faces, process=False)
    elif kind == mjtGeom.mjGEOM_BOX:
        shape = trimesh.primitives.Box(2 * size).to_mesh()
    elif kind == mjtGeom.mjGEOM_SPHERE:
        shape = trimesh.primitives.Sphere(size[0]).to_mesh()
    elif kind == mjtGeom.mjGEOM_CYLINDER:
        shape = trimesh.primitives.Cylinder(size[0], 2 * size[1]).to_mesh()
    elif kind == mjtGeom.mjGEOM_CAPSULE:
        shape = trimesh.primitives.Capsule(size[0], 2 * size[1]).to_mesh()
    elif kind == mjtGeom.mjGEOM_ELLIPSOID:
        shape = trimesh.primitives.Sphere(1.0).to_mesh().apply_scale(size)
    else:
        name = mjtGeom(kind).name.removeprefix("mjGEOM_").lower()
        raise ValueError(f"its geom {geom.name!r} is a {name}, which bounds no body")
    return shape.apply_transform(_geom_pose(data, geom))


def _geom_pose(data: mujoco.MjData, geom) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = data.geom_xmat[geom.id].reshape(3, 3), data.geom_xpos[geom.id]
    return T


def _rgba(spec: mujoco.MjSpec, geom) -> tuple[float, ...]:
    """A geom's own, or its material's."""
    rgba = tuple(geom.rgba.tolist())
    if geom.material and rgba == UNCOLOURED:
        rgba = tuple(spec.material(geom.material).rgba.tolist())
    return rgba


def _color(spec: mujoco.MjSpec, shown: list) -> tuple[float, float, float, float] | None:
    """Of the first geom with a colour that can be seen."""
    for rgba in (_rgba(spec, geom) for geom in shown):
        if rgba != UNCOLOURED and rgba[3] > 0:
            red, green, blue, _ = rgba
            return red, green, blue, 1.0
    return None


def _single_visual(spec, model, data, shown: list, files: dict[str, Path]):
    """As `ObjectSource.visual` has it; None also for a mesh with a frame of its own."""
    if len(shown) != 1 or model.geom_type[shown[0].id] != mjtGeom.mjGEOM_MESH:
        return None
    mesh = spec.mesh(shown[0].meshname)
    if mesh.name not in files or mesh.refpos.any() or mesh.refquat[1:].any():
        return None
    number, T = model.geom_dataid[shown[0].id], np.eye(4)
    mujoco.mju_quat2Mat(rotation := np.zeros(9), model.mesh_quat[number])
    T[:3, :3], T[:3, 3] = rotation.reshape(3, 3), model.mesh_pos[number]  # compiled to file's frame
    return files[mesh.name], mesh.scale.copy(), _geom_pose(data, shown[0]) @ np.linalg.inv(T)
