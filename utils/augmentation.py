"""Turning, shifting, scaling and mirroring an RGB-D image together with its dense grasp labels.

Image, depth, mask, angle bins and widths move together, so that the labels of the changed image
are the changed labels. Angles are image angles of the closing line, from +u (right) towards +v
(down), modulo pi; bin k of B is centred at k x pi / B. torchvision resamples; it is imported where
it is used, because its import takes seconds and only a training needs it. This module knows no data
set, no network and no simulator.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import torch

# depth (H, W) metres, a generator, rgb (3, H, W) uint8 -> depth
TensorNoise = Callable[[torch.Tensor, np.random.Generator, torch.Tensor], torch.Tensor]


@dataclass(frozen=True, eq=False)
class LabelledImage:
    """One RGB-D image with dense labels, as tensors.

    rgb: (3, H, W) uint8. depth: (H, W) float32 metres, 0 means unknown. quality: (B, H, W) float32
    in [0, 1]. width: (B, H, W) float32, the opening, metres. mask: (H, W) or (B, H, W) bool, where
    labels hold. centre: (2, H, W) float32, the pixel (u, v) of the centre of mass of the object
    seen, NaN where no object is seen; None if unknown. width_in_pixels: the widths are pixels of
    this image instead of metres (rasterised rectangles).
    """

    rgb: torch.Tensor
    depth: torch.Tensor
    quality: torch.Tensor
    width: torch.Tensor
    mask: torch.Tensor
    centre: torch.Tensor | None = None
    width_in_pixels: bool = False

    def __post_init__(self) -> None:
        size = tuple(self.depth.shape)
        bins = (self.quality.shape[0], *size)
        allowed = {
            "rgb": [(3, *size)], "depth": [size], "quality": [bins], "width": [bins],
            "mask": [size, bins], "centre": [(2, *size)],
        }  # fmt: skip
        for name, shapes in allowed.items():
            if name == "centre" and self.centre is None:
                continue
            shape = tuple(getattr(self, name).shape)
            if len(size) != 2 or shape not in shapes:
                raise ValueError(f"LabelledImage.{name}: shape {shape} with depth {size}")
        if self.rgb.dtype != torch.uint8 or self.mask.dtype != torch.bool:
            raise ValueError(
                "LabelledImage: rgb must be uint8 and mask bool, got "
                f"{self.rgb.dtype} and {self.mask.dtype}"
            )


class LabelledImages(Protocol):
    """A sequence of labelled images."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> LabelledImage: ...


@dataclass(frozen=True)
class Similarity:
    """A change of the image: first mirrored, then turned and scaled about its centre, then shifted.

    turn: radians, from +u towards +v (clockwise as seen on a screen). shift: pixels (du, dv).
    scale: 2 makes everything twice as large. mirror: left and right swapped.
    """

    turn: float = 0.0
    shift: tuple[float, float] = (0.0, 0.0)
    scale: float = 1.0
    mirror: bool = False

    def matrix(self, shape: tuple[int, int]) -> np.ndarray:
        """Return the (3, 3) matrix from an old pixel (u, v, 1) of an image (H, W) to its new place.

        `GraspRectangle.transformed` takes it, too. For pure shifts and scales, `matrix @ K` is the
        pinhole matrix of the changed image.
        """
        height, width = shape
        centre = np.array([(width - 1) / 2, (height - 1) / 2])
        c, s = np.cos(self.turn), np.sin(self.turn)
        linear = self.scale * np.array([[c, -s], [s, c]]) @ np.diag([1 - 2 * self.mirror, 1])
        matrix = np.eye(3)
        matrix[:2, :2] = linear
        matrix[:2, 2] = centre + self.shift - linear @ centre
        return matrix


def apply_similarity(image: LabelledImage, change: Similarity) -> LabelledImage:
    """Return the changed image with its labels.

    The size stays; pixels from outside the image are black, with depth 0 and mask False. Colour is
    resampled bilinearly; depth, labels and mask take the nearest pixel, because between an object
    and the table there is no surface, and quarter turns of square images stay exact.

    Scaling is a change of the focal length: depth and widths in metres do not change, while the
    opening measured in pixels grows by `scale` (and `width_in_pixels` widths are multiplied by it).
    Turning is exact for a camera that rolls about its axis with fx = fy and a central principal
    point.
    """
    rgb, size = image.rgb, image.depth.shape
    # The origin of each new pixel: the changed image of pixel numbers counted from 1.
    source = torch.arange(1, image.depth.numel() + 1, dtype=torch.float32).reshape(1, *size)
    if change.mirror:
        rgb, source = rgb.flip(-1), source.flip(-1)
    rgb = _affine(rgb, change, kind="Image")
    source = _affine(source, change, kind="Mask").long().flatten() - 1
    outside = source < 0
    source.clamp_(min=0)

    def moved(values: torch.Tensor, beyond: float = 0) -> torch.Tensor:
        flat = values.flatten(-2).index_select(-1, source)
        return flat.masked_fill_(outside, beyond).unflatten(-1, size)

    depth, quality, width = moved(image.depth), moved(image.quality), moved(image.width)
    mask = moved(image.mask.reshape(-1, *size))
    quality, width, mask = turn_bins(quality, width, mask, change.turn, change.mirror)
    if image.width_in_pixels:
        width = width * change.scale
    centre = image.centre
    if centre is not None:
        matrix = torch.from_numpy(change.matrix(tuple(size))).float()
        centre = torch.einsum("ij,jvu->ivu", matrix[:2, :2], moved(centre, np.nan))
        centre += matrix[:2, 2, None, None]
    return replace(
        image, rgb=rgb, depth=depth, quality=quality, width=width,
        mask=mask[0] if image.mask.ndim == 2 else mask, centre=centre,
    )  # fmt: skip


def _affine(image: torch.Tensor, change: Similarity, kind: str) -> torch.Tensor:
    """Turned, scaled and shifted. kind: of torchvision's tensors; `affine` turns clockwise,
    interpolates an "Image" and takes the nearest pixel of a "Mask"."""
    if (change.turn, *change.shift, change.scale) == (0, 0, 0, 1):
        return image
    from torchvision import tv_tensors
    from torchvision.transforms.v2 import InterpolationMode
    from torchvision.transforms.v2.functional import affine

    moved = affine(
        getattr(tv_tensors, kind)(image),
        angle=float(np.degrees(change.turn)),
        translate=list(change.shift),
        scale=change.scale,
        shear=[0.0, 0.0],
        interpolation=InterpolationMode.BILINEAR,
    )
    return moved.as_subclass(torch.Tensor)


def turn_bins(
    quality: torch.Tensor,
    width: torch.Tensor,
    mask: torch.Tensor,
    turn: float,
    mirror: bool = False,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Move labels (B, ...) along the circle of angle bins: angle a becomes (+-a) + turn modulo pi.

    Mirroring takes a to pi - a, before the turn. A turn of n + f bins, 0 <= f < 1, moves by whole
    bins if f = 0; otherwise new bin k mixes old bins k - n and k - n - 1 with the weights 1 - f
    and f, also across the seam between 180 and 0 degrees. Widths are mixed with weight times
    quality, so that the width of a bin without a grasp has no influence; where neither bin has
    quality, by weight alone. A mask (B, ...) holds where both bins' masks hold; a mask (1, ...) for
    all bins stays.
    """
    bins = quality.shape[0]
    if mirror:
        order = (-torch.arange(bins)) % bins
        quality, width = quality[order], width[order]
        mask = mask[order] if len(mask) == bins else mask
    shift = turn / (np.pi / bins)
    whole = int(np.floor(shift + 1e-6))  # 1e-6 bins: a whole turn up to rounding is whole
    fraction = max(shift - whole, 0.0)
    quality, width = quality.roll(whole, 0), width.roll(whole, 0)
    mask = mask.roll(whole, 0) if len(mask) == bins else mask
    if fraction < 1e-6:
        return quality, width, mask
    a, b = (1 - fraction) * quality, fraction * quality.roll(1, 0)
    mixed = a + b
    plain = (1 - fraction) * width + fraction * width.roll(1, 0)
    by_quality = (a * width + b * width.roll(1, 0)) / mixed.clamp_min(torch.finfo(a.dtype).tiny)
    mask = mask & mask.roll(1, 0) if len(mask) == bins else mask
    return mixed, torch.where(mixed > 0, by_quality, plain), mask


@dataclass(frozen=True)
class ColourJitter:
    """Half ranges: brightness, contrast and saturation factors 1 +- x; hue +- x of the circle."""

    brightness: float = 0.2
    contrast: float = 0.2
    saturation: float = 0.2
    hue: float = 0.02

    def __call__(self, rgb: torch.Tensor, rng: np.random.Generator) -> torch.Tensor:
        """Return the image (3, H, W) uint8 with changed colours."""
        from torchvision.transforms.v2 import functional as F

        for adjust, half in (
            (F.adjust_brightness, self.brightness),
            (F.adjust_contrast, self.contrast),
            (F.adjust_saturation, self.saturation),
        ):
            if half > 0:
                rgb = adjust(rgb, rng.uniform(max(0.0, 1 - half), 1 + half))
        return F.adjust_hue(rgb, rng.uniform(-self.hue, self.hue)) if self.hue > 0 else rgb


@dataclass(frozen=True)
class Augmentation:
    """Draws a change from its ranges and applies it: `augment(image, rng)`.

    max_turn: radians, in both directions. turn_step: turns are rounded to multiples of it; pi / B
    (10 degrees) mixes no bins and so keeps hard labels hard; None does not round. max_shift: share
    of the image's side, in both directions. scale: lowest and highest, drawn uniformly in its
    logarithm. mirror: probability. colour: None keeps the colours. depth_noise: called last with
    (depth (H, W) metres, rng, rgb), returns the noisy depth; unknown depth is 0.
    """

    max_turn: float = np.pi
    turn_step: float | None = None
    max_shift: float = 0.05
    scale: tuple[float, float] = (0.8, 1.25)
    mirror: float = 0.5
    colour: ColourJitter | None = ColourJitter()
    depth_noise: TensorNoise | None = None

    def draw(
        self, rng: np.random.Generator, shape: tuple[int, int], zoom: float = 1.0
    ) -> Similarity:
        """Draw a change for an image of shape (H, W), with its scale around `zoom`; the number of
        random draws does not depend on the ranges."""
        turn = rng.uniform(-self.max_turn, self.max_turn)
        if self.turn_step:
            turn = np.round(turn / self.turn_step) * self.turn_step
        dv, du = rng.uniform(-self.max_shift, self.max_shift, size=2) * shape
        scale = zoom * np.exp(rng.uniform(*np.log(self.scale)))
        mirror = rng.random() < self.mirror
        return Similarity(float(turn), (float(du), float(dv)), float(scale), bool(mirror))

    def __call__(
        self, image: LabelledImage, rng: np.random.Generator, zoom: float = 1.0
    ) -> LabelledImage:
        """Return the changed image with its labels; `image` itself does not change."""
        image = apply_similarity(image, self.draw(rng, tuple(image.depth.shape), zoom))
        if self.colour is not None:
            image = replace(image, rgb=self.colour(image.rgb, rng))
        if self.depth_noise is not None:
            image = replace(image, depth=self.depth_noise(image.depth, rng, image.rgb))
        return image
