"""Grasps carried out by the whole arm, and how each failure is named."""

import numpy as np
import pytest

from envs.cell_layout import BIN_CENTRE, BIN_HALF_SIZE
from envs.execution import execute_grasp
from tests.helpers.cubes import cube_grasp, cube_scene
from tests.helpers.simulators import needs_pybullet, pybullet
from utils.transforms import Grasp


@pytest.fixture(scope="module")
def cell(bullet_cell):
    return bullet_cell


def test_good_grasp_succeeds_and_the_cube_ends_in_the_bin(cell, box_set):
    cell.load(cube_scene(box_set))
    outcome = execute_grasp(cell, cube_grasp())
    assert outcome.reason == "success" and outcome.success and outcome.object_index == 0
    assert 3 < outcome.sim_seconds < 12
    assert not cell.remaining
    assert abs(cell.object_position(0)[:2] - BIN_CENTRE).max() < BIN_HALF_SIZE
    np.testing.assert_allclose(cell.robot.q, cell.home, atol=5e-3)


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
