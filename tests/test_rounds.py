"""A round: when it ends, which grasps are tried, and planners that fail."""

import contextlib
import json
from dataclasses import asdict, replace
from types import SimpleNamespace

import numpy as np
import pytest

from envs.cell_layout import Placement, Scene
from envs.cell_scenes import make_scene
from envs.closed_loop import ClosedLoop
from envs.execution import GraspFailure, GraspOutcome
from envs.next_grasp import ROOM_OVER_TOUCH, choose, within_reach
from envs.objects import load_object_set
from envs.rounds import run_round
from models.planners import make_planner
from tests.helpers.cubes import cube_grasp, cube_scene
from utils.calibration import Calibration
from utils.config import with_settings
from utils.geometry import GripperGeometry, Workspace
from utils.random_streams import Stream, planner_seed
from utils.result_formats import format_table
from utils.results import summarise
from utils.transforms import Grasp


@pytest.fixture(scope="module")
def cell(bullet_cell):
    return bullet_cell


def planner_of(grasps):
    """A planner that returns these whatever it sees."""
    return lambda frame: list(grasps)


@pytest.mark.slow
def test_rounds_are_deterministic_whatever_came_before(cell, config):
    primitives = load_object_set("primitives", cache_dir=config.cache_folder)
    scene = make_scene("pile", primitives, 5, config)

    def play():
        plan = make_planner("heuristic", GripperGeometry(), Workspace(), 0)
        record = run_round(cell, scene, plan, policy="h", objects="p", max_failures=2)
        poses = [cell.object_pose(i) for i in range(len(cell.bodies))]
        return [(a.reason, a.sim_seconds) for a in record.attempts], np.array(poses)

    reasons, poses = play()
    cell.load(make_scene("packed", primitives, 6, config))
    cell.step(100)
    again, poses_again = play()
    assert reasons == again
    np.testing.assert_array_equal(poses, poses_again)


def test_stop_rule(cell, box_set):
    scene = cube_scene(box_set)
    settings = {"policy": "x", "objects": "box", "max_failures": 2}
    cleared = run_round(cell, scene, planner_of([cube_grasp()]), **settings)
    assert (cleared.ended, cleared.objects_cleared, cleared.successes) == ("cleared", 1, 1)
    nothing = run_round(cell, scene, planner_of([]), **settings)
    assert (nothing.ended, nothing.executed, nothing.objects_cleared) == ("no_plan", 0, 0)
    miss = cube_grasp(offset=(0.13, 0, 0))
    failed = run_round(cell, scene, planner_of([miss]), **settings)
    assert (failed.ended, failed.executed, failed.successes) == ("failures", 2, 0)


class Targeted:
    """A planner that tells objects apart, and returns these grasps whatever it sees."""

    def __init__(self, grasps):
        self.grasps, self.frames = grasps, []

    def segments(self, frame):
        return np.full(frame.depth.shape, -1)

    def __call__(self, frame):
        self.frames.append(frame)
        return list(self.grasps)


def test_a_round_with_a_target_ends_when_it_is_in_the_tray(cell, box_set):
    """Two cubes 12 cm apart, of which the second is wanted."""
    level = np.array([0.0, 0.0, 0.0, 1.0])
    places = np.array([(0.5, 0.06, 0.03), (0.5, -0.06, 0.03)])
    placements = tuple(Placement(box_set[0], place, level) for place in places)
    scene = Scene("retrieve", 0, placements, target=1)
    settings = {"policy": "x", "objects": "box", "max_failures": 9}
    other, wanted, miss = (
        cube_grasp(offset=offset) for offset in ((0, 0.06, 0), (0, -0.06, 0), (0.13, 0, 0))
    )
    plan = Targeted([wanted, other])
    record = run_round(cell, scene, plan, **settings)
    assert (record.ended, record.target_in_hand, record.executed) == ("target", True, 1)
    assert record.objects_cleared == 1 and cell.remaining == {0}
    seen = plan.frames[0]
    assert seen.segmentation is None and seen.truth is None
    points = seen.points()[seen.target]  # the target's pixels alone
    assert len(points) > 200 and (np.abs(points[:, :2] - places[1, :2]) < 0.035).all()

    record = run_round(cell, scene, Targeted([other]), **settings)  # then the other one is gone
    assert (record.ended, record.target_in_hand, record.executed) == ("picks", False, 2)
    record = run_round(cell, scene, Targeted([miss]), **settings)
    assert (record.ended, record.target_in_hand, record.executed) == ("picks", False, 2)
    record = run_round(cell, scene, Targeted([miss]), **(settings | {"max_failures": 1}))
    assert (record.ended, record.target_in_hand) == ("failures", False)
    record = run_round(cell, scene, Targeted([]), **settings)
    assert (record.ended, record.target_in_hand) == ("no_plan", False)


def test_a_target_that_falls_off_while_another_thing_is_picked_ends_the_round(
    cell, box_set, monkeypatch
) -> None:
    """So is one of two things without a target, of which the other was picked."""
    level = np.array([0.0, 0.0, 0.0, 1.0])
    places = np.array([(0.5, 0.06, 0.03), (0.5, -0.06, 0.03)])
    placements = tuple(Placement(box_set[0], place, level) for place in places)

    def execute(cell, grasp, approach, **how):
        cell.remaining.clear()  # the first in the tray, the second beside the table
        return GraspOutcome("success", 5.0, object_index=0)

    monkeypatch.setattr("envs.rounds.execute_grasp", execute)
    settings = {"policy": "x", "objects": "box", "max_failures": 9}
    plan = Targeted([cube_grasp(offset=(0, 0.06, 0))])
    record = run_round(cell, Scene("retrieve", 0, placements, target=1), plan, **settings)
    assert (record.ended, record.target_in_hand) == ("fell_off", False)
    record = run_round(cell, Scene("retrieve", 0, placements, target=0), plan, **settings)
    assert (record.ended, record.target_in_hand) == ("target", True)
    record = run_round(cell, Scene("pile", 0, placements), plan, **settings)
    assert (record.ended, record.objects_cleared, record.target_in_hand) == ("fell_off", 1, None)


def test_a_round_goes_on_elsewhere_after_a_failure(cell, box_set) -> None:
    """Before it tries the same place from another side, and comes back when nothing else is left:
    three grasps 13 cm beside the cube, which fail, are ranked before the cube's."""
    beside = [
        replace(cube_grasp(offset=(0.13, y, 0)), angle=angle, quality=0.9)
        for y, angle in ((0, 0.0), (0, 1.0), (0.03, 0.0))
    ]

    def ended(quality: float, calibration: Calibration | None) -> tuple[str, int]:
        plan = planner_of([*beside, replace(cube_grasp(), quality=quality)])
        plan.calibration = calibration
        scene = cube_scene(box_set)
        record = run_round(cell, scene, plan, policy="x", objects="box", max_failures=2)
        return record.ended, record.executed

    chances = Calibration(1.0, 0.0)
    assert ended(0.6, chances) == ("cleared", 2)
    assert ended(0.4, chances) == ("failures", 2), "more likely to fail"
    assert ended(0.6, None) == ("failures", 2), "a score tells nothing of likelihood"


def test_what_slipped_is_lifted_firmly(cell, box_set, monkeypatch) -> None:
    """The attempt after one that lost what it had gripped, until another reason or a success."""
    firmly, reasons = [], iter(("slipped", "dropped", "missed", "slipped", "success"))

    def execute(cell, grasp, approach, **how):
        firmly.append(how["firmly"])
        return GraspOutcome(next(reasons), 3.0)

    monkeypatch.setattr("envs.rounds.execute_grasp", execute)
    scene = cube_scene(box_set)
    plan = planner_of([cube_grasp()])
    with pytest.raises(StopIteration):
        run_round(cell, scene, plan, policy="x", objects="box", max_failures=9)
    assert firmly == [False, True, True, False, True, False]


def test_what_the_arm_cannot_reach_is_passed_over(cell, box_set) -> None:
    """A hand that comes back towards the robot, level with the table."""
    cell.load(cube_scene(box_set))
    away = Grasp(np.array([0.5, 0.0, 0.03]), 0.0, 0.08, 1.0, np.array([-1.0, 0.0, 0.0]))
    tilted = replace(cube_grasp(), approach=np.array([0.0, 0.5, -np.sqrt(0.75)]))
    far = cube_grasp(offset=(1.0, 0.0, 0.0))
    assert [*map(id, within_reach(cell, [away, tilted, far]))] == [id(tilted), id(far)]
    record = run_round(
        cell, cube_scene(box_set), planner_of([away, away]), policy="x", objects="box",
        max_failures=2,
    )  # fmt: skip
    assert (record.ended, record.executed) == ("no_plan", 0)  # nothing moved
    assert record.attempts[0].detail == "all planned grasps (2) are out of reach"
    plan = planner_of([away, replace(cube_grasp(), quality=0.4)])
    record = run_round(
        cell, cube_scene(box_set), plan, policy="x", objects="box", max_failures=2, abstain=0.5
    )
    some = "all planned grasps that are worth trying (1 of 2) are out of reach"
    assert record.attempts[0].detail == some


def test_a_palm_that_was_stopped_comes_down_less_deep(cell, box_set) -> None:
    """A cube 60 mm high, grasped 12 mm over the table: the palm, 39 mm over E, meets its top
    when E is 21 mm up. The same grasp again, raised over that, succeeds."""
    deep = cube_grasp(offset=(0, 0, -0.018))
    heights = []
    record = run_round(
        cell, cube_scene(box_set), planner_of([deep]), policy="x", objects="box",
        max_failures=2, on_attempt=lambda frame, grasp, outcome: heights.append(
            (grasp.position[2], outcome.palm_stopped_at)
        ),
    )  # fmt: skip
    assert [attempt.reason for attempt in record.attempts] == ["collision", "success"]
    (first, stopped), (second, not_stopped) = heights
    assert first == pytest.approx(0.012) and stopped[2] == pytest.approx(0.021, abs=0.002)
    assert second == pytest.approx(stopped[2] + ROOM_OVER_TOUCH) and not_stopped is None


def test_a_round_goes_through_the_plan_until_something_succeeds(cell, box_set) -> None:
    """What failed is remembered, all of it, and forgotten after a success: the planner names the
    same two grasps out of reach before the cube's each time."""
    places = [(0.5, -0.08, 0.03), (0.5, 0.08, 0.03)]
    scene = Scene(
        "packed", 0, tuple(Placement(box_set[0], np.array(p), np.eye(4)[3]) for p in places)
    )
    bad = [Grasp(np.array([1.5, y, 0.03]), 0.0, 0.08, 1.0) for y in (0.0, 0.1)]
    good = [Grasp(np.array(p), 0.0, 0.08, 0.4) for p in places]  # too poor to come first
    tried = []

    def plan(frame):
        return [*bad, good[2 - len(cell.remaining)]]  # the cubes one after the other

    record = run_round(
        cell, scene, plan, policy="x", objects="box", max_failures=3,
        on_attempt=lambda frame, grasp, outcome: tried.append(grasp),
    )  # fmt: skip
    assert [id(grasp) for grasp in tried] == [id(g) for g in (*bad, good[0], *bad, good[1])]
    assert [attempt.success for attempt in record.attempts] == [False, False, True] * 2
    assert (record.ended, record.objects_cleared) == ("cleared", 2)


def test_attempts_at_what_does_not_fit_the_hand_are_counted_apart(cell, config, box_set) -> None:
    """A cube of 6 cm, and beside it one of 9 cm that is tried first."""
    wide = load_object_set("box", scale=1.5, cache_dir=config.cache_folder)[0]
    places = [(0.5, -0.1, 0.03), (0.5, 0.1, 0.045)]
    scene = Scene(
        "packed",
        0,
        tuple(Placement(m, np.array(p), np.eye(4)[3]) for m, p in zip((box_set[0], wide), places)),
    )
    plans = iter([places[1], places[0], places[1], places[1]])

    def plan(frame):
        return [Grasp(np.array(next(plans)), 0.0, 0.08, 1.0)]

    record = run_round(cell, scene, plan, policy="x", objects="box", max_failures=2)
    assert [attempt.success for attempt in record.attempts] == [False, True, False, False]
    assert [attempt.graspable for attempt in record.attempts] == [False, True, False, False]
    names = [scene.placements[index].model.name for index in (1, 0, 1, 1)]
    assert [attempt.aimed for attempt in record.attempts] == names
    assert (record.objects_total, record.ungraspable) == (2, 1)
    (row,) = summarise([record], 0)
    assert (row.attempts, row.successes, row.objects_total) == (4, 1, 2)
    assert (row.graspable_attempts, row.graspable_successes, row.graspable_total) == (1, 1, 1)
    assert "100 % 1/1, 100 % 1/1" in format_table([row])


def test_physics_that_blows_up_ends_the_round(cell, box_set, monkeypatch):
    def plan(frame):
        monkeypatch.setattr(type(cell.robot), "q", property(lambda robot: np.full(7, np.nan)))
        return [cube_grasp()]

    record = run_round(cell, cube_scene(box_set), plan, policy="x", objects="b", max_failures=2)
    assert record.ended == "physics"
    assert [attempt.reason for attempt in record.attempts] == ["physics"]


@pytest.mark.parametrize("step", [100, 450])  # on the way to the cube, and with it to the tray
def test_physics_that_blows_up_on_the_way_ends_the_round(cell, box_set, monkeypatch, step):
    def blow_up(cell):
        if cell.steps == step:
            monkeypatch.setattr(type(cell.robot), "q", property(lambda robot: np.full(7, np.nan)))

    monkeypatch.setattr(cell, "on_step", blow_up)
    plan, settings = planner_of([cube_grasp()]), {"policy": "x", "objects": "b"}
    record = run_round(cell, cube_scene(box_set), plan, max_failures=2, **settings)
    assert record.ended == "physics"
    assert [attempt.reason for attempt in record.attempts] == ["physics"]


def test_a_miscalibrated_round_plans_with_the_wrong_camera_pose(cell, box_set):
    """A centimetre off, in a direction of the scene's seed; levelling mends the height alone."""
    plan = Targeted([])
    scene = replace(cube_scene(box_set), seed=7)
    run_round(cell, scene, plan, policy="x", objects="b", max_failures=2, scenario="miscalibrated")
    (frame,) = plan.frames
    shift, _ = np.random.default_rng([7, 0, Stream.MOTION]).normal(size=(2, 3))
    off = 0.01 * shift / np.linalg.norm(shift)
    np.testing.assert_allclose(frame.T_WC[:2, 3], np.array([0.5, 0.0]) + off[:2], atol=1e-9)
    assert frame.T_WC[2, 3] == pytest.approx(0.8, abs=0.001)


class StoppedAtOnce(ClosedLoop):
    """A closed loop that keeps its latency and ends every attempt."""

    latencies = []

    def __init__(self, *arguments):
        self.latencies.append(arguments[-1])
        super().__init__(*arguments)

    def __call__(self, cell, grasp):
        raise GraspFailure("lost")


def test_a_late_image_is_later_by_the_time_that_it_takes_to_process(cell, box_set, monkeypatch):
    """0.1 s of the scenario and 0.02 s of the config."""
    slow = with_settings(cell.config, "closed_loop", {"compute_seconds": 0.02})
    monkeypatch.setattr(cell, "config", slow)
    monkeypatch.setattr("envs.rounds.ClosedLoop", StoppedAtOnce)
    monkeypatch.setattr(StoppedAtOnce, "latencies", [])
    settings = {"policy": "x", "objects": "b", "max_failures": 1, "controller": "ibvs"}
    for scenario in ("latency", "static"):
        run_round(
            cell, cube_scene(box_set), planner_of([cube_grasp()]), scenario=scenario, **settings
        )
    assert StoppedAtOnce.latencies == pytest.approx([0.12, 0.02])


def test_every_attempt_has_a_motion_of_its_own(cell, box_set, monkeypatch):
    """A conveyor's heading is drawn anew: up to 30 degrees from +y towards the middle, which lies
    towards +x here."""
    headings = []

    def note(cell, motion):
        headings.append(motion.heading)
        return contextlib.nullcontext()

    monkeypatch.setattr("envs.rounds.disturbed", note)
    scene = replace(cube_scene(box_set, (0.45, 0.0, 0.03)), seed=7)
    miss = cube_grasp(offset=(0.13, 0, 0))
    run_round(
        cell, scene, planner_of([miss]), policy="x", objects="b", max_failures=2,
        scenario="moving_5cm",
    )  # fmt: skip
    expected = [
        np.pi / 2 - np.random.default_rng([7, attempt, Stream.MOTION]).uniform(0, np.pi / 6)
        for attempt in (1, 2)
    ]
    assert headings == pytest.approx(expected)
    assert abs(expected[1] - expected[0]) > 0.01


def test_a_record_names_what_was_held_and_how_far_the_hand_leaned(cell, box_set):
    """The second of two cubes, gripped 40 degrees from straight above."""
    other = replace(box_set[0], name="other")
    level = np.array([0.0, 0.0, 0.0, 1.0])
    placements = (
        Placement(box_set[0], np.array([0.5, 0.12, 0.03]), level),
        Placement(other, np.array([0.5, 0.0, 0.03]), level),
    )
    tilt = np.deg2rad(40)
    approach = np.array([np.sin(tilt), 0.0, -np.cos(tilt)])
    grasp = Grasp(np.array([0.5, 0.0, 0.038]), np.pi / 2, 0.08, 1.0, approach)
    record = run_round(
        cell, Scene("packed", 0, placements), planner_of([grasp]), policy="x", objects="b",
        max_failures=1,
    )  # fmt: skip
    first = record.attempts[0]
    assert (first.success, first.held) == (True, "other")
    assert first.tilt == pytest.approx(0.6981, abs=1e-4)  # radians


class Planner:
    """A planner that keeps the seeds of its resets and raises an exception after one of them."""

    def __init__(self, failing_seed=None):
        self.failing_seed, self.seeds = failing_seed, []

    def reset(self, seed):
        self.seeds.append(seed)

    def __call__(self, frame):
        assert frame.truth is None
        if self.seeds[-1] == self.failing_seed:
            raise RuntimeError("no idea")
        return [cube_grasp()]


def test_a_planner_that_raises_ends_its_round_alone(cell, box_set):
    planner, settings = Planner(failing_seed=planner_seed(1)), {"objects": "box", "max_failures": 2}
    scenes = [Scene("isolated", seed, cube_scene(box_set).placements) for seed in range(3)]
    rounds = [run_round(cell, scene, planner, policy="mine:plan", **settings) for scene in scenes]
    assert [record.ended for record in rounds] == ["cleared", "planner_error", "cleared"]
    assert planner.seeds == [planner_seed(seed) for seed in range(3)], "reset for every round"
    (attempt,) = rounds[1].attempts
    assert attempt.reason == "planner_error" and rounds[1].executed == 0
    assert "mine:plan raised RuntimeError: no idea" in attempt.detail
    assert "test_rounds.py, line" in attempt.detail


@pytest.mark.parametrize("height", [0.85, -1000.0])
def test_a_grasp_that_no_camera_sees_ends_its_round(cell, box_set, height):
    """Behind the camera, which is 0.8 m over the table, or as far away as no picture shows."""

    def plan(frame):
        return [Grasp((0.5, 0.0, height), 0.0, 0.05, 1.0)]

    record = run_round(cell, cube_scene(box_set), plan, policy="x", objects="b", max_failures=2)
    assert record.ended == "planner_error" and "that its camera sees" in record.attempts[0].detail
    json.dumps(asdict(record), allow_nan=False)
    both = run_round(
        cell, cube_scene(box_set), lambda frame: [*plan(frame), cube_grasp()], policy="x",
        objects="b", max_failures=2,
    )  # fmt: skip
    assert both.ended == "cleared"


def test_a_call_that_raises_is_timed_itself(cell, box_set, monkeypatch):
    """The first call takes long and its grasp fails, the second raises soon."""
    now = [100.0]
    monkeypatch.setattr("envs.rounds.time", SimpleNamespace(perf_counter=lambda: now[0]))

    def plan(frame):
        if now[0] > 100:
            now[0] += 0.02
            raise RuntimeError("no idea")
        now[0] += 0.3
        return [cube_grasp(offset=(0.13, 0, 0))]

    record = run_round(cell, cube_scene(box_set), plan, policy="x", objects="b", max_failures=3)
    first, second = record.attempts
    assert second.reason == "planner_error"
    assert (first.plan_seconds, second.plan_seconds) == pytest.approx((0.3, 0.02))


def test_the_search_for_what_the_arm_reaches_is_timed(cell, box_set, monkeypatch):
    now = [100.0]
    monkeypatch.setattr("envs.rounds.time", SimpleNamespace(perf_counter=lambda: now[0]))

    def slow(*arguments):
        now[0] += 0.5
        return choose(*arguments)

    monkeypatch.setattr("envs.rounds.choose", slow)
    settings = {"policy": "x", "objects": "b", "max_failures": 1}
    record = run_round(cell, cube_scene(box_set), lambda frame: [cube_grasp()], **settings)
    assert [attempt.plan_seconds for attempt in record.attempts] == pytest.approx([0.5])


def test_a_planner_is_reset_with_a_number_that_does_not_give_the_scene_away(cell, box_set):
    class Planner:
        seeds = []

        def reset(self, seed):
            self.seeds.append(seed)

        def __call__(self, frame):
            return []

    scene = replace(cube_scene(box_set), seed=12)
    for _ in range(2):
        run_round(cell, scene, Planner(), policy="x", objects="b", max_failures=1)
    first, second = Planner.seeds
    assert first == second == planner_seed(12) != 12


@pytest.mark.parametrize("result", [None, 3, [(0.5, 0.0, 0.1)], np.zeros((2, 3))])
def test_a_planner_that_returns_something_else_is_named(cell, box_set, result):
    record = run_round(
        cell, cube_scene(box_set), lambda frame: result, policy="mine", objects="box",
        max_failures=2,
    )  # fmt: skip
    assert record.ended == "planner_error"
    assert "mine: a planner returns a list of Grasp" in record.attempts[0].detail


def test_a_privileged_planner_sees_the_truth(cell, box_set):
    class Privileged:
        needs_truth = True

        def __call__(self, frame):
            return [] if frame.truth is None else [cube_grasp()]

    scene, settings = cube_scene(box_set), {"policy": "x", "objects": "box", "max_failures": 1}
    assert run_round(cell, scene, Privileged(), **settings).ended == "cleared"
    assert run_round(cell, scene, lambda frame: Privileged()(frame), **settings).ended == "no_plan"
