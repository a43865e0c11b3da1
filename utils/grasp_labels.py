"""Dense grasp labels from the true geometry, and their comparison with executed grasps.

A label holds quality and opening for every pixel and angle bin. It predicts the outcome of a hand
that comes straight down: fingertips `grasp_depth` below the pixel's surface point, closing line
along the bin's image angle. `utils.grasp_quality` computes it on the exact height map (vertical
lines against the true solids). Code that converts a pixel to a grasp must use
`grasp_below_surface`, so that hand and label agree on the depth. A share of the labelled pairs
(pixel, angle) is executed by the arm; `label_truth` computes precision and recall from these
trials. This module knows no simulator and no network.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from utils.geometry import GripperGeometry, Workspace
from utils.grasp_quality import LabelSettings, grasp_depth, grasp_quality, undersides
from utils.height_map import height_map_from_scene
from utils.statistics import clustered_interval
from utils.transforms import Grasp, ImageGrasp, RGBDFrame, image_to_grasp

SETTINGS = LabelSettings()
_ROBOT = -2  # in RGBDFrame.segmentation
ANGLE_BINS = 18  # bin k is centred at k * 10 degrees of ImageGrasp.angle
STRATA = (0.0, 1e-6, 0.3, 0.5, 0.6, 0.7, 0.8, 1.01)  # edges in quality
CELL = 0.001  # m, along the closing line
MARGIN = 0.08  # m outside the workspace, up to which grasps are labelled
PER_STRATUM = 3  # pairs drawn from each stratum of a frame; twice as many of quality 0


@dataclass(frozen=True)
class GraspLabels:
    """Labels of one frame.

    quality: (18, H, W) float32 in [0, 1], 0 where a grasp is infeasible. Its cube is the product of
    all factors: contacts, lever arms, margins, and feasible pixels and bins around. width: (18, H,
    W) float32 metres, the opening before closing; 0 where quality is 0. valid: (H, W) bool, the
    pixels that carry a label: depth known, within the map.
    """

    quality: np.ndarray
    width: np.ndarray
    valid: np.ndarray


def grasp_below_surface(
    grasp: ImageGrasp,
    K: np.ndarray,
    T_WC: np.ndarray,
    table_height: float,
    gripper: GripperGeometry,
    settings: LabelSettings = SETTINGS,
) -> Grasp:
    """Return the grasp in W that a label describes; `grasp.depth` is that of the visible surface.

    The fingertips are `grasp_depth` straight below the surface point; the angle is that of
    `image_to_grasp`.
    """
    at_surface = image_to_grasp(grasp, K, T_WC)
    position = at_surface.position.copy()
    position[2] -= float(grasp_depth(position[2], table_height, settings))
    position[2] += gripper.tip_below_centre
    return replace(at_surface, position=position)


def bin_angles() -> np.ndarray:
    """Return the (18,) image angles of the bins' centres, radians."""
    return np.arange(ANGLE_BINS) * np.pi / ANGLE_BINS


def dense_labels(frame: RGBDFrame, gripper: GripperGeometry, workspace: Workspace) -> GraspLabels:
    """Label every pixel and angle bin of a noise-free frame that carries its true geometry. Raises
    ValueError if the frame holds no truth.

    Table pixels have quality 0, because a grasp is centred on its object; robot pixels are not
    valid. Angles are computed in steps of 10 degrees in W from bin 0 at the principal point. These
    are the bins of a camera that looks straight down; for another camera each pixel takes the
    nearest angle.
    """
    if frame.truth is None:
        raise ValueError("dense_labels needs frame.truth; this frame holds none")
    points = frame.points()
    with np.errstate(invalid="ignore"):
        reach = np.abs(points[..., :2] - workspace.centre).max(axis=-1)
        valid = reach < workspace.size / 2 + MARGIN - CELL
        if frame.segmentation is not None:
            valid &= frame.segmentation != _ROBOT
        rise = points[..., 2] - frame.truth.table_height
        active = valid & (rise > SETTINGS.table_clearance + SETTINGS.min_engagement)
        if frame.segmentation is not None:
            active &= frame.segmentation >= 0  # walls are part of the table
    quality = np.zeros((ANGLE_BINS, *valid.shape), np.float32)
    width = np.zeros_like(quality)
    v, u = np.nonzero(active)
    if len(u) and frame.truth.objects:
        # A quarter of a cell more makes the count odd: a cell, not a corner, in the middle.
        heights = height_map_from_scene(frame.truth, workspace, CELL, MARGIN + CELL / 4)
        under = undersides(frame.truth, heights)
        start, step, turn_of_bin = _world_turns(frame, u, v)
        surface = points[v, u]
        judged = [
            grasp_quality(surface, start + k * step, heights, under, frame.truth, gripper, SETTINGS)
            for k in range(ANGLE_BINS)
        ]
        each = np.arange(len(u))
        quality[:, v, u] = np.stack([found.quality for found in judged])[turn_of_bin, each]
        width[:, v, u] = 2 * np.stack([found.half for found in judged])[turn_of_bin, each]
        quality = np.cbrt(quality * (0.6 + 0.4 * _support(quality > 0)))
    return GraspLabels(quality, width, valid)


def _support(feasible: np.ndarray) -> np.ndarray:
    """Return the share (18, H, W) of the 3 x 3 pixels and 3 bins around that are feasible, too."""
    share = np.stack([cv2.blur(plane, (3, 3)) for plane in feasible.astype(np.float32)])
    return (np.roll(share, 1, axis=0) + share + np.roll(share, -1, axis=0)) / 3


def _world_turns(frame: RGBDFrame, u: np.ndarray, v: np.ndarray) -> tuple[float, float, np.ndarray]:
    """Return the angle in W of bin 0 at the principal point, the signed step to the next bin, and
    the index (18, N) of the nearest of those 18 angles for each bin at each pixel."""
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


# --- Executed labels ------------------------------------------------------------------------


@dataclass(frozen=True)
class Trial:
    """One executed pair (pixel, angle); it represents `weight` pairs of its frame and stratum."""

    quality: float
    weight: float
    success: bool


def draw_pairs(
    frame: RGBDFrame, labels: GraspLabels, gripper: GripperGeometry, rng: np.random.Generator
) -> Iterator[tuple[Grasp, float, float]]:
    """Yield grasps of pairs drawn from every stratum of quality, with their quality and weight.

    Pairs of quality 0 come from the objects' pixels and are executed with the hand wide open.
    """
    settings = SETTINGS
    lowest = settings.table_clearance + settings.min_engagement
    rise = frame.points()[..., 2] - frame.truth.table_height
    on_object = labels.valid & (frame.segmentation >= 0) & (rise > lowest)
    quality = np.where(on_object, labels.quality, -1)
    for low, high in zip(STRATA, STRATA[1:]):
        members = np.flatnonzero((quality >= low) & (quality < high))
        count = min(len(members), PER_STRATUM * (2 if low == 0 else 1))
        for flat in rng.choice(members, count, replace=False) if count else ():
            k, v, u = np.unravel_index(flat, quality.shape)
            at_surface = ImageGrasp(
                np.array([u, v]),
                bin_angles()[k],
                float(frame.depth[v, u]),
                float(labels.width[k, v, u]) or gripper.max_opening,
                0.0,
            )
            grasp = grasp_below_surface(
                at_surface, frame.K, frame.T_WC, frame.truth.table_height, gripper, settings
            )
            yield grasp, float(quality[k, v, u]), len(members) / count


@dataclass(frozen=True)
class LabelTruth:
    """Precision and recall of positive labels (quality `LabelSettings.positive` and above).

    executed, positives: the number of executed pairs, and of the positive ones among them.
    precision: of the drawn pairs, with its 95 % interval, for which those of one scene are not
    independent. precision_weighted, recall_weighted: over
    all pairs of the frames. by_stratum: (low, high, executed, success rate) in quality.
    """

    executed: int
    positives: int
    precision: float
    precision_ci95: tuple[float, float]
    precision_weighted: float
    recall_weighted: float
    by_stratum: tuple[tuple[float, float, int, float], ...]

    def describe(self) -> str:
        """Describe precision and recall in one line."""
        low, high = self.precision_ci95
        return (
            f"labels against physics: {self.executed} executed, {100 * self.precision:.1f} % "
            f"[{100 * low:.1f}, {100 * high:.1f}] of the {self.positives} positive ones succeed; "
            f"{100 * self.recall_weighted:.0f} % of all grasps that would succeed are positive "
            "(labels are strict)"
        )


def label_truth(groups: Sequence[Sequence[Trial]]) -> LabelTruth:
    """Compute precision and recall of the labels from the trials of each scene, or of whole
    scenes together, such as a shard's; NaN where none was executed."""
    trials = [trial for group in groups for trial in group]
    least = SETTINGS.positive
    positive = [t for t in trials if t.quality >= least]
    hits = sum(t.success for t in positive)
    good = sum(t.weight for t in trials if t.success)
    caught = sum(t.weight for t in positive if t.success)
    of_groups = [[t.success for t in group if t.quality >= least] for group in groups]
    strata = [
        (low, high, [t.success for t in trials if low <= t.quality < high])
        for low, high in zip(STRATA, STRATA[1:])
    ]
    return LabelTruth(
        executed=len(trials),
        positives=len(positive),
        precision=_ratio(hits, len(positive)),
        precision_ci95=clustered_interval([(sum(group), len(group)) for group in of_groups]),
        precision_weighted=_ratio(caught, sum(t.weight for t in positive)),
        recall_weighted=_ratio(caught, good),
        by_stratum=tuple(
            (low, min(high, 1.0), len(stratum), _ratio(sum(stratum), len(stratum)))
            for low, high, stratum in strata
        ),
    )


def _ratio(part: float, whole: float) -> float:
    return part / whole if whole else float("nan")
