"""One scene in both simulators: python -m benchmarks.show_simulators --output FILE.png

Writes a picture of the cell and the images of its camera, PyBullet's left and MuJoCo's right, and
prints how far depth, segmentation and the settled objects' places differ; `seed` chooses the scene.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from envs.cell import Cell, Intrinsics
from envs.cell_scenes import LAYOUTS, make_scene
from envs.mujoco_cell import MujocoCell
from envs.objects import load_objects
from envs.simulators import cell_class
from envs.studio import SCENIC_EYE, SCENIC_TARGET
from utils.image_overlay import picture_path, write_picture
from utils.runs import parse_args, run_script
from utils.transforms import RGBDFrame, look_at

OUTPUT = Path("runs/show_simulators/simulators.png")
_SIDE = 320  # pixels of each picture of the camera
_DEEPEST, _HIGHEST = 0.81, 0.70  # m, black and white in the picture of depth


def main(argv: Sequence[str] | None = None) -> None:
    def options(parser: argparse.ArgumentParser) -> None:
        parser.add_argument(
            "--output", type=picture_path, default=OUTPUT, help=f"PNG or JPEG; default: {OUTPUT}"
        )
        parser.add_argument("--objects", default="random_urdfs", help="a named set or a folder")
        parser.add_argument("--layout", default="pile", choices=LAYOUTS)

    summary = "Show one scene in both simulators."
    config, chosen = parse_args(argv, summary, options, resumes=False)
    objects = load_objects(chosen.objects, config)
    scene = make_scene(chosen.layout, objects, config.seed, config)
    with cell_class("pybullet")(config) as bullet, MujocoCell(config) as mujoco:
        for cell in (bullet, mujoco):
            cell.build(scene)
        frames = bullet.frame(), mujoco.frame()
        rows = [
            [cv2.resize(scenic(cell), (2 * _SIDE, 3 * _SIDE // 2)) for cell in (bullet, mujoco)],
            [picture for frame in frames for picture in (colours(frame), depths(frame))],
        ]
        for cell in (bullet, mujoco):
            cell.load(scene)
        moved = [
            np.linalg.norm(bullet.object_position(i) - mujoco.object_position(i))
            for i in sorted(bullet.remaining)
        ]
    write_picture(chosen.output, np.vstack([np.hstack(row) for row in rows]))
    off = 1000 * np.abs(frames[0].depth - frames[1].depth)
    same = frames[0].segmentation == frames[1].segmentation
    print(
        f"depth differs by {np.median(off):.4f} mm in the median, by more than 1 mm at "
        f"{100 * (off > 1).mean():.2f} % of the pixels; segmentation is the same at "
        f"{100 * same.mean():.2f} %; settled objects lie {1000 * max(moved):.2f} mm apart at most"
    )
    print(f"wrote {chosen.output}")


def scenic(cell: Cell) -> np.ndarray:
    view = Intrinsics(640, 480, fov_deg=45.0, near=0.05, far=5.0)
    return cell.image(view, look_at(SCENIC_EYE, SCENIC_TARGET)).rgb


def colours(frame: RGBDFrame) -> np.ndarray:
    return cv2.resize(frame.rgb, (_SIDE, _SIDE), interpolation=cv2.INTER_NEAREST)


def depths(frame: RGBDFrame) -> np.ndarray:
    grey = np.clip((_DEEPEST - frame.depth) / (_DEEPEST - _HIGHEST), 0, 1)
    grey = np.repeat(np.uint8(255 * grey)[..., None], 3, axis=2)
    return cv2.resize(grey, (_SIDE, _SIDE), interpolation=cv2.INTER_NEAREST)


if __name__ == "__main__":
    run_script(main)
