"""Antipodal search on a height map: grasps whose two fingers close on opposite faces.

The search has two stages. The dense stage (`models.planner_runs`) finds, for every angle and height
of the fingertips, runs of matter along the closing line that fit between the fingers. The second
stage (`models.planner_measure`) poses each of the best on the map, measures contacts, clearances
and lever arms, centres the grasp and turns it onto the faces. `models.planner_candidates` has the
candidates and the margins of both stages. `SearchPlanner` is the base of the planners that search.
This module knows height maps only: neither the image nor the solids behind them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from models.planner_candidates import Candidates, SearchSettings
from models.planner_measure import measure, turn_onto_faces, without_bumps
from models.planner_runs import dense_candidates
from utils.calibration import Calibration
from utils.depth_correction import corrected
from utils.geometry import GripperGeometry, Workspace
from utils.height_map import HeightMap
from utils.target import pixel_labels
from utils.transforms import Grasp, RGBDFrame


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
    found = without_bumps(found, heights, gripper)
    found = turn_onto_faces(found, heights, gripper, settings)
    return _valued(found, value).best(len(found))


def _valued(found: Candidates, value) -> Candidates:
    return found if value is None else replace(found, score=found.score * value(found))
