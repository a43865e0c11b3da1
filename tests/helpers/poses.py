"""Poses that tests write down as a position and three angles."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation


def pose(position, degrees, R: np.ndarray) -> np.ndarray:
    """(4, 4) pose at a position (3,), turned from R (3, 3) about its own x, y and z in turn."""
    T = np.eye(4)
    T[:3, :3] = R @ Rotation.from_euler("XYZ", degrees, degrees=True).as_matrix()
    T[:3, 3] = position
    return T
