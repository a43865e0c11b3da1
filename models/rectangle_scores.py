"""The rectangle metric of a network's best grasp on real images, as on Cornell and Jacquard.

The network tells centre, angle and width of a grasp; the length of the plates, which the metric's
rectangle has besides, is the median one of the labels that the network was trained on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from models.grasp_peaks import PeakSettings, find_peaks
from models.graspnet import GraspNet, to_input
from models.rectangle_examples import View
from utils.real_data import RealSample
from utils.rectangles import GraspRectangle, intersection_over_union, rectangle_match
from utils.transforms import angle_difference

BEST = PeakSettings(threshold=-1.0, count=1)


@dataclass(frozen=True, eq=False)
class Judged:
    """A network's best grasp on one image. rectangle: in pixels of the data set's image. iou,
    angle_error: of the label with the largest IoU, the error in radians; correct: by the metric."""

    name: str
    object_id: str
    rectangle: GraspRectangle
    quality: float
    correct: bool
    iou: float
    angle_error: float

    def as_dict(self) -> dict:
        """Plain numbers for a JSON file; angles in degrees."""
        return {
            "name": self.name,
            "object": self.object_id,
            "correct": self.correct,
            "quality": round(self.quality, 4),
            "u": round(float(self.rectangle.centre[0]), 2),
            "v": round(float(self.rectangle.centre[1]), 2),
            "angle_deg": round(float(np.degrees(self.rectangle.angle)), 2),
            "width_px": round(self.rectangle.width, 2),
            "height_px": round(self.rectangle.height, 2),
            "iou": round(self.iou, 4),
            "angle_error_deg": round(float(np.degrees(self.angle_error)), 2),
        }


def median_plate_length(samples: Sequence[RealSample]) -> float:
    """Pixels, of all labels of some images."""
    return float(np.median([r.height for sample in samples for r in sample.positives]))


@torch.inference_mode()
def best_rectangle(
    model: GraspNet, sample: RealSample, view: View, plate_length: float
) -> tuple[GraspRectangle, float]:
    """The network's best grasp on an image, in that image's pixels, and its quality.

    plate_length: pixels of the image, what the rectangle measures across the closing line. The
    model has to be in evaluation mode.
    """
    rgb, depth, _ = view.warp(sample)
    device = next(model.parameters()).device
    x = to_input(rgb, depth)[None].to(device, memory_format=torch.channels_last)
    found = find_peaks(*model(x), BEST)
    zoom = view.size / view.side
    opening = max(float(found.width[0]) / view.metres_per_pixel, 1e-3)
    there = GraspRectangle(found.pixel[0], float(found.angle[0]), opening, plate_length * zoom)
    back = np.linalg.inv(view.matrix(sample.depth.shape))
    return there.transformed(back), float(found.quality[0])


def judge(
    model: GraspNet, samples: Sequence[RealSample], view: View, plate_length: float
) -> list[Judged]:
    """The rectangle metric of the best grasp on every image; the model ends in evaluation mode."""
    model.eval()
    return [
        judged(sample, *best_rectangle(model, sample, view, plate_length)) for sample in samples
    ]


def judged(sample: RealSample, rectangle: GraspRectangle, quality: float) -> Judged:
    """The rectangle metric of a grasp on an image, in that image's pixels."""
    overlaps = [intersection_over_union(rectangle, label) for label in sample.positives]
    nearest = int(np.argmax(overlaps))
    error = angle_difference(rectangle.angle, sample.positives[nearest].angle)
    return Judged(
        sample.name, sample.object_id, rectangle, quality,
        rectangle_match(rectangle, sample.positives), overlaps[nearest], float(error),
    )  # fmt: skip
