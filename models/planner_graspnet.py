"""GraspNet as a planner: its peaks and an antipodal search propose grasps, which a critic ranks.

A network's maps are exact to a few millimetres; fingers beside an object need better. So the grasps
at its peaks are fitted to the height map. Where none of them is likely to succeed, an antipodal
search proposes others, and the network's quality at their places and angles is a factor on their
scores: before they are measured on the height map, so that few have to be, and after. Of the best,
a critic says how likely they succeed (`models.grasp_critic`). What the network tells about a frame
is the subject of `models.graspnet_view`.
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch

from models import fan_search
from models.fan_views import fan_views
from models.grasp_critic import CriticInputs, GraspCritic, critic_inputs, shipped_critic
from models.graspnet_decoding import PeakSettings
from models.graspnet_io import SHIPPED, SavedGraspNet, fastest_dtype, for_inference, load_graspnet
from models.graspnet_view import NetworkView
from models.planner_antipodal import SearchPlanner
from models.planner_candidates import Candidates, SearchSettings, with_chances
from models.planner_fan import SEARCH, FanPlanner, FanSettings, distinct
from models.planner_measure import measure, turn_onto_faces, without_bumps
from utils.depth_correction import corrected
from utils.errors import UserError
from utils.geometry import GripperGeometry, Workspace
from utils.grasp_quality import grasp_depth
from utils.height_map import OTHER_LABEL, HeightMap, tilted_height_map
from utils.target import only_target
from utils.transforms import PLANAR, Grasp, RGBDFrame, known_depth, top_down_pose

# Half the heuristic's angles: turning onto the faces and the network make up for it. The split
# factor is strict because the votes separate objects better than height alone.
SETTINGS = SearchSettings(angles=9, shortlist=120, finalists=120, split_factor=0.1)
# Of the quality map: many peaks, because the height map decides which of them fit.
PEAKS = PeakSettings(threshold=0.02, count=80, radius=3)
DEPTH_STEPS = (0.0, 0.008, -0.008)  # m, of the fingertips, from the depth of the labels
# Candidates that the critic judges: of a planar search, and of each view of a fan; no two of them
# are both closer and less turned than this, m and rad.
PLANAR_JUDGED, VIEW_JUDGED = 40, 12
JUDGED_DISTANCE, JUDGED_TURN = 0.01, np.deg2rad(20)
# The critic's chance from which a grasp is as good as any: no other ones are looked for. For the
# other sides of `graspnet6d` it lies between two limits that were compared on training objects
# (docs/choices.md); the search beside the peaks took it over.
LIKELY = 0.975

Judge = Callable[[HeightMap, Candidates, CriticInputs], np.ndarray]


def loaded(checkpoint: Path) -> SavedGraspNet:
    """The network of a file, read once as long as the file does not change. Raises UserError."""
    return _loaded(checkpoint, checkpoint.stat().st_mtime if checkpoint.exists() else 0.0)


@functools.lru_cache(maxsize=4)  # a training replaces its file at every better score
def _loaded(path: Path, changed: float) -> SavedGraspNet:
    saved = load_graspnet(path)
    return saved._replace(model=for_inference(saved.model, fastest_dtype()))


def chances_by(critic: GraspCritic) -> Judge:
    """A critic as the judge of candidates."""
    return lambda heights, found, inputs: critic.chance(inputs)


class WithCritic:
    """What the planners share whose candidates a critic may judge last (`models.grasp_critic`).

    judge: from a map, candidates and what the critic sees of them to their chances (N,); None
    leaves the search's scores.
    """

    gripper: GripperGeometry
    judge: Judge | None = None

    def judged(
        self, heights: HeightMap, found: Candidates, seen: NetworkView, count: int
    ) -> Candidates:
        """The best of the candidates, no two alike, scored by their chances."""
        if self.judge is None or len(found) == 0:
            return found
        found = found.distinct(count, JUDGED_DISTANCE, JUDGED_TURN)
        value, least_held = seen.value(heights, found), self.gripper.least_held
        inputs = critic_inputs(found, heights, value, seen.towards, least_held)
        return replace(found, score=self.judge(heights, found, inputs)).best(len(found))


class GraspNetPlanner(WithCritic, SearchPlanner):
    """Grasps at the peaks of a network's quality map and, where a critic finds none of them likely,
    of an antipodal search that the network values, ranked by the critic, on the RGB-D image alone.
    A network without a critic ranks the search.

    checkpoint: file of the network, unless `network` is given. critic: has the last word; where
    none is given, the shipped one for the shipped network, with which it was trained, and none for
    others. likely: the critic's chance of the best peak, from which nothing is searched. Raises
    UserError if a file cannot be loaded.
    """

    def __init__(
        self,
        gripper: GripperGeometry,
        workspace: Workspace,
        seed: int = 0,
        checkpoint: Path = SHIPPED,
        network: SavedGraspNet | None = None,
        settings: SearchSettings = SETTINGS,
        critic: GraspCritic | None = None,
        likely: float = LIKELY,
    ):
        super().__init__(gripper, workspace, seed, settings)
        self.network = network or loaded(checkpoint)
        self.likely = likely
        if critic is None and network is None and checkpoint.resolve() == SHIPPED:
            critic = shipped_critic()
        if critic is not None:
            self.judge = chances_by(critic)

    def __call__(self, frame: RGBDFrame) -> list[Grasp]:
        if not known_depth(frame.depth).any():  # a blank frame shows nothing to grasp
            return []
        return self.of_corrected(corrected(frame, self.workspace.table_height))

    def of_corrected(self, frame: RGBDFrame) -> list[Grasp]:
        """The grasps in a frame that is corrected by its table (`utils.depth_correction`)."""
        # A target may be as low as what the crop takes for table.
        seen = NetworkView(self.network, frame, self.workspace, crop=frame.target is None)
        heights = only_target(seen.heights, frame)
        if len(heights.centres) == 0:  # table and walls alone
            return []
        return self.grasps(self.ranked(heights, seen), frame.roughness)

    def ranked(self, heights: HeightMap, seen: NetworkView) -> Candidates:
        """Candidates on the map of a view, best first."""
        if self.judge is None:
            return self.searched(heights, seen)
        at_peaks = self.at_peaks(heights, seen)
        if len(at_peaks) and at_peaks.score[0] >= self.likely:
            return at_peaks
        both = Candidates.joined([at_peaks, self.searched(heights, seen)])
        return both.best(len(both))

    def searched(self, heights: HeightMap, seen: NetworkView) -> Candidates:
        """Those of the antipodal search, judged."""
        found = self.search(heights, partial(seen.value, heights))
        return self.judged(heights, found, seen, self._count)

    def at_peaks(self, heights: HeightMap, seen: NetworkView) -> Candidates:
        """Those at the network's peaks, judged.

        At each peak of the quality map, and at the angles that the network prefers there, a grasp
        is posed: centred between its contacts, turned onto the faces, as deep as a label is or a
        little more or less. Of those whose fingers and palm find room, the critic judges the ones
        that the search would rank first.
        """
        found = fitted_peaks(heights, seen, self.gripper, self.workspace, self.settings)
        return self.judged(heights, found, seen, self._count)

    @property
    def _count(self) -> int:
        return max(PLANAR_JUDGED, self.settings.returned)

    def heights(self, frame: RGBDFrame) -> HeightMap:
        return NetworkView(self.network, frame, self.workspace).heights


class GraspNetDirectPlanner(GraspNetPlanner):
    """The network's own peaks alone: nothing is searched."""

    def ranked(self, heights: HeightMap, seen: NetworkView) -> Candidates:
        return self.at_peaks(heights, seen)


def fitted_peaks(
    heights: HeightMap,
    seen: NetworkView,
    gripper: GripperGeometry,
    workspace: Workspace,
    settings: SearchSettings,
) -> Candidates:
    """Measured candidates at the peaks of a network's quality, scored as the search does."""
    value = partial(seen.value, heights)
    rough = _at_points(seen.peaks(PEAKS), heights, gripper, workspace, settings)
    rough = replace(rough, score=value(rough))
    for margins in (settings, settings.relaxed(), settings.off_centre()):
        deep = _at_depths(rough.best(margins.shortlist), workspace.table_height, margins)
        found = measure(deep, heights, gripper, margins, len(DEPTH_STEPS)).best(margins.finalists)
        found = without_bumps(found, heights, gripper)
        if len(found):
            found = turn_onto_faces(found, heights, gripper, margins)
            return replace(found, score=found.score * value(found)).best(len(found))
    return found


def _at_points(
    points: np.ndarray,
    heights: HeightMap,
    gripper: GripperGeometry,
    workspace: Workspace,
    settings: SearchSettings,
) -> Candidates:
    """Candidates at points (N, 3) at all angles, their fingertips at the surface."""
    away = np.abs(points[:, :2] - workspace.centre).max(axis=1)
    points = points[away < workspace.size / 2 + settings.reach]
    points = points[heights.label[heights.index(points[:, :2])] != OTHER_LABEL]
    count = settings.angles
    angle = np.tile(np.arange(count) * np.pi / count, len(points))
    xy = np.repeat(points[:, :2], count, axis=0)
    surface = heights.height[heights.index(xy)]
    width = gripper.max_opening - 2 * settings.rooms[0]
    return Candidates.rough(xy, angle, surface, np.full(len(xy), width), np.ones(len(xy)))


def _at_depths(rough: Candidates, table: float, settings: SearchSettings) -> Candidates:
    """Each candidate with its fingertips DEPTH_STEPS over the depth that a label has. table: m."""
    tip = rough.tip - grasp_depth(rough.tip, table)
    lowest = table + settings.table_clearance
    return Candidates.joined(
        [replace(rough, tip=np.maximum(tip + step, lowest)) for step in DEPTH_STEPS]
    )


# The critic's chance tells already what a tilt costs; what is left is the room for the arm.
JUDGED_FAN = FanSettings(tilt_scale=3.0)


class GraspNetFanPlanner(WithCritic, FanPlanner):
    """From straight above where that is likely to succeed, as `GraspNetPlanner` plans for a hand
    with a wrist; elsewhere in a fan of views, too: a network values the candidates by the image
    that was taken, and a critic has the last word on each view's: the shipped one, unless `critic`
    is given. A critic on another device than the network's is copied. Raises UserError for a file
    of another network without a critic of its own.

    likely: the critic's chance of the best grasp from straight above, from which no other side is
    looked at (and of the best peak there, from which nothing is searched); over 1, the fan alone
    serves. device: of the network. at_once: whether all views are searched in one pass there
    (`models.fan_search`); by default on a GPU alone, though with many cores it is quicker on a CPU,
    too. Frames with fixtures or a second look, and those of a planner with another `judge`, are
    searched view by view, the latter in the fan alone.
    """

    def __init__(
        self,
        gripper: GripperGeometry,
        workspace: Workspace,
        seed: int = 0,
        checkpoint: Path = SHIPPED,
        network: SavedGraspNet | None = None,
        critic: GraspCritic | None = None,
        likely: float = LIKELY,
    ):
        super().__init__(gripper, workspace, seed, SEARCH, JUDGED_FAN)
        if critic is None and network is None and checkpoint.resolve() != SHIPPED:
            raise UserError(
                f"{checkpoint}: graspnet6d ranks by a critic, which was trained with the shipped "
                "network; plan with graspnet, which needs none for a network of your own"
            )
        self.network = network or loaded(checkpoint)
        self.device = next(self.network.model.parameters()).device
        self.critic = critic or shipped_critic()
        if next(self.critic.parameters()).device != self.device:
            self.critic = copy.deepcopy(self.critic).to(self.device)  # others use it where it is
        self.judge = self._own_judge = chances_by(self.critic)
        self.likely = likely
        self._above = GraspNetPlanner(
            self._with_wrist,
            workspace,
            seed,
            network=self.network,
            critic=self.critic,
            likely=likely,
        )
        self.at_once = self.device.type == "cuda"

    def return_at_least(self, count: int) -> None:
        super().return_at_least(count)
        self._above.return_at_least(count)

    def __call__(self, frame: RGBDFrame) -> list[Grasp]:
        if not known_depth(frame.depth).any():
            return []
        frame = corrected(frame, self.workspace.table_height)
        by_critic = self.judge is self._own_judge
        above = []
        if by_critic and self.likely <= 1 and not self.covered(frame.fixtures):
            above = self._above.of_corrected(frame)
        if above and above[0].quality >= self.likely:
            grasps = above
        else:
            fan = self._from_any_side(frame, by_critic)
            leaning = [grasp for grasp in fan if grasp.tilt > PLANAR] if above else fan
            grasps = sorted([*above, *leaning], key=self._worth, reverse=True)
            grasps = grasps[: self.fan.returned]
        return with_chances(grasps, self.calibration, frame.roughness)

    def _from_any_side(self, frame: RGBDFrame, by_critic: bool) -> list[Grasp]:
        """The grasps of the fan with the critic's chances, best first."""
        seen = NetworkView(self.network, frame, self.workspace, below=True)
        overhead = only_target(seen.heights, frame)
        if by_critic and self.at_once and not frame.fixtures and frame.second is None:
            return self._searched_at_once(seen, overhead)

        def tilted(T_WV: np.ndarray) -> HeightMap:
            return tilted_height_map(overhead, *seen.holeless, T_WV)

        def of_view(heights: HeightMap, found: Candidates) -> Candidates:
            return self.judged(heights, found, seen, VIEW_JUDGED)

        covered = self.covered(frame.fixtures)
        return self.search_fan(overhead, tilted, seen.value, of_view, covered)

    def heights(self, frame: RGBDFrame) -> HeightMap:
        return NetworkView(self.network, frame, self.workspace, below=True).heights

    @torch.inference_mode()
    def _searched_at_once(self, seen: NetworkView, overhead: HeightMap) -> list[Grasp]:
        """As `search_fan`, all views together on the network's device."""
        frames = np.stack(self.frames(overhead))
        views = fan_views(overhead, *seen.holeless, frames, self.device)
        for settings in (self.settings, self.settings.relaxed()):
            found = fan_search.search_once(
                views, self._with_wrist, self.workspace, settings, seen.values
            )
            if len(found):
                break
        else:
            return []
        found = found.distinct(VIEW_JUDGED, JUDGED_DISTANCE, JUDGED_TURN)
        chance = fan_search.chances(
            found, views, seen.towards, self.gripper.least_held, self.critic
        )
        found = replace(found, score=chance).best()
        columns = (found.view, *found.xy.T, found.tip, found.angle, found.opening, found.score)
        view, x, y, tip, angle, opening, score = torch.stack(columns).cpu().numpy()
        view = view.astype(int)
        place = np.column_stack([x, y, tip + self.gripper.tip_below_centre])
        tilt = np.arccos(np.clip(frames[:, 2, 2], -1.0, 1.0))[view]
        order = np.argsort(-score * self.fan.preference(tilt), kind="stable")
        poses = frames[view[order]] @ top_down_pose(place[order], angle[order])
        return [
            Grasp.from_pose(poses[kept], float(opening[order[kept]]), float(score[order[kept]]))
            for kept in distinct(poses, self.fan)
        ]
