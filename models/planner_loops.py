"""The loops of the second stage of the search over the cells beside candidates, compiled.

The maps are flat arrays here, and `where` (M, V, U) holds indices into them: of cells on V lines
beside each of M places. Candidate i is at place i modulo M, so that the same places may follow each
other at other heights of the fingertips. `models.planner_measure` tells what each loop is for.
"""

from __future__ import annotations

import numpy as np

from utils.compiled import compiled


@compiled
def cells_around(
    xy: np.ndarray,
    along: np.ndarray,
    across: np.ndarray,
    u: np.ndarray,
    v: np.ndarray,
    origin: np.ndarray,
    cell: float,
    rows: int,
    columns: int,
) -> np.ndarray:
    """(M, V, U) indices of the cells of a map (rows, columns) that are u (U,) along and v (V,)
    across from each place xy (M, 2); the nearest cell if outside. origin: (2,), cell: m."""
    where = np.empty((len(xy), len(v), len(u)), np.intp)
    for i in range(len(xy)):
        for line in range(len(v)):
            over_x, over_y = v[line] * across[i, 0], v[line] * across[i, 1]
            for k in range(len(u)):
                x = ((xy[i, 0] + u[k] * along[i, 0]) + over_x) - origin[0]
                y = ((xy[i, 1] + u[k] * along[i, 1]) + over_y) - origin[1]
                column, row = np.rint(x / cell), np.rint(y / cell)
                # NaN, which is no index, fails the comparison.
                column = min(column, columns - 1.0) if column > 0 else 0.0
                row = min(row, rows - 1.0) if row > 0 else 0.0
                where[i, line, k] = int(row) * columns + int(column)
    return where


@compiled
def first_contacts(
    height: np.ndarray, level: np.ndarray, window: np.ndarray, u: np.ndarray, cell: float
) -> np.ndarray:
    """(2, N, V) m, where each line of heights (M, V, U) first rises over a level (N,), from the
    left and from the right; +inf and -inf where it does not. window: (N, U) bool, where it counts.
    u: (U,) m, the middles of the cells along the lines, which are `cell` m wide."""
    found = np.empty((2, len(level), height.shape[1]))
    found[0], found[1] = np.inf, -np.inf
    for i in range(len(level)):
        lines = height[i % len(height)]
        for line in range(len(lines)):
            for k in range(len(u)):
                if window[i, k] and lines[line, k] > level[i]:
                    found[0, i, line] = u[k] - cell / 2
                    break
            for k in range(len(u) - 1, -1, -1):
                if window[i, k] and lines[line, k] > level[i]:
                    found[1, i, line] = u[k] + cell / 2
                    break
    return found


@compiled
def highest_across(surface: np.ndarray, where: np.ndarray, some: np.ndarray) -> np.ndarray:
    """(K, U) m, the highest surface, m, of all lines of the candidates `some` (K,)."""
    highest = np.empty((len(some), where.shape[2]), surface.dtype)
    for i in range(len(some)):
        place = some[i] % len(where)
        for k in range(where.shape[2]):
            most = surface[where[place, 0, k]]
            for line in range(1, where.shape[1]):
                most = max(most, surface[where[place, line, k]])
            highest[i, k] = most
    return highest


@compiled
def widest_opening(
    obstacles: np.ndarray,
    beside: np.ndarray,
    width: np.ndarray,
    tip: np.ndarray,
    rooms: np.ndarray,
    offset: float,
    most: float,
    outline: np.ndarray,
    least_room: float,
    clearance: float,
    inner: float,
) -> np.ndarray:
    """(K,) widest opening, m, of fingers that come straight down over candidates whose lines meet
    obstacles (K, U) m at the places `beside` (K, U) from the middle of their contacts; 0 where none
    is free.

    width, tip: (K,) m. rooms: (R,) m between a contact and the finger, the widest first; at least
    `least_room`. offset: m, of the hand. most: m, of an open hand. outline: (P, 2) as
    `GripperGeometry.finger_outline`. clearance: m under a finger. inner: m inside a finger's face,
    from which only the closing pads count.
    """
    opening = np.zeros(len(width))
    for i in range(len(width)):
        half_width = width[i] / 2 + abs(offset)
        for room in rooms:
            half = min(half_width + room, most / 2)
            if half < half_width + least_room - 1e-9:
                continue
            free = True
            for k in range(beside.shape[1]):
                outward = abs(beside[i, k] - offset) - half
                if outward >= -inner:
                    under = _interpolated(max(outward, 0.0), outline)
                elif abs(beside[i, k]) > width[i] / 2 + least_room:
                    # Between contact and finger the pads pass, over all that is below the tips.
                    under = clearance + 0.001
                else:
                    continue
                if not obstacles[i, k] - under <= tip[i] - clearance:
                    free = False
                    break
            if free:
                opening[i] = 2 * half
                break
    return opening


@compiled
def _interpolated(place: float, outline: np.ndarray) -> float:
    """The height of an outline (P, 2) at a place, infinite beyond its end; as `np.interp`."""
    last = len(outline) - 1
    if place >= outline[last, 0]:
        return outline[last, 1] if place == outline[last, 0] else np.inf
    k = 0
    while outline[k + 1, 0] <= place:
        k += 1
    slope = (outline[k + 1, 1] - outline[k, 1]) / (outline[k + 1, 0] - outline[k, 0])
    return slope * (place - outline[k, 0]) + outline[k, 1]


@compiled
def least_gap(surface: np.ndarray, where: np.ndarray, underside: np.ndarray) -> np.ndarray:
    """(M,) m, the smallest gap between an underside (V,), m, and the surface, m, on the lines below
    it."""
    gap = np.empty(len(where))
    for i in range(len(where)):
        least = np.inf
        for line in range(where.shape[1]):
            most = surface[where[i, line, 0]]
            for k in range(1, where.shape[2]):
                most = max(most, surface[where[i, line, k]])
            least = min(least, underside[line] - most)
        gap[i] = least
    return gap


@compiled
def share_over(
    surface: np.ndarray, where: np.ndarray, some: np.ndarray, under: np.ndarray, tip: np.ndarray
) -> np.ndarray:
    """(K,) share of the cells beside the candidates `some` (K,) whose surface, m, rises over the
    fingertips `tip` (K,) and what is `under` (K, U) them, m over the tips."""
    share = np.empty(len(some))
    for i in range(len(some)):
        place, count = some[i] % len(where), 0
        for line in range(where.shape[1]):
            for k in range(where.shape[2]):
                count += surface[where[place, line, k]] - under[i, k] > tip[i]
        share[i] = count / (where.shape[1] * where.shape[2])
    return share
