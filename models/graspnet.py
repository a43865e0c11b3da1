"""GraspNet: from an RGB-D image to ranked grasps (the tutorial's chapter 3).

This module holds, in this order: the conversion of an image to the network's input, the network,
the conversion of labels to training targets, and the loss. `models.graspnet_decoding` turns the
network's maps into grasps. An angle on the image is that of the closing line from +u (right)
towards +v (down), modulo pi; bin k of K is centred at k * 180 / K degrees. Widths are metres. This
module knows no simulator.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import nn

from models.graspnet_backbones import BACKBONES
from models.graspnet_decoding import decode_grasps
from utils.depth_holes import check_rgbd, fill_holes
from utils.errors import UserError, unknown_choice
from utils.geometry import GripperGeometry
from utils.grasp_labels import ANGLE_BINS
from utils.transforms import known_depth

PANDA_HAND = GripperGeometry()

# --- From an image to the input ------------------------------------------------------------

INPUT_CHANNELS = 4  # red, green, blue, depth
DEPTH_UNIT = 0.1  # metres of depth that count 1 in the input: objects are about that high
OFFSET_UNIT = 10.0  # pixels to a centre of mass that count 1 in the last layer
DEPTH_LIMIT = 0.3  # metres from the level beyond which depth is clipped


def to_input(rgb: np.ndarray, depth: np.ndarray, level: float | None = None) -> torch.Tensor:
    """Return the network's input (4, H, W) float32 of one image; the one place of normalisation.

    rgb: (H, W, 3) uint8. depth: (H, W) metres; 0, negative or not finite means unknown.
    level: m, the depth that becomes 0; None: the median, which is the table's in most images.
    Colours become -0.5..0.5. Depth is filled from the nearest known pixel, centred (so that the
    camera's distance does not matter) and clipped to +-0.3 m, which become +-3. Raises UserError
    as `check_rgbd` does.
    """
    median = check_rgbd(rgb, depth)
    filled = fill_holes(depth)
    if not known_depth(depth).all():
        median = float(np.median(filled))
    centred = (
        np.clip(filled - (median if level is None else level), -DEPTH_LIMIT, DEPTH_LIMIT)
        / DEPTH_UNIT
    )
    image = np.empty((INPUT_CHANNELS, *depth.shape), np.float32)
    image[:3] = np.moveaxis(rgb, -1, 0)
    image[:3] /= 255
    image[:3] -= 0.5
    image[3] = centred
    return torch.from_numpy(image)


# --- The network ---------------------------------------------------------------------------


class GraspNet(nn.Module):
    """A network that predicts quality, angle and width of the best grasp at every pixel.

    input_channels: 4 for `to_input`. num_angle_bins: K bins over [0, pi). max_width: metres, the
    largest width that the network can predict; 0.15 in the tutorial, 0.08 fits the Panda hand.
    backbone: one of `models.graspnet_backbones.BACKBONES`; "tutorial" is the tutorial's encoder and
    decoder. centre_head: a fourth head predicts the offset from each pixel to the centre of mass of
    the object seen there. `model_args` holds these five arguments, so that
    `GraspNet(**model_args)` is the same architecture.
    """

    def __init__(
        self,
        input_channels: int = INPUT_CHANNELS,
        num_angle_bins: int = ANGLE_BINS,
        max_width: float = 0.15,
        backbone: str = "tutorial",
        centre_head: bool = False,
    ):
        super().__init__()
        if backbone not in BACKBONES:
            raise unknown_choice("GraspNet backbone (train.backbone)", backbone, BACKBONES)
        self.model_args = {
            "input_channels": input_channels,
            "num_angle_bins": num_angle_bins,
            "max_width": max_width,
            "backbone": backbone,
            "centre_head": centre_head,
        }
        self.input_channels = input_channels
        self.num_angle_bins = num_angle_bins
        self.max_width = max_width
        self.backbone = BACKBONES[backbone](input_channels)
        features = self.backbone.out_channels
        self.quality_head = nn.Conv2d(features, 1, kernel_size=1)
        self.angle_head = nn.Conv2d(features, num_angle_bins, kernel_size=1)
        self.width_head = nn.Conv2d(features, 1, kernel_size=1)
        self.centre_head = nn.Conv2d(features, 2, kernel_size=1) if centre_head else None

    def forward(
        self, x: torch.Tensor, logits: bool = False, centres: bool = False
    ) -> tuple[torch.Tensor, ...]:
        """Return maps of the input's height and width; any size is allowed.

        x: (B, C, H, W). Returns quality (B, 1, H, W) in [0, 1], angle logits (B, K, H, W) and
        width (B, 1, H, W) in metres. With `logits` the quality is returned before its sigmoid, as
        GraspLoss needs it. With `centres` the map of the centre head follows: (B, 2, H, W), pixels
        (du, dv) to the centre of mass. These are arguments, not methods, so that
        DistributedDataParallel sees the call.
        """
        if x.ndim != 4 or x.shape[1] != self.input_channels:
            raise UserError(
                f"GraspNet: got an input of shape {tuple(x.shape)}, "
                f"expected (B, {self.input_channels}, H, W)"
            )
        return self.heads(self.features(x), logits, centres)

    def features(self, x: torch.Tensor) -> torch.Tensor:
        """Return the backbone's feature map (B, out_channels, H, W) of x (B, C, H, W)."""
        height, width = x.shape[-2:]
        below, right = -height % self.backbone.stride, -width % self.backbone.stride
        if below or right:
            x = F.pad(x, (0, right, 0, below), mode="replicate")
        weight = next(self.backbone.parameters())  # of another dtype than x after `for_inference`
        return self.backbone(x.to(weight.dtype))[..., :height, :width].to(x.dtype)

    def heads(
        self, features: torch.Tensor, logits: bool = False, centres: bool = False
    ) -> tuple[torch.Tensor, ...]:
        """Return the heads' maps of a feature map, as `forward` does."""
        heads = [self.quality_head, self.angle_head, self.width_head]
        if centres:
            heads.append(self.centre_head)
        # One convolution takes a quarter of the time of all.
        weight = torch.cat([head.weight for head in heads])
        bias = torch.cat([head.bias for head in heads])
        maps = F.conv2d(features, weight, bias).split([head.out_channels for head in heads], dim=1)
        quality, angle, width, *offset = maps
        metres = torch.sigmoid(width) * self.max_width
        found = quality if logits else torch.sigmoid(quality), angle, metres
        return (*found, *(pixels * OFFSET_UNIT for pixels in offset))

    @torch.no_grad()
    def predict_grasp(
        self,
        x: torch.Tensor,
        K: np.ndarray | None = None,
        T_WC: np.ndarray | None = None,
        depth: np.ndarray | None = None,
        gripper: GripperGeometry = PANDA_HAND,
        **decoding,
    ) -> dict:
        """Return the best pixel of one image as in the tutorial and, with a camera, metric grasps.

        x: (1, C, H, W). The returned dict holds `x` and `y` in fractions of the image, `theta` in
        fractions of 180 degrees (bin k is centred at k / num_angle_bins), `width` in metres and
        `quality`. With K, T_WC and depth it also holds `grasps`, the list that
        `decode_grasps(..., gripper, **decoding)` returns, best first; the gripper is the Panda's
        own hand unless another one is given.
        """
        if len(x) != 1:
            raise ValueError(f"predict_grasp takes one image, got a batch of {len(x)}")
        training = self.training
        self.eval()
        try:
            quality, angle, width = self(x)
        finally:
            self.train(training)
        rows, columns = quality.shape[-2:]
        row, column = divmod(int(quality.argmax()), columns)
        found = {
            "x": column / columns,
            "y": row / rows,
            "theta": int(angle[0, :, row, column].argmax()) / self.num_angle_bins,
            "width": float(width[0, 0, row, column]),
            "quality": float(quality[0, 0, row, column]),
        }
        if K is not None and T_WC is not None and depth is not None:
            found["grasps"] = decode_grasps(
                quality, angle, width, K, T_WC, depth, gripper, **decoding
            )
        return found


def create_model(
    input_channels: int = INPUT_CHANNELS,
    num_angle_bins: int = ANGLE_BINS,
    *,
    name: str = "tutorial",
    max_width: float = 0.15,
    centre_head: bool = False,
) -> GraspNet:
    """Make a GraspNet with the backbone `name`; an unknown one is a UserError that lists all."""
    return GraspNet(input_channels, num_angle_bins, max_width, name, centre_head)


# --- Targets and loss ----------------------------------------------------------------------


class GraspTargets(NamedTuple):
    """The maps that the network should predict for B images.

    quality: (B, 1, H, W) in [0, 1]. angle: (B, K, H, W), at each pixel a distribution over bins.
    width: (B, 1, H, W) metres. valid: (B, 1, H, W) weight of the pixel in the quality loss, 0 to
    leave it out. graspable: (B, 1, H, W) its weight in the angle and width losses. offset: (B, 2,
    H, W) pixels to the centre of mass. on_object: (B, 1, H, W) weight of the pixel in the loss of
    the offsets.
    """

    quality: torch.Tensor
    angle: torch.Tensor
    width: torch.Tensor
    valid: torch.Tensor
    graspable: torch.Tensor
    offset: torch.Tensor
    on_object: torch.Tensor


def targets_from_labels(
    quality: torch.Tensor,
    width: torch.Tensor,
    valid: torch.Tensor | None = None,
    graspable_from: float = 0.5,
    offset: torch.Tensor | None = None,
) -> GraspTargets:
    """Make targets from dense labels: the quality of a grasp at each pixel AND in each angle bin.

    quality, width: (B, K, H, W), in [0, 1] and metres. valid: (B, 1, H, W) weights or None for 1.
    graspable_from: the quality from which on a pixel teaches angle and width. offset: (B, 2, H, W)
    pixels to the centre of mass of the object seen, NaN where there is none; None if unknown.

    The targets of quality and width are those of the pixel's best bin. The angle's target gives
    every bin its share of the summed cubes of quality: where several angles are good, all of them
    are right (with one hard angle per pixel the angle head collapses), and the cube, which is the
    plain product of the label's factors, keeps the share of barely feasible bins small.
    """
    best, bin_ = quality.max(dim=1, keepdim=True)
    share = quality**3
    total = share.sum(dim=1, keepdim=True)
    bins = quality.shape[1]
    angle = torch.where(total > 0, share / total.clamp(min=1e-12), 1 / bins)
    of_best = width.gather(1, bin_).nan_to_num(0.0)
    valid = torch.ones_like(best) if valid is None else valid.to(best.dtype)
    if offset is None:
        offset = quality.new_full((len(quality), 2, *best.shape[2:]), torch.nan)
    on_object = offset.isfinite().all(dim=1, keepdim=True).to(best.dtype)
    graspable = valid * (best >= graspable_from)
    return GraspTargets(best, angle, of_best, valid, graspable, offset.nan_to_num(0.0), on_object)


class GraspLoss(nn.Module):
    """Quality, angle and width losses, each averaged over its pixels in an image, then over images.

    The quality's loss is binary cross-entropy (nats); the angle's is cross-entropy against the
    target's whole distribution (nats); the width's is L1 in metres, so `width_weight` is per metre
    (10: one centimetre counts 0.1); the centre head's is L1 in pixels, so `centre_weight` is per
    pixel. Averaging image by image makes every image count alike, and makes the mean over processes
    with batches of equal size the loss of the joint batch.

    The default weights of quality, angle and width are 1, 1, 10 (the tutorial's are 1, 1, 0.5);
    configs/default.yaml trains with 10, 1, 50. All are given by name: the tutorial's first argument
    is another one, the weight of the angle.
    """

    def __init__(
        self,
        *,
        quality_weight: float = 1.0,
        angle_weight: float = 1.0,
        width_weight: float = 10.0,
        centre_weight: float = 0.1,
    ):
        super().__init__()
        self.quality_weight = quality_weight
        self.angle_weight = angle_weight
        self.width_weight = width_weight
        self.centre_weight = centre_weight

    def forward(
        self,
        quality_logits: torch.Tensor,
        angle_logits: torch.Tensor,
        width: torch.Tensor,
        targets: GraspTargets,
        offset: torch.Tensor | None = None,
        *tutorial: torch.Tensor,
    ) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Return the weighted sum, and its unweighted parts (detached scalars).

        The first three arguments, and `offset` of a network with a centre head, are the maps that
        the network returns with `logits` (and `centres`); half precision is widened here. Raises
        TypeError for the tutorial's call with seven tensors.
        """
        if tutorial or not isinstance(targets, GraspTargets):
            raise TypeError(
                "GraspLoss: expected (quality_logits, angle_logits, width, targets) with targets "
                "of models.graspnet.targets_from_labels; the tutorial's seven tensors allow only "
                "one angle per pixel, with which the angle head collapses"
            )
        quality = F.binary_cross_entropy_with_logits(
            quality_logits.float(), targets.quality, reduction="none"
        )
        angle = -(targets.angle * angle_logits.float().log_softmax(dim=1)).sum(1, keepdim=True)
        distance = (width.float() - targets.width).abs()
        quality_loss = mean_per_image(quality, targets.valid)
        angle_loss = mean_per_image(angle, targets.graspable)
        width_loss = mean_per_image(distance, targets.graspable)
        total = (
            self.quality_weight * quality_loss
            + self.angle_weight * angle_loss
            + self.width_weight * width_loss
        )
        parts = {"quality_loss": quality_loss, "angle_loss": angle_loss, "width_loss": width_loss}
        if offset is not None:
            off = (offset.float() - targets.offset).abs().sum(dim=1, keepdim=True)
            parts["centre_loss"] = mean_per_image(off, targets.on_object)
            total = total + self.centre_weight * parts["centre_loss"]
        return total, {name: part.detach() for name, part in parts.items()}


def mean_per_image(value: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """Average (B, ...) over each image by weight, then over images; no weight counts as 0."""
    summed = (value * weight).flatten(1).sum(1)
    return (summed / weight.flatten(1).sum(1).clamp(min=1e-6)).mean()


def main() -> None:
    """Print the number of parameters and the output shapes of every backbone, as the tutorial."""
    x = torch.randn(2, INPUT_CHANNELS, 224, 224)
    for name in BACKBONES:
        model = create_model(name=name)
        with torch.no_grad():
            quality, angle, width = model(x)
        print(f"{name}")
        print(f"  parameters: {sum(p.numel() for p in model.parameters()):,}")
        print(f"  input:      {tuple(x.shape)}")
        print(f"  quality:    {tuple(quality.shape)}")
        print(f"  angle:      {tuple(angle.shape)}")
        print(f"  width:      {tuple(width.shape)}")


if __name__ == "__main__":
    main()
