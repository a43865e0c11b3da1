"""Ranked grasps for your own RGB-D image.

    python predict.py --rgb rgb.png --depth depth.png --intrinsics 615 615 320 240
    python predict.py ... --intrinsics intrinsics.json      # {"fx": 615, "fy": 615, "cx": 320, ...}
    python predict.py ... --camera-pose T_WC.txt --table-height 0.02    # grasps in your world, too
    python predict.py --export graspnet.onnx                            # the network for ONNX

--depth is a PNG, TIFF or NPY file of the colour image's size. Whole numbers are millimetres, floats
metres; --depth-scale sets another unit. --intrinsics are fx fy cx cy in pixels, with integers at
pixel centres, or a JSON file with these keys (and width and height, which are checked), as
`python -m envs.studio --rgbd FOLDER` writes it. --camera-pose is T_WC, 4x4, .npy, .txt, .json or
.yaml: it takes a point in the camera's optical frame (x right, y down, z forward) to the world,
whose z is up.

Without --table-height the table is the dominant plane of the depth image. Without --camera-pose
the gripper descends along that plane's normal. The program prints JSON, and writes it to
OUT/grasps.json with a picture in OUT/grasps.png; OUT is runs/predict/<name of the image>, with a
number where another image of that name was first. Each grasp has `pixel` (u, v) and `image_angle`
(from right towards down) on the image, `width` between the finger pads, and in `camera` and `world`
the pose of the middle between the pads, 7.2 mm above the lowest point of the fingertips: z along
the approach, y along the closing line. `quality` is the network's own score, and not a chance of
success, as planners state it (docs/planner.md). Units are metres and radians; quaternions are x, y,
z, w. If there is nothing to grasp the list is empty. Bad input ends with one sentence and status 2.
"""

from __future__ import annotations

import utils.installation  # noqa: F401 - ends in one sentence where a package is missing

# isort: split
import argparse
import itertools
import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from models.graspnet import check_rgbd
from models.graspnet_inference import PredictedGrasp, Prediction, predict, training_scale
from models.graspnet_io import SHIPPED, SavedGraspNet, load_graspnet
from utils.errors import UserError
from utils.image_overlay import is_prediction_panel, prediction_panel
from utils.images import read_depth, read_intrinsics, read_pose, read_rgb
from utils.runs import run_script, write_atomic
from utils.table_plane import Table, find_table, table_at_height
from utils.transforms import RGBDFrame, inverse_pose, position_quaternion

FORMAT = "robot-grasping grasps"  # marks a grasps.json of this program
VERSION = 1


def main(argv: Sequence[str] | None = None) -> int:
    options = parse_options(argv)
    saved = load_graspnet(options.checkpoint)
    if options.export is not None:
        from models.graspnet_io import export_onnx  # nothing else needs ONNX

        export_onnx(saved, options.export)
        print(f"wrote {options.export}", file=sys.stderr)
        return 0

    out = options.out or free_folder(Path("runs/predict") / options.rgb.stem, options.rgb)
    check_output(out)
    image = read_image(options)
    training_scale(image, saved.metres_per_pixel)  # wrong units fail here, not at the table
    table = locate_table(image, options)
    print(f"table: {table.describe()}", file=sys.stderr)
    frame = replace(image, T_WC=table.T_WC)
    found = predict(
        saved.model, saved.metres_per_pixel, frame, table.height, saved.gripper, options.count
    )

    text = json.dumps(as_plain(found, frame, table, options), indent=2, allow_nan=False)
    write_atomic(out / "grasps.png", picture(found, frame, saved))
    write_atomic(out / "grasps.json", text + "\n")
    print(text)
    print(f"wrote {out / 'grasps.json'} and {out / 'grasps.png'}", file=sys.stderr)
    return 0


def parse_options(argv: Sequence[str] | None) -> argparse.Namespace:
    summary, _, details = __doc__.partition("\n\n")
    parser = argparse.ArgumentParser(
        description=summary, epilog=details, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rgb", type=Path, metavar="FILE", help="colour image, PNG or JPEG")
    parser.add_argument("--depth", type=Path, metavar="FILE", help="depth, PNG, TIFF or NPY")
    parser.add_argument("--depth-scale", type=float, metavar="S", help="metres for 1 in the file")
    parser.add_argument(
        "--intrinsics", nargs="+", metavar="F", help="fx fy cx cy, or a JSON file with these keys"
    )
    parser.add_argument("--camera-pose", type=Path, metavar="FILE", help="T_WC, 4x4")
    parser.add_argument("--table-height", type=float, metavar="Z", help="m in the world")
    parser.add_argument("--checkpoint", type=Path, metavar="FILE", default=SHIPPED)
    parser.add_argument(
        "--out", type=Path, metavar="FOLDER", help="default: runs/predict/<name of the image>"
    )
    parser.add_argument("--count", type=int, metavar="N", help="largest number of grasps; 20")
    parser.add_argument("--export", type=Path, metavar="FILE.onnx", help="write the network")
    options = parser.parse_args(argv)
    image = [options.rgb, options.depth, options.intrinsics]
    others = [options.depth_scale, options.camera_pose, options.table_height, options.out]
    others += [*image, options.count]
    if options.export is not None and any(part is not None for part in others):
        raise UserError("--export writes the network and takes only --checkpoint beside it")
    if options.export is None and any(part is None for part in image):
        raise UserError("--rgb, --depth and --intrinsics are needed (or --export FILE.onnx)")
    options.count = 20 if options.count is None else options.count
    if options.count < 1:
        raise UserError(f"--count: got {options.count}, expected at least 1")
    if options.table_height is not None:
        if options.camera_pose is None:
            raise UserError("--table-height is a height in the world: it needs --camera-pose")
        if not np.isfinite(options.table_height):
            raise UserError(f"--table-height: got {options.table_height}, expected metres")
    return options


def free_folder(folder: Path, rgb: Path) -> Path:
    """`folder`, or `folder`-2, -3, ...: the first that holds no grasps of another image."""
    for number in itertools.count(1):
        numbered = folder if number == 1 else folder.with_name(f"{folder.name}-{number}")
        before = own_json(numbered / "grasps.json")
        if before is None or Path(before["rgb"]).resolve() == rgb.resolve():
            return numbered
    raise AssertionError("itertools.count ended")


def check_output(folder: Path) -> None:
    """Raise UserError where the results would overwrite files of another program."""
    if folder.exists() and not folder.is_dir():
        raise UserError(f"--out {folder}: exists and is no folder")
    text, drawing = folder / "grasps.json", folder / "grasps.png"
    for path, own in (
        (text, own_json(text) is not None),
        (drawing, is_prediction_panel(drawing)),
    ):
        if path.exists() and not own:
            raise UserError(f"{path}: exists and was not written by predict.py; give another --out")


def own_json(path: Path) -> dict[str, Any] | None:
    """The content of a grasps.json of this program; None if the file is something else."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        Path(content["rgb"]).resolve()
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        return None
    return content if content.get("format") == FORMAT else None


def read_image(options: argparse.Namespace) -> RGBDFrame:
    """The image as a frame whose world is the camera's frame, until the table is known."""
    rgb, depth = read_rgb(options.rgb), read_depth(options.depth, options.depth_scale)
    check_rgbd(rgb, depth)
    K = read_intrinsics(options.intrinsics, rgb.shape[1], rgb.shape[0])
    return RGBDFrame(rgb, depth, K, np.eye(4))


def locate_table(image: RGBDFrame, options: argparse.Namespace) -> Table:
    """The table, and the camera above it.

    Without --camera-pose the table defines the world, see `utils.table_plane.Plane.camera_pose`.
    """
    T_WC = None if options.camera_pose is None else read_pose(options.camera_pose)
    if options.table_height is None:
        return find_table(image.points(), T_WC)
    return table_at_height(options.table_height, image.points(), T_WC)


def as_plain(
    found: Prediction, frame: RGBDFrame, table: Table, options: argparse.Namespace
) -> dict[str, Any]:
    """The content of grasps.json."""
    T_CW, posed = inverse_pose(frame.T_WC), options.camera_pose is not None
    return {
        "format": FORMAT,
        "version": VERSION,
        "rgb": str(options.rgb),
        "depth": str(options.depth),
        "checkpoint": str(options.checkpoint),
        "K": frame.K.tolist(),
        "T_WC": frame.T_WC.tolist() if posed else None,
        "table": {
            "estimated": table.share is not None,
            "normal_camera": T_CW[:3, 2].tolist(),
            "camera_height": float(frame.T_WC[2, 3] - table.height),
            "height_world": table.height if posed else None,
        },
        "grasps": [grasp_as_plain(grasp, T_CW, posed) for grasp in found.grasps],
    }


def grasp_as_plain(grasp: PredictedGrasp, T_CW: np.ndarray, posed: bool) -> dict[str, Any]:
    plain = {
        "quality": grasp.in_world.quality,
        "pixel": grasp.on_image.pixel.tolist(),
        "image_angle": grasp.on_image.angle,
        "width": grasp.in_world.width,
        "camera": pose_as_plain(T_CW @ grasp.in_world.pose),
    }
    if posed:
        plain["world"] = {**pose_as_plain(grasp.in_world.pose), "angle": grasp.in_world.angle}
    return plain


def pose_as_plain(T: np.ndarray) -> dict[str, Any]:
    position, quaternion = position_quaternion(T)
    return {
        "position": position.tolist(),
        "rotation": T[:3, :3].tolist(),
        "quaternion": quaternion.tolist(),
    }


def picture(found: Prediction, frame: RGBDFrame, saved: SavedGraspNet) -> bytes:
    return prediction_panel(
        frame.rgb,
        frame.K,
        [grasp.on_image for grasp in found.grasps],
        found.quality,
        found.angle,
        found.width,
        saved.model.max_width,
    )


if __name__ == "__main__":
    run_script(main)
