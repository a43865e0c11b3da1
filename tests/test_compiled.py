"""`utils.compiled`: loops that are compiled wherever the code lies, and what is kept of them."""

from __future__ import annotations

import ast
import errno
import importlib
import importlib.util
import inspect
import os
from pathlib import Path

import numpy as np
import pytest
from numba.core.caching import IndexDataCacheFile
from numba.core.registry import CPUDispatcher

from utils.compiled import LoopCache, compiled

REPOSITORY = Path(__file__).resolve().parent.parent
SOURCE = """
from utils.compiled import compiled

@compiled
def total(values):
    result = {start}
    for value in values:
        result += 1 / value
    return result
"""


def loop_of(folder: Path, start: str = "0.0"):
    """The loop of SOURCE in a file in `folder`, its file as old as ever, and nothing cached in this
    process."""
    path = folder / "summing.py"
    path.write_text(SOURCE.format(start=start))
    os.utime(path, (1e9, 1e9))
    # Python knows a changed source by its time and length alone.
    Path(importlib.util.cache_from_source(str(path))).unlink(missing_ok=True)
    spec = importlib.util.spec_from_file_location("summing", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.total


def test_a_loop_gives_what_python_gives(tmp_path):
    total = loop_of(tmp_path)
    assert total(np.array([1.0, 2.0, 4.0])) == 1.75
    assert total(np.zeros(1)) == np.inf  # as NumPy divides


def test_the_next_process_compiles_nothing(tmp_path):
    loop_of(tmp_path)(np.array([2.0]))
    total = loop_of(tmp_path)
    assert total(np.array([2.0])) == 0.5
    assert sum(total.stats.cache_hits.values()) == 1


def test_a_changed_source_is_compiled_again(tmp_path):
    """Even where the file has the same length and the same time."""
    assert loop_of(tmp_path, "0.0")(np.array([2.0])) == 0.5
    assert loop_of(tmp_path, "1.0")(np.array([2.0])) == 1.5


def test_a_full_disk_costs_the_cache_alone(tmp_path, monkeypatch):
    """Nothing is kept, nothing fails, and no older code comes back once there is room again."""
    loop_of(tmp_path, "0.0")(np.array([2.0]))

    def full(self, name, data):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(IndexDataCacheFile, "_save_data", full)
        assert loop_of(tmp_path, "3.0")(np.array([2.0])) == 3.5
    for hits in (0, 1):
        total = loop_of(tmp_path, "3.0")
        assert total(np.array([2.0])) == 3.5
        assert sum(total.stats.cache_hits.values()) == hits


def test_without_a_folder_nothing_is_kept(monkeypatch):
    """As in a read-only installation without a home, where Numba refuses to cache."""

    def refused(self, loop):
        raise RuntimeError("cannot cache function: no locator available")

    monkeypatch.setattr(LoopCache, "__init__", refused)
    assert compiled(lambda values: values.sum())(np.array([0.5, 1.5])) == 2.0


def modules_with_loops() -> list[str]:
    return sorted(
        ".".join(path.relative_to(REPOSITORY).with_suffix("").parts)
        for folder in ("utils", "models", "envs")
        for path in (REPOSITORY / folder).glob("*.py")
        if "@compiled" in path.read_text()
    )


@pytest.mark.parametrize("name", modules_with_loops())
def test_loops_use_nothing_of_other_modules_of_the_project(name):
    """What a loop uses is compiled into it, and only a change of its own file is noticed."""
    module = importlib.import_module(name)
    tree = ast.parse(inspect.getsource(module))
    imported = {
        alias.asname or alias.name
        for node in tree.body
        if isinstance(node, ast.ImportFrom) and node.module.split(".")[0] in REPOSITORY_PACKAGES
        for alias in node.names
    }
    loops = [loop for loop in vars(module).values() if isinstance(loop, CPUDispatcher)]
    mine = [loop for loop in loops if loop.py_func.__module__ == name]
    assert mine
    for loop in mine:
        used = set(loop.py_func.__code__.co_names) & imported
        assert not used, f"{name}.{loop.py_func.__name__} uses {used}"


REPOSITORY_PACKAGES = {"utils", "models", "envs"}
