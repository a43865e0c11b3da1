"""Frames of boxes on the table, rendered by a closed form; many tests know what is in them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from utils.geometry import ConvexSolid, SceneGeometry, SolidObject
from utils.transforms import RGBDFrame, look_at, pose_matrix

CORNERS = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
K = np.array([[390.6, 0, 111.5], [0, 390.6, 111.5], [0, 0, 1.0]])  # 224 px, 32 degrees
T_WC = look_at((0.5, 0, 0.8), (0.5, 0, 0), up=(1, 0, 0))
BOX = ((0.06, 0.08, 0.10), 0.0, (0.5, 0.0))  # size, yaw, place as of `boxes_frame`
# A flat box between two walls of boxes: no finger fits beside it, whose long side is too wide.
FLAT = ((0.03, 0.09, 0.03), 0.0, (0.5, 0.0))
TALL = [((0.03, 0.09, 0.06), 0.0, (0.5 + side * 0.035, 0.0)) for side in (-1, 1)]
MIDDLE = np.array([0.5, 0.0, 0.0])  # of the workspace, in W


def yaw_pose(x: float, y: float, z: float, yaw: float) -> np.ndarray:
    return pose_matrix((x, y, z), (0, 0, np.sin(yaw / 2), np.cos(yaw / 2)))


def boxes_frame(
    boxes: list[tuple[tuple[float, float, float], float, tuple[float, ...]]],
    walls: int = 0,
    focal: float = 390.6,
    T_WC: np.ndarray = T_WC,
) -> RGBDFrame:
    """The frame of boxes (size, yaw, (x, y)) standing on the table, or (x, y, z) hanging over it,
    z being the lower side; depth by the slab formula. The last `walls` of them are walls. focal:
    pixels. T_WC: (4, 4) of the camera."""
    v, u = np.mgrid[0:224, 0:224]
    rays = (
        np.stack([(u - 111.5) / focal, (v - 111.5) / focal, np.ones_like(u)], axis=-1)
        @ T_WC[:3, :3].T
    )
    eye = T_WC[:3, 3]
    depth = -eye[2] / rays[..., 2]
    objects = []
    for size, yaw, (x, y, *lower) in boxes:
        half = np.array(size) / 2
        T = yaw_pose(x, y, half[2] + sum(lower), yaw)
        local_eye, local_rays = (eye - T[:3, 3]) @ T[:3, :3], rays @ T[:3, :3]
        with np.errstate(divide="ignore"):
            slabs = np.sort([(s * half - local_eye) / local_rays for s in (-1, 1)], axis=0)
        near, far = slabs[0].max(axis=-1), slabs[1].min(axis=-1)
        depth = np.where((near < far) & (near < depth), near, depth)
        solid = ConvexSolid.from_vertices(CORNERS * half).transformed(T)
        objects.append(SolidObject((solid,), T[:3, 3], 0.7))
    rgb = np.zeros((224, 224, 3), np.uint8)
    count = len(objects) - walls
    truth = SceneGeometry(
        tuple(objects[:count]), walls=tuple(wall.solids[0] for wall in objects[count:])
    )
    seen_by = np.array([[focal, 0, 111.5], [0, focal, 111.5], [0, 0, 1.0]])
    return RGBDFrame(rgb, depth.astype(np.float32), seen_by, T_WC, truth=truth)


def shelf_frame(things: list) -> RGBDFrame:
    """Boxes under a board, its lower side 0.3 m over the table and its front edge at y = 0.07,
    which a back holds at y = -0.18; seen from the open side, 61 degrees off the vertical."""
    shelf = [((0.40, 0.26, 0.02), 0.0, (0.5, -0.06, 0.30)), ((0.40, 0.02, 0.30), 0.0, (0.5, -0.18))]
    view = look_at((0.5, 0.65, 0.49), (0.5, -0.05, 0.10), (0.0, 0.0, 1.0))
    frame = boxes_frame([*things, *shelf], walls=2, T_WC=view)
    return replace(frame, fixtures=frame.truth.walls)


def bin_walls(half: float = 0.15, height: float = 0.10, thick: float = 0.01) -> list:
    """Four walls of a bin around the middle of the workspace, as boxes of `boxes_frame`."""
    off, long = half + thick / 2, 2 * (half + thick)
    return [((thick, long, height), 0.0, (0.5 + side * off, 0.0)) for side in (-1, 1)] + [
        ((long, thick, height), 0.0, (0.5, side * off)) for side in (-1, 1)
    ]


def from_side(azimuth: float, tilt: float = 45.0, distance: float = 0.6) -> np.ndarray:
    """T_WC of a camera that looks at the workspace's middle; degrees and metres."""
    turn, lean = np.deg2rad(azimuth), np.deg2rad(tilt)
    out = np.array([np.sin(lean) * np.cos(turn), np.sin(lean) * np.sin(turn), np.cos(lean)])
    return look_at(MIDDLE + distance * out, MIDDLE)


def seen_from(*azimuths: float, boxes=(BOX,)) -> RGBDFrame:
    """Boxes from one or two sides, in degrees; the second frame is the first one's `second`."""
    first, *others = (boxes_frame(list(boxes), T_WC=from_side(turn)) for turn in azimuths)
    return replace(first, second=others[0]) if others else first
