"""The scoreboard from end to end, small."""

import json
import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import trimesh

import evaluate
import utils.runs
from envs.cell_scenes import make_scene
from envs.objects import load_objects
from envs.pybullet_files import data_folder
from envs.rounds import run_round
from envs.simulators import make_cell
from models.planners import make_planner
from tests.helpers.cluster import local_cluster
from tests.helpers.records import ROUNDS
from tests.helpers.simulators import needs_pybullet
from tests.helpers.systems import needs_proc
from utils.config import DEFAULTS
from utils.errors import UserError
from utils.evaluation import Outcome
from utils.geometry import GripperGeometry, Workspace
from utils.result_records import differing_rounds, read_rounds, write_sample
from utils.runs import REPOSITORY, code_of, this_python
from utils.runs import run_script as end_like_a_script

SMALL = ["evaluate.rounds=2", "evaluate.workers=2", "evaluate.videos=0", "evaluate.object_sets=box",
         "evaluate.depth_noises=none"]  # fmt: skip


def run_script(arguments, folder, **options):
    """evaluate.py as a user runs it; its run folder lies below `folder`."""
    return subprocess.run(
        [sys.executable, REPOSITORY / "evaluate.py", *arguments],
        cwd=folder, capture_output=True, text=True, timeout=300, **options,
    )  # fmt: skip


def refusal(arguments, folder, monkeypatch, captured) -> str:
    """The one line on stderr with which evaluate.py, run here and not in a process of its own,
    refuses its input. captured: capsys, or capfd for what other processes write, too."""
    return refused(arguments, folder, monkeypatch, captured)[0]


def refused(arguments, folder, monkeypatch, captured) -> tuple[str, str]:
    """That line, and what it has printed."""
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "argv", ["evaluate.py", *map(str, arguments)])
    monkeypatch.setattr(sys, "path", list(sys.path))  # a script adds the current folder
    with pytest.raises(SystemExit) as end:
        end_like_a_script(evaluate.main)
    assert end.value.code == 2
    printed, errors = captured.readouterr()
    assert "Traceback" not in errors
    (line,) = [x for x in errors.splitlines() if x.startswith("error:")]
    return line, printed


def only_run(folder: Path) -> Path:
    (run,) = (folder / "runs" / "evaluate").iterdir()
    return run


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """One finished evaluation of the heuristic and the random planner on the cube, by worker
    processes: its tests are slow ones."""
    folder = tmp_path_factory.mktemp("evaluation")
    done = run_script(
        [*SMALL, "evaluate.policies=heuristic,random", "evaluate.scenarios=isolated",
         "evaluate.videos=1", "--results", "copy.json"],
        folder,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return folder, done


@pytest.mark.slow
def test_results_file_has_the_agreed_format(finished):
    folder, _ = finished
    results = json.loads((only_run(folder) / "results.json").read_text())
    assert results["schema"] == 1
    assert {"commit", "config", "device", "rows"} <= results.keys()
    assert [row["policy"] for row in results["rows"]] == ["heuristic", "random"]
    agreed = {
        "policy", "scenario", "objects", "seed", "rounds", "attempts", "successes",
        "objects_total", "objects_cleared", "success_rate", "success_ci95", "cleared_rate",
        "cleared_ci95", "plan_ms_median", "sim_seconds_per_pick", "picks_per_hour",
    }  # fmt: skip
    heuristic = results["rows"][0]
    assert agreed <= heuristic.keys()
    assert (heuristic["rounds"], heuristic["objects_total"]) == (2, 2)
    assert heuristic["success_rate"] == 1.0, "the heuristic lifts a single cube"
    assert 300 < heuristic["picks_per_hour"] < 1200
    assert json.loads((folder / "copy.json").read_text()) == results


@pytest.mark.slow
def test_table_csv_report_and_film_are_written(finished):
    folder, done = finished
    run = only_run(folder)
    assert "heuristic" in done.stdout and "isolated" in done.stdout
    assert (run / "results.csv").read_text().startswith("policy,scenario,objects")
    page = (run / "report.html").read_text()
    assert "data:video/mp4" in page and "data:image/png" in page
    assert list((run / "films").glob("*.mp4"))


@pytest.mark.slow
def test_policies_see_the_same_scenes(finished):
    folder, _ = finished
    rounds = read_rounds(only_run(folder) / "rounds.jsonl")
    seeds = {p: {r.seed for r in rounds if r.policy == p} for p in ("heuristic", "random")}
    assert seeds["heuristic"] == seeds["random"] == {0, 1}


@pytest.mark.slow
def test_a_run_is_compared_with_another(finished, tmp_path, monkeypatch, capsys):
    """Both played by the same code: no difference but that of the policies."""
    folder, _ = finished
    other = tmp_path / "other"
    other.mkdir()
    for file in ("config.yaml", "rounds.jsonl"):
        shutil.copy(only_run(folder) / file, other)
    monkeypatch.chdir(tmp_path)
    files = ["--csv", "pairs.csv", "--latex", "pairs.tex", "--results", "pairs.json"]
    assert evaluate.main(["--compare", str(only_run(folder)), str(other), *files]) == 0
    _, _, *pairs, legend = capsys.readouterr().out.splitlines()
    assert len(pairs) == 2 and all("+0.0 (under 20 rounds)  2" in line for line in pairs)
    assert legend.startswith("first - second on the same scenes")
    pairs = json.loads((tmp_path / "pairs.json").read_text())["comparisons"]
    assert [pair["first"][:9] for pair in pairs] == ["heuristic", "random (2"]
    assert pairs[0]["cleared"] == {"value": 0.0, "low": 0.0, "high": 0.0, "rounds": 2}
    assert len((tmp_path / "pairs.csv").read_text().splitlines()) == 3
    assert "toprule" in (tmp_path / "pairs.tex").read_text()
    assert not (tmp_path / "runs").exists(), "nothing is played"


@pytest.mark.slow
def test_published_rounds_are_played_again(finished, tmp_path, monkeypatch, capsys, played_here):
    """A round of another processor's last digits, and one whose published outcome was changed."""
    folder, _ = finished
    write_sample(only_run(folder), tmp_path / "sample.jsonl", count=1)
    origin, heuristic, random = (tmp_path / "sample.jsonl").read_text().splitlines()
    changed = json.loads(heuristic)
    changed["attempts"][0]["sim_seconds"] += 0.1
    changed["objects_cleared"] = 1 - changed["objects_cleared"]
    jittered = json.loads(random)
    jittered["attempts"][0]["sim_seconds"] += 1e-9
    origin = json.loads(origin)
    origin["versions"]["numpy"] = "1.0"
    origin["versions"]["processor"] = "another one"
    lines = map(json.dumps, (origin, changed, jittered))
    (tmp_path / "sample.jsonl").write_text("\n".join(lines))
    monkeypatch.chdir(tmp_path)
    assert evaluate.main(["--replay", "sample.jsonl", "evaluate.workers=1"]) == 1
    printed = capsys.readouterr().out
    assert "the rounds were played with 1.0" in printed and "python is" not in printed
    assert "here, the rounds were played with another one" in printed
    assert "ends otherwise: heuristic, isolated, scene 0" in printed
    assert "0 of 2 rounds are the same, 1 others end alike" in printed
    assert f"git checkout {origin['commit']}" in printed


MODULE = """
from utils.transforms import Grasp

def plan(frame):
    return []

class Careless:
    def __init__(self, gripper, workspace, seed):
        self.opening, self.centre = gripper.max_opening, workspace.centre

    def __call__(self, frame):
        raise KeyError("no grasp")
"""


def test_planners_of_another_module_are_scored(tmp_path, monkeypatch, capsys):
    (tmp_path / "my_planners.py").write_text(MODULE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    policies = "evaluate.policies=my_planners:plan,my_planners:Careless"
    settings = ["evaluate.scenarios=isolated", "evaluate.rounds=1", "evaluate.workers=1"]
    assert evaluate.main([*SMALL[2:], policies, *settings]) == 0, "the run goes on"
    assert "my_planners:Careless raised KeyError: 'no grasp'" in capsys.readouterr().out
    rows = json.loads((only_run(tmp_path) / "results.json").read_text())["rows"]
    assert [row["policy"] for row in rows] == ["my_planners:plan", "my_planners:Careless"]
    assert [row["failures"]["no_plan"] for row in rows] == [1, 0]
    assert [row["failures"]["planner_error"] for row in rows] == [0, 1]
    assert [row["attempts"] for row in rows] == [0, 0]


@pytest.mark.slow
def test_resume_runs_only_what_is_missing(finished, monkeypatch, played_here):
    """Here, with the outcome that the worker processes of the first run had."""
    folder, _ = finished
    run = only_run(folder)
    monkeypatch.chdir(folder)
    journal = run / "rounds.jsonl"
    first, lines = read_rounds(journal), journal.read_text().splitlines(keepends=True)
    journal.write_text("".join(lines[:3]))
    assert evaluate.main(["--resume", str(run)]) == 0
    again = journal.read_text().splitlines(keepends=True)
    assert len(again) == len(lines) == 4 and again[:3] == lines[:3]
    assert differing_rounds(first, read_rounds(journal)) == []


@pytest.mark.slow
def test_each_depth_noise_is_the_same_as_when_it_is_scored_alone(
    tmp_path, monkeypatch, capsys, played_here
):
    """Noisy rows first; the noisy round is to the last bit that of a camera with this noise, and
    not the clean one; resumed after it, and played again."""
    settings = ["evaluate.rounds=1", "evaluate.workers=1", "evaluate.videos=0",
                "evaluate.object_sets=box", "evaluate.scenarios=isolated",
                "evaluate.policies=heuristic", "sim.renderer=tiny"]  # fmt: skip

    def play(name, *overrides):
        folder = tmp_path / name
        folder.mkdir()
        monkeypatch.chdir(folder)
        assert evaluate.main([*settings, *overrides]) == 0
        return only_run(folder)

    both = play("both")
    rows = json.loads((both / "results.json").read_text())["rows"]
    assert [row["depth_noise"] for row in rows] == ["realsense", "none"]
    noisy, clean = rounds = read_rounds(both / "rounds.jsonl")
    assert noisy.attempts[0].grasp != clean.attempts[0].grasp
    alone = read_rounds(play("alone", "camera.depth_noise=realsense") / "rounds.jsonl")
    assert len(alone) == 1 and differing_rounds([noisy], alone) == []
    journal = (both / "rounds.jsonl").read_text().splitlines(keepends=True)
    (both / "rounds.jsonl").write_text(journal[0])
    assert evaluate.main(["--resume", str(both)]) == 0
    assert differing_rounds(rounds, read_rounds(both / "rounds.jsonl")) == []
    write_sample(both, tmp_path / "sample.jsonl")
    capsys.readouterr()
    assert evaluate.main(["--replay", str(tmp_path / "sample.jsonl")]) == 0
    assert "2 of 2 rounds are the same" in capsys.readouterr().out


@pytest.fixture(scope="module")
def undisturbed(finished, tmp_path_factory):
    """The run of `finished`, its journal continued to four rounds with nothing killed."""
    run = tmp_path_factory.mktemp("undisturbed") / "run"
    shutil.copytree(only_run(finished[0]), run)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(run.parent)
        assert evaluate.main(["--resume", str(run), "evaluate.rounds=4"]) == 0
    return run


def test_a_finished_run_is_of_the_code_that_played_it(finished, tmp_path, monkeypatch):
    run = tmp_path / "run"
    shutil.copytree(only_run(finished[0]), run)
    before, now = code_of(run), utils.runs.environment()
    monkeypatch.setattr(utils.runs, "environment", lambda: now | {"commit": "a" * 40})
    assert evaluate.main(["--resume", str(run)]) == 0
    assert code_of(run) == before


@pytest.fixture(params=["local", "cluster"])
def engine(request):
    """Overrides that choose the engine, and a function that lists its worker processes."""
    if request.param == "local":
        yield [], lambda: [process.pid for process in multiprocessing.active_children()]
        return
    with local_cluster(2) as cluster:
        override = f"compute.scheduler={cluster.scheduler_address}"
        yield [override], lambda: [worker.pid for worker in cluster.workers.values()]


@pytest.mark.slow
def test_rounds_are_the_same_when_a_worker_is_killed(undisturbed, engine, tmp_path, monkeypatch):
    """With kill -9 in the middle of a scene."""
    overrides, workers = engine
    monkeypatch.chdir(tmp_path)

    def kill_one():
        deadline = time.monotonic() + 300
        while time.monotonic() < deadline:
            journals = list(tmp_path.glob("runs/evaluate/*/rounds.jsonl"))
            if journals and workers():
                killed.append(min(workers()))
                os.kill(killed[0], signal.SIGKILL)
                return
            time.sleep(0.02)

    killed: list[int] = []
    killer = threading.Thread(target=kill_one)
    killer.start()
    policies = ["evaluate.policies=heuristic,random", "evaluate.scenarios=isolated"]
    assert evaluate.main([*SMALL, *policies, "evaluate.rounds=4", *overrides]) == 0
    killer.join()
    assert len(killed) == 1
    runs = [undisturbed, only_run(tmp_path)]
    expected, got = (read_rounds(run / "rounds.jsonl") for run in runs)
    assert len(got) == len(expected) == 8 and differing_rounds(expected, got) == []
    rows = [json.loads((run / "results.json").read_text())["rows"] for run in runs]
    for row in [*rows[0], *rows[1]]:
        del row["plan_ms_median"]  # time by the clock
    assert rows[0] == rows[1]


@pytest.mark.slow
def test_ctrl_c_writes_what_was_measured(tmp_path):
    process = subprocess.Popen(
        [sys.executable, REPOSITORY / "evaluate.py", *SMALL, "evaluate.rounds=400",
         "evaluate.policies=heuristic", "evaluate.scenarios=isolated"],
        cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        start_new_session=True,
        # A shell's background jobs ignore Ctrl-C, and so would what they start.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    deadline = time.monotonic() + 240
    while True:
        journals = list(tmp_path.glob("runs/evaluate/*/rounds.jsonl"))
        if journals and len(journals[0].read_text().splitlines()) >= 3:
            break
        if process.poll() is not None or time.monotonic() > deadline:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
            errors = process.communicate()[1]
            pytest.fail(f"evaluate.py did not get to three rounds in time, or ended: {errors}")
        time.sleep(0.2)
    os.killpg(process.pid, signal.SIGINT)  # what a terminal does at Ctrl-C
    output, _ = process.communicate(timeout=120)
    assert process.returncode == 130
    results = json.loads((only_run(tmp_path) / "results.json").read_text())
    assert results["complete"] is False and results["rows"][0]["rounds"] >= 3
    assert "interrupted" in output and "--resume" in output


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["evaluate.policies=heuristik"], "random, sb3:FILE.zip; did you mean heuristic?"),
        (["evaluate.policies=no_such_module:plan"], "there is no module 'no_such_module'"),
        (["evaluate.policies=sb3:none.zip", "evaluate.scenarios=isolated"], "none.zip"),
        (["--compare", "here", "there"], "--compare here: not the folder of an evaluation"),
        (["--compare", "a", "b", "seed=1"], "--compare: KEY=VALUE would have no effect with it"),
        (["--compare", "a", "b", "--replay", "c"], "--compare: --replay would have no effect"),
        (
            ["--replay", "a", "--results", "b", "--csv", "c", "--latex", "d"],
            "--replay: --results, --csv, --latex would have no effect with it; omit them",
        ),
        (
            ["--replay", "a", "evaluate.rounds=2", "evaluate.film_format=gif", "seed=2"],
            "--replay: evaluate.rounds, evaluate.film_format would have no effect with it; omit",
        ),
        (["--csv", "a", "--latex", "./a"], "--csv, --latex: both name a; give each its own file"),
        (["--replay", "a", "--config", str(DEFAULTS)], "--replay: --config would have no effect"),
        (
            [
                "transfer.policies=[[a, b, no_such_module:plan, null, null]]",
                "evaluate.depth_noises=null",
            ],
            "transfer.policies: 'no_such_module:plan' cannot be loaded",
        ),
        (["compute.scheduler=nowhere"], "compute.scheduler=nowhere: cannot reach a scheduler"),
        (["camera.depth_noise=kinec"], "camera.depth_noise: got 'kinec'"),
        (["camera.depth_noise=no_module:noise"], "there is no module 'no_module'"),
        (["--replay", "none.jsonl"], "none.jsonl: cannot read this sample"),
        (
            ["--csv", "no/such/folder/x.csv"],
            "x.csv: not a file in an existing folder; choose another",
        ),
        (["evaluate.policies=ppo", "evaluate.scenarios=pile"], "allowed with it are"),
        (
            ["evaluate.policies=ppo:none.pt", "evaluate.scenarios=isolated"],
            "none.pt: cannot read the checkpoint: No such file or directory",
        ),
        (
            ["evaluate.policies=ppo", "evaluate.scenarios=static", "evaluate.controllers=ibvs"],
            "evaluate.controllers: ppo is its own controller; use open_loop with it",
        ),
        (["evaluate.roundz=3"], "unknown key (command line); did you mean evaluate.rounds?"),
        (["evaluate.rounds=many"], "got 'many' (command line); expected a whole number >= 1"),
        (
            ["evaluate.object_sets=no/such/folder"],
            "household, rounded, an existing folder or an import path module:name",
        ),
        (["--config", "missing.yaml"], "missing.yaml: no such config file; check the path"),
        (["--resume", "nowhere"], "--resume nowhere: no such folder; give the folder of a run"),
        (["--results", "no/such/folder/x.json"], "x.json: not a file in an existing folder;"),
        pytest.param(
            ["--results", "/proc/x.json"],
            "--results /proc/x.json: cannot be written",
            marks=needs_proc,
        ),
        (["camera.up=[0,0,1]"], "camera: look_at: `up` is parallel to the line of sight"),
        (["robot.home=[9,0,0,-2,0,1.5,0]"], "is outside the Panda's joint limits, [-2.8973, -1.76"),
        (["workspace.center=[7,7]"], "the workspace must lie within 0.8 m of the robot and at"),
        (["safety.box_lower=[0.15,-0.3,0.02]"], "leaves out [0.42, -0.48, 0.3] m"),
        (["cache_dir=~nobody_here/x"], "this machine knows no such home folder; set cache_dir or"),
        (["evaluate.object_sets=~nobody_here/x"], "object_sets: got '~nobody_here/x', expected"),
        (['evaluate.policies="a\\0b.pt"'], "a name has no character \\0"),
        (["--csv", 300 * "a"], "aaa'; give a shorter name"),
        (["--compare", 300 * "a", "b"], "aaa/config.yaml'; give a shorter name"),
        (
            ["cache_dir=/dev/null/x"],
            "cannot make this folder (Not a directory); set cache_dir or $",
        ),
        (
            ["evaluate.controllers=[open_loop,ibvs]", "closed_loop.controller=pbvs"],
            "closed_loop.controller=pbvs would be ignored: evaluate.controllers is [open_loop,",
        ),
        (["evaluate.controllers=ibvs", "closed_loop.controller=open_loop"], "would be ignored"),
        (["evaluate.depth_noises=kinect,foggy"], "evaluate.depth_noises: got 'foggy'"),
        (
            ["evaluate.depth_noises=realsense,none", "camera.depth_noise=kinect"],
            "camera.depth_noise=kinect would be ignored: evaluate.depth_noises is [realsense, none",
        ),
    ],
)
def test_bad_input_is_one_clear_line(arguments, message, tmp_path, monkeypatch, capsys):
    assert message in refusal(arguments, tmp_path, monkeypatch, capsys)
    assert not (tmp_path / "runs").exists(), "nothing is started before the input is checked"


@pytest.mark.parametrize("option", ["--results", "--csv", "--latex"])
def test_a_copy_that_cannot_be_written_takes_nothing_from_the_run(
    option, tmp_path, monkeypatch, capsys
):
    """Its folder is gone when the rounds have been played."""
    (tmp_path / "away").mkdir()

    def played(*_):
        (tmp_path / "away").rmdir()
        (tmp_path / "away").touch()
        return Outcome(ROUNDS)

    monkeypatch.setattr(evaluate, "play", played)
    monkeypatch.setattr(evaluate, "check_everything", lambda config: None)
    arguments = ["evaluate.policies=heuristic,random", "evaluate.scenarios=pile", *SMALL]
    line = refusal([*arguments, option, "away/copy"], tmp_path, monkeypatch, capsys)
    assert "away/copy: cannot be written" in line
    names = {path.name for path in only_run(tmp_path).iterdir()}
    assert names >= {"results.json", "results.csv", "report.html"}


def test_an_interrupted_evaluation_goes_on_with_the_files_of_its_options(
    tmp_path, monkeypatch, capsys
):
    told = []

    def played(config, run, work, resume):
        told.append(resume)
        return Outcome(ROUNDS[:1], interrupted=True)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(evaluate, "play", played)
    monkeypatch.setattr(evaluate, "check_everything", lambda config: None)
    arguments = ["evaluate.policies=heuristic,random", "evaluate.scenarios=pile", *SMALL]
    files = ["--latex", "pairs.tex", "--csv", "pairs.csv", "--results", "copy.json"]
    assert evaluate.main([*arguments, *files]) == 130
    run = only_run(tmp_path).relative_to(tmp_path)
    written = "--results copy.json --csv pairs.csv --latex pairs.tex"
    command = f"{this_python()} evaluate.py --resume {run} {written}"
    assert told == [command]
    assert f"1 of 4 rounds; go on with {command}\n" in capsys.readouterr().out


def test_the_report_of_a_column_goes_on_with_that_of_the_whole_run(tmp_path, monkeypatch, capsys):
    told = []

    def played(config, folder, work, resume):
        told.append(resume)
        return Outcome([], interrupted=True)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(evaluate, "play", played)
    monkeypatch.setattr(evaluate, "check_everything", lambda *_: None)
    arguments = ["transfer.policies=[[a, b, heuristic, null, null]]", "transfer.columns=pybullet",
                 "evaluate.depth_noises=null", "--results", "copy.json"]  # fmt: skip
    assert evaluate.main(arguments) == 130
    run = only_run(tmp_path).relative_to(tmp_path)
    assert told == [f"{this_python()} evaluate.py --resume {run} --results copy.json"]
    assert f"interrupted; go on with {told[0]}\n" in capsys.readouterr().out


def test_a_folder_without_meshes_is_refused(tmp_path, monkeypatch, capsys):
    (tmp_path / "empty").mkdir()
    line = refusal(["evaluate.object_sets=empty"], tmp_path, monkeypatch, capsys)
    assert "empty" in line and ".stl" in line.lower()


def test_a_broken_mesh_is_named_before_any_work_is_done(tmp_path, monkeypatch, capfd):
    meshes = tmp_path / "meshes"
    meshes.mkdir()
    trimesh.creation.box([0.04, 0.04, 0.06]).export(meshes / "good.stl")
    (meshes / "bad.obj").write_text("v 0 0 0\nv 1 0 nan\nv 0 1 0\nf 1 2 3\n")
    arguments = ["evaluate.object_sets=meshes", "evaluate.policies=heuristic", "evaluate.rounds=8",
                 "evaluate.scenarios=isolated", "evaluate.videos=0",
                 "evaluate.workers=2"]  # fmt: skip
    assert "bad.obj" in refusal(arguments, tmp_path, monkeypatch, capfd)
    assert not (tmp_path / "runs").exists()


@pytest.mark.slow
def test_own_meshes_are_picked(tmp_path, monkeypatch, played_here):
    meshes = tmp_path / "meshes"
    meshes.mkdir()
    trimesh.creation.cylinder(radius=0.5, height=2.0).export(meshes / "can.ply")
    trimesh.creation.annulus(r_min=0.7, r_max=1.0, height=1.0).export(meshes / "ring.glb")
    monkeypatch.chdir(tmp_path)
    arguments = ["evaluate.object_sets=meshes", "objects.fit=0.05", "evaluate.policies=oracle",
                 "evaluate.scenarios=isolated,pile", "evaluate.rounds=2", "evaluate.videos=0",
                 "scene.count=3", "evaluate.workers=1", "evaluate.depth_noises=none"]  # fmt: skip
    assert evaluate.main(arguments) == 0
    results = json.loads((only_run(tmp_path) / "results.json").read_text())
    assert sum(row["successes"] for row in results["rows"]) >= 6


@pytest.mark.slow
def test_piles_of_unseen_objects_are_cleared(config):
    """The scoreboard's headline on a few fixed scenes, with room for scatter: the README's table of
    50 rounds has random at 23 %, heuristic at 95 %, oracle at 100 % success."""
    objects = load_objects("random_urdfs", config)
    scenes = [make_scene("pile", objects, 700_000 + i, config) for i in range(5)]
    rates = {}
    with make_cell(config) as cell:
        for policy in ("random", "heuristic", "oracle"):
            rounds = []
            for scene in scenes:
                plan = make_planner(policy, GripperGeometry(), Workspace(), scene.seed)
                rounds.append(
                    run_round(
                        cell, scene, plan, policy=policy, objects="random_urdfs",
                        max_failures=2,
                    )
                )  # fmt: skip
            rates[policy] = sum(r.successes for r in rounds) / sum(r.executed for r in rounds)
    assert rates["oracle"] >= 0.92 and rates["heuristic"] >= 0.82 and rates["random"] <= 0.5


@pytest.mark.slow
@needs_pybullet
def test_meshes_from_pybullet_data_are_picked(tmp_path, monkeypatch, played_here):
    """As they are found: one scanned and not convex, one with a handle that bounds no solid."""
    data = data_folder()
    (tmp_path / "toys").mkdir()
    for name in ("duck.obj", "objects/mug.obj"):
        shutil.copy(data / name, tmp_path / "toys")
    monkeypatch.chdir(tmp_path)
    arguments = ["evaluate.object_sets=toys", "objects.fit=0.055", "evaluate.policies=heuristic",
                 "evaluate.scenarios=isolated", "evaluate.rounds=6", "evaluate.videos=0",
                 "evaluate.workers=1", "evaluate.depth_noises=none"]  # fmt: skip
    assert evaluate.main(arguments) == 0
    (row,) = json.loads((only_run(tmp_path) / "results.json").read_text())["rows"]
    assert row["successes"] >= 5


@pytest.mark.slow
def test_resume_refuses_another_experiment(finished, monkeypatch, capsys):
    folder, _ = finished
    changed = ["--resume", only_run(folder), "robot.grip_force=3.0"]
    line = refusal(changed, folder, monkeypatch, capsys)
    assert "--resume" in line and "evaluate.rounds" in line


@pytest.mark.slow
def test_an_impossible_scene_ends_the_run_but_not_the_results(
    tmp_path, monkeypatch, capsys, played_here
):
    arguments = [*SMALL, "evaluate.scenarios=isolated,pile", "evaluate.policies=heuristic",
                 "scene.count=8", "workspace.size=0.06", "evaluate.workers=1",
                 "evaluate.rounds=1"]  # fmt: skip
    line, printed = refused(arguments, tmp_path, monkeypatch, capsys)
    # Resumed, the same scene could not be made again.
    assert "scene.count" in line and "interrupted: " in printed and "--resume" not in printed
    results = json.loads((only_run(tmp_path) / "results.json").read_text())
    assert results["complete"] is False and results["rows"][0]["rounds"] >= 1
    assert (only_run(tmp_path) / "report.html").exists()


def test_a_filmed_round_without_an_attempt_has_a_picture(tmp_path, monkeypatch, played_here):
    meshes = tmp_path / "meshes"
    meshes.mkdir()
    trimesh.creation.box([0.12, 0.12, 0.06]).export(meshes / "slab.stl")
    monkeypatch.chdir(tmp_path)
    arguments = ["evaluate.object_sets=meshes", "evaluate.policies=heuristic", "evaluate.rounds=1",
                 "evaluate.scenarios=isolated", "evaluate.videos=1",
                 "evaluate.workers=1", "evaluate.depth_noises=none"]  # fmt: skip
    assert evaluate.main(arguments) == 0
    assert list((only_run(tmp_path) / "films").glob("*.mp4"))


@pytest.mark.parametrize(
    ("policies", "planner", "message"),
    [
        ('["antigravity:plan"]', "antigravity:plan", "names code to run, evaluate.policies"),
        ('["heuristic"]', "antigravity:plan", "a round of antigravity:plan, which its own config"),
        ('["heuristic"]', "heuristic", "a round of elsewhere:objects in the scenario pile"),
    ],
)
def test_a_sample_names_no_code(tmp_path, policies, planner, message):
    """Anyone may send one."""
    sample = tmp_path / "sample.jsonl"
    objects = "elsewhere:objects" if "elsewhere" in message else "box"
    overrides = [f"evaluate.policies={policies}", "evaluate.object_sets=box",
                 "evaluate.scenarios=pile", "cache_dir=/proc/elsewhere"]  # fmt: skip
    origin = {"commit": None, "versions": {}, "overrides": overrides}
    record = {
        "policy": planner, "scenario": "pile", "objects": objects, "seed": 0, "objects_total": 1,
        "objects_cleared": 0, "attempts": [], "ended": "lost",
    }  # fmt: skip
    sample.write_text(f"{json.dumps(origin)}\n{json.dumps(record)}\n")
    with pytest.raises(UserError, match=message):
        evaluate.main(["--replay", str(sample)])
    assert "antigravity" not in sys.modules
