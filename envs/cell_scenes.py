"""Scene layouts: which objects lie where, as a pure function of a seed.

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
(`envs.cell_layout.Scene`). This module knows no robot, camera or task.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from envs.cell_layout import (
    Box,
    LayoutTable,
    ObjectModel,
    Placement,
    Scene,
    Viewpoint,
    square_walls,
)
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
LAYOUTS = (
    "isolated", "packed", "pile", "dense", "bin", "household", "tall", "wall", "flat", "retrieve",
    "shelf",
)  # fmt: skip
TARGET_LAYOUT = "retrieve"  # of whose objects one is wanted
DENSE_COUNT, RETRIEVE_COUNT = 15, 8
WALL_COUNT, FLAT_COUNT = 3, 2  # wide things, which need room beside each other
SHELF_COUNT = 3
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
_TALL = 0.12  # m, least height of what stands in the layout tall; a finger is 0.045 m long
_TALL_GAP = 0.015  # m, most between neighbours: a finger with its room needs 0.02 m
_LEANER = (0.10, 0.115)  # m, of the layout wall: least longest side, and greatest second one
_LEAN = np.radians((12, 28))  # rad from the vertical, when put down
_LEANS = np.radians((8, 35))  # rad, at rest
_SLOT_PLAY = 0.02  # m to either side of the places at which things lean
_FLAT, _SPAN = 0.016, 0.085  # m, of the layout flat: greatest thickness, least second longest side
_BLOCK = np.array([0.34, 0.16, 0.15])  # m, on which flat things lie; half a hand high and more
_OVERHANG = (0.02, 0.06)  # m
# m, of the layout shelf: its board's length, depth, thickness and lower side, and by how much its
# front edge is beyond the middle of the workspace; the arm goes in level up to 0.15 m deep.
_BOARD, _BOARD_HEIGHT, _FRONT = np.array([0.40, 0.26, 0.02]), 0.30, 0.07
_SHELVED = (0.12, 0.25)  # m, longest sides of what stands under the board
_SHELF_MIDDLE, _SHELF_REACH = np.array([0.0, -0.02]), np.array([0.12, 0.05])  # m, of the places
_SHELF_GAP = 0.03  # m, least between neighbours: a finger with its room needs 0.02 m


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
    check_suited(layout, objects, config)
    rng = np.random.default_rng([seed, LAYOUTS.index(layout)])
    arrange = _ARRANGEMENTS[layout]
    count = _COUNTS.get(layout, config.scene.count)
    walls = _WALLS[layout](config) if layout in _WALLS else ()
    fixed, viewpoint = layout in _FIXED, _viewpoint(layout, config)
    for _ in range(_TRIES):
        if layout == "household":
            chosen = _mixed(objects, count, rng, config)
        elif layout in _SUITED:
            chosen = _suited(objects, count, rng, layout)
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
            if layout == "wall" and not all(map(_leans, placements)):
                continue
            target = _covered(placements, config) if layout == TARGET_LAYOUT else None
            if layout != TARGET_LAYOUT or target is not None:
                return Scene(layout, seed, placements, walls, fixed, viewpoint, target)
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
    workspace = Workspace(tuple(config.workspace.center), config.workspace.size)
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


def _walls_around(config: Config) -> tuple[Box, ...]:
    """Walls around the workspace, _WALL_GAP from its edges."""
    centre, half_size = np.array(config.workspace.center), config.workspace.size / 2 + _WALL_GAP
    return tuple(square_walls(centre, half_size, _WALL_HEIGHT, _WALL_THICKNESS))


def _wall_beside(config: Config) -> tuple[Box, ...]:
    """One wall along the workspace's left edge, away from the bin."""
    half = np.array([config.workspace.size + 0.1, _WALL_THICKNESS, _WALL_HEIGHT]) / 2
    x, y = config.workspace.center
    return (Box(half, np.array([x, y + config.workspace.size / 2 + half[1], half[2]])),)


def _block(config: Config) -> tuple[Box, ...]:
    """A block in the middle of the workspace."""
    return (Box(_BLOCK / 2, np.append(config.workspace.center, _BLOCK[2] / 2)),)


def _shelf(config: Config) -> tuple[Box, ...]:
    """A board over the workspace, and the back that holds it on the side of the bin."""
    x, y = config.workspace.center
    front = y + _FRONT
    back = np.array([_BOARD[0], _BOARD[2], _BOARD_HEIGHT])
    return (
        Box(_BOARD / 2, np.array([x, front - _BOARD[1] / 2, _BOARD_HEIGHT + _BOARD[2] / 2])),
        Box(back / 2, np.array([x, front - _BOARD[1] + back[1] / 2, back[2] / 2])),
    )


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


def _stand_close(
    table: LayoutTable, models: list[ObjectModel], rng, config: Config
) -> list[int] | None:
    """Each object on its longest side's end, near another one; None if one finds no place."""
    middle, reach = np.array(config.workspace.center), np.full(2, _PACKED_REGION)
    return _stand_in(table, models, rng, middle, reach, _PACKED_GAP, _TALL_GAP)


def _stand_below(
    table: LayoutTable, models: list[ObjectModel], rng, config: Config
) -> list[int] | None:
    """Each object on its longest side's end under the board; None if one finds no place."""
    middle = np.array(config.workspace.center) + _SHELF_MIDDLE
    return _stand_in(table, models, rng, middle, _SHELF_REACH, _SHELF_GAP)


def _stand_in(
    table: LayoutTable,
    models: list[ObjectModel],
    rng,
    middle: np.ndarray,
    reach: np.ndarray,
    gap: float,
    within: float | None = None,
) -> list[int] | None:
    """Each object on its longest side's end, its centre no farther than `reach` (2,) from `middle`
    (2,); gap, within: as in `_put_free`. None if one finds no place."""
    bodies: list[int] = []
    for model in models:
        upright = Rotation.align_vectors([[0, 0, 1]], [np.eye(3)[np.argmax(model.extents)]])[0]

        def anywhere(model=model, upright=upright) -> tuple[np.ndarray, Rotation]:
            rotation = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi)) * upright
            place = middle + rng.uniform(-reach, reach)
            return np.append(place, 0.001 - _lowest(model, rotation)), rotation

        if not _put_free(table, model, bodies, anywhere, gap, within):
            return None
    return bodies


def _put_free(
    table: LayoutTable,
    model: ObjectModel,
    bodies: list[int],
    draw: Callable[[], tuple[np.ndarray, Rotation]],
    gap: float = _PACKED_GAP,
    within: float | None = None,
) -> bool:
    """Put an object at the first pose that `draw` gives, of _TRIES, at which it is `gap` m from all
    `bodies`, and is nearer than `within` m to one of them; False where there is none or it does not
    stay. The object is appended to `bodies`."""
    for _ in range(_TRIES):
        position, rotation = draw()
        body = table.put(model, position, rotation.as_quat())
        near = within is None or not bodies or table.is_near(body, bodies, within)
        if near and not table.is_near(body, bodies, gap):
            stays = _stands(table, body, rotation, bodies)
            bodies.append(body)
            return stays
        table.remove(body)
    return False


def _lean(table: LayoutTable, models: list[ObjectModel], rng, config: Config) -> list[int] | None:
    """Each object on its longest side's end, its thinnest side towards the wall, leaning over;
    None if one finds no place or does not come to rest."""
    bodies: list[int] = []
    face = config.workspace.center[1] + config.workspace.size / 2  # y of the wall
    reach = config.workspace.size / 2 - 0.03
    # Wide things find room only beside each other, not at random places.
    slots = rng.permutation(np.linspace(-reach, reach, len(models)))
    for model, slot in zip(models, slots):
        thin, _, long = np.eye(3)[np.argsort(model.extents, kind="stable")]
        upright = Rotation.align_vectors([[0, 0, 1], [0, 1, 0]], [long, thin])[0]
        rotation = Rotation.from_euler("x", -rng.uniform(*_LEAN)) * upright
        corners = rotation.apply(np.concatenate(model.parts))
        # It comes to lean on the wall's upper edge where it is higher, on its face otherwise.
        low = corners[:, 2].min()
        farthest = _reach_below(corners, low + _WALL_HEIGHT)
        for _ in range(_TRIES):
            x = config.workspace.center[0] + slot + rng.uniform(-_SLOT_PLAY, _SLOT_PLAY)
            position = np.array([x, face - 0.001 - farthest, 0.001 - low])
            body = table.put(model, position, rotation.as_quat())
            if not table.is_near(body, bodies, _PACKED_GAP):
                break
            table.remove(body)
        else:
            return None
        bodies.append(body)
        if not table.settle(bodies):
            return None
    return bodies


def _leans(placed: Placement) -> bool:
    """Whether an object leans, and neither stands upright nor lies."""
    turn = Rotation.from_quat(placed.quaternion).as_matrix()
    lean = np.arccos(min(abs(turn[2, np.argmax(placed.model.extents)]), 1.0))
    return bool(_LEANS[0] <= lean <= _LEANS[1])


def _reach_below(corners: np.ndarray, height: float) -> float:
    """Greatest y of the convex hull of points (N, 3), no higher than `height`."""
    low = corners[corners[:, 2] <= height]
    high = corners[corners[:, 2] > height]
    farthest = low[:, 1].max()
    if len(high) == 0:
        return float(farthest)
    share = (height - low[:, None, 2]) / (high[:, 2] - low[:, None, 2])
    crossing = low[:, None, 1] + share * (high[:, 1] - low[:, None, 1])
    return float(max(farthest, crossing.max()))


def _overhang(
    table: LayoutTable, models: list[ObjectModel], rng, config: Config
) -> list[int] | None:
    """Each object flat on the block, some of it beyond the edge towards +y; None if one finds no
    place or falls."""
    bodies: list[int] = []
    x, y = config.workspace.center
    for model in models:
        level = Rotation.align_vectors([[0, 0, 1]], [np.eye(3)[np.argmin(model.extents)]])[0]

        def over_the_edge(model=model, level=level) -> tuple[np.ndarray, Rotation]:
            rotation = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi)) * level
            corners = rotation.apply(np.concatenate(model.parts))
            room = max(_BLOCK[0] / 2 - np.abs(corners[:, 0]).max(), 0.0)
            edge = y + _BLOCK[1] / 2
            position = np.array([
                x + rng.uniform(-room, room),
                min(edge + rng.uniform(*_OVERHANG) - corners[:, 1].max(), edge - 0.01),
                _BLOCK[2] + 0.001 - corners[:, 2].min(),
            ])  # fmt: skip
            return position, rotation

        if not _put_free(table, model, bodies, over_the_edge):
            return None
    return bodies


def _viewpoint(layout: str, config: Config) -> Viewpoint | None:
    """Of the layout wall from over the objects, of flat and shelf from the side that is open, for
    the shelf 61 degrees off the vertical; the configured camera serves the others."""
    x, y = config.workspace.center
    if layout == "wall":
        y += config.workspace.size / 2 - 0.07
        return Viewpoint((x, y, 0.8), (x, y, 0.0), (1.0, 0.0, 0.0))
    if layout == "flat":
        return Viewpoint((x, y + 0.61, 0.66), (x, y + 0.04, 0.12), (0.0, 0.0, 1.0))
    if layout == "shelf":
        return Viewpoint((x, y + 0.65, 0.49), (x, y - 0.05, 0.10), (0.0, 0.0, 1.0))
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
    "bin": _pile_up, "household": _pile_up, "tall": _stand_close, "wall": _lean, "flat": _overhang,
    "retrieve": _pile_up, "shelf": _stand_below,
}  # fmt: skip
_COUNTS = {
    "isolated": 1, "dense": DENSE_COUNT, "wall": WALL_COUNT, "flat": FLAT_COUNT,
    "retrieve": RETRIEVE_COUNT, "shelf": SHELF_COUNT,
}  # fmt: skip
_WALLS = {"bin": _walls_around, "wall": _wall_beside, "flat": _block, "shelf": _shelf}
_FIXED = ("wall", "flat", "shelf")  # whose walls are fixtures of the cell
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
