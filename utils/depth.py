"""The noise that real cameras add to depth images.

A depth noise is a callable `noise(depth, rng) -> depth` that turns a clean depth image into a
measured one; one with `sees_colours = True` is called with the colours too, `noise(depth, rng,
rgb)`. `DEPTH_NOISES` lists the known ones; `make_depth_noise` makes one of them, or one of
your own, for all that measure depth: the cell's cameras, the closed loop, the environments, the
randomisation and the training. `seeded_noise` gives it the random numbers of a scene;
`utils.random_streams` lists who draws them.

`KinectNoise` has four effects, after Handa et al., "A benchmark for RGB-D visual odometry, 3D
reconstruction and SLAM" (ICRA 2014), Barron and Malik, "Intrinsic scene properties from a single
RGB-D image" (CVPR 2013), and Bohg et al., "Robot arm pose estimation through pixel-wise part
classification" (ICRA 2014), whose window of projected dots makes the holes. `RealSenseNoise` is an
active stereo camera, `GammaNoise` the noise with which Dex-Net 2.0 and GIGA were trained,
`GaussianNoise` that of the Edge Grasp Network's tests.

What the holes may show that they leave is the subject of `utils.depth_holes`. This module knows no
simulator, no network and no grasps.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from functools import cached_property, lru_cache
from numbers import Real
from typing import Any, ClassVar, NamedTuple

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.special import ndtri

from utils.errors import UserError, unknown_choice
from utils.plugins import is_import_path, load_plugin
from utils.random_streams import Stream
from utils.transforms import known_depth

# (H, W) float32 metres and a generator for the draws, and (H, W, 3) uint8 colours for noises that
# have `sees_colours` -> (H, W) float32 metres, 0 where unknown.
DepthNoise = Callable[..., np.ndarray]

_PATTERN_SEED = 1975  # the projector's pattern never changes; any number would do
_DOT_CELL = 3  # sensor pixels: the pattern has one dot in each square of this side
_INLIER_GROWTH = 1.2**2  # Bohg et al.: far from the centre, disparities may differ by this x r^2
# With more an image would take gigabytes, or minutes.
_WIDEST_WINDOW = 31  # sensor pixels
_WIDEST_IN_IMAGE, _LONGEST_CORRELATION = 4096, 200  # pixels of the image


@dataclass(frozen=True)
class KinectNoise:
    """A structured-light camera such as the first Kinect: steps, noise and holes.

    image_focal: pixels, focal length of the images that the noise is applied to. focal, baseline:
    pixels and metres, of the sensor (480 px at 640 x 480). The lengths below are in the sensor's
    pixels; image_focal / focal converts them to the image's, so that one sensor fits every
    resolution.
    shift: standard deviation, pixels, of the offset at which each pixel reads the disparity.
    step: pixels, the unit in which disparities are counted. noise: standard deviation of a
    disparity in steps, so that wider steps come with more noise. Barron and Malik's formula
    35130 / round(35130 / z + N(0, 1/6) + 0.5), z in centimetres, counts 35130 cm = 585.5 px x
    7.5 cm x 8, hence eighths of a pixel: their 1/6 is 1/6 of a step. (Of a pixel, it would be 3 mm
    at 0.8 m, three times what Khoshelham and Elberink, Sensors 2012, measured.) Their 0.5 undoes a
    truncation that this code does not make.
    window: pixels, odd, 3 to 31; side of the square in which dots are matched. tolerance: pixels,
    by which a dot at the centre may differ from the window's mean, others by up to 1.44 r^2 times
    as much, r pixels away. support: share of the window's dots, in [0, 1), that a match has to
    exceed.
    """

    image_focal: float = 480.0
    focal: float = 480.0
    baseline: float = 0.075
    shift: float = 0.5
    noise: float = 1 / 6
    step: float = 1 / 8
    window: int = 9
    tolerance: float = 0.1
    support: float = 1 / 1.2

    def __post_init__(self) -> None:
        _check_numbers(self)
        for name in ("image_focal", "focal", "baseline", "step", "tolerance"):
            if not getattr(self, name) > 0:
                raise ValueError(f"KinectNoise.{name} must be > 0, got {getattr(self, name)}")
        for name in ("shift", "noise"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"KinectNoise.{name} must be >= 0, got {getattr(self, name)}")
        if not 3 <= self.window <= _WIDEST_WINDOW or self.window % 2 != 1:
            raise ValueError(
                f"KinectNoise.window must be an odd number from 3 to {_WIDEST_WINDOW}, got "
                f"{self.window}"
            )
        if not 0 <= self.support < 1:
            raise ValueError(f"KinectNoise.support must be in [0, 1), got {self.support}")
        wide = self.window * self.image_focal / self.focal
        if wide > _WIDEST_IN_IMAGE:
            raise ValueError(
                f"KinectNoise.window would span {wide:.4g} pixels of the image (window x "
                f"image_focal / focal), expected at most {_WIDEST_IN_IMAGE}; take a longer focal"
            )

    def __call__(self, depth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """(H, W) float32 metres as measured; 0 where there is no measurement.

        depth: (H, W) metres along the optical axis, 0 (or NaN) where unknown. Always draws
        3 x H x W normal deviates. Raises UserError for an image smaller than the window.
        """
        depth = np.asarray(depth, dtype=np.float32)
        if depth.ndim != 2 or min(depth.shape) < self.matching.window:
            raise UserError(
                f"KinectNoise: depth must be (H, W) and at least {self.matching.window} pixels "
                f"either way, got {depth.shape}; take larger images, or a smaller window or a "
                "longer focal in camera.depth_noise_args"
            )
        draws = rng.standard_normal((3, *depth.shape), dtype=np.float32)
        disparity = self._matched(self._shifted(depth, draws[0], draws[1]))
        steps = np.rint(disparity / self.step + self.noise * draws[2])
        with np.errstate(divide="ignore"):
            measured = np.float32(self.focal * self.baseline / self.step) / steps
        return np.where((disparity > 0) & (steps > 0), measured, np.float32(0))

    @cached_property
    def matching(self) -> Matching:
        """The window and its tolerances, in pixels of the image."""
        scale = self.image_focal / self.focal
        half = max(1, round((self.window - 1) / 2 * scale))
        across = np.arange(-half, half + 1)
        squared = across[:, None] ** 2 + across**2
        allowed = self.tolerance * np.maximum(1, _INLIER_GROWTH * squared / scale**2)
        return Matching(
            window=2 * half + 1,
            cell=max(1, round(_DOT_CELL * scale)),
            reach=max(1, round(self.window / 3 * scale)),
            allowed=allowed.astype(np.float32),
        )

    def _shifted(self, depth: np.ndarray, du: np.ndarray, dv: np.ndarray) -> np.ndarray:
        """(H, W) disparities read a random shift beside each pixel; 0 where a neighbour that the
        interpolation needs is unknown.

        The interpolation is of disparities, not depths: a plane's are linear in the image.
        """
        height, width = depth.shape
        known = depth > 0
        disparity = np.full_like(depth, np.nan)
        np.divide(np.float32(self.focal * self.baseline), depth, out=disparity, where=known)
        sigma = np.float32(self.shift * self.image_focal / self.focal)
        u = sigma * du + np.arange(width, dtype=np.float32)
        v = sigma * dv + np.arange(height, dtype=np.float32)[:, None]
        found = cv2.remap(disparity, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.nan_to_num(found, copy=False, nan=0.0)

    def _matched(self, disparity: np.ndarray) -> np.ndarray:
        """(H, W) disparities where the sensor recognises the pattern, 0 elsewhere.

        The sensor recognises a dot if enough of the dots around it have the window's mean
        disparity. A pixel takes the disparity of the nearest recognised dot within reach; of
        equally near dots it takes the upper one, then the left one.
        """
        matching = self.matching
        size = (matching.window, matching.window)
        pattern = dot_pattern(*disparity.shape, matching.cell)
        rows, cols, dots_around = _whole_windows(*disparity.shape, matching.cell, matching.window)
        kernel = np.ones(size, np.uint8)
        spread = cv2.dilate(disparity, kernel) - cv2.erode(disparity, kernel)
        recognised = disparity[rows, cols] > 0
        # Every dot agrees where nothing differs by the least tolerance; the others need a test.
        doubtful = np.flatnonzero(recognised & (spread[rows, cols] >= self.tolerance))
        centre = rows[doubtful], cols[doubtful]
        total, count = (
            cv2.boxFilter(image, cv2.CV_64F, size, normalize=False)[centre]
            for image in (disparity, (disparity > 0).astype(np.float32))
        )
        mean = (total / count).astype(np.float32)
        corner = tuple(index - matching.window // 2 for index in centre)
        around = sliding_window_view(disparity, size)[corner]
        agree = np.abs(around - mean[:, None, None]) < matching.allowed
        agree &= around > 0
        agree &= sliding_window_view(pattern, size)[corner]
        agreeing = agree.sum(axis=(1, 2), dtype=np.uint16)
        recognised[doubtful] = agreeing > self.support * dots_around[doubtful]
        rows, cols = rows[recognised], cols[recognised]
        matched = np.zeros_like(disparity)
        flat, stride = matched.reshape(-1), matched.shape[1]
        index, value = rows * stride + cols, disparity[rows, cols]
        for dv, du in farthest_first(matching.reach):  # the nearest is written last
            flat[index + (dv * stride + du)] = value
        return matched


class Matching(NamedTuple):
    """window: pixels, odd. cell: pixels, side of the square with one dot. reach: pixels, radius of
    the disc that takes a dot's disparity. allowed: (window, window) pixels of disparity."""

    window: int
    cell: int
    reach: int
    allowed: np.ndarray


@lru_cache(maxsize=32)
def dot_pattern(height: int, width: int, cell: int) -> np.ndarray:
    """(H, W) bool, the projector's dots: one at a random place in each square of `cell` pixels."""
    rng = np.random.default_rng(_PATTERN_SEED)
    corners = np.mgrid[0:height:cell, 0:width:cell]
    rows, cols = corners + rng.integers(cell, size=corners.shape)
    inside = (rows < height) & (cols < width)
    pattern = np.zeros((height, width), dtype=bool)
    pattern[rows[inside], cols[inside]] = True
    pattern.flags.writeable = False
    return pattern


@lru_cache(maxsize=32)
def _whole_windows(
    height: int, width: int, cell: int, window: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows and columns (N,) of the dots whose window lies in the image, and the dots in each."""
    pattern, margin = dot_pattern(height, width, cell), window // 2
    inside = np.zeros_like(pattern)
    inside[margin : height - margin, margin : width - margin] = True
    rows, cols = np.nonzero(pattern & inside)
    windows = sliding_window_view(pattern, (window, window))[rows - margin, cols - margin]
    return rows, cols, windows.sum(axis=(1, 2))


@lru_cache(maxsize=32)
def farthest_first(reach: int) -> tuple[tuple[int, int], ...]:
    """Offsets (dv, du) of a disc's pixels; among equally far ones in reading order."""
    across = range(-reach, reach + 1)
    disc = [(dv, du) for dv in across for du in across if dv**2 + du**2 <= reach**2]
    return tuple(sorted(disc, key=lambda offset: (-(offset[0] ** 2) - offset[1] ** 2, *offset)))


@dataclass(frozen=True)
class RealSenseNoise:
    """An active stereo camera such as Intel's D435: errors that grow with the square of the
    distance, shadows beside whatever stands up, and holes where the surface returns no pattern.

    The standard deviation at distance z is z^2 subpixel / (focal x baseline), after Grunnet-Jepsen,
    Sweetser and Woodfill, "Tuning depth cameras for best performance" (Intel RealSense), who expect
    a sub-pixel error of 0.1 down to 0.05 px on a textured surface. focal, baseline: pixels and
    metres of the sensor. The defaults are the D435's at 848 x 480 and 90 degrees; the D415 at
    1280 x 720 and 65 degrees has 1005 px and 0.055 m, hence 0.4 times the error.
    image_focal: pixels, focal length of the images that the noise is applied to.
    correlation: pixels of the sensor; errors d pixels apart correlate by
    exp(-d^2 / (2 correlation^2)), because neighbours share most of their matching window.

    The second camera does not see what lies in the shadow on the left of an edge. Other pixels are
    lost with a probability that rises from 0 to 1 between two limits: brightness falling from
    `dark` to 0 (0..255), the least of the three channels rising from `shiny` to 255 (a reflection
    that outshines the pattern), and the surface's tilt against the image plane rising from
    `grazing` to 90 degrees, which a step in depth does too. These limits, and the correlation, are
    choices; no data sheet states them. Without colours, dark and shiny surfaces are measured.
    """

    sees_colours: ClassVar[bool] = True

    image_focal: float = 424.0
    focal: float = 424.0
    baseline: float = 0.05
    subpixel: float = 0.08
    correlation: float = 2.5
    dark: float = 40.0
    shiny: float = 250.0
    grazing: float = 70.0

    def __post_init__(self) -> None:
        _check_numbers(self)
        for name in ("image_focal", "focal", "baseline"):
            if not getattr(self, name) > 0:
                raise ValueError(f"RealSenseNoise.{name} must be > 0, got {getattr(self, name)}")
        for name, most in (
            ("subpixel", np.inf), ("correlation", np.inf), ("dark", 255), ("shiny", 255),
            ("grazing", 90),
        ):  # fmt: skip
            if not 0 <= getattr(self, name) <= most:
                raise ValueError(
                    f"RealSenseNoise.{name} must be in [0, {most}], got {getattr(self, name)}"
                )
        _check_correlation(self, self.correlation * self.image_focal / self.focal)

    def __call__(
        self, depth: np.ndarray, rng: np.random.Generator, rgb: np.ndarray | None = None
    ) -> np.ndarray:
        """(H, W) float32 metres as measured; 0 where there is no measurement.

        depth: (H, W) metres along the optical axis, 0 (or NaN) where unknown. rgb: (H, W, 3) uint8.
        """
        depth = _depth_image(depth, "RealSenseNoise")
        length = self.correlation * self.image_focal / self.focal
        error, luck = (correlated_field(depth.shape, length, rng) for _ in range(2))
        known = known_depth(depth)
        inverse = np.zeros_like(depth)
        np.divide(1, depth, out=inverse, where=known)
        # The error is of the disparity, which is focal x baseline / depth.
        unit = self.subpixel / (self.focal * self.baseline)
        noisy = inverse + np.float32(unit) * error
        lost = luck < ndtri(self._lost(depth, known, rgb))
        kept = known & (noisy > 0) & ~lost & ~self._in_shadow(inverse, known)
        measured = np.zeros_like(depth)
        np.divide(1, noisy, out=measured, where=kept)
        return measured

    def _in_shadow(self, inverse: np.ndarray, known: np.ndarray) -> np.ndarray:
        """(H, W) bool, pixels that the second camera does not see.

        It sees a pixel of column u at u minus the disparity; a pixel further right that lands
        further left is nearer and hides it.
        """
        u = np.arange(inverse.shape[1], dtype=np.float32)
        lands = np.where(known, u - np.float32(self.image_focal * self.baseline) * inverse, np.inf)
        leftmost = np.minimum.accumulate(lands[:, ::-1], axis=1)[:, ::-1]
        return lands > leftmost

    def _lost(self, depth: np.ndarray, known: np.ndarray, rgb: np.ndarray | None) -> np.ndarray:
        """(H, W) probability that a pixel has no measurement."""
        filled = np.where(known, depth, depth[known].mean() if known.any() else 1.0)
        dz_dv, dz_du = np.gradient(filled)
        tilt = np.degrees(np.arctan(np.hypot(dz_du, dz_dv) * self.image_focal / filled))
        seen = 1 - _ramp(tilt, self.grazing, 90.0)
        if rgb is not None:
            colours = np.asarray(rgb, np.float32)
            seen = seen * _ramp(colours @ _BRIGHTNESS, 0.0, self.dark)
            seen = seen * (1 - _ramp(colours.min(axis=-1), self.shiny, 255.0))
        return 1 - seen


@dataclass(frozen=True)
class GammaNoise:
    """The noise of Dex-Net 2.0 (Mahler et al., RSS 2017, its depth images z' = alpha z + epsilon),
    which GIGA (Jiang et al., RSS 2021) trains with as well.

    alpha is one Gamma variable for each image, of shape `shape` and scale 1 / shape (mean 1,
    variance 1 / shape). epsilon is a Gaussian process of mean 0 and standard deviation `sigma`
    (metres), whose values d pixels apart correlate by exp(-d^2 / (2 correlation^2)). The published
    code of both draws epsilon on a grid of every fourth pixel and interpolates; correlation=4 comes
    near to it. image_focal is ignored: the pixels are the image's.
    """

    image_focal: float = 0.0
    shape: float = 1000.0
    sigma: float = 0.005
    correlation: float = 2**0.5

    def __post_init__(self) -> None:
        _check_numbers(self)
        if not self.shape > 0:
            raise ValueError(f"GammaNoise.shape must be > 0, got {self.shape}")
        for name in ("sigma", "correlation"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"GammaNoise.{name} must be >= 0, got {getattr(self, name)}")
        _check_correlation(self, self.correlation)

    def __call__(self, depth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """(H, W) float32 metres; unknown pixels (0 or NaN) are 0."""
        depth = _depth_image(depth, "GammaNoise")
        factor = np.float32(rng.gamma(self.shape, 1 / self.shape))
        error = np.float32(self.sigma) * correlated_field(depth.shape, self.correlation, rng)
        measured = factor * depth + error
        return np.where(known_depth(depth) & (measured > 0), measured, np.float32(0))


@dataclass(frozen=True)
class GaussianNoise:
    """An error of mean 0 and standard deviation `sigma` (metres) at each pixel, independent of all
    others: the noise of clutter removal in Huang et al., "Edge Grasp Network" (ICRA 2023), and
    Hu et al., "OrbitGrasp" (CoRL 2024). image_focal is ignored.
    """

    image_focal: float = 0.0
    sigma: float = 0.0008

    def __post_init__(self) -> None:
        _check_numbers(self)
        if not self.sigma >= 0:
            raise ValueError(f"GaussianNoise.sigma must be >= 0, got {self.sigma}")

    def __call__(self, depth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """(H, W) float32 metres; unknown pixels (0 or NaN) are 0. Draws H x W normal deviates."""
        depth = _depth_image(depth, "GaussianNoise")
        measured = depth + np.float32(self.sigma) * rng.standard_normal(depth.shape, np.float32)
        return np.where(known_depth(depth) & (measured > 0), measured, np.float32(0))


_BRIGHTNESS = np.array([0.299, 0.587, 0.114], np.float32)  # of red, green and blue; ITU-R BT.601


def _check_numbers(noise: Any) -> None:
    """Raise ValueError for a parameter that is no finite number."""
    for field in fields(noise):
        value = getattr(noise, field.name)
        if not isinstance(value, Real) or not math.isfinite(value):
            name = f"{type(noise).__name__}.{field.name}"
            raise ValueError(f"{name} must be a finite number, got {value!r}")


def _check_correlation(noise: Any, length: float) -> None:
    """Raise ValueError for errors that correlate over too many pixels of the image."""
    if length > _LONGEST_CORRELATION:
        raise ValueError(
            f"{type(noise).__name__}.correlation is {length:.4g} pixels of the image, expected at "
            f"most {_LONGEST_CORRELATION}"
        )


def _depth_image(depth: np.ndarray, name: str) -> np.ndarray:
    """(H, W) float32; ValueError for another number of axes or less than two pixels either way."""
    depth = np.asarray(depth, dtype=np.float32)
    if depth.ndim != 2 or min(depth.shape) < 2:
        raise ValueError(f"{name}: depth must be (H, W), 2 x 2 or more, got {depth.shape}")
    return depth


def _ramp(value: np.ndarray, low: float, high: float) -> np.ndarray:
    """0 up to `low`, 1 from `high`, linear between; a step at `high` where both are equal."""
    if low >= high:
        return (value >= high).astype(np.float32)
    return np.clip((value - low) / (high - low), 0, 1)


def correlated_field(shape: tuple[int, ...], length: float, rng: np.random.Generator) -> np.ndarray:
    """(H, W) float32 normal deviates of variance 1, d pixels apart correlated by
    exp(-d^2 / (2 length^2)); independent for length 0. The borders are like the rest."""
    width = length / 2**0.5  # a Gaussian correlated with itself is sqrt(2) times as wide
    half = int(np.ceil(4 * width))
    across = np.arange(-half, half + 1)
    kernel = np.exp(-(across**2) / (2 * width**2)) if half else np.ones(1)
    kernel = (kernel / np.linalg.norm(kernel)).astype(np.float32)
    white = rng.standard_normal([side + 2 * half for side in shape], dtype=np.float32)
    field = cv2.sepFilter2D(white, cv2.CV_32F, kernel, kernel)
    return field[half : half + shape[0], half : half + shape[1]]


# A noise is made by a call with the image's focal length in pixels (image_focal) and its own
# parameters as keyword arguments. A new noise is one more entry; "none" is no noise.
DEPTH_NOISES: dict[str, Callable[..., DepthNoise]] = {
    "kinect": KinectNoise,
    "realsense": RealSenseNoise,
    "gamma": GammaNoise,
    "gaussian": GaussianNoise,
}


def make_depth_noise(
    name: str,
    image_focal: float,
    arguments: Mapping[str, Any] | None = None,
    key: str = "camera.depth_noise",
) -> DepthNoise | None:
    """The depth noise of that name, or of the import path `module:name`; None for "none".

    image_focal: focal length, pixels, of the images that the noise is applied to. arguments: the
    noise's own parameters (`camera.depth_noise_args`); "none" ignores them. key: the config's, for
    messages. Raises UserError for an unknown name and for parameters that the noise refuses.
    """
    if name == "none":
        return None
    if name in DEPTH_NOISES:
        make = DEPTH_NOISES[name]
    elif is_import_path(name):
        make = load_plugin(name, key)
    else:
        raise unknown_choice(key, name, ["none", *DEPTH_NOISES, "module:name"])
    try:
        noise = make(image_focal=image_focal, **(arguments or {}))
    except (TypeError, ValueError) as error:
        where = f"{key}_args: {name!r} does not take them" if arguments else f"{key}: {name!r}"
        raise UserError(f"{where}: {error}") from error
    if not callable(noise):
        raise UserError(
            f"{key}: {name!r} returned a {type(noise).__name__}, expected a callable "
            "noise(depth, rng)"
        )
    return noise


def measure(
    noise: DepthNoise,
    depth: np.ndarray,
    rng: np.random.Generator,
    rgb: np.ndarray | None = None,
) -> np.ndarray:
    """(H, W) metres as measured; rgb (H, W, 3) uint8 reaches the noises that look at colours."""
    if getattr(noise, "sees_colours", False):
        return noise(depth, rng, rgb)
    return noise(depth, rng)


def seeded_noise(
    noise: DepthNoise | None, stream: Stream, seed: int, frame: int
) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """A function from a clean depth image and its colours to the measured depth; for no noise, the
    clean one.

    seed: of the scene. frame: the number of images before. Further calls of one function go on with
    its random numbers.
    """
    if noise is None:
        return lambda depth, rgb: depth
    rng = np.random.default_rng([seed, frame, stream])
    return lambda depth, rgb: measure(noise, depth, rng, rgb)
