"""The second stage of the antipodal search: candidates posed on a height map and measured.

`measure` finds contacts, clearances and lever arms, centres each candidate and scores it;
`without_bumps` leaves out what only noise has raised; `turn_onto_faces` turns the others until the
pads lie flat. `models.fan_measure` does the same for a fan of views with PyTorch.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from models.planner_candidates import FACTS, Candidates, SearchSettings, grip_score
from utils.depth_correction import TRUSTED_ROUGHNESS, bump_height
from utils.geometry import GripperGeometry
from utils.grasp_quality import contact_levels, fit_faces
from utils.height_map import OTHER_LABEL, WALL_LABEL, HeightMap

UNSURE = 0.001  # m, by which `_thickness` may be wrong
LINES = 9  # across a pad, along which contacts are looked for
REACH = 0.004  # m beyond the open fingers that are looked at
PALM_STEP = 0.006  # m between the points under the palm that are looked at
# m from a contact to the nearest and the farthest place beside it that is looked at, and how many
# places along the closing line and across it.
BESIDE, BESIDE_LINES = (0.003, 0.008), 5
# Standard deviations by which noise raises the highest cell between the fingers: a choice
# (docs/choices.md).
HIGHEST_CELL = 2.0


def turn_onto_faces(
    found: Candidates,
    heights: HeightMap,
    gripper: GripperGeometry,
    settings: SearchSettings,
    times: int = 2,
) -> Candidates:
    """Measured candidates, each turned and measured again as long as its score rises."""
    better = np.arange(len(found))
    for _ in range(times):
        before = found.take(better)
        turned = replace(before, angle=np.mod(before.angle + before.turn, np.pi))
        turned = measure(turned, heights, gripper, settings)
        wins = turned.score > before.score
        better = better[wins]
        found = found.replaced(better, turned.take(wins))
    return found


def measure(
    candidates: Candidates,
    heights: HeightMap,
    gripper: GripperGeometry,
    settings: SearchSettings,
    depths: int = 1,
) -> Candidates:
    """The candidates posed on the map, centred between their contacts, and scored.

    The pads are flat: a pad stops where the first of the lines across it meets matter. The slope of
    the contacts across the pad gives the angle to the face, their shift with height its tilt.
    depths: how many times the same places and angles follow each other, at other heights of the
    fingertips.
    """
    N, tip = len(candidates), candidates.tip
    along, across = candidates.axes()
    reach = gripper.max_opening / 2 + gripper.finger_outline[-1][0] + REACH
    reach += np.abs(settings.offsets).max()
    most = np.ceil(reach / heights.cell)
    u = np.arange(-most, most + 1) * heights.cell
    v = np.linspace(-1, 1, LINES) * gripper.finger_half_width
    once = N // depths
    where = cells_around(
        candidates.xy[:once], along[:once], across[:once], u, v, heights
    )  # (N, V, U)
    height = heights.height.take(where)
    highest = height.max(axis=1)  # across the pads
    if depths > 1:
        where, height = (np.tile(part, (depths, 1, 1)) for part in (where, height))
        highest = np.tile(highest, (depths, 1))

    # Contacts, searched a little beyond the width that the candidate claims.
    window = np.abs(u) <= candidates.width[:, None] / 2 + settings.rooms[0]
    top = np.where(window, highest, -np.inf).max(axis=1)
    engagement = top - tip
    lower, upper = contact_levels(tip, engagement)
    low = (height > lower[:, None, None]) & window[:, None]
    low_left, low_right = _first_contacts(low, u, heights.cell)
    high = (highest > upper[:, None]) & window
    high_left, high_right = _first_contacts(high, u, heights.cell)
    left, right = low_left.min(axis=1), low_right.max(axis=1)
    touched = np.isfinite(left) & np.isfinite(high_left)
    left, right = np.where(touched, left, 0.0), np.where(touched, right, 0.0)
    width, shift = right - left, (right + left) / 2
    turn, wedge, cover = fit_faces(low_left - left[:, None], right[:, None] - low_right, v)
    rise = upper - tip - 0.001
    tilt_left = np.arctan2(np.maximum(high_left - left, 0), rise)
    tilt_right = np.arctan2(np.maximum(right - high_right, 0), rise)
    # The steeper face counts: of a thin sloping wall the other one, which is hidden, is as steep.
    tilt = np.where(touched, np.maximum(tilt_left, tilt_right), np.pi / 2)

    # The object between the fingers, and the lever arms to its centre of mass.
    xy = candidates.xy + shift[:, None] * along
    inner = np.minimum(0.003, width / 3)
    ends = [
        heights.label[heights.index(candidates.xy + (end[:, None] * along))]
        for end in (left + inner, right - inner)
    ]
    label = np.maximum(*ends)
    centre = heights.centres[np.maximum(label, 0)]  # walls and table have none
    arm_across = np.abs(((centre[:, :2] - xy) * across).sum(axis=1))
    arm_along = np.abs(((centre[:, :2] - xy) * along).sum(axis=1))
    arm_up = np.abs(centre[:, 2] - tip - gripper.pad_height / 2)

    # Clearance of fingers and palm on a straight descent, for candidates that are feasible so far.
    left_over = touched & (wedge < settings.max_wedge) & (engagement >= settings.min_engagement)
    left_over &= np.minimum(*ends) > WALL_LABEL
    if heights.beyond is not None:
        left_over &= ~heights.beyond[heights.index(xy)]
    if gripper.least_held:
        thickness = _thickness(low_left, low_right, along, heights.cell)
        left_over &= thickness > gripper.least_held + UNSURE
    if heights.fixed is not None:  # a fixture under an object that leans over it
        between = (u > left[:, None]) & (u < right[:, None])
        fixed = heights.fixed.take(where).max(axis=1)
        under = (tip - settings.clearance)[:, None]
        left_over &= (np.where(between, fixed, -np.inf) <= under).all(axis=1)
    left_over = np.nonzero(left_over & (label >= 0) & (width > 0))[0]
    other = heights.label == OTHER_LABEL
    if other.any():
        between = np.abs(u - shift[left_over, None]) < width[left_over, None] / 2
        mixed = other.take(where[left_over]) & (height[left_over] > tip[left_over, None, None])
        mixed = (mixed & between[:, None]).sum(axis=(1, 2)) / (len(v) * between.sum(axis=1))
        left_over = left_over[mixed <= settings.most_other]
    offset, opening, covered = np.zeros(N), np.zeros(N), np.zeros(N)
    obstacles = heights.highest_around("height", 1, cv2.MORPH_RECT)
    for away in settings.offsets:
        waiting = left_over[opening[left_over] == 0]
        room = _widest_opening(
            obstacles.take(where[waiting]).max(axis=1), u - shift[waiting, None], away,
            tip[waiting], width[waiting], gripper, settings,
        )  # fmt: skip
        waiting, room = waiting[room > 0], room[room > 0]
        middle = xy[waiting] + away * along[waiting]
        gap = _palm_gap(middle, along[waiting], across[waiting], heights, gripper)
        fits = gap >= settings.clearance - tip[waiting]
        opening[waiting[fits]], offset[waiting[fits]] = room[fits], away
    left_over = left_over[opening[left_over] > 0]
    beside = opening[left_over]
    if gripper.opens_fully:  # what may be hidden beside the contacts counts all the same
        beside = np.minimum(beside, width[left_over] + 2 * settings.rooms[-1])
    near = np.abs(u - (shift + offset)[left_over, None])
    under = gripper.finger_underside(near - beside[:, None] / 2)
    over = heights.ceiling.take(where[left_over]) - under[:, None]
    covered[left_over] = (over > tip[left_over, None, None]).mean(axis=(1, 2))

    room_beside = (opening - width) / 2 - np.abs(offset)  # on the side of the nearer finger
    score = grip_score(
        np, settings, wedge=wedge, turn=turn, tilt=tilt, arms=(arm_across, arm_along, arm_up),
        cover=cover, engagement=engagement,
        roomy=np.interp(room_beside, (0.003, 0.008), (0.4, 1.0)),
        covered=covered, together=ends[0] == ends[1],
        over_table=heights.rise(np.column_stack([xy, np.where(touched, top, 0.0)])),
    )  # fmt: skip
    feasible = np.zeros(N, bool)
    feasible[left_over] = True
    turn = np.clip(turn, -np.pi / settings.angles, np.pi / settings.angles)
    facts = np.column_stack([
        wedge, tilt_left, tilt_right, cover, arm_across, arm_along, arm_up, engagement, covered,
        room_beside, ends[0] == ends[1],
    ])  # fmt: skip
    facts = np.nan_to_num(facts, posinf=np.pi, neginf=-np.pi)  # of what touches nothing
    score *= feasible
    return Candidates(xy, candidates.angle, tip, width, opening, offset, turn, label, score, facts)


def without_bumps(found: Candidates, heights: HeightMap, gripper: GripperGeometry) -> Candidates:
    """The candidates but for those on bumps that the noise of a depth image has made.

    What fingers hold rises over their tips, and over the surface beside it unless that is the table
    or a wall, by more than noise may raise the highest cell between them.
    """
    if heights.noise == 0 or len(found) == 0:
        return found
    along, across = found.axes()
    beside = np.linspace(*BESIDE, BESIDE_LINES) + found.width[:, None] / 2
    beside = np.stack([-beside, beside], axis=1)[..., None, None]  # (N, side, line, 1, 1)
    over = np.linspace(-1, 1, BESIDE_LINES)[:, None] * gripper.finger_half_width
    points = found.xy[:, None, None, None] + beside * along[:, None, None, None]
    where = heights.index(points + over * across[:, None, None, None])
    surface, label = np.median(heights.height[where], axis=(2, 3)), heights.label[where]
    on_table = ((label == -1) | (label == WALL_LABEL)).mean(axis=(2, 3)) >= 0.5
    engagement = found.facts[:, FACTS.index("engagement")]
    rise = (found.tip + engagement)[:, None] - surface
    kept = (on_table | (rise > bump_height(heights.noise))).all(axis=1)
    return found.take(kept & (engagement > least_engagement(heights.noise)))


def least_engagement(noise: float) -> float:
    """Metres that what is held has to rise over the fingertips where flat surfaces have this
    standard deviation, m. What is less flat than a smoothed image has another reason than noise."""
    return HIGHEST_CELL * min(noise, TRUSTED_ROUGHNESS)


def cells_around(xy, along, across, u, v, heights: HeightMap) -> np.ndarray:
    """(N, V, U) flat indices of the map's cells u along and v across from each centre."""
    columns = heights.height.shape[1]
    col, row = (
        heights.nearest(
            (xy[:, k, None] + u * along[:, k, None])[:, None]
            + v[:, None] * across[:, k, None, None],
            k,
        )
        for k in (0, 1)
    )
    row *= columns
    row += col
    return row.astype(np.intp)


def _first_contacts(matter: np.ndarray, u: np.ndarray, cell: float) -> tuple[np.ndarray, ...]:
    """(...) places at which lines (..., U) first meet matter, from the left and from the right;
    +inf (left) and -inf (right) for lines that meet none."""
    hit = matter.any(axis=-1)
    left = u[matter.argmax(axis=-1)] - cell / 2
    right = u[len(u) - 1 - matter[..., ::-1].argmax(axis=-1)] + cell / 2
    return np.where(hit, left, np.inf), np.where(hit, right, -np.inf)


def _thickness(left: np.ndarray, right: np.ndarray, along: np.ndarray, cell: float) -> np.ndarray:
    """(N,) metres between the flat pads once they have turned what they hold onto its faces; -inf
    where few lines meet matter.

    left, right: (N, V) first contacts of the lines across the pads. along: (N, 2) closing lines.
    The longest third of the chords counts: those of a board are alike, however it is turned. A cell
    has matter if any point lies in it, so that a shape is wider by a cell's extent along the line.
    """
    chords = np.sort(right - left, axis=1)[:, -(left.shape[1] // 3) :]
    return chords.mean(axis=1) - cell * np.abs(along).sum(axis=1)


def _widest_opening(
    obstacles: np.ndarray,
    beside: np.ndarray,
    offset: float,
    tip: np.ndarray,
    width: np.ndarray,
    gripper: GripperGeometry,
    settings: SearchSettings,
) -> np.ndarray:
    """(N,) widest opening of the fingers that is free on a straight descent; 0 where none is. Of a
    gripper that opens fully only the widest of all counts.

    obstacles, beside: (N, U) heights along the closing line and where they are, from the middle of
    the contacts. offset: of the hand's middle from there.
    """
    # Between contact and finger only the closing pads pass, over all that is below the tips.
    sill = np.where(
        np.abs(beside) > width[:, None] / 2 + settings.rooms[0], settings.clearance + 0.001, np.inf
    )
    near, half_width = np.abs(beside - offset), width / 2 + abs(offset)
    opening, open_yet = np.zeros(len(tip)), np.arange(len(tip))
    for room in (np.inf,) if gripper.opens_fully else reversed(settings.rooms):
        half = np.minimum(half_width[open_yet] + room, gripper.max_opening / 2)
        outward = near[open_yet] - half[:, None]
        below_finger = gripper.finger_underside(np.maximum(outward, 0))
        under = np.where(outward < -settings.inner_margin, sill[open_yet], below_finger)
        fits = (obstacles[open_yet] - under).max(axis=1) <= tip[open_yet] - settings.clearance
        fits &= half >= half_width[open_yet] + settings.rooms[0] - 1e-9
        opening[open_yet[fits]] = 2 * half[fits]
        open_yet = open_yet[~fits]
    return opening


def _palm_gap(
    xy, along, across, heights: HeightMap, gripper: GripperGeometry, step: float = PALM_STEP
) -> np.ndarray:
    """(N,) smallest gap between the palm's underside, fingertips at 0, and the matter below it."""
    # Samples lie `step` apart, so each must stand for the highest cell within step / sqrt(2); one
    # more cell for rounding to the grid.
    radius = int(np.ceil(step / np.sqrt(2) / heights.cell)) + 1
    scene = heights.highest_around("ceiling", radius, cv2.MORPH_ELLIPSE)
    ends = gripper.palm_half_length, gripper.palm_outline[-1][0]
    u, v = (np.linspace(-end, end, 2 * int(np.ceil(end / step)) + 1) for end in ends)
    nearby = scene.take(cells_around(xy, along, across, u, v, heights)).max(axis=2)
    return (gripper.palm_underside(v) - nearby).min(axis=1)
