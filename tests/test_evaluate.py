"""The scoreboard from end to end, small."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import trimesh

import evaluate
from utils.results import read_rounds

REPOSITORY = Path(__file__).resolve().parent.parent
SMALL = ["evaluate.rounds=2", "evaluate.workers=2", "evaluate.videos=0", "evaluate.object_sets=box"]


def run_script(arguments, folder, **options):
    """evaluate.py as a user runs it; its run folder lies below `folder`."""
    return subprocess.run(
        [sys.executable, REPOSITORY / "evaluate.py", *arguments],
        cwd=folder, capture_output=True, text=True, timeout=300, **options,
    )  # fmt: skip


def only_run(folder: Path) -> Path:
    (run,) = (folder / "runs" / "evaluate").iterdir()
    return run


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """One finished evaluation of the heuristic and the random planner on the cube."""
    folder = tmp_path_factory.mktemp("evaluation")
    done = run_script(
        [*SMALL, "evaluate.policies=heuristic,random", "evaluate.scenarios=isolated",
         "evaluate.videos=1", "--results", "copy.json"],
        folder,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return folder, done


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


def test_table_csv_report_and_film_are_written(finished):
    folder, done = finished
    run = only_run(folder)
    assert "heuristic" in done.stdout and "isolated" in done.stdout
    assert (run / "results.csv").read_text().startswith("policy,scenario,objects")
    page = (run / "report.html").read_text()
    assert "data:video/mp4" in page and "data:image/png" in page
    assert list((run / "films").glob("*.mp4"))


def test_policies_see_the_same_scenes(finished):
    folder, _ = finished
    rounds = read_rounds(only_run(folder) / "rounds.jsonl")
    seeds = {p: {r.seed for r in rounds if r.policy == p} for p in ("heuristic", "random")}
    assert seeds["heuristic"] == seeds["random"] == {0, 1}


def test_resume_runs_only_what_is_missing(finished):
    folder, _ = finished
    run = only_run(folder)
    before = (run / "rounds.jsonl").read_text()
    (run / "rounds.jsonl").write_text("".join(before.splitlines(keepends=True)[:3]))
    done = run_script(["--resume", run], folder)
    assert done.returncode == 0, done.stderr
    lines = (run / "rounds.jsonl").read_text().splitlines()
    assert len(lines) == 4
    rounds = [json.loads(line) for line in lines]
    again = {(r["policy"], r["seed"]): [a["sim_seconds"] for a in r["attempts"]] for r in rounds}
    first = [json.loads(line) for line in before.splitlines()]
    assert again == {
        (r["policy"], r["seed"]): [a["sim_seconds"] for a in r["attempts"]] for r in first
    }


def test_ctrl_c_writes_what_was_measured(tmp_path):
    process = subprocess.Popen(
        [sys.executable, REPOSITORY / "evaluate.py", *SMALL, "evaluate.rounds=400",
         "evaluate.policies=heuristic", "evaluate.scenarios=isolated"],
        cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        start_new_session=True,
    )  # fmt: skip
    deadline = time.time() + 120
    while time.time() < deadline:
        journals = list(tmp_path.glob("runs/evaluate/*/rounds.jsonl"))
        if journals and len(journals[0].read_text().splitlines()) >= 3:
            break
        time.sleep(0.2)
    os.killpg(process.pid, signal.SIGINT)  # what a terminal does at Ctrl-C
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 130
    results = json.loads((only_run(tmp_path) / "results.json").read_text())
    assert results["complete"] is False and results["rows"][0]["rounds"] >= 3
    assert "interrupted" in output and "--resume" in output


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["evaluate.policies=heuristik"], "heuristic"),
        (["evaluate.roundz=3"], "evaluate.rounds"),
        (["evaluate.rounds=many"], "evaluate.rounds"),
        (["evaluate.object_sets=no/such/folder"], "no/such/folder"),
        (["--config", "missing.yaml"], "missing.yaml"),
        (["--resume", "nowhere"], "nowhere"),
    ],
)
def test_bad_input_is_one_clear_line(arguments, message, tmp_path):
    done = run_script(arguments, tmp_path)
    assert done.returncode == 2
    (line,) = [x for x in done.stderr.splitlines() if x.startswith("error:")]
    assert message in line
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "runs").exists(), "nothing is started before the input is checked"


def test_a_folder_without_meshes_is_refused(tmp_path):
    (tmp_path / "empty").mkdir()
    done = run_script(["evaluate.object_sets=empty"], tmp_path)
    assert done.returncode == 2 and "empty" in done.stderr and ".stl" in done.stderr.lower()


def test_a_broken_mesh_is_named_before_any_work_is_done(tmp_path):
    meshes = tmp_path / "meshes"
    meshes.mkdir()
    trimesh.creation.box([0.04, 0.04, 0.06]).export(meshes / "good.stl")
    (meshes / "bad.obj").write_text("v 0 0 0\nv 1 0 nan\nv 0 1 0\nf 1 2 3\n")
    done = run_script(
        ["evaluate.object_sets=meshes", "evaluate.policies=heuristic", "evaluate.rounds=8",
         "evaluate.scenarios=isolated", "evaluate.videos=0"],
        tmp_path,
    )  # fmt: skip
    assert done.returncode == 2 and "bad.obj" in done.stderr and "Traceback" not in done.stderr
    assert not (tmp_path / "runs").exists()


@pytest.mark.slow
def test_own_meshes_are_picked(tmp_path):
    meshes = tmp_path / "meshes"
    meshes.mkdir()
    trimesh.creation.cylinder(radius=0.5, height=2.0).export(meshes / "can.ply")
    trimesh.creation.annulus(r_min=0.7, r_max=1.0, height=1.0).export(meshes / "ring.glb")
    done = run_script(
        ["evaluate.object_sets=meshes", "objects.fit=0.05", "evaluate.policies=oracle",
         "evaluate.scenarios=isolated,pile", "evaluate.rounds=2", "evaluate.videos=0",
         "scene.count=3"],
        tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    results = json.loads((only_run(tmp_path) / "results.json").read_text())
    assert sum(row["successes"] for row in results["rows"]) >= 6


def test_tasks_cover_the_plan_once(config):
    plan = config.evaluate
    listed = list(evaluate.tasks(config, [], Path("run")))
    assert len(listed) == plan.rounds * len(plan.scenarios) * len(plan.object_sets)
    assert all(task.policies == plan.policies for task in listed)
