"""GraspNet's maps of the image of any camera, which is resampled to the scale of training.

Convolutions know sizes in pixels only. So the image is resampled, with square pixels, until one of
its pixels spans as many metres at the median depth as in training. `models.graspnet_view` converts
what the maps show back to the original's pixels. This module knows no simulator and no files.
"""

from __future__ import annotations

import torch

from models.graspnet import INPUT_CHANNELS, GraspNet, to_input
from utils.depth_holes import check_rgbd, fill_holes
from utils.errors import UserError
from utils.images import PixelScaling
from utils.transforms import RGBDFrame

SMALLEST_SIDE = 32  # pixels at the training's scale, some 6 cm: less cannot show a grasp
MOST_PIXELS = 2**22  # at the training's scale, 3.6 m x 3.6 m; half a GB for a layer of 32 channels


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


@torch.inference_mode()
def run_network(
    model: GraspNet,
    frame: RGBDFrame,
    scaling: PixelScaling,
    centres: bool = False,
    level: float | None = None,
) -> tuple[torch.Tensor, ...]:
    """Return GraspNet's three maps of the scaled image, with `centres` four, on the CPU.

    level: as of `to_input`. Raises UserError for a network that takes other images.
    """
    if model.input_channels != INPUT_CHANNELS:
        raise UserError(
            f"the network takes {model.input_channels} channels; an RGB-D image has "
            f"{INPUT_CHANNELS}"
        )
    depth = scaling.image(fill_holes(frame.depth))
    image = to_input(scaling.image(frame.rgb), depth, level)
    device = next(model.parameters()).device
    if model.training:  # eval() walks through all modules
        model.eval()
    batch = image[None].to(device, memory_format=torch.channels_last)  # quickest on CPUs
    maps = model(batch, centres=centres)
    return tuple(part.float().cpu() for part in maps)
