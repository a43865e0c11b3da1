"""The transfer report: its figures by hand, its table, and the command from end to end."""

import json
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import evaluate
from utils.config import Config, TransferPolicy, load_config
from utils.errors import UserError
from utils.result_records import AttemptRecord, RoundRecord
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
        return TransferLine(TransferPolicy(name, training, name, None, None), "pile", scores)

    missing = TransferPolicy("net", "physics", "runs/none.pt", None, "python train.py --weights x")
    return [
        line("blind", "-", pybullet=Score(20, 100), mujoco=Score(10, 100)),
        line("good", "-", pybullet=Score(80, 100), mujoco=Score(90, 100)),
        line("net", "vision", pybullet=Score(90, 100), mujoco=Score(85, 100), cornell=Score(4, 8)),
        TransferLine(missing, "pile", {}, trained=False),
    ]


def test_worlds_agree_as_far_as_they_do(lines):
    (one,) = agreements(lines)
    assert (one.real, one.simulation, one.policies) == ("mujoco", "pybullet", 3)
    assert one.pearson_r == pytest.approx(np.corrcoef([20, 80, 90], [10, 90, 85])[0, 1])
    # "good" and "net" change places; in MuJoCo they differ by 0.05.
    assert one.mmrv == pytest.approx((0 + 0.05 + 0.05) / 3)


def test_policies_are_compared_on_the_same_scenes_alone(lines):
    """One more policy, on other scenes, has nobody to be compared with; two more have."""

    def boxes(name, *rates):
        scores = {world: Score(n, 100) for world, n in zip(("pybullet", "mujoco"), rates)}
        who = TransferPolicy(name, "-", name, ("isolated", "box"), None)
        return TransferLine(who, "isolated of box", scores)

    with_one = [*lines, boxes("a", 100, 0)]
    assert agreements(with_one) == agreements(lines)
    piles, alone = agreements([*with_one, boxes("b", 50, 50)])
    assert piles == agreements(lines)[0]
    assert (alone.scenes, alone.policies) == ("isolated of box", 2)
    assert alone.pearson_r == pytest.approx(-1.0)
    assert alone.mmrv == pytest.approx(0.5)  # the two, 0.5 apart, change places


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
    small = [who for who in transfer.policies if who.policy == "GraspNet, 800 images"]
    parts = ["none", "physics", "vision", "both", "both for longer", "both + adaptation"]
    assert [who.training for who in small] == parts
    for who in small:  # the commands are of one budget
        assert config_of(who).data.frames == 800
    learned = [who for who in transfer.policies if who.policy == "PPO"]
    assert [who.training for who in learned] == ["none", "physics", "vision", "both"]
    assert {
        (config_of(who).rl.total_steps, config_of(who).rl.target_success) for who in learned
    } == {(102400, 0.98)}
    assert {who.scenes for who in learned} == {("isolated", "box")}
    for who in learned:
        varied = config_of(who).randomization.parts if "Randomized" in who.train_with else ()
        assert ("physics" in varied) == (who.training in ("physics", "both"))
        assert ("vision" in varied) == (who.training in ("vision", "both"))


def test_the_commands_of_the_report_do_as_its_rows_say():
    rows = [who for who in load_config(REPORT).transfer.policies if who.policy[:8] == "GraspNet"]
    for who in rows:
        config, both = config_of(who), who.training.startswith("both")
        assert config.train.backbone == "tutorial_skip"
        assert config.data.randomise_physics == (who.training == "physics" or both)
        assert config.data.randomise == (who.training.startswith("vision") or both)
        assert (config.train.depth_noise_share > 0) == config.data.randomise
        assert (config.adaptation.target is not None) == ("adaptation" in who.training)


def config_of(who: TransferPolicy) -> Config:
    """That of the command which trains a row's policy; it leaves what the row's planner reads."""
    python, script, *words = shlex.split(who.train_with)
    assert (python, script) in {("python", "train_graspnet.py"), ("python", "train_rl.py")}
    assert words[-2:] == ["--weights", who.planner.removeprefix("ppo:")]
    file = REPOSITORY / words[1] if words[0] == "--config" else None
    return load_config(file, [word for word in words[:-2] if "=" in word])


def test_rows_on_the_same_scenes_are_one_contest():
    """However the scenes are told; and a folder goes by its path, as another may have its name."""
    rows = [
        ["a", "-", "heuristic", None, None],
        ["b", "-", "random", ["pile", "box"], None],
        ["c", "-", "random", ["isolated", "box"], None],
        ["d", "-", "random", None, "never trained: a.pt"],
    ]
    config = load_config(
        None,
        [f"transfer.policies={json.dumps(rows)}", "evaluate.scenarios=pile",
         "evaluate.object_sets=box", "transfer.columns=[outside,mujoco,cornell]"],
    )  # fmt: skip
    played = evaluate.contests(config)
    told = [(one.world, str(one.scenes), [who.policy for who in one.rows]) for one in played]
    assert told == [
        ("outside", "pile of box", ["a", "b", "d"]), ("mujoco", "pile of box", ["a", "b", "d"]),
        ("outside", "isolated of box", ["c"]), ("mujoco", "isolated of box", ["c"]),
    ]  # fmt: skip
    one, two = (evaluate.Scenes(("isolated",), (name,)) for name in ("a/meshes", "b/meshes"))
    assert evaluate.folder_name(one) == "isolated_of_a_meshes" != evaluate.folder_name(two)


def test_a_row_that_cannot_play_its_scenes_is_named():
    with pytest.raises(UserError, match="the row PPO, none is scored on pile of box; give it"):
        evaluate.main(
            ["transfer.policies=[[PPO, none, ppo, null, null]]", "evaluate.scenarios=pile",
             "evaluate.object_sets=box", "transfer.columns=pybullet"]
        )  # fmt: skip


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
        "evaluate.workers=1", "evaluate.scenarios=isolated", "evaluate.object_sets=primitives",
        "transfer.columns=pybullet,outside,cornell", "sim.renderer=tiny",
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
    assert (run / "transfer.png").exists()
    for scenes in ("isolated_of_primitives", "isolated_of_box"):
        assert (run / "outside" / scenes / "rounds.jsonl").exists()
    boxes = [row for row in rows if row["scenes"] == "isolated of box"]
    assert [row["policy"] for row in boxes] == [
        "random",
        "heuristic",
        "PPO (shipped)",
        *["PPO"] * 4,
    ]
