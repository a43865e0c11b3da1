"""Chances fitted to the executed grasps of runs, and the shipped ones."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from dataclasses import replace
from fnmatch import fnmatch

import numpy as np
import pytest

from benchmarks.calibrate import (
    ExecutedGrasps,
    commit_of,
    fitted_chances,
    grasps_of,
    main,
    rounds_of,
)
from models.planners import CALIBRATIONS
from utils.calibration import Calibration, load_calibrations
from utils.config import dump_config, load_config
from utils.errors import UserError
from utils.result_records import AttemptRecord, RoundRecord, append_round, read_rounds
from utils.results import stated_chances, summarise
from utils.runs import REPOSITORY
from utils.transforms import ImageGrasp


def played(
    policy: str,
    grasps: list[tuple[float, bool]],
    line: tuple[float, float] | None = None,
    roughness: float = 0.0,
) -> RoundRecord:
    attempts = tuple(
        AttemptRecord(won, "success" if won else "missed", 0.01, 3.0,
                      ImageGrasp(np.zeros(2), 0.0, 0.7, 0.05, quality), roughness=roughness)
        for quality, won in grasps
    )  # fmt: skip
    cleared = sum(won for _, won in grasps)
    return RoundRecord(
        policy, "pile", "box", 1, len(grasps), cleared, attempts, "failures", calibration=line
    )


def test_a_row_has_the_error_of_what_was_stated() -> None:
    grasps = [(0.8, True), (0.8, False), (0.95, True)]
    (row,) = summarise([played("heuristic", grasps, (1.0, 2.0))], 0)
    assert row.calibration_error == pytest.approx(0.65 / 3)
    (row,) = summarise([played("mine", grasps)], 0)
    assert row.calibration_error is None  # scores
    assert stated_chances([played("mine", grasps)]) is None


def test_the_journal_leads_back_to_the_scores(tmp_path) -> None:
    line = Calibration(1.5, 2.0)
    scores = np.array([0.2, 0.5, 0.9, 1.1])
    raw = played("heuristic", [*zip(scores.tolist(), [True, False, True, True])])
    stated = played(
        "heuristic", [*zip(line(scores).tolist(), [True, False, True, True])], (1.5, 2.0)
    )
    append_round(tmp_path / "rounds.jsonl", stated)
    (read,) = read_rounds(tmp_path / "rounds.jsonl")
    assert read.calibration == (1.5, 2.0, 0.0, 0.0, 0.0)  # as older files have it
    for record in (raw, read):
        np.testing.assert_allclose(grasps_of([record])[0], scores)


def test_a_success_ends_the_doubt() -> None:
    won = [False, True, True, False, False, True]
    assert grasps_of([played("heuristic", [(0.9, one) for one in won])]).failed.tolist() == [
        False, True, False, False, True, True,
    ]  # fmt: skip


def test_runs_that_do_not_tell_how_rough_their_frames_were_are_not_fitted(tmp_path) -> None:
    record = played("heuristic", [(0.9, True), (0.7, False)])
    older = replace(record.attempts[1], roughness=None)
    append_round(tmp_path / "rounds.jsonl", replace(record, attempts=(record.attempts[0], older)))
    (read,) = read_rounds(tmp_path / "rounds.jsonl")
    assert [attempt.roughness for attempt in read.attempts] == [0.0, None]
    with pytest.raises(UserError, match="scene 1: an older run.* play it again"):
        grasps_of([read])


def test_runs_are_fitted_and_only_those_of_training_objects_are_written(tmp_path, capsys) -> None:
    for split in ("train", "test"):
        (tmp_path / split).mkdir()
        config = load_config(None, [f"objects.split={split}", "evaluate.abstain=0"])
        (tmp_path / split / "config.yaml").write_text(dump_config(config))
        grasps = [(0.9, True), (0.7, True), (0.6, False), (0.8, True)]
        append_round(tmp_path / split / "rounds.jsonl", played("heuristic", grasps))
        nothing = RoundRecord(
            "heuristic",
            "bin",
            "box",
            2,
            1,
            0,
            (AttemptRecord(False, "no_plan", 0.1, 0.0),),
            "no_plan",
        )
        append_round(tmp_path / split / "rounds.jsonl", nothing)
    file = tmp_path / "fits.json"
    file.write_text(json.dumps({"planners": {"oracle": {"slope": 1.5, "offset": 2.5}}}))
    assert main([str(tmp_path / "train"), "--output", str(file)]) == 0
    assert "heuristic  pile" in capsys.readouterr().out
    content = json.loads(file.read_text())
    fits = content["planners"]
    assert fits["heuristic"]["runs"] == ["train"] and fits["heuristic"]["successes"] == 3
    assert fits["oracle"] == {"slope": 1.5, "offset": 2.5}  # the runs have no such planner
    shutil.copytree(tmp_path / "train", tmp_path / "another" / "train")  # of the same name
    runs = [str(tmp_path / "train"), str(tmp_path / "another" / "train")]
    assert main([*runs, *runs[:1], "--output", str(tmp_path / "both.json")]) == 0
    both = json.loads((tmp_path / "both.json").read_text())["planners"]["heuristic"]
    assert both["grasps"] == 8 and both["runs"] == ["train", "train"]
    with pytest.raises(UserError, match="train.*config.yaml: exists and holds no fits"):
        main([str(tmp_path / "train"), "--output", str(tmp_path / "train" / "config.yaml")])
    with pytest.raises(UserError, match="split is test.*training objects alone"):
        main([str(tmp_path / "test"), "--output", str(file)])
    assert main([str(tmp_path / "test")]) == 0
    for abstain in ("0.5", "null"):
        surest = load_config(None, ["objects.split=train", f"evaluate.abstain={abstain}"])
        (tmp_path / "train" / "config.yaml").write_text(dump_config(surest))
        with pytest.raises(UserError, match="not all grasps may have been tried"):
            main([str(tmp_path / "train"), "--output", str(file)])
    with pytest.raises(UserError, match=r"no rounds.jsonl"):
        main([str(tmp_path / "nothing")])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("robot.arm=none", "robot.arm is not panda"),
        ("evaluate.randomise=true", "evaluate.randomise is not false"),
        ("gripper.max_opening=0.1", "the section gripper is not the default"),
    ],
)
def test_fits_of_another_cell_than_the_arms_are_not_written(tmp_path, change, message) -> None:
    config = load_config(None, ["objects.split=train", "evaluate.abstain=0", change])
    (tmp_path / "config.yaml").write_text(dump_config(config))
    append_round(tmp_path / "rounds.jsonl", played("heuristic", [(0.9, True), (0.7, False)]))
    assert len(rounds_of(tmp_path, None)) == 1
    with pytest.raises(UserError, match=f"{message}: play it with that, or omit --output"):
        rounds_of(tmp_path, tmp_path / "fits.json")


def test_a_user_fits_planners_to_a_hand_of_their_own(tmp_path) -> None:
    changes = ["objects.split=train", "evaluate.abstain=0", "gripper.max_opening=0.1",
               "evaluate.policies=my_module:plan"]  # fmt: skip
    (tmp_path / "config.yaml").write_text(dump_config(load_config(None, changes)))
    append_round(tmp_path / "rounds.jsonl", played("my_module:plan", [(0.9, True)]))
    assert len(rounds_of(tmp_path, tmp_path / "fits.json")) == 1


def test_planners_of_a_user_are_fitted_and_random_and_policies_are_not(tmp_path, capsys) -> None:
    (tmp_path / "config.yaml").write_text(dump_config(load_config(None, ["objects.split=train"])))
    for name in ("random", "ppo:my.pt"):
        append_round(tmp_path / "rounds.jsonl", played(name, [(0.9, True), (0.7, False)]))
    with pytest.raises(UserError, match="no policy of these runs has scores.*random, ppo:my.pt"):
        main([str(tmp_path)])
    grasps = [(0.9, True), (0.7, True), (0.6, False), (0.8, True)]
    append_round(tmp_path / "rounds.jsonl", played("my_module:plan", grasps))
    assert main([str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert "my_module:plan" in printed and "random" not in printed and "ppo" not in printed


def test_a_score_of_one_that_was_rounded_is_one() -> None:
    rng = np.random.default_rng(0)
    scores = np.append(rng.uniform(0.3, 1, 400), 1.0)
    grasps = ExecutedGrasps(
        scores, scores, rng.random(401) < scores**3, np.zeros(401), np.zeros(401, bool)
    )
    exact, rounded = (
        fitted_chances({"my_module:plan": own})["my_module:plan"]
        for own in (grasps, grasps._replace(scores=scores * (1 + 2e-13)))
    )
    assert exact(0.99) == pytest.approx(rounded(0.99), abs=1e-6)


def test_what_the_critic_judges_has_no_penalty(tmp_path) -> None:
    """Rough frames fail oftener here, and only who does not see it in the score learns it."""
    (tmp_path / "config.yaml").write_text(
        dump_config(load_config(None, ["objects.split=train", "evaluate.abstain=0"]))
    )
    for name in ("graspnet", "graspnet6d", "heuristic"):
        grasps = [(0.9, True), (0.7, True), (0.6, False), (0.8, True)]
        append_round(tmp_path / "rounds.jsonl", played(name, grasps, roughness=0.0))
        rough = [(0.9, True), (0.7, False), (0.6, False), (0.8, False)]
        later = replace(played(name, rough, roughness=0.002), seed=2)
        append_round(tmp_path / "rounds.jsonl", later)
    assert main([str(tmp_path), "--output", str(tmp_path / "fits.json")]) == 0
    fits = load_calibrations(tmp_path / "fits.json")
    assert fits["graspnet"].penalty == fits["graspnet6d"].penalty == 0
    assert fits["heuristic"].penalty > 0


CONFIGS = {
    config.evaluate.name: config
    for config in map(load_config, sorted(REPOSITORY.glob("configs/calibration*")))
}


def test_the_shipped_fits_are_of_the_runs_that_the_configs_play() -> None:
    """For each planner, of the runs of all configs that have it; on training objects alone."""
    shipped = json.loads(CALIBRATIONS.read_text(encoding="utf-8"))["planners"]
    assert {*shipped} == {name for config in CONFIGS.values() for name in config.evaluate.policies}
    for name, fit in shipped.items():
        of = {run.split("-", 2)[2] for run in fit["runs"]}  # date, time, name
        assert of == {one for one, config in CONFIGS.items() if name in config.evaluate.policies}
    for config in CONFIGS.values():
        assert config.objects.split == "train" and config.evaluate.abstain == 0
        assert 900 <= config.seed <= 999


@pytest.mark.skipif(shutil.which("make") is None, reason="needs make")
def test_one_command_plays_every_config_and_fits_to_all_their_runs() -> None:
    done = subprocess.run(
        ["make", "-n", "calibration"], cwd=REPOSITORY, capture_output=True, text=True, check=True
    )
    played = re.findall(r"evaluate.py --config (\S+)", done.stdout)
    assert {load_config(REPOSITORY / file).evaluate.name for file in played} == {*CONFIGS}
    fitted = done.stdout.split("benchmarks.calibrate")[1]
    assert set(re.findall(r"runs/evaluate/\S+\]-([\w-]+)", fitted)) == {*CONFIGS}
    assert f"--output {CALIBRATIONS.relative_to(REPOSITORY)}" in fitted


def test_make_calibration_takes_its_own_runs_alone():
    text = (REPOSITORY / "Makefile").read_text(encoding="utf-8")
    (stamp,) = re.findall(r"^STAMP := (.*)$", text, re.MULTILINE)
    assert text.count("runs/evaluate/$(STAMP)-calibration") == 4
    own = "20261127-171555-calibration"
    assert fnmatch(own, f"{stamp}-calibration")
    for other in ("20261127-171555-my-calibration", f"{own}-household", f"{own}-rounded"):
        assert not fnmatch(other, f"{stamp}-calibration")


def test_chances_belong_to_the_code_that_the_grasps_were_executed_with(tmp_path):
    runs = [tmp_path / "a", tmp_path / "b"]
    for run, facts in zip(runs, ({"commit": "1" * 40}, {"commit": "2" * 40})):
        run.mkdir()
        (run / "environment.json").write_text(json.dumps(facts))
    assert commit_of(runs[:1]) == "1" * 40
    with pytest.raises(UserError, match="of several commits .1111.*2222.*play them anew"):
        commit_of(runs)
    (runs[1] / "environment.json").write_text(json.dumps({"commit": "2" * 40, "changes": "ab"}))
    with pytest.raises(UserError, match="b was played with uncommitted code"):
        commit_of(runs[1:])
    # One that was continued with other code is of both.
    facts = {"commit": "1" * 40, "continued": [{"commit": "3" * 40, "changes": None}]}
    (runs[0] / "environment.json").write_text(json.dumps(facts))
    with pytest.raises(UserError, match="of several commits .1111.*3333"):
        commit_of(runs[:1])
