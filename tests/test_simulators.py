"""What holds in every simulator of the registry: the interface, and one gripper definition."""

from __future__ import annotations

import inspect
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from envs import execution
from envs.cell import TABLE_OR_BACKGROUND, Camera, Cell
from envs.cell_layout import Placement, Scene, square_walls
from envs.execution import GraspFailure, execute_grasp
from envs.object_bodies import load_object
from envs.objects import load_object_set
from envs.robot import Robot
from envs.simulators import SIMULATORS, check_simulator, make_cell, make_layout_table
from models.planners import make_planner
from tests.helpers.simulators import INSTALLED, move
from utils.config import load_config
from utils.errors import UserError
from utils.geometry import Workspace
from utils.height_map import WALL_LABEL, height_map_from_frame, height_map_from_scene
from utils.transforms import Grasp, inverse_pose, project

WIDE = 0.10  # m
SIDE = 0.09  # m, of a cube that the Panda's own hand cannot take


def _cell(simulator: str, *overrides: str):
    return make_cell(load_config(None, [f"simulator={simulator}", "sim.renderer=tiny", *overrides]))


@pytest.fixture(scope="module", params=INSTALLED)
def wide(request):
    """A cell whose hand opens 0.10 m, and the frame of a cube of 0.09 m in it."""
    with _cell(request.param, f"gripper.max_opening={WIDE}") as cell:
        config = cell.config
        cubes = load_object_set("box", scale=SIDE / 0.06, cache_dir=config.cache_folder)
        at = Placement(cubes[0], np.array([0.5, 0.0, SIDE / 2]), np.eye(4)[3])
        cell.load(Scene("isolated", 0, (at,)))
        yield cell


def test_a_hand_of_ten_centimetres_opens_that_far(wide):
    wide.robot.place(wide.home, opening=0.0)
    wide.robot.open_gripper()
    wide.step(round(1.5 / wide.dt))
    assert wide.robot.opening == pytest.approx(WIDE, abs=2e-4)
    wide.robot.command_gripper(0.2)  # wider than it can
    wide.step(round(0.5 / wide.dt))
    assert wide.robot.opening == pytest.approx(WIDE, abs=2e-4)


@pytest.mark.parametrize("policy", ["heuristic", "oracle"])
def test_planners_use_the_whole_opening(wide, policy):
    wide.load(wide.scene)
    plan = make_planner(policy, wide.gripper, Workspace(), 0)
    best = plan(wide.frame(with_truth=True))[0]
    assert SIDE < best.width <= WIDE


def test_a_hand_of_ten_centimetres_grasps_a_cube_of_nine(wide):
    wide.load(wide.scene)
    outcome = execute_grasp(wide, Grasp(np.array([0.5, 0.0, 0.06]), 0.0, WIDE, 1.0))
    assert outcome.reason == "success"


@pytest.mark.parametrize("simulator", INSTALLED)
def test_the_pandas_own_hand_opens_eight_centimetres(simulator, box_set):
    with _cell(simulator) as cell:
        at = Placement(box_set[0], np.array([0.5, 0.0, 0.03]), np.eye(4)[3])
        cell.load(Scene("isolated", 0, (at,)))
        cell.robot.command_gripper(0.2)
        cell.step(round(0.5 / cell.dt))
        assert cell.robot.opening == pytest.approx(0.08, abs=2e-4)


# Public methods that only the simulator's own modules call, between a cell and its robot; `mirror`
# belongs to what `Cell.detailed_twin` returns.
OWN = {
    "pybullet": {"mirror"},
    "mujoco": {"meet", "pose", "step"},
}


@pytest.mark.parametrize("simulator", INSTALLED)
def test_a_simulator_brings_nothing_under_another_name(simulator, box_set):
    """Cell, robot and camera are implementations of the abstract ones. What the abstract classes
    declare keeps its parameters, so that calls mean the same in every simulator, and what they do
    not declare is known here."""
    with _cell(simulator) as cell:
        at = Placement(box_set[0], np.array([0.5, 0.0, 0.03]), np.eye(4)[3])
        cell.build(Scene("isolated", 0, (at,)))
        assert isinstance(cell.robot, Robot) and isinstance(cell.camera, Camera)
        added = set()
        for thing, base in ((cell, Cell), (cell.robot, Robot), (cell.camera, Camera)):
            for name, method in inspect.getmembers(base, inspect.isfunction):
                if name != "__init__":
                    own = inspect.signature(getattr(type(thing), name))
                    assert own.parameters.keys() == inspect.signature(method).parameters.keys()
            added |= {name for name in dir(type(thing)) if not name.startswith("_")} - {*dir(base)}
        assert added - {"camera"} == OWN[simulator]  # Cell.camera is an attribute


@pytest.fixture(scope="module", params=INSTALLED)
def walled(request, box_set):
    """A cell with a cube between walls of 10 cm, and its scene."""
    walls = tuple(square_walls(np.array([0.5, 0.0]), 0.15, 0.10, 0.01))
    at = Placement(box_set[0], np.array([0.5, 0.0, 0.03]), np.eye(4)[3])
    with _cell(request.param) as cell:
        cell.load(Scene("bin", 0, (at,), walls))
        yield cell


def test_walls_are_seen_where_they_stand(walled):
    """Their tops are 0.7 m before the camera, which is 0.8 m over the table."""
    frame = walled.frame(with_truth=True)
    for off, z, error in ((0.155, 0.1, 1e-3), (0.1505, 0.05, 0.008), (0.1, 0.0, 1e-3)):
        for side in (-1, 1):  # the top, the inner face, the table before it
            (u, v), _ = project(np.array([0.5 + side * off, 0.03, z]), frame.K, frame.T_WC)
            assert frame.depth[round(v), round(u)] == pytest.approx(0.8 - z, abs=error)
            assert frame.segmentation[round(v), round(u)] == TABLE_OR_BACKGROUND
    heights = height_map_from_frame(frame, Workspace())
    exact = height_map_from_scene(frame.truth, Workspace())
    for found in (heights, exact):
        at = found.index(np.array([[0.655, 0.0], [0.345, 0.1], [0.4, 0.155], [0.6, -0.155]]))
        assert (found.label[at] == WALL_LABEL).all()
        np.testing.assert_allclose(found.height[at], 0.1, atol=1e-3)


def test_a_wall_is_part_of_the_table(walled):
    """What touches it touches the table, it is painted as the table is, and it stops the hand."""
    walled.load(walled.scene)
    for x, touches in ((0.55, False), (0.6203, True)):  # the wall begins at x = 0.65
        move(walled, 0, position=(x, 0.0, 0.06))
        walled.step()
        assert walled.touches_table(0) == touches
    walled.load(walled.scene)
    walled.randomizable().paint([(1.0, 0.0, 0.0, 1.0), (0.0, 0.0, 1.0, 1.0)])
    frame = walled.frame()
    (u, v), _ = project(np.array([0.655, 0.0, 0.1]), frame.K, frame.T_WC)
    red, green, blue = frame.rgb[round(v), round(u)]
    assert red > 100 > max(green, blue)
    outcome = execute_grasp(walled, Grasp(np.array([0.62, 0.0, 0.03]), 0.0, 0.08, 1.0))
    assert outcome.reason == "collision"


def test_an_unknown_simulator_is_refused():
    config = load_config(None, ["simulator=mujocco"])
    with pytest.raises(UserError, match="expected one of mujoco, pybullet; did you mean mujoco?"):
        make_cell(config)


@pytest.mark.parametrize(
    ("installed", "chosen"), [(True, ("random_urdfs", "primitives")), (False, ("primitives",))]
)
def test_auto_among_object_sets_is_what_is_offered_and_none_twice(monkeypatch, installed, chosen):
    spec = object() if installed else None
    monkeypatch.setattr("utils.config_types.importlib.util.find_spec", lambda _: spec)
    config = load_config(None, ["evaluate.object_sets=auto,primitives"])
    assert config.evaluate.object_sets == chosen


def test_auto_is_the_simulator_that_is_installed():
    config = load_config(None, ["simulator=auto"])
    assert config.simulator == config.scene.simulator == INSTALLED[0]


@pytest.mark.parametrize("name", SIMULATORS)
def test_a_simulator_that_is_not_installed_is_refused(name, monkeypatch):
    missing = replace(SIMULATORS[name], package="no_such_package")
    monkeypatch.setitem(SIMULATORS, name, missing)
    config = load_config(None, [f"simulator={name}", f"scene.simulator={name}"])
    message = f"simulator={name}: the package no_such_package is not installed; .*pip install"
    with pytest.raises(UserError, match=message):
        make_cell(config)
    with pytest.raises(UserError, match=f"scene.{message}"):
        make_layout_table(config, [])
    (other,) = SIMULATORS.keys() - {name}
    if other in INSTALLED:
        mixed = load_config(None, [f"simulator={other}", f"scene.simulator={name}"])
        with pytest.raises(UserError, match=f"scene.{message}.*use scene.simulator={other}"):
            check_simulator(mixed)


def test_a_body_tumbles_alike_however_it_lies_in_its_file(taught_cell, tmp_path):
    """A rod flung with a spin about none of its axes, from a file in which it is straight and from
    one in which it is not. Without products of inertia the two end 150 degrees apart."""
    turn = trimesh.transformations.rotation_matrix(np.pi / 4, (0, 1, 0))
    rod, ends = trimesh.creation.box((0.12, 0.02, 0.02)), []
    for name, T in (("straight", np.eye(4)), ("turned", turn)):
        rod.copy().apply_transform(T).export(tmp_path / f"{name}.stl")
        model = load_object(tmp_path / f"{name}.stl", cache_dir=tmp_path)
        place = turn @ inverse_pose(T)  # the rod itself starts alike
        place[:3, 3] = 0.5, 0.0, 0.6
        quaternion = Rotation.from_matrix(place[:3, :3]).as_quat()
        taught_cell.load(Scene("isolated", 0, (Placement(model, place[:3, 3], quaternion),)))
        taught_cell.carry(0, place, np.array([0.0, 0.0, 1.0]), 20.0)
        np.testing.assert_allclose(taught_cell.object_pose(0), place, atol=1e-6)
        taught_cell.step(round(0.2 / taught_cell.dt))
        ends.append(taught_cell.object_pose(0) @ T)
    apart = Rotation.from_matrix(ends[0][:3, :3].T @ ends[1][:3, :3]).magnitude()
    assert np.degrees(apart) < 2


def test_a_thin_plate_keeps_the_inertia_that_its_file_states(taught_cell, tmp_path):
    """Of a lamina one moment is the sum of the two others, but for rounding after scaling."""
    trimesh.creation.box((0.12, 0.10, 0.002)).export(tmp_path / "plate.stl")
    mesh = "<geometry><mesh filename='plate.stl'/></geometry>"
    (tmp_path / "plate.urdf").write_text(
        "<robot name='plate'><link name='l'><inertial><mass value='0.18'/><inertia ixx='0.00015' "
        "iyy='0.000216' izz='0.000366' ixy='0' ixz='0' iyz='0'/></inertial>"
        f"<collision>{mesh}</collision></link></robot>"
    )
    for scale in (0.65, 0.9, 1.0):
        model = load_object(tmp_path / "plate.urdf", scale=scale, cache_dir=tmp_path)
        at = Placement(model, np.array([0.5, 0.0, 0.01]), np.eye(4)[3])
        taught_cell.load(Scene("isolated", 0, (at,)))
        stated = 1e-4 * np.array([1.5, 2.16, 3.66]) * scale**5
        np.testing.assert_allclose(model.inertia, stated, rtol=1e-6)


def test_what_rests_on_the_table_touches_it_however_long(taught_cell, box_set):
    """MuJoCo lets it sleep, and has no contacts of what sleeps."""
    places = [(0.45, -0.06, 0.03), (0.55, 0.06, 0.03), (0.55, 0.06, 0.09)]
    cubes = tuple(Placement(box_set[0], np.array(place), np.eye(4)[3]) for place in places)
    taught_cell.load(Scene("isolated", 0, cubes))
    taught_cell.step(round(1.0 / taught_cell.dt))
    assert [taught_cell.touches_table(i) for i in range(3)] == [True, True, False]


@pytest.mark.parametrize("simulator", INSTALLED)
def test_the_true_friction_is_that_of_the_randomised_cell(simulator, box_set):
    ranges = [
        f"randomization.physics.{name}=[{low}, {high}, uniform, scale, episode]"
        for name, low, high in (("object_friction", 0.5, 0.6), ("finger_friction", 0.8, 0.9))
    ]
    with _cell(simulator, "evaluate.randomise=true", *ranges) as cell:
        at = Placement(box_set[0], np.array([0.5, 0.0, 0.03]), np.eye(4)[3])
        cell.load(Scene("isolated", 3, (at,)))
        (friction,) = (thing.friction for thing in cell.truth().objects)
        assert 0.4 <= friction / box_set[0].friction <= 0.54


def test_an_arm_that_a_failure_has_stopped_goes_home_from_where_it_is(cell, monkeypatch):
    """In the middle of a quick motion; the gate's reference is where the arm is then."""
    rest, apart, go_home = cell.robot.q, [], execution.go_home

    def lost(cell, grasp):
        path = cell.robot.joint_move(rest, rest + 0.5)
        half = len(path.positions) // 2
        for q, velocity in zip(path.positions[:half], path.velocities[:half]):
            cell.robot.command_arm(q, velocity)
            cell.step()
        assert np.abs(path.velocities[half]).max() > 1.0  # rad/s
        raise GraspFailure("missed")

    def go_home_later(cell):
        cell.step(round(0.3 / cell.dt))
        apart.append(np.abs(cell.robot.q - cell.robot.gate._q).max())
        return go_home(cell)

    monkeypatch.setattr(execution, "go_home", go_home_later)
    outcome = execute_grasp(cell, Grasp((0.5, 0.0, 0.03), 0.0, 0.08, 1.0), lost)
    assert outcome.reason == "missed" and outcome.detail == "" and apart[0] < 0.02


def test_the_arm_does_not_meet_itself(cell):
    """A posture in which the hand's hull overlaps that of a link: nothing is felt."""
    q = np.array([0.0, -0.3, 0.0, -2.9, 0.0, 0.4, 0.8])
    cell.robot.place(q)
    cell.step(round(0.2 / cell.dt))
    assert np.linalg.norm(cell.robot.external_force()) < 2 and np.abs(cell.robot.q - q).max() < 0.01


def test_placing_the_arm_leaves_a_moving_object_moving(cell):
    move(cell, 0, velocity=(0.0, 0.0, 1.0))
    cell.robot.place(cell.home)
    assert cell.speed(0) == pytest.approx(1.0)
