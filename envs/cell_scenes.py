"""Scene layouts: which objects lie where, as a pure function of a seed.

`isolated`: one object, dropped. `packed`: objects standing upright side by side. `pile`: objects
dropped through a box whose walls are then taken away. `dense`: a pile of DENSE_COUNT objects,
whatever `scene.count` says. `bin`: a pile between walls that stand around the workspace.
`household`: a pile of objects as different in size as the set has them, see `_mixed`. `retrieve`: a
pile of RETRIEVE_COUNT objects, one of which, partly covered by others, is wanted, see `_covered`.
`packed` and `pile` follow VGN (Breyer et al., "Volumetric Grasping Network", CoRL 2020).

The objects come to rest in the simulator `scene.simulator`, whichever simulator the scene is for,
so that all simulators start from the same poses. The scene itself is data
(`envs.cell_layout.Scene`). This module knows no robot, camera or task.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from envs.cell_layout import Box, LayoutTable, ObjectModel, Placement, Scene, square_walls
from envs.objects import ObjectSet, fits
from envs.simulators import make_layout_table
from models.planner_contacts import buried_share
from utils.config import Config
from utils.errors import UserError
from utils.geometry import SceneGeometry, SolidObject, Workspace
from utils.grasp_quality import RELAXED
from utils.height_map import height_map_from_scene
from utils.transforms import pose_matrix

# Their places are part of the scenes' seeds.
LAYOUTS = ("isolated", "packed", "pile", "dense", "bin", "household", "retrieve")
TARGET_LAYOUT = "retrieve"  # of whose objects one is wanted
DENSE_COUNT, RETRIEVE_COUNT = 15, 8
# Of the object to retrieve: what others cover of it, seen from above, and what shows of it.
LEAST_COVERED, LEAST_SHOWN, LEAST_AREA = 0.2, 0.2, 2e-4  # shares, m2

_DROP_CLEARANCE = 0.02  # m between an isolated object's lowest point and the table
_PILE_DROP_HEIGHT = 0.20  # m, as in VGN
_PILE_WALLS = {"half_size": 0.12, "height": 0.30, "thickness": 0.02}  # m
# m, of the layout bin. Around the default workspace the overhead camera, 0.8 m up, sees the inner
# edges of the walls' tops at 0.17 x 0.8 / 0.7 = 0.194 m from the middle; the image ends at 0.2 m.
# In a narrower bin more objects lie in corners, for which the hand, 0.21 m long, is too wide.
_WALL_HEIGHT, _WALL_THICKNESS, _WALL_GAP = 0.10, 0.01, 0.02
_PACKED_REGION = 0.07  # m, half side of the square of centres: VGN's 14 cm
_PACKED_GAP = 0.004  # m, least distance between neighbours
_TRIES = 50


class SceneError(UserError):
    """No valid scene could be made."""


def make_scene(layout: str, objects: ObjectSet, seed: int, config: Config) -> Scene:
    """The scene of a seed: the same arguments always give the same scene, bit for bit.

    Objects are drawn without repetition while the set has enough of them. A draw whose objects
    come to rest outside the workspace is thrown away and the next one taken from the same
    generator; after 50 draws SceneError is raised.
    """
    if layout not in LAYOUTS:
        raise SceneError(f"unknown scene layout {layout!r}; allowed are {', '.join(LAYOUTS)}")
    rng = np.random.default_rng([seed, LAYOUTS.index(layout)])
    arrange = _ARRANGEMENTS[layout]
    fixed = {"isolated": 1, "dense": DENSE_COUNT, "retrieve": RETRIEVE_COUNT}
    count = fixed.get(layout, config.scene.count)
    walls = tuple(_walls_around(config)) if layout == "bin" else ()
    for _ in range(_TRIES):
        if layout == "household":
            chosen = _mixed(objects, count, rng, config)
        else:
            chosen = rng.choice(len(objects), size=count, replace=count > len(objects))
        models = [objects[int(i)] for i in chosen]
        with make_layout_table(config, models, walls) as table:
            bodies = arrange(table, models, rng, config)
            if bodies is None or not table.settle(bodies):
                continue
            poses = [table.pose(body) for body in bodies]
        if all(_inside(position, config) for position, _ in poses):
            placements = tuple(Placement(model, *pose) for model, pose in zip(models, poses))
            target = _covered(placements, config) if layout == TARGET_LAYOUT else None
            if layout != TARGET_LAYOUT or target is not None:
                return Scene(layout, seed, placements, walls, target)
    covering = " with one under others" if layout == TARGET_LAYOUT else ""
    raise SceneError(
        f"no {layout} scene of {count} objects of {objects.name!r} (seed {seed}) came to rest "
        f"inside the {config.workspace.size} m workspace{covering} in {_TRIES} tries; use smaller "
        "objects (objects.scale, objects.fit), fewer (scene.count) or a larger workspace.size"
    )


def _mixed(objects: ObjectSet, count: int, rng, config: Config) -> np.ndarray:
    """Numbers (count,) of objects of mixed sizes, in random order: those that the hand spans where
    they are narrowest are sorted by that width and cut into `count` equal parts, and one is drawn
    from each. No object is scaled, so that sizes and masses are true."""
    widest = config.gripper.max_opening - 2 * RELAXED.room
    fitting = objects.by_width(widest)
    if not fitting:
        raise SceneError(
            f"no object of {objects.name!r} is less than {widest:.3f} m wide, so that the hand "
            "spans none; use smaller objects (objects.scale, objects.fit)"
        )
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
    workspace = Workspace(tuple(config.workspace.center), config.workspace.size)
    heights = height_map_from_scene(scene, workspace)
    covered = buried_share(scene, heights)
    shown = np.bincount(heights.label[heights.label >= 0], minlength=len(placements))
    wanted = (shown * heights.cell**2 >= LEAST_AREA) & (1 - covered >= LEAST_SHOWN)
    wanted &= [fits(one.model, config.gripper.geometry) for one in placements]
    covered = np.where(wanted, covered, 0.0)
    return int(covered.argmax()) if covered.max() >= LEAST_COVERED else None


def _walls_around(config: Config) -> Iterator[Box]:
    """Walls around the workspace, _WALL_GAP from its edges."""
    centre, half_size = np.array(config.workspace.center), config.workspace.size / 2 + _WALL_GAP
    return square_walls(centre, half_size, _WALL_HEIGHT, _WALL_THICKNESS)


def _inside(position: np.ndarray, config: Config) -> bool:
    offset = abs(position[:2] - config.workspace.center)
    return bool(np.isfinite(position).all() and offset.max() <= config.workspace.size / 2
                and position[2] > 0)  # fmt: skip


def _drop_one(table: LayoutTable, models: list[ObjectModel], rng, config: Config) -> list[int]:
    reach = max(config.workspace.size / 2 - 0.05, 0.0)
    rotation = Rotation.random(rng=rng)
    position = np.append(config.workspace.center + rng.uniform(-reach, reach, 2), 0.0)
    position[2] = _DROP_CLEARANCE - _lowest(models[0], rotation)
    return [table.put(models[0], position, rotation.as_quat())]


def _pile_up(table: LayoutTable, models: list[ObjectModel], rng, config: Config) -> list[int]:
    walls = table.put_walls(square_walls(config.workspace.center, **_PILE_WALLS))
    bodies = []
    for model in models:
        rotation = Rotation.random(rng=rng)
        reach = config.workspace.size / 6  # VGN drops into the central third
        position = np.append(config.workspace.center + rng.uniform(-reach, reach, 2), 0.0)
        position[2] = _PILE_DROP_HEIGHT - _lowest(model, rotation)
        bodies.append(table.put(model, position, rotation.as_quat()))
        table.settle(bodies[-1:])
    for wall in walls:
        table.remove(wall)
    return bodies


def _stand_upright(
    table: LayoutTable, models: list[ObjectModel], rng, config: Config
) -> list[int] | None:
    """Each object on its tallest stable side, at a free place; None if one finds no place."""
    bodies: list[int] = []
    for model in models:
        body = _stand_one(table, model, bodies, rng, config)
        if body is None:
            return None
        bodies.append(body)
    return bodies


def _stand_one(
    table: LayoutTable, model: ObjectModel, others: list[int], rng, config: Config
) -> int | None:
    for axis in np.argsort(-model.extents):  # the longest side up first
        for _ in range(10):
            upright = Rotation.align_vectors([[0, 0, 1]], [np.eye(3)[axis]])[0]
            rotation = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi)) * upright
            place = config.workspace.center + rng.uniform(-_PACKED_REGION, _PACKED_REGION, 2)
            position = np.append(place, 0.001 - _lowest(model, rotation))
            body = table.put(model, position, rotation.as_quat())
            if not table.is_near(body, others, _PACKED_GAP):
                if _stands(table, body, rotation, others):
                    return body
                table.remove(body)
                break  # it topples on this side, wherever it is put
            table.remove(body)
    return None


def _stands(table: LayoutTable, body: int, rotation: Rotation, others: list[int]) -> bool:
    """Whether a body just put down stays within 20 degrees of how it was put."""
    table.settle([body, *others])
    _, quaternion = table.pose(body)
    tilt = (Rotation.from_quat(quaternion) * rotation.inv()).as_matrix()[2, 2]
    return bool(tilt > np.cos(np.radians(20)))


def _lowest(model: ObjectModel, rotation: Rotation) -> float:
    """Height in metres of the lowest point relative to the centre of mass."""
    return min(float(rotation.apply(part)[:, 2].min()) for part in model.parts)


_ARRANGEMENTS = {
    "isolated": _drop_one, "packed": _stand_upright, "pile": _pile_up, "dense": _pile_up,
    "bin": _pile_up, "household": _pile_up, "retrieve": _pile_up,
}  # fmt: skip
