"""Grasps carried out by the whole arm, and how each failure is named."""

from types import SimpleNamespace

import numpy as np
import pytest

from envs.arm_paths import line
from envs.cell_layout import TRAY_CENTRE, TRAY_HALF_SIZE, Placement, Scene
from envs.execution import (
    ApproachResult,
    GraspFailure,
    InHandMotion,
    WeighingGrip,
    close_fingers,
    execute_grasp,
    follow,
    open_loop,
    reaches,
)
from envs.object_bodies import native_object
from envs.object_shapes import NativeShape
from envs.robot_kinematics import forward_kinematics
from tests.helpers.cubes import cube_grasp, cube_scene
from tests.helpers.simulators import needs_pybullet, pybullet
from utils.config import with_settings
from utils.transforms import Grasp


@pytest.fixture(scope="module")
def cell(bullet_cell):
    return bullet_cell


def test_good_grasp_succeeds_and_the_cube_ends_in_the_tray(cell, box_set):
    cell.load(cube_scene(box_set))
    outcome = execute_grasp(cell, cube_grasp())
    assert outcome.reason == "success" and outcome.success and outcome.object_index == 0
    assert 2 < outcome.sim_seconds < 5
    assert not cell.remaining
    assert abs(cell.object_position(0)[:2] - TRAY_CENTRE).max() < TRAY_HALF_SIZE
    np.testing.assert_allclose(cell.robot.q, cell.home, atol=5e-3)


def test_the_hand_comes_down_straight_and_slowly_at_the_end(cell, box_set, monkeypatch):
    """The corner above the grasp is cut by at most 4 cm of its 12; below, the references of the
    fingertips lie on the vertical line, and keep the approach speed in the last 4 cm."""
    cell.load(cube_scene(box_set))
    grasp, references = cube_grasp(), []
    command, close = cell.robot.command_arm, cell.robot.command_gripper
    monkeypatch.setattr(
        cell.robot, "command_arm", lambda q, v: (references.append(np.array(q)), command(q, v))
    )
    closing = []
    monkeypatch.setattr(
        cell.robot, "command_gripper", lambda *args: (closing.append(len(references)), close(*args))
    )
    assert execute_grasp(cell, grasp).success
    references = references[: closing[1]]  # it opens, comes down and closes
    tips = np.array([forward_kinematics(q)[:3, 3] for q in references])
    lowest = tips[:, 2].argmin()
    np.testing.assert_allclose(tips[lowest], grasp.position, atol=1e-4)
    down = tips[: lowest + 1]
    line = down[down[:, 2] < grasp.position[2] + 0.08]
    assert abs(line[:, :2] - grasp.position[:2]).max() < 5e-4
    slow = line[line[:, 2] < grasp.position[2] + 0.04]
    speeds = np.linalg.norm(np.diff(slow, axis=0), axis=1) / cell.dt
    settings = cell.config.execution
    assert settings.pregrasp_height == 0.12
    assert 0.9 * settings.approach_speed < speeds.max() < 1.01 * settings.approach_speed


def test_what_is_lost_on_the_way_to_the_tray_was_dropped(cell, box_set, monkeypatch):
    """The fingers open 10 cm beside the middle, over the lift height."""

    def open_beside(cell):
        if cell.object_position(0)[1] < -0.1:
            cell.robot.command_gripper(0.08)

    cell.load(cube_scene(box_set))
    monkeypatch.setattr(cell, "on_step", open_beside)
    outcome = execute_grasp(cell, cube_grasp())
    assert (outcome.reason, outcome.object_index) == ("dropped", 0)


def test_what_is_picked_is_held_as_long_as_is_asked(cell, box_set, monkeypatch):
    """Up to the tray alone it takes less than a second."""
    held = []

    def note(cell):
        if cell.is_lifted(0, 0.3):
            held.append(cell.seconds)

    asked = with_settings(cell.config, "execution", {"hold_seconds": 3.0})
    monkeypatch.setattr(cell, "config", asked)
    cell.load(cube_scene(box_set))
    monkeypatch.setattr(cell, "on_step", note)
    assert execute_grasp(cell, cube_grasp()).success
    assert 3.0 <= held[-1] - held[0] < 3.5


def test_what_a_failed_attempt_pushed_off_the_table_does_not_remain(cell, box_set):
    (first,), (second,) = (cube_scene(box_set, (0.5, y, 0.03)).placements for y in (0.06, -0.06))

    def push_off(cell, grasp):
        below = cell.object_pose(1)
        below[2, 3] = -0.5
        cell.carry(1, below, np.zeros(3), 0.0)
        raise GraspFailure("missed")

    cell.load(Scene("packed", 0, (first, second)))
    assert execute_grasp(cell, cube_grasp(), push_off).reason == "missed"
    assert cell.remaining == {0}


@pytest.mark.parametrize("turn", [-90, -30, 90, 150])
def test_a_tilted_hand_comes_along_its_approach(cell, box_set, monkeypatch, turn):
    """40 degrees from straight above, its fingers level, on two faces of a turned cube."""
    tilt, turn = np.deg2rad(40), np.deg2rad(turn)
    approach = np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), -np.cos(tilt)])
    cell.load(cube_scene(box_set, yaw=turn))
    # At right angles to the tilt the closing line is level: its angle is the same in W.
    grasp = Grasp(np.array([0.5, 0.0, 0.038]), turn + np.pi / 2, 0.08, 1.0, approach)
    assert abs(grasp.closing_direction[2]) < 1e-12 and reaches(cell, grasp)
    references, closing = [], []
    command, close = cell.robot.command_arm, cell.robot.command_gripper
    monkeypatch.setattr(
        cell.robot, "command_arm", lambda q, v: (references.append(np.array(q)), command(q, v))
    )
    monkeypatch.setattr(
        cell.robot, "command_gripper", lambda *args: (closing.append(len(references)), close(*args))
    )
    outcome = execute_grasp(cell, grasp)
    assert outcome.reason == "success", outcome.detail
    poses = np.array([forward_kinematics(q) for q in references[: closing[1]]])
    back = (grasp.position - poses[:, :3, 3]) @ approach
    assert back[-1] == pytest.approx(0.0, abs=1e-4)
    line = poses[(back < 0.08) & (np.arange(len(back)) > back.argmax())]
    beside = np.cross(line[:, :3, 3] - grasp.position, approach)
    assert np.linalg.norm(beside, axis=1).max() < 5e-4
    np.testing.assert_allclose(line[:, :3, 2] @ approach, 1.0, atol=1e-5)
    assert cell.seconds < 6


@pytest.mark.parametrize(
    ("grasp", "reason"),
    [
        (cube_grasp(offset=(0.15, 0, 0)), "missed"),
        (cube_grasp(angle=np.pi / 4), "collision"),  # 8.5 cm across the diagonal
        (cube_grasp(width=0.03), "collision"),  # the fingers come down on its top
        (cube_grasp(offset=(0, 0, -0.05)), "collision"),  # into the table
        (Grasp(np.array([1.5, 0.0, 0.03]), 0.0, 0.08, 1.0), "ik"),
    ],
)
def test_failures_are_named(cell, box_set, grasp, reason):
    cell.load(cube_scene(box_set))
    outcome = execute_grasp(cell, grasp)
    assert outcome.reason == reason and not outcome.success
    assert cell.remaining == {0}
    np.testing.assert_allclose(cell.robot.q, cell.home, atol=5e-3)


@pytest.mark.parametrize("limit", [10.0, 25.0])
def test_a_contact_stops_the_arm_on_its_way_to_the_pregrasp(cell, box_set, monkeypatch, limit):
    """A column of 2.5 kg and 36 cm between home and the cube, which the hand would knock over."""
    shape = NativeShape("box", (0.05, 0.07, 0.36))
    column = native_object("column", shape, 2000.0, 0.7, (1.0, 0.0, 0.0, 1.0))
    standing = Placement(column, np.array([0.42, 0.0, 0.18]), np.array([0.0, 0.0, 0.0, 1.0]))
    cube = cube_scene(box_set, position=(0.5, -0.06, 0.03)).placements
    stops = with_settings(cell.config, "execution", {"contact_stop": limit})
    monkeypatch.setattr(cell, "config", stops)
    cell.load(Scene("isolated", 0, (*cube, standing)))
    outcome = execute_grasp(cell, cube_grasp(offset=(0.0, -0.06, 0.0)))
    assert outcome.reason == "collision" and f"allowed are {limit} N" in outcome.detail
    assert outcome.sim_seconds < 1.5  # 0.5 s to the column, the rest back home


def test_a_hand_that_presses_less_for_a_moment_has_missed_nothing(cell, box_set, monkeypatch):
    cell.load(cube_scene(box_set))
    felt, grips = iter([False]), cell.robot.grips
    monkeypatch.setattr(cell.robot, "grips", lambda: next(felt, True) and grips())
    assert execute_grasp(cell, cube_grasp()).reason == "success"


def test_the_arm_keeps_its_wrist_off_the_tray(cell, box_set):
    """A hand that leans by 75 degrees, low over the table: on the left side of the workspace its
    wrist is over the table, on the right side, as far from the middle, it would be in the
    tray's wall by 6 mm."""
    cell.load(cube_scene(box_set))
    tilt, reached = np.deg2rad(75), []
    for side in (1, -1):
        approach = np.array([0.0, -side * np.sin(tilt), -np.cos(tilt)])
        position = np.array([0.5, side * 0.12, 0.06])
        reached.append(reaches(cell, Grasp(position, 0.0, 0.08, 1.0, approach)))
    assert reached == [True, False]


def test_a_bottle_is_carried_over_the_tray_and_not_into_its_wall(cell, monkeypatch):
    """Gripped at its neck, 18 cm over the table, it hangs lower than the tray's wall at the height
    from which other things are released."""
    shape = NativeShape("cylinder", (0.02, 0.2))
    bottle = native_object("bottle", shape, 500.0, 0.8, (1.0, 0.0, 0.0, 1.0))
    standing = Placement(bottle, np.array([0.5, 0.0, 0.1]), np.array([0.0, 0.0, 0.0, 1.0]))
    cell.load(Scene("isolated", 0, (standing,)))
    dropped = []
    monkeypatch.setattr(cell, "retire", lambda index: dropped.append(cell.object_position(index)))
    outcome = execute_grasp(cell, Grasp(np.array([0.5, 0.0, 0.18]), 0.0, 0.06, 1.0))
    assert outcome.reason == "success", outcome.detail
    assert abs(dropped[0][:2] - TRAY_CENTRE).max() < TRAY_HALF_SIZE


def test_what_turns_until_it_hangs_is_lifted_off_the_table(cell):
    """A bar of 0.5 kg and 30 cm, gripped 8 cm beside its middle, hangs 23 cm below the fingers in
    the end: lifted to 22 cm, its lower end would still rest on the table."""
    mass, size = 0.5, (0.024, 0.3, 0.03)
    bar = native_object("bar", NativeShape("box", size), mass / np.prod(size), 0.5, (1, 0, 0, 1))
    lying = Placement(bar, np.array([0.5, 0.0, 0.015]), np.array([0.0, 0.0, 0.0, 1.0]))
    cell.load(Scene("isolated", 0, (lying,)))
    outcome = execute_grasp(cell, Grasp(np.array([0.5, 0.08, 0.02]), 0.0, 0.05, 1.0))
    assert outcome.success, outcome.detail
    assert outcome.motion.turned > np.deg2rad(45)


@pytest.mark.parametrize(("closed_at", "reason"), [(0.03, "success"), (None, "ik")])
def test_a_hand_that_has_risen_lifts_by_what_is_left(cell, box_set, closed_at, reason):
    """A learned policy may hand the arm over when it has lifted: here by 24 cm, at 0.69 m from the
    arm, where 30 cm more are out of its reach."""

    def risen(cell, grasp):
        close_fingers(cell, open_loop(cell, grasp).wait)
        T_WE = forward_kinematics(cell.robot.q)
        T_WE[2, 3] += 0.24
        follow(cell, line(cell, cell.robot.q, T_WE, 0.2))
        return ApproachResult(cell.step, None, closed_at)

    cell.load(cube_scene(box_set, (0.69, 0.0, 0.03)))
    outcome = execute_grasp(cell, cube_grasp(offset=(0.19, 0.0, 0.0)), risen)
    assert outcome.reason == reason


@needs_pybullet
def test_a_frictionless_object_slips(cell, box_set):
    cell.load(cube_scene(box_set))
    from envs.pybullet_panda import FINGERS

    # Pads and cube without any friction: the lift leaves the cube behind.
    for body, link in ((cell.bodies[0], -1), *((cell.robot.body, f) for f in FINGERS)):
        pybullet.changeDynamics(
            body, link, lateralFriction=0.0, spinningFriction=0.0, rollingFriction=0.0,
            physicsClientId=cell.client,
        )  # fmt: skip
    assert execute_grasp(cell, cube_grasp()).reason == "slipped"


def test_an_object_slides_along_the_fingertips_and_not_along_the_closing_line():
    """By (3, 9, 4) mm in the hand's axes, the second of which is the closing line, and back again:
    sqrt(3^2 + 4^2) = 5 mm."""
    hand = forward_kinematics(np.array([0.3, 0.2, -0.4, -2.0, 0.5, 1.8, 0.6]))
    there = np.eye(4)
    there[:3, 3] = 0.003, 0.009, 0.004
    moved = iter([np.eye(4), there, np.eye(4)])
    cell = SimpleNamespace(
        robot=SimpleNamespace(tip_pose=lambda: hand),
        object_pose=lambda index: hand @ next(moved),
    )
    motion = InHandMotion(cell, 0)
    for _ in range(2):
        motion.look()
    assert motion.slid == pytest.approx(0.005)
    assert motion.turned == pytest.approx(0.0, abs=1e-7)


class _FeltRobot:
    """Fingers that close as a test says; what they were told is noted, newtons a finger."""

    grip_force, opening, dt = 10.0, 0.050, 1 / 240

    def __init__(self, pull: float):
        self._pull, self.told = pull, [self.grip_force]

    def external_force(self) -> float:
        return self._pull

    def command_gripper(self, width: float, force: float) -> None:
        assert width == 0.0
        self.told.append(force)


def feel_for_a_sixtieth_of_a_second(grip: WeighingGrip) -> None:
    for _ in range(4):
        grip.feel()


@pytest.mark.parametrize(
    ("closed_by", "firmly", "force"),
    [(0.0, False, 10.0), (0.0049, False, 10.0), (0.0051, False, 40.0), (0.0, True, 40.0)],
)
def test_what_gives_way_between_the_fingers_is_gripped_firmly(closed_by, firmly, force):
    robot = _FeltRobot(pull=1.0)  # 3 x 1 N / (2 x 0.4) = 3.75 N a finger would do
    grip = WeighingGrip(robot, firmly)
    robot.opening -= closed_by
    feel_for_a_sixtieth_of_a_second(grip)
    assert robot.told[-1] == force


def test_a_grip_that_gave_way_stays_as_hard_as_the_weight_needs():
    robot = _FeltRobot(pull=14.4)
    grip = WeighingGrip(robot)
    for _ in range(3):
        grip.feel()
    assert robot.told == [10.0], "it has not felt for long enough"
    grip.feel()
    assert robot.told[-1] == pytest.approx(54.0)  # 3 x 14.4 N / (2 x 0.4)
    robot.opening -= 0.01
    grip.feel()
    assert robot.told[-1] == pytest.approx(54.0)  # no softer
    robot.opening += 0.01  # turned back
    feel_for_a_sixtieth_of_a_second(grip)
    assert robot.told[-1] == pytest.approx(54.0)
