"""Photographs whose geometry is known exactly: a box on a table, seen from the side."""

from __future__ import annotations

import numpy as np

from models.photographs import K
from utils.rectangles import GraspRectangle, RealSample
from utils.transforms import RGBDFrame, deproject, look_at

# Cornell's camera looks down like this: 0.73 m over the table, 37 degrees from straight down.
T_WC = look_at((0.0, -0.55, 0.73), (0.0, 0.0, 0.0))
ROBOT = np.array([-0.3, -0.9, 0.1])
ROBOT_BEFORE = np.array([0.0, 0.8, 0.2])  # in the camera's frame, below its middle and before it
BOX = np.array([0.06, 0.16, 0.08])  # m along x, y and z, in the middle of the view
GREY, RED = (200, 200, 200), (180, 30, 30)


def photographed(
    box: np.ndarray | None = BOX, noise: float = 0.0, labels: tuple[GraspRectangle, ...] = ()
) -> tuple[RealSample, RGBDFrame]:
    """The sample whose depths are distances from ROBOT, and the true frame; by the slab formula."""
    v, u = np.mgrid[:480, :640]
    rays = deproject(np.stack([u, v], axis=-1), np.ones(u.shape), K, T_WC) - T_WC[:3, 3]
    depth, rgb = -T_WC[2, 3] / rays[..., 2], np.full((480, 640, 3), GREY, np.uint8)
    if box is not None:
        low, high = np.array([-box[0] / 2, -box[1] / 2, 0.0]), np.array([*box[:2] / 2, box[2]])
        slabs = np.sort([(side - T_WC[:3, 3]) / rays for side in (low, high)], axis=0)
        near, far = slabs[0].max(axis=-1), slabs[1].min(axis=-1)
        hit = (near < far) & (near < depth)
        depth, rgb[hit] = np.where(hit, near, depth), RED
    frame = RGBDFrame(rgb, depth.astype(np.float32), K, T_WC)
    distance = np.linalg.norm(frame.points() - ROBOT, axis=-1)
    distance += noise * np.random.default_rng(0).standard_normal(distance.shape)
    return RealSample("pcd0100", "box", rgb, distance.astype(np.float32), labels), frame
