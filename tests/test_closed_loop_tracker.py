"""The wrist camera's images, and the object that is found in them."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from envs.closed_loop import GuidedApproach
from envs.closed_loop_tracker import ObjectTracker, WristCamera
from envs.robot_kinematics import forward_kinematics
from envs.servo_arm import ServoArm
from tests.helpers.box_rounds import grasp_of_box, loop
from utils.config import load_config
from utils.errors import TargetLostError
from utils.transforms import inverse_pose, planar, planar_part


def test_images_arrive_late(cell):
    camera, seen = WristCamera(cell, latency=0.1), []
    for _ in range(6):
        sight = camera()
        seen.append(None if sight is None else round(cell.seconds - sight.seconds, 6))
        cell.step(8)
    assert seen == [None, None, None, 0.1, 0.1, 0.1]


def test_the_object_is_found_by_the_real_camera(cell):
    descent = GuidedApproach(loop(cell, "pbvs"), ServoArm(cell), grasp_of_box(cell))
    x, y, turn = np.subtract(
        planar_part(descent.target.T_WO),
        [*cell.object_pose(0)[:2, 3], grasp_of_box(cell).angle],
    )
    assert np.hypot(x, y) < 3e-3, "from home, where a pixel covers 5 mm of the table"
    assert abs(np.degrees((turn + np.pi / 2) % np.pi - np.pi / 2)) < 4


def test_the_wrist_cameras_noise_is_the_configs_and_of_the_scene(cell, monkeypatch):
    clean = WristCamera(cell)().depth
    noisy = load_config(None, ["sim.renderer=tiny", "camera.depth_noise=kinect"])
    monkeypatch.setattr(cell, "config", noisy)
    first, again = WristCamera(cell)().depth, WristCamera(cell)().depth
    np.testing.assert_array_equal(first, again)
    camera = WristCamera(cell)
    assert (camera().depth != camera().depth).any(), "each image has noise of its own"
    known = (first > 0) & (clean > 0)
    error = np.abs(first - clean)[known]
    # From 0.5 m: 0.5^2 m^2 / (480 px x 0.075 m) x 1/8 px is 0.9 mm a step of disparity.
    assert 1e-4 < np.median(error) < 1.5e-3
    assert 0.5 < known.mean() < 1.0, "with holes, at the edges of things"


def test_the_uncertainty_of_a_sight_is_turned_into_the_world():
    """Standard deviations of 2 along and 1 across an object that is turned by 30 degrees: C_xx is
    4 cos^2 + sin^2 = 3.25, C_xy is 3 sin cos = 1.299."""
    home = np.array([0, -np.pi / 4, 0, -3 * np.pi / 4, 0, np.pi / 2, np.pi / 4])
    T_WO, seen = planar(0.5, 0.1, np.pi / 6), []
    found = SimpleNamespace(
        T_CO=inverse_pose(forward_kinematics(home)) @ T_WO, covariance=np.diag([4.0, 1.0, 9.0])
    )
    tracker = object.__new__(ObjectTracker)  # without a frame that its template is cut from
    tracker.T_EC, tracker.T_WO = np.eye(4), T_WO
    tracker.matcher = SimpleNamespace(find=lambda *where: found, round=False)
    tracker.motion = SimpleNamespace(
        at=lambda seconds: np.zeros(6), see=lambda *what: seen.append(what) or True
    )
    assert tracker.update(SimpleNamespace(seconds=1.0, q=home, depth=None))
    ((pose, covariance, seconds),) = seen
    assert pose == pytest.approx((0.5, 0.1, np.pi / 6)) and seconds == 1.0
    expected = [[3.25, 1.299, 0], [1.299, 1.75, 0], [0, 0, 9]]
    np.testing.assert_allclose(covariance, expected, atol=1e-3)


def test_false_matches_alone_are_a_lost_object():
    """Each lies too far from where the object was going; the object was last seen at 1 s."""
    home = np.array([0, -np.pi / 4, 0, -3 * np.pi / 4, 0, np.pi / 2, np.pi / 4])
    T_WO = planar(0.5, 0.1, 0.0)
    found = SimpleNamespace(
        T_CO=inverse_pose(forward_kinematics(home)) @ T_WO, covariance=np.eye(3)
    )
    tracker = object.__new__(ObjectTracker)  # without a frame that its template is cut from
    tracker.T_EC, tracker.T_WO, tracker.found_seconds, tracker.lost_seconds = (
        np.eye(4),
        T_WO,
        1,
        0.3,
    )
    tracker.matcher = SimpleNamespace(find=lambda *where: found, round=False)
    tracker.motion = SimpleNamespace(at=lambda seconds: np.zeros(6), see=lambda *what: False)
    assert tracker.update(SimpleNamespace(seconds=1.2, q=home, depth=None))
    assert tracker.found_seconds == 1
    with pytest.raises(TargetLostError, match="too far .* 0.3 s"):
        tracker.update(SimpleNamespace(seconds=1.4, q=home, depth=None))
