"""What has to be moved aside before the target can be grasped."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from models.planner_candidates import with_chances
from models.planner_target import TargetPlanner
from models.planners import HeuristicPlanner, make_planner
from tests.helpers.box_frames import FLAT, TALL, boxes_frame
from utils.calibration import Calibration
from utils.errors import UserError
from utils.geometry import GripperGeometry, Workspace
from utils.transforms import Grasp, RGBDFrame

FAR = ((0.04, 0.06, 0.05), 0.0, (0.5, 0.11))


def plan_for(name: str = "heuristic") -> TargetPlanner:
    return TargetPlanner(make_planner(name, GripperGeometry(), Workspace(), 0))


def frame_of(boxes, wanted=FLAT) -> RGBDFrame:
    """The frame of boxes, with the pixels of the wanted one as its target."""
    frame = boxes_frame(boxes)
    points = frame.points()
    size, _, place = wanted
    inside = (np.abs(points[..., :2] - place) < np.array(size[:2]) / 2 + 0.001).all(axis=-1)
    return replace(
        frame, target=inside & (points[..., 2] > 0.004) & (points[..., 2] < size[2] + 0.001)
    )


def is_of(grasp: Grasp, box) -> bool:
    size, _, place = box
    return bool((np.abs(grasp.position[:2] - place) < np.array(size[:2]) / 2 + 0.003).all())


def test_a_free_target_is_grasped_as_the_planner_would() -> None:
    plan, frame = plan_for(), frame_of([FLAT, FAR])
    grasps = plan(frame)
    assert grasps and [g.quality for g in grasps] == [g.quality for g in plan.plan(frame)]
    assert all(is_of(grasp, FLAT) for grasp in grasps)


@pytest.mark.parametrize("name", ["heuristic", "graspnet"])
def test_a_low_target_is_found_beside_something_high(name: str) -> None:
    """A ruler of 5.2 mm, lower than what GraspNet takes for table where it looks for a pile."""
    ruler, mug = ((0.02, 0.10, 0.0052), 0.0, (0.43, -0.10)), ((0.06, 0.06, 0.08), 0.3, (0.55, 0.10))
    grasps = plan_for(name)(frame_of([ruler, mug], ruler))
    assert grasps and all(is_of(grasp, ruler) for grasp in grasps)


def test_a_planner_keeps_its_own_order_of_the_targets_grasps() -> None:
    """As one does that prefers steep approaches to likelier ones."""

    class Backwards(HeuristicPlanner):
        def __call__(self, frame: RGBDFrame) -> list[Grasp]:
            return super().__call__(frame)[::-1]

    plan, frame = TargetPlanner(Backwards(GripperGeometry(), Workspace())), frame_of([FLAT, FAR])
    qualities = [grasp.quality for grasp in plan(frame)]
    best = max(grasp.quality for grasp in plan.plan(replace(frame, target=None)))
    sure = [quality for quality in qualities if quality >= plan.settings.share * best]
    assert len(set(sure)) > 1 and sure == sorted(sure) == qualities[: len(sure)]
    others = qualities[len(sure) :]
    assert others == sorted(others, reverse=True)


def test_a_planner_of_another_project_needs_no_workspace() -> None:
    """The attributes of docs/planner.md alone; its chances are those of `Calibration(1, 0)`."""
    own = make_planner("heuristic", GripperGeometry(), Workspace(), 0)

    class Plain:
        calibration = Calibration(1.0, 0.0)

        def segments(self, frame: RGBDFrame) -> np.ndarray:
            return own.segments(frame)

        def __call__(self, frame: RGBDFrame) -> list[Grasp]:
            return own(frame)

    assert is_of(TargetPlanner(Plain())(frame_of([FLAT, FAR]))[0], FLAT)


@pytest.mark.parametrize("name", ["heuristic", "oracle"])
def test_neighbours_in_the_way_come_first_and_the_target_when_they_are_gone(name: str) -> None:
    plan = plan_for(name)
    first = plan(frame_of([FLAT, *TALL, FAR]))[0]
    assert any(is_of(first, box) for box in TALL)
    # With both gone the target is free; the box 11 cm away is never touched.
    assert is_of(plan(frame_of([FLAT, FAR]))[0], FLAT)


def test_a_rough_frame_moves_nothing_aside_that_a_smooth_one_leaves() -> None:
    """Its roughness lowers every chance under 0.9: no grasp gets more promising than another."""
    calibration = Calibration(2.0, 3.0, 2000.0)
    plan = HeuristicPlanner(GripperGeometry(), Workspace())
    beside = ((0.04, 0.06, 0.05), 0.0, (0.5, 0.085))
    frame, rng = frame_of([FLAT, beside]), np.random.default_rng(0)
    noise = rng.normal(0, 0.0015, frame.depth.shape).astype(np.float32)
    rough = replace(frame, depth=frame.depth + noise)
    assert calibration(1.0) > 0.9 > calibration(2.0, 0.0015)
    plan.calibration = calibration
    for seen in (frame, rough):
        assert is_of(TargetPlanner(plan)(seen)[0], FLAT)
        assert TargetPlanner(plan).clearing(seen, plan(seen)) == []


def test_scores_that_are_no_chances_are_compared_with_each_other_alone() -> None:
    """The same planner without its calibration, and all of its scores divided by a thousand: what
    goes first is the same, of a free target and of one that is walled in."""

    class Faint(HeuristicPlanner):
        def __call__(self, frame: RGBDFrame) -> list[Grasp]:
            return [replace(g, quality=g.quality / 1000) for g in super().__call__(frame)]

    beside = ((0.04, 0.06, 0.05), 0.0, (0.5, 0.085))
    for boxes in ([FLAT, beside], [FLAT, *TALL, FAR]):
        frame = frame_of(boxes)
        known, scored, faint = (
            TargetPlanner(plan)(frame)
            for plan in (
                make_planner("heuristic", GripperGeometry(), Workspace(), 0),
                HeuristicPlanner(GripperGeometry(), Workspace()),
                Faint(GripperGeometry(), Workspace()),
            )
        )
        first = [grasps[0].position for grasps in (known, scored, faint)]
        np.testing.assert_array_equal(first[1], first[2])
        assert is_of(known[0], FLAT) == is_of(scored[0], FLAT) == (boxes[1] is beside)


def test_chances_that_are_never_low_do_not_make_every_grasp_promising() -> None:
    """The target's grasps have a fiftieth of the score of all others. By a calibration that gives
    even the least score a chance over 0.9, the scores decide."""

    flat = Calibration(0.05, 3.5)

    class Poor(HeuristicPlanner):
        def __call__(self, frame: RGBDFrame) -> list[Grasp]:
            scored = [
                replace(grasp, quality=0.02 if is_of(grasp, FLAT) else 1.0)
                for grasp in super().__call__(frame)
            ]
            return with_chances(sorted(scored, key=lambda grasp: -grasp.quality), flat)

    beside = [((0.03, 0.09, 0.06), 0.0, (0.5 + side * 0.065, 0.0)) for side in (-1, 1)]
    plan, frame = Poor(GripperGeometry(), Workspace()), frame_of([FLAT, *beside])
    plan.calibration = flat
    assert flat(0.0) > 0.94
    assert is_of(plan(frame)[0], FLAT)  # which can be grasped as it lies
    assert any(is_of(TargetPlanner(plan)(frame)[0], box) for box in beside)


def test_what_lies_where_the_target_was_last_seen_is_moved_aside() -> None:
    plan = plan_for()
    plan(frame_of([FLAT, *TALL, FAR]))
    cover = ((0.04, 0.10, 0.06), 0.0, (0.5, 0.0))  # has fallen over it
    hidden = boxes_frame([cover, FAR])
    hidden = replace(hidden, target=np.zeros(hidden.depth.shape, bool))
    assert is_of(plan(hidden)[0], cover)
    plan.reset(1)  # another scene: the target has never been seen
    assert plan(hidden) == []


def test_of_what_cannot_be_grasped_yet_the_neighbours_are_moved_aside() -> None:
    """The neighbours of the target are wider than the hand; a third object stands beside each."""
    wide = [((0.085, 0.10, 0.05), 0.0, (0.5 + side * 0.0625, 0.0)) for side in (-1, 1)]
    third = ((0.03, 0.05, 0.08), 0.0, (0.57, 0.085))
    plan = plan_for()
    frame = frame_of([FLAT, *wide, third])
    assert plan.plan(frame) == []
    assert is_of(plan(frame)[0], third)


def test_a_frame_without_a_target_is_planned_as_ever() -> None:
    plan, frame = plan_for(), boxes_frame([FLAT, FAR])
    np.testing.assert_equal([g.quality for g in plan(frame)], [g.quality for g in plan.plan(frame)])


def test_a_planner_that_cannot_tell_objects_apart_is_refused() -> None:
    with pytest.raises(UserError, match=r"segments\(frame\)"):
        plan_for("random")
