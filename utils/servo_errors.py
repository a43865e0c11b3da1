"""What can be wrong with a servo's input, each by its own name.

A servo never answers bad input with a velocity, least of all a zero one that looks like success.
"""

from __future__ import annotations

from utils.errors import UserError


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
