"""The gates before the motors: their laws against hand computations, and what they refuse."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from envs.cell_scenes import make_scene
from envs.execution import check_tray, execute_grasp
from envs.grasping_env import RobotGraspingEnv
from envs.robot_kinematics import (
    JOINT_LOWER,
    JOINT_UPPER,
    JOINT_VELOCITY,
    forward_kinematics,
    geometric_jacobian,
    tip_position,
)
from envs.robot_safety import ArmGate, ArmStoppedError, SafetyGate, reaching_down
from envs.simulators import make_cell
from utils.config import load_config
from utils.errors import UserError
from utils.transforms import Grasp


def arm_gate(*overrides: str, floor: float = 0.009) -> ArmGate:
    config = load_config(None, overrides)
    made = ArmGate(config.safety, config.robot, DT, floor)
    made.restart(HOME)
    return made


@pytest.fixture(scope="module")
def narrow():
    """A cell whose workspace ends before the tray, which is 48 cm to the right."""
    config = load_config(None, ["sim.renderer=tiny", "safety.box_lower=[0.15,-0.3,0.02]"])
    with make_cell(config) as cell:
        yield cell


HOME = np.array([0, -np.pi / 4, 0, -3 * np.pi / 4, 0, np.pi / 2, np.pi / 4])


RADIUS, HEIGHT = 0.306891, 0.485282  # m, of E at home: from the base's axis, and above the table


DT = 1 / 240


@cache
def settings_of(*overrides):
    return load_config(None, overrides)


def gate(*overrides) -> SafetyGate:
    config = settings_of(*overrides)
    return SafetyGate(config.safety, config.robot, DT)


def passed(desired, *overrides, q=HOME, contact_force=0.0, age=0.0) -> np.ndarray:
    """What the gate lets pass of desired joint velocities that it does not refuse."""
    verdict = gate(*overrides).check(np.asarray(desired), q, contact_force, age)
    assert verdict.reason is None
    return verdict.velocity


def refusal(desired, *overrides, q=HOME, contact_force=0.0, age=0.0) -> str:
    """Why the gate stops the arm; the velocity is zero then."""
    verdict = gate(*overrides).check(np.asarray(desired), q, contact_force, age)
    np.testing.assert_array_equal(verdict.velocity, np.zeros(7))
    return verdict.reason


def joint(number: int, speed: float) -> np.ndarray:
    velocities = np.zeros(7)
    velocities[number - 1] = speed
    return velocities


def towards(v_W) -> np.ndarray:
    """(7,) joint velocities at home that move E with v_W (3,) and do not turn it."""
    return np.linalg.pinv(geometric_jacobian(HOME)) @ [*v_W, 0, 0, 0]


def test_the_tip_is_where_forward_kinematics_has_it():
    rng = np.random.default_rng(0)
    for q in rng.uniform(JOINT_LOWER, JOINT_UPPER, (50, 7)):
        np.testing.assert_allclose(
            tip_position(q.tolist()), forward_kinematics(q)[:3, 3], atol=1e-12
        )


def test_what_is_legal_passes_as_it_is():
    q, velocity = HOME + joint(1, 2.175 * DT), joint(1, 2.175)
    sent = arm_gate().passed(q, velocity)
    assert sent[0] is q and sent[1] is velocity


def test_a_command_that_is_too_fast_is_slowed_as_a_whole():
    # Joint 1 is asked for 4.35 rad/s, twice its limit, joint 5 for 1 rad/s: half of both.
    desired = joint(1, 4.35) + joint(5, 1.0)
    made = arm_gate()
    q, velocity = made.passed(HOME + DT * desired, desired)
    np.testing.assert_allclose(q, HOME + DT * desired / 2)
    np.testing.assert_allclose(velocity, desired / 2)
    # The next one is counted from what was sent: the other half of the way is just legal.
    np.testing.assert_allclose(
        made.passed(HOME + DT * desired, desired / 2)[0], HOME + DT * desired
    )
    # A jump of the reference counts even where the velocity of the command is harmless.
    q, _ = arm_gate("robot.velocity_scale=0.5").passed(HOME + joint(1, 0.1), np.zeros(7))
    np.testing.assert_allclose(q, HOME + joint(1, 2.175 / 2 * DT))


def test_joints_stay_within_their_limits_and_may_come_back():
    made, edge = arm_gate("safety.box_lower=[-2,-2,-2]", "safety.box_upper=[2,2,2]"), HOME.copy()
    edge[3] = JOINT_UPPER[3] - 0.001
    made.restart(edge)
    made.admit(edge + joint(4, 0.0005))
    with pytest.raises(ArmStoppedError, match=r"joint 4 would leave its limits \(-0.069 rad\)"):
        made.admit(edge + joint(4, 0.002))
    assert made.refusal(edge + joint(4, 0.0005)) is None, "a refused command is forgotten"
    edge[3] = JOINT_UPPER[3] + 0.05  # it was pushed out
    made.restart(edge)
    assert made.refusal(edge - joint(4, 0.01)) is None
    assert "joint 4" in made.refusal(edge + joint(4, 0.01))


@pytest.mark.parametrize("broken", [np.nan, np.inf])
def test_the_arm_gate_refuses_numbers_that_are_not_finite(broken):
    assert "joint 3" in arm_gate().refusal(HOME + joint(3, broken))
    for wrong in ((HOME + joint(3, broken), np.zeros(7)), (HOME, joint(3, broken))):
        with pytest.raises(ArmStoppedError, match="not finite"):
            arm_gate().passed(*wrong)


def test_the_tip_stays_in_the_box_and_may_come_back():
    # Turning about the base takes E to y = r sin(angle); the box ends at 5 cm and its tolerance.
    made = arm_gate("safety.box_upper=[0.8, 0.05, 0.8]")
    made.admit(HOME + joint(1, np.arcsin(0.0505 / RADIUS)))
    reason = made.refusal(HOME + joint(1, np.arcsin(0.052 / RADIUS)))
    assert reason == "the workspace ends here (y = 0.052 m)"
    made.restart(HOME + joint(1, 0.5))
    assert made.refusal(HOME + joint(1, 0.45)) is None
    assert "y = " in made.refusal(HOME + joint(1, 0.55))
    below = arm_gate(f"safety.box_lower=[0,-1,{HEIGHT + 0.01}]", floor=HEIGHT - 0.01)
    assert below.refusal(HOME) is None, "the floor of grasps is lower than the box of servo loops"


def test_the_open_loop_does_not_leave_the_workspace(narrow, box_set):
    narrow.load(make_scene("isolated", box_set, 0, narrow.config))
    T = narrow.object_pose(0)
    side = int(np.argmin(np.abs(T[2, :3])))
    angle, places = np.arctan2(T[1, side], T[0, side]), [0.0]
    narrow.on_step = lambda cell: places.append(cell.robot.tip_pose()[1, 3])
    outcome = execute_grasp(narrow, Grasp(np.array([*T[:2, 3], 0.03]), angle, 0.07, 1.0))
    narrow.on_step = None
    assert outcome.reason == "stopped"
    assert outcome.detail.startswith("stopped: the workspace ends here (y = -0.30")
    assert outcome.object_index == 0, "what was in the hand is named"
    # It was commanded to stop at the edge, 30 cm, at the carry's full speed of over 1 m/s, and
    # needs no longer way than with the hand's acceleration, 13 m/s2.
    speed = abs(np.diff(places)).max() / narrow.dt
    assert speed > 1.0 and -0.30 - speed**2 / (2 * 13) < min(places) < -0.30
    np.testing.assert_allclose(narrow.robot.q, narrow.home, atol=5e-3)


def test_a_box_without_the_tray_is_refused(narrow, config):
    check_tray(config)
    with pytest.raises(UserError, match=r"leaves out \[0.42, -0.48, 0.3\] m.*widen the box"):
        check_tray(narrow.config)
    high = ["execution.lift_height=0.3", "safety.box_upper=[0.8,0.55,0.44]"]
    with pytest.raises(UserError, match=r"leaves out \[0.42, -0.48, 0.45\] m"):
        check_tray(load_config(None, high))  # to which what may hang is lifted
    low = ["safety.box_lower=[0.15,-0.55,0.3]", "closed_loop.floor=0.009"]
    check_tray(load_config(None, low))  # planned motions reach down to the floor of grasps


def test_an_arm_stretched_at_the_edge_is_put_home(narrow, box_set):
    """Its elbow is bent by less than at its full reach, sqrt(0.316^2 + 0.0825^2) + sqrt(0.384^2 +
    0.0825^2) m at -0.467 rad: any way back to home, at -2.36 rad, leads through that reach."""
    narrow.load(make_scene("isolated", box_set, 0, narrow.config))
    stretched = np.array([0.142, 1.338, 0.036, -0.387, -0.039, 1.741, 0.330])

    def chase(cell, grasp):
        cell.robot.place(stretched)
        raise ArmStoppedError("the workspace ends here")

    outcome = execute_grasp(narrow, Grasp(np.array([0.5, 0, 0.03]), 0.0, 0.07, 1.0), chase)
    assert outcome.reason == "stopped"
    assert outcome.detail.endswith("no way home within the workspace, it was put there by hand")
    np.testing.assert_allclose(narrow.robot.q, narrow.home, atol=5e-3)


def test_a_contact_stops_the_open_loop_with_a_reason(narrow, box_set):
    narrow.load(make_scene("isolated", box_set, 0, narrow.config))
    place = narrow.object_position(0)
    place[2] = 0.02
    diagonal = np.arctan2(*narrow.object_pose(0)[1::-1, 0]) + np.pi / 4
    outcome = execute_grasp(narrow, Grasp(place, diagonal, 0.02, 1.0))  # onto the box from above
    assert outcome.reason == "collision"
    assert "allowed are 10.0 N" in outcome.detail


def test_the_environment_does_not_leave_the_workspace():
    config = load_config(None, ["sim.renderer=tiny", "safety.box_upper=[0.8,0.55,0.55]"])
    env = RobotGraspingEnv(config=config, observations=["state"], control="joint", objects="box")
    env.reset(seed=0)
    action = np.zeros(8, np.float32)
    action[3] = 1.0  # the elbow stretches, which raises the hand
    heights, reachable = [], []
    for _ in range(30):
        *_, info = env.step(action)
        heights.append(info["end_effector_position"][2])
        reachable.append(info["reachable"])
    assert reachable[0] and not reachable[-1]
    assert 0.52 < max(heights) < 0.555, "m"
    env.step(-action)
    assert env.step(-action)[-1]["reachable"], "the way back is open"
    env.close()


def test_a_home_outside_the_box_is_refused():
    """Home's fingertips are 0.485 m up: the arm could leave, and never come back."""
    config = load_config(None, ["sim.renderer=tiny", "safety.box_upper=[0.8,0.55,0.4]"])
    with pytest.raises(UserError, match="robot.home has the fingertips at .*0.485.* widen the box"):
        make_cell(config)


def test_a_harmless_velocity_passes_unchanged():
    desired = np.array([0.1, -0.05, 0.02, 0.1, -0.1, 0.05, 0.2])
    np.testing.assert_array_equal(passed(desired), desired)
    np.testing.assert_array_equal(passed(np.zeros(7)), np.zeros(7))


def test_joint_speeds_are_scaled_together():
    desired = np.array([0.435, -0.1, 0, 0.2, 0, 0, 0.05])
    # A tenth of 2.175 rad/s is half of the first joint's desired velocity.
    np.testing.assert_allclose(passed(desired, "robot.velocity_scale=0.1"), desired / 2)


def test_the_arm_speeds_up_and_slows_down_within_the_acceleration_limits():
    desired = np.array([0.2, -0.1, 0, 0.2, 0, 0, 0.05])
    # In 1/240 s joints 1, 2 and 4 may change by 15, 7.5 and 12.5 rad/s^2 times that, which are
    # shares of 0.3125, 0.3125 and 0.2604 of it: the last one applies to all joints.
    share = 12.5 / 240 / 0.2
    speed_up = gate().check(desired, HOME, 0.0, 0.0, np.zeros(7)).velocity
    np.testing.assert_allclose(speed_up, share * desired, rtol=1e-9)
    slow_down = gate().check(np.zeros(7), HOME, 0.0, 0.0, desired).velocity
    np.testing.assert_allclose(slow_down, (1 - share) * desired, rtol=1e-9)
    near = desired + 0.01
    np.testing.assert_allclose(gate().check(near, HOME, 0.0, 0.0, desired).velocity, near)
    half = gate("robot.acceleration_scale=0.5").check(desired, HOME, 0.0, 0.0, np.zeros(7)).velocity
    np.testing.assert_allclose(half, share / 2 * desired, rtol=1e-9)


def test_a_velocity_that_leads_back_is_no_reason_to_stop():
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


def test_a_joint_brakes_before_its_limit_and_takes_the_others_along():
    q = HOME.copy()
    q[6] = JOINT_UPPER[6] - 0.02 - 0.002  # 2 mrad before the margin; 20 rad/s^2
    desired = joint(7, 0.9) + joint(1, 0.3)
    share = np.sqrt(2 * 20.0 * 0.002) / 0.9  # 0.283 rad/s are allowed
    np.testing.assert_allclose(passed(desired, q=q), share * desired, rtol=1e-9)
    # Away from the limit nothing holds it back.
    np.testing.assert_array_equal(passed(-desired, q=q), -desired)
    # Very near, the next period must not cross the limit: 0.1 mrad in 1/240 s.
    q[6] = JOINT_UPPER[6] - 0.02 - 1e-4
    np.testing.assert_allclose(passed(desired, q=q), 1e-4 / DT / 0.9 * desired, rtol=1e-9)


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
    desired = towards(0.2 * direction)
    for room, allowed in ((0.002, np.sqrt(2 * 6.5 * 0.002)), (1e-4, 1e-4 / DT)):
        box[(sign + 1) // 2, axis] = place + sign * room
        sides = [f"safety.box_{n}={b.tolist()}" for n, b in zip(("lower", "upper"), box)]
        np.testing.assert_allclose(
            geometric_jacobian(HOME)[:3] @ passed(desired, *sides), allowed * direction,
            rtol=0.02, atol=1e-9,  # the place of E above is rounded to 1 um
        )  # fmt: skip
        np.testing.assert_allclose(passed(-desired, *sides), -desired)
    box[(sign + 1) // 2, axis] = place - sign * 0.01  # it is outside
    sides = [f"safety.box_{n}={b.tolist()}" for n, b in zip(("lower", "upper"), box)]
    assert f"the workspace ends here ({'xyz'[axis]} = " in refusal(desired, *sides)
    np.testing.assert_allclose(passed(-desired, *sides), -desired)


def test_old_perception_means_zero_velocity():
    desired = joint(1, 0.1)
    np.testing.assert_array_equal(passed(desired, age=0.1), desired)
    assert refusal(desired, age=0.105) == (
        "what was seen last is 105 ms old, the watchdog allows 100 ms"
    )
    assert "watchdog" in refusal(desired, "safety.watchdog=0.05", age=0.06)
    assert "watchdog" in refusal(desired, age=np.inf)
    assert "watchdog" in refusal(desired, age=np.nan)


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
def test_whatever_passes_keeps_every_limit_and_its_direction(q, desired, scale):
    q, desired = np.array(q), np.array(desired)
    lower, upper = [-0.9, -0.9, 0.0], [0.9, 0.9, 1.2]
    tip, J = forward_kinematics(q)[:3, 3], geometric_jacobian(q)
    assume(((tip > lower) & (tip < upper)).all())
    verdict = gate(
        f"robot.velocity_scale={scale}", f"safety.box_lower={lower}", f"safety.box_upper={upper}",
    ).check(desired, q, 0.0, 0.0)  # fmt: skip
    v = verdict.velocity
    assert (verdict.reason is None) or not v.any()
    assert np.dot(v, desired) >= 0
    np.testing.assert_allclose(np.linalg.norm(v) * desired, np.linalg.norm(desired) * v, atol=1e-9)
    assert (np.abs(v) <= scale * JOINT_VELOCITY * (1 + 1e-9)).all()
    assert (q + DT * v >= JOINT_LOWER + 0.02 - 1e-12).all()
    assert (q + DT * v <= JOINT_UPPER - 0.02 + 1e-12).all()
    twist = J @ v
    assert np.linalg.norm(twist[:3]) <= 0.25 * (1 + 1e-9)
    assert np.linalg.norm(twist[3:]) <= 1.0 + 1e-9
    after = tip + DT * twist[:3]
    assert (after >= np.array(lower) - 1e-12).all() and (after <= np.array(upper) + 1e-12).all()


def test_settings_that_make_no_sense_are_refused():
    with pytest.raises(UserError, match="box_lower must be below box_upper"):
        load_config(None, ["safety.box_lower=[0.9,0,0]"])
    for key in "watchdog", "linear_speed", "angular_speed", "contact_stop":
        with pytest.raises(UserError, match=f"safety.{key}"):
            load_config(None, [f"safety.{key}=0"])


def test_a_velocity_beyond_its_limit_is_slowed_down_where_the_reference_stands_still():
    one = arm_gate()
    _, velocity = one.passed(HOME, 2 * np.array(one.speeds))
    np.testing.assert_allclose(velocity, one.speeds)


def test_a_box_that_reaches_lower_than_the_floor_stays_as_it_is():
    safety = settings_of("safety.box_lower=[0.15,-0.5,-0.1]").safety
    assert reaching_down(safety, 0.0).box_lower == (0.15, -0.5, -0.1)
    assert reaching_down(safety, -0.2).box_lower == (0.15, -0.5, -0.2)


def test_an_arm_that_has_come_back_into_its_box_may_not_leave_it_again():
    """E is at a height of 0.485 m at home, over a box that ends at 0.48."""
    one = arm_gate("safety.box_upper=[0.80,0.55,0.48]")
    lower = HOME + np.linalg.pinv(geometric_jacobian(HOME)[:3]) @ (0, 0, -0.02)
    assert tip_position(lower.tolist())[2] < 0.475
    one.admit(HOME)  # outside, but no farther
    one.admit(lower)
    with pytest.raises(ArmStoppedError):
        one.admit(HOME)
