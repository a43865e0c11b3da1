"""The dense stage of the antipodal search: runs of matter that may fit between the fingers.

The height map is turned to every angle, so that the closing line lies along its rows; a run is what
rises over a height of the fingertips without a gap. It is a candidate where the fingers find room
at both ends, the palm over it, and the faces look along the line. `models.fan_search` does the same
for a fan of views with PyTorch.
"""

from __future__ import annotations

import itertools

import cv2
import numpy as np

from models.planner_candidates import Candidates, SearchSettings
from utils.geometry import GripperGeometry, Workspace
from utils.height_map import OTHER_LABEL, HeightMap
from utils.transforms import transform_points

NOWHERE = -1e3  # m, under everything
EDGE_BLUR = 0.002  # m, standard deviation over the heights whose gradients are edges
MOST_AT_ONCE = 2**19  # cells of turned maps


def dense_candidates(
    heights: HeightMap, gripper: GripperGeometry, workspace: Workspace, settings: SearchSettings
) -> Candidates:
    """Runs of matter that may fit between the fingers, for every angle, fingertip height and row
    of the map."""
    cell, on_objects = heights.cell, heights.label >= 0
    levels = _levels(heights, on_objects, gripper, settings)
    if len(levels) == 0:
        return Candidates.rough(np.empty((0, 2)), *np.empty((4, 0)))
    # A square that holds all graspable matter, and fingers beside it, at any angle.
    matter = np.argwhere(on_objects)[:, ::-1]
    first, last = matter.min(axis=0), matter.max(axis=0)
    centre_cell, thickness = (first + last) // 2, gripper.finger_outline[1][0]
    beside = (gripper.max_opening if gripper.opens_fully else max(settings.rooms)) + 2 * thickness
    beside += 2 * np.abs(settings.offsets).max()
    if (heights.label == OTHER_LABEL).any():  # what is not to be grasped may be under the palm
        beside += gripper.palm_half_length
    half = int(np.linalg.norm(last - first) / 2 + beside / cell) + 2
    size, middle = 2 * half + 1, heights.origin + cell * centre_cell
    # Gradients of the blurred map point across an edge whatever its height.
    slope = np.stack(
        np.gradient(cv2.GaussianBlur(heights.height, (0, 0), EDGE_BLUR / cell))[::-1], axis=-1
    )
    finger = np.ones(
        (2 * int(gripper.finger_half_width / cell) + 1, int(thickness / cell)), np.uint8
    )
    palm_half = int(gripper.palm_outline[1][0] / cell), int(gripper.palm_half_length / cell)
    palm = np.ones((2 * palm_half[0] + 1, 2 * palm_half[1] + 1), np.uint8)
    # Only what stands on the table is gripped; the table itself is in the way of a tilted hand.
    standing = np.where(heights.label == -1, NOWHERE, heights.height).astype(np.float32)
    ground = float(heights.height.min())
    every_angle = np.arange(settings.angles) * np.pi / settings.angles
    # As many at once as make few array operations, but no large arrays.
    count = max(1, MOST_AT_ONCE // size**2)
    parts = []
    for one in range(0, len(every_angle), count):
        angles = every_angle[one : one + count]
        along = np.column_stack([np.cos(angles), np.sin(angles)])
        across = np.column_stack([-along[:, 1], along[:, 0]])
        turned, objects, under_finger, under_palm = np.empty(
            (4, len(angles), size, size), np.float32
        )
        for n in range(len(angles)):
            axes = np.column_stack([along[n], across[n]])
            warp = np.column_stack([axes, centre_cell - axes @ (half, half)])
            for image, outside, out in (
                (heights.height, ground, turned[n]), (standing, NOWHERE, objects[n]),
            ):  # fmt: skip
                cv2.warpAffine(
                    image, warp, (size, size), out, flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP,
                    borderValue=outside,
                )  # fmt: skip
            cv2.dilate(turned[n], finger, under_finger[n])
            cv2.dilate(turned[n], palm, under_palm[n])

        # Of these angles at once: rows of the turned maps, one map under the other.
        turned, under_finger, under_palm = (
            maps.reshape(-1, size) for maps in (turned, under_finger, under_palm)
        )
        level, row, first, last = _runs(
            objects, levels, gripper.max_opening - 2 * settings.rooms[0], cell
        )
        tip, centre = levels[level], np.rint((first + last) / 2).astype(int)
        away = np.rint(np.divide(settings.offsets, cell)).astype(int)[:, None]
        under_hand = under_palm[row, np.clip(centre + away, 0, size - 1)].min(axis=0)
        free = under_hand < tip - settings.clearance + gripper.palm_height
        row, first, last, tip = row[free], first[free], last[free], tip[free]
        limit, free = tip - settings.clearance, np.zeros(len(tip), bool)
        rooms = settings.rooms  # a sloping flank needs more room
        if gripper.opens_fully:
            rooms = ((gripper.max_opening - (last - first + 1) * cell) / 2,)
        for room, away in itertools.product(rooms, settings.offsets):
            beside = room + thickness / 2  # from the contact to the finger's middle
            # Beside a wall it may be outside.
            left = np.rint(first - (beside + max(-2 * away, 0)) / cell).astype(int)
            right = np.rint(last + (beside + max(2 * away, 0)) / cell).astype(int)
            left, right = np.maximum(left, 0), np.minimum(right, size - 1)
            fits = (under_finger[row, left] < limit) & (under_finger[row, right] < limit)
            opening = (last - first + 1) * cell + 2 * (room + abs(away))
            free |= fits & (opening < gripper.max_opening + 2 * cell)
        row, first, last, tip = row[free], first[free], last[free], tip[free]

        rise = turned[row, first] - tip
        angle, row = np.divmod(row, size)
        along, across, angle = along[angle], across[angle], angles[angle]
        base = middle + cell * (row - half)[:, None] * across
        at_first, at_inside, xy, at_last = (
            base + cell * (column - half)[:, None] * along
            for column in (first, first + 1.5, (first + last) / 2, last)
        )
        place = transform_points(heights.T_WV, np.column_stack([xy, tip]))[:, :2]
        reach = np.abs(place - workspace.centre).max(axis=1) < workspace.size / 2 + settings.reach
        # Outward normals are minus the gradient: cosines against the closing line on both sides.
        facing = np.minimum(
            (_unit(slope[heights.index(at_first)]) * along).sum(axis=1),
            -(_unit(slope[heights.index(at_last)]) * along).sum(axis=1),
        )
        inside = heights.label[heights.index(at_inside)]
        arm = np.abs(((heights.centres[np.maximum(inside, -1), :2] - xy) * across).sum(axis=1))
        score = np.exp(-((arm / 0.03) ** 2)) * np.clip(facing, 0, 1) ** 2
        score *= (
            reach
            * (inside >= 0)
            * (facing > settings.min_facing)
            * np.clip(rise / settings.good_engagement, 0.2, 1)
        )
        parts.append(Candidates.rough(xy, angle, tip, (last - first + 1) * cell, score))
    return Candidates.joined(parts)


def _unit(slope: np.ndarray) -> np.ndarray:
    """(N, 2) slopes as unit vectors, and 0 where it is level."""
    return slope / (np.linalg.norm(slope, axis=-1, keepdims=True) + 1e-9)


def _levels(
    heights: HeightMap, on_objects: np.ndarray, gripper: GripperGeometry, settings: SearchSettings
) -> np.ndarray:
    """(L,) heights of the fingertips to try: over the table, and no deeper below the lowest matter
    than the palm lets them reach; may be empty. on_objects: (R, C) bool."""
    if not on_objects.any() or len(heights.centres) == 0:
        return np.empty(0)
    lowest = float(heights.table()[on_objects].min()) + settings.table_clearance
    height = heights.height[on_objects]
    useless = height.min() - gripper.palm_height - lowest  # the palm would meet the matter
    first = lowest + settings.level_step * max(np.floor(useless / settings.level_step), 0.0)
    return np.arange(first, height.max() - settings.min_engagement, settings.level_step)


def _runs(
    turned: np.ndarray, levels: np.ndarray, max_width: float, cell: float
) -> tuple[np.ndarray, ...]:
    """Runs of cells over a level along the rows of maps (A, R, C): level, row of all A x R, first
    and last column, each (M,), sorted by map.

    A run may bridge a gap to the next one or two of its row (a ring, a mug). Every second row is
    enough: the pad spans several.
    """
    maps, rows, columns = turned.shape
    above = turned.max(axis=2) > levels[0]
    picked = np.concatenate(
        [n * rows + _every_second(np.flatnonzero(above[n])) for n in range(maps)]
    )
    # No matter at both ends of a row, so that every run has a first and a last cell there.
    columns += 2
    matter = np.zeros((len(levels), len(picked), columns), bool)
    flat = turned.reshape(-1, columns - 2)[picked]
    np.greater(flat, levels[:, None, None], out=matter[..., 1:-1])
    matter = matter.reshape(-1)
    line, place = np.divmod(np.flatnonzero(matter[1:] != matter[:-1]), columns)
    line, first, last = line[::2], place[::2], place[1::2] - 1
    found = []
    for bridge in range(3):
        n = max(len(line) - bridge, 0)
        fits = line[:n] == line[bridge:]
        fits &= (last[bridge:] - first[:n] + 1) * cell < max_width + cell
        found.append((line[:n][fits], first[:n][fits], last[bridge:][fits]))
    line, first, last = (np.concatenate(column) for column in zip(*found))
    level, row = np.divmod(line, max(len(picked), 1))
    row = picked[row]
    order = np.argsort(row // rows, kind="stable")
    return level[order], row[order], first[order], last[order]


def _every_second(rows: np.ndarray) -> np.ndarray:
    """Every second row from the first to the last of some."""
    return np.arange(rows[0], rows[-1] + 1, 2) if len(rows) else rows
