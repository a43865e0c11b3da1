"""The rows of the transfer report, their scenes, and the command from end to end."""

import json
import shlex
from types import SimpleNamespace

import numpy as np
import pytest

import evaluate
from envs import transfer_plan
from envs.registries import check_names
from envs.simulators import SIMULATORS
from envs.transfer_plan import (
    COLUMNS,
    PhotographColumn,
    Scenes,
    SimulatedColumn,
    columns_of,
    evaluations_of,
    score_photographs,
)
from models.rectangle_examples import JudgedRectangle
from utils.config import Config, load_config
from utils.config_schema import TransferPolicy
from utils.errors import UserError
from utils.evaluation import Outcome, depth_noises_of
from utils.rectangles import GraspRectangle
from utils.runs import REPOSITORY
from utils.statistics import clustered_interval
from utils.transfer import Score, pairs_of

REPORT = REPOSITORY / "configs" / "sim_to_real.yaml"


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


def test_rows_on_the_same_scenes_are_one_evaluation():
    """Whether the scenes are the row's own or not; folders of objects go by their whole path."""
    rows = [
        ["a", "-", "heuristic", None, None],
        ["b", "-", "random", ["pile", "box"], None],
        ["c", "-", "random", ["isolated", "box"], None],
        ["d", "-", "random", None, "never trained: a.pt"],
    ]
    config = load_config(
        None,
        [f"transfer.policies={json.dumps(rows)}", "evaluate.scenarios=pile",
         "evaluate.object_sets=box", "transfer.columns=[outside,mujoco,cornell]",
         "evaluate.depth_noises=null"],
    )  # fmt: skip
    played = evaluations_of(config)
    found = [(one.column, str(one.scenes), [row.policy for row in one.rows]) for one in played]
    assert found == [
        ("outside", "pile of box", ["a", "b", "d"]), ("mujoco", "pile of box", ["a", "b", "d"]),
        ("outside", "isolated of box", ["c"]), ("mujoco", "isolated of box", ["c"]),
    ]  # fmt: skip
    one, two = (Scenes(("isolated",), (name,)) for name in ("a/meshes", "b/meshes"))
    assert one.folder == "isolated_of_a_meshes" != two.folder


def test_the_columns_of_the_report_are_one_registry():
    """The simulated ones name simulators, and what predicts a column is a column, too."""
    simulated = [one for one in COLUMNS.values() if isinstance(one, SimulatedColumn)]
    assert {one.simulator for one in simulated} <= set(SIMULATORS)
    assert {one.simulation for one in COLUMNS.values()} <= {None, *COLUMNS}
    assert list(columns_of(load_config())) == list(COLUMNS)


def test_each_simulated_column_says_what_is_played():
    config = load_config(REPORT, ["transfer.columns=[pybullet,mujoco,outside]"])
    played = {one.column: one.config for one in evaluations_of(config)}
    found = {name: (one.simulator, one.evaluate.randomise) for name, one in played.items()}
    assert found == {
        "pybullet": ("pybullet", False),
        "mujoco": ("mujoco", False),
        "outside": ("pybullet", True),
    }


def test_an_unknown_column_is_answered_by_the_known_ones():
    config = load_config(REPORT, ["transfer.columns=[pybullet,mujcoo]"])
    with pytest.raises(UserError, match="transfer.columns: got 'mujcoo', .* did you mean mujoco?"):
        evaluations_of(config)


def test_photographs_are_judged_for_the_default_hand_alone():
    config = load_config(REPORT, ["transfer.columns=[pybullet,cornell]", "gripper.max_opening=0.1"])
    with pytest.raises(UserError, match="transfer.columns: cornell judges .* leave gripper"):
        columns_of(config)
    columns_of(load_config(REPORT, ["transfer.columns=[pybullet]", "gripper.max_opening=0.1"]))


def test_a_new_column_is_an_entry_of_the_registry(monkeypatch):
    noisy = SimulatedColumn("MuJoCo again", simulation="mujoco", simulator="mujoco")
    monkeypatch.setitem(COLUMNS, "again", noisy)
    config = load_config(REPORT, ["transfer.columns=[mujoco,again]"])
    check_names(config)
    assert {one.config.simulator for one in evaluations_of(config)} == {"mujoco"}
    assert pairs_of(columns_of(config)) == [("again", "mujoco")]


def test_a_row_that_cannot_play_its_scenes_is_named():
    with pytest.raises(UserError, match="the row PPO, none is scored on pile of box; give it"):
        evaluate.main(
            ["transfer.policies=[[PPO, none, ppo, null, null]]", "evaluate.scenarios=pile",
             "evaluate.object_sets=box", "transfer.columns=pybullet",
             "evaluate.depth_noises=null"]
        )  # fmt: skip


def test_the_report_has_one_depth_noise():
    with pytest.raises(UserError, match="columns with one depth noise; set evaluate.depth_noises"):
        evaluations_of(load_config(REPORT, ["evaluate.depth_noises=realsense,none"]))
    row = 'transfer.policies=[[a, "-", heuristic, null, null]]'
    config = load_config(REPORT, ["camera.depth_noise=kinect", row, "transfer.columns=mujoco"])
    (noisy,) = evaluations_of(config)
    assert depth_noises_of(noisy.config) == ("kinect",)


def test_rows_that_cannot_see_photographs_have_no_score_there(tmp_path):
    config = load_config()
    for planner, scenes in (("oracle", None), ("ppo", None), ("none.pt", None),
                            ("heuristic", ("pile", "box"))):  # fmt: skip
        row = TransferPolicy("a", "-", planner, scenes, None)
        assert score_photographs(row, [], config, tmp_path) == {}


def test_pictures_and_folders_have_names_of_their_own_on_every_system(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(transfer_plan, "draw_rectangles", lambda path, *_: drawn.append(path.name))
    column = PhotographColumn("A", judge=lambda *_: [judgement(True)])
    monkeypatch.setitem(COLUMNS, "a", column)
    config = load_config(None, ["transfer.columns=a"])
    for planner in ("my_module:plan", "your_module:plan", "heuristic"):
        row = TransferPolicy("a", "-", planner, None, None)
        score_photographs(row, [SimpleNamespace(object_id="cup")], config, tmp_path)
    assert drawn == ["my_module_plan-a.png", "your_module_plan-a.png", "heuristic-a.png"]
    scenes = Scenes(("pile", "packed"), ("my_module:objects", "path/to/meshes"))
    assert scenes.folder == "pile-packed_of_my_module_objects-path_to_meshes"


def test_photographs_of_one_object_are_not_taken_as_independent(tmp_path, monkeypatch):
    """The cup is right in all four photographs, the pan in none, of which one shows no grasp."""
    monkeypatch.setattr(transfer_plan, "draw_rectangles", lambda *_: None)
    judged = [judgement(right) for right in (True, False) * 3] + [judgement(True), None]
    monkeypatch.setitem(COLUMNS, "a", PhotographColumn("A", judge=lambda *_: judged))
    samples = [SimpleNamespace(object_id=name) for name in ("cup", "pan") * 4]
    row = TransferPolicy("a", "-", "heuristic", None, None)
    score = score_photographs(row, samples, load_config(None, ["transfer.columns=a"]), tmp_path)
    assert score == {"a": Score(4, 8, ((4, 4), (0, 4)))}
    # Two objects that are right or wrong as a whole tell no more than two photographs would.
    assert score["a"].ci95 == clustered_interval([1, 0])


def judgement(right):
    return JudgedRectangle("", "", GraspRectangle(np.zeros(2), 0.0, 1.0, 1.0), 1.0, right, 1.0, 0.0)


@pytest.mark.parametrize(
    "override",
    ["simulator=mujoco", "evaluate.randomise=true", "transfer.cornell=c"],
)
def test_a_key_that_the_report_would_ignore_is_refused(override):
    overrides = ["transfer.columns=pybullet", override]
    with pytest.raises(UserError, match=f"{override.partition('=')[0]} would be ignored: "):
        evaluations_of(load_config(REPORT, overrides), overrides)
    evaluations_of(load_config(REPORT), ["transfer.cornell=c"])


@pytest.mark.parametrize("ended", [{"interrupted": True}, {"error": UserError("no room")}, {}])
def test_photographs_are_scored_once_all_rounds_are_played(ended, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    scored = []
    monkeypatch.setattr(evaluate, "photographs", lambda folder: ["a photograph"])
    monkeypatch.setattr(evaluate, "play", lambda *_: Outcome([], **ended))
    monkeypatch.setattr(evaluate, "check_everything", lambda *_: None)
    monkeypatch.setattr(evaluate, "score_photographs", lambda row, *_: scored.append(row) or {})
    arguments = [
        "transfer.policies=[[a, b, heuristic, null, null]]", "evaluate.depth_noises=null",
        "transfer.columns=pybullet,cornell", "transfer.cornell=some/cornell",
    ]  # fmt: skip
    if "error" in ended:
        with pytest.raises(UserError, match="no room"):
            evaluate.main(arguments)
    else:
        assert evaluate.main(arguments) == (130 if ended else 0)
    assert len(scored) == (0 if ended else 1)


def test_the_report_has_no_paired_differences(tmp_path):
    with pytest.raises(UserError, match="the transfer report has no paired differences"):
        evaluate.main(["--config", str(REPORT), "--csv", str(tmp_path / "pairs.csv")])


def test_outside_is_outside():
    """No range of physics meets that of training in more than a point."""
    training, outside = (load_config(path).randomization for path in (None, REPORT))
    for name in type(training.physics).model_fields:
        inner, outer = getattr(training.physics, name), getattr(outside.physics, name)
        assert outer.low >= inner.high or outer.high <= inner.low, name
        assert outer.operation == inner.operation, name


@pytest.mark.slow
def test_the_command_from_end_to_end(tmp_path, monkeypatch, capsys, played_here):
    monkeypatch.chdir(tmp_path)
    arguments = [
        "--config", str(REPORT), "evaluate.rounds=1", "evaluate.workers=1",
        "evaluate.scenarios=isolated", "evaluate.object_sets=primitives",
        "transfer.columns=pybullet,outside,cornell", "sim.renderer=tiny",
        "--results", "copy.json",
    ]  # fmt: skip
    assert evaluate.main(arguments) == 0
    printed = capsys.readouterr().out
    assert "PyBullet outside the ranges" in printed and "not trained" in printed
    assert "transfer.cornell" in printed
    rows = json.loads((tmp_path / "copy.json").read_text())["rows"]
    heuristic = next(row for row in rows if row["policy"] == "heuristic")
    assert set(heuristic["columns"]) == {"pybullet", "outside"}
    (run,) = (tmp_path / "runs" / "evaluate").iterdir()
    assert (run / "transfer.png").exists()
    for scenes in ("isolated_of_primitives", "isolated_of_box"):
        assert (run / "outside" / scenes / "rounds.jsonl").exists()
    boxes = [row for row in rows if row["scenes"] == "isolated of box"]
    assert [row["policy"] for row in boxes] == [
        "random",
        "heuristic",
        "PPO (shipped)",
        *["PPO"] * 3,
        "PPO of other settings",
        "PPO",
    ]
