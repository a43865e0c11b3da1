"""Learned policies at work in the cell: they bring the hand around an object and close it.

A policy is a callable from an observation of `RobotGraspingEnv` to an action. The rest of the
attempt and its judgement are the same as for planned grasps (`envs.execution`). evaluate.py scores
policies of train_rl.py (`ppo`, `ppo:FILE.pt`) and of Stable-Baselines3 (`sb3:FILE.zip`).
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from envs.cell import Cell, PhysicsError
from envs.execution import ApproachResult, GraspFailure
from envs.grasping_env import RobotGraspingEnv
from envs.robot_kinematics import forward_kinematics
from models.grasp_policy import SavedPolicy, load_policy
from models.sb3_policy import Sb3Policy, load_sb3
from utils.checkpoint import reading
from utils.config import Config, with_settings
from utils.errors import UserError
from utils.result_records import OPEN_LOOP
from utils.transforms import Grasp, RGBDFrame
from utils.worker_process import kept

KNOWN_TO_A_ROBOT = (
    "rgb", "depth", "state", "end_effector_position", "gripper", "opening_error", "reachable",
)  # fmt: skip
_SURE = 3  # observations in a row with something gripped: a first touch may slip
_STILL = 0.001  # m between two observations: fingers that move may push without holding
LEARNED_SCENARIOS = ("isolated", "static")  # one object, which stays where it is
LEARNED = ("ppo", "sb3")  # the word before the colon, followed by a file
SHIPPED = Path(__file__).resolve().parents[1] / "checkpoints" / "ppo_box.pt"


class PolicyApproach:
    """An `envs.execution.Approach` by a policy that acts in turns.

    trained: sections env and camera of the config that the policy was trained with, as plain data;
        the rest of the config is the cell's, and so is the depth noise.
    observations: the entries that the policy observes, whatever `trained` says.
    closed_at: the hand's pose when it closed, None until then.

    The approach ends when both fingers have gripped something for a quarter of a second and stand
    still, which a gripper feels; then the object is held, lifted and judged like any other.
    """

    def __init__(
        self,
        cell: Cell,
        policy: Callable[[dict[str, np.ndarray]], np.ndarray],
        trained: dict[str, dict[str, Any]],
        observations: Sequence[str],
    ):
        # Reward and starts are not used, and the cell has its objects already.
        plain = trained["env"] | {"reward": "sparse", "goal": "object", "objects": "box"}
        plain |= {"near_share": 0.0, "observations": list(observations)}
        noise = cell.config.camera.model_dump(include={"depth_noise", "depth_noise_args"})
        config = with_settings(cell.config, "camera", trained["camera"] | noise)
        self.env = RobotGraspingEnv(config=config, cell=cell, **plain)
        self.policy = policy
        self.closed_at: Grasp | None = None

    def __call__(self, cell: Cell, grasp: Grasp) -> ApproachResult:
        """Raises GraspFailure when nothing is gripped within the actions of a training episode;
        a grip at the last of them alone counts, too, even of fingers that still move."""
        self.closed_at, ended, gripped, touches = None, False, 0, False
        before = cell.robot.opening
        try:
            observation, info = self.env.take_over()
            while not ended and gripped < _SURE:
                action = self.policy(observation)
                observation, _, terminated, truncated, info = self.env.step(action)
                ended = terminated or truncated
                moved, before = abs(cell.robot.opening - before), cell.robot.opening
                touched, touches = touches, cell.robot.grips()
                gripped = gripped + 1 if touches and moved < _STILL else 0
                if touches and not touched:
                    self.closed_at = _grasp_of(cell)
        finally:
            self.env.hand_over()
        if info["reason"] == "physics":
            raise PhysicsError("the simulation blew up while a policy was acting")
        if not touches:
            self.closed_at = None
            raise GraspFailure("stopped", detail=f"gripped nothing ({info['reason']})")
        return ApproachResult(cell.step, None, float(self.closed_at.position[2]))


def placeholder(frame: RGBDFrame) -> list[Grasp]:
    """The planner beside a policy that plans nothing: a grasp that stands for the policy's own
    until the hand has closed."""
    return [Grasp(np.array([0.5, 0.0, 0.0]), 0.0, 0.0, 0.0)]


def _grasp_of(cell: Cell) -> Grasp:
    """The hand's pose as a planar grasp."""
    T_WE = forward_kinematics(cell.robot.q)
    angle = math.atan2(T_WE[1, 1], T_WE[0, 1]) % math.pi
    return Grasp(T_WE[:3, 3].copy(), angle, cell.robot.opening, 1.0)


# --- By name, as in evaluate.policies -----------------------------------------------------------


def is_learned(name: str) -> bool:
    """Whether a policy acts in turns and plans nothing."""
    return name == "ppo" or name.partition(":")[0] in LEARNED and ":" in name


@kept
def load_learned(name: str) -> SavedPolicy | Sb3Policy:
    """Load `ppo` (the shipped one), `ppo:FILE.pt` or `sb3:FILE.zip`. Raises UserError."""
    kind, _, file = name.partition(":")
    if kind == "sb3":
        return load_sb3(Path(file))
    return load_policy(Path(file) if file else SHIPPED)


def check_learned(
    name: str, scenarios: Sequence[str], controllers: Sequence[str], config: Config
) -> None:
    """Raise UserError for a policy that cannot be loaded, or not be scored in this evaluation; warn
    of objects that it was not trained on."""
    policy = load_learned(name)
    if isinstance(policy, Sb3Policy):
        _check_spaces(policy, config)
    _check_knowledge(name, policy.observations)
    for scenario in scenarios:
        if scenario not in LEARNED_SCENARIOS:
            raise UserError(
                f"evaluate.policies: {name} takes one object that stays where it is, so that it "
                f"cannot play {scenario!r}; allowed with it are evaluate.scenarios="
                f"{','.join(LEARNED_SCENARIOS)}"
            )
    if any(controller != OPEN_LOOP for controller in controllers):
        raise UserError(
            f"evaluate.controllers: {name} is its own controller; use {OPEN_LOOP} with it"
        )
    if remark := foreign_objects(name, config.evaluate.object_sets):
        warnings.warn(remark, stacklevel=2)


def foreign_objects(name: str, object_sets: Sequence[str]) -> str:
    """A sentence about the object sets that a policy of train_rl.py was not trained on; empty where
    there are none, or where its file does not tell. It names the shipped policies that were."""
    policy = load_learned(name)
    if isinstance(policy, Sb3Policy):
        return ""
    with reading(name):
        trained = policy.config.get("env", {}).get("objects")
    others = [one for one in object_sets if one != trained]
    if trained is None or not others:
        return ""
    remark = f"{name} was trained on {trained}, and not on {', '.join(others)}"
    shipped = [one for one in others if (SHIPPED.parent / f"ppo_{one}.pt").is_file()]
    if shipped:
        names = ", ".join(f"ppo:checkpoints/ppo_{one}.pt" for one in shipped)
        remark += f"; {names} {'was' if len(shipped) == 1 else 'were'}"
    return remark


def _check_knowledge(name: str, observed: Sequence[str]) -> None:
    """Raise UserError for a policy that observes what a robot cannot know."""
    unknown = [key for key in observed if key not in KNOWN_TO_A_ROBOT]
    if unknown:
        raise UserError(
            f"evaluate.policies: {name} was trained to observe {', '.join(unknown)}, which no "
            "robot knows; score it with benchmarks.bench_policy"
        )


def _check_spaces(policy: Sb3Policy, config: Config) -> None:
    """Raise UserError for a policy whose spaces are not those of the config's section env."""
    env = RobotGraspingEnv(config=config)
    try:
        policy.check_spaces(env.observation_space, env.action_space)
    finally:
        env.close()


def learned_approach(name: str, cell: Cell) -> PolicyApproach:
    """The approach of a learned policy in a cell. A policy of Stable-Baselines3 brings no config,
    so that it acts in the environment of the cell's."""
    policy = load_learned(name)
    if isinstance(policy, Sb3Policy):
        sections = {"env": cell.config.env, "camera": cell.config.camera}
        trained = {key: sections[key].model_dump() for key in sections}
        return PolicyApproach(cell, policy, trained, policy.observations)
    with reading(name):
        return PolicyApproach(cell, policy, policy.config, policy.observations)
