"""A MuJoCo model of a scene: table, bin, objects and Panda where PyBullet's cell has them.

Sizes, masses, inertias, and friction with table and fingers are PyBullet's; contacts are MuJoCo's
own (between two objects MuJoCo takes the larger coefficient, PyBullet the product). This module
knows no cell, and no physics step is made here.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from envs.board import BLACK, WHITE, Board
from envs.cell_layout import BIN_COLOUR, GRAVITY, TABLE_COLOUR, Box, bin_walls, table_box
from envs.cell_scenes import Scene
from envs.mujoco_camera import add_view
from envs.mujoco_panda import FINGERS, load_mujoco, panda_spec
from envs.objects import ObjectModel
from utils.geometry import GripperGeometry
from utils.transforms import position_quaternion

if TYPE_CHECKING:
    import mujoco

# MuJoCo takes the larger friction of two that touch, PyBullet the product, with 1 on table and
# fingers: with nothing on these here, the object's own coefficient counts in both.
_NO_FRICTION = 1e-5
# m and dimensionless lengths of torsional and rolling friction, MuJoCo's defaults.
_TORSION, _ROLLING = 0.005, 1e-4
# s, in which a contact gets rid of a penetration. MuJoCo's default, 20 ms, is so soft that objects
# of 30 g creep and turn in a grip of 10 N (by 1.6 mm in half a second, with this by 0.5 mm).
_CONTACT_TIME = 0.005


def scene_spec(scene: Scene, gripper: GripperGeometry) -> mujoco.MjSpec:
    """A model of Panda, table, bin and the scene's objects at their resting poses, with a camera.

    Bodies are called `table`, `bin0` to `bin3` and `object0` on. Raises UserError without MuJoCo.
    """
    mujoco = load_mujoco()
    spec = panda_spec(gripper)
    spec.option.gravity = [0, 0, -GRAVITY]
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 100  # of friction's stiffness: grasped objects creep less
    for name in FINGERS:
        for geom in spec.body(name).geoms:
            geom.friction = [_NO_FRICTION, _TORSION, _ROLLING]
    _add_box(mujoco, spec, "table", table_box(), TABLE_COLOUR)
    for i, wall in enumerate(bin_walls()):
        _add_box(mujoco, spec, f"bin{i}", wall, BIN_COLOUR)
    for i, placed in enumerate(scene.placements):
        _add_object(mujoco, spec, f"object{i}", placed.model, placed.position, placed.quaternion)
    # The base stands on the table.
    exclude = spec.add_exclude()
    exclude.bodyname1, exclude.bodyname2 = "table", "panda_link1"
    for geom in spec.geoms:
        geom.solref[0] = _CONTACT_TIME
    add_view(spec)
    return spec


def add_board(spec: mujoco.MjSpec, board: Board, T_WO: np.ndarray) -> None:
    """Add a board that stays at T_WO (4, 4) and collides with nothing."""
    mujoco = load_mujoco()
    position, quaternion = position_quaternion(T_WO)
    body = spec.worldbody.add_body(
        name="board", pos=list(position), quat=np.roll(quaternion, 1).tolist()
    )
    half, middle = board.white()
    white = body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=half, pos=middle, rgba=list(WHITE))
    vertices, triangles = board.black()
    mesh = spec.add_mesh(name="board", uservert=np.ravel(vertices), userface=triangles)
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL  # a plane has no volume
    black = body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh.name, rgba=list(BLACK))
    for geom in (white, black):
        geom.contype = geom.conaffinity = 0


def _add_box(mujoco, spec: mujoco.MjSpec, name: str, box: Box, colour) -> None:
    body = spec.worldbody.add_body(name=name, pos=list(box.position))
    geom = body.add_geom(
        name=name, type=mujoco.mjtGeom.mjGEOM_BOX, size=list(box.half_size), rgba=list(colour)
    )
    geom.friction = [_NO_FRICTION, _TORSION, _ROLLING]


def _add_object(mujoco, spec, name: str, model: ObjectModel, position, quaternion) -> None:
    body = spec.worldbody.add_body(
        name=name, pos=list(position), quat=np.roll(quaternion, 1).tolist()
    )
    body.add_freejoint(name=name)
    body.mass, body.inertia, body.ipos = model.mass, model.inertia, [0, 0, 0]
    body.explicitinertial = True
    for i, part in enumerate(model.parts):
        mesh = spec.add_mesh(name=f"{name}_{i}")
        mesh.uservert = np.asarray(part, dtype=np.float32).ravel()
        geom = body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh.name)
        geom.rgba = list(model.color)
        geom.friction = [model.friction, _TORSION, max(model.rolling_friction, _ROLLING)]
        geom.condim = 6 if model.rolling_friction else 4
