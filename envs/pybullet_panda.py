"""The Franka Panda's body in PyBullet: model, motors, gripper and contacts.

Knows nothing of objects, cameras or grasps; where to move is worked out in `envs.robot_kinematics`.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections import deque
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pybullet
import pybullet_data
from scipy.spatial.transform import Rotation

from envs.robot import Robot
from envs.robot_kinematics import (
    JOINT_LOWER,
    JOINT_TORQUE,
    JOINT_UPPER,
    JOINT_VELOCITY,
    TOOL_LENGTH,
)
from envs.robot_safety import ArmGate
from utils.runs import write_atomic

MAX_OPENING = 0.08  # m between the fingertips
FINGER_SPEED = 0.05  # m/s a finger, from the Franka Hand's product manual
GRIP_COSINE = np.cos(np.radians(70))  # of the steepest contact normal that counts as a grip

# Link numbers in the model that `panda_urdf` writes; the hand is part of the last arm link.
ARM = list(range(7))
LEFT_FINGER, RIGHT_FINGER = FINGERS = [7, 8]


class Panda(Robot):
    """The robot's body in one physics client.

    position_gain, velocity_gain, gripper_gain: factors on the motors' gains. latency: physics steps
    after which a motor command arrives. All are as good as the motors can be unless changed.
    gate: what every command to the arm passes; no other way leads to its motors.
    """

    def __init__(self, client: int, dt: float, urdf: Path, grip_force: float, gate: ArmGate):
        self.client, self.dt, self.grip_force, self.gate = client, dt, grip_force, gate
        self.position_gain = self.velocity_gain = self.gripper_gain = 1.0
        self.latency = 0
        self._clock = 0  # physics steps
        self._underway: deque[tuple[int, Callable[[], object]]] = deque()  # by time of arrival
        self.body = pybullet.loadURDF(
            str(urdf), useFixedBase=True, flags=_URDF_FLAGS, physicsClientId=client
        )
        # One motor drives both fingers, as in the real hand: the left finger's, and a gear takes it
        # to the right one. Without the gear the fingers drift off centre (bullet3 #2101).
        pybullet.setJointMotorControl2(
            self.body, RIGHT_FINGER, pybullet.VELOCITY_CONTROL, force=0, physicsClientId=client
        )
        gear = pybullet.createConstraint(
            self.body, LEFT_FINGER, self.body, RIGHT_FINGER, pybullet.JOINT_GEAR,
            [1, 0, 0], [0, 0, 0], [0, 0, 0], physicsClientId=client,
        )  # fmt: skip
        pybullet.changeConstraint(gear, gearRatio=-1, erp=0.1, maxForce=50, physicsClientId=client)
        for link in [*ARM, *FINGERS]:
            pybullet.changeDynamics(
                self.body, link, linearDamping=0, angularDamping=0, physicsClientId=client
            )
        for joint, lower, upper in zip(ARM, JOINT_LOWER, JOINT_UPPER):  # the URDF's are wider
            pybullet.changeDynamics(
                self.body, joint, jointLowerLimit=lower, jointUpperLimit=upper,
                physicsClientId=client,
            )  # fmt: skip
        self.limit_speed(JOINT_VELOCITY.max())

    def limit_speed(self, speed: float) -> None:
        """No joint gets faster than `speed` rad/s, whatever moves it.

        The motors' own limit holds back the motors only: a quick shoulder throws the light wrist.
        Bullet has one such limit for all joints of a body.
        """
        pybullet.changeDynamics(self.body, -1, maxJointVelocity=speed, physicsClientId=self.client)

    def place(self, q: np.ndarray, opening: float = MAX_OPENING) -> None:
        """Put the robot at joint positions q (7,) with the gripper at `opening` metres, at rest."""
        for joint, value in zip([*ARM, *FINGERS], [*q, opening / 2, opening / 2]):
            pybullet.resetJointState(self.body, joint, value, 0.0, physicsClientId=self.client)
        self._underway.clear()
        latency, self.latency = self.latency, 0
        self._stay(q)
        self.command_gripper(opening)
        self.latency = latency

    def _send(self, command: Callable[..., object], *args, **kwargs) -> None:
        """Give a motor command, or put it on its way; commands arrive in the order given."""
        if self.latency or self._underway:
            due = self._clock + self.latency
            self._underway.append((due, partial(command, *args, **kwargs)))
        else:
            command(*args, **kwargs)

    def receive(self, count: int) -> int:
        """Carry out the commands that have arrived, and let the motors' clock run on for up to
        `count` physics steps; for how many, because none arrives in between."""
        while self._underway and self._underway[0][0] <= self._clock:
            self._underway.popleft()[1]()
        if self._underway:
            count = min(count, self._underway[0][0] - self._clock)
        self._clock += count
        return count

    def _send_arm(self, q: np.ndarray, velocity: np.ndarray) -> None:
        self._send(
            pybullet.setJointMotorControlArray, self.body, ARM, pybullet.POSITION_CONTROL,
            targetPositions=q, targetVelocities=velocity, forces=JOINT_TORQUE,
            positionGains=[self.position_gain * _POSITION_GAIN] * 7,
            velocityGains=[self.velocity_gain] * 7,
            physicsClientId=self.client,
        )  # fmt: skip

    def _drive_arm(self, q: np.ndarray, speeds: list[float]) -> None:
        self._send(self._drive, q.tolist(), speeds, self.position_gain * _DRIVE_GAIN)

    def _drive(self, q: list[float], speeds: list[float], gain: float) -> None:
        for joint, position, torque, limit in zip(ARM, q, _TORQUES, speeds):
            pybullet.setJointMotorControl2(
                self.body, joint, pybullet.POSITION_CONTROL,
                targetPosition=position, targetVelocity=0.0, force=torque,
                positionGain=gain, velocityGain=self.velocity_gain, maxVelocity=limit,
                physicsClientId=self.client,
            )  # fmt: skip

    def command_gripper(self, opening: float, force: float | None = None) -> None:
        """Drive both fingers towards `opening` metres with at most `force` newtons a finger."""
        opening = min(max(float(opening), 0.0), MAX_OPENING)
        self._send(
            pybullet.setJointMotorControl2, self.body, LEFT_FINGER, pybullet.POSITION_CONTROL,
            targetPosition=opening / 2, force=2 * (self.grip_force if force is None else force),
            positionGain=self.gripper_gain * _GRIPPER_GAIN, velocityGain=1.0,
            maxVelocity=FINGER_SPEED,
            physicsClientId=self.client,
        )  # fmt: skip

    def state(self) -> list[float]:
        """Joint positions (7, rad), joint velocities (7, rad/s) and the gripper's opening (m)."""
        states = pybullet.getJointStates(self.body, _STATE_JOINTS, physicsClientId=self.client)
        q, velocities, *_ = zip(*states)
        return [*q[:7], *velocities[:7], q[7] + q[8]]

    def joint_state(self) -> tuple[np.ndarray, np.ndarray, float]:
        """Joint positions (7,) rad, velocities (7,) rad/s and the gripper's opening in metres."""
        state = self.state()
        return np.array(state[:7]), np.array(state[7:14]), state[14]

    def closing_direction(self) -> np.ndarray:
        """(3,) unit vector in W along E's y axis, read from the physics."""
        state = pybullet.getLinkState(self.body, LEFT_FINGER, physicsClientId=self.client)
        x, y, z, w = state[5]
        return np.array([2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w)])

    def tip_pose(self) -> np.ndarray:
        """(4, 4) T_WE, read from the physics: quicker than forward kinematics."""
        state = pybullet.getLinkState(self.body, ARM[-1], physicsClientId=self.client)
        (px, py, pz), R = state[4], pybullet.getMatrixFromQuaternion(state[5])
        rows = [
            (_HALF * (x - y), _HALF * (x + y), z, p + TOOL_LENGTH * z)
            for x, y, z, p in ((*R[:3], px), (*R[3:6], py), (*R[6:], pz))
        ]
        return np.array([*rows, (0.0, 0.0, 0.0, 1.0)])

    @property
    def q(self) -> np.ndarray:
        """Joint positions (7,) in radians."""
        return self.joint_state()[0]

    @property
    def opening(self) -> float:
        """Distance between the fingertips in metres."""
        return self.joint_state()[2]

    def grip_forces(self, body: int) -> tuple[float, float]:
        """Newtons with which the left and the right finger press a body towards each other.

        A contact counts only where its normal lies within 70 degrees of the closing line and points
        inwards: a body that lies on the fingers, or is pushed down by a fist, is not gripped.
        """
        contacts = [
            pybullet.getContactPoints(
                bodyA=self.body, bodyB=body, linkIndexA=finger, physicsClientId=self.client
            )
            for finger in FINGERS
        ]
        if not (contacts[0] and contacts[1]):
            return 0.0, 0.0
        # The left finger is on the side of E's +y axis, so its contacts push the body along -y.
        closing = self.closing_direction()
        inwards = []
        for sign, touching in zip((-1.0, 1.0), contacts):
            force = 0.0
            for contact in touching:
                normal = contact[7]  # on the body, pointing at the finger
                share = -sign * (
                    normal[0] * closing[0] + normal[1] * closing[1] + normal[2] * closing[2]
                )
                if share > GRIP_COSINE:
                    force += share * contact[9]
            inwards.append(force)
        return inwards[0], inwards[1]

    def holds(self, body: int, min_force: float = 0.1) -> bool:
        """Whether both fingers grip the body with at least `min_force` newtons each."""
        return min(self.grip_forces(body)) >= min_force

    def touches(self) -> bool:
        """Whether anything touches the robot, or is so near that Bullet already looks at it."""
        return bool(pybullet.getContactPoints(bodyA=self.body, physicsClientId=self.client))

    def touches_body(self, body: int) -> bool:
        """Whether the robot and a body are in contact."""
        contacts = pybullet.getContactPoints(
            bodyA=self.body, bodyB=body, physicsClientId=self.client
        )
        return any(contact[8] <= 0.0 for contact in contacts)

    def palm_touches(self) -> bool:
        """Whether anything presses on the hand itself, not only on its fingers."""
        contacts = pybullet.getContactPoints(
            bodyA=self.body, linkIndexA=ARM[-1], physicsClientId=self.client
        )
        return any(contact[9] > 0 for contact in contacts)

    def contact_force(self) -> float:
        """Sum of the normal forces in newtons on the whole robot."""
        contacts = pybullet.getContactPoints(bodyA=self.body, physicsClientId=self.client)
        return sum(contact[9] for contact in contacts)


_URDF_FLAGS = pybullet.URDF_ENABLE_CACHED_GRAPHICS_SHAPES
_POSITION_GAIN, _DRIVE_GAIN, _GRIPPER_GAIN = 0.3, 0.1, 0.2
_TORQUES = JOINT_TORQUE.tolist()
_STATE_JOINTS = [*ARM, *FINGERS]
_HALF = math.sqrt(0.5)  # the hand is turned by -45 degrees about joint 7's axis


def panda_urdf(cache_dir: Path, fine: bool) -> Path:
    """Write the robot's model made from pybullet_data's `franka_panda/panda.urdf`; its path.

    Links behind fixed joints (flange, hand, grasp target) are welded to their parents: the same
    body, but each link costs the articulated-body solver time at every step. Unless `fine`, the
    visual meshes (about 102,000 triangles, which the software renderer transforms at every frame)
    are replaced by the collision meshes (3,400).
    """
    stock = Path(pybullet_data.getDataPath()) / "franka_panda" / "panda.urdf"
    robot = ElementTree.parse(stock).getroot()
    for mesh in robot.iter("mesh"):
        name = mesh.attrib["filename"].replace("package://", "")
        name = name if fine else name.replace("/visual/", "/collision/")
        mesh.set("filename", str(stock.parent / name))
    _weld_fixed_joints(robot)
    path = cache_dir / f"panda_{'fine' if fine else 'low_polygon'}.urdf"
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
