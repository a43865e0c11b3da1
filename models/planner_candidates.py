"""What the antipodal search works with: its candidate grasps, and its margins and preferences.

`Candidates` holds all grasps column by column, so that each step of `models.planner_antipodal` is
one array operation. This module knows neither images nor height maps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from utils.calibration import Calibration
from utils.geometry import GripperGeometry
from utils.grasp_quality import RELAXED
from utils.transforms import Grasp, angle_difference

# What the search measures of a candidate, metres and radians: half the angle between the faces in
# plan view; each face's tilt; the smaller share of a pad in touch; lever arms to the centre of
# mass; how far the matter rises over the tips; the share of the hand under which matter may be
# hidden; the room beside each contact; 1 where both ends lie on one object.
FACTS = (
    "wedge", "tilt_left", "tilt_right", "cover", "arm_across", "arm_along", "arm_up", "engagement",
    "covered", "room", "one_object",
)  # fmt: skip


# m, of a hand whose one finger pushes what it grips until the other one touches it, too.
OFF_CENTRE = (0.0, 0.01, -0.01, 0.02, -0.02)


@dataclass
class Candidates:
    """N candidate grasps, one column for each quantity; metres and radians.

    xy: (N, 2) middle between the contacts in W. angle: (N,) of the closing line. tip: (N,) height
    of the fingertips' lowest point in W. width: (N,) of the matter between the fingers. opening:
    (N,) of the hand before closing. offset: (N,) of the hand's middle from xy along the closing
    line; the finger that touches first pushes what it meets. turn: (N,) rotation that would bring
    the pads flat onto the faces. label: (N,) the object in the height map. score: (N,), 0 for an
    infeasible grasp. facts: (N, len(FACTS)) what was measured, 0 before.
    """

    xy: np.ndarray
    angle: np.ndarray
    tip: np.ndarray
    width: np.ndarray
    opening: np.ndarray
    offset: np.ndarray
    turn: np.ndarray
    label: np.ndarray
    score: np.ndarray
    facts: np.ndarray

    @staticmethod
    def rough(xy, angle, tip, width, score) -> Candidates:
        """Candidates of the dense stage, which are not measured yet."""
        offset, turn, label, facts = (
            np.zeros(len(tip)),
            np.zeros(len(tip)),
            np.full(len(tip), -1),
            np.zeros((len(tip), len(FACTS))),
        )
        return Candidates(xy, angle, tip, width, width.copy(), offset, turn, label, score, facts)

    @staticmethod
    def joined(parts: Sequence[Candidates]) -> Candidates:
        """All candidates of several lists."""
        columns = (np.concatenate([getattr(part, name) for part in parts]) for name in COLUMNS)
        return Candidates(*columns)

    def __len__(self) -> int:
        return len(self.angle)

    def take(self, index) -> Candidates:
        return Candidates(*(getattr(self, name)[index] for name in COLUMNS))

    def best(self, count: int) -> Candidates:
        """The `count` best feasible candidates, best first."""
        order = np.argsort(-self.score, kind="stable")[:count]
        return self.take(order[self.score[order] > 0])

    def replaced(self, index: np.ndarray, others: Candidates) -> Candidates:
        """All candidates, with `others` in the places `index`."""
        result = self.take(np.arange(len(self)))
        for name in COLUMNS:
            getattr(result, name)[index] = getattr(others, name)
        return result

    def axes(self) -> tuple[np.ndarray, np.ndarray]:
        """(N, 2) unit vectors along the closing line and across it."""
        return closing_axes(self.angle)

    def distinct(self, count: int, distance: float, angle: float) -> Candidates:
        """Non-maximum suppression: at most `count`, no two closer than both distance and angle."""
        dx, dy = (along[:, None] - along for along in self.xy.T)
        apart = np.sqrt(dx * dx + dy * dy) >= distance
        apart |= angle_difference(self.angle[:, None], self.angle) >= angle
        return self.take(suppressed(~apart, count))

    def grasps(self, gripper: GripperGeometry) -> list[Grasp]:
        """The candidates as grasps, in the same order."""
        height = self.tip + gripper.tip_below_centre
        middle = self.xy + self.offset[:, None] * self.axes()[0]
        return [
            Grasp(np.array([x, y, z]), angle, opening, score)
            for (x, y), z, angle, opening, score in zip(
                middle, height, self.angle, self.opening.tolist(), self.score.tolist()
            )
        ]


COLUMNS = tuple(field.name for field in fields(Candidates))


def closing_axes(angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(..., 2) unit vectors along closing lines at angles (...) and across them."""
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.stack([cosine, sine], axis=-1), np.stack([-sine, cosine], axis=-1)


def with_chances(
    grasps: list[Grasp], calibration: Calibration | None, roughness: float = 0.0
) -> list[Grasp]:
    """The grasps in the same order, with chances of success in place of scores, in a frame of this
    roughness, m."""
    if calibration is None:
        return grasps
    chances = calibration([grasp.quality for grasp in grasps], roughness).tolist()
    return [replace(grasp, quality=chance) for grasp, chance in zip(grasps, chances)]


@dataclass(frozen=True)
class SearchSettings:
    """Margins and preferences of the search; metres and radians unless said."""

    angles: int = 18  # bin k is centred at k * 180 / angles degrees
    level_step: float = 0.006  # between the heights of the fingertips that are tried
    table_clearance: float = 0.004  # under the fingertips
    clearance: float = 0.003  # over all matter under fingers and palm
    rooms: tuple[float, ...] = (0.004, 0.006, 0.008, 0.012)  # room beside each contact when open
    inner_margin: float = 0.0015  # part of that room that has to be free of matter
    min_engagement: float = 0.006  # the object must rise this far over the fingertips
    good_engagement: float = 0.022  # and gains nothing beyond this
    max_wedge: float = np.deg2rad(28)  # half the angle between the two faces, mu = 0.5
    min_facing: float = 0.75  # cosine of an edge's gradient against the closing line, dense stage
    covered_weight: float = 4.0  # exp(-w x) where hidden matter may be under a share x of the hand
    reach: float = 0.04  # how far outside the workspace a grasp's centre may lie
    shortlist: int = 1000  # survivors of the dense stage that are measured
    finalists: int = 250  # of these, turned onto the faces and measured again
    split_factor: float = 0.5  # on the score of a grasp whose ends lie on different objects
    offsets: tuple[float, ...] = (0.0,)  # of the hand along its closing line, the first that fits
    most_other: float = 0.1  # share of other objects between the fingers that close on a target
    returned: int = 20  # grasps at most
    distinct_distance: float = 0.01  # no two returned grasps are both closer than this
    distinct_turn: float = np.deg2rad(20)  # and turned by less than this

    def relaxed(self) -> SearchSettings:
        """Settings whose margins are at most the `RELAXED` ones."""
        return replace(
            self,
            table_clearance=min(self.table_clearance, RELAXED.table_clearance),
            clearance=min(self.clearance, RELAXED.clearance),
            rooms=(min(self.rooms[0], RELAXED.room), *self.rooms),
            inner_margin=0.0,
            min_engagement=min(self.min_engagement, RELAXED.min_engagement),
            max_wedge=max(self.max_wedge, RELAXED.max_wedge),
            min_facing=min(self.min_facing, 0.6),
        )

    def off_centre(self) -> SearchSettings:
        """Relaxed settings whose hand may also stand beside the middle of what it grips, where a
        wall or a neighbour leaves the palm no room over it. Few of the shortlist fit there."""
        return replace(self.relaxed(), offsets=OFF_CENTRE, shortlist=4 * self.shortlist)


def grip_score(
    xp, settings: SearchSettings, *, wedge, turn, tilt, arms, cover, engagement, roomy, covered,
    together, over_table,
):  # fmt: skip
    """(N,) scores of measured candidates, as arrays of xp, which is numpy or torch.

    wedge, turn, tilt: (N,) radians, as in FACTS and `Candidates`; tilt of the worse face. arms:
    three of (N,), m, across, along and up. cover: (N,) share of a pad in touch. engagement: (N,) m.
    roomy: (N,) a factor for the room beside the contacts. covered: (N,) share of the hand.
    together: (N,) whether both ends lie on one object. over_table: (N,) m, of the object's top.
    """
    across, along, up = arms
    score = xp.exp(-((wedge / 0.25) ** 2) - (turn / 0.25) ** 2 - (tilt / 0.45) ** 2)
    score = score * xp.exp(-((across / 0.022) ** 2) - (along / 0.06) ** 2 - (up / 0.05) ** 2)
    score = score * (0.4 + 0.6 * cover)
    score = score * (engagement / settings.good_engagement).clip(0.2, 1)
    score = score * roomy
    score = score * xp.exp(-settings.covered_weight * covered)
    score = score * xp.where(together, 1.0, settings.split_factor)
    return score * (1 + 2 * over_table.clip(0, 0.15))  # prefers the top of a pile


def suppressed(alike: np.ndarray, count: int) -> list[int]:
    """Non-maximum suppression: the numbers of at most `count` of N, best first, of which no two are
    alike (N, N) bool."""
    kept, free = [], np.ones(len(alike), bool)
    while free.any() and len(kept) < count:
        kept.append(int(free.argmax()))
        free &= ~alike[kept[-1]]
        free[kept[-1]] = False
    return kept
