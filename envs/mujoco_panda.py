"""The Panda in MuJoCo, and its hand without the arm: links, servos, gripper and contacts.

This module knows nothing of scenes and tasks. MuJoCo is optional: pip install "mujoco>=3.12,<4".
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np

from envs.floating_hand import YIELDING_FORCE, FloatingHand
from envs.panda_model import (
    ARM_JOINTS,
    ARM_LINKS,
    CARRIAGE_BASE,
    CARRIAGE_FORCE,
    CARRIAGE_JOINTS,
    FINGER_DRIVE_INERTIA,
    FINGER_FORCE,
    FINGER_JOINTS,
    FINGERS,
    HAND,
    Link,
    floating_links,
    panda_links,
)
from envs.robot import DRIVE_GAIN, FINGER_SPEED, Contact, Hand, Robot
from envs.robot_kinematics import (
    JOINT_LOWER,
    JOINT_TORQUE,
    JOINT_UPPER,
    JOINT_VELOCITY,
    forward_kinematics,
)
from envs.robot_safety import ArmGate
from utils.errors import UserError
from utils.geometry import GripperGeometry
from utils.transforms import position_quaternion

if TYPE_CHECKING:
    import mujoco

_HAND_LINKS = (ARM_LINKS[-1], HAND)  # one link in PyBullet's cell

# Servos: N m/rad and N m s/rad, near critical damping with the reflected inertia of the motors,
# about 0.1 kg m2 (the gears' ratio squared times the rotor's), which the identified links lack.
_STIFFNESS = (4500.0, 4500.0, 3500.0, 3500.0, 2000.0, 2000.0, 2000.0)
_DAMPING_RATIO_OF_STIFFNESS = 0.1  # s
_ARMATURE = 0.1
_CARRIAGE_STIFFNESS = 20_000.0  # N/m
_FINGER_STIFFNESS, _FINGER_DAMPING = 4000.0, 100.0  # N/m, N s/m


def load_mujoco():
    """The `mujoco` module. Raises UserError where it is not installed."""
    try:
        import mujoco
    except ImportError as error:
        raise UserError(
            'MuJoCo is not installed: pip install "mujoco>=3.12,<4" (4.0.0 is another package)'
        ) from error
    if mujoco.get_mju_user_warning() is None:
        mujoco.set_mju_user_warning(_tell)
    return mujoco


def _tell(warning: str) -> None:
    """In place of MuJoCo's own way, which also writes MUJOCO_LOG.TXT into the current folder."""
    print(f"MuJoCo: {warning}", file=sys.stderr)


def panda_spec(gripper: GripperGeometry) -> mujoco.MjSpec:
    """A model of the Panda alone, with its base at W's origin; a scene can be added to it.

    Actuators: seven position servos in radians, and the distance between the fingertips in metres.
    One motor drives both fingers, as in the real hand. Raises UserError without MuJoCo.
    """
    mujoco, spec = _linked(panda_links(gripper))
    for i, name in enumerate(ARM_JOINTS):
        joint = spec.joint(name)
        joint.armature = _ARMATURE
        _joint_servo(mujoco, spec, name, _STIFFNESS[i], JOINT_TORQUE[i])
    _add_gripper(mujoco, spec, gripper)
    # As in PyBullet, the arm does not meet itself: its hulls are larger than its links.
    for one, other in combinations([link.name for link in panda_links(gripper)], 2):
        exclude = spec.add_exclude()
        exclude.bodyname1, exclude.bodyname2 = one, other
    return spec


def floating_spec(gripper: GripperGeometry) -> mujoco.MjSpec:
    """A model of the hand without the arm, on its carriage.

    Actuators: three position servos in metres, and the distance between the fingertips. Raises
    UserError without MuJoCo.
    """
    mujoco, spec = _linked(floating_links(gripper))
    spec.body(CARRIAGE_BASE).mocap = True  # what can be put elsewhere at any time
    for name in CARRIAGE_JOINTS:
        _joint_servo(mujoco, spec, name, _CARRIAGE_STIFFNESS, CARRIAGE_FORCE)
    _add_gripper(mujoco, spec, gripper)
    return spec


def _linked(links: tuple[Link, ...]) -> tuple[Any, mujoco.MjSpec]:
    """The `mujoco` module and a model of links alone."""
    mujoco = load_mujoco()
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    for link in links:
        _add_link(mujoco, spec, link)
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    return mujoco, spec


def _add_gripper(mujoco, spec: mujoco.MjSpec, gripper: GripperGeometry) -> None:
    for name in FINGER_JOINTS:
        spec.joint(name).armature = FINGER_DRIVE_INERTIA
    equal = spec.add_equality()
    equal.type, equal.objtype = mujoco.mjtEq.mjEQ_JOINT, mujoco.mjtObj.mjOBJ_JOINT
    equal.name, (equal.name1, equal.name2) = "fingers", FINGER_JOINTS
    equal.data[:5] = [0, 1, 0, 0, 0]  # both fingers are at the same position
    opening = spec.add_tendon(name="opening")
    for name in FINGER_JOINTS:
        opening.wrap_joint(name, 1.0)
    # The tendon's force acts on both fingers alike, so this one is a finger's.
    _servo(mujoco, spec, "opening", mujoco.mjtTrn.mjTRN_TENDON, (
        _FINGER_STIFFNESS, -_FINGER_STIFFNESS, -_FINGER_DAMPING,
    ), FINGER_FORCE)  # fmt: skip
    fingers = spec.actuator("opening")
    fingers.ctrlrange = [-_beyond(FINGER_FORCE), gripper.max_opening]
    fingers.ctrllimited = True


def _add_link(mujoco, spec: mujoco.MjSpec, link: Link) -> None:
    parent = spec.worldbody if link.parent is None else spec.body(link.parent)
    position, quaternion = position_quaternion(link.T)
    body = parent.add_body(name=link.name, pos=list(position), quat=np.roll(quaternion, 1).tolist())
    body.mass, body.ipos, body.fullinertia = link.inertial
    body.explicitinertial = True
    body.gravcomp = 1.0  # Franka's controller carries the arm's own weight
    for shape, hull in zip(link.shapes, link.hulls()):
        mesh = spec.add_mesh(name=f"{link.name}_{shape.part}", uservert=hull.ravel())
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh.name, rgba=[1, 1, 1, 1])
    if link.joint is not None:
        kinds = {"revolute": mujoco.mjtJoint.mjJNT_HINGE, "prismatic": mujoco.mjtJoint.mjJNT_SLIDE}
        joint = body.add_joint(
            name=link.joint.name, type=kinds[link.joint.kind], axis=list(link.joint.axis)
        )
        joint.range, joint.limited = [link.joint.lower, link.joint.upper], True


def _beyond(force: float) -> float:
    """m by which the fingers' goal lies beyond where they are when they press with `force` N."""
    return force / _FINGER_STIFFNESS


def _joint_servo(mujoco, spec, name: str, stiffness: float, force: float) -> None:
    gains = stiffness, -stiffness, -_DAMPING_RATIO_OF_STIFFNESS * stiffness
    _servo(mujoco, spec, name, mujoco.mjtTrn.mjTRN_JOINT, gains, force)


def _servo(mujoco, spec, target: str, kind, gains, force: float) -> None:
    """force = gain x control + position gain x position + velocity gain x velocity, limited.

    The control has no limits of its own: what makes up for the damping takes it beyond the range of
    a joint that is within.
    """
    actuator = spec.add_actuator(name=target, target=target, trntype=kind)
    actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
    actuator.gainprm[0] = gains[0]
    actuator.biasprm[:3] = [0.0, *gains[1:]]
    actuator.forcerange, actuator.forcelimited = [-force, force], True


class MujocoHand(Hand):
    """What hand and fingers do in a MuJoCo model, whatever carries them; `model` and `data` are
    MuJoCo's.

    carriers: names of the joints that carry the hand. The fingers have the last actuator.
    """

    _carriers: tuple[str, ...]

    def _compile(self, spec: mujoco.MjSpec, substeps: int) -> None:
        self._mujoco = load_mujoco()
        spec.option.timestep = self.dt / substeps
        self.substeps = substeps
        self.model = spec.compile()
        self.data = self._mujoco.MjData(self.model)
        joints = [self.model.joint(name) for name in (*self._carriers, *FINGER_JOINTS)]
        self._places = [joint.qposadr[0] for joint in joints]
        self._speeds = [joint.dofadr[0] for joint in joints]
        bodies = [self.model.body(i) for i in range(self.model.nbody)]
        self._links = {body.name: body.id for body in bodies if body.name.startswith("panda_")}
        self.links = list(self._links.values())
        self._is_robot = np.isin(self.model.geom_bodyid, self.links)

    @property
    def q(self) -> np.ndarray:
        """(N,) positions of the joints that carry the hand, rad or m."""
        return self.data.qpos[self._places[:-2]].copy()

    @property
    def opening(self) -> float:
        """Distance between the fingertips, m."""
        return float(self.data.qpos[self._places[-2:]].sum())

    def pose(self, body: str) -> np.ndarray:
        """(4, 4) pose in W of a link's frame, by its name in the URDF."""
        T, found = np.eye(4), self.data.body(body)
        T[:3, :3], T[:3, 3] = found.xmat.reshape(3, 3), found.xpos
        return T

    def _send_gripper(self, opening: float, force: float) -> None:
        self._send(self._drive_fingers, opening, force)

    def _drive_fingers(self, opening: float, force: float) -> None:
        self.model.actuator_forcerange[-1] = [-force, force]
        # A closing hand aims beyond closed, so that it also grips a thin object with all its force.
        self._opening = opening or -_beyond(force)

    def _move_fingers(self) -> None:
        """The fingers' target of one period."""
        control, reach = self.data.ctrl, 2 * FINGER_SPEED * self.dt
        # Fingers that an object has stopped open from where they are.
        control[-1] = max(control[-1], min(self._opening, self.opening))
        control[-1] += min(max(self._opening - control[-1], -reach), reach)

    def finger_force(self) -> float:
        """Newtons a finger with which the motor closes it."""
        return -float(self.data.actuator_force[-1])

    # --- Contacts -----------------------------------------------------------------------------

    def renew_contacts(self) -> None:
        """Nothing is left to do: MuJoCo finds all contacts anew in each of its steps."""

    def _finger_contacts(self, finger: int, body: int) -> Iterator[Contact]:
        for number, normal in self._contacts_between(self._links[FINGERS[finger]], body):
            yield tuple(normal.tolist()), self._normal_force(number)

    def touches(self) -> bool:
        """Whether anything touches the robot."""
        return len(self._robot_contacts()) > 0

    def touches_body(self, body: int) -> bool:
        """Whether the robot and a body, by MuJoCo's number, are in contact."""
        touching = self.data.contact.geom[self._robot_contacts()]
        return bool((self.model.geom_bodyid[touching] == body).any())

    def palm_touches(self) -> bool:
        """Whether anything presses on the hand itself, not only on its fingers."""
        hand = [number for name, number in self._links.items() if name in _HAND_LINKS]
        numbers = self._robot_contacts()
        bodies = self.model.geom_bodyid[self.data.contact.geom[numbers]]
        palm = numbers[np.isin(bodies, hand).any(axis=1)]
        return any(self._normal_force(number) > 0 for number in palm)

    def contact_force(self) -> float:
        """Sum of the normal forces in newtons on the robot by what is not the robot."""
        return sum(map(self._normal_force, self._robot_contacts()))

    def meet(self, one: int, other: int) -> bool:
        """Whether two bodies, by MuJoCo's numbers, touch."""
        return any(True for _ in self._contacts_between(one, other))

    def _robot_contacts(self) -> np.ndarray:
        """Numbers of the contacts between the robot and anything else."""
        ours = self._is_robot[self.data.contact.geom]
        return np.flatnonzero(ours[:, 0] != ours[:, 1])

    def _contacts_between(self, one: int, other: int):
        """Number of each contact of two bodies, and its normal (3,) in W, into `other`."""
        contact = self.data.contact
        for number, bodies in enumerate(self.model.geom_bodyid[contact.geom].tolist()):
            if bodies == [one, other]:
                yield number, contact.frame[number, :3]
            elif bodies == [other, one]:
                yield number, -contact.frame[number, :3]

    def _normal_force(self, number: int) -> float:
        force = np.zeros(6)
        self._mujoco.mj_contactForce(self.model, self.data, number, force)
        return float(force[0])


class MujocoPanda(MujocoHand, Robot):
    """The Panda in a MuJoCo model; `model` and `data` are MuJoCo's.

    spec: a model made from `panda_spec`. dt: s, a control period, in which MuJoCo takes `substeps`
    steps of its own. damping_time: s, the arm's servos' damping over their stiffness. Raises
    UserError without MuJoCo.
    """

    _carriers = ARM_JOINTS

    def __init__(
        self,
        spec: mujoco.MjSpec,
        dt: float,
        substeps: int,
        gripper: GripperGeometry,
        grip_force: float,
        gate: ArmGate,
    ):
        super().__init__(dt, gripper, grip_force, gate)
        self.damping_time = _DAMPING_RATIO_OF_STIFFNESS
        self._compile(spec, substeps)
        self.limit_speed(JOINT_VELOCITY.max())
        self.place(np.zeros(7))

    # --- State --------------------------------------------------------------------------------

    def state(self) -> list[float]:
        """Joint positions (7, rad), joint velocities (7, rad/s) and the gripper's opening (m)."""
        velocity = self.data.qvel[self._speeds[:7]]
        return [*self.q.tolist(), *velocity.tolist(), self.opening]

    def tip_pose(self) -> np.ndarray:
        """(4, 4) T_WE."""
        return forward_kinematics(self.q)

    # --- Motion -------------------------------------------------------------------------------

    def place(self, q: np.ndarray, opening: float | None = None) -> None:
        """Put the robot at joint positions q (7,) with the gripper at `opening` metres, at rest."""
        opening = self.max_opening if opening is None else opening
        self.data.qpos[self._places] = [*q, opening / 2, opening / 2]
        self.data.qvel[self._speeds] = 0.0
        self._stay_placed(q, opening)
        self.data.ctrl[:7], self.data.ctrl[7] = q, opening
        self._mujoco.mj_forward(self.model, self.data)

    def limit_speed(self, speed: float) -> None:
        """No joint gets faster than `speed` rad/s while `drive_arm_to` moves the arm, whatever else
        moves it; the servos that follow a trajectory are not held back."""
        self._fastest = np.minimum(JOINT_VELOCITY, speed)

    def _send_arm(self, q: np.ndarray, velocity: np.ndarray) -> None:
        self._send(self._follow, np.array(q, dtype=float), np.array(velocity, dtype=float))

    def _follow(self, q: np.ndarray, velocity: np.ndarray) -> None:
        self._goal, self._speed = q, None
        # The servo's damping brakes the desired motion, too: stiffness x this takes it back.
        self._reference = q + self.damping_time * velocity

    def _drive_arm(self, q: np.ndarray, speeds: list[float]) -> None:
        self._send(self._drive, np.array(q, dtype=float), speeds)

    def _drive(self, q: np.ndarray, speeds: list[float]) -> None:
        self._goal = q
        self._reference, self._speed = self.q, np.minimum(self._fastest, speeds)

    def step(self, count: int = 1) -> None:
        """Advance by so many control periods."""
        for _ in range(count):
            self.receive(1)
            self._move_fingers()
            self.data.ctrl[:7] = self._arm_target()
            self._mujoco.mj_step(self.model, self.data, self.substeps)
            if self._speed is not None:
                self._hold_back()

    def _hold_back(self) -> None:
        """Take away the speed beyond `limit_speed`, as PyBullet does: a quick shoulder or a
        collision throws the light wrist, which no motor can hold."""
        velocity = self.data.qvel[self._speeds[:7]]
        if (abs(velocity) > self._fastest).any():
            held = np.minimum(np.maximum(velocity, -self._fastest), self._fastest)
            self.data.qvel[self._speeds[:7]] = held

    def _arm_target(self) -> np.ndarray:
        if self._speed is None:
            return self._reference
        way = self._goal - self._reference
        step = np.clip(DRIVE_GAIN * way, -self._speed * self.dt, self._speed * self.dt)
        self._reference = self._reference + step
        target = self._reference + self.damping_time * step / self.dt
        # The servo asks for the velocity (target - q) / damping_time. An arm that is behind, while
        # it accelerates or after a collision, must not catch up faster than the limit; nor may it
        # overshoot the end of a joint's range, before which the reference does not brake.
        q, reach = self.q, self.damping_time * self._speed
        lower, upper = np.maximum(q - reach, JOINT_LOWER), np.minimum(q + reach, JOINT_UPPER)
        return np.minimum(np.maximum(target, lower), upper)

    # --- What the robot feels -----------------------------------------------------------------

    def external_torques(self) -> np.ndarray:
        """(7,) N m, of MuJoCo's last step: M a + bias - passive - motors."""
        data, inertial = self.data, np.zeros(self.model.nv)
        self._mujoco.mj_mulM(self.model, data, inertial, data.qacc)
        torques = inertial + data.qfrc_bias - data.qfrc_passive - data.qfrc_actuator
        return torques[self._speeds[:7]]


class MujocoFloatingHand(MujocoHand, FloatingHand):
    """The hand without the arm in a model made from `floating_spec`; arguments as of
    `MujocoPanda`."""

    _carriers = CARRIAGE_JOINTS

    def __init__(
        self,
        spec: mujoco.MjSpec,
        dt: float,
        substeps: int,
        gripper: GripperGeometry,
        grip_force: float,
    ):
        super().__init__(dt, gripper, grip_force)
        self._compile(spec, substeps)
        self._yields, self._reference = False, np.zeros(3)

    def yield_to_fingers(self) -> None:
        self._send(self._yield)

    def _yield(self) -> None:
        self._limit_force(YIELDING_FORCE)
        self._yields = True

    def _limit_force(self, force: float) -> None:
        self.model.actuator_forcerange[1] = [-force, force]

    def overlaps(self) -> bool:
        self._mujoco.mj_forward(self.model, self.data)
        return bool((self.data.contact.dist[self._robot_contacts()] <= 0).any())

    def step(self, count: int = 1) -> None:
        """Advance by so many control periods."""
        for _ in range(count):
            self.receive(1)
            self._move_fingers()
            if self._yields:  # it brakes the hand, and does not pull it back
                self._reference[1] = self.data.qpos[self._places[1]]
            self.data.ctrl[:3] = self._reference
            self._mujoco.mj_step(self.model, self.data, self.substeps)

    def _put(self, T_WE: np.ndarray, opening: float) -> None:
        position, quaternion = position_quaternion(T_WE)
        self.data.mocap_pos[0], self.data.mocap_quat[0] = position, np.roll(quaternion, 1)
        self.data.qpos[self._places] = [0.0, 0.0, 0.0, opening / 2, opening / 2]
        self.data.qvel[self._speeds] = 0.0
        self.data.ctrl[-1] = opening
        self._mujoco.mj_forward(self.model, self.data)

    def _send_carriage(self, q: np.ndarray, velocity: np.ndarray) -> None:
        # The servo's damping brakes the desired motion, too, see `MujocoPanda`.
        self._send(self._follow, q + _DAMPING_RATIO_OF_STIFFNESS * velocity)

    def _follow(self, reference: np.ndarray) -> None:
        self._limit_force(CARRIAGE_FORCE)
        self._yields, self._reference = False, reference
