"""The plan of an evaluation, and playing it."""

import os
import signal
from dataclasses import replace

import numpy as np
import pytest

from tests.helpers.played_here import CallingExecutor
from tests.helpers.processes import another_process_within
from tests.helpers.records import CONFIG, ROUNDS
from utils import evaluation, executor
from utils.config import changed_keys, load_config
from utils.errors import UserError
from utils.evaluation import (
    FilmFile,
    TaskResult,
    check_depth_noises,
    check_rounds,
    depth_noises_of,
    describe_workers,
    going_on,
    in_order,
    interruption,
    planned_rounds,
    play,
    replay,
    tasks,
    with_depth_noise,
)
from utils.report import GalleryItem
from utils.result_records import Sample, append_round, read_rounds
from utils.runs import new_run_folder


def test_tasks_cover_the_plan_once(config):
    plan = config.evaluate
    listed = list(tasks(config, []))
    assert len(listed) == plan.rounds * len(plan.scenarios) * len(plan.object_sets)
    entries = tuple(
        (policy, "open_loop", noise) for noise in ("realsense", "none") for policy in plan.policies
    )
    assert all(task.policies == entries for task in listed)


@pytest.mark.parametrize(("seed", "scenes"), [(0, {0, 1}), (3, {300_000, 300_001})])
def test_evaluations_of_two_seeds_share_no_scene(seed, scenes):
    config = load_config(None, [f"seed={seed}", "evaluate.rounds=2"])
    assert {task.seed for task in tasks(config, [])} == scenes


def test_only_missing_rounds_are_left_to_do():
    (task,) = tasks(CONFIG, ROUNDS[1:])
    assert (task.seed, task.policies) == (0, (("heuristic", "open_loop", "none"),))


def test_an_interrupted_evaluation_says_how_many_of_the_planned_rounds_it_has():
    assert planned_rounds(CONFIG) == 4
    assert interruption(4, CONFIG) is None
    assert interruption(3, CONFIG) == "interrupted: 3 of 4 rounds"
    several = load_config(None, ["evaluate.controllers=open_loop,ibvs", "evaluate.scenarios=moved",
                              "evaluate.policies=heuristic", "evaluate.rounds=7"])  # fmt: skip
    assert planned_rounds(several) == 28


def test_rounds_are_in_the_order_of_the_plan():
    assert in_order(ROUNDS[::-1], CONFIG) == ROUNDS


def test_each_depth_noise_is_a_row_of_its_own_in_the_order_of_the_key():
    """Noisy rows come first, and only the clean rounds are left to do."""
    config = one_worker("evaluate.depth_noises=realsense,none")
    noisy = [replace(record, depth_noise="realsense") for record in ROUNDS]
    assert in_order([*ROUNDS, *noisy][::-1], config) == [*noisy, *ROUNDS]
    assert planned_rounds(config) == 8
    left = [task.policies for task in tasks(config, noisy)]
    assert left == 2 * [(("heuristic", "open_loop", "none"), ("random", "open_loop", "none"))]


def test_only_the_first_depth_noise_is_filmed():
    config = one_worker("evaluate.depth_noises=gamma,none", "evaluate.videos=1")
    assert [task.filmed for task in tasks(config, [])] == ["gamma", None]


# --- Which depth noise counts -------------------------------------------------------------------


def test_the_camera_s_own_noise_is_scored_alone_where_it_is_set(tmp_path):
    """On the command line, in a file, and in a run of an older version, which has no
    evaluate.depth_noises. A list that is set, too, counts."""
    (tmp_path / "mine.yaml").write_text("camera: {depth_noise: kinect}\n")
    for config in (load_config(None, ["camera.depth_noise=kinect"]),
                   load_config(tmp_path / "mine.yaml")):  # fmt: skip
        assert depth_noises_of(config) == ("kinect",)
        assert load_config(None, changed_keys(config)) == config
    assert depth_noises_of(load_config(None, ["camera.depth_noise=none"])) == ("none",)
    both = load_config(tmp_path / "mine.yaml", ["evaluate.depth_noises=none,kinect"])
    assert depth_noises_of(both) == ("none", "kinect")
    assert load_config(None, changed_keys(both)) == both
    assert depth_noises_of(load_config()) == ("realsense", "none")


def test_parameters_belong_to_the_camera_s_own_noise():
    config = load_config(None, ["camera.depth_noise=kinect", "camera.depth_noise_args={noise: 0.3}",
                                "evaluate.depth_noises=kinect,realsense"])  # fmt: skip
    check_depth_noises(config)
    assert with_depth_noise(config, "kinect") == config
    assert with_depth_noise(config, "kinect").camera.make_noise(480.0).noise == 0.3
    usual = load_config(None, ["camera.depth_noise=realsense", "evaluate.depth_noises=null"]).camera
    assert with_depth_noise(config, "realsense").camera == usual


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["camera.depth_noise=kinect"], "camera.depth_noise=kinect would be ignored: evaluate"),
        (["camera.depth_noise=none"], "camera.depth_noise=none would be ignored"),
    ],
)
def test_a_noise_that_would_be_ignored_is_refused(overrides, message):
    overrides = ["evaluate.depth_noises=realsense,gamma", *overrides]
    with pytest.raises(UserError, match=message):
        check_depth_noises(load_config(None, overrides), overrides)


def test_an_evaluation_can_only_grow(tmp_path):
    run = new_run_folder("evaluate", None, CONFIG, tmp_path)
    check_rounds(CONFIG, None)
    check_rounds(load_config(run / "config.yaml", ["evaluate.rounds=3"]), run)
    with pytest.raises(UserError, match="evaluate.rounds is 1, the run began with 2; it can only"):
        check_rounds(load_config(run / "config.yaml", ["evaluate.rounds=1"]), run)


# --- Played by workers that know the records by heart -------------------------------------------


def known_round(config, task):
    return TaskResult([
        replace(r, depth_noise=noise)
        for policy, _, noise in task.policies
        for r in ROUNDS
        if (r.policy, r.seed) == (policy, task.seed)
    ])  # fmt: skip


def no_second_scene(config, task):
    if task.seed == 1:
        raise UserError("the second scene cannot be made")
    return known_round(config, task)


def test_a_resumed_evaluation_plays_the_rest(tmp_path, played_here):
    config = one_worker()
    append_round(tmp_path / "rounds.jsonl", ROUNDS[2])
    outcome = play(config, tmp_path, known_round)
    assert outcome.rounds == ROUNDS and outcome.error is None and not outcome.interrupted
    assert len(read_rounds(tmp_path / "rounds.jsonl")) == 4


def filmed(config, task):
    image = np.full((8, 8, 3), task.seed, np.uint8)
    pictures = [GalleryItem(image, f"scene {task.seed}", False, "heuristic")]
    film = FilmFile(f"{task.seed}.mp4", b"film", f"film of {task.seed}")
    return TaskResult(known_round(config, task).rounds, pictures, [film])


def test_a_resumed_evaluation_shows_the_pictures_and_films_of_both_parts(tmp_path, played_here):
    play(one_worker("evaluate.rounds=1"), tmp_path, filmed)
    outcome = play(one_worker(), tmp_path, filmed)
    assert [item.caption for item in outcome.gallery] == ["scene 0", "scene 1"]
    assert [item.image.max() for item in outcome.gallery] == [0, 1]
    films = tmp_path / "films"
    assert outcome.films == [(films / "0.mp4", "0"), (films / "1.mp4", "film of 1")]
    again = play(one_worker(), tmp_path, filmed)
    assert len(again.gallery) == len(again.films) == 2


def test_what_a_killed_evaluation_shows_is_on_the_disk_before_its_rounds(
    tmp_path, monkeypatch, played_here
):
    """The films; and the pictures, here with every task."""
    monkeypatch.setattr(evaluation, "GALLERY_SECONDS", -1)
    there = []

    def append(journal, record):
        there.append((record.seed, len(list(tmp_path.glob("films/*")))))

    monkeypatch.setattr(evaluation, "append_round", append)
    monkeypatch.setattr(evaluation, "write_gallery", lambda *what: there.append(len(what[1])))
    play(one_worker(), tmp_path, filmed)
    assert there == [(0, 1), (0, 1), 1, (1, 2), (1, 2), 2, 2]


def test_a_round_that_was_played_twice_is_refused(tmp_path):
    for record in (*ROUNDS[:2], ROUNDS[0]):
        append_round(tmp_path / "rounds.jsonl", record)
    with pytest.raises(UserError, match="round of heuristic on box in .* the seed 0, 2 times"):
        play(one_worker(), tmp_path, known_round)


def test_two_processes_do_not_play_the_same_run(tmp_path, played_here):
    journal = tmp_path / "rounds.jsonl"
    with another_process_within(
        "from utils.result_records import writing", "writing(argument)", journal
    ):
        with pytest.raises(UserError, match="rounds.jsonl: another process is adding rounds"):
            play(one_worker(), tmp_path, known_round)
        assert not journal.exists()
    assert play(one_worker(), tmp_path, known_round).rounds == ROUNDS


def test_a_round_with_a_noise_that_the_config_does_not_play_is_refused(tmp_path):
    append_round(tmp_path / "rounds.jsonl", replace(ROUNDS[0], depth_noise="gamma"))
    with pytest.raises(UserError, match="with the depth noise gamma, which its config does not"):
        play(one_worker(), tmp_path, known_round)


def test_a_scene_that_cannot_be_made_ends_the_run_but_not_the_results(tmp_path, played_here):
    outcome = play(one_worker(), tmp_path, no_second_scene)
    assert "second scene" in str(outcome.error)
    assert outcome.rounds == [ROUNDS[0], ROUNDS[2]] == read_rounds(tmp_path / "rounds.jsonl")


def dies_of_the_second_scene(config, task):
    if task.seed == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return known_round(config, task)


def test_a_scene_that_no_process_survives_leaves_the_rounds_so_far(tmp_path, monkeypatch):
    """Which the next part of the run does not play again."""
    monkeypatch.setattr(executor, "MOST_LOSSES", 1)  # of 4: each starts a process
    outcome = play(one_worker(), tmp_path, dies_of_the_second_scene)
    journal = tmp_path / "rounds.jsonl"
    error = str(outcome.error)
    assert error.startswith("1 worker processes in a row died of the same task")
    assert f"; 2 rounds are safe in {journal}: go on with {going_on(tmp_path)}, perhaps" in error
    assert f"evaluate.py --resume {tmp_path}, perhaps with evaluate.workers=1" in error
    assert outcome.rounds == [ROUNDS[0], ROUNDS[2]] == read_rounds(journal)
    monkeypatch.setattr(evaluation, "open_executor", CallingExecutor)
    again = play(one_worker(), tmp_path, known_round)
    assert again.error is None and again.rounds == ROUNDS and len(read_rounds(journal)) == 4


def test_a_sample_is_played_again(played_here):
    sample = Sample(None, {}, [], ROUNDS[:3])
    assert replay(sample, one_worker(), known_round) == ROUNDS[:3]


@pytest.mark.parametrize(
    "override, round_",
    [("evaluate.policies=oracle", "heuristic"), ("evaluate.scenarios=packed", "box")],
)
def test_what_leaves_a_round_of_a_sample_out_is_named(override, round_):
    sample = Sample(None, {}, [], ROUNDS[:3])
    words = f"a round of {round_}.*, which its own config with {override} does not .*; omit"
    with pytest.raises(UserError, match=words):
        replay(sample, one_worker(override), known_round, [override])


def test_a_torn_journal_is_gone_on_with(tmp_path, played_here):
    append_round(tmp_path / "rounds.jsonl", ROUNDS[0])
    with (tmp_path / "rounds.jsonl").open("a") as journal:
        journal.write('{"policy": "heur')
    assert play(one_worker(), tmp_path, known_round).rounds == ROUNDS
    assert len(read_rounds(tmp_path / "rounds.jsonl")) == len(ROUNDS)


def one_worker(*overrides):
    changes = [*changed_keys(CONFIG), "evaluate.workers=1", *overrides]
    return load_config(None, changes)


@pytest.mark.parametrize(("count", "words"), [(1, "1 worker"), (3, "3 workers")])
def test_one_worker_is_singular(count, words):
    assert describe_workers(load_config(None, [f"evaluate.workers={count}"])).endswith(f", {words}")
    cluster = load_config(None, ["compute.scheduler=tcp://a:1", f"evaluate.workers={count}"])
    assert describe_workers(cluster) == f"the cluster of tcp://a:1, {words}"
