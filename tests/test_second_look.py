"""The arm that looks a second time: when, from where, and what it costs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from envs.cell import ROBOT
from envs.cell_layout import Scene
from envs.evaluation_worker import check_everything
from envs.rounds import run_round
from envs.second_look import CM3, SecondLook, way_to_look, wrist_frame
from envs.simulators import cell_class
from tests.helpers.cubes import cube_scene
from tests.helpers.simulators import INSTALLED
from utils.config import DEFAULTS, load_config
from utils.errors import UserError

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
    first = cell.frame()
    places = np.array([cell.object_position(index) for index in (0, 1)])
    look = SecondLook(cell, 20 * CM3, lambda frame: frame)
    frame = look(first)
    assert frame.second is not None and first.second is None
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
    frame = SecondLook(cell, 20 * CM3, lambda frame: frame)(cell.frame())
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
        assert look(frame) is frame
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


class Watcher:
    """A planner that keeps its frames and finds nothing."""

    def __init__(self, needs_truth: bool):
        self.needs_truth = needs_truth
        self.frames = []

    def __call__(self, frame):
        self.frames.append(frame)
        return []


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
    assert (record.attempts[0].sim_seconds > 0.5) == (not needs_truth)
