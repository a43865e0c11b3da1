"""The arm servoes to a board: the final pose in both mountings, and what stops it."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.bench_servo_cell import LAWS, make_task
from envs.board import Board
from envs.board_servo import Sight, servo_settings, servo_to_goal, view_of
from envs.pybullet_bodies import static_box
from envs.pybullet_cell import PybulletCell
from envs.robot_kinematics import forward_kinematics
from envs.robot_safety import ArmStoppedError
from utils.errors import TargetLostError, UserError
from utils.servo_features import MOUNTINGS
from utils.transforms import transform_points

BOARD = Board()
MARKERS = BOARD.points * 4 / 7  # their middles: 4 cells from the board's, the corners are 7


@pytest.fixture(scope="module")
def cell(config):
    with PybulletCell(config) as cell:
        yield cell


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("mounting", MOUNTINGS)
def test_the_arm_ends_at_the_goal(cell, config, mounting, law):
    cell.config = config
    task = make_task(cell, mounting, seed=list(LAWS).index(law))
    history = task.run(law)
    position, angle = task.errors()
    assert history.converged and position < 0.5 and angle < 0.5
    assert history.times[-1] < 5.0
    assert abs(cell.robot.joint_state()[1]).max() < 1e-3  # at rest


@pytest.mark.slow
@pytest.mark.parametrize("law", ["image_based", "position_based", "hybrid_2.5d"])
@pytest.mark.parametrize("mounting", MOUNTINGS)
def test_the_arm_ends_at_the_goal_from_other_starts(cell, config, mounting, law):
    cell.config = config
    for seed in (10, 11):
        task = make_task(cell, mounting, seed)
        assert task.run(law).converged
        assert max(task.errors()) < 0.5


def exact_camera(task, servo):
    """Sees the board where it is; for tests that are not about images."""
    return lambda: Sight(view_of(task.board, servo.camera, task.true_pose()), task.cell.seconds)


@pytest.mark.parametrize("mounting", MOUNTINGS)
def test_a_covered_marker_stops_the_arm(cell, config, mounting):
    cell.config = config
    task = make_task(cell, mounting, seed=0)
    servo, camera, poses = task.servo("image_based"), task.camera(), []

    def see():
        poses.append(forward_kinematics(cell.robot.q))
        if len(poses) == 6:
            T_WO = cell.camera_pose(camera.mount) @ task.true_pose()
            marker = transform_points(T_WO, MARKERS[3] + [0, 0, 0.01])
            static_box(cell.client, [0.02, 0.02, 0.001], marker, (0.5, 0.5, 0.5, 1))
        return camera()

    history = servo_to_goal(cell, servo, task.goal(servo), see, task.carried)
    assert not history.converged and history.iterations == 5
    assert history.reason == "stopped: target lost: of its 4 markers not seen: 3"
    stopped = forward_kinematics(cell.robot.q)
    assert np.linalg.norm(poses[5][:3, 3] - poses[0][:3, 3]) > 0.01  # it was on its way
    assert np.linalg.norm(stopped[:3, 3] - poses[5][:3, 3]) < 0.005
    assert abs(cell.robot.joint_state()[1]).max() < 1e-3


@pytest.mark.parametrize("frozen", ["no image", "old image"])
def test_stale_perception_means_zero_velocity(cell, config, frozen):
    cell.config = config
    task = make_task(cell, "eye_in_hand", seed=0)
    servo = task.servo("position_based")
    look, sights, speeds = exact_camera(task, servo), [], []

    def see():
        if len(sights) < 6:
            sights.append(look())
            return sights[-1]
        return None if frozen == "no image" else sights[-1]

    def record(cell):
        speeds.append((cell.seconds, float(abs(cell.robot.joint_state()[1]).max())))

    cell.on_step = record
    history = servo_to_goal(cell, servo, task.goal(servo), see)
    cell.on_step = None
    assert "ms old, the watchdog allows 100 ms" in history.reason and not history.converged
    seen = sights[-1].seconds
    assert max(speed for t, speed in speeds if t <= seen + 0.1) > 0.1
    # The joints need a moment to come to rest: at most 0.3 rad/s at 7.5 rad/s^2.
    assert max(speed for t, speed in speeds if t > seen + 0.1 + 0.05) < 0.01
    assert cell.seconds < seen + 0.35


def test_late_images_are_still_good_enough(cell, config):
    cell.config = config
    task = make_task(cell, "eye_to_hand", seed=1)
    servo = task.servo("position_based")
    look, sights = exact_camera(task, servo), []

    def see():
        sights.append(look())
        return sights[max(0, len(sights) - 3)]  # 67 ms old

    history = servo_to_goal(cell, servo, task.goal(servo), see, task.carried)
    assert history.converged and max(task.errors()) < 0.5


def test_nothing_to_see_is_an_error_and_no_motion(cell, config):
    cell.config = config
    task = make_task(cell, "eye_in_hand", seed=0)
    cell.robot.place(cell.home + [1.5, 0, 0, 0, 0, 0, 0])
    before, servo = cell.robot.q, task.servo("image_based")
    with pytest.raises(TargetLostError):
        servo_to_goal(cell, servo, task.goal(servo), task.camera())
    with pytest.raises(ArmStoppedError, match="watchdog"):
        servo_to_goal(cell, servo, task.goal(servo), lambda: None)
    np.testing.assert_allclose(cell.robot.q, before, atol=1e-4)


def test_a_mounting_must_be_known(cell, config):
    cell.config = config
    with pytest.raises(UserError, match="mounting: got 'eye_on_hand', expected one of"):
        servo_settings(cell, "eye_on_hand")
