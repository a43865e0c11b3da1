"""Shapes that planners reason about: the scene's true solids, the workspace and the gripper.

A convex solid is the set of points with normals @ x <= offsets, so that a line meets it in one
interval that is found in closed form. This module knows no simulator and no network.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import ConvexHull

from utils.errors import UserError
from utils.transforms import transform_points

# The tray into which picked objects go, beside the workspace.
TRAY_CENTRE = np.array([0.42, -0.48])  # m in W; outside the overhead camera's view
TRAY_HALF_SIZE, TRAY_WALL = 0.13, 0.005  # m
HANGS_FROM = 0.05  # m over the table, of the lowest point of what hangs over it


@dataclass(frozen=True)
class ConvexSolid:
    """vertices (V, 3) in metres; outward unit normals (F, 3) and offsets (F,)."""

    vertices: np.ndarray
    normals: np.ndarray
    offsets: np.ndarray

    @staticmethod
    def from_vertices(vertices: np.ndarray) -> ConvexSolid:
        hull = ConvexHull(np.asarray(vertices, dtype=float))
        planes = np.unique(hull.equations.round(9), axis=0)
        return ConvexSolid(hull.points[hull.vertices], planes[:, :3], -planes[:, 3])

    def transformed(self, T: np.ndarray) -> ConvexSolid:
        normals = self.normals @ T[:3, :3].T
        return ConvexSolid(
            transform_points(T, self.vertices), normals, self.offsets + normals @ T[:3, 3]
        )

    def hangs(self, table_height: float) -> bool:
        """Whether the solid, in W, leaves room below it on a table, as a shelf's board does."""
        return bool(self.vertices[:, 2].min() > table_height + HANGS_FROM)


@dataclass(frozen=True)
class SolidObject:
    """One object in the world frame: its convex solids, centre of mass (3,) and friction."""

    solids: tuple[ConvexSolid, ...]
    centre_of_mass: np.ndarray
    friction: float


@dataclass(frozen=True)
class SceneGeometry:
    """All objects of a scene in W; the table is the half-space z <= table_height, and walls stand
    on it."""

    objects: tuple[SolidObject, ...]
    table_height: float = 0.0
    walls: tuple[ConvexSolid, ...] = ()

    def transformed(self, T: np.ndarray) -> SceneGeometry:
        """The objects and walls in another frame, in which the table is no longer level; `T` (4, 4)
        takes points of W there."""
        objects = tuple(
            replace(
                item,
                solids=tuple(solid.transformed(T) for solid in item.solids),
                centre_of_mass=transform_points(T, item.centre_of_mass),
            )
            for item in self.objects
        )
        walls = tuple(wall.transformed(T) for wall in self.walls)
        return SceneGeometry(objects, self.table_height, walls)

    def uncovered(self) -> SceneGeometry:
        """The scene in W without walls that hang over the table."""
        walls = tuple(wall for wall in self.walls if not wall.hangs(self.table_height))
        return replace(self, walls=walls)


@dataclass(frozen=True)
class LineHits:
    """Where N lines meet a convex solid.

    enter, leave: (N,) line parameters; a line that misses has enter = inf and leave = -inf.
    enter_normal, leave_normal: (N, 3) outward unit normals of the faces; NaN where missed.
    """

    enter: np.ndarray
    leave: np.ndarray
    enter_normal: np.ndarray
    leave_normal: np.ndarray

    @property
    def hit(self) -> np.ndarray:
        """(N,) bool: the line meets the solid."""
        return self.enter <= self.leave


def intersect_lines(solid: ConvexSolid, origins: np.ndarray, directions: np.ndarray) -> LineHits:
    """Closed-form intersection of lines origins + t * directions with a convex solid.

    origins: (N, 3); directions: (N, 3) or (3,), need not be unit length. Each face cuts the line
    to a half-line, so the interval is [max of entering t, min of leaving t] (Cyrus and Beck 1978;
    Ericson, Real-Time Collision Detection, 5.3.8).
    """
    origins = np.atleast_2d(np.asarray(origins, dtype=float))
    directions = np.broadcast_to(np.asarray(directions, dtype=float), origins.shape)
    rate = directions @ solid.normals.T
    room = solid.offsets - origins @ solid.normals.T
    parallel = np.abs(rate) < 1e-12
    t = room / np.where(parallel, 1.0, rate)
    entering = np.where((rate < 0) & ~parallel, t, -np.inf)
    leaving = np.where((rate > 0) & ~parallel, t, np.inf)
    first, last = entering.argmax(axis=1), leaving.argmin(axis=1)
    rows = np.arange(len(origins))
    enter, leave = entering[rows, first], leaving[rows, last]
    missed = (enter > leave) | (parallel & (room < 0)).any(axis=1)
    return LineHits(
        np.where(missed, np.inf, enter),
        np.where(missed, -np.inf, leave),
        np.where(missed[:, None], np.nan, solid.normals[first]),
        np.where(missed[:, None], np.nan, solid.normals[last]),
    )


@dataclass(frozen=True)
class Workspace:
    """The square of the table on which objects are placed: centre (x, y) in W and side, metres."""

    centre: tuple[float, float] = (0.5, 0.0)
    size: float = 0.30
    table_height: float = 0.0

    def __post_init__(self) -> None:
        """Raises UserError where the centre is no pair of numbers or the side not positive."""
        centre = np.asarray(self.centre, dtype=float)
        if centre.shape != (2,) or not np.isfinite([*centre, self.size, self.table_height]).all():
            raise UserError(
                f"workspace: got the centre {self.centre} and the side {self.size}, expected "
                "(x, y) and a number, in metres"
            )
        if self.size <= 0:
            raise UserError(f"workspace: the side must be positive, got {self.size:g} m")


@dataclass(frozen=True)
class GripperGeometry:
    """Outer shape of the Franka hand, metres, measured from the fingertips' lowest point up.

    Read off the convex hulls of the collision meshes `finger.obj` and `hand.obj` in
    pybullet_data/franka_panda, with the joint origins of its `panda.urdf`: the hand's frame lies
    0.1122 above the tips, E 0.105 below that frame. "Along" is the closing line, "across" is
    horizontal and at right angles to it. `envs.panda_model` makes the simulators' fingers and the
    palm's underside from these numbers.

    The defaults are the Panda's own hand. Robot, planners, labels and networks take theirs from a
    config or a checkpoint (`gripper.max_opening`), whose default repeats this one;
    tests/test_geometry.py checks that the two are equal.
    """

    max_opening: float = 0.08  # two finger joints of 0.04 each
    opens_fully: bool = False  # whether the hand comes to every grasp as wide open as it gets
    least_held: float = 0.0  # between the fingers: closed to this, or less, a hand counts as empty
    tip_below_centre: float = 0.0072  # 0.1122 - 0.105: how far the tips reach below E
    finger_half_width: float = 0.0105  # across, at the widest
    pad_half_width: float = 0.0087  # across, the flat face that touches the object
    pad_height: float = 0.0176  # flat from the tip up
    pad_recess: float = 0.0026  # how far the hull has receded from the pad's face at its upper end
    flank: float = 0.0155  # outward from the pad's face, where the finger gets its whole width
    tip_half_width: float = 0.0056  # across, at the lowest point
    tip_bevel: float = 0.0030  # height above the tip from which the pad has its whole width
    palm_half_length: float = 0.104  # along
    # Underside of a finger: (distance outward from the pad's face, height above the tip).
    finger_outline: tuple[tuple[float, float], ...] = (
        (0.0, 0.0), (0.0143, 0.0), (0.0145, 0.0007), (0.0253, 0.0350), (0.0264, 0.0538),
    )  # fmt: skip
    # Underside of the hand: (distance across, height above the tip); it widens upwards.
    palm_outline: tuple[tuple[float, float], ...] = (
        (0.0, 0.0460), (0.0160, 0.0470), (0.0172, 0.0485), (0.0192, 0.0565), (0.0316, 0.1055),
    )  # fmt: skip

    def opening_before(self, width: float) -> float:
        """Metres between the fingertips on the way to a grasp of this width."""
        return self.max_opening if self.opens_fully else width

    @property
    def finger_thickness(self) -> float:
        """Metres along, of a finger's tip."""
        return self.finger_outline[1][0]

    @property
    def palm_half_width(self) -> float:
        """Metres across, of the hand's lowest part."""
        return self.palm_outline[1][0]

    @property
    def palm_height(self) -> float:
        """Height of the hand's lowest point above the fingertips, metres."""
        return self.palm_outline[0][1]

    def finger_underside(self, outward: np.ndarray) -> np.ndarray:
        """Height of a finger's underside above the tip at distances outward from its pad's face.

        Infinite where there is no finger. An object under it is hit on a straight descent exactly
        if it is higher than the tip's final height plus this.
        """
        distance, height = np.array(self.finger_outline).T
        return np.interp(outward, distance, height, left=np.inf, right=np.inf)

    def palm_underside(self, across: np.ndarray) -> np.ndarray:
        """Height of the hand's underside above the tips at distances across the closing line."""
        distance, height = np.array(self.palm_outline).T
        return np.interp(np.abs(across), distance, height, right=np.inf)
