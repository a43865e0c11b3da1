"""The tutorial's import path: its three servos and their methods."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from tests.helpers.servo_cases import LAWS
from utils.errors import UserError
from utils.servo_features import interaction_matrix
from utils.servo_reference import CAMERA, FOCAL, GOAL, SQUARE, START
from utils.transforms import transform_points
from utils.visual_servo import (
    CollinearPointsError,
    DepthError,
    HybridVisualServo,
    ImageBasedVisualServo,
    PointError,
    PositionBasedVisualServo,
    ServoError,
)


def test_the_three_doors_lead_to_the_same_laws():
    history = LAWS[0].simulate(SQUARE, START, GOAL, max_iterations=1)
    corners, wanted = history.points[0], history.goal_points
    depths, wanted_depths = transform_points(START, SQUARE)[:, 2], np.full(4, 0.75)
    image = ImageBasedVisualServo(CAMERA).compute_velocity(corners, wanted, depths)
    np.testing.assert_allclose(image, history.velocities[0])
    pose = PositionBasedVisualServo(CAMERA).compute_end_effector_velocity(START, GOAL)
    # By hand: v = 0.5 (t_C - R_CG t_G) with R_CG = R_CO here, w = -0.5 log(R_GC).
    t = START[:3, 3] - START[:3, :3] @ GOAL[:3, 3]
    np.testing.assert_allclose(pose[:3], 0.5 * t)
    np.testing.assert_allclose(pose[3:], 0.5 * np.radians([10, -10, 50]))
    depth_map = np.zeros((480, 640), np.float32)
    for (u, v), depth in zip(np.rint(corners).astype(int), depths):
        depth_map[v, u] = depth
    for alpha in 0.0, 0.3, 1.0:
        servo = HybridVisualServo(CAMERA, alpha=alpha, interaction="current")
        blend = servo.compute_velocity(START, corners, GOAL, wanted, depth_map)
        np.testing.assert_allclose(blend, alpha * pose + (1 - alpha) * image, atol=1e-7)
    extended = HybridVisualServo(CAMERA, scheme="2.5d")
    assert extended.compute_velocity(START, corners, GOAL, wanted, depth_map).shape == (6,)
    desired = ImageBasedVisualServo(CAMERA, interaction="desired")
    L = interaction_matrix(desired.camera.normalise(wanted), wanted_depths)
    expected = -0.5 * np.linalg.pinv(L) @ ((corners - wanted) / FOCAL).ravel()
    np.testing.assert_allclose(
        desired.compute_velocity(corners, wanted, depths, wanted_depths), expected
    )


def test_every_servo_error_is_a_user_error():
    assert all(issubclass(e, ServoError) for e in (DepthError, PointError, CollinearPointsError))
    assert issubclass(ServoError, UserError)


def test_the_example_of_the_docs_runs_as_printed(tmp_path, monkeypatch, capsys):
    """docs/servo.md compares gains; its table holds what the example prints."""
    page = (Path(__file__).resolve().parents[1] / "docs" / "servo.md").read_text(encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    exec(re.search(r"```python\n(.*?)```", page, re.DOTALL).group(1), {})
    assert (tmp_path / "gains.png").stat().st_size > 20_000
    lines = capsys.readouterr().out.splitlines()
    printed = [re.search(r"after (\d+) iterations (\S+) mm off", line).groups() for line in lines]
    rows = re.findall(r"^\| [^|]+ \| (\d+) \| ([\d.]+) \| ([\d.]+) mm \|$", page, re.MULTILINE)
    assert [(images, off) for images, _, off in rows] == printed and len(rows) == 4
    assert [float(seconds) for _, seconds, _ in rows] == [
        pytest.approx(int(images) * 0.04, abs=0.05) for images, _, _ in rows
    ]
