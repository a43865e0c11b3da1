"""The Panda's kinematics, its limits and motions that respect them, without a simulator."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from envs.robot_kinematics import (
    JOINT_ACCELERATION,
    JOINT_LOWER,
    JOINT_UPPER,
    JOINT_VELOCITY,
    ServoStep,
    UnreachableError,
    forward_kinematics,
    geometric_jacobian,
    inverse_kinematics,
    pose_error,
    rotation_vector,
    time_path,
)
from utils.transforms import top_down_pose

HOME = np.array([0, -np.pi / 4, 0, -3 * np.pi / 4, 0, np.pi / 2, np.pi / 4])


joint_positions = st.tuples(*(st.floats(a, b) for a, b in zip(JOINT_LOWER, JOINT_UPPER)))


def test_forward_kinematics_known_pose():
    # The hand is at (0.306891, 0, 0.590282) in this posture and E 0.105 m below it.
    np.testing.assert_allclose(forward_kinematics(HOME)[:3, 3], [0.306891, 0, 0.485282], atol=1e-5)


@given(joint_positions)
@settings(max_examples=60, deadline=None)
def test_jacobian_is_the_derivative(q):
    q = np.array(q)
    jacobian, T, h = geometric_jacobian(q), forward_kinematics(q), 1e-6
    for joint in range(7):
        moved = q.copy()
        moved[joint] += h
        numeric = pose_error(T, forward_kinematics(moved)) / h
        np.testing.assert_allclose(jacobian[:, joint], numeric, atol=1e-5)


@given(st.floats(-np.pi, np.pi), st.floats(-1, 1), st.floats(-1, 1), st.floats(0.1, 1))
def test_rotation_vector_equals_scipy(angle, x, y, z):
    axis = np.array([x, y, z]) / np.linalg.norm([x, y, z])
    R = Rotation.from_rotvec(angle * axis)
    ours = Rotation.from_rotvec(rotation_vector(R.as_matrix()))
    assert (ours * R.inv()).magnitude() < 1e-6


def test_inverse_kinematics_reaches_the_whole_workspace():
    rng = np.random.default_rng(1)
    for _ in range(200):
        position = rng.uniform([0.33, -0.17, 0.01], [0.67, 0.17, 0.3])
        target = top_down_pose(position, rng.uniform(-np.pi, 0))  # half a turn around home
        q = inverse_kinematics(target, HOME, HOME)
        assert (q >= JOINT_LOWER).all() and (q <= JOINT_UPPER).all()
        error = pose_error(forward_kinematics(q), target)
        assert abs(error[:3]).max() < 1e-4 and abs(error[3:]).max() < 1e-3


def test_unreachable_pose_is_refused_by_name():
    with pytest.raises(UnreachableError, match=r"\[2.0, 0.0, 0.3\] m within its joint limits"):
        inverse_kinematics(top_down_pose([2.0, 0.0, 0.3], -np.pi / 2), HOME)


def test_servo_step_converges_on_a_near_pose():
    target = forward_kinematics(HOME)
    target[:3, 3] += [0.02, -0.01, -0.03]
    q = HOME
    for _ in range(8):
        q = ServoStep(q).towards(target)
    assert abs(pose_error(forward_kinematics(q), target)).max() < 1e-4


def test_time_path_respects_every_limit():
    rng = np.random.default_rng(2)
    dt = 1 / 1000
    for _ in range(20):
        ends = rng.uniform(JOINT_LOWER, JOINT_UPPER, (2, 7))
        path = time_path(
            ends, np.array([0.0, 1.0]), dt=dt, max_speed=np.inf, max_acceleration=np.inf
        )
        acceleration = np.diff(path.velocities, axis=0) / dt
        assert (abs(path.velocities) <= JOINT_VELOCITY * 1.001).all()
        assert (abs(acceleration) <= JOINT_ACCELERATION * 1.01).all()
        np.testing.assert_allclose(path.positions[-1], ends[1])
        # One limit is touched: the motion is no slower than it has to be.
        used = max(
            (abs(path.velocities) / JOINT_VELOCITY).max(),
            (abs(acceleration) / JOINT_ACCELERATION).max(),
        )
        assert used > 0.97


def test_velocity_scale_slows_down():
    ends = np.vstack([HOME, HOME + 0.5])
    fast, slow = (
        time_path(ends, np.array([0.0, 1.0]), dt=0.001, max_speed=np.inf, max_acceleration=np.inf,
                  velocity_scale=s, acceleration_scale=s)
        for s in (1.0, 0.25)
    )  # fmt: skip
    assert len(slow) >= 2 * len(fast) - 1
