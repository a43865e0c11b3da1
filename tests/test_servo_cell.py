"""Servoing in the cell: the board's image, the final pose in both mountings, and what stops it."""

from __future__ import annotations

import cv2
import numpy as np
import pybullet
import pytest

from benchmarks import bench_servo_cell
from benchmarks.bench_servo_cell import LAWS, make_task, pose
from envs.board import Board
from envs.board_servo import Sight, servo_settings, servo_to_goal, view_of
from envs.camera import Intrinsics
from envs.cell_scenes import Scene
from envs.pybullet_bodies import add_board, static_box
from envs.pybullet_camera import PybulletCamera
from envs.pybullet_cell import PybulletCell
from envs.robot_kinematics import JOINT_UPPER, forward_kinematics, geometric_jacobian
from envs.robot_safety import ArmStoppedError
from envs.servo_arm import ServoArm
from utils.config import load_config
from utils.errors import TargetLostError, UserError
from utils.servo_features import MOUNTINGS
from utils.transforms import inverse_pose, project, transform_points

BOARD = Board()
MARKERS = BOARD.points * 4 / 7  # their middles: 4 cells from the board's, the corners are 7
FACING = np.diag([1.0, -1.0, -1.0])
INTRINSICS = Intrinsics(640, 480, 60.0)


@pytest.fixture(scope="module")
def cell(config):
    with PybulletCell(config) as cell:
        yield cell


@pytest.fixture(scope="module")
def studio():
    """A client with a grey table and a board at the world's origin."""
    client = pybullet.connect(pybullet.DIRECT)
    static_box(client, [0.6, 0.6, 0.02], [0, 0, -0.1], (0.6, 0.6, 0.6, 1))
    add_board(client, BOARD, np.eye(4))
    yield client
    pybullet.disconnect(physicsClientId=client)


def photograph(client, T_OC, intrinsics=INTRINSICS):
    return PybulletCamera(client, pybullet.ER_TINY_RENDERER).render(intrinsics, T_OC).rgb


def empty(cell, *overrides):
    """The cell without objects, under other settings."""
    cell.config = load_config(None, ["sim.renderer=tiny", *overrides])
    cell.build(Scene("isolated", 0, ()))
    return cell


# The board


def test_board_is_as_large_as_it_says():
    # 20 cells; the outermost corners are 14 apart and 7 sqrt(2) from the middle, turned by 8
    # degrees from the diagonals.
    np.testing.assert_allclose(BOARD.size, 0.2)
    angles = np.radians([143, 53, -37, -127])
    expected = 0.07 * np.sqrt(2) * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    np.testing.assert_allclose(BOARD.points[:, :2], expected)
    np.testing.assert_allclose(BOARD.points[:, 2], 0)


@pytest.mark.parametrize("seed", range(5))
def test_corners_and_pose_are_found_to_a_fraction_of_a_pixel(studio, seed):
    rng = np.random.default_rng(seed)
    T_CO = pose([*rng.uniform(-0.02, 0.02, 2), rng.uniform(0.2, 0.3)],
                rng.uniform(-1, 1, 3) * [12, 12, 180], FACING)  # fmt: skip
    pixels = BOARD.find(photograph(studio, inverse_pose(T_CO)))
    expected, _ = project(BOARD.points, INTRINSICS.K, inverse_pose(T_CO))
    np.testing.assert_allclose(pixels, expected, atol=0.3)
    assert np.sqrt(np.mean((pixels - expected) ** 2)) < 0.12
    found = BOARD.pose(pixels, INTRINSICS.K)
    np.testing.assert_allclose(found[:3, 3], T_CO[:3, 3], atol=2e-4)
    np.testing.assert_allclose(found[:3, :3], T_CO[:3, :3], atol=4e-3)


def test_pose_of_exact_corners_is_exact():
    T_CO = pose([0.02, -0.01, 0.3], [10, -15, 40], FACING)
    pixels, _ = project(BOARD.points, INTRINSICS.K, inverse_pose(T_CO))
    np.testing.assert_allclose(BOARD.pose(pixels, INTRINSICS.K), T_CO, atol=1e-6)


def test_a_board_that_is_not_all_seen_is_lost(studio):
    straight = pose([0, 0, 0.25], [0, 0, 0], FACING)
    with pytest.raises(TargetLostError, match="of its 4 markers not seen: 0, 1, 2, 3"):
        BOARD.find(photograph(studio, inverse_pose(pose([1, 0, 0.25], [0, 0, 0], FACING))))
    with pytest.raises(TargetLostError, match="not seen: 1, 2$"):
        BOARD.find(photograph(studio, inverse_pose(pose([0.15, 0, 0.25], [0, 0, 0], FACING))))
    image = photograph(studio, inverse_pose(straight))
    (u, v), _ = project(MARKERS[2], INTRINSICS.K, inverse_pose(straight))
    cv2.circle(image, (round(u), round(v)), 15, (90, 90, 90), -1)
    with pytest.raises(TargetLostError, match="not seen: 2$"):
        BOARD.find(image)


def test_markers_that_do_not_lie_on_one_board_are_refused(studio):
    image = photograph(studio, inverse_pose(pose([0, 0, 0.25], [0, 0, 0], FACING)))
    middle = image.shape[0] // 2
    image[:middle] = np.roll(image[:middle], 60, axis=1)
    with pytest.raises(TargetLostError, match="correlate|aligned"):
        BOARD.find(image)


# Where the arm ends


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
    for seed in 10, 11:
        task = make_task(cell, mounting, seed)
        assert task.run(law).converged
        assert max(task.errors()) < 0.5


# What stops it


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


def drive(cell, wish, seconds=3.0, carried=None):
    """The reason for which a constant wish (7,) was stopped, and E's path (k, 3)."""
    arm, path = ServoArm(cell, carried), []
    with pytest.raises(ArmStoppedError) as stopped:
        for _ in range(round(seconds / cell.dt)):
            path.append(forward_kinematics(cell.robot.q)[:3, 3])
            arm.move(wish, 0.0)
    arm.stop()
    path.append(forward_kinematics(cell.robot.q)[:3, 3])
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


def test_contact_stops_the_arm(cell):
    empty(cell)
    wall = static_box(cell.client, [0.1, 0.01, 0.3], [0.35, 0.15, 0.3], (0.5, 0.5, 0.5, 1))
    reason, _ = drive(cell, np.array([0.6, 0, 0, 0, 0, 0, 0]))
    assert reason.startswith("contact with ")
    nearest = pybullet.getClosestPoints(cell.robot.body, wall, 0.1, physicsClientId=cell.client)
    assert min(point[8] for point in nearest) > -0.002  # it did not go on into the wall


def test_what_is_carried_counts_as_the_arm(cell, config):
    cell.config = config
    task = make_task(cell, "eye_to_hand", seed=0)
    height = cell.robot.tip_pose()[2, 3]
    half = [0.05, 0.05, height / 2 - 0.03]
    block = static_box(cell.client, half, [0.5, 0, half[2]], (0.5, 0.5, 0.5, 1))
    down = np.linalg.pinv(geometric_jacobian(cell.robot.q)) @ [0, 0, -0.1, 0, 0, 0]
    reason, path = drive(cell, down, carried=task.carried)
    assert reason.startswith("contact with ")
    near = pybullet.getClosestPoints(task.body, block, 0.1, physicsClientId=cell.client)
    assert abs(min(point[8] for point in near)) < 0.002 and height - path[-1, 2] > 0.02
    # Without a block the lowest corner of the target ends at the box, and E well above it.
    task = make_task(cell, "eye_to_hand", seed=0)
    reason, path = drive(cell, down, carried=task.carried)
    assert reason.startswith("the workspace ends here (z = 0.02")
    corners = transform_points(cell.camera_pose("overhead") @ task.true_pose(), BOARD.outline)
    assert corners[:, 2].min() == pytest.approx(0.02, abs=1e-3) and path[-1, 2] > 0.022


def test_a_mounting_must_be_known(cell, config):
    cell.config = config
    with pytest.raises(UserError, match="mounting: got 'eye_on_hand', expected one of"):
        servo_settings(cell, "eye_on_hand")


@pytest.mark.slow
def test_quick_benchmark_reports_every_law(capfd, tmp_path):
    bench_servo_cell.main(["--quick", "--json", str(tmp_path / "bench.json")])
    lines = capfd.readouterr().out.splitlines()
    assert len(lines) >= 1 + 4 * len(MOUNTINGS) * len(LAWS)
    assert not any(line.endswith("NO") for line in lines)
