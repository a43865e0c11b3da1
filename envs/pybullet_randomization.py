"""Randomised physics and colours in PyBullet: changed from nominal, and brought back exactly.

`utils.domain_randomization` draws what this module applies. This module knows no distribution.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from typing import Any

import numpy as np
import pybullet

from envs.pybullet_bodies import Quaternion, body_quaternion
from envs.pybullet_panda import ARM, FINGERS, PybulletPanda
from utils.config_types import Change, changed_in
from utils.transforms import pose_matrix

# The keyword of `changeDynamics` and the place in `getDynamicsInfo`'s answer of each quantity.
_PLACES = {
    "mass": 0, "lateralFriction": 1, "localInertiaDiagonal": 2, "restitution": 5,
    "rollingFriction": 6, "spinningFriction": 7, "contactDamping": 8, "contactStiffness": 9,
}  # fmt: skip
_OF_OBJECTS = {
    "object_mass": "mass",
    "object_friction": "lateralFriction",
    "rolling_friction": "rollingFriction",
    "restitution": "restitution",
}
_OF_FINGERS = {
    "finger_friction": "lateralFriction",
    "spinning_friction": "spinningFriction",
    "contact_stiffness": "contactStiffness",
    "contact_damping": "contactDamping",
}
_OF_MOTORS = {
    "arm_position_gain": "position_gain",
    "arm_velocity_gain": "velocity_gain",
    "gripper_gain": "gripper_gain",
}

Link = tuple[int, int]  # PyBullet's numbers of body and link, -1 for the base


class PybulletRandomizable:
    """A `utils.domain_randomization.Randomizable` of a cell's scene as built.

    dt: s, a physics step. table, bodies: PyBullet's numbers. remaining: the cell's own set of the
    objects that are not retired. principal: of each body, see `ObjectModel`. What is nominal is
    read here, but for joint damping, which PyBullet does not report: nominal is what the robot's
    file says.
    """

    def __init__(
        self, client: int, dt: float, robot: PybulletPanda, table: int, bodies: Sequence[int],
        remaining: Set[int], principal: Sequence[Quaternion | None],
    ):  # fmt: skip
        self._client, self._dt, self._robot = client, dt, robot
        self._table, self._bodies, self._remaining = table, list(bodies), remaining
        self.surfaces, self._principal = [table, *bodies], dict(zip(bodies, principal))
        links = [(body, -1) for body in (*bodies, table)]
        links += [(robot.body, link) for link in (*ARM, *FINGERS)]
        self._dynamics: dict[Link, tuple] = {
            link: pybullet.getDynamicsInfo(*link, physicsClientId=client) for link in links
        }
        self._damping = {
            joint: pybullet.getJointInfo(robot.body, joint, physicsClientId=client)[6]
            for joint in ARM
        }
        parameters = pybullet.getPhysicsEngineParameters(physicsClientId=client)
        self._gravity = tuple(parameters[f"gravityAcceleration{axis}"] for axis in "XYZ")
        self._motors = {name: getattr(robot, name) for name in _OF_MOTORS.values()}
        self._latency = robot.latency
        self._colours = [
            pybullet.getVisualShapeData(body, physicsClientId=client)[0][7]
            for body in self.surfaces
        ]

    def sizes(self) -> dict[str, int | None]:
        sizes: dict[str, int | None] = dict.fromkeys(_OF_OBJECTS, len(self._bodies))
        return sizes | {"robot_mass": len(ARM), "joint_damping": len(ARM)}

    def apply(self, changes: Mapping[str, Change]) -> None:
        client, robot = self._client, self._robot
        for link, quantities in self._quantities(changes).items():
            pybullet.changeDynamics(*link, **quantities, physicsClientId=client)
        for i, joint in enumerate(ARM):
            damping = changed_in(changes, "joint_damping", self._damping[joint], i)
            pybullet.changeDynamics(robot.body, joint, jointDamping=damping, physicsClientId=client)
            robot.joint_damping[i] = damping
        x, y, z = self._gravity
        pybullet.setGravity(x, y, changed_in(changes, "gravity", z), physicsClientId=client)
        for name, attribute in _OF_MOTORS.items():
            value = changed_in(changes, name, self._motors[attribute])
            setattr(robot, attribute, value)
        seconds = changed_in(changes, "latency", self._latency * self._dt)
        robot.latency = max(0, round(seconds / self._dt))

    def paint(self, colours: Sequence[Sequence[float]] | None) -> None:
        for body, colour in zip(self.surfaces, self._colours if colours is None else colours):
            pybullet.changeVisualShape(
                body, -1, rgbaColor=list(colour), physicsClientId=self._client
            )

    def pose(self, body: int) -> np.ndarray:
        position, quaternion = pybullet.getBasePositionAndOrientation(
            body, physicsClientId=self._client
        )
        return pose_matrix(position, body_quaternion(quaternion, self._principal.get(body)))

    def _quantities(self, changes: Mapping[str, Change]) -> dict[Link, dict[str, Any]]:
        """Arguments of `changeDynamics` by link: every quantity that any parameter changes."""
        found = {}
        for i, body in enumerate(self._bodies):
            values = {
                quantity: changed_in(changes, name, self._nominal((body, -1), quantity), i)
                for name, quantity in _OF_OBJECTS.items()
            }
            found[body, -1] = self._with_inertia((body, -1), values)
            if i not in self._remaining:  # a retired object is immovable
                del values["mass"], values["localInertiaDiagonal"]
        table = (self._table, -1)
        # Bullet multiplies the restitutions of two bodies in contact: with 1 for the table, the
        # object's own counts.
        bounces = 1.0 if "restitution" in changes else self._nominal(table, "restitution")
        friction = changed_in(changes, "table_friction", self._nominal(table, "lateralFriction"))
        found[table] = {"lateralFriction": friction, "restitution": bounces}
        for i, link in enumerate(ARM):
            key = (self._robot.body, link)
            mass = changed_in(changes, "robot_mass", self._nominal(key, "mass"), i)
            found[key] = self._with_inertia(key, {"mass": mass})
        for link in FINGERS:
            key = (self._robot.body, link)
            found[key] = {
                quantity: changed_in(changes, name, self._nominal(key, quantity))
                for name, quantity in _OF_FINGERS.items()
            }
        return found

    def _nominal(self, link: Link, quantity: str) -> Any:
        return self._dynamics[link][_PLACES[quantity]]

    def _with_inertia(self, link: Link, values: dict[str, Any]) -> dict[str, Any]:
        """The values with the inertia that belongs to their mass; without it Bullet would compute
        one from the shape."""
        mass = self._nominal(link, "mass")
        factor = values["mass"] / mass if mass else 1.0
        nominal = self._nominal(link, "localInertiaDiagonal")
        values["localInertiaDiagonal"] = [factor * i for i in nominal]
        return values
