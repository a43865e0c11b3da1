"""Scores of planners and networks from simulation on Cornell's photographs.

No planner or network is trained or fitted on the photographs' labels. A photograph becomes a frame:
its distances are converted to depths, and the table gives the camera's pose (`utils.table_plane`).
The labels are for a hand that can hold a cereal box, which the Panda's cannot. A hand of the same
shape that is k times as large acts in its world as the Panda's does in a world that is k times as
small; so frames are shrunk, and everything else is as in the cell. The plates of a rectangle are
half as long as its opening, as Morrison, Corke and Leitner ("Closing the loop for robotic
grasping", RSS 2018) draw theirs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from models.graspnet import to_input
from models.graspnet_decoding import HIGHEST_PEAK, find_peaks, surface_depth, surface_grasps
from models.graspnet_io import SavedGraspNet
from models.planner_candidates import SearchSettings
from models.planner_graspnet import GraspNetPlanner
from models.planners import Planner, make_planner, needs_truth, tilts
from models.rectangle_examples import JudgedRectangle, best_rectangle, judged
from utils.errors import UserError
from utils.geometry import GripperGeometry, Workspace
from utils.images import overhead_view
from utils.real_data import FORMATS, existing_folder, open_real_data
from utils.rectangles import GraspRectangle, RealSample, View
from utils.table_plane import find_table_camera
from utils.transforms import Grasp, RGBDFrame, image_to_grasp, project

# A first Kinect's colour camera as its driver describes it where it was not calibrated.
K = np.array([[525.0, 0.0, 319.5], [0.0, 525.0, 239.5], [0.0, 0.0, 1.0]])
SHAPE = (480, 640)  # rows and columns of its images
HAND = GripperGeometry()
OPENING = 0.15  # m, of the hand that photographs are judged for: the tutorial's widest
SHRUNK = OPENING / HAND.max_opening  # how many times smaller a photograph's world becomes
REACH = SearchSettings().reach  # m outside a workspace that the planners' search still grasps
# With it planners reach 0.30 m of the shrunk world, as large a square as the cell's.
WORKSPACE = Workspace((0.0, 0.0), 0.30 - 2 * REACH)
PIXEL = 0.002  # m, of the view from which the height of a planner's grasp is read


def photographs(root: Path) -> list[RealSample]:
    """Read Cornell's images in a folder; raises UserError for a missing or broken file."""
    samples = list(open_real_data("cornell", existing_folder(root, "transfer.cornell")))
    for sample in samples:
        if sample.depth.shape != SHAPE:
            height, width = sample.depth.shape
            raise UserError(
                f"{root}: {sample.name} has {width} x {height} px, Cornell's photographs 640 x 480"
            )
    return samples


def frame_of(sample: RealSample, shrunk: float = SHRUNK) -> RGBDFrame:
    """Return a photograph as a frame for planners, in a world that is `shrunk` times as small.

    The table is z = 0, and the camera looks at the middle of WORKSPACE. The pixels stay the same.
    """
    camera = find_table_camera(sample.depth, K)
    T_WC = camera.T_WC
    T_WC[:3, 3] /= shrunk
    depth = camera.depth(sample.depth, K) / np.float32(shrunk)
    return RGBDFrame(sample.rgb, depth, K, T_WC)


def judge_photographs(
    planner: str, samples: Sequence[RealSample], seed: int
) -> list[JudgedRectangle | None] | None:
    """Score the best grasp of a planner, or of a network alone, on every photograph.

    An entry is None where the planner finds no grasp. The result is None for a planner with an
    attribute `needs_truth` that is true, as a photograph has no true scene, and for one whose
    grasps may lean, which a rectangle cannot tell.
    """
    planned = make_planner(planner, HAND, WORKSPACE, seed, "transfer.policies")
    if needs_truth(planned) or tilts(planned):
        return None
    found: list[JudgedRectangle | None] = []
    for sample in samples:
        frame = frame_of(sample)
        grasp = best_grasp(planned, frame)
        if grasp is None:
            found.append(None)
        else:
            found.append(judged(sample, rectangle_of(grasp, frame), grasp.quality))
    return found


def judge_as_taken(
    planner: str, samples: Sequence[RealSample], seed: int
) -> list[JudgedRectangle | None] | None:
    """Score a network on the photographs in the view in which networks are trained on them.

    They are levelled and at the network's scale, but neither seen from above nor in a smaller
    world. Returns None for other planners, which need the camera's pose.
    """
    planned = make_planner(planner, HAND, WORKSPACE, seed, "transfer.policies")
    if not isinstance(planned, GraspNetPlanner):
        return None
    model, view = planned.network.model.eval(), _as_taken(planned.network.metres_per_pixel)
    found: list[JudgedRectangle | None] = []
    for sample in samples:
        rectangle, quality = best_rectangle(model, view.levelled(sample), view, plate_length=1.0)
        half_as_long = replace(rectangle, height=rectangle.width / 2)
        found.append(judged(sample, half_as_long, quality))
    return found


def _as_taken(metres_per_pixel: float) -> View:
    """Return Cornell's view in pixels that span `metres_per_pixel`, a multiple of 8 of them."""
    view = FORMATS["cornell"].view
    span = view.size * view.metres_per_pixel  # m
    size = 8 * round(span / metres_per_pixel / 8)
    return replace(view, size=size, metres_per_pixel=span / size)


def best_grasp(planner: Planner, frame: RGBDFrame) -> Grasp | None:
    """Return a network's best grasp or another planner's first, on the surface that the image
    shows: a rectangle has no depth of the fingers below it."""
    if isinstance(planner, GraspNetPlanner):
        return network_grasp(planner.network, frame)
    planned = planner(frame)
    if not planned:
        return None
    view = overhead_view(frame, WORKSPACE, PIXEL, REACH)
    pixel, _ = project(planned[0].position, view.K, view.T_WC)
    (distance,) = surface_depth(view.depth, pixel)
    x, y, _ = planned[0].position
    return replace(planned[0], position=np.array([x, y, view.T_WC[2, 3] - distance]))


def from_above(frame: RGBDFrame, metres_per_pixel: float) -> RGBDFrame:
    """Return a photograph's frame as the overhead camera would see it, at this scale."""
    return overhead_view(frame, WORKSPACE, metres_per_pixel, REACH)


@torch.inference_mode()
def network_grasp(saved: SavedGraspNet, frame: RGBDFrame) -> Grasp:
    """Return the grasp at the best pixel of a network's view from above, on the surface there."""
    view = from_above(frame, saved.metres_per_pixel)
    maps = saved.model.eval()(to_input(view.rgb, view.depth)[None])
    (grasp,) = surface_grasps(find_peaks(*maps, HIGHEST_PEAK), view.depth, HAND)
    return image_to_grasp(grasp, view.K, view.T_WC)


def rectangle_of(grasp: Grasp, frame: RGBDFrame) -> GraspRectangle:
    """Return a grasp as a rectangle on the image, whose opening is the projected one."""
    half = grasp.width / 2 * grasp.closing_direction
    (start, end), _ = project(grasp.position + np.stack([-half, half]), frame.K, frame.T_WC)
    du, dv = end - start
    opening = max(float(np.hypot(du, dv)), 1e-3)
    return GraspRectangle((start + end) / 2, float(np.arctan2(dv, du)), opening, opening / 2)
