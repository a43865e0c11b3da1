"""The arm that looks a second time: when, from where, and what it costs."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from envs import second_look
from envs.arm_paths import scales
from envs.cell import ROBOT, PhysicsError
from envs.cell_layout import Box, Scene
from envs.evaluation_worker import check_everything
from envs.robot_kinematics import choose_posture
from envs.rounds import run_round
from envs.second_look import (
    CM3,
    SecondLook,
    _is_clear,
    box_around,
    known_heights,
    way_to_look,
    wrist_frame,
)
from envs.simulators import cell_class
from tests.helpers.box_frames import boxes_frame
from tests.helpers.cubes import cube_scene
from tests.helpers.simulators import INSTALLED
from utils.config import DEFAULTS, load_config
from utils.errors import UserError
from utils.geometry import Workspace
from utils.height_map import HeightMap
from utils.next_view import OpenSpace
from utils.transforms import Grasp, RGBDFrame, top_down_pose

AZIMUTH = 60.0  # degrees, of the first camera: clear of the arm


@pytest.fixture(scope="module", params=INSTALLED)
def cell(request):
    """One that a camera sees from the side, in each simulator."""
    words = [
        "sim.renderer=tiny", "camera.view=side", f"camera.side_azimuth_deg=[{AZIMUTH}, {AZIMUTH}]",
        "camera.side_tilt_deg=[50, 50]", "camera.depth_noise=realsense",
    ]  # fmt: skip
    with cell_class(request.param)(load_config(None, words)) as cell:
        yield cell


def two_cubes(box_set) -> Scene:
    scene = cube_scene(box_set, (0.45, 0.04, 0.03))
    other = replace(scene.placements[0], position=np.array([0.56, -0.05, 0.03]))
    return replace(scene, placements=(*scene.placements, other))


def test_the_second_frame_shows_the_other_side_and_leaves_all_as_it_was(cell, box_set) -> None:
    cell.load(two_cubes(box_set))
    places = np.array([cell.object_position(index) for index in (0, 1)])
    look = SecondLook(cell, 20 * CM3, lambda frame: frame)
    frame = look(cell.frame)
    assert frame.second is not None and look.remark == ""
    x, y = frame.second.T_WC[:2, 3] - (0.5, 0.0)
    opposite = np.rad2deg(np.arctan2(y, x)) - AZIMUTH - 180
    assert abs((opposite + 180) % 360 - 180) < 75
    assert set(np.unique(frame.second.segmentation)) >= {0, 1}
    assert ROBOT not in frame.second.segmentation  # the fingers are just outside the image
    np.testing.assert_allclose(cell.robot.q, cell.home, atol=0.01)
    still = np.array([cell.object_position(index) for index in (0, 1)])
    np.testing.assert_allclose(still, places, atol=1e-3)
    assert 0.5 < look.sim_seconds < 5 and look.plan_seconds > 0


def test_the_pose_of_the_second_frame_is_that_of_its_camera(cell, box_set) -> None:
    """What the two frames show of the table and of the cubes' tops is at one height."""
    cell.load(two_cubes(box_set))
    frame = SecondLook(cell, 20 * CM3, lambda frame: frame)(cell.frame)
    points = frame.second.points()
    for index in (0, 1):
        on = points[(frame.second.segmentation == index) & np.isfinite(points[..., 0])]
        place = cell.object_position(index)
        assert (np.abs(on - place) < 0.03 * np.sqrt(2) + 0.006).all()
        assert abs(np.quantile(on[:, 2], 0.9) - 0.06) < 0.004
    table = points[(frame.second.segmentation == -1)]
    near = np.abs(table[:, :2] - (0.5, 0.0)).max(axis=1) < 0.15
    assert abs(np.nanmedian(table[near, 2])) < 0.002


def test_no_look_is_taken_where_little_is_open_or_none_is_wanted(cell, box_set) -> None:
    cell.load(two_cubes(box_set))
    frame, steps = cell.frame(), cell.steps
    for least in (0.0, 1.0):  # 1 m3 is more than there is
        look = SecondLook(cell, least, lambda frame: frame)
        assert look(lambda: frame) is frame
        assert look.sim_seconds == 0.0 and cell.steps == steps
    assert way_to_look(cell, frame, 1e-6) is not None
    with pytest.raises(UserError, match="evaluate.second_look.* needs the whole arm"):
        check_everything(load_config(DEFAULTS, ["robot.arm=none", "evaluate.second_look=20"]))


def test_noise_of_the_second_frame_is_its_own_and_the_same_again(cell, box_set) -> None:
    cell.load(two_cubes(box_set))
    first = cell.frame()
    one, again = wrist_frame(cell).depth, wrist_frame(cell).depth
    np.testing.assert_array_equal(one, again)
    cell.load(two_cubes(box_set))
    wrist_frame(cell)
    np.testing.assert_array_equal(cell.frame().depth, first.depth)


def stopped_by_the_first_object(cell, monkeypatch) -> np.ndarray:
    """Let the arm feel 100 N 0.3 s after it has left home, when the first object jumps aside;
    where that object is then (3,)."""
    aside = cell.object_pose(0)
    aside[1, 3] += 0.08
    felt = []

    def force(robot) -> float:
        felt.append(cell.seconds)
        if felt[-1] < felt[0] + 0.3:
            return 0.0
        cell.carry(0, aside, np.zeros(3), 0.0)
        return 100.0

    monkeypatch.setattr(type(cell.robot), "external_force", force)
    return aside[:3, 3]


def test_after_a_contact_the_frame_is_taken_again(cell, box_set, monkeypatch) -> None:
    """The returned frame shows the cube where it is now, and the remark says what happened."""
    cell.load(two_cubes(box_set))
    before = cell.object_position(0).copy()
    now = stopped_by_the_first_object(cell, monkeypatch)
    go_home, put = second_look.go_home, "it was put there by hand"
    monkeypatch.setattr(second_look, "go_home", lambda cell: go_home(cell) or put)
    look = SecondLook(cell, 20 * CM3, lambda frame: frame)
    frame = look(cell.frame)
    assert frame.second is None and look.sim_seconds > 0.5
    points = frame.points()[frame.segmentation == 0]
    assert np.linalg.norm(np.nanmean(points, axis=0) - now) < 0.03 * np.sqrt(3)
    assert np.linalg.norm(now - before) > 0.07
    limit = cell.config.execution.contact_stop
    told = f"the second look was stopped: contact with 100.0 N, allowed are {limit} N"
    assert look.remark == f"{told}; {put}"
    np.testing.assert_allclose(cell.robot.q, cell.home, atol=0.01)
    monkeypatch.undo()
    assert look(cell.frame).second is not None and look.remark == ""  # of the last look alone


def test_a_round_says_that_a_look_was_stopped(cell, box_set, monkeypatch) -> None:
    scene = two_cubes(box_set)
    cell.load(scene)
    stopped_by_the_first_object(cell, monkeypatch)
    watcher = Watcher()
    record = run_round(
        cell, scene, watcher, policy="w", objects="box", max_failures=2, second_look=20.0
    )
    (attempt,), (frame,) = record.attempts, watcher.frames
    assert attempt.reason == "no_plan" and frame.second is None
    assert attempt.detail.startswith("the second look was stopped: contact with 100.0 N")


@pytest.mark.parametrize("by_planning", [True, False])
def test_physics_that_blow_up_during_a_look_end_the_round_alone(
    cell, box_set, monkeypatch, by_planning
) -> None:
    """Planning from joints that are not finite raises ValueError; else the positions tell it."""
    scene = two_cubes(box_set)
    cell.load(scene)

    def blown_up() -> None:
        raise PhysicsError("the robot's joint positions are not finite")

    def taken(cell) -> RGBDFrame:
        monkeypatch.setattr(cell, "check_physics", blown_up)
        if by_planning:
            raise ValueError("`y` must contain only finite values")
        return wrist_frame(cell)

    monkeypatch.setattr(second_look, "wrist_frame", taken)
    record = run_round(
        cell, scene, Watcher(), policy="w", objects="box", max_failures=2, second_look=20.0
    )
    assert [attempt.reason for attempt in record.attempts] == [record.ended] == ["physics"]


class Watcher:
    """A planner that keeps its frames and finds nothing, or fails."""

    def __init__(self, needs_truth: bool = False, fails: bool = False):
        self.needs_truth, self.fails = needs_truth, fails
        self.frames = []

    def __call__(self, frame):
        self.frames.append(frame)
        if self.fails:
            raise RuntimeError("no idea")
        return []


def assert_shows_table_and_first_cube(frame: RGBDFrame, cell) -> None:
    """The table at z = 0, and over 1 cm nothing near the first cube but that cube: its half
    diagonal and 6 mm."""
    points = frame.points()
    near = np.abs(points[..., :2] - (0.5, 0.0)).max(axis=-1) < 0.15
    low = near & (points[..., 2] < 0.01)
    assert low.sum() > 1000 and abs(np.median(points[low, 2])) < 0.002
    away = points - cell.object_position(0)
    on = (points[..., 2] > 0.01) & (np.linalg.norm(away[..., :2], axis=-1) < 0.07)
    assert on.sum() > 200 and (np.abs(away[on]) < 0.03 * np.sqrt(2) + 0.006).all()


@pytest.mark.parametrize("needs_truth", [False, True])
def test_a_round_takes_second_frames_for_planners_that_see_no_truth(
    cell, box_set, needs_truth
) -> None:
    watcher = Watcher(needs_truth)
    record = run_round(
        cell, two_cubes(box_set), watcher, policy="w", objects="box", max_failures=2,
        second_look=20.0,
    )  # fmt: skip
    (frame,) = watcher.frames
    assert (frame.second is None) == needs_truth
    if not needs_truth:
        assert frame.second.segmentation is None
        assert_shows_table_and_first_cube(frame.second, cell)
    assert (record.attempts[0].sim_seconds > 0.5) == (not needs_truth)


@pytest.mark.parametrize(("fails", "reason"), [(False, "no_plan"), (True, "planner_error")])
def test_a_look_counts_whatever_the_planner_makes_of_it(
    cell, box_set, monkeypatch, fails, reason
) -> None:
    """Its second and a half, and the choice of the view: 0.3 s here, where a plan takes 0.02 s."""
    now, watcher = [100.0], Watcher(fails=fails)
    for module in ("rounds", "second_look"):
        clock = SimpleNamespace(perf_counter=lambda: now[0])
        monkeypatch.setattr(f"envs.{module}.time", clock)

    def choose(*arguments):
        now[0] += 0.3
        return way_to_look(*arguments)

    def plan(frame):
        now[0] += 0.02
        return watcher(frame)

    monkeypatch.setattr(second_look, "way_to_look", choose)
    settings = {"policy": "w", "objects": "box", "max_failures": 2}
    (with_look,), (without,) = (
        run_round(cell, two_cubes(box_set), plan, **settings, second_look=cm3).attempts
        for cm3 in (20.0, 0.0)
    )
    assert with_look.reason == without.reason == reason
    assert with_look.sim_seconds > 0.5 and without.sim_seconds == 0.0
    assert (with_look.plan_seconds, without.plan_seconds) == pytest.approx((0.32, 0.02))


def test_a_look_adds_its_time_to_that_of_an_executed_attempt(cell, box_set) -> None:
    """The same grasp with a look before it and without differs by what the look alone takes, but
    for two of the checks, 0.05 s apart, in which the fingers come to rest."""
    scene = two_cubes(box_set)
    grasp = Grasp(np.array([0.45, 0.04, 0.03]), 0.0, 0.08, 1.0)
    settings = {"policy": "w", "objects": "box", "max_failures": 1}
    with_look, without = (
        run_round(cell, scene, lambda frame: [grasp], second_look=cm3, **settings).attempts[0]
        for cm3 in (20.0, 0.0)
    )
    cell.load(scene)
    look = SecondLook(cell, 20 * CM3, lambda frame: frame)
    look(cell.frame)
    assert look.sim_seconds > 0.5
    more = with_look.sim_seconds - without.sim_seconds
    assert more == pytest.approx(look.sim_seconds, abs=0.1)


# --- What stands in the arm's way -------------------------------------------------------------


def test_the_shadow_beside_an_object_is_table_where_it_has_the_tables_colour() -> None:
    """A red box on a grey table, seen from above; beside it a strip of 15 mm has no depth. Without
    its colour the box would be as much longer."""
    size, wide = (0.06, 0.08, 0.10), 0.015
    frame = boxes_frame([(size, 0.0, (0.5, 0.0))])
    x, y, z = np.moveaxis(frame.points(), -1, 0)
    rgb = np.where((z > 0.001)[..., None], (170, 40, 40), (150, 150, 150)).astype(np.uint8)
    shadow = (z < 0.001) & (abs(y) < 0.05) & (x > 0.53) & (x < 0.535 + wide)
    frame = replace(frame, rgb=rgb, depth=np.where(shadow, 0, frame.depth).astype(np.float32))
    heights = known_heights(frame, Workspace())
    box = box_around(heights)
    low, high = box.position - box.half_size, box.position + box.half_size
    # The eye, 0.8 m up, sees no table within 0.03 * 0.10 / 0.70 m of the box.
    np.testing.assert_allclose(low, (0.47, -0.04, 0.0), atol=0.008)
    np.testing.assert_allclose(high, (0.53, 0.04, 0.10), atol=0.008)
    space = OpenSpace(heights, Workspace())
    assert len(space.matter) * space.voxel == pytest.approx(np.prod(size), rel=0.12)


def flat_map(**raised: float) -> HeightMap:
    """Cells of 2 mm, 0 m high, from (0.3, -0.2) m on; one of them, in row 7 and column 4, may be
    raised."""
    height = np.zeros((20, 20), np.float32)
    ceiling = height.copy()
    ceiling[7, 4] = raised.get("to", 0.0)
    label = np.full(height.shape, -1)
    return HeightMap(height, ceiling, label, np.empty((0, 3)), np.array([0.3, -0.2]), 0.002, 0.0)


def test_the_box_around_one_cell_is_as_wide_as_the_cell() -> None:
    box = box_around(flat_map(to=0.05))
    np.testing.assert_allclose(box.half_size, (0.001, 0.001, 0.025), atol=1e-9)
    np.testing.assert_allclose(box.position, (0.308, -0.186, 0.025), atol=1e-9)


def test_nothing_on_the_table_is_in_no_ones_way(cell, box_set) -> None:
    """The hand goes to a place right over the first cell of an empty map."""
    cell.load(two_cubes(box_set))
    nothing = flat_map()
    assert box_around(nothing) is None
    pose = top_down_pose(np.array([*nothing.origin, 0.09]), 0.0)
    way = cell.robot.joint_move(cell.home, choose_posture(pose, cell.home), **scales(cell))
    assert _is_clear(cell, way, box_around(nothing))
    assert not _is_clear(cell, way, Box(np.zeros(3), np.array([*nothing.origin, 0.0])))
