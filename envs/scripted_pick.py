"""A scripted pick in `RobotGraspingEnv`, the demonstration: python -m envs.grasping_env [--gui]

It lifts the cube of one scene (`seed=N` chooses it), prints a line on each phase, and leaves
picture.png and film.mp4 in a new folder of runs/grasping_env/. With --gui a window shows the
physics instead.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

import numpy as np

from envs.grasping_env import RobotGraspingEnv
from envs.robot_kinematics import forward_kinematics
from envs.studio import write_film
from utils.config import with_settings
from utils.image_overlay import write_picture
from utils.runs import new_run_folder, parse_args

# Of the way down that is left, in one action: the arm still moves by what it was told before. With
# all of it the hand would go a centimetre too far and press its palm on the cube.
SHARE_DOWN = 0.5

PHASES = {
    "approach": "the hand moves over the cube",
    "descend": "the hand goes down around it",
    "close": "the fingers close",
    "lift": "the hand lifts it",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Play one scripted episode and show it."""
    summary = "Lift a cube by a script; `seed` chooses it."
    config, options = parse_args(argv, summary, _add_options, resumes=False)
    actions = {"control": "ee_planar", "gripper": "opening", "frame": "world"}
    config = with_settings(config, "env", actions)
    env = RobotGraspingEnv("human" if options.gui else "rgb_array", config)
    observation, info = env.reset(seed=config.seed)
    print("observation:", {name: value.shape for name, value in observation.items()})
    print(f"action: {env.action_space}: dx, dy, dz, dyaw, gripper")
    phase, total, step, ended = "", 0.0, 0, False
    pictures = [] if options.gui else [env.render()]
    while not ended:
        now, action = scripted_pick(env, info)
        if now != phase:
            phase = now
            print(f"step {step:3d}: {PHASES[phase]}; {_state_in_words(env, info)}")
        observation, reward, terminated, truncated, info = env.step(action)
        total, step, ended = total + reward, step + 1, terminated or truncated
        if not options.gui:
            pictures.append(env.render())
    print(
        f"step {step:3d}: ended by {info['reason']}, return {total:.3f}; "
        f"{_state_in_words(env, info)}"
    )
    if not options.gui:
        folder = new_run_folder("grasping_env", None, config)
        write_picture(folder / "picture.png", pictures[-1])
        write_film(folder / "film.mp4", pictures, env.metadata["render_fps"])
        print(f"picture and film: {folder / 'picture.png'}, {folder / 'film.mp4'}")
    env.close()
    return 0 if info["is_success"] else 1


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--gui", action="store_true", help="show a window; needs a display")


def _state_in_words(env: RobotGraspingEnv, info: dict[str, Any]) -> str:
    return (
        f"fingers {1000 * env.get_gripper_width():.0f} mm apart, cube at "
        f"{info['object_position'][2]:.3f} m, {'grasped' if info['grasped'] else 'not grasped'}"
    )


def scripted_pick(env: RobotGraspingEnv, info: dict[str, Any]) -> tuple[str, np.ndarray]:
    """The phase of PHASES that a pick of the nearest object is in, and its (5,) `ee_planar`
    action."""
    offset = info["object_position"] - info["end_effector_position"]
    over_it = bool(np.linalg.norm(offset[:2]) < 0.01)
    if not over_it:
        offset[2] += 0.12
    opening = env.get_gripper_width()
    closing = info["grasped"] or opening < 0.07 or (over_it and abs(offset[2]) < 0.01)
    if closing:
        offset[:] = 0.0, 0.0, 0.05 if info["grasped"] else 0.0
    elif over_it:
        offset[2] *= SHARE_DOWN
    move = np.clip(offset / env.settings.position_step, -1, 1)
    turn = 0.0 if closing else np.clip(_turn_to_sides(env) / env.settings.rotation_step, -1, 1)
    action = np.array([*move, turn, -1.0 if closing else 1.0], dtype=np.float32)
    if closing:
        return "lift" if info["grasped"] else "close", action
    return "descend" if over_it else "approach", action


def _turn_to_sides(env: RobotGraspingEnv) -> float:
    """Yaw in radians that brings the closing line square to the sides of the first object: a cube's
    diagonal is wider than the hand."""
    sides = env.cell.object_pose(0)[:3, :3]
    level = sides[:, np.argmin(abs(sides[2]))]
    closing_line = forward_kinematics(env.cell.robot.q)[:3, 1]
    angle = np.arctan2(level[1], level[0]) - np.arctan2(closing_line[1], closing_line[0])
    return float((angle + np.pi / 4) % (np.pi / 2) - np.pi / 4)
