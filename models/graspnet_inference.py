"""GraspNet on the image of any camera: resampling to the scale of training, and back.

Convolutions know sizes in pixels only. So the image is resampled, with square pixels, until one of
its pixels spans as many metres at the median depth as in training; grasps and maps are converted
back to the original's pixels. This module knows no simulator and no files.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from models.graspnet import INPUT_CHANNELS, GraspNet, to_input
from models.graspnet_decoding import (
    LABELS,
    Peaks,
    PeakSettings,
    find_peaks,
    surface_grasps,
)
from utils.depth import check_rgbd, fill_holes
from utils.errors import UserError
from utils.geometry import GripperGeometry
from utils.grasp_labels import grasp_below_surface
from utils.images import PixelScaling
from utils.transforms import Grasp, ImageGrasp, RGBDFrame, deproject

SMALLEST_SIDE = 32  # pixels at the training's scale, some 6 cm: less cannot show a grasp
MOST_PIXELS = 2**22  # at the training's scale, 3.6 m x 3.6 m; half a GB for a layer of 32 channels
PEAKS = PeakSettings(count=1000)  # those above the table remain


@dataclass(frozen=True)
class PredictedGrasp:
    """A grasp twice: on_image on the visible surface, in pixels of the original image; in_world in
    W, at the place where the fingers close."""

    on_image: ImageGrasp
    in_world: Grasp


@dataclass(frozen=True)
class Prediction:
    """Ranked grasps and the network's maps.

    grasps: best first. quality, angle, width: (H, W) float32 at the original image's pixels: in [0,
    1], image angles in [0, pi), metres.
    """

    grasps: list[PredictedGrasp]
    quality: np.ndarray
    angle: np.ndarray
    width: np.ndarray


def predict(
    model: GraspNet,
    metres_per_pixel: float,
    frame: RGBDFrame,
    table_height: float,
    gripper: GripperGeometry,
    count: int = 20,
) -> Prediction:
    """Find the `count` best grasps in a frame of any size, aspect ratio and focal lengths.

    metres_per_pixel: the scale of the training images. table_height: z of the table in W, metres.
    gripper: the hand, whose opening limits the widths; `SavedGraspNet.gripper` is that of the
    training. A grasp needs a surface beside which the fingertips fit, as in the labels; peaks on
    the table are left out. Raises UserError as `training_scale` does.
    """
    scaling, maps = scaled_maps(model, metres_per_pixel, frame)
    grasps = grasps_in_maps(maps, scaling, frame, table_height, gripper)
    quality, angle, width = maps
    shape = frame.depth.shape
    bins = angle[0].argmax(dim=0).numpy() * (np.pi / model.num_angle_bins)
    # Lines at 0 and 180 degrees are the same: doubled angles are interpolated as vectors.
    cosine, sine = (
        scaling.original_map(part(2 * bins).astype(np.float32), shape) for part in (np.cos, np.sin)
    )
    return Prediction(
        grasps[:count],
        scaling.original_map(quality[0, 0].numpy(), shape),
        scaling.original_angles(np.arctan2(sine, cosine) / 2).astype(np.float32),
        scaling.original_map(width[0, 0].numpy(), shape),
    )


def scaled_maps(
    model: GraspNet, metres_per_pixel: float, frame: RGBDFrame, centres: bool = False
) -> tuple[PixelScaling, tuple[torch.Tensor, ...]]:
    """Return the scaling to the training's pixels and the network's three maps there; with
    `centres` also the map of the centre head."""
    scaling = training_scale(frame, metres_per_pixel)
    return scaling, run_network(model, frame, scaling, centres)


def grasps_in_maps(
    maps: tuple[torch.Tensor, torch.Tensor, torch.Tensor],
    scaling: PixelScaling,
    frame: RGBDFrame,
    table_height: float,
    gripper: GripperGeometry,
) -> list[PredictedGrasp]:
    """Return the grasps on surfaces above the table, best first, at the original's pixels."""
    found = find_peaks(*maps, PEAKS)
    rows, columns = frame.depth.shape
    original = Peaks(
        np.clip(scaling.original_pixels(found.pixel), 0, (columns - 1, rows - 1)),
        scaling.original_angles(found.angle),
        found.width,
        found.quality,
    )
    # The same radius in metres as one pixel at the training's scale.
    radius = max(1, round(1 / min(scaling.u, scaling.v)))
    seen = surface_grasps(original, frame.depth, gripper, radius)
    pixels = np.array([grasp.pixel for grasp in seen]).reshape(-1, 2)
    surface = deproject(pixels, [grasp.depth for grasp in seen], frame.K, frame.T_WC)
    rises = surface[:, 2] - table_height > LABELS.table_clearance + LABELS.min_engagement
    return [
        PredictedGrasp(
            grasp,
            grasp_below_surface(grasp, frame.K, frame.T_WC, table_height, gripper, LABELS),
        )
        for grasp, high in zip(seen, rises)
        if high
    ]


def training_scale(frame: RGBDFrame, metres_per_pixel: float) -> PixelScaling:
    """Return the scaling after which a pixel spans `metres_per_pixel` at the median known depth.

    Raises UserError as `check_rgbd` does, and for a view that is far too small or too wide.
    """
    distance = check_rgbd(frame.rgb, frame.depth)
    scaling = PixelScaling.to_focal_length(frame.K, distance / metres_per_pixel)
    height, width = frame.depth.shape
    rows, columns = height * scaling.v, width * scaling.u
    if min(rows, columns) < SMALLEST_SIDE or rows * columns > MOST_PIXELS:
        raise UserError(
            f"at the median depth of {distance:.3g} m the image would span "
            f"{columns * metres_per_pixel:.3g} m x {rows * metres_per_pixel:.3g} m, too "
            f"{'little' if min(rows, columns) < SMALLEST_SIDE else 'much'} for a hand's grasps; "
            "check the unit of the depth and the focal length"
        )
    return scaling


@torch.no_grad()
def run_network(
    model: GraspNet, frame: RGBDFrame, scaling: PixelScaling, centres: bool = False
) -> tuple[torch.Tensor, ...]:
    """Return GraspNet's three maps of the scaled image, with `centres` four, on the CPU.

    Raises UserError for a network that takes other images.
    """
    if model.input_channels != INPUT_CHANNELS:
        raise UserError(
            f"the network takes {model.input_channels} channels; an RGB-D image has "
            f"{INPUT_CHANNELS}"
        )
    depth = scaling.image(fill_holes(frame.depth))
    image = to_input(scaling.image(frame.rgb), depth)
    device = next(model.parameters()).device
    if model.training:  # eval() walks through all modules
        model.eval()
    maps = model(image[None].to(device), centres=centres)
    return tuple(part.float().cpu() for part in maps)
