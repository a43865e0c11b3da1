"""Grasps from any side: the antipodal search in a fan of tilted views of one scene.

A parallel gripper that comes along a straight line sees the scene as a height map along that line.
So a grasp with six degrees of freedom is a planar grasp in a tilted view (`utils.height_map`), and
the planar search serves each direction of the fan. What the camera has not seen bounds the ceiling
of every view; the table is a slope there. This module knows neither networks nor the arm, which
decides later what it can reach.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from models.planner_antipodal import SearchPlanner, search_once
from models.planner_candidates import Candidates, SearchSettings, suppressed, with_chances
from models.planner_contacts import buried_share, scored_by_contacts
from utils.depth_correction import corrected
from utils.geometry import ConvexSolid, GripperGeometry, Workspace
from utils.height_map import (
    HeightMap,
    height_map_from_frame,
    height_map_from_scene,
    tilted_height_map,
    tilted_view,
)
from utils.seen_heights import without_holes
from utils.target import object_of_target, only_object, only_target
from utils.transforms import DOWN, Grasp, RGBDFrame, inverse_pose

Value = Callable[[HeightMap, Candidates], np.ndarray]
"""A factor (N,) on the scores of candidates that were found on a map."""
Judge = Callable[[HeightMap, Candidates], Candidates]
"""The candidates of one view, best first, with other scores; perhaps fewer."""


@dataclass(frozen=True)
class FanSettings:
    """The directions of a fan, and what their grasps are worth; degrees unless said.

    rings: tilt from the vertical and number of directions around it, for each ring of the fan.
    level: the last ring where something hangs over the table, so that the hand comes from the side
    alone.
    tilt_scale: rad, of the Gaussian that prefers steep approaches: arm and table leave them more
    room. It decides on the order alone, and no quality falls by it. returned: grasps at most; no
    two are closer than distinct_distance (m) and turned by less than distinct_turn (rad). wrist:
    what the arm behind the hand takes up beside it: m across, and m above the fingertips.
    """

    rings: tuple[tuple[float, int], ...] = ((30.0, 8), (60.0, 8), (85.0, 4))
    level: tuple[float, int] = (85.0, 16)
    tilt_scale: float = 1.2
    returned: int = 40
    distinct_distance: float = 0.01
    distinct_turn: float = np.deg2rad(20)
    wrist: tuple[float, float] = (0.06, 0.13)

    def preference(self, tilt: np.ndarray) -> np.ndarray:
        """(...) factors on the scores, as grasps are ordered, of approaches tilted by radians."""
        return np.exp(-((np.minimum(tilt, _TILTED) / self.tilt_scale) ** 2))

    def directions(self, covered: bool = False) -> list[np.ndarray]:
        """Approaches (3,), unit vectors in W, the vertical first. covered: whether something hangs
        over the table."""
        fan = [np.array(DOWN)]
        rings = (*self.rings[:-1], self.level) if covered else self.rings
        for tilt, count in rings:
            for turn in np.arange(count) * 2 * np.pi / count:
                out = np.sin(np.deg2rad(tilt)) * np.array([np.cos(turn), np.sin(turn)])
                fan.append(np.array([*out, -np.cos(np.deg2rad(tilt))]))
        return fan


_TILTED = np.deg2rad(60)  # beyond which a tilt costs no more
_LEVEL = np.cos(np.deg2rad(75))  # of a view that counts as level
_LEVEL_FROM = 0.09  # m over the table of the highest matter, from which level views are searched
# Fewer angles and candidates in each view than in one view alone: there are many views.
SEARCH = SearchSettings(angles=9, shortlist=80, finalists=60, covered_weight=2.0)


class FanPlanner(SearchPlanner):
    """Base of the planners that search a fan of views.

    Arguments as in `SearchPlanner`; fan: the views.
    """

    tilts = True

    def __init__(
        self,
        gripper: GripperGeometry,
        workspace: Workspace,
        seed: int = 0,
        settings: SearchSettings = SEARCH,
        fan: FanSettings = FanSettings(),
    ):
        super().__init__(gripper, workspace, seed, settings)
        self.fan = fan
        self._with_wrist = replace(gripper, palm_outline=(*gripper.palm_outline, fan.wrist))

    def return_at_least(self, count: int) -> None:
        super().return_at_least(count)
        self.fan = replace(self.fan, returned=max(count, self.fan.returned))

    def search_fan(
        self,
        overhead: HeightMap,
        maps: Callable[[np.ndarray], HeightMap],
        value: Value | None = None,
        judge: Judge | None = None,
        covered: bool = False,
    ) -> list[Grasp]:
        """The grasps of all views with their scores, best first by score and tilt; may be empty.

        overhead: the map from above, without what hangs over the table. maps: gives the height map
        in a frame T_WV (4, 4). judge: has the last word on what a view's candidates are worth.
        covered: whether something hangs over the table. Where nothing in any view meets the
        margins, relaxed ones serve.
        """
        views = [maps(T_WV) for T_WV in self.frames(overhead, covered)]
        for settings in (self.settings, self.settings.relaxed()):
            grasps = []
            for heights in views:
                grasps += self._search_view(heights, settings, value, judge)
            if grasps:
                grasps = sorted(grasps, key=self._worth, reverse=True)
                poses = np.array([grasp.pose for grasp in grasps])
                return [grasps[kept] for kept in distinct(poses, self.fan)]
        return []

    def _worth(self, grasp: Grasp) -> float:
        return grasp.quality * float(self.fan.preference(np.array(grasp.tilt)))

    def covered(self, solids: Sequence[ConvexSolid]) -> bool:
        """Whether one of the solids, in W, hangs over the table."""
        return any(solid.hangs(self.workspace.table_height) for solid in solids)

    def frames(self, overhead: HeightMap, covered: bool = False) -> list[np.ndarray]:
        """The frames T_WV (4, 4) of the fan, the one from above first. Those of a hand that comes
        nearly level are left out where nothing is high enough for it."""
        rises = overhead.height[overhead.label >= 0] - overhead.table_height
        level = rises.max(initial=-np.inf) >= _LEVEL_FROM
        return [
            tilted_view(approach, self.workspace)
            for approach in self.fan.directions(covered)
            if level or approach[2] <= -_LEVEL
        ]

    def _search_view(
        self,
        heights: HeightMap,
        settings: SearchSettings,
        value: Value | None,
        judge: Judge | None,
    ) -> list[Grasp]:
        tilt = np.arccos(np.clip(heights.T_WV[2, 2], -1.0, 1.0))
        on_map = None if value is None else lambda candidates: value(heights, candidates)
        found = search_once(
            heights, self._with_wrist, self.workspace, settings, on_map, 2 if tilt > 0 else 1
        )
        if judge is not None and len(found):
            found = judge(heights, found)
        found = found.distinct(
            settings.returned, settings.distinct_distance, settings.distinct_turn
        )
        return [
            Grasp.from_pose(heights.T_WV @ grasp.pose, grasp.width, grasp.quality)
            for grasp in found.grasps(self.gripper)
        ]


def distinct(poses: np.ndarray, fan: FanSettings) -> list[int]:
    """Non-maximum suppression of hands at poses T_WE (N, 4, 4), best first: the numbers of at most
    `fan.returned` that are left."""
    place = poses[:, :3, 3]
    alike = np.linalg.norm(place[:, None] - place, axis=2) < fan.distinct_distance
    alike &= turns_between(poses) < fan.distinct_turn
    return suppressed(alike, fan.returned)


def turns_between(poses: np.ndarray) -> np.ndarray:
    """(N, N) radians of the least turn that takes the hand at one of the poses T_WE (N, 4, 4),
    which may be flipped, to that at another.

    For rotations R and S: trace(R^T S) = 1 + 2 cos(turn).
    """
    x, y, z = (poses[:, :3, k] @ poses[:, :3, k].T for k in range(3))  # the diagonal of R^T S
    return np.arccos(np.clip((np.maximum(x + y, -x - y) + z - 1) / 2, -1, 1))


class HeuristicFanPlanner(FanPlanner):
    """The fan on the depth image; colours tell table and edges in a rough one."""

    def __call__(self, frame: RGBDFrame) -> list[Grasp]:
        frame = corrected(frame, self.workspace.table_height)
        overhead = only_target(self.heights(frame), frame)
        filled, hiding = without_holes(frame, self.workspace)

        def seen(T_WV: np.ndarray) -> HeightMap:
            return tilted_height_map(overhead, filled, hiding, T_WV)

        grasps = self.search_fan(overhead, seen, covered=self.covered(frame.fixtures))
        return with_chances(grasps, self.calibration, frame.roughness)

    def heights(self, frame: RGBDFrame) -> HeightMap:
        return height_map_from_frame(frame, self.workspace, below=True)


class OracleFanPlanner(FanPlanner):
    """The fan on exact height maps, then exact contacts under perturbed poses.

    count: candidates of a view whose contacts are computed.
    """

    needs_truth = True
    count = 20

    def __call__(self, frame: RGBDFrame) -> list[Grasp]:
        overhead, truth = self.heights(frame), frame.truth
        assert truth is not None  # `heights` needs it
        buried = buried_share(truth, overhead)
        wanted = None if frame.target is None else object_of_target(overhead, frame)

        def of_target(heights: HeightMap) -> HeightMap:
            return heights if frame.target is None else only_object(heights, wanted)

        def exact(T_WV: np.ndarray) -> HeightMap:
            return of_target(height_map_from_scene(truth, self.workspace, T_WV=T_WV))

        def by_contacts(heights: HeightMap, found: Candidates) -> Candidates:
            found = found.distinct(self.count, 0.004, np.deg2rad(8))
            scene = truth.transformed(inverse_pose(heights.T_WV))
            return scored_by_contacts(found, scene, self.gripper, buried)

        covered = self.covered(truth.walls)
        grasps = self.search_fan(of_target(overhead), exact, None, by_contacts, covered)
        return with_chances(grasps, self.calibration)

    def heights(self, frame: RGBDFrame) -> HeightMap:
        if frame.truth is None:
            raise ValueError("The oracle planner needs frame.truth; this frame holds none")
        return height_map_from_scene(frame.truth.uncovered(), self.workspace)
