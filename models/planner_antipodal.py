"""Antipodal search on a height map: grasps whose two fingers close on opposite faces.

The search has two stages. The dense stage finds, for every angle and height of the fingertips, runs
of matter along the closing line that fit between the fingers. The second stage poses each of the
best on the map, measures contacts, clearances and lever arms, centres the grasp and turns it onto
the faces. `models.planner_candidates` has the candidates and the margins of both stages.
`SearchPlanner` is the base of the planners that search. This module knows height maps only: neither
the image nor the solids behind them.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np

from models.planner_candidates import Candidates, SearchSettings, grip_score
from utils.calibration import Calibration
from utils.depth_correction import corrected
from utils.geometry import GripperGeometry, Workspace
from utils.grasp_quality import contact_levels, fit_faces
from utils.height_map import OTHER_LABEL, WALL_LABEL, HeightMap
from utils.target import pixel_labels
from utils.transforms import Grasp, RGBDFrame, transform_points

NOWHERE = -1e3  # m, under everything
UNSURE = 0.001  # m, by which `_thickness` may be wrong
EDGE_BLUR = 0.002  # m, standard deviation over the heights whose gradients are edges
LINES = 9  # across a pad, along which contacts are looked for
REACH = 0.004  # m beyond the open fingers that are looked at
PALM_STEP = 0.006  # m between the points under the palm that are looked at


class SearchPlanner:
    """Base of the planners that search a height map.

    gripper, workspace: the hand and the square of the table that it works on. seed: unused, for
    the search draws nothing at random; all planners are made with the same arguments. calibration:
    by which qualities are chances of success; None leaves scores.
    """

    calibration: Calibration | None = None

    def __init__(
        self,
        gripper: GripperGeometry,
        workspace: Workspace,
        seed: int = 0,
        settings: SearchSettings | None = None,
    ):
        self.gripper, self.workspace = gripper, workspace
        self.settings = settings or SearchSettings()

    def heights(self, frame: RGBDFrame) -> HeightMap:
        """The map from above of a frame that is corrected by its table, cut into objects as the
        planner sees them."""
        raise NotImplementedError

    def segments(self, frame: RGBDFrame) -> np.ndarray:
        """(H, W) int32: the number of the object at each pixel, -1 where there is none. A planner
        with this method honours `RGBDFrame.target`: it returns grasps of that object alone."""
        frame = corrected(frame, self.workspace.table_height)
        return pixel_labels(self.heights(frame), frame)

    def search(
        self, heights: HeightMap, value: Callable[[Candidates], np.ndarray] | None = None
    ) -> Candidates:
        """Feasible candidates on a height map, best first; `value` as in `search`."""
        return search(heights, self.gripper, self.workspace, self.settings, value)

    def return_at_least(self, count: int) -> None:
        """Return up to `count` grasps, where the planner would return fewer."""
        returned = max(count, self.settings.returned)
        self.settings = replace(self.settings, returned=returned)

    def grasps(self, found: Candidates, roughness: float = 0.0) -> list[Grasp]:
        """The best of the candidates as grasps, no two of them nearly alike. roughness: m, of the
        frame that they were found in."""
        settings = self.settings
        kept = found.distinct(settings.returned, settings.distinct_distance, settings.distinct_turn)
        if self.calibration is not None:  # as `with_chances`, but each grasp is made once
            kept = replace(kept, score=self.calibration(kept.score, roughness))
        return kept.grasps(self.gripper)


def search(
    heights: HeightMap,
    gripper: GripperGeometry,
    workspace: Workspace,
    settings: SearchSettings,
    value: Callable[[Candidates], np.ndarray] | None = None,
) -> Candidates:
    """Feasible candidates on a height map, measured and scored, best first; may be empty.

    value: returns a factor (N,) on the candidates' scores, such as a network's prediction. Where
    nothing meets the margins, a second search has relaxed ones, and a third a hand that stands off
    the centre: a poor attempt may clear an object, no attempt ends the round.
    """
    found = search_once(heights, gripper, workspace, settings, value)
    for easier in (settings.relaxed(), settings.off_centre()):
        if len(found) == 0:
            found = search_once(heights, gripper, workspace, easier, value)
    return found


def search_once(
    heights: HeightMap,
    gripper: GripperGeometry,
    workspace: Workspace,
    settings: SearchSettings,
    value: Callable[[Candidates], np.ndarray] | None = None,
    stride: int = 1,
) -> Candidates:
    """`search` with these margins alone. stride: of the cells that the dense stage looks at."""
    dense = dense_candidates(heights.every(stride), gripper, workspace, settings)
    found = _valued(dense, value)
    found = found.best(settings.shortlist)
    if len(found) == 0:
        return found
    found = measure(found, heights, gripper, settings).best(settings.finalists)
    found = turn_onto_faces(found, heights, gripper, settings)
    return _valued(found, value).best(len(found))


def _valued(found: Candidates, value) -> Candidates:
    return found if value is None else replace(found, score=found.score * value(found))


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
    parts = []
    for angle in np.arange(settings.angles) * np.pi / settings.angles:
        along = np.array([np.cos(angle), np.sin(angle)])
        across = np.array([-along[1], along[0]])
        axes = np.column_stack([along, across])
        warp = np.column_stack([axes, centre_cell - axes @ (half, half)])
        turned, objects = (
            cv2.warpAffine(
                image, warp, (size, size), flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP,
                borderValue=outside,
            )
            for image, outside in ((heights.height, ground), (standing, NOWHERE))
        )  # fmt: skip
        level, row, first, last = _runs(
            objects, levels, gripper.max_opening - 2 * settings.rooms[0], cell
        )
        tip, centre = levels[level], np.rint((first + last) / 2).astype(int)
        under_finger, under_palm = cv2.dilate(turned, finger), cv2.dilate(turned, palm)
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

        base = middle + cell * (row - half)[:, None] * across
        at_first, at_inside, xy, at_last = (
            base + cell * (column - half)[:, None] * along
            for column in (first, first + 1.5, (first + last) / 2, last)
        )
        place = transform_points(heights.T_WV, np.column_stack([xy, tip]))[:, :2]
        reach = np.abs(place - workspace.centre).max(axis=1) < workspace.size / 2 + settings.reach
        # Outward normals are minus the gradient: cosines against the closing line on both sides.
        facing = np.minimum(
            _unit(slope[heights.index(at_first)]) @ along,
            -_unit(slope[heights.index(at_last)]) @ along,
        )
        inside = heights.label[heights.index(at_inside)]
        arm = np.abs((heights.centres[np.maximum(inside, -1), :2] - xy) @ across)
        rise = turned[row, first] - tip
        score = np.exp(-((arm / 0.03) ** 2)) * np.clip(facing, 0, 1) ** 2
        score *= (
            reach
            * (inside >= 0)
            * (facing > settings.min_facing)
            * np.clip(rise / settings.good_engagement, 0.2, 1)
        )
        parts.append(
            Candidates.rough(xy, np.full(len(tip), angle), tip, (last - first + 1) * cell, score)
        )
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
    """Runs of cells over a level along the rows: level, row, first and last column, each (M,).

    A run may bridge a gap to the next one or two of its row (a ring, a mug). Every second row is
    enough: the pad spans several.
    """
    rows = np.nonzero(turned.max(axis=1) > levels[0])[0]
    picked = np.arange(rows[0], rows[-1] + 1, 2) if len(rows) else rows
    # No matter at both ends of a row, so that every run has a first and a last cell there.
    columns = turned.shape[1] + 2
    matter = np.zeros((len(levels), len(picked), columns), bool)
    np.greater(turned[picked], levels[:, None, None], out=matter[..., 1:-1])
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
    return level, picked[row], first, last


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
