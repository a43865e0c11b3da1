"""Planners: anything that turns an RGB-D frame into ranked grasps.

A planner is a callable `plan(frame) -> list[Grasp]`, best first; an empty list means that there is
nothing to grasp. `random` and `heuristic` see only the depth image, `oracle` the true geometry.
This module knows no simulator.

Heuristic and oracle share one search over a height map: runs of matter along the closing line
that fit between the fingers (dense, every angle and height); each survivor is then posed on the
map, its contacts, clearances and lever arms measured, and it is centred and turned onto the faces.
The oracle judges the best ones by exact line-solid intersections, also with the pose perturbed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Protocol

import cv2
import numpy as np

from utils.geometry import GripperGeometry, SceneGeometry, Workspace, intersect_lines
from utils.height_map import HeightMap, height_map_from_frame, height_map_from_scene
from utils.transforms import Grasp, RGBDFrame, angle_difference


class Planner(Protocol):
    """needs_truth: whether the frame must carry `truth`."""

    needs_truth: bool

    def reset(self, seed: int) -> None: ...

    def __call__(self, frame: RGBDFrame) -> list[Grasp]: ...


@dataclass(frozen=True)
class SearchSettings:
    """Margins and preferences of the search; metres and radians unless said."""

    angles: int = 18  # bin k is centred at k * 180 / angles degrees
    level_step: float = 0.006  # between the heights of the fingertips that are tried
    table_clearance: float = 0.004  # under the fingertips
    clearance: float = 0.003  # over whatever lies under fingers and palm
    rooms: tuple[float, ...] = (0.004, 0.006, 0.008, 0.012)  # room beside each contact when open
    inner_margin: float = 0.0015  # of that room, free of matter beside the descending finger
    min_engagement: float = 0.006  # the object must rise this far over the fingertips
    good_engagement: float = 0.022  # and gains nothing beyond this
    max_wedge: float = np.deg2rad(28)  # half the angle between the two faces, mu = 0.5
    min_facing: float = 0.75  # cosine of an edge's gradient against the closing line, dense stage
    reach: float = 0.04  # how far outside the workspace a grasp's centre may lie
    shortlist: int = 1000  # survivors of the dense stage that are measured
    finalists: int = 250  # of these, turned onto the faces and measured again
    returned: int = 20


@dataclass
class Candidates:
    """N grasps in the making.

    xy: (N, 2) fingertips' centre in W. angle: (N,). tip: (N,) height of the fingertips' lowest
    point in W. width: (N,) of what is between the fingers. opening: (N,) before closing.
    turn: (N,) rotation that would bring the pads flat onto the faces. label: (N,) the object in
    the height map. score: (N,), 0 = not feasible.
    """

    xy: np.ndarray
    angle: np.ndarray
    tip: np.ndarray
    width: np.ndarray
    opening: np.ndarray
    turn: np.ndarray
    label: np.ndarray
    score: np.ndarray

    @staticmethod
    def rough(xy, angle, tip, width, score) -> Candidates:
        """Candidates of the dense stage, not measured yet."""
        return Candidates(
            xy, angle, tip, width, width, np.zeros(len(tip)), np.full(len(tip), -1), score
        )

    def __len__(self) -> int:
        return len(self.angle)

    def take(self, index) -> Candidates:
        return Candidates(*(getattr(self, field.name)[index] for field in fields(self)))

    def best(self, count: int) -> Candidates:
        """The `count` best feasible ones, best first."""
        order = np.argsort(-self.score, kind="stable")[:count]
        return self.take(order[self.score[order] > 0])

    def better(self, other: Candidates) -> Candidates:
        """Of each pair of candidates the one with the higher score."""
        wins = other.score > self.score
        pairs = [(getattr(self, f.name), getattr(other, f.name)) for f in fields(self)]
        return Candidates(
            *(np.where(wins[:, None] if a.ndim == 2 else wins, b, a) for a, b in pairs)
        )

    def axes(self) -> tuple[np.ndarray, np.ndarray]:
        """(N, 2) unit vectors along the closing line and across it."""
        along = np.stack([np.cos(self.angle), np.sin(self.angle)], axis=-1)
        return along, np.stack([-along[:, 1], along[:, 0]], axis=-1)

    def distinct(self, count: int, distance: float, angle: float) -> Candidates:
        """Non-maximum suppression: at most `count`, no two closer than both distance and angle."""
        kept: list[int] = []
        for i in range(len(self)):
            near = np.linalg.norm(self.xy[kept] - self.xy[i], axis=1) < distance
            if not (near & (angle_difference(self.angle[kept], self.angle[i]) < angle)).any():
                kept.append(i)
                if len(kept) == count:
                    break
        return self.take(kept)

    def grasps(self, gripper: GripperGeometry) -> list[Grasp]:
        height = self.tip + gripper.tip_below_centre
        return [
            Grasp(np.array([x, y, z]), angle, opening, score)
            for (x, y), z, angle, opening, score in zip(
                self.xy, height, self.angle, self.opening.tolist(), self.score.tolist()
            )
        ]


def search(
    heights: HeightMap, gripper: GripperGeometry, workspace: Workspace, settings: SearchSettings
) -> Candidates:
    """Feasible candidates on a height map, measured and scored, best first; may be empty.

    Where nothing meets the margins, a second search gives some of them up: a poor attempt may clear
    an object, none ends the round.
    """
    found = _search_once(heights, gripper, workspace, settings)
    if len(found) == 0:
        daring = replace(
            settings,
            clearance=0.0015,
            rooms=(0.003, *settings.rooms),
            inner_margin=0.0,
            min_engagement=0.004,
            max_wedge=np.deg2rad(38),
            min_facing=0.6,
        )
        found = _search_once(heights, gripper, workspace, daring)
    return found


def _search_once(
    heights: HeightMap, gripper: GripperGeometry, workspace: Workspace, settings: SearchSettings
) -> Candidates:
    found = dense_candidates(heights, gripper, workspace, settings).best(settings.shortlist)
    if len(found) == 0:
        return found
    found = measure(found, heights, gripper, settings).best(settings.finalists)
    for _ in range(2):
        turned = replace(found, angle=np.mod(found.angle + found.turn, np.pi))
        found = found.better(measure(turned, heights, gripper, settings))
    return found.best(len(found))


def dense_candidates(
    heights: HeightMap, gripper: GripperGeometry, workspace: Workspace, settings: SearchSettings
) -> Candidates:
    """Every angle, fingertip height and row of the map: what might fit between the fingers."""
    size, cell = heights.height.shape[0], heights.cell
    half = (size - 1) / 2
    middle = heights.origin + cell * half
    lowest = heights.table_height + settings.table_clearance
    levels = np.arange(lowest, heights.height.max() - settings.min_engagement, settings.level_step)
    # Gradients of the blurred map point across an edge whatever its height.
    slope = np.stack(
        np.gradient(cv2.GaussianBlur(heights.height, (0, 0), 0.002 / cell))[::-1], axis=-1
    )
    slope /= np.linalg.norm(slope, axis=-1, keepdims=True) + 1e-9
    thickness = gripper.finger_outline[1][0]
    finger = np.ones(
        (2 * int(gripper.finger_half_width / cell) + 1, int(thickness / cell)), np.uint8
    )
    palm_half = int(gripper.palm_outline[1][0] / cell), int(gripper.palm_half_length / cell)
    palm = np.ones((2 * palm_half[0] + 1, 2 * palm_half[1] + 1), np.uint8)
    parts = [Candidates.rough(np.empty((0, 2)), *np.empty((4, 0)))]
    for angle in np.arange(settings.angles) * np.pi / settings.angles if len(levels) else ():
        along = np.array([np.cos(angle), np.sin(angle)])
        across = np.array([-along[1], along[0]])
        axes = np.column_stack([along, across])
        warp = np.column_stack([axes, half - axes @ (half, half)])
        turned = cv2.warpAffine(
            heights.height, warp, (size, size), flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP,
            borderValue=heights.table_height,
        )  # fmt: skip
        level, row, first, last = _runs(
            turned, levels, gripper.max_opening - 2 * settings.rooms[0], cell
        )
        tip, centre = levels[level], np.rint((first + last) / 2).astype(int)
        under_finger, under_palm = cv2.dilate(turned, finger), cv2.dilate(turned, palm)
        limit = tip - settings.clearance
        free = np.zeros(len(tip), bool)
        for room in settings.rooms:  # a sloping flank asks for more of it
            offset = (room + thickness / 2) / cell  # from the contact to the finger's middle
            left, right = (
                np.clip(np.rint(at).astype(int), 0, size - 1)
                for at in (first - offset, last + offset)
            )
            fits = (under_finger[row, left] < limit) & (under_finger[row, right] < limit)
            free |= fits & ((last - first + 1) * cell + 2 * room < gripper.max_opening + 2 * cell)
        free &= under_palm[row, centre] < limit + gripper.palm_height
        row, first, last, tip = row[free], first[free], last[free], tip[free]

        base = middle + cell * (row - half)[:, None] * across
        at_first, at_inside, xy, at_last = (
            base + cell * (column - half)[:, None] * along
            for column in (first, first + 1.5, (first + last) / 2, last)
        )
        reach = np.abs(xy - workspace.centre).max(axis=1) < workspace.size / 2 + settings.reach
        # Outward normals are minus the gradient: cosines against the closing line on both sides.
        facing = np.minimum(
            slope[heights.index(at_first)] @ along, -slope[heights.index(at_last)] @ along
        )
        inside = heights.label[heights.index(at_inside)]
        arm = np.abs((heights.centres[inside, :2] - xy) @ across) if len(heights.centres) else 0.0
        rise = turned[row, first] - tip
        score = np.exp(-((arm / 0.03) ** 2)) * np.clip(facing, 0, 1) ** 2
        score *= (
            reach
            * (facing > settings.min_facing)
            * np.clip(rise / settings.good_engagement, 0.2, 1)
        )
        parts.append(
            Candidates.rough(xy, np.full(len(tip), angle), tip, (last - first + 1) * cell, score)
        )
    return Candidates(
        *(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Candidates))
    )


def _runs(
    turned: np.ndarray, levels: np.ndarray, max_width: float, cell: float
) -> tuple[np.ndarray, ...]:
    """Runs of cells over a level along the rows: level, row, first and last column, each (M,).

    A run may bridge a gap to the next one or two of its row (a ring, a mug). Every second row is
    enough: the pad spans several.
    """
    rows = np.nonzero(turned.max(axis=1) > levels[0])[0]
    picked = np.arange(rows[0], rows[-1] + 1, 2) if len(rows) else rows
    matter = turned[picked] > levels[:, None, None]
    edge = np.diff(np.pad(matter, ((0, 0), (0, 0), (1, 1))).view(np.int8), axis=-1)
    level, row, first = np.nonzero(edge == 1)
    last = np.nonzero(edge == -1)[2] - 1
    found = []
    for bridge in range(3):
        n = max(len(level) - bridge, 0)
        fits = (level[:n] == level[bridge:]) & (row[:n] == row[bridge:])
        fits &= (last[bridge:] - first[:n] + 1) * cell < max_width + cell
        found.append((level[:n][fits], picked[row[:n][fits]], first[:n][fits], last[bridge:][fits]))
    return tuple(np.concatenate(column) for column in zip(*found))


def measure(
    candidates: Candidates, heights: HeightMap, gripper: GripperGeometry, settings: SearchSettings
) -> Candidates:
    """Pose each candidate on the map; centre it between its contacts and score it.

    The pads are flat: a pad stops where the first of the lines across it meets matter. Slopes of
    the meeting points across the pad give the angle to the face, their shift with height its tilt.
    """
    cell, N = heights.cell, len(candidates)
    along, across = candidates.axes()
    reach = gripper.max_opening / 2 + gripper.finger_outline[-1][0] + 0.004
    u = np.arange(-np.ceil(reach / cell), np.ceil(reach / cell) + 1) * cell
    v = np.linspace(-1, 1, 9) * gripper.finger_half_width
    grid = (
        candidates.xy[:, None, None]
        + u[:, None, None] * along[:, None, None]
        + v[:, None] * across[:, None, None]
    )
    where = heights.index(grid)  # (N, U, V)
    H = heights.height[where]
    tip = candidates.tip

    # Contacts, searched a little beyond the width that the candidate claims.
    window = np.abs(u) <= candidates.width[:, None] / 2 + settings.rooms[0]
    top = np.where(window[..., None], H, -np.inf).max(axis=(1, 2))
    engagement = top - tip
    upper = tip + 0.5 * np.clip(engagement, 0.002, 0.016)
    low_left, low_right = _first_contacts(H, window, tip + 0.001, u, cell)
    high_left, high_right = _first_contacts(H, window, upper, u, cell)
    left, right = low_left.min(axis=1), low_right.max(axis=1)
    touched = np.isfinite(left) & np.isfinite(high_left.min(axis=1))
    left, right = np.where(touched, left, 0.0), np.where(touched, right, 0.0)
    width, shift = right - left, (right + left) / 2
    slope_left, cover_left = _face(low_left - left[:, None], v)
    slope_right, cover_right = _face(right[:, None] - low_right, v)
    yaw_left, yaw_right = np.arctan(slope_left), -np.arctan(slope_right)
    turn, wedge = -(yaw_left + yaw_right) / 2, np.abs(yaw_left - yaw_right) / 2
    rise = upper - tip - 0.001
    with np.errstate(invalid="ignore"):
        tilt_left = np.arctan2(np.maximum(high_left.min(axis=1) - left, 0), rise)
        tilt_right = np.arctan2(np.maximum(right - high_right.max(axis=1), 0), rise)
    tilt = np.where(touched, (tilt_left + tilt_right) / 2, np.pi / 2)

    # Clearance of fingers and palm on a straight descent, at the widest opening that is free.
    xy = candidates.xy + shift[:, None] * along
    free, opening, room = np.zeros(N, bool), np.zeros(N), np.zeros(N)
    near = np.abs(u - shift[:, None])
    obstacles = cv2.dilate(heights.height, np.ones((3, 3)))[where].max(axis=2)
    for candidate_room in settings.rooms:
        half = np.minimum(width / 2 + candidate_room, gripper.max_opening / 2)
        outward = near - half[:, None]
        # Between contact and finger only the closing pads pass, over anything below the tips.
        sill = np.where(
            near > width[:, None] / 2 + settings.rooms[0], settings.clearance + 0.001, np.inf
        )
        below_finger = gripper.finger_underside(np.maximum(outward, 0))
        under = np.where(outward < -settings.inner_margin, sill, below_finger)
        fits = (obstacles - under).max(axis=1) <= tip - settings.clearance
        fits &= half >= width / 2 + settings.rooms[0] - 1e-9
        free |= fits
        opening, room = np.where(fits, 2 * half, opening), np.where(fits, half - width / 2, room)
    under = gripper.finger_underside(near - opening[:, None] / 2)[..., None]
    blind = ((heights.ceiling[where] - under > tip[:, None, None]) & (under < np.inf)).mean(
        axis=(1, 2)
    )
    left_over = np.nonzero(free & touched)[0]
    gap = _palm_gap(xy[left_over], along[left_over], across[left_over], heights, gripper)
    free[left_over] = gap >= settings.clearance - tip[left_over]

    # What is held, and how far from its centre of mass.
    inner = np.minimum(0.003, width / 3)
    ends = [
        heights.label[heights.index(candidates.xy + (end[:, None] * along))]
        for end in (left + inner, right - inner)
    ]
    label = np.maximum(*ends)
    centre = heights.centres[label]
    arm_across = np.abs(((centre[:, :2] - xy) * across).sum(axis=1))
    arm_along = np.abs(((centre[:, :2] - xy) * along).sum(axis=1))
    arm_up = np.abs(centre[:, 2] - tip - gripper.pad_height / 2)

    score = np.exp(-((wedge / 0.25) ** 2) - (turn / 0.25) ** 2 - (tilt / 0.45) ** 2)
    score *= np.exp(-((arm_across / 0.022) ** 2) - (arm_along / 0.06) ** 2 - (arm_up / 0.05) ** 2)
    score *= 0.4 + 0.6 * np.minimum(cover_left, cover_right)
    score *= np.clip(engagement / settings.good_engagement, 0.2, 1)
    score *= np.interp(room, (0.003, 0.008), (0.4, 1.0))
    score *= np.exp(-4 * blind)
    score *= np.where(ends[0] == ends[1], 1.0, 0.5)
    score *= 1 + 2 * np.clip(top - heights.table_height, 0, 0.15)  # mildly: the top of a pile first
    feasible = (
        touched & free & (wedge < settings.max_wedge) & (engagement >= settings.min_engagement)
    )
    feasible &= (label >= 0) & (width > 0)
    turn = np.clip(turn, -np.pi / settings.angles, np.pi / settings.angles)
    return Candidates(xy, candidates.angle, tip, width, opening, turn, label, score * feasible)


def _first_contacts(H, window, level, u, cell) -> tuple[np.ndarray, np.ndarray]:
    """(N, V) where lines across the pads first meet matter over `level`, from either side.

    Lines that meet nothing hold +inf (left) and -inf (right).
    """
    matter = (level[:, None, None] < H) & window[..., None]
    hit = matter.any(axis=1)
    left = u[matter.argmax(axis=1)] - cell / 2
    right = u[len(u) - 1 - matter[:, ::-1].argmax(axis=1)] + cell / 2
    return np.where(hit, left, np.inf), np.where(hit, right, -np.inf)


def _face(gap: np.ndarray, v: np.ndarray, near: float = 0.008, touch: float = 0.0025):
    """Slope (N,) of the gap between pad and face (N, V) across the pad, and share (N,) in touch."""
    weight = (gap < near).astype(float)
    gap = np.where(gap < near, gap, 0.0)
    total = np.maximum(weight.sum(axis=1), 1)
    mean_v = (weight * v).sum(axis=1) / total
    spread = weight * (v - mean_v[:, None])
    variance = (spread * v).sum(axis=1)
    slope = (spread * gap).sum(axis=1) / np.where(variance > 1e-9, variance, np.inf)
    return slope, (weight * (gap < touch)).mean(axis=1)


def _palm_gap(
    xy, along, across, heights: HeightMap, gripper: GripperGeometry, step: float = 0.006
) -> np.ndarray:
    """(N,) smallest height of the palm's underside, fingertips at 0, over the scene in W."""
    # Samples lie `step` apart, so each must stand for the highest cell within step / sqrt(2); one
    # more cell for rounding to the grid.
    radius = int(np.ceil(step / np.sqrt(2) / heights.cell)) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    scene = cv2.dilate(heights.height, disc)
    ends = gripper.palm_half_length, gripper.palm_outline[-1][0]
    u, v = (np.linspace(-end, end, 2 * int(np.ceil(end / step)) + 1) for end in ends)
    grid = (
        xy[:, None, None]
        + u[:, None, None] * along[:, None, None]
        + v[:, None] * across[:, None, None]
    )
    return (gripper.palm_underside(v) - scene[heights.index(grid)]).min(axis=(1, 2))


class RandomPlanner:
    """Uniform over the pixels that lie above the table, at a random angle, fully open."""

    needs_truth = False

    def __init__(self, gripper: GripperGeometry, workspace: Workspace, seed: int, count: int = 20):
        self.gripper, self.workspace, self.count = gripper, workspace, count
        self.reset(seed)

    def reset(self, seed: int) -> None:
        self._random = np.random.default_rng(seed)

    def __call__(self, frame: RGBDFrame) -> list[Grasp]:
        points = frame.points().reshape(-1, 3)
        table, settings = self.workspace.table_height, SearchSettings()
        reach = self.workspace.size / 2 + settings.reach
        above = points[:, 2] > table + settings.min_engagement + settings.table_clearance
        above &= np.abs(points[:, :2] - self.workspace.centre).max(axis=1) < reach
        candidates = points[above]
        if len(candidates) == 0:
            return []
        lowest = table + settings.table_clearance + self.gripper.tip_below_centre
        grasps = []
        for quality in np.linspace(1, 0, self.count, endpoint=False):
            x, y, top = candidates[self._random.integers(len(candidates))]
            height = max(top - 0.02, lowest)  # the fingers reach 2 cm below the surface
            angle = self._random.uniform(0, np.pi)
            grasps.append(Grasp(np.array([x, y, height]), angle, self.gripper.max_opening, quality))
        return grasps


class HeuristicPlanner:
    """Antipodal search on the height map that the depth image gives; sees nothing else."""

    needs_truth = False

    def __init__(
        self,
        gripper: GripperGeometry,
        workspace: Workspace,
        seed: int = 0,
        settings: SearchSettings = SearchSettings(),
    ):
        self.gripper, self.workspace, self.settings = gripper, workspace, settings

    def reset(self, seed: int) -> None:
        """Nothing to do: the planner is deterministic."""

    def __call__(self, frame: RGBDFrame) -> list[Grasp]:
        heights = height_map_from_frame(frame, self.workspace)
        found = search(heights, self.gripper, self.workspace, self.settings)
        found = found.distinct(self.settings.returned, 0.01, np.deg2rad(20))
        return found.grasps(self.gripper)


class OraclePlanner:
    """The same search on the exact height map, then exact contacts under perturbed poses."""

    needs_truth = True

    def __init__(
        self,
        gripper: GripperGeometry,
        workspace: Workspace,
        seed: int = 0,
        settings: SearchSettings = SearchSettings(shortlist=1500, finalists=500),
        judged: int = 120,
    ):
        self.gripper, self.workspace, self.settings, self.judged = (
            gripper,
            workspace,
            settings,
            judged,
        )

    def reset(self, seed: int) -> None:
        """Nothing to do: the planner is deterministic."""

    def __call__(self, frame: RGBDFrame) -> list[Grasp]:
        if frame.truth is None:
            raise ValueError("The oracle planner needs frame.truth; this frame holds none")
        heights = height_map_from_scene(frame.truth, self.workspace)
        found = search(heights, self.gripper, self.workspace, self.settings)
        found = found.distinct(self.judged, 0.004, np.deg2rad(8))
        if len(found) == 0:
            return []
        quality = exact_quality(found, frame.truth, self.gripper)
        buried = buried_share(frame.truth, heights)
        # Antipodal ones first; if there is none, the best of the rest, by the map's measure.
        found.score = found.score * (0.01 + quality) * (1 - 0.7 * buried[found.label])
        found = found.best(len(found)).distinct(self.settings.returned, 0.01, np.deg2rad(20))
        return found.grasps(self.gripper)


def buried_share(scene: SceneGeometry, heights: HeightMap) -> np.ndarray:
    """(M,) share of each object's plan view that another object covers."""
    seen = np.bincount(heights.label[heights.label >= 0], minlength=len(scene.objects))
    whole = np.empty(len(scene.objects))
    workspace, margin = _square_of(heights)
    for number, thing in enumerate(scene.objects):
        alone = SceneGeometry((thing,), scene.table_height)
        whole[number] = (
            height_map_from_scene(alone, workspace, 2 * heights.cell, margin).label >= 0
        ).sum()
    return np.clip(1 - seen / np.maximum(4 * whole, 1), 0, 1)


def _square_of(heights: HeightMap) -> tuple[Workspace, float]:
    """The workspace (and zero margin) that a square height map covers."""
    side = heights.cell * (heights.height.shape[0] - 1)
    return Workspace(tuple(heights.origin + side / 2), side, heights.table_height), 0.0


# Pose errors under which a grasp should hold: (along, across) in metres, then angle in radians.
PERTURBATIONS = np.array(
    [(0, 0, 0)]
    + [(s * 0.005, 0, 0) for s in (-1, 1)]
    + [(0, s * 0.005, 0) for s in (-1, 1)]
    + [(0, 0, s * np.deg2rad(5)) for s in (-1, 1)]
)


def exact_quality(
    candidates: Candidates, scene: SceneGeometry, gripper: GripperGeometry
) -> np.ndarray:
    """(N,) in [0, 1]: contacts of the flat pads with the true solids, nominal and perturbed.

    A pose counts 0 unless both pads first meet the same object with normals inside the friction
    cone (Nguyen 1988: two soft contacts whose line lies in both cones close by force).
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
    value = _pad_contacts(
        centre.reshape(-1, 3), along.reshape(-1, 3), across.reshape(-1, 3),
        np.repeat(candidates.opening / 2, P), scene, gripper,
    ).reshape(N, P)  # fmt: skip
    return 0.4 * value[:, 0] + 0.4 * value[:, 1:].mean(axis=1) + 0.2 * value.min(axis=1)


def _pad_contacts(
    centre, along, across, half, scene: SceneGeometry, gripper: GripperGeometry
) -> np.ndarray:
    """(N,) quality in [0, 1] of pads that close along lines over their faces.

    centre: (N, 3) between the fingertips' lowest points; along, across: (N, 3); half: (N,).
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
    flat, directions = origins.reshape(-1, 3), np.repeat(along, L, axis=0)
    limit = np.repeat(half, L)
    # Travel of each pad from its open position to the first matter on each line, left then right.
    travel = np.full((2, N * L), np.inf)
    owner = np.full((2, N * L), -1)
    facing = np.zeros((2, N * L))
    for number, thing in enumerate(scene.objects):
        for solid in thing.solids:
            middle = (solid.vertices.max(axis=0) + solid.vertices.min(axis=0)) / 2
            radius = np.linalg.norm(solid.vertices - middle, axis=1).max()
            offset_ = middle - flat
            t = (offset_ * directions).sum(axis=1)
            close = np.linalg.norm(offset_ - t[:, None] * directions, axis=1) < radius
            lines = np.nonzero(close & (np.abs(t) < limit + radius))[0]
            if len(lines) == 0:
                continue
            hits = intersect_lines(solid, flat[lines], directions[lines])
            # A solid that lies wholly behind a pad, outside, is not between the fingers.
            between = hits.hit & (hits.leave > -limit[lines]) & (hits.enter < limit[lines])
            for side, (distance, normal, sign) in enumerate(
                ((hits.enter, hits.enter_normal, -1), (-hits.leave, hits.leave_normal, 1))
            ):
                distance = distance + limit[lines]
                better = between & (distance < travel[side, lines])
                chosen = lines[better]
                travel[side, chosen] = distance[better]
                owner[side, chosen] = number
                facing[side, chosen] = sign * (normal[better] * directions[chosen]).sum(axis=1)
    travel, owner, facing = (x.reshape(2, N, L) for x in (travel, owner, facing))

    first = travel.min(axis=2, keepdims=True)
    touch = travel < first + 0.0015
    share = touch.mean(axis=2)
    count = np.maximum(touch.sum(axis=2), 1)
    angle = np.arccos(np.clip((facing * touch).sum(axis=2) / count, -1, 1))
    held = np.take_along_axis(owner, travel.argmin(axis=2)[..., None], axis=2)
    alone = np.where(touch, owner == held, True).all(axis=2)
    point = (
        np.stack([(touch * offset).sum(axis=2), (touch * height).sum(axis=2)], axis=-1)
        / count[..., None]
    )
    good = (held[0] == held[1])[:, 0] & (held[0, :, 0] >= 0) & alone.all(axis=0)
    good &= (first[..., 0] > 0.0005).all(axis=0)  # a pad that starts inside matter has hit it
    held = held[0, :, 0]
    friction = np.array([thing.friction for thing in scene.objects])[held]
    cone = 0.9 * np.arctan(np.minimum(friction, 1.0))  # the fingers' own friction is 1
    worst = angle.max(axis=0)
    to_mass = np.array([thing.centre_of_mass for thing in scene.objects])[held] - centre
    arm = np.abs((to_mass * across).sum(axis=1) - point[..., 0].mean(axis=0))
    above = np.abs(to_mass[:, 2] - point[..., 1].mean(axis=0))
    value = np.exp(-((worst / (0.7 * cone)) ** 2)) * np.exp(
        -((arm / 0.02) ** 2) - (above / 0.06) ** 2
    )
    return value * (0.3 + 0.7 * np.minimum(share.min(axis=0) / 0.5, 1)) * good * (worst < cone)


PLANNERS: dict[str, Callable[..., Planner]] = {
    "random": RandomPlanner,
    "heuristic": HeuristicPlanner,
    "oracle": OraclePlanner,
}


def make_planner(name: str, gripper: GripperGeometry, workspace: Workspace, seed: int) -> Planner:
    """The planner of that name; `seed` starts its own random generator."""
    if name not in PLANNERS:
        raise ValueError(f"Unknown planner {name!r}; choose one of {', '.join(PLANNERS)}")
    return PLANNERS[name](gripper, workspace, seed)
