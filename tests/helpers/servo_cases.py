"""Cameras, views and strategies that the tests of visual servoing share."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from utils.servo_reference import CAMERA
from utils.visual_servo import HybridVisualServo, ImageBasedVisualServo, PositionBasedVisualServo

CORNERS = np.array([[220.0, 140], [420, 140], [420, 340], [220, 340]])  # pixels, a square
LAWS = (
    ImageBasedVisualServo(CAMERA),
    PositionBasedVisualServo(CAMERA),
    HybridVisualServo(CAMERA),
    HybridVisualServo(CAMERA, scheme="2.5d"),
)
LAW_NAMES = ("image", "position", "blend", "2.5d")

unit = st.floats(-1, 1)
directions = (
    st.tuples(unit, unit, unit)
    .map(np.array)
    .filter(lambda v: np.linalg.norm(v) > 0.1)
    .map(lambda v: v / np.linalg.norm(v))
)
twists = st.tuples(*[st.floats(-1.5, 1.5)] * 6).map(np.array)


def derivative(function, step=1e-5):
    """The central difference of a function of time at 0."""
    return (function(step) - function(-step)) / (2 * step)
