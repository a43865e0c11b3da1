"""The safety gate: its laws against hand computations, and what it refuses."""

from functools import cache

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from envs.robot_kinematics import (
    JOINT_LOWER,
    JOINT_UPPER,
    JOINT_VELOCITY,
    forward_kinematics,
    geometric_jacobian,
)
from envs.robot_safety import SafetyGate
from utils.config import load_config
from utils.errors import UserError

HOME = np.array([0, -np.pi / 4, 0, -3 * np.pi / 4, 0, np.pi / 2, np.pi / 4])
RADIUS, HEIGHT = 0.306891, 0.485282  # m, of E at home: from the base's axis, and above the table
DT = 1 / 240


@cache
def settings_of(*overrides):
    return load_config(None, overrides)


def gate(*overrides, **options) -> SafetyGate:
    config = settings_of(*overrides)
    return SafetyGate(config.safety, config.robot, DT, **options)


def passed(wish, *overrides, q=HOME, contact_force=0.0, age=0.0, **options) -> np.ndarray:
    """What the gate lets pass of a wish that it does not refuse."""
    verdict = gate(*overrides, **options).check(np.asarray(wish), q, contact_force, age)
    assert verdict.reason is None
    return verdict.velocity


def refusal(wish, *overrides, q=HOME, contact_force=0.0, age=0.0) -> str:
    """Why the gate stops the arm; the velocity is zero then."""
    verdict = gate(*overrides).check(np.asarray(wish), q, contact_force, age)
    np.testing.assert_array_equal(verdict.velocity, np.zeros(7))
    return verdict.reason


def joint(number: int, speed: float) -> np.ndarray:
    velocities = np.zeros(7)
    velocities[number - 1] = speed
    return velocities


def towards(v_W) -> np.ndarray:
    """(7,) joint velocities at home that move E with v_W (3,) and do not turn it."""
    return np.linalg.pinv(geometric_jacobian(HOME)) @ [*v_W, 0, 0, 0]


def test_a_harmless_wish_passes_unchanged():
    wish = np.array([0.1, -0.05, 0.02, 0.1, -0.1, 0.05, 0.2])
    np.testing.assert_array_equal(passed(wish), wish)
    np.testing.assert_array_equal(passed(np.zeros(7)), np.zeros(7))


def test_joint_speeds_are_scaled_together():
    wish = np.array([0.435, -0.1, 0, 0.2, 0, 0, 0.05])
    # A tenth of 2.175 rad/s is half of the first joint's wish.
    np.testing.assert_allclose(passed(wish, "robot.velocity_scale=0.1"), wish / 2)


def test_the_arm_speeds_up_and_slows_down_within_the_acceleration_limits():
    wish = np.array([0.2, -0.1, 0, 0.2, 0, 0, 0.05])
    # In 1/240 s joints 1, 2 and 4 may change by 15, 7.5 and 12.5 rad/s^2 times that, which are
    # shares of 0.3125, 0.3125 and 0.2604 of this wish: the last one is everybody's.
    share = 12.5 / 240 / 0.2
    speed_up = gate().check(wish, HOME, 0.0, 0.0, np.zeros(7)).velocity
    np.testing.assert_allclose(speed_up, share * wish, rtol=1e-9)
    slow_down = gate().check(np.zeros(7), HOME, 0.0, 0.0, wish).velocity
    np.testing.assert_allclose(slow_down, (1 - share) * wish, rtol=1e-9)
    near = wish + 0.01
    np.testing.assert_allclose(gate().check(near, HOME, 0.0, 0.0, wish).velocity, near)
    half = gate("robot.acceleration_scale=0.5").check(wish, HOME, 0.0, 0.0, np.zeros(7)).velocity
    np.testing.assert_allclose(half, share / 2 * wish, rtol=1e-9)


def test_a_wish_to_come_back_is_no_reason_to_stop():
    q = HOME.copy()
    q[6] = JOINT_UPPER[6] - 0.02  # at the limit, and still going there
    verdict = gate().check(joint(7, -0.5), q, 0.0, 0.0, joint(7, 0.5))
    assert verdict.reason is None
    np.testing.assert_array_equal(verdict.velocity, joint(7, -0.5))


def test_linear_speed_of_the_fingertips():
    # Turning about the base, E goes round a circle: 0.25 m/s are 0.25 / r rad/s.
    np.testing.assert_allclose(passed(joint(1, 0.9)), joint(1, 0.25 / RADIUS), rtol=1e-5)


def test_angular_speed_of_the_hand():
    # E lies on the last joint's axis, so nothing but the angle counts.
    np.testing.assert_allclose(passed(joint(7, -2.5)), joint(7, -1.0), rtol=1e-9)


def test_linear_speed_of_what_is_carried():
    # A point 0.5 m beside the last joint's axis moves with 0.4 m/s at 0.8 rad/s.
    carried = np.array([[0, 0, 0], [0.5, 0, 0]])
    velocity = passed(joint(7, 0.8), "safety.box_lower=[-1,-1,0]", guarded_E=carried)
    np.testing.assert_allclose(velocity, joint(7, 0.5), rtol=1e-9)


def test_a_joint_brakes_before_its_limit_and_takes_the_others_along():
    q = HOME.copy()
    q[6] = JOINT_UPPER[6] - 0.02 - 0.002  # 2 mrad before the margin; 20 rad/s^2
    wish = joint(7, 0.9) + joint(1, 0.3)
    share = np.sqrt(2 * 20.0 * 0.002) / 0.9  # 0.283 rad/s are allowed
    np.testing.assert_allclose(passed(wish, q=q), share * wish, rtol=1e-9)
    np.testing.assert_array_equal(passed(-wish, q=q), -wish)  # away from it nothing holds it back
    # Very near, the next period must not cross the limit: 0.1 mrad in 1/240 s.
    q[6] = JOINT_UPPER[6] - 0.02 - 1e-4
    np.testing.assert_allclose(passed(wish, q=q), 1e-4 / DT / 0.9 * wish, rtol=1e-9)


def test_a_joint_at_its_limit_stops_the_arm_and_may_come_back():
    q = HOME.copy()
    q[3] = JOINT_UPPER[3] - 0.02
    assert "joint 4 is at its limit (-0.090 rad)" in refusal(joint(4, 0.1), q=q)
    q[3] += 0.01  # wherever it came from
    assert "joint 4" in refusal(joint(4, 0.1) + joint(1, 0.2), q=q)
    np.testing.assert_array_equal(passed(joint(4, -0.1), "safety.box_upper=[2,2,2]", q=q),
                                  joint(4, -0.1))  # fmt: skip


@pytest.mark.parametrize(
    ("axis", "sign", "place"), [(0, 1, RADIUS), (0, -1, RADIUS), (1, 1, 0), (1, -1, 0),
                                (2, 1, HEIGHT), (2, -1, HEIGHT)],
)  # fmt: skip
def test_the_arm_brakes_before_each_side_of_the_box(axis, sign, place):
    box = np.array([[-1.0, -1, -1], [1, 1, 1]])
    direction = sign * np.eye(3)[axis]
    wish = towards(0.2 * direction)
    for room, allowed in ((0.002, np.sqrt(2 * 6.5 * 0.002)), (1e-4, 1e-4 / DT)):
        box[(sign + 1) // 2, axis] = place + sign * room
        sides = [f"safety.box_{n}={b.tolist()}" for n, b in zip(("lower", "upper"), box)]
        np.testing.assert_allclose(
            geometric_jacobian(HOME)[:3] @ passed(wish, *sides), allowed * direction,
            rtol=0.02, atol=1e-9,  # the place of E above is rounded to 1 um
        )  # fmt: skip
        np.testing.assert_allclose(passed(-wish, *sides), -wish)
    box[(sign + 1) // 2, axis] = place - sign * 0.01  # it is outside
    sides = [f"safety.box_{n}={b.tolist()}" for n, b in zip(("lower", "upper"), box)]
    assert f"the workspace ends here ({'xyz'[axis]} = " in refusal(wish, *sides)
    np.testing.assert_allclose(passed(-wish, *sides), -wish)


def test_old_perception_means_zero_velocity():
    wish = joint(1, 0.1)
    np.testing.assert_array_equal(passed(wish, age=0.1), wish)
    assert refusal(wish, age=0.105) == (
        "what was seen last is 105 ms old, the watchdog allows 100 ms"
    )
    assert "watchdog" in refusal(wish, "safety.watchdog=0.05", age=0.06)
    assert "watchdog" in refusal(wish, age=np.inf)
    assert "watchdog" in refusal(wish, age=np.nan)


def test_contact_stops_the_arm():
    np.testing.assert_array_equal(passed(joint(1, 0.1), contact_force=10.0), joint(1, 0.1))
    assert "contact with 12.0 N" in refusal(joint(1, 0.1), contact_force=12.0)
    assert "contact" in refusal(joint(1, 0.1), contact_force=np.nan)


@pytest.mark.parametrize("broken", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_not_finite_go_nowhere(broken):
    assert "finite" in refusal(joint(3, broken))
    assert "finite" in refusal(joint(3, 0.1), q=HOME + joint(2, broken))


@settings(max_examples=200)
@given(
    st.tuples(*(st.floats(a + 0.02, b - 0.02) for a, b in zip(JOINT_LOWER, JOINT_UPPER))),
    st.tuples(*[st.floats(-5, 5)] * 7),
    st.sampled_from([0.1, 0.5, 1.0]),
)
def test_whatever_passes_keeps_every_limit_and_its_direction(q, wish, scale):
    q, wish = np.array(q), np.array(wish)
    lower, upper, guarded = [-0.9, -0.9, 0.0], [0.9, 0.9, 1.2], np.eye(3) * 0.1
    T, J = forward_kinematics(q), geometric_jacobian(q)
    points = T[:3, 3] + guarded @ T[:3, :3].T
    assume(((points > lower) & (points < upper)).all())
    verdict = gate(
        f"robot.velocity_scale={scale}", f"safety.box_lower={lower}", f"safety.box_upper={upper}",
        guarded_E=guarded,
    ).check(wish, q, 0.0, 0.0)  # fmt: skip
    v = verdict.velocity
    assert (verdict.reason is None) or not v.any()
    assert np.dot(v, wish) >= 0
    np.testing.assert_allclose(np.linalg.norm(v) * wish, np.linalg.norm(wish) * v, atol=1e-9)
    assert (np.abs(v) <= scale * JOINT_VELOCITY * (1 + 1e-9)).all()
    assert (q + DT * v >= JOINT_LOWER + 0.02 - 1e-12).all()
    assert (q + DT * v <= JOINT_UPPER - 0.02 + 1e-12).all()
    twist = J @ v
    speeds = twist[:3] + np.cross(twist[3:], points - T[:3, 3])
    assert np.linalg.norm(speeds, axis=1).max() <= 0.25 * (1 + 1e-9)
    assert np.linalg.norm(twist[3:]) <= 1.0 + 1e-9
    after = points + DT * speeds
    assert (after >= np.array(lower) - 1e-12).all() and (after <= np.array(upper) + 1e-12).all()


def test_settings_that_make_no_sense_are_refused():
    with pytest.raises(UserError, match="box_lower must be below box_upper"):
        load_config(None, ["safety.box_lower=[0.9,0,0]"])
    for key in "watchdog", "linear_speed", "angular_speed", "contact_stop":
        with pytest.raises(UserError, match=f"safety.{key}"):
            load_config(None, [f"safety.{key}=0"])
    for points in np.zeros((0, 3)), np.zeros(3), np.zeros((2, 2)):
        with pytest.raises(UserError, match="guarded_E"):
            gate(guarded_E=points)
