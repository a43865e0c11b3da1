"""How planners and networks that were made in simulation alone do on Cornell's photographs.

No label teaches anything, and nothing is fitted to one. A photograph becomes a frame: its distances
become depths, the table tells where the camera is (`utils.table_plane`). The labels are for a hand
that can hold a cereal box, which the Panda's cannot. A hand of the same shape that is k times as
large does in its world what the Panda's does in one that is k times as small; so frames are shrunk,
and everything else is as in the cell. The plates of a rectangle are half as long as its opening, as
Morrison, Corke and Leitner ("Closing the loop for robotic grasping", RSS 2018) draw theirs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from models.graspnet import to_input
from models.graspnet_decoding import PeakSettings, find_peaks, surface_depth, surface_grasps
from models.graspnet_io import SavedGraspNet
from models.planner_graspnet import GraspNetPlanner
from models.planners import Planner, make_planner, needs_truth
from models.rectangle_examples import Judged, View, best_rectangle, judged
from models.rectangle_folds import VIEWS
from utils.errors import UserError
from utils.geometry import GripperGeometry, Workspace
from utils.images import overhead_view
from utils.real_data import RealSample, existing_folder, open_real_data
from utils.rectangles import GraspRectangle
from utils.table_plane import find_table_camera
from utils.transforms import Grasp, RGBDFrame, image_to_grasp, project

# A first Kinect's colour camera as its driver describes it where it was not calibrated.
K = np.array([[525.0, 0.0, 319.5], [0.0, 525.0, 239.5], [0.0, 0.0, 1.0]])
SHAPE = (480, 640)  # rows and columns of its images
HAND = GripperGeometry()
OPENING = 0.15  # m, of the hand that photographs are judged for: the tutorial's widest
SHRUNK = OPENING / HAND.max_opening  # how many times smaller a photograph's world becomes
REACH = 0.04  # m outside a workspace that the planners' search still grasps (`SearchSettings`)
# So that planners reach 0.30 m of the shrunk world, as large a square as the cell's.
WORKSPACE = Workspace((0.0, 0.0), 0.30 - 2 * REACH)
PIXEL = 0.002  # m, of the view that tells how high a planner's grasp lies
BEST = PeakSettings(threshold=-1.0, count=1)


def photographs(root: Path) -> list[RealSample]:
    """Cornell's images in a folder. Raises UserError naming what is wrong with it."""
    samples = list(open_real_data("cornell", existing_folder(root, "transfer.cornell")))
    for sample in samples:
        if sample.depth.shape != SHAPE:
            height, width = sample.depth.shape
            raise UserError(
                f"{root}: {sample.name} has {width} x {height} px, Cornell's photographs 640 x 480"
            )
    return samples


def frame_of(sample: RealSample, shrunk: float = SHRUNK) -> RGBDFrame:
    """What planners see of a photograph, in a world that is `shrunk` times as small: z = 0 is the
    table, and the camera looks at the middle of WORKSPACE. Pixels are the photograph's."""
    camera = find_table_camera(sample.depth, K)
    T_WC = camera.T_WC
    T_WC[:3, 3] /= shrunk
    depth = camera.depth(sample.depth, K) / np.float32(shrunk)
    return RGBDFrame(sample.rgb, depth, K, T_WC)


def judge_photographs(
    planner: str, samples: Sequence[RealSample], seed: int
) -> list[Judged | None] | None:
    """The rectangle metric of a planner's best grasp, or a network's, on every photograph; None
    where it finds none, and for a planner that needs more than a frame."""
    planned = make_planner(planner, HAND, WORKSPACE, seed)
    if needs_truth(planned):
        return None
    found: list[Judged | None] = []
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
) -> list[Judged | None] | None:
    """The same of a network that is given the photographs as one that is trained on them sees them:
    levelled, at its own scale, but neither from above nor in a smaller world. None for planners of
    another kind, which have to know where the camera is."""
    planned = make_planner(planner, HAND, WORKSPACE, seed)
    if not isinstance(planned, GraspNetPlanner):
        return None
    model, view = planned.network.model.eval(), _as_taken(planned.network.metres_per_pixel)
    found: list[Judged | None] = []
    for sample in samples:
        rectangle, quality = best_rectangle(model, view.levelled(sample), view, plate_length=1.0)
        half_as_long = replace(rectangle, height=rectangle.width / 2)
        found.append(judged(sample, half_as_long, quality))
    return found


def _as_taken(metres_per_pixel: float) -> View:
    """Cornell's view in pixels that span `metres_per_pixel`, a multiple of 8 of them."""
    view = VIEWS["cornell"]
    span = view.size * view.metres_per_pixel  # m
    size = 8 * round(span / metres_per_pixel / 8)
    return replace(view, size=size, metres_per_pixel=span / size)


def best_grasp(planner: Planner, frame: RGBDFrame) -> Grasp | None:
    """A network's best grasp, else the planner's first; on the surface that the image shows, below
    which it does not tell how far the fingers go."""
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
    """A photograph's frame as a network sees it whose pixels span `metres_per_pixel`."""
    return overhead_view(frame, WORKSPACE, metres_per_pixel, REACH)


@torch.inference_mode()
def network_grasp(saved: SavedGraspNet, frame: RGBDFrame) -> Grasp:
    """The grasp at the best pixel of what a network sees from above, on the surface there."""
    view = from_above(frame, saved.metres_per_pixel)
    maps = saved.model.eval()(to_input(view.rgb, view.depth)[None])
    (grasp,) = surface_grasps(find_peaks(*maps, BEST), view.depth, HAND)
    return image_to_grasp(grasp, view.K, view.T_WC)


def rectangle_of(grasp: Grasp, frame: RGBDFrame) -> GraspRectangle:
    """A grasp as a rectangle on the image: the opening is its projection."""
    half = grasp.width / 2 * grasp.closing_direction
    (start, end), _ = project(grasp.position + np.stack([-half, half]), frame.K, frame.T_WC)
    du, dv = end - start
    opening = max(float(np.hypot(du, dv)), 1e-3)
    return GraspRectangle((start + end) / 2, float(np.arctan2(dv, du)), opening, opening / 2)
