"""Automatic ranges that all environments of a training share: one parameter, counted by hand.

Episodes last one step and succeed exactly while gravity is changed by at most 0.55 m/s^2, of the
1 m/s^2 that its range may grow to.
"""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import train_rl
from envs.grasping_env import RobotGraspingEnv
from envs.vector_env import vector_envs
from models.ppo import KIND
from tests.helpers.compare import same
from tests.test_train_rl import REPOSITORY, TORCHRUN
from utils.adaptive_ranges import AdaptiveRanges, Bound
from utils.checkpoint import load_checkpoint
from utils.config import load_config
from utils.errors import UserError

ENDURED = 0.55  # m/s^2
BOUND = Bound("gravity", "high")
STILL = [
    f"randomization.physics.{name}="
    + ("1,1,uniform,scale,episode" if spec.operation == "scale" else "0,0,uniform,add,episode")
    for name, spec in load_config().randomization.physics
    if name != "gravity"
]
SHARED = [
    "rl.env_id=RandomizedGrasping-v0", "rl.env_kwargs=[control=ee_planar]", "rl.envs=3",
    "rl.rollout_steps=2", "rl.batch_size=6", "rl.total_steps=48", "rl.evaluate_every=2",
    "rl.evaluation_episodes=2", "rl.hidden_dim=8", "rl.device=cpu", "rl.parallel=false",
    "rl.epochs=1", "env.observations=state", "env.max_steps=1", "env.substeps=1",
    "sim.renderer=tiny", "randomization.parts=physics", *STILL,
    "randomization.physics.gravity=0,1,uniform,add,episode", "randomization.adaptive.enabled=true",
    "randomization.adaptive.initial=0.3", "randomization.adaptive.step=0.1",
    "randomization.adaptive.boundary_share=1", "randomization.adaptive.episodes=6",
]  # fmt: skip


@pytest.fixture
def enduring(monkeypatch):
    """Whatever a policy does, it is gravity that decides."""

    def step(env, action):
        gravity = env.randomizer.sample["physics"]["gravity"][1]
        success = gravity <= ENDURED
        info = env._info("success" if success else "max_steps")
        return env._observation(), float(success), True, False, info

    monkeypatch.setattr(RobotGraspingEnv, "step", step)


def trained(tmp_path, monkeypatch, *changes: str) -> Path:
    monkeypatch.chdir(tmp_path)
    assert train_rl.main([*SHARED, *changes]) == 0
    return max(Path("runs/train_rl").resolve().iterdir(), key=lambda run: run.stat().st_mtime_ns)


def samples_of(envs, restart) -> list[dict]:
    """What the environments were reset to by a call."""
    told = []
    for name in ("reset", "reset_wait"):
        if method := getattr(envs._envs, name, None):

            def spied(*arguments, method=method, **named):
                result = method(*arguments, **named)
                told.append(result[1]["randomization"])
                return result

            setattr(envs._envs, name, spied)
    restart()
    (infos,) = told
    return infos


@pytest.mark.parametrize("parallel", ["false", "true"])
def test_every_environment_begins_with_the_ranges_of_all(parallel):
    """At 0.3 of the way; after five successes of six at the bound (0.83 > 0.8) at 0.4."""
    config = load_config(None, [*SHARED, f"rl.parallel={parallel}"])
    with vector_envs(config, 3) as envs:

        def gravities(*arguments) -> list[float]:
            sample = samples_of(envs, lambda: envs.restart(*arguments))
            begun = sample["_physics"]
            drawn = [pair[1] for pair in sample["physics"]["gravity"][begun]]
            assert [bound[:2] for bound in sample["bound"][begun]] == [list(BOUND)] * begun.sum()
            return drawn

        assert gravities([1, 2, 3]) == pytest.approx([0.3] * 3)
        envs.ranges.record_all([(BOUND, 0.3, True)] * 5)
        assert gravities([1, 2, 3]) == pytest.approx([0.3] * 3)
        envs.ranges.record_all([(BOUND, 0.3, False)])
        assert gravities([None] * 3, np.array([True, False, True])) == pytest.approx([0.4] * 2)
        assert gravities([None] * 3, np.array([False, True, False])) == pytest.approx([0.4])
        with envs.at_full_difficulty():  # uniform in [0, 1], no bound
            sample = samples_of(envs, lambda: envs.restart([1, 2, 3]))
            drawn = [pair[1] for pair in sample["physics"]["gravity"]]
            assert list(sample["bound"]) == [None] * 3 and len(set(drawn)) == 3
            assert samples_of(envs, lambda: envs.restart([1, 2, 3]))["seed"].tolist() == (
                sample["seed"].tolist()
            )
        assert gravities([1, 2, 3]) == pytest.approx([0.4] * 3)


def test_ranges_of_a_training_widen_by_the_episodes_of_all(tmp_path, monkeypatch, enduring):
    """Three environments play two episodes each at the bound for an update: six, as many as judge
    it. It moves out while 0.55 is endured, and from 0.6 back. Of the update after a move only three
    count, as the others had begun before it; evaluations after every second begin all anew."""
    run = trained(tmp_path, monkeypatch)
    events = EventAccumulator(str(run / "tensorboard")).Reload()
    widths = [event.value for event in events.Scalars("ranges/gravity.high")]
    assert widths == pytest.approx([0.4, 0.4, 0.5, 0.5, 0.6, 0.6, 0.5, 0.5])
    assert [event.value for event in events.Scalars("ranges/width")] == widths
    assert [event.step for event in events.Scalars("ranges/width")] == [*range(6, 49, 6)]
    history = json.loads((run / "results.json").read_text())["history"]
    assert [row["range_width"] for row in history] == pytest.approx([0.3, 0.4, 0.5, 0.6, 0.5])
    ranges = load_checkpoint(run / "last.pt", KIND)["extra"]["ranges"]
    assert ranges == {"gravity.high": {"share": pytest.approx(0.5), "results": [True] * 3}}


def test_shared_ranges_go_on_where_they_were(tmp_path, monkeypatch, enduring):
    """Stopped after four updates of six: 18 episodes have widened the range, and three, which have
    begun since, wait for twelve others."""
    slow = "randomization.adaptive.episodes=15", "rl.total_steps=36"
    whole = load_checkpoint(trained(tmp_path, monkeypatch, *slow) / "last.pt", KIND)
    with monkeypatch.context() as patch:
        patch.setattr(train_rl, "reached", lambda config, row: row["update"] == 4)
        run = trained(tmp_path, monkeypatch, *slow)
    half = load_checkpoint(run / "last.pt", KIND)["extra"]["ranges"]
    assert half == {"gravity.high": {"share": pytest.approx(0.4), "results": [True] * 3}}
    assert train_rl.main(["--resume", str(run)]) == 0
    again = load_checkpoint(run / "last.pt", KIND)
    assert again["extra"]["ranges"]["gravity.high"]["share"] == pytest.approx(0.5)
    for part in ("step", "model", "optimizer", "extra"):
        assert same(again[part], whole[part]), part


def test_a_bound_moves_one_step_for_what_was_played_at_it():
    """Twelve results where six are enough, in whatever order they come from other processes; what
    was played elsewhere, at 0.2, does not count."""
    first, second = (
        AdaptiveRanges(
            {"gravity": config.randomization.physics.gravity}, config.randomization.adaptive
        )
        for config in [load_config(None, SHARED)] * 2
    )
    results = [(BOUND, 0.3, True)] * 10 + [(BOUND, 0.3, False)] * 2 + [(BOUND, 0.2, False)] * 9
    first.record_all(results)
    second.record_all(reversed(results))
    assert first.shares == second.shares == {"gravity.high": pytest.approx(0.4)}
    assert first.state() == second.state()
    first.take_over({"gravity.high": 0.7})
    assert first.ranges["gravity"].high == pytest.approx(0.7)


def test_an_environment_alone_keeps_to_itself():
    """Its own ranges learn; those of others do not from it; what is no range is refused."""
    config = load_config(None, [*SHARED, "randomization.adaptive.episodes=1"])
    env = gymnasium.make("RandomizedGrasping-v0", config=config).unwrapped
    action = np.zeros(env.action_space.shape)
    for options, width in ((None, 0.2), ({"ranges": {"gravity.high": 0.9}}, 0.9)):
        env.reset(seed=0, options=options)
        *_, info = env.step(action)  # nothing is lifted in one step
        assert info["bound"][:2] == list(BOUND) and not info["is_success"]
        assert env.randomizer.adaptive.width == pytest.approx(width)
    with pytest.raises(UserError, match="'ranges' must be 'widest' or the shares"):
        env.reset(options={"ranges": {"mass.high": 0.5}})
    env.close()
    off = load_config(None, [*SHARED, "randomization.adaptive.enabled=false"])
    env = gymnasium.make("RandomizedGrasping-v0", config=off).unwrapped
    with pytest.raises(UserError, match="adaptive.enabled=true"):
        env.reset(options={"ranges": {"gravity.high": 0.5}})
    env.close()


@pytest.mark.slow
def test_processes_share_their_ranges(tmp_path):
    """Two of two environments each: an update brings eight episodes to the eight that judge, all of
    them failures, so 0.3 becomes 0.2 and then 0.1. Four of one process alone would judge nothing.
    """
    changes = ["rl.envs=4", "rl.batch_size=8", "rl.total_steps=16", "rl.evaluate_every=1",
               "randomization.adaptive.episodes=8"]  # fmt: skip
    done = subprocess.run(
        [*TORCHRUN, REPOSITORY / "train_rl.py", *SHARED, *changes], cwd=tmp_path, timeout=300,
        capture_output=True, text=True,
        env=os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(REPOSITORY)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    (run,) = (tmp_path / "runs" / "train_rl").iterdir()
    rows = json.loads((run / "results.json").read_text())["history"]
    assert [row["range_width"] for row in rows] == pytest.approx([0.3, 0.2, 0.1])
