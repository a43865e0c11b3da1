"""Grasp quality on an exact height map: how good is a grasp if the open hand comes straight down?

The height map is turned so that the closing line runs along its rows. Sliding maxima then give the
obstacles under fingers and palm, rows of heights give the contacts of the pads. Space under an
overhang counts as matter for the descent, and for the contacts down to the lowest point of the
object. `grasp_quality` multiplies Gaussian factors of angles and lever arms into one number; dense
labels (`utils.grasp_labels`) and the environment's goals are made of it. The antipodal search
(`models.planner_measure`) shares `contact_levels`, `fit_faces` and the relaxed margins, but has
a score of its own. This module knows no camera, no simulator and no network.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np

from utils.compiled import compiled
from utils.geometry import GripperGeometry, SceneGeometry, intersect_lines
from utils.height_map import HeightMap

_RIM = 0.004  # m of map beyond the hand around every grasp
_SMALLEST_HALF = 0.004  # m, half the smallest opening that is tried
NEAR_FACE = 0.008  # m, lines across the pad within this gap belong to the face that is fitted
TOUCH = 0.0025  # m, and those within this gap touch it
_NOTHING = np.iinfo(np.int16).min  # in place of the label of what a line touches


class RelaxedMargins(NamedTuple):
    """Margins for objects that no grasp with the usual margins fits: objects on slopes or between
    others need less room and a wider wedge, objects as flat as a pencil less height."""

    table_clearance: float = 0.002  # m, under the fingertips
    clearance: float = 0.001  # m, over whatever lies under fingers and palm
    room: float = 0.003  # m, beside each contact when the hand is open
    min_engagement: float = 0.003  # m that the object must rise over the fingertips
    max_wedge: float = np.deg2rad(38)  # half the angle between the two faces


RELAXED = RelaxedMargins()


@dataclass(frozen=True)
class LabelSettings:
    """Margins and scales of grasp quality; metres and radians unless said.

    The defaults were chosen by executing labelled grasps on training scenes, which
    `python -m benchmarks.bench_labels` repeats: of quality `positive` and above, 93 % succeed
    (docs/graspnet.md). The depth is a compromise: deeper grips better, shallower reaches more of a
    pile (at 2 cm 76 of 84 objects in 20 scenes have a feasible grasp; at 1.5 cm 77, at 2.5 cm 73).
    """

    depth: float = 0.020  # fingertips below the visible surface, where the table leaves room
    table_clearance: float = 0.004  # under the fingertips
    min_engagement: float = 0.006  # the surface must rise this far over the fingertips
    clearance: float = 0.002  # over whatever lies under fingers and palm
    room: float = 0.005  # between each open finger and what it descends beside
    min_room: float = 0.002  # the same where neighbours or the largest opening leave no more
    side_margin: float = 0.001  # across, beside the fingers
    max_wedge: float = np.deg2rad(30)  # half the angle between the faces, whatever the friction
    # Scales of the Gaussian factors of quality.
    wedge_scale: float = 0.35
    turn_scale: float = 0.30
    tilt_scale: float = 0.50
    mass_across_scale: float = 0.030
    mass_along_scale: float = 0.080
    mass_up_scale: float = 0.080
    off_centre_scale: float = 0.025
    positive: float = 0.6  # labels of at least this quality count as grasps that succeed

    def relaxed(self) -> LabelSettings:
        """The settings with `RELAXED` margins and wider Gaussians for wedge and tilt."""
        return replace(self, **RELAXED._asdict(), wedge_scale=0.6, tilt_scale=1.0)


def grasp_depth(surface_height, table_height: float, settings: LabelSettings = LabelSettings()):
    """The depth of the fingertips' lowest point below a visible surface (...), metres.

    `settings.depth`, but never nearer to the table than `settings.table_clearance`. Heights are z
    in W; accepts arrays. Not positive where nothing stands on the table.
    """
    lowest = table_height + settings.table_clearance
    return np.minimum(settings.depth, np.asarray(surface_height) - lowest)


def undersides(scene: SceneGeometry, heights: HeightMap) -> np.ndarray:
    """(R, C) float32 lowest matter, z in W, of the object that is on top in each cell; the table's
    height where no object is. Pads meet nothing below it."""
    under = np.full(heights.height.shape, np.inf)
    for number, item in enumerate(scene.objects):
        for solid in item.solids:
            low, high = solid.vertices[:, :2].min(axis=0), solid.vertices[:, :2].max(axis=0)
            (top, bottom), (left, right) = (heights.index(np.stack([low, high]))[i] for i in (0, 1))
            label = heights.label[top : bottom + 1, left : right + 1]
            row, column = (
                at + first for at, first in zip(np.nonzero(label == number), (top, left))
            )
            if len(row) == 0:
                continue
            xy = heights.origin + heights.cell * np.stack([column, row], axis=-1)
            lines = np.column_stack([xy, np.zeros(len(xy))])
            enter = intersect_lines(solid, lines, (0.0, 0.0, 1.0)).enter
            under[row, column] = np.minimum(under[row, column], enter)
    return np.where(np.isfinite(under), under, heights.table_height).astype(np.float32)


@dataclass(frozen=True)
class _TurnedMap:
    """The height map around some points, with the closing line along its rows.

    Steps are `cell` along (columns) and 2 * cell across (rows). height, label: (R, C). row, column:
    (N,) int32, where the points lie; there are `reach` metres of map on all sides of them.
    """

    height: np.ndarray
    under: np.ndarray
    label: np.ndarray
    row: np.ndarray
    column: np.ndarray
    cell: float

    @staticmethod
    def around(
        xy: np.ndarray,
        heights: HeightMap,
        under: np.ndarray,
        along: np.ndarray,
        across: np.ndarray,
        reach: float,
    ) -> _TurnedMap:
        cell, middle = heights.cell, (heights.height.shape[0] - 1) / 2
        from_middle = (xy - heights.origin) / cell - middle
        column = np.rint(from_middle @ along).astype(np.int32)
        row = np.rint(from_middle @ across / 2).astype(np.int32)
        rim = int(reach / cell)
        first_column, first_row = column.min() - rim, row.min() - rim // 2
        column, row = column - first_column, row - first_row
        size = (int(column.max()) + rim + 1, int(row.max()) + rim // 2 + 1)
        warp = np.column_stack(
            [along, 2 * across, middle + first_column * along + 2 * first_row * across]
        )
        flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
        height, under, label = (
            cv2.warpAffine(image, warp, size, flags=flags, borderValue=outside)
            for image, outside in (
                (heights.height, heights.table_height),
                (under, heights.table_height),
                (heights.label.astype(np.int16), -1),
            )
        )
        return _TurnedMap(height, under, label, row, column, cell)

    def highest(self, left: float, right: float, half_across: float) -> np.ndarray:
        """(R, C) sliding maximum from `left` to `right` along and +-half_across across, metres."""
        first, last = round(left / self.cell), round(right / self.cell)
        rows = int(np.ceil(half_across / (2 * self.cell) - 0.25))
        kernel = np.ones((2 * rows + 1, last - first + 1), np.uint8)
        return cv2.dilate(self.height, kernel, anchor=(-first, rows))

    def at(self, image: np.ndarray, index: np.ndarray, rows, columns) -> np.ndarray:
        """Values (M, ...) of an (R, C) image at the points `index` (M,), moved by whole rows and
        columns, each of shape (1, ...) or (M, ...)."""
        shift = np.asarray(rows * image.shape[1] + columns)
        flat = self.row[index] * image.shape[1] + self.column[index]
        return np.take(image, flat.reshape(-1, *(1,) * (shift.ndim - 1)) + shift)


@dataclass(frozen=True)
class GraspQuality:
    """The quality of N grasps; lengths in metres.

    quality: (N,) in [0, 1], 0 for an infeasible grasp. half: (N,) half the opening of the hand
    that comes down, 0 for an infeasible grasp. widest: (N,) half the widest opening for which all
    openings from `half` on are free. middle, reach: (N,) the middle between the contacts along the
    closing line, measured from the grasp's surface point, and half the distance between them.
    """

    quality: np.ndarray
    half: np.ndarray
    widest: np.ndarray
    middle: np.ndarray
    reach: np.ndarray


def grasp_quality(
    surface: np.ndarray,
    angle: float,
    heights: HeightMap,
    under: np.ndarray,
    scene: SceneGeometry,
    gripper: GripperGeometry,
    settings: LabelSettings,
) -> GraspQuality:
    """The quality of grasps at surface points (N, 3) in W that close along the world angle `angle`.

    Each grasp counts by itself. under: the result of `undersides`.
    """
    along = np.array([np.cos(angle), np.sin(angle)])
    across = np.array([-along[1], along[0]])
    finger_end = gripper.max_opening / 2 + gripper.finger_outline[-1][0]
    reach = max(gripper.palm_half_length, finger_end) + _RIM
    turned = _TurnedMap.around(surface[:, :2], heights, under, along, across, reach)
    depth = grasp_depth(surface[:, 2], heights.table_height, settings)
    tip = (surface[:, 2] - depth).astype(np.float32)
    limit = tip - settings.clearance

    palm = _palm_sill(turned, gripper)
    index = np.nonzero(palm[turned.row // 2, turned.column // 4] <= limit)[0]
    index, half, widest = _opening(turned, index, limit, gripper, settings)
    found = GraspQuality(*np.zeros((5, len(surface)), np.float32))
    if len(index) == 0:
        return found
    face = _faces(turned, index, tip[index], half, gripper)
    offset = heights.centres[face.label] - np.column_stack([surface[index, :2], tip[index]])
    friction = np.array([item.friction for item in scene.objects])[face.label]
    quality = _quality(
        face, offset[:, :2] @ along, offset[:, :2] @ across, offset[:, 2], friction, half,
        gripper, settings,
    )  # fmt: skip
    some = quality > 0
    index, left, right = index[some], face.left[some], face.right[some]
    found.quality[index] = quality[some]
    found.half[index], found.widest[index] = half[some], widest[some]
    found.middle[index], found.reach[index] = (left + right) / 2, (right - left) / 2
    return found


def _palm_sill(turned: _TurnedMap, gripper: GripperGeometry) -> np.ndarray:
    """(R / 2, C / 4) height in W above which the fingertips must stay so that the palm is clear."""
    rows, columns = (n - n % k for n, k in zip(turned.height.shape, (2, 4)))
    coarse = turned.height[:rows, :columns].reshape(rows // 2, 2, columns // 4, 4).max(axis=(1, 3))
    length = 2 * int(np.ceil(gripper.palm_half_length / (4 * turned.cell))) + 1
    sills, inner = [], 0.0
    for outer in (gripper.palm_outline[2][0], 0.025, gripper.palm_outline[-1][0]):
        wide = 2 * int(np.ceil(outer / (4 * turned.cell))) + 1
        sills.append(
            cv2.dilate(coarse, np.ones((wide, length), np.uint8)) - gripper.palm_underside(inner)
        )
        inner = outer
    sill = np.maximum.reduce(sills)
    return np.pad(sill, ((0, 1), (0, 1)), mode="edge").astype(np.float32)


def _finger_sills(
    turned: _TurnedMap, gripper: GripperGeometry, settings: LabelSettings
) -> tuple[np.ndarray, np.ndarray]:
    """(R, C) each: height in W above which the fingertips must stay if the left (right) pad's face
    comes down at that cell; includes `min_room` on the face's side."""
    half = gripper.finger_half_width + settings.side_margin
    outline = np.array(gripper.finger_outline)[:, 0]
    ends = (outline[2] + 0.0015, 0.020, 0.023, outline[-1])
    left, right, start = [], [], 0.0
    for end in ends:
        above = np.float32(gripper.finger_underside(start))
        right.append(turned.highest(-settings.min_room, end, half) - above)
        left.append(turned.highest(-end, settings.min_room, half) - above)
        start = end
    return np.maximum.reduce(left), np.maximum.reduce(right)


def _opening(
    turned: _TurnedMap,
    index: np.ndarray,
    limit: np.ndarray,
    gripper: GripperGeometry,
    settings: LabelSettings,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The points of `index` (M,) where both fingers can come down, half the smallest opening, and
    half the widest one up to which all are free.

    The smallest opening has `min_room` beside each finger. It grows towards `room` as far as the
    fingers stay clear and the hand opens.
    """
    left, right = _finger_sills(turned, gripper, settings)
    last = round(gripper.max_opening / 2 / turned.cell)
    steps = np.arange(int(_SMALLEST_HALF / turned.cell), last + 1, dtype=np.int32)
    at_left = turned.at(left, index, 0, -steps[None])
    sill = np.maximum(at_left, turned.at(right, index, 0, steps[None]))
    clear = sill <= limit[index, None]
    some = clear.any(axis=1)
    index, clear = index[some], clear[some]
    rows, first = np.arange(len(index)), clear.argmax(axis=1)
    chosen, open_ = first, np.ones(len(index), bool)
    for more in range(1, round((settings.room - settings.min_room) / turned.cell) + 1):
        wider = np.minimum(first + more, len(steps) - 1)
        open_ &= clear[rows, wider]
        chosen = np.where(open_, wider, chosen)
    blocked = ~clear & (steps > steps[first][:, None])
    widest = np.where(blocked.any(axis=1), blocked.argmax(axis=1) - 1, len(steps) - 1)
    # Half a cell from centres to edges, and a quarter that the worse of two rounded sides adds.
    return index, *(
        ((steps[at] - 0.75) * turned.cell).astype(np.float32) for at in (chosen, widest)
    )


@dataclass(frozen=True)
class _Faces:
    """The faces that the closing pads of M grasps meet; lengths in metres, angles in radians.

    touched: (M,) both pads meet matter of one object, `label`. left, right: (M,) the contacts along
    the closing line from the pixel. engagement: how far the matter between rises over the tips.
    wedge: half the angle between the faces in plan view. turn: mean angle of the faces to the pads.
    tilt: mean angle of the faces from the vertical. cover: smaller share of a pad in touch.
    """

    touched: np.ndarray
    label: np.ndarray
    left: np.ndarray
    right: np.ndarray
    engagement: np.ndarray
    wedge: np.ndarray
    turn: np.ndarray
    tilt: np.ndarray
    cover: np.ndarray


def _faces(
    turned: _TurnedMap,
    index: np.ndarray,
    tip: np.ndarray,
    half: np.ndarray,
    gripper: GripperGeometry,
) -> _Faces:
    """Lines along the closing direction, spread over the pad's width, against the height map."""
    cell = turned.cell
    reach = round(float(half.max()) / cell)
    steps = np.arange(-reach, reach + 1, dtype=np.int32)
    spread = np.linspace(-1, 1, 5) * 0.92 * gripper.pad_half_width
    lines = np.rint(spread / (2 * cell)).astype(np.int32)
    v = lines * np.float32(2 * cell)
    height = turned.at(turned.height, index, lines[None, :, None], steps)  # (M, 5, S)
    under = turned.at(turned.under, index, lines[None, :, None], steps)
    met = under < (tip + 0.6 * gripper.pad_height)[:, None, None]  # not under an overhang
    met &= np.abs(steps * cell) < half[:, None, None]
    height = np.where(met, height, -np.inf)
    engagement = height.max(axis=(1, 2)) - tip
    lower, upper = contact_levels(tip, engagement)
    low, high = (_first_matter(height, level) for level in (lower, upper))
    offset = (steps - np.float32(0.5)) * np.float32(cell)
    at_low, at_high = (
        (np.where(hit, offset[first], np.inf), np.where(hit, offset[last] + cell, -np.inf))
        for hit, first, last in (low, high)
    )
    left, right = at_low[0].min(axis=1), at_low[1].max(axis=1)
    touched = low[0].any(axis=1) & high[0].any(axis=1)
    left, right = np.where(touched, left, 0.0), np.where(touched, right, 0.0)
    gaps = at_low[0] - left[:, None], right[:, None] - at_low[1]
    turn, wedge, cover = fit_faces(*gaps, v)
    cover = cover.astype(np.float32)  # as all that the labels store
    rise = upper - tip - 0.001
    back_left = np.maximum(at_high[0].min(axis=1) - left, 0)
    back_right = np.maximum(right - at_high[1].max(axis=1), 0)
    with np.errstate(invalid="ignore"):
        tilt = (np.arctan2(back_left, rise) + np.arctan2(back_right, rise)) / 2
    inner = np.int32(2)
    labels = np.concatenate([
        np.where(
            gap < TOUCH, turned.at(turned.label, index, lines[None], steps[end] + inward), _NOTHING
        )
        for gap, end, inward in zip(gaps, low[1:], (inner, -inner))
    ], axis=1)  # fmt: skip
    label = np.maximum(labels.max(axis=1), 0)
    touched &= ((labels == label[:, None]) | (labels == _NOTHING)).all(axis=1)
    return _Faces(
        touched, label, left, right, engagement, wedge, turn, tilt, cover,
    )  # fmt: skip


def _first_matter(height: np.ndarray, level: np.ndarray) -> tuple[np.ndarray, ...]:
    """Whether lines (M, L, S) rise over a level (M,), and the first and last place, (M, L) each."""
    matter = height > level[:, None, None]
    first = matter.argmax(axis=2)
    last = height.shape[2] - 1 - matter[:, :, ::-1].argmax(axis=2)
    return matter.any(axis=2), first, last


def contact_levels(tip: np.ndarray, engagement: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two heights (...) in W at which the contacts of the pads are looked for: just over the
    fingertips `tip`, and up to 8 mm higher, within the `engagement` of the object."""
    return tip + 0.001, tip + 0.5 * engagement.clip(0.002, 0.016)


def fit_faces(
    left_gap: np.ndarray, right_gap: np.ndarray, v: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """How flat pads lie on the two faces that they meet: turn, wedge and cover, each (N,).

    left_gap, right_gap: (N, L) metres between pad and matter on L lines across each pad, at the
    places v (L,). turn: rotation of the hand, radians, that would bring both pads flat onto the
    faces. wedge: half the angle between the faces in plan view. cover: smaller share of a pad's
    lines in touch.
    """
    (left, left_cover), (right, right_cover) = (_fit_face(gap, v) for gap in (left_gap, right_gap))
    left, right = np.arctan(left), np.arctan(right)
    return -(left - right) / 2, np.abs(left + right) / 2, np.minimum(left_cover, right_cover)


@compiled
def _fit_face(gap: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Slope (N,) of the gaps (N, L) over the places v (L,), by least squares over those under
    `NEAR_FACE`; and the share (N,) of lines in touch."""
    slope, cover = np.zeros(len(gap)), np.zeros(len(gap))
    near, touch = gap.dtype.type(NEAR_FACE), gap.dtype.type(TOUCH)
    for i in range(len(gap)):
        count, total = 0, 0.0
        for k in range(len(v)):
            if gap[i, k] < near:
                count += 1
                total += v[k]
                cover[i] += gap[i, k] < touch
        cover[i] /= len(v)
        mean, variance, together = total / max(count, 1), 0.0, 0.0
        for k in range(len(v)):
            if gap[i, k] < near:
                variance += (v[k] - mean) * v[k]
                together += (v[k] - mean) * gap[i, k]
        if variance > 1e-9:
            slope[i] = together / variance
    return slope, cover


def _quality(
    face: _Faces,
    mass_along: np.ndarray,
    mass_across: np.ndarray,
    mass_up: np.ndarray,
    friction: np.ndarray,
    half: np.ndarray,
    gripper: GripperGeometry,
    settings: LabelSettings,
) -> np.ndarray:
    """(M,) in [0, 1]: 0 unless both pads press on one object inside its friction cone (Nguyen 1988,
    two soft contacts; the fingers' own friction is 1), else the product of all factors.

    mass_*: (M,) the held object's centre of mass, seen from between the fingertips' lowest points.
    """
    middle = (face.left + face.right) / 2
    room = half - np.maximum(-face.left, face.right)
    cone = np.minimum(np.arctan(friction), settings.max_wedge)
    quality = np.exp(
        -((face.wedge / settings.wedge_scale) ** 2)
        - (face.turn / settings.turn_scale) ** 2
        - (face.tilt / settings.tilt_scale) ** 2
        - (mass_across / settings.mass_across_scale) ** 2
        - ((mass_along - middle) / settings.mass_along_scale) ** 2
        - ((mass_up - gripper.pad_height / 2) / settings.mass_up_scale) ** 2
        - (middle / settings.off_centre_scale) ** 2
    )
    quality *= 0.6 + 0.4 * face.cover
    quality *= np.clip(face.engagement / settings.depth, 0.4, 1)
    quality *= np.interp(room, (settings.min_room, settings.room), (0.8, 1.0))
    feasible = face.touched & (face.engagement >= settings.min_engagement)
    feasible &= (face.wedge < cone) & (face.tilt < cone)
    return np.where(feasible, quality, 0)
