"""Closed-loop grasping in the cell: which controllers grasp, and what stops the arm."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import evaluate
from envs import closed_loop, closed_loop_tracker
from envs.closed_loop import ClosedLoop, GuidedApproach
from envs.closed_loop_tracker import WristCamera
from envs.execution import execute_grasp
from envs.mujoco_cell import MujocoCell
from envs.robot_kinematics import forward_kinematics, geometric_jacobian
from envs.rounds import run_round
from envs.scenarios import teach, true_calibration, wrong_calibration
from envs.servo_arm import ServoArm
from tests.helpers.box_rounds import grasp_of_box, loop, round_with_a_box
from tests.helpers.simulators import needs_pybullet
from utils.config import load_config
from utils.runs import REPOSITORY
from utils.transforms import planar

IN_PYBULLET = pytest.mark.parametrize(
    "taught_cell",
    [pytest.param("pybullet", marks=needs_pybullet)],
    indirect=True,
    scope="module",
)
CLOSED = ("pbvs", "ibvs", "hybrid")


@pytest.mark.parametrize("controller", CLOSED)
def test_every_controller_grasps_a_box_at_rest(cell, controller):
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


@pytest.mark.slow
@pytest.mark.parametrize("controller", ["ibvs", "hybrid"])
def test_a_wrong_calibration_does_not_hurt_what_was_shown(cell, scene, controller):
    record = run_round(
        cell, scene, lambda frame: [grasp_of_box(cell)], policy="exact", objects="box",
        max_failures=1, scenario="miscalibrated", controller=controller,
    )  # fmt: skip
    assert record.successes == 1


@pytest.mark.slow
def test_evaluate_scores_closed_loops(tmp_path, monkeypatch, played_here):
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


def frozen_after(camera, count):
    """A camera that gives `count` images and no more."""
    left = [count]

    def see():
        left[0] -= 1
        return camera() if left[0] >= 0 else None

    return see


@pytest.mark.parametrize("images", [15, 52])
def test_a_frozen_camera_stops_the_arm(cell, images):
    """The gate's watchdog stops it, and it is at rest before the attempt sends it home."""
    approach = loop(cell, "ibvs", camera=frozen_after(WristCamera(cell), images))
    settling = 16 if isinstance(cell, MujocoCell) else 0  # its arm needs longer
    speeds, ends = [], []

    def until_it_fails(cell, grasp):
        try:
            return approach(cell, grasp)
        finally:
            ends.append(cell.steps)
            cell.step(settling)

    cell.on_step = lambda cell: speeds.append(np.abs(cell.robot.joint_state()[1]).max())
    outcome = execute_grasp(cell, grasp_of_box(cell), until_it_fails)
    cell.on_step = None
    assert outcome.reason == "stopped" and "the watchdog allows 100 ms" in outcome.detail
    # One period of 8 steps, and the watchdog's 24, after the last image; 24 to come to rest.
    (end,) = ends
    assert images * 8 + 20 < end < images * 8 + 24 + 8 + 30
    assert max(speeds[: images * 8]) > 0.1, "the arm was on its way"
    assert max(speeds[end + settling - 1 : images * 8 + 56]) < 1e-2, "the arm is at rest"


@IN_PYBULLET
@pytest.mark.parametrize("stage", ["near", "final", "closing"])
def test_a_camera_that_freezes_later_stops_the_arm(cell, stage):
    camera = WristCamera(cell)
    approach = loop(
        cell, "ibvs", camera=lambda: None if approach.record.stage == stage else camera()
    )
    outcome = execute_grasp(cell, replace(grasp_of_box(cell), width=0.08), approach)
    assert outcome.reason == "stopped", outcome
    assert "the watchdog allows 100 ms" in outcome.detail
    assert approach.record.stage == stage


@IN_PYBULLET
def test_a_frozen_camera_stops_the_arm_whose_camera_is_tilted(cell):
    """Two degrees and a centimetre off: the loop is fed wrong poses, and then none."""
    calibration = wrong_calibration(cell, np.random.default_rng(1), 0.01, np.radians(2))
    frame = calibration.frame(cell.frame(), "overhead", np.eye(4))
    camera = frozen_after(WristCamera(cell), 20)
    approach = ClosedLoop(cell, "ibvs", frame, calibration, teach(cell), camera=camera)
    outcome = execute_grasp(cell, grasp_of_box(cell), approach)
    assert outcome.reason == "stopped" and "the watchdog allows 100 ms" in outcome.detail
    assert approach.record.stage in ("far", "near")


@IN_PYBULLET
def test_images_that_come_late_stop_the_arm(cell):
    outcome = execute_grasp(cell, grasp_of_box(cell), loop(cell, "ibvs", latency=0.1))
    assert outcome.reason == "stopped" and "the watchdog allows 100 ms" in outcome.detail


@IN_PYBULLET
def test_the_arm_waits_for_an_object_that_images_do_not_show(cell):
    """Blank images for 0.2 s: the arm comes to rest after the watchdog's 0.1 s, then goes on."""
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


@IN_PYBULLET
def test_a_vanished_object_stops_the_arm(cell):
    grasp, camera, start = grasp_of_box(cell), WristCamera(cell), cell.seconds

    def see():
        if cell.seconds - start > 0.5:
            away = np.eye(4)
            away[:3, 3] = [2, 2, 0.1]
            cell.carry(0, away, np.zeros(3), 0.0)
        return camera()

    outcome = execute_grasp(cell, grasp, loop(cell, "pbvs", camera=see))
    assert outcome.reason == "lost" and "target lost" in outcome.detail


@IN_PYBULLET
def test_fewer_than_three_points_stop_the_arm(cell, monkeypatch):
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


@pytest.mark.parametrize(("direction", "asked"), [(-3.1, False), (2.85, True)])
def test_a_turn_is_measured_the_shorter_way_round(monkeypatch, direction, asked):
    """From 3.1 rad to -3.1 rad are 0.08 rad, less than after which a flip is considered again."""
    questions = []
    monkeypatch.setattr(closed_loop, "must_flip", lambda *args: questions.append(args))
    place = planar(0.5, 0.0, direction)
    guided = SimpleNamespace(
        target=SimpleNamespace(predicted=lambda now: place), chosen_at=3.1,
        cell=SimpleNamespace(seconds=0.0, home=None, robot=SimpleNamespace(q=None)),
        _hand_above=lambda T_WO: T_WO,
    )  # fmt: skip
    GuidedApproach._reconsider_flip(guided)
    assert bool(questions) == asked


@IN_PYBULLET
def test_an_approach_that_does_not_end_is_stopped(cell, monkeypatch):
    short = load_config(None, ["sim.renderer=tiny", "closed_loop.seconds=0.3"])
    monkeypatch.setattr(cell, "config", short)
    outcome = execute_grasp(cell, grasp_of_box(cell), loop(cell, "pbvs"))
    assert outcome.reason == "stopped" and "0.3 s" in outcome.detail


@pytest.mark.parametrize("taught_cell", ["mujoco"], indirect=True, scope="module")
def test_a_push_in_the_final_approach_ends_in_a_collision(cell):
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


def test_the_hand_is_fed_forward_the_way_the_object_goes(cell):
    """A law that desires no velocity: what is left is the velocity of the object's point below the
    hand, v + omega x r by hand, and the goal's sinking. Ahead of the object, not behind it."""
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


@IN_PYBULLET
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
