"""Files that come with PyBullet, in the package `pybullet_data`: objects, and the Panda's model.

Both simulators build the Panda from the same URDF. Reading the files needs no simulator.
"""

from __future__ import annotations

import importlib.util
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from utils.geometry import GripperGeometry
from utils.runs import write_atomic

FINGER_JOINTS = ("panda_finger_joint1", "panda_finger_joint2")


def data_folder() -> Path | None:
    """The folder of `pybullet_data`, None where PyBullet is not installed."""
    found = importlib.util.find_spec("pybullet_data")
    return None if found is None else Path(found.origin).parent


def panda_model(gripper: GripperGeometry, fine: bool = False) -> ElementTree.Element:
    """The URDF `franka_panda/panda.urdf` with absolute mesh paths and the gripper's joint limits.

    Unless `fine`, the visual meshes (about 102,000 triangles, which a software renderer transforms
    at every frame) are replaced by the collision meshes (3,400).
    """
    stock = data_folder() / "franka_panda" / "panda.urdf"
    robot = ElementTree.parse(stock).getroot()
    for mesh in robot.iter("mesh"):
        name = mesh.attrib["filename"].replace("package://", "")
        name = name if fine else name.replace("/visual/", "/collision/")
        mesh.set("filename", str(stock.parent / name))
    for name in FINGER_JOINTS:
        limit = robot.find(f"joint[@name='{name}']/limit")
        limit.set("upper", repr(gripper.max_opening / 2))
    return robot


def write_welded_panda(cache_dir: Path, gripper: GripperGeometry, fine: bool) -> Path:
    """Write `panda_model` for PyBullet into the cache folder; its path.

    Links behind fixed joints (flange, hand, grasp target) are welded to their parents: the same
    body, but each link costs the articulated-body solver time at every step.
    """
    robot = panda_model(gripper, fine)
    _weld_fixed_joints(robot)
    detail = "fine" if fine else "low_polygon"
    path = cache_dir / f"panda_{detail}_{1000 * gripper.max_opening:g}mm.urdf"
    text = ElementTree.tostring(robot, encoding="utf-8")
    if not path.exists() or path.read_bytes() != text:
        write_atomic(path, text)
    return path


def _weld_fixed_joints(robot: ElementTree.Element) -> None:
    """Give the shapes and mass of each link behind a fixed joint to the link before it."""
    links = {link.attrib["name"]: link for link in robot.iter("link")}
    for joint in robot.findall("joint[@type='fixed']"):
        T = _origin(joint)
        parent, child = (joint.find(end).attrib["link"] for end in ("parent", "child"))
        for shape in [*links[child].findall("visual"), *links[child].findall("collision")]:
            _set_origin(shape, T @ _origin(shape))
            links[parent].append(shape)
        _add_mass(links[parent], links[child], T)
        for other in robot.findall("joint"):
            if other is not joint and other.find("parent").attrib["link"] == child:
                other.find("parent").set("link", parent)
                _set_origin(other, T @ _origin(other))
        robot.remove(links[child])
        robot.remove(joint)


def _add_mass(parent: ElementTree.Element, child: ElementTree.Element, T: np.ndarray) -> None:
    """Add a welded link's mass at its place. PyBullet works out the inertia from the shapes."""
    added = child.find("inertial")
    if added is None:
        return
    own = parent.find("inertial")
    if own is None:
        _set_origin(added, T @ _origin(added))
        parent.append(added)
        return
    masses = [float(inertial.find("mass").attrib["value"]) for inertial in (own, added)]
    if sum(masses) > 0:
        centre = np.eye(4)
        centre[:3, 3] = np.average(
            [_origin(own)[:3, 3], (T @ _origin(added))[:3, 3]], axis=0, weights=masses
        )
        _set_origin(own, centre)
    own.find("mass").set("value", repr(sum(masses)))


def _origin(element: ElementTree.Element) -> np.ndarray:
    """(4, 4) transform of a URDF element's origin."""
    T, origin = np.eye(4), element.find("origin")
    if origin is not None:
        xyz, rpy = ([float(x) for x in origin.get(k, "0 0 0").split()] for k in ("xyz", "rpy"))
        T[:3, :3] = Rotation.from_euler("xyz", rpy).as_matrix()
        T[:3, 3] = xyz
    return T


def _set_origin(element: ElementTree.Element, T: np.ndarray) -> None:
    origin = element.find("origin")
    if origin is None:
        origin = ElementTree.SubElement(element, "origin")
    origin.set("xyz", " ".join(repr(float(x)) for x in T[:3, 3]))
    rpy = Rotation.from_matrix(T[:3, :3]).as_euler("xyz")
    origin.set("rpy", " ".join(repr(float(x)) for x in rpy))
