"""Training the critic: what it learns of executed grasps, and where these are kept."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from benchmarks import train_critic
from benchmarks.train_critic import (
    collect,
    compared,
    first_of_plans,
    fit,
    half_width,
    judged,
    scene_of_plans,
)
from benchmarks.train_critic import main as train
from envs.critic_examples import PLANNERS, Examples
from models.grasp_critic import INPUTS, GraspCritic
from tests.helpers.executed_grasps import column, made_up
from tests.helpers.simulators import INSTALLED
from utils.config import load_config
from utils.errors import UserError


@pytest.fixture(scope="module")
def known() -> GraspCritic:
    """One that has learned the rule of the cover."""
    return fit(made_up(300, 0), seed=0, epochs=15)


@pytest.mark.parametrize(("by_patch", "epochs"), [(False, 25), (True, 15)])
def test_a_rule_is_learned(by_patch, epochs) -> None:
    critic = fit(made_up(300, 0, by_patch), seed=0, epochs=epochs)
    scores = judged(critic, made_up(100, 1, by_patch))
    for name in PLANNERS:
        assert scores[f"{name} by search"] < 0.2  # and as many nothing else
        assert scores[f"{name} by critic"] > 0.8  # a sixteenth of the plans holds no success
    assert scores["calibration error"] < 0.05


def test_the_first_of_each_plan_is_the_one_of_highest_score() -> None:
    examples = made_up(2, 0)._replace(plan=np.repeat([4, 9], 12))
    score = np.arange(24.0) % 12
    np.testing.assert_array_equal(first_of_plans(examples, score), examples.success[[11, 23]])


def test_plans_of_one_scene_are_not_independent() -> None:
    """Of ten scenes whose four plans end alike, the mean is as certain as of ten plans."""
    ends, scene = np.array([1.0, 0, 0, 1, 1, 0, 1, 1, 1, 0]), np.arange(10)
    alone = half_width(ends, scene)
    assert alone == pytest.approx(1.96 * ends.std(ddof=1) / np.sqrt(10))
    assert half_width(np.repeat(ends, 4), np.repeat(scene, 4)) == pytest.approx(alone)
    examples = made_up(3, 0)
    plans = len({*examples.plan}) // 3
    assert [*scene_of_plans(examples)] == [*np.repeat([0, 1, 2], plans)]


def test_the_same_examples_give_the_same_critic() -> None:
    one, other = (fit(made_up(30, 0), seed=3, epochs=2) for _ in range(2))
    inputs = made_up(5, 1).inputs
    np.testing.assert_array_equal(one.chance(inputs), other.chance(inputs))


def test_the_first_of_a_plan_is_sought_among_those_that_were_drawn(known) -> None:
    """Of each plan, the candidate of highest cover was chosen by a critic: it does not count."""
    examples = made_up(60, 1)
    chosen = first_of_plans(
        examples._replace(success=np.arange(720)), column(examples.inputs, "cover")
    )
    examples.drawn[chosen] = False
    examples.success[:] = False
    examples.success[chosen] = True
    assert judged(known, examples)["graspnet6d by critic"] == 0
    assert judged(known, examples._replace(drawn=~examples.drawn))["graspnet6d by critic"] == 1


def test_a_comparison_judges_each_scene_by_what_learned_from_the_others(monkeypatch) -> None:
    """A critic without training ranks by chance; trained on the rule it finds it in scenes that it
    has not seen, with either hand: half of the scenes are of VGN's, all cameras upright."""
    examples = made_up(200, 0)
    facts = examples.inputs.facts
    facts[:, INPUTS.index("least_held")] = np.where(examples.scene % 4 < 2, 0.008, 0.0)
    facts[:, INPUTS.index("camera_height")] = 1.0
    learned_from = []

    def fitted(own: Examples, seed: int, initial: GraspCritic, device) -> GraspCritic:
        learned_from.append({*own.scene})
        return fit(own, seed, epochs=15)

    monkeypatch.setattr("benchmarks.train_critic.fit", fitted)
    torch.manual_seed(0)
    table = compared(GraspCritic(), examples, seed=0, folds=2)
    assert [len(scenes) for scenes in learned_from] == [100, 100]
    assert not learned_from[0] & learned_from[1]
    rows = {line[:16].strip(): line[16:].split() for line in table.splitlines()[2:]}
    assert {*rows} == {"all", "the arm's hand", "VGN's hand", "camera upright"}
    assert [int(rows[name][0]) for name in ("all", "the arm's hand", "VGN's hand")] == [
        len({*examples.plan}), len({*examples.plan}) // 2, len({*examples.plan}) // 2
    ]  # fmt: skip
    for row in rows.values():
        before, after = float(row[1]), float(row[3])
        assert after > 80 > before + 20  # half of what is drawn by chance succeeds
        assert float(row[5]) == pytest.approx(after - before, abs=0.11)


def test_a_stopped_collection_goes_on(tmp_path, monkeypatch) -> None:
    """Of 120 scenes in files of 50, the last file is missing: its 20 scenes alone are played."""
    played = []

    def examples(config, number: int) -> Examples:
        played.append(number)
        return made_up(1, number)._replace(scene=np.full(12, number))

    monkeypatch.setattr("envs.critic_examples.examples_of", examples)
    monkeypatch.setattr(
        "benchmarks.train_critic.completed", lambda workers, call, numbers: map(call, numbers)
    )
    config = load_config(None, ["data.workers=1"])
    whole = collect(config, 120, tmp_path)
    assert played == list(range(120))
    (tmp_path / "scenes-00100-00119.npz").unlink()
    played.clear()
    again = collect(config, 120, tmp_path)
    assert played == list(range(100, 120))
    for one, other in zip((*whole.inputs, *whole[1:]), (*again.inputs, *again[1:])):
        np.testing.assert_array_equal(one, other)
    played.clear()
    more, fewer = collect(config, 160, tmp_path), collect(config, 60, tmp_path)
    assert played == list(range(120, 160)), "an unfinished file is gone on with in another"
    assert [*more.scene[::12]] == list(range(160)) and [*fewer.scene[::12]] == list(range(60))
    others = [("seed=1", "seed")]
    others += [("simulator=mujoco", "simulator")] if len(INSTALLED) > 1 else []
    for setting, name in others:
        with pytest.raises(UserError, match=f"holds grasps of another {name}; give another folder"):
            collect(load_config(None, ["data.workers=1", setting]), 120, tmp_path)
    (tmp_path / "scenes-00000-00049.npz").write_bytes(b"no archive")
    with pytest.raises(UserError, match=r"scenes-00000-00049\.npz: holds no executed grasps"):
        collect(config, 120, tmp_path)
    (tmp_path / "settings.json").write_text("{")
    with pytest.raises(UserError, match=r"settings\.json: cannot be read"):
        collect(config, 120, tmp_path)


def test_grasps_of_other_meshes_are_not_taken(tmp_path) -> None:
    own = tmp_path / "own"
    own.mkdir()
    (own / "cube.obj").write_text("v 0 0 0")
    config = load_config(None, [f"data.object_sets={own}"])
    train_critic.check_same_settings(tmp_path, config)
    train_critic.check_same_settings(tmp_path, config)
    (own / "cube.obj").write_text("v 0 0 1")
    with pytest.raises(UserError, match="grasps of another content of object_sets; give another"):
        train_critic.check_same_settings(tmp_path, config)
    built_in = load_config(None, ["data.object_sets=primitives"])
    train_critic.check_same_settings(tmp_path / "built_in", built_in)
    assert "content" not in (tmp_path / "built_in" / "settings.json").read_text()


def test_a_critic_goes_on_from_another_ones_weights(known) -> None:
    """Of a rule that is known already, few examples take nothing away."""
    few = made_up(20, 2)
    again, anew = fit(few, seed=0, epochs=1, initial=known), fit(few, seed=0, epochs=1)
    torch.testing.assert_close(again.mean, known.mean)
    tested = made_up(100, 1)
    assert judged(again, tested)["graspnet6d by critic"] > 0.8
    assert judged(anew, tested)["graspnet6d by critic"] < 0.7


def test_scenes_without_grasps_are_one_sentence(tmp_path, monkeypatch) -> None:
    few = made_up(3, 1)
    monkeypatch.setattr(train_critic, "collect", lambda *_: few.where(few.scene < 0))
    with pytest.raises(UserError, match="0 grasps were executed, 0 of them in the tenth"):
        train(["--scenes", "10", "--output", str(tmp_path / "critic.pt")])


def test_what_cannot_be_trained_is_refused(tmp_path) -> None:
    with pytest.raises(UserError, match="--scenes 3: give 10 or more"):
        train(["--scenes", "3", "--output", str(tmp_path / "critic.pt")])
    for both in ([], ["--folds", "2", "--output", str(tmp_path / "critic.pt")]):
        with pytest.raises(UserError, match=r"give --output FILE\.pt or --folds K"):
            train(both)
    for wrong in (["2"], ["1", "--initial", "c.pt"], ["2", "--initial", "c.pt", "--more", "f"]):
        with pytest.raises(UserError, match=f"--folds {wrong[0]}: give 2 or more"):
            train(["--folds", *wrong])


def test_grasps_of_other_runs_are_learned_from_too(tmp_path, monkeypatch, capsys) -> None:
    """20 scenes of 12 grasps, 2 of which are held out, and 12 scenes of another run, of which those
    with the numbers of held-out ones, 0 and 10, are left out, too."""
    monkeypatch.setattr(
        "envs.critic_examples.examples_of",
        lambda config, number: made_up(1, number)._replace(scene=np.full(12, number)),
    )
    monkeypatch.setattr(
        "benchmarks.train_critic.completed", lambda workers, call, numbers: map(call, numbers)
    )
    monkeypatch.setattr("benchmarks.train_critic.EPOCHS", 1)
    more = tmp_path / "more"
    others = [made_up(1, k)._replace(scene=np.full(12, k)) for k in range(12)]
    Examples.joined(others).save(more / "scenes-00000-00011.npz")
    call = ["--output", str(tmp_path / "c.pt"), "--scenes", "20", "--examples", str(tmp_path / "e")]
    assert train([*call, "--more", str(more), "data.workers=1"]) == 0
    assert f"learned from {18 * 12 + 10 * 12}\n" in capsys.readouterr().out
    compare = ["--folds", "2", "--initial", call[1], *call[2:], "data.workers=1"]
    assert train(compare) == 0
    assert "VGN's hand" in capsys.readouterr().out
    with pytest.raises(UserError, match=r"--more .*nothing: holds no executed grasps"):
        train([*call, "--more", str(tmp_path / "nothing"), "data.workers=1"])
