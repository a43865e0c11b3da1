"""Physics parameters of a cell in PyBullet: changed from nominal, and brought back exactly.

Knows no distribution, and the cell only as far as `World` says.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import pybullet

from utils.random_ranges import changed

# The keyword of `changeDynamics` and the place in `getDynamicsInfo`'s answer of each quantity.
_PLACES = {
    "mass": 0, "lateralFriction": 1, "localInertiaDiagonal": 2, "restitution": 5,
    "rollingFriction": 6, "spinningFriction": 7, "contactDamping": 8, "contactStiffness": 9,
}  # fmt: skip
OF_OBJECTS = {
    "object_mass": "mass",
    "object_friction": "lateralFriction",
    "rolling_friction": "rollingFriction",
    "restitution": "restitution",
}
OF_FINGERS = {
    "finger_friction": "lateralFriction",
    "spinning_friction": "spinningFriction",
    "contact_stiffness": "contactStiffness",
    "contact_damping": "contactDamping",
}
OF_MOTORS = {
    "arm_position_gain": "position_gain",
    "arm_velocity_gain": "velocity_gain",
    "gripper_gain": "gripper_gain",
}

Change = tuple[str, Any]  # operation, and a value or a list of them
Link = tuple[int, int]  # PyBullet's numbers of body and link, -1 for the base


class Robot(Protocol):
    body: int
    position_gain: float
    velocity_gain: float
    gripper_gain: float
    latency: int


class World(Protocol):
    """What is randomised. client: PyBullet's. bodies: of the objects. remaining: numbers of those
    that are still in the game. arm, fingers: link numbers of the robot. dt: s, a physics step."""

    client: int
    bodies: Sequence[int]
    remaining: set[int]
    table: int
    robot: Robot
    dt: float


@dataclass(frozen=True)
class Nominal:
    """What PyBullet answered before anything was changed."""

    dynamics: Mapping[Link, tuple]
    damping: Mapping[int, float]
    gravity: tuple[float, float, float]
    motors: Mapping[str, float]
    latency: int


class RandomPhysics:
    """The physics of one built world: take it after every build, then `apply` and `restore`.

    Joint damping cannot be read back from PyBullet; nominal is what the robot's file says.
    """

    def __init__(self, world: World, arm: Sequence[int], fingers: Sequence[int]):
        self._world, self._arm, self._fingers = world, tuple(arm), tuple(fingers)
        client, robot = world.client, world.robot
        links = [(body, -1) for body in (*world.bodies, world.table)]
        links += [(robot.body, link) for link in (*arm, *fingers)]
        parameters = pybullet.getPhysicsEngineParameters(physicsClientId=client)
        self.nominal = Nominal(
            {link: pybullet.getDynamicsInfo(*link, physicsClientId=client) for link in links},
            {
                joint: pybullet.getJointInfo(robot.body, joint, physicsClientId=client)[6]
                for joint in arm
            },
            tuple(parameters[f"gravityAcceleration{axis}"] for axis in "XYZ"),
            {name: getattr(robot, name) for name in OF_MOTORS.values()},
            robot.latency,
        )

    def sizes(self) -> dict[str, int | None]:
        """How many values a parameter takes: a list of one for each object or joint, or None."""
        sizes: dict[str, int | None] = dict.fromkeys(OF_OBJECTS, len(self._world.bodies))
        sizes |= {"robot_mass": len(self._arm), "joint_damping": len(self._arm)}
        return sizes

    def apply(self, changes: Mapping[str, Change]) -> None:
        """Make everything nominal but for the changes, by parameter; their names are the keys of
        the config's section randomization.physics (those of actions are not for here)."""
        world, client = self._world, self._world.client
        for link, quantities in self._quantities(changes).items():
            pybullet.changeDynamics(*link, **quantities, physicsClientId=client)
        for i, joint in enumerate(self._arm):
            damping = _changed(changes, "joint_damping", self.nominal.damping[joint], i)
            pybullet.changeDynamics(
                world.robot.body, joint, jointDamping=damping, physicsClientId=client
            )
        x, y, z = self.nominal.gravity
        pybullet.setGravity(x, y, _changed(changes, "gravity", z), physicsClientId=client)
        for name, attribute in OF_MOTORS.items():
            value = _changed(changes, name, self.nominal.motors[attribute])
            setattr(world.robot, attribute, value)
        seconds = _changed(changes, "latency", self.nominal.latency * world.dt)
        world.robot.latency = max(0, round(seconds / world.dt))

    def restore(self) -> None:
        """Make everything nominal."""
        self.apply({})

    def _quantities(self, changes: Mapping[str, Change]) -> dict[Link, dict[str, Any]]:
        """What `changeDynamics` is told of each link: all that any parameter ever changes."""
        world, found = self._world, {}
        for i, body in enumerate(world.bodies):
            told = {
                quantity: _changed(changes, name, self._of((body, -1), quantity), i)
                for name, quantity in OF_OBJECTS.items()
            }
            found[body, -1] = self._with_inertia((body, -1), told)
            if i not in world.remaining:  # it was made immovable
                del told["mass"], told["localInertiaDiagonal"]
        table = (world.table, -1)
        # Bullet multiplies the restitutions of what touches: with 1 here the object's own counts.
        bounces = 1.0 if "restitution" in changes else self._of(table, "restitution")
        friction = _changed(changes, "table_friction", self._of(table, "lateralFriction"))
        found[table] = {"lateralFriction": friction, "restitution": bounces}
        for i, link in enumerate(self._arm):
            key = (world.robot.body, link)
            mass = _changed(changes, "robot_mass", self._of(key, "mass"), i)
            found[key] = self._with_inertia(key, {"mass": mass})
        for link in self._fingers:
            key = (world.robot.body, link)
            found[key] = {
                quantity: _changed(changes, name, self._of(key, quantity))
                for name, quantity in OF_FINGERS.items()
            }
        return found

    def _of(self, link: Link, quantity: str) -> Any:
        return self.nominal.dynamics[link][_PLACES[quantity]]

    def _with_inertia(self, link: Link, told: dict[str, Any]) -> dict[str, Any]:
        """With the inertia that goes with the mass; Bullet would make one up from the shape."""
        mass = self._of(link, "mass")
        factor = told["mass"] / mass if mass else 1.0
        told["localInertiaDiagonal"] = [factor * i for i in self._of(link, "localInertiaDiagonal")]
        return told


def _changed(
    changes: Mapping[str, Change], name: str, nominal: float, index: int | None = None
) -> float:
    if name not in changes:
        return nominal
    operation, value = changes[name]
    return changed(operation, nominal, value if index is None else value[index])
