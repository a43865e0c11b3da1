"""Whether arm, hand and what it holds are clear of the cell at given joint positions.

The shapes are those that both simulators build the robot from (`envs.panda_model`), as points on
their surfaces; what stands in the cell for good is boxes. Objects are the planners' matter.
"""

from __future__ import annotations

import functools

import numpy as np
from scipy.spatial import ConvexHull, cKDTree

from envs.cell import Cell
from envs.cell_layout import Box, distance_to_box, table_box, tray_walls
from envs.panda_model import ARM_DISCS, ARM_LINKS, finger_hull, hull_of_discs, palm_hull
from envs.robot_kinematics import (
    GRASP_DEPTH,
    JOINT_LOWER,
    JOINT_UPPER,
    forward_kinematics,
    link_poses,
)
from utils.geometry import GripperGeometry

_APART = 0.008  # m, at most between a place on a link or the hand and the nearest of its points
# m kept around these points, so that a face keeps 6 mm; the arm follows its references to 2.
_MARGIN = 0.01
_HELD_MARGIN = 0.02  # m kept around the middle line of what the hand holds
_FIRST = 3  # of the links that are looked at: the lower ones turn over the robot's own base


def arm_is_clear(cell: Cell, q: np.ndarray) -> bool:
    """Whether the arm, but for its hand, stays clear of table, tray, the walls whose place is known
    (`Scene.known_walls`) and its joints' limits at joint positions q (N, 7)."""
    margin = cell.config.safety.joint_margin
    if (q < JOINT_LOWER + margin).any() or (q > JOINT_UPPER - margin).any():
        return False  # where a curve between waypoints may leave the limits
    boxes = [table_box(), *tray_walls(), *_known_walls(cell)]
    poses = link_poses(q)[:, _FIRST - 1 :]
    return all(
        _is_clear(places, points, box)
        for places, points in zip(poses.swapaxes(0, 1), _link_surfaces())
        for box in boxes
    )


def _is_clear(poses: np.ndarray, points: np.ndarray, box: Box, margin: float = _MARGIN) -> bool:
    """Whether a body stays more than `margin` m from a box at poses (N, 4, 4). points: (P, 3) m in
    its frame."""
    middle = points.mean(axis=0)
    reach = np.linalg.norm(points - middle, axis=1).max()
    near = distance_to_box(_placed(poses, middle[None]), box)[:, 0] <= reach + margin
    places = _placed(poses[near], points)
    return bool(distance_to_box(places, box).min(initial=np.inf) > margin)


def _placed(poses: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(N, P, 3) points (P, 3) of a body's frame at poses (N, 4, 4)."""
    return points @ poses[:, :3, :3].swapaxes(1, 2) + poses[:, None, :3, 3]


def hand_is_clear(cell: Cell, q: np.ndarray, held: np.ndarray | None = None) -> bool:
    """Whether the hand stays clear of the walls whose place is known at joint positions q (N, 7).
    held: (M, 3) metres in E, points on an object that it holds."""
    poses = np.array([forward_kinematics(at) for at in q])
    return all(
        _is_clear(poses, hand_points(cell.gripper), wall)
        and (held is None or _is_clear(poses, held, wall, _HELD_MARGIN))
        for wall in _known_walls(cell)
    )


def _known_walls(cell: Cell) -> tuple[Box, ...]:
    return cell.scene.known_walls if cell.scene else ()


def held_points(T_WE: np.ndarray) -> np.ndarray:
    """(M, 3) metres in E: points on an object on the table, gripped at T_WE (4, 4), of which only
    the place of its lower end is known: it may be as long on the other side of the hand."""
    below = T_WE[:3, :3].T @ np.array([0.0, 0.0, max(T_WE[2, 3], 0.0)])
    return np.linspace(-1, 1, 9)[:, None] * below


@functools.lru_cache
def hand_points(gripper: GripperGeometry) -> np.ndarray:
    """(M, 3) metres in E: points on the surface of the hand, its fingers open."""
    finger = surface_points(finger_hull(gripper), _APART)
    outside = finger + (0.0, gripper.max_opening / 2, gripper.tip_below_centre - finger[:, 2].max())
    palm = surface_points(palm_hull(gripper), _APART) - (0.0, 0.0, GRASP_DEPTH)
    return np.concatenate([palm, outside, outside * (1, -1, 1)])


@functools.lru_cache
def _link_surfaces() -> list[np.ndarray]:
    """Of each link from `_FIRST` on, points (P, 3) on its surface, m in the link's frame."""
    links = ARM_LINKS[_FIRST - 1 :]
    return [surface_points(hull_of_discs(ARM_DISCS[link]), _APART) for link in links]


def surface_points(hull: np.ndarray, apart: float) -> np.ndarray:
    """(P, 3) points on the surface of the convex hull of points (V, 3), of which no place on it is
    farther away than `apart` m."""
    fine = []
    for corners in hull[ConvexHull(hull).simplices]:
        longest = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).max()
        count = int(np.ceil(2 * longest / apart))
        i, j = np.triu_indices(count + 1)
        fine.append(np.column_stack([i, j - i, count - j]) / count @ corners)
    # In a triangle with sides of at most apart / 2, a corner is within 0.29 apart of any place.
    points, kept = np.concatenate(fine), []
    near, left = cKDTree(points), np.ones(len(points), bool)
    for number, point in enumerate(points):
        if left[number]:
            kept.append(number)
            left[near.query_ball_point(point, 0.7 * apart)] = False
    return points[kept]
