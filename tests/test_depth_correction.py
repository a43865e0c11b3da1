"""The correction of depth by the table: closed forms, and clean frames that stay as they are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.helpers.box_frames import CORNERS, boxes_frame
from utils.depth import GammaNoise, make_depth_noise, measure
from utils.depth_correction import (
    COLOUR_NOISE,
    SMOOTHING_RADIUS,
    _fixture_pixels,
    corrected,
    scale_to_table,
    smoothed_by_colour,
    table_roughness,
)
from utils.depth_holes import table_in_holes
from utils.geometry import ConvexSolid, Workspace, intersect_lines
from utils.height_map import height_map_from_frame
from utils.transforms import RGBDFrame, deproject, look_at

SIZE, FOCAL, EYE = 120, 240.0, 0.8
GREY, RED = (140, 140, 140), (200, 40, 30)
BOX = np.s_[40:70, 50:80]
BOX_HEIGHT = 0.05


def scene(tilt: float = 0.0) -> RGBDFrame:
    """A grey table at z = 0 with a red box on it, seen from EYE metres away, `tilt` rad off the
    vertical: the box is a plane parallel to the table."""
    eye = EYE * np.array([np.sin(tilt), 0.0, np.cos(tilt)])
    T_WC = look_at(eye, target=(0.0, 0.0, 0.0), up=(0, 1, 0))
    K = np.array([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1.0]])
    rgb = np.full((SIZE, SIZE, 3), GREY, np.uint8)
    rgb[BOX] = RED
    v, u = np.mgrid[:SIZE, :SIZE]
    rays = np.stack([(u - K[0, 2]) / FOCAL, (v - K[1, 2]) / FOCAL, np.ones(u.shape)], axis=-1)
    down = (rays @ T_WC[:3, :3].T)[..., 2]
    height = np.zeros((SIZE, SIZE))
    height[BOX] = BOX_HEIGHT
    return RGBDFrame(rgb, ((height - eye[2]) / down).astype(np.float32), K, T_WC)


@given(scale=st.floats(0.91, 1.09), tilt=st.floats(0.0, 1.0))
@settings(deadline=None, max_examples=25)
def test_scale_is_the_inverse_of_the_camera_s(scale: float, tilt: float) -> None:
    frame = scene(tilt)
    measured = replace(frame, depth=frame.depth * np.float32(scale))
    assert scale_to_table(measured, 0.0) == pytest.approx(1 / scale, abs=1e-5)


def test_a_scale_is_measured_where_a_tenth_of_the_image_lies_beneath_the_table() -> None:
    """A plate 3 cm over a bench of which a tenth is seen; the camera measures 2 % too near."""
    frame = scene()
    depth = frame.depth.copy()
    depth[: SIZE // 10] = EYE + 0.03
    measured = replace(frame, depth=depth * np.float32(0.98))
    assert scale_to_table(measured, 0.0) == pytest.approx(1 / 0.98, abs=1e-4)


def test_scale_of_a_noisy_table() -> None:
    """Dex-Net's noise: 5 mm at 0.8 m is 0.6 %, of some 10,000 pixels of which 1 / 12 are
    independent, hence 2e-4."""
    frame = scene()
    for seed in range(5):
        rng = np.random.default_rng(seed)
        factor = rng.gamma(1000, 1e-3)
        noisy = GammaNoise()(frame.depth, np.random.default_rng(seed))
        found = scale_to_table(replace(frame, depth=noisy), 0.0)
        assert found == pytest.approx(1 / factor, abs=8e-4)


def test_a_large_box_is_not_taken_for_the_table() -> None:
    """Its top, 5 cm high, covers more of the image than the table: a factor of 0.8 / 0.75 = 1.067,
    which a camera is rarely wrong by."""
    frame = scene()
    depth = np.full_like(frame.depth, EYE - BOX_HEIGHT)
    depth[:, : SIZE // 3] = EYE
    assert scale_to_table(replace(frame, depth=depth), 0.0) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("height", [0.01, 0.02, 0.03])
def test_a_known_board_is_not_taken_for_the_table(height: float) -> None:
    """It covers two thirds of the table that is seen, or all of it; without its place its top is
    the table where nothing else is seen."""
    for side in (0.36, 1.0):
        frame = boxes_frame([((side, side, height), 0.0, (0.5, 0.0))], walls=1)
        knowing = replace(frame, fixtures=frame.truth.walls)
        assert scale_to_table(knowing, 0.0) == pytest.approx(1.0, abs=1e-4)
        alone = 1.0 if side == 0.36 else 0.8 / (0.8 - height)
        assert scale_to_table(frame, 0.0) == pytest.approx(alone, abs=5e-3)
    frame = boxes_frame([((0.36, 0.36, height), 0.0, (0.5, 0.0))], walls=1)
    scaled = replace(frame, depth=frame.depth * np.float32(0.95), fixtures=frame.truth.walls)
    assert scale_to_table(scaled, 0.0) == pytest.approx(1 / 0.95, abs=1e-4)


@pytest.mark.parametrize("height", [0.015, 0.03, 0.05])
@pytest.mark.parametrize("scale", [0.97, 1.0, 1.05])
def test_what_has_a_flat_surface_under_it_is_not_the_table(height: float, scale: float) -> None:
    """A board that nobody knows leaves a quarter of the image to the table. The camera measures all
    depths `scale` times too far, with 2 mm of noise at each pixel."""
    frame, rng = scene(), np.random.default_rng(0)
    depth = np.full_like(frame.depth, EYE - height)
    depth[:, : SIZE // 4] = EYE
    depth = scale * (depth + rng.normal(0, 0.002, depth.shape)).astype(np.float32)
    found = scale_to_table(replace(frame, depth=depth.astype(np.float32)), 0.0)
    assert found == pytest.approx(1 / scale, abs=1e-3)


@pytest.mark.parametrize("x", [0.2, 0.5, -0.5])
def test_pixels_of_fixtures_are_those_whose_rays_meet_them(x: float) -> None:
    """A wall before the camera, around it, and behind it; the reference is each ray's own
    intersection. Rays that graze the outline may fall on either side of it."""
    frame = scene(0.9)
    eye = frame.T_WC[:3, 3]
    wall = ConvexSolid.from_vertices(CORNERS * (0.3, 0.05, 0.3) + (eye[0] - x, 0.02, eye[2] - 0.3))
    v, u = np.mgrid[:SIZE, :SIZE]
    ends = deproject(np.stack([u, v], -1), np.ones(u.shape), frame.K, frame.T_WC).reshape(-1, 3)
    hits = intersect_lines(wall, np.broadcast_to(eye, ends.shape), ends - eye)
    expected = np.isfinite(hits.enter) & (hits.leave > 0)
    found = _fixture_pixels(replace(frame, fixtures=(wall,))).ravel()
    assert (found != expected).mean() < 0.02
    assert expected.any() == (x > 0)


def test_without_a_table_nothing_is_scaled() -> None:
    frame = scene()
    assert scale_to_table(replace(frame, depth=np.full_like(frame.depth, 0.3)), 0.0) == 1.0
    assert scale_to_table(replace(frame, depth=np.zeros_like(frame.depth)), 0.0) == 1.0
    assert table_roughness(replace(frame, depth=np.zeros_like(frame.depth)), 0.0) == 0.0


def test_a_surface_that_is_no_table_scales_nothing() -> None:
    """A wall, 45 degrees to the table: each of its lines asks for another factor."""
    frame = scene(np.deg2rad(45))
    flat = replace(frame, depth=np.full_like(frame.depth, EYE))
    assert scale_to_table(flat, 0.0) == 1.0


def test_roughness_is_the_standard_deviation() -> None:
    frame, rng = scene(), np.random.default_rng(0)
    depth = frame.depth + rng.normal(0, 0.004, frame.depth.shape).astype(np.float32)
    assert table_roughness(replace(frame, depth=depth), 0.0) == pytest.approx(0.004, rel=0.03)


def test_roughness_is_that_of_the_corrected_depth() -> None:
    """2 mm of a camera that measures 5 % too near are 2 / 0.95 mm once it is corrected."""
    frame, rng = scene(), np.random.default_rng(1)
    noise = rng.normal(0, 0.002, frame.depth.shape)
    near = replace(frame, depth=(0.95 * frame.depth + noise).astype(np.float32))
    assert table_roughness(near, 0.0) == pytest.approx(0.002 / 0.95, rel=0.02)


def test_a_good_camera_s_frame_stays_as_it_is() -> None:
    frame, rng = scene(0.4), np.random.default_rng(0)
    same = corrected(frame, 0.0)
    assert same.depth is frame.depth and same.roughness < 1e-6
    depth = frame.depth + rng.normal(0, 0.0002, frame.depth.shape).astype(np.float32)
    same = corrected(replace(frame, depth=depth), 0.0)
    assert same.depth is depth and same.roughness == pytest.approx(0.0002, rel=0.03)


def test_a_table_gets_flat_and_a_box_stays() -> None:
    frame, rng = scene(0.4), np.random.default_rng(0)
    depth = frame.depth + rng.normal(0, 0.001, frame.depth.shape).astype(np.float32)
    flat = corrected(replace(frame, depth=depth), 0.0)
    assert flat.roughness == pytest.approx(0.001, rel=0.03)
    table = np.ones(depth.shape, bool)
    table[BOX] = False
    np.testing.assert_allclose(flat.depth[table], frame.depth[table], atol=1e-6)
    np.testing.assert_array_equal(flat.depth[BOX], depth[BOX])


def table_frame(boxes=(), noise="realsense", seed=0, colour=(60, 90, 200)) -> RGBDFrame:
    """Boxes of a colour on a table of another one, measured with this depth noise and corrected."""
    frame, rng = boxes_frame(boxes), np.random.default_rng(seed)
    rgb = np.full((*frame.depth.shape, 3), (156, 150, 140), np.uint8)
    rgb[frame.points()[..., 2] > 0.001] = colour
    rgb += rng.integers(0, 7, rgb.shape, np.uint8)  # no surface has one exact colour
    camera = make_depth_noise(noise, float(frame.K[0, 0]))
    depth = frame.depth if camera is None else measure(camera, frame.depth, rng, rgb)
    return corrected(replace(frame, depth=depth, rgb=rgb), 0.0)


@pytest.mark.parametrize("noise", ["realsense", "gamma", "gaussian"])
@pytest.mark.parametrize("seed", range(5))
def test_a_rough_table_has_no_bumps(noise, seed) -> None:
    frame = table_in_holes(table_frame(noise=noise, seed=seed), 0.0)
    assert frame.roughness > 0.0005
    heights = height_map_from_frame(frame, Workspace())
    assert (heights.label < 0).all()
    assert np.mean(heights.height > 0.0005) < 1e-3


@pytest.mark.parametrize(
    "size, colour, noise, stays",
    [
        ((0.02, 0.02, 0.008), (60, 90, 200), "realsense", True),  # of a colour of its own
        ((0.02, 0.02, 0.020), (156, 150, 140), "realsense", True),  # higher than any bump
        ((0.02, 0.02, 0.008), (156, 150, 140), "none", True),  # seen by a good camera
        ((0.02, 0.02, 0.008), (156, 150, 140), "realsense", False),
        ((0.04, 0.06, 0.005), (156, 150, 140), "realsense", False),  # however wide it is
        ((0.04, 0.06, 0.005), (156, 150, 160), "realsense", False),  # 20 from the table's colour
        ((0.04, 0.06, 0.008), (156, 150, 180), "realsense", True),  # 40 from it
    ],
)
def test_what_is_no_bump_stays(size, colour, noise, stays) -> None:
    frame = table_in_holes(table_frame([(size, 0.0, (0.5, 0.0))], noise, colour=colour), 0.0)
    heights = height_map_from_frame(frame, Workspace())
    number = heights.label[heights.index(np.array([0.5, 0.0]))]
    assert (number >= 0) == stays
    assert heights.label.max() + 1 == len(heights.centres) == stays
    if stays:
        np.testing.assert_allclose(heights.centres[number, :2], (0.5, 0.0), atol=0.005)


def test_a_frame_that_is_corrected_twice_tells_how_rough_it_was() -> None:
    frame, rng = scene(), np.random.default_rng(0)
    depth = frame.depth + rng.normal(0, 0.005, frame.depth.shape).astype(np.float32)
    once = corrected(replace(frame, depth=depth), 0.0)
    assert table_roughness(once, 0.0) < 0.003  # it was smoothed
    assert once.roughness == corrected(once, 0.0).roughness == pytest.approx(0.005, rel=0.05)


@pytest.mark.parametrize("degrees", [20, 45])
def test_a_tilted_view_and_a_second_frame_get_a_flat_table(degrees: float) -> None:
    frame, rng = scene(np.deg2rad(degrees)), np.random.default_rng(0)
    table = np.ones(frame.depth.shape, bool)
    table[BOX] = False
    depth = frame.depth + rng.normal(0, 0.001, frame.depth.shape).astype(np.float32)
    rough = replace(frame, depth=depth)
    both = corrected(replace(rough, second=rough), 0.0)
    for seen in (both, both.second):
        np.testing.assert_allclose(seen.depth[table], frame.depth[table], atol=1e-6)


def test_a_hole_stays_a_hole() -> None:
    frame, rng = scene(), np.random.default_rng(0)
    depth = frame.depth + rng.normal(0, 0.001, frame.depth.shape).astype(np.float32)
    depth[:10] = 0
    flat = corrected(replace(frame, depth=depth), 0.0)
    assert (flat.depth[:10] == 0).all()
    nothing = replace(frame, depth=np.zeros_like(frame.depth))
    assert (corrected(nothing, 0.0).depth == 0).all()


def test_smoothing_averages_a_surface_and_keeps_its_edge() -> None:
    """A window of n independent pixels, averaged twice, has at most 1 / sqrt(n) of the noise; and a
    step of colour keeps a step of depth."""
    frame, rng = scene(), np.random.default_rng(0)
    sigma = 0.005
    noisy = frame.depth + rng.normal(0, sigma, frame.depth.shape).astype(np.float32)
    smooth = smoothed_by_colour(replace(frame, depth=noisy))
    radius = round(SMOOTHING_RADIUS * FOCAL / EYE)
    error = smooth - frame.depth
    inside = error[2 * radius : 30, 2 * radius : -2 * radius]
    assert inside.std() < sigma / (2 * radius + 1)
    step = smooth[45:65, 49] - smooth[45:65, 50]  # across the edge, one pixel apart
    assert step.mean() == pytest.approx(BOX_HEIGHT, abs=0.003)


def test_smoothing_is_the_guided_filter_of_a_window() -> None:
    """In the middle of an image of uniform windows: least squares of depth on colours with a ridge
    of COLOUR_NOISE^2, written out for each window and averaged."""
    rng = np.random.default_rng(1)
    frame = scene()
    frame = replace(
        frame, rgb=rng.integers(0, 256, frame.rgb.shape, dtype=np.uint8),
        depth=(0.8 + rng.normal(0, 0.01, frame.depth.shape)).astype(np.float32),
    )  # fmt: skip
    radius = round(SMOOTHING_RADIUS * FOCAL / float(np.median(frame.depth)))
    v = u = SIZE // 2
    across = range(-radius, radius + 1)
    values = []
    for dv in across:
        for du in across:
            window = np.s_[
                v + dv - radius : v + dv + radius + 1, u + du - radius : u + du + radius + 1
            ]
            colours = frame.rgb[window].reshape(-1, 3) / 255.0
            depth = frame.depth[window].ravel().astype(float)
            away = colours - colours.mean(axis=0)
            matrix = away.T @ away / len(away) + COLOUR_NOISE**2 * np.eye(3)
            slope = np.linalg.solve(matrix, away.T @ depth / len(away))
            values.append(slope @ (frame.rgb[v, u] / 255 - colours.mean(axis=0)) + depth.mean())
    assert smoothed_by_colour(frame)[v, u] == pytest.approx(np.mean(values), abs=2e-6)


def test_unknown_pixels_stay_unknown_and_weigh_nothing() -> None:
    frame = scene()
    depth = frame.depth.copy()
    depth[20:30, 20:30] = 0
    smooth = smoothed_by_colour(replace(frame, depth=depth))
    assert (smooth[20:30, 20:30] == 0).all()
    beside = smooth[15:20, 20:30]
    np.testing.assert_allclose(beside, EYE, atol=1e-5)
