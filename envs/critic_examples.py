"""Examples for the critic: what `graspnet6d` measures of its candidates, and whether it is true.

Scenes of training objects are seen by a camera from above or from a side, with one of the depth
noises. A candidate is sound where exact contacts hold, at its pose or some of the perturbed ones
(`models.planner_contacts`), and the open hand has room on the exact height map. No grasp is
executed. The examples of a scene are a pure function of the config and its number.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from envs.cell import Cell, camera_intrinsics
from envs.cell_layout import Scene
from envs.cell_scenes import SceneError, make_scene
from envs.objects import ObjectSet, load_object_set
from envs.simulators import make_cell
from models.grasp_critic import INPUTS, GraspCritic
from models.planner_antipodal import measure
from models.planner_candidates import Candidates
from models.planner_contacts import exact_quality
from models.planner_graspnet import GraspNetFanPlanner
from utils.config import Config, with_settings
from utils.depth import make_depth_noise
from utils.depth import measure as measured
from utils.geometry import SceneGeometry, Workspace
from utils.height_map import HeightMap, height_map_from_scene
from utils.transforms import RGBDFrame, inverse_pose, look_at
from utils.worker_process import kept

SOUND = 0.05  # exact quality from which contacts hold
FRAMES_PER_SCENE = 2  # of the whole scene, then of a part of it, as in a round that clears it
_LAYOUTS = {
    "isolated": 0.10, "packed": 0.30, "pile": 0.35, "bin": 0.05, "tall": 0.10, "wall": 0.05,
    "flat": 0.05,
}  # fmt: skip
_OWN_SETS = {"tall": ("tall",), "wall": ("tall", "flat"), "flat": ("flat",)}
_NOISES = {"none": 0.25, "realsense": 0.35, "gaussian": 0.2, "kinect": 0.1, "gamma": 0.1}
_FROM_ABOVE = 0.35  # share of cameras within 15 degrees of the vertical; the others up to 65
_FIRST_SEED = 3_000_000_000  # no evaluation and no other training uses these seeds


def examples_of(config: Config, number: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of one scene: inputs (N, K) of the critic, whether each candidate is sound (N,) bool, and the
    scores (N,) by which the search ranked it. In a worker process."""
    rng = np.random.default_rng([config.seed, _FIRST_SEED + number])
    cell, planner = _cell_of(config), _planner_of(config, bool(rng.random() < 0.5))
    scene = draw_scene(config, _sets_of(config), rng)
    inputs, sound, scores = [np.empty((0, len(INPUTS)), np.float32)], [], []
    for frame_number in range(FRAMES_PER_SCENE):
        total = len(scene.placements)
        count = total if frame_number == 0 else int(rng.integers(1, total + 1))
        some = np.sort(rng.choice(total, count, replace=False))
        cell.load(replace(scene, placements=tuple(scene.placements[i] for i in some)))
        frame = draw_frame(config, cell, rng)
        truth = frame.truth
        assert truth is not None

        def judge(heights: HeightMap, found: Candidates, facts: np.ndarray) -> Candidates:
            inputs.append(facts)
            sound.append(is_sound(found, heights.T_WV, truth, planner))  # noqa: B023 - used at once
            scores.append(found.score)
            return found

        planner.judged_by(frame.without_truth(), judge)
    return np.concatenate(inputs), np.concatenate([[], *sound]) > 0, np.concatenate([[], *scores])


def is_sound(
    found: Candidates, T_WV: np.ndarray, truth: SceneGeometry, planner: GraspNetFanPlanner
) -> np.ndarray:
    """(N,) bool: the exact contacts of candidates of a view hold, and the open hand is free."""
    scene = truth.transformed(inverse_pose(T_WV))
    exact = height_map_from_scene(truth, planner.workspace, 0.002, T_WV=T_WV)
    free = measure(found, exact, planner.gripper, planner.settings).score > 0
    return free & (exact_quality(found, scene, planner.gripper) > SOUND)


@kept
def _cell_of(config: Config) -> Cell:
    return make_cell(with_settings(config, "robot", {"arm": "none"}))  # no arm is in the way


@kept
def _planner_of(config: Config, opens_fully: bool) -> GraspNetFanPlanner:
    gripper = replace(config.gripper.geometry, opens_fully=opens_fully)
    return GraspNetFanPlanner(
        gripper,
        Workspace(tuple(config.workspace.center), config.workspace.size),
        critic=GraspCritic(),
    )


@kept
def _sets_of(config: Config) -> dict[str, ObjectSet]:
    settings = config.objects.model_dump() | {"split": "train"}
    return {
        name: load_object_set(
            name, max_opening=config.gripper.max_opening, cache_dir=config.cache_folder, **settings
        )
        for name in dict.fromkeys([*config.data.object_sets, "tall", "flat"])
    }


def draw_scene(config: Config, sets: dict[str, ObjectSet], rng: np.random.Generator) -> Scene:
    """A scene of random layout, object set and number of objects."""
    while True:
        layout = str(rng.choice(list(_LAYOUTS), p=list(_LAYOUTS.values())))
        name = str(rng.choice(_OWN_SETS.get(layout, config.data.object_sets)))
        crowd = with_settings(
            config, "scene", {"count": int(rng.integers(2, 7 if layout == "packed" else 9))}
        )
        try:
            return make_scene(layout, sets[name], int(rng.integers(2**62)), crowd)
        except SceneError:  # too many for this layout: another draw, from the same generator
            continue


def draw_frame(config: Config, cell: Cell, rng: np.random.Generator) -> RGBDFrame:
    """The scene as a random camera measures it, with its truth."""
    most = (0, 15) if rng.random() < _FROM_ABOVE else (15, 65)
    tilt, heading = np.radians(rng.uniform(*most)), rng.uniform(0, 2 * np.pi)
    distance = rng.uniform(0.55, 0.85)
    away = np.array([np.cos(heading) * np.sin(tilt), np.sin(heading) * np.sin(tilt), np.cos(tilt)])
    target = np.array([*config.workspace.center, 0.03]) + [*rng.uniform(-0.03, 0.03, 2), 0.0]
    roll = rng.uniform(0, 2 * np.pi)
    up = (np.cos(roll), np.sin(roll), 0.0) if tilt < 0.3 else (0.0, 0.0, 1.0)
    width, height = ((448, 384), (224, 224))[rng.integers(2)]
    spans = 2 * np.degrees(np.arctan(0.21 / distance))  # the workspace and a little more
    intrinsics = replace(
        camera_intrinsics(config.camera),
        width=width, height=height, fov_deg=float(spans * rng.uniform(0.95, 1.1)),
    )  # fmt: skip
    frame = cell.look(intrinsics, look_at(target + distance * away, target, up), with_truth=True)
    name = str(rng.choice(list(_NOISES), p=list(_NOISES.values())))
    noise = make_depth_noise(name, float(frame.K[0, 0]))
    if noise is None:
        return frame
    return replace(frame, depth=measured(noise, frame.depth, rng, frame.rgb))
