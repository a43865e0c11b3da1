"""The bare world: physics settings, table and bin. Knows nothing of robots or objects."""

from __future__ import annotations

import numpy as np
import pybullet

from utils.config import SimConfig

GRAVITY = 9.81  # m/s^2
# (rad/s)^2 or (m/s)^2: the solver stops before its last iteration where no velocity changes by more
# than the root of this. PyBullet's default.
SOLVER_RESIDUAL = 1e-7
TABLE_CENTRE = np.array([0.35, 0.0])  # m in W; the robot's base stands on the table
TABLE_SIZE = np.array([1.20, 1.50])  # m along x and y; its top is z = 0
_X_MIN, _Y_MIN = (TABLE_CENTRE - TABLE_SIZE / 2).tolist()
_X_MAX, _Y_MAX = (TABLE_CENTRE + TABLE_SIZE / 2).tolist()
_TABLE_THICKNESS = 0.04  # m
_TABLE_COLOUR = (0.62, 0.60, 0.57, 1.0)

BIN_CENTRE = np.array([0.42, -0.48])  # m in W; outside the overhead camera's view
BIN_HALF_SIZE, BIN_HEIGHT, _BIN_WALL = 0.13, 0.08, 0.005  # m
_BIN_COLOUR = (0.25, 0.35, 0.45, 1.0)

_WALL_COLOUR = (0.8, 0.8, 0.8, 1.0)


def set_up_physics(client: int, sim: SimConfig) -> None:
    """Empty the client's world and give it gravity, time step and a deterministic solver."""
    pybullet.resetSimulation(physicsClientId=client)
    pybullet.setGravity(0, 0, -GRAVITY, physicsClientId=client)
    pybullet.setPhysicsEngineParameter(
        fixedTimeStep=1.0 / sim.frequency,
        numSolverIterations=sim.solver_iterations,
        solverResidualThreshold=SOLVER_RESIDUAL,
        deterministicOverlappingPairs=1,
        physicsClientId=client,
    )


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


def add_table(client: int) -> int:
    """The table, its top at z = 0. Returns its body number."""
    half = [*(TABLE_SIZE / 2), _TABLE_THICKNESS / 2]
    table = static_box(client, half, [*TABLE_CENTRE, -_TABLE_THICKNESS / 2], _TABLE_COLOUR)
    # Bullet combines lateral friction as the product, and rolling friction as the sum of each
    # body's times the other's lateral one: with 1 and 0 here the object's own coefficients count.
    pybullet.changeDynamics(
        table, -1, lateralFriction=1.0, rollingFriction=0.0, spinningFriction=0.0,
        physicsClientId=client,
    )  # fmt: skip
    return table


def add_walls(client: int, centre, half_size: float, height: float, thickness: float, colour=None):
    """Four walls around a square on the table, `half_size` being the inner half. Body numbers."""
    outer = half_size + thickness / 2
    walls = []
    for sign in (-1, 1):
        for axis in (0, 1):
            size = np.array([half_size + thickness, half_size + thickness, height / 2])
            size[axis] = thickness / 2
            position = np.array([centre[0], centre[1], height / 2])
            position[axis] += sign * outer
            walls.append(static_box(client, size, position, colour or _WALL_COLOUR))
    return walls


def add_bin(client: int) -> list[int]:
    """The bin beside the workspace into which picked objects go. Body numbers."""
    return add_walls(client, BIN_CENTRE, BIN_HALF_SIZE, BIN_HEIGHT, _BIN_WALL, _BIN_COLOUR)


def on_table(position: np.ndarray) -> bool:
    """Whether a point (3,) in W is over the table and not below its top."""
    x, y, z = position
    return bool(_X_MIN <= x <= _X_MAX and _Y_MIN <= y <= _Y_MAX and z > -_TABLE_THICKNESS)
