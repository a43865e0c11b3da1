"""Dense grasp labels: quality and opening for every pixel and angle bin, from the true geometry.

A label answers "what if the hand came straight down here?": fingertips at `grasp_depth` below the
pixel's surface point, closing line along the bin's image angle. All angles and pixels are judged on
an exact height map (vertical lines against the true solids), turned so that the closing line lies
along its rows: sliding maxima give what stands in the way of fingers and palm, rows of heights
give the contacts. Matter under an overhang counts as solid. Whoever decodes a grasp from a pixel
must use `grasp_below_surface`, so that hand and label agree on the depth.

This module knows no simulator and no network.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from utils.geometry import GripperGeometry, SceneGeometry, Workspace
from utils.height_map import HeightMap, height_map_from_scene
from utils.transforms import Grasp, ImageGrasp, RGBDFrame, image_to_grasp

ANGLE_BINS = 18  # bin k is centred at k * 10 degrees of ImageGrasp.angle


@dataclass(frozen=True)
class LabelSettings:
    """What makes a label; metres and radians unless said. The factors are Gaussian scales.

    Calibrated by executing labelled grasps on training scenes (see docs of the measurement).
    """

    depth: float = 0.025  # fingertips below the visible surface, where the table leaves room
    table_clearance: float = 0.004  # under the fingertips
    min_engagement: float = 0.006  # the surface must rise this far over the fingertips
    clearance: float = 0.003  # over whatever lies under fingers and palm
    room: float = 0.005  # between each finger and what it descends beside
    min_room: float = 0.003  # the same where neighbours or the largest opening leave no more
    side_margin: float = 0.002  # across, beside the fingers
    max_wedge: float = np.deg2rad(30)  # largest half angle between the faces, whatever the friction
    positive: float = 0.5  # labels of at least this quality count as successes


@dataclass(frozen=True)
class GraspLabels:
    """quality: (18, H, W) float32 in [0, 1], 0 where a grasp is infeasible.
    width: (18, H, W) float32 metres, the opening before closing; 0 where quality is 0.
    valid: (H, W) bool, the pixels that carry a label: depth known, within the map.
    """

    quality: np.ndarray
    width: np.ndarray
    valid: np.ndarray


def grasp_depth(surface_height, table_height: float, settings: LabelSettings = LabelSettings()):
    """How far the fingertips' lowest point goes below a visible surface (...), metres.

    `settings.depth`, but never nearer to the table than `settings.table_clearance`. Heights are z
    in W; accepts arrays. Not positive where nothing stands on the table.
    """
    lowest = table_height + settings.table_clearance
    return np.minimum(settings.depth, np.asarray(surface_height) - lowest)


def grasp_below_surface(
    grasp: ImageGrasp,
    K: np.ndarray,
    T_WC: np.ndarray,
    table_height: float,
    gripper: GripperGeometry,
    settings: LabelSettings = LabelSettings(),
) -> Grasp:
    """The world grasp that a label stands for; `grasp.depth` is that of the visible surface.

    Straight below the surface point by `grasp_depth`; the angle is that of `image_to_grasp`.
    """
    at_surface = image_to_grasp(grasp, K, T_WC)
    position = at_surface.position.copy()
    position[2] -= float(grasp_depth(position[2], table_height, settings))
    position[2] += gripper.tip_below_centre
    return replace(at_surface, position=position)


def bin_angles() -> np.ndarray:
    """(18,) image angles of the bins' centres, radians."""
    return np.arange(ANGLE_BINS) * np.pi / ANGLE_BINS


def dense_labels(
    frame: RGBDFrame,
    gripper: GripperGeometry,
    workspace: Workspace,
    settings: LabelSettings = LabelSettings(),
    cell: float = 0.001,
    margin: float = 0.08,
) -> GraspLabels:
    """Labels of every pixel and angle bin of a noise-free frame that carries its true geometry.

    cell: resolution along the closing line, metres. margin: how far outside the workspace grasps
    are labelled. Raises ValueError when the frame holds no truth.

    Angles are judged in steps of 10 degrees in W from bin 0 at the principal point. For a camera
    that looks straight down these are the bins; for another one each pixel takes the nearest.
    """
    if frame.truth is None:
        raise ValueError("dense_labels needs frame.truth; this frame holds none")
    points = frame.points()
    with np.errstate(invalid="ignore"):
        reach = np.abs(points[..., :2] - workspace.centre).max(axis=-1)
        valid = reach < workspace.size / 2 + margin - cell
        rise = points[..., 2] - frame.truth.table_height
        active = valid & (rise > settings.table_clearance + settings.min_engagement)
    quality = np.zeros((ANGLE_BINS, *valid.shape), np.float32)
    width = np.zeros_like(quality)
    v, u = np.nonzero(active)
    if len(u) and frame.truth.objects:
        heights = height_map_from_scene(frame.truth, workspace, cell, margin)
        start, step, turn_of_bin = _world_turns(frame, u, v)
        surface = points[v, u]
        judged = np.stack([
            _judge(surface, start + k * step, heights, frame.truth, gripper, settings)
            for k in range(ANGLE_BINS)
        ])  # fmt: skip
        found = judged[turn_of_bin, :, np.arange(len(u))]  # (18, N, 2)
        quality[:, v, u], width[:, v, u] = found[..., 0], found[..., 1]
    return GraspLabels(quality, width, valid)


def _world_turns(frame: RGBDFrame, u: np.ndarray, v: np.ndarray) -> tuple[float, float, np.ndarray]:
    """World angle of bin 0 at the principal point, the signed step to the next bin, and (18, N)
    which of those 18 world angles is nearest to each bin at each pixel."""
    K, bins = frame.K, bin_angles()
    u, v = np.append(u, K[0, 2]), np.append(v, K[1, 2])
    centre = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(len(u))], axis=-1)
    along = np.stack([np.cos(bins) / K[0, 0], np.sin(bins) / K[1, 1], np.zeros(len(bins))], axis=-1)
    # As in `image_to_grasp`: the plane of the image line cut with the horizontal plane.
    normal = np.cross(centre, along[:, None]) @ frame.T_WC[:3, :3].T
    angle = np.arctan2(-normal[..., 0], normal[..., 1])
    start = angle[0, -1]
    step = np.copysign(np.pi / ANGLE_BINS, np.sin(2 * (angle[1, -1] - start)))
    turns = np.rint((angle[:, :-1] - start) / step).astype(int)
    return start, step, np.mod(turns, ANGLE_BINS)


@dataclass(frozen=True)
class _TurnedMap:
    """The height map with the closing line along its rows: [row, col] lies at
    (col - columns // 2) * cell along and (row - rows // 2) * 2 * cell across the map's centre."""

    height: np.ndarray
    label: np.ndarray
    cell: float

    @staticmethod
    def of(heights: HeightMap, along: np.ndarray, across: np.ndarray) -> _TurnedMap:
        count, cell = heights.height.shape[0], heights.cell
        middle = (count - 1) / 2
        columns, rows = (2 * int(0.54 * n) + 1 for n in (count, count / 2))
        axes = np.column_stack([along, 2 * across])
        offset = middle - axes @ (columns // 2, rows // 2)
        warp = np.column_stack([axes, offset])
        flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
        height = cv2.warpAffine(
            heights.height, warp, (columns, rows), flags=flags, borderValue=heights.table_height
        )
        label = cv2.warpAffine(
            heights.label.astype(np.int16), warp, (columns, rows), flags=flags, borderValue=-1
        )
        return _TurnedMap(height, label, cell)

    def highest(self, left: float, right: float, half_across: float) -> np.ndarray:
        """Sliding maximum from `left` to `right` metres along and +-half_across metres across."""
        first, last = round(left / self.cell), round(right / self.cell)
        rows = int(np.ceil(half_across / (2 * self.cell) - 0.25))
        kernel = np.ones((2 * rows + 1, last - first + 1), np.uint8)
        return cv2.dilate(self.height, kernel, anchor=(-first, rows))


def _judge(
    surface: np.ndarray,
    angle: float,
    heights: HeightMap,
    scene: SceneGeometry,
    gripper: GripperGeometry,
    settings: LabelSettings,
) -> np.ndarray:
    """(2, N) quality and width of grasps at surface points (N, 3) in W closing along `angle`."""
    along = np.array([np.cos(angle), np.sin(angle)])
    across = np.array([-along[1], along[0]])
    turned = _TurnedMap.of(heights, along, across)
    rows, columns = turned.height.shape
    middle = heights.origin + heights.cell * (heights.height.shape[0] - 1) / 2
    place = surface[:, :2] - middle
    column = np.rint(place @ along / turned.cell).astype(np.int32) + columns // 2
    row = np.rint(place @ across / (2 * turned.cell)).astype(np.int32) + rows // 2
    tip = (surface[:, 2] - grasp_depth(surface[:, 2], heights.table_height, settings)).astype(
        np.float32
    )
    result = np.zeros((2, len(surface)), np.float32)

    limit = tip - settings.clearance
    inside = (column > 45) & (column < columns - 46) & (row > 5) & (row < rows - 6)
    place_ = np.nonzero(inside)[0]
    free = _palm_sill(turned, gripper)[row[place_] // 2, column[place_] // 4] <= limit[place_]
    index = place_[free]
    index, half = _smallest_opening(turned, row, column, limit, index, gripper, settings)
    if len(index) == 0:
        return result
    result[0, index] = _contact_quality(
        turned, row[index], column[index], tip[index], surface[index], half, along, across,
        heights, scene, gripper, settings,
    )  # fmt: skip
    result[1, index] = np.where(result[0, index] > 0, 2 * half, 0)
    return result
