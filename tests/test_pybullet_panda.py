"""The Panda in PyBullet: kinematics beside PyBullet's, straight lines, coupled fingers."""

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pybullet")

import pybullet
import pybullet_data
from scipy.spatial.transform import Rotation

from envs.panda_model import ARM_LINKS, BASE, FINGER_DRIVE_INERTIA, INERTIALS
from envs.panda_model import FINGERS as FINGER_LINKS
from envs.panda_urdf import write_panda
from envs.pybullet_bodies import set_up_physics
from envs.pybullet_panda import ARM, FINGERS, PybulletPanda
from envs.robot_kinematics import (
    GRASP_DEPTH,
    JOINT_ACCELERATION,
    JOINT_JERK,
    JOINT_LOWER,
    JOINT_TORQUE,
    JOINT_UPPER,
    JOINT_VELOCITY,
    UnreachableError,
    forward_kinematics,
    geometric_jacobian,
    inverse_kinematics,
)
from envs.robot_safety import ArmGate
from utils.transforms import top_down_pose

HOME = np.array([0, -np.pi / 4, 0, -3 * np.pi / 4, 0, np.pi / 2, np.pi / 4])


@pytest.fixture(scope="module")
def robot(config):
    client = pybullet.connect(pybullet.DIRECT)
    set_up_physics(client, config.sim)
    urdf = write_panda(config.cache_folder, config.gripper.geometry)
    dt = 1 / config.sim.frequency
    gate = ArmGate(config.safety, config.robot, dt, config.closed_loop.floor)
    gripper, force = config.gripper.geometry, config.robot.grip_force
    robot = PybulletPanda(client, dt, urdf, gripper, force, gate)
    robot.place(HOME)
    yield robot
    pybullet.disconnect(physicsClientId=client)


@pytest.fixture(scope="module")
def stock():
    """A client and PyBullet's own Panda in it, with its link `panda_grasptarget` (11) at E."""
    client = pybullet.connect(pybullet.DIRECT)
    path = Path(pybullet_data.getDataPath()) / "franka_panda" / "panda.urdf"
    yield client, pybullet.loadURDF(str(path), useFixedBase=True, physicsClientId=client)
    pybullet.disconnect(physicsClientId=client)


def test_kinematics_equal_pybullets(stock):
    client, body = stock
    rng = np.random.default_rng(0)
    for _ in range(50):
        q = rng.uniform(JOINT_LOWER, JOINT_UPPER)
        for joint, value in zip(ARM, q):
            pybullet.resetJointState(body, joint, value, physicsClientId=client)
        state = pybullet.getLinkState(
            body, 11, computeForwardKinematics=True, physicsClientId=client
        )
        T = forward_kinematics(q)
        np.testing.assert_allclose(T[:3, 3], state[4], atol=1e-6)
        np.testing.assert_allclose(T[:3, :3], Rotation.from_quat(state[5]).as_matrix(), atol=1e-6)
        linear, angular = pybullet.calculateJacobian(
            body, 11, [0, 0, 0], [*q, 0, 0], [0] * 9, [0] * 9, physicsClientId=client
        )
        theirs = np.vstack([linear, angular])[:, :7]
        np.testing.assert_allclose(geometric_jacobian(q), theirs, atol=1e-9)


def _distance(client: int, body: int, point) -> float:
    """From a body's collision shapes to a 1 mm ball, metres."""
    shape = pybullet.createCollisionShape(
        pybullet.GEOM_SPHERE, radius=0.001, physicsClientId=client
    )
    ball = pybullet.createMultiBody(0, shape, -1, list(point), physicsClientId=client)
    found = pybullet.getClosestPoints(body, ball, 1.0, physicsClientId=client)
    pybullet.removeBody(ball, physicsClientId=client)
    return min(point[8] for point in found)


def test_links_are_where_the_stock_robot_has_them(stock, robot):
    client, body = stock
    rng = np.random.default_rng(3)
    for _ in range(10):
        q, opening = rng.uniform(JOINT_LOWER, JOINT_UPPER), rng.uniform(0, 0.08)
        robot.place(q, opening)
        for joint, value in zip([*ARM, 9, 10], [*q, opening / 2, opening / 2]):
            pybullet.resetJointState(body, joint, value, physicsClientId=client)
        for ours, theirs in zip([*ARM, *FINGERS], [*ARM, 9, 10]):
            a, b = (
                pybullet.getLinkState(i, link, computeForwardKinematics=True, physicsClientId=c)
                for i, link, c in ((robot.body, ours, robot.client), (body, theirs, client))
            )
            np.testing.assert_allclose(a[4], b[4], atol=1e-6)  # the links' frames
            assert abs(np.dot(a[5], b[5])) == pytest.approx(1, abs=1e-6)
        # So are the shapes: distances to a small ball near the hand, which arm links may be 6 mm
        # nearer or farther from.
        near = forward_kinematics(q)[:3, 3] + rng.uniform(-0.15, 0.15, 3)
        np.testing.assert_allclose(
            _distance(robot.client, robot.body, near), _distance(client, body, near), atol=0.007
        )
        np.testing.assert_allclose(robot.tip_pose(), forward_kinematics(q), atol=1e-6)


def test_the_ready_pose(robot):
    """As Franka and PyBullet have it: the hand at 0.590 m, E at 0.485 m."""
    robot.place(HOME)
    T = robot.tip_pose()
    np.testing.assert_allclose(T[:3, 3], [0.306891, 0, 0.485282], atol=1e-6)
    np.testing.assert_allclose(
        T[:3, 3] - GRASP_DEPTH * T[:3, 2], [0.306891, 0, 0.590282], atol=1e-6
    )


def test_masses_and_inertias_are_the_identified_ones(robot):
    """Principal moments of each link; hand and last arm link are one body."""
    found = [
        pybullet.getDynamicsInfo(robot.body, link, physicsClientId=robot.client)
        for link in [*ARM, *FINGERS]
    ]
    moving = [inertial for name, inertial in INERTIALS.items() if name != BASE]
    drives = 2 * FINGER_DRIVE_INERTIA  # in PyBullet a part of the fingers
    assert sum(f[0] for f in found) - drives == pytest.approx(sum(i.mass for i in moving))
    names = [*ARM_LINKS[:-1], None, *FINGER_LINKS]
    for name, (mass, _, moments, centre, *_) in zip(names, found):
        if name is None or name in FINGER_LINKS:
            continue
        inertial = INERTIALS[name]
        assert mass == pytest.approx(inertial.mass)
        assert centre == pytest.approx(inertial.centre)
        expected = np.linalg.eigvalsh(inertial.tensor())
        np.testing.assert_allclose(np.sort(moments), expected, rtol=1e-3)


def test_straight_moves_respect_every_limit(robot):
    rng = np.random.default_rng(4)
    for _ in range(25):
        x, y = rng.uniform([0.36, -0.14], [0.64, 0.14])
        start = inverse_kinematics(top_down_pose([x, y, 0.2], rng.uniform(-np.pi, 0)), HOME, HOME)
        target = forward_kinematics(start)
        target[2, 3] = 0.02
        for speed in (0.25, np.inf):
            path = robot.straight_move(start, target, speed, HOME)
            rest = np.zeros((1, 7))
            acceleration = np.diff(path.velocities, axis=0, prepend=rest, append=rest) / robot.dt
            jerk = np.diff(acceleration, axis=0, prepend=rest, append=rest) / robot.dt
            assert (abs(path.velocities) <= JOINT_VELOCITY * 1.001).all()
            assert (abs(acceleration) <= JOINT_ACCELERATION * 1.001).all()
            assert (abs(jerk) <= JOINT_JERK * 1.001).all()
            tips = np.array([forward_kinematics(q)[:3, 3] for q in path.positions])
            fastest = np.linalg.norm(np.diff(tips, axis=0), axis=1).max() / robot.dt
            assert fastest <= min(speed, 1.7) * 1.001


def _run(robot, trajectory):
    """Follow a trajectory; positions, velocities and motor torques (7,) after every step."""
    states = []
    for q, velocity in zip(trajectory.positions, trajectory.velocities):
        robot.command_arm(q, velocity)
        pybullet.stepSimulation(physicsClientId=robot.client)
        joints = pybullet.getJointStates(robot.body, ARM, physicsClientId=robot.client)
        states.append((*robot.joint_state()[:2], np.array([joint[3] for joint in joints])))
    return states


def test_motion_in_physics_is_legal_and_accurate(robot):
    robot.place(HOME)
    goal = inverse_kinematics(top_down_pose([0.55, 0.15, 0.15], -2.0), HOME, HOME)
    states = _run(robot, robot.joint_move(HOME, goal))
    assert max((abs(velocity) / JOINT_VELOCITY).max() for _, velocity, _ in states) < 1.01
    # Well below the limits, so the motors' own caps are not what keeps the torques legal.
    assert max((abs(torque) / JOINT_TORQUE).max() for *_, torque in states) < 0.9
    np.testing.assert_allclose(robot.q, goal, atol=2e-3)


def test_straight_line_stays_straight(robot):
    start = inverse_kinematics(top_down_pose([0.5, -0.1, 0.2], -1.2), HOME, HOME)
    robot.place(start)
    target = forward_kinematics(start)
    target[2, 3] -= 0.15
    points = [
        forward_kinematics(q)[:3, 3]
        for q, *_ in _run(robot, robot.straight_move(start, target, 0.25, HOME))
    ]
    sideways = np.linalg.norm(np.array(points)[:, :2] - target[:2, 3], axis=1)
    assert sideways.max() < 5e-4
    np.testing.assert_allclose(points[-1], target[:3, 3], atol=1e-3)


def test_a_line_out_of_reach_is_refused(robot):
    target = forward_kinematics(HOME)
    target[0, 3] += 1.0
    with pytest.raises(UnreachableError):
        robot.straight_move(HOME, target, 0.25, HOME)


def test_fingers_are_coupled(robot):
    robot.place(HOME, opening=0.08)
    for opening in (0.0, 0.05, 0.2):
        robot.command_gripper(opening)
        for _ in range(400):
            pybullet.stepSimulation(physicsClientId=robot.client)
        left, right = (
            pybullet.getJointState(robot.body, finger, physicsClientId=robot.client)[0]
            for finger in FINGERS
        )
        assert left == pytest.approx(right, abs=1e-4)
        assert robot.opening == pytest.approx(min(opening, robot.max_opening), abs=1e-3)
