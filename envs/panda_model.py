"""The Franka Panda with its hand as data: joints, masses, shapes and surfaces of every link.

Both simulators build the robot from `panda_links`: MuJoCo by its own interface, PyBullet from the
URDF that `envs.panda_urdf` makes of it. Lengths and limits are those of `envs.robot_kinematics`;
the shape of the fingers and of the palm's underside is that of `utils.geometry`. This module knows
no simulator.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from envs.robot import FINGER_SPEED
from envs.robot_kinematics import (
    FLANGE_LENGTH,
    GRASP_DEPTH,
    HAND_TURN,
    HAND_VELOCITY,
    JOINT_LOWER,
    JOINT_TORQUE,
    JOINT_UPPER,
    JOINT_VELOCITY,
    joint_origin,
)
from utils.geometry import GripperGeometry
from utils.transforms import transform_points

BASE = "panda_link0"
ARM_LINKS = tuple(f"panda_link{i}" for i in range(1, 8))
HAND = "panda_hand"
FINGERS = ("panda_leftfinger", "panda_rightfinger")
ARM_JOINTS = tuple(f"panda_joint{i}" for i in range(1, 8))
FINGER_JOINTS = ("panda_finger_joint1", "panda_finger_joint2")

# What carries a hand without an arm; the third joint moves the hand itself.
CARRIAGE_BASE = "panda_carriage"
_CARRIAGE_LINKS = ("panda_carriage_x", "panda_carriage_y")
CARRIAGE_JOINTS = ("panda_carriage_joint1", "panda_carriage_joint2", "panda_carriage_joint3")
# m either way along each axis: a pregrasp, a lift and the way aside of a tilted hand (`attempt`).
CARRIAGE_REACH = 0.6
CARRIAGE_FORCE = 300.0  # N, of each of its motors: much more than objects on a table push back

FINGER_FORCE = 70.0  # N, highest continuous grasping force in the Franka Hand's product manual


# --- Masses ---------------------------------------------------------------------------------------


class Inertial(NamedTuple):
    """mass: kg. centre: (3,) m in the link's frame. inertia: kg m2 about the centre, along the
    link's axes: xx, yy, zz, xy, xz, yz."""

    mass: float
    centre: tuple[float, float, float]
    inertia: tuple[float, float, float, float, float, float]

    def tensor(self) -> np.ndarray:
        """(3, 3) inertia about the centre, kg m2."""
        xx, yy, zz, xy, xz, yz = self.inertia
        return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


# Arm: Gaz, Cognetti, Oliva, Robuffo Giordano and De Luca, "Dynamic identification of the Franka
# Emika Panda robot with retrieval of feasible parameters using penalty-based optimization" (RA-L
# 2019), in the links' frames as Franka's description of the robot and MuJoCo Menagerie carry them.
# Hand: the same two.
INERTIALS = {
    BASE: Inertial(
        0.629769, (-0.041018, -0.00014, 0.049974),
        (0.00315, 0.00388, 0.004285, 8.2904e-7, 0.00015, 8.2299e-6),
    ),
    "panda_link1": Inertial(
        4.970684, (0.003875, 0.002081, -0.04762),
        (0.70337, 0.70661, 0.0091170, -0.000139, 0.006772, 0.019169),
    ),
    "panda_link2": Inertial(
        0.646926, (-0.003141, -0.02872, 0.003495),
        (0.007962, 0.02811, 0.025995, -0.003925, 0.010254, 0.000704),
    ),
    "panda_link3": Inertial(
        3.228604, (0.027518, 0.039252, -0.066502),
        (0.037242, 0.036155, 0.01083, -0.004761, -0.011396, -0.012805),
    ),
    "panda_link4": Inertial(
        3.587895, (-0.05317, 0.104419, 0.027454),
        (0.025853, 0.019552, 0.028323, 0.007796, -0.001332, 0.008641),
    ),
    "panda_link5": Inertial(
        1.225946, (-0.011953, 0.041065, -0.038437),
        (0.035549, 0.029474, 0.008627, -0.002117, -0.004037, 0.000229),
    ),
    "panda_link6": Inertial(
        1.666555, (0.060149, -0.014117, -0.010517),
        (0.001964, 0.004354, 0.005433, 0.000109, -0.001158, 0.000341),
    ),
    "panda_link7": Inertial(
        0.735522, (0.010517, -0.004252, 0.061597),
        (0.012516, 0.010027, 0.004815, -0.000428, -0.001196, -0.000741),
    ),
    HAND: Inertial(0.73, (-0.01, 0.0, 0.03), (0.001, 0.0025, 0.0017, 0.0, 0.0, 0.0)),
    **dict.fromkeys(
        FINGERS, Inertial(0.015, (0.0, 0.0, 0.0), (2.375e-6, 2.375e-6, 7.5e-7, 0.0, 0.0, 0.0))
    ),
}  # fmt: skip

# Of each part of the carriage: a number near the hand's, so that the solver's steps stay good.
_CARRIAGE_INERTIAL = Inertial(0.5, (0.0, 0.0, 0.0), (0.001, 0.001, 0.001, 0.0, 0.0, 0.0))


# --- Surfaces -------------------------------------------------------------------------------------


class Surface(NamedTuple):
    """friction: coefficient of sliding; that of the object counts besides. spinning: the largest
    torque about a contact's normal, over the largest friction force, m. stiffness: N/m, and
    damping: N s/m, of a contact."""

    friction: float
    spinning: float
    stiffness: float
    damping: float


# A rubber fingertip touches an object not in a point but in a patch, here a disc of this radius
# under even pressure: a bit less than half the 17.6 mm width of the tips. About its normal friction
# then holds a torque of 2/3 radius x friction force (Howe and Cutkosky, "Practical force-motion
# models for sliding manipulation", IJRR 1996).
PATCH_RADIUS = 0.0075  # m
# Stiffness and damping, for PyBullet alone, as pybullet_data's `franka_panda/panda.urdf` has them.
FINGER_SURFACE = Surface(
    friction=1.0, spinning=2 / 3 * PATCH_RADIUS, stiffness=30000.0, damping=1000.0
)

# kg that motor and gear add to what a finger's motion has to accelerate. Nobody has published it.
# With the 15 g of a finger alone PyBullet's solver, which takes from joint to contact a limited
# impulse in each iteration, grips with 5 N whatever the motor's force; with this, with up to 70 N.
FINGER_DRIVE_INERTIA = 0.2


# --- Shapes ---------------------------------------------------------------------------------------
# Each link is one convex hull, the form in which both simulators would take a mesh, too. Arm links
# are hulls of a few discs, fitted by least squares to the tangent planes of pybullet_data's
# collision meshes in 700 directions; `python -m benchmarks.show_robot` prints how far the two lie
# apart.


class Disc(NamedTuple):
    """axis: x, y or z of the link's frame. centre: (3,) m in it. radius: m."""

    axis: str
    centre: tuple[float, float, float]
    radius: float


ARM_DISCS = {
    BASE: (
        Disc("z", (0.0, 0.0, 0.0), 0.071),
        Disc("z", (0.0, 0.081, 0.0), 0.013),
        Disc("z", (0.0, -0.081, 0.0), 0.013),
        Disc("z", (-0.110, 0.033, 0.0), 0.041),
        Disc("z", (-0.110, -0.033, 0.0), 0.041),
        Disc("z", (-0.008, 0.049, 0.036), 0.039),
        Disc("z", (-0.008, -0.049, 0.036), 0.039),
        Disc("z", (-0.052, 0.0, 0.063), 0.073),
        Disc("z", (0.0, 0.0, 0.140), 0.055),
    ),
    "panda_link1": (
        Disc("z", (0.0, 0.0, -0.192), 0.055),
        Disc("z", (0.0, 0.0, -0.127), 0.055),
        Disc("y", (0.0, 0.0, 0.0), 0.055),
        Disc("y", (0.0, -0.065, 0.0), 0.055),
        Disc("y", (0.0, -0.109, 0.0), 0.046),
        Disc("y", (0.0, -0.127, 0.0), 0.020),
    ),
    "panda_link2": (
        Disc("y", (0.0, -0.194, 0.0), 0.055),
        Disc("y", (0.0, -0.127, 0.0), 0.055),
        Disc("z", (0.0, 0.0, 0.0), 0.055),
        Disc("z", (0.0, 0.0, 0.065), 0.055),
        Disc("z", (0.0, 0.0, 0.109), 0.046),
        Disc("z", (0.0, 0.0, 0.127), 0.020),
    ),
    "panda_link3": (
        Disc("z", (0.0, 0.0, -0.121), 0.055),
        Disc("z", (0.0, 0.0, -0.034), 0.044),
        Disc("y", (0.0825, 0.001, 0.0), 0.055),
        Disc("y", (0.0825, 0.077, 0.0), 0.051),
        Disc("y", (0.0825, 0.095, 0.0), 0.044),
        Disc("y", (0.0825, 0.109, 0.0), 0.020),
    ),
    "panda_link4": (
        Disc("y", (-0.0825, 0.124, 0.0), 0.055),
        Disc("y", (-0.0825, 0.035, 0.0), 0.045),
        Disc("z", (0.0, 0.0, 0.001), 0.055),
        Disc("z", (0.0, 0.0, 0.077), 0.051),
        Disc("z", (0.0, 0.0, 0.095), 0.044),
        Disc("z", (0.0, 0.0, 0.109), 0.020),
    ),
    "panda_link5": (
        Disc("z", (0.0, 0.0, -0.260), 0.055),
        Disc("z", (0.0, 0.0, -0.229), 0.054),
        Disc("z", (0.0, 0.039, -0.193), 0.050),
        Disc("y", (0.0, 0.016, 0.0), 0.048),
        Disc("y", (0.0, 0.101, 0.0), 0.051),
        Disc("y", (0.0, 0.126, 0.002), 0.027),
    ),
    "panda_link6": (
        Disc("z", (0.0, 0.0, -0.015), 0.048),
        Disc("z", (0.0, 0.0, 0.031), 0.046),
        Disc("z", (0.010, 0.001, 0.054), 0.030),
        Disc("z", (0.061, 0.057, 0.0), 0.026),
        Disc("y", (0.088, -0.051, 0.0), 0.044),
        Disc("y", (0.088, 0.052, 0.0), 0.040),
        Disc("y", (0.079, 0.073, 0.0), 0.036),
        Disc("x", (0.119, 0.041, 0.0), 0.029),
    ),
    "panda_link7": (
        Disc("z", (0.0, 0.0, 0.052), 0.044),
        Disc("z", (0.0, 0.0, 0.097), 0.044),
        Disc("z", (0.0, 0.0, 0.1068), 0.030),
        Disc("z", (-0.033, -0.033, 0.0875), 0.007),
        Disc("z", (0.038, 0.058, 0.081), 0.020),
        Disc("z", (0.058, 0.038, 0.081), 0.020),
        Disc("z", (0.038, 0.075, 0.092), 0.006),
        Disc("z", (0.075, 0.038, 0.092), 0.006),
        Disc("z", (0.038, 0.080, 0.079), 0.001),  # from here on, the corners of its lug
        Disc("z", (0.080, 0.038, 0.079), 0.001),
        Disc("z", (0.037, 0.077, 0.096), 0.001),
        Disc("z", (0.077, 0.037, 0.096), 0.001),
    ),
}
_CORNERS = 16  # of the polygon that stands for a disc

# The palm's underside, as `palm_outline` has it, reaches along the closing line from y to y, mm.
_PALM_ENDS = ((-93.1, 92.1), (-87.3, 91.1), (-90.0, 89.2), (-85.2, 93.6), (-0.9, -0.9))
# The rest of the hand: mm across, along and below the hand's frame; each point is on both sides.
# Fitted like the discs. The mesh is 0.6 mm off its own mirror image, the real hand is not.
_HAND_POINTS = (
    (2.3, -83.9, -26.0), (2.0, -43.1, -26.0), (2.3, -100.2, -15.8), (0.6, -104.2, -7.4),
    (25.4, 83.3, -4.7), (31.6, -0.9, 1.0), (21.7, 91.0, 1.4), (14.1, 92.8, 3.2),
    (16.8, -91.2, 4.3), (22.3, 93.9, 8.6), (18.7, 97.2, 19.9), (17.1, -96.7, 29.3),
    (17.8, 99.7, 42.6), (19.1, 98.2, 47.9), (16.8, -99.0, 53.4), (16.1, 99.9, 54.8),
    (14.0, -100.0, 56.1), (9.8, 100.2, 58.0), (7.3, -100.1, 58.7), (0.3, 97.6, 62.2),
    (14.5, -92.6, 65.3), (13.4, 92.9, 65.5),
)  # fmt: skip


def hull_of_discs(discs: tuple[Disc, ...]) -> np.ndarray:
    """(V, 3) vertices, m, of the convex hull of discs, each taken as a polygon that is as far
    outside of the circle at its corners as it is inside at its edges."""
    angles = 2 * np.pi * np.arange(_CORNERS) / _CORNERS
    scale = 2 / (1 + np.cos(np.pi / _CORNERS))
    circle = np.column_stack([np.cos(angles), np.sin(angles), 0 * angles])
    points = []
    for axis, centre, radius in discs:
        rim = np.roll(circle, "xyz".index(axis) + 1, axis=1)  # z becomes the disc's axis
        points.append(np.array(centre) + scale * radius * rim)
    return _corners(np.vstack(points))


def finger_hull(gripper: GripperGeometry) -> np.ndarray:
    """(V, 3) vertices, m, of the left finger in its frame: x across, y outward, z towards the tip;
    the pad's face is y = 0."""
    thickness = gripper.finger_outline[1][0]
    (outside, shoulder), (base, length) = gripper.finger_outline[-2:]
    tip, pad, bevel = gripper.tip_half_width, gripper.pad_half_width, gripper.tip_bevel
    half = gripper.finger_half_width
    points = [  # across, outward, above the tip
        (tip, 0.0, 0.0), (tip, thickness, 0.0),
        (pad, 0.0, bevel), (pad, thickness - 0.0003, bevel),
        (pad - 0.0009, thickness - 0.0001, bevel / 2),  # the outer edge of the bevel is round
        (pad, 0.0, gripper.pad_height),
        (half, gripper.flank, shoulder), (half, outside, shoulder),
        (half, gripper.pad_recess, length), (half, base, length),
    ]  # fmt: skip
    return _corners(_on_both_sides(points) * (1, 1, -1) + (0, 0, length))


def palm_hull(gripper: GripperGeometry) -> np.ndarray:
    """(V, 3) vertices, m, of the hand without its fingers in its frame: x across, y along the
    closing line, z towards the tips."""
    tips = GRASP_DEPTH + gripper.tip_below_centre
    underside = [
        (across, end / 1000, tips - height)
        for (across, height), ends in zip(gripper.palm_outline, _PALM_ENDS)
        for end in ends
    ]
    return _corners(_on_both_sides([*underside, *(np.array(_HAND_POINTS) / 1000)]))


def _on_both_sides(points) -> np.ndarray:
    points = np.array(points)
    return np.vstack([points, points * (-1, 1, 1)])


def _corners(points: np.ndarray) -> np.ndarray:
    """The vertices of the points' convex hull."""
    return points[ConvexHull(points).vertices]


# --- Links ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Joint:
    """kind: URDF's word. axis: (3,) in the joint's frame. lower, upper: rad or m. speed: rad/s or
    m/s. effort: N m or N."""

    name: str
    kind: str
    axis: tuple[float, float, float]
    lower: float
    upper: float
    speed: float
    effort: float


class Shape(NamedTuple):
    """A convex solid. part: link0 to link7, hand or finger. T: (4, 4) pose of the part's frame in
    the link's. hull: (V, 3) vertices in the part's frame, m."""

    part: str
    T: np.ndarray
    hull: np.ndarray


@dataclass(frozen=True)
class Link:
    """T: (4, 4) pose in the parent's frame with the joint at 0. joint: None for a link that cannot
    move against its parent."""

    name: str
    parent: str | None
    T: np.ndarray
    joint: Joint | None
    inertial: Inertial
    shapes: tuple[Shape, ...]
    surface: Surface | None = None

    def hulls(self) -> list[np.ndarray]:
        """Vertices (V, 3) of its convex solids in its frame, m."""
        return [transform_points(shape.T, shape.hull) for shape in self.shapes]


@functools.cache  # MuJoCo's cell asks at every build
def panda_links(gripper: GripperGeometry) -> tuple[Link, ...]:
    """Base, seven arm links, hand, left and right finger; each comes after its parent."""
    base = Shape("link0", np.eye(4), hull_of_discs(ARM_DISCS[BASE]))
    links = [Link(BASE, None, np.eye(4), None, INERTIALS[BASE], (base,))]
    for i, name in enumerate(ARM_LINKS):
        joint = Joint(
            ARM_JOINTS[i], "revolute", (0.0, 0.0, 1.0), float(JOINT_LOWER[i]),
            float(JOINT_UPPER[i]), float(JOINT_VELOCITY[i]), float(JOINT_TORQUE[i]),
        )  # fmt: skip
        shape = Shape(f"link{i + 1}", np.eye(4), hull_of_discs(ARM_DISCS[name]))
        T = _pose(*joint_origin(i + 1))
        links.append(Link(name, links[-1].name, T, joint, INERTIALS[name], (shape,)))
    flange = _pose((0.0, 0.0, FLANGE_LENGTH), HAND_TURN, "z")
    return (*links, *_hand_links(gripper, ARM_LINKS[-1], flange, None))


@functools.cache
def floating_links(gripper: GripperGeometry) -> tuple[Link, ...]:
    """The hand without the arm: a base that has E's frame, a carriage of three straight joints
    along its axes, and at the last one hand, left and right finger."""
    links = [Link(CARRIAGE_BASE, None, np.eye(4), None, _CARRIAGE_INERTIAL, ())]
    limits = -CARRIAGE_REACH, CARRIAGE_REACH, HAND_VELOCITY[0], CARRIAGE_FORCE
    axes = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
    joints = [Joint(name, "prismatic", axis, *limits) for name, axis in zip(CARRIAGE_JOINTS, axes)]
    for name, joint in zip(_CARRIAGE_LINKS, joints):
        links.append(Link(name, links[-1].name, np.eye(4), joint, _CARRIAGE_INERTIAL, ()))
    behind = _pose((0.0, 0.0, -GRASP_DEPTH))
    return (*links, *_hand_links(gripper, links[-1].name, behind, joints[-1]))


def _hand_links(
    gripper: GripperGeometry, parent: str, T: np.ndarray, joint: Joint | None
) -> list[Link]:
    """Hand, left and right finger; T: (4, 4) pose of the hand's frame in its parent's."""
    palm = Shape("hand", np.eye(4), palm_hull(gripper))
    links = [Link(HAND, parent, T, joint, INERTIALS[HAND], (palm,))]
    hull, length = finger_hull(gripper), gripper.finger_outline[-1][1]
    T = _pose((0.0, 0.0, GRASP_DEPTH + gripper.tip_below_centre - length))
    for name, joint_name, side, turn in zip(FINGERS, FINGER_JOINTS, (1.0, -1.0), (0.0, np.pi)):
        joint = Joint(
            joint_name, "prismatic", (0.0, side, 0.0), 0.0, gripper.max_opening / 2,
            FINGER_SPEED, FINGER_FORCE,
        )  # fmt: skip
        shape = Shape("finger", _pose(turn=turn, axis="z"), hull)
        links.append(Link(name, HAND, T, joint, INERTIALS[name], (shape,), FINGER_SURFACE))
    return links


def _pose(offset=(0.0, 0.0, 0.0), turn: float = 0.0, axis: str = "x") -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_euler(axis, turn).as_matrix(), offset
    return T
