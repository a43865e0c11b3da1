"""The plan of an evaluation, and playing it."""

import pytest

from tests.helpers.records import CONFIG, ROUNDS
from utils.config import load_config
from utils.errors import UserError
from utils.evaluation import (
    TaskResult,
    check_rounds,
    in_order,
    interruption,
    planned_rounds,
    play,
    replay,
    tasks,
)
from utils.result_records import Sample, append_round, read_rounds
from utils.runs import new_run_folder


def test_tasks_cover_the_plan_once(config):
    plan = config.evaluate
    listed = list(tasks(config, []))
    assert len(listed) == plan.rounds * len(plan.scenarios) * len(plan.object_sets)
    pairs = tuple((policy, "open_loop") for policy in plan.policies)
    assert all(task.policies == pairs for task in listed)


def test_only_missing_rounds_are_left_to_do():
    (task,) = tasks(CONFIG, ROUNDS[1:])
    assert (task.seed, task.policies) == (0, (("heuristic", "open_loop"),))


def test_interruption():
    assert planned_rounds(CONFIG) == 4
    assert interruption(4, CONFIG) is None
    assert interruption(3, CONFIG) == "interrupted: 3 of 4 rounds"
    several = load_config(None, ["evaluate.controllers=open_loop,ibvs", "evaluate.scenarios=moved",
                              "evaluate.policies=heuristic", "evaluate.rounds=7"])  # fmt: skip
    assert planned_rounds(several) == 14


def test_rounds_are_in_the_order_of_the_plan():
    assert in_order(ROUNDS[::-1], CONFIG) == ROUNDS


def test_an_evaluation_can_only_grow(tmp_path):
    run = new_run_folder("evaluate", None, CONFIG, tmp_path)
    check_rounds(CONFIG, None)
    check_rounds(load_config(run / "config.yaml", ["evaluate.rounds=3"]), run)
    with pytest.raises(UserError, match="evaluate.rounds is 1, the run began with 2; it can only"):
        check_rounds(load_config(run / "config.yaml", ["evaluate.rounds=1"]), run)


# --- Played by workers that know the records by heart -------------------------------------------


def known_round(config, task):
    rounds = [r for r in ROUNDS if r.seed == task.seed and (r.policy, "open_loop") in task.policies]
    return TaskResult(rounds)


def no_second_scene(config, task):
    if task.seed == 1:
        raise UserError("the second scene cannot be made")
    return known_round(config, task)


def test_a_resumed_evaluation_plays_the_rest(tmp_path):
    config = load_config(None, [*_overrides(), "evaluate.workers=1"])
    append_round(tmp_path / "rounds.jsonl", ROUNDS[2])
    outcome = play(config, tmp_path, known_round)
    assert outcome.rounds == ROUNDS and outcome.error is None and not outcome.interrupted
    assert len(read_rounds(tmp_path / "rounds.jsonl")) == 4


def test_a_scene_that_cannot_be_made_ends_the_run_but_not_the_results(tmp_path):
    config = load_config(None, [*_overrides(), "evaluate.workers=1"])
    outcome = play(config, tmp_path, no_second_scene)
    assert "second scene" in str(outcome.error)
    assert outcome.rounds == [ROUNDS[0], ROUNDS[2]] == read_rounds(tmp_path / "rounds.jsonl")


def test_a_sample_is_played_again():
    sample = Sample(None, {}, [], ROUNDS[:3])
    again = replay(sample, load_config(None, [*_overrides(), "evaluate.workers=1"]), known_round)
    assert again == ROUNDS[:3]


def _overrides():
    return ["evaluate.policies=heuristic,random", "evaluate.scenarios=pile", "evaluate.rounds=2",
            "evaluate.object_sets=box"]  # fmt: skip
