"""A user's own RGB-D image from files: colour, depth, intrinsics, camera pose.

Whatever is missing or cannot be meant is a `UserError` that names the file or the option. This
module knows no network and no simulator.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from PIL import Image
from scipy.spatial.transform import Rotation

from utils.errors import UserError
from utils.transforms import known_depth

MILLIMETRES = 0.001  # what whole numbers in a depth file are, unless the user says otherwise
SATURATED = 65535  # the other usual value of an unknown pixel in 16 bits, beside 0
MAX_PIXEL_ASPECT = 1.5  # fx / fy: real sensors stay well below; swapped numbers do not
RIGID_TOLERANCE = 1e-3  # of a rotation's orthonormality: poses are often printed with 4 digits


def open_image(path: Path) -> Image.Image:
    """The decoded image; UserError if it is missing, unreadable or cut short."""
    try:
        with Image.open(path) as image:
            image.load()
            return image.copy()
    except FileNotFoundError:
        raise UserError(f"{path}: no such file") from None
    # Pillow raises any of these for damaged files.
    except (OSError, SyntaxError, ValueError, EOFError, Image.DecompressionBombError) as error:
        raise UserError(f"{path}: not a readable image, or cut short ({error})") from error


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
    ones metres. Zero, negative, not finite, and 65535 in 16 bits are unknown.
    """
    if scale is not None and not 0 < scale < np.inf:
        raise UserError(f"--depth-scale: got {scale:g}, expected a positive number such as 0.001")
    values = _load_array(path) if path.suffix.lower() == ".npy" else np.asarray(open_image(path))
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
    if scale is None:
        scale = 1.0 if values.dtype.kind == "f" else MILLIMETRES
    known = known_depth(values)
    if values.dtype == np.uint16:
        known &= values != SATURATED
    return np.where(known, values * np.float64(scale), 0).astype(np.float32)


def intrinsics_matrix(numbers: Sequence[float], width: int, height: int) -> np.ndarray:
    """The (3, 3) K of [fx, fy, cx, cy] in pixels of an image of that size, once they are checked.

    Integer coordinates lie at pixel centres, as in OpenCV and ROS.
    """
    if len(numbers) != 4:
        raise UserError(f"--intrinsics: got {len(numbers)} numbers, expected 4: fx fy cx cy")
    if not np.isfinite(numbers).all():
        raise UserError(f"--intrinsics: {_listed(numbers)}: expected finite numbers")
    fx, fy, cx, cy = map(float, numbers)
    if fx <= 0 or fy <= 0:
        raise UserError(f"--intrinsics: focal lengths {fx:g} and {fy:g}, expected positive pixels")
    if max(fx / fy, fy / fx) > MAX_PIXEL_ASPECT:
        raise UserError(
            f"--intrinsics: focal lengths {fx:g} and {fy:g} differ by more than a factor of "
            f"{MAX_PIXEL_ASPECT:g}; the order is fx fy cx cy"
        )
    if not (-width / 2 <= cx <= 1.5 * width and -height / 2 <= cy <= 1.5 * height):
        raise UserError(
            f"--intrinsics: the principal point ({cx:g}, {cy:g}) lies far outside the image of "
            f"{width}x{height} pixels; are these the intrinsics of another resolution?"
        )
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def read_pose(path: Path) -> np.ndarray:
    """(4, 4) T_WC, rigid, of an .npy, .json, .yaml or text file.

    The file holds 4x4 or 16 numbers row by row; JSON and YAML may name them T_WC. Rotations that
    are orthonormal up to rounding are made so exactly.
    """
    T = _pose_numbers(path)
    if T.size == 16 and T.ndim in (1, 2):
        T = T.reshape(4, 4)
    if T.shape != (4, 4):
        raise UserError(f"{path}: numbers of shape {T.shape}, expected a 4x4 camera pose T_WC")
    if not np.isfinite(T).all():
        raise UserError(f"{path}: the camera pose holds a number that is not finite")
    if np.abs(T[3] - (0, 0, 0, 1)).max() > 1e-6:
        raise UserError(
            f"{path}: the last row of the camera pose is {_listed(T[3])}, expected 0 0 0 1; "
            "is it transposed?"
        )
    R = T[:3, :3]
    if np.abs(R.T @ R - np.eye(3)).max() > RIGID_TOLERANCE or np.linalg.det(R) < 0:
        raise UserError(
            f"{path}: the camera pose is not rigid: its 3x3 part must be a rotation "
            f"(determinant {np.linalg.det(R):.3g}, expected 1)"
        )
    rigid = np.eye(4)
    rigid[:3, :3] = Rotation.from_matrix(R).as_matrix()
    rigid[:3, 3] = T[:3, 3]
    return rigid


def _load_array(path: Path) -> np.ndarray:
    try:
        values = np.load(path, allow_pickle=False)  # a pickled object could run code
    except FileNotFoundError:
        raise UserError(f"{path}: no such file") from None
    except (OSError, ValueError, EOFError) as error:
        raise UserError(f"{path}: not a readable array, or cut short ({error})") from error
    if not isinstance(values, np.ndarray):  # an .npz under a wrong name
        raise UserError(f"{path}: holds several arrays, expected one as np.save writes it")
    return values


def _pose_numbers(path: Path) -> np.ndarray:
    try:
        suffix = path.suffix.lower()
        if suffix == ".npy":
            return np.asarray(_load_array(path), dtype=float)
        text = path.read_text(encoding="utf-8")
        if suffix in (".json", ".yaml", ".yml"):
            content: Any = json.loads(text) if suffix == ".json" else yaml.safe_load(text)
            if isinstance(content, dict):
                if "T_WC" not in content:
                    raise UserError(f"{path}: has no entry T_WC")
                content = content["T_WC"]
            return np.asarray(content, dtype=float)
        rows = [line.replace(",", " ").split() for line in text.splitlines() if line.strip()]
        return np.asarray(rows, dtype=float)
    except FileNotFoundError:
        raise UserError(f"{path}: no such file") from None
    except UserError:
        raise
    # A ValueError is also what JSON and UTF-8 raise.
    except (OSError, ValueError, TypeError, yaml.YAMLError) as error:
        raise UserError(f"{path}: cannot be read as a 4x4 camera pose ({error})") from error


def _listed(numbers: Sequence[float]) -> str:
    return " ".join(f"{number:g}" for number in numbers)
