"""The cell in MuJoCo beside PyBullet's: what cameras see, what is gripped, what is a success."""

import sys

import numpy as np
import pytest
from scipy import ndimage

pytest.importorskip("mujoco", reason='MuJoCo is optional: pip install "mujoco>=3.3,<4"')

from envs.camera import Intrinsics
from envs.cell import ROBOT, TABLE_OR_BACKGROUND, PhysicsError
from envs.cell_scenes import make_scene
from envs.execution import execute_grasp
from envs.mujoco_cell import MujocoCell
from envs.objects import load_object_set
from envs.pybullet_cell import PybulletCell
from envs.simulators import make_cell
from models.planners import make_planner
from utils.config import load_config
from utils.errors import UserError
from utils.geometry import GripperGeometry, Workspace
from utils.transforms import look_at, position_quaternion


@pytest.fixture(scope="module")
def worlds(config):
    with PybulletCell(config) as bullet, MujocoCell(config) as mujoco:
        yield bullet, mujoco


@pytest.fixture(scope="module")
def pile(config):
    objects = load_object_set("random_urdfs", cache_dir=config.cache_folder)
    return make_scene("pile", objects, 2, config)


def away_from_edges(depth: np.ndarray) -> np.ndarray:
    """Pixels with nothing but a plane around them: on it, one over the depth is linear."""
    inverse = np.divide(1, depth, where=depth > 0, out=np.zeros_like(depth))
    bend = np.abs(ndimage.laplace(inverse))
    return ndimage.maximum_filter(bend, 3) < 0.005  # a step of 3 mm at 0.8 m


@pytest.mark.parametrize("mount", ["overhead", "wrist", "oblique"])
def test_both_worlds_look_the_same(worlds, pile, mount):
    """The same pixel is the same point of the same body, from every side: intrinsics, poses, depth
    and segmentation agree."""
    for cell in worlds:
        cell.build(pile)
    intrinsics = Intrinsics(280, 200, 40.0, near=0.1, far=2.0)
    T_WC = (
        look_at((1.1, -0.5, 0.6), (0.45, 0.0, 0.1))
        if mount == "oblique"
        else worlds[0].camera_pose(mount)
    )
    bullet, mujoco = (cell.look(intrinsics, T_WC) for cell in worlds)
    inside = away_from_edges(bullet.depth) & away_from_edges(mujoco.depth)
    assert inside.mean() > 0.85
    assert np.abs(bullet.depth - mujoco.depth)[inside].max() < 0.002
    same = bullet.segmentation == mujoco.segmentation
    assert same[inside].mean() > 0.999 and same.mean() > 0.985
    assert set(np.unique(mujoco.segmentation)) >= {TABLE_OR_BACKGROUND, 0, 1, 2, 3, 4}
    if mount == "oblique":
        assert ROBOT in mujoco.segmentation
    np.testing.assert_array_equal(bullet.K, mujoco.K)


def test_colours_are_the_objects_own(worlds, pile):
    """Another renderer, but the same colours and light: hues agree where the same body is seen."""
    for cell in worlds:
        cell.build(pile)
    bullet, mujoco = (cell.frame() for cell in worlds)
    for number in range(len(pile.placements)):
        both = (bullet.segmentation == number) & (mujoco.segmentation == number)
        a, b = (frame.rgb[both].mean(axis=0) for frame in (bullet, mujoco))
        assert a @ b / np.linalg.norm(a) / np.linalg.norm(b) > 0.99
        assert 0.7 < a.sum() / b.sum() < 1.4


def test_ambient_light_reaches_into_shadows(worlds, pile):
    """The hand's shadow on the table has the ambient share of the light, 0.5, as films have it."""
    mujoco = worlds[1]
    mujoco.build(pile)
    intrinsics, T_WC = (
        Intrinsics(240, 184, 45.0, 0.05, 5.0),
        look_at((1.1, -0.5, 0.6), (0.4, 0, 0.1)),
    )
    light = {"lightDirection": (0, 0, 1), "lightAmbientCoeff": 0.5, "lightDiffuseCoeff": 0.45}
    lit, shaded = (mujoco.look(intrinsics, T_WC, light=light | {"shadow": on}) for on in (0, 1))
    on_table = (lit.segmentation == TABLE_OR_BACKGROUND) & (lit.depth > 0)
    share = shaded.rgb[on_table].mean(axis=1) / lit.rgb[on_table].mean(axis=1)
    assert share.max() == pytest.approx(1.0, abs=0.02)
    assert share.min() == pytest.approx(0.5 / 0.95, abs=0.02)


def test_table_depth_is_exact(worlds, pile):
    """The overhead camera looks straight down on the table from 0.8 m."""
    mujoco = worlds[1]
    mujoco.build(pile)
    frame = mujoco.frame()
    table = frame.depth[frame.segmentation == TABLE_OR_BACKGROUND]
    np.testing.assert_allclose(table, 0.8, atol=1e-4)


def test_pictures_of_several_sizes(worlds, pile):
    mujoco = worlds[1]
    mujoco.build(pile)
    for width, height in ((64, 48), (900, 700), (64, 48)):
        image = mujoco.image(Intrinsics(width, height, 28.0), mujoco.camera_pose("overhead"))
        assert image.rgb.shape == (height, width, 3) and image.depth.shape == (height, width)
        assert image.depth[0, 0] == pytest.approx(0.8, abs=1e-4)


def test_settled_objects_stay_where_pybullet_has_them(worlds, pile):
    for cell in worlds:
        cell.load(pile)
    for index in worlds[1].remaining:
        off = worlds[0].object_position(index) - worlds[1].object_position(index)
        assert np.linalg.norm(off) < 0.003


def test_an_oracle_clears_a_pile(worlds, pile):
    """Judged by the same function as in PyBullet."""
    mujoco = worlds[1]
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
    ("gravity", "reasons"), [(70.0, {"success"}), (150.0, {"slipped", "dropped"})]
)
def test_friction_carries_what_coulomb_says(held_box, gravity, reasons):
    """Two fingers carry 2 mu F = 10 N; 0.1 kg weighs that at 100 m/s2."""
    cell, grasp = held_box

    def heavier(cell: MujocoCell) -> None:
        if cell.object_position(0)[2] > 0.19:
            cell.robot.model.opt.gravity[2] = -gravity

    cell.on_step = heavier
    assert execute_grasp(cell, grasp).reason in reasons


def test_what_is_picked_is_out_of_the_game(held_box):
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


def test_speed(held_box):
    """A cube that falls for 0.1 s is as fast as g t."""
    cell, _ = held_box
    cell.robot.data.qpos[cell.robot.model.joint("object0").qposadr[0] + 2] += 0.3
    cell.step(24)
    assert cell.speed(0) == pytest.approx(0.981, rel=0.01)


def test_a_world_that_blows_up_says_so(held_box):
    cell, _ = held_box
    cell.robot.data.qvel[:] = 1e12
    cell.step(2)
    with pytest.raises(PhysicsError):
        cell.check_physics()


def test_without_mujoco_the_error_says_what_to_do(config, monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(UserError, match="pip install"):
        make_cell(load_config(None, ["simulator=mujoco"]))


def test_randomisation_is_refused():
    with pytest.raises(UserError, match="simulator=pybullet"):
        make_cell(load_config(None, ["simulator=mujoco", "evaluate.randomise=true"]))


def test_a_cell_of_pybullet_is_not_made_for_mujoco():
    with pytest.raises(UserError, match=r"only evaluate\.py"):
        PybulletCell(load_config(None, ["simulator=mujoco"]))
