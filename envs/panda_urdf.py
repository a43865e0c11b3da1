"""The Panda of `envs.panda_model` as a URDF with meshes, for PyBullet.

Files go into a folder whose name is a digest of what they hold, so that versions never mix.
"""

from __future__ import annotations

import hashlib
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from envs.panda_model import Inertial, Joint, Link, Shape, Surface, floating_links, panda_links
from utils.atomic_files import write_atomic
from utils.geometry import GripperGeometry
from utils.transforms import transform_points

WHITE = (1.0, 1.0, 1.0, 1.0)


def write_panda(
    cache_dir: Path,
    gripper: GripperGeometry,
    meshes: Mapping[str, Path] | None = None,
    arm: bool = True,
) -> Path:
    """Write the robot with welded links into the cache folder; the URDF's path.

    meshes: for pictures, of each part the detailed mesh, which brings its own colours. Other parts
    are shown as the shapes of the physics, in white.
    arm: False for the hand alone (`floating_links`).
    """
    files: dict[str, bytes] = {}
    robot = ElementTree.Element("robot", name="panda")
    for link in welded(panda_links(gripper) if arm else floating_links(gripper)):
        element = _add(robot, "link", name=link.name)
        _add_inertial(element, link.inertial)
        if link.surface is not None:
            _add_surface(element, link.surface)
        for shape in link.shapes:
            files[f"{shape.part}.obj"] = _obj(shape.hull)
            _add_mesh(element, "collision", shape.T, f"{shape.part}.obj")
            _add_picture(element, shape, meshes or {})
        if link.joint is not None:
            _add_joint(robot, link, link.joint)
    ElementTree.indent(robot)  # PyBullet takes no line of more than some 1,000 characters
    files["panda.urdf"] = ElementTree.tostring(robot, encoding="utf-8")
    content = b"".join(name.encode() + data for name, data in sorted(files.items()))
    folder = cache_dir / f"panda_{hashlib.sha256(content).hexdigest()[:12]}"
    for name, data in files.items():
        if not (folder / name).exists():
            write_atomic(folder / name, data)
    return folder / "panda.urdf"


def welded(links: tuple[Link, ...]) -> tuple[Link, ...]:
    """The same robot with each link that cannot move made part of its parent: Bullet's solver
    spends time on every link at every step."""
    found: dict[str, Link] = {}
    part_of: dict[str, tuple[str, np.ndarray]] = {}  # of a welded link: the whole, its pose in it
    for link in links:
        parent, T = part_of.get(link.parent, (link.parent, np.eye(4)))
        T = T @ link.T
        if parent is None or link.joint is not None:
            found[link.name] = replace(link, parent=parent, T=T)
            continue
        part_of[link.name] = parent, T
        whole = found[parent]
        moved = [shape._replace(T=T @ shape.T) for shape in link.shapes]
        found[parent] = replace(
            whole,
            inertial=_together(whole.inertial, link.inertial, T),
            shapes=(*whole.shapes, *moved),
        )
    return tuple(found.values())


def _together(one: Inertial, other: Inertial, T: np.ndarray) -> Inertial:
    """Two bodies as one; the other's frame is at T (4, 4) in this one's."""
    masses = np.array([one.mass, other.mass])
    centres = np.array([one.centre, transform_points(T, np.array(other.centre))])
    centre = masses @ centres / masses.sum()
    tensor = one.tensor() + T[:3, :3] @ other.tensor() @ T[:3, :3].T
    for mass, arm in zip(masses, centres - centre):  # Steiner's theorem
        tensor += mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = tensor.tolist()
    return Inertial(float(masses.sum()), tuple(centre.tolist()), (xx, yy, zz, xy, xz, yz))


# --- XML and meshes -------------------------------------------------------------------------------


def _add(parent: ElementTree.Element, tag: str, **values) -> ElementTree.Element:
    """A new element; numbers are written so that they are read back as the same ones."""
    text = {
        name: value if isinstance(value, str) else " ".join(repr(float(v)) for v in np.ravel(value))
        for name, value in values.items()
    }
    return ElementTree.SubElement(parent, tag, text)


def _add_origin(parent: ElementTree.Element, T: np.ndarray) -> None:
    _add(parent, "origin", xyz=T[:3, 3], rpy=Rotation.from_matrix(T[:3, :3]).as_euler("xyz"))


def _add_inertial(link: ElementTree.Element, inertial: Inertial) -> None:
    element = _add(link, "inertial")
    _add(element, "origin", xyz=inertial.centre)
    _add(element, "mass", value=inertial.mass)
    names = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    _add(element, "inertia", **dict(zip(names, inertial.inertia)))


def _add_surface(link: ElementTree.Element, surface: Surface) -> None:
    element = _add(link, "contact")
    _add(element, "friction_anchor")
    _add(element, "lateral_friction", value=surface.friction)
    _add(element, "spinning_friction", value=surface.spinning)
    _add(element, "stiffness", value=surface.stiffness)
    _add(element, "damping", value=surface.damping)


def _add_picture(link: ElementTree.Element, shape: Shape, meshes: Mapping[str, Path]) -> None:
    """What cameras see."""
    element = _add_mesh(link, "visual", shape.T, str(meshes.get(shape.part, f"{shape.part}.obj")))
    material = _add(element, "material", name="_".join(f"{c:g}" for c in WHITE))
    _add(material, "color", rgba=WHITE)


def _add_mesh(
    link: ElementTree.Element, kind: str, T: np.ndarray, filename: str
) -> ElementTree.Element:
    element = _add(link, kind)
    _add_origin(element, T)
    _add(_add(element, "geometry"), "mesh", filename=filename)
    return element


def _add_joint(robot: ElementTree.Element, link: Link, joint: Joint) -> None:
    element = _add(robot, "joint", name=joint.name, type=joint.kind)
    _add_origin(element, link.T)
    _add(element, "parent", link=link.parent)
    _add(element, "child", link=link.name)
    _add(element, "axis", xyz=joint.axis)
    _add(
        element, "limit",
        lower=joint.lower, upper=joint.upper, velocity=joint.speed, effort=joint.effort,
    )  # fmt: skip


def _obj(hull: np.ndarray) -> bytes:
    """A convex hull (V, 3) as triangles in Wavefront's format, seen from outside anticlockwise."""
    found = ConvexHull(hull)
    lines = [f"v {x:.7g} {y:.7g} {z:.7g}" for x, y, z in hull]
    for corners, plane in zip(found.simplices, found.equations):
        a, b, c = hull[corners]
        if np.cross(b - a, c - a) @ plane[:3] < 0:
            corners = corners[::-1]
        lines.append("f " + " ".join(str(i + 1) for i in corners))
    return ("\n".join(lines) + "\n").encode()
