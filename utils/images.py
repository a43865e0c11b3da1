"""RGB-D images: read from a user's files, resampled, and seen from straight above.

`read_rgb`, `read_depth` and `read_mask` read the files of predict.py; whatever is missing or makes
no sense is a `UserError` that names the file or the option. `PixelScaling`
resamples an image, and takes pixels, angles and maps back exactly. `overhead_view` renders what a
camera straight above the table would see. This module knows no network, no grasps and no simulator.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from utils.depth_holes import nearest_values
from utils.errors import UserError
from utils.geometry import Workspace
from utils.transforms import RGBDFrame, deproject, known_depth, look_at, project


@dataclass(frozen=True)
class PixelScaling:
    """One factor for each image axis: u, v are scaled pixels per original pixel, > 0.

    Integer coordinates lie at pixel centres, so pixel u becomes (u + 0.5) * factor - 0.5.
    """

    u: float
    v: float

    @staticmethod
    def to_focal_length(K: np.ndarray, focal: float) -> PixelScaling:
        """The scaling that makes both focal lengths equal to `focal` pixels, so the pixels square.

        For pixels that are square already, both factors are equal.
        """
        return PixelScaling(focal / K[0, 0], focal / K[1, 1])

    def intrinsics(self, K: np.ndarray) -> np.ndarray:
        """The (3, 3) pinhole matrix of the scaled image."""
        centre = self.pixels(K[:2, 2])
        return np.array(
            [[K[0, 0] * self.u, 0.0, centre[0]], [0.0, K[1, 1] * self.v, centre[1]], [0, 0, 1]]
        )

    def size(self, shape: tuple[int, int]) -> tuple[int, int]:
        """(H, W) of the scaled image: the pixels that the original covers completely."""
        # Up to rounding: 0.7 * 320 must not lose a row to floating point.
        return int(shape[0] * self.v + 1e-6), int(shape[1] * self.u + 1e-6)

    def pixels(self, pixels: np.ndarray) -> np.ndarray:
        """Scaled places of original pixels (..., 2) as (u, v)."""
        return (np.asarray(pixels, float) + 0.5) * (self.u, self.v) - 0.5

    def original_pixels(self, pixels: np.ndarray) -> np.ndarray:
        """Original places of scaled pixels (..., 2). Inverse of `pixels`."""
        return (np.asarray(pixels, float) + 0.5) / (self.u, self.v) - 0.5

    def image(self, image: np.ndarray) -> np.ndarray:
        """The scaled image of (H, W) or (H, W, C), float32 or uint8.

        Area averages where it shrinks, so that nothing aliases; linear where it grows.
        """
        rows, columns = self.size(image.shape[:2])
        for along_u, along_v in ((self.u, 1.0), (1.0, self.v)):
            method = cv2.INTER_AREA if min(along_u, along_v) < 1 else cv2.INTER_LINEAR
            # Factors, not a size: a size would round them.
            image = cv2.resize(image, None, fx=along_u, fy=along_v, interpolation=method)
        return np.ascontiguousarray(image[:rows, :columns])


# --- A user's files -------------------------------------------------------------------------

MILLIMETRES = 0.001  # unit of whole numbers in a depth file, unless the user gives another one
SATURATED = 65535  # the other usual value of an unknown pixel in 16 bits, beside 0


LARGEST_IMAGE = 50_000_000  # pixels: a small file may stand for any number of them
# Of what Pillow reads, formats that hold pixels alone: some run other programs, or refer to files.
IMAGE_FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "PPM", "WEBP")


def open_image(path: Path) -> Image.Image:
    """The decoded image; UserError if it is missing, unreadable, cut short, empty or too large."""
    try:
        with Image.open(path, formats=IMAGE_FORMATS) as image:
            _check_size(path, image.size)
            image.load()
            whole = image.copy()
            whole.format = image.format  # a copy has none
            return whole
    except FileNotFoundError:
        raise UserError(f"{path}: no such file") from None
    except UserError:
        raise
    except Exception as error:  # Pillow's readers raise errors of many kinds for damaged files
        raise UserError(
            f"{path}: not a readable image ({', '.join(IMAGE_FORMATS)}), or cut short ({error})"
        ) from error


def _check_size(path: Path, sides: Sequence[int]) -> None:
    count = math.prod(sides)
    if not 0 < count <= LARGEST_IMAGE:
        raise UserError(
            f"{path}: {' x '.join(map(str, sides))} pixels, expected 1 to {LARGEST_IMAGE:,}"
        )


def read_rgb(path: Path) -> np.ndarray:
    """(H, W, 3) uint8 of a PNG or JPEG; an alpha channel is dropped, grey images are refused."""
    image = open_image(path)
    if image.mode not in ("RGB", "RGBA", "P"):
        raise UserError(
            f"{path}: an image with channels {''.join(image.getbands())!r}, "
            "expected colour: red, green, blue"
        )
    return np.array(image.convert("RGB"))


def read_depth(path: Path, scale: float | None = None) -> np.ndarray:
    """(H, W) float32 metres along the optical axis of a PNG, TIFF or NPY; 0 where unknown.

    scale: metres that 1 in the file stands for; None: whole numbers are millimetres, fractional
    ones metres. Unknown are values that are zero, negative or not finite; 65535 in 16 bits; and
    65535 in wider integers without a scale, where nothing is larger.
    """
    if scale is not None and not 0 < scale < np.inf:
        raise UserError(f"--depth-scale: got {scale:g}, expected a positive number such as 0.001")
    values = load_array(path) if path.suffix.lower() == ".npy" else _depth_values(path)
    if values.ndim == 3 and values.shape[2] == 1:
        values = values[..., 0]
    if values.ndim != 2:
        raise UserError(
            f"{path}: an array of shape {values.shape}, expected one channel of depth, (H, W)"
        )
    if values.dtype.kind not in "uif" or values.dtype.itemsize == 1:
        raise UserError(
            f"{path}: depth as {values.dtype}, expected 16-bit whole numbers or floats; "
            "8 bits are a picture of depth, not depth"
        )
    known = known_depth(values)
    if values.dtype.kind == "u" and values.dtype.itemsize == 2:  # of either byte order
        known &= values != SATURATED
    elif scale is None and values.dtype.kind != "f" and values.max() == SATURATED:
        known &= values != SATURATED  # a program has read 16 bits into more
    if scale is None:
        scale = 1.0 if values.dtype.kind == "f" else MILLIMETRES
    with np.errstate(over="ignore"):
        metres = np.where(known, values * np.float64(scale), 0).astype(np.float32)
    if not np.isfinite(metres).all():
        raise UserError(
            f"{path}: depths of up to {values[known].max():g} x {scale:g} m are too large to be "
            "any; give the metres that 1 in the file stands for, such as --depth-scale 0.001"
        )
    return metres


def _depth_values(path: Path) -> np.ndarray:
    image = open_image(path)
    if (image.format, image.mode) == ("PPM", "I"):
        # Pillow stretches the 16 bits of a PGM to its largest value, and reads them as 32.
        values = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED)
        if values is None:
            raise UserError(f"{path}: a PGM that OpenCV cannot read; write a PNG")
        return values
    return np.asarray(image)


def read_mask(path: Path, shape: tuple[int, int]) -> np.ndarray:
    """(H, W) bool of a PNG or NPY of `shape`: True where it is not 0; of a colour image, where any
    channel but alpha is not. Raises UserError for another size and for a mask of no or of every
    pixel."""
    if path.suffix.lower() == ".npy":
        values = load_array(path)
    else:
        image = open_image(path)
        values = np.asarray(image.convert("RGB") if image.mode in ("RGBA", "LA", "P") else image)
    if values.ndim == 3:
        values = values.any(axis=2)
    if values.ndim != 2 or values.dtype.kind not in "uifb":
        raise UserError(
            f"{path}: an array of shape {values.shape} of {values.dtype}, expected a mask (H, W) "
            "of numbers, not 0 where the object is"
        )
    if values.shape != shape:
        raise UserError(
            f"{path}: a mask of {values.shape[1]}x{values.shape[0]} pixels, the image has "
            f"{shape[1]}x{shape[0]}; give one of the same size"
        )
    mask = np.nan_to_num(values.astype(float)) != 0
    if not mask.any():
        raise UserError(f"{path}: the mask is empty: all pixels are 0; mark those of the object")
    if mask.all():
        raise UserError(
            f"{path}: the mask marks every pixel, as a picture in place of a mask does; only those "
            "of the object may be other than 0"
        )
    return mask


def load_array(path: Path) -> np.ndarray:
    """The array of a file that np.save wrote. Raises UserError, naming the file."""
    try:
        # Mapped, because a header may promise more numbers than the file has and memory holds; and
        # without pickles, because a pickled object could run code.
        values = np.load(path, mmap_mode="r", allow_pickle=False)
    except FileNotFoundError:
        raise UserError(f"{path}: no such file") from None
    except Exception as error:  # numpy's reader raises errors of many kinds for damaged files
        raise UserError(f"{path}: not a readable array, or cut short ({error})") from error
    if not isinstance(values, np.ndarray):  # an .npz under a wrong name
        raise UserError(f"{path}: holds several arrays, expected one as np.save writes it")
    _check_size(path, values.shape)
    return np.array(values)


# --- The view from above --------------------------------------------------------------------
# A network that was trained on images from above knows no other view.

DISTANCE = 0.8  # m over the table, as the cell's overhead camera
ON_TABLE = 0.01  # m over the table, up to which hidden table takes a pixel's colour
PARTS = (-0.25, 0.25)  # each pixel stands for points of its square, two by two


def overhead_view(
    frame: RGBDFrame, workspace: Workspace, metres_per_pixel: float, margin: float = 0.0
) -> RGBDFrame:
    """The workspace, widened by `margin` metres, as a camera DISTANCE above its middle sees it.

    Pixels span `metres_per_pixel` of the table; +v runs along the world's -y. Each pixel shows the
    highest of the frame's points that fall into it. Pixels without a point have the table's depth,
    and the colour of the nearest table.
    """
    size = 8 * round((workspace.size + 2 * margin) / metres_per_pixel / 8)
    focal, middle = DISTANCE / metres_per_pixel, (size - 1) / 2
    K = np.array([[focal, 0.0, middle], [0.0, focal, middle], [0.0, 0.0, 1.0]])
    foot = np.array([*workspace.centre, workspace.table_height])
    T_WC = look_at(foot + (0.0, 0.0, DISTANCE), foot, (0.0, 1.0, 0.0))

    depth = np.full((size, size), DISTANCE, np.float32)
    rgb = np.zeros((size, size, 3), np.uint8)
    seen = np.zeros((size, size), bool)
    points, colours = _points(frame)
    pixels, far = project(points, K, T_WC)
    pixels = np.rint(pixels)
    inside = np.flatnonzero(((pixels >= 0) & (pixels < size)).all(axis=1))  # NaN is not
    inside = inside[np.argsort(-far[inside], kind="stable")]  # the nearest is written last
    u, v = pixels[inside].astype(int).T
    at = v, u
    depth[at], seen[at] = far[inside], True
    rgb[at] = colours[inside]

    table = seen & (depth > DISTANCE - ON_TABLE)
    if table.any():
        rgb = np.where(seen[..., None], rgb, nearest_values(rgb, table))
    return replace(
        frame, rgb=rgb, depth=depth, K=K, T_WC=T_WC, segmentation=None, truth=None, target=None
    )


def _points(frame: RGBDFrame) -> tuple[np.ndarray, np.ndarray]:
    """(N, 3) points in W of all parts of the known pixels, and their colours (N, 3)."""
    row, column = np.nonzero(known_depth(frame.depth))
    depth, colour = frame.depth[row, column], frame.rgb[row, column]
    parts = [
        deproject(np.stack([column + du, row + dv], axis=-1), depth, frame.K, frame.T_WC)
        for dv, du in itertools.product(PARTS, PARTS)
    ]
    return np.concatenate(parts), np.concatenate([colour] * len(parts))
