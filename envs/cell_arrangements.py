"""How the objects of each layout are put on a table, and what stands there with them.

An arrangement puts models on a `LayoutTable`, by the numbers that a generator draws, and returns
their bodies; None where one of them finds no place or does not stay. Single objects and piles are
dropped; other things are put down one after the other at free places: on the table, against a wall,
on a block, under a board. `envs.cell_scenes` chooses the models and accepts or refuses what has
come to rest. This module knows no robot, camera or task.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from envs.cell_layout import (
    Box,
    LayoutTable,
    ObjectModel,
    Placement,
    Viewpoint,
    square_walls,
)
from utils.config import Config

_DROP_CLEARANCE = 0.02  # m between an isolated object's lowest point and the table
_PILE_DROP_HEIGHT = 0.20  # m, as in VGN
_PILE_WALLS = {"half_size": 0.12, "height": 0.30, "thickness": 0.02}  # m
# m, of the layout bin. Around the default workspace the overhead camera, 0.8 m up, sees the inner
# edges of the walls' tops at 0.17 x 0.8 / 0.7 = 0.194 m from the middle; the image ends at 0.2 m.
# In a narrower bin more objects lie in corners, for which the hand, 0.21 m long, is too wide.
_WALL_HEIGHT, _WALL_THICKNESS, _WALL_GAP = 0.10, 0.01, 0.02
_PACKED_REGION = 0.07  # m, half side of the square of centres: VGN's 14 cm
_PACKED_GAP = 0.004  # m, least distance between neighbours
_TRIES = 50  # of a place for one object
_TALL_GAP = 0.015  # m, most between neighbours: a finger with its room needs 0.02 m
_LEAN = np.radians((12, 28))  # rad from the vertical, when put down
_LEANS = np.radians((8, 35))  # rad, at rest
_SLOT_PLAY = 0.02  # m to either side of the places at which things lean
_BLOCK = np.array([0.34, 0.16, 0.15])  # m, on which flat things lie; half a hand high and more
_OVERHANG = (0.02, 0.06)  # m
# m, of the layout shelf: its board's length, depth, thickness and lower side, and by how much its
# front edge is beyond the middle of the workspace; the arm goes in level up to 0.15 m deep.
_BOARD, _BOARD_HEIGHT, _FRONT = np.array([0.40, 0.26, 0.02]), 0.30, 0.07
_SHELF_MIDDLE, _SHELF_REACH = np.array([0.0, -0.02]), np.array([0.12, 0.05])  # m, of the places
_SHELF_GAP = 0.03  # m, least between neighbours: a finger with its room needs 0.02 m


# --- What stands there ------------------------------------------------------------------------


def _walls_around(config: Config) -> tuple[Box, ...]:
    """Walls around the workspace, _WALL_GAP from its edges."""
    centre, half_size = np.array(config.workspace.center), config.workspace.size / 2 + _WALL_GAP
    return tuple(square_walls(centre, half_size, _WALL_HEIGHT, _WALL_THICKNESS))


def _wall_beside(config: Config) -> tuple[Box, ...]:
    """One wall along the workspace's left edge, away from the tray."""
    half = np.array([config.workspace.size + 0.1, _WALL_THICKNESS, _WALL_HEIGHT]) / 2
    x, y = config.workspace.center
    return (Box(half, np.array([x, y + config.workspace.size / 2 + half[1], half[2]])),)


def _block(config: Config) -> tuple[Box, ...]:
    """A block in the middle of the workspace."""
    return (Box(_BLOCK / 2, np.append(config.workspace.center, _BLOCK[2] / 2)),)


def _shelf(config: Config) -> tuple[Box, ...]:
    """A board over the workspace, and the back that holds it on the side of the tray."""
    x, y = config.workspace.center
    front = y + _FRONT
    back = np.array([_BOARD[0], _BOARD[2], _BOARD_HEIGHT])
    return (
        Box(_BOARD / 2, np.array([x, front - _BOARD[1] / 2, _BOARD_HEIGHT + _BOARD[2] / 2])),
        Box(back / 2, np.array([x, front - _BOARD[1] + back[1] / 2, back[2] / 2])),
    )


def viewpoint_of(layout: str, config: Config) -> Viewpoint | None:
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


# --- Dropped, and put down ----------------------------------------------------------------------


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


def leans(placed: Placement) -> bool:
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


def _stands(table: LayoutTable, body: int, rotation: Rotation, others: list[int]) -> bool:
    """Whether a body just put down stays within 20 degrees of how it was put."""
    table.settle([body, *others])
    _, quaternion = table.pose(body)
    tilt = (Rotation.from_quat(quaternion) * rotation.inv()).as_matrix()[2, 2]
    return bool(tilt > np.cos(np.radians(20)))


def _lowest(model: ObjectModel, rotation: Rotation) -> float:
    """Height in metres of the lowest point relative to the centre of mass."""
    return min(float(rotation.apply(part)[:, 2].min()) for part in model.parts)


# The layouts, whose places here are part of the scenes' seeds: a new one stands at the end (number
# 11 is taken, see `utils.random_streams`: in `make_scene` the next one's seed needs a third number)
ARRANGEMENTS = {
    "isolated": _drop_one, "packed": _stand_upright, "pile": _pile_up, "dense": _pile_up,
    "bin": _pile_up, "household": _pile_up, "tall": _stand_close, "wall": _lean, "flat": _overhang,
    "retrieve": _pile_up, "shelf": _stand_below,
}  # fmt: skip
WALLS = {"bin": _walls_around, "wall": _wall_beside, "flat": _block, "shelf": _shelf}
FIXED = ("wall", "flat", "shelf")  # whose walls are fixtures of the cell
