"""How a network that was trained in simulation alone does on labelled photographs of Cornell.

No image of the data set teaches it anything, not even how long a rectangle is: the plates are half
as long as the opening, as Morrison, Corke and Leitner ("Closing the loop for robotic grasping",
RSS 2018) draw theirs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from models.graspnet_io import SavedGraspNet
from models.real_training_data import VIEWS
from models.rectangle_examples import View
from models.rectangle_scores import Judged, judge
from utils.real_data import RealSample, open_real_data


def photographs(root: Path) -> list[RealSample]:
    """Cornell's images in a folder, levelled. Raises UserError naming what is wrong with it."""
    view = VIEWS["cornell"]
    return [view.levelled(sample) for sample in open_real_data("cornell", root)]


def judge_photographs(saved: SavedGraspNet, samples: Sequence[RealSample]) -> list[Judged]:
    """The rectangle metric of a network's best grasp on every photograph."""
    return judge(saved.model, samples, view_of(saved.metres_per_pixel), None)


def view_of(metres_per_pixel: float) -> View:
    """Cornell's view at the scale that a network was trained at: it knows no other."""
    view = VIEWS["cornell"]
    span = view.size * view.metres_per_pixel  # m
    # Whole pixels, and a multiple of 8: networks halve images three times.
    size = 8 * round(span / metres_per_pixel / 8)
    return replace(view, size=size, metres_per_pixel=span / size)
