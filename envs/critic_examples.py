"""Examples for the critic: what the planners see of their candidates, and what becomes of them.

Scenes of training objects, household and rounded things and some larger than usual among them, are
seen by a camera from above or from a side, with one of the depth noises. A floating hand, half the
time by VGN's rule of when it is empty, executes some of the candidates and carries away what it
grips (`envs.floating_execution`): half of them drawn at random, the others those of the rest that
the shipped critic likes best, so that the next one learns what this one overrates. The examples of
a scene are a pure function of the config, its number and the shipped critic.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from envs.cell import Cell, PhysicsError, camera_intrinsics
from envs.cell_layout import Scene
from envs.cell_scenes import SceneError, make_scene
from envs.data_generation import MOST_DRAWS
from envs.floating_execution import attempt, clears_table, floating_hand
from envs.objects import ObjectSet, load_object_set
from envs.simulators import make_cell
from models.grasp_critic import INPUTS, CriticInputs, GraspCritic, nothing, shipped_critic
from models.planner_candidates import Candidates
from models.planner_graspnet import (
    JUDGED_FAN,
    LIKELY,
    GraspNetFanPlanner,
    GraspNetPlanner,
    WithCritic,
)
from utils.atomic_files import write_atomic
from utils.config import Config, with_settings
from utils.depth import make_depth_noise
from utils.depth import measure as measured
from utils.errors import UNREADABLE_NPZ, UserError
from utils.height_map import HeightMap
from utils.transforms import Grasp, RGBDFrame, look_at, position_quaternion
from utils.worker_process import kept

# Whose candidates are executed, and how many of each plan's.
PLANNERS = {"graspnet6d": 14, "graspnet": 20}  # the latter at peaks and of a search
FRAMES_PER_SCENE = 2  # of the whole scene, then of a part of it, as in a round that clears it
_LAYOUTS = {
    "isolated": 0.03, "packed": 0.12, "pile": 0.16, "bin": 0.15, "household": 0.29, "tall": 0.03,
    "wall": 0.06, "shelf": 0.06, "flat": 0.10,
}  # fmt: skip
# Scale of larger objects, which stand for household things that the hand hardly spans, and their
# share among the scenes of these sets.
_LARGE, _LARGE_SHARE = {"random_urdfs": 1.0, "primitives": 1.3}, 0.35
_OWN_SETS = {
    "tall": ("tall",), "wall": ("tall", "flat"), "shelf": ("tall",), "flat": ("flat",),
    "household": ("household", "rounded"),
}  # fmt: skip
_NOISES = {"none": 0.25, "realsense": 0.35, "gaussian": 0.2, "kinect": 0.1, "gamma": 0.1}
_FROM_ABOVE = 0.4  # share of cameras within 15 degrees of the vertical; the others up to 65
VGN_LEAST_HELD = 0.008  # m, as configs/vgn.yaml has it
LABEL = "carried, not too thin"  # what counts as a success: see `execute`
GENERATION = 3  # counts the changes of what is drawn here
# No other training uses these, nor an evaluation with a seed below 30,000; those with larger seeds,
# as the sealed ones, are of objects that no training sees.
_FIRST_SEED = 3_000_000_000


class Examples(NamedTuple):
    """N executed candidates: what the critic sees of them, which succeeded (N,) bool, the scores
    (N,) by which the search ranked them, the numbers (N,) of their scenes and of their plans, each
    of one planner for one frame, and which were drawn (N,) bool, not chosen by a critic."""

    inputs: CriticInputs
    success: np.ndarray
    score: np.ndarray
    scene: np.ndarray
    plan: np.ndarray
    drawn: np.ndarray

    def where(self, mask: np.ndarray) -> Examples:
        return Examples(self.inputs.take(mask), *(column[mask] for column in self[1:]))

    @staticmethod
    def joined(parts: Sequence[Examples]) -> Examples:
        inputs = CriticInputs.joined([part.inputs for part in parts])
        return Examples(inputs, *(np.concatenate(column) for column in list(zip(*parts))[1:]))

    def save(self, path: Path) -> None:
        """Write a NumPy archive, whole or not at all. Raises UserError where that fails."""
        columns = {"facts": self.inputs.facts, "patches": self.inputs.patches}
        columns |= dict(zip(self._fields[1:], self[1:]))
        buffer = io.BytesIO()
        np.savez_compressed(buffer, **columns)
        write_atomic(path, buffer.getvalue())

    @staticmethod
    def load(path: Path) -> Examples:
        """Raises UserError, naming the file, where it is no archive of examples."""
        try:
            with np.load(path, allow_pickle=False) as file:
                inputs = CriticInputs(file["facts"], file["patches"])
                return Examples(inputs, *(file[name] for name in Examples._fields[1:]))
        except UNREADABLE_NPZ as error:
            raise UserError(
                f"{path}: holds no executed grasps ({error}); remove it, and its scenes are played "
                "again"
            ) from error


_NONE = Examples(
    nothing(), np.empty(0, bool), np.empty(0), *np.empty((2, 0), int), np.empty(0, bool)
)


def planner_of(plan: np.ndarray) -> np.ndarray:
    """(N,) numbers in PLANNERS of the planners that made plans (N,)."""
    return plan % len(PLANNERS)


def examples_of(config: Config, number: int) -> Examples:
    """Executed candidates of one scene, in a worker process."""
    rng = np.random.default_rng([config.seed, _FIRST_SEED + number])
    cell, planners = _cell_of(config), _planners_of(config, bool(rng.random() < 0.5))
    least_held = planners[0].gripper.least_held
    scene = draw_scene(config, _sets_of(config), rng)
    found = [_NONE]
    for frame_number in range(FRAMES_PER_SCENE):
        total = len(scene.placements)
        count = total if frame_number == 0 else int(rng.integers(1, total + 1))
        some = np.sort(rng.choice(total, count, replace=False))
        part = replace(scene, placements=tuple(scene.placements[i] for i in some))
        try:
            part = at_rest(cell, part)
        except PhysicsError:  # the next one is loaded into a rebuilt cell
            continue
        frame = draw_frame(config, cell, rng)
        for which, (planner, most) in enumerate(zip(planners, PLANNERS.values())):
            inputs, scores, grasps = judged_by(planner, frame)
            tried, drawn = worth_trying(inputs, most, rng)
            success = np.array([execute(cell, part, grasps[i], least_held) for i in tried], bool)
            plan = (number * FRAMES_PER_SCENE + frame_number) * len(PLANNERS) + which
            numbers = np.full(len(tried), number), np.full(len(tried), plan)
            found.append(Examples(inputs.take(tried), success, scores[tried], *numbers, drawn))
    return Examples.joined(found)


def numbered_examples_of(config: Config, number: int) -> tuple[int, Examples]:
    """The number of a scene and its `examples_of`, in a worker process."""
    return number, examples_of(config, number)


def worth_trying(
    inputs: CriticInputs, most: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Up to `most` indices (M,) of candidates, and which of them were drawn (M,) bool, from all, so
    that they favour no critic. The others, half of them, are those of the rest that the shipped
    critic ranks first."""
    order = rng.permutation(len(inputs.facts))
    drawn, rest = np.split(order, [most - most // 2])
    others = inputs.take(rest)
    tilt = others.facts[:, INPUTS.index("tilt")]
    rank = np.argsort(-shipped_critic().chance(others) * JUDGED_FAN.preference(tilt))
    best = rest[rank[: most // 2]]
    return np.concatenate([best, drawn]), np.arange(len(best) + len(drawn)) >= len(best)


def judged_by(
    planner: WithCritic, frame: RGBDFrame
) -> tuple[CriticInputs, np.ndarray, list[Grasp]]:
    """What a planner asks its critic about a frame: inputs of N candidates, the scores (N,) by
    which the search ranked them, and the grasps."""
    inputs, scores, grasps = [nothing()], [np.empty(0)], []

    def judge(heights: HeightMap, found: Candidates, seen: CriticInputs) -> np.ndarray:
        inputs.append(seen)
        scores.append(found.score)
        for grasp in found.grasps(planner.gripper):
            pose = heights.T_WV @ grasp.pose
            grasps.append(Grasp.from_pose(pose, grasp.width, grasp.quality))
        return np.full(len(found), LIKELY / 2)  # so that the planner goes on to look elsewhere

    planner.judge = judge
    planner(frame)
    return CriticInputs.joined(inputs), np.concatenate(scores), grasps


def at_rest(cell: Cell, scene: Scene) -> Scene:
    """The scene as its objects come to rest, which lean on each other, and which others may have
    been taken from; the cell has it."""
    cell.load(scene)
    placements = []
    for index, placed in enumerate(scene.placements):
        position, quaternion = position_quaternion(cell.object_pose(index))
        placements.append(replace(placed, position=position, quaternion=quaternion))
    return replace(scene, placements=tuple(placements))


def execute(cell: Cell, scene: Scene, grasp: Grasp, least_held: float) -> bool:
    """Whether a grasp of the freshly loaded scene lifts something that is wider than `least_held`
    m between the fingers and carries it away; not, where the simulation blows up."""
    cell.load(scene)
    try:
        carried = clears_table(cell, grasp) and attempt(cell, grasp, carry=True).success
        return carried and floating_hand(cell).opening > least_held
    except PhysicsError:  # the next one loads its scene into a rebuilt cell
        return False


@kept
def _cell_of(config: Config) -> Cell:
    return make_cell(with_settings(config, "robot", {"arm": "none"}))  # no arm is in the way


@kept
def _planners_of(config: Config, as_vgn: bool) -> list[WithCritic]:
    """Those of the arm's hand, or of one that opens fully and counts as empty as VGN's does."""
    least_held = VGN_LEAST_HELD if as_vgn else 0.0
    gripper = replace(config.gripper.geometry, opens_fully=as_vgn, least_held=least_held)
    workspace = config.workspace.geometry
    return [  # in the order of PLANNERS; these critics are never asked
        GraspNetFanPlanner(gripper, workspace, critic=GraspCritic()),
        GraspNetPlanner(gripper, workspace, critic=GraspCritic()),
    ]


@kept
def _sets_of(config: Config) -> dict[str, ObjectSet]:
    """Of each name, and those of `_LARGE` once more as NAME, large."""
    names = dict.fromkeys([*usual_sets(config), "tall", "flat", "rounded"])
    kinds = {name: (name, config.objects.scale) for name in names}
    kinds |= {_large(name): (name, scale) for name, scale in _LARGE.items() if name in names}
    settings = config.objects.model_dump() | {"split": "train"}
    return {
        kind: load_object_set(
            name, max_opening=config.gripper.max_opening, cache_dir=config.cache_folder,
            **settings | {"scale": scale},
        )
        for kind, (name, scale) in kinds.items()
    }  # fmt: skip


def usual_sets(config: Config) -> list[str]:
    """Names of the sets of most layouts."""
    return list(dict.fromkeys([*config.data.object_sets, "household"]))


def _large(name: str) -> str:
    return f"{name}, large"


def draw_scene(config: Config, sets: dict[str, ObjectSet], rng: np.random.Generator) -> Scene:
    """A scene of random layout, object set and number of objects. Raises UserError if none of
    MOST_DRAWS draws gives one."""
    for _ in range(MOST_DRAWS):
        layout = str(rng.choice(list(_LAYOUTS), p=list(_LAYOUTS.values())))
        name = str(rng.choice(_OWN_SETS.get(layout, usual_sets(config))))
        if rng.random() < _LARGE_SHARE and _large(name) in sets:
            name = _large(name)
        crowd = with_settings(
            config, "scene", {"count": int(rng.integers(2, 7 if layout == "packed" else 9))}
        )
        try:
            return make_scene(layout, sets[name], int(rng.integers(2**62)), crowd)
        except SceneError:  # too many for this layout: another draw, from the same generator
            continue
    raise UserError(
        f"none of {MOST_DRAWS} scenes drawn for the critic came to rest inside the workspace; use "
        "smaller objects (objects.scale, objects.fit) or a larger workspace.size"
    )


def draw_frame(config: Config, cell: Cell, rng: np.random.Generator) -> RGBDFrame:
    """The scene as a random camera measures it."""
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
    frame = cell.look(intrinsics, look_at(target + distance * away, target, up))
    name = str(rng.choice(list(_NOISES), p=list(_NOISES.values())))
    noise = make_depth_noise(name, float(frame.K[0, 0]))
    if noise is None:
        return frame
    return replace(frame, depth=measured(noise, frame.depth, rng, frame.rgb))
