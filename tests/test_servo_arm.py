"""What the gate does to constant velocities: box, joint limits and contact."""

from __future__ import annotations

import numpy as np
import pytest

from envs.cell_layout import Scene
from envs.robot_kinematics import JOINT_UPPER, forward_kinematics
from envs.robot_safety import ArmStoppedError
from envs.servo_arm import ServoArm
from envs.simulators import cell_class
from tests.helpers.simulators import INSTALLED, is_pybullet, needs_pybullet, pybullet
from utils.config import load_config


@pytest.fixture(scope="module", params=INSTALLED)
def cell(request, config):
    with cell_class(request.param)(config) as cell:
        yield cell


def empty(cell, *overrides):
    """The cell without objects, under other settings."""
    cell.config = load_config(None, ["sim.renderer=tiny", *overrides])
    cell.build(Scene("isolated", 0, ()))
    return cell


def drive(cell, desired, seconds=3.0):
    """The reason for which a constant desired (7,) was stopped, and E's path (k, 3)."""
    arm, path = ServoArm(cell), []
    with pytest.raises(ArmStoppedError) as stopped:
        for _ in range(round(seconds / cell.dt)):
            path.append(forward_kinematics(cell.robot.q)[:3, 3])
            arm.move(desired, 0.0)
    arm.stop()
    path.append(forward_kinematics(cell.robot.q)[:3, 3])
    if not is_pybullet(cell):  # its servos come to rest with a time constant of 0.1 s
        cell.step(round(0.1 / cell.dt))
    assert abs(cell.robot.joint_state()[1]).max() < 1e-3
    return str(stopped.value), np.array(path)


def test_the_arm_does_not_leave_its_box(cell):
    empty(cell, "safety.box_upper=[0.8,0.1,0.8]")
    reason, path = drive(cell, np.array([0.8, 0, 0, 0, 0, 0, 0]))
    assert reason.startswith("the workspace ends here (y = 0.")
    assert 0.098 < path[:, 1].max() < 0.1005


def test_the_arm_does_not_run_into_a_joint_limit(cell):
    empty(cell)
    reason, _ = drive(cell, np.array([0, 0, 0, 0, 0, 0, 0.9]))
    assert reason.startswith("joint 7 is at its limit")
    assert JOINT_UPPER[6] - 0.022 < cell.robot.q[6] < JOINT_UPPER[6] - 0.019


@needs_pybullet
def test_contact_stops_the_arm(bullet_cell):
    from envs.pybullet_bodies import static_box

    cell = empty(bullet_cell)
    wall = static_box(cell.client, [0.1, 0.01, 0.3], [0.35, 0.15, 0.3], (0.5, 0.5, 0.5, 1))
    reason, _ = drive(cell, np.array([0.6, 0, 0, 0, 0, 0, 0]))
    assert reason.startswith("contact with ")
    nearest = pybullet.getClosestPoints(cell.robot.body, wall, 0.1, physicsClientId=cell.client)
    assert min(point[8] for point in nearest) > -0.002  # it did not go on into the wall
