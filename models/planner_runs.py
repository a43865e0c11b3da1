"""The dense stage of the antipodal search: runs of matter that may fit between the fingers.

The height map is turned to every angle, so that the closing line lies along its rows; a run is what
rises over a height of the fingertips without a gap. It is a candidate where the fingers find room
at both ends, the palm over it, and the faces look along the line. `models.fan_search` does the same
for a fan of views with PyTorch.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import cv2
import numpy as np

from models.planner_candidates import Candidates, SearchSettings, closing_axes
from utils.geometry import GripperGeometry, Workspace
from utils.height_map import OTHER_LABEL, HeightMap
from utils.transforms import transform_points

NOWHERE = -1e3  # m, under everything
EDGE_BLUR = 0.002  # m, standard deviation over the heights whose gradients are edges
MOST_AT_ONCE = 2**19  # cells of turned maps


class _Square(NamedTuple):
    """What of a map is turned: all graspable matter, and fingers beside it, at any angle. centre:
    (2,) column and row of the middle cell. half: cells from there to a side."""

    centre: np.ndarray
    half: int

    @property
    def size(self) -> int:
        return 2 * self.half + 1


class _Turned(NamedTuple):
    """The square at some angles, so that the closing line lies along its rows. angles: (A,).
    heights, objects, under_finger and under_palm: (A, S, S) m, of everything, of what stands on the
    table, and the highest matter in reach of a finger and of the palm around each cell."""

    angles: np.ndarray
    heights: np.ndarray
    objects: np.ndarray
    under_finger: np.ndarray
    under_palm: np.ndarray


class _Runs(NamedTuple):
    """M runs of matter over a height of the fingertips. row: (M,) of all turned maps, one under the
    other. first, last: (M,) columns. tip: (M,) m."""

    row: np.ndarray
    first: np.ndarray
    last: np.ndarray
    tip: np.ndarray

    def take(self, index: np.ndarray) -> _Runs:
        return _Runs(*(column[index] for column in self))


def dense_candidates(
    heights: HeightMap, gripper: GripperGeometry, workspace: Workspace, settings: SearchSettings
) -> Candidates:
    """Runs of matter that may fit between the fingers, for every angle, fingertip height and row
    of the map."""
    levels = _levels(heights, gripper, settings)
    if len(levels) == 0:
        return Candidates.rough(np.empty((0, 2)), *np.empty((4, 0)))
    square, slope = _square(heights, gripper, settings), _slopes(heights)
    angles = np.arange(settings.angles) * np.pi / settings.angles
    # As many at once as make few array operations, but no large arrays.
    count = max(1, MOST_AT_ONCE // square.size**2)
    parts = []
    for one in range(0, len(angles), count):
        turned = _turned(heights, square, angles[one : one + count], gripper)
        widest = gripper.max_opening - 2 * settings.rooms[0]
        runs = _runs(turned.objects, levels, widest, heights.cell)
        runs = _under_a_palm(runs, turned, heights.cell, gripper, settings)
        runs = _between_fingers(runs, turned, heights.cell, gripper, settings)
        parts.append(_scored(runs, turned, square, slope, heights, workspace, settings))
    return Candidates.joined(parts)


def _square(heights: HeightMap, gripper: GripperGeometry, settings: SearchSettings) -> _Square:
    matter = np.argwhere(heights.label >= 0)[:, ::-1]
    first, last = matter.min(axis=0), matter.max(axis=0)
    beside = gripper.max_opening if gripper.opens_fully else max(settings.rooms)
    beside += 2 * gripper.finger_thickness
    beside += 2 * np.abs(settings.offsets).max()
    if (heights.label == OTHER_LABEL).any():  # what is not to be grasped may be under the palm
        beside += gripper.palm_half_length
    half = int(np.linalg.norm(last - first) / 2 + beside / heights.cell) + 2
    return _Square((first + last) // 2, half)


def _turned(
    heights: HeightMap, square: _Square, angles: np.ndarray, gripper: GripperGeometry
) -> _Turned:
    cell, size, half = heights.cell, square.size, square.half
    finger = np.ones(
        (2 * int(gripper.finger_half_width / cell) + 1, int(gripper.finger_thickness / cell)),
        np.uint8,
    )
    palm_half = int(gripper.palm_half_width / cell), int(gripper.palm_half_length / cell)
    palm = np.ones((2 * palm_half[0] + 1, 2 * palm_half[1] + 1), np.uint8)
    # Only what stands on the table is gripped; the table itself is in the way of a tilted hand.
    standing = np.where(heights.label == -1, NOWHERE, heights.height).astype(np.float32)
    ground = float(heights.height.min())
    turned = _Turned(angles, *np.empty((4, len(angles), size, size), np.float32))
    for n, angle in enumerate(angles):
        axes = np.column_stack(closing_axes(angle))
        warp = np.column_stack([axes, square.centre - axes @ (half, half)])
        for image, outside, out in (
            (heights.height, ground, turned.heights[n]), (standing, NOWHERE, turned.objects[n]),
        ):  # fmt: skip
            cv2.warpAffine(
                image, warp, (size, size), out, flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP,
                borderValue=outside,
            )  # fmt: skip
        cv2.dilate(turned.heights[n], finger, turned.under_finger[n])
        cv2.dilate(turned.heights[n], palm, turned.under_palm[n])
    return turned


def _under_a_palm(
    runs: _Runs, turned: _Turned, cell: float, gripper: GripperGeometry, settings: SearchSettings
) -> _Runs:
    """Those over which the palm has room, wherever the hand may stand."""
    size = turned.under_palm.shape[2]
    centre = np.rint((runs.first + runs.last) / 2).astype(int)
    away = np.rint(np.divide(settings.offsets, cell)).astype(int)[:, None]
    column = np.clip(centre + away, 0, size - 1)
    under_hand = turned.under_palm.reshape(-1, size)[runs.row, column].min(axis=0)
    return runs.take(under_hand < runs.tip - settings.clearance + gripper.palm_height)


def _between_fingers(
    runs: _Runs, turned: _Turned, cell: float, gripper: GripperGeometry, settings: SearchSettings
) -> _Runs:
    """Those beside which both fingers have room, wherever the hand may stand."""
    size = turned.under_finger.shape[2]
    under_finger = turned.under_finger.reshape(-1, size)
    limit, width = runs.tip - settings.clearance, (runs.last - runs.first + 1) * cell
    rooms = settings.rooms  # a sloping flank needs more room
    if gripper.opens_fully:
        rooms = ((gripper.max_opening - width) / 2,)
    free = np.zeros(len(runs.row), bool)
    for room, offset in itertools.product(rooms, settings.offsets):
        # A hand off the centre that opens no further has less room on one side.
        least = room - abs(offset) if gripper.opens_fully else room
        beside = least + gripper.finger_thickness / 2  # from the contact to the finger's middle
        # Beside a wall it may be outside.
        left = np.rint(runs.first - (beside + max(-2 * offset, 0)) / cell).astype(int)
        right = np.rint(runs.last + (beside + max(2 * offset, 0)) / cell).astype(int)
        left, right = np.maximum(left, 0), np.minimum(right, size - 1)
        fits = (under_finger[runs.row, left] < limit) & (under_finger[runs.row, right] < limit)
        fits &= least > settings.rooms[0] - cell
        free |= fits & (width + 2 * (least + abs(offset)) < gripper.max_opening + 2 * cell)
    return runs.take(free)


def _scored(
    runs: _Runs,
    turned: _Turned,
    square: _Square,
    slope: np.ndarray,
    heights: HeightMap,
    workspace: Workspace,
    settings: SearchSettings,
) -> Candidates:
    """The runs as candidates, scored without contacts. slope: (R, C, 2) of `_slopes`."""
    cell, half, (row, first, last, tip) = heights.cell, square.half, runs
    rise = turned.heights.reshape(-1, square.size)[row, first] - tip
    number, row = np.divmod(row, square.size)
    angle = turned.angles[number]
    along, across = closing_axes(angle)
    base = heights.origin + cell * square.centre + cell * (row - half)[:, None] * across
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
    centre = heights.centres[np.maximum(inside, 0), :2]  # walls and table have none
    arm = np.abs(((centre - xy) * across).sum(axis=1))
    score = np.exp(-((arm / 0.03) ** 2)) * np.clip(facing, 0, 1) ** 2
    score *= reach * (inside >= 0) * (facing > settings.min_facing)
    score *= np.clip(rise / settings.good_engagement, 0.2, 1)
    return Candidates.rough(xy, angle, tip, (last - first + 1) * cell, score)


def _slopes(heights: HeightMap) -> np.ndarray:
    """(R, C, 2) gradients of the blurred map, which point across an edge whatever its height."""
    blurred = cv2.GaussianBlur(heights.height, (0, 0), EDGE_BLUR / heights.cell)
    return np.stack(np.gradient(blurred)[::-1], axis=-1)


def _unit(slope: np.ndarray) -> np.ndarray:
    """(N, 2) slopes as unit vectors, and 0 where it is level."""
    return slope / (np.linalg.norm(slope, axis=-1, keepdims=True) + 1e-9)


def _levels(heights: HeightMap, gripper: GripperGeometry, settings: SearchSettings) -> np.ndarray:
    """(L,) heights of the fingertips to try: over the table, and no deeper below the lowest matter
    than the palm lets them reach; may be empty."""
    on_objects = heights.label >= 0
    if not on_objects.any() or len(heights.centres) == 0:
        return np.empty(0)
    lowest = float(heights.table()[on_objects].min()) + settings.table_clearance
    height = heights.height[on_objects]
    useless = height.min() - gripper.palm_height - lowest  # the palm would meet the matter
    first = lowest + settings.level_step * max(np.floor(useless / settings.level_step), 0.0)
    return np.arange(first, height.max() - settings.min_engagement, settings.level_step)


def _runs(turned: np.ndarray, levels: np.ndarray, max_width: float, cell: float) -> _Runs:
    """Runs of cells over a level along the rows of maps (A, R, C), sorted by map.

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
    return _Runs(row, first, last, levels[level]).take(order)


def _every_second(rows: np.ndarray) -> np.ndarray:
    """Every second row from the first to the last of some."""
    return np.arange(rows[0], rows[-1] + 1, 2) if len(rows) else rows
