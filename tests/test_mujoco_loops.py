"""What moves the objects and what follows them in MuJoCo, beside closed forms and PyBullet."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("mujoco", reason='MuJoCo is optional: pip install "mujoco>=3.3,<4"')

import evaluate
from envs.camera import wrist_mount
from envs.camera_calibration import teach, true_calibration
from envs.cell_layout import GRAVITY
from envs.cell_scenes import make_scene
from envs.closed_loop import ClosedLoop, GuidedApproach
from envs.closed_loop_tracker import WristCamera
from envs.execution import execute_grasp
from envs.mujoco_cell import MujocoCell
from envs.pybullet_cell import PybulletCell
from envs.robot_kinematics import inverse_kinematics
from envs.rounds import run_round
from envs.scenarios import SCENARIOS, Conveyor, disturbed
from envs.servo_arm import ServoArm
from tests.helpers.box_rounds import grasp_of_box, round_with_a_box
from utils.transforms import planar_part, top_down_pose

REPOSITORY = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def worlds(config):
    with PybulletCell(config) as bullet, MujocoCell(config) as mujoco:
        for cell in (bullet, mujoco):
            teach(cell)  # empties the cell, the first time
        yield bullet, mujoco


@pytest.fixture(scope="module")
def scene(config, box_set):
    return make_scene("isolated", box_set, 0, config)


@pytest.fixture
def cell(worlds, scene):
    mujoco = worlds[1]
    mujoco.load(scene)
    return mujoco


def turn_between(before, after):
    """rad about +z of W from one pose to another."""
    R = after[:3, :3] @ before[:3, :3].T
    return np.arctan2(R[1, 0], R[0, 0])


# What disturbs


def test_what_is_carried_flies_on_as_it_was_sent(cell):
    """A tilted cube let go in the air: p + v t - g t^2 / 2, and a turn about W's vertical, which a
    cube keeps, whichever way its own axes point."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", [0.5, -0.3, 1.0]).as_matrix()
    T[:3, 3] = [0.55, 0.05, 0.3]
    cell.carry(0, T, np.array([0.3, -0.2, 0.1]), 2.0)
    np.testing.assert_allclose(cell.object_pose(0), T, atol=1e-12)
    cell.step(24)
    time, after = 24 * cell.dt, cell.object_pose(0)
    fallen = np.array([0.03, -0.02, 0.1 * time - GRAVITY * time**2 / 2])
    np.testing.assert_allclose(after[:3, 3] - T[:3, 3], fallen, atol=1e-3)
    expected = Rotation.from_euler("z", 2.0 * time).as_matrix() @ T[:3, :3]
    np.testing.assert_allclose(after[:3, :3], expected, atol=1e-3)


@pytest.mark.parametrize("turn_rate", [0.0, 0.4])
def test_a_conveyor_moves_at_its_speed(cell, turn_rate):
    before = cell.object_pose(0)
    with disturbed(cell, Conveyor(0.05, np.pi / 2, turn_rate)):
        cell.step(48)  # up to speed, after half the way that the full speed would have made
        middle = cell.object_pose(0)
        assert middle[1, 3] - before[1, 3] == pytest.approx(0.005, abs=2e-4)
        cell.step(240)
        after = cell.object_pose(0)
        assert cell.speed(0) == pytest.approx(0.05, rel=0.5), "the table brakes within a step"
    chord = 0.05 if turn_rate == 0 else 2 * 0.05 / turn_rate * np.sin(turn_rate / 2)
    assert np.linalg.norm(after[:2, 3] - middle[:2, 3]) == pytest.approx(chord, abs=2e-4)
    assert turn_between(middle, after) == pytest.approx(turn_rate, abs=5e-3)
    assert after[2, 3] == pytest.approx(before[2, 3], abs=5e-4)


@pytest.mark.parametrize("scenario", ["moved", "moving_10cm", "turning_5cm", "crossing_5cm"])
def test_both_worlds_move_an_object_the_same_way(worlds, scene, scenario):
    ways, turns = [], []
    for cell in worlds:
        cell.load(scene)
        before = cell.object_pose(0)
        motion = SCENARIOS[scenario].motion(cell, 0)
        with disturbed(cell, motion):
            cell.step(360)
        after = cell.object_pose(0)
        ways.append(after[:3, 3] - before[:3, 3])
        turns.append(turn_between(before, after))
        expected = motion(360 * cell.dt)
        np.testing.assert_allclose([*ways[-1][:2], turns[-1]], expected, atol=3e-3)
    assert np.linalg.norm(ways[1]) > 0.03
    np.testing.assert_allclose(ways[0], ways[1], atol=1e-3)
    assert turns[0] == pytest.approx(turns[1], abs=0.01)


def test_the_robots_touch_ends_a_disturbance(cell):
    start = cell.object_position(0)
    # The fingers wait 7 cm ahead of the middle of the box, whose half diagonal is 4.2 cm.
    in_the_way = top_down_pose(start + [0.07, 0.0, 0.0], 0.0)
    cell.robot.place(inverse_kinematics(in_the_way, cell.home), opening=0.0)
    assert not cell.robot.touches_body(cell.bodies[0])
    with disturbed(cell, Conveyor(0.05, 0.0)):
        cell.step(480)
        assert cell.before_step.over
    assert cell.before_step is None
    assert 0.005 < cell.object_position(0)[0] - start[0] < 0.05, "2 s would have made 9.5 cm"
    assert cell.speed(0) < 1e-3, "friction has stopped it"


# What looks


def test_both_wrist_cameras_are_where_they_are_said_to_be(worlds):
    """A board held at a known place before the hand, found in the picture of either world."""
    for cell in worlds:
        off = teach(cell) @ wrist_mount(cell.config.camera)  # identity
        assert np.linalg.norm(off[:3, 3]) < 3e-4
        assert np.degrees(np.arccos((np.trace(off[:3, :3]) - 1) / 2)) < 0.2


def test_both_wrist_cameras_find_the_object_where_it_is(worlds, scene):
    for cell in worlds:
        cell.load(scene)
        grasp = grasp_of_box(cell)
        loop = ClosedLoop(cell, "pbvs", cell.frame(), true_calibration(cell), teach(cell))
        found = GuidedApproach(loop, ServoArm(cell), grasp).target.T_WO
        x, y, turn = np.subtract(planar_part(found), [*cell.object_pose(0)[:2, 3], grasp.angle])
        assert np.hypot(x, y) < 3e-3, "from home, where a pixel covers 5 mm of the table"
        assert abs(np.degrees((turn + np.pi / 2) % np.pi - np.pi / 2)) < 4


# Who grasps


@pytest.mark.parametrize("scenario", ["moved", "moving_5cm", "turning_5cm", "latency"])
def test_the_loop_grasps_what_the_open_loop_misses(cell, scene, scenario, monkeypatch):
    results = {
        controller: round_with_a_box(cell, scene, scenario, controller, monkeypatch).successes
        for controller in ("open_loop", "ibvs")
    }
    assert results == {"open_loop": 0, "ibvs": 1}


@pytest.mark.parametrize("controller", ["ibvs", "hybrid"])
def test_a_wrong_calibration_does_not_hurt_what_was_shown(cell, scene, controller):
    record = run_round(
        cell, scene, lambda frame: [grasp_of_box(cell)], policy="exact", objects="box",
        max_failures=1, scenario="miscalibrated", controller=controller,
    )  # fmt: skip
    assert record.successes == 1


@pytest.mark.slow
def test_evaluate_scores_closed_loops(tmp_path, monkeypatch):
    """The command of docs/sim_to_real.md, on one object."""
    monkeypatch.chdir(tmp_path)
    settings = (
        "simulator=mujoco", "sim.renderer=tiny", "evaluate.object_sets=box", "evaluate.rounds=1",
        "evaluate.scenarios=moved", "evaluate.controllers=open_loop,hybrid", "evaluate.workers=1",
    )  # fmt: skip
    config = REPOSITORY / "configs" / "servo.yaml"
    assert evaluate.main(["--config", str(config), "--results", "results.json", *settings]) == 0
    rows = json.loads((tmp_path / "results.json").read_text())["rows"]
    assert [(row["policy"], row["success_rate"]) for row in rows] == [
        ("heuristic", 0.0), ("heuristic+hybrid", 1.0),
    ]  # fmt: skip


def test_a_frozen_camera_stops_the_arm(cell):
    camera, left = WristCamera(cell), [15]

    def see():
        left[0] -= 1
        return camera() if left[0] >= 0 else None

    loop = ClosedLoop(cell, "ibvs", cell.frame(), true_calibration(cell), teach(cell), camera=see)
    speeds = []
    cell.on_step = lambda cell: speeds.append(np.abs(cell.robot.joint_state()[1]).max())
    outcome = execute_grasp(cell, grasp_of_box(cell), loop)
    cell.on_step = None
    assert outcome.reason == "stopped" and "the watchdog allows 100 ms" in outcome.detail
    # One period of 8 steps, and the watchdog's 24, after the last image; 24 to come to rest.
    assert max(speeds[: 15 * 8]) > 0.1 and max(speeds[15 * 8 + 32 : 15 * 8 + 56][-4:]) < 1e-2


def test_a_push_in_the_last_centimetres_is_told_by_the_contact(cell):
    """The cube jumps under the closed fingers' way: what presses on them stops the arm."""
    grasp = grasp_of_box(cell)
    loop = ClosedLoop(cell, "pbvs", cell.frame(), true_calibration(cell), teach(cell))

    def aside(cell):
        if loop.record.stage == "final" and cell.before_step is not None:
            T = cell.object_pose(0)
            T[:2, 3] += 0.04 * np.array([np.cos(grasp.angle), np.sin(grasp.angle)])
            cell.carry(0, T, np.zeros(3), 0.0)
            cell.before_step = None

    cell.before_step = aside
    outcome = execute_grasp(cell, grasp, loop)
    assert outcome.reason == "collision" and "contact with" in outcome.detail
