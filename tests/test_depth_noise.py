"""The depth camera's noise: against loops over pixels, closed forms, and in the cell."""

import time
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from envs.cell_scenes import make_scene
from envs.objects import load_object_set
from envs.pybullet_cell import PybulletCell
from utils.augmentation import Augmentation, LabelledImage
from utils.config import ConfigError, load_config, with_settings
from utils.depth import KinectNoise, dot_pattern

FB = 480 * 0.075  # pixels x metres: disparity x depth


def plane(depth: float, side: int = 224) -> np.ndarray:
    return np.full((side, side), depth, dtype=np.float32)


def steps_and_slopes(side: int = 224) -> np.ndarray:
    """A table at 0.8 m with a box, a ramp, a thin wall and a patch of unknown depth."""
    depth, s = plane(0.8, side), side // 8
    depth[s : 3 * s, s : 3 * s] = 0.74
    depth[4 * s : 7 * s, s : 3 * s] = np.linspace(0.7, 0.79, 3 * s)[:, None]
    depth[s : 7 * s, 4 * s : 4 * s + 2] = 0.65
    depth[5 * s : 7 * s, 5 * s : 7 * s] = 0
    return depth


def by_loops(noise: KinectNoise, depth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The same measurement, one pixel after another, from the same draws."""
    height, width = depth.shape
    shift_u, shift_v, jitter = rng.standard_normal((3, height, width), dtype=np.float32)
    scale = noise.image_focal / noise.focal
    disparity = np.zeros((height, width))
    for v in range(height):
        for u in range(width):
            x = min(max(u + noise.shift * scale * float(shift_u[v, u]), 0), width - 1)
            y = min(max(v + noise.shift * scale * float(shift_v[v, u]), 0), height - 1)
            left, top = min(int(x), width - 2), min(int(y), height - 2)
            corners = [(top, left), (top, left + 1), (top + 1, left), (top + 1, left + 1)]
            z = [float(depth[corner]) for corner in corners]
            if min(z) > 0:
                fx, fy = x - left, y - top
                weights = [(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy]
                disparity[v, u] = sum(w * FB / depth for w, depth in zip(weights, z))
    half = round(4 * scale)
    pattern = dot_pattern(height, width, round(3 * scale))
    recognised = np.zeros((height, width), dtype=bool)
    for v in range(half, height - half):
        for u in range(half, width - half):
            if not pattern[v, u] or disparity[v, u] == 0:
                continue
            window = [
                (v + j, u + i) for j in range(-half, half + 1) for i in range(-half, half + 1)
            ]
            known = [disparity[p] for p in window if disparity[p] > 0]
            mean = sum(known) / len(known)
            dots = agree = 0
            for p in window:
                if pattern[p]:
                    dots += 1
                    r2 = ((p[0] - v) ** 2 + (p[1] - u) ** 2) / scale**2
                    near = abs(disparity[p] - mean) < 0.1 * max(1, 1.44 * r2)
                    agree += disparity[p] > 0 and near
            recognised[v, u] = agree > dots / 1.2
    reach = round(3 * scale)
    measured = np.zeros((height, width), dtype=np.float32)
    for v in range(height):
        for u in range(width):
            nearest = None
            for j in range(max(v - reach, 0), min(v + reach + 1, height)):
                for i in range(max(u - reach, 0), min(u + reach + 1, width)):
                    r2 = (j - v) ** 2 + (i - u) ** 2
                    if recognised[j, i] and r2 <= reach**2 and (nearest is None or r2 < nearest[0]):
                        nearest = r2, disparity[j, i]
            if nearest is not None:
                measured[v, u] = FB / (round(nearest[1] * 8 + float(jitter[v, u]) / 6) / 8)
    return measured


def test_equals_the_loops_and_is_much_faster():
    """By 30 times on a machine that has nothing else to do; the best of several times may be half
    of that where others work, and array code that loops over pixels is far below it."""
    noise, depth = KinectNoise(), steps_and_slopes(112)
    slow = []
    for _ in range(2):
        start = time.perf_counter()
        expected = by_loops(noise, depth, np.random.default_rng(3))
        slow.append(time.perf_counter() - start)
    np.testing.assert_array_equal(expected == 0, noise(depth, np.random.default_rng(3)) == 0)
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        fast = []
        for _ in range(20):
            rng = np.random.default_rng(3)
            start = time.perf_counter()
            measured = noise(depth, rng)
            fast.append(time.perf_counter() - start)
    finally:
        cv2.setNumThreads(threads)
    # Rounding in single precision may tip a disparity that lies between two steps.
    same = np.isclose(measured, expected, rtol=1e-6)
    assert (~same).mean() < 1e-3
    one_step = 0.81**2 / FB / 8
    assert abs(measured - expected)[~same].max(initial=0) < one_step
    assert 0.01 < (expected == 0).mean() < 0.5  # there was something to get wrong
    assert min(slow) / min(fast) > 15


@pytest.mark.parametrize("image_focal", [200.0, 900.0])
def test_equals_the_loops_at_other_resolutions(image_focal):
    noise, depth = KinectNoise(image_focal=image_focal), steps_and_slopes(48)
    expected = by_loops(noise, depth, np.random.default_rng(4))
    measured = noise(depth, np.random.default_rng(4))
    assert (~np.isclose(measured, expected, rtol=1e-6)).mean() < 1e-3


def errors_of_planes(around: float) -> np.ndarray:
    """Errors (m) over planes that lie evenly spread between two steps near `around` metres."""
    errors = []
    for seed, part in enumerate(np.linspace(-0.5, 0.5, 64, endpoint=False)):
        z = 8 * FB / (round(8 * FB / around) + part)
        measured = KinectNoise()(plane(z, 32), np.random.default_rng(seed))
        errors.append((measured[measured > 0] - z).astype(float))
    return np.concatenate(errors)


def test_mean_error_is_near_zero():
    # A single plane is biased by up to half a step; all of them together are not.
    assert abs(errors_of_planes(0.8).mean()) < 0.02 * 0.8**2 / FB / 8


@pytest.mark.parametrize("around", [0.5, 0.8, 1.6])
def test_spread_grows_with_the_square_of_the_depth(around):
    # Uniform within a step, and a sixth of a step: sqrt(1/12 + 1/36) = 1/3 of a step.
    one_step = around**2 / FB / 8
    assert errors_of_planes(around).std() == pytest.approx(one_step / 3, rel=0.03)


def test_depths_lie_on_steps_of_two_millimetres():
    ramp = np.broadcast_to(np.linspace(0.75, 0.85, 224, dtype=np.float32)[:, None], (224, 224))
    measured = KinectNoise()(ramp, np.random.default_rng(0))
    values = np.unique(measured[measured > 0])
    eighths = 8 * FB / values.astype(float)
    np.testing.assert_allclose(eighths, np.rint(eighths), atol=1e-3)
    # Disparities from 42.35 to 48 pixels in eighths.
    assert len(values) == pytest.approx(8 * (FB / 0.75 - FB / 0.85), abs=3)
    at_table = np.diff(values)[np.searchsorted(values, 0.8)]
    assert at_table == pytest.approx(0.8**2 / FB / 8, rel=0.02)
    assert 0.002 < at_table < 0.0025


def test_noise_free_settings_leave_only_the_steps():
    measured = KinectNoise(shift=0, noise=0)(plane(0.8), np.random.default_rng(0))
    assert set(np.unique(measured)) == {np.float32(0), np.float32(0.8)}  # 36 / 0.8 = 45 pixels


def test_a_plane_has_holes_at_the_image_border_only():
    measured = KinectNoise()(plane(0.8), np.random.default_rng(0))
    assert (measured[8:-8, 8:-8] > 0).all()
    assert 0 < (measured == 0).mean() < 0.06


def test_holes_lie_near_discontinuities_and_unknown_pixels():
    depth = steps_and_slopes()
    measured = KinectNoise()(depth, np.random.default_rng(0))
    # A jump (or the unknown) within reach of the window, the shift and the dot's disc.
    kernel = np.ones((21, 21), np.uint8)
    near = (cv2.dilate(depth, kernel) - cv2.erode(depth, kernel) > 0.03) | (depth == 0)
    hole, inside = measured == 0, np.s_[8:-8, 8:-8]
    assert (hole & near & (depth > 0))[inside].sum() > 500
    assert not (hole & ~near)[inside].any()
    unknown = cv2.erode((depth == 0).astype(np.uint8), np.ones((13, 13), np.uint8)) > 0
    assert unknown.any() and not measured[unknown].any()
    assert not KinectNoise()(np.full((32, 32), np.nan), np.random.default_rng(0)).any()


def test_deterministic_and_leaves_its_input_alone():
    noise, depth = KinectNoise(), steps_and_slopes()
    before = depth.copy()
    first = noise(depth, np.random.default_rng(5))
    assert first.dtype == np.float32 and first.shape == depth.shape
    np.testing.assert_array_equal(first, noise(depth, np.random.default_rng(5)))
    assert (first != noise(depth, np.random.default_rng(6))).any()
    np.testing.assert_array_equal(depth, before)


def test_the_generator_advances_alike_whatever_is_seen():
    after = []
    for depth in (plane(0.8), steps_and_slopes(), plane(0.0)):
        rng = np.random.default_rng(0)
        KinectNoise()(depth, rng)
        after.append(rng.random())
    assert len(set(after)) == 1


@pytest.mark.parametrize(
    "wrong", [{"focal": 0}, {"image_focal": np.nan}, {"noise": -1}, {"window": 8}, {"step": 0}]
)
def test_wrong_parameters_are_refused(wrong):
    with pytest.raises(ValueError, match=f"KinectNoise.{next(iter(wrong))}"):
        KinectNoise(**wrong)


@pytest.mark.parametrize("shape", [(3, 32, 32), (8, 32)])
def test_wrong_shapes_are_refused(shape):
    with pytest.raises(ValueError, match=r"\(H, W\)"):
        KinectNoise()(np.ones(shape), np.random.default_rng(0))


def test_as_an_augmentation():
    noise, depth = KinectNoise(), torch.from_numpy(steps_and_slopes(64))
    labels = torch.zeros(18, 64, 64)
    image = LabelledImage(
        torch.zeros(3, 64, 64, dtype=torch.uint8), depth, labels, labels,
        torch.ones(64, 64, dtype=torch.bool),
    )  # fmt: skip
    still = Augmentation(max_turn=0, max_shift=0, scale=(1, 1), mirror=0, colour=None)
    changed = replace(still, depth_noise=noise.on_tensor)(image, np.random.default_rng(0))
    rng = np.random.default_rng(0)
    still.draw(rng, (64, 64))
    np.testing.assert_array_equal(changed.depth.numpy(), noise(depth.numpy(), rng))
    assert changed.depth.dtype == torch.float32 and (depth == 0).any()


def test_wrong_config_value_names_the_choices():
    with pytest.raises(ConfigError, match=r"camera.depth_noise.*kinec.*none.*kinect"):
        load_config(None, ["camera.depth_noise=kinec"])


@pytest.fixture(scope="module")
def frames(config):
    """Two frames of a scene with and without noise, and again after other work."""
    objects = load_object_set("primitives", cache_dir=config.cache_folder)
    noisy = with_settings(config, "camera", {"depth_noise": "kinect"})
    scene, other = (make_scene("pile", objects, seed, config) for seed in (1, 2))
    with PybulletCell(config) as cell:
        cell.load(scene)
        clean = [cell.frame(with_truth=True), cell.frame()]
    with PybulletCell(noisy) as cell:
        cell.load(scene)
        first = [cell.frame(with_truth=True), cell.frame()]
        cell.load(other)
        cell.frame()
        cell.load(scene)
        again = [cell.frame(), cell.frame()]
    return clean, first, again


def test_cell_measures_with_noise(frames):
    clean, noisy, _ = frames
    np.testing.assert_array_equal(clean[0].depth, clean[1].depth)
    for a, b in zip(clean, noisy):
        np.testing.assert_array_equal(a.rgb, b.rgb)
        np.testing.assert_array_equal(a.segmentation, b.segmentation)
        # The table, 0.8 m away, happens to lie on a step: 45 pixels of disparity.
        error = (b.depth - a.depth)[(b.depth > 0) & (a.segmentation >= 0)]
        assert 2e-4 < np.median(abs(error)) < 2e-3
        assert 0.01 < (b.depth == 0).mean() < 0.25
    for a, b in zip(clean[0].truth.objects, noisy[0].truth.objects):
        np.testing.assert_array_equal(a.centre_of_mass, b.centre_of_mass)


def test_cells_noise_depends_on_seed_and_frame_alone(frames):
    _, noisy, again = frames
    assert (noisy[0].depth != noisy[1].depth).any()
    for a, b in zip(noisy, again):
        np.testing.assert_array_equal(a.depth, b.depth)
