"""GraspNet on disk: the one format that training, planner and `predict.py` share.

A file holds weights, architecture, config and the pixel size of the training images. This module
knows neither how a network is trained nor what it is used for.

GraspNet as an ONNX file for runtimes without PyTorch.

The graph takes `image`, (B, 4, H, W) float32 as `models.graspnet.to_input` makes it, for any B and
for H and W that are multiples of the backbone's stride; pad other sizes by repeating the last row
and column and crop the maps. It gives `quality`, `angle_logits` and `width` as `GraspNet.forward`
does; a centre head is left out. The file's metadata say what else has to be known.
"""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import nn
from torch.export import Dim
from torch.nn.utils.fusion import fuse_conv_bn_eval

from models.graspnet import GraspNet
from utils.checkpoint import load_checkpoint, load_weights, save_checkpoint
from utils.errors import UserError
from utils.runs import write_atomic

SHIPPED = Path(__file__).resolve().parent.parent / "checkpoints" / "graspnet.pt"
KIND = "graspnet"  # also of training checkpoints, which hold an optimiser besides
CENTRE_HEAD = "centre_head."  # how the names of its weights begin
PIXEL_SIZE = "metres_per_pixel"  # its entry in a checkpoint's `extra`


class SavedGraspNet(NamedTuple):
    """model: in evaluation mode. metres_per_pixel: what one pixel of a training image spans at the
    image's median depth; convolutions know no other scale. config: the resolved config, plain.
    extra: anything else plain that was saved, such as metrics."""

    model: GraspNet
    metres_per_pixel: float
    config: dict[str, Any]
    extra: dict[str, Any]


def metres_per_pixel(K: np.ndarray, depth: float) -> float:
    """What one pixel of a camera with matrix K (3, 3) spans at a depth in metres."""
    return 2 * depth / float(K[0, 0] + K[1, 1])


def save_graspnet(
    path: Path | str,
    model: GraspNet,
    metres_per_pixel: float,
    config: dict[str, Any] | None = None,
    **extra: Any,
) -> None:
    """Write a network for use, without what only training needs.

    model: the bare module, not its DistributedDataParallel. metres_per_pixel, config, extra: see
    SavedGraspNet. Raises TypeError for what could not be loaded again.
    """
    if not 0 < metres_per_pixel < np.inf:
        raise ValueError(f"metres_per_pixel must be > 0 and finite, got {metres_per_pixel}")
    save_checkpoint(
        path,
        kind=KIND,
        model_args=model.model_args,
        model=model,
        config=config,
        extra={**extra, PIXEL_SIZE: float(metres_per_pixel)},
    )


def load_graspnet(path: Path | str, map_location: str | torch.device = "cpu") -> SavedGraspNet:
    """The network in a file of `save_graspnet`, or in a training checkpoint of kind `KIND` whose
    `extra` holds `PIXEL_SIZE`.

    Raises UserError, naming the file, if it is missing, damaged, no GraspNet of ours, of another
    version or architecture, or holds weights that are not finite.
    """
    checkpoint = load_checkpoint(path, KIND, map_location=map_location)
    try:
        model = GraspNet(**checkpoint["model_args"])
    except (TypeError, ValueError, RuntimeError) as error:  # UserError is a ValueError
        raise UserError(f"{path}: a checkpoint of another architecture: {error}") from None
    load_weights(model, checkpoint, path)
    if not all(bool(torch.isfinite(value).all()) for value in model.state_dict().values()):
        raise UserError(f"{path}: holds weights that are not finite; its training has diverged")
    extra = dict(checkpoint["extra"])
    pixel_size = extra.pop(PIXEL_SIZE, None)
    if not isinstance(pixel_size, float) or not 0 < pixel_size < np.inf:
        raise UserError(f"{path}: does not say the pixel size it was trained at ({PIXEL_SIZE})")
    return SavedGraspNet(model.to(map_location).eval(), pixel_size, checkpoint["config"], extra)


def load_initial(model: GraspNet, path: Path | str) -> None:
    """Put the weights of a saved network into a new one of the same backbone.

    A centre head that only the saved one has is left out; one that only the new one has keeps its
    random weights. Raises UserError as `load_graspnet` does, and if the weights do not fit.
    """
    saved = load_graspnet(path).model
    weights = saved.state_dict()
    if model.centre_head is None or saved.centre_head is None:
        weights = {name: w for name, w in weights.items() if not name.startswith(CENTRE_HEAD)}
        own = {n: w for n, w in model.state_dict().items() if n.startswith(CENTRE_HEAD)}
        weights |= own
    load_weights(model, {"model": weights}, path)


def for_inference(model: GraspNet) -> GraspNet:
    """A faster copy that gives the same maps up to rounding; it cannot be trained or saved.

    Every batch normalisation is folded into the convolution before it, and weights lie channels
    last, the order that CPU convolutions like best.
    """
    fast = copy.deepcopy(model).eval().requires_grad_(False)
    for sequence in [module for module in fast.modules() if isinstance(module, nn.Sequential)]:
        for i in range(len(sequence) - 1):
            layer, norm = sequence[i : i + 2]
            if isinstance(norm, nn.BatchNorm2d):
                transposed = isinstance(layer, nn.ConvTranspose2d)
                sequence[i] = fuse_conv_bn_eval(layer, norm, transpose=transposed)
                sequence[i + 1] = nn.Identity()
    return fast.to(memory_format=torch.channels_last)


PRODUCER = "robot-grasping"
OPSET = 18
OUTPUTS = ("quality", "angle_logits", "width")


def export_onnx(saved: SavedGraspNet, path: Path) -> None:
    """Write the network whole or not at all; an older export at `path` is replaced.

    Raises UserError if something else lies there.
    """
    check_export_path(path)
    model = saved.model.cpu().eval()
    stride = model.backbone.stride
    example = torch.zeros(2, model.input_channels, 3 * stride, 4 * stride)
    # Sides are declared as multiples of the stride, so GraspNet's own padding falls away.
    shape = {0: Dim("batch"), 2: stride * Dim("rows"), 3: stride * Dim("columns")}
    program = torch.onnx.export(
        model,
        (example,),
        dynamo=True,
        opset_version=OPSET,
        input_names=["image"],
        output_names=list(OUTPUTS),
        dynamic_shapes={"x": shape},
        verbose=False,
    )
    onnx_model = program.model_proto
    onnx_model.producer_name = PRODUCER
    described = {
        **{key: value for key, value in model.model_args.items() if key != "centre_head"},
        "stride": stride,
        "metres_per_pixel": saved.metres_per_pixel,
    }
    for key, value in described.items():
        onnx_model.metadata_props.add(key=key, value=json.dumps(value))
    try:
        write_atomic(path, onnx_model.SerializeToString())
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror}") from None


def check_export_path(path: Path) -> None:
    """Raise UserError unless the path is free or holds an export of ours."""
    import onnx  # takes a second to import and is needed for nothing else

    if not path.exists():
        return
    try:
        ours = onnx.load(path, load_external_data=False).producer_name == PRODUCER
    except Exception:  # protobuf and onnx raise several types for what is not ONNX
        ours = False
    if not ours:
        raise UserError(f"{path}: exists and is no export of this program; give another name")
