"""Simulated images as training data: examples, batches, pixel sizes."""

from __future__ import annotations

import os
import signal
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from models.graspnet_data import AtPixelSize, EpochBatches, GraspExamples, epoch_loader
from tests.helpers.compare import same
from utils.augmentation import Augmentation, LabelledImage
from utils.config import load_config
from utils.distributed import ALONE
from utils.errors import UserError

BINS = 18


def test_processes_share_every_batch():
    whole = list(EpochBatches(23, 6, seed=4, epoch=2))
    assert len(whole) == len(EpochBatches(23, 6, seed=4, epoch=2)) == 3  # 5 images are left out
    indices = [index for batch in whole for _, index in batch]
    assert len(set(indices)) == 18 and set(indices) <= set(range(23))
    assert {epoch for batch in whole for epoch, _ in batch} == {2}
    parts = [list(EpochBatches(23, 6, seed=4, epoch=2, rank=rank, ranks=3)) for rank in range(3)]
    for number, batch in enumerate(whole):
        shares = [part[number] for part in parts]
        assert [len(share) for share in shares] == [2, 2, 2]
        assert sorted(sum(shares, [])) == sorted(batch)


def test_epochs_are_shuffled_anew_and_can_be_entered_midway():
    whole = list(EpochBatches(40, 8, seed=1, epoch=0))
    assert whole == list(EpochBatches(40, 8, seed=1, epoch=0))
    assert whole[3:] == list(EpochBatches(40, 8, seed=1, epoch=0, skip=3))
    orders = [
        [index for batch in EpochBatches(40, 8, seed, epoch) for _, index in batch]
        for seed, epoch in ((1, 0), (1, 1), (2, 0))
    ]
    assert all(sorted(order) == list(range(40)) != order for order in orders)
    assert orders[0] != orders[1] != orders[2] != orders[0]


class SentSigterm(list):
    """Numbers, each of which sends SIGTERM to the process that reads it."""

    def __getitem__(self, place):
        os.kill(os.getpid(), signal.SIGTERM)
        return super().__getitem__(place[1])


@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGTERM to ignore")
def test_processes_that_load_leave_sigterm_to_the_main_process():
    """Batch systems send it to all processes of a job."""
    config = load_config(None, ["train.batch_size=2", "train.workers=1"])
    data = SimpleNamespace(train=SentSigterm(range(6)))
    batches = list(epoch_loader(config, data, ALONE, 0, 0))
    assert sorted(torch.cat(batches).tolist()) == list(range(6))


def test_a_checkpoint_of_another_number_of_images_is_not_gone_on_with():
    """Of 10 images an epoch of five steps was half done; there are 30 now, or fewer."""
    config = load_config(None, ["train.batch_size=2", "train.workers=0"])
    data = SimpleNamespace(train=range(6))
    for skip in (-2, 4):
        with pytest.raises(UserError, match=f"lies {skip} steps .* epoch 2, expected 0 to 3: "):
            epoch_loader(config, data, ALONE, 1, skip)
    assert len(epoch_loader(config, data, ALONE, 1, 3)) == 0  # stopped in its last step


def blocks(seed: int, side: int = 64) -> LabelledImage:
    """Blocks up to 10 cm high on a table 0.8 m away, whose quality is their height in decimetres,
    in all bins, and whose red says the same."""
    rng = np.random.default_rng(seed)
    height = np.zeros((side, side), np.float32)
    for _ in range(6):
        row, column = rng.integers(8, side - 14, 2)
        height[row : row + 6, column : column + 6] = rng.integers(1, 11) / 100
    quality = torch.from_numpy(height * 10)
    rgb = torch.zeros(3, side, side, dtype=torch.uint8)
    rgb[0] = (quality * 250).round().to(torch.uint8)
    return LabelledImage(
        rgb,
        torch.from_numpy(0.8 - height),
        quality.expand(BINS, -1, -1).clone(),
        torch.full((BINS, side, side), 0.03),
        torch.ones(side, side, dtype=torch.bool),
    )


IMAGES = [blocks(seed) for seed in range(3)]
CHANGES = Augmentation(turn_step=np.pi / BINS, scale=(0.9, 1.1), max_shift=0.05, colour=None)


@pytest.mark.parametrize("augmentation", [None, CHANGES])
def test_cropped_examples_keep_labels_on_their_pixels(augmentation):
    examples = GraspExamples(IMAGES, 0, 0.3, augmentation, crop=24)
    corners = set()
    for epoch in range(10):
        image, targets = examples[epoch, epoch % 3]
        assert image.shape == (4, 24, 24)
        assert targets.quality.shape == targets.width.shape == (1, 24, 24)
        assert targets.angle.shape == (BINS, 24, 24)
        valid = targets.valid[0] > 0
        # Depth is counted in decimetres from the table's, height in the label's unit.
        torch.testing.assert_close(-image[3][valid], targets.quality[0][valid], atol=1e-5, rtol=0)
        if augmentation is None:  # colours are interpolated when an image is turned
            torch.testing.assert_close(
                (image[0] + 0.5) * 255 / 250, targets.quality[0], atol=1e-5, rtol=0
            )
            assert valid.all()
        assert targets.quality.max() > 0, "a crop shows something to grasp"
        graspable = valid & (targets.quality[0] >= 0.3)
        assert torch.equal(targets.graspable[0] > 0, graspable)
        torch.testing.assert_close(targets.angle, torch.full_like(targets.angle, 1 / BINS))
        assert np.allclose(targets.width[0][graspable], 0.03)
        corners.add(image[3].numpy().tobytes())
    assert len(corners) > 3, "other windows of an image in other epochs"


def test_a_crop_larger_than_the_image_is_the_image():
    image, _ = GraspExamples(IMAGES, 0, 0.3, crop=160)[0, 1]
    whole, _ = GraspExamples(IMAGES, 0, 0.3)[0, 1]
    assert torch.equal(image, whole) and whole.shape == (4, 64, 64)


def test_an_example_is_a_function_of_seed_epoch_and_index():
    def example(seed: int, epoch: int, index: int) -> tuple:
        image, targets = GraspExamples(IMAGES, seed, 0.3, CHANGES, crop=24)[epoch, index]
        return image, *targets

    first = example(3, 1, 2)
    assert same(first, example(3, 1, 2))
    examples = GraspExamples(IMAGES, 3, 0.3, CHANGES, crop=24)
    examples[0, 0], examples[5, 1]  # whatever was asked before
    assert torch.equal(examples[1, 2].image, first[0])
    for other in ((4, 1, 2), (3, 2, 2), (3, 1, 1)):
        assert not torch.equal(example(*other)[0], first[0])


class OneFrame(list):
    """An image of a camera with focal length 100 px, 0.8 m above the table."""

    cameras = ((np.array([[100.0, 0, 31.5], [0, 100.0, 31.5], [0, 0, 1]]), np.eye(4)),)

    def table_distance(self, index: int) -> float:
        return 0.8


def test_images_are_scaled_to_the_pixel_size_of_training():
    flat = blocks(0)
    depth = torch.full((64, 64), 0.8)
    depth[28:36, 28:36] = 0.7  # 8 px of 8 mm
    frame = LabelledImage(flat.rgb, depth, flat.quality, flat.width, flat.mask)
    scaled = AtPixelSize(OneFrame([frame]), metres_per_pixel=0.004)
    assert len(scaled) == 1 and scaled.zoom(0) == pytest.approx(2.0)  # 0.8 / 100 = 8 mm
    near = scaled[0].depth < 0.75
    assert near.sum() == 16 * 16 and near[24:40, 24:40].all()
    assert scaled[0].depth.unique().tolist() == pytest.approx([0.7, 0.8])  # never scaled itself
    # In training the scale goes into the augmentation's own resampling.
    none = Augmentation(
        max_turn=0, max_shift=0, scale=(1, 1), mirror=0, colour=None, depth_noise=None
    )
    plain, changed = (GraspExamples(scaled, 0, 0.3, change)[0, 0] for change in (None, none))
    assert same((plain.image, *plain.targets), (changed.image, *changed.targets))
    half = AtPixelSize(OneFrame([frame]), metres_per_pixel=0.016)
    assert half.zoom(0) == pytest.approx(0.5)
    assert (half[0].depth == 0).sum() == 64 * 64 - 32 * 32  # outside is unknown
    assert not half[0].mask[:16].any()
