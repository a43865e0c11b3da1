"""The marker board: its size, and how precisely an image gives its corners and its pose."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

pytest.importorskip("pybullet")

import pybullet

from envs.board import Board
from envs.cell import Intrinsics
from envs.pybullet_bodies import add_board, static_box
from envs.pybullet_camera import PybulletCamera
from tests.helpers.poses import pose
from utils.errors import TargetLostError
from utils.transforms import inverse_pose, project

BOARD = Board()
MARKERS = BOARD.points * 4 / 7  # their middles: 4 cells from the board's, the corners are 7
FACING = np.diag([1.0, -1.0, -1.0])
INTRINSICS = Intrinsics(640, 480, 60.0)


@pytest.fixture(scope="module")
def studio():
    """A client with a grey table and a board at the world's origin."""
    client = pybullet.connect(pybullet.DIRECT)
    static_box(client, [0.6, 0.6, 0.02], [0, 0, -0.1], (0.6, 0.6, 0.6, 1))
    add_board(client, BOARD, np.eye(4))
    yield client
    pybullet.disconnect(physicsClientId=client)


def photograph(client, T_OC, intrinsics=INTRINSICS):
    return PybulletCamera(client, pybullet.ER_TINY_RENDERER).render(intrinsics, T_OC).rgb


def test_board_is_as_large_as_it_says():
    # 20 cells; the outermost corners are 14 apart and 7 sqrt(2) from the middle, turned by 8
    # degrees from the diagonals.
    np.testing.assert_allclose(BOARD.size, 0.2)
    angles = np.radians([143, 53, -37, -127])
    expected = 0.07 * np.sqrt(2) * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    np.testing.assert_allclose(BOARD.points[:, :2], expected)
    np.testing.assert_allclose(BOARD.points[:, 2], 0)


@pytest.mark.parametrize("seed", range(5))
def test_corners_and_pose_are_found_to_a_fraction_of_a_pixel(studio, seed):
    rng = np.random.default_rng(seed)
    T_CO = pose([*rng.uniform(-0.02, 0.02, 2), rng.uniform(0.2, 0.3)],
                rng.uniform(-1, 1, 3) * [12, 12, 180], FACING)  # fmt: skip
    pixels = BOARD.find(photograph(studio, inverse_pose(T_CO)))
    expected, _ = project(BOARD.points, INTRINSICS.K, inverse_pose(T_CO))
    np.testing.assert_allclose(pixels, expected, atol=0.3)
    assert np.sqrt(np.mean((pixels - expected) ** 2)) < 0.12
    found = BOARD.pose(pixels, INTRINSICS.K)
    np.testing.assert_allclose(found[:3, 3], T_CO[:3, 3], atol=2e-4)
    np.testing.assert_allclose(found[:3, :3], T_CO[:3, :3], atol=4e-3)


def test_pose_of_exact_corners_is_exact():
    T_CO = pose([0.02, -0.01, 0.3], [10, -15, 40], FACING)
    pixels, _ = project(BOARD.points, INTRINSICS.K, inverse_pose(T_CO))
    np.testing.assert_allclose(BOARD.pose(pixels, INTRINSICS.K), T_CO, atol=1e-6)


def test_a_board_that_is_not_all_seen_is_lost(studio):
    straight = pose([0, 0, 0.25], [0, 0, 0], FACING)
    with pytest.raises(TargetLostError, match="of its 4 markers not seen: 0, 1, 2, 3"):
        BOARD.find(photograph(studio, inverse_pose(pose([1, 0, 0.25], [0, 0, 0], FACING))))
    with pytest.raises(TargetLostError, match="not seen: 1, 2$"):
        BOARD.find(photograph(studio, inverse_pose(pose([0.15, 0, 0.25], [0, 0, 0], FACING))))
    image = photograph(studio, inverse_pose(straight))
    (u, v), _ = project(MARKERS[2], INTRINSICS.K, inverse_pose(straight))
    cv2.circle(image, (round(u), round(v)), 15, (90, 90, 90), -1)
    with pytest.raises(TargetLostError, match="not seen: 2$"):
        BOARD.find(image)


def test_markers_that_do_not_lie_on_one_board_are_refused(studio):
    image = photograph(studio, inverse_pose(pose([0, 0, 0.25], [0, 0, 0], FACING)))
    middle = image.shape[0] // 2
    image[:middle] = np.roll(image[:middle], 60, axis=1)
    with pytest.raises(TargetLostError, match="correlate|aligned"):
        BOARD.find(image)
