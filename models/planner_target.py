"""One object among others: grasps of the target, or of what has to be moved aside first.

`TargetPlanner` works on any planner that honours `RGBDFrame.target`. It asks for grasps of the
target; where none is promising, for those of the neighbours, the one most in the way first. It
knows the image and the planner's own segmentation only, and remembers where the target was last
seen, so that it can uncover what is wholly hidden. This module knows no simulator and no arm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from models.planner_antipodal import SearchPlanner
from models.planners import Planner, calibration_of, needs_truth, reset_planner, takes_targets
from utils.calibration import Calibration
from utils.depth_correction import table_roughness
from utils.errors import UserError
from utils.target import MOSTLY, check_target, target_at, target_in_box
from utils.transforms import Grasp, RGBDFrame, known_depth


@dataclass(frozen=True)
class ClearingSettings:
    """When to take the target, and what is in its way; metres unless said.

    promising: least chance of success with which the target, or what is in its way, is grasped
    while there is an alternative. share: the same for planners that state no chances, or none under
    `promising`, as a share of the best score in the whole scene: scores are compared with each
    other alone. near: a surface at this distance from the target, seen from above, counts exp(-1)
    of one right beside it. over: height over the target at which it counts in full. beside: what a
    surface counts that is not over the target. in_the_way: cm2 of such surface from which an object
    is in the way. covering: cm2 of surface over the target and half as near, from which an object
    may rest on it, so that it goes first even where the target's grasps look promising. points: of
    each object that are looked at. enough: objects with promising grasps after which the search for
    others ends; one more than is needed, for the case that a grasp fails.
    """

    promising: float = 0.9
    share: float = 0.1  # on training scenes it decides as 0.9 does where chances are known
    near: float = 0.02
    over: float = 0.02
    beside: float = 0.2
    in_the_way: float = 0.5
    covering: float = 3.0
    points: int = 2000
    enough: int = 2


class TargetPlanner:
    """A planner whose grasps of the target come first, or, where none is promising, those that
    move aside what is in its way; best first, so that qualities need not fall.

    plan: honours targets. Frames carry the target's visible pixels (`RGBDFrame.target`), none where
    it is hidden. Raises UserError for a planner that cannot tell objects apart.
    """

    def __init__(self, plan: Planner, settings: ClearingSettings = ClearingSettings()):
        check_takes_targets(plan)
        self.plan, self.settings = plan, settings
        self.needs_truth = needs_truth(plan)
        self.calibration: Calibration | None = calibration_of(plan)
        self._last = np.empty((0, 3))  # where the target was last seen, in W

    def reset(self, seed: int) -> None:
        self._last = np.empty((0, 3))
        reset_planner(self.plan, seed)

    def __call__(self, frame: RGBDFrame) -> list[Grasp]:
        if frame.target is None:
            return self.plan(frame)
        grasps = self.plan(frame) if frame.target.any() else []
        objects = self._objects(frame)
        clearing = self._clearing(objects, grasps)
        aside, others = objects.parted(clearing)
        # Of promising grasps the planner's own order counts, which may prefer other things.
        promising, poor = objects.parted(grasps)
        poor = sorted([*poor, *others], key=lambda grasp: -grasp.quality)
        return [*aside, *promising, *poor]

    def clearing(self, frame: RGBDFrame, grasps: list[Grasp]) -> list[Grasp]:
        """Grasps that move aside what is in the way of the target, the promising ones of the object
        most in the way first; where its own `grasps` are promising, only of what may rest on it."""
        return self._clearing(self._objects(frame), grasps)

    def _objects(self, frame: RGBDFrame) -> _Objects:
        segments = self.plan.segments(frame)  # type: ignore[attr-defined]
        return _Objects(frame, segments, self.settings, self._promising(frame))

    def _promising(self, frame: RGBDFrame) -> float:
        """Least quality of a promising grasp: that of the score which has the least chance of
        `ClearingSettings` in a frame that is not rough, because roughness lowers all chances.
        Chances of a planner that nearly always succeeds may all lie above the least one: they tell
        no grasp from another, but its scores do."""
        chances, least, rough = self.calibration, self.settings.promising, frame.roughness
        workspace = getattr(self.plan, "workspace", None)  # of the project's planners
        if chances is not None and workspace is not None and not self.needs_truth:
            rough = max(rough, table_roughness(frame, workspace.table_height))
        if chances is not None and chances(0.0) < least:
            return float(chances(chances.scores(least), rough))
        everything = self.plan(replace(frame, target=None))
        if not everything:
            return 0.0
        best = max(grasp.quality for grasp in everything)
        if chances is None:
            return self.settings.share * best
        return chances.of_share(best, self.settings.share, rough)

    def _clearing(self, objects: _Objects, grasps: list[Grasp]) -> list[Grasp]:
        shown = objects.surface(objects.target)
        if len(shown):
            self._last = shown
        if objects.promise(grasps):
            return self._grasps_of(objects, objects.covering(self._last))[0]
        promising, others = self._neighbours(objects)
        return [*promising, *sorted(others, key=lambda grasp: -grasp.quality)]

    def _neighbours(self, objects: _Objects) -> tuple[list[Grasp], list[Grasp]]:
        """Promising grasps and others of what is in the target's way, of the object most in the way
        first; where none is promising, of what is in the way of these objects, and so on."""
        ring, visited, others = [self._last], set(), []
        while ring:
            found = dict.fromkeys(n for place in ring for n in objects.in_the_way(place))
            numbers = [number for number in found if number not in visited]
            promising, more = self._grasps_of(objects, numbers)
            others += more
            if promising:
                return promising, others
            visited.update(numbers)
            ring = [objects.surface(objects.labels == number) for number in numbers]
        return [], others

    def _grasps_of(self, objects: _Objects, numbers: list[int]) -> tuple[list[Grasp], list[Grasp]]:
        """Promising grasps of objects, in their order, and the other ones."""
        promising, others, enough = [], [], self.settings.enough
        for number in numbers:
            found = self.plan(replace(objects.frame, target=objects.labels == number))
            sure, unsure = objects.parted(found)
            promising, others = promising + sure, others + unsure
            enough -= bool(sure)
            if enough == 0:
                break
        return promising, others


class _Objects:
    """The objects of a frame but the target, as a planner tells them apart.

    labels: (H, W) numbers of the objects, -1 elsewhere. promising: least quality of a grasp that is
    worth trying while there is an alternative.
    """

    def __init__(
        self,
        frame: RGBDFrame,
        segments: np.ndarray,
        settings: ClearingSettings,
        promising: float,
    ):
        assert frame.target is not None
        self.frame, self.settings, self.promising = frame, settings, promising
        self.target = frame.target
        self.labels = np.where(frame.target, -1, segments)
        self._points = frame.points()
        self._known = np.isfinite(self._points[..., 2])
        # What a pixel shows of the scene, cm2.
        self._area = 1e4 * frame.depth**2 / (frame.K[0, 0] * frame.K[1, 1])
        numbers, counts = np.unique(self.labels[self.labels >= 0], return_counts=True)
        whole = np.bincount(segments[segments >= 0], minlength=1)
        # The rim of the target is none of the others.
        self.numbers = [
            int(number)
            for number, count in zip(numbers, counts)
            if count >= (1 - MOSTLY) * whole[number]
        ]

    def promise(self, grasps: list[Grasp]) -> bool:
        """Whether any of an object's grasps is promising."""
        return bool(self.parted(grasps)[0])

    def parted(self, grasps: list[Grasp]) -> tuple[list[Grasp], list[Grasp]]:
        """Promising grasps and others, in their order."""
        sure = [grasp for grasp in grasps if grasp.quality >= self.promising]
        return sure, [grasp for grasp in grasps if grasp.quality < self.promising]

    def surface(self, pixels: np.ndarray) -> np.ndarray:
        """(N, 3) points in W that some pixels (H, W) show, at most `points`, evenly."""
        points = self._points[pixels & self._known]
        return points[:: max(1, -(-len(points) // self.settings.points))]

    def in_the_way(self, place: np.ndarray) -> list[int]:
        """The objects in the way of a hand that goes to a surface (N, 3), which may be hidden now:
        those with enough surface near it and over it, seen from above; the one with most first."""
        settings = self.settings
        return self._around(place, settings.near, settings.beside, settings.in_the_way)

    def covering(self, place: np.ndarray) -> list[int]:
        """The objects that may rest on what has a surface (N, 3)."""
        return self._around(place, self.settings.near / 2, 0.0, self.settings.covering)

    def _around(self, place: np.ndarray, near: float, beside: float, least: float) -> list[int]:
        if len(place) == 0:
            return []
        tree, settings, found = cKDTree(place[:, :2]), self.settings, []
        for number in self.numbers:
            row, column = np.nonzero((self.labels == number) & self._known)
            step = max(1, -(-len(row) // settings.points))
            row, column = row[::step], column[::step]
            surface = self._points[row, column]
            apart, nearest = tree.query(surface[:, :2])
            over = np.clip((surface[:, 2] - place[nearest, 2]) / settings.over, 0, 1)
            weight = np.exp(-apart / near) * np.maximum(over, beside) * self._area[row, column]
            if step * float(weight.sum()) > least:
                found.append((step * float(weight.sum()), number))
        return [number for _, number in sorted(found, key=lambda pair: -pair[0])]


def check_takes_targets(plan: Planner, name: str = "the planner", task: str = "do that") -> None:
    """Raise UserError for a planner that does not honour `RGBDFrame.target`. name, task: of the
    planner, and what it should do; for the error."""
    if not takes_targets(plan):
        raise UserError(
            f"{name} does not tell objects apart (it has no method segments(frame), see "
            f"docs/planner.md), so that it cannot {task}; heuristic, graspnet, oracle and their 6d "
            "variants can"
        )


def check_reached(
    grasps: Sequence[Grasp], clearing: Sequence[Grasp], width: float, opening: float
) -> list[str]:
    """A remark on a target that is not free yet. Raises UserError for one that no grasp reaches,
    and that is too wide or has nothing in its way that could be moved. width: `least_width` of the
    target; opening: of the hand, m."""
    if grasps and clearing:
        return [
            "something is in the target's way or may rest on it: `clearing` moves it aside first"
        ]
    if grasps:
        return []
    if width > opening:
        raise UserError(
            f"no grasp reaches the target: what is seen of it is at least {width:.2g} m wide, and "
            f"the hand opens {opening:g} m"
        )
    if not clearing:
        raise UserError(
            "no grasp reaches the target, and nothing beside it can be moved aside; try another "
            "view or --planner graspnet6d, whose hand comes from any side"
        )
    return ["no grasp reaches the target yet; `clearing` moves aside what is in its way"]


def find_target(
    plan: SearchPlanner,
    taken: RGBDFrame,
    frame: RGBDFrame,
    point: Sequence[float] | None,
    box: Sequence[float] | None,
    mask: np.ndarray | None,
) -> np.ndarray | None:
    """(H, W) bool, the pixels of the one object that a user has named by a pixel (u, v), a box
    (u0, v0, u1, v1) or a mask (H, W); None where nothing was named.

    taken: the frame as the camera gave it, which the planner corrects itself. frame: the same,
    corrected. Raises UserError where nothing is there.
    """
    if mask is not None:
        check_target(mask, frame, plan.workspace)
        return mask
    if point is not None:
        return target_at(plan.segments(taken), frame, point)
    if box is not None:
        return target_in_box(plan.segments(taken), box)
    return None


def least_width(frame: RGBDFrame, table_height: float) -> float:
    """Metres of what is seen of the frame's target where it is narrowest: across it, as seen from
    above, or from the table to its top; 0 where no depth is known. Of each extent, 2 % of the
    pixels on both sides are left out, which at edges lie between the object and what is behind."""
    points = frame.points()[frame.target & known_depth(frame.depth)]
    if len(points) == 0:
        return 0.0
    angle = np.deg2rad(np.arange(0, 180, 5))
    across = points[:, :2] @ np.stack([np.cos(angle), np.sin(angle)])
    low, high = np.percentile(across, (2, 98), axis=0)
    top = float(np.percentile(points[:, 2], 98))
    return float(min((high - low).min(), top - table_height))
