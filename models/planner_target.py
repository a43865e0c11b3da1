"""One object among others: grasps of the target, or of what has to be moved aside first.

`TargetPlanner` works on any planner that honours `RGBDFrame.target`. It asks for grasps of the
target; where none is promising, for those of the neighbours, the one most in the way first. It
knows the image and the planner's own segmentation only, and remembers where the target was last
seen, so that it can uncover what is wholly hidden. This module knows no simulator and no arm.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from models.planners import Planner, calibration_of, needs_truth, reset_planner, takes_targets
from utils.calibration import Calibration
from utils.errors import UserError
from utils.target import MOSTLY
from utils.transforms import Grasp, RGBDFrame


@dataclass(frozen=True)
class ClearingSettings:
    """When to take the target, and what is in its way; metres unless said.

    promising: least chance of success with which the target is grasped while something else may be
    moved aside. least: the same for a neighbour that is moved aside; worse grasps come last.
    near: a neighbour's surface at this distance from the target, seen from above, counts exp(-1) of
    one right beside it. over: height over the target at which it counts in full. beside: what a
    surface counts that is not over the target. in_the_way: cm2 of such surface from which a
    neighbour is in the way. points: of the target and of each neighbour that are looked at.
    """

    promising: float = 0.8
    least: float = 0.5
    near: float = 0.02
    over: float = 0.02
    beside: float = 0.2
    in_the_way: float = 0.5
    points: int = 2000


class TargetPlanner:
    """A planner whose grasps of the target come first, or, where none is promising, those that
    move its neighbours aside; best first, so that qualities need not fall.

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
        if grasps and grasps[0].quality >= self.settings.promising:
            return grasps
        clearing = self.clearing(frame)
        useful = [grasp for grasp in clearing if grasp.quality >= self.settings.least]
        return useful + sorted(
            [*grasps, *(grasp for grasp in clearing if grasp.quality < self.settings.least)],
            key=lambda grasp: -grasp.quality,
        )

    def clearing(self, frame: RGBDFrame) -> list[Grasp]:
        """Grasps of the objects in the target's way, those of the object most in the way first."""
        found = []
        for pixels in self.neighbours(frame):
            found += self.plan(replace(frame, target=pixels))
        return found

    def neighbours(self, frame: RGBDFrame) -> list[np.ndarray]:
        """(H, W) bool of each object that is in the target's way, the one most in the way first.

        An object is in the way by its surface near the target and over it, seen from above; over
        the place where the target was last seen, where no pixel shows it now.
        """
        assert frame.target is not None
        settings, points = self.settings, frame.points()
        known = np.isfinite(points[..., 2])
        if (frame.target & known).any():
            self._last = _thinned(points[frame.target & known], settings.points)
        if len(self._last) == 0:
            return []
        segments = self.plan.segments(frame)  # type: ignore[attr-defined]
        labels = np.where(frame.target, -1, segments)
        tree = cKDTree(self._last[:, :2])
        # What a pixel shows of the scene, cm2, with the depth along the axis for the distance.
        area = 1e4 * frame.depth**2 / (frame.K[0, 0] * frame.K[1, 1])
        found = []
        for label in np.unique(labels[labels >= 0]):
            pixels = labels == label
            row, column = np.nonzero(pixels & known)
            if len(row) < (1 - MOSTLY) * (segments == label).sum():
                continue  # the rim of the target, or nothing known
            step = -(-len(row) // settings.points)
            row, column = row[::step], column[::step]
            surface = points[row, column]
            apart, nearest = tree.query(surface[:, :2])
            over = np.clip((surface[:, 2] - self._last[nearest, 2]) / settings.over, 0, 1)
            weight = np.exp(-apart / settings.near) * np.maximum(over, settings.beside)
            found.append((step * float((weight * area[row, column]).sum()), pixels))
        found.sort(key=lambda pair: -pair[0])
        return [pixels for weight, pixels in found if weight > settings.in_the_way]


def check_takes_targets(plan: Planner, name: str = "the planner", task: str = "do that") -> None:
    """Raise UserError for a planner that does not honour `RGBDFrame.target`. name, task: of the
    planner, and what it should do; for the error."""
    if not takes_targets(plan):
        raise UserError(
            f"{name} does not tell objects apart (it has no method segments(frame), see "
            f"docs/planner.md), so that it cannot {task}; heuristic, graspnet, oracle and their 6d "
            "variants can"
        )


def _thinned(points: np.ndarray, count: int) -> np.ndarray:
    """About `count` of points (N, 3), evenly."""
    return points[:: -(-len(points) // count)]
