"""What a camera straight above the table would see of an RGB-D image that was taken from the side.

A network that has learned from above knows no other view. Every known pixel goes to where its point
lies; what the image does not show is bare table, as in a height map. This module knows no network.
"""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np

from utils.depth_holes import nearest_values
from utils.geometry import Workspace
from utils.transforms import RGBDFrame, deproject, known_depth, look_at, project

DISTANCE = 0.8  # m over the table, as the cell's overhead camera
ON_TABLE = 0.01  # m over the table, up to which a pixel lends its colour to hidden table
PARTS = (-0.25, 0.25)  # each pixel stands for points of its square, two by two


def overhead_view(
    frame: RGBDFrame, workspace: Workspace, metres_per_pixel: float, margin: float = 0.0
) -> RGBDFrame:
    """The workspace widened by `margin` (metres) as seen from DISTANCE above its middle, in pixels
    that span `metres_per_pixel` of the table, whose +v runs along the world's -y.

    The highest of the points that fall into a pixel is seen. Where there is none the depth is the
    table's, and the colour that of the nearest table.
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
    u, v = np.rint(pixels).astype(int).T
    inside = np.flatnonzero((u >= 0) & (u < size) & (v >= 0) & (v < size))
    inside = inside[np.argsort(-far[inside], kind="stable")]  # the nearest is written last
    at = v[inside], u[inside]
    depth[at], seen[at] = far[inside], True
    rgb[at] = colours[inside]

    table = seen & (depth > DISTANCE - ON_TABLE)
    if table.any():
        rgb = np.where(seen[..., None], rgb, nearest_values(rgb, table))
    return replace(frame, rgb=rgb, depth=depth, K=K, T_WC=T_WC, segmentation=None, truth=None)


def _points(frame: RGBDFrame) -> tuple[np.ndarray, np.ndarray]:
    """(N, 3) points in W of all parts of the known pixels, and their colours (N, 3)."""
    row, column = np.nonzero(known_depth(frame.depth))
    depth, colour = frame.depth[row, column], frame.rgb[row, column]
    parts = [
        deproject(np.stack([column + du, row + dv], axis=-1), depth, frame.K, frame.T_WC)
        for dv, du in itertools.product(PARTS, PARTS)
    ]
    return np.concatenate(parts), np.concatenate([colour] * len(parts))
