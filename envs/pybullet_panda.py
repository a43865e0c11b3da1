"""The Panda in PyBullet, and its hand without the arm: model, motors, gripper and contacts.

This module knows nothing of objects, cameras or grasps; `envs.robot_kinematics` works out where to
move.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pybullet

from envs.cell_layout import GRAVITY
from envs.floating_hand import YIELDING_FORCE, FloatingHand
from envs.panda_model import CARRIAGE_FORCE, FINGER_DRIVE_INERTIA
from envs.pybullet_bodies import WHOLE_FACES
from envs.robot import DRIVE_GAIN, FINGER_SPEED, LEFT, Contact, Hand, Robot
from envs.robot_kinematics import JOINT_TORQUE, JOINT_VELOCITY, TOOL_LENGTH
from envs.robot_safety import ArmGate
from utils.geometry import GripperGeometry
from utils.transforms import position_quaternion

# Link numbers in the URDF of `envs.panda_urdf`; the hand is part of the last arm link.
ARM = list(range(7))
FINGERS = [7, 8]
CARRIAGE = list(range(3))  # of the hand without the arm, which is part of the last of these

_URDF_FLAGS = (
    pybullet.URDF_ENABLE_CACHED_GRAPHICS_SHAPES | pybullet.URDF_USE_INERTIA_FROM_FILE | WHOLE_FACES
)
_POSITION_GAIN, _GRIPPER_GAIN = 0.3, 0.2
_TORQUES = JOINT_TORQUE.tolist()
_STATE_JOINTS = [*ARM, *FINGERS]
_ANY_SPEED = 100.0  # rad/s, at which Bullet cuts every joint off unless told otherwise
CARRYING_EFFORT = 3  # times sim.solver_iterations, while the hand carries something
_RENEWED_COSINE = math.cos(math.radians(10) / 2)  # of half the angle by which the hand has turned
_MOVING, _EVERYTHING = 1, -1  # Bullet's group of what moves, and the groups that this meets
_HALF = math.sqrt(0.5)  # the hand is turned by -45 degrees about joint 7's axis


class PybulletHand(Hand):
    """What hand and fingers do in a physics client, whatever carries them.

    carriers: numbers of the joints that carry the hand, which is part of the last one's link; the
    fingers come after them. gripper_gain: factor on the fingers' motor gains, 1 unless changed.
    """

    _carriers: list[int]

    def _load(self, client: int, urdf: Path) -> None:
        """Load the body and make its joints' nature that of the real hand."""
        self.client = client
        self.gripper_gain = 1.0
        self._contacts_from: tuple[float, ...] | None = None  # the hand's quaternion of then
        self.palm = self._carriers[-1]
        self.fingers = [self.palm + 1, self.palm + 2]
        self.joints = [*self._carriers, *self.fingers]
        self.body = pybullet.loadURDF(
            str(urdf), useFixedBase=True, flags=_URDF_FLAGS, physicsClientId=client
        )
        self.links = [self.body]
        # In the real hand one motor drives both fingers. Here each has its share, and a gear keeps
        # them together: without it they drift off centre (bullet3 #2101).
        gear = pybullet.createConstraint(
            self.body, self.fingers[0], self.body, self.fingers[1], pybullet.JOINT_GEAR,
            [1, 0, 0], [0, 0, 0], [0, 0, 0], physicsClientId=self.client,
        )  # fmt: skip
        pybullet.changeConstraint(
            gear, gearRatio=-1, erp=0.1, maxForce=50, physicsClientId=self.client
        )
        for link in self.joints:
            pybullet.changeDynamics(
                self.body, link, linearDamping=0, angularDamping=0, physicsClientId=self.client
            )
        # Bullet has no inertia of a joint's own, so that the finger has it.
        for link in self.fingers:
            mass = pybullet.getDynamicsInfo(self.body, link, physicsClientId=self.client)[0]
            pybullet.changeDynamics(
                self.body, link, mass=mass + FINGER_DRIVE_INERTIA, physicsClientId=self.client
            )

    def mirror(self, other: PybulletHand) -> None:
        """Be where another cell's robot is now."""
        states = pybullet.getJointStates(other.body, self.joints, physicsClientId=other.client)
        for joint, state in zip(self.joints, states):
            pybullet.resetJointState(self.body, joint, state[0], physicsClientId=self.client)

    def closing_direction(self) -> np.ndarray:
        """(3,) unit vector in W along E's y axis, read from the physics."""
        state = pybullet.getLinkState(self.body, self.fingers[LEFT], physicsClientId=self.client)
        x, y, z, w = state[5]
        return np.array([2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w)])

    def _send_gripper(self, opening: float, force: float) -> None:
        for finger in self.fingers:
            self._send(
                pybullet.setJointMotorControl2, self.body, finger, pybullet.POSITION_CONTROL,
                targetPosition=opening / 2, force=force,
                positionGain=self.gripper_gain * _GRIPPER_GAIN, velocityGain=1.0,
                maxVelocity=FINGER_SPEED,
                physicsClientId=self.client,
            )  # fmt: skip

    def finger_force(self) -> float:
        """Newtons a finger with which the motors close it."""
        states = pybullet.getJointStates(self.body, self.fingers, physicsClientId=self.client)
        return -sum(state[3] for state in states) / 2

    # --- Contacts -----------------------------------------------------------------------------

    @contextmanager
    def carrying(self) -> Iterator[None]:
        """With `CARRYING_EFFORT` times as many iterations of the solver, which else stops before
        the friction in the fingers holds all: what is held creeps."""
        iterations = pybullet.getPhysicsEngineParameters(physicsClientId=self.client)[
            "numSolverIterations"
        ]
        self._set_iterations(CARRYING_EFFORT * iterations)
        self._contacts_from = None  # what was found before was of another grip
        try:
            yield
        finally:
            self._set_iterations(iterations)

    def _set_iterations(self, count: int) -> None:
        pybullet.setPhysicsEngineParameter(numSolverIterations=count, physicsClientId=self.client)

    def renew_contacts(self) -> None:
        """Let the fingers' contacts be found again where the hand has turned by some degrees.

        Bullet keeps a contact with a friction anchor as it was found, its normal in W included: in
        a hand that turns with what it holds, the fingers soon press across their closing line, and
        the object slips out.
        """
        turned = pybullet.getLinkState(self.body, self.palm, physicsClientId=self.client)[5]
        before = self._contacts_from = self._contacts_from or turned
        if abs(sum(a * b for a, b in zip(turned, before))) < _RENEWED_COSINE:
            self._contacts_from = turned
            for finger in self.fingers:  # the same filter again: Bullet forgets what it had found
                pybullet.setCollisionFilterGroupMask(
                    self.body, finger, _MOVING, _EVERYTHING, physicsClientId=self.client
                )

    def _finger_contacts(self, finger: int, body: int) -> Iterator[Contact]:
        contacts = pybullet.getContactPoints(
            bodyA=self.body,
            bodyB=body,
            linkIndexA=self.fingers[finger],
            physicsClientId=self.client,
        )
        for contact in contacts:
            x, y, z = contact[7]  # on the body, pointing at the finger
            yield (-x, -y, -z), contact[9]

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
            bodyA=self.body, linkIndexA=self.palm, physicsClientId=self.client
        )
        return any(contact[9] > 0 for contact in contacts)

    def contact_force(self) -> float:
        """Sum of the normal forces in newtons on the whole robot."""
        contacts = pybullet.getContactPoints(bodyA=self.body, physicsClientId=self.client)
        return sum(contact[9] for contact in contacts)


class PybulletPanda(PybulletHand, Robot):
    """The robot's body in one physics client.

    urdf: the model that `envs.panda_urdf.write_panda` has written for this gripper.
    position_gain, velocity_gain: factors on the arm motors' gains, 1 unless changed.
    joint_damping: (7,) N m s/rad, as it was set in Bullet, which does not report it; 0 at first.
    """

    _carriers = ARM

    def __init__(
        self,
        client: int,
        dt: float,
        urdf: Path,
        gripper: GripperGeometry,
        grip_force: float,
        gate: ArmGate,
    ):
        super().__init__(dt, gripper, grip_force, gate)
        self.position_gain = self.velocity_gain = 1.0
        self.joint_damping = np.zeros(7)
        self._load(client, urdf)
        self._held_back: float | None = None  # rad/s; as yet what Bullet has
        self.limit_speed(JOINT_VELOCITY.max())
        # The clock, positions and velocities when the torques were asked last, and the answer.
        self._felt: tuple[int, tuple, tuple] | None = None
        self._torques = np.zeros(7)

    # --- State --------------------------------------------------------------------------------

    def state(self) -> list[float]:
        """Joint positions (7, rad), joint velocities (7, rad/s) and the gripper's opening (m)."""
        states = pybullet.getJointStates(self.body, _STATE_JOINTS, physicsClientId=self.client)
        q, velocities, *_ = zip(*states)
        return [*q[:7], *velocities[:7], q[7] + q[8]]

    def tip_pose(self) -> np.ndarray:
        """(4, 4) T_WE, read from the physics: quicker than forward kinematics."""
        state = pybullet.getLinkState(self.body, ARM[-1], physicsClientId=self.client)
        (px, py, pz), R = state[4], pybullet.getMatrixFromQuaternion(state[5])
        rows = [
            (_HALF * (x - y), _HALF * (x + y), z, p + TOOL_LENGTH * z)
            for x, y, z, p in ((*R[:3], px), (*R[3:6], py), (*R[6:], pz))
        ]
        return np.array([*rows, (0.0, 0.0, 0.0, 1.0)])

    def place(self, q: np.ndarray, opening: float | None = None) -> None:
        """Put the robot at joint positions q (7,) with the gripper at `opening` metres, at rest."""
        opening = self.max_opening if opening is None else opening
        for joint, value in zip([*ARM, *FINGERS], [*q, opening / 2, opening / 2]):
            pybullet.resetJointState(self.body, joint, value, 0.0, physicsClientId=self.client)
        self._felt = None  # the joints have jumped
        self._stay_placed(q, opening)

    # --- Motors -------------------------------------------------------------------------------

    def limit_speed(self, speed: float) -> None:
        """No joint gets faster than `speed` rad/s while `drive_arm_to` moves the arm, whatever else
        moves it; the motors that follow a trajectory are not held back.

        The motors' own limit holds back the motors only: a quick shoulder throws the light wrist.
        """
        self._fastest = speed

    def _hold_back(self, speed: float) -> None:
        """Cut all joints' speeds off at `speed` rad/s: Bullet has one such limit for a body. What
        is cut off is felt as an external force."""
        if speed != self._held_back:
            pybullet.changeDynamics(
                self.body, -1, maxJointVelocity=speed, physicsClientId=self.client
            )
            self._held_back = speed

    def _send_arm(self, q: np.ndarray, velocity: np.ndarray) -> None:
        self._send(self._follow, q, velocity)

    def _follow(self, q: np.ndarray, velocity: np.ndarray) -> None:
        self._hold_back(_ANY_SPEED)
        pybullet.setJointMotorControlArray(
            self.body, ARM, pybullet.POSITION_CONTROL,
            targetPositions=q, targetVelocities=velocity, forces=JOINT_TORQUE,
            positionGains=[self.position_gain * _POSITION_GAIN] * 7,
            velocityGains=[self.velocity_gain] * 7,
            physicsClientId=self.client,
        )  # fmt: skip

    def _drive_arm(self, q: np.ndarray, speeds: list[float]) -> None:
        self._send(self._drive, q.tolist(), speeds, self.position_gain * DRIVE_GAIN)

    def _drive(self, q: list[float], speeds: list[float], gain: float) -> None:
        self._hold_back(self._fastest)
        for joint, position, torque, limit in zip(ARM, q, _TORQUES, speeds):
            pybullet.setJointMotorControl2(
                self.body, joint, pybullet.POSITION_CONTROL,
                targetPosition=position, targetVelocity=0.0, force=torque,
                positionGain=gain, velocityGain=self.velocity_gain, maxVelocity=limit,
                physicsClientId=self.client,
            )  # fmt: skip

    # --- What the robot feels -----------------------------------------------------------------

    def external_torques(self) -> np.ndarray:
        """(7,) N m. Bullet integrates M(q) (v' - v) / dt = motors - damping v + external -
        bias(q, v), where q and v are those before the step."""
        before = self._felt
        if before is not None and before[0] == self._clock:  # asked twice in one step
            return self._torques
        states = pybullet.getJointStates(self.body, _STATE_JOINTS, physicsClientId=self.client)
        q, velocities, _, motors = zip(*states)
        self._felt, self._torques = (self._clock, q, velocities), np.zeros(7)
        if before is None or before[0] != self._clock - 1:
            return self._torques
        accelerations = (np.array(velocities) - before[2]) / self.dt
        expected = pybullet.calculateInverseDynamics(
            self.body, list(before[1]), list(before[2]), accelerations.tolist(),
            physicsClientId=self.client,
        )  # fmt: skip
        self._torques = np.array(expected[:7]) - motors[:7]
        if self.joint_damping.any():
            self._torques += self.joint_damping * before[2][:7]
        return self._torques


class PybulletFloatingHand(PybulletHand, FloatingHand):
    """The hand without the arm, on a carriage. urdf: written by `write_panda` with arm=False."""

    _carriers = CARRIAGE

    def __init__(
        self, client: int, dt: float, urdf: Path, gripper: GripperGeometry, grip_force: float
    ):
        super().__init__(dt, gripper, grip_force)
        self._load(client, urdf)
        self._yields = False
        moved = [*CARRIAGE[1:], *self.fingers]
        self._mass = sum(
            pybullet.getDynamicsInfo(self.body, link, physicsClientId=client)[0] for link in moved
        )  # kg, of all that gives way to the fingers

    @property
    def q(self) -> np.ndarray:
        return np.array(self._positions(CARRIAGE))

    def receive(self, count: int) -> int:
        part = super().receive(count)
        if not self._yields:
            return part
        # What carries the hand carries its weight as well, which would pull a sloping line down.
        # Bullet takes a torque for one step alone.
        self._clock += 1 - part
        weight = self._mass * GRAVITY * float(self._placed[2, 1])
        pybullet.setJointMotorControl2(
            self.body, CARRIAGE[1], pybullet.TORQUE_CONTROL, force=weight,
            physicsClientId=self.client,
        )  # fmt: skip
        return 1

    @property
    def opening(self) -> float:
        return sum(self._positions(self.fingers))

    def _positions(self, joints: list[int]) -> list[float]:
        states = pybullet.getJointStates(self.body, joints, physicsClientId=self.client)
        return [state[0] for state in states]

    def yield_to_fingers(self) -> None:
        self._send(self._yield)

    def _yield(self) -> None:
        self._yields = True
        pybullet.setJointMotorControl2(
            self.body, CARRIAGE[1], pybullet.VELOCITY_CONTROL,
            targetVelocity=0.0, force=YIELDING_FORCE, physicsClientId=self.client,
        )  # fmt: skip

    def overlaps(self) -> bool:
        pybullet.performCollisionDetection(physicsClientId=self.client)
        contacts = pybullet.getContactPoints(bodyA=self.body, physicsClientId=self.client)
        return any(contact[8] <= 0.0 for contact in contacts)

    def mirror(self, other: PybulletHand) -> None:
        super().mirror(other)
        place = pybullet.getBasePositionAndOrientation(other.body, physicsClientId=other.client)
        pybullet.resetBasePositionAndOrientation(self.body, *place, physicsClientId=self.client)

    def _put(self, T_WE: np.ndarray, opening: float) -> None:
        position, quaternion = position_quaternion(T_WE)
        pybullet.resetBasePositionAndOrientation(
            self.body, position, quaternion, physicsClientId=self.client
        )
        for joint, value in zip(self.joints, [0.0, 0.0, 0.0, opening / 2, opening / 2]):
            pybullet.resetJointState(self.body, joint, value, 0.0, physicsClientId=self.client)

    def _send_carriage(self, q: np.ndarray, velocity: np.ndarray) -> None:
        self._send(self._drive_carriage, q, velocity)

    def _drive_carriage(self, q: np.ndarray, velocity: np.ndarray) -> None:
        self._yields = False
        pybullet.setJointMotorControlArray(
            self.body, CARRIAGE, pybullet.POSITION_CONTROL,
            targetPositions=q, targetVelocities=velocity, forces=[CARRIAGE_FORCE] * 3,
            positionGains=[_POSITION_GAIN] * 3, velocityGains=[1.0] * 3,
            physicsClientId=self.client,
        )  # fmt: skip
