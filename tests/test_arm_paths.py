"""Paths of the arm below a board: in from the side, out as it came, and over it to the tray."""

import numpy as np
import pytest

from envs import arm_paths
from envs.arm_paths import first_plan, height_over, way_out, withdrawn
from envs.cell_layout import TRAY_CENTRE, TRAY_HALF_SIZE, Box, Placement, Scene
from envs.execution import execute_grasp, reaches
from envs.next_grasp import within_reach
from envs.object_bodies import native_object
from envs.object_shapes import NativeShape
from envs.robot_kinematics import UnreachableError, forward_kinematics
from envs.rounds import run_round
from envs.simulators import make_cell
from models.planners import make_planner
from tests.helpers.simulators import INSTALLED
from utils.config import load_config
from utils.geometry import Workspace
from utils.transforms import Grasp, top_down_pose

FRONT, UNDER, TOP = 0.07, 0.30, 0.32  # m: y of the board's front edge, z of its two sides
SHELF = (
    Box(np.array([0.20, 0.13, 0.01]), np.array([0.5, FRONT - 0.13, 0.31])),
    Box(np.array([0.20, 0.01, 0.15]), np.array([0.5, FRONT - 0.25, 0.15])),
)
LEVEL = np.array([0.0, -np.sin(np.deg2rad(85)), -np.cos(np.deg2rad(85))])
GRASP = Grasp(np.array([0.5, -0.02, 0.08]), 0.0, 0.075, 1.0, LEVEL)


@pytest.fixture(scope="module", params=INSTALLED)
def shelved(request):
    """A cell with a carton, 5 cm wide and 18 cm high, under the board of a shelf."""
    carton = native_object(
        "carton", NativeShape("box", (0.05, 0.05, 0.18)), 300.0, 0.8, (1, 0, 0, 1)
    )
    standing = Placement(carton, np.array([0.5, -0.02, 0.09]), np.array([0.0, 0.0, 0.0, 1.0]))
    with make_cell(load_config(None, [f"simulator={request.param}", "sim.renderer=tiny"])) as cell:
        cell.load(Scene("shelf", 0, (standing,), SHELF, True))
        yield cell


def test_an_only_way_that_is_blocked_is_none(shelved, monkeypatch):
    monkeypatch.setattr(arm_paths, "all_plans", lambda cell, grasp: iter(["the only way"]))
    monkeypatch.setattr(arm_paths, "clears", lambda cell, plan, grasp: False)
    with pytest.raises(UnreachableError, match="hangs over the table"):
        first_plan(shelved, GRASP)


def test_the_way_out_ends_before_the_board(shelved):
    """E starts 9 cm behind the front edge and has 9 cm to go beyond it."""
    assert shelved.hanging == [SHELF[0]]
    assert way_out(
        shelved, np.array([0.5, -0.02, 0.1]), np.array([0.0, 1.0, 0.0])
    ) == pytest.approx(0.18, abs=0.011)
    assert way_out(shelved, np.array([0.5, 0.2, 0.1]), np.array([0.0, 1.0, 0.0])) == 0.0
    assert way_out(shelved, np.array([0.5, -0.02, 0.5]), np.array([0.0, 1.0, 0.0])) == 0.0
    assert height_over(shelved, 0.1) > TOP + 0.1
    pose = GRASP.pose
    before = withdrawn(shelved, pose)
    np.testing.assert_allclose(before[:3, :3], pose[:3, :3])
    assert before[1, 3] > FRONT + 0.08 and 0.0 < before[2, 3] - pose[2, 3] < 0.02
    from_above = top_down_pose(np.array([0.5, -0.02, 0.1]), 0.0)
    assert withdrawn(shelved, from_above) is from_above  # there is no way out


def test_what_is_gripped_below_a_board_comes_out_before_it_goes_up(shelved, monkeypatch):
    shelved.load(shelved.scene)
    assert reaches(shelved, GRASP)
    places, closing, robot = [], [], shelved.robot
    command, close = robot.command_arm, robot.command_gripper
    monkeypatch.setattr(
        robot,
        "command_arm",
        lambda q, v: (places.append(forward_kinematics(np.array(q))[:3, 3]), command(q, v)),
    )
    monkeypatch.setattr(
        robot, "command_gripper", lambda *args: (closing.append(len(places)), close(*args))
    )
    outcome = execute_grasp(shelved, GRASP)
    assert outcome.reason == "success", outcome.detail
    assert abs(shelved.object_position(0)[:2] - TRAY_CENTRE).max() < TRAY_HALF_SIZE
    places = np.array(places)
    before, after = places[: closing[1]], places[closing[1] :]
    # The fingertips are low in front of the board or below it, and never in its middle or above.
    for part in (before, after):
        low = part[part[:, 2] < TOP]
        under = (abs(low[:, 0] - 0.5) < 0.2) & (low[:, 1] < FRONT) & (low[:, 1] > FRONT - 0.26)
        assert under.any() and low[under][:, 2].max() < 0.12
    # A carton of 18 cm hangs 8 cm below the hand: what is over the board passes it.
    over = after[(abs(after[:, 0] - 0.5) < 0.2) & (abs(after[:, 1] + 0.06) < 0.13)]
    assert over[over[:, 2] > UNDER][:, 2].min() > TOP + 0.08
    np.testing.assert_allclose(robot.q, shelved.home, atol=5e-3)


def test_no_arm_reaches_through_a_board(shelved):
    """From straight above, and from the side of the back."""
    shelved.load(shelved.scene)
    outcome = execute_grasp(shelved, Grasp(GRASP.position, 0.0, 0.075, 1.0))
    assert outcome.reason == "ik"
    assert not reaches(shelved, Grasp(GRASP.position, 0.0, 0.075, 1.0, LEVEL * (1, -1, 1)))
    from_above = Grasp(GRASP.position, 0.0, 0.075, 1.0)
    assert list(within_reach(shelved, [from_above, GRASP])) == [GRASP]
    assert len(shelved.remaining) == 1


def test_a_planner_from_above_ends_the_round_without_a_plan(shelved):
    plan = make_planner("heuristic", shelved.gripper, Workspace(), 0)
    record = run_round(shelved, shelved.scene, plan, policy="h", objects="o", max_failures=2)
    assert record.ended == "no_plan" and record.objects_cleared == 0
