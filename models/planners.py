"""Planners: callables `plan(frame) -> list[Grasp]` that turn an RGB-D frame into ranked grasps.

The list is sorted, best first; an empty list means that there is nothing to grasp. `PLANNERS`
names the planners of this project: `random` sees the depth image, `heuristic` and `graspnet` also
the colours, `oracle` the true geometry; those that end in `6d` grasp from any side, the others
from straight above. A planner of your own is named by its import path, see
`make_planner` and docs/planner.md. This module knows no simulator.
"""

from __future__ import annotations

import functools
import inspect
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from models.grasp_critic import critic_inputs, shipped_critic
from models.graspnet_io import SHIPPED
from models.planner_antipodal import SearchPlanner
from models.planner_candidates import FACTS, SearchSettings
from models.planner_contacts import buried_share, scored_by_contacts
from models.planner_fan import HeuristicFanPlanner, OracleFanPlanner
from models.planner_graspnet import (
    GraspNetDirectPlanner,
    GraspNetFanPlanner,
    GraspNetPlanner,
)
from utils.calibration import Calibration, load_calibrations
from utils.depth_correction import corrected
from utils.errors import UserError, unknown_choice
from utils.geometry import GripperGeometry, Workspace
from utils.height_map import HeightMap, height_map_from_frame, height_map_from_scene
from utils.plugins import is_import_path, load_plugin
from utils.target import object_of_target, only_object, only_target
from utils.transforms import Grasp, RGBDFrame


class Planner(Protocol):
    """Any callable that plans grasps. Five attributes are optional.

    needs_truth: True if the frame has to carry `truth`; without the attribute it carries none.
    tilts: True if grasps come from any side, and not from straight above alone.
    calibration: by which qualities are chances of success (`utils.calibration.Calibration`), so
        that what rather fails is not tried; without the attribute, or with None, they are scores.
    reset(seed): called before each scene, for planners that draw random numbers.
    segments(frame): (H, W) int32, the number of the object at each pixel, -1 where there is none;
        a planner that has it honours `RGBDFrame.target` and returns grasps of that object alone.
    """

    def __call__(self, frame: RGBDFrame) -> list[Grasp]: ...


def needs_truth(planner: Planner | type) -> bool:
    """Whether the planner's frames have to carry the scene's true geometry."""
    return bool(getattr(planner, "needs_truth", False))


def tilts(planner: Planner | type) -> bool:
    """Whether the planner's grasps come from any side."""
    return bool(getattr(planner, "tilts", False))


def takes_targets(planner: Planner | type) -> bool:
    """Whether the planner grasps one object among others where its frame names one; a
    `SearchPlanner` of a user's does so only with height maps of its own."""
    segments, heights = (getattr(planner, name, None) for name in ("segments", "heights"))
    bare = getattr(heights, "__func__", heights) is SearchPlanner.heights
    return callable(segments) and not bare


def calibration_of(planner: Planner) -> Calibration | None:
    """By which the planner's qualities are chances of success; None where they are scores."""
    return getattr(planner, "calibration", None)


def reset_planner(planner: Planner, seed: int) -> None:
    """Prepare the planner for a new scene: `planner.reset(seed)`, where it has that method."""
    reset = getattr(planner, "reset", None)
    if reset is not None:
        reset(seed)


class RandomPlanner:
    """Grasps uniform over the pixels above the table, at random angles, with the hand wide open.
    Their scores tell nothing, so that no chances are fitted to them."""

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
            height = max(top - 0.02, lowest)  # the hand's centre, 2 cm below the surface
            angle = self._random.uniform(0, np.pi)
            grasps.append(Grasp(np.array([x, y, height]), angle, self.gripper.max_opening, quality))
        return grasps


class HeuristicPlanner(SearchPlanner):
    """Antipodal search on the height map of the depth image; colours tell table and edges in a
    rough one, and nothing else."""

    def __call__(self, frame: RGBDFrame) -> list[Grasp]:
        frame = corrected(frame, self.workspace.table_height)
        found = self.search(only_target(self.heights(frame), frame))
        return self.grasps(found, frame.roughness)

    def heights(self, frame: RGBDFrame) -> HeightMap:
        return height_map_from_frame(frame, self.workspace)


# Score of a grasp that the critic is sure of, without antipodal contacts: below most with such.
# What it is less sure of loses more than its chance, because the contacts speak against it: on
# training rounds, 30 of 41 of chances over 0.8 succeeded, and 7 of 26 of chances around 0.5.
_FALLBACK, _UNSURE_POWER = 0.02, 3
_OVERHEAD = np.array((0.0, 0.0, 1.0))  # towards a camera that hides nothing from an oracle


class OraclePlanner(SearchPlanner):
    """The same search on the exact height map, then exact contacts under perturbed poses.

    Where no contacts are antipodal, the critic's chances decide (`models.grasp_critic`): it has
    learned which grasps hold all the same, as one of a bowl's rim does, which turns until its wall
    is parallel to the pads. It does not decide where the object rises less than
    `settings.min_engagement` over the fingertips, which a relaxed search allows.

    judged: number of candidates whose contacts are computed.
    """

    needs_truth = True

    def __init__(
        self,
        gripper: GripperGeometry,
        workspace: Workspace,
        seed: int = 0,
        settings: SearchSettings = SearchSettings(shortlist=1500, finalists=500),  # noqa: B008 - frozen
        judged: int = 120,
    ):
        super().__init__(gripper, workspace, seed, settings)
        self.judged = judged

    def __call__(self, frame: RGBDFrame) -> list[Grasp]:
        heights, truth = self.heights(frame), frame.truth
        assert truth is not None  # `heights` needs it
        aimed = heights
        if frame.target is not None:
            aimed = only_object(heights, object_of_target(heights, frame))
        found = self.search(aimed).distinct(self.judged, 0.004, np.deg2rad(8))
        if len(found) == 0:
            return []
        ones = np.ones(len(found))  # as if a grasp network valued all of them
        inputs = critic_inputs(found, aimed, ones, _OVERHEAD, self.gripper.least_held)
        fallback = _FALLBACK * shipped_critic().chance(inputs) ** _UNSURE_POWER
        # All six grips of a YCB can's flange, 3 mm deep, slipped off, with chances of 0.65 to 0.90.
        shallow = found.facts[:, FACTS.index("engagement")] < self.settings.min_engagement
        fallback = np.where(shallow, 0.0, fallback)
        buried = buried_share(truth, heights)
        return self.grasps(scored_by_contacts(found, truth, self.gripper, buried, fallback))

    def heights(self, frame: RGBDFrame) -> HeightMap:
        if frame.truth is None:
            raise ValueError("The oracle planner needs frame.truth; this frame holds none")
        return height_map_from_scene(frame.truth, self.workspace)


# A planner is made by a call with the gripper, the workspace and a seed.
PLANNERS: dict[str, Callable[[GripperGeometry, Workspace, int], Any]] = {
    "random": RandomPlanner,
    "heuristic": HeuristicPlanner,
    "graspnet": GraspNetPlanner,
    "graspnet_direct": GraspNetDirectPlanner,
    "oracle": OraclePlanner,
    "heuristic6d": HeuristicFanPlanner,
    "graspnet6d": GraspNetFanPlanner,
    "oracle6d": OracleFanPlanner,
}


# Fitted to executed grasps of training objects by `python -m benchmarks.calibrate`.
CALIBRATIONS = SHIPPED.parent / "calibration.json"


@functools.cache
def calibrations() -> dict[str, Calibration]:
    """By planner, those that are shipped."""
    return load_calibrations(CALIBRATIONS)


def make_planner(
    name: str,
    gripper: GripperGeometry,
    workspace: Workspace,
    seed: int,
    key: str = "planner",
) -> Planner:
    """The planner that `name` stands for.

    name: a key of `PLANNERS`; a GraspNet checkpoint FILE.pt; or an import path `module:name`, see
    `plugin_planner`. seed: starts the planner's own random generator. key: of the
    config, where the name stands; for errors.

    The qualities of the project's own planners but `random` are chances of success
    (`CALIBRATIONS`); those of others, and of checkpoints, are scores of their own.

    Raises UserError for any other name, and for a file or module that cannot be loaded.
    """
    if name in PLANNERS:
        planner = PLANNERS[name](gripper, workspace, seed)
        if hasattr(planner, "calibration"):
            planner.calibration = calibrations().get(name)
            if planner.calibration is None:
                warnings.warn(
                    f"{CALIBRATIONS}: holds no chances of {name}: its qualities are scores, and an "
                    "evaluation tries all of its grasps; restore the file, or run make calibration",
                    stacklevel=2,
                )
        return planner
    if name == "ppo" or name.startswith(("ppo:", "sb3:")):
        raise UserError(
            f"{key}: {name} is a policy, which acts in turns and plans no grasp; score it by "
            f"evaluate.py evaluate.policies={name}"
        )
    if Path(name).suffix == ".pt":
        return GraspNetPlanner(gripper, workspace, seed, Path(name))
    if is_import_path(name):
        planner = plugin_planner(name, gripper, workspace, seed, key)
        chances = calibration_of(planner)
        if not isinstance(chances, Calibration | None):
            raise UserError(
                f"{key}: the attribute `calibration` of {name!r} is {chances!r:.40}, expected a "
                "utils.calibration.Calibration or None"
            )
        return planner
    others = ["FILE.pt of GraspNet", "module:name"]
    if key == "evaluate.policies":
        others += ["ppo", "ppo:FILE.pt", "sb3:FILE.zip"]
    raise unknown_choice(key, name, [*PLANNERS, *others])


def plugin_planner(
    path: str, gripper: GripperGeometry, workspace: Workspace, seed: int, key: str
) -> Planner:
    """The planner that an import path `module:name` names: a function `plan(frame)`; or an object
    that a class, or a function with the parameters gripper, workspace and seed, makes of these.

    Raises UserError where it cannot be loaded or made.
    """
    loaded = load_plugin(path, key)
    if not (isinstance(loaded, type) or _makes_planners(loaded)):
        return loaded
    try:
        planner = loaded(gripper, workspace, seed)
    except Exception as error:  # whatever the module's own code raises is its author's to fix
        raise UserError(
            f"{key}: {path!r} raised {type(error).__name__}: {error}; it is called "
            "with gripper, workspace and seed"
        ) from error
    if not callable(planner):
        raise UserError(
            f"{key}: {path!r} made a {type(planner).__name__}, expected a planner, "
            "which can be called with a frame"
        )
    return planner


def _makes_planners(function: Callable[..., Any]) -> bool:
    try:
        parameters = inspect.signature(function).parameters
    except ValueError:  # a built-in function without a signature
        return False
    return list(parameters)[:3] == ["gripper", "workspace", "seed"]
