"""The shipped policies at work in the cell."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.bench_policy import config_of, run_episodes
from models.grasp_policy import load_policy

CHECKPOINTS = Path(__file__).resolve().parent.parent / "checkpoints"


@pytest.fixture(scope="module")
def box():
    return CHECKPOINTS / "ppo_box.pt"


def test_the_policy_of_the_box_lifts_it(box):
    """200 of 200 in docs/ppo.md: by far not each in ten would fail by chance."""
    config = config_of(box, ["sim.renderer=tiny"])
    ends = run_episodes(load_policy(box), config, 10)
    assert sum(reason == "success" for reason, _ in ends) >= 9


def test_it_is_not_told_where_the_box_is(box):
    policy = load_policy(box)
    assert {part.key for part in policy.layout.images} == {"rgb", "depth"}
    assert {part.key for part in policy.layout.state} == {"end_effector_position", "gripper"}
    assert config_of(box).env.near_share == 0, "at full difficulty"
