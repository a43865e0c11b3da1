"""Bodies in a PyBullet client: table, tray and walls, objects, boards, and whether they rest.

`PybulletTable` is the empty table on which scenes are laid out before any cell is built;
`envs.cell_scenes` decides what is put where. The functions take the number of the physics client.
This module knows no cell, robot or camera.
"""

from __future__ import annotations

import atexit
import functools
import threading
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np
import pybullet
import trimesh
from typing_extensions import Self

from envs.board import BLACK, WHITE, Board
from envs.cell_layout import (
    GRAVITY,
    REST_SPEED,
    TABLE_COLOUR,
    TRAY_COLOUR,
    WALL_COLOUR,
    Box,
    LayoutTable,
    ObjectModel,
    rest_check_steps,
    table_box,
    tray_walls,
)
from envs.object_files import FineVisual
from envs.object_shapes import NativeShape
from utils.config import Config
from utils.config_schema import SimConfig
from utils.transforms import position_quaternion

# (rad/s)^2 or (m/s)^2: the solver stops before its last iteration where no velocity changes by more
# than the root of this. PyBullet's default.
SOLVER_RESIDUAL = 1e-7
# Of two meshes with this flag, Bullet finds all corners of the area in which their faces touch, at
# once; else it finds one point of contact a step, and what is gripped turns about the first ones.
# The flag of URDF files means the same to `createCollisionShape`, which has no name for it and
# passes it over for boxes.
WHOLE_FACES = pybullet.URDF_INITIALIZE_SAT_FEATURES
_EDGE = np.radians(20)  # between two faces; a sharper one is drawn as an edge, not as a curve
Quaternion = Sequence[float]  # x, y, z, w
_HERE = (0.0, 0.0, 0.0)


def set_up_physics(client: int, sim: SimConfig) -> None:
    """Remove all bodies, and set gravity, time step and a deterministic solver."""
    pybullet.resetSimulation(physicsClientId=client)
    pybullet.setGravity(0, 0, -GRAVITY, physicsClientId=client)
    pybullet.setPhysicsEngineParameter(
        fixedTimeStep=1.0 / sim.frequency,
        numSolverIterations=sim.solver_iterations,
        solverResidualThreshold=SOLVER_RESIDUAL,
        deterministicOverlappingPairs=1,
        physicsClientId=client,
    )


# --- Table, tray and walls -------------------------------------------------------------------


def static_box(client: int, half_size, position, colour) -> int:
    """An immovable box: half_size and position (3,) in metres. Returns PyBullet's body number.

    In maximal coordinates: a plain rigid body collides just the same and is spared what every
    articulated body, even an immovable one, costs at every step.
    """
    half_size = list(half_size)
    return pybullet.createMultiBody(
        0,
        pybullet.createCollisionShape(
            pybullet.GEOM_BOX, halfExtents=half_size, physicsClientId=client
        ),
        pybullet.createVisualShape(
            pybullet.GEOM_BOX, halfExtents=half_size, rgbaColor=colour, physicsClientId=client
        ),
        list(position),
        useMaximalCoordinates=True,
        physicsClientId=client,
    )


def _static_boxes(client: int, boxes: Sequence[Box], colour) -> int:
    """Several boxes as one immovable body, which stands where the first one is."""
    kinds, half_sizes = [pybullet.GEOM_BOX] * len(boxes), [box.half_size.tolist() for box in boxes]
    places = [(box.position - boxes[0].position).tolist() for box in boxes]
    return pybullet.createMultiBody(
        0,
        pybullet.createCollisionShapeArray(
            kinds, halfExtents=half_sizes, collisionFramePositions=places, physicsClientId=client
        ),
        pybullet.createVisualShapeArray(
            kinds, halfExtents=half_sizes, visualFramePositions=places,
            rgbaColors=[colour] * len(boxes), physicsClientId=client,
        ),
        boxes[0].position.tolist(),
        useMaximalCoordinates=True,
        physicsClientId=client,
    )  # fmt: skip


def add_table(client: int, walls: Sequence[Box] = ()) -> int:
    """The table, its top at z = 0, with walls that are part of it. Returns its body number."""
    if walls:
        table = _static_boxes(client, [table_box(), *walls], TABLE_COLOUR)
    else:
        table = static_box(client, *table_box(), TABLE_COLOUR)
    # Bullet combines lateral friction as the product, and rolling friction as the sum of each
    # body's times the other's lateral one: with 1 and 0 here the object's own coefficients count.
    pybullet.changeDynamics(
        table, -1, lateralFriction=1.0, rollingFriction=0.0, spinningFriction=0.0,
        physicsClientId=client,
    )  # fmt: skip
    return table


def add_walls(client: int, walls: Iterable[Box], colour=WALL_COLOUR) -> list[int]:
    """Immovable walls; their body numbers."""
    return [static_box(client, *wall, colour) for wall in walls]


def add_tray(client: int) -> list[int]:
    """The tray beside the workspace into which picked objects go. Body numbers of its walls."""
    return add_walls(client, tray_walls(), TRAY_COLOUR)


# --- Objects --------------------------------------------------------------------------------


def spawn(client: int, model: ObjectModel, position, quaternion, fine: bool = False) -> int:
    """Put an object into a physics client; returns its body number.

    position (3,) of the centre of mass in W; quaternion (x, y, z, w). With `fine` the camera sees
    the original mesh, otherwise exactly what the physics touches.
    """
    # The shapes live until `resetSimulation`, even if the body is removed (bullet3 #2086).
    body = pybullet.createMultiBody(
        baseMass=model.mass,
        baseCollisionShapeIndex=_collision_shape(client, model.collision),
        baseVisualShapeIndex=_visual_shape(
            client, model.collision, model.color, model.fine_visual if fine else None
        ),
        basePosition=np.asarray(position, dtype=float).tolist(),
        baseOrientation=np.asarray(quaternion, dtype=float).tolist(),
        baseInertialFrameOrientation=model.principal or (0.0, 0.0, 0.0, 1.0),
        physicsClientId=client,
    )
    pybullet.changeDynamics(
        body,
        -1,
        localInertiaDiagonal=model.inertia.tolist(),
        lateralFriction=model.friction,
        rollingFriction=model.rolling_friction,
        spinningFriction=model.spinning_friction,
        restitution=0.0,
        linearDamping=0.04,
        angularDamping=0.04,
        physicsClientId=client,
    )
    if isinstance(model.collision, Path):
        # Bullet grows hulls by 1 mm: objects would hover above what the camera sees.
        pybullet.changeDynamics(body, -1, collisionMargin=0.0, physicsClientId=client)
    return body


def body_quaternion(quaternion: Quaternion, principal: Quaternion | None) -> Quaternion:
    """The quaternion in W of a body's own axes. quaternion: that which Bullet states of it, of the
    principal axes (`ObjectModel.principal`)."""
    if principal is None:
        return quaternion
    x, y, z, w = principal
    return pybullet.multiplyTransforms(_HERE, quaternion, _HERE, (-x, -y, -z, w))[1]


def bullet_quaternion(quaternion: Quaternion, principal: Quaternion | None) -> Quaternion:
    """The inverse of `body_quaternion`."""
    if principal is None:
        return quaternion
    return pybullet.multiplyTransforms(_HERE, quaternion, _HERE, principal)[1]


def _collision_shape(client: int, shape: NativeShape | Path) -> int:
    """Number of a new collision shape; `shape` is native or an OBJ file of convex parts."""
    if isinstance(shape, NativeShape):
        kind, size = _native_arguments(shape)
        return pybullet.createCollisionShape(kind, physicsClientId=client, **size)
    return pybullet.createCollisionShape(
        pybullet.GEOM_MESH, fileName=str(shape), flags=WHOLE_FACES, physicsClientId=client
    )


def _visual_shape(
    client: int,
    shape: NativeShape | Path,
    color: tuple[float, float, float, float],
    fine: FineVisual | None = None,
) -> int:
    """Number of a new visual shape: that of the collision shape, or `fine` in its place.

    A native shape is drawn as it is, whatever `fine` is.
    """
    if isinstance(shape, NativeShape):
        vertices, triangles, normals = _drawn(shape)
        return pybullet.createVisualShape(
            pybullet.GEOM_MESH,
            vertices=vertices,
            indices=triangles,
            normals=normals,
            rgbaColor=color,
            physicsClientId=client,
        )
    if fine is None:
        return pybullet.createVisualShape(
            pybullet.GEOM_MESH, fileName=str(shape), rgbaColor=color, physicsClientId=client
        )
    return pybullet.createVisualShape(
        pybullet.GEOM_MESH,
        fileName=str(fine.path),
        meshScale=fine.scale,
        visualFramePosition=fine.position,
        visualFrameOrientation=fine.quaternion,
        # The colour multiplies a texture: white leaves it as it is.
        rgbaColor=(1, 1, 1, 1) if _has_texture(fine.path) else color,
        physicsClientId=client,
    )


def _native_arguments(shape: NativeShape) -> tuple[int, dict]:
    if shape.kind == "box":
        return pybullet.GEOM_BOX, {"halfExtents": [side / 2 for side in shape.size]}
    if shape.kind == "sphere":
        return pybullet.GEOM_SPHERE, {"radius": shape.size[0]}
    kinds = {"cylinder": pybullet.GEOM_CYLINDER, "capsule": pybullet.GEOM_CAPSULE}
    return kinds[shape.kind], {"radius": shape.size[0], "height": shape.size[1]}


@functools.lru_cache(maxsize=256)
def _drawn(shape: NativeShape) -> tuple[list, list, list]:
    """Vertices (V, 3), triangles (3 T,) and normals (V, 3) of what the camera sees of a shape.

    PyBullet's own drawings are not what it collides: the caps of its capsule are cones, up to 4 mm
    inside the true ones, its spheres are 1 mm too small, its cylinders 1 mm too thick.
    Boxes are the same to the last bit.
    """
    mesh = trimesh.graph.smooth_shade(shape.mesh("drawn"), angle=_EDGE)
    return mesh.vertices.tolist(), mesh.faces.ravel().tolist(), mesh.vertex_normals.tolist()


def _has_texture(path: Path) -> bool:
    material = path.with_suffix(".mtl")
    return material.is_file() and "map_Kd" in material.read_text(errors="replace")


# --- Boards ---------------------------------------------------------------------------------


def add_board(client: int, board: Board, T_WO: np.ndarray) -> int:
    """Put a board that stays at T_WO (4, 4) into a client; its body number."""
    half, below = board.white()
    vertices, triangles = board.black()
    position, quaternion = position_quaternion(T_WO)
    white = pybullet.createVisualShape(
        pybullet.GEOM_BOX, halfExtents=half, visualFramePosition=below, rgbaColor=WHITE,
        specularColor=[0, 0, 0], physicsClientId=client,
    )  # fmt: skip
    # Geometry and not a texture: its edges are where they are said to be to the last digit.
    black = pybullet.createVisualShape(
        pybullet.GEOM_MESH, vertices=vertices, indices=triangles,
        normals=[[0, 0, 1]] * len(vertices), rgbaColor=BLACK, specularColor=[0, 0, 0],
        physicsClientId=client,
    )  # fmt: skip
    solid = pybullet.createCollisionShape(
        pybullet.GEOM_BOX, halfExtents=half, collisionFramePosition=below,
        physicsClientId=client,
    )  # fmt: skip
    return pybullet.createMultiBody(
        0.0, solid, white, position, quaternion,
        linkMasses=[0.0], linkCollisionShapeIndices=[-1], linkVisualShapeIndices=[black],
        linkPositions=[[0, 0, 0]], linkOrientations=[[0, 0, 0, 1]],
        linkInertialFramePositions=[[0, 0, 0]], linkInertialFrameOrientations=[[0, 0, 0, 1]],
        linkParentIndices=[0], linkJointTypes=[pybullet.JOINT_FIXED],
        linkJointAxis=[[0, 0, 1]], physicsClientId=client,
    )  # fmt: skip


# --- Rest -----------------------------------------------------------------------------------


def settle(client: int, bodies: Sequence[int], config: Config, checks: int = 1) -> bool:
    """Step until the bodies rest; False if they still move after scene.settle_seconds.

    checks: how many times in a row, `rest_check_steps` apart, they must be found at rest. A single
    check cannot tell a body that rests from one that begins to topple or turns round at the top of
    a bounce.
    """
    found, steps = 0, rest_check_steps(config.sim.frequency)
    for step in range(int(config.scene.settle_seconds * config.sim.frequency)):
        pybullet.stepSimulation(physicsClientId=client)
        if step % steps == steps - 1:
            found = found + 1 if all(_resting(client, body) for body in bodies) else 0
            if found == checks:
                return True
    return False


def _resting(client: int, body: int) -> bool:
    linear, angular = pybullet.getBaseVelocity(body, physicsClientId=client)
    return max(map(abs, linear)) < REST_SPEED and max(map(abs, angular)) < 10 * REST_SPEED


# --- The table on which scenes are laid out --------------------------------------------------


class PybulletTable(LayoutTable):
    """A `LayoutTable` in PyBullet.

    All tables of a process share one physics client, because connecting takes 25 ms and laying out
    an isolated scene 5 ms; it is connected at first use and disconnected when the process ends. So
    only one table can be in use at a time: entering a second one inside the first raises
    RuntimeError, and another thread waits for its turn.
    """

    _client: ClassVar[int | None] = None
    _turn: ClassVar[threading.RLock] = threading.RLock()
    _in_use: ClassVar[bool] = False

    def __init__(self, config: Config, models: Sequence[ObjectModel], walls: Sequence[Box] = ()):
        self._config, self._walls = config, walls
        self._principal: dict[int, Quaternion | None] = {}  # of each body, see `ObjectModel`

    def __enter__(self) -> Self:
        PybulletTable._turn.acquire()
        if PybulletTable._in_use:
            PybulletTable._turn.release()
            raise RuntimeError("a PybulletTable is in use already; leave its with block first")
        PybulletTable._in_use = True
        try:
            if PybulletTable._client is None:
                PybulletTable._client = pybullet.connect(pybullet.DIRECT)
                atexit.register(PybulletTable._disconnect)
            set_up_physics(self._client, self._config.sim)
            add_table(self._client, self._walls)
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *exception: object) -> None:
        PybulletTable._in_use = False
        PybulletTable._turn.release()

    @staticmethod
    def _disconnect() -> None:
        pybullet.disconnect(physicsClientId=PybulletTable._client)
        PybulletTable._client = None

    def put(self, model: ObjectModel, position: np.ndarray, quaternion: np.ndarray) -> int:
        body = spawn(self._client, model, position, quaternion)
        self._principal[body] = model.principal
        return body

    def put_walls(self, walls: Iterable[Box]) -> list[int]:
        return add_walls(self._client, walls)

    def remove(self, body: int) -> None:
        pybullet.removeBody(body, physicsClientId=self._client)

    def settle(self, bodies: Sequence[int], checks: int = 1) -> bool:
        return settle(self._client, bodies, self._config, checks)

    def pose(self, body: int) -> tuple[np.ndarray, np.ndarray]:
        position, quaternion = pybullet.getBasePositionAndOrientation(
            body, physicsClientId=self._client
        )
        return np.array(position), np.array(body_quaternion(quaternion, self._principal[body]))

    def is_near(self, body: int, others: Sequence[int], distance: float) -> bool:
        return any(
            pybullet.getClosestPoints(body, other, distance, physicsClientId=self._client)
            for other in others
        )
