"""Hostile actions in every mode and simulator, and the watch that compares the arm with limits."""

from threading import Event
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.soak_arm import (
    MODES,
    SAMPLED,
    LimitWatch,
    hostile_actions,
    hostile_episodes,
    judge_memory,
    soak_memory,
)
from benchmarks.soak_tally import Tally
from envs.robot_kinematics import JOINT_UPPER
from tests.helpers.simulators import INSTALLED
from utils.config import load_config


def test_actions_are_extreme_and_of_all_kinds():
    random = np.random.default_rng(0)
    actions = np.array([a for a, _ in zip(hostile_actions(5, random), range(2000))])
    within = abs(actions).max(axis=1) <= 1
    assert 0.5 < within.mean() < 0.95 and abs(actions).max() > 1e100
    assert np.isfinite(actions).all()
    assert {-1.0, 0.0, 1.0} <= set(actions[within].ravel())


@pytest.mark.parametrize("simulator", INSTALLED)
def test_limits_hold_at_every_physics_step_of_every_mode(simulator):
    config = load_config(None, [f"simulator={simulator}", "sim.renderer=tiny"])
    watch, tally, random = LimitWatch(config), Tally("actions"), np.random.default_rng(1)
    for mode in MODES:
        hostile_episodes(config, mode, 20, random, watch, tally, Event())
    assert tally.tried == 200 and watch.steps == 200 * 20
    assert watch.speed <= 1e-6
    # Momentum, and what presses on the arm, may take it beyond a limit that no command passes.
    assert tally.survived == 200 - len(watch.forces) >= 198


@pytest.mark.parametrize(
    ("changed", "value"),
    [(0, JOINT_UPPER[0] + 0.01), (1, 1.7), (7, 2.18), (3, np.nan), (9, np.inf)],
    ids=["range", "box", "speed", "NaN", "infinite"],
)
def test_what_is_beyond_a_limit_is_noticed(changed, value):
    config = load_config()
    state = [*config.robot.home, *np.zeros(7), 0.08]
    robot = SimpleNamespace(state=lambda: list(state))
    watch, cell = LimitWatch(config), SimpleNamespace(robot=robot)
    watch.follow(cell)
    cell.on_step(cell)
    assert watch.held()
    state[changed] = value
    cell.on_step(cell)
    assert not watch.held()


def test_memory_is_measured_over_resets_and_steps():
    (tally,) = soak_memory(INSTALLED[0], 2e-4, 0, Event())
    assert tally.tried == tally.survived >= 200
    assert "resets, actions of 4 physics steps" in tally.note
    assert tally.note.endswith("too few episodes to judge the memory")


@pytest.mark.parametrize(("kilobytes", "survived"), [(3.9, 12), (4.1, 0)])
def test_memory_is_judged_by_the_episode_however_short_the_run(kilobytes, survived):
    tally = Tally("memory", tried=12, survived=12)
    beginning = [int(1e6), int(9e8), int(2e8)]  # does not count
    judge_memory(tally, beginning + [int(3e8 + n * SAMPLED * 1e3 * kilobytes) for n in range(4)])
    assert tally.survived == survived
    assert tally.note == f"; 301 MB at the end, +{kilobytes} kB an episode in the second half"
