"""Grasps from any side: tilted views, their maps, and planners that search a fan of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from envs.evaluation_worker import check_everything
from envs.object_primitives import FAMILIES, make_primitive
from envs.objects import load_object_set
from envs.rounds import NoGraspsError, checked_grasps
from models.grasp_critic import INPUTS
from models.planner_antipodal import search
from models.planner_candidates import Candidates, SearchSettings
from models.planner_fan import FanSettings, HeuristicFanPlanner, OracleFanPlanner, turns_between
from models.planner_measure import measure
from models.planners import PLANNERS, make_planner
from tests.helpers.box_frames import CORNERS, bin_walls, boxes_frame, shelf_frame
from utils.config import DEFAULTS, load_config
from utils.errors import UserError
from utils.geometry import ConvexSolid, GripperGeometry, SceneGeometry, SolidObject, Workspace
from utils.height_map import (
    WALL_LABEL,
    height_map_from_frame,
    height_map_from_scene,
    tilted_height_map,
    tilted_view,
)
from utils.seen_heights import table_slope, without_holes
from utils.transforms import DOWN, Grasp, tilt_rotation, transform_points

FLIP = np.diag([-1.0, -1.0, 1.0, 1.0])


def approaches(most: float = 89.0):
    """Unit vectors up to `most` degrees from straight down."""
    degrees = st.tuples(st.floats(0, most), st.floats(0, 360))
    return degrees.map(lambda both: approach(*both))


def approach(tilt: float, turn: float) -> np.ndarray:
    """The direction `tilt` degrees from straight down, towards `turn` degrees from W's x."""
    out = np.sin(np.deg2rad(tilt)) * np.array([np.cos(np.deg2rad(turn)), np.sin(np.deg2rad(turn))])
    return np.array([*out, -np.cos(np.deg2rad(tilt))])


def between(first: Grasp, second: Grasp) -> float:
    return turns_between(np.array([first.pose, second.pose]))[0, 1]


# --- Poses ------------------------------------------------------------------------------------


@given(approaches())
def test_the_tilt_is_the_least_rotation_from_straight_down(direction) -> None:
    """SciPy's rotation about the axis DOWN x direction by the angle between the two."""
    axis = np.cross(DOWN, direction)
    sine = np.linalg.norm(axis)
    angle = np.arctan2(sine, np.dot(DOWN, direction))
    expected = Rotation.from_rotvec(axis / sine * angle if sine > 1e-12 else axis).as_matrix()
    np.testing.assert_allclose(tilt_rotation(direction), expected, atol=1e-9)


@given(approaches(), st.floats(0, 3.14), st.booleans())
def test_a_grasp_is_its_pose_whichever_finger_is_left(direction, angle, flipped) -> None:
    grasp = Grasp(np.array([0.4, 0.1, 0.05]), angle, 0.06, 0.5, direction)
    np.testing.assert_allclose(grasp.pose[:3, 2], direction, atol=1e-12)
    np.testing.assert_allclose(grasp.pose[:3, 1], grasp.closing_direction, atol=1e-12)
    again = Grasp.from_pose(grasp.pose @ FLIP if flipped else grasp.pose, 0.06, 0.5)
    assert between(grasp, again) < 1e-6
    np.testing.assert_allclose(again.approach, direction, atol=1e-9)
    assert grasp.tilt == pytest.approx(np.arccos(-direction[2]), abs=1e-7)


@given(approaches(), st.floats(0, 3.14), st.floats(0, 1.5), st.integers(0, 2))
def test_the_turn_between_grasps_is_that_of_their_hands(direction, angle, turn, axis) -> None:
    """By up to 85 degrees about an axis of the hand; beyond a right angle a flip is nearer."""
    T = Grasp(np.zeros(3), angle, 0.06, 0.5, direction).pose
    turned = T.copy()
    turned[:3, :3] = T[:3, :3] @ Rotation.from_euler("xyz"[axis], turn).as_matrix()
    if turned[2, 2] < 0:  # not from below
        other = Grasp.from_pose(turned @ FLIP, 0.06, 0.5)
        grasp = Grasp.from_pose(T, 0.06, 0.5)
        assert between(grasp, other) == pytest.approx(turn, abs=1e-5)


@pytest.mark.parametrize(
    ("direction", "message"),
    [((0, 0, 1.0), "not point up"), ((0, 0, -2.0), "unit vector"), ((0, -1.0), "shape"),
     ((0, np.nan, -1.0), "non-finite")],
)  # fmt: skip
def test_an_approach_that_is_none_is_refused(direction, message) -> None:
    with pytest.raises(ValueError, match=message):
        Grasp(np.zeros(3), 0.0, 0.05, 1.0, np.array(direction))


def test_a_hand_that_points_up_makes_no_grasp() -> None:
    with pytest.raises(ValueError, match="not point up"):
        Grasp.from_pose(np.eye(4), 0.05, 1.0)


# --- Maps -------------------------------------------------------------------------------------


@given(approaches(85.0), st.floats(-2, 2))
def test_the_table_is_a_slope_in_a_tilted_view(direction, table) -> None:
    workspace = Workspace(table_height=table)
    T_WV = tilted_view(direction, workspace)
    origin, cell = np.array([0.45, -0.05]), 0.01
    slope = table_slope((7, 11), origin, cell, table, T_WV)
    row, column = np.mgrid[0:7, 0:11]
    points = np.stack([origin[0] + cell * column, origin[1] + cell * row, slope], axis=-1)
    near = abs(slope - table) < 0.9  # farther off, it ends
    np.testing.assert_allclose(transform_points(T_WV, points)[near, 2], table, atol=1e-6)


def test_a_table_seen_along_itself_is_a_wall_on_one_side() -> None:
    """A hand that comes along W's x: V's x points up in W, or down."""
    T_WV = tilted_view(np.array([1.0, 0.0, 0.0]), Workspace())
    slope = table_slope((3, 40), np.array([0.4, 0.0]), 0.005, 0.0, T_WV)
    column = np.arange(40) * 0.005 + 0.4
    height = transform_points(T_WV, np.column_stack([column, 0 * column, 0 * column]))[:, 2]
    assert (slope[1, height < -0.03] > 0.9).all() and (slope[1, height > 0.03] < -0.9).all()


@pytest.mark.parametrize("tilt", [0, 20, 40])
def test_a_tilted_map_of_an_image_is_that_of_the_solids(tilt) -> None:
    """A box under a camera straight above, which does not see its flanks: where the view meets its
    top, the two maps agree; the rest of the box is below the ceiling."""
    workspace = Workspace()
    frame = boxes_frame([((0.06, 0.08, 0.05), 0.4, (0.5, 0.0))])
    T_WV = tilted_view(approach(tilt, 30), workspace)
    overhead = height_map_from_frame(frame, workspace)
    seen = tilted_height_map(overhead, *without_holes(frame, workspace), T_WV)
    exact = height_map_from_scene(frame.truth, workspace, cell=0.002, T_WV=T_WV)
    row, column = np.indices(exact.height.shape)
    place = exact.origin + exact.cell * np.stack([column, row], axis=-1)
    rise = exact.rise(np.dstack([place, exact.height]))
    on_top = rise > 0.0495
    assert on_top.sum() > 700
    # Cells at the edge may hold the table beside it, and none more than a cell's slope is off.
    close = abs(seen.height - exact.height)[on_top] < 0.002
    assert close.mean() > 0.95
    assert (seen.label[on_top] == 0).mean() > 0.97
    assert (seen.ceiling > exact.height - 0.004).mean() > 0.995
    np.testing.assert_allclose(
        transform_points(T_WV, seen.centres), [[0.5, 0.0, 0.025]], atol=0.0015
    )


@pytest.mark.parametrize(("tilt", "height"), [(30, 0.05), (60, 0.06), (60, 0.12)])
def test_no_matter_reaches_above_the_ceiling(tilt, height) -> None:
    """The flanks of a box, which a camera above does not see, and the table behind it, which it
    does: a hand from the side meets the flank first."""
    workspace = Workspace()
    frame = boxes_frame([((0.06, 0.06, height), 0.0, (0.5, 0.0))])
    T_WV = tilted_view(approach(tilt, 90), workspace)
    overhead = height_map_from_frame(frame, workspace)
    seen = tilted_height_map(overhead, *without_holes(frame, workspace), T_WV)
    exact = height_map_from_scene(frame.truth, workspace, cell=0.002, T_WV=T_WV)
    box = exact.label == 0
    assert (seen.ceiling[box] > exact.height[box] - 0.006).mean() > 0.99


def test_what_lies_outside_the_map_from_above_is_no_object() -> None:
    """Seen by a camera with a wide view: a box 29 cm beside the one in the workspace."""
    boxes = [((0.05, 0.05, 0.05), 0.0, (0.5, 0.0)), ((0.05, 0.05, 0.12), 0.0, (0.5, 0.29))]
    frame, workspace = boxes_frame(boxes), Workspace()
    for planner in (OracleFanPlanner, HeuristicFanPlanner):
        for grasp in planner(GripperGeometry(), workspace)(frame):
            assert abs(grasp.position[:2] - workspace.centre).max() < 0.2
    only = boxes_frame(boxes[1:])
    assert OracleFanPlanner(GripperGeometry(), workspace)(only) == []


# --- Planners ---------------------------------------------------------------------------------


def leaning_plate(lean: float) -> SceneGeometry:
    """A plate of 120 x 100 x 12 mm that leans by `lean` degrees: its longest side points to W's x
    at 0 and upwards at 90; its lowest corner touches the table."""
    turn = Rotation.from_euler("y", -lean, degrees=True).as_matrix()
    corners = (CORNERS * (0.06, 0.05, 0.006)) @ turn.T
    corners += (0.5, 0.0, -corners[:, 2].min())
    solid = ConvexSolid.from_vertices(corners)
    return SceneGeometry((SolidObject((solid,), corners.mean(axis=0), 0.5),))


@pytest.mark.parametrize("lean", [45, 60])
def test_a_leaning_plate_is_gripped_flat_on_its_faces(lean) -> None:
    """From straight above, vertical pads meet faces that are 45 or 30 degrees off; the hand that
    comes along the plate meets them squarely. Friction of 0.5 holds to 27 degrees."""
    scene = leaning_plate(lean)
    normal = np.array([-np.sin(np.deg2rad(lean)), 0.0, np.cos(np.deg2rad(lean))])
    frame = replace(boxes_frame([]), truth=scene)
    workspace = Workspace()

    def off_the_normal(grasp):
        return np.degrees(np.arccos(min(abs(grasp.closing_direction @ normal), 1.0)))

    best = OracleFanPlanner(GripperGeometry(), workspace)(frame)[0]
    assert off_the_normal(best) < 16  # half the step between two rings
    planar = make_planner("oracle", GripperGeometry(), workspace, 0)(frame)
    assert all(off_the_normal(grasp) > 27 for grasp in planar)


@pytest.mark.parametrize("sign", [1, -1])
def test_what_no_contacts_speak_for_has_the_critics_order(monkeypatch, sign) -> None:
    """Vertical pads have no antipodal contacts on a plate that leans by 45 degrees: an oracle whose
    critic likes high fingertips prefers high grasps, one whose critic likes low ones low grasps."""
    place = INPUTS.index("tip_rise")

    class Critic:
        def chance(self, inputs):
            return 0.5 + sign * np.clip(inputs.facts[:, place], 0.0, 0.4).astype(float)

    monkeypatch.setattr("models.planners.shipped_critic", Critic)
    frame = replace(boxes_frame([]), truth=leaning_plate(45))
    grasps = make_planner("oracle", GripperGeometry(), Workspace(), 0)(frame)
    heights = [round(sign * grasp.position[2], 4) for grasp in grasps]
    assert len(set(heights)) > 2 and heights == sorted(heights, reverse=True)


def test_what_contacts_speak_against_counts_by_the_third_power(monkeypatch) -> None:
    """Of the critic's chance: half a chance is an eighth of the score."""
    frame, scores = replace(boxes_frame([]), truth=leaning_plate(45)), {}
    for likely in (1.0, 0.5):

        class Critic:
            def chance(self, inputs, likely=likely):
                return np.full(len(inputs.facts), likely)

        monkeypatch.setattr("models.planners.shipped_critic", Critic)
        scored = PLANNERS["oracle"](GripperGeometry(), Workspace(), 0)(frame)
        scores[likely] = [grasp.quality for grasp in scored]
    assert scores[1.0] and max(scores[1.0]) <= 0.02  # below most with antipodal contacts
    np.testing.assert_allclose(np.array(scores[1.0]) / scores[0.5], 8.0)


def test_the_fan_is_even_and_holds_the_vertical() -> None:
    fan = np.array(FanSettings().directions())
    np.testing.assert_allclose(np.linalg.norm(fan, axis=1), 1.0)
    np.testing.assert_allclose(fan[0], DOWN)
    np.testing.assert_allclose(fan[:, :2].sum(axis=0), 0.0, atol=1e-12)
    assert (fan[:, 2] < 0).all()


def test_the_same_frame_gives_the_same_grasps_and_none_are_alike() -> None:
    boxes = [((0.05, 0.05, 0.05), 0.4, (0.47, 0.03)), ((0.03, 0.1, 0.06), 1.0, (0.56, -0.05))]
    frame = boxes_frame(boxes)
    planner = HeuristicFanPlanner(GripperGeometry(), Workspace())
    first, second = planner(frame), planner(frame)
    assert [g.quality for g in first] == [g.quality for g in second] and len(first) > 10
    # Ordered by score and by how steep the approach is; the quality is the score alone.
    worth = [g.quality * float(planner.fan.preference(np.array(g.tilt))) for g in first]
    assert worth == sorted(worth, reverse=True)
    assert [g.quality for g in first] != worth
    for i, grasp in enumerate(first):
        assert 0 < grasp.width <= GripperGeometry().max_opening + 1e-9
        for other in first[:i]:
            apart = np.linalg.norm(grasp.position - other.position)
            assert apart >= 0.01 or between(grasp, other) >= np.deg2rad(20) - 1e-9


@pytest.mark.parametrize("name", ["oracle", "oracle6d"])
def test_oracles_leave_out_what_lies_too_wide_for_the_hand(name):
    """A box of 9 x 12 cm, 4 cm high: its level faces are too far apart for a hand of 8 cm, and its
    top and its underside look away from each other."""
    plan = make_planner(name, GripperGeometry(), Workspace(), 0)
    wide, cube = ((0.09, 0.12, 0.04), 0.3, (0.45, -0.06)), ((0.04,) * 3, 0.0, (0.55, 0.08))
    assert plan(boxes_frame([wide])) == []
    grasps = plan(boxes_frame([wide, cube]))
    assert grasps and all(np.hypot(*(g.position[:2] - (0.55, 0.08))) < 0.03 for g in grasps)


def test_the_oracle_needs_the_truth() -> None:
    with pytest.raises(ValueError, match="frame.truth"):
        OracleFanPlanner(GripperGeometry(), Workspace())(boxes_frame([]).without_truth())


def test_bowls_are_the_bowls_of_a_split(tmp_path) -> None:
    found = load_object_set("benchmarks.bowls:bowls", split="sealed", cache_dir=tmp_path)
    assert len(found) == 9 and all(found[i].name.startswith("bowl_10") for i in range(9))
    with pytest.raises(UserError, match="unseen_families: has no bowls"):
        load_object_set("benchmarks.bowls:bowls", split="unseen_families", cache_dir=tmp_path)


def test_a_third_of_the_bowls_lean_more_than_friction_holds() -> None:
    """The figures of benchmarks/bowls.py and docs/six_dof.md, over all splits."""
    lean, cone = [], []
    for index in range(FAMILIES.index("bowl"), 1100, len(FAMILIES)):
        bowl = make_primitive(index)
        base, walls = bowl.parts[0], np.concatenate(bowl.parts[1:])
        out = np.linalg.norm(walls[:, :2], axis=1).max() - np.linalg.norm(base[0, :2])
        lean.append(np.degrees(np.arctan2(out, walls[:, 2].max() - base[:, 2].max())))
        cone.append(np.degrees(np.arctan(bowl.friction)))
    assert (round(min(lean)), round(max(lean))) == (15, 49)
    assert (round(min(cone)), round(max(cone))) == (22, 45)
    assert np.mean(np.array(lean) > cone) == pytest.approx(1 / 3, abs=0.02)


def test_closed_loops_refuse_planners_that_tilt(config) -> None:
    closed = load_config(
        DEFAULTS, ["evaluate.policies=[heuristic6d]", "closed_loop.controller=ibvs"]
    )
    with pytest.raises(UserError, match="heuristic6d plans .* any side.*with open_loop alone"):
        check_everything(closed)
    with pytest.raises(NoGraspsError, match="straight above"):
        grasps = [Grasp((0.5, 0, 0.05), 0, 0.05, 1.0, approach(30, 0))]
        checked_grasps(grasps, boxes_frame([]), 2.0, planar=True)


def test_a_wall_beside_one_object_is_measured_and_infeasible() -> None:
    """Walls have a label of their own, below those of objects, and no centre of mass."""
    frame = boxes_frame([((0.05, 0.05, 0.05), 0.0, (0.5, 0.0)), *bin_walls()], walls=4)
    heights = height_map_from_scene(frame.truth, Workspace())
    assert len(heights.centres) == 1
    on_wall = Candidates.rough(
        np.array([[0.655, 0.0]]), np.zeros(1), np.array([0.08]), np.array([0.01]), np.ones(1)
    )
    found = measure(on_wall, heights, GripperGeometry(), SearchSettings())
    assert found.label == [WALL_LABEL] and found.score == [0]


def test_what_a_camera_sees_far_from_the_workspace_costs_nothing_and_changes_nothing() -> None:
    """The same camera with a wider image: K's centre moves, and all that is added lies outside."""
    workspace = Workspace()
    frame = boxes_frame([((0.06, 0.08, 0.05), 0.4, (0.5, 0.0))])
    edge, K = 40, frame.K + np.array([[0, 0, 40], [0, 0, 40], [0, 0, 0]])
    depth = np.pad(frame.depth, edge, constant_values=0.8)
    rgb = np.pad(frame.rgb, ((edge, edge), (edge, edge), (0, 0)))
    wide = replace(frame, rgb=rgb, depth=depth, K=K, segmentation=None)
    part, _ = without_holes(wide, workspace)
    width = part.depth.shape[1]
    # Over the table 0.46 m, 0.8 m away; over the box's top the same pixels see less.
    assert width == pytest.approx(0.46 / 0.8 * K[0, 0], abs=6)
    assert width < depth.shape[1]
    seen = height_map_from_frame(wide, workspace)
    narrow = height_map_from_frame(frame, workspace)
    inside = np.s_[60:-60, 60:-60]
    np.testing.assert_allclose(seen.height[inside], narrow.height[inside], atol=1e-6)


def test_no_hand_comes_through_a_wall_beyond_the_map() -> None:
    """A wall, 25 cm high, stands 11 cm beside the workspace: the map from above ends before it, and
    a hand that comes from its side would be in it."""
    bottle, wall = ((0.05, 0.05, 0.14), 0.0, (0.5, 0.10)), ((0.3, 0.02, 0.25), 0.0, (0.5, 0.27))
    plan = HeuristicFanPlanner(GripperGeometry(), Workspace())
    behind = np.linspace(0.05, 0.2, 40)[:, None, None]  # of the fingertips, along the hand
    beside = np.linspace(-0.1, 0.1, 21)[:, None]  # and across, the palm is 0.2 m long
    for boxes, crossing in (([bottle], True), ([bottle, wall], False)):
        grasps = plan(boxes_frame(boxes, focal=200.0))
        hands = np.array([
            grasp.position - behind * grasp.approach + beside * grasp.closing_direction
            for grasp in grasps
        ])  # fmt: skip
        inside = np.abs(hands - (0.5, 0.27, 0.125)) < (0.15, 0.01, 0.125)
        assert inside.all(axis=-1).any() == crossing


def test_no_grasp_takes_a_known_wall_with_what_leans_over_it():
    """A thing 3 cm wide hides the edge of a wall, 10 cm high, and rises 2 cm over it. Fingers on
    both sides that reach lower would close on the wall."""
    thing, wall = ((0.06, 0.03, 0.12), 0.0, (0.5, 0.0)), ((0.3, 0.01, 0.10), 0.0, (0.5, 0.0))
    frame = boxes_frame([thing, wall], walls=1)
    lowest = []
    for fixtures in ((), frame.truth.walls):
        heights = height_map_from_frame(replace(frame, fixtures=fixtures), Workspace())
        found = search(heights, GripperGeometry(), Workspace(), SearchSettings())
        lowest.append(found.tip[found.label == 0].min())
    assert lowest[0] < 0.09 and lowest[1] > 0.1


@pytest.mark.parametrize("name", ["heuristic", "graspnet", "oracle"])
def test_from_above_there_is_no_grasp_below_a_board(name):
    frame = shelf_frame([CARTON])
    assert make_planner(name, GripperGeometry(), Workspace(), 0)(frame) == []
    assert make_planner(f"{name}6d", GripperGeometry(), Workspace(), 0)(frame)


CARTON = ((0.05, 0.06, 0.16), 0.0, (0.5, -0.02))


@pytest.mark.parametrize("name", ["heuristic6d", "graspnet6d", "oracle6d"])
def test_a_carton_below_a_board_is_gripped_from_the_open_side(name):
    """Along its 5 cm, by a hand that meets neither the board, 0.3 m over the table, nor the back.
    One that leans by 30 degrees takes it by the part that is nearest to the open side."""
    grasps = make_planner(name, GripperGeometry(), Workspace(), 0)(shelf_frame([CARTON]))
    behind = np.linspace(0.0, 0.2, 40)[:, None, None]  # of the fingertips, along the hand
    beside = np.linspace(-0.1, 0.1, 21)[:, None]  # and across, the palm is 0.2 m long
    level = []
    for grasp in grasps:
        assert grasp.tilt > np.deg2rad(29)
        hand = grasp.position - behind * grasp.approach + beside * grasp.closing_direction
        for middle, half in (((0.5, -0.06, 0.31), (0.2, 0.13, 0.01)),
                             ((0.5, -0.18, 0.15), (0.2, 0.01, 0.15))):  # fmt: skip
            assert not (np.abs(hand - middle) < half).all(axis=-1).any()
        if grasp.approach[1] < -0.99:
            level.append(grasp)
    best = level[0]
    assert abs(best.closing_direction[0]) > np.cos(np.deg2rad(5))
    assert best.position[0] == pytest.approx(0.5, abs=0.003) and 0.04 < best.position[2] < 0.14
    assert 0.05 < best.width <= 0.08


def test_the_fan_has_more_level_directions_below_a_board():
    fan = FanSettings()
    counts = []
    for covered in (False, True):
        tilts = np.degrees(np.arccos(-np.array(fan.directions(covered))[:, 2])).round()
        counts.append({tilt: int((tilts == tilt).sum()) for tilt in np.unique(tilts).tolist()})
    assert counts == [{0: 1, 30: 8, 60: 8, 85: 4}, {0: 1, 30: 8, 60: 8, 85: 16}]


def test_level_views_are_searched_where_something_is_high():
    for height, tilts in ((0.08, {0, 30, 60}), (0.12, {0, 30, 60, 85})):
        plan = HeuristicFanPlanner(GripperGeometry(), Workspace())
        truth = boxes_frame([((0.05, 0.05, height), 0.0, (0.5, 0.0))]).truth
        overhead = height_map_from_scene(truth, Workspace())
        frames = plan.frames(overhead)
        assert {round(np.degrees(np.arccos(T_WV[2, 2]))) for T_WV in frames} == tilts


@pytest.mark.parametrize("lift", [-1.5, -0.9, 0.9, 1.5])
@pytest.mark.parametrize("name", ["heuristic", "heuristic6d", "graspnet", "oracle6d"])
def test_a_table_may_be_at_any_height(name: str, lift: float) -> None:
    """A robot's world need not begin at its table."""
    boxes = [((0.04, 0.06, 0.05), 0.4, (0.47, 0.03)), ((0.03, 0.05, 0.10), 1.0, (0.56, -0.06))]
    frame = boxes_frame(boxes)
    T_WC, T = frame.T_WC.copy(), np.eye(4)
    T_WC[2, 3] += lift
    T[2, 3] = lift
    truth = replace(frame.truth.transformed(T), table_height=lift)
    here, there = (
        make_planner(name, GripperGeometry(), Workspace(table_height=table), 0)(one)
        for table, one in ((0.0, frame), (lift, replace(frame, T_WC=T_WC, truth=truth)))
    )
    assert len(here) == len(there) > 5
    for one, other in zip(here, there):
        np.testing.assert_allclose(other.position - [0, 0, lift], one.position, atol=1e-3)
        assert other.quality == pytest.approx(one.quality, abs=0.01)
