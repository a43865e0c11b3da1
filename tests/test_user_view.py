"""The part of a user's image to plan on, and whether it shows enough."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from models import photographs
from tests.helpers.real_images import CORNELL
from utils.errors import UserError
from utils.geometry import Workspace
from utils.table_plane import BEHIND, DEPTHS, FROM_BASE, distances, table_misses
from utils.transforms import RGBDFrame, look_at
from utils.user_view import (
    LARGEST,
    MISREAD,
    SMALLEST,
    _check_units,
    as_depths,
    check_found,
    check_view,
    corrected_view,
    given_workspace,
    locate_table,
    workspace_of,
)

FOCAL, SIDE, UP = 300.0, 480, 1.5  # a camera 1.5 m over the table, which shows 2.4 m of it
K = np.array([[FOCAL, 0, (SIDE - 1) / 2], [0, FOCAL, (SIDE - 1) / 2], [0, 0, 1.0]])
T_WC = look_at((0.0, 0.0, UP), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0))  # right is x, up in the image is y


def scene(*boxes: tuple[float, float, float], height: float = 0.05) -> RGBDFrame:
    """Squares (x, y, side) that are raised over the table, in metres; exact at their tops."""
    v, u = np.mgrid[:SIDE, :SIDE]
    depth = np.full((SIDE, SIDE), UP, np.float32)
    for x, y, side in boxes:
        at = UP - height
        on_x, on_y = (u - K[0, 2]) / FOCAL * at, -(v - K[1, 2]) / FOCAL * at
        depth[(np.abs(on_x - x) <= side / 2) & (np.abs(on_y - y) <= side / 2)] = at
    return RGBDFrame(np.zeros((SIDE, SIDE, 3), np.uint8), depth, K, T_WC)


def test_a_small_scene_gets_the_smallest_square_around_it() -> None:
    workspace, remarks = workspace_of(scene((0.3, -0.2, 0.06)), 0.0)
    np.testing.assert_allclose(workspace.centre, (0.3, -0.2), atol=0.01)
    assert (workspace.size, workspace.table_height, remarks) == (SMALLEST, 0.0, [])


def test_the_square_holds_all_matter_with_a_margin() -> None:
    workspace, remarks = workspace_of(scene((-0.2, 0.1, 0.1), (0.4, 0.0, 0.1)), 0.0)
    # From x = -0.25 to 0.45, and 2 cm more on both sides; y from -0.05 to 0.15.
    np.testing.assert_allclose(workspace.centre, (0.1, 0.05), atol=0.01)
    assert workspace.size == pytest.approx(0.74, abs=0.02) and remarks == []


def test_a_principal_point_outside_the_image_is_remarked_upon() -> None:
    frame = scene((0.0, 0.0, 0.06))
    outside = K.copy()
    outside[0, 2] = SIDE
    assert check_view(frame, Workspace((0.0, 0.0))) == []
    (remark,) = check_view(replace(frame, K=outside), Workspace((-0.8, 0.0)))
    assert remark.startswith("the principal point (480, 239.5) lies outside the image of 480x480")


def test_intrinsics_of_half_the_image_s_size_are_remarked_upon() -> None:
    half = K.copy()
    half[:2, 2] /= 2
    (remark,) = check_view(replace(scene((0.0, 0.0, 0.06)), K=half), Workspace((0.5, -0.5)))
    assert remark.startswith("the principal point (119.75, 119.75) is far from the middle")


def crate() -> RGBDFrame:
    """Tops of boxes side by side, 6 cm over a table of which a third is seen around them."""
    return scene((0.0, 0.0, 1.88), height=0.06)


def test_a_table_beneath_the_largest_plane_is_the_table_and_the_depths_stay_as_they_are() -> None:
    image = replace(crate(), T_WC=np.eye(4))
    assert np.mean(image.depth == np.float32(UP - 0.06)) == pytest.approx(0.67, abs=0.02)
    table = locate_table(image, None, None)
    assert table.height == 0 and table.T_WC[2, 3] == pytest.approx(UP, abs=1e-3)
    assert table.share == pytest.approx(0.33, abs=0.02)
    frame, remarks = corrected_view(replace(image, T_WC=table.T_WC), table.height)
    np.testing.assert_array_equal(frame.depth, image.depth)
    assert remarks == []
    posed = locate_table(image, T_WC, None)  # the same in the user's world
    assert posed.height == pytest.approx(0.0, abs=1e-3)
    np.testing.assert_array_equal(posed.T_WC, T_WC)


def test_a_table_of_which_a_twentieth_is_seen_beneath_what_is_on_it_is_no_error_of_scale() -> None:
    frame = scene((0.0, 0.0, 2.22), height=0.06)
    assert 0.05 < np.mean(frame.depth == np.float32(UP)) < 0.1
    corrected, remarks = corrected_view(frame, 0.0)
    np.testing.assert_array_equal(corrected.depth, frame.depth)
    assert remarks == []


@pytest.mark.parametrize("far", [2.2, 4.5])
def test_a_floor_that_fills_most_of_the_image_counts_as_table(far) -> None:
    """Lengths in pixels, and the network's level, are taken at the median depth."""
    small = scene((0.0, 0.0, 0.06))
    depth = small.depth.copy()
    beside = np.ones(depth.shape, bool)
    beside[80:400, 80:400] = False  # the table is 1.6 m wide
    depth[beside] = far
    assert np.median(depth) == pytest.approx(far)
    frame, remarks = corrected_view(replace(small, depth=depth), 0.0)
    np.testing.assert_allclose(frame.depth, small.depth, atol=1e-6)
    assert remarks == []


def test_a_floor_that_is_taken_for_the_table_is_told_of() -> None:
    small = replace(scene((0.0, 0.0, 0.06)), T_WC=np.eye(4))
    depth = np.full_like(small.depth, 2.2)
    depth[80:400, 80:400] = small.depth[80:400, 80:400]  # 44 % of the image
    image = replace(small, depth=depth)
    table = locate_table(image, None, None)
    assert table.T_WC[2, 3] == pytest.approx(2.2)
    remark = check_view(replace(image, T_WC=table.T_WC), Workspace((0.0, 0.0)))[-1]
    assert remark.startswith("a flat surface 0.7") and "holds 4" in remark
    assert check_view(scene((0.0, 0.0, 0.3), height=0.4), Workspace((0.0, 0.0))) == []


def test_a_table_height_that_is_too_low_is_told_of() -> None:
    """Depths are scaled by up to 12 %, here 21 cm."""
    frame = scene((0.0, 0.0, 0.06))
    remark = check_view(frame, Workspace((0.0, 0.0), table_height=-0.24), given=True)[-1]
    assert remark.startswith("a flat surface 0.24 m over") and "--table-height" in remark
    assert check_view(frame, Workspace((0.0, 0.0)), given=True) == []


def test_what_lies_above_the_horizon_is_unknown() -> None:
    level = look_at((0.0, 0.0, UP), (1.0, 0.0, UP - 0.3), (0.0, 0.0, 1.0))
    frame = replace(scene(), T_WC=level, depth=np.full((SIDE, SIDE), 3.0, np.float32))
    depth = corrected_view(frame, 0.0)[0].depth
    assert (depth[:40] == 0).all() and (depth[-40:] > 0).all()


def test_a_pose_that_tilts_the_table_is_remarked_upon_or_refused() -> None:
    image = replace(scene((0.0, 0.0, 0.06)), T_WC=np.eye(4))

    def leaning(degrees: float) -> np.ndarray:
        side = UP * np.tan(np.deg2rad(degrees))
        return look_at((side, 0.0, UP), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0))

    assert locate_table(image, leaning(1.0), None).remarks() == []
    (remark,) = locate_table(image, leaning(5.0), None).remarks()
    assert remark.startswith("the table found is tilted by 5 degrees in your world")
    with pytest.raises(UserError, match="tilted by 20 degrees"):
        locate_table(image, leaning(20.0), None)


def test_what_may_be_in_another_unit_is_remarked_upon() -> None:
    frame = scene((0.0, 0.0, 0.06))
    wide = replace(frame, depth=10 * frame.depth)
    depth = np.median(wide.depth)
    (remark,) = _check_units(wide)
    assert f"spans {SIDE * depth / FOCAL:.3g} m x" in remark and "unit of the depth" in remark
    near = replace(frame, depth=np.full_like(frame.depth, 0.05 * FOCAL / SIDE))
    assert "spans" in _check_units(near)[0]


def test_single_pixels_of_noise_do_not_count() -> None:
    frame = scene((0.3, -0.2, 0.06))
    depth = frame.depth.copy()
    depth[5, 5] = depth[400, 20] = 1.2
    # A pixel spans 5 mm here, a quarter of the 1 cm squares that have to be filled by a fifth.
    depth = np.repeat(np.repeat(depth, 2, axis=0), 2, axis=1)
    depth[11, 11] = depth[10, 11] = depth[11, 10] = UP  # 2.5 mm are left
    depth[801, 41] = depth[800, 41] = depth[801, 40] = UP
    fine = np.diag([2.0, 2.0, 1.0]) @ K
    fine[:2, 2] += 0.5
    rgb = np.repeat(np.repeat(frame.rgb, 2, axis=0), 2, axis=1)
    workspace, _ = workspace_of(replace(frame, rgb=rgb, depth=depth, K=fine), 0.0)
    np.testing.assert_allclose(workspace.centre, (0.3, -0.2), atol=0.01)


def test_an_empty_table_is_searched_where_the_camera_looks() -> None:
    workspace, _ = workspace_of(scene(), 0.0)
    np.testing.assert_allclose(workspace.centre, (0, 0), atol=1e-6)
    assert workspace.size == SMALLEST


@pytest.mark.parametrize(
    ("depth", "message"),
    [(0.0, "no pixel is known"), (np.nan, "no pixel is known"), (800.0, "median is 800 m.*millim")],
)
def test_depths_that_mean_nothing_are_refused(depth, message) -> None:
    with pytest.raises(UserError, match=message):
        workspace_of(replace(scene(), depth=np.full((SIDE, SIDE), depth, np.float32)), 0.0)


def test_of_a_scene_that_is_too_large_the_middle_or_the_place_of_the_target_is_searched() -> None:
    frame = scene((-0.8, 0.0, 0.1), (0.0, 0.1, 0.1), (0.8, 0.0, 0.1))
    workspace, remarks = workspace_of(frame, 0.0)
    assert (
        workspace.size == LARGEST
        and len(remarks) == 1
        and "1.7 m" in remarks[0]
        and "middle of the view" in remarks[0]
    )
    np.testing.assert_allclose(workspace.centre, (0.0, 0.05), atol=0.01)
    marked = np.zeros((SIDE, SIDE), bool)
    marked[200:280, 390:] = True
    workspace, remarks = workspace_of(frame, 0.0, marked)
    # The square ends where the matter ends, at 0.85 and 2 cm of margin.
    assert workspace.centre[0] == pytest.approx(0.87 - LARGEST / 2, abs=0.01)
    assert "around the target" in remarks[0]


def test_a_rough_table_is_remarked_upon() -> None:
    """And no further than 15 mm over it is anything taken for it."""
    frame, rng = scene((0.0, 0.0, 0.3)), np.random.default_rng(0)
    assert corrected_view(frame, 0.0)[1] == []
    for sigma, bump in ((0.0024, 12), (0.0035, 15)):
        noise = rng.normal(0, sigma, frame.depth.shape).astype(np.float32)
        (remark,) = corrected_view(replace(frame, depth=frame.depth + noise), 0.0)[1]
        assert f"rough by {1000 * sigma:.1f} mm" in remark and f"height of {bump} mm" in remark


def test_a_given_workspace() -> None:
    frame = scene()
    found = given_workspace(frame, 0.02, (0.5, 0.1, 0.3))
    assert found == (Workspace((0.5, 0.1), 0.3, 0.02), [])
    for size in (0.1, 1.2, np.nan):
        with pytest.raises(UserError, match="a side of 0.15 to 1 m"):
            given_workspace(frame, 0.02, (0.5, 0.1, size))


@pytest.mark.parametrize(("x", "outside"), [(0.9, 0), (1.0, 0), (1.15, 38), (1.35, 88)])
def test_a_given_workspace_that_the_image_hardly_shows_is_remarked_upon(x, outside) -> None:
    """The image shows the table up to x = 1.2 m, in front of the camera alone."""
    workspace, remarks = given_workspace(scene(), 0.0, (x, 0.0, 0.4))
    expected = [f"{outside}% of --workspace lies outside the image, where nothing is found"]
    assert remarks == (expected if outside else []) and workspace.centre == (x, 0.0)
    behind = replace(scene(), T_WC=look_at((0.0, 0.0, -1.0), (0.0, 0.0, -2.0), (0.0, 1.0, 0.0)))
    assert given_workspace(behind, 0.0, (0.0, 0.0, 0.4))[1][0].startswith("100% of --workspace")


@pytest.mark.parametrize(("degrees", "remarks"), [(0, 0), (40, 0), (60, 1), (80, None)])
def test_an_oblique_view_is_named_and_a_very_oblique_one_refused(degrees, remarks) -> None:
    tilt = np.deg2rad(degrees)
    T_WC = look_at((-np.sin(tilt), 0, np.cos(tilt)), (0, 0, 0), (0, 1, 0))
    frame = replace(scene(), T_WC=T_WC)
    if remarks is None:
        with pytest.raises(UserError, match=f"too oblique: the camera looks {degrees} degrees"):
            check_view(frame, Workspace((0.0, 0.0)))
    else:
        assert len(check_view(frame, Workspace((0.0, 0.0)))) == remarks


@pytest.mark.parametrize(("share", "remarks"), [(0.2, 0), (0.4, 1), (0.6, None)])
def test_missing_depth_is_named_and_too_much_of_it_refused(share, remarks) -> None:
    frame = scene()
    depth = frame.depth.copy()
    depth[np.random.default_rng(0).random(depth.shape) < share] = 0
    depth[:, :100] = 0  # beside the workspace, which is 0.5 m away from there
    frame = replace(frame, depth=depth)
    if remarks is None:
        with pytest.raises(UserError, match="too much is unseen"):
            check_view(frame, Workspace((0.0, 0.0)))
    else:
        assert len(check_view(frame, Workspace((0.0, 0.0)))) == remarks


def test_an_image_without_a_grasp_says_why() -> None:
    """A table alone, and a block on it, 8 cm high."""
    assert check_found(3, scene(), Workspace((0.3, -0.2))) == []
    (empty,) = check_found(0, scene(), Workspace((0.3, -0.2)))
    (full,) = check_found(0, scene((0.3, -0.2, 0.06)), Workspace((0.3, -0.2)))
    assert "nothing there rises 4 mm" in empty and "too wide for the hand" in full


BESIDE = np.array([0.3, 1.0, 0.4])  # of a robot's base, in the optical frame of a camera 1.5 m up


@pytest.mark.parametrize(("origin", "noise"), [(BEHIND, 0.0), (BESIDE, 0.001)])
def test_distances_from_a_base_are_told_from_depths_and_become_depths(origin, noise) -> None:
    frame = scene((0.3, -0.2, 0.06))
    rng = np.random.default_rng(0)
    depth = (frame.depth + rng.normal(0, noise, frame.depth.shape)).astype(np.float32)
    far = distances(depth, K, origin)
    with pytest.raises(UserError, match="seems to hold distances from a robot's base.*--from-base"):
        as_depths(far, K)
    np.testing.assert_allclose(as_depths(far, K, from_base=True), depth, atol=2e-3)
    assert as_depths(far, K, from_base=False) is far
    assert as_depths(depth, K) is depth


def test_distances_from_the_camera_are_told_from_depths() -> None:
    frame = scene((0.3, -0.2, 0.06))
    ranges = np.linalg.norm(frame.points() - frame.T_WC[:3, 3], axis=-1)
    with pytest.raises(UserError, match="seems to hold distances from the camera: .* divide each"):
        as_depths(ranges, K)


def test_a_scene_without_a_table_holds_no_distances_from_a_base() -> None:
    steps = np.random.default_rng(0).uniform(0.8, 1.2, (30, 30))
    depth = np.kron(steps, np.ones((16, 16))).astype(np.float32)
    assert as_depths(depth, K) is depth
    with pytest.raises(UserError, match="--from-base: the depth image shows no flat table"):
        as_depths(depth, K, from_base=True)


def test_depths_of_a_table_s_edge_are_no_distances() -> None:
    """Two planes, of which the higher one fills more than half of the image."""
    v, _ = np.mgrid[:SIDE, :SIDE]
    depth = np.where(v > 0.6 * SIDE, 0.9 * UP, 0.6 * UP).astype(np.float32)
    assert as_depths(depth, K) is depth


@pytest.mark.parametrize("height", [0.2, 0.7])
@pytest.mark.parametrize("size", [(1080, 1920), (720, 1280), (240, 424), (60, 60)])
def test_depths_at_any_resolution_are_no_distances(size, height) -> None:
    """A table from near and far, with a ball half as wide as the image is high, which six
    parameters fit better than three where it fills what is looked at; 1 mm of noise."""
    focal, middle = 0.73 * size[1], (np.array(size[::-1]) - 1) / 2
    K = np.array([[focal, 0, middle[0]], [0, focal, middle[1]], [0, 0, 1.0]])
    v, u = np.mgrid[: size[0], : size[1]]
    rays = np.stack([(u - middle[0]) / focal, (v - middle[1]) / focal, np.ones(size)], axis=-1)
    radius = 0.2 * height * size[0] / focal
    square, along = (rays**2).sum(axis=-1), height * np.ones(size)
    root = along**2 - square * (height**2 - radius**2)
    ball = (along - np.sqrt(np.maximum(root, 0))) / square
    depth = np.where(root > 0, ball, height) + np.random.default_rng(0).normal(0, 0.001, size)
    assert as_depths(depth.astype(np.float32), K) is not None


@pytest.mark.parametrize("unknown", [0.0, 0.6])
def test_small_and_incomplete_images_are_no_distances(unknown) -> None:
    rng = np.random.default_rng(0)
    for side in (6, 8, 12, 16, 32):
        small = np.array([[side, 0, side / 2], [0, side, side / 2], [0, 0, 1.0]])
        depth = rng.normal(0.8, 0.001, (side, side)).astype(np.float32)
        depth[rng.random((side, side)) < unknown] = 0
        assert as_depths(depth, small) is depth


@pytest.mark.skipif(not CORNELL.is_dir(), reason=f"no Cornell data at {CORNELL}")
def test_cornell_s_depth_images_are_told_from_depths() -> None:
    """Every eighth; MISREAD lies between these ratios and those of depths."""
    for sample in photographs.photographs(CORNELL)[::8]:
        misses = table_misses(sample.depth, photographs.K)
        assert misses[DEPTHS] > 4 * MISREAD * misses[FROM_BASE], sample.name
        depth = as_depths(sample.depth, photographs.K, from_base=True)
        misses = table_misses(depth, photographs.K)
        assert misses[DEPTHS] < MISREAD / 3 * misses[FROM_BASE], sample.name
