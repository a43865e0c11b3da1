"""What stands in a cell, as data: gravity, table, tray, walls, objects, the scene of a round, and
the views from the side that its seed draws.

Every simulator builds its cell from these constants and from a `Scene`, and implements the
`LayoutTable` on which objects come to rest. `envs.objects` makes the objects, `envs.cell_scenes`
lays scenes out. This module knows no simulator and no robot.
"""

from __future__ import annotations

import itertools
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
from typing_extensions import Self

from envs.object_files import FineVisual
from envs.object_shapes import NativeShape
from utils.config import Config
from utils.config_schema import CameraConfig, WorkspaceConfig
from utils.geometry import TRAY_CENTRE, TRAY_HALF_SIZE, TRAY_WALL, ConvexSolid
from utils.random_streams import Stream
from utils.transforms import look_at

GRAVITY = 9.81  # m/s^2

TABLE_CENTRE = np.array([0.35, 0.0])  # m in W; the robot's base stands on the table
TABLE_SIZE = np.array([1.20, 1.50])  # m along x and y; its top is z = 0
TABLE_THICKNESS = 0.04  # m
TABLE_COLOUR = (0.62, 0.60, 0.57, 1.0)
_X_MIN, _Y_MIN = (TABLE_CENTRE - TABLE_SIZE / 2).tolist()
_X_MAX, _Y_MAX = (TABLE_CENTRE + TABLE_SIZE / 2).tolist()

TRAY_HEIGHT = 0.08  # m
TRAY_COLOUR = (0.25, 0.35, 0.45, 1.0)

WALL_COLOUR = (0.8, 0.8, 0.8, 1.0)

REST_SPEED = 0.01  # m/s or (times 10) rad/s under which an object counts as resting
_REST_CHECK_SECONDS = 0.05  # between two checks of whether objects rest
# In a row, after which they certainly do: 0.2 s, in which a body that topples gets ten times as
# fast, and one that rocks has not only turned round.
CERTAIN_REST_CHECKS = 5
# The same for what was stood upright, which may begin to topple from its very edge: 1 s.
STANDING_REST_CHECKS = 20
STANDING_MOVED = 0.004  # m, by which it may move in that time where it is put down anew


def rest_check_steps(frequency: float) -> int:
    """Physics steps between two checks of whether objects rest. frequency: of them, Hz."""
    return max(1, round(_REST_CHECK_SECONDS * frequency))


class Box(NamedTuple):
    """half_size (3,) and position (3,) of the centre in W, metres."""

    half_size: np.ndarray
    position: np.ndarray

    def solid(self) -> ConvexSolid:
        """The box in W."""
        corners = np.array(list(itertools.product((-1, 1), repeat=3)))
        return ConvexSolid.from_vertices(self.position + corners * self.half_size)


def table_box() -> Box:
    """The table, its top at z = 0."""
    return Box(
        np.array([*(TABLE_SIZE / 2), TABLE_THICKNESS / 2]),
        np.array([*TABLE_CENTRE, -TABLE_THICKNESS / 2]),
    )


def tray_walls() -> Iterator[Box]:
    """The four walls of the tray beside the workspace into which picked objects go."""
    return square_walls(TRAY_CENTRE, TRAY_HALF_SIZE, TRAY_HEIGHT, TRAY_WALL)


def square_walls(
    centre: np.ndarray, half_size: float, height: float, thickness: float
) -> Iterator[Box]:
    """Four walls around a square on the table with centre (2,); `half_size` is the inner half."""
    outer = half_size + thickness / 2
    for sign in (-1, 1):
        for axis in (0, 1):
            size = np.array([half_size + thickness, half_size + thickness, height / 2])
            size[axis] = thickness / 2
            position = np.array([centre[0], centre[1], height / 2])
            position[axis] += sign * outer
            yield Box(size, position)


def distance_to_box(points: np.ndarray, box: Box) -> np.ndarray:
    """(...) metres from points (..., 3) in W to a box, 0 within it."""
    beyond = np.abs(points - box.position) - box.half_size
    return np.linalg.norm(np.maximum(beyond, 0.0), axis=-1)


def on_table(position: np.ndarray) -> bool:
    """Whether a point (3,) in W is over the table and not below its top."""
    x, y, z = position
    return bool(_X_MIN <= x <= _X_MAX and _Y_MIN <= y <= _Y_MAX and z > -TABLE_THICKNESS)


# --- Objects and scenes ----------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class ObjectModel:
    """One rigid object. Lengths are metres in the body frame: origin at the centre of mass, axes as
    in the source.

    parts: vertex arrays (V, 3) of the convex parts.
    mass: kg. inertia: (3,) principal moments, kg m2, about the body axes, or about those that the
    quaternion `principal` (4,) turns the body axes into.
    friction: lateral coefficient. rolling_friction, spinning_friction: metres.
    color: RGBA in 0..1.
    collision: a native shape, or an OBJ file with one `o` group for each convex part.
    fine_visual: the original mesh for pictures, None where the collision shape is the original.
    extents: (3,) sides of the bounding box along the body axes.
    remarks: what of its file was not taken as it stands.
    """

    name: str
    parts: tuple[np.ndarray, ...]
    mass: float
    inertia: np.ndarray
    friction: float
    color: tuple[float, float, float, float]
    collision: NativeShape | Path
    fine_visual: FineVisual | None
    extents: np.ndarray
    rolling_friction: float = 0.0
    spinning_friction: float = 0.0
    principal: tuple[float, float, float, float] | None = None
    remarks: tuple[str, ...] = ()

    def geometry(self) -> tuple[ConvexSolid, ...]:
        """The convex parts as solids, in the body frame."""
        return self._solids

    @cached_property
    def narrowest(self) -> float:
        """m, the smallest distance of a face of the convex hull from the corner farthest from
        it."""
        hull = ConvexSolid.from_vertices(np.concatenate(self.parts))
        return float(np.ptp(hull.vertices @ hull.normals.T, axis=0).min())

    @cached_property
    def _solids(self) -> tuple[ConvexSolid, ...]:
        return tuple(ConvexSolid.from_vertices(part) for part in self.parts)


@dataclass(frozen=True)
class Placement:
    """An object and its resting pose: position (3,) of the centre of mass, quaternion (4,), W."""

    model: ObjectModel
    position: np.ndarray
    quaternion: np.ndarray


@dataclass(frozen=True)
class Viewpoint:
    """Where a fixed camera stands, in W: position and target in metres, and the direction that
    points up in its image."""

    position: tuple[float, float, float]
    target: tuple[float, float, float]
    up: tuple[float, float, float]


def side_view(camera: CameraConfig, workspace: WorkspaceConfig, seed: int) -> np.ndarray:
    """(4, 4) T_WC of a camera that looks at the workspace's centre on the table from the side.

    Tilt, distance and azimuth are uniform in their ranges; the same seed gives the same pose.
    """
    rng = np.random.default_rng([seed, Stream.SIDE_VIEW])
    tilt, azimuth = (
        np.radians(rng.uniform(*bounds))
        for bounds in (camera.side_tilt_deg, camera.side_azimuth_deg)
    )
    level, up = np.sin(tilt), np.cos(tilt)
    outwards = np.array([level * np.cos(azimuth), level * np.sin(azimuth), up])
    centre = np.array([*workspace.center, 0.0])
    eye = centre + rng.uniform(*camera.side_distance) * outwards
    return look_at(eye, centre, (0.0, 0.0, 1.0))


@dataclass(frozen=True)
class Scene:
    """Objects at rest. layout: one of `envs.cell_scenes.LAYOUTS`. seed: from which the scene was
    drawn. walls: stand on the table and are part of it: of its colour and friction, and what
    touches them touches the table. fixed: whether the walls are fixtures of the cell, whose place
    planners know, or stand there like a box that somebody has brought. viewpoint: of the fixed
    camera where the configured one would not see what matters; None is the configured one. target:
    number of the one object that is to be retrieved, None where all are to be picked."""

    layout: str
    seed: int
    placements: tuple[Placement, ...]
    walls: tuple[Box, ...] = ()
    fixed: bool = False
    viewpoint: Viewpoint | None = None
    target: int | None = None

    @property
    def known_walls(self) -> tuple[Box, ...]:
        """Those whose place planners, and the arm, know."""
        return self.walls if self.fixed else ()

    @property
    def fixtures(self) -> tuple[ConvexSolid, ...]:
        """Solids in W of the `known_walls`."""
        return tuple(wall.solid() for wall in self.known_walls)


EMPTY = Scene("isolated", 0, ())


class LayoutTable(ABC):
    """A table alone, on which objects are put down and come to rest. Use it in a `with` block.

    models: the objects that may be put on it, each as often as it stands there. walls: of the
    scene, which stay (`Scene.walls`). Bodies are the table's own numbers. Entering takes everything
    else off the table. least_checks: the fewest in a row after which `settle` takes bodies to rest.
    """

    least_checks = 1

    @abstractmethod
    def __init__(
        self, config: Config, models: Sequence[ObjectModel], walls: Sequence[Box] = ()
    ): ...

    @abstractmethod
    def __enter__(self) -> Self: ...

    @abstractmethod
    def __exit__(self, *exception: object) -> None: ...

    @abstractmethod
    def put(self, model: ObjectModel, position: np.ndarray, quaternion: np.ndarray) -> int:
        """Add an object with its centre of mass at position (3,) in W; its body number."""

    @abstractmethod
    def put_walls(self, walls: Iterable[Box]) -> list[int]:
        """Add immovable walls that can be removed; their body numbers."""

    @abstractmethod
    def remove(self, body: int) -> None:
        """Take an object or a wall away."""

    @abstractmethod
    def settle(self, bodies: Sequence[int], checks: int = 1) -> bool:
        """Simulate until the bodies rest; False if they still move after scene.settle_seconds.

        checks: how many times in a row, `rest_check_steps` apart, they must be found at rest, at
        least.
        """

    @abstractmethod
    def pose(self, body: int) -> tuple[np.ndarray, np.ndarray]:
        """Position (3,) of an object's centre of mass in W and its quaternion (4,)."""

    @abstractmethod
    def is_near(self, body: int, others: Sequence[int], distance: float) -> bool:
        """Whether a body comes closer than `distance` metres to one of the others."""
