"""GraspNet as an ONNX file for runtimes without PyTorch.

The graph takes `image`, (B, 4, H, W) float32 as `models.graspnet.to_input` makes it, for any B and
for H and W that are multiples of the backbone's stride; pad other sizes by repeating the last row
and column and crop the maps. It gives `quality`, `angle_logits` and `width` as `GraspNet.forward`
does; a centre head is left out. The file's metadata say what else has to be known.
"""

from __future__ import annotations

import json
from pathlib import Path

import torch
from torch.export import Dim

from models.graspnet_io import SavedGraspNet
from utils.errors import UserError
from utils.files import write_atomic

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
