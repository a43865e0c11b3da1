"""The gate that every command to the motors passes: by hand, and on the open loop and the env."""

from __future__ import annotations

import numpy as np
import pytest

from envs.cell_scenes import make_scene
from envs.execution import check_bin, execute_grasp
from envs.grasping_env import RobotGraspingEnv
from envs.pybullet_cell import PybulletCell
from envs.robot_kinematics import JOINT_LOWER, JOINT_UPPER, forward_kinematics, tip_position
from envs.robot_safety import ArmGate, ArmStoppedError
from utils.config import load_config
from utils.errors import UserError
from utils.transforms import Grasp

DT = 1 / 240
HOME = np.array([0, -np.pi / 4, 0, -3 * np.pi / 4, 0, np.pi / 2, np.pi / 4])
RADIUS, HEIGHT = 0.306891, 0.485282  # m, of E at HOME from the base's axis and above the table


def gate(*overrides: str, floor: float = 0.009) -> ArmGate:
    config = load_config(None, overrides)
    made = ArmGate(config.safety, config.robot, DT, floor)
    made.restart(HOME)
    return made


def joint(number: int, value: float) -> np.ndarray:
    values = np.zeros(7)
    values[number - 1] = value
    return values


def test_the_tip_is_where_forward_kinematics_has_it():
    rng = np.random.default_rng(0)
    for q in rng.uniform(JOINT_LOWER, JOINT_UPPER, (50, 7)):
        np.testing.assert_allclose(
            tip_position(q.tolist()), forward_kinematics(q)[:3, 3], atol=1e-12
        )


def test_what_is_legal_passes_as_it_is():
    q, velocity = HOME + joint(1, 2.175 * DT), joint(1, 2.175)
    sent = gate().passed(q, velocity)
    assert sent[0] is q and sent[1] is velocity


def test_a_command_that_is_too_fast_is_slowed_as_a_whole():
    # Joint 1 is asked for 4.35 rad/s, twice its limit, joint 5 for 1 rad/s: half of both.
    wish = joint(1, 4.35) + joint(5, 1.0)
    made = gate()
    q, velocity = made.passed(HOME + DT * wish, wish)
    np.testing.assert_allclose(q, HOME + DT * wish / 2)
    np.testing.assert_allclose(velocity, wish / 2)
    # The next one is counted from what was sent: the other half of the way is just legal.
    np.testing.assert_allclose(made.passed(HOME + DT * wish, wish / 2)[0], HOME + DT * wish)
    # A jump of the reference counts even where the velocity that is told is harmless.
    q, _ = gate("robot.velocity_scale=0.5").passed(HOME + joint(1, 0.1), np.zeros(7))
    np.testing.assert_allclose(q, HOME + joint(1, 2.175 / 2 * DT))


def test_joints_stay_within_their_limits_and_may_come_back():
    made, edge = gate("safety.box_lower=[-2,-2,-2]", "safety.box_upper=[2,2,2]"), HOME.copy()
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
def test_numbers_that_are_not_finite_go_nowhere(broken):
    assert "joint 3" in gate().refusal(HOME + joint(3, broken))
    for wrong in ((HOME + joint(3, broken), np.zeros(7)), (HOME, joint(3, broken))):
        with pytest.raises(ArmStoppedError, match="not finite"):
            gate().passed(*wrong)


def test_the_tip_stays_in_the_box_and_may_come_back():
    # Turning about the base takes E to y = r sin(angle); the box ends at 5 cm and its tolerance.
    made = gate("safety.box_upper=[0.8, 0.05, 0.8]")
    made.admit(HOME + joint(1, np.arcsin(0.0505 / RADIUS)))
    reason = made.refusal(HOME + joint(1, np.arcsin(0.052 / RADIUS)))
    assert reason == "the workspace ends here (y = 0.052 m)"
    made.restart(HOME + joint(1, 0.5))
    assert made.refusal(HOME + joint(1, 0.45)) is None
    assert "y = " in made.refusal(HOME + joint(1, 0.55))
    below = gate(f"safety.box_lower=[0,-1,{HEIGHT + 0.01}]", floor=HEIGHT - 0.01)
    assert below.refusal(HOME) is None, "the floor of grasps is lower than the box of servo loops"


@pytest.fixture(scope="module")
def narrow():
    """A cell whose workspace ends before the bin, which is 48 cm to the right."""
    config = load_config(None, ["sim.renderer=tiny", "safety.box_lower=[0.15,-0.3,0.02]"])
    with PybulletCell(config) as cell:
        yield cell


def test_the_open_loop_does_not_leave_the_workspace(narrow, box_set):
    narrow.load(make_scene("isolated", box_set, 0, narrow.config))
    T = narrow.object_pose(0)
    side = int(np.argmin(np.abs(T[2, :3])))
    angle, lowest = np.arctan2(T[1, side], T[0, side]), [0.0]
    narrow.on_step = lambda cell: lowest.append(cell.robot.tip_pose()[1, 3])
    outcome = execute_grasp(narrow, Grasp(np.array([*T[:2, 3], 0.03]), angle, 0.07, 1.0))
    narrow.on_step = None
    assert outcome.reason == "stopped"
    assert outcome.detail.startswith("stopped: the workspace ends here (y = -0.30")
    assert outcome.object_index == 0, "what was in the hand is named"
    # It was told to hold still at the edge, 30 cm, at the carry's full speed of over 1 m/s.
    assert -0.32 < min(lowest) < -0.30
    np.testing.assert_allclose(narrow.robot.q, narrow.home, atol=5e-3)


def test_a_box_without_the_bin_is_refused(narrow, config):
    check_bin(config)
    with pytest.raises(UserError, match=r"leaves out \[0.42, -0.48, 0.25\] m.*widen the box"):
        check_bin(narrow.config)
    low = ["safety.box_lower=[0.15,-0.55,0.3]", "closed_loop.floor=0.009"]
    check_bin(load_config(None, low))  # planned motions reach down to the floor of grasps


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
        PybulletCell(config)
