"""Motions within the limits of velocity, acceleration and jerk, of joints and hand."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicSpline

from envs.robot_kinematics import JOINT_LOWER, JOINT_UPPER, geometric_jacobian
from envs.robot_motion import Limits, SCurve, blended, timed

HOME = np.array([0, -np.pi / 4, 0, -3 * np.pi / 4, 0, np.pi / 2, np.pi / 4])
DT = 1 / 240

# From Franka's documentation of its control interface, limits of the Panda: for each joint, and for
# translation and rotation of the hand.
JOINTS = [
    [2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61],
    [15, 7.5, 10, 12.5, 15, 20, 20],
    [7500, 3750, 5000, 6250, 7500, 10000, 10000],
]
HAND = [[1.7, 2.5], [13, 25], [6500, 12500]]

joint_positions = st.tuples(*(st.floats(a, b) for a, b in zip(JOINT_LOWER, JOINT_UPPER)))
bounds = st.floats(0.05, 50)


def move(start, goal, dt=DT, **scales):
    return timed(CubicSpline([0.0, 1.0], [start, goal]), dt, Limits(**scales))


def shares_of_limits(start, trajectory, dt=DT):
    """The largest share of each limit that references use: velocity, acceleration and jerk of the
    joints, and of the hand, by differences and the Jacobian."""
    path = np.vstack([start, trajectory.positions])
    joints = np.diff(path, axis=0) / dt
    middles = (path[1:] + path[:-1]) / 2
    twists = np.array([geometric_jacobian(q) @ v for q, v in zip(middles, joints)])
    shares = []
    for joint_limits, hand_limits in zip(JOINTS, HAND):
        hand = np.linalg.norm(twists.reshape(-1, 2, 3), axis=2)
        shares += [(abs(joints) / joint_limits).max(), (hand / hand_limits).max()]
        rest = np.zeros((1, 7)), np.zeros((1, 6))
        joints = np.diff(np.vstack([rest[0], joints, rest[0]]), axis=0) / dt
        twists = np.diff(np.vstack([rest[1], twists, rest[1]]), axis=0) / dt
    return np.array(shares)


@pytest.mark.parametrize(
    ("velocity", "acceleration", "jerk", "seconds"),
    [
        (0.5, 1.0, 10.0, 2.6),  # all bounds are reached: 1 / v + v / a + a / j
        (0.1, 10.0, 0.1, 12.0),  # the acceleration is not: 1 / v + 2 sqrt(v / j)
        (10.0, 1.0, 10.0, 0.1 + np.sqrt(4.01)),  # the velocity is not
        (10.0, 10.0, 0.5, 4.0),  # neither is: 4 cbrt(1 / (2 j))
    ],
)
def test_time_from_rest_to_rest_in_closed_form(velocity, acceleration, jerk, seconds):
    assert SCurve(velocity, acceleration, jerk).duration == pytest.approx(seconds)


@given(bounds, bounds, bounds)
@settings(max_examples=50, deadline=None)
def test_s_curves_equal_ruckigs(velocity, acceleration, jerk):
    ruckig = pytest.importorskip("ruckig")
    task = ruckig.InputParameter(1)
    task.target_position = [1.0]
    task.max_velocity, task.max_acceleration, task.max_jerk = [velocity], [acceleration], [jerk]
    reference = ruckig.Trajectory(1)
    ruckig.Ruckig(1).calculate(task, reference)
    curve = SCurve(velocity, acceleration, jerk)
    assert curve.duration == pytest.approx(reference.duration, rel=1e-6)
    times = np.linspace(0, curve.duration, 20)
    expected = [reference.at_time(t)[0][0] for t in times]
    np.testing.assert_allclose(curve(times), expected, atol=1e-6)


@given(joint_positions, joint_positions, st.sampled_from([DT, 0.001]))
@settings(max_examples=25, deadline=None)
def test_joint_moves_respect_every_limit(start, goal, dt):
    start, goal = np.array(start), np.array(goal)
    trajectory = move(start, goal, dt)
    np.testing.assert_allclose(trajectory.positions[-1], goal, atol=1e-9)
    assert (shares_of_limits(start, trajectory, dt) <= 1.0001).all()


@given(joint_positions)
@settings(max_examples=25, deadline=None)
def test_joint_moves_are_no_slower_than_they_have_to_be(goal):
    """A limit is touched, but for the part of a period by which the time is rounded up."""
    trajectory = move(HOME, np.array(goal))
    if len(trajectory) > 50:
        assert shares_of_limits(HOME, trajectory).max() > 0.93


@given(joint_positions, joint_positions, joint_positions, st.integers(0, 60))
@settings(max_examples=25, deadline=None)
def test_blended_moves_respect_every_limit(start, corner, goal, most):
    start, corner, goal = map(np.array, (start, corner, goal))
    first, second = move(start, corner), move(corner, goal)
    way = blended(start, first, second, DT, Limits(), most)
    saved = len(first) + len(second) - len(way)
    assert 0 <= saved <= most
    np.testing.assert_array_equal(
        way.positions[: len(first) - saved], first.positions[: len(first) - saved]
    )
    np.testing.assert_allclose(way.positions[-1], goal, atol=1e-9)
    assert (way.positions >= JOINT_LOWER).all() and (way.positions <= JOINT_UPPER).all()
    assert (shares_of_limits(start, way) <= 1.0001).all()


def test_moves_of_different_joints_are_blended_all_the_way():
    """Each may take a tenth of the limits, and both together two tenths."""
    slow = {"velocity_scale": 0.1, "acceleration_scale": 0.1}
    corner = HOME + np.array([0, 0, 0, 0, 0, 0, 0.5])
    goal = corner + np.array([0.1, 0, 0, 0, 0, 0, 0])
    first, second = move(HOME, corner, **slow), move(corner, goal, **slow)
    most = len(second) // 2
    way = blended(HOME, first, second, DT, Limits(velocity_scale=0.2, acceleration_scale=0.2), most)
    assert len(way) == len(first) + len(second) - most


def test_moves_that_may_not_be_blended_stop_at_the_corner():
    first, second = move(HOME, HOME + 0.3), move(HOME + 0.3, HOME)
    way = blended(HOME, first, second, DT, Limits(), most=0)
    np.testing.assert_allclose(way.positions, np.vstack([first.positions, second.positions]))


def test_a_joint_alone_takes_the_time_of_the_closed_form():
    goal = HOME + np.array([0, 0, 0, 0, 0, 0, 1.0])  # the hand turns by it, at 2.5 rad/s
    seconds = 1 / 2.5 + 2.5 / 20 + 20 / 10000
    assert len(move(HOME, goal)) == np.ceil(seconds / DT)


def test_where_nothing_moves_one_reference_is_enough():
    trajectory = move(HOME, HOME)
    np.testing.assert_array_equal(trajectory.positions, [HOME])
    np.testing.assert_array_equal(trajectory.velocities, np.zeros((1, 7)))


def test_scales_slow_down():
    fast = move(HOME, HOME + 0.5)
    slow = move(HOME, HOME + 0.5, velocity_scale=0.25, acceleration_scale=0.25)
    assert len(slow) >= 2 * len(fast) - 1
    assert shares_of_limits(HOME, slow)[:2].max() <= 0.2501
