"""All views of a fan at once: the maps, the stages and the grasps are those of NumPy and OpenCV."""

from __future__ import annotations

import copy
from dataclasses import fields, replace

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from models import fan_measure, fan_search
from models.fan_candidates import FanCandidates
from models.fan_views import FanViews, fan_views, highest_within
from models.grasp_critic import critic_inputs, shipped_critic
from models.planner_candidates import Candidates
from models.planner_fan import SEARCH, turns_between
from models.planner_graspnet import GraspNetFanPlanner
from models.planner_measure import measure, turn_onto_faces, without_bumps
from models.planner_runs import dense_candidates
from tests.helpers.box_frames import boxes_frame, shelf_frame
from tests.helpers.ridges import across, ridge_on_a_slab
from utils.geometry import GripperGeometry, Workspace
from utils.height_map import OTHER_LABEL, WALL_LABEL, HeightMap, tilted_height_map, tilted_view
from utils.seen_heights import without_holes
from utils.transforms import DOWN, RGBDFrame, look_at

CPU = torch.device("cpu")
GPU = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
BOXES = [
    ((0.05, 0.05, 0.05), 0.4, (0.47, 0.03)),
    ((0.03, 0.10, 0.12), 1.0, (0.56, -0.05)),
    ((0.06, 0.04, 0.03), 2.0, (0.43, -0.09)),
]
ASIDE = look_at((0.5, 0.45, 0.6), (0.5, 0.0, 0.03), (0.0, 0.0, 1.0))  # 38 degrees off the vertical
SIDES = [np.array(DOWN)] + [
    np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), -np.cos(tilt)])
    for tilt, turn in ((0.5, 0.3), (1.05, 2.0), (1.05, 4.5), (1.48, 1.6))
]


def frame_of(noise: float = 0.0, holes: bool = False) -> RGBDFrame:
    """Three boxes seen from aside; noise: m, standard deviation of the depth."""
    frame = boxes_frame(BOXES, T_WC=ASIDE)
    generator = np.random.default_rng(3)
    depth = frame.depth + generator.normal(0, noise, frame.depth.shape).astype(np.float32)
    if holes:
        depth[90:96, 60:140] = 0
        depth[150:190, 20:60] = 0  # too wide to be filled
    return replace(frame, depth=depth)


def both(frame: RGBDFrame, others: bool = False) -> tuple[list[HeightMap], FanViews]:
    """The maps of SIDES, one by one and at once; others: the first object alone is the target."""
    planner = GraspNetFanPlanner(GripperGeometry(), Workspace())
    overhead = planner.heights(frame)
    if others:
        label = np.where(overhead.label > 0, OTHER_LABEL, overhead.label)
        overhead = replace(overhead, label=label)
    holeless = without_holes(frame, planner.workspace)
    frames = np.stack([tilted_view(side, planner.workspace) for side in SIDES])
    single = [tilted_height_map(overhead, *holeless, T_WV) for T_WV in frames]
    return single, fan_views(overhead, *holeless, frames, CPU)


# What both kinds of candidates have.
COLUMNS = [field.name for field in fields(Candidates) if field.name != "offset"]


def tensors(found: Candidates, view: int) -> FanCandidates:
    """Candidates of one map as those of a view, whose hands all stand over the middle."""
    columns = (torch.from_numpy(np.array(getattr(found, name))) for name in COLUMNS)
    return FanCandidates(torch.full((len(found),), view), *columns, torch.ones(len(found)).double())


# --- Maps -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("noise", "holes"), [(0.0, False), (0.002, True)])
def test_the_maps_are_those_of_each_view(noise, holes) -> None:
    """Up to cells on whose border a point lies: 32-bit points fall on either side of it."""
    single, views = both(frame_of(noise, holes))
    assert len(views) == len(SIDES)
    for number, heights in enumerate(single):
        for name in ("height", "ceiling", "label"):
            expected, found = getattr(heights, name), getattr(views, name)[number].numpy()
            other = np.abs(found - expected) > 1e-4
            assert other.mean() < 1e-3, (number, name, other.sum())
        centres = views.centres[number, : len(heights.centres)].numpy()
        np.testing.assert_allclose(centres, heights.centres, atol=1e-12)
        np.testing.assert_allclose(views.table[number].numpy(), heights.table(), atol=1e-6)


@given(st.integers(0, 3), st.integers(0, 2), st.integers(0, 4), st.integers(0, 2**31))
def test_the_highest_within_a_window_is_opencvs(above, left, right, seed) -> None:
    image = np.random.default_rng(seed).random((9, 11), np.float32)
    kernel = np.ones((2 * above + 1, left + right + 1), np.uint8)
    expected = cv2.dilate(image, kernel, anchor=(left, above))
    found = highest_within(torch.from_numpy(image)[None], above, (left, right))[0]
    np.testing.assert_array_equal(found.numpy(), expected)


# --- Stages -----------------------------------------------------------------------------------


@given(st.integers(-10_000, 40_000))
def test_the_underside_of_a_finger_is_that_of_its_outline(micrometres) -> None:
    gripper, outward = GripperGeometry(), 1e-6 * micrometres
    found = fan_measure._outline(gripper.finger_outline, torch.tensor([outward]).double())
    assert float(found[0]) == pytest.approx(float(gripper.finger_underside(np.array(outward))))


@given(st.lists(st.tuples(st.integers(0, 2), st.floats(0, 0.05), st.floats(0, 3.1)), max_size=12))
def test_of_like_candidates_the_first_stays_in_each_view(rows) -> None:
    rows.sort(key=lambda row: row[0])
    view, x, angle = np.array(rows).reshape(-1, 3).T
    xy = np.column_stack([x, np.zeros(len(x))])
    found = Candidates.rough(xy, angle, x, x, np.ones(len(x)))
    expected = [
        np.column_stack([part.xy[:, 0], part.angle])
        for number in range(3)
        for part in [found.take(view == number).distinct(4, 0.01, 0.3)]
    ]
    batch = replace(tensors(found, 0), view=torch.from_numpy(view).long()).distinct(4, 0.01, 0.3)
    kept = np.column_stack([batch.xy[:, 0], batch.angle])
    np.testing.assert_array_equal(kept, np.concatenate(expected))


@pytest.mark.parametrize("name", ["panda", "fully open", "least held", "target"])
def test_each_stage_is_that_of_one_view(name: str) -> None:
    """The first stage may round a place on a turned map to another cell; what is measured, and what
    the critic says of it, is the same to rounding."""
    gripper = {
        "fully open": GripperGeometry(opens_fully=True),
        "least held": GripperGeometry(least_held=0.032),
    }.get(name, GripperGeometry())
    workspace, critic = Workspace(), shipped_critic()
    single, views = both(frame_of(0.001), others=name == "target")
    feasible = 0
    for number, heights in enumerate(single):
        one = views.part(number, number + 1)
        heights = replace(
            heights, height=one.height[0].numpy(), ceiling=one.ceiling[0].numpy(),
            label=one.label[0].numpy(),
        )  # fmt: skip
        expected = dense_candidates(heights.every(2), gripper, workspace, SEARCH)
        expected = expected.take(expected.score > 0)
        found = fan_search.dense_candidates(one.every(2), gripper, workspace, SEARCH)
        assert all(part.dtype in (torch.int64, torch.float64) for part in vars(found).values())
        if len(expected):
            assert alike_rough(found, expected) >= 0.97
        rough = expected.best(80)
        expected, found = (
            measure(rough, heights, gripper, SEARCH),
            fan_measure.measure(tensors(rough, 0), one, gripper, SEARCH),
        )
        feasible += (expected.score > 0).sum()
        assert_same(found, expected)
        expected = expected.best(60)
        if len(expected) == 0:
            continue
        expected, found = (
            turn_onto_faces(expected, heights, gripper, SEARCH),
            fan_measure.turn_onto_faces(found.best(60), one, gripper, SEARCH),
        )
        assert_same(found, expected)
        towards, value = np.array([0.6, 0.0, 0.8]), np.linspace(0.1, 0.9, len(expected))
        inputs = critic_inputs(expected, heights, value, towards, gripper.least_held)
        found = replace(found, value=torch.from_numpy(value))
        chance = fan_search.chances(found, one, towards, gripper.least_held, critic)
        np.testing.assert_allclose(chance.detach(), critic.chance(inputs), atol=1e-4)
    assert feasible > 20


@pytest.mark.parametrize("label", [0, OTHER_LABEL, -1, WALL_LABEL])
@pytest.mark.parametrize("rise", [0.011, 0.013])
def test_bumps_are_those_of_one_view(label: int, rise: float) -> None:
    """A ridge over a slab with this label on both sides, in noise that makes bumps of 12 mm."""
    heights = ridge_on_a_slab(rise, 0.0024, label)
    labels = np.where(heights.height > heights.height.min(), 0, label)
    maps = (heights.height, heights.ceiling, labels, heights.centres, heights.T_WV)
    views = FanViews(
        *(torch.from_numpy(part.copy())[None] for part in maps), tuple(heights.origin),
        heights.cell, 0.0, noise=heights.noise,
    )  # fmt: skip
    for depth in (0.0045, 0.008):  # of which the first is less than noise may raise a cell
        found = across(heights, depth)
        held = fan_measure.without_bumps(tensors(found, 0), views, GripperGeometry())
        expected = without_bumps(found, replace(heights, label=labels), GripperGeometry())
        kept = depth > 0.0048 and (rise > 0.012 or label in (-1, WALL_LABEL))
        assert len(held) == len(expected) == kept


def alike_rough(found: FanCandidates, expected: Candidates) -> float:
    """The smaller share of either whose place, angle, height, width and score the other has."""
    rows, scores = [], []
    for part in (found, expected):
        numbers = (part.xy, part.angle, part.tip, part.width, part.score)
        xy, angle, tip, width, score = map(np.asarray, map(torch.as_tensor, numbers))
        rows.append(np.column_stack([xy, 10 * angle, 10 * tip, width]))
        scores.append(score)
    same = np.abs(rows[0][:, None] - rows[1]).max(axis=2) < 1e-4
    same &= np.abs(scores[0][:, None] - scores[1]) < 1e-3
    return min(same.any(axis=0).mean(), same.any(axis=1).mean())


def assert_same(found: FanCandidates, expected: Candidates) -> None:
    """All columns of the candidates; of infeasible ones the score alone."""
    np.testing.assert_allclose(found.score, expected.score, atol=1e-6)
    some = expected.score > 0
    assert not expected.offset.any()
    for name in COLUMNS:
        ours, theirs = getattr(found, name).numpy(), getattr(expected, name)
        np.testing.assert_allclose(ours[some], theirs[some], atol=1e-6, err_msg=name)


# --- Planner ----------------------------------------------------------------------------------


KINDS = {
    "plain": {},
    "fully open": {"opens_fully": True},
    "least held": {"least_held": 0.032},
    "target": {},
    "cut off": {},
    "flat": {},
}


def kind_of_frame(kind: str) -> RGBDFrame:
    if kind == "cut off":  # by the border of the image
        return boxes_frame([*BOXES, ((0.2, 0.05, 0.05), 0.0, (0.5, 0.23))])
    if kind == "flat":  # so that only relaxed margins fit
        return boxes_frame([((0.03, 0.12, 0.0095), 0.4, (0.5, 0.0))], T_WC=ASIDE)
    frame = frame_of(0.001)
    if kind == "target":
        segments = GraspNetFanPlanner(GripperGeometry(), Workspace()).segments(frame)
        frame = replace(frame, target=segments == segments.max())
    return frame


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=GPU)])
def test_the_grasps_are_those_of_one_view_after_the_other(device: str, kind: str) -> None:
    gripper = GripperGeometry(**KINDS[kind])
    by_view = GraspNetFanPlanner(gripper, Workspace(), likely=np.inf)
    assert not by_view.at_once, "on two cores NumPy is quicker"
    saved = by_view.network
    saved = saved._replace(model=copy.deepcopy(saved.model).to(device))
    planner = GraspNetFanPlanner(gripper, Workspace(), network=saved, likely=np.inf)
    assert planner.at_once == (device == "cuda")
    planner.at_once = True
    frame = kind_of_frame(kind)
    planner(boxes_frame(BOXES[:2]))  # what is recorded on a GPU serves any frame
    expected, found = by_view(frame), planner(frame)
    assert len(expected) >= 3
    assert len(found) == pytest.approx(len(expected), abs=2)
    assert found[0].quality == pytest.approx(expected[0].quality, abs=0.02)
    turns = turns_between(np.array([grasp.pose for grasp in (*expected, *found)]))
    away = np.array([[np.linalg.norm(a.position - b.position) for b in found] for a in expected])
    alike = (away < 0.004) & (turns[: len(expected), len(expected) :] < np.deg2rad(6))
    assert alike.any(axis=1).mean() >= 0.8
    worth = [g.quality * float(planner.fan.preference(np.array(g.tilt))) for g in found]
    assert worth == pytest.approx(sorted(worth, reverse=True), abs=1e-12)


def test_a_camera_in_32_bits_gives_the_same_grasps() -> None:
    planner = GraspNetFanPlanner(GripperGeometry(), Workspace(), likely=np.inf)
    planner.at_once = True
    frame = boxes_frame(BOXES)
    single = replace(frame, K=frame.K.astype(np.float32), T_WC=frame.T_WC.astype(np.float32))
    assert len(planner(single)) == planner.fan.returned


def test_another_judge_judges_view_by_view() -> None:
    planner = GraspNetFanPlanner(GripperGeometry(), Workspace())
    planner.at_once = True
    planner.judge = lambda heights, found, inputs: np.full(len(found), 0.25)
    assert {grasp.quality for grasp in planner(boxes_frame(BOXES))} == {0.25}


def test_an_empty_table_has_no_grasp() -> None:
    planner = GraspNetFanPlanner(GripperGeometry(), Workspace())
    planner.at_once = True
    assert planner(boxes_frame([])) == []


def test_a_shelf_is_searched_view_by_view(monkeypatch) -> None:
    """Fixtures and second frames are left to NumPy."""
    planner = GraspNetFanPlanner(GripperGeometry(), Workspace())
    planner.at_once = True
    monkeypatch.setattr(planner, "_searched_at_once", None)
    monkeypatch.setattr(planner, "_above", None)
    frame = shelf_frame([((0.05, 0.05, 0.12), 0.3, (0.5, -0.02))])
    assert planner(frame), "nor is it looked at from straight above"
    planner.likely = np.inf
    plain = boxes_frame(BOXES)
    assert planner(replace(plain, second=plain))
