"""Scenes: which objects lie where, as a pure function of a layout and a seed.

`isolated`: one object, dropped. `packed`: objects standing upright side by side. `pile`: objects
dropped through a box whose walls are then taken away. `dense`: a pile of DENSE_COUNT objects,
whatever `scene.count` says. `bin`: a pile between walls that stand around the workspace.
`household`: a pile of objects as different in size as the set has them, see `_mixed`.
`tall`: things higher than the fingers are long, upright and close together. `wall`: things that
lean against a wall. `flat`: things wider than the hand at the edge of a block. `retrieve`: a pile
of RETRIEVE_COUNT objects, one of which, partly covered by others, is wanted, see `_covered`.
`shelf`: tall things under a board, open to one side.
`packed` and `pile` follow VGN (Breyer et al., "Volumetric Grasping Network", CoRL 2020).

The objects come to rest in the simulator `scene.simulator`, whichever simulator the scene is for,
so that all simulators start from the same poses. The scene itself is data
(`envs.cell_layout.Scene`). Here objects are chosen and scenes accepted; how the objects of each
layout are put on the table, and what stands there, is the subject of `envs.cell_arrangements`. This
module knows no robot, camera or task.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np

from envs.cell_arrangements import ARRANGEMENTS, FIXED, WALLS, leans, viewpoint_of
from envs.cell_layout import (
    STANDING_MOVED,
    STANDING_REST_CHECKS,
    ObjectModel,
    Placement,
    Scene,
    rest_check_steps,
)
from envs.objects import ObjectSet, fits
from envs.simulators import make_layout_table
from models.planner_contacts import buried_share
from utils.config import Config
from utils.errors import RecurringError
from utils.geometry import SceneGeometry, SolidObject
from utils.grasp_quality import RELAXED
from utils.height_map import height_map_from_scene
from utils.transforms import pose_matrix

LAYOUTS = tuple(ARRANGEMENTS)
TARGET_LAYOUT = "retrieve"  # of whose objects one is wanted
DENSE_COUNT, RETRIEVE_COUNT = 15, 8
WALL_COUNT, FLAT_COUNT = 3, 2  # wide things, which need room beside each other
SHELF_COUNT = 3
# Of the object to retrieve: what others cover of it, seen from above, and what shows of it.
LEAST_COVERED, LEAST_SHOWN, LEAST_AREA = 0.2, 0.2, 2e-4  # shares, m2

_DRAWS = 50  # of objects and places, after which a seed has no scene
_TALL = 0.12  # m, least height of what stands in the layout tall; a finger is 0.045 m long
_LEANER = (0.10, 0.115)  # m, of the layout wall: least longest side, and greatest second one
_FLAT, _SPAN = 0.016, 0.085  # m, of the layout flat: greatest thickness, least second longest side
_SHELVED = (0.12, 0.25)  # m, longest sides of what stands under the board of the layout shelf


class SceneError(RecurringError):
    """No valid scene could be made."""


def make_scene(layout: str, objects: ObjectSet, seed: int, config: Config) -> Scene:
    """The scene of a seed: the same arguments always give the same scene, bit for bit.

    Objects are drawn without repetition while the set has enough of them. A draw whose objects
    come to rest outside the workspace is thrown away and the next one taken from the same
    generator; after 50 draws SceneError is raised, and at once where scene.settle_seconds is too
    short for any.
    """
    if layout not in LAYOUTS:
        raise SceneError(f"unknown scene layout {layout!r}; allowed are {', '.join(LAYOUTS)}")
    check_suited(layout, objects, config)
    rng = np.random.default_rng([seed, LAYOUTS.index(layout)])
    arrange = ARRANGEMENTS[layout]
    count = _COUNTS.get(layout, config.scene.count)
    walls = WALLS[layout](config) if layout in WALLS else ()
    fixed, viewpoint = layout in FIXED, viewpoint_of(layout, config)
    for _ in range(_DRAWS):
        if layout == "household":
            chosen = _mixed(objects, count, rng, config)
        elif layout in _SUITED:
            chosen = _suited(objects, count, rng, layout)
        else:
            chosen = rng.choice(len(objects), size=count, replace=count > len(objects))
        models = [objects[int(i)] for i in chosen]
        with make_layout_table(config, models, walls) as table:
            checks = STANDING_REST_CHECKS if layout == "packed" else 1
            _check_settle_time(layout, max(checks, table.least_checks), config)
            bodies = arrange(table, models, rng, config)
            if bodies is None or not table.settle(bodies, checks):
                continue
            poses = [table.pose(body) for body in bodies]
        if layout == "packed" and not _stand_for_good(config, models, poses):
            continue
        if all(_inside(position, config) for position, _ in poses):
            placements = tuple(Placement(model, *pose) for model, pose in zip(models, poses))
            if layout == "wall" and not all(map(leans, placements)):
                continue
            target = _covered(placements, config) if layout == TARGET_LAYOUT else None
            if layout != TARGET_LAYOUT or target is not None:
                return Scene(layout, seed, placements, walls, fixed, viewpoint, target)
    also = {TARGET_LAYOUT: " with one under others", "wall": " with all leaning"}.get(layout, "")
    fewer = "" if layout in _COUNTS else ", fewer (scene.count)"
    raise SceneError(
        f"no {layout} scene of {count} objects of {objects.name!r} (seed {seed}) came to rest "
        f"inside the {config.workspace.size} m workspace{also} in {_DRAWS} tries; use smaller "
        f"objects (objects.scale, or objects.fit for those of a folder){fewer} or a larger "
        "workspace.size"
    )


def _check_settle_time(layout: str, checks: int, config: Config) -> None:
    """Raise SceneError where scene.settle_seconds ends before so many checks for rest in a row."""
    steps = checks * rest_check_steps(config.sim.frequency)
    if int(config.scene.settle_seconds * config.sim.frequency) < steps:
        least = math.ceil(100 * steps / config.sim.frequency) / 100
        raise SceneError(
            f"scene.settle_seconds={config.scene.settle_seconds:g} is too short for the layout "
            f"{layout} in {config.scene.simulator}, whose objects have to rest for {least:g} s; "
            f"use {least:g} or, because they have to come to rest before, more"
        )


def _stand_for_good(config: Config, models: Sequence[ObjectModel], poses) -> bool:
    """Whether objects that came to rest in these poses stay there when a cell puts them down anew:
    what stands on its very edge may be held by the contacts in which it came to rest."""
    with make_layout_table(config, models) as table:
        bodies = [table.put(model, *pose) for model, pose in zip(models, poses)]
        if not table.settle(bodies, STANDING_REST_CHECKS):
            return False
        moved = [np.linalg.norm(table.pose(b)[0] - pose[0]) for b, pose in zip(bodies, poses)]
    return max(moved) < STANDING_MOVED


def _mixed(objects: ObjectSet, count: int, rng, config: Config) -> np.ndarray:
    """Numbers (count,) of objects of mixed sizes, in random order: those that the hand spans where
    they are narrowest are sorted by that width and cut into `count` equal parts, and one is drawn
    from each. No object is scaled, so that sizes and masses are true."""
    fitting = objects.by_width(_widest(config))
    places = (np.arange(count) + rng.uniform(size=count)) * len(fitting) / count
    return rng.permutation(np.array(fitting)[places.astype(int)])


def _covered(placements: tuple[Placement, ...], config: Config) -> int | None:
    """The number of the object to retrieve: of those that the hand spans and that still show, the
    one of which others cover the largest share, seen from above; None where that is too little."""
    bodies = tuple(
        SolidObject(
            tuple(solid.transformed(pose_matrix(one.position, one.quaternion))
                  for solid in one.model.geometry()),
            one.position,
            one.model.friction,
        )
        for one in placements
    )  # fmt: skip
    scene = SceneGeometry(bodies)
    workspace = config.workspace.geometry
    heights = height_map_from_scene(scene, workspace)
    covered = buried_share(scene, heights)
    shown = np.bincount(heights.label[heights.label >= 0], minlength=len(placements))
    wanted = (shown * heights.cell**2 >= LEAST_AREA) & (1 - covered >= LEAST_SHOWN)
    wanted &= [fits(one.model, config.gripper.geometry) for one in placements]
    covered = np.where(wanted, covered, 0.0)
    return int(covered.argmax()) if covered.max() >= LEAST_COVERED else None


def _suited(objects: ObjectSet, count: int, rng, layout: str) -> np.ndarray:
    """Numbers (count,) of objects of a shape that belongs into the layout, drawn without repetition
    while the set has enough of them."""
    suits, _ = _SUITED[layout]
    found = list(itertools.islice(
        (index for index in rng.permutation(len(objects)).tolist()
         if suits(np.sort(objects[index].extents))), count
    ))  # fmt: skip
    return np.resize(found, count)


def check_suited(layout: str, objects: ObjectSet, config: Config) -> None:
    """Raise SceneError for a set of which no object belongs into a layout."""
    if layout == "household":
        widest = _widest(config)
        if not any(model.narrowest <= widest for model in objects):
            raise SceneError(
                f"no object of {objects.name!r} is less than {widest:.3f} m wide, so that the hand "
                "spans none; use smaller objects (objects.scale, objects.fit)"
            )
    elif layout in _SUITED:
        suits, what = _SUITED[layout]
        if not any(suits(np.sort(model.extents)) for model in objects):
            raise SceneError(
                f"no object of {objects.name!r} is {what}, as the layout {layout} needs it; use "
                f"the set {'flat' if layout == 'flat' else 'tall'}"
            )


def _widest(config: Config) -> float:
    """m, of what the hand spans with relaxed margins."""
    return config.gripper.max_opening - 2 * RELAXED.room


def _inside(position: np.ndarray, config: Config) -> bool:
    offset = abs(position[:2] - config.workspace.center)
    return bool(np.isfinite(position).all() and offset.max() <= config.workspace.size / 2
                and position[2] > 0)  # fmt: skip


_COUNTS = {
    "isolated": 1, "dense": DENSE_COUNT, "wall": WALL_COUNT, "flat": FLAT_COUNT,
    "retrieve": RETRIEVE_COUNT, "shelf": SHELF_COUNT,
}  # fmt: skip
# By an object's sides, the shortest first; and in words.
_SUITED = {
    "tall": (lambda sides: sides[2] >= _TALL, f"{_TALL} m long"),
    "wall": (
        lambda sides: sides[2] >= _LEANER[0] and sides[1] <= _LEANER[1],
        f"{_LEANER[0]} m long and at most {_LEANER[1]} m wide",
    ),
    "shelf": (
        lambda sides: _SHELVED[0] <= sides[2] <= _SHELVED[1],
        f"{_SHELVED[0]} to {_SHELVED[1]} m long",
    ),
    "flat": (
        lambda sides: sides[0] <= _FLAT and sides[1] >= _SPAN,
        f"at most {_FLAT} m thick and {_SPAN} m wide",
    ),
}
