"""Frames and grasps: closed forms and round trips."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from tests.helpers.servo_cases import directions, twists
from utils.errors import UserError
from utils.geometry import SceneGeometry
from utils.transforms import (
    Grasp,
    ImageGrasp,
    RGBDFrame,
    angle_difference,
    deproject,
    grasp_to_image,
    image_to_grasp,
    inverse_pose,
    look_at,
    planar_part,
    pose_exp,
    pose_matrix,
    position_quaternion,
    project,
    ray_component,
    rotation_exp,
    rotation_log,
    skew,
    top_down_pose,
    velocity_transform,
    wrap_to_pi_range,
)

K = np.array([[400.0, 0.0, 111.5], [0.0, 400.0, 111.5], [0.0, 0.0, 1.0]])
angles = st.floats(-20, 20)
small = st.floats(-0.15, 0.15)


def test_top_down_pose_by_hand():
    # Closing along +x: y_E = x_W, z_E = -z_W, hence x_E = y_E x z_E = x_W x (-z_W) = y_W.
    T = top_down_pose([0.4, 0.1, 0.2], 0.0)
    np.testing.assert_allclose(T[:3, :3], [[0, 1, 0], [1, 0, 0], [0, 0, -1]], atol=1e-15)
    np.testing.assert_allclose(T[:3, 3], [0.4, 0.1, 0.2])


@given(angles)
def test_top_down_pose_is_a_rotation_that_closes_along_the_angle(angle):
    R = top_down_pose(np.zeros(3), angle)[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1)
    np.testing.assert_allclose(R[:, 1], [np.cos(angle), np.sin(angle), 0], atol=1e-12)


@pytest.mark.parametrize(
    ("angle", "wrapped"), [(0, 0), (np.pi, 0), (-0.1, np.pi - 0.1), (7, 7 - 2 * np.pi)]
)
def test_wrap_by_hand(angle, wrapped):
    assert wrap_to_pi_range(angle) == pytest.approx(wrapped)


@given(angles)
def test_wrap_stays_in_range(angle):
    assert 0 <= wrap_to_pi_range(angle) < np.pi


def test_angle_difference_across_the_seam():
    degrees = np.degrees(angle_difference(np.radians([179, 1, 45]), np.radians([1, 179, 135])))
    np.testing.assert_allclose(degrees, [2, 2, 90])


def test_pose_round_trip_and_inverse():
    quaternion = Rotation.random(rng=np.random.default_rng(0)).as_quat(canonical=True)
    T = pose_matrix([1.0, 2.0, 3.0], quaternion)
    position, again = position_quaternion(T)
    np.testing.assert_allclose(position, [1, 2, 3])
    assert abs(again @ quaternion) == pytest.approx(1)
    np.testing.assert_allclose(T @ inverse_pose(T), np.eye(4), atol=1e-12)


def test_camera_above_the_table_by_hand():
    # 0.8 m above (0.5, 0), image up = +x: a point 0.1 m to the robot's left (+y) and on the table
    # appears 400 * 0.1 / 0.8 = 50 px left of the centre.
    T = look_at([0.5, 0, 0.8], [0.5, 0, 0], up=(1, 0, 0))
    pixel, depth = project(np.array([0.5, 0.1, 0.0]), K, T)
    np.testing.assert_allclose(pixel, [111.5 - 50, 111.5], atol=1e-9)
    assert depth == pytest.approx(0.8)
    np.testing.assert_allclose(deproject(pixel, depth, K, T), [0.5, 0.1, 0.0], atol=1e-12)


def test_rays_lead_where_pixels_are_deprojected():
    camera = np.array([[400.0, 0.0, 3.2], [0.0, 380.0, 1.7], [0.0, 0.0, 1.0]])
    T = look_at([0.2, -0.3, 0.7], [0.5, 0.1, 0.0])
    depth = np.random.default_rng(0).uniform(0.4, 0.9, (5, 7))
    v, u = np.mgrid[:5, :7]
    points = deproject(np.stack([u, v], axis=-1), depth, camera, T)
    for axis in range(3):
        along = T[axis, 3] + depth * ray_component(axis, depth.shape, camera, T)
        np.testing.assert_allclose(along, points[..., axis], atol=1e-12)


def test_points_behind_the_camera_have_no_pixel():
    T = look_at([0, 0, 1], [0, 0, 0], up=(1, 0, 0))
    assert np.isnan(project(np.array([0.0, 0.0, 2.0]), K, T)[0]).all()


@pytest.mark.parametrize("eye", [(0, 0, 1), (0, 0, 0)])
def test_look_at_refuses_undefined_views(eye):
    with pytest.raises(ValueError, match="look_at"):
        look_at(eye, (0, 0, 0), up=(0, 0, 1))


@given(small, small, st.floats(0, 0.15), angles, st.floats(0, 0.08), small, small)
def test_grasp_image_round_trip(x, y, z, angle, width, tilt_x, tilt_y):
    T_WC = look_at([0.5 + tilt_x, tilt_y, 0.8], [0.5, 0.0, 0.0], up=(1, 0.1, 0))
    grasp = Grasp(np.array([0.5 + x, y, z]), angle, width, 0.7)
    again = image_to_grasp(grasp_to_image(grasp, K, T_WC), K, T_WC)
    np.testing.assert_allclose(again.position, grasp.position, atol=1e-9)
    assert angle_difference(again.angle, grasp.angle) < 1e-9
    assert (again.width, again.quality) == (grasp.width, grasp.quality)


def test_image_angle_by_hand():
    # Seen from above with image up = +x, image right = -y: closing along +x is vertical.
    T = look_at([0.5, 0, 0.8], [0.5, 0, 0], up=(1, 0, 0))
    on_image = grasp_to_image(Grasp(np.array([0.5, 0, 0]), 0.0, 0.05, 1.0), K, T)
    assert isinstance(on_image, ImageGrasp)
    assert on_image.angle == pytest.approx(np.pi / 2)


@pytest.mark.parametrize(
    "arguments",
    [((0, 0), 0, 0.05, 1), ((0, 0, np.nan), 0, 0.05, 1), ((0, 0, 0), np.inf, 0.05, 1),
     ((0, 0, 0), 0, -0.01, 1)],
)  # fmt: skip
def test_grasp_refuses_nonsense(arguments):
    position, *rest = arguments
    with pytest.raises(ValueError, match="Grasp"):
        Grasp(np.array(position, dtype=float), *rest)


def test_frame_points_and_blinding():
    depth = np.array([[0.8, 0.0]], dtype=np.float32)
    T = look_at([0.5, 0, 0.8], [0.5, 0, 0], up=(1, 0, 0))
    flat = np.array([[100.0, 0, 0], [0, 100.0, 0], [0, 0, 1]])
    frame = RGBDFrame(np.zeros((1, 2, 3), np.uint8), depth, flat, T, np.zeros((1, 2)), "secret")
    np.testing.assert_allclose(frame.points()[0, 0], [0.5, 0, 0], atol=1e-7)
    assert np.isnan(frame.points()[0, 1]).all()
    blind = frame.without_truth()
    assert blind.truth is None and blind.segmentation is None


def translated(x):
    T = np.eye(4)
    T[0, 3] = x
    return T


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"K": np.eye(4)}, r"K: got an array of shape \(4, 4\)"),
        ({"T_WC": np.eye(4)[:3]}, r"T_WC: got an array of shape \(3, 4\)"),
        ({"T_WC": np.diag([1.0, 1.0, -1.0, 1.0])}, "no rotation"),
        ({"T_WC": np.diag([2.0, 2.0, 2.0, 1.0])}, "no rotation"),
        ({"T_WC": np.full((4, 4), np.nan)}, "not finite"),
        ({"T_WC": translated(np.nan)}, "not finite"),
        ({"T_WC": translated(0.5).T}, r"last row is \[0.5, 0.0, 0.0, 1.0\].*transposed"),
        ({"target": np.ones((2, 1), bool)}, r"target: .* \(2, 1\), expected .* \(1, 2\)"),
    ],
)
def test_a_frame_without_a_camera_is_refused(changes, message):
    image = {"rgb": np.zeros((1, 2, 3), np.uint8), "depth": np.ones((1, 2), np.float32)}
    with pytest.raises(UserError, match=message):
        RGBDFrame(**image | {"K": np.eye(3), "T_WC": np.eye(4)} | changes)


# Rigid motion


def twist_matrix(twist):
    A = np.zeros((4, 4))
    A[:3, :3], A[:3, 3] = skew(twist[3:]), twist[:3]
    return A


@given(twists, st.sampled_from([0, 1e-9, 1e-6, 0.9e-4, 1.1e-4, 1, 2]))
def test_exponential_is_the_matrix_exponential(twist, scale):
    twist = twist * scale
    np.testing.assert_allclose(pose_exp(twist), expm(twist_matrix(twist)), atol=1e-13)


@given(directions, st.floats(-15, 0).map(lambda power: np.pi - 10**power))
def test_rotation_log_near_pi(axis, angle):
    R = rotation_exp(axis * angle)
    np.testing.assert_allclose(rotation_exp(rotation_log(R)), R, atol=1e-14)
    if angle < np.pi - 1e-9:
        np.testing.assert_allclose(rotation_log(R), axis * angle, atol=1e-12)


@given(directions)
def test_rotation_log_at_pi_about_any_axis(axis):
    # R = 2 u u^T - I is the rotation by pi about u; +u and -u are the same rotation.
    found = rotation_log(2 * np.outer(axis, axis) - np.eye(3))
    assert np.linalg.norm(found) == pytest.approx(np.pi, abs=1e-12)
    np.testing.assert_allclose(np.outer(found, found) / np.pi**2, np.outer(axis, axis), atol=1e-12)


@given(twists)
def test_rotation_log_is_scipys(twist):
    R = Rotation.from_rotvec(1.2 * twist[3:])
    np.testing.assert_allclose(rotation_log(R.as_matrix()), R.as_rotvec(), atol=1e-12)


@given(twists, twists)
def test_velocity_transform_is_the_adjoint(pose, twist):
    # T_AB [v_B] T_BA = [v_A] for the same motion, by definition of a change of frame.
    T = pose_exp(pose)
    seen = T @ twist_matrix(twist) @ inverse_pose(T)
    np.testing.assert_allclose(twist_matrix(velocity_transform(T) @ twist), seen, atol=1e-12)


def test_velocity_transform_has_the_lever_arm_by_hand():
    # E turns with 2 rad/s about its z; a camera 0.1 m along E's x moves with w x r = 0.2 m/s in y.
    T_CE = np.eye(4)
    T_CE[0, 3] = -0.1
    np.testing.assert_allclose(
        velocity_transform(T_CE) @ [0, 0, 0, 0, 0, 2], [0, 0.2, 0, 0, 0, 2], atol=1e-15
    )


RGB, DEPTH = np.zeros((4, 6, 3), np.uint8), np.ones((4, 6), np.float32)
PINHOLE = np.array([[100.0, 0.0, 2.5], [0.0, 100.0, 1.5], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize(
    ("part", "message"),
    [
        ({"rgb": RGB[..., 0]}, "rgb: got an array of shape"),
        ({"rgb": RGB / 255}, "rgb: got float64, expected uint8"),
        ({"depth": DEPTH[..., None]}, "depth: got an array of shape"),
        ({"depth": (1000 * DEPTH).astype(np.uint16)}, "divide millimetres by 1000"),
        ({"depth": DEPTH[:2]}, "rgb and depth differ in size: 6x4 and 6x2 pixels"),
        ({"K": np.zeros((3, 3))}, "K: got .* with positive focal lengths"),
        ({"K": np.diag([-100.0, 100.0, 1.0])}, "K: got"),
        ({"K": PINHOLE * np.nan}, "K: got"),
        ({"K": PINHOLE + np.eye(3, k=1)}, "K: got"),  # skewed pixels
        ({"K": np.eye(4)}, "K: got an array of shape"),
        ({"T_WC": np.zeros((4, 4))}, "its last row"),
        ({"T_WC": np.eye(3)}, "T_WC: got an array of shape"),
    ],
)
def test_a_frame_that_is_none_is_one_sentence(part: dict, message: str) -> None:
    good = {"rgb": RGB, "depth": DEPTH, "K": PINHOLE, "T_WC": np.eye(4)}
    with pytest.raises(UserError, match=message):
        RGBDFrame(**(good | part))


def test_a_frame_takes_lists_for_its_matrices() -> None:
    frame = RGBDFrame(RGB, DEPTH, PINHOLE.tolist(), np.eye(4).tolist())
    np.testing.assert_array_equal(frame.K, PINHOLE)
    np.testing.assert_array_equal(frame.part(slice(1, 3), slice(2, 5)).K[:2, 2], (0.5, 0.5))


def test_a_target_of_numbers_is_a_mask() -> None:
    image = np.zeros(DEPTH.shape, np.uint8)
    image[1, 2] = 254  # as an image file holds it; & True would make it 0
    target = RGBDFrame(RGB, DEPTH, PINHOLE, np.eye(4), target=image).target
    assert target.dtype == bool
    np.testing.assert_array_equal(np.argwhere(target), [(1, 2)])


@pytest.mark.parametrize("number", [np.float32(0.04), np.array(0.04)])
def test_a_grasp_of_a_planner_that_computes_in_float32_can_be_written(number) -> None:
    grasp = Grasp(np.zeros(3, np.float32), number, number, number)
    assert json.loads(json.dumps([grasp.angle, grasp.width, grasp.quality])) == pytest.approx(
        [0.04] * 3
    )


def test_a_width_in_millimetres_is_refused() -> None:
    with pytest.raises(ValueError, match="Grasp.width is in metres, 0 to 1, got 80"):
        Grasp(np.zeros(3), 0.0, 80.0, 1.0)


def test_a_grasp_comes_back_from_a_camera_whose_pixels_are_not_square():
    """Beside the middle of an image with other focal lengths and another middle along u and v."""
    K = np.array([[400.0, 0, 120], [0, 300, 90], [0, 0, 1]])
    T_WC = look_at((0.3, -0.2, 0.7), (0.5, 0.0, 0.0))
    grasp = Grasp(np.array([0.45, 0.06, 0.02]), 0.6, 0.05, 0.9)
    back = image_to_grasp(grasp_to_image(grasp, K, T_WC), K, T_WC)
    np.testing.assert_allclose(back.position, grasp.position, atol=1e-12)
    assert back.angle == pytest.approx(0.6, abs=1e-9)


def test_the_turn_of_a_pose_that_leans_is_the_nearest_one():
    """Leaning by a about x after a turn by t about z: the entries' sum and difference give t."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("zx", (0.5, 0.1)).as_matrix()  # first z, then x, of the parent
    assert planar_part(T) == pytest.approx((0.0, 0.0, 0.5), abs=1e-12)


def test_a_blinded_frame_hides_the_truth_of_its_second_one():
    rgb, depth = np.zeros((4, 4, 3), np.uint8), np.ones((4, 4), np.float32)
    K = np.array([[10.0, 0, 2], [0, 10, 2], [0, 0, 1]])
    truth = SceneGeometry(())
    second = RGBDFrame(rgb, depth, K, np.eye(4), np.zeros((4, 4), np.int32), truth)
    seen = replace(second, second=second).without_truth()
    for frame in (seen, seen.second):
        assert frame.truth is None and frame.segmentation is None
