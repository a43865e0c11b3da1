"""The fan of views and the grasps chosen from it: python -m benchmarks.show_fan --output FILE.png

FILE_views.png shows the height maps of the first scene from each direction of the fan; FILE.png
shows the arm at the grasp that the planner prefers in each of some scenes, seen across its tilt.
Options choose the planner and the scenes, and, as with every script, keys of the config; with
evaluate.second_look the planner gets a second frame where it is worth it.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from envs.cell import Cell, Intrinsics
from envs.cell_scenes import make_scene
from envs.evaluation_worker import new_planner
from envs.execution import reaches
from envs.next_grasp import first_untried, within_reach
from envs.objects import load_objects
from envs.robot_kinematics import choose_posture
from envs.second_look import CM3, SecondLook
from envs.simulators import make_cell
from models.planner_fan import FanPlanner
from models.planners import needs_truth
from utils.errors import UserError
from utils.height_map import HeightMap, height_map_from_frame, tilted_height_map, tilted_view
from utils.image_overlay import contact_sheet, picture_path, write_picture
from utils.runs import parse_args, run_script
from utils.seen_heights import without_holes
from utils.transforms import Grasp, RGBDFrame, look_at

OUTPUT = Path("runs/show_fan/fan.png")
_VIEW = Intrinsics(360, 300, fov_deg=34.0, near=0.05, far=3.0)
_SHOWN = 0.12  # m of height between black and white


def main(argv: Sequence[str] | None = None) -> None:
    def options(parser: argparse.ArgumentParser) -> None:
        parser.add_argument(
            "--output", type=picture_path, default=OUTPUT, help=f"PNG or JPEG; default: {OUTPUT}"
        )
        parser.add_argument("--planner", default="graspnet6d", help="one that grasps from any side")
        parser.add_argument("--layout", default="pile", help="of the scenes, a key of scenarios")
        parser.add_argument("--scenes", type=int, default=10, help="how many, from the seed on")

    summary = "Draw a fan of views and the grasps chosen from it."
    config, chosen = parse_args(argv, summary, options, resumes=False)
    planner = new_planner(chosen.planner, config)
    if not isinstance(planner, FanPlanner):
        raise UserError(f"--planner: {chosen.planner} grasps from straight above alone")
    objects = load_objects(config.evaluate.object_sets[0], config)
    pictures, captions = [], []
    with make_cell(config) as cell:
        for seed in range(config.seed, config.seed + chosen.scenes):
            cell.load(make_scene(chosen.layout, objects, seed, config))
            least = 0.0 if needs_truth(planner) else config.evaluate.second_look * CM3
            look_again = SecondLook(cell, least, calibrated=lambda second: second)
            frame = look_again(partial(cell.frame, needs_truth(planner)))
            if not pictures:
                path = chosen.output.with_stem(f"{chosen.output.stem}_views")
                write_picture(path, views(planner, frame.without_truth()))
                print(f"wrote {path}")
            grasps = planner(frame)
            grasp = first_untried(within_reach(cell, grasps), [])
            if grasp is None:
                continue
            pictures.append(at_grasp(cell, grasp))
            captions.append(f"scene {seed}: {np.degrees(grasp.tilt):.0f} degrees")
    write_picture(chosen.output, contact_sheet(pictures, captions, columns=5))
    print(f"wrote {chosen.output}")


def views(planner: FanPlanner, frame: RGBDFrame) -> np.ndarray:
    """(H, W, 3) uint8: the frame's height maps in the views of the fan. Bright is near the hand;
    what the camera has not seen is red, up to where it may reach."""
    overhead = height_map_from_frame(frame, planner.workspace)
    filled, hiding = without_holes(frame, planner.workspace)
    pictures, captions = [], []
    for approach in planner.fan.directions():
        T_WV = tilted_view(approach, planner.workspace)
        heights = tilted_height_map(overhead, filled, hiding, T_WV)
        pictures.append(shaded(heights))
        tilt = np.degrees(np.arccos(-approach[2]))
        towards = np.degrees(np.arctan2(approach[1], approach[0])) % 360
        captions.append(f"{tilt:.0f}, towards {towards:.0f}" if tilt else "straight down")
    return contact_sheet(pictures, captions, columns=6)


def shaded(heights: HeightMap) -> np.ndarray:
    """(H, W, 3) uint8: heights over the middle of the table, in grey, what is hidden in red."""
    on_objects = heights.label >= 0
    middle = float(np.median(heights.height[on_objects] if on_objects.any() else heights.height))
    grey = np.clip((heights.height - middle) / _SHOWN + 0.5, 0, 1) * 255
    hidden = heights.ceiling > heights.height + 0.005
    red, others = np.where(hidden, 200, grey), np.where(hidden, grey / 2, grey)
    image = np.stack([red, others, others], axis=-1).astype(np.uint8)[::-1]
    return cv2.resize(image, (200, 200), interpolation=cv2.INTER_AREA)


def at_grasp(cell: Cell, grasp: Grasp) -> np.ndarray:
    """(H, W, 3) uint8: the open hand at a grasp, seen along W's horizontal across its tilt."""
    if reaches(cell, grasp):
        cell.robot.place(choose_posture(grasp.pose, cell.home), grasp.width)
    beside = np.cross(grasp.approach, (0.0, 0.0, 1.0))
    if grasp.tilt < 0.01:
        beside = grasp.closing_direction
    beside = beside / np.linalg.norm(beside) * (1 if beside[0] > 0 else -1)  # not inside the arm
    eye = grasp.position + 0.55 * beside + (0.0, 0.0, 0.2)
    return cell.image(_VIEW, look_at(eye, grasp.position + (0.0, 0.0, 0.05))).rgb


if __name__ == "__main__":
    run_script(main)
