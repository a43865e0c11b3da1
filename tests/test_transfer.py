"""The transfer report: its figures by hand, its table, and the command from end to end."""

import json
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from utils.config import TransferPolicy, load_config
from utils.round_records import AttemptRecord, RoundRecord
from utils.statistics import mean_maximum_rank_violation, pearson_correlation
from utils.transfer import (
    Score,
    TransferLine,
    agreements,
    draw_transfer,
    format_transfer,
    score_of,
    transfer_content,
    transfer_notes,
)

REPOSITORY = Path(__file__).resolve().parent.parent
REPORT = REPOSITORY / "configs" / "sim_to_real.yaml"


def test_pearson_by_hand():
    # Deviations (-1, 0, 1) and (-1, 1, 0): 1 / 2.
    assert pearson_correlation([1, 2, 3], [1, 3, 2]) == pytest.approx(0.5)
    assert pearson_correlation([0.2, 0.4, 0.9], [0.1, 0.2, 0.45]) == pytest.approx(1.0)
    assert pearson_correlation([1, 2], [5, 3]) == pytest.approx(-1.0)


def test_pearson_agrees_with_numpy():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 30))
    assert pearson_correlation(a, b) == pytest.approx(np.corrcoef(a, b)[0, 1])


def test_pearson_is_undefined_without_change():
    assert pearson_correlation([0.5], [0.5]) is None
    assert pearson_correlation([0.5, 0.5], [0.1, 0.9]) is None


def test_rank_violation_by_hand():
    # Real 0.2 < 0.5 < 0.9; the simulation swaps the first two: each of them is violated by 0.3,
    # the third by nothing.
    real = [0.2, 0.5, 0.9]
    assert mean_maximum_rank_violation(real, [0.5, 0.2, 0.9]) == pytest.approx(0.6 / 3)
    # All turned round: 0.7, 0.4 (with the third) and 0.7.
    assert mean_maximum_rank_violation(real, [0.9, 0.5, 0.2]) == pytest.approx(1.8 / 3)
    assert mean_maximum_rank_violation(real, [0.01, 0.02, 0.03]) == 0.0


def test_rank_violation_of_ties():
    """Equal in the simulation, but really 0.4 apart: the lower one's order is not foretold."""
    assert mean_maximum_rank_violation([0.3, 0.7], [0.5, 0.5]) == pytest.approx(0.4 / 2)
    assert mean_maximum_rank_violation([0.3, 0.3], [0.5, 0.5]) == 0.0


def test_lists_that_do_not_pair_up_are_refused():
    for measure in (pearson_correlation, mean_maximum_rank_violation):
        with pytest.raises(ValueError, match="one length"):
            measure([0.1, 0.2], [0.1])


def round_of(policy: str, *reasons: str) -> RoundRecord:
    attempts = tuple(AttemptRecord(r == "success", r, 0.01, 5.0) for r in reasons)
    cleared = sum(attempt.success for attempt in attempts)
    ended = "no_plan" if reasons[-1] == "no_plan" else "cleared"
    return RoundRecord(policy, "pile", "box", 0, 5, cleared, attempts, ended)


def test_a_score_counts_executed_grasps():
    rounds = [
        round_of("a", "success", "missed", "success"),
        round_of("a", "success", "no_plan"),
        round_of("b", "missed"),
    ]
    assert score_of(rounds, "a") == Score(3, 4)


@pytest.fixture
def lines():
    """Three policies in two worlds, a network on photographs, and one that is not trained."""

    def line(name, training, **scores):
        return TransferLine(TransferPolicy(name, training, name, None), scores)

    missing = TransferPolicy("net", "physics", "runs/none.pt", "python train.py --weights x")
    return [
        line("blind", "-", pybullet=Score(20, 100), mujoco=Score(10, 100)),
        line("good", "-", pybullet=Score(80, 100), mujoco=Score(90, 100)),
        line("net", "vision", pybullet=Score(90, 100), mujoco=Score(85, 100), cornell=Score(4, 8)),
        TransferLine(missing, {}, trained=False),
    ]


def test_worlds_agree_as_far_as_they_do(lines):
    (one,) = agreements(lines)
    assert (one.real, one.simulation, one.policies) == ("mujoco", "pybullet", 3)
    assert one.pearson_r == pytest.approx(np.corrcoef([20, 80, 90], [10, 90, 85])[0, 1])
    # "good" and "net" change places; in MuJoCo they differ by 0.05.
    assert one.mmrv == pytest.approx((0 + 0.05 + 0.05) / 3)


def test_the_table_says_what_is_missing(lines):
    worlds = ("pybullet", "mujoco", "cornell")
    table = format_transfer(lines, worlds).splitlines()
    assert "80 % [71, 87] 80/100" in table[3]
    assert "50 % [22, 78] 4/8" in table[4] and "not trained" in table[5]
    notes = transfer_notes(lines, worlds)
    assert any("python train.py --weights x" in note for note in notes)
    assert not any("transfer.cornell" in note for note in notes)
    assert any("transfer.cornell" in note for note in transfer_notes(lines[:2], worlds))


def test_results_and_picture(lines):
    content = json.loads(json.dumps(transfer_content(lines), allow_nan=False))
    assert content["rows"][1]["worlds"]["mujoco"]["success_rate"] == 0.9
    assert content["rows"][3]["trained"] is False
    assert content["agreement"][0]["policies"] == 3
    assert draw_transfer(lines, ("pybullet", "mujoco", "cornell"))[:4] == b"\x89PNG"


def test_the_shipped_report_is_a_config():
    transfer = load_config(REPORT).transfer
    oracle = "oracle (sees the true scene)"
    policies = {who.policy for who in transfer.policies}
    assert policies == {"random", "heuristic", oracle, "GraspNet (shipped)", "GraspNet"}
    rows = [who for who in transfer.policies if who.policy == "GraspNet"]
    parts = ["none", "physics", "vision", "both", "both for longer", "both + adaptation"]
    assert [who.training for who in rows] == parts
    for who in rows:  # the commands can be read, and are of one budget
        words = shlex.split(who.train_with)
        assert words[:2] == ["python", "train_graspnet.py"] and words[-1] == who.planner
        config = load_config(REPOSITORY / words[3], [word for word in words[4:-2] if "=" in word])
        assert (config.data.frames, config.train.backbone) == (800, "tutorial_skip")
        physics = who.training == "physics" or who.training.startswith("both")
        assert config.data.randomise_physics == physics
        assert config.data.randomise == (who.training not in ("none", "physics"))
        assert (config.adaptation.target is not None) == ("adaptation" in who.training)


def test_outside_is_outside():
    """No range of physics meets that of training in more than a point."""
    training, outside = (load_config(path).randomization for path in (None, REPORT))
    for name in type(training.physics).model_fields:
        inner, outer = getattr(training.physics, name), getattr(outside.physics, name)
        assert outer.low >= inner.high or outer.high <= inner.low, name
        assert outer.operation == inner.operation, name


@pytest.mark.slow
def test_the_command_from_end_to_end(tmp_path):
    command = [
        sys.executable, REPOSITORY / "evaluate.py", "--config", REPORT, "evaluate.rounds=1",
        "evaluate.workers=1", "evaluate.scenarios=isolated", "evaluate.object_sets=box",
        "transfer.worlds=pybullet,outside,cornell", "sim.renderer=tiny",
        "--results", "copy.json",
    ]  # fmt: skip
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert "PyBullet outside the ranges" in done.stdout and "not trained" in done.stdout
    assert "transfer.cornell" in done.stdout
    rows = json.loads((tmp_path / "copy.json").read_text())["rows"]
    heuristic = next(row for row in rows if row["policy"] == "heuristic")
    assert set(heuristic["worlds"]) == {"pybullet", "outside"}
    (run,) = (tmp_path / "runs" / "evaluate").iterdir()
    assert (run / "transfer.png").exists() and (run / "outside" / "rounds.jsonl").exists()
