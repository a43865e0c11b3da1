"""What of a data set trains and what tests, without leaks: by image, by object, in folds.

This module knows indices and the objects' names alone, no images.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from utils.errors import UserError


@dataclass(frozen=True)
class Split:
    """Indices into a data set, each list sorted; no index is in both."""

    train: tuple[int, ...]
    test: tuple[int, ...]

    def describe(self, names: Sequence[str]) -> str:
        """Two lines with the counts and every name, to be printed: there is no official split."""
        return "\n".join(
            f"{part} ({len(indices)}): {' '.join(names[i] for i in indices)}"
            for part, indices in (("train", self.train), ("test", self.test))
        )


def image_wise_split(count: int, test_fraction: float, seed: int) -> Split:
    """Images drawn at random: test objects may be known from other images in training."""
    order = np.random.default_rng(seed).permutation(count)
    return _split(count, order[: _test_size(count, test_fraction)])


def object_wise_split(object_ids: Sequence[str], test_fraction: float, seed: int) -> Split:
    """Whole objects drawn at random: no test object is seen in training."""
    objects = np.array(sorted(set(object_ids)))
    drawn = np.random.default_rng(seed).permutation(objects)
    test_objects = set(drawn[: _test_size(len(objects), test_fraction)])
    return _split(len(object_ids), [i for i, o in enumerate(object_ids) if o in test_objects])


def block_folds(object_ids: Sequence[str], folds: int, seed: int | None = None) -> list[Split]:
    """k folds for cross-validation; consecutive images of one object are never torn apart.

    A block is a run of equal object ids. Without a seed the blocks keep their order, so each test
    fold is one stretch of the data set; with a seed they are shuffled first. Fold sizes differ by
    as little as whole blocks in that order allow. An object photographed again later makes a
    second block: where that happens, `object_wise_split` is the stricter one.
    """
    starts = [i for i in range(len(object_ids)) if i == 0 or object_ids[i] != object_ids[i - 1]]
    blocks = np.split(np.arange(len(object_ids)), starts[1:])
    if not 2 <= folds <= len(blocks):
        raise UserError(f"folds: got {folds}, expected 2 to {len(blocks)} (the number of blocks)")
    if seed is not None:
        order = np.random.default_rng(seed).permutation(len(blocks))
        blocks = [blocks[i] for i in order]
    ends = np.cumsum([len(block) for block in blocks])
    cuts = [0]
    for k in range(1, folds):  # the border nearest to k / folds of all images; no fold empty
        low, high = cuts[-1] + 1, len(blocks) - (folds - k)
        nearest = np.abs(ends[low - 1 : high] - k * len(object_ids) / folds).argmin()
        cuts.append(low + int(nearest))
    cuts.append(len(blocks))
    return [_split(len(object_ids), np.concatenate(blocks[a:b])) for a, b in zip(cuts, cuts[1:])]


def object_folds(object_ids: Sequence[str], folds: int, seed: int | None = None) -> list[Split]:
    """k folds for cross-validation by object: those of a test image are in no training image.

    As `block_folds`, but with all images of an object in one block, wherever they stand in the data
    set; objects come in the order in which they first appear.
    """
    first: dict[str, int] = {}
    for index, name in enumerate(object_ids):
        first.setdefault(name, index)
    order = sorted(range(len(object_ids)), key=lambda i: first[object_ids[i]])
    splits = block_folds([object_ids[i] for i in order], folds, seed)
    return [_split(len(order), [order[i] for i in split.test]) for split in splits]


def image_folds(count: int, folds: int, seed: int) -> list[Split]:
    """k folds for cross-validation by image, drawn at random: a test image's object may be known
    from training images. Fold sizes differ by at most one."""
    if not 2 <= folds <= count:
        raise UserError(f"folds: got {folds}, expected 2 to {count} (the number of images)")
    order = np.random.default_rng(seed).permutation(count)
    return [_split(count, test) for test in np.array_split(order, folds)]


def _test_size(count: int, fraction: float) -> int:
    """At least one on either side."""
    if count < 2 or not 0 < fraction < 1:
        raise UserError(f"cannot split {count} items with test fraction {fraction}")
    return min(max(round(count * fraction), 1), count - 1)


def _split(count: int, test: Sequence[int]) -> Split:
    chosen = {int(i) for i in test}
    return Split(tuple(i for i in range(count) if i not in chosen), tuple(sorted(chosen)))
