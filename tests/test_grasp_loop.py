"""Closed-loop grasping in the cell: who grasps, what stops it, and what disturbs the objects."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pybullet
import pytest

from envs import closed_loop_tracker
from envs.camera import wrist_mount
from envs.camera_calibration import displaced, level, teach, true_calibration, wrong_calibration
from envs.cell_scenes import make_scene
from envs.closed_loop import ClosedLoop, GuidedApproach
from envs.closed_loop_tracker import WristCamera
from envs.execution import GraspFailure, execute_grasp
from envs.pybullet_cell import PybulletCell
from envs.robot_kinematics import forward_kinematics, geometric_jacobian, inverse_kinematics
from envs.rounds import run_round
from envs.scenarios import SCENARIOS, Conveyor, Displacement, crossing, disturbed
from envs.servo_arm import ServoArm
from tests.helpers.box_rounds import grasp_of_box, round_with_a_box
from utils.config import load_config
from utils.table_plane import fit_table_plane
from utils.transforms import inverse_pose, planar_part, top_down_pose

CLOSED = ("pbvs", "ibvs", "hybrid")


@pytest.fixture(scope="module")
def cell(config):
    with PybulletCell(config) as cell:
        teach(cell)  # empties the cell, the first time
        yield cell


@pytest.fixture(scope="module")
def scene(config, box_set):
    return make_scene("isolated", box_set, 0, config)


def loop(cell, controller, latency=0.0, camera=None):
    calibration = true_calibration(cell)
    return ClosedLoop(cell, controller, cell.frame(), calibration, teach(cell), latency, camera)


# Who grasps


@pytest.mark.parametrize("controller", CLOSED)
def test_every_controller_grasps_a_box_at_rest(cell, scene, controller):
    cell.load(scene)
    approach = loop(cell, controller)
    outcome = execute_grasp(cell, grasp_of_box(cell), approach)
    assert outcome.success, outcome
    assert approach.record.stage == "closing"


@pytest.mark.slow
@pytest.mark.parametrize("scenario", ["moved", "moving_5cm", "turning_5cm", "latency"])
def test_the_loop_grasps_what_the_open_loop_misses(cell, scene, scenario, monkeypatch):
    results = {}
    for controller in ("open_loop", "ibvs"):
        record = round_with_a_box(cell, scene, scenario, controller, monkeypatch)
        results[controller] = record.successes
        assert record.scenario == scenario and record.controller == controller
    assert results == {"open_loop": 0, "ibvs": 1}


# What stops it


def frozen_after(camera, count):
    """A camera that gives `count` images and no more."""
    left = [count]

    def see():
        left[0] -= 1
        return camera() if left[0] >= 0 else None

    return see


@pytest.mark.parametrize("images", [15, 52])
def test_a_frozen_camera_stops_the_arm(cell, scene, images):
    cell.load(scene)
    grasp = grasp_of_box(cell)
    approach = loop(cell, "ibvs", camera=frozen_after(WristCamera(cell), images))
    with pytest.raises(GraspFailure) as failure:
        approach(cell, grasp)
    speeds = np.abs(cell.robot.joint_state()[1])
    assert failure.value.reason == "stopped"
    assert "the watchdog allows 100 ms" in failure.value.detail
    assert speeds.max() < 1e-2, "the arm is at rest"
    # One period of 8 steps, and the watchdog's 24, after the last image.
    assert images * 8 + 20 < cell.steps < images * 8 + 24 + 8 + 30


@pytest.mark.parametrize("stage", ["near", "final", "closing"])
def test_a_camera_that_freezes_later_stops_the_arm(cell, scene, stage):
    cell.load(scene)
    camera = WristCamera(cell)
    approach = loop(
        cell, "ibvs", camera=lambda: None if approach.record.stage == stage else camera()
    )
    outcome = execute_grasp(cell, replace(grasp_of_box(cell), width=0.08), approach)
    assert outcome.reason == "stopped", outcome
    assert "the watchdog allows 100 ms" in outcome.detail
    assert approach.record.stage == stage


def test_a_frozen_camera_stops_the_arm_whose_camera_is_tilted(cell, scene):
    """Two degrees and a centimetre off: the loop is fed wrong poses, and then none."""
    cell.load(scene)
    calibration = wrong_calibration(cell, np.random.default_rng(1), 0.01, np.radians(2))
    frame = calibration.frame(cell.frame(), "overhead", np.eye(4))
    camera = frozen_after(WristCamera(cell), 20)
    approach = ClosedLoop(cell, "ibvs", frame, calibration, teach(cell), camera=camera)
    outcome = execute_grasp(cell, grasp_of_box(cell), approach)
    assert outcome.reason == "stopped" and "the watchdog allows 100 ms" in outcome.detail
    assert approach.record.stage in ("far", "near")


def test_images_that_come_late_stop_the_arm(cell, scene):
    cell.load(scene)
    outcome = execute_grasp(cell, grasp_of_box(cell), loop(cell, "ibvs", latency=0.1))
    assert outcome.reason == "stopped" and "the watchdog allows 100 ms" in outcome.detail


def test_the_arm_waits_for_an_object_that_images_do_not_show(cell, scene):
    """Blank images for 0.2 s: the arm comes to rest after the watchdog's 0.1 s, then goes on."""
    cell.load(scene)
    camera, slowest = WristCamera(cell), [np.inf]

    def see():
        sight = camera()
        if 0.5 < cell.seconds < 0.7:
            slowest[0] = min(slowest[0], np.abs(cell.robot.joint_state()[1]).max())
            return sight._replace(depth=np.zeros_like(sight.depth))
        return sight

    outcome = execute_grasp(cell, grasp_of_box(cell), loop(cell, "ibvs", camera=see))
    assert outcome.success, outcome
    assert slowest[0] < 0.05, "rad/s"


def test_a_vanished_object_stops_the_arm(cell, scene):
    cell.load(scene)
    grasp, camera, start = grasp_of_box(cell), WristCamera(cell), cell.seconds

    def see():
        if cell.seconds - start > 0.5:
            pybullet.resetBasePositionAndOrientation(
                cell.bodies[0], [2, 2, 0.1], [0, 0, 0, 1], physicsClientId=cell.client
            )
        return camera()

    outcome = execute_grasp(cell, grasp, loop(cell, "pbvs", camera=see))
    assert outcome.reason == "lost" and "target lost" in outcome.detail


def test_fewer_than_three_points_stop_the_arm(cell, scene, monkeypatch):
    cell.load(scene)
    make = closed_loop_tracker.make_template

    def far_points(frame, grasp):
        template = make(frame, grasp)
        points = template.points.copy()
        points[2:] += [0.5, 0, 0]  # all but two leave the image
        return replace(template, points=points)

    monkeypatch.setattr(closed_loop_tracker, "make_template", far_points)
    outcome = execute_grasp(cell, grasp_of_box(cell), loop(cell, "ibvs"))
    assert outcome.reason == "lost"
    assert "2 of those on the object are in the image, needed are at least 3" in outcome.detail


def test_an_approach_that_does_not_end_is_stopped(cell, scene, monkeypatch):
    short = load_config(None, ["sim.renderer=tiny", "closed_loop.seconds=0.3"])
    monkeypatch.setattr(cell, "config", short)
    cell.load(scene)
    outcome = execute_grasp(cell, grasp_of_box(cell), loop(cell, "pbvs"))
    assert outcome.reason == "stopped" and "0.3 s" in outcome.detail


# What disturbs


def test_a_displacement_ends_where_it_says(cell, scene):
    cell.load(scene)
    before = cell.object_pose(0)
    with disturbed(cell, Displacement(np.array([0.04, -0.03]), 0.5, start=0.1)):
        cell.step(24)
        np.testing.assert_allclose(cell.object_pose(0)[:3, 3], before[:3, 3], atol=2e-4)
        cell.step(240)
    after = cell.object_pose(0)
    np.testing.assert_allclose(after[:3, 3] - before[:3, 3], [0.04, -0.03, 0], atol=5e-4)
    R = after[:3, :3] @ before[:3, :3].T
    assert np.arctan2(R[1, 0], R[0, 0]) == pytest.approx(0.5, abs=0.01)
    assert cell.before_step is None


PLACES = [(0.6, 0.1), (0.4, -0.1), (0.5, 0.14), (0.36, 0.02)]


@pytest.mark.parametrize("place", PLACES)
def test_a_crossing_goes_through_the_middle(place):
    for seed in range(20):
        path = crossing(np.random.default_rng(seed), np.array(place), np.array([0.5, 0.0]), 0.05)
        way = np.subtract(path(10.0)[:2], path(0.2)[:2])
        towards = np.subtract((0.5, 0.0), place)
        assert np.linalg.norm(way) == pytest.approx(0.49)
        cosine = way @ towards / np.linalg.norm(way) / np.linalg.norm(towards)
        assert np.degrees(np.arccos(cosine)) <= 30 + 1e-6


@pytest.mark.parametrize("turn_rate", [0.0, 0.4])
def test_a_conveyor_moves_at_its_speed(cell, scene, turn_rate):
    cell.load(scene)
    before = cell.object_pose(0)
    with disturbed(cell, Conveyor(0.05, np.pi / 2, turn_rate)):
        cell.step(48)  # up to speed, after half the way that the full speed would have made
        middle = cell.object_pose(0)
        assert middle[1, 3] - before[1, 3] == pytest.approx(0.005, abs=5e-4)
        cell.step(240)
        after = cell.object_pose(0)
    chord = 0.05 if turn_rate == 0 else 2 * 0.05 / turn_rate * np.sin(turn_rate / 2)
    travelled = np.linalg.norm(after[:2, 3] - middle[:2, 3])
    assert travelled == pytest.approx(chord, abs=5e-4)
    R = after[:3, :3] @ middle[:3, :3].T
    assert np.arctan2(R[1, 0], R[0, 0]) == pytest.approx(turn_rate, abs=5e-3)
    assert after[2, 3] == pytest.approx(before[2, 3], abs=5e-4)


def test_the_robots_touch_ends_a_disturbance(cell, scene):
    cell.load(scene)
    start = cell.object_position(0)
    # The fingers wait 7 cm ahead of the middle of the box, whose half diagonal is 4.2 cm.
    in_the_way = top_down_pose(start + [0.07, 0.0, 0.0], 0.0)
    cell.robot.place(inverse_kinematics(in_the_way, cell.home), opening=0.0)
    with disturbed(cell, Conveyor(0.05, 0.0)):
        cell.step(480)
        assert cell.before_step.over
    assert 0.005 < cell.object_position(0)[0] - start[0] < 0.05, "2 s would have made 9.5 cm"


def test_a_miscalibration_is_as_large_as_it_says(cell, scene):
    T = cell.camera_pose("overhead")
    rng = np.random.default_rng(3)
    for _ in range(5):
        wrong = displaced(T, rng, 0.01, np.radians(2))
        assert np.linalg.norm(wrong[:3, 3] - T[:3, 3]) == pytest.approx(0.01)
        cosine = (np.trace(wrong[:3, :3] @ T[:3, :3].T) - 1) / 2
        assert np.degrees(np.arccos(cosine)) == pytest.approx(2.0, abs=1e-6)
    cell.load(scene)
    scenario = SCENARIOS["miscalibrated"]
    first, again = scenario.calibration(cell), scenario.calibration(cell)
    np.testing.assert_array_equal(first.T_WC, again.T_WC)
    for T, true in zip((first.T_WC, first.T_EC), (cell.camera_pose(), wrist_mount(CONFIG))):
        assert np.linalg.norm(T[:3, 3] - true[:3, 3]) == pytest.approx(0.01)


CONFIG = load_config().camera


def test_levelling_finds_the_table_and_leaves_the_place(cell, scene):
    cell.load(scene)
    frame = cell.frame()
    wrong = wrong_calibration(cell, np.random.default_rng(0), 0.01, np.radians(2)).T_WC
    levelled = level(replace(frame, T_WC=wrong))
    normal, offset = fit_table_plane(frame.depth, frame.K, inverse_pose(levelled.T_WC))
    np.testing.assert_allclose(levelled.T_WC[:3, :3] @ normal, [0, 0, 1], atol=1e-9)
    assert levelled.T_WC[2, 3] == pytest.approx(0.8, abs=1e-3)  # as high as it truly is
    np.testing.assert_allclose(levelled.T_WC[:2, 3], wrong[:2, 3])  # as far off as it was


def test_what_is_taught_is_true_whatever_is_believed(cell):
    T = teach(cell) @ wrist_mount(CONFIG)  # identity
    assert np.linalg.norm(T[:3, 3]) < 3e-4
    assert np.degrees(np.arccos((np.trace(T[:3, :3]) - 1) / 2)) < 0.2


def test_images_arrive_late(cell, scene):
    cell.load(scene)
    camera, seen = WristCamera(cell, latency=0.1), []
    for _ in range(6):
        sight = camera()
        seen.append(None if sight is None else round(cell.seconds - sight.seconds, 6))
        cell.step(8)
    assert seen == [None, None, None, 0.1, 0.1, 0.1]


def test_the_object_is_found_by_the_real_camera(cell, scene):
    cell.load(scene)
    descent = GuidedApproach(loop(cell, "pbvs"), ServoArm(cell), grasp_of_box(cell))
    x, y, turn = np.subtract(
        planar_part(descent.target.T_WO),
        [*cell.object_pose(0)[:2, 3], grasp_of_box(cell).angle],
    )
    assert np.hypot(x, y) < 3e-3, "from home, where a pixel covers 5 mm of the table"
    assert abs(np.degrees((turn + np.pi / 2) % np.pi - np.pi / 2)) < 4


def test_the_hand_is_fed_forward_the_way_the_object_goes(cell, scene):
    """A law that wishes for nothing: what is left is the velocity of the object's point below the
    hand, v + omega x r by hand, and the goal's sinking. Ahead of the object, not behind it."""
    cell.load(scene)
    descent = GuidedApproach(loop(cell, "pbvs"), ServoArm(cell), grasp_of_box(cell))
    state = descent.target.motion.state
    x, y = state[:2]
    state[3:] = [0.04, -0.03, 0.3]
    q = cell.robot.q
    T_WE, J = forward_kinematics(q), geometric_jacobian(q)

    class NoVelocity:
        def compute_joint_velocities(self, *args):
            return np.zeros(7)

    twist = J @ descent._joint_velocities(q, T_WE, np.zeros(6), NoVelocity(), 0.05)
    rx, ry = T_WE[:2, 3] - (x, y)
    expected = [0.04 - 0.3 * ry, -0.03 + 0.3 * rx, -0.05, 0, 0, 0.3]
    np.testing.assert_allclose(twist, expected, atol=4e-3)


def test_the_wrist_cameras_noise_is_the_configs_and_of_the_scene(cell, scene, monkeypatch):
    cell.load(scene)
    clean = WristCamera(cell)().depth
    noisy = load_config(None, ["sim.renderer=tiny", "camera.depth_noise=kinect"])
    monkeypatch.setattr(cell, "config", noisy)
    first, again = WristCamera(cell)().depth, WristCamera(cell)().depth
    np.testing.assert_array_equal(first, again)
    camera = WristCamera(cell)
    assert (camera().depth != camera().depth).any(), "each image has noise of its own"
    known = (first > 0) & (clean > 0)
    error = np.abs(first - clean)[known]
    # From 0.5 m: 0.5^2 m^2 / (480 px x 0.075 m) x 1/8 px is 0.9 mm a step of disparity.
    assert 1e-4 < np.median(error) < 1.5e-3
    assert 0.5 < known.mean() < 1.0, "with holes, at the edges of things"


def test_computing_takes_its_time(cell, scene, monkeypatch):
    """The time to work out a velocity counts as an image's age: too much and the arm stops."""
    monkeypatch.setattr(cell, "config", slow := load_config(
        None, ["sim.renderer=tiny", "closed_loop.compute_seconds=0.1"]
    ))  # fmt: skip
    assert slow.safety.watchdog == 0.1
    record = run_round(
        cell, scene, lambda frame: [grasp_of_box(cell)], policy="exact", objects="box",
        max_failures=1, controller="ibvs",
    )  # fmt: skip
    assert record.attempts[0].reason == "stopped"
    assert "the watchdog allows 100 ms" in record.attempts[0].detail
