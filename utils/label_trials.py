"""Grasp labels against physics: labelled (pixel, angle) pairs that were carried out, and what they
say of the labels. This module knows no simulator.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from utils.geometry import GripperGeometry
from utils.grasp_labels import GraspLabels, LabelSettings, bin_angles, grasp_below_surface
from utils.statistics import wilson_interval
from utils.transforms import Grasp, ImageGrasp, RGBDFrame

STRATA = (0.0, 1e-6, 0.3, 0.5, 0.6, 0.7, 0.8, 1.01)  # edges in quality
PER_STRATUM = 3  # pairs drawn from each stratum of a frame; twice as many of quality 0


@dataclass(frozen=True)
class Trial:
    """One executed pair; it stands for `weight` pairs of its frame and stratum."""

    quality: float
    weight: float
    success: bool


def draw_pairs(
    frame: RGBDFrame, labels: GraspLabels, rng: np.random.Generator, per_stratum: int = PER_STRATUM
) -> Iterator[tuple[Grasp, float, float]]:
    """Grasps of pairs drawn from every stratum of quality, each with its quality and its weight.

    Pairs of quality 0 come from the objects' pixels and are tried with the hand wide open.
    """
    settings, gripper = LabelSettings(), GripperGeometry()
    lowest = settings.table_clearance + settings.min_engagement
    on_object = labels.valid & (frame.segmentation >= 0) & (frame.points()[..., 2] > lowest)
    quality = np.where(on_object, labels.quality, -1)
    for low, high in zip(STRATA, STRATA[1:]):
        members = np.flatnonzero((quality >= low) & (quality < high))
        count = min(len(members), per_stratum * (2 if low == 0 else 1))
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

    executed, positives: how many pairs were carried out, and how many of these were positive.
    precision: of those drawn, with its 95 % interval; precision_weighted and recall_weighted: over
    all pairs of the frames instead. by_stratum: (low, high, executed, success rate) in quality.
    """

    executed: int
    positives: int
    precision: float
    precision_ci95: tuple[float, float]
    precision_weighted: float
    recall_weighted: float
    by_stratum: tuple[tuple[float, float, int, float], ...]


def label_truth(trials: Sequence[Trial]) -> LabelTruth:
    """What the trials say of the labels; NaN where nothing was executed."""
    positive = [t for t in trials if t.quality >= LabelSettings().positive]
    hits = sum(t.success for t in positive)
    good = sum(t.weight for t in trials if t.success)
    caught = sum(t.weight for t in positive if t.success)
    groups = [
        (low, high, [t.success for t in trials if low <= t.quality < high])
        for low, high in zip(STRATA, STRATA[1:])
    ]
    return LabelTruth(
        executed=len(trials),
        positives=len(positive),
        precision=_ratio(hits, len(positive)),
        precision_ci95=wilson_interval(hits, len(positive)),
        precision_weighted=_ratio(caught, sum(t.weight for t in positive)),
        recall_weighted=_ratio(caught, good),
        by_stratum=tuple(
            (low, min(high, 1.0), len(group), _ratio(sum(group), len(group)))
            for low, high, group in groups
        ),
    )


def _ratio(part: float, whole: float) -> float:
    return part / whole if whole else float("nan")
