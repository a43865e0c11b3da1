"""Real images with labelled rectangles: views, training examples, the rectangle metric."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from models.rectangle_examples import (
    RectangleExamples,
    RectangleImages,
    best_rectangle,
    judge,
    median_plate_length,
)
from models.rectangle_folds import AUGMENTATION, real_folds
from tests.helpers.real_images import SHAPE, VIEW, sample, write_cornell
from utils.augmentation import LabelledImage, Similarity, apply_similarity
from utils.config import load_config
from utils.real_data import FORMATS
from utils.rectangles import GraspRectangle, View, rectangle_match


class OneGrasp(torch.nn.Module):
    """A network that says the same grasp of every image: pixel (u, v), angle bin, metres."""

    def __init__(self, pixel, angle_bin, metres):
        super().__init__()
        self.pixel, self.angle_bin, self.metres = pixel, angle_bin, metres
        self.anything = torch.nn.Parameter(torch.zeros(1))

    def forward(self, x):
        height, width = x.shape[-2:]
        v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        far = (u - self.pixel[0]) ** 2 + (v - self.pixel[1]) ** 2
        quality = torch.exp(-far / 18.0)[None, None]
        angle = torch.zeros(1, 18, height, width)
        bins = torch.arange(18)
        turn = torch.minimum((bins - self.angle_bin) % 18, (self.angle_bin - bins) % 18)
        angle -= (turn**2 / 2.0)[None, :, None, None]
        return quality, angle, torch.full((1, 1, height, width), self.metres)


# --- Views and examples ---------------------------------------------------------------------


def test_a_view_looks_at_the_middle_of_the_image():
    # 100 of 160 x 120 pixels around the centre (79.5, 59.5) become 50: a pixel is two.
    matrix = VIEW.matrix(SHAPE)
    assert matrix @ [79.5, 59.5, 1] == pytest.approx([24.5, 24.5, 1])
    assert matrix @ [89.5, 49.5, 1] == pytest.approx([29.5, 19.5, 1])
    rgb, depth, rectangles = VIEW.warp(sample(GraspRectangle([89.5, 49.5], 0.4, 20, 10)))
    assert rgb.shape == (50, 50, 3) and depth.shape == (50, 50)
    assert rectangles[0].centre == pytest.approx([29.5, 19.5])
    assert (rectangles[0].width, rectangles[0].height) == pytest.approx((10, 5))
    assert rgb[20, 30].tolist() == [60, 40, 30] and rgb[5, 5].tolist() == [230] * 3


def test_views_are_of_their_cameras_scale():
    # Cornell's Kinect: 2.29 mm a pixel at 1.2 m, three fifths as many in the view.
    assert FORMATS["cornell"].view.metres_per_pixel == pytest.approx(0.0038095, rel=1e-4)


def test_widths_go_from_pixels_to_metres_and_back():
    # 24 px wide in the image are 12 in the view and, at 4 mm a pixel, 48 mm for the network.
    one = sample(GraspRectangle([79.5, 59.5], 0.0, 24, 12))
    examples = RectangleExamples(
        [one], VIEW, AUGMENTATION, seed=0, repeats=4, crop=50, max_width=0.2, graspable_from=0.5
    )
    targets = examples._targets(VIEW.warp(one)[2])
    at_centre = targets.width[0, 24, 24]
    assert at_centre == pytest.approx(0.048)
    back, _ = best_rectangle(OneGrasp((24.5, 24.5), 0, float(at_centre)), one, VIEW, 12.0)
    assert (back.width, back.height) == pytest.approx((24, 12), rel=1e-4)
    assert back.centre == pytest.approx([79.5, 59.5], abs=0.05)


def test_wider_labels_than_the_network_can_tell_count_as_its_widest():
    one = sample(GraspRectangle([79.5, 59.5], 0.0, 24, 12))
    examples = RectangleExamples(
        [one], VIEW, AUGMENTATION, seed=0, repeats=1, crop=50, max_width=0.03, graspable_from=0.5
    )
    assert examples._targets(VIEW.warp(one)[2]).width.max() == pytest.approx(0.03)


def test_examples_show_what_their_targets_say():
    # Wherever chance turns and shifts it, the label lies on the dark bar, which it labels across.
    one = sample(GraspRectangle([85.0, 55.0], 1.0, 30, 16))
    examples = RectangleExamples(
        [one], VIEW, AUGMENTATION, seed=3, repeats=20, crop=40, max_width=0.3, graspable_from=0.5
    )
    assert len(examples) == 20
    covered = []
    for index in range(20):
        example = examples[0, index]
        assert example.image.shape == (4, 40, 40) and example.targets.angle.shape == (18, 40, 40)
        labelled = example.targets.graspable[0] > 0
        dark = example.image[:3].mean(0) < example.image[:3].mean()
        covered.append(dark[labelled].float().mean())
        again = examples[0, index]
        assert torch.equal(example.image, again.image)
    assert np.nanmean(covered) > 0.95


def test_examples_show_the_corners_of_the_view_too():
    # Crops around the label in the middle alone would start at 6 to 23.
    one = sample(GraspRectangle([79.5, 59.5], 0.0, 24, 12))
    examples = RectangleExamples(
        [one], VIEW, AUGMENTATION, seed=0, repeats=1, crop=20, max_width=0.2, graspable_from=0.5
    )
    rng, rectangles = np.random.default_rng(0), VIEW.warp(one)[2]
    starts = {examples._corner(rectangles, rng) for _ in range(400)}
    assert starts >= {(0, 0), (0, 30), (30, 0), (30, 30)}
    assert max(max(start) for start in starts) == 30


def test_labelled_images_have_widths_in_pixels_of_the_view():
    image = RectangleImages([sample(GraspRectangle([79.5, 59.5], 0.0, 24, 12))], VIEW)[0]
    assert image.width_in_pixels and image.width.max() == 12
    assert image.quality[0, 24, 24] == 1


def test_the_border_goes_on_beside_the_image():
    wide = View(side=300, size=60, metres_per_pixel=0.004)
    rgb, depth, _ = wide.warp(sample(GraspRectangle([79.5, 59.5], 0.0, 24, 12)))
    assert rgb[0, 0].tolist() == [230] * 3 and depth[0, 0] == pytest.approx(1.2)


def test_beyond_a_photograph_and_beyond_a_simulated_image_is_the_same():
    """A network that adapts would else tell the domains by their corners."""
    one, turn = sample(GraspRectangle([79.5, 59.5], 0.0, 24, 12)), Similarity(turn=np.pi / 4)
    seen = replace(one, **dict(zip(("rgb", "depth"), VIEW.warp(one))))  # nothing beyond the view
    whole = replace(VIEW, side=50)
    rgb, depth, _ = whole.warp(seen, turn.matrix((50, 50)), border=cv2.BORDER_CONSTANT)
    colours = torch.from_numpy(np.moveaxis(seen.rgb, -1, 0).copy())
    known = torch.from_numpy(seen.depth)
    maps = torch.zeros(18, 50, 50)
    image = LabelledImage(colours, known, maps, maps, torch.ones(50, 50, dtype=torch.bool))
    simulated = apply_similarity(image, turn)
    np.testing.assert_array_equal(depth == 0, simulated.depth == 0)
    assert 0.1 < (depth == 0).mean() < 0.25, "four corners"
    assert (rgb[depth == 0].max(axis=-1) < 230).all()


def test_turned_rectangles_are_turned_exactly():
    change = Similarity(turn=0.35, scale=1.2).matrix((50, 50))
    one = sample(GraspRectangle([79.5, 59.5], 0.25, 24, 12))
    rectangle = VIEW.warp(one, change)[2][0]
    assert rectangle.angle == pytest.approx(0.6)
    assert rectangle.width == pytest.approx(12 * 1.2)


@pytest.mark.parametrize("ranges", [False, True])
def test_a_slanted_table_is_levelled(ranges):
    # A plane 45 degrees from the image, 1 m away in its middle; a box is 10 % nearer than it.
    v, u = (np.mgrid[:120, :160] - np.reshape([60, 80], (2, 1, 1))) / 260
    table = 1 / (1 + v)
    table = table * np.sqrt(1 + u**2 + v**2) if ranges else table
    depth = table.astype(np.float32)
    depth[50:70, 60:90] *= 0.9
    one = replace(sample(GraspRectangle([80, 60], 0.0, 24, 12)), depth=depth)
    seen = VIEW.levelled(one).depth[10:110, 30:130]
    box = np.zeros((120, 160), bool)
    box[50:70, 60:90] = True
    box = box[10:110, 30:130]
    middle = np.median(seen[~box])
    assert seen.dtype == np.float32 and middle == pytest.approx(1.0, abs=0.05)
    assert np.abs(seen[~box] / middle - 1).max() < 0.01
    assert seen[box] / middle == pytest.approx(0.9, abs=0.005)


def test_only_slanted_views_level_their_samples(tmp_path):
    root = write_cornell(tmp_path / "cornell", 4)
    slope = np.linspace(0.9, 1.4, SHAPE[0], dtype=np.float32)[:, None].repeat(SHAPE[1], 1)
    for file in root.glob("*d.tiff"):
        Image.fromarray(slope).save(file)
    config = load_config(None, ["data.kind=cornell", f"data.root={root}", "data.folds=2"])
    fold = real_folds(config)[0]
    for samples in (fold.test_samples, fold.data.train.samples):
        assert np.ptp(samples[0].depth) < 0.05
    assert FORMATS["cornell"].view.slanted and not FORMATS["jacquard"].view.slanted


def test_the_same_rectangle_matches_itself_through_a_view():
    label = GraspRectangle([70.3, 50.2], 2.2, 31, 13)
    there = VIEW.warp(sample(label))[2][0]
    back = there.transformed(np.linalg.inv(VIEW.matrix(SHAPE)))
    assert rectangle_match(back, [label])
    assert back.corners() == pytest.approx(label.corners())


# --- The metric -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "u, angle_bin, correct, iou",
    [
        (79.5, 0, True, 1.0),
        (87.5, 0, True, 1 / 2),  # 24 wide, 8 off: 16 shared of 32
        (92.5, 0, True, 11 / 37),  # 13 off: 11 shared of 37, over a quarter
        (94.5, 0, False, 9 / 39),  # 15 off: under it
        (79.5, 2, True, None),  # 20 degrees
        (79.5, 4, False, None),  # 40 degrees
        (79.5, 16, True, None),  # -20 degrees, across the seam
    ],
)
def test_metric_from_the_networks_maps(u, angle_bin, correct, iou):
    one = sample(GraspRectangle([79.5, 59.5], 0.0, 24, 12))
    model = OneGrasp((24.5 + (u - 79.5) / 2, 24.5), angle_bin, 0.048)
    judged = judge(model, [one], VIEW, 12.0)[0]
    assert judged.correct is correct
    if iou is not None:
        assert judged.iou == pytest.approx(iou, abs=0.01)
    assert np.degrees(judged.angle_error) == pytest.approx(
        10 * min(angle_bin, 18 - angle_bin), abs=1e-3
    )
    assert judged.as_dict()["width_px"] == pytest.approx(24, abs=0.01)


def test_plate_length_is_the_labels_median():
    samples = [sample(GraspRectangle([79.5, 59.5], 0.0, 24, h)) for h in (8, 10, 30)]
    assert median_plate_length(samples) == 10
