"""The Panda in MuJoCo beside PyBullet's; skipped where MuJoCo, which is optional, is missing."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from envs.mujoco_panda import MujocoPanda, panda_spec
from envs.panda_model import BASE, FINGER_JOINTS, HAND, INERTIALS
from envs.robot_kinematics import GRASP_DEPTH, JOINT_LOWER, JOINT_UPPER, forward_kinematics
from envs.robot_safety import ArmGate

READY = np.array([0, -np.pi / 4, 0, -3 * np.pi / 4, 0, np.pi / 2, np.pi / 4])


@pytest.fixture(scope="module")
def panda(config) -> MujocoPanda:
    dt = 1 / config.sim.frequency
    gate = ArmGate(config.safety, config.robot, dt, config.closed_loop.floor)
    hand = config.gripper.geometry
    return MujocoPanda(panda_spec(hand), dt, 2, hand, config.robot.grip_force, gate)


@pytest.fixture(scope="module")
def stock():
    """PyBullet's own Panda: joint positions (7,) to the pose of its hand and grasp target."""
    pybullet = pytest.importorskip("pybullet")
    pybullet_data = pytest.importorskip("pybullet_data")
    client = pybullet.connect(pybullet.DIRECT)
    body = pybullet.loadURDF(
        f"{pybullet_data.getDataPath()}/franka_panda/panda.urdf", useFixedBase=True,
        physicsClientId=client,
    )  # fmt: skip
    links = {
        pybullet.getJointInfo(body, i, physicsClientId=client)[12].decode(): i
        for i in range(pybullet.getNumJoints(body, physicsClientId=client))
    }

    def positions(q):
        for joint, value in enumerate(q):
            pybullet.resetJointState(body, joint, value, physicsClientId=client)
        states = [
            pybullet.getLinkState(
                body, links[name], computeForwardKinematics=True, physicsClientId=client
            )
            for name in (HAND, "panda_grasptarget")
        ]
        return [(np.array(s[4]), np.array(s[5])) for s in states]

    yield positions
    pybullet.disconnect(physicsClientId=client)


def grasp_target(panda) -> np.ndarray:
    """(4, 4) T_WE from where MuJoCo has the hand."""
    T = panda.pose(HAND)
    T[:3, 3] += GRASP_DEPTH * T[:3, 2]
    return T


def test_the_hand_where_franka_and_pybullet_have_it(panda):
    panda.place(READY)
    np.testing.assert_allclose(panda.pose(HAND)[:3, 3], [0.306891, 0, 0.590282], atol=1e-6)
    np.testing.assert_allclose(grasp_target(panda)[:3, 3], [0.306891, 0, 0.485282], atol=1e-6)


def test_forward_kinematics_agree_with_pybullet_and_with_ours(panda, stock):
    rng = np.random.default_rng(0)
    for q in rng.uniform(JOINT_LOWER, JOINT_UPPER, (50, 7)):
        panda.place(q)
        for T, (position, quaternion) in zip((panda.pose(HAND), grasp_target(panda)), stock(q)):
            np.testing.assert_allclose(T[:3, 3], position, atol=1e-6)
            R = Rotation.from_quat(quaternion).as_matrix()
            np.testing.assert_allclose(T[:3, :3], R, atol=2e-6)
        np.testing.assert_allclose(grasp_target(panda), forward_kinematics(q), atol=1e-6)


def test_masses_and_inertias_are_the_identified_ones(panda):
    for name, inertial in INERTIALS.items():
        body = panda.model.body(name)
        assert body.mass[0] == inertial.mass
        moments = np.linalg.eigvalsh(inertial.tensor())
        np.testing.assert_allclose(np.sort(body.inertia), moments, rtol=1e-6)


def test_gravity_torques(panda):
    """Static torques of a horizontal arm, from centres of mass by hand: sum of m g x lever arm."""
    q = np.array([0, np.pi / 2, 0, -0.07, 0, 0.5, 0])
    panda.place(q)
    total = 0.0
    for name, inertial in INERTIALS.items():
        if name in (BASE, "panda_link1"):
            continue
        centre = panda.pose(name) @ [*inertial.centre, 1.0]
        total += inertial.mass * 9.81 * centre[0]
    assert panda.data.qfrc_bias[1] == pytest.approx(-total, rel=1e-6)


def test_servos_hold_and_move_the_arm(panda):
    panda.place(READY)
    goal = READY + 0.2
    panda.drive_arm_to(goal)
    panda.command_gripper(0.03)
    panda.step(round(2.0 / panda.dt))
    np.testing.assert_allclose(panda.q, goal, atol=1e-4)  # the arm's weight is compensated
    assert panda.opening == pytest.approx(0.03, abs=1e-3)
    left, right = (panda.data.joint(name).qpos[0] for name in FINGER_JOINTS)
    assert left == pytest.approx(right, abs=1e-4)


def test_a_trajectory_is_followed(panda):
    """Within 3 mm at the fingertips at up to 1.9 rad/s, and 1 mrad when the servos have settled."""
    start = READY + np.array([0.5, 0.3, -0.3, 0.2, 0.3, -0.2, 0.4])
    panda.place(start)
    way = panda.joint_move(start, READY)
    farthest = 0.0
    for q, velocity in zip(way.positions, way.velocities):
        panda.command_arm(q, velocity)
        panda.step()
        off = (panda.tip_pose() - forward_kinematics(q))[:3, 3]
        farthest = max(farthest, float(np.linalg.norm(off)))
    assert farthest < 0.003
    panda.step(round(0.2 / panda.dt))
    np.testing.assert_allclose(panda.q, READY, atol=1e-3)


def test_a_joint_near_its_limit_is_as_quick_as_elsewhere(panda):
    q, velocity = READY.copy(), np.zeros(7)
    q[6], velocity[6] = JOINT_UPPER[6] - 0.3, 1.0
    panda.place(q)
    for _ in range(round(0.28 / panda.dt)):
        q[6] += velocity[6] * panda.dt
        panda.command_arm(q, velocity)
        panda.step()
        assert panda.q[6] == pytest.approx(q[6], abs=0.005)  # it moves 4.2 mrad in a period


def test_fingers_close_no_faster_than_the_hand(panda):
    """0.05 m/s a finger: 4 cm less in 0.4 s."""
    panda.place(READY, opening=0.08)
    panda.command_gripper(0.0)
    panda.step(round(0.4 / panda.dt))
    assert panda.opening == pytest.approx(0.04, abs=0.004)


def test_a_driven_joint_keeps_its_speed(panda):
    panda.place(READY)
    goal = READY + np.array([1.0, 0, 0, 0, 0, 0, 0])
    panda.drive_arm_to(goal, speed=0.5)
    panda.step(round(1.0 / panda.dt))
    assert panda.joint_state()[1][0] == pytest.approx(0.5, abs=0.01)
    panda.step(round(1.5 / panda.dt))
    np.testing.assert_allclose(panda.q, goal, atol=1e-3)
