"""The second stage of the antipodal search: candidates posed on a height map and measured.

`measure` finds contacts, clearances and lever arms, centres each candidate and scores it;
`without_bumps` leaves out what only noise has raised; `turn_onto_faces` turns the others until the
pads lie flat. `models.fan_measure` does the same for a fan of views with PyTorch.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import cv2
import numpy as np

from models import planner_loops as loops
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


Array = TypeVar("Array")  # np.ndarray, or torch.Tensor in `models.fan_measure`


@dataclass(frozen=True)
class Lines(Generic[Array]):
    """Cells of a map on lines beside N candidates. u: (U,) m along the closing line, from the
    middle that a candidate claims. v: (V,) m, the places of the lines across it. where: (M, V, U)
    flat indices, and height: (M, V, U) m; M is N, or a fraction of it where candidates i, M + i ...
    are at the same place. highest: (N, U) m of all lines."""

    u: Array
    v: Array
    where: Array
    height: Array
    highest: Array


@dataclass(frozen=True)
class Contacts(Generic[Array]):
    """Where flat pads meet matter, as they close on N candidates.

    left, right: (N,) m along the closing line from the middle that a candidate claims; both 0 where
    a pad meets nothing. touched: (N,) bool, whether both meet matter. top: (N,) m, of the highest
    matter between them. chords: (N, V) m between the first contacts of each line across the pads.
    turn, wedge, cover: (N,) of `fit_faces`. tilt_left, tilt_right: (N,) rad of the faces from
    upright.
    """

    left: Array
    right: Array
    touched: Array
    top: Array
    chords: Array
    turn: Array
    wedge: Array
    cover: Array
    tilt_left: Array
    tilt_right: Array

    @property
    def width(self) -> Array:
        """(N,) m."""
        return self.right - self.left

    @property
    def shift(self) -> Array:
        """(N,) m, of the middle between the contacts from the one that a candidate claims."""
        return (self.right + self.left) / 2


@dataclass(frozen=True)
class Held(Generic[Array]):
    """What is between the pads of N candidates. xy: (N, 2) m, the middle between the contacts.
    label: (N,) the object. left, right: (N,) labels just inside the contacts. arms: (N,) m to its
    centre of mass across, along and up."""

    xy: Array
    label: Array
    left: Array
    right: Array
    arms: tuple[Array, Array, Array]


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

    depths: how many times the same places and angles follow each other, at other heights of the
    fingertips.
    """
    posed = _Posed(candidates, heights, gripper, settings, depths)
    tip, contacts, held = posed.tip, posed.contacts, posed.held
    some = posed.graspable()
    opening, offset = posed.room(some)
    some = some[opening[some] > 0]
    covered = posed.covered(some, opening, offset)

    engagement = contacts.top - tip
    beside = (opening - contacts.width) / 2 - np.abs(offset)  # on the side of the nearer finger
    # The steeper face counts: of a thin sloping wall the other one, which is hidden, is as steep.
    tilt = np.maximum(contacts.tilt_left, contacts.tilt_right)
    together = held.left == held.right
    on_top = np.column_stack([held.xy, np.where(contacts.touched, contacts.top, 0.0)])
    score = grip_score(
        np, settings, wedge=contacts.wedge, turn=contacts.turn,
        tilt=np.where(contacts.touched, tilt, np.pi / 2), arms=held.arms, cover=contacts.cover,
        engagement=engagement, roomy=np.interp(beside, (0.003, 0.008), (0.4, 1.0)),
        covered=covered, together=together, over_table=heights.rise(on_top),
    )  # fmt: skip
    feasible = np.zeros(len(candidates), bool)
    feasible[some] = True
    facts = np.column_stack([
        contacts.wedge, contacts.tilt_left, contacts.tilt_right, contacts.cover, *held.arms,
        engagement, covered, beside, together,
    ])  # fmt: skip
    facts = np.nan_to_num(facts, posinf=np.pi, neginf=-np.pi)  # of what touches nothing
    most = np.pi / settings.angles
    return Candidates(
        held.xy, candidates.angle, tip, contacts.width, opening, offset,
        np.clip(contacts.turn, -most, most), held.label, score * feasible, facts,
    )  # fmt: skip


class _Posed:
    """Candidates on a map, their pads closed on what is between them."""

    def __init__(
        self,
        candidates: Candidates,
        heights: HeightMap,
        gripper: GripperGeometry,
        settings: SearchSettings,
        depths: int,
    ):
        self.heights, self.gripper, self.settings = heights, gripper, settings
        self.xy, self.tip = candidates.xy, candidates.tip
        self.along, self.across = candidates.axes()
        self.lines = self._lines(depths)
        self.contacts = self._contacts(candidates.width)
        self.held = self._held()

    def _lines(self, depths: int) -> Lines[np.ndarray]:
        heights, gripper = self.heights, self.gripper
        reach = gripper.max_opening / 2 + gripper.finger_outline[-1][0] + REACH
        reach += np.abs(self.settings.offsets).max()
        most = np.ceil(reach / heights.cell)
        u = np.arange(-most, most + 1) * heights.cell
        v = np.linspace(-1, 1, LINES) * gripper.finger_half_width
        xy, along, across = (
            part[: len(part) // depths] for part in (self.xy, self.along, self.across)
        )
        where = cells_around(xy, along, across, u, v, heights)
        height = heights.height.take(where)
        return Lines(u, v, where, height, np.tile(height.max(axis=1), (depths, 1)))

    def _contacts(self, claimed: np.ndarray) -> Contacts[np.ndarray]:
        """A pad stops where the first of the lines across it meets matter. The slope of the
        contacts across the pad gives the angle to the face, their shift with height its tilt.

        claimed: (N,) m, widths of the candidates. Contacts are searched a little beyond them.
        """
        tip, lines, u, cell = self.tip, self.lines, self.lines.u, self.heights.cell
        window = np.abs(u) <= claimed[:, None] / 2 + self.settings.rooms[0]
        top = np.where(window, lines.highest, -np.inf).max(axis=1)
        lower, upper = contact_levels(tip, top - tip)
        low_left, low_right = loops.first_contacts(lines.height, lower, window, u, cell)
        high = loops.first_contacts(lines.highest[:, None], upper, window, u, cell)
        high_left, high_right = high[..., 0]
        left, right = low_left.min(axis=1), low_right.max(axis=1)
        touched = np.isfinite(left) & np.isfinite(high_left)
        left, right = np.where(touched, left, 0.0), np.where(touched, right, 0.0)
        turn, wedge, cover = fit_faces(
            low_left - left[:, None], right[:, None] - low_right, lines.v
        )
        rise = upper - tip - 0.001
        return Contacts(
            left, right, touched, top, low_right - low_left, turn, wedge, cover,
            np.arctan2(np.maximum(high_left - left, 0), rise),
            np.arctan2(np.maximum(right - high_right, 0), rise),
        )  # fmt: skip

    def _held(self) -> Held[np.ndarray]:
        contacts, heights = self.contacts, self.heights
        xy = self.xy + contacts.shift[:, None] * self.along
        inner = np.minimum(0.003, contacts.width / 3)
        left, right = (
            heights.label[heights.index(self.xy + (end[:, None] * self.along))]
            for end in (contacts.left + inner, contacts.right - inner)
        )
        label = np.maximum(left, right)
        centre = heights.centres[np.maximum(label, 0)]  # walls and table have none
        arms = (
            np.abs(((centre[:, :2] - xy) * self.across).sum(axis=1)),
            np.abs(((centre[:, :2] - xy) * self.along).sum(axis=1)),
            np.abs(centre[:, 2] - self.tip - self.gripper.pad_height / 2),
        )
        return Held(xy, label, left, right, arms)

    def graspable(self) -> np.ndarray:
        """(M,) numbers of the candidates whose pads close on one object that may be grasped."""
        heights, settings, lines = self.heights, self.settings, self.lines
        contacts, held, tip, width = self.contacts, self.held, self.tip, self.contacts.width
        good = contacts.touched & (contacts.wedge < settings.max_wedge)
        good &= contacts.top - tip >= settings.min_engagement
        good &= (np.minimum(held.left, held.right) > WALL_LABEL) & (held.label >= 0) & (width > 0)
        if heights.beyond is not None:
            good &= ~heights.beyond[heights.index(held.xy)]
        if self.gripper.least_held:
            thickness = _thickness(contacts.chords, self.along, heights.cell)
            good &= thickness > self.gripper.least_held + UNSURE
        if heights.fixed is not None:  # a fixture under an object that leans over it
            between = (lines.u > contacts.left[:, None]) & (lines.u < contacts.right[:, None])
            fixed = loops.highest_across(heights.fixed.ravel(), lines.where, np.arange(len(tip)))
            under = (tip - settings.clearance)[:, None]
            good &= (np.where(between, fixed, -np.inf) <= under).all(axis=1)
        some = np.nonzero(good)[0]
        other = heights.label == OTHER_LABEL
        if other.any():
            between = np.abs(lines.u - contacts.shift[some, None]) < width[some, None] / 2
            place = some % len(lines.where)
            mixed = lines.height[place] > tip[some, None, None]
            mixed &= other.take(lines.where[place])
            mixed = (mixed & between[:, None]).sum(axis=(1, 2)) / (LINES * between.sum(axis=1))
            some = some[mixed <= settings.most_other]
        return some

    def room(self, some: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(N,) widest opening of the candidates `some` (M,) that leaves fingers and palm clearance
        on a straight descent, and (N,) the hand's offset there; 0 of what has no room, and of
        others."""
        offset, opening = np.zeros(len(self.tip)), np.zeros(len(self.tip))
        for away in self.settings.offsets:
            waiting = some[opening[some] == 0]
            room = self._widest_opening(waiting, away)
            waiting, room = waiting[room > 0], room[room > 0]
            fits = self._palm_gap(waiting, away) >= self.settings.clearance - self.tip[waiting]
            opening[waiting[fits]], offset[waiting[fits]] = room[fits], away
        return opening, offset

    def _widest_opening(self, some: np.ndarray, offset: float) -> np.ndarray:
        """(M,) widest opening of the fingers of the candidates `some` that is free on a straight
        descent; 0 where none is. Of a gripper that opens fully only the widest of all counts.

        offset: m along the closing line, of the hand's middle from that of the contacts.
        """
        gripper, settings, contacts = self.gripper, self.settings, self.contacts
        tip, width = self.tip[some], contacts.width[some]
        obstacles = self.heights.highest_around("height", 1, cv2.MORPH_RECT)
        obstacles = loops.highest_across(obstacles.ravel(), self.lines.where, some)
        beside = self.lines.u - contacts.shift[some, None]
        rooms = np.full(1, np.inf) if gripper.opens_fully else np.array(settings.rooms[::-1])
        return loops.widest_opening(
            obstacles, beside, width, tip, rooms, offset, gripper.max_opening,
            np.array(gripper.finger_outline), settings.rooms[0], settings.clearance,
            settings.inner_margin,
        )  # fmt: skip

    def _palm_gap(self, some: np.ndarray, offset: float) -> np.ndarray:
        """(M,) smallest gap between the palm's underside, fingertips at 0, and the matter below
        it, of the candidates `some`. offset: as in `_widest_opening`."""
        heights, gripper = self.heights, self.gripper
        along, across = self.along[some], self.across[some]
        # Samples lie PALM_STEP apart, so each must stand for the highest cell within
        # PALM_STEP / sqrt(2); one more cell for rounding to the grid.
        radius = int(np.ceil(PALM_STEP / np.sqrt(2) / heights.cell)) + 1
        scene = heights.highest_around("ceiling", radius, cv2.MORPH_ELLIPSE)
        ends = gripper.palm_half_length, gripper.palm_outline[-1][0]
        u, v = (np.linspace(-end, end, 2 * int(np.ceil(end / PALM_STEP)) + 1) for end in ends)
        middle = self.held.xy[some] + offset * along
        where = cells_around(middle, along, across, u, v, heights)
        return loops.least_gap(scene.ravel(), where, gripper.palm_underside(v))

    def covered(self, some: np.ndarray, opening: np.ndarray, offset: np.ndarray) -> np.ndarray:
        """(N,) share of the hand under which matter may be hidden; 0 but of the candidates
        `some`. opening, offset: (N,) m."""
        gripper, lines, contacts = self.gripper, self.lines, self.contacts
        covered, beside = np.zeros(len(self.tip)), opening[some]
        if gripper.opens_fully:  # what may be hidden beside the contacts counts all the same
            beside = np.minimum(beside, contacts.width[some] + 2 * self.settings.rooms[-1])
        near = np.abs(lines.u - (contacts.shift + offset)[some, None])
        under = gripper.finger_underside(near - beside[:, None] / 2)
        ceiling = self.heights.ceiling.ravel()
        covered[some] = loops.share_over(ceiling, lines.where, some, under, self.tip[some])
        return covered


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
    origin, cell = np.asarray(heights.origin, float), float(heights.cell)
    return loops.cells_around(xy, along, across, u, v, origin, cell, *heights.height.shape)


def _thickness(chords: np.ndarray, along: np.ndarray, cell: float) -> np.ndarray:
    """(N,) metres between the flat pads once they have turned what they hold onto its faces; -inf
    where few lines meet matter.

    chords: (N, V) m between the first contacts of each line. along: (N, 2) closing lines.
    The longest third of the chords counts: those of a board are alike, however it is turned. A cell
    has matter if any point lies in it, so that a shape is wider by a cell's extent along the line.
    """
    longest = np.sort(chords, axis=1)[:, -(chords.shape[1] // 3) :]
    return longest.mean(axis=1) - cell * np.abs(along).sum(axis=1)
