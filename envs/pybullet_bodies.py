"""PyBullet shapes of an object: what collides and what the camera sees.

This module knows shapes only: neither mass nor friction, and no object set.
"""

from __future__ import annotations

from pathlib import Path

import pybullet

from envs.object_files import FineVisual
from envs.object_primitives import NativeShape


def collision_shape(client: int, shape: NativeShape | Path) -> int:
    """Id of a new collision shape; `shape` is native or an OBJ file of convex parts."""
    if isinstance(shape, NativeShape):
        kind, size = _native_arguments(shape, "height")
        return pybullet.createCollisionShape(kind, physicsClientId=client, **size)
    return pybullet.createCollisionShape(
        pybullet.GEOM_MESH, fileName=str(shape), physicsClientId=client
    )


def visual_shape(
    client: int,
    shape: NativeShape | Path,
    color: tuple[float, float, float, float],
    fine: FineVisual | None = None,
) -> int:
    """Id of a new visual shape: what `collision_shape` makes of `shape`, or `fine` in its place.

    A native shape shows itself, whatever `fine` is.
    """
    if isinstance(shape, NativeShape):
        kind, size = _native_arguments(shape, "length")
        return pybullet.createVisualShape(kind, rgbaColor=color, physicsClientId=client, **size)
    if fine is None:
        return pybullet.createVisualShape(
            pybullet.GEOM_MESH, fileName=str(shape), rgbaColor=color, physicsClientId=client
        )
    return pybullet.createVisualShape(
        pybullet.GEOM_MESH,
        fileName=str(fine.path),
        meshScale=fine.scale,
        visualFramePosition=fine.position,
        visualFrameOrientation=fine.quaternion,
        # The colour multiplies a texture: white leaves it as it is.
        rgbaColor=(1, 1, 1, 1) if _has_texture(fine.path) else color,
        physicsClientId=client,
    )


def _native_arguments(shape: NativeShape, length_name: str) -> tuple[int, dict]:
    """PyBullet calls a cylinder's length "height" when it collides and "length" when it shows."""
    if shape.kind == "box":
        return pybullet.GEOM_BOX, {"halfExtents": [side / 2 for side in shape.size]}
    if shape.kind == "sphere":
        return pybullet.GEOM_SPHERE, {"radius": shape.size[0]}
    kinds = {"cylinder": pybullet.GEOM_CYLINDER, "capsule": pybullet.GEOM_CAPSULE}
    return kinds[shape.kind], {"radius": shape.size[0], length_name: shape.size[1]}


def _has_texture(path: Path) -> bool:
    material = path.with_suffix(".mtl")
    return material.is_file() and "map_Kd" in material.read_text(errors="replace")
