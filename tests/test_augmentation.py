"""Augmentation: the labels of the changed image are the changed labels, in closed form."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from utils.augmentation import (
    Augmentation,
    ColourJitter,
    LabelledImage,
    Similarity,
    apply_similarity,
    turn_bins,
)
from utils.rectangles import GraspRectangle, rasterise
from utils.transforms import Grasp, angle_difference, grasp_to_image, look_at

BIN = np.pi / 18
SIZE = 61
METRES_PER_PIXEL = 0.002
LABELS = [
    GraspRectangle(np.array([40.0, 22.0]), 2 * BIN, 24, 12),
    GraspRectangle(np.array([18.0, 35.0]), 17 * BIN, 18, 9),
]


def labelled(rectangles=LABELS, shape=(SIZE, SIZE)) -> LabelledImage:
    """The labelled pixels are white on black and nearer to the camera than the table. Labels are
    hard: each is in its nearest bin alone."""
    quality, width = (torch.from_numpy(x) for x in rasterise(rectangles, shape))
    hard = quality == 1
    quality, width = hard.float(), width * hard
    painted = quality.amax(0)
    return LabelledImage(
        rgb=(255 * painted).to(torch.uint8).expand(3, -1, -1).contiguous(),
        depth=0.8 - 0.05 * painted,
        quality=quality,
        width=width * METRES_PER_PIXEL,
        mask=torch.ones(shape, dtype=torch.bool),
    )


def scene_after(change: Similarity, shape=(SIZE, SIZE)) -> LabelledImage:
    """The picture of the changed scene, drawn afresh; widths in metres are the objects' own."""
    moved = [r.transformed(change.matrix(shape)) for r in LABELS]
    scene = labelled(moved, shape)
    return replace(scene, width=scene.width / change.scale)


def equal(a: LabelledImage, b: LabelledImage) -> bool:
    return all(
        torch.equal(getattr(a, name), getattr(b, name))
        for name in ("rgb", "depth", "quality", "width", "mask")
    )


@pytest.mark.parametrize("mirror", [False, True])
@pytest.mark.parametrize("quarters", [0, 1, 2, 3, -1])
@pytest.mark.parametrize("shape", [(SIZE, SIZE), (60, 60)])
def test_quarter_turns_and_mirroring_are_exact(quarters, mirror, shape):
    change = Similarity(turn=quarters * np.pi / 2, mirror=mirror)
    assert equal(apply_similarity(labelled(shape=shape), change), scene_after(change, shape))


@pytest.mark.parametrize("mirror", [False, True])
@pytest.mark.parametrize("turn_bins_by, scale", [(3, 1), (-3, 1), (1, 1), (7, 1.5), (3, 0.8)])
def test_turned_scene_up_to_the_rim(turn_bins_by, scale, mirror):
    """30 degrees and others: right bins and widths; only pixels on the labels' rims may differ."""
    change = Similarity(turn_bins_by * BIN, (3.0, -2.0), scale, mirror)
    found, expected = apply_similarity(labelled(), change), scene_after(change)
    assert set(found.quality.unique().tolist()) == {0.0, 1.0}  # whole bins: still hard labels
    for k in range(18):
        a, b = found.quality[k] > 0, expected.quality[k] > 0
        assert a.any() == b.any()
        if b.any():
            assert (a & b).sum() / (a | b).sum() > 0.75
            assert torch.allclose(found.width[k][a & b], expected.width[k][a & b])
    on_label, seen = found.quality.amax(0) > 0, found.rgb[0] > 127
    assert (on_label & seen).sum() / (on_label | seen).sum() > 0.9  # picture and labels agree
    assert torch.equal(found.depth == 0.75, on_label)
    assert torch.equal(found.mask, found.depth > 0)


def test_four_quarter_turns_are_the_identity():
    rng = np.random.default_rng(0)
    noise = LabelledImage(
        torch.from_numpy(rng.integers(0, 256, (3, 20, 20), dtype=np.uint8)),
        torch.from_numpy(rng.random((20, 20), dtype=np.float32)),
        torch.from_numpy(rng.random((18, 20, 20), dtype=np.float32)),
        torch.from_numpy(rng.random((18, 20, 20), dtype=np.float32)),
        torch.from_numpy(rng.random((18, 20, 20)) < 0.5),
    )
    turned = noise
    for _ in range(4):
        turned = apply_similarity(turned, Similarity(turn=np.pi / 2))
    assert equal(turned, noise)
    flipped = apply_similarity(noise, Similarity(mirror=True))
    assert equal(apply_similarity(flipped, Similarity(mirror=True)), noise)
    assert equal(apply_similarity(noise, Similarity()), noise)


def one_bin(k: int, width: float = 0.05, pixel_mask: bool = True) -> tuple[torch.Tensor, ...]:
    quality, widths = torch.zeros(18, 1), torch.zeros(18, 1)
    quality[k], widths[k] = 1, width
    mask = torch.ones(1 if pixel_mask else 18, 1, dtype=torch.bool)
    return quality, widths, mask


@pytest.mark.parametrize(
    "k, degrees, expected",
    [
        (2, 30, {5: 1.0}),
        (2, 4, {2: 0.6, 3: 0.4}),  # 24 degrees lies between the bins of 20 and 30
        (17, 4, {17: 0.6, 0: 0.4}),  # 174, over the seam
        (0, -4, {0: 0.6, 17: 0.4}),
        (16, 27, {0: 0.3, 1: 0.7}),  # 187 = 7
        (5, 180, {5: 1.0}),
        (5, 365, {5: 0.5, 6: 0.5}),
    ],
)
def test_bins_turn_on_the_circle(k, degrees, expected):
    quality, width, _ = turn_bins(*one_bin(k), np.radians(degrees))
    by_bin = np.zeros(18)
    by_bin[list(expected)] = list(expected.values())
    assert quality[:, 0].numpy() == pytest.approx(by_bin, abs=1e-5)
    assert width[list(expected), 0].numpy() == pytest.approx(0.05)  # no zero of a neighbour


@pytest.mark.parametrize("k", range(18))
def test_mirroring_takes_an_angle_to_pi_minus_it(k):
    quality, width, _ = turn_bins(*one_bin(k), 0.0, mirror=True)
    expected = round((np.pi - k * BIN) / BIN) % 18
    assert quality[:, 0].argmax() == width[:, 0].argmax() == expected


def test_widths_are_mixed_by_quality_and_masks_need_both_bins():
    quality, width, mask = one_bin(3, pixel_mask=False)
    quality[4], width[4], mask[8] = 0.5, 0.02, False
    quality, width, mask = turn_bins(quality, width, mask, np.radians(2))
    assert quality[4, 0] == pytest.approx(0.8 * 0.5 + 0.2 * 1)
    assert width[4, 0] == pytest.approx((0.4 * 0.02 + 0.2 * 0.05) / 0.6)
    assert torch.where(~mask[:, 0])[0].tolist() == [8, 9]


@pytest.mark.parametrize("turn", np.radians([90, 30, -50]))
def test_turning_is_rolling_the_camera(turn):
    """A grasp seen by a camera rolled by -turn about its axis: pixel and image angle as changed."""
    K = np.array([[300, 0, 30], [0, 300, 30], [0, 0, 1.0]])
    T_WC = look_at((0.5, 0, 0.8), (0.55, 0.05, 0), up=(1, 0, 0))
    roll = np.eye(4)
    c, s = np.cos(turn), np.sin(turn)
    roll[:2, :2] = [[c, s], [-s, c]]  # the camera turns one way, its picture the other
    grasp = Grasp(np.array([0.52, 0.03, 0.02]), 0.4, 0.05, 1.0)
    before, after = grasp_to_image(grasp, K, T_WC), grasp_to_image(grasp, K, T_WC @ roll)
    matrix = Similarity(turn=turn).matrix((61, 61))
    assert matrix @ [*before.pixel, 1] == pytest.approx([*after.pixel, 1])
    assert angle_difference(before.angle + turn, after.angle) == pytest.approx(0, abs=1e-9)
    assert (before.depth, before.width) == pytest.approx((after.depth, after.width))


def test_scaling_changes_widths_in_pixels_but_not_in_metres():
    """A focal length 1.5 times as long: 0.04 m at 0.8 m spans f w / z = 15, then 22.5 px."""
    K = np.array([[300, 0, 30], [0, 300, 30], [0, 0, 1.0]])
    change = Similarity(scale=1.5)
    K_after = change.matrix((61, 61)) @ K
    tips = np.array([[-0.02, 0, 0.8], [0.02, 0, 0.8]])
    spans = [np.ptp((tips @ k.T)[:, 0] / 0.8) for k in (K, K_after)]
    assert spans == pytest.approx([15, 22.5])
    metric = labelled()
    pixels = replace(metric, width=metric.width / METRES_PER_PIXEL, width_in_pixels=True)
    metric_after, pixels_after = (apply_similarity(x, change) for x in (metric, pixels))
    assert metric_after.width.amax() == pytest.approx(24 * METRES_PER_PIXEL)
    assert pixels_after.width.amax() == pytest.approx(36)
    assert metric_after.depth[30, 30] == metric.depth[30, 30]
    assert (metric_after.quality.sum() / metric.quality.sum()).item() == pytest.approx(
        1.5**2, rel=0.1
    )


def test_shift_leaves_unknown_behind():
    image = labelled()
    shifted = apply_similarity(image, Similarity(shift=(5.0, -3.0)))
    for name in ("rgb", "depth", "quality", "width"):
        a, b = getattr(shifted, name), getattr(image, name)
        assert torch.equal(a[..., :-3, 5:], b[..., 3:, :-5])
    unknown = ~shifted.mask
    assert unknown[-3:].all() and unknown[:, :5].all() and not unknown[:-3, 5:].any()
    assert (shifted.depth[unknown] == 0).all()


def test_augmentation_depends_on_its_generator_alone():
    image, before = labelled(), torch.get_rng_state()
    augment = Augmentation(depth_noise=lambda depth, rng, rgb: depth + rng.normal())
    one, same, other = (augment(image, np.random.default_rng(s)) for s in (1, 1, 2))
    assert equal(one, same) and not equal(one, other)
    assert torch.equal(torch.get_rng_state(), before)
    assert equal(image, labelled())  # the original is untouched


def test_augmentation_draws_within_its_ranges():
    rng = np.random.default_rng(0)
    augment = Augmentation(max_turn=0.6, max_shift=0.1, scale=(0.5, 2.0), turn_step=BIN)
    drawn = [augment.draw(rng, (100, 200)) for _ in range(500)]
    turns = np.array([d.turn for d in drawn]) / BIN
    assert turns == pytest.approx(np.rint(turns)) and set(np.rint(turns)) == set(range(-3, 4))
    assert 19 < max(d.shift[0] for d in drawn) <= 20 and 9 < max(d.shift[1] for d in drawn) <= 10
    assert 0.5 <= min(d.scale for d in drawn) < 0.51 < 1.9 < max(d.scale for d in drawn) <= 2
    assert 0.4 < np.mean([d.mirror for d in drawn]) < 0.6


def test_colour_jitter_moves_colours_only():
    image = labelled()
    image = replace(image, rgb=image.rgb // 2 + 40)
    augment = Augmentation(0.0, None, 0.0, (1.0, 1.0), 0.0, ColourJitter())
    after = augment(image, np.random.default_rng(0))
    assert after.rgb.dtype == torch.uint8 and not torch.equal(after.rgb, image.rgb)
    assert equal(replace(after, rgb=image.rgb), image)
    plain = ColourJitter(0, 0, 0, 0)
    assert torch.equal(plain(image.rgb, np.random.default_rng(0)), image.rgb)


@pytest.mark.parametrize(
    "wrong",
    [
        dict(rgb=torch.zeros(4, SIZE, SIZE, dtype=torch.uint8)),
        dict(width=torch.zeros(17, SIZE, SIZE)),
        dict(mask=torch.ones(SIZE, SIZE)),
        dict(depth=torch.zeros(1, SIZE, SIZE)),
    ],
)
def test_wrong_shapes_are_refused(wrong):
    with pytest.raises(ValueError, match="LabelledImage"):
        replace(labelled(), **wrong)


@pytest.mark.parametrize("mirror", [False, True])
@pytest.mark.parametrize("turn, scale, shift", [(0.0, 1.0, (4.0, -3.0)), (0.7, 1.2, (2.0, 5.0))])
def test_centres_go_where_their_object_goes(turn, scale, shift, mirror):
    """By hand: from the middle (30, 30), first mirrored, then turned clockwise and scaled."""
    image = labelled()
    centre = torch.full((2, SIZE, SIZE), torch.nan)
    centre[:, 20:25, 36:45] = torch.tensor([40.0, 22.0])[:, None, None]
    image = replace(image, centre=centre)
    found = apply_similarity(image, Similarity(turn, shift, scale, mirror)).centre
    du, dv = -10.0 if mirror else 10.0, -8.0
    c, s = np.cos(turn), np.sin(turn)
    expected = 30 + scale * (c * du - s * dv) + shift[0], 30 + scale * (s * du + c * dv) + shift[1]
    on = found[0].isfinite()
    assert on.sum() == pytest.approx(45 * scale**2, rel=0.2)
    assert found[0][on].numpy() == pytest.approx(expected[0], abs=1e-4)
    assert found[1][on].numpy() == pytest.approx(expected[1], abs=1e-4)
    # The object's own middle lies there, whatever was done to it.
    v, u = torch.nonzero(on, as_tuple=True)
    assert (float(u.float().mean()), float(v.float().mean())) == pytest.approx(expected, abs=0.7)
