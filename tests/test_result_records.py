"""Records that contradict themselves, the journal, and samples that others can play again."""

import json
import os
from dataclasses import replace

import numpy as np
import pytest

from tests.helpers.records import CONFIG, ROUNDS, a_round, attempt
from utils.config import load_config
from utils.errors import UserError
from utils.result_records import (
    AttemptRecord,
    RoundRecord,
    append_round,
    cut_torn_line,
    differing_rounds,
    ending,
    read_rounds,
    read_sample,
    without_times,
    write_sample,
)
from utils.runs import environment, new_run_folder
from utils.transforms import ImageGrasp


@pytest.mark.parametrize(
    "make",
    [
        lambda: AttemptRecord(True, "missed", 0, 0),
        lambda: AttemptRecord(False, "success", 0, 0),
        lambda: AttemptRecord(False, "bored", 0, 0),
        lambda: a_round("x", 0, 5, 6, []),
        lambda: a_round("x", 0, 5, 0, [], "bored"),
        lambda: a_round("x", 0, 5, 0, [attempt("missed")], "no_plan"),
        lambda: a_round("x", 0, 5, 0, [attempt("no_plan")], "failures"),
        lambda: a_round("x", 0, 5, 0, [attempt("planner_error")], "failures"),
    ],
)
def test_contradictory_records_are_refused(make):
    with pytest.raises(ValueError):
        make()


def test_a_planner_is_the_policy_without_its_controller():
    assert ROUNDS[0].planner == "heuristic"
    record = RoundRecord("my+net+ibvs", "moved", "box", 0, 1, 0, (), "failures", "ibvs")
    assert record.planner == "my+net"


@pytest.fixture
def journal(tmp_path):
    path = tmp_path / "rounds.jsonl"
    for record in ROUNDS:
        append_round(path, record)
    return path


def test_a_journal_holds_every_round(tmp_path):
    grasp = ImageGrasp(np.array([3.5, 4.25]), 0.1, 0.5, 0.07, 0.9)
    record = a_round("x", 3, 1, 0, [AttemptRecord(False, "missed", 0.1, 2.0, grasp, held="mug")])
    append_round(tmp_path / "rounds.jsonl", record)
    (read,) = read_rounds(tmp_path / "rounds.jsonl")
    assert read.attempts[0].grasp.pixel == [3.5, 4.25] and read.attempts[0].held == "mug"
    assert differing_rounds([record], [read]) == []
    assert read_rounds(tmp_path / "none.jsonl") == []


def test_each_line_of_a_journal_is_on_the_disk_at_once(tmp_path, monkeypatch):
    path, sizes = tmp_path / "rounds.jsonl", []
    monkeypatch.setattr(os, "fsync", lambda number: sizes.append(os.fstat(number).st_size))
    for record in ROUNDS[:2]:
        append_round(path, record)
        assert sizes[-1] == path.stat().st_size
    assert len(sizes) == 2 and sizes[0] < sizes[1]


def test_a_journal_of_an_older_version_is_read(tmp_path):
    """Without the keys that were added later."""
    attempt = {"success": True, "reason": "success", "plan_seconds": 0.1, "sim_seconds": 6.0}
    old = {
        "policy": "heuristic", "scenario": "pile", "objects": "box", "seed": 0, "ended": "cleared",
        "objects_total": 1, "objects_cleared": 1, "attempts": [attempt | {"grasp": None}],
    }  # fmt: skip
    (tmp_path / "old.jsonl").write_text(json.dumps(old) + "\n")
    (record,) = read_rounds(tmp_path / "old.jsonl")
    assert (record.successes, record.controller, record.randomization) == (1, "open_loop", None)
    assert record.depth_noise == "none"
    (record,) = read_rounds(tmp_path / "old.jsonl", "kinect")
    assert record.depth_noise == "kinect", "of the run's config"
    fell = old | {"ended": "lost", "objects_cleared": 0, "attempts": []}
    (tmp_path / "fell.jsonl").write_text(json.dumps(fell) + "\n")
    (record,) = read_rounds(tmp_path / "fell.jsonl")
    assert record.ended == "fell_off"
    origin = {"commit": None, "versions": {}, "overrides": ["camera.depth_noise=gamma"]}
    (tmp_path / "sample.jsonl").write_text(f"{json.dumps(origin)}\n{json.dumps(old)}\n")
    (record,) = read_sample(tmp_path / "sample.jsonl").rounds
    assert record.depth_noise == "gamma"


def test_a_torn_last_line_of_the_journal_is_taken_off(journal):
    whole = journal.read_text()
    torn = whole + whole.splitlines()[0][:40]
    journal.write_text(torn)
    before = read_rounds(journal)
    assert before == read_rounds(journal) and journal.read_text() == torn, "readers write nothing"
    cut_torn_line(journal)
    append_round(journal, replace(before[0], seed=7))
    assert len(read_rounds(journal)) == len(ROUNDS) + 1


def test_a_line_that_is_no_round_is_named(journal):
    with journal.open("a") as file:
        file.write('{"policy": "heuristic"}\n')
    with pytest.raises(UserError, match="rounds.jsonl, line 5: not a recorded round"):
        read_rounds(journal)


@pytest.mark.parametrize(
    ("place", "change"),
    [
        ("attempt", {"turn_ms": []}), ("attempt", {"turn_ms_mean": "8"}),
        ("attempt", {"turned": "x"}), ("attempt", {"slid": True}), ("attempt", {"tilt": None}),
        ("attempt", {"held": 3}), ("attempt", {"detail": None}), ("attempt", {"roughness": {}}),
        ("attempt", {"sim_seconds": 10**400}),
        ("round", {"target_in_hand": "x"}), ("round", {"randomization": [1]}),
    ],
)  # fmt: skip
def test_an_entry_of_another_type_is_named(journal, place, change):
    first, *others = journal.read_text().splitlines()
    content = json.loads(first)
    (content if place == "round" else content["attempts"][0]).update(change)
    journal.write_text("\n".join([json.dumps(content), *others]) + "\n")
    said = rf"rounds.jsonl, line 1: not a recorded round \({next(iter(change))} is "
    with pytest.raises(UserError, match=said):
        read_rounds(journal)


def test_a_sample_holds_the_first_rounds_of_each_row_and_their_origin(tmp_path):
    run = new_run_folder("evaluate", None, CONFIG, tmp_path)
    for record in reversed(ROUNDS):  # the workers' speed decides the order of a journal
        append_round(run / "rounds.jsonl", record)
    write_sample(run, tmp_path / "sample.jsonl", count=1)
    sample = read_sample(tmp_path / "sample.jsonl")
    assert sample.rounds == [ROUNDS[2], ROUNDS[0]], "the first round of each of two policies"
    append_round(run / "rounds.jsonl", replace(ROUNDS[0], depth_noise="kinect"))
    write_sample(run, tmp_path / "noisy.jsonl", count=1, commit="c0ffee")
    assert read_sample(tmp_path / "noisy.jsonl").commit == "c0ffee"
    noises = [record.depth_noise for record in read_sample(tmp_path / "noisy.jsonl").rounds]
    assert sorted(noises) == ["kinect", "none", "none"]
    assert load_config(None, sample.overrides) == CONFIG
    facts = environment()
    assert sample.commit == facts["commit"] and sample.versions["python"] == facts["python"]
    assert sample.versions["numpy"] == np.__version__


@pytest.mark.parametrize(
    "text",
    [
        "",
        "no json\n",
        '{"policy": "heuristic"}\n',
        "[1]\n",
        '{"commit": null, "versions": {}, "overrides": ["camera=3"]}',
        '{"commit": null, "versions": {}, "overrides": {"seed=1": 2}}',
        '{"commit": null, "versions": ["numpy"], "overrides": []}',
        '{"commit": null, "versions": {"numpy": 2}, "overrides": []}',
        '{"commit": 3, "versions": {}, "overrides": []}',
    ],
)
def test_a_file_that_is_no_sample_is_refused(tmp_path, text):
    (tmp_path / "file.jsonl").write_text(text)
    with pytest.raises(UserError, match="not a sample of rounds"):
        read_sample(tmp_path / "file.jsonl")
    with pytest.raises(UserError, match="cannot read"):
        read_sample(tmp_path / "missing.jsonl")


def test_rounds_differ_in_outcomes_not_in_wall_clock_times():
    def played(plan_seconds, sim_seconds):
        attempts = [attempt("success", plan_seconds, sim_seconds), attempt("no_plan", 0.2, 0)]
        return a_round("heuristic", 1, 5, 1, attempts, "no_plan")

    assert without_times(played(9.0, 6)) == without_times(ROUNDS[1])
    assert differing_rounds(ROUNDS[1:2], [played(9.0, 6)]) == []
    assert differing_rounds(ROUNDS[1:2], [played(0.06, 6.1)]) == ROUNDS[1:2]
    assert differing_rounds(ROUNDS[1:2], [played(0.06, 6.1)], ending) == []
    missed = [attempt("missed", 0.06, 6), attempt("no_plan", 0.2, 0)]
    other = a_round("heuristic", 1, 5, 1, missed, "no_plan")
    assert differing_rounds(ROUNDS[1:2], [other], ending) == ROUNDS[1:2]
    assert differing_rounds(ROUNDS, ROUNDS[:3]) == ROUNDS[3:]


def test_a_round_keeps_all_five_numbers_of_its_calibration(tmp_path):
    """Of older files, which have fewer, the others are 0."""
    file = tmp_path / "rounds.jsonl"
    whole = replace(ROUNDS[0], calibration=(1.57, -0.53, 600.0, 0.4, 1.07))
    append_round(file, whole)
    (text,) = file.read_text().splitlines()
    assert read_rounds(file) == [whole]
    file.write_text(text.replace(", 0.4, 1.07", "") + "\n")
    (read,) = read_rounds(file)
    assert read.calibration == (1.57, -0.53, 600.0, 0.0, 0.0)
