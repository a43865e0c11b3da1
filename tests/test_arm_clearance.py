"""Whether arm and hand are clear of boxes: their shapes are those that the simulators move."""

from dataclasses import replace

import numpy as np
import pytest

from envs.arm_clearance import arm_is_clear, hand_is_clear, surface_points
from envs.cell_layout import Box, Scene
from envs.panda_model import ARM_DISCS, ARM_LINKS, hull_of_discs
from envs.robot_kinematics import forward_kinematics, link_poses
from envs.simulators import make_cell
from utils.config import load_config
from utils.transforms import transform_points

HOME = np.array([0, -np.pi / 4, 0, -3 * np.pi / 4, 0, np.pi / 2, np.pi / 4])


@pytest.fixture(scope="module")
def cell():
    with make_cell(load_config(None, ["sim.renderer=tiny"])) as cell:
        yield cell


def test_points_cover_a_surface():
    """A box of 10 x 6 x 4 cm: points lie on its faces, and no place on them is far from all."""
    half = np.array([0.05, 0.03, 0.02])
    corners = half * np.stack(np.meshgrid(*[(-1, 1)] * 3), axis=-1).reshape(-1, 3)
    points = surface_points(corners, 0.01)
    assert np.allclose(np.max(abs(points) / half, axis=1), 1.0)
    rng = np.random.default_rng(0)
    places = rng.uniform(-half, half, (600, 3))
    axes = rng.integers(0, 3, 600)
    rows = np.arange(600)
    places[rows, axes] = np.sign(places[rows, axes]) * half[axes]
    gaps = np.linalg.norm(places[:, None] - points, axis=2).min(axis=1)
    assert gaps.max() <= 0.01
    assert len(points) < 4 * 0.0248 / 0.01**2  # of a surface of 248 cm2


def _wall_before(x: float) -> Scene:
    box = Box(np.array([0.05, 1.0, 1.0]), np.array([x + 0.05, 0.0, 1.0]))
    return Scene("wall", 0, (), (box,), fixed=True)


@pytest.mark.parametrize(("gap", "clear"), [(0.012, True), (0.004, False), (-0.03, False)])
def test_the_farthest_corner_of_all_links_decides(cell, monkeypatch, gap, clear):
    """A wall `gap` m in front of the farthest corner of the links from the upper arm on."""
    q = np.array([HOME])
    poses = link_poses(q)[0]
    farthest = max(
        transform_points(pose, hull_of_discs(ARM_DISCS[link]))[:, 0].max()
        for pose, link in zip(poses[2:], ARM_LINKS[2:])
    )
    monkeypatch.setattr(cell, "scene", _wall_before(farthest + gap))
    assert arm_is_clear(cell, q) is clear
    # A wall that somebody has brought is not known to the arm.
    monkeypatch.setattr(cell, "scene", replace(cell.scene, layout="bin", fixed=False))
    assert arm_is_clear(cell, q)


@pytest.mark.parametrize(("gap", "clear"), [(0.012, True), (0.004, False)])
def test_the_hand_is_as_long_as_it_is(cell, monkeypatch, gap, clear):
    """Below the hand at home, which points down, its tips are `tip_below_centre` under E."""
    q = np.array([HOME])
    x, y, z = forward_kinematics(HOME)[:3, 3]
    tips = z - cell.gripper.tip_below_centre
    board = Box(np.array([0.2, 0.2, 0.01]), np.array([x, y, tips - gap - 0.01]))
    monkeypatch.setattr(cell, "scene", Scene("shelf", 0, (), (board,), fixed=True))
    assert hand_is_clear(cell, q) is clear
    below = np.array([[0.0, 0.0, 0.03]])  # of what hangs 3 cm below E
    assert not hand_is_clear(cell, q, below)
    monkeypatch.setattr(cell, "scene", replace(cell.scene, fixed=False))
    assert hand_is_clear(cell, q, below)
