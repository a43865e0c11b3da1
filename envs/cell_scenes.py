"""Scene layouts: which objects lie where, as a pure function of a seed.

`isolated`: one object, dropped. `packed`: objects standing upright side by side. `pile`: objects
dropped through a box whose walls are then taken away. The last two follow VGN (Breyer et al.,
"Volumetric Grasping Network", CoRL 2020). Knows nothing of the robot, cameras or tasks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pybullet
from scipy.spatial.transform import Rotation

from envs.cell_layout import add_table, add_walls, set_up_physics
from envs.objects import ObjectModel, ObjectSet, spawn
from utils.config import Config
from utils.errors import UserError

LAYOUTS = ("isolated", "packed", "pile")

_DROP_CLEARANCE = 0.02  # m between an isolated object's lowest point and the table
_PILE_DROP_HEIGHT = 0.20  # m, as in VGN
_PILE_WALLS = {"half_size": 0.12, "height": 0.30, "thickness": 0.02}  # m
_PACKED_REGION = 0.07  # m, half side of the square of centres: VGN's 14 cm
_PACKED_GAP = 0.004  # m, least distance between neighbours
REST_SPEED = 0.01  # m/s or (times 10) rad/s under which an object counts as resting
LOOK_EVERY = 12  # steps between two looks at whether objects rest
_TRIES = 50


@dataclass(frozen=True)
class Placement:
    """An object and its resting pose: position (3,) of the centre of mass, quaternion (4,), W."""

    model: ObjectModel
    position: np.ndarray
    quaternion: np.ndarray


@dataclass(frozen=True)
class Scene:
    layout: str
    seed: int
    placements: tuple[Placement, ...]


EMPTY = Scene("isolated", 0, ())


class SceneError(UserError):
    """No valid scene could be made."""


def make_scene(
    layout: str, objects: ObjectSet, seed: int, config: Config, client: int | None = None
) -> Scene:
    """The scene of a seed: the same arguments always give the same scene, bit for bit.

    client: a physics client whose world may be emptied and used; None makes one for the moment.

    Objects are drawn without repetition while the set has enough of them. A draw whose objects
    come to rest outside the workspace is thrown away and the next one taken from the same
    generator; after 50 draws SceneError is raised.
    """
    if layout not in LAYOUTS:
        raise SceneError(f"unknown scene layout {layout!r}; allowed are {', '.join(LAYOUTS)}")
    rng = np.random.default_rng([seed, LAYOUTS.index(layout)])
    arrange = {"isolated": _drop_one, "packed": _stand_upright, "pile": _pile_up}[layout]
    count = 1 if layout == "isolated" else config.scene.count
    borrowed = client is not None
    client = client if borrowed else pybullet.connect(pybullet.DIRECT)
    try:
        for _ in range(_TRIES):
            chosen = rng.choice(len(objects), size=count, replace=count > len(objects))
            models = [objects[int(i)] for i in chosen]
            set_up_physics(client, config.sim)
            add_table(client)
            bodies = arrange(client, models, rng, config)
            if bodies is None or not settle(client, bodies, config):
                continue
            poses = [
                pybullet.getBasePositionAndOrientation(b, physicsClientId=client) for b in bodies
            ]
            if all(_inside(position, config) for position, _ in poses):
                placements = tuple(
                    Placement(m, np.array(p), np.array(q)) for m, (p, q) in zip(models, poses)
                )
                return Scene(layout, seed, placements)
    finally:
        if not borrowed:
            pybullet.disconnect(physicsClientId=client)
    raise SceneError(
        f"no {layout} scene of {count} objects of {objects.name!r} (seed {seed}) came to rest "
        f"inside the {config.workspace.size} m workspace in {_TRIES} tries; use smaller objects "
        "(objects.scale, objects.fit), fewer (scene.count) or a larger workspace.size"
    )


def settle(client: int, bodies: list[int], config: Config, looks: int = 1) -> bool:
    """Step until the bodies rest; False if they still move after scene.settle_seconds.

    looks: how many times in a row, LOOK_EVERY steps apart, they must be found at rest. One look
    cannot tell a body that rests from one that begins to topple or turns round at the top of a
    bounce.
    """
    found = 0
    for step in range(int(config.scene.settle_seconds * config.sim.frequency)):
        pybullet.stepSimulation(physicsClientId=client)
        if step % LOOK_EVERY == LOOK_EVERY - 1:
            found = found + 1 if all(_resting(client, body) for body in bodies) else 0
            if found == looks:
                return True
    return False


def _resting(client: int, body: int) -> bool:
    linear, angular = pybullet.getBaseVelocity(body, physicsClientId=client)
    return max(map(abs, linear)) < REST_SPEED and max(map(abs, angular)) < 10 * REST_SPEED


def _inside(position, config: Config) -> bool:
    offset = abs(np.array(position[:2]) - config.workspace.center)
    return bool(np.isfinite(position).all() and offset.max() <= config.workspace.size / 2
                and position[2] > 0)  # fmt: skip


def _drop_one(client: int, models: list[ObjectModel], rng, config: Config) -> list[int]:
    reach = max(config.workspace.size / 2 - 0.05, 0.0)
    rotation = Rotation.random(rng=rng)
    position = np.append(config.workspace.center + rng.uniform(-reach, reach, 2), 0.0)
    position[2] = _DROP_CLEARANCE - _lowest(models[0], rotation)
    return [spawn(client, models[0], position, rotation.as_quat())]


def _pile_up(client: int, models: list[ObjectModel], rng, config: Config) -> list[int]:
    walls = add_walls(client, config.workspace.center, **_PILE_WALLS)
    bodies = []
    for model in models:
        rotation = Rotation.random(rng=rng)
        reach = config.workspace.size / 6  # VGN drops into the central third
        position = np.append(config.workspace.center + rng.uniform(-reach, reach, 2), 0.0)
        position[2] = _PILE_DROP_HEIGHT - _lowest(model, rotation)
        bodies.append(spawn(client, model, position, rotation.as_quat()))
        settle(client, bodies[-1:], config)
    for wall in walls:
        pybullet.removeBody(wall, physicsClientId=client)
    return bodies


def _stand_upright(client: int, models: list[ObjectModel], rng, config: Config) -> list[int] | None:
    """Each object on its tallest stable side, at a free place; None if one finds no place."""
    bodies: list[int] = []
    for model in models:
        body = _stand_one(client, model, bodies, rng, config)
        if body is None:
            return None
        bodies.append(body)
    return bodies


def _stand_one(client: int, model: ObjectModel, others: list[int], rng, config: Config):
    for axis in np.argsort(-model.extents):  # the longest side up first
        for _ in range(10):
            upright = Rotation.align_vectors([[0, 0, 1]], [np.eye(3)[axis]])[0]
            rotation = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi)) * upright
            place = config.workspace.center + rng.uniform(-_PACKED_REGION, _PACKED_REGION, 2)
            position = np.append(place, 0.001 - _lowest(model, rotation))
            body = spawn(client, model, position, rotation.as_quat())
            crowded = any(
                pybullet.getClosestPoints(body, other, _PACKED_GAP, physicsClientId=client)
                for other in others
            )
            if not crowded:
                if _stands(client, body, rotation, others, config):
                    return body
                pybullet.removeBody(body, physicsClientId=client)
                break  # it topples on this side, wherever it is put
            pybullet.removeBody(body, physicsClientId=client)
    return None


def _stands(client: int, body: int, rotation: Rotation, others: list[int], config: Config) -> bool:
    """Whether a body just put down stays within 20 degrees of how it was put."""
    settle(client, [body, *others], config)
    _, quaternion = pybullet.getBasePositionAndOrientation(body, physicsClientId=client)
    tilt = (Rotation.from_quat(quaternion) * rotation.inv()).as_matrix()[2, 2]
    return bool(tilt > np.cos(np.radians(20)))


def _lowest(model: ObjectModel, rotation: Rotation) -> float:
    """Height in metres of the lowest point relative to the centre of mass."""
    return min(float(rotation.apply(part)[:, 2].min()) for part in model.parts)
