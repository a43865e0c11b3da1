"""The policies of train_rl.py among those that evaluate.py scores: `ppo` and `ppo:FILE.pt`."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path

from envs.base_cell import BaseCell
from envs.policy_approach import SCENARIOS, TOLD_A_ROBOT, PolicyApproach
from models.grasp_policy import SavedPolicy, load_policy
from utils.errors import UserError
from utils.round_records import OPEN_LOOP

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
def approach_by(name: str, cell: BaseCell) -> PolicyApproach:
    """How a learned policy brings the hand around an object in a cell."""
    policy = learned(name)
    return PolicyApproach(cell, policy, policy.config)
