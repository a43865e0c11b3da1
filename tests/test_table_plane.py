"""The dominant plane of a depth image under clutter and noise, against a known pose."""

from __future__ import annotations

import numpy as np
import pytest

from utils.errors import UserError
from utils.table_plane import dominant_plane
from utils.transforms import inverse_pose, look_at, transform_points


def cloud(T_WC: np.ndarray, noise: float, share_of_boxes: float) -> np.ndarray:
    """Points of a table z = 0 with boxes on it, in the camera's frame."""
    random = np.random.default_rng(0)
    points = random.uniform((-0.3, -0.3, 0), (0.3, 0.3, 0), (5000, 3))
    boxes = random.random(5000) < share_of_boxes
    points[boxes, 2] = random.uniform(0.01, 0.12, boxes.sum())
    points[random.random(5000) < 0.05] = np.nan
    seen = transform_points(inverse_pose(T_WC), points)
    return seen * (1 + random.normal(0, noise, (5000, 1)))  # along the line of sight


@pytest.mark.parametrize("eye", [(0.0, 0.01, 0.8), (0.5, -0.3, 0.6), (-0.9, 0.2, 0.5)])
def test_the_table_is_found_under_clutter_and_noise(eye):
    T_WC = look_at(eye, (0, 0, 0))
    plane = dominant_plane(cloud(T_WC, 0.002, 0.4))
    normal = T_WC[:3, :3].T @ (0, 0, 1)
    assert np.rad2deg(np.arccos(plane.normal @ normal)) < 0.5
    assert plane.distance == pytest.approx(eye[2], abs=0.003)
    pose = plane.camera_pose()
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
    np.testing.assert_allclose(pose[:3, 3], (0, 0, plane.distance), atol=1e-12)
    assert pose[1, 0] == pytest.approx(0, abs=1e-12) and pose[0, 0] > 0  # x is the image's right


def test_a_portrait_camera_that_looks_along_the_table_has_a_frame_too():
    plane = dominant_plane(np.random.default_rng(0).uniform((0.3, -1, 1), (0.3, 1, 2), (500, 3)))
    pose = plane.camera_pose()  # the normal is the image's left
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
    np.testing.assert_allclose(pose[:3, 3], (0, 0, 0.3), atol=1e-9)


def test_no_plane_is_said():
    points = np.random.default_rng(0).uniform((-1, -1, 0.5), (1, 1, 3), (3000, 3))
    with pytest.raises(UserError, match="no table found"):
        dominant_plane(points)
    with pytest.raises(UserError, match="too few"):
        dominant_plane(np.full((10, 3), np.nan))
    line = np.linspace(0, 1, 50)[:, None] * (0, 0, 1.0) + (0, 0, 1)
    with pytest.raises(UserError, match="one line"):
        dominant_plane(line)
