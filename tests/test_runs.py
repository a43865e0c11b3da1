"""Run folders, what may change when a run is resumed, and files written whole or not at all."""

import json
import math
import re

import numpy as np
import pytest
import yaml

from tests.helpers.records import CONFIG
from utils.config import load_config
from utils.errors import UserError
from utils.runs import (
    check_resume,
    environment,
    git_state,
    new_run_folder,
    save_results,
    write_json_atomic,
)


def test_run_folder(tmp_path):
    first = new_run_folder("evaluate", "pile", CONFIG, tmp_path)
    second = new_run_folder("evaluate", "pile", CONFIG, tmp_path)
    assert first != second and first.parent == second.parent == tmp_path / "evaluate"
    assert re.fullmatch(r"\d{8}-\d{6}-pile(-2)?", second.name)
    assert load_config(first / "config.yaml") == CONFIG
    assert yaml.safe_load((first / "config.yaml").read_text())["evaluate"]["rounds"] == 2
    facts = json.loads((first / "environment.json").read_text())
    assert facts["packages"]["numpy"] == np.__version__ and facts["cpu_count"] >= 1
    assert re.fullmatch(r"\d{8}-\d{6}", new_run_folder("evaluate", None, CONFIG, tmp_path).name)


def test_run_folder_errors(tmp_path):
    for name in ("../x", "a/b", ".x", "a b", "-x"):
        with pytest.raises(UserError, match="run name"):
            new_run_folder("evaluate", name, CONFIG, tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot make a run folder"):
        new_run_folder("evaluate", None, CONFIG, tmp_path / "file")


def test_git_state_outside_a_repository(tmp_path):
    assert git_state(tmp_path) == (None, None)
    assert set(environment()) >= {"commit", "dirty", "platform", "packages", "cpu_count"}


def test_json_refuses_nan(tmp_path):
    with pytest.raises(ValueError):
        write_json_atomic(tmp_path / "x.json", {"a": math.inf})
    assert list(tmp_path.iterdir()) == []


def test_results_tell_where_they_come_from(tmp_path):
    save_results(tmp_path / "results.json", {"best": 0.5})
    content = json.loads((tmp_path / "results.json").read_text())
    assert content["best"] == 0.5 and content["commit"] == git_state().commit
    assert content["versions"]["numpy"] == np.__version__


def test_only_what_may_change_is_changed_when_a_run_is_resumed(tmp_path):
    run, free = new_run_folder("evaluate", None, CONFIG, tmp_path), ["evaluate.workers", "rl.lr"]
    check_resume(CONFIG, None, free)
    check_resume(CONFIG, run, free)
    changes = ["evaluate.workers=7", "rl.lr=1.0"]
    config = load_config(run / "config.yaml", changes)
    check_resume(config, run, free)
    with pytest.raises(UserError, match="only evaluate.workers may differ"):
        check_resume(config, run, free[:1])
    with pytest.raises(UserError, match="no last.pt or fold./last.pt in there"):
        check_resume(CONFIG, run, free, ["last.pt", "fold*/last.pt"])
    (run / "fold0").mkdir()
    (run / "fold0" / "last.pt").touch()
    check_resume(CONFIG, run, free, ["last.pt", "fold*/last.pt"])
