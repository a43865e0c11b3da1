"""A learned policy at work in the cell: it brings the hand around an object and closes it.

The rest of the attempt, and who says whether it succeeded, is the same as for planned grasps
(`envs.execution`). A policy is any callable from an observation of `RobotGraspingEnv` to an action.

The policies of train_rl.py among those that evaluate.py scores: `ppo` and `ppo:FILE.pt`.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from envs.cell import Cell, PhysicsError
from envs.execution import ApproachResult, GraspFailure
from envs.grasping_env import RobotGraspingEnv
from envs.robot_kinematics import forward_kinematics
from models.grasp_policy import SavedPolicy, load_policy
from utils.config import with_settings
from utils.errors import UserError
from utils.result_records import OPEN_LOOP
from utils.transforms import Grasp, RGBDFrame

TOLD_A_ROBOT = ("rgb", "depth", "state", "end_effector_position", "gripper", "opening_error")
_SURE = 3  # looks in a row at which something must be gripped: a first touch may slip
SCENARIOS = ("isolated", "static")  # one object, which stays where it is


class PolicyApproach:
    """An `envs.execution.Approach`. trained: sections env and camera of the config that the policy
    was trained with, as plain data; everything else is the cell's, and so is the depth noise.

    It ends when both fingers have gripped something for a quarter of a second, which a gripper
    feels; from there the object is held, lifted and judged as any other. closed_at: where that was,
    None until then.
    """

    def __init__(
        self,
        cell: Cell,
        policy: Callable[[dict[str, np.ndarray]], np.ndarray],
        trained: dict[str, dict[str, Any]],
    ):
        # No reward is asked for; the objects are those of the cell.
        plain = trained["env"] | {"reward": "sparse", "goal": "object", "objects": "box"}
        noise = cell.config.camera.model_dump(include={"depth_noise", "depth_noise_args"})
        config = with_settings(cell.config, "camera", trained["camera"] | noise)
        self.env = RobotGraspingEnv(config=config, cell=cell, **plain)
        self.policy = policy
        self.closed_at: Grasp | None = None

    def __call__(self, cell: Cell, grasp: Grasp) -> ApproachResult:
        """Raises GraspFailure when nothing is gripped in as many actions as in training."""
        self.closed_at, ended, gripped = None, False, 0
        try:
            observation, info = self.env.take_over()
            while not ended and gripped < _SURE:
                action = self.policy({**info, **observation})
                observation, _, terminated, truncated, info = self.env.step(action)
                ended = terminated or truncated
                gripped = gripped + 1 if info["grasped"] else 0
                if gripped == 1:
                    self.closed_at = _grasp_of(cell)
        finally:
            self.env.hand_over()
        if info["reason"] == "physics":
            raise PhysicsError("the simulation blew up while a policy was acting")
        if not info["grasped"]:
            self.closed_at = None
            raise GraspFailure("stopped", detail=f"gripped nothing ({info['reason']})")
        return ApproachResult(cell.step, None)


def nowhere_yet(frame: RGBDFrame) -> list[Grasp]:
    """The plan of a policy that makes none: something to be named until it has closed the hand."""
    return [Grasp(np.array([0.5, 0.0, 0.0]), 0.0, 0.0, 0.0)]


def _grasp_of(cell: Cell) -> Grasp:
    """The hand's pose as a planar grasp."""
    T_WE = forward_kinematics(cell.robot.q)
    angle = math.atan2(T_WE[1, 1], T_WE[0, 1]) % math.pi
    return Grasp(T_WE[:3, 3].copy(), angle, cell.robot.opening, 1.0)


LEARNED = "ppo"
SHIPPED = Path(__file__).resolve().parents[1] / "checkpoints" / "ppo_box.pt"


def is_learned(name: str) -> bool:
    """Whether a policy is one of train_rl.py's, which sees and moves in turns and plans nothing."""
    return name == LEARNED or name.startswith(f"{LEARNED}:")


@functools.cache
def learned(name: str) -> SavedPolicy:
    """The policy `ppo`, as shipped, or `ppo:FILE.pt`. Raises UserError if it cannot be loaded."""
    _, _, file = name.partition(":")
    return load_policy(Path(file) if file else SHIPPED)


def check_learned(name: str, scenarios: Sequence[str], controllers: Sequence[str]) -> None:
    """Raise UserError for a policy that cannot be loaded or cannot play what is asked for."""
    told = [part.key for part in learned(name).layout.state if part.key not in TOLD_A_ROBOT]
    if told:
        raise UserError(
            f"evaluate.policies: {name} was trained to be told {', '.join(told)}, which no robot "
            "knows; score it with benchmarks.bench_policy"
        )
    for scenario in scenarios:
        if scenario not in SCENARIOS:
            raise UserError(
                f"evaluate.policies: {name} takes one object that stays where it is, so that it "
                f"cannot play {scenario!r}; allowed with it are evaluate.scenarios="
                f"{','.join(SCENARIOS)}"
            )
    if any(controller != OPEN_LOOP for controller in controllers):
        raise UserError(
            f"evaluate.controllers: {name} is its own controller; use {OPEN_LOOP} with it"
        )


@functools.cache
def approach_by(name: str, cell: Cell) -> PolicyApproach:
    """How a learned policy brings the hand around an object in a cell."""
    policy = learned(name)
    return PolicyApproach(cell, policy, policy.config)
