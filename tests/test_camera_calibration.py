"""Calibration errors, levelled frames, and what the wrist camera is taught."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from envs.camera import wrist_mount
from envs.camera_calibration import displaced, level, teach, wrong_calibration
from envs.cell_scenes import make_scene
from envs.scenarios import SCENARIOS
from utils.config import load_config
from utils.table_plane import fit_table_plane
from utils.transforms import inverse_pose


@pytest.fixture(scope="module")
def scene(config, box_set):
    return make_scene("isolated", box_set, 0, config)


@pytest.fixture
def cell(taught_cell, scene):
    """The cell of either simulator with the scene of one box, loaded."""
    taught_cell.load(scene)
    return taught_cell


CONFIG = load_config().camera


def test_a_miscalibration_is_as_large_as_it_says(cell):
    T = cell.camera_pose("overhead")
    rng = np.random.default_rng(3)
    for _ in range(5):
        wrong = displaced(T, rng, 0.01, np.radians(2))
        assert np.linalg.norm(wrong[:3, 3] - T[:3, 3]) == pytest.approx(0.01)
        cosine = (np.trace(wrong[:3, :3] @ T[:3, :3].T) - 1) / 2
        assert np.degrees(np.arccos(cosine)) == pytest.approx(2.0, abs=1e-6)
    scenario = SCENARIOS["miscalibrated"]
    first, again = scenario.calibration(cell), scenario.calibration(cell)
    np.testing.assert_array_equal(first.T_WC, again.T_WC)
    for T, true in zip((first.T_WC, first.T_EC), (cell.camera_pose(), wrist_mount(CONFIG))):
        assert np.linalg.norm(T[:3, 3] - true[:3, 3]) == pytest.approx(0.01)


def test_levelling_finds_the_table_and_leaves_the_place(cell):
    frame = cell.frame()
    wrong = wrong_calibration(cell, np.random.default_rng(0), 0.01, np.radians(2)).T_WC
    levelled = level(replace(frame, T_WC=wrong))
    normal, offset = fit_table_plane(frame.depth, frame.K, inverse_pose(levelled.T_WC))
    np.testing.assert_allclose(levelled.T_WC[:3, :3] @ normal, [0, 0, 1], atol=1e-9)
    assert levelled.T_WC[2, 3] == pytest.approx(0.8, abs=1e-3)  # as high as it truly is
    np.testing.assert_allclose(levelled.T_WC[:2, 3], wrong[:2, 3])  # as far off as it was


def test_what_is_taught_is_the_true_mount(cell):
    T = teach(cell) @ wrist_mount(CONFIG)  # identity
    assert np.linalg.norm(T[:3, 3]) < 3e-4
    assert np.degrees(np.arccos((np.trace(T[:3, :3]) - 1) / 2)) < 0.2
