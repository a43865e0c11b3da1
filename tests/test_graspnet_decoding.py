"""Peaks of GraspNet's maps, and the metric grasps there."""

import numpy as np
import pytest
import torch

from models.graspnet import GraspNet, targets_from_labels
from models.graspnet_decoding import PeakSettings, decode_grasps, find_peaks, surface_depth
from utils.geometry import GripperGeometry
from utils.grasp_labels import LabelSettings
from utils.transforms import Grasp, angle_difference, grasp_to_image, look_at, project

BINS = 18
HAND = GripperGeometry()
STEP = np.pi / BINS


def circular_gaussian(angle: float, sigma: float) -> np.ndarray:
    """(18,) worth of each bin for a grasp at an angle, over the wrapped line."""
    return np.exp(-0.5 * (angle_difference(np.arange(BINS) * STEP, angle) / sigma) ** 2)


def labels_of(blobs, size: tuple[int, int], sigma: float = 3.0, sigma_angle: float = 0.25):
    """Dense labels (1, 18, H, W) of blobs (u, v, angle, width, worth); of two, the better."""
    v, u = np.mgrid[0 : size[0], 0 : size[1]]
    quality, width = np.zeros((2, BINS, *size))
    for at_u, at_v, angle, opening, worth in blobs:
        near = worth * np.exp(-((u - at_u) ** 2 + (v - at_v) ** 2) / (2 * sigma**2))
        mine = near * circular_gaussian(angle, sigma_angle)[:, None, None]
        width = np.where(mine > quality, opening, width)
        quality = np.maximum(mine, quality)
    return torch.from_numpy(quality)[None].float(), torch.from_numpy(width)[None].float()


def maps_of(blobs, size: tuple[int, int], **shape) -> tuple[torch.Tensor, ...]:
    """The maps of a network that has learnt these labels perfectly."""
    targets = targets_from_labels(*labels_of(blobs, size, **shape))
    return targets.quality, targets.angle.clamp(min=1e-9).log(), targets.width


@pytest.mark.parametrize("degrees", [0.0, 3.0, 7.5, 44.0, 90.0, 174.0, 176.0, 178.9, 179.9])
def test_peaks_are_found_between_pixels_and_between_bins(degrees: float) -> None:
    blobs = [
        (20.3, 31.8, np.deg2rad(degrees), 0.03, 0.9),
        (55.5, 12.2, np.deg2rad(degrees + 61), 0.05, 0.8),
        (60.0, 44.5, np.deg2rad(degrees + 119), 0.07, 0.7),
    ]
    found = find_peaks(*maps_of(blobs, (60, 80)))
    assert len(found.quality) == 3
    for number, (u, v, angle, width, _) in enumerate(blobs):
        assert np.abs(found.pixel[number] - (u, v)).max() < 0.05
        assert np.rad2deg(angle_difference(found.angle[number], angle)) < 1
        assert 0 <= found.angle[number] < np.pi
        assert found.width[number] == pytest.approx(width)
    assert np.all(np.diff(found.quality) < 0)


@pytest.mark.parametrize("sigma", [0.12, 0.2, 0.35, 0.5])
def test_angles_of_narrow_and_wide_distributions(sigma: float) -> None:
    for degrees in np.arange(0, 180, 3.7):
        blob = (10, 10, np.deg2rad(degrees), 0.05, 0.9)
        found = find_peaks(*maps_of([blob], (21, 21), sigma_angle=sigma))
        assert np.rad2deg(angle_difference(found.angle[0], np.deg2rad(degrees))) < 1


def test_of_a_range_of_equally_good_angles_the_middle_is_taken() -> None:
    quality, _, width = maps_of([(10, 10, 0.0, 0.05, 0.9)], (21, 21))
    angle = torch.full((1, BINS, 21, 21), -12.0)
    angle[:, [16, 17, 0, 1, 2]] = 0  # 155 to 25 degrees, across the seam
    found = find_peaks(quality, angle, width)
    assert np.rad2deg(angle_difference(found.angle[0], 0.0)) < 1


def test_an_oblique_ridge_is_still_located() -> None:
    v, u = np.mgrid[0:40, 0:40] - np.array([18.3, 21.6])[:, None, None]
    along, across = (u + v) / np.sqrt(2), (u - v) / np.sqrt(2)
    quality = torch.from_numpy(0.9 * np.exp(-(along**2) / 50 - across**2 / 8))
    found = find_peaks(quality, torch.zeros(BINS, 40, 40), torch.full((40, 40), 0.05))
    assert np.abs(found.pixel[0] - (21.6, 18.3)).max() < 0.05


def test_a_peak_at_the_border_stays_there() -> None:
    quality, angle, width = maps_of([(0, 20, 1.0, 0.05, 0.9)], (40, 30))
    found = find_peaks(quality, angle, width, PeakSettings(blur=0))
    np.testing.assert_allclose(found.pixel, [[0, 20]], atol=1e-3)


def test_at_the_images_edge_and_on_a_plateau() -> None:
    quality = torch.zeros(1, 1, 30, 40)
    quality[0, 0, 0, 0] = 0.9  # a corner
    quality[0, 0, 10:22, 10:30] = 0.7  # as after saturation
    settings = PeakSettings(blur=0)
    found = find_peaks(quality, torch.zeros(1, BINS, 30, 40), 0.05 + 0 * quality, settings)
    assert found.quality[0] == pytest.approx(0.9) and np.abs(found.pixel[0]).max() <= 1
    for i, pixel in enumerate(found.pixel):
        assert all(np.abs(pixel - other).max() > 2 for other in found.pixel[:i])
    assert 2 <= len(found.quality) <= settings.count


def test_nothing_over_the_threshold_is_an_empty_list() -> None:
    K, T_WC, depth = camera(0.0)
    maps = maps_of([(50, 50, 1.0, 0.05, 0.45)], depth.shape)
    assert decode_grasps(*maps, K, T_WC, depth, HAND) == []
    assert len(decode_grasps(*maps, K, T_WC, depth, HAND, peaks=PeakSettings(threshold=0.3))) == 1


def test_busy_and_flat_maps_yield_as_many_grasps_as_asked_for() -> None:
    K, T_WC, depth = camera(0.0, (224, 224))
    torch.manual_seed(0)
    angle, width = torch.randn(1, BINS, 224, 224), torch.full((1, 1, 224, 224), 0.05)
    for quality in (torch.rand(1, 1, 224, 224), torch.full((1, 1, 224, 224), 0.9)):
        found = decode_grasps(quality, angle, width, K, T_WC, depth, HAND)
        assert len(found) == PeakSettings().count


SURFACE = 0.05  # m, height of the plane that the test camera sees


def camera(tilt: float, size: tuple[int, int] = (200, 224)):
    """K, T_WC and the depth of a level surface, seen from above at a tilt in metres."""
    height, width = size
    K = np.array([[450.0, 0, (width - 1) / 2], [0, 450.0, (height - 1) / 2], [0, 0, 1]])
    T_WC = look_at((0.5 - tilt, 0.1 * tilt, 0.8), (0.5, 0.0, 0.0), up=(1, 0, 0))
    v, u = np.mgrid[0:height, 0:width]
    rays = np.stack([(u - K[0, 2]) / 450, (v - K[1, 2]) / 450, np.ones(size)], axis=-1)
    depth = (SURFACE - T_WC[2, 3]) / (rays @ T_WC[2, :3])
    return K, T_WC, depth.astype(np.float32)


# The surface is read off at whole pixels, which on a tilted image is up to 1 mm of depth.
@pytest.mark.parametrize(("tilt", "tolerance"), [(0.0, 2e-4), (0.5, 1e-3)])
def test_grasps_go_through_labels_and_back(tilt: float, tolerance: float) -> None:
    K, T_WC, depth = camera(tilt)
    labels = LabelSettings(depth=0.03)
    random = np.random.default_rng(2)
    wanted = []
    for quality, (x, y) in zip(
        np.linspace(0.95, 0.6, 5),
        ((0.5, 0.0), (0.42, -0.08), (0.57, 0.07), (0.44, 0.09), (0.58, -0.06)),
    ):
        position = (
            x + random.uniform(0, 0.01),
            y + random.uniform(0, 0.01),
            SURFACE - 0.03 + 0.0072,
        )
        width = random.uniform(0.02, 0.07)
        wanted.append(Grasp(position, random.uniform(0, np.pi), width, quality))
    blobs = []
    for grasp in wanted:
        top = Grasp((*grasp.position[:2], SURFACE), grasp.angle, grasp.width, grasp.quality)
        on_image = grasp_to_image(top, K, T_WC)
        blobs.append((*on_image.pixel, on_image.angle, grasp.width, grasp.quality))
    found = decode_grasps(*maps_of(blobs, depth.shape), K, T_WC, depth, HAND, labels=labels)
    assert len(found) == len(wanted)
    for grasp, true in zip(found, wanted):
        assert np.abs(grasp.position - true.position).max() < tolerance
        assert np.rad2deg(angle_difference(grasp.angle, true.angle)) < 1
        assert grasp.width == pytest.approx(true.width, abs=1e-6)


def test_the_fingertips_stay_off_the_table_and_the_hand_within_its_opening() -> None:
    K, T_WC, depth = camera(0.0)
    u, v = project(np.array([0.5, 0.0, SURFACE]), K, T_WC)[0]
    maps = maps_of([(u, v, 0.5, 0.12, 0.9)], depth.shape)
    # The grasp's position lies 7.2 mm over the tips' lowest point.
    for labelled, table, tip in (
        (LabelSettings(depth=0.03), 0.0, SURFACE - 0.03),
        (LabelSettings(depth=0.5, table_clearance=0.004), 0.0, 0.004),
        (LabelSettings(depth=0.5, table_clearance=0.01), 0.02, 0.03),
    ):
        (grasp,) = decode_grasps(*maps, K, T_WC, depth, HAND, table_height=table, labels=labelled)
        assert grasp.position[2] == pytest.approx(tip + 0.0072, abs=2e-4)
        assert grasp.width == HAND.max_opening


def test_surface_depth_ignores_holes_and_a_peak_in_the_dark_is_left_out() -> None:
    depth = np.full((20, 20), 0.7, np.float32)
    depth[9:11, 9:12] = 0
    depth[0:8, 0:8] = np.nan
    found = surface_depth(depth, np.array([[10.2, 9.8], [3.0, 3.0], [19.4, 19.4]]))
    assert found[[0, 2]] == pytest.approx([0.7, 0.7]) and np.isnan(found[1])
    K, T_WC, seen = camera(0.0)
    maps = maps_of([(100, 100, 0.5, 0.05, 0.9)], seen.shape)
    assert decode_grasps(*maps, K, T_WC, np.zeros_like(seen), HAND) == []


def test_predict_grasp_keeps_the_tutorials_dict_and_adds_metric_grasps() -> None:
    K, T_WC, depth = camera(0.0, (64, 80))

    class Known(GraspNet):
        def forward(self, x, logits=False):
            return maps_of([(40, 16, np.deg2rad(70), 0.05, 0.9)], (64, 80))

    model = Known(backbone="ggcnn").train()
    found = model.predict_grasp(torch.zeros(1, 4, 64, 80))
    assert found == pytest.approx(
        {"x": 0.5, "y": 0.25, "theta": 70 / 180, "width": 0.05, "quality": 0.9}
    )
    assert model.training
    found = model.predict_grasp(torch.zeros(1, 4, 64, 80), K, T_WC, depth)
    (grasp,) = found["grasps"]
    assert project(grasp.position, K, T_WC)[0] == pytest.approx((40, 16), abs=0.5)
    with pytest.raises(ValueError, match="batch of 2"):
        model.predict_grasp(torch.zeros(2, 4, 64, 80))


def test_between_two_surfaces_the_nearer_one_counts() -> None:
    """Of two known depths around a pixel the median is the smaller one."""
    depth = np.zeros((5, 5), np.float32)
    depth[1, 1], depth[3, 3] = 0.6, 0.5
    assert surface_depth(depth, np.array([[2.0, 2.0]])) == pytest.approx([0.5])
