"""Exact quality of candidate grasps: contacts of the pads with the scene's true solids.

Lines across the flat pads are intersected with every convex solid, also with the pose perturbed.
`buried_share` tells which objects others cover. Both need the true geometry, so only privileged
planners may use them. This module knows no image and no search.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from models.planner_candidates import Candidates
from utils.geometry import GripperGeometry, SceneGeometry, Workspace, intersect_lines
from utils.height_map import HeightMap, height_map_from_scene

# Pose errors under which a grasp should hold: (along, across) in metres, then angle in radians.
PERTURBATIONS = np.array(
    [(0, 0, 0)]
    + [(s * 0.005, 0, 0) for s in (-1, 1)]
    + [(0, s * 0.005, 0) for s in (-1, 1)]
    + [(0, 0, s * np.deg2rad(5)) for s in (-1, 1)]
)


# The score of `scored_by_contacts` below which a grasp is left out. By the height map's fallback,
# no executed grasp below it succeeded on training scenes, such as on plates that lie flat, and
# nearly all others did; by that of `OraclePlanner`, it is a critic's chance of 37 %: there, 5 of 70
# grasps under 35 % succeeded.
_HOPELESS = 1e-3


def scored_by_contacts(
    found: Candidates,
    scene: SceneGeometry,
    gripper: GripperGeometry,
    buried: np.ndarray,
    fallback: np.ndarray | None = None,
) -> Candidates:
    """The candidates with scores that the exact contacts decide, best first; hopeless ones are left
    out.

    scene: in the candidates' frame. buried: (M,) share of each object that others cover. fallback:
    (N,) small scores, which decide where no contacts are antipodal, unless the pads would slip off;
    by default those of the height map.
    """
    quality, slips = exact_contacts(found, scene, gripper)
    least = 0.01 * found.score if fallback is None else fallback
    least = np.where(slips, 0.0, least)
    score = (found.score * quality + least) * (1 - 0.7 * buried[found.label])
    found = replace(found, score=np.where(score >= _HOPELESS, score, 0.0))
    return found.best(len(found))


def exact_quality(
    candidates: Candidates, scene: SceneGeometry, gripper: GripperGeometry
) -> np.ndarray:
    """(N,) in [0, 1]: the quality of `exact_contacts`."""
    return exact_contacts(candidates, scene, gripper)[0]


def exact_contacts(
    candidates: Candidates, scene: SceneGeometry, gripper: GripperGeometry
) -> tuple[np.ndarray, np.ndarray]:
    """How well the pads hold, and whether they slip off.

    Returns the quality (N,) in [0, 1] of the pads' contacts, at the nominal pose and at
    `PERTURBATIONS`, and (N,) bool whether the pads slip off upwards at the nominal one.

    The quality of a pose is 0 unless both pads first meet the same object with normals inside the
    friction cone (Nguyen 1988: two soft contacts whose line lies in both cones close by force).
    Pads slip off where the two faces rise towards the hand, on average, by more than that cone's
    angle: no turn of the object makes such a wedge narrower.
    """
    N, P = len(candidates), len(PERTURBATIONS)
    along, across = candidates.axes()
    along, across = (
        np.broadcast_to(np.pad(axis, ((0, 0), (0, 1)))[:, None], (N, P, 3))
        for axis in (along, across)
    )
    cos, sin = np.cos(PERTURBATIONS[:, 2, None]), np.sin(PERTURBATIONS[:, 2, None])
    centre = np.column_stack([candidates.xy, candidates.tip])[:, None]
    centre = centre + PERTURBATIONS[:, :1] * along + PERTURBATIONS[:, 1:2] * across
    along, across = cos * along + sin * across, cos * across - sin * along
    value, slips = _pad_contacts(
        centre.reshape(-1, 3), along.reshape(-1, 3), across.reshape(-1, 3),
        np.repeat(candidates.opening / 2, P), np.repeat(candidates.offset, P), scene, gripper,
    )  # fmt: skip
    value, slips = value.reshape(N, P), slips.reshape(N, P)[:, 0]
    quality = 0.4 * value[:, 0] + 0.4 * value[:, 1:].mean(axis=1) + 0.2 * value.min(axis=1)
    return quality, slips


def _pad_contacts(
    centre, along, across, half, away, scene: SceneGeometry, gripper: GripperGeometry
) -> tuple[np.ndarray, np.ndarray]:
    """(N,) quality in [0, 1] of the contacts of two closing pads, and (N,) whether they slip off.

    centre: (N, 3) at the fingertips' lowest points; along, across: (N, 3); half: (N,) of the
    opening; away: (N,) of the hand's middle from the centre along the closing line.
    """
    offset, height = (
        axis.ravel()
        for axis in np.meshgrid(
            np.linspace(-1, 1, 5) * 0.92 * gripper.pad_half_width,
            np.linspace(0.08, 0.95, 4) * gripper.pad_height,
        )
    )
    N, L = len(centre), len(offset)
    origins = (
        centre[:, None]
        + offset[:, None] * across[:, None]
        + height[:, None] * np.array((0, 0, 1.0))
    )
    first_hits = _first_hits(
        scene, origins.reshape(-1, 3), np.repeat(along, L, axis=0),
        np.repeat([half - away, half + away], L, axis=1),
    )  # fmt: skip
    travel, owner, facing, rising = (part.reshape(2, N, L) for part in first_hits)

    first = travel.min(axis=2, keepdims=True)
    touch = travel < first + 0.0015
    share = touch.mean(axis=2)
    count = np.maximum(touch.sum(axis=2), 1)
    angle = np.arccos(np.clip((facing * touch).sum(axis=2) / count, -1, 1))
    met = np.take_along_axis(owner, travel.argmin(axis=2)[..., None], axis=2)
    alone = np.where(touch, owner == met, True).all(axis=2)
    point = (
        np.stack([(touch * offset).sum(axis=2), (touch * height).sum(axis=2)], axis=-1)
        / count[..., None]
    )
    held = met[0, :, 0]
    good = (met[0] == met[1])[:, 0] & (held >= 0) & alone.all(axis=0)
    good &= (first[..., 0] > 0.0005).all(axis=0)  # a pad that starts inside matter has hit it
    friction = np.array([item.friction for item in scene.objects])[held]
    cone = 0.9 * np.arctan(np.minimum(friction, 1.0))  # the fingers' own friction is 1
    slope = np.arcsin(np.clip((rising * touch).sum(axis=2) / count, -1, 1))
    slips = slope.mean(axis=0) > cone
    worst = angle.max(axis=0)
    to_mass = np.array([item.centre_of_mass for item in scene.objects])[held] - centre
    arm = np.abs((to_mass * across).sum(axis=1) - point[..., 0].mean(axis=0))
    above = np.abs(to_mass[:, 2] - point[..., 1].mean(axis=0))
    value = np.exp(-((worst / (0.7 * cone)) ** 2)) * np.exp(
        -((arm / 0.02) ** 2) - (above / 0.06) ** 2
    )
    value = value * (0.3 + 0.7 * np.minimum(share.min(axis=0) / 0.5, 1)) * good * (worst < cone)
    return value, slips


def _first_hits(
    scene: SceneGeometry, origins: np.ndarray, directions: np.ndarray, limits: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """What pads that close along M lines first meet, the left one and the right one, (2, M) each:
    m that a pad travels, infinite where it meets nothing; the number of the object, -1 for walls
    and nothing; the cosine between the face's normal and the pad's, and the sine of the angle by
    which the face looks up.

    origins, directions: (M, 3) of the lines. limits: (2, M) m from the origins to the open pads.
    """
    # Travel of each pad from its open position to the first matter on each line, left then right.
    travel = np.full(limits.shape, np.inf)
    owner = np.full(limits.shape, -1)
    facing = np.zeros(limits.shape)
    rising = np.zeros(limits.shape)  # sine of the angle by which the face looks up
    bodies = [(number, item.solids) for number, item in enumerate(scene.objects)]
    for number, solids in [*bodies, (-1, scene.walls)]:  # -1 is not an object to be held
        for solid in solids:
            middle = (solid.vertices.max(axis=0) + solid.vertices.min(axis=0)) / 2
            radius = np.linalg.norm(solid.vertices - middle, axis=1).max()
            to_middle = middle - origins
            t = (to_middle * directions).sum(axis=1)
            close = np.linalg.norm(to_middle - t[:, None] * directions, axis=1) < radius
            lines = np.nonzero(close & (-limits[0] - radius < t) & (t < limits[1] + radius))[0]
            if len(lines) == 0:
                continue
            hits = intersect_lines(solid, origins[lines], directions[lines])
            # A solid that lies wholly behind a pad, outside, is not between the fingers.
            between = hits.hit & (hits.leave > -limits[0, lines]) & (hits.enter < limits[1, lines])
            for side, (distance, normal, sign) in enumerate(
                ((hits.enter, hits.enter_normal, -1), (-hits.leave, hits.leave_normal, 1))
            ):
                distance = distance + limits[side, lines]
                better = between & (distance < travel[side, lines])
                chosen = lines[better]
                travel[side, chosen] = distance[better]
                owner[side, chosen] = number
                facing[side, chosen] = sign * (normal[better] * directions[chosen]).sum(axis=1)
                rising[side, chosen] = normal[better, 2]
    return travel, owner, facing, rising


def buried_share(scene: SceneGeometry, heights: HeightMap) -> np.ndarray:
    """(M,) share of each object's plan view that another object covers."""
    seen = np.bincount(heights.label[heights.label >= 0], minlength=len(scene.objects))
    whole = np.empty(len(scene.objects))
    side = heights.cell * (heights.height.shape[0] - 1)
    workspace = Workspace(tuple(heights.origin + side / 2), side, heights.table_height)
    for number, item in enumerate(scene.objects):
        alone = SceneGeometry((item,), scene.table_height)
        whole[number] = (
            height_map_from_scene(alone, workspace, 2 * heights.cell, 0.0).label >= 0
        ).sum()
    return np.clip(1 - seen / np.maximum(4 * whole, 1), 0, 1)
