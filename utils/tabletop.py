"""The table under an object: where a depth image shows it, and motions in its plane.

Frames: C camera, W world, P the table as the camera sees it (origin below the camera, z up).
"""

from __future__ import annotations

import numpy as np

from utils.servo_errors import TargetLostError
from utils.transforms import inverse_pose, known_depth

_PLANE_BANDS = (0.035, 0.012, 0.004)  # m around the expected table, narrower and narrower
_PLANE_SHARE = 0.15  # of the known pixels that have to lie on the table


def table_plane(depth: np.ndarray, K: np.ndarray, T_CW: np.ndarray, table: float = 0.0):
    """(3,) unit normal towards the camera and offset d (metres) of the table, n . p + d = 0 in C.

    Least squares on the pixels near the plane z = `table` of W, which T_CW (4, 4) has to tell to a
    few centimetres only. Raises TargetLostError where too little of it is seen.
    """
    step = max(1, int(np.sqrt(depth.size / 8000)))
    z = depth[::step, ::step].astype(float)
    v, u = np.mgrid[0 : depth.shape[0] : step, 0 : depth.shape[1] : step]
    points = np.stack([(u - K[0, 2]) / K[0, 0] * z, (v - K[1, 2]) / K[1, 1] * z, z], axis=-1)
    points = points[known_depth(z)]
    normal = T_CW[:3, 2].copy()
    offset = -normal @ (T_CW[:3, 3] + table * normal)
    for band in _PLANE_BANDS:
        near = points[np.abs(points @ normal + offset) < band]
        if len(near) < max(50, _PLANE_SHARE * len(points)):
            raise TargetLostError("target lost: the table it stands on is not in the depth image")
        centre = near.mean(axis=0)
        axis = np.linalg.eigh((near - centre).T @ (near - centre))[1][:, 0]
        normal = axis if axis @ normal > 0 else -axis
        offset = -normal @ centre
    return normal, float(offset)


def table_frame(normal: np.ndarray, offset: float) -> np.ndarray:
    """(4, 4) T_PC of a table n . p + d = 0 in C: P lies on it below the camera, z up."""
    x = np.array([1.0, 0, 0]) - normal[0] * normal
    x /= np.linalg.norm(x)
    T_CP = np.eye(4)
    T_CP[:3, :3] = np.column_stack([x, np.cross(normal, x), normal])
    T_CP[:3, 3] = -offset * normal
    return inverse_pose(T_CP)


def planar(x: float, y: float, turn: float) -> np.ndarray:
    """(4, 4) motion in the plane: a turn about z, then a shift."""
    T = np.eye(4)
    c, s = np.cos(turn), np.sin(turn)
    T[:2, :2], T[:2, 3] = [[c, -s], [s, c]], (x, y)
    return T


def planar_part(T: np.ndarray) -> tuple[float, float, float]:
    """x, y and turn about z of a (4, 4) pose whose z axis is nearly that of its parent."""
    return float(T[0, 3]), float(T[1, 3]), float(np.arctan2(T[1, 0] - T[0, 1], T[0, 0] + T[1, 1]))
