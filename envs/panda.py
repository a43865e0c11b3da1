"""The Franka Panda: kinematics, limits, motors and gripper.

The kinematics are closed-form numpy (no simulator state is touched to plan), the motors are
PyBullet's. Knows nothing of objects, cameras or grasps.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pybullet
import pybullet_data
from scipy.spatial.transform import Rotation

from utils.errors import UserError
from utils.files import write_atomic

# Limits of the arm, from Franka Emika's interface specification (Panda).
JOINT_LOWER = np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973])  # rad
JOINT_UPPER = np.array([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973])  # rad
JOINT_VELOCITY = np.array([2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61])  # rad/s
JOINT_ACCELERATION = np.array([15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0])  # rad/s^2
JOINT_TORQUE = np.array([87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0])  # N m
CARTESIAN_ACCELERATION = 6.5  # m/s^2, half of the specified 13, which leaves room for tracking
MAX_OPENING = 0.08  # m between the fingertips
FINGER_SPEED = 0.05  # m/s a finger, from the Franka Hand's product manual

# Link numbers in pybullet_data's franka_panda/panda.urdf.
ARM = list(range(7))
HAND, LEFT_FINGER, RIGHT_FINGER, TIP = 8, 9, 10, 11
FINGERS = [LEFT_FINGER, RIGHT_FINGER]

# Modified (Craig) Denavit-Hartenberg parameters, same specification: a_{i-1}, alpha_{i-1}, d_i.
_A = (0.0, 0.0, 0.0, 0.0825, -0.0825, 0.0, 0.088)
_ALPHA = (0.0, -np.pi / 2, np.pi / 2, np.pi / 2, -np.pi / 2, np.pi / 2, np.pi / 2)
_D = (0.333, 0.0, 0.316, 0.0, 0.384, 0.0, 0.0)


def _link_terms() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(7, 4, 4) each: link i's transform is constant + cosine * cos(q_i) + sine * sin(q_i)."""
    constant, cosine, sine = np.zeros((3, 7, 4, 4))
    for i, (a, alpha, d) in enumerate(zip(_A, _ALPHA, _D)):
        twist = np.eye(4)
        twist[:3, :3] = Rotation.from_euler("x", alpha).as_matrix()
        twist[:3, 3] = a, -np.sin(alpha) * d, np.cos(alpha) * d
        constant[i] = twist @ np.diag([0.0, 0.0, 1.0, 1.0])
        cosine[i] = twist @ np.diag([1.0, 1.0, 0.0, 0.0])
        sine[i, :, 0], sine[i, :, 1] = twist[:, 1], -twist[:, 0]
    return constant, cosine, sine


_LINK_CONSTANT, _LINK_COSINE, _LINK_SINE = _link_terms()
# Flange 0.107 m beyond joint 7; hand turned by -45 degrees; E 0.105 m beyond the hand's origin.
_TOOL = np.eye(4)
_TOOL[:3, :3] = Rotation.from_euler("z", -np.pi / 4).as_matrix()
_TOOL[:3, 3] = 0.0, 0.0, 0.107 + 0.105


class UnreachableError(UserError):
    """The arm cannot reach a pose within its joint limits."""


def forward_kinematics(q: np.ndarray) -> np.ndarray:
    """(4, 4) T_WE for joint positions q (7,), the robot's base being the world frame."""
    return _chain(q)[0]


def _chain(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """T_WE (4, 4) and the geometric Jacobian (6, 7) of E in W, linear rows first."""
    cosines, sines = np.cos(q)[:, None, None], np.sin(q)[:, None, None]
    links = _LINK_CONSTANT + cosines * _LINK_COSINE + sines * _LINK_SINE
    T = links[0]
    poses = [T]
    for link in links[1:]:
        T = T @ link
        poses.append(T)
    T = T @ _TOOL
    frames = np.array(poses)
    axes = frames[:, :3, 2]
    arm = T[:3, 3] - frames[:, :3, 3]
    jacobian = np.empty((6, 7))
    jacobian[0] = axes[:, 1] * arm[:, 2] - axes[:, 2] * arm[:, 1]
    jacobian[1] = axes[:, 2] * arm[:, 0] - axes[:, 0] * arm[:, 2]
    jacobian[2] = axes[:, 0] * arm[:, 1] - axes[:, 1] * arm[:, 0]
    jacobian[3:] = axes.T
    return T, jacobian


def geometric_jacobian(q: np.ndarray) -> np.ndarray:
    """(6, 7) Jacobian of E in W: rows v then omega, for joint positions q (7,)."""
    return _chain(q)[1]


def rotation_vector(R: np.ndarray) -> np.ndarray:
    """(3,) axis-angle logarithm of a (3, 3) rotation, fast where the angle is not near pi."""
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()
    cosine = 0.5 * (a + e + i - 1.0)
    if cosine < -0.99:
        return Rotation.from_matrix(R).as_rotvec()
    x, y, z = 0.5 * (h - f), 0.5 * (c - g), 0.5 * (d - b)
    sine = math.sqrt(x * x + y * y + z * z)
    scale = math.atan2(sine, cosine) / sine if sine > 1e-9 else 1.0
    return np.array([scale * x, scale * y, scale * z])


def rotation_matrix(vector: np.ndarray) -> np.ndarray:
    """(3, 3) rotation of an axis-angle vector (3,), by Rodrigues' formula."""
    x, y, z = vector.tolist()
    angle = math.sqrt(x * x + y * y + z * z)
    if angle < 1e-9:
        return np.array([[1.0, -z, y], [z, 1.0, -x], [-y, x, 1.0]])
    x, y, z = x / angle, y / angle, z / angle
    s, c = math.sin(angle), math.cos(angle)
    t = 1.0 - c
    return np.array(
        [
            [c + t * x * x, t * x * y - s * z, t * x * z + s * y],
            [t * x * y + s * z, c + t * y * y, t * y * z - s * x],
            [t * x * z - s * y, t * y * z + s * x, c + t * z * z],
        ]
    )


def pose_error(T: np.ndarray, target: np.ndarray) -> np.ndarray:
    """(6,) small motion in W that takes pose T to the target: metres, then radians."""
    error = np.empty(6)
    error[:3] = target[:3, 3] - T[:3, 3]
    error[3:] = rotation_vector(target[:3, :3] @ T[:3, :3].T)
    return error


def moved(T: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """Pose T (4, 4) after a motion (6,) in W, metres then radians: `pose_error` the other way."""
    result = np.eye(4)
    result[:3, :3] = rotation_matrix(motion[3:]) @ T[:3, :3]
    result[:3, 3] = T[:3, 3] + motion[:3]
    return result


def inverse_kinematics(
    target: np.ndarray,
    seed: np.ndarray,
    rest: np.ndarray | None = None,
    *,
    position_tolerance: float = 1e-4,
    rotation_tolerance: float = 1e-3,
    max_iterations: int = 100,
) -> np.ndarray:
    """Joint positions (7,) that bring E to the target pose (4, 4) in W.

    Damped least squares within the joint limits (Buss, "Introduction to inverse kinematics",
    2004), started at `seed`; the redundant joint is drawn towards `rest`. The result has been
    checked by forward kinematics: within `position_tolerance` metres and `rotation_tolerance`
    radians, otherwise UnreachableError.
    """
    q = np.clip(np.asarray(seed, dtype=float), JOINT_LOWER, JOINT_UPPER)
    for _ in range(max_iterations):
        T, jacobian = _chain(q)
        error = pose_error(T, target)
        if abs(error[:3]).max() < position_tolerance and abs(error[3:]).max() < rotation_tolerance:
            return q
        q = q + _damped_step(jacobian, error, q, rest)
        q = np.minimum(np.maximum(q, JOINT_LOWER), JOINT_UPPER)
    position = np.round(target[:3, 3], 3).tolist()
    raise UnreachableError(
        f"the arm cannot reach the pose at {position} m within its joint limits: inverse kinematics "
        f"stopped {1000 * np.linalg.norm(error[:3]):.1f} mm and "
        f"{np.degrees(np.linalg.norm(error[3:])):.1f} degrees away; choose a pose within 0.85 m of "
        "the base"
    )


def _damped_step(jacobian, error, q, rest, damping: float = 0.02, max_step: float = 0.3):
    """One damped-least-squares step (7,) with a pull towards `rest` in the null space."""
    square = jacobian @ jacobian.T
    square.flat[::7] += damping**2
    if rest is None:
        step = jacobian.T @ np.linalg.solve(square, error)
    else:
        # The pull fades near the goal, where the damping would let it leak into the task.
        pull = 0.1 * min(1.0, abs(error).max() / 0.05) * (rest - q)
        step = pull + jacobian.T @ np.linalg.solve(square, error - jacobian @ pull)
    largest = abs(step).max()
    return step * (max_step / largest) if largest > max_step else step


class ServoStep:
    """One cheap step of inverse kinematics for every control period of a streamed pose command.

    The kinematic chain is walked once: `reached` is (4, 4) T_WE at `q` (7,), and `towards` gives
    the joint positions (7,) one damped step nearer to a target pose, within the joint limits.
    """

    def __init__(self, q: np.ndarray):
        self.q = q
        self.reached, self._jacobian = _chain(q)

    def towards(self, target: np.ndarray) -> np.ndarray:
        step = _damped_step(self._jacobian, pose_error(self.reached, target), self.q, None)
        return np.minimum(np.maximum(self.q + step, JOINT_LOWER), JOINT_UPPER)


@dataclass(frozen=True)
class Trajectory:
    """Joint references at the control rate: positions (N, 7) rad and velocities (N, 7) rad/s."""

    positions: np.ndarray
    velocities: np.ndarray

    def __len__(self) -> int:
        return len(self.positions)


def time_path(
    waypoints: np.ndarray,
    lengths: np.ndarray,
    *,
    dt: float,
    max_speed: float,
    max_acceleration: float,
    velocity_scale: float = 1.0,
    acceleration_scale: float = 1.0,
) -> Trajectory:
    """Run along joint waypoints (M, 7) with a smooth profile that respects every joint's limits.

    lengths (M,) is the path coordinate of each waypoint (metres or any unit); max_speed and
    max_acceleration bound its first two derivatives. The profile is the quintic
    s(u) = 10u^3 - 15u^4 + 6u^5, whose peaks are 1.875 L/T and 5.7735 L/T^2.
    """
    total = lengths[-1] - lengths[0]
    if total < 1e-9:
        return Trajectory(waypoints[-1:].copy(), np.zeros((1, 7)))
    share = (lengths - lengths[0]) / total
    slope = abs(np.diff(waypoints, axis=0)) / np.maximum(np.diff(share), 1e-9)[:, None]
    steepest = slope.max(axis=0)
    duration = max(
        1.875 * total / max_speed,
        np.sqrt(5.7735 * total / max_acceleration),
        float(np.max(1.875 * steepest / (JOINT_VELOCITY * velocity_scale))),
        float(np.sqrt(np.max(5.7735 * steepest / (JOINT_ACCELERATION * acceleration_scale)))),
        dt,
    )
    steps = int(np.ceil(duration / dt))
    u = np.arange(1, steps + 1) / steps
    s = u**3 * (10 - 15 * u + 6 * u**2)
    positions = np.column_stack([np.interp(s, share, waypoints[:, j]) for j in range(7)])
    velocities = np.diff(np.vstack([waypoints[:1], positions]), axis=0) / dt
    return Trajectory(positions, velocities)


class Panda:
    """The robot's body in one physics client."""

    def __init__(self, client: int, dt: float, urdf: Path, grip_force: float = 20.0):
        self.client, self.dt, self.grip_force = client, dt, grip_force
        self.body = pybullet.loadURDF(
            str(urdf), useFixedBase=True, flags=_URDF_FLAGS, physicsClientId=client
        )
        # Without this gear the fingers drift off the hand's centre (bullet3 #2101).
        gear = pybullet.createConstraint(
            self.body, LEFT_FINGER, self.body, RIGHT_FINGER, pybullet.JOINT_GEAR,
            [1, 0, 0], [0, 0, 0], [0, 0, 0], physicsClientId=client,
        )  # fmt: skip
        pybullet.changeConstraint(gear, gearRatio=-1, erp=0.1, maxForce=50, physicsClientId=client)
        for link in [*ARM, HAND, *FINGERS]:
            pybullet.changeDynamics(
                self.body, link, linearDamping=0, angularDamping=0, physicsClientId=client
            )
        for joint, lower, upper in zip(ARM, JOINT_LOWER, JOINT_UPPER):  # the URDF's are wider
            pybullet.changeDynamics(
                self.body, joint, jointLowerLimit=lower, jointUpperLimit=upper,
                physicsClientId=client,
            )  # fmt: skip
        # The motors' own limit holds back the motors only: a quick shoulder throws the light wrist.
        # Bullet has one such limit for all joints of a body.
        pybullet.changeDynamics(
            self.body, -1, maxJointVelocity=JOINT_VELOCITY.max(), physicsClientId=client
        )

    def place(self, q: np.ndarray, opening: float = MAX_OPENING) -> None:
        """Put the robot at joint positions q (7,) with the gripper at `opening` metres, at rest."""
        for joint, value in zip([*ARM, *FINGERS], [*q, opening / 2, opening / 2]):
            pybullet.resetJointState(self.body, joint, value, 0.0, physicsClientId=self.client)
        self.command_arm(q, np.zeros(7))
        self.command_gripper(opening)

    def command_arm(self, q: np.ndarray, velocity: np.ndarray) -> None:
        """Motor targets of one control period of a trajectory: q (7,) rad, velocity (7,) rad/s."""
        pybullet.setJointMotorControlArray(
            self.body, ARM, pybullet.POSITION_CONTROL,
            targetPositions=q, targetVelocities=velocity, forces=JOINT_TORQUE,
            positionGains=_POSITION_GAINS, velocityGains=_VELOCITY_GAINS,
            physicsClientId=self.client,
        )  # fmt: skip

    def drive_arm_to(self, q: np.ndarray, velocity_scale: float = 1.0) -> None:
        """Motor targets for several periods: the motors go to q (7,) no faster than the limits."""
        for joint in ARM:
            pybullet.setJointMotorControl2(
                self.body, joint, pybullet.POSITION_CONTROL,
                targetPosition=q[joint], targetVelocity=0.0, force=JOINT_TORQUE[joint],
                positionGain=_DRIVE_GAIN, velocityGain=1.0,
                maxVelocity=JOINT_VELOCITY[joint] * velocity_scale,
                physicsClientId=self.client,
            )  # fmt: skip

    def command_gripper(self, opening: float, force: float | None = None) -> None:
        """Drive both fingers towards `opening` metres with at most `force` newtons a finger."""
        opening = min(max(float(opening), 0.0), MAX_OPENING)
        for finger in FINGERS:
            pybullet.setJointMotorControl2(
                self.body, finger, pybullet.POSITION_CONTROL,
                targetPosition=opening / 2, force=self.grip_force if force is None else force,
                positionGain=0.2, velocityGain=1.0, maxVelocity=FINGER_SPEED,
                physicsClientId=self.client,
            )  # fmt: skip

    def joint_state(self) -> tuple[np.ndarray, np.ndarray, float]:
        """Joint positions (7,) rad, velocities (7,) rad/s and the gripper's opening in metres."""
        states = pybullet.getJointStates(self.body, _STATE_JOINTS, physicsClientId=self.client)
        q = np.array([state[0] for state in states[:7]])
        velocity = np.array([state[1] for state in states[:7]])
        return q, velocity, states[7][0] + states[8][0]

    @property
    def q(self) -> np.ndarray:
        """Joint positions (7,) in radians."""
        return self.joint_state()[0]

    @property
    def opening(self) -> float:
        """Distance between the fingertips in metres."""
        return self.joint_state()[2]

    def joint_move(self, start: np.ndarray, goal: np.ndarray, **scales: float) -> Trajectory:
        """The quickest synchronous motion between joint positions (7,) within all limits."""
        waypoints = np.linspace(start, goal, 2)
        return time_path(
            waypoints, np.array([0.0, 1.0]), dt=self.dt,
            max_speed=np.inf, max_acceleration=np.inf, **scales,
        )  # fmt: skip

    def straight_move(
        self, start: np.ndarray, goal: np.ndarray, speed: float, rest: np.ndarray, **scales: float
    ) -> Trajectory:
        """E moves on a straight line from FK(start) to the pose `goal` (4, 4), turning evenly.

        start: joint positions (7,). speed: peak Cartesian speed in m/s. Raises UnreachableError if
        any point of the line cannot be reached or the arm would have to jump between postures.
        """
        T = forward_kinematics(start)
        distance = float(np.linalg.norm(goal[:3, 3] - T[:3, 3]))
        turn = rotation_vector(T[:3, :3].T @ goal[:3, :3])
        # A radian counts as 0.2 m, so that a turn on the spot gets waypoints and time as well.
        length = max(distance, 0.2 * float(np.linalg.norm(turn)), 1e-6)
        count = max(2, int(np.ceil(length / _WAYPOINT_SPACING)) + 1)
        waypoints = [np.asarray(start, dtype=float)]
        for share in np.linspace(0, 1, count)[1:]:
            pose = np.eye(4)
            pose[:3, :3] = T[:3, :3] @ Rotation.from_rotvec(share * turn).as_matrix()
            pose[:3, 3] = (1 - share) * T[:3, 3] + share * goal[:3, 3]
            q = inverse_kinematics(pose, waypoints[-1], rest)
            if abs(q - waypoints[-1]).max() > _MAX_JUMP:
                raise UnreachableError(
                    f"the straight line to {np.round(goal[:3, 3], 3).tolist()} m passes too near a "
                    "singular posture of the arm; choose another approach"
                )
            waypoints.append(q)
        return time_path(
            np.array(waypoints), np.linspace(0, length, count), dt=self.dt,
            max_speed=speed, max_acceleration=CARTESIAN_ACCELERATION, **scales,
        )  # fmt: skip

    def finger_contacts(self, body: int) -> tuple[float, float]:
        """Normal forces in newtons of the left and the right finger on a body."""
        forces = []
        for finger in FINGERS:
            contacts = pybullet.getContactPoints(
                bodyA=self.body, bodyB=body, linkIndexA=finger, physicsClientId=self.client
            )
            forces.append(sum(contact[9] for contact in contacts))
        return forces[0], forces[1]

    def holds(self, body: int, min_force: float = 0.1) -> bool:
        """Whether both fingers press on the body with at least `min_force` newtons each."""
        return min(self.finger_contacts(body)) >= min_force

    def contact_force(self) -> float:
        """Sum of the normal forces in newtons on the whole robot."""
        contacts = pybullet.getContactPoints(bodyA=self.body, physicsClientId=self.client)
        return sum(contact[9] for contact in contacts)


_URDF_FLAGS = pybullet.URDF_ENABLE_CACHED_GRAPHICS_SHAPES
_POSITION_GAINS = [0.3] * 7
_VELOCITY_GAINS = [1.0] * 7
_DRIVE_GAIN = 0.1
_STATE_JOINTS = [*ARM, *FINGERS]
_WAYPOINT_SPACING = 0.01  # m
_MAX_JUMP = 0.3  # rad between neighbouring waypoints


def panda_urdf(cache_dir: Path, fine: bool) -> Path:
    """The URDF to load: pybullet_data's own for pictures, or one with low-polygon visuals.

    The stock visual meshes have about 102,000 triangles, which the software renderer transforms
    at every frame; the collision meshes that replace them have 3,400.
    """
    stock = Path(pybullet_data.getDataPath()) / "franka_panda" / "panda.urdf"
    if fine:
        return stock
    tree = ElementTree.parse(stock)
    for mesh in tree.iter("mesh"):
        name = mesh.attrib["filename"].replace("package://", "").replace("/visual/", "/collision/")
        mesh.set("filename", str(stock.parent / name))
    path = cache_dir / "panda_low_polygon.urdf"
    text = ElementTree.tostring(tree.getroot(), encoding="unicode")
    if not path.exists() or path.read_text() != text:
        write_atomic(path, text)
    return path
