"""A pick by rule in `RobotGraspingEnv`, without a display: python -m envs.scripted_pick"""

from __future__ import annotations

from typing import Any

import numpy as np

from envs.grasping_env import RobotGraspingEnv
from envs.robot_kinematics import forward_kinematics


def scripted_action(env: RobotGraspingEnv, info: dict[str, Any]) -> np.ndarray:
    """(5,) `ee_planar` action of a simple pick of the nearest object: above it, down, close, up."""
    offset = info["object_position"] - info["end_effector_position"]
    over_it = bool(np.linalg.norm(offset[:2]) < 0.01)
    if not over_it:
        offset[2] += 0.12
    opening = env.get_gripper_width()
    closing = info["grasped"] or opening < 0.07 or (over_it and abs(offset[2]) < 0.01)
    if closing:
        offset[:] = 0.0, 0.0, 0.05 if info["grasped"] else 0.0
    move = np.clip(offset / env.settings.position_step, -1, 1)
    turn = 0.0 if closing else np.clip(_turn_to_sides(env) / env.settings.rotation_step, -1, 1)
    return np.array([*move, turn, -1.0 if closing else 1.0], dtype=np.float32)


def _turn_to_sides(env: RobotGraspingEnv) -> float:
    """Yaw in radians that brings the closing line square to the sides of the first object: a cube's
    diagonal is wider than the hand."""
    sides = env.cell.object_pose(0)[:3, :3]
    level = sides[:, np.argmin(abs(sides[2]))]
    closing_line = forward_kinematics(env.cell.robot.q)[:3, 1]
    angle = np.arctan2(level[1], level[0]) - np.arctan2(closing_line[1], closing_line[0])
    return float((angle + np.pi / 4) % (np.pi / 2) - np.pi / 4)


def main() -> None:
    """The scripted pick on the default scene."""
    env = RobotGraspingEnv(render_mode="rgb_array", control="ee_planar")
    observation, info = env.reset(seed=0)
    print("observation:", {name: value.shape for name, value in observation.items()})
    print("action:", env.action_space)
    done, step, total = False, 0, 0.0
    while not done:
        observation, reward, terminated, truncated, info = env.step(scripted_action(env, info))
        total, step, done = total + reward, step + 1, terminated or truncated
        if step % 5 == 0 or done:
            print(
                f"step {step:3d}: reward {reward:+.3f}, gripper {env.get_gripper_width():.3f} m, "
                f"object at {info['object_position'][2]:.3f} m, grasped {info['grasped']}"
            )
    print(f"ended by {info['reason']} with return {total:.3f}; picture {env.render().shape}")
    env.close()


if __name__ == "__main__":
    main()
