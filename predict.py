"""Ranked grasps for your own RGB-D image, of all that it shows or of one object.

    python predict.py --rgb rgb.png --depth depth.png --intrinsics 615 615 320 240
    python predict.py ... --intrinsics camera.json          # {"fx": 615, "fy": 615, "cx": 320, ...}
    python predict.py ... --camera-pose T_WC.txt --table-height 0.02    # grasps in your world, too
    python predict.py ... --point 312 200                   # grasp that one
    python predict.py --export graspnet.onnx                            # the network for ONNX

Both images are those of a pinhole (undistorted), and the depth is registered to the colour image:
--depth is a PNG, TIFF or NPY file of its size. Whole numbers are millimetres, floats metres;
--depth-scale sets another unit, and --from-base reads distances from a robot's base, as Cornell's
data set has them. --intrinsics are fx fy cx cy in pixels, with integers at pixel centres, or a JSON
or YAML file with these keys, as `python -m envs.studio --rgbd FOLDER` writes it, or with K as ROS
and Open3D write it; width and height in it are checked. --camera-pose is T_WC, 4x4, .npy, .txt,
.json or .yaml: it takes a point in the camera's optical frame (x right, y down, z forward) to the
world, whose z is up.

The grasps are those of a planner (docs/planner.md): --planner graspnet, graspnet_direct, heuristic,
heuristic6d, whose hand comes from any side, or graspnet6d, which leans it where it has to.
--checkpoint takes a network of your own. The planner works on the square of the table that holds
all matter above it, or on --workspace X Y SIZE, its centre and side in the world. One object is
named by a pixel on it (--point U V), by a box drawn around it (--box U0 V0 U1 V1), or by its pixels
(--mask FILE, a PNG or NPY of the image's size, not 0 where the object is), which alone part two
objects that touch where the planner sees one, and join the pieces in which planners with a network
see one of more than 10 cm. Then all grasps are of that object, and
`clearing` holds grasps that first move aside what is in its way.

Without --table-height the table is the dominant plane of the depth image. Without --camera-pose the
table's normal is up. The program prints JSON, on a terminal a table, and writes the JSON to
OUT/grasps.json with a picture in OUT/grasps.png; OUT is runs/predict/<time>-<name of the image>, or
the folder of --out, where they replace an earlier run's. Each grasp has `pixel` (u, v) and
`image_angle` (from right towards down), where its position and closing line lie on the image,
`width` between the finger pads, `tilt` of the approach from the table's normal, and in `camera` and
`world` the pose of the middle between the pads, 7.2 mm above the lowest point of the fingertips: z
along the approach, y along the closing line. `quality` is the chance of success where `calibrated`,
beside `grasps`, is true, and else the planner's score. A robot here tries none under 0.5; planners
from any side prefer steep approaches to slightly likelier ones. Units are metres and radians;
quaternions are x, y, z, w. If there is nothing to grasp the list is empty. `remarks` say what to
mistrust. Bad input, and an object that was named and that no grasp reaches, end with one sentence
and status 2.
"""

from __future__ import annotations

import utils.installation  # noqa: F401 - ends in one sentence where a package is missing

# isort: split
import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from models.graspnet_io import SHIPPED, SavedGraspNet, export_onnx, load_graspnet
from models.planner_antipodal import SearchPlanner
from models.planner_target import TargetPlanner, check_reached, find_target, least_width
from models.planners import PLANNERS as ALL_PLANNERS
from models.planners import make_planner
from utils.atomic_files import check_writable, write_atomic
from utils.calibration import unlikely_ones
from utils.camera_files import read_intrinsics, read_pose
from utils.depth_holes import check_rgbd
from utils.errors import UserError, unknown_choice
from utils.geometry import GripperGeometry, Workspace
from utils.grasp_files import MARK, check_output, format_grasps, grasps_as_plain, scene_as_plain
from utils.image_overlay import grasp_picture
from utils.images import read_depth, read_mask, read_rgb
from utils.run_checks import check_place
from utils.runs import collected_remarks, portable_name, run_script, timed_folder
from utils.target import marked_pixels
from utils.transforms import RGBDFrame
from utils.user_view import (
    as_depths,
    check_found,
    check_mask,
    check_view,
    chosen_workspace,
    corrected_view,
    locate_table,
)

FOLDER = Path("runs/predict")
NETWORK_PLANNERS = ("graspnet", "graspnet_direct", "graspnet6d")
PLANNERS = (*NETWORK_PLANNERS, "heuristic", "heuristic6d")  # those that see the image alone


def main(argv: Sequence[str] | None = None) -> int:
    options = parse_options(argv)
    if options.export is not None:
        check_writable("--export", options.export)
        export_onnx(load_graspnet(options.checkpoint or SHIPPED), options.export)
        print(f"wrote {options.export}", file=sys.stderr)
        return 0
    if options.out is not None:
        check_output(options.out)
    check_place(options.out or FOLDER)
    with collected_remarks() as told:
        image = read_image(options)
    mask = None if options.mask is None else read_mask(options.mask, image.depth.shape)
    network = options.planner in NETWORK_PLANNERS
    saved = load_graspnet(options.checkpoint or SHIPPED) if network else None
    T_WC = None if options.camera_pose is None else read_pose(options.camera_pose)
    table = locate_table(image, T_WC, options.table_height)
    print(f"table: {table.describe()}", file=sys.stderr)
    if T_WC is not None:
        x, y, z = T_WC[:3, 3]
        print(f"camera: at ({x:.3f}, {y:.3f}, {z:.3f}) m in your world", file=sys.stderr)
    taken = replace(image, T_WC=table.T_WC)  # which the planner corrects itself
    frame, scaled = corrected_view(taken, table.height)
    marked = marked_pixels(frame.depth.shape, options.point, options.box, mask)
    workspace, cut = chosen_workspace(frame, table.height, options.workspace, marked)
    remarks = [
        *told,
        *table.remarks(),
        *scaled,
        *cut,
        *check_view(frame, workspace, options.table_height is not None),
    ]
    with collected_remarks() as more:
        planner = new_planner(options, saved, workspace)
    target = find_target(planner, taken, frame, options.point, options.box, mask)
    taken, frame = replace(taken, target=target), replace(frame, target=target)

    found, clearing = planner(taken), None
    grasps = found[: options.count]
    if target is not None:
        clearing = TargetPlanner(planner).clearing(taken, found)[: options.count]
        width, opening = least_width(frame, table.height), planner.gripper.max_opening
        remarks += [*check_mask(mask), *check_reached(grasps, clearing, width, opening)]
    else:
        remarks += check_found(len(grasps), frame, workspace)
    remarks += more
    if planner.calibration is not None:
        remarks += unlikely_ones(grasps) + unlikely_ones(clearing or [], "grasps of `clearing`")
    content = {
        **MARK,
        "rgb": str(options.rgb),
        "depth": str(options.depth),
        "planner": options.planner,
        "checkpoint": str(options.checkpoint or SHIPPED) if network else None,
        "calibrated": planner.calibration is not None,
        **scene_as_plain(frame, table, workspace, T_WC is not None),
        "grasps": grasps_as_plain(grasps, frame, T_WC is not None),
        "clearing": None
        if clearing is None
        else grasps_as_plain(clearing, frame, T_WC is not None),
        "remarks": remarks,
    }
    text = json.dumps(content, indent=2, allow_nan=False)
    out = options.out or timed_folder(FOLDER, portable_name(options.rgb.stem))
    verb = "replaced" if (out / "grasps.json").exists() else "wrote"
    write_atomic(out / "grasps.png", grasp_picture(frame, grasps, clearing or []))
    write_atomic(out / "grasps.json", text + "\n")
    print(format_grasps(content) if sys.stdout.isatty() else text)
    for remark in remarks:
        print(f"remark: {remark}", file=sys.stderr)
    print(f"{verb} {out / 'grasps.json'} and {out / 'grasps.png'}", file=sys.stderr)
    return 0


def parse_options(argv: Sequence[str] | None) -> argparse.Namespace:
    summary, _, details = __doc__.partition("\n\n")
    parser = argparse.ArgumentParser(
        description=summary, epilog=details, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rgb", type=Path, metavar="FILE", help="colour image, PNG or JPEG")
    parser.add_argument("--depth", type=Path, metavar="FILE", help="depth, PNG, TIFF or NPY")
    parser.add_argument("--depth-scale", type=float, metavar="S", help="metres for 1 in the file")
    base = "--depth holds distances from a robot's base, as Cornell's images do"
    parser.add_argument("--from-base", action=argparse.BooleanOptionalAction, help=base)
    lens = "fx fy cx cy, or a JSON or YAML file with them or K"
    parser.add_argument("--intrinsics", nargs="+", metavar="F", help=lens)
    parser.add_argument("--camera-pose", type=Path, metavar="FILE", help="T_WC, 4x4")
    parser.add_argument("--table-height", type=float, metavar="Z", help="m in the world")
    parser.add_argument("--planner", metavar="NAME", help=f"{', '.join(PLANNERS)}")
    parser.add_argument("--checkpoint", type=Path, metavar="FILE", help="a network of your own")
    parser.add_argument(
        "--workspace", type=float, nargs=3, metavar=("X", "Y", "SIZE"), help="m in the world"
    )
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--point", type=float, nargs=2, metavar=("U", "V"), help="on the object")
    corners, around = ("U0", "V0", "U1", "V1"), "around the object, corners in any order"
    which.add_argument("--box", type=float, nargs=4, metavar=corners, help=around)
    which.add_argument("--mask", type=Path, metavar="FILE", help="the object's pixels, PNG or NPY")
    parser.add_argument(
        "--out", type=Path, metavar="FOLDER", help="default: runs/predict/<time>-<name of --rgb>"
    )
    parser.add_argument("--count", type=int, metavar="N", help="largest number of grasps; 20")
    parser.add_argument("--export", type=Path, metavar="FILE.onnx", help="write the network")
    options = parser.parse_args(argv)
    image = {name: getattr(options, name) for name in ("rgb", "depth", "intrinsics")}
    others = [options.depth_scale, options.camera_pose, options.table_height, options.out]
    others += [*image.values(), options.count, options.planner, options.workspace]
    others += [options.point, options.box, options.mask, options.from_base]
    if options.export is not None and any(part is not None for part in others):
        raise UserError("--export writes the network and takes only --checkpoint beside it")
    if options.export is None and (missing := [k for k, part in image.items() if part is None]):
        lacking = ", ".join(f"--{name}" for name in missing)
        raise UserError(f"missing: {lacking}; an image takes --rgb, --depth and --intrinsics")
    options.planner = options.planner or PLANNERS[0]
    if options.planner not in PLANNERS:
        raise unknown_choice("--planner", options.planner, PLANNERS)
    if options.checkpoint is not None and options.planner not in NETWORK_PLANNERS:
        raise UserError(f"--checkpoint: {options.planner} has no network; omit one of the two")
    options.count = 20 if options.count is None else options.count
    if options.count < 1:
        raise UserError(f"--count: got {options.count}, expected at least 1")
    if options.table_height is not None:
        if options.camera_pose is None:
            raise UserError("--table-height is a height in the world: it needs --camera-pose")
        if not np.isfinite(options.table_height):
            raise UserError(f"--table-height: got {options.table_height}, expected metres")
    for name in ("point", "box"):
        marked = getattr(options, name)
        if marked is not None and not np.isfinite(marked).all():
            raise UserError(f"--{name} {' '.join(map(str, marked))}: expected pixels")
    if options.workspace is not None and options.camera_pose is None:
        raise UserError("--workspace is a square in the world: it needs --camera-pose")
    return options


def read_image(options: argparse.Namespace) -> RGBDFrame:
    """The image as a frame whose world is the camera's frame, until the table is known."""
    rgb, depth = read_rgb(options.rgb), read_depth(options.depth, options.depth_scale)
    check_rgbd(rgb, depth)
    K = read_intrinsics(options.intrinsics, rgb.shape[1], rgb.shape[0])
    return RGBDFrame(rgb, as_depths(depth, K, options.from_base), K, np.eye(4))


def new_planner(
    options: argparse.Namespace, saved: SavedGraspNet | None, workspace: Workspace
) -> SearchPlanner:
    """The planner, which gives as many grasps as were asked for, or as usual."""
    if saved is None or options.checkpoint is None:
        planner = make_planner(options.planner, GripperGeometry(), workspace, 0, "--planner")
    else:
        make = ALL_PLANNERS[options.planner]
        planner = make(saved.gripper, workspace, checkpoint=options.checkpoint)
    planner.return_at_least(options.count)
    return planner


if __name__ == "__main__":
    run_script(main)
