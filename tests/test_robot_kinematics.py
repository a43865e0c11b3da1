"""The Panda's kinematics and its limits, without a simulator."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from envs.robot_kinematics import (
    GRASP_DEPTH,
    HAND_TURN,
    JOINT_LOWER,
    JOINT_UPPER,
    TOOL_LENGTH,
    ServoStep,
    UnreachableError,
    all_postures,
    arm_points,
    forward_kinematics,
    geometric_jacobian,
    inverse_kinematics,
    link_poses,
    must_flip,
    pose_error,
    postures,
    rotation_vector,
    should_flip,
    tip_twists,
)
from utils.transforms import top_down_pose

HOME = np.array([0, -np.pi / 4, 0, -3 * np.pi / 4, 0, np.pi / 2, np.pi / 4])


def wrist_at(angle: float) -> np.ndarray:
    """HOME with the last joint at an angle in radians."""
    return np.append(HOME[:-1], angle)


def test_a_gripper_is_flipped_on_its_way_where_its_wrist_meets_a_limit():
    """0.1 rad before the limit there is no room; flipped, with another elbow, there is."""
    home = wrist_at(JOINT_UPPER[-1] - 0.1)
    pose = forward_kinematics(home)
    found = postures(pose, home)
    flipped = found[True][-1]
    assert found[False] == pytest.approx(home, abs=1e-6) and abs(flipped) < JOINT_UPPER[-1] - 0.3
    assert must_flip(pose, home, wrist_at(flipped - 2.7))
    assert not must_flip(pose, home, wrist_at(flipped - 2.9))  # more than a law turns that way
    assert not must_flip(forward_kinematics(HOME), home, HOME)
    out_of_reach = pose.copy()
    out_of_reach[0, 3] += 2.0
    assert not must_flip(out_of_reach, home, HOME)


def test_a_gripper_sets_out_flipped_where_that_turns_the_wrist_less():
    """Where both postures have room the nearer one wins; 0.1 rad before the limit there is none."""
    roomy = forward_kinematics(wrist_at(0.9))
    kept, flipped = (posture[-1] for posture in postures(roomy, HOME).values())
    assert max(abs(kept), abs(flipped)) < JOINT_UPPER[-1] - 0.6 and kept - flipped > 1
    assert not should_flip(roomy, HOME, wrist_at(kept - 0.1))
    assert should_flip(roomy, HOME, wrist_at(flipped + 0.1))
    tight = wrist_at(JOINT_UPPER[-1] - 0.1)
    assert should_flip(forward_kinematics(tight), tight, tight)


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


@given(joint_positions, joint_positions)
@settings(max_examples=20, deadline=None)
def test_twists_are_the_jacobian_times_velocities(q, velocity):
    q, velocity = np.array(q), np.array(velocity)
    expected = geometric_jacobian(q) @ velocity
    np.testing.assert_allclose(tip_twists(q[None], velocity[None])[0], expected, atol=1e-12)


@settings(max_examples=30)
@given(joint_positions)
def test_points_on_the_arm_lie_on_its_links(q):
    """From the upper arm's end, 0.316 m from the shoulder at 0.333 m, to the flange, 0.105 m behind
    E, on a way that is as long as the links; no two neighbours farther apart than 5 cm."""
    q = np.array(q)
    points = arm_points(q[None])[0]
    assert np.linalg.norm(points[0] - (0, 0, 0.333)) == pytest.approx(0.316)
    T = forward_kinematics(q)
    np.testing.assert_allclose(points[-1], T[:3, 3] - GRASP_DEPTH * T[:3, 2], atol=1e-12)
    assert np.linalg.norm(np.diff(points, axis=0), axis=1).max() < 0.05 + 1e-9
    length = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
    assert length == pytest.approx(0.0825 + 0.0825 + 0.384 + 0.088 + 0.107)


@settings(max_examples=30)
@given(joint_positions)
def test_the_last_link_carries_the_tool(q):
    """E is TOOL_LENGTH along joint 7's axis; the hand is turned about it."""
    q = np.array(q)
    tool = np.eye(4)
    tool[:2, :2] = [[np.cos(HAND_TURN), -np.sin(HAND_TURN)], [np.sin(HAND_TURN), np.cos(HAND_TURN)]]
    tool[2, 3] = TOOL_LENGTH
    np.testing.assert_allclose(link_poses(q[None])[0, 6] @ tool, forward_kinematics(q), atol=1e-12)


def test_more_postures_are_those_near_home_and_others():
    pose = top_down_pose(np.array([0.5, 0.0, 0.2]), 0.3)
    near, more = all_postures(pose, HOME), all_postures(pose, HOME, more=True)
    assert len(more) > len(near)
    for q in more:
        T = forward_kinematics(q)
        np.testing.assert_allclose(T[:3, 3], pose[:3, 3], atol=2e-4)
    for q in near:
        assert any(np.array_equal(q, other) for other in more)


def test_more_starts_reach_level_poses_that_home_does_not():
    """A hand that comes level from the robot's side, its closing line vertical."""
    reached = 0
    for x, y in ((0.45, 0.0), (0.5, -0.1), (0.55, 0.05), (0.6, 0.1)):
        pose = np.eye(4)
        pose[:3, :3] = np.column_stack([(0, 1, 0), (0, 0, 1), (1, 0, 0)])
        pose[:3, 3] = x, y, 0.15
        try:
            found = all_postures(pose, HOME)
        except UnreachableError:
            continue
        reached += 1
        with pytest.raises(UnreachableError):
            postures(pose, HOME)
        for q in found:
            T = forward_kinematics(q)
            np.testing.assert_allclose(T[:3, 3], pose[:3, 3], atol=2e-4)
            assert T[:3, 2] @ pose[:3, 2] > 1 - 1e-5 and abs(T[:3, 1] @ pose[:3, 1]) > 1 - 1e-5
    assert reached >= 2
