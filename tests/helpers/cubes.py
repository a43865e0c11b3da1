"""A scene of one cube, and the grasp through its middle."""

from __future__ import annotations

import numpy as np

from envs.cell_layout import Placement, Scene
from utils.transforms import Grasp


def cube_scene(box_set, position=(0.5, 0.0, 0.03), yaw=0.0) -> Scene:
    """One 6 cm cube lying flat at a known place."""
    quaternion = np.array([0, 0, np.sin(yaw / 2), np.cos(yaw / 2)])
    return Scene("isolated", 0, (Placement(box_set[0], np.array(position), quaternion),))


def cube_grasp(angle=0.0, offset=(0.0, 0.0, 0.0), width=0.08) -> Grasp:
    return Grasp(np.array([0.5, 0.0, 0.03]) + offset, angle, width, 1.0)
