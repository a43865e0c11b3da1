"""The table in images of depth and of distance, against known poses."""

from __future__ import annotations

import numpy as np
import pytest

from envs.cell import Intrinsics
from envs.cell_scenes import make_scene
from envs.objects import load_object_set
from envs.simulators import make_cell
from models import photographs
from models.graspnet_adaptation import DISTINCT
from models.photographs import K
from tests.helpers.photographs import BOX, ROBOT, ROBOT_BEFORE, T_WC, photographed
from tests.helpers.real_images import CORNELL
from utils.depth import KinectNoise
from utils.errors import UserError
from utils.real_data import fill_depth_holes
from utils.table_plane import (
    BEHIND,
    DEPTHS,
    FLAT,
    FROM_BASE,
    FROM_CAMERA,
    TableCamera,
    distances,
    dominant_plane,
    find_table_camera,
    table_misses,
)
from utils.transforms import RGBDFrame, deproject, inverse_pose, look_at, transform_points


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


# --- The camera of an image of distances ----------------------------------------------------


def disc_on_a_table(away: float, tilt: float, towards: float, height: float = 0.06) -> np.ndarray:
    """(480, 640) depths of a table `away` metres below a camera that is tilted by `tilt` degrees
    in the image's direction `towards`, and of a disc of 10 cm across, `height` metres above it."""
    v, u = np.mgrid[:480, :640]
    rays = deproject(np.stack([u, v], axis=-1), np.ones(u.shape), K, np.eye(4))
    tilt, towards = np.radians([tilt, towards])
    side = np.sin(tilt) * np.array([np.cos(towards), np.sin(towards)])
    normal = np.array([*side, np.cos(tilt)])
    table, top = away / (rays @ normal), (away - height) / (rays @ normal)
    middle = np.array([0.0, 0.0, (away - height) / normal[2]])
    beside = np.linalg.norm(rays * top[..., None] - middle, axis=-1)
    return np.where(beside < 0.05, top, table)


def test_distances_from_the_robot_tell_the_camera_and_the_depths():
    sample, true = photographed()
    camera = find_table_camera(sample.depth, K)
    np.testing.assert_allclose(camera.T_WC, T_WC, atol=2e-3)
    robot = camera.T_WC[:3, :3] @ camera.origin + camera.T_WC[:3, 3]
    assert robot == pytest.approx(ROBOT, abs=5e-3)
    np.testing.assert_allclose(camera.depth(sample.depth, K), true.depth, atol=3e-3)


def test_noise_leaves_heights_true_to_millimetres():
    sample, true = photographed(noise=0.002)
    camera = find_table_camera(sample.depth, K)
    found = RGBDFrame(true.rgb, camera.depth(sample.depth, K), K, camera.T_WC)
    top = true.points()[..., 2] > BOX[2] - 1e-4
    assert np.median(found.points()[top, 2]) == pytest.approx(BOX[2], abs=2e-3)


def test_distances_are_what_the_table_s_camera_undoes():
    sample, true = photographed()
    from_robot = true.T_WC[:3, :3].T @ (ROBOT - true.T_WC[:3, 3])
    np.testing.assert_allclose(distances(true.depth, K, from_robot), sample.depth, atol=1e-6)
    found = find_table_camera(distances(true.depth, K), K).depth(distances(true.depth, K), K)
    np.testing.assert_allclose(found, true.depth, atol=3e-3)


@pytest.mark.parametrize("away", [0.4, 0.5, 0.6, 0.65, 1.2])
@pytest.mark.parametrize(("tilt", "towards"), [(0, 0), (10, 90), (37, -90), (37, 0), (37, 90)])
def test_near_cameras_are_found_too(away, tilt, towards):
    """Of distances as docs/sim_to_real.md makes them, of depths with a millimetre of noise. At
    0.4 m the disc fills an eighth of the image's middle, and lifts the table by millimetres."""
    depth = disc_on_a_table(away, tilt, towards)
    noise = 0.001 * np.random.default_rng(0).standard_normal(depth.shape)
    image = distances(depth + noise, K)
    camera = find_table_camera(image, K)
    assert camera.T_WC[2, 3] == pytest.approx(away, abs=5e-3)
    assert camera.origin == pytest.approx(BEHIND, abs=0.01)
    error = np.abs(camera.depth(image, K) - depth)
    assert np.median(error) < 5e-3 and error.max() < 0.015
    assert camera.sees(image.shape, K, 0.15)


@pytest.mark.parametrize("away", [0.4, 0.5, 0.6])
def test_an_origin_is_found_above_the_table(away):
    """One 0.2 m before the camera, whose mirror image explains the table as well."""
    bare = disc_on_a_table(away, 0, 0, height=0.0)
    camera = find_table_camera(distances(bare, K, ROBOT_BEFORE), K)
    assert camera.table == pytest.approx([0, 0, 1 / away], abs=1e-3)
    assert camera.origin == pytest.approx(ROBOT_BEFORE, abs=1e-3)


def test_distances_do_not_tell_depths_before_the_foot_of_the_origin():
    """By hand: on the optical axis an origin (0, 0.8, 0.2) is nearest 0.2 m from the camera, so a
    point at 0.15 m is as far from it as one at 0.25 m; one at 0.3 m comes back."""
    camera = TableCamera(np.array([0.0, 0.0, 2.0]), ROBOT_BEFORE)
    axis = np.array([[319.5, 239.5]] * 2)
    assert camera.least_depth(deproject(axis, np.ones(2), K, np.eye(4))) == pytest.approx(0.2)
    centred = K - [[0, 0, 319.5], [0, 0, 239.5], [0, 0, 0]]  # the only pixel lies on the axis
    for depth, found in ((0.15, 0.25), (0.3, 0.3)):
        image = distances(np.full((1, 1), depth), centred, ROBOT_BEFORE)
        assert camera.depth(image, centred) == pytest.approx(found, abs=1e-6)
    # 200 pixels below the axis it is nearest at (0.8 y + 0.2) / (1 + y^2) = 0.441 m, y = 200 / 525.
    assert camera.sees((480, 640), K, height=0.05)
    assert not camera.sees((480, 640), K, height=0.07)


@pytest.mark.parametrize("focal", [150.0, 160.0, 544.0 / 3])
def test_a_wide_angle_camera_s_depths_are_told_from_distances(focal):
    """Some rays never meet the plane from which the search starts."""
    wide = np.array([[focal, 0, 320], [0, focal, 240], [0, 0, 1.0]])
    misses = table_misses(np.full((480, 640), 0.8), wide)
    assert misses[DEPTHS] < 1e-6 and misses[FROM_BASE] < 1e-3 and misses[FROM_CAMERA] > 0.02


def test_unknown_depths_stay_unknown():
    depth = disc_on_a_table(0.6, 10, 90)
    depth[:2, :2] = [[0, np.nan], [-1, np.inf]]
    image = distances(depth, K)
    assert (image[:2, :2] == 0).all() and (image.ravel()[2:640] > 0.5).all()
    found = TableCamera(np.array([0.0, 0.0, 1 / 0.6]), BEHIND).depth(image, K)
    assert (found[:2, :2] == 0).all()
    np.testing.assert_allclose(found[2:], depth[2:], atol=1e-6)


def test_a_bare_table_tells_what_an_image_holds():
    """Without noise only what is true explains it exactly; a reading that is not is off by more
    than a Kinect's noise, but for depths read as distances from a base."""
    sample, true = photographed(box=None)
    slant = np.linalg.norm(true.points() - T_WC[:3, 3], axis=-1)
    for image, reading in (
        (sample.depth, FROM_BASE), (true.depth, DEPTHS), (slant, FROM_CAMERA),
    ):  # fmt: skip
        misses = table_misses(image, K)
        assert misses[reading] < 1e-4
        assert all(miss > FLAT for other, miss in misses.items()
                   if other not in (reading, FROM_BASE))  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("tilt", [0, 15, 37])
def test_depths_rendered_in_the_cell_are_told_from_distances(config, tilt):
    """With a Kinect's noise: what `models.graspnet_adaptation.DISTINCT` lies between."""
    vertical = float(np.degrees(2 * np.arctan(240 / 525)))
    angle, middle = np.radians(tilt), np.array([0.5, 0.0, 0.0])
    eye = middle + 0.75 * np.array([-np.sin(angle), 0.0, np.cos(angle)])
    objects = load_object_set("primitives", cache_dir=config.cache_folder)
    with make_cell(config) as cell:
        cell.load(make_scene("pile", objects, 1, config))
        T_WC = look_at(eye, middle, (0.0, 1.0, 0.0))
        clean = cell.image(Intrinsics(640, 480, vertical, 0.1, 2.0), T_WC).depth
    depth = fill_depth_holes(KinectNoise()(clean, np.random.default_rng(0)))

    def other_readings(image: np.ndarray) -> float:
        misses = table_misses(image, K)
        base = misses.pop(FROM_BASE)
        return min(misses.values()) / base

    assert other_readings(depth) < 1.1 < DISTINCT < 3 < other_readings(distances(depth, K))


@pytest.mark.skipif(not CORNELL.is_dir(), reason=f"no Cornell data at {CORNELL}")
def test_cornell_s_photographs_hold_distances_from_a_base():
    """What `models.graspnet_adaptation.DISTINCT` and docs/sim_to_real.md say; every eighth."""
    for sample in photographs.photographs(CORNELL)[::8]:
        misses = table_misses(sample.depth, K)
        base = misses.pop(FROM_BASE)
        assert 0.7e-3 < base < 1.2e-3, sample.name
        assert min(misses.values()) / base > 16.9, sample.name
