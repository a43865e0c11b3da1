"""Errors that are the user's to fix, each one sentence.

This module knows nothing about what went wrong; it only fixes how it is said.

What can be wrong with a servo's input, each by its own name.

A servo never answers bad input with a velocity, least of all a zero one that looks like success.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class UserError(ValueError):
    """Bad input that its author can repair; the message says what, where, and what to do.

    Scripts print it as one line without a traceback, see `utils.config.run_script`.
    """


def did_you_mean(value: object, known: Iterable[str]) -> str:
    """'; did you mean X?' with the nearest known name, or '' when nothing is near."""
    near = difflib.get_close_matches(str(value), list(known), n=1, cutoff=0.6)
    return f"; did you mean {near[0]}?" if near else ""


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
    """Fewer than three points, or as many as on the other side are not there."""


class TargetLostError(ServoError):
    """What is servoed to, or so much of it that its place is unsure, is not in the image."""


class PointError(ServoError):
    """A point is not finite or lies outside the image."""


class CollinearPointsError(ServoError):
    """All points lie on one line, so that the motion about it cannot be seen."""


class DepthError(ServoError):
    """A depth is missing, zero, not finite or behind the camera."""


class PoseError(ServoError):
    """A pose is missing or is no rigid transform."""


class SingularMatrixError(ServoError):
    """The matrix to be inverted is singular and neither damping nor truncation was asked for."""
