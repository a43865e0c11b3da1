"""A camera's intrinsics and pose, read from a user's numbers and files.

Drivers and calibrations write them in several forms. Whatever is missing or makes no sense is a
`UserError` that names the file or the option.
"""

from __future__ import annotations

import json
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np
from scipy.spatial.transform import Rotation

from utils.config import YAML_ERRORS, load_yaml
from utils.errors import UserError, one_line
from utils.images import load_array

FARTHEST_CAMERA = 50.0  # m; 5 cm in millimetres
LARGEST_POSE, LARGEST_INTRINSICS = 10_000, 100_000  # bytes of a text
RIGID_TOLERANCE = 1e-3  # of a rotation's orthonormality: poses are often printed with 4 digits
MAX_PIXEL_ASPECT = 1.5  # fx / fy: real sensors stay well below; swapped numbers do not
INTRINSICS = ("fx", "fy", "cx", "cy")  # keys of an intrinsics file, pixels
# Keys of its matrix: ROS 1 and ROS 2 (CameraInfo), calibrations of ROS and OpenCV, Open3D.
MATRICES = ("K", "k", "camera_matrix", "cameraMatrix", "intrinsic_matrix")
# Keys under which cameras' drivers and calibrations write the coefficients of a lens.
DISTORTION = (
    "coeffs", "D", "d", "dist_coeffs", "distCoeffs", "distortion", "distortion_coefficients",
    "k1", "k2", "k3", "p1", "p2",
)  # fmt: skip


def read_intrinsics(given: Sequence[str], width: int, height: int) -> np.ndarray:
    """The (3, 3) K of an image of that size: from the four numbers fx fy cx cy as text, or from one
    JSON or YAML file that names them, or their matrix as ROS, OpenCV and Open3D write it, and that
    may also name the width and height they belong to. Raises UserError, naming file or option."""
    if len(given) == 1 and (path := Path(given[0])).suffix.lower() in (".json", ".yaml", ".yml"):
        values = _intrinsics_in(path)
        size = values.get("width", width), values.get("height", height)
        if size != (width, height):
            raise UserError(
                f"{path}: intrinsics of an image of {size[0]}x{size[1]} pixels, the image has "
                f"{width}x{height}"
            )
        of_this_image = "width" in values and "height" in values
        return intrinsics_matrix([values[key] for key in INTRINSICS], width, height, of_this_image)
    try:
        numbers = [float(text) for text in given]
    except ValueError:
        raise UserError(
            f"--intrinsics: got {' '.join(given)}, expected 4 numbers fx fy cx cy, or a FILE.json "
            "or FILE.yaml"
        ) from None
    return intrinsics_matrix(numbers, width, height)


def _intrinsics_in(path: Path) -> dict[str, Any]:
    """The content of a file, with the entries INTRINSICS, and width and height where it has them
    under any of their names."""
    values = _mapping_in(path)
    for key in ("width", "height"):
        if f"image_{key}" in values:  # as in calibrations of ROS
            values.setdefault(key, values[f"image_{key}"])
    named = [key for key in MATRICES if key in values]
    if named and not all(key in values for key in INTRINSICS):
        values |= dict(zip(INTRINSICS, _of_matrix(values[named[0]], f"{path}: {named[0]}")))
    missing = [key for key in INTRINSICS if key not in values]
    if missing:
        raise UserError(
            f"{path}: has no {', '.join(missing)}; expected {', '.join(INTRINSICS)}, or one of "
            f"{', '.join(MATRICES)} with the nine numbers of the camera's matrix"
        )
    for key in (*INTRINSICS, "width", "height"):
        if not _is_number(value := values.get(key, 0)):
            raise UserError(f"{path}: {key} is {value!r:.40}, expected a number")
    bent = [key for key in DISTORTION if any(map(_bends, _entries(values.get(key))))]
    if bent:
        warnings.warn(
            f"{path}: {bent[0]} says that the lens distorts, and images are read as those of a "
            "pinhole; undistort the colour and the depth image first, if that is not done",
            stacklevel=2,
        )
    return values


def _mapping_in(path: Path) -> dict[str, Any]:
    """The first document of a JSON or YAML file, or what it holds under `intrinsic`; empty where
    that is no mapping."""
    kind = path.suffix[1:].upper()
    try:
        if path.stat().st_size > LARGEST_INTRINSICS:
            raise UserError(f"{path}: has more than {LARGEST_INTRINSICS} bytes, this is no camera")
        text = path.read_text(encoding="utf-8")
        values = json.loads(text) if kind == "JSON" else load_yaml(_first_document(text))
    except FileNotFoundError:
        raise UserError(f"{path}: no such file") from None
    except UserError:
        raise
    except (OSError, *YAML_ERRORS) as error:  # a ValueError is also what JSON raises
        raise UserError(f"{path}: cannot be read as {kind} ({one_line(error)})") from error
    if isinstance(values, dict) and isinstance(values.get("intrinsic"), dict):
        values = values["intrinsic"]  # Open3D's PinholeCameraParameters
    return values if isinstance(values, dict) else {}


def _first_document(text: str) -> str:
    """A YAML text up to where its second document begins, as messages printed by ROS end, without
    the directive and the type that OpenCV's FileStorage writes, which are no YAML 1.1."""
    lines = text.replace("!!opencv-matrix", "").splitlines()
    if lines and lines[0].startswith("%YAML"):
        del lines[0]
    if lines and lines[0].rstrip() == "---":
        del lines[0]
    ends = [number for number, line in enumerate(lines) if line.rstrip() in ("---", "...")]
    return "\n".join(lines[: ends[0]] if ends else lines)


def _of_matrix(content: object, name: str) -> list[float]:
    """[fx, fy, cx, cy] of a camera's matrix: nine numbers, row by row or, as Open3D has them,
    column by column; in one list or three, or under `data`."""
    entries = _entries(content)
    if len(entries) != 9:
        raise UserError(f"{name}: holds {len(entries)} numbers, expected the 9 of a 3x3 matrix")
    wrong = [entry for entry in entries if not _is_number(entry)]
    if wrong:
        raise UserError(f"{name}: holds {wrong[0]!r:.40}, expected a number")
    K = np.array(entries, dtype=float).reshape(3, 3)
    if K[0, 2] == K[1, 2] == 0:
        K = K.T
    if not np.allclose([K[0, 1], K[1, 0], *K[2]], [0, 0, 0, 0, 1]):
        raise UserError(
            f"{name}: {_listed(entries)}: expected fx 0 cx 0 fy cy 0 0 1, the matrix of a pinhole "
            "without skew"
        )
    return [float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])]


def _entries(value: object) -> list[object]:
    """The entries of a list, of lists in a list, or of these under `data`; without that name, the
    values of a mapping; a lone value as one."""
    if isinstance(value, dict):
        value = value.get("data", list(value.values()))
    if not isinstance(value, list):
        return [] if value is None else [value]
    return [part for row in value for part in (row if isinstance(row, list) else [row])]


def _is_number(value: object) -> TypeGuard[float]:
    return type(value) in (int, float) and abs(value) <= sys.float_info.max  # type: ignore[arg-type]


def _bends(value: object) -> bool:
    """Whether an entry of a lens's coefficients is a number other than 0."""
    return _is_number(value) and value != 0


def intrinsics_matrix(
    numbers: Sequence[float], width: int, height: int, of_this_image: bool = False
) -> np.ndarray:
    """The (3, 3) K of [fx, fy, cx, cy] in pixels of an image of that size, once they are checked.

    Integer coordinates lie at pixel centres, as in OpenCV and ROS. of_this_image: the user says
    that they belong to this size, so that the principal point may lie beside the image, as in a
    part of a larger one.
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
    if not (of_this_image or (0 <= cx < width and 0 <= cy < height)):
        raise UserError(
            f"--intrinsics: the principal point ({cx:g}, {cy:g}) lies outside the image of "
            f"{width}x{height} pixels, as in intrinsics of another resolution; scale them to this "
            "one. If the image is a part of a larger one, give a JSON file with fx, fy, cx, cy and "
            f'"width": {width}, "height": {height}'
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
    if (far := float(np.linalg.norm(T[:3, 3]))) > FARTHEST_CAMERA:
        raise UserError(
            f"{path}: the camera stands {far:.4g} m from the world's origin, at most "
            f"{FARTHEST_CAMERA:g} m are allowed; is the pose in millimetres?"
        )
    rigid = np.eye(4)
    rigid[:3, :3] = Rotation.from_matrix(R).as_matrix()
    rigid[:3, 3] = T[:3, 3]
    return rigid


def _pose_numbers(path: Path) -> np.ndarray:
    try:
        suffix = path.suffix.lower()
        if suffix == ".npy":
            return np.asarray(load_array(path), dtype=float)
        if path.stat().st_size > LARGEST_POSE:
            raise UserError(f"{path}: has more than {LARGEST_POSE} bytes, this is no camera pose")
        text = path.read_text(encoding="utf-8")
        if suffix in (".json", ".yaml", ".yml"):
            content: Any = json.loads(text) if suffix == ".json" else load_yaml(text)
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
    except (OSError, TypeError, *YAML_ERRORS) as error:
        raise UserError(f"{path}: cannot be read as a 4x4 camera pose ({error})") from error


def _listed(numbers: Sequence[float]) -> str:
    return " ".join(f"{number:g}" for number in numbers)
