"""Photographs as frames: a box on a table seen from the side, whose geometry is known exactly."""

import numpy as np
import pytest

from envs.camera import Intrinsics
from envs.cell_scenes import make_scene
from envs.objects import load_object_set
from envs.pybullet_cell import PybulletCell
from models import photographs
from models.graspnet_adaptation import DISTINCT
from models.graspnet_io import SavedGraspNet
from models.photographs import HAND, SHRUNK, WORKSPACE, K, frame_of, judge_photographs
from models.planner_graspnet import GraspNetPlanner
from tests.helpers.fixed_maps import FixedMaps
from tests.helpers.real_images import write_cornell
from tests.test_real_data import CORNELL
from utils.depth import KinectNoise
from utils.errors import UserError
from utils.images import overhead_view
from utils.real_data import RealSample, fill_depth_holes
from utils.rectangles import GraspRectangle
from utils.table_plane import (
    BEHIND,
    DEPTHS,
    FLAT,
    FROM_BASE,
    FROM_CAMERA,
    TableCamera,
    distances,
    find_table_camera,
    table_misses,
)
from utils.transforms import Grasp, RGBDFrame, deproject, look_at, project

METRES_PER_PIXEL = 0.0018

# Cornell's camera looks down like this: 0.73 m over the table, 37 degrees from straight down.
T_WC = look_at((0.0, -0.55, 0.73), (0.0, 0.0, 0.0))
ROBOT = np.array([-0.3, -0.9, 0.1])
ROBOT_BEFORE = np.array([0.0, 0.8, 0.2])  # in the camera's frame, below its middle and before it
BOX = np.array([0.06, 0.16, 0.08])  # m along x, y and z, in the middle of the view
GREY, RED = (200, 200, 200), (180, 30, 30)


def photographed(
    box: np.ndarray | None = BOX, noise: float = 0.0, labels: tuple[GraspRectangle, ...] = ()
) -> tuple[RealSample, RGBDFrame]:
    """The sample whose depths are distances from ROBOT, and the true frame; by the slab formula."""
    v, u = np.mgrid[:480, :640]
    rays = deproject(np.stack([u, v], axis=-1), np.ones(u.shape), K, T_WC) - T_WC[:3, 3]
    depth, rgb = -T_WC[2, 3] / rays[..., 2], np.full((480, 640, 3), GREY, np.uint8)
    if box is not None:
        low, high = np.array([-box[0] / 2, -box[1] / 2, 0.0]), np.array([*box[:2] / 2, box[2]])
        slabs = np.sort([(side - T_WC[:3, 3]) / rays for side in (low, high)], axis=0)
        near, far = slabs[0].max(axis=-1), slabs[1].min(axis=-1)
        hit = (near < far) & (near < depth)
        depth, rgb[hit] = np.where(hit, near, depth), RED
    frame = RGBDFrame(rgb, depth.astype(np.float32), K, T_WC)
    distance = np.linalg.norm(frame.points() - ROBOT, axis=-1)
    distance += noise * np.random.default_rng(0).standard_normal(distance.shape)
    return RealSample("pcd0100", "box", rgb, distance.astype(np.float32), labels), frame


# --- The camera ------------------------------------------------------------------------------


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
    with PybulletCell(config) as cell:
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


# --- From above ------------------------------------------------------------------------------


def test_the_view_from_above_shows_the_top_of_a_box_where_it_is():
    _, frame = photographed()
    view = overhead_view(frame, WORKSPACE, 0.0018)
    assert view.depth.shape == (120, 120)  # 0.22 m
    high = view.depth < 0.8 - BOX[2] + 1e-3
    v, u = np.nonzero(high)
    corners, _ = project(np.array([[-0.03, 0.08, 0.08], [0.03, -0.08, 0.08]]), view.K, view.T_WC)
    assert (u.min(), v.min()) == pytest.approx(corners[0], abs=1.5)
    assert (u.max(), v.max()) == pytest.approx(corners[1], abs=1.5)
    assert high.sum() == pytest.approx(np.prod(corners[1] - corners[0]), rel=0.05)
    assert (view.rgb[high] == RED).all()


def test_what_the_box_hides_is_bare_table():
    _, frame = photographed()
    view = overhead_view(frame, WORKSPACE, 0.0018)
    (hidden,), _ = project(np.array([[0.0, 0.1, 0.0]]), view.K, view.T_WC)  # 2 cm behind
    u, v = np.rint(hidden).astype(int)
    assert view.depth[v, u] == pytest.approx(0.8, abs=1e-3)
    assert tuple(view.rgb[v, u]) == GREY


# --- Grasps and rectangles -------------------------------------------------------------------


def test_a_rectangle_is_the_projected_opening():
    _, frame = photographed()
    across = photographs.rectangle_of(Grasp(np.zeros(3), 0.0, 0.08, 1.0), frame)
    away = np.linalg.norm(T_WC[:3, 3])
    assert across.centre == pytest.approx((319.5, 239.5))
    assert (across.angle, across.width) == pytest.approx((0.0, 525 * 0.08 / away))
    assert across.height == across.width / 2
    along = photographs.rectangle_of(Grasp(np.zeros(3), np.pi / 2, 0.08, 1.0), frame)
    assert along.angle == pytest.approx(np.pi / 2)
    # Foreshortened by the sine of the camera's elevation.
    assert along.width == pytest.approx(525 * 0.08 / away * 0.73 / away, rel=0.01)


def test_a_shrunk_world_looks_the_same():
    sample, _ = photographed()
    whole, small = frame_of(sample, 1.0), frame_of(sample, 2.0)
    point = np.array([0.03, -0.05, 0.04])
    at, far = project(point, whole.K, whole.T_WC)
    there, near = project(point / 2, small.K, small.T_WC)
    assert at == pytest.approx(there) and far == pytest.approx(2 * near)
    np.testing.assert_allclose(whole.depth, 2 * small.depth, rtol=1e-6)


def truth(sample_frame: RGBDFrame, grasp: Grasp) -> tuple[GraspRectangle, ...]:
    return (photographs.rectangle_of(grasp, sample_frame),)


def test_the_heuristic_grasps_a_photographed_box_across():
    _, frame = photographed()
    label = truth(frame, Grasp(np.array([0.0, 0.0, BOX[2]]), 0.0, 0.09, 1.0))
    sample, _ = photographed(noise=0.001, labels=label)
    (found,) = judge_photographs("heuristic", [sample], seed=0)
    assert found.correct and found.iou > 0.5
    assert np.degrees(found.angle_error) < 5


def test_nothing_on_the_table_is_nothing_to_grasp():
    sample, _ = photographed(box=None)
    assert judge_photographs("heuristic", [sample], seed=0) == [None]


def test_a_network_s_best_pixel_becomes_a_grasp_of_the_photograph():
    sample, frame = photographed()
    middle = 8 * round(0.30 / METRES_PER_PIXEL / 8) / 2 - 0.5
    # 27 pixels of 1.8 mm to the right of the middle; 0.8 m away, where the table is.
    network = FixedMaps((middle + 27.5, middle - 0.5), radius=0.1)
    grasp = photographs.network_grasp(
        SavedGraspNet(network, METRES_PER_PIXEL, {}, {}), frame_of(sample)
    )
    right = 27.5 * METRES_PER_PIXEL
    assert grasp.position == pytest.approx((right, 0.5 * METRES_PER_PIXEL, 0.0), abs=2e-3)
    assert (grasp.angle, grasp.width) == pytest.approx((0.0, 0.05))
    rectangle = photographs.rectangle_of(grasp, frame_of(sample))
    (true,) = truth(frame, Grasp(SHRUNK * grasp.position, 0.0, SHRUNK * 0.05, 1.0))
    assert rectangle.centre == pytest.approx(true.centre, abs=1.0)
    assert rectangle.width == pytest.approx(true.width, rel=0.01)


def test_the_hand_opens_as_wide_as_the_tutorial_s_network_can_tell():
    assert SHRUNK * HAND.max_opening == pytest.approx(0.15)


def test_as_taken_a_network_s_best_pixel_lies_on_the_photograph_s_own_grid(monkeypatch):
    """Of the middle 400 pixels of a photograph, each 1.2 m / 525 wide, a network of 2 mm a pixel
    sees 8 round(400 * 1.2 / 525 / 0.002 / 8) = 456."""
    label = GraspRectangle(np.array([320.0, 240.0]), 0.0, 40.0, 20.0)
    sample, _ = photographed(labels=(label,))
    network = SavedGraspNet(FixedMaps((285, 227), radius=0.5), 0.002, {}, {})
    monkeypatch.setattr(
        photographs, "make_planner", lambda *_: GraspNetPlanner(HAND, WORKSPACE, network=network)
    )
    (found,) = photographs.judge_as_taken("network.pt", [sample], seed=0)
    right, down = 400 / 456 * (np.array([285, 227]) - 455 / 2)
    assert found.rectangle.centre == pytest.approx((319.5 + right, 239.5 + down), abs=1e-3)
    assert found.rectangle.width == pytest.approx(0.05 / (1.2 / 525), rel=0.01)
    assert found.rectangle.height == pytest.approx(found.rectangle.width / 2)


def test_whoever_cannot_see_photographs_is_not_judged_by_them():
    sample, _ = photographed()
    assert judge_photographs("oracle", [sample], seed=0) is None
    assert judge_photographs("heuristic", [], seed=0) == []
    assert photographs.judge_as_taken("heuristic", [sample], seed=0) is None


def test_images_of_another_size_are_refused(tmp_path):
    with pytest.raises(UserError, match="640 x 480"):
        photographs.photographs(write_cornell(tmp_path, 1))
