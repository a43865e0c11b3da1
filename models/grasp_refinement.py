"""A network's grasps made exact on the depth image that it saw.

A network names places well to a few millimetres; a finger needs better than that beside an object.
So each grasp is posed on the height map of the same image: centred between the faces, turned onto
them, put lower where that holds better, opened as far as nothing is in the way, or dropped where
fingers or palm would hit something.
This module knows neither the network nor the simulator.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from models.antipodal import SearchSettings, measure, turn_onto_faces
from models.candidates import Candidates
from utils.geometry import GripperGeometry
from utils.height_map import HeightMap
from utils.transforms import Grasp


@dataclass(frozen=True)
class RefinementSettings:
    """search: margins, as in the antipodal search. geometry: the exponent of the measured contacts'
    score in the ranking, next to the network's quality; 0 ranks by the network alone. turns: how
    often a grasp is turned onto its faces. deeper: metres further down that are tried as well, as
    far as the table leaves room. distance, angle: metres and radians, grasps closer than
    both are one."""

    search: SearchSettings = SearchSettings()
    geometry: float = 0.5
    turns: int = 2
    deeper: tuple[float, ...] = (0.0, 0.008, 0.016)
    distance: float = 0.01
    angle: float = np.deg2rad(20)


def refine(
    grasps: Sequence[Grasp],
    heights: HeightMap,
    gripper: GripperGeometry,
    settings: RefinementSettings = RefinementSettings(),
) -> list[Grasp]:
    """The grasps that fit the height map, exact and ranked anew; empty if none does."""
    if not grasps:
        return []
    lowest = heights.table_height + settings.search.table_clearance
    widest = gripper.max_opening - 2 * settings.search.rooms[0]  # leaves room beside the faces
    repeated = [grasp for grasp in grasps for _ in settings.deeper]
    tip = np.array([grasp.position[2] for grasp in repeated]) - gripper.tip_below_centre
    deeper = np.tile(settings.deeper, len(grasps))
    found = Candidates.rough(
        xy=np.array([grasp.position[:2] for grasp in repeated]),
        angle=np.array([grasp.angle for grasp in repeated]),
        tip=np.maximum(tip - deeper, np.minimum(tip, lowest)),
        width=np.minimum([grasp.width for grasp in repeated], widest),
        score=np.array([grasp.quality for grasp in repeated]),
    )
    # Where the table stops several of the depths, one of them is enough.
    depths = found.tip.reshape(len(grasps), -1)
    found = found.take((np.diff(depths, axis=1, prepend=np.inf) != 0).ravel())
    quality = found.score
    found = measure(found, heights, gripper, settings.search)
    found = turn_onto_faces(found, heights, gripper, settings.search, settings.turns)
    fits = found.score > 0
    found.score = np.where(fits, quality * np.minimum(found.score, 1) ** settings.geometry, 0.0)
    ranked = found.best(len(found)).distinct(len(found), settings.distance, settings.angle)
    return ranked.grasps(gripper)
