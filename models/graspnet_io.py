"""GraspNet on disk: the checkpoint that training, planner and `predict.py` share, and ONNX.

A checkpoint holds weights, architecture, config and the pixel size of the training images. An ONNX
file holds the network for runtimes without PyTorch (`export_onnx`). This module knows neither how a
network is trained nor what it is used for.
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
from utils.atomic_files import write_atomic
from utils.checkpoint import (
    build_model,
    load_checkpoint,
    load_weights,
    reading,
    save_checkpoint,
)
from utils.errors import UserError
from utils.geometry import GripperGeometry

SHIPPED = Path(__file__).resolve().parent.parent / "checkpoints" / "graspnet.pt"
KIND = "graspnet"  # also of training checkpoints, which hold an optimiser as well
CENTRE_HEAD = "centre_head."  # the names of its weights begin so
PIXEL_SIZE = "metres_per_pixel"  # the entry of the pixel size in a checkpoint's `extra`
# Of ONNX files; the name marks those that `export_onnx` may replace.
PRODUCER = "robot-grasping"
OPSET = 18
OUTPUTS = ("quality", "angle_logits", "width")


class SavedGraspNet(NamedTuple):
    """A network and the facts that are needed to use it.

    model: in evaluation mode. metres_per_pixel: the length that one pixel of a training image spans
    at the image's median depth; convolutions know no other scale. config: the resolved config as
    plain data. extra: other plain data that was saved, such as scores.
    """

    model: GraspNet
    metres_per_pixel: float
    config: dict[str, Any]
    extra: dict[str, Any]

    @property
    def gripper(self) -> GripperGeometry:
        """The hand that the network was trained for: the section `gripper` of its config. A config
        from before that section existed means the Panda's own hand."""
        return GripperGeometry(**self.config.get("gripper", {}))


def metres_per_pixel(K: np.ndarray, depth: float) -> float:
    """Return the length that one pixel of a camera with matrix K (3, 3) spans at a depth in m."""
    return 2 * depth / float(K[0, 0] + K[1, 1])


def save_graspnet(
    path: Path | str,
    model: GraspNet,
    metres_per_pixel: float,
    config: dict[str, Any] | None = None,
    **extra: Any,
) -> None:
    """Write a network for use, in half precision and without the state of its training.

    model: the bare module, not its DistributedDataParallel. metres_per_pixel, config, extra: see
    SavedGraspNet. Raises TypeError for values that could not be loaded again.
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
        half_precision=True,
    )


def load_graspnet(path: Path | str) -> SavedGraspNet:
    """Load a network onto the CPU from a file of `save_graspnet` or from a training checkpoint.

    Raises UserError, naming the file, if it is missing, damaged, no GraspNet of this project, of
    another version or architecture, or holds weights that are not finite.
    """
    checkpoint = load_checkpoint(path, KIND)
    model = build_model(GraspNet, checkpoint, path)
    extra = dict(checkpoint["extra"])
    pixel_size = extra.pop(PIXEL_SIZE, None)
    if not isinstance(pixel_size, float) or not 0 < pixel_size < np.inf:
        raise UserError(f"{path}: does not hold the pixel size of its images ({PIXEL_SIZE})")
    saved = SavedGraspNet(model, pixel_size, checkpoint["config"], extra)
    with reading(path):
        opening = saved.gripper.max_opening
        if not min(opening, model.max_width) > 0:
            raise ValueError(f"its hand opens {opening} m, its widths end at {model.max_width} m")
    return saved


def load_initial(model: GraspNet, path: Path | str, quiet: bool = False) -> None:
    """Copy the weights of a saved network into a new one of the same backbone.

    A centre head that only the saved network has is left out; one that only the new network has
    keeps its random weights. The widths of the new one end at its own `max_width`; unless
    `quiet`, a remark is printed where the saved one ended elsewhere. Raises UserError as
    `load_graspnet` does, and if the weights do not fit.
    """
    saved = load_graspnet(path).model
    if saved.max_width != model.max_width and not quiet:
        print(
            f"{path}: its widths end at {saved.max_width:g} m, the new network's at "
            f"{model.max_width:g} m; they are {model.max_width / saved.max_width:.2g} times as "
            "large until the training corrects them (train.max_width)"
        )
    weights = saved.state_dict()
    if model.centre_head is None or saved.centre_head is None:
        weights = {name: w for name, w in weights.items() if not name.startswith(CENTRE_HEAD)}
        own = {n: w for n, w in model.state_dict().items() if n.startswith(CENTRE_HEAD)}
        weights |= own
    load_weights(model, {"model": weights}, path)


def for_inference(model: GraspNet, dtype: torch.dtype = torch.float32) -> GraspNet:
    """Return a faster copy with the same maps up to rounding; it cannot be trained or saved.

    Every batch normalisation is folded into the convolution before it, and the weights are stored
    channels last, the order in which CPU convolutions are fastest. dtype: of the backbone; the
    heads stay float32, for a map rounded to bfloat16 has plateaus where it should have peaks.
    """
    fast = copy.deepcopy(model).eval().requires_grad_(False)
    for sequence in [module for module in fast.modules() if isinstance(module, nn.Sequential)]:
        for i in range(len(sequence) - 1):
            layer, norm = sequence[i : i + 2]
            if isinstance(norm, nn.BatchNorm2d):
                transposed = isinstance(layer, nn.ConvTranspose2d)
                sequence[i] = fuse_conv_bn_eval(layer, norm, transpose=transposed)
                sequence[i + 1] = nn.Identity()
    fast.backbone.to(dtype)
    return fast.to(memory_format=torch.channels_last)


def fastest_dtype() -> torch.dtype:
    """The number format in which this CPU's convolutions are fastest: bfloat16 where its matrix
    unit takes it (Intel's AMX), else float32.

    Without the unit bfloat16 is slower than float32, even on CPUs with instructions for it.
    """
    matrix_unit = torch.cpu.get_capabilities().get("amx_bf16", False)
    return torch.bfloat16 if matrix_unit else torch.float32


def export_onnx(saved: SavedGraspNet, path: Path) -> None:
    """Write the network as an ONNX file; an older export at `path` is replaced.

    The graph takes `image`, (B, 4, H, W) float32 as `models.graspnet.to_input` makes it, for any B
    and for H and W that are multiples of the backbone's stride; pad other sizes by repeating the
    last row and column, and crop the maps. It returns `quality`, `angle_logits` and `width` as
    `GraspNet.forward` does; a centre head is left out. The file's metadata hold the architecture,
    the stride and the pixel size. Raises UserError if another file lies at `path`.
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
    write_atomic(path, onnx_model.SerializeToString())


def check_export_path(path: Path) -> None:
    """Raise UserError unless the path is free or holds an export of this project."""
    import onnx  # takes a second to import and is needed here alone

    if not path.exists():
        return
    try:
        exported_here = onnx.load(path, load_external_data=False).producer_name == PRODUCER
    except Exception:  # protobuf and onnx raise several types for other files
        exported_here = False
    if not exported_here:
        raise UserError(f"{path}: exists and is no export of this program; give another name")
