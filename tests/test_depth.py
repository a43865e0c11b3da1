"""Noises of depth images against loops over pixels, closed forms and in the cell."""

import cv2
import numpy as np
import pytest
import torch

from benchmarks.depth_loops import FB, by_loops, steps_and_slopes
from envs.cell_scenes import make_scene
from envs.objects import load_object_set
from envs.registries import check_names
from envs.simulators import make_cell
from models.graspnet_data import NoisyShare
from utils.config import ConfigError, changed_keys, load_config, with_settings
from utils.depth import (
    DEPTH_NOISES,
    GammaNoise,
    GaussianNoise,
    KinectNoise,
    RealSenseNoise,
    make_depth_noise,
    seeded_noise,
)
from utils.errors import UserError
from utils.random_streams import Stream


def plane(depth: float, side: int = 224) -> np.ndarray:
    return np.full((side, side), depth, dtype=np.float32)


def test_array_code_measures_what_the_loops_over_pixels_measure():
    """How much faster it is, `benchmarks.bench_sim2real` measures."""
    noise, depth = KinectNoise(), steps_and_slopes(112)
    expected = by_loops(noise, depth, np.random.default_rng(3))
    measured = noise(depth, np.random.default_rng(3))
    np.testing.assert_array_equal(expected == 0, measured == 0)
    # Rounding in single precision may tip a disparity that lies between two steps.
    same = np.isclose(measured, expected, rtol=1e-6)
    assert (~same).mean() < 1e-3
    one_step = 0.81**2 / FB / 8
    assert abs(measured - expected)[~same].max(initial=0) < one_step
    assert 0.01 < (expected == 0).mean() < 0.5  # there was something to get wrong


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


def seeded(noise, depth: np.ndarray) -> np.ndarray:
    """The measured image, which depends on the seed alone; the noise leaves its input alone."""
    before = depth.copy()
    first = noise(depth, np.random.default_rng(5))
    assert first.dtype == np.float32 and first.shape == depth.shape
    np.testing.assert_array_equal(first, noise(depth, np.random.default_rng(5)))
    assert (first != noise(depth, np.random.default_rng(6))).any()
    np.testing.assert_array_equal(depth, before)
    return first


def test_a_seed_gives_one_image_of_kinect_noise_and_the_input_is_left_alone():
    noise, depth = KinectNoise(), steps_and_slopes()
    seeded(noise, depth)


def test_the_generator_advances_alike_whatever_is_seen():
    after = []
    for depth in (plane(0.8), steps_and_slopes(), plane(0.0)):
        rng = np.random.default_rng(0)
        KinectNoise()(depth, rng)
        after.append(rng.random())
    assert len(set(after)) == 1


@pytest.mark.parametrize(
    "wrong",
    [
        {"focal": 0}, {"image_focal": np.nan}, {"noise": -1}, {"window": 8}, {"step": 0},
        {"window": 33}, {"support": 1}, {"support": np.nan}, {"support": "high"},
        {"shift": np.inf}, {"baseline": np.inf},
    ],
)  # fmt: skip
def test_wrong_parameters_are_refused(wrong):
    with pytest.raises(ValueError, match=f"KinectNoise.{next(iter(wrong))}"):
        KinectNoise(**wrong)


@pytest.mark.parametrize("shape", [(3, 32, 32), (8, 32)])
def test_wrong_shapes_are_refused(shape):
    with pytest.raises(ValueError, match=r"\(H, W\)"):
        KinectNoise()(np.ones(shape), np.random.default_rng(0))
    with pytest.raises(
        UserError, match=r"at least 31 pixels .* got \(16, 16\); take larger images"
    ):
        KinectNoise(window=31)(np.ones((16, 16)), np.random.default_rng(0))


def test_a_share_of_the_training_images_is_measured():
    """Alike whether the noise is applied to an array or to a tensor of the training."""
    noise, depth = KinectNoise(), torch.from_numpy(steps_and_slopes(64))
    rng = np.random.default_rng(0)
    rgb = torch.zeros(3, 64, 64, dtype=torch.uint8)
    measured = NoisyShare(1.0, (noise,))(depth, rng, rgb)
    rng = np.random.default_rng(0)
    rng.random(), rng.integers(1)  # whether this image is one of the share, and its noise
    np.testing.assert_array_equal(measured.numpy(), noise(depth.numpy(), rng))
    assert measured.dtype == torch.float32 and (depth == 0).any()
    assert NoisyShare(0.0, (noise,))(depth, rng, rgb) is depth
    assert NoisyShare(1.0, ())(depth, rng, rgb) is depth
    both, found = NoisyShare(1.0, (lambda d, r: d + 1, lambda d, r: d + 2)), set()
    for _ in range(20):
        found.add(float((both(depth, rng, rgb) - depth).median()))
    assert sorted(found) == pytest.approx([1.0, 2.0])


# --- Active stereo and Dex-Net's noise --------------------------------------------------------


def spread_and_correlation(field: np.ndarray, apart: int) -> tuple[float, float]:
    """Standard deviation, and correlation of values `apart` pixels apart along both axes."""
    field = field.astype(float) - field.mean()
    pairs = (field[:, apart:] * field[:, :-apart]).mean(), (field[apart:] * field[:-apart]).mean()
    return field.std(), float(np.mean(pairs) / field.var())


@pytest.mark.parametrize("z", [0.4, 0.8, 1.6])
def test_active_stereo_errs_by_the_square_of_the_distance(z):
    """Intel's formula with its D435: 1.2 mm at 0.57 m, 2.4 mm at 0.8 m; D415: 0.93 mm at 0.8 m."""
    errors = RealSenseNoise()(plane(z, 400), np.random.default_rng(0)) - z
    spread, correlation = spread_and_correlation(errors, 2)
    assert spread == pytest.approx(z**2 * 0.08 / (424 * 0.05), rel=0.04)
    assert abs(errors.mean()) < 0.1 * spread
    assert correlation == pytest.approx(np.exp(-(2**2) / (2 * 2.5**2)), abs=0.03)
    d415 = RealSenseNoise(1005, focal=1005, baseline=0.055)
    ratio = (d415(plane(z, 400), np.random.default_rng(1)) - z).std() / spread
    assert ratio == pytest.approx(424 * 0.05 / (1005 * 0.055), rel=0.08)


def test_active_stereo_correlates_over_the_same_angle_at_every_resolution():
    errors = RealSenseNoise(image_focal=848)(plane(0.8, 500), np.random.default_rng(0))
    assert spread_and_correlation(errors, 4)[1] == pytest.approx(np.exp(-4 / 12.5), abs=0.04)


def test_a_shadow_lies_on_the_left_as_wide_as_the_step_in_disparity():
    depth = plane(0.8, 120)
    depth[40:80, 60:90] = 0.6
    noise = RealSenseNoise(subpixel=0, grazing=90)
    hole = noise(depth, np.random.default_rng(0)) == 0
    width = 424 * 0.05 * (1 / 0.6 - 1 / 0.8)  # 8.8 pixels
    rows, cols = np.nonzero(hole)
    assert set(rows) == set(range(40, 80)) and cols.max() == 59
    assert len(rows) / 40 == pytest.approx(width, abs=1)


def test_pixels_are_lost_on_dark_shiny_and_grazing_surfaces():
    """The share lost is the probability that the docstring states."""
    noise, depth = RealSenseNoise(), plane(0.8, 300)

    def share_lost(level: int | tuple[int, int, int]) -> float:
        rgb = np.full((300, 300, 3), level, np.uint8)
        return float((noise(depth, np.random.default_rng(2), rgb) == 0).mean())

    assert [share_lost(level) for level in (40, 128, 250)] == [0, 0, 0]
    assert share_lost(0) == share_lost(255) == 1
    assert share_lost(20) == pytest.approx(0.5, abs=0.03)
    assert share_lost(10) == pytest.approx(0.75, abs=0.03)
    assert share_lost(252) == pytest.approx(0.4, abs=0.03)
    assert share_lost((255, 255, 0)) == share_lost((255, 0, 0)) == 0  # no reflection, not dark
    assert share_lost((0, 0, 255)) == pytest.approx(1 - 0.114 * 255 / 40, abs=0.03)
    assert (noise(depth, np.random.default_rng(2)) > 0).all()  # no colours, nothing dark

    def tilted(degrees: float) -> np.ndarray:
        """A plane turned about the image's rows: 1 / z is linear in the column."""
        u = np.arange(200) - 99.5
        inverse = (1 - np.tan(np.radians(degrees)) * u / 424) / 0.8
        return np.broadcast_to(1 / inverse, (200, 200)).astype(np.float32)

    holes = RealSenseNoise(baseline=1e-6, subpixel=0)  # no shadows, no errors
    middle = np.s_[:, 90:110]
    for degrees, share in ((0, 0.0), (65, 0.0), (75, 0.25), (80, 0.5)):
        lost = [
            (holes(tilted(degrees), np.random.default_rng(seed))[middle] == 0).mean()
            for seed in range(20)
        ]
        assert np.mean(lost) == pytest.approx(share, abs=0.05)


def test_gamma_noise_has_the_mean_and_variance_of_dex_net():
    factors = [
        GammaNoise(sigma=0)(plane(0.5, 2), np.random.default_rng(seed))[0, 0] / 0.5
        for seed in range(20_000)
    ]
    assert np.mean(factors) == pytest.approx(1, abs=3 * np.sqrt(1e-3 / 20_000))
    assert np.var(factors) == pytest.approx(1e-3, rel=0.04)
    error = GammaNoise(shape=1e14)(plane(0.7, 500), np.random.default_rng(0)) - 0.7
    spread, correlation = spread_and_correlation(error, 2)
    assert spread == pytest.approx(0.005, rel=0.02)
    assert correlation == pytest.approx(np.exp(-1), abs=0.02)  # d^2 / (2 l^2) = 4 / 4
    assert spread_and_correlation(error, 6)[1] == pytest.approx(0, abs=0.02)


def test_gaussian_noise_is_independent_and_the_same_at_every_distance():
    for distance in (0.3, 1.2):
        error = GaussianNoise()(plane(distance, 500), np.random.default_rng(0)) - distance
        spread, correlation = spread_and_correlation(error, 1)
        assert spread == pytest.approx(0.0008, rel=0.01)
        assert correlation == pytest.approx(0, abs=0.01)
        assert abs(error.mean()) < 4 * 0.0008 / 500
    # By Gauss's own table, 31.7 % lie outside of one standard deviation and 4.55 % outside of two.
    for sigmas, share in ((1, 0.317), (2, 0.0455)):
        assert (abs(error) > sigmas * 0.0008).mean() == pytest.approx(share, abs=0.005)


def test_scenes_have_noise_of_their_own():
    """Drawn from the scene's seed, the image's number and the stream."""
    stream, clean = Stream.PLANNING_NOISE, plane(0.7, 500)
    one, other = (
        seeded_noise(GaussianNoise(), stream, seed, 0)(clean, None) - clean for seed in (1, 2)
    )
    drawn = np.random.default_rng([1, 0, stream]).standard_normal((500, 500), np.float32)
    np.testing.assert_allclose(one, 0.0008 * drawn, atol=2e-7)
    assert abs(np.corrcoef(one.ravel(), other.ravel())[0, 1]) < 0.01


@pytest.mark.parametrize("noise", [RealSenseNoise(), GammaNoise(), GaussianNoise()])
def test_every_noise_is_seeded_keeps_its_input_and_the_unknown(noise):
    depth = steps_and_slopes(64)
    first = seeded(noise, depth)
    assert not first[depth == 0].any() and np.isfinite(first).all() and (first >= 0).all()
    assert not noise(np.full((32, 32), np.nan), np.random.default_rng(0)).any()
    with pytest.raises(ValueError, match=r"\(H, W\)"):
        noise(np.ones((3, 4, 5)), np.random.default_rng(0))
    after = []
    for seen in (plane(0.8, 64), depth, plane(0.0, 64)):
        rng = np.random.default_rng(0)
        noise(seen, rng)
        after.append(rng.random())
    assert len(set(after)) == 1  # the generator advances alike whatever is seen


@pytest.mark.parametrize(
    ("name", "wrong", "message"),
    [
        ("realsense", {"baseline": 0}, "RealSenseNoise.baseline must be > 0"),
        ("realsense", {"dark": 300}, r"RealSenseNoise.dark must be in \[0, 255\], got 300"),
        ("realsense", {"subpixel": -1}, "RealSenseNoise.subpixel must be in"),
        ("gamma", {"shape": 0}, "GammaNoise.shape must be > 0"),
        ("gamma", {"sigma": -1}, "GammaNoise.sigma must be >= 0"),
        ("gaussian", {"sigma": -1}, "GaussianNoise.sigma must be >= 0"),
        ("realsense", {"subpixel": np.inf}, "RealSenseNoise.subpixel must be a finite number"),
        ("gamma", {"shape": np.inf}, "GammaNoise.shape must be a finite number, got inf"),
        ("gaussian", {"sigma": None}, "GaussianNoise.sigma must be a finite number, got None"),
        # Of images of 480 pixels' focal length: 9 x 480 / 1, and 200 x 480 / 424.
        ("kinect", {"focal": 1}, "window would span 4320 pixels of the image"),
        ("realsense", {"correlation": 200}, "correlation is 226.4 pixels of the image, .* 200"),
    ],
)
def test_wrong_parameters_of_a_profile_are_refused(name, wrong, message):
    with pytest.raises(UserError, match=message):
        make_depth_noise(name, 480.0, wrong)


def test_training_shows_colours_to_the_noise():
    rgb = torch.full((3, 64, 64), 128, dtype=torch.uint8)
    rgb[:, :32] = 0
    depth = torch.full((64, 64), 0.8)
    measured = NoisyShare(1.0, (RealSenseNoise(),))(depth, np.random.default_rng(0), rgb)
    assert not measured[:32].any() and (measured[32:] > 0).all()


def gaussian(image_focal: float, sigma: float = 0.001):
    """A depth noise of one's own, as a user writes it in a module of theirs."""
    return lambda depth, rng: depth + sigma * rng.standard_normal(depth.shape, np.float32)


def test_a_noise_is_made_by_name_by_import_path_or_not_at_all():
    assert make_depth_noise("none", 480.0, {"ignored": 1}) is None
    assert make_depth_noise("kinect", 390.0, {"step": 0.25}) == KinectNoise(390.0, step=0.25)
    assert set(DEPTH_NOISES) == {"kinect", "realsense", "gamma", "gaussian"}
    own = make_depth_noise("tests.test_depth:gaussian", 480.0, {"sigma": 0.1})
    assert own(plane(0.8), np.random.default_rng(0)).std() == pytest.approx(0.1, rel=0.02)


@pytest.mark.parametrize(
    ("name", "arguments", "message"),
    [
        (
            "kinec",
            {},
            "gamma, gaussian, kinect, module:name, none, realsense; did you mean kinect",
        ),
        ("builtins:int", None, "depth_noise: 'builtins:int': .*image_focal"),
        ("kinect", {"nois": 1}, "depth_noise_args: 'kinect' does not take them.*'nois'"),
        ("kinect", {"noise": -1}, "KinectNoise.noise must be >= 0"),
        ("tests.test_depth:nothing", {}, "has no 'nothing'"),
        ("tests.test_depth:test_a_plane_has_holes_at_the_image_border_only", {}, "image_focal"),
        ("builtins:dict", {}, "returned a dict, expected a callable"),
    ],
)
def test_what_makes_no_noise_is_refused_in_one_sentence(name, arguments, message):
    with pytest.raises(UserError, match=message):
        make_depth_noise(name, 480.0, arguments)


def test_the_configs_noise_is_checked_by_name_and_arguments():
    chosen = ["camera.depth_noise=kinect", "camera.depth_noise_args={noise: 0.3}"]
    config = load_config(None, chosen)
    assert config.camera.depth_noise_args == {"noise": 0.3}
    assert load_config(None, changed_keys(config)) == config and hash(config)
    with pytest.raises(UserError, match=r"camera.depth_noise_args: 'kinect'.*nois"):
        check_names(load_config(None, [chosen[0], "camera.depth_noise_args={nois: 0.3}"]))
    with pytest.raises(ConfigError, match="depth_noise_args would be ignored"):
        load_config(None, ["camera.depth_noise_args={noise: 0.3}"])
    with pytest.raises(ConfigError, match=r"camera.depth_noise_args: got 3 .*expected"):
        load_config(None, ["camera.depth_noise_args=3"])


@pytest.fixture(scope="module")
def frames(config):
    """Two frames of a scene with and without noise, and again after other work."""
    objects = load_object_set("primitives", cache_dir=config.cache_folder)
    noisy = with_settings(config, "camera", {"depth_noise": "kinect"})
    own = {"depth_noise": "tests.test_depth:gaussian", "depth_noise_args": {"sigma": 0.01}}
    scene, other = (make_scene("pile", objects, seed, config) for seed in (1, 2))
    with make_cell(config) as cell:
        cell.load(scene)
        clean = [cell.frame(with_truth=True), cell.frame()]
    with make_cell(noisy) as cell:
        cell.load(scene)
        first = [cell.frame(with_truth=True), cell.frame()]
        cell.load(other)
        cell.frame()
        cell.load(scene)
        again = [cell.frame(), cell.frame()]
    with make_cell(with_settings(config, "camera", own)) as cell:
        cell.load(scene)
        spread = [cell.frame()]
    return clean, first, again, spread


def test_cell_measures_with_noise(frames):
    clean, noisy, _, _ = frames
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
    _, noisy, again, _ = frames
    assert (noisy[0].depth != noisy[1].depth).any()
    for a, b in zip(noisy, again):
        np.testing.assert_array_equal(a.depth, b.depth)


def test_cell_measures_with_a_noise_of_ones_own(frames):
    clean, _, _, own = frames
    assert (own[0].depth - clean[0].depth).std() == pytest.approx(0.01, rel=0.02)


# --- Holes ----------------------------------------------------------------------------------
