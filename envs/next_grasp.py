"""Which grasp of a plan the arm tries next, and which it leaves.

What has failed is not tried again at once, for often nothing has moved. Of planners that state
chances, grasps elsewhere that are more likely to succeed than not (whose quality as planned is 0.5
or more) come first; of all, those that are not alike one that has just failed. After a failure, all
chances count as lower (`utils.calibration`): by these it is judged, and recorded, whether a grasp
is worth trying.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from envs.cell import Cell
from envs.execution import GraspOutcome, reaches
from envs.floating_execution import clears_table
from models.planners import Planner, calibration_of
from utils.calibration import LEAST_CHANCE, Calibration
from utils.transforms import PLANAR, Grasp

# A grasp nearer than both to one that failed is the same one again.
TRIED_DISTANCE = 0.02  # m
TRIED_ANGLE = np.deg2rad(30)
ANOTHER = 0.05  # m from every grasp that failed: most likely another object
ROOM_OVER_TOUCH = 0.004  # m above the height of a contact


@dataclass
class Failures:
    """The grasps that failed: in a row, with the places (3,), m in W, of the hand where its palm
    met something, None elsewhere; and in the round, where nothing was picked since. slipped:
    whether the judge found that the last of them had lost what it had gripped."""

    in_a_row: list[Grasp] = field(default_factory=list)
    palm_stops: list[np.ndarray | None] = field(default_factory=list)
    in_round: list[Grasp] = field(default_factory=list)
    slipped: bool = False

    def note(self, grasp: Grasp, outcome: GraspOutcome) -> None:
        """Remember what has been executed."""
        self.slipped = outcome.reason in ("slipped", "dropped")
        if outcome.success:
            self.in_a_row, self.palm_stops = [], []
            # What lay there is gone.
            self.in_round = [one for one in self.in_round if not _is_near(one, grasp)]
            return
        self.in_a_row.append(grasp)
        self.palm_stops.append(outcome.palm_stopped_at)
        self.in_round.append(grasp)


def choose(
    cell: Cell,
    grasps: Sequence[Grasp],
    failures: Failures,
    least: float,
    chances: Calibration | None,
) -> tuple[Grasp | None, str]:
    """The grasp of a plan that is tried, with the quality that it has now, or None and why none is.

    least: quality below which none is tried. chances: of the planner, None for one whose qualities
    are scores.
    """
    now = partial(after_a_failure, chances=chances if failures.in_a_row else None)
    worth = [grasp for grasp in grasps if now(grasp).quality >= least]
    if not worth:
        return None, _abstained(map(now, grasps), least)
    if failures.in_round and chances is not None:
        worth = elsewhere_first(worth, failures.in_round)
    chosen = first_untried(within_reach(cell, worth), failures.in_a_row)
    if chosen is None:
        return None, _out_of_reach(len(worth), len(grasps))
    return now(no_deeper(chosen, failures.in_a_row, failures.palm_stops)), ""


def _abstained(grasps: Iterable[Grasp], least: float) -> str:
    """Why none of the grasps is tried; empty where there are none."""
    best = max((grasp.quality for grasp in grasps), default=None)
    return "" if best is None else f"abstained: the best quality is {best:.4g}, under {least:g}"


def _out_of_reach(worth: int, planned: int) -> str:
    """Says that no grasp is within reach. worth: the number of those that are good enough to try;
    planned: of all."""
    if worth == planned:
        return f"all planned grasps ({planned}) are out of reach"
    return f"all planned grasps that are worth trying ({worth} of {planned}) are out of reach"


def least_quality(planner: Planner, abstain: float | None, has_arm: bool) -> float:
    """Below which quality a planner's grasps are not tried. abstain: as in the config; None leaves
    out what is more likely to fail, where the planner states chances of success, an arm's."""
    if abstain is not None:
        return abstain
    return LEAST_CHANCE if has_arm and calibration_of(planner) is not None else 0.0


def after_a_failure(grasp: Grasp, chances: Calibration | None) -> Grasp:
    """The grasp with the chance that it has after a failure, by its planner's calibration; itself
    without one."""
    if chances is None:
        return grasp
    return replace(grasp, quality=chances.after_failure(grasp.quality))


def within_reach(cell: Cell, grasps: Sequence[Grasp]) -> Iterator[Grasp]:
    """The grasps that the arm can go to, in their order; those from straight above are not asked
    where nothing hangs over the table, because nearly all are. A floating hand reaches all that are
    above the table."""
    reachable = reaches if cell.has_arm else clears_table
    least = 0.0 if cell.hanging else PLANAR
    for grasp in grasps:
        if grasp.tilt < least or reachable(cell, grasp):
            yield grasp


def first_untried(grasps: Iterable[Grasp], failed: Sequence[Grasp]) -> Grasp | None:
    """The first grasp that is not near one of those that failed; the first of all where each is;
    None of none."""
    first = None
    for grasp in grasps:
        first = first or grasp
        if not any(_alike(grasp, other) for other in failed):
            return grasp
    return first


def elsewhere_first(grasps: Iterable[Grasp], failed: Sequence[Grasp]) -> list[Grasp]:
    """The grasps in their order, but first those that are more likely to succeed than not and lie
    ANOTHER from all that failed."""

    def is_last(grasp: Grasp) -> bool:
        return grasp.quality < LEAST_CHANCE or any(_is_near(grasp, other) for other in failed)

    return sorted(grasps, key=is_last)


def _is_near(grasp: Grasp, other: Grasp) -> bool:
    """Whether two grasps are most likely of the same object."""
    return bool(np.linalg.norm(grasp.position - other.position) < ANOTHER)


def _alike(grasp: Grasp, other: Grasp) -> bool:
    """Whether two grasps are so near each other that one of them is enough to try."""
    along = grasp.approach
    apart = grasp.position - other.position
    beside = apart - (apart @ along) * along  # a deeper grasp is the same one
    cosines = abs(grasp.closing_direction @ other.closing_direction), along @ other.approach
    return bool(np.linalg.norm(beside) <= TRIED_DISTANCE and min(cosines) >= np.cos(TRIED_ANGLE))


def no_deeper(grasp: Grasp, failed: Sequence[Grasp], stops: Sequence[np.ndarray | None]) -> Grasp:
    """The grasp, drawn back before the places `stops` (m, of E) at which the palm met something.

    A camera may miss a thin part that stands up from an object; the contact with the palm tells how
    high that part is.
    """
    deepest = min(
        (
            stop @ grasp.approach - ROOM_OVER_TOUCH
            for other, stop in zip(failed, stops)
            if stop is not None and _alike(replace(other, angle=grasp.angle), grasp)
        ),
        default=np.inf,
    )
    too_deep = grasp.position @ grasp.approach - deepest
    if too_deep <= 0:
        return grasp
    return replace(grasp, position=grasp.position - too_deep * grasp.approach)
