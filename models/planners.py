"""Planners: anything that turns an RGB-D frame into ranked grasps.

A planner is a callable `plan(frame) -> list[Grasp]`, best first; an empty list means that there is
nothing to grasp. `random` and `heuristic` see only the depth image, `graspnet` also the colours,
`oracle` the true geometry.
Heuristic and oracle share one search over a height map (`models.planner_antipodal`); the oracle judges the
best ones by exact contacts (`models.planner_contacts`), also with the pose perturbed. This module
knows no simulator.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import numpy as np

from models.planner_antipodal import SearchSettings, search
from models.planner_contacts import buried_share, exact_quality
from models.planner_graspnet import GraspNetPlanner
from utils.errors import unknown_choice
from utils.geometry import GripperGeometry, Workspace
from utils.height_map import height_map_from_frame, height_map_from_scene
from utils.transforms import Grasp, RGBDFrame

HEURISTIC_SETTINGS = SearchSettings()
ORACLE_SETTINGS = SearchSettings(shortlist=1500, finalists=500)


class Planner(Protocol):
    """needs_truth: whether the frame must carry `truth`."""

    needs_truth: bool

    def reset(self, seed: int) -> None: ...

    def __call__(self, frame: RGBDFrame) -> list[Grasp]: ...


class RandomPlanner:
    """Uniform over the pixels that lie above the table, at a random angle, fully open."""

    needs_truth = False

    def __init__(self, gripper: GripperGeometry, workspace: Workspace, seed: int, count: int = 20):
        self.gripper, self.workspace, self.count = gripper, workspace, count
        self.reset(seed)

    def reset(self, seed: int) -> None:
        self._random = np.random.default_rng(seed)

    def __call__(self, frame: RGBDFrame) -> list[Grasp]:
        points = frame.points().reshape(-1, 3)
        table, settings = self.workspace.table_height, SearchSettings()
        reach = self.workspace.size / 2 + settings.reach
        above = points[:, 2] > table + settings.min_engagement + settings.table_clearance
        above &= np.abs(points[:, :2] - self.workspace.centre).max(axis=1) < reach
        candidates = points[above]
        if len(candidates) == 0:
            return []
        lowest = table + settings.table_clearance + self.gripper.tip_below_centre
        grasps = []
        for quality in np.linspace(1, 0, self.count, endpoint=False):
            x, y, top = candidates[self._random.integers(len(candidates))]
            height = max(top - 0.02, lowest)  # the fingers reach 2 cm below the surface
            angle = self._random.uniform(0, np.pi)
            grasps.append(Grasp(np.array([x, y, height]), angle, self.gripper.max_opening, quality))
        return grasps


class HeuristicPlanner:
    """Antipodal search on the height map that the depth image gives; sees nothing else."""

    needs_truth = False

    def __init__(
        self,
        gripper: GripperGeometry,
        workspace: Workspace,
        seed: int = 0,
        settings: SearchSettings = HEURISTIC_SETTINGS,
    ):
        self.gripper, self.workspace, self.settings = gripper, workspace, settings

    def reset(self, seed: int) -> None:
        """Nothing to do: the planner is deterministic."""

    def __call__(self, frame: RGBDFrame) -> list[Grasp]:
        heights = height_map_from_frame(frame, self.workspace)
        found = search(heights, self.gripper, self.workspace, self.settings)
        found = found.distinct(
            self.settings.returned, self.settings.distinct_distance, self.settings.distinct_turn
        )
        return found.grasps(self.gripper)


class OraclePlanner:
    """The same search on the exact height map, then exact contacts under perturbed poses."""

    needs_truth = True

    def __init__(
        self,
        gripper: GripperGeometry,
        workspace: Workspace,
        seed: int = 0,
        settings: SearchSettings = ORACLE_SETTINGS,
        judged: int = 120,
    ):
        self.gripper, self.workspace, self.settings, self.judged = (
            gripper,
            workspace,
            settings,
            judged,
        )

    def reset(self, seed: int) -> None:
        """Nothing to do: the planner is deterministic."""

    def __call__(self, frame: RGBDFrame) -> list[Grasp]:
        if frame.truth is None:
            raise ValueError("The oracle planner needs frame.truth; this frame holds none")
        heights = height_map_from_scene(frame.truth, self.workspace)
        found = search(heights, self.gripper, self.workspace, self.settings)
        found = found.distinct(self.judged, 0.004, np.deg2rad(8))
        if len(found) == 0:
            return []
        quality = exact_quality(found, frame.truth, self.gripper)
        buried = buried_share(frame.truth, heights)
        # Antipodal ones first; if there is none, the best of the rest, by the map's measure.
        found.score = found.score * (0.01 + quality) * (1 - 0.7 * buried[found.label])
        found = found.best(len(found))
        found = found.distinct(
            self.settings.returned, self.settings.distinct_distance, self.settings.distinct_turn
        )
        return found.grasps(self.gripper)


PLANNERS: dict[str, Callable[..., Planner]] = {
    "random": RandomPlanner,
    "heuristic": HeuristicPlanner,
    "graspnet": GraspNetPlanner,
    "oracle": OraclePlanner,
}


def make_planner(name: str, gripper: GripperGeometry, workspace: Workspace, seed: int) -> Planner:
    """The planner of that name, or the network in a checkpoint file (NAME.pt); `seed` starts its
    own random generator.

    Raises UserError for a name that is neither, or a file that holds no network.
    """
    if name in PLANNERS:
        return PLANNERS[name](gripper, workspace, seed)
    if Path(name).suffix == ".pt":
        return GraspNetPlanner(gripper, workspace, seed, Path(name))
    others = ("a GraspNet checkpoint FILE.pt", "ppo", "ppo:FILE.pt")
    raise unknown_choice("evaluate.policies", name, [*PLANNERS, *others])
