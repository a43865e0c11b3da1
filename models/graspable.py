"""Whether a hand can take an object at all: alone on the table, in some pose in which it can rest.

It rests on a face of its convex hull over which its centre of mass lies. It can be taken if the
antipodal search with its smallest margins finds a grasp there from straight above, whose pads, in
the exact geometry, meet the object within the friction cone. The margins leave 3 mm beside each
finger (`utils.grasp_quality.RELAXED`), so that a box fits a hand that opens 0.08 m up to a
smallest side of 74 mm. This module knows no simulator.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from models.planner_antipodal import search
from models.planner_candidates import SearchSettings
from models.planner_contacts import exact_quality
from utils.geometry import (
    ConvexSolid,
    GripperGeometry,
    SceneGeometry,
    SolidObject,
    Workspace,
    intersect_lines,
)
from utils.height_map import height_map_from_scene

_SETTINGS = SearchSettings(angles=9, shortlist=120, finalists=120).relaxed()
# `exact_quality` of a grasp: less have those that one of the small errors of the pose, which it
# counts in, makes possible, such as by two facets of a rough model of a ball.
_LEAST_QUALITY = 0.1
_MOST_POSES = 12  # those in which the object lies lowest; round ones have hundreds
_DISTINCT = np.cos(np.deg2rad(15))  # poses whose undersides differ by less count once


def is_graspable(solids: Sequence[ConvexSolid], friction: float, gripper: GripperGeometry) -> bool:
    """Whether the hand can take an object with these convex solids, whose centre of mass is at the
    origin."""
    for T in resting_poses(solids):
        thing = SolidObject(tuple(solid.transformed(T) for solid in solids), T[:3, 3], friction)
        scene = SceneGeometry((thing,))
        corners = np.concatenate([solid.vertices for solid in thing.solids])
        workspace = Workspace((0.0, 0.0), 2 * float(np.abs(corners[:, :2]).max()))
        found = search(height_map_from_scene(scene, workspace), gripper, workspace, _SETTINGS)
        if len(found) and exact_quality(found, scene, gripper).max() > _LEAST_QUALITY:
            return True
    return False


def resting_poses(solids: Sequence[ConvexSolid]) -> Iterator[np.ndarray]:
    """Poses (4, 4) in W in which an object with its centre of mass at the origin can rest on the
    table, the lowest first."""
    hull = ConvexSolid.from_vertices(np.concatenate([solid.vertices for solid in solids]))
    hits = intersect_lines(hull, np.zeros_like(hull.normals), hull.normals)
    # A line down from the centre of mass leaves through the face on which the object rests.
    stable = (hits.leave_normal * hull.normals).sum(axis=1) > 1 - 1e-6
    taken: list[np.ndarray] = []
    for face in np.nonzero(stable)[0][np.argsort(hull.offsets[stable], kind="stable")]:
        down = hull.normals[face]
        if all(down @ other < _DISTINCT for other in taken):
            taken.append(down)
            T = np.eye(4)
            T[:3, :3] = Rotation.align_vectors([[0.0, 0.0, -1.0]], [down])[0].as_matrix()
            T[2, 3] = hull.offsets[face]
            yield T
        if len(taken) == _MOST_POSES:
            return
