"""Plug-ins by import path: what is found, and one sentence for everything that is not."""

import json
import math
import sys

import pytest

from utils.errors import UserError
from utils.plugins import is_import_path, load_plugin
from utils.runs import run_script


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path


def test_functions_methods_and_modules_in_packages_are_found():
    assert load_plugin("math:hypot", "planner") is math.hypot
    assert load_plugin("json.decoder:JSONDecoder.decode", "x") is json.JSONDecoder.decode
    assert load_plugin("math:pi", "x", must_be_callable=False) == math.pi


def test_a_script_finds_modules_of_the_current_folder(tmp_path, monkeypatch):
    (tmp_path / "plugin_of_the_folder.py").write_text("def plan(frame):\n    return [frame]\n")
    monkeypatch.chdir(tmp_path)
    before = list(sys.path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    with pytest.raises(UserError, match="no module"):
        load_plugin("plugin_of_the_folder:plan", "planner")
    assert sys.path == before, "a library leaves the path alone"

    def main(argv):
        assert load_plugin("plugin_of_the_folder:plan", "planner")(3) == [3]
        return 7

    with pytest.raises(SystemExit) as end:
        run_script(main)
    assert end.value.code == 7


def test_only_module_and_name_make_an_import_path():
    assert is_import_path("my_package.module:Planner")
    for other in ("ppo", "ppo:runs/model.pt", "model.pt", ":plan", "module:", "a:b:c", "C:\\x.pt"):
        assert not is_import_path(other)


@pytest.mark.parametrize(
    "path, expected",
    [
        ("math", "evaluate.policies: got 'math', expected an import path module:name"),
        ("no_such_module:plan", "there is no module 'no_such_module'; start in the folder"),
        ("json.no_part:plan", "there is no module 'json.no_part'"),
        ("math:hypt", "math has no 'hypt'; did you mean hypot?"),
        ("json:JSONDecoder.qqq", "JSONDecoder has no 'qqq'; check the name after the colon"),
        ("math:pi", "'math:pi' is a float, expected something that can be called"),
        ("raises_at_import:plan", "raised RuntimeError: no licence .*raises_at_import.py, line 2"),
        ("imports_nothing:plan", "raised ModuleNotFoundError: No module named 'absent_package'"),
        ("is_not_python:plan", "raised SyntaxError"),
    ],
)
def test_what_cannot_be_loaded_is_refused_in_one_sentence(path, expected, folder):
    (folder / "raises_at_import.py").write_text("x = 1\nraise RuntimeError('no\\nlicence')\n")
    (folder / "imports_nothing.py").write_text("import absent_package\n")
    (folder / "is_not_python.py").write_text("def (\n")
    with pytest.raises(UserError, match=expected) as error:
        load_plugin(path, "evaluate.policies")
    assert "\n" not in str(error.value) and str(error.value).startswith("evaluate.policies: ")
