"""The errors that a user can repair, each a class, and the wording that several messages share.

`UserError` is the base. A visual servo raises one subclass for each fault of its input, and never
returns a velocity for a faulty input: a zero velocity would be taken for success.
"""

from __future__ import annotations

import difflib
import struct
import zipfile
import zlib
from collections.abc import Iterable

# What numpy and zipfile raise on a damaged .npz, depending on where the damage is.
UNREADABLE_NPZ = (
    OSError, EOFError, KeyError, ValueError, TypeError, IndexError, AttributeError, MemoryError,
    OverflowError, NotImplementedError, SyntaxError, struct.error, zipfile.BadZipFile, zlib.error,
)  # fmt: skip


class UserError(ValueError):
    """Bad input that its author can repair; the message says what, where, and what to do.

    Scripts print it as one line without a traceback, see `utils.runs.run_script`.
    """


class RecurringError(UserError):
    """One that a run of the same config meets again, so that it cannot simply go on."""


def did_you_mean(value: object, known: Iterable[str]) -> str:
    """'; did you mean X?' with the nearest known name, or '' when nothing is near."""
    near = difflib.get_close_matches(str(value), list(known), n=1, cutoff=0.6)
    return f"; did you mean {near[0]}?" if near else ""


def one_line(error: BaseException) -> str:
    """An error's message on one line, whatever line breaks it has."""
    return " ".join(str(error).split())


def unknown_choice(where: str, value: object, known: Iterable[str]) -> UserError:
    """The error for a name that is none of `known`, e.g. a planner's name in a config."""
    known = sorted(known)
    return UserError(
        f"{where}: got {value!r}, expected one of {', '.join(known)}{did_you_mean(value, known)}"
    )


class ServoError(UserError):
    """Any input from which no velocity can be computed."""


class CameraMatrixError(ServoError):
    """K is no pinhole camera matrix, or the camera's description is incomplete."""


class FeatureCountError(ServoError):
    """There are fewer than three points, or the current and desired points differ in number."""


class TargetLostError(ServoError):
    """The image shows too little of the target to determine its pose."""


class PointError(ServoError):
    """A point is not finite or lies outside the image."""


class CollinearPointsError(ServoError):
    """All points lie on one line, so that they do not determine the rotation about it."""


class DepthError(ServoError):
    """A depth is missing, zero, not finite or behind the camera."""


class PoseError(ServoError):
    """A pose is missing or is no rigid transform."""


class SingularMatrixError(ServoError):
    """The matrix to be inverted is singular and neither damping nor truncation was asked for."""
