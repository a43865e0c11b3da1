"""A hand without an arm, in each simulator, judged by the protocol of VGN's clutter removal."""

import re
from dataclasses import replace

import numpy as np
import pytest

from envs.cell import require_arm
from envs.cell_layout import Box, Placement, Scene, table_box
from envs.execution import execute_grasp
from envs.floating_execution import PREGRASP, attempt, clears_table, execute_floating, floating_hand
from envs.floating_hand import meets_box
from envs.grasping_env import RobotGraspingEnv
from envs.mujoco_panda import MujocoFloatingHand
from envs.object_bodies import native_object
from envs.object_shapes import NativeShape
from envs.objects import load_object_set
from envs.robot_motion import SCurve
from envs.rounds import run_round
from envs.simulators import make_cell
from envs.studio import Studio
from models.planner_fan import HeuristicFanPlanner
from models.planners import HeuristicPlanner
from tests.helpers.box_frames import boxes_frame
from tests.helpers.cubes import cube_grasp, cube_scene
from tests.helpers.simulators import INSTALLED
from utils.config import load_config
from utils.errors import UserError
from utils.geometry import GripperGeometry, Workspace
from utils.transforms import DOWN, Grasp, look_at, top_down_pose

SIDE = np.array([np.sqrt(0.5), 0.0, -np.sqrt(0.5)])  # 45 degrees from straight above
HAND = GripperGeometry()
LEVEL = Grasp(np.array([0.5, 0.0, 0.03]), 0.0, 0.08, 1.0, np.array([1.0, 0.0, 0.0]))


def config_of(simulator: str, *overrides: str):
    return load_config(
        None,
        [
            f"simulator={simulator}",
            "sim.renderer=tiny",
            "robot.arm=none",
            "gripper.least_held=0.008",
            *overrides,
        ],
    )


@pytest.fixture(scope="module", params=INSTALLED)
def cell(request):
    with make_cell(config_of(request.param)) as cell:
        yield cell


def test_the_hand_stands_where_it_is_put_and_follows_a_line_at_its_speed(cell, box_set):
    cell.load(cube_scene(box_set))
    hand, T = floating_hand(cell), cube_grasp(0.3).pose
    T[:3, 3] = (0.4, 0.1, 0.5)
    hand.put(T, 0.05)
    np.testing.assert_allclose(hand.tip_pose(), T, atol=1e-9)
    assert hand.opening == pytest.approx(0.05) and not hand.overlaps()
    goal = T[:3, 3] + (0.06, 0.0, -0.08)  # 10 cm away
    q, velocity = hand.line(goal, 0.1)
    assert len(q) * cell.dt == pytest.approx(SCurve(1.0, 130.0, 65_000.0).duration, abs=cell.dt)
    assert np.linalg.norm(velocity, axis=1).max() == pytest.approx(0.1, rel=1e-3)
    places = []
    for one in zip(q, velocity):
        hand.command(*one)
        cell.step()
        places.append(hand.tip_pose()[:3, 3])
    np.testing.assert_allclose(places[-1], goal, atol=3e-4)
    beside = np.cross(np.array(places) - T[:3, 3], (0.6, 0.0, -0.8))
    assert np.linalg.norm(beside, axis=1).max() < 3e-4
    np.testing.assert_allclose(hand.tip_pose()[:3, :3], T[:3, :3], atol=1e-9)


@pytest.mark.parametrize("side", [-1, 1])
def test_a_leaning_hand_reaches_as_far_as_it_has_to_carry(cell, box_set, side):
    """Half a metre from a pregrasp, up and aside, along axes of its own that lean by 60 degrees."""
    cell.load(cube_scene(box_set))
    hand, grasp = floating_hand(cell), cube_grasp(0.0)
    lean = np.array([0.0, side * np.sin(np.pi / 3), -np.cos(np.pi / 3)])
    hand.put(replace(grasp, position=np.array([0.5, 0.0, 0.1]), approach=lean).pose, 0.05)
    goal = hand.tip_pose()[:3, 3] + (0.0, -0.25, 0.43)
    for one in zip(*hand.line(goal, 0.5)):
        hand.command(*one)
        cell.step()
    np.testing.assert_allclose(hand.tip_pose()[:3, 3], goal, atol=3e-3)


@pytest.mark.parametrize("approach", [DOWN, SIDE])
def test_a_cube_is_gripped_and_removed(cell, box_set, approach):
    """A 6 cm cube, its faces level with the fingers, from above and from a side. 5 cm at 0.1 m/s,
    the closing of 1 cm a finger at 0.05 m/s and the retreat of 10 cm take 1.7 s at least."""
    cell.load(cube_scene(box_set))
    grasp = replace(cube_grasp(np.pi / 2), approach=approach)
    grasp = replace(grasp, position=grasp.position + (0.0, 0.0, 0.015))
    outcome = execute_floating(cell, grasp)
    assert (outcome.reason, outcome.object_index) == ("success", 0)
    speed = cell.config.execution.approach_speed
    assert outcome.sim_seconds > (PREGRASP + 0.1) / speed + 0.01 / 0.05
    assert not cell.remaining and outcome.motion.slid < 0.005
    frame = cell.frame()
    assert (frame.segmentation == -1).all(), "neither the cube nor the hand is in sight"


def test_a_hand_leaves_a_place_below_a_board_as_it_came(cell, box_set):
    """A level hand on a cube, 9 cm below a board, which it would meet 10 cm straight up."""
    board = Box(np.array([0.1, 0.2, 0.01]), np.array([0.55, 0.0, 0.16]))
    cell.load(replace(cube_scene(box_set), layout="shelf", walls=(board,)))
    level = np.array([np.sin(np.deg2rad(80)), 0.0, -np.cos(np.deg2rad(80))])
    grasp = replace(cube_grasp(np.pi / 2, offset=(0.0, 0.0, 0.02)), approach=level)
    places = []
    cell.on_step = lambda cell: places.append(cell.robot.tip_pose()[:3, 3])
    outcome = execute_floating(cell, grasp)
    cell.on_step = None
    assert (outcome.reason, outcome.object_index) == ("success", 0), outcome.detail
    before = np.array(places)[np.linalg.norm(np.array(places) - grasp.position, axis=1) < 0.15]
    assert before[:, 2].max() < grasp.position[2] + 0.1 * np.cos(np.deg2rad(80)) + 5e-3


def test_a_contact_where_the_hand_starts_or_on_its_way_is_a_collision(cell, box_set):
    """Turned by 45 degrees, the cube's diagonal of 8.5 cm is wider than the open hand. Where the
    hand starts 5 cm higher, 1 cm lower than the cube's top, the cube is in its way at once."""
    for height, detail in ((0.03, "the open hand met something"), (0.0, "no room where it")):
        cell.load(cube_scene(box_set))
        place = cell.object_position(0)
        outcome = execute_floating(cell, cube_grasp(np.pi / 4, offset=(0.0, 0.0, height - 0.03)))
        assert (outcome.reason, outcome.object_index) == ("collision", None)
        assert detail in outcome.detail
        assert np.linalg.norm(cell.object_position(0) - place) < 2e-3
        assert cell.remaining == {0}


def test_vgns_hand_stops_at_a_contact_and_closes_there(cell, box_set):
    """A finger lands on the corner of a cube that is too wide: with `grip` the hand closes there,
    over the cube, and so it misses."""
    cell.load(cube_scene(box_set))
    cell.config = cell.config.model_copy(
        update={"execution": cell.config.execution.model_copy(update={"on_contact": "grip"})}
    )
    try:
        outcome = execute_floating(cell, cube_grasp(np.pi / 4))
        assert outcome.reason in ("missed", "slipped")
        assert re.match(r"the open hand met something \d+ mm before .* and closed", outcome.detail)
    finally:
        cell.config = cell.config.model_copy(
            update={"execution": cell.config.execution.model_copy(update={"on_contact": "fail"})}
        )


def test_the_hand_gives_way_to_what_its_fingers_cannot_push(cell, box_set):
    """A block of 6 cm that does not move, 8 mm off the middle: the hand moves there while it
    closes, and stays when it is told to hold."""
    block = Box(np.array([0.03, 0.03, 0.04]), np.array([0.5, 0.008, 0.04]))
    cell.load(replace(cube_scene(box_set, position=(0.5, 0.14, 0.03)), walls=(block,)))
    hand = floating_hand(cell)
    hand.put(cube_grasp(np.pi / 2, offset=(0.0, 0.0, 0.03)).pose)
    hand.yield_to_fingers()
    hand.command_gripper(0.0)
    cell.step(round(1.2 / cell.dt))
    np.testing.assert_allclose(hand.tip_pose()[:3, 3], (0.5, 0.008, 0.06), atol=2e-3)
    assert hand.opening == pytest.approx(0.06, abs=2.5e-3) and hand.contact_force() > 10
    hand.hold()
    before = hand.q
    cell.step(60)
    np.testing.assert_allclose(hand.q, before, atol=1e-3)


def test_a_hand_that_gives_way_is_not_pulled_back(cell):
    """Moved by 10 mm along its closing line, it stays there."""
    cell.load(Scene("isolated", 0, ()))
    hand = floating_hand(cell)
    hand.put(cube_grasp(offset=(0.0, 0.0, 0.1)).pose)
    hand.yield_to_fingers()
    cell.step(10)
    if isinstance(hand, MujocoFloatingHand):
        hand.data.qpos[hand._places[1]] += 0.010
    else:
        import pybullet

        pybullet.resetJointState(hand.body, 1, hand.q[1] + 0.010, physicsClientId=hand.client)
    before = hand.tip_pose()[:3, 3]
    cell.step(round(0.5 / cell.dt))
    assert np.linalg.norm(hand.tip_pose()[:3, 3] - before) < 1e-3


@pytest.mark.parametrize("tilt", [0, 30, 60, 85])  # degrees, of a closing line that leans with it
def test_a_hand_that_gives_way_does_not_sink_under_its_own_weight(cell, tilt):
    """The carriage carries the hand's weight: with nothing between the fingers it stays."""
    cell.load(Scene("isolated", 0, ()))
    hand = floating_hand(cell)
    slope = np.deg2rad(tilt)
    approach = np.array([np.sin(slope), 0.0, -np.cos(slope)])
    closing = np.array([np.cos(slope), 0.0, np.sin(slope)])
    T = np.eye(4)
    T[:3, :3] = np.column_stack([np.cross(closing, approach), closing, approach])
    T[:3, 3] = 0.5, 0.0, 0.4
    hand.put(T)
    hand.hold()
    hand.yield_to_fingers()
    cell.step(round(0.5 / cell.dt))
    np.testing.assert_allclose(hand.tip_pose()[:3, 3], T[:3, 3], atol=1e-3)
    hand.hold()
    cell.step(round(0.5 / cell.dt))
    np.testing.assert_allclose(hand.tip_pose()[:3, 3], T[:3, 3], atol=1e-3)


def test_an_empty_hand_misses_and_so_does_a_thin_grip(cell, box_set):
    """A plate of 6 mm is thinner than gripper.least_held."""
    cell.load(cube_scene(box_set))
    beside = execute_floating(cell, cube_grasp(offset=(0.0, 0.12, 0.0)))
    assert (beside.reason, beside.object_index) == ("missed", None)
    cubes = load_object_set("box", scale=0.1, cache_dir=cell.config.cache_folder)  # 6 mm
    at = Placement(cubes[0], np.array([0.5, 0.0, 0.003]), np.eye(4)[3])
    cell.load(Scene("isolated", 0, (at,)))
    grasp = cube_grasp(np.pi / 2, offset=(0.0, 0.0, -0.0215))
    assert attempt(cell, grasp).success  # but for the rule it is held
    cell.load(Scene("isolated", 0, (at,)))
    outcome = execute_floating(cell, grasp)
    assert outcome.reason == "missed" and "8 mm or less count as empty" in outcome.detail


def test_what_is_carried_has_to_leave_the_table(cell):
    """A beam of 0.5 kg, gripped 17 cm beside its middle: the hand still holds it after the retreat
    of 10 cm, but its other end lies on the table, or it hangs from the fingers."""
    beam = native_object("beam", NativeShape("box", (0.4, 0.03, 0.03)), 1390, 0.8, (0, 0, 1, 1))
    assert beam.mass == pytest.approx(0.5, abs=0.01)
    at = Placement(beam, np.array([0.5, 0.0, 0.015]), np.eye(4)[3])
    middle, end = (
        Grasp(np.array([x, 0.0, 0.015]), np.pi / 2, 0.08, 1.0) for x in (0.5, 0.67)
    )  # fmt: skip
    for grasp, carried in ((middle, "success"), (end, "dropped")):
        cell.load(Scene("isolated", 0, (at,)))
        assert attempt(cell, grasp).success
        cell.load(Scene("isolated", 0, (at,)))
        assert attempt(cell, grasp, carry=True).reason == carried


def test_physics_that_blows_up_on_the_way_ends_the_round(cell, box_set, monkeypatch):
    def blow_up(cell):
        if cell.steps == 40:  # 3.3 cm of the 5 before the grasp
            monkeypatch.setattr(type(cell.robot), "q", property(lambda robot: np.full(3, np.nan)))

    monkeypatch.setattr(cell, "on_step", blow_up)
    plan, settings = (lambda frame: [cube_grasp(np.pi / 2)]), {"policy": "x", "objects": "b"}
    record = run_round(cell, cube_scene(box_set), plan, max_failures=2, **settings)
    assert record.ended == "physics"


def test_a_round_ends_after_two_failures_in_a_row(cell, box_set):
    """VGN's rule; the third grasp of the list would have succeeded."""
    wrong = [cube_grasp(np.pi / 4), cube_grasp(-np.pi / 4)]

    def plan(frame):
        return [*wrong, cube_grasp(np.pi / 2)]

    record = run_round(cell, cube_scene(box_set), plan, policy="x", objects="b", max_failures=2)
    assert [attempt.reason for attempt in record.attempts] == ["collision", "collision"]
    assert record.ended == "failures" and record.objects_cleared == 0
    wrong.pop()
    record = run_round(cell, cube_scene(box_set), plan, policy="x", objects="b", max_failures=2)
    assert [attempt.reason for attempt in record.attempts] == ["collision", "success"]
    assert record.ended == "cleared"


@pytest.mark.parametrize(
    ("grasp", "depth"),
    [
        (cube_grasp(), 0.0072),
        (LEVEL, 0.1042),
        (replace(LEVEL, angle=np.pi / 2), 0.0316),
    ],
)
def test_how_far_a_hand_reaches_down(grasp, depth):
    """From above it is the tips that are lowest, 7.2 mm below E. Of a level hand it is, with the
    fingers one above the other, the palm's end, and with the fingers level its side, 31.6 mm at its
    widest."""
    half = np.array([0.5, 0.5, 0.02])
    for gap, meets in ((0.0005, False), (-0.0005, True)):
        top = grasp.position[2] - depth - gap
        box = Box(half, np.array([0.5, 0.0, top - half[2]]))
        assert meets_box(HAND, grasp.pose, 0.08, box) is meets


def test_hands_that_would_cut_into_the_table_are_out_of_reach(cell):
    assert clears_table(cell, cube_grasp())
    assert not clears_table(cell, cube_grasp(offset=(0.0, 0.0, -0.025)))


def test_beside_the_table_a_hand_may_be_lower_than_its_top(cell):
    """A hand that comes level from outside to 2 cm over the edge, closing vertically: its lower
    finger is 2 cm below the table's top, its tips 1 cm outside of the edge, or 2 cm inside."""
    edge = table_box().position[0] + table_box().half_size[0]
    for inside, clear in ((-0.01, True), (0.02, False)):
        tips = np.array([edge - inside, 0.0, 0.02])
        level = Grasp(tips, 0.0, 0.08, 1.0, np.array([-1.0, 0.0, 0.0]))
        assert clears_table(cell, level) is clear


def test_the_parked_hand_is_in_no_side_view_and_pictures_show_it_at_work(box_set):
    for seed in range(4):
        with make_cell(config_of(INSTALLED[0], "camera.view=side")) as cell:
            scene = replace(cube_scene(box_set), seed=seed)
            cell.load(scene)
            assert set(np.unique(cell.frame().segmentation)) == {-1, 0}
            with Studio(cell, 160, 120) as studio:
                without = studio.picture()
                floating_hand(cell).put(top_down_pose(np.array([0.5, 0.0, 0.15]), 0.0))
                changed = (studio.picture() != without).any(axis=-1)
            assert 50 < changed.sum() < 2000  # a hand, not another scene


def test_what_needs_the_arm_is_refused(cell, box_set):
    with pytest.raises(UserError, match=r"execute_grasp needs the whole arm; set robot\.arm=panda"):
        execute_grasp(cell, cube_grasp())
    with pytest.raises(UserError, match=r"robot\.arm=none: RobotGraspingEnv needs"):
        RobotGraspingEnv(config=config_of(INSTALLED[0]))
    for overrides, what in (
        (["camera.view=fixed", "camera.mount=wrist"], r"camera\.mount=wrist needs"),
        (["evaluate.randomise=true"], "randomise"),
    ):
        with pytest.raises(UserError, match=what):
            make_cell(config_of(INSTALLED[0], *overrides))
    require_arm(load_config(None), "anything")


def test_an_arm_does_not_play_vgns_rule_for_contacts():
    with pytest.raises(UserError, match=r"on_contact=grip: .*set robot\.arm=none"):
        make_cell(config_of(INSTALLED[0], "execution.on_contact=grip", "robot.arm=panda"))


@pytest.mark.parametrize("make", [HeuristicPlanner, HeuristicFanPlanner])
@pytest.mark.parametrize("gap", [0.012, 0.05])
def test_planners_leave_room_for_a_hand_that_opens_fully(make, gap):
    """Two boxes 4 cm wide side by side: between them is room for a finger, 21 mm wide and 15 to 26
    mm thick, only where they are 5 cm apart; across the gap a hand 8 cm wide never fits 12 mm."""
    boxes = [((0.04, 0.06, 0.06), 0.0, (0.5 + x, 0.0)) for x in (-0.02 - gap / 2, 0.02 + gap / 2)]
    grasps = make(replace(HAND, opens_fully=True), Workspace())(boxes_frame(boxes))
    assert grasps and all(grasp.width == HAND.max_opening for grasp in grasps)
    along_x = [grasp for grasp in grasps if abs(grasp.closing_direction[0]) > 0.9]
    assert bool(along_x) == (gap > 0.03)


@pytest.mark.parametrize("yaw", [0.0, 0.4, np.pi / 4])
@pytest.mark.parametrize("make", [HeuristicPlanner, HeuristicFanPlanner])
def test_planners_leave_out_what_counts_as_empty_however_well_it_is_held(make, yaw):
    """Boards on their long edge, 5 cm high: of 8 mm and less they are left out, of 11 not."""
    across = np.array([-np.sin(yaw), np.cos(yaw), 0.0])

    def found(thickness, hand):
        frame = boxes_frame([((0.1, thickness, 0.05), yaw, (0.5, 0.0))])
        grasps = make(hand, Workspace())(frame)
        return any(abs(grasp.closing_direction @ across) > 0.98 for grasp in grasps)

    hand = replace(HAND, least_held=0.008)
    assert found(0.006, HAND) and not found(0.006, hand) and found(0.011, hand)


@pytest.mark.parametrize("thickness, counts", [(0.006, False), (0.011, True)])
def test_from_a_side_a_board_is_as_thick_as_it_looks_along_its_faces(thickness, counts):
    """52 degrees off the vertical. Across its faces the camera sees one of them alone, and what
    stands behind it may be as thick as its shadow."""
    away = np.array([np.sin(np.radians(52)), 0.0, np.cos(np.radians(52))])
    target = np.array([0.5, 0.0, 0.0])
    frame = boxes_frame(
        [((0.1, thickness, 0.05), 0.0, (0.5, 0.0))],
        focal=540, T_WC=look_at(target + 0.68 * away, target, (0, 0, 1)),
    )  # fmt: skip
    grasps = HeuristicPlanner(replace(HAND, least_held=0.008), Workspace())(frame)
    assert any(abs(grasp.closing_direction[1]) > 0.95 for grasp in grasps) == counts
