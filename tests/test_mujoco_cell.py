"""The cell in MuJoCo beside PyBullet's: its bodies, what is gripped, what is a success."""

import os
from dataclasses import replace

import numpy as np
import pytest

from envs.cell import PhysicsError
from envs.cell_layout import Scene
from envs.cell_scenes import make_scene
from envs.execution import execute_grasp
from envs.mujoco_bodies import wake
from envs.mujoco_cell import MujocoCell
from envs.object_shapes import NativeShape
from envs.objects import load_object_set
from models.planners import make_planner
from tests.helpers.cubes import cube_scene
from tests.helpers.simulators import pybullet
from utils.errors import UserError
from utils.geometry import TRAY_CENTRE, GripperGeometry, Workspace
from utils.transforms import position_quaternion


def test_settled_objects_stay_where_pybullet_has_them(cells, pile):
    for cell in cells:
        cell.load(pile)
    for index in cells[1].remaining:
        off = cells[0].object_position(index) - cells[1].object_position(index)
        assert np.linalg.norm(off) < 0.003


def test_frictions_are_pybullets(cells, pile):
    """Bullet multiplies the coefficients of two bodies, which it tells itself. The pile's objects
    have the same one, so that MuJoCo's larger of two squares is their product."""
    bullet, mujoco = cells
    for cell in cells:
        cell.load(pile)

    def coefficient(body: int, link: int = -1) -> float:
        return pybullet.getDynamicsInfo(body, link, physicsClientId=bullet.client)[1]

    robot = bullet.robot.body
    links = pybullet.getNumJoints(robot, physicsClientId=bullet.client)
    theirs = {"panda_link0": coefficient(robot), "table": coefficient(bullet.table)}
    theirs |= {f"tray{i}": coefficient(wall) for i, wall in enumerate(bullet.tray)}
    for link in range(links):
        name = pybullet.getJointInfo(robot, link, physicsClientId=bullet.client)[12].decode()
        theirs[name] = coefficient(robot, link)
    theirs["panda_hand"] = theirs["panda_link7"]  # one body in Bullet

    model = mujoco.robot.model
    found = set()
    for pair, ends in enumerate(zip(model.pair_geom1, model.pair_geom2)):
        thing, other = sorted(model.geom_bodyid[list(ends)], key=mujoco.bodies.count, reverse=True)
        expected = theirs[model.body(other).name]
        expected *= coefficient(bullet.bodies[mujoco.bodies.index(thing)])
        assert model.pair_friction[pair, :2] == pytest.approx(expected), model.body(other).name
        found.add(model.body(other).name)
    assert found == theirs.keys() & {model.body(i).name for i in model.geom_bodyid}
    own = [coefficient(body) for body in bullet.bodies]
    assert own == own[:1] * len(own)
    squares = model.geom_friction[np.isin(model.geom_bodyid, mujoco.bodies), 0]
    assert squares == pytest.approx(own[0] ** 2)


def test_what_leans_on_a_retired_object_wakes_and_falls(config, box_set):
    """Two cubes of 6 cm, one on the other; both sleep, and the upper one comes down by a cube."""
    one = make_scene("isolated", box_set, 0, config).placements[0]
    stack = [replace(one, position=np.array([0.5, 0.0, z]), quaternion=np.array([0, 0, 0, 1.0]))
             for z in (0.03, 0.09)]  # fmt: skip
    with MujocoCell(config) as cell:
        cell.build(Scene("pile", 0, tuple(stack)))
        cell.step(60)
        assert not cell.robot.data.body_awake[cell.bodies].any()
        cell.retire(0)
        cell.step(24)  # 0.1 s: by 4.9 cm of its 6
        assert cell.object_position(1)[2] == pytest.approx(0.09 - 9.81 * 0.1**2 / 2, abs=3e-3)


@pytest.mark.parametrize(
    "off_centre, height, stays",
    [(0.0, 0.03, True), (0.10, 0.03, True), (0.12, 0.03, False), (0.0, 0.3, False)],
)
def test_a_retired_object_stays_in_the_tray_and_nowhere_else(
    cells, box_set, off_centre, height, stays
):
    """A cube of 6 cm; the tray is 26 cm wide and 8 cm high, and its walls are 5 mm thick."""
    one = make_scene("isolated", box_set, 0, cells[0].config).placements[0]
    place = np.array([*(TRAY_CENTRE + [0.0, off_centre]), height])
    level = replace(one, position=place, quaternion=np.array([0, 0, 0, 1.0]))
    for cell in cells:
        cell.build(Scene("isolated", 0, (level,)))
        cell.retire(0)
        cell.step(24)
        expected = place if stays else [*cell.config.workspace.center, -0.5]
        assert cell.object_position(0) == pytest.approx(expected, abs=1e-4)


def test_no_camera_sees_what_was_taken_from_the_table(cells, box_set):
    for cell in cells:
        cell.load(cube_scene(box_set))
        assert (cell.frame().depth < 0.75).sum() > 500
        cell.retire(0)
        assert cell.frame().depth.min() > 0.79


@pytest.mark.slow
def test_an_oracle_clears_a_pile(cells, pile):
    """Judged by the same function as in PyBullet."""
    mujoco = cells[1]
    mujoco.load(pile)
    plan = make_planner("oracle", GripperGeometry(), Workspace(), 0)
    outcomes = []
    while mujoco.remaining and len(outcomes) < 6:
        outcomes.append(execute_grasp(mujoco, plan(mujoco.frame(with_truth=True))[0]))
    assert sum(outcome.success for outcome in outcomes) >= 4
    assert all(3 < outcome.sim_seconds < 10 for outcome in outcomes)


@pytest.fixture
def held_box(config, box_set):
    """A cell, and the best grasp of the cube (0.1 kg, friction 0.5, by a grip of 10 N)."""
    with MujocoCell(config) as cell:
        cell.load(make_scene("isolated", box_set, 0, config))
        plan = make_planner("oracle", GripperGeometry(), Workspace(), 0)
        yield cell, plan(cell.frame(with_truth=True))[0]


@pytest.mark.parametrize(
    ("gravity", "firmly", "reasons"),
    [
        (70.0, False, {"success"}),
        (150.0, False, {"slipped", "dropped"}),
        (280.0, True, {"success"}),
        (600.0, True, {"slipped", "dropped"}),
    ],
)
def test_friction_carries_what_coulomb_says(held_box, gravity, firmly, reasons, monkeypatch):
    """Two fingers carry 2 mu F = 10 N; 0.1 kg weighs that at 100 m/s2. Firmly, it is four times as
    much. The hand does not press harder as the weight grows."""
    cell, grasp = held_box
    monkeypatch.setattr("envs.execution.holding_force", lambda pull: 0.0)

    def heavier(cell: MujocoCell) -> None:
        if cell.object_position(0)[2] > 0.19:
            cell.robot.model.opt.gravity[2] = -gravity

    cell.on_step = heavier
    assert execute_grasp(cell, grasp, firmly=firmly).reason in reasons


def test_what_is_picked_is_out_of_the_round(held_box):
    cell, grasp = held_box
    assert cell.held_object() is None
    assert execute_grasp(cell, grasp).success
    assert cell.remaining == set()
    before = cell.object_position(0)
    cell.step(120)
    np.testing.assert_allclose(cell.object_position(0), before, atol=1e-6)


def test_a_collision_stops_the_approach(held_box):
    cell, grasp = held_box
    across = type(grasp)(grasp.position + [0, 0, -0.001], grasp.angle, 0.03, 1.0)
    outcome = execute_grasp(cell, across)  # fingers 3 cm apart come down on 6 cm of cube
    assert outcome.reason == "collision"


def test_fingertips_are_no_palm(held_box):
    """Fingers 3 cm apart come down on 6 cm of cube: what stops them is not under the palm."""
    cell, grasp = held_box
    narrow = type(grasp)(grasp.position, grasp.angle, 0.03, 1.0)
    assert execute_grasp(cell, narrow).palm_stopped_at is None
    assert not cell.robot.palm_touches()


def test_what_presses_on_the_palm_is_felt(held_box):
    """The cube put between the open fingers, up against the hand: E is 47 mm below the palm."""
    cell, _ = held_box
    T_WE = cell.robot.tip_pose()
    place = cell.robot.model.joint("object0").qposadr[0]
    cell.robot.data.qpos[place : place + 3] = T_WE[:3, 3] - 0.018 * T_WE[:3, 2]
    cell.robot.data.qpos[place + 3 : place + 7] = np.roll(position_quaternion(T_WE)[1], 1)
    cell.step(1)
    assert cell.robot.palm_touches()


def test_the_speed_of_an_object_is_that_of_free_fall(held_box):
    """A cube that falls for 0.1 s is as fast as g t."""
    cell, _ = held_box
    cell.robot.data.qpos[cell.robot.model.joint("object0").qposadr[0] + 2] += 0.3
    cell.step(24)
    assert cell.speed(0) == pytest.approx(0.981, rel=0.01)


def test_diverged_physics_is_reported(held_box):
    cell, _ = held_box
    cell.robot.data.qvel[:] = 1e12
    cell.step(2)
    with pytest.raises(PhysicsError):
        cell.check_physics()


def test_a_pose_that_is_not_finite_is_a_fault_of_the_physics(held_box):
    cell, _ = held_box
    start = cell._places[0]
    cell.robot.data.qpos[start + 3 : start + 7] = np.nan
    with pytest.raises(PhysicsError, match="object 0 has a non-finite pose"):
        cell.object_pose(0)


@pytest.mark.skipif("DISPLAY" in os.environ, reason="there is a display")
def test_without_a_display_no_window_opens(config):
    with pytest.raises(UserError, match="needs a display, and there is none here"):
        MujocoCell(config, gui=True)


@pytest.mark.skipif("DISPLAY" not in os.environ, reason="there is no display")
def test_a_window_changes_nothing(config, box_set):
    """Two scenes after each other, shown and not shown; the camera draws beside the window."""
    one = make_scene("isolated", box_set, 0, config)
    ends = []
    for gui in (True, False):
        with MujocoCell(config, gui=gui) as cell:
            for _ in range(2):
                cell.build(one)
                cell.robot.drive_arm_to(cell.home + 0.1)
                cell.step(10)
            ends.append((cell.robot.q.tolist(), cell.frame().rgb.tolist()))
    assert ends[0] == ends[1]


@pytest.fixture(scope="module")
def scene(config):
    objects = load_object_set("primitives", cache_dir=config.cache_folder)
    return make_scene("pile", objects, 1, config)


@pytest.fixture(scope="module")
def cell(config, scene):
    with MujocoCell(config) as cell:
        cell.build(scene)
        yield cell


def test_objects_are_the_same_bodies(cell, scene):
    for i, placed in enumerate(scene.placements):
        body = cell.robot.model.body(f"object{i}")
        assert body.mass[0] == pytest.approx(placed.model.mass)
        np.testing.assert_allclose(np.sort(body.inertia), np.sort(placed.model.inertia), rtol=1e-6)
        np.testing.assert_allclose(cell.object_pose(i)[:3, 3], placed.position, atol=1e-9)


def test_shapes_lie_where_pybullet_has_them(cell, scene):
    """MuJoCo moves meshes to their own centres; their vertices in W must not notice."""
    for i, placed in enumerate(scene.placements):
        T, body = cell.object_pose(i), cell.robot.model.body(f"object{i}")
        if isinstance(placed.model.collision, NativeShape):
            sides = 2 * cell.robot.model.geom_aabb[body.geomadr[0], 3:]
            np.testing.assert_allclose(sides, placed.model.extents, atol=1e-6)
            continue
        for k, part in enumerate(placed.model.parts):
            geom = body.geomadr[0] + k
            mesh = cell.robot.model.mesh(f"object{i}_{k}")
            begin, count = mesh.vertadr[0], mesh.vertnum[0]
            vertices = cell.robot.model.mesh_vert[begin : begin + count]
            R = cell.robot.data.geom_xmat[geom].reshape(3, 3)
            seen = vertices @ R.T + cell.robot.data.geom_xpos[geom]
            expected = part @ T[:3, :3].T + T[:3, 3]
            for bound in (np.min, np.max):
                np.testing.assert_allclose(bound(seen, 0), bound(expected, 0), atol=1e-5)


def test_what_rests_in_pybullet_rests_here(cell, scene):
    """The two cells' contacts differ by tenths of a millimetre; nothing may fall or fly."""
    cell.step(round(1.0 / cell.dt))
    for i, placed in enumerate(scene.placements):
        moved = np.linalg.norm(cell.object_pose(i)[:3, 3] - placed.position)
        assert moved < 0.02, f"object {i} moved {1000 * moved:.1f} mm"


def test_a_box_slides_on_a_tilt_steeper_than_its_friction(config, box_set):
    """mu = 0.5: gravity tilted by 20 degrees (tangent 0.36) holds it, by 35 (0.70) does not."""
    cell = MujocoCell(config)
    cell.build(make_scene("isolated", box_set, 0, config))
    start = cell.object_pose(0)[:3, 3]
    moved = {}
    for degrees in (20, 35):
        cell.robot.model.opt.gravity[:] = (
            9.81 * np.sin(np.radians(degrees)), 0, -9.81 * np.cos(np.radians(degrees)),
        )  # fmt: skip
        wake(cell.robot.model, cell.robot.data, cell.bodies)
        cell.step(round(0.3 / cell.dt))
        moved[degrees] = np.linalg.norm(cell.object_pose(0)[:3, 3] - start)
    assert moved[20] < 0.005 < 0.03 < moved[35]
