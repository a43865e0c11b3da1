"""What the robot feels: forces on its hand, and whether something is between its fingers, in every
simulator that is installed."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.show_bar import grip, solid
from envs.cell import Cell
from envs.cell_layout import EMPTY
from envs.object_shapes import NativeShape
from envs.robot_kinematics import JOINT_VELOCITY, choose_posture, forward_kinematics
from envs.robot_motion import Trajectory
from envs.simulators import make_cell
from tests.helpers.simulators import INSTALLED, is_pybullet, pybullet
from utils.transforms import top_down_pose


@pytest.fixture(scope="module", params=INSTALLED)
def cell(request, config):
    with make_cell(config.model_copy(update={"simulator": request.param})) as cell:
        yield cell


def push(cell: Cell, force: np.ndarray) -> None:
    """Press on the hand at E with `force` (3,) N for the next physics step."""
    robot, at = cell.robot, cell.robot.tip_pose()[:3, 3]
    if is_pybullet(cell):
        pybullet.applyExternalForce(
            robot.body, 6, force, at, pybullet.WORLD_FRAME, physicsClientId=cell.client
        )
        return
    import mujoco

    body = robot.data.body("panda_link7")
    robot.data.xfrc_applied[body.id, :3] = force
    robot.data.xfrc_applied[body.id, 3:] = np.cross(at - robot.data.xipos[body.id], force)
    mujoco.mj_forward(robot.model, robot.data)


@pytest.mark.parametrize("force", [[20.0, 0, 0], [0, -20.0, 0], [0, 0, 20.0], [3.0, 4.0, 12.0]])
def test_a_push_at_the_fingertips_is_felt(cell, force):
    cell.build(EMPTY)
    felt = []
    for _ in range(60):
        push(cell, np.array(force))
        cell.step()
        felt.append(cell.robot.external_force())
    assert np.median(felt[30:]) == pytest.approx(np.linalg.norm(force), rel=0.02)


def felt_on(cell: Cell, trajectory: Trajectory) -> list[float]:
    felt = []
    for q, velocity in zip(trajectory.positions, trajectory.velocities):
        cell.robot.command_arm(q, velocity)
        cell.step()
        felt.append(cell.robot.external_force())
    return felt


def test_nothing_is_felt_where_nothing_touches(cell):
    """On a quick way there and back: the nominal robot explains all torques."""
    cell.build(EMPTY)
    start = cell.robot.q
    goal = choose_posture(top_down_pose([0.55, -0.2, 0.2], 0.7), cell.home)
    for there in (cell.robot.joint_move(start, goal), cell.robot.joint_move(goal, start)):
        assert max(felt_on(cell, there)) < 1.0


def test_nothing_is_felt_at_the_highest_speed(cell):
    """The hand turns as fast as it may, for a moment: v = v_max sin2(pi t / T). A speed limit for
    `drive_arm_to` does not cut it off, which would feel like a contact."""
    cell.build(EMPTY)
    cell.robot.limit_speed(1.0)
    T, fastest = 1.5, -JOINT_VELOCITY[6]
    t = np.arange(cell.dt, T, cell.dt)
    positions, velocities = np.tile(cell.robot.q, (len(t), 1)), np.zeros((len(t), 7))
    velocities[:, 6] = 0.999 * fastest * np.sin(np.pi * t / T) ** 2
    positions[:, 6] += 0.999 * fastest * (t / 2 - T / (4 * np.pi) * np.sin(2 * np.pi * t / T))
    assert max(felt_on(cell, Trajectory(positions, velocities))) < 1.0
    cell.robot.limit_speed(JOINT_VELOCITY.max())


def test_joint_damping_is_not_felt(cell):
    """0.5 N m s/rad, the most that is randomised, which joints at 2 rad/s would feel as 1 N m."""
    cell.build(EMPTY)
    cell.randomizable().apply({"joint_damping": ("add", [0.5] * 7)})
    goal = choose_posture(top_down_pose([0.55, -0.2, 0.2], 0.7), cell.home)
    assert max(felt_on(cell, cell.robot.joint_move(cell.robot.q, goal))) < 1.0


@pytest.mark.parametrize("mass", [0.2, 0.6])
def test_a_held_weight_is_felt(cell, box_set, mass):
    grip(cell, solid(box_set[0], NativeShape("box", (0.04, 0.03, 0.04)), mass, 0.8), 60.0)
    felt = []
    for _ in range(240):
        cell.step()
        felt.append(cell.robot.external_force())
    assert np.mean(felt[120:]) == pytest.approx(9.81 * mass, rel=0.05)
    assert cell.robot.grips()


def test_a_first_question_and_one_after_a_pause_feel_nothing_in_pybullet(cell):
    if not is_pybullet(cell):
        pytest.skip("MuJoCo keeps the last step's accelerations")
    cell.build(EMPTY)
    np.testing.assert_array_equal(cell.robot.external_torques(), np.zeros(7))
    cell.step(2)
    np.testing.assert_array_equal(cell.robot.external_torques(), np.zeros(7))
    cell.step()
    assert cell.robot.external_torques().any()


def test_who_asks_twice_in_a_step_is_told_the_same(cell):
    cell.build(EMPTY)
    for _ in range(2):
        push(cell, np.array([20.0, 0.0, 0.0]))
        cell.step()
        felt = [cell.robot.external_force() for _ in range(2)]
    assert felt[0] == felt[1] > 10.0


@pytest.mark.parametrize("thickness", [0.003, 0.06])
def test_fingers_that_something_keeps_apart_grip(cell, box_set, thickness):
    grip(cell, solid(box_set[0], NativeShape("box", (0.04, thickness, 0.04)), 0.1, 0.5), 10.0)
    cell.step(120)
    assert cell.robot.grips()


@pytest.mark.parametrize("thickness, grips", [(0.006, False), (0.01, True)])
def test_a_nearly_closed_hand_may_count_as_empty(cell, box_set, monkeypatch, thickness, grips):
    grip(cell, solid(box_set[0], NativeShape("box", (0.04, thickness, 0.04)), 0.1, 0.5), 10.0)
    monkeypatch.setattr(cell.robot, "gripper", replace(cell.robot.gripper, least_held=0.008))
    cell.step(120)
    assert cell.robot.grips() == grips


def test_fingers_that_close_on_nothing_or_move_do_not_grip(cell):
    cell.build(EMPTY)
    cell.robot.command_gripper(0.0)
    cell.step(60)
    assert cell.robot.opening > 0.01 and not cell.robot.grips()  # on their way
    cell.step(300)
    assert not cell.robot.grips()
    cell.robot.open_gripper()
    cell.step(60)
    assert not cell.robot.grips()
    cell.step(300)
    assert forward_kinematics(cell.robot.q)[2, 3] > 0.1 and not cell.robot.grips()


def test_an_object_that_is_pulled_out_is_missed(cell, box_set):
    grip(cell, solid(box_set[0], NativeShape("box", (0.04, 0.03, 0.04)), 0.1, 0.5), 10.0)
    assert cell.robot.grips()
    T_WO = cell.object_pose(0)
    T_WO[2, 3] -= 0.2
    cell.carry(0, T_WO, np.zeros(3), 0.0)
    cell.step(240)
    assert not cell.robot.grips()
