"""The shipped policies at work in the cell."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pybullet
import pytest
import torch

from benchmarks.bench_policy import config_of, run_episodes
from envs.cell import Cell
from envs.execution import execute_grasp
from envs.objects import load_object_set
from envs.policy_approach import PolicyApproach, nowhere_yet
from envs.scenes import make_scene
from envs.vector import make_env
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


@pytest.mark.parametrize("objects", ["random_urdfs", "primitives"])
def test_policies_lift_what_they_have_never_seen(objects):
    """176 and 171 of 200 in docs/ppo.md: fewer than 6 of 10 would be chance once in a hundred."""
    path = CHECKPOINTS / f"ppo_{objects}.pt"
    config = config_of(path, ["sim.renderer=tiny", "objects.split=test"])
    assert config.env.objects == objects
    policy = load_policy(path)
    told = {part.key for part in (*policy.layout.images, *policy.layout.state)}
    assert told == {"rgb", "depth", "end_effector_position", "gripper", "squeeze"}
    ends = run_episodes(policy, config, 10)
    assert sum(reason == "success" for reason, _ in ends) >= 6


def test_it_is_not_told_where_the_box_is(box):
    policy = load_policy(box)
    assert {part.key for part in policy.layout.images} == {"rgb", "depth"}
    assert {part.key for part in policy.layout.state} == {"end_effector_position", "gripper"}
    assert config_of(box).env.near_share == 0, "at full difficulty"


def test_moving_the_hidden_box_changes_nothing_but_the_image(box):
    policy, env = load_policy(box), make_env(config_of(box, ["sim.renderer=tiny"]))
    observation, _ = env.reset(seed=1)
    before = policy.layout.read_one(observation)
    cell, inner = env.unwrapped.cell, env.unwrapped
    position, quaternion = pybullet.getBasePositionAndOrientation(
        cell.bodies[0], physicsClientId=cell.client
    )
    elsewhere = np.array(position) + [0.06, -0.05, 0.0]
    pybullet.resetBasePositionAndOrientation(
        cell.bodies[0], elsewhere, quaternion, physicsClientId=cell.client
    )
    inner._look()
    seen = {**inner._info(None), **inner._observation()}
    assert seen["object_position"] == pytest.approx(elsewhere), "the simulator knows"
    after = policy.layout.read_one(seen)
    assert torch.equal(before.state, after.state)
    assert all(not torch.equal(a, b) for a, b in zip(before.images, after.images))
    env.close()


def test_the_policy_grasps_for_the_judge_of_planned_grasps(box, config):
    """In the cell of evaluate.py, whose own camera hangs overhead."""
    policy = load_policy(box)
    objects = load_object_set("box", cache_dir=config.cache_folder, **config.objects.model_dump())
    with Cell(config) as cell:
        approach, outcomes = PolicyApproach(cell, policy, policy.config), []
        for seed in range(3):
            cell.load(make_scene("isolated", objects, seed, config, cell.client))
            (grasp,) = nowhere_yet(cell.frame())
            place = cell.object_position(0)
            outcomes.append(execute_grasp(cell, grasp, approach))
            assert np.linalg.norm(approach.closed_at.position - place) < 0.06
        assert sum(outcome.success for outcome in outcomes) >= 2


def test_a_policy_that_grips_nothing_is_stopped(box, config):
    policy = load_policy(box)
    objects = load_object_set("box", cache_dir=config.cache_folder, **config.objects.model_dump())
    with Cell(config) as cell:
        approach = PolicyApproach(cell, lambda observation: np.zeros(5), policy.config)
        cell.load(make_scene("isolated", objects, 0, config, cell.client))
        outcome = execute_grasp(cell, nowhere_yet(cell.frame())[0], approach)
        assert (outcome.reason, approach.closed_at) == ("stopped", None)
        assert "gripped nothing" in outcome.detail
        assert np.abs(cell.robot.q - cell.home).max() < 0.02, "home again"
