"""Finding an object again: synthetic depth images of known scenes."""

from __future__ import annotations

import numpy as np
import pytest

from envs.cell import Intrinsics
from utils.errors import TargetLostError
from utils.object_tracking import TemplateMatcher, grasp_frame, make_template
from utils.table_plane import fit_table_plane
from utils.transforms import Grasp, RGBDFrame, inverse_pose, look_at, planar, planar_part, project

OVERHEAD = Intrinsics(224, 224, 28.0)
WRIST = Intrinsics(132, 180, 72.0)
FROM_ABOVE = look_at([0.5, 0, 0.8], [0.5, 0, 0], [1, 0, 0])
SIZE = np.array([0.06, 0.03, 0.04])  # m, of the block that is looked at


def depth_of_block(intrinsics, T_WC, T_WB):
    """(H, W) depth, ray by ray: the table z = 0 and a block of SIZE that stands on it at T_WB."""
    v, u = np.mgrid[0 : intrinsics.height, 0 : intrinsics.width]
    K = intrinsics.K
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], axis=-1)
    eye, way = T_WC[:3, 3], rays @ T_WC[:3, :3].T
    depth = -eye[2] / way[..., 2]
    T_BW = inverse_pose(T_WB)
    eye, way = T_BW[:3, :3] @ eye + T_BW[:3, 3], way @ T_BW[:3, :3].T
    low, high = [-SIZE[0] / 2, -SIZE[1] / 2, 0], [SIZE[0] / 2, SIZE[1] / 2, SIZE[2]]
    way = np.where(np.abs(way) < 1e-12, 1e-12, way)
    a, b = (low - eye) / way, (high - eye) / way
    enter, leave = np.minimum(a, b).max(axis=-1), np.maximum(a, b).min(axis=-1)
    return np.where(enter < leave, enter, depth).astype(np.float32)


def without_colours(depth, K, T_WC):
    return RGBDFrame(np.zeros((*depth.shape, 3), np.uint8), depth, K, T_WC)


@pytest.fixture(scope="module")
def block():
    """A grasp of the block, and the tracker of what the overhead camera saw of it."""
    T_WB = planar(0.52, 0.04, 0.5)
    frame = without_colours(depth_of_block(OVERHEAD, FROM_ABOVE, T_WB), OVERHEAD.K, FROM_ABOVE)
    grasp = Grasp(np.array([0.525, 0.043, 0.02]), 0.5 + np.pi / 2, 0.05, 1.0)
    template = make_template(frame, grasp)
    return T_WB, grasp, TemplateMatcher(template, WRIST.K, (WRIST.width, WRIST.height))


def test_what_is_round_is_so_wherever_it_is_grasped(block):
    """A disc of 4 cm height, grasped at its middle and 3 cm beside it: a turn about the grasp moves
    it sideways, but no picture tells how far it has turned about its middle."""
    v, u = np.mgrid[0 : OVERHEAD.height, 0 : OVERHEAD.width]
    K, eye = OVERHEAD.K, FROM_ABOVE[:3, 3]
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], axis=-1)
    way = rays @ FROM_ABOVE[:3, :3].T
    depth = -eye[2] / way[..., 2]
    top = (0.04 - eye[2]) / way[..., 2]
    at = eye[:2] + way[..., :2] * top[..., None]
    depth = np.where(np.linalg.norm(at - (0.5, 0.0), axis=-1) < 0.035, top, depth)
    frame = without_colours(depth.astype(np.float32), OVERHEAD.K, FROM_ABOVE)
    for beside in (0.0, 0.03):
        grasp = Grasp(np.array([0.5 + beside, 0.0, 0.02]), 0.4, 0.05, 1.0)
        template = make_template(frame, grasp)
        assert TemplateMatcher(template, WRIST.K, (WRIST.width, WRIST.height)).round
    assert not block[2].round


@pytest.mark.parametrize("seed", range(6))
def test_a_moved_object_is_found_where_it_is(block, seed):
    T_WB, grasp, tracker = block
    rng = np.random.default_rng(seed)
    # The wrist camera is 7 cm beside the grasp, 20 to 35 cm up, and a little askew.
    eye = grasp.position + [-0.07, *rng.uniform(-0.02, 0.02, 1), rng.uniform(0.2, 0.35)]
    T_WC = look_at(eye, eye + [*rng.uniform(-0.05, 0.05, 2), -1.0], [1, 0, 0])
    about = planar(*T_WB[:2, 3], 0)
    motion = about @ planar(*rng.uniform(-0.01, 0.01, 2), rng.uniform(-0.2, 0.2))
    motion = motion @ inverse_pose(about)
    depth = depth_of_block(WRIST, T_WC, motion @ T_WB)
    T_WO = grasp_frame(grasp)
    found = tracker.find(depth, inverse_pose(T_WC) @ T_WO, inverse_pose(T_WC))
    x, y, turn = planar_part(inverse_pose(motion @ T_WO) @ T_WC @ found.T_CO)
    assert np.hypot(x, y) < 1e-3 and abs(np.degrees(turn)) < 1.5
    assert found.correlation > 0.97


def test_an_object_far_from_where_it_was_expected_is_found(block):
    T_WB, grasp, tracker = block
    T_WC = look_at([0.5, 0, 0.55], [0.5, 0, 0], [1, 0, 0])
    motion = planar(0.5, 0, 0) @ planar(-0.09, -0.07, 1.2) @ planar(-0.5, 0, 0)
    depth = depth_of_block(WRIST, T_WC, motion @ T_WB)
    T_WO = grasp_frame(grasp)
    found = tracker.find(depth, inverse_pose(T_WC) @ T_WO, inverse_pose(T_WC))
    x, y, _ = planar_part(inverse_pose(motion @ T_WO) @ T_WC @ found.T_CO)
    # The block looks the same after half a turn about its middle, which the grasp is 6 mm off.
    assert np.hypot(x, y) < 0.015


def test_the_measured_pose_does_not_depend_on_the_calibration(block):
    T_WB, grasp, tracker = block
    eye = grasp.position + [-0.07, 0, 0.25]
    T_WC = look_at(eye, eye + [0, 0, -1.0], [1, 0, 0])
    depth, T_WO = depth_of_block(WRIST, T_WC, T_WB), grasp_frame(grasp)
    wrong = T_WC @ planar(0.006, -0.006, np.radians(2))
    wrong[2, 3] += 0.005
    right, other = (
        tracker.find(depth, inverse_pose(T) @ T_WO, inverse_pose(T)).T_CO for T in (T_WC, wrong)
    )
    np.testing.assert_allclose(other[:3, 3], right[:3, 3], atol=1e-3)
    np.testing.assert_allclose(other[:3, :3], right[:3, :3], atol=0.017)  # 1 degree of the 2


def test_the_table_is_fitted_under_a_wrong_calibration():
    T_WC = look_at([0.45, 0.1, 0.5], [0.5, 0, 0], [1, 0, 0])
    depth = depth_of_block(WRIST, T_WC, planar(0.5, 0, 0))
    assumed = T_WC @ planar(0, 0, 0)
    assumed[2, 3] += 0.01
    normal, offset = fit_table_plane(depth, WRIST.K, inverse_pose(assumed))
    np.testing.assert_allclose(normal, T_WC[2, :3], atol=2e-3)
    np.testing.assert_allclose(offset, 0.5, atol=5e-4)


def test_an_empty_table_and_a_place_outside_the_image_are_distinguished(block):
    T_WB, grasp, tracker = block
    T_WC = look_at([0.5, 0, 0.4], [0.5, 0, 0], [1, 0, 0])
    empty = depth_of_block(WRIST, T_WC, planar(5, 5, 0))
    T_CO = inverse_pose(T_WC) @ grasp_frame(grasp)
    with pytest.raises(TargetLostError, match="correlate by 0.00"):
        tracker.find(empty, T_CO, inverse_pose(T_WC))
    with pytest.raises(TargetLostError, match="outside the image"):
        tracker.find(empty, inverse_pose(T_WC) @ planar(1.2, 0, 0), inverse_pose(T_WC))
    with pytest.raises(TargetLostError, match="table"):
        tracker.find(np.zeros_like(empty), T_CO, inverse_pose(T_WC))
    frame = without_colours(empty, WRIST.K, T_WC)
    with pytest.raises(TargetLostError, match="nothing stands"):
        make_template(frame, grasp)


def test_the_features_lie_on_the_object(block):
    _, grasp, tracker = block
    pixels, _ = project(tracker.template.points, WRIST.K, np.eye(4))
    assert len(pixels) == 8
    middle = tracker.template.points.mean(axis=0)
    # The grasp is 5.8 mm off the block's middle, the block 4 cm high.
    assert 0.003 < np.hypot(*middle[:2]) < 0.008
    np.testing.assert_allclose(middle[2], SIZE[2], atol=1e-3)
