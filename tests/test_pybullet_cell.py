"""The cell in PyBullet: frames, physics steps, and what counts as gripped and lifted."""

import numpy as np
import pytest

pytest.importorskip("pybullet")

import pybullet

from envs.cell import ROBOT, TABLE_OR_BACKGROUND, PhysicsError
from envs.pybullet_cell import PybulletCell
from envs.pybullet_panda import FINGERS
from envs.randomized_env import RandomizedGraspingEnv
from envs.robot_kinematics import choose_posture, forward_kinematics, inverse_kinematics
from envs.simulators import make_cell
from tests.helpers.cubes import cube_grasp, cube_scene
from utils.config import load_config, with_settings
from utils.errors import UserError
from utils.transforms import top_down_pose


@pytest.fixture(scope="module")
def cell(bullet_cell):
    return bullet_cell


def test_frame_shows_the_cube_where_it_is(cell, box_set):
    cell.load(cube_scene(box_set))
    frame = cell.frame(with_truth=True)
    on_cube = frame.segmentation == 0
    top = frame.points()[on_cube & (frame.points()[..., 2] > 0.059)]
    np.testing.assert_allclose(top.mean(axis=0), [0.5, 0.0, 0.06], atol=1e-3)
    np.testing.assert_allclose(np.ptp(top, axis=0)[:2], 0.06, atol=4e-3)
    assert (frame.segmentation == TABLE_OR_BACKGROUND).any()
    assert not (frame.segmentation == ROBOT).any(), "the robot at home is in the overhead view"
    assert cell.frame().truth is None
    vertices = np.vstack([s.vertices for s in frame.truth.objects[0].solids])
    np.testing.assert_allclose(np.ptp(vertices, axis=0), 0.06, atol=1e-3)


def test_wrist_camera_sees_the_workspace(config, box_set):
    wrist = with_settings(config, "camera", {"mount": "wrist"})
    with PybulletCell(wrist) as cell:
        cell.load(cube_scene(box_set, position=(0.42, 0.0, 0.03)))
        frame = cell.frame()
        cube = frame.points()[(frame.segmentation == 0) & (frame.points()[..., 2] > 0.059)]
        np.testing.assert_allclose(cube.mean(axis=0), [0.42, 0.0, 0.06], atol=3e-3)


@pytest.mark.parametrize("count", [2, 12, 20, 31])  # 31: rounding would lose a step
def test_steps_in_one_call_are_the_same_steps(config, box_set, count):
    """A cube falls on the table and the hand presses on it: bit-identical to single steps."""
    ends = []
    for on_step in (None, lambda cell: None):  # with a hook every step is a call of its own
        with PybulletCell(config) as cell:
            cell.build(cube_scene(box_set, position=(0.5, 0.0, 0.06)))
            cell.on_step = on_step
            pressing = inverse_kinematics(
                top_down_pose([0.5, 0.0, 0.05], 0.0), cell.home, cell.home
            )
            cell.robot.drive_arm_to(pressing)
            for _ in range(480 // count):
                cell.step(count)
            assert cell.robot.touches(), "the hand has not met the cube"
            assert cell.steps == 480 // count * count
            state = [*cell.robot.joint_state(), cell.robot.contact_force()]
            ends.append(np.concatenate([np.ravel(x) for x in (*state, cell.object_pose(0))]))
    np.testing.assert_array_equal(*ends)


def test_an_object_flung_upwards_is_not_lifted(cell, box_set):
    cell.load(cube_scene(box_set))
    pybullet.resetBaseVelocity(cell.bodies[0], [0, 0, 4], [0, 0, 0], physicsClientId=cell.client)
    cell.step(24)
    assert cell.object_position(0)[2] > 0.15
    assert cell.held_object() is None and not cell.is_lifted(0, 0.15)


def test_a_fist_on_the_cube_is_no_grip(cell, box_set):
    cell.load(cube_scene(box_set))
    above = choose_posture(top_down_pose([0.5, 0.0, 0.075], 0.0), cell.home)
    cell.robot.place(above, opening=0.0)
    target = forward_kinematics(above)
    target[2, 3] -= 0.03
    pressing = inverse_kinematics(target, above, above)
    for _ in range(60):
        cell.robot.drive_arm_to(pressing)
        cell.step()
    assert cell.robot.contact_force() > 10
    assert cell.held_object() is None


def test_a_cube_lying_on_the_fingers_is_no_grip(cell, box_set):
    cell.load(cube_scene(box_set, position=(0.5, 0.3, 0.03)))
    level = cell.home + [0, 0, 0, 0, 0, np.pi / 2, 0]  # the hand points forwards, fingers level
    cell.robot.place(level, opening=0.02)
    tip = cell.robot.tip_pose()[:3, 3]
    pybullet.resetBasePositionAndOrientation(
        cell.bodies[0], tip + [-0.01, 0, 0.045], [0, 0, 0, 1], physicsClientId=cell.client
    )
    cell.step(60)
    touching = [
        pybullet.getContactPoints(cell.robot.body, cell.bodies[0], f, physicsClientId=cell.client)
        for f in FINGERS
    ]
    assert all(touching), "the test needs the cube to rest on both fingers"
    assert cell.held_object() is None


def test_a_gripped_object_that_stands_on_the_table_is_not_lifted(cell, box_set):
    cell.load(cube_scene(box_set))
    posture = choose_posture(cube_grasp().pose, cell.home)
    cell.robot.place(posture, opening=0.08)
    cell.robot.command_gripper(0.0)
    cell.step(240)
    assert cell.held_object() == 0
    assert not cell.is_lifted(0, height=0.02)


def test_non_finite_physics_is_noticed(cell, box_set):
    cell.load(cube_scene(box_set))
    pybullet.resetBasePositionAndOrientation(
        cell.bodies[0], [np.nan, 0, 0], [0, 0, 0, 1], physicsClientId=cell.client
    )
    with pytest.raises(PhysicsError):
        cell.check_physics()


def test_lost_objects_are_retired(cell, box_set):
    cell.load(cube_scene(box_set))
    pybullet.resetBasePositionAndOrientation(
        cell.bodies[0], [0.5, 0.0, -0.5], [0, 0, 0, 1], physicsClientId=cell.client
    )
    assert cell.retire_lost_objects() == [0] and not cell.remaining


@pytest.mark.parametrize(
    ("make", "override"),
    [
        (PybulletCell, "sim.renderer=egl"),
        (make_cell, "randomization.texture_folder=nowhere"),
        (
            lambda config: RandomizedGraspingEnv(config=config),
            "randomization.texture_folder=nowhere",
        ),
    ],
)
def test_what_is_refused_leaves_no_client_behind(monkeypatch, make, override):
    monkeypatch.setattr("envs.pybullet_camera._egl_plugin", lambda: None)
    clients = []
    connect = pybullet.connect
    monkeypatch.setattr(pybullet, "connect", lambda *a: clients.append(connect(*a)) or clients[-1])
    config = load_config(None, ["evaluate.randomise=true", "sim.renderer=tiny", override])
    with pytest.raises(UserError):
        make(config)
    assert clients and not any(map(pybullet.isConnected, clients))
