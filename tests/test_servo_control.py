"""Gains, limits, inverses, and the arm behind the camera beside PyBullet's kinematics."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given

from envs.pybullet_files import data_folder
from tests.helpers.servo_cases import derivative, twists
from utils.errors import UserError
from utils.servo_control import camera_jacobian, joint_velocities, pseudo_inverse
from utils.servo_features import interaction_matrix
from utils.servo_reference import CAMERA, SQUARE, object_pose
from utils.transforms import inverse_pose, pose_matrix, transform_points
from utils.visual_servo import (
    AdaptiveGain,
    ImageBasedVisualServo,
    PoseError,
    PositionBasedVisualServo,
    ServoView,
    SingularMatrixError,
    TwistLimits,
    joint_limit_avoidance,
)


def test_adaptive_gain_by_hand():
    gain = AdaptiveGain(4, 0.4, 30)
    assert gain(0) == 4
    assert gain(0.12) == pytest.approx(0.4 + 3.6 * np.exp(-1))
    assert gain(100) == pytest.approx(0.4)
    slope = (gain(1e-7) - gain(0)) / 1e-7
    assert slope == pytest.approx(-30, rel=1e-5)


@pytest.mark.parametrize(
    ("values", "words"),
    [((np.inf, 0.4, 30), "at_zero: .*got inf"), ((4, 0, 30), "at_infinity: .*got 0"),
     ((4, 0.4, np.nan), "slope_at_zero: .*got nan"), ((1, 2, 30), "at_zero > at_infinity")],
)  # fmt: skip
def test_an_impossible_adaptive_gain_is_refused_by_the_name_of_its_fault(values, words):
    with pytest.raises(UserError, match=words):
        AdaptiveGain(*values)


@given(twists)
def test_limits_scale_the_whole_twist(twist):
    limited = TwistLimits(0.2, 0.7).scale(twist)
    assert np.linalg.norm(limited[:3]) <= 0.2 + 1e-12
    assert np.linalg.norm(limited[3:]) <= 0.7 + 1e-12
    np.testing.assert_allclose(
        limited * np.linalg.norm(twist), twist * np.linalg.norm(limited), atol=1e-12
    )


def test_pseudo_inverse_exact_damped_and_truncated():
    A = np.random.default_rng(1).normal(size=(8, 6))
    inverse, condition = pseudo_inverse(A)
    np.testing.assert_allclose(inverse, np.linalg.pinv(A), atol=1e-12)
    assert condition == pytest.approx(np.linalg.cond(A))
    damped, condition = pseudo_inverse(A, damping=0.3)
    np.testing.assert_allclose(damped, np.linalg.solve(A.T @ A + 0.09 * np.eye(6), A.T))
    assert condition == pytest.approx(np.linalg.cond(A))
    singular = np.diag([2.0, 1.0, 0.0])
    truncated, condition = pseudo_inverse(singular, truncation=1e-6)
    np.testing.assert_allclose(truncated, np.diag([0.5, 1.0, 0.0]))
    assert condition == np.inf


@pytest.mark.parametrize("A", [np.diag([1.0, 1e-12]), np.zeros((2, 2)), np.full((2, 2), np.nan)])
def test_pseudo_inverse_refuses_singular_matrices(A):
    with pytest.raises(SingularMatrixError, match="matrix"):
        pseudo_inverse(A)


def test_pseudo_inverse_refuses_infinity_even_when_damped():
    with pytest.raises(SingularMatrixError, match="finite"):
        pseudo_inverse(np.array([[np.inf, 1], [1, 1]]), damping=0.1, truncation=0.1)


@pytest.fixture(scope="module")
def panda():
    """A fixed Panda; gives T_WE, Jacobian and E's velocity in W, from PyBullet."""
    pybullet = pytest.importorskip("pybullet")
    from pybullet_utils.bullet_client import BulletClient

    client = BulletClient(pybullet.DIRECT)
    client.setAdditionalSearchPath(str(data_folder()))
    body = client.loadURDF("franka_panda/panda.urdf", useFixedBase=True)
    yield Panda(client, body)
    client.disconnect()


class Panda:
    HAND = 11
    q = np.array([0.3, -0.5, 0.2, -2.0, 0.4, 1.7, 0.6])

    def __init__(self, client, body):
        self.client, self.body = client, body

    def pose(self, q):
        for joint, angle in enumerate(q):
            self.client.resetJointState(self.body, joint, angle)
        state = self.client.getLinkState(self.body, self.HAND, computeForwardKinematics=1)
        return pose_matrix(state[4], state[5])

    def velocity(self, q, qdot):
        for joint, (angle, speed) in enumerate(zip(q, qdot)):
            self.client.resetJointState(self.body, joint, angle, speed)
        state = self.client.getLinkState(
            self.body, self.HAND, computeLinkVelocity=1, computeForwardKinematics=1
        )
        np.testing.assert_allclose(state[0], state[4], atol=1e-9)  # this link's mass is at E
        return np.concatenate([state[6], state[7]])

    def jacobian(self, q):
        zeros = [0.0] * 9
        J = self.client.calculateJacobian(self.body, self.HAND, [0, 0, 0], [*q, 0, 0], zeros, zeros)
        return np.vstack(J)[:, :7]


T_EC = object_pose([0.05, -0.02, -0.06], [10, 20, 90])


T_WC = object_pose([0.9, 0.1, 0.8], [150, 60, 20])


IN_HAND = CAMERA | {"mounting": "eye_in_hand", "T_EC": T_EC}


TO_HAND = CAMERA | {"mounting": "eye_to_hand", "T_WC": T_WC}


def test_camera_velocity_is_that_of_pybullets_link(panda):
    qdot = np.array([0.3, -0.2, 0.5, 0.1, -0.4, 0.6, -0.7])
    T_WE, v_W = panda.pose(panda.q), panda.velocity(panda.q, qdot)
    # By hand: the camera's origin is an arm r away from E, so its velocity is v + w x r.
    r = T_WE[:3, :3] @ T_EC[:3, 3]
    R_CW = (T_WE @ T_EC)[:3, :3].T
    by_hand = np.concatenate([R_CW @ (v_W[:3] + np.cross(v_W[3:], r)), R_CW @ v_W[3:]])
    J = camera_jacobian("eye_in_hand", T_WE, panda.jacobian(panda.q), T_EC=T_EC)
    np.testing.assert_allclose(J @ qdot, by_hand, atol=1e-6)


@pytest.mark.parametrize("config", [IN_HAND, TO_HAND], ids=["in hand", "to hand"])
def test_image_moves_as_the_joints_say(panda, config):
    """L J qdot is the measured motion of the points, with the sign and lever arm of the mount."""
    q, qdot = panda.q, np.array([0.3, -0.2, 0.5, 0.1, -0.4, 0.6, -0.7])
    servo = ImageBasedVisualServo(config)
    in_hand = config is IN_HAND
    T_WE = panda.pose(q)
    T_WC_now = T_WE @ T_EC if in_hand else T_WC
    # Points 0.5 m in front of the camera: fixed in the world, or riding on the hand.
    points_C = SQUARE + [0.02, 0.03, 0.5]
    carried = transform_points(
        inverse_pose(np.eye(4) if in_hand else T_WE), transform_points(T_WC_now, points_C)
    )

    def image(dt):
        T_WE = panda.pose(q + dt * qdot)
        if in_hand:
            p = transform_points(inverse_pose(T_WE @ T_EC), carried)
        else:
            p = transform_points(inverse_pose(T_WC) @ T_WE, carried)
        return (p[:, :2] / p[:, 2:]).ravel()

    camera = servo.camera
    J = camera_jacobian(
        camera.mounting, T_WE, panda.jacobian(q), T_EC=camera.T_EC, T_WC=camera.T_WC
    )
    L = interaction_matrix(points_C[:, :2] / points_C[:, 2:], points_C[:, 2])
    # PyBullet's poses are good to about 1e-7 m, hence the long step; the values are around 1.
    np.testing.assert_allclose(L @ J @ qdot, derivative(image, 2e-3), atol=1e-3)


@pytest.mark.parametrize("config", [IN_HAND, TO_HAND], ids=["in hand", "to hand"])
@pytest.mark.parametrize("law", [ImageBasedVisualServo, PositionBasedVisualServo])
def test_arm_servoes_to_the_goal(panda, config, law):
    """The whole chain: views from PyBullet's kinematics, joints moved by the servo's velocities."""
    servo = law(config, 1.0)
    q_goal = panda.q + np.array([0.1, -0.1, 0.1, 0.1, -0.1, 0.1, 0.2])
    in_hand = config is IN_HAND

    def look(T_WE):
        T_CO = inverse_pose(T_WE @ T_EC) @ T_WO if in_hand else inverse_pose(T_WC) @ T_WE @ T_EO
        p = transform_points(T_CO, SQUARE)
        return ServoView(servo.camera.to_pixels(p[:, :2] / p[:, 2:]), p[:, 2], T_CO)

    goal_pose = panda.pose(q_goal)
    ahead = object_pose([0, 0, 0.5], [15, -10, 30])  # of the object in the camera at the goal
    T_WO = goal_pose @ T_EC @ ahead
    T_EO = inverse_pose(goal_pose) @ T_WC @ ahead
    state = {"q": panda.q.copy()}

    def move(v_C):
        T_WE = panda.pose(state["q"])
        qdot = servo.compute_joint_velocities(T_WE, v_C, panda.jacobian(state["q"]))
        state["q"] = state["q"] + servo.dt * qdot

    history = servo.run(lambda: look(panda.pose(state["q"])), move, look(goal_pose), 600)
    assert history.converged
    # The error shrinks by 1 - gain dt = 0.96 a step: 1e-5 is reached after about 270.
    assert history.iterations == pytest.approx(
        1 + np.log(1e-5 / history.error_norms[0]) / np.log(0.96), rel=0.05
    )


def test_secondary_task_leaves_the_camera_alone_and_the_limit_behind(panda):
    servo = ImageBasedVisualServo(IN_HAND)
    T_WE, J_W = panda.pose(panda.q), panda.jacobian(panda.q)
    twist = np.array([0.05, -0.02, 0.03, 0.1, 0.2, -0.1])
    upper, lower = panda.q + 2.0, panda.q - 2.0
    lower[2], upper[2] = panda.q[2] - 3.9, panda.q[2] + 0.1  # joint 3 is near its upper limit
    away = joint_limit_avoidance(panda.q, lower, upper, gain=2.0)
    # 10 % of 4 rad is 0.4; 0.3 rad of it are used up.
    np.testing.assert_allclose(away, [0, 0, -0.6, 0, 0, 0, 0], atol=1e-12)
    plain = servo.compute_joint_velocities(T_WE, twist, J_W)
    both = servo.compute_joint_velocities(T_WE, twist, J_W, secondary=away)
    J = camera_jacobian("eye_in_hand", T_WE, J_W, T_EC=T_EC)
    np.testing.assert_allclose(J @ plain, twist, atol=1e-10)
    np.testing.assert_allclose(J @ both, twist, atol=1e-10)
    assert both[2] < plain[2] - 0.01


def test_damped_joint_velocities_keep_the_secondary_task_out_of_the_task(panda):
    J = panda.jacobian(panda.q)
    still = joint_velocities(J, np.zeros(6), np.ones(7), damping=0.05)
    np.testing.assert_allclose(J @ still, 0, atol=1e-10)
    assert np.linalg.norm(still) > 0.1


def test_singular_posture_is_refused_or_damped(panda):
    servo = ImageBasedVisualServo(IN_HAND)
    T_WE, twist = panda.pose(panda.q), np.full(6, 0.1)
    flat = panda.jacobian(panda.q)
    flat[2] = flat[1]
    with pytest.raises(SingularMatrixError):
        servo.compute_joint_velocities(T_WE, twist, flat)
    assert np.isfinite(servo.compute_joint_velocities(T_WE, twist, flat, damping=0.05)).all()


@pytest.mark.parametrize(
    ("config", "missing"), [({}, "T_EC"), ({"mounting": "eye_to_hand"}, "T_WC")]
)
def test_joint_velocities_need_the_mounting(config, missing):
    servo = ImageBasedVisualServo(CAMERA | config)
    with pytest.raises(PoseError, match=missing):
        servo.compute_joint_velocities(np.eye(4), np.zeros(6), np.eye(6))
