"""A picture of a closed loop at work: python -m benchmarks.show_grasp_loop [FILE] [SCENARIO]

FILE is runs/show_grasp_loop/servo.png where none is named; KEY=VALUE overrides may follow,
simulator=mujoco too. Above what a bystander sees, below the wrist camera's depth image with the
points that the law looks at, at four moments of one grasp of the test object that `seed` chooses.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from envs.cell_scenes import make_scene
from envs.closed_loop import ClosedLoop
from envs.closed_loop_tracker import WristImage
from envs.execution import execute_grasp
from envs.objects import load_objects
from envs.robot_kinematics import forward_kinematics
from envs.scenarios import SCENARIOS, disturbed, teach
from envs.simulators import make_cell
from envs.studio import Studio
from models.planners import make_planner
from utils.atomic_files import check_writable
from utils.config import load_config
from utils.errors import unknown_choice
from utils.geometry import GripperGeometry
from utils.image_overlay import write_picture
from utils.runs import run_script
from utils.transforms import inverse_pose, transform_points

OUTPUT = Path("runs/show_grasp_loop/servo.png")  # where no FILE is named
MOMENTS = (0.4, 1.4, 2.2, 2.7)  # s after the arm has set out
_SIZE = (320, 240)


def main(argv: Sequence[str] | None = None) -> None:
    argv = list(sys.argv[1:] if argv is None else argv)
    overrides = [a for a in argv if "=" in a]
    names = [a for a in argv if "=" not in a]
    file, scenario = [*names, *(str(OUTPUT), "turning_5cm")[len(names) :]][:2]
    if scenario not in SCENARIOS:
        raise unknown_choice("scenario", scenario, SCENARIOS)
    if names:
        check_writable("FILE", Path(file))
    config = load_config(None, overrides)
    objects = load_objects("random_urdfs", config)
    workspace = config.workspace.geometry
    plan = make_planner("heuristic", GripperGeometry(), workspace, config.seed)
    with make_cell(config) as cell:
        conditions = SCENARIOS[scenario]
        scene = make_scene(conditions.layout, objects, config.seed, config)
        taught = teach(cell, scene)
        cell.load(scene)
        calibration, frame = conditions.calibration(cell), cell.frame()
        loop = ClosedLoop(cell, "ibvs", frame, calibration, taught, conditions.latency)
        pictures, camera, start = [], loop.camera, cell.seconds
        with Studio(cell, *_SIZE) as studio:

            def see():
                sight = camera()
                passed = len(pictures) < len(MOMENTS) and sight is not None
                if passed and cell.seconds - start >= MOMENTS[len(pictures)]:
                    pictures.append(_both(studio.picture(), sight, loop))
                return sight

            loop.camera = see
            with disturbed(cell, conditions.motion(cell, 0)):
                outcome = execute_grasp(cell, plan(frame)[0], loop)
    write_picture(Path(file), np.hstack(pictures))
    print(f"{outcome.reason} {outcome.detail}; wrote {file}")


def _both(picture: np.ndarray, sight: WristImage, loop: ClosedLoop) -> np.ndarray:
    depth = sight.depth
    nearest, farthest = depth[depth > 0].min(), depth.max()
    grey = (255 * (farthest - depth) / max(farthest - nearest, 1e-3)).clip(0, 255).astype(np.uint8)
    image = cv2.resize(cv2.cvtColor(grey, cv2.COLOR_GRAY2RGB), None, fx=2, fy=2)
    T_WC = forward_kinematics(sight.q) @ loop.T_EC
    points = transform_points(inverse_pose(T_WC) @ loop.target.T_WO, loop.target.template.points)
    for u, v in points[:, :2] / points[:, 2:] * loop.K[[0, 1], [0, 1]] + loop.K[:2, 2]:
        cv2.circle(image, (round(2 * u + 0.5), round(2 * v + 0.5)), 3, (230, 60, 40), -1)
    below = np.full((image.shape[0], picture.shape[1], 3), 255, np.uint8)
    left = (picture.shape[1] - image.shape[1]) // 2
    below[:, left : left + image.shape[1]] = image
    return np.vstack([picture, below])


if __name__ == "__main__":
    run_script(main)
