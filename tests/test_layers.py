"""Who may import whom, as docs/architecture.md draws it, over the modules' real import graph.

The layers are contracts of import-linter in pyproject.toml; what its contracts cannot say (a rule
by the first word of a file's name, circles between single modules, scripts) is checked here with
grimp, the graph that import-linter stands on. An import inside a function counts too.
"""

from __future__ import annotations

import ast
from graphlib import CycleError, TopologicalSorter

import grimp
import pytest
from importlinter.cli import EXIT_STATUS_SUCCESS, lint_imports

from envs.simulators import SIMULATORS
from utils.runs import REPOSITORY

SCRIPTS = ("evaluate", "predict", "train_graspnet", "train_rl")
SOURCES = sorted(
    file for folder in (".", "envs", "models", "utils", "benchmarks")
    for file in (REPOSITORY / folder).glob("*.py")
)  # fmt: skip
# What opens a client or asks whether there is one, and functions of numbers alone.
WITHOUT_A_CLIENT = {
    "connect", "isConnected", "multiplyTransforms", "invertTransform", "getMatrixFromQuaternion",
    "getQuaternionFromEuler", "getEulerFromQuaternion", "computeViewMatrix",
    "computeProjectionMatrixFOV",
}  # fmt: skip
# `python -m` of the first starts the demonstration in the second, below `__name__ == "__main__"`;
# nothing is imported so when the first is imported.
DEMONSTRATIONS = {
    ("envs.grasping_env", "envs.scripted_pick"),
    ("utils.visual_servo", "utils.servo_reference"),
}


@pytest.fixture(scope="module")
def imports() -> dict[str, set[str]]:
    """The modules that each module of the product imports, other packages' included."""
    graph = grimp.build_graph(
        "envs", "models", "utils", include_external_packages=True, cache_dir=None
    )
    return {module: graph.find_modules_directly_imported_by(module) for module in graph.modules}


def test_contracts_of_import_linter_are_kept(capsys, monkeypatch):
    monkeypatch.chdir(REPOSITORY)
    status = lint_imports(config_filename="pyproject.toml", no_cache=True, no_logo=True)
    assert status == EXIT_STATUS_SUCCESS, capsys.readouterr().out


def test_only_a_simulators_own_modules_import_it(imports):
    """Packages NAME and NAME_..., such as pybullet_data, by modules envs.NAME_... alone."""
    importers = {
        (name, module)
        for name in SIMULATORS
        for module, imported in imports.items()
        if any(one == name or one.startswith(f"{name}_") for one in imported)
    }
    assert {name for name, _ in importers} == set(SIMULATORS)
    assert not [(name, one) for name, one in importers if not one.startswith(f"envs.{name}_")]


@pytest.mark.parametrize(
    "file",
    [path for path in SOURCES if "pybullet" in path.read_text(encoding="utf-8")],
    ids=lambda path: path.name,
)
def test_every_pybullet_call_names_its_client(file):
    """Without the keyword PyBullet takes the first client of the process, which may be another
    cell's. A function may be an argument of a call with the keyword. Constants have capitals."""
    tree = ast.parse(file.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        assert not (isinstance(node, ast.ImportFrom) and node.module == "pybullet"), node.lineno
        if isinstance(node, ast.Import):
            assert not any(one.name == "pybullet" and one.asname for one in node.names), node.lineno
    named = {
        part
        for node in ast.walk(tree)
        if isinstance(node, ast.Call)
        and any(keyword.arg == "physicsClientId" for keyword in node.keywords)
        for part in (node.func, *node.args)
    }
    without = [
        f"{file.name}:{node.lineno} {node.attr}"
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute)
        and isinstance(node.value, ast.Name)
        and node.value.id == "pybullet"
        and not node.attr.isupper()
        and node.attr not in WITHOUT_A_CLIENT
        and node not in named
    ]
    assert without == []


def test_no_module_of_tests_imports_another():
    """What several need is in tests/helpers/."""
    graph = grimp.build_graph("tests", cache_dir=None)
    modules = {module for module in graph.modules if module.startswith("tests.test_")}
    assert len(modules) > 100
    assert not [one for one in modules if graph.find_modules_that_directly_import(one)]


def test_no_circle_of_imports(imports):
    graph = {
        module: {one for one in imported if (module, one) not in DEMONSTRATIONS}
        for module, imported in imports.items()
    }
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(f"these modules import each other: {' -> '.join(error.args[1])}")


@pytest.mark.parametrize(("module", "demonstration"), sorted(DEMONSTRATIONS))
def test_demonstrations_are_imported_by_scripts_alone(module, demonstration):
    tree = ast.parse((REPOSITORY / f"{module.replace('.', '/')}.py").read_text())
    everywhere = [node for node in ast.walk(tree) if _is_import_of(node, demonstration)]
    main = [node for node in tree.body if isinstance(node, ast.If) and "__main__" in ast.dump(node)]
    inside = [node for block in main for node in ast.walk(block)]
    assert everywhere and all(node in inside for node in everywhere)


def _is_import_of(node: ast.AST, module: str) -> bool:
    package, _, name = module.rpartition(".")
    if isinstance(node, ast.ImportFrom):
        return node.module == module or (
            node.module == package and any(alias.name == name for alias in node.names)
        )
    return isinstance(node, ast.Import) and any(alias.name == module for alias in node.names)


@pytest.mark.parametrize("script", SCRIPTS)
def test_no_script_imports_another(script):
    tree = ast.parse((REPOSITORY / f"{script}.py").read_text())
    imported = {
        name.split(".")[0]
        for node in ast.walk(tree)
        for name in (
            [node.module or ""] if isinstance(node, ast.ImportFrom)
            else [alias.name for alias in node.names] if isinstance(node, ast.Import)
            else []
        )
    }  # fmt: skip
    assert not imported & {*SCRIPTS, "tests", "benchmarks"}


@pytest.mark.parametrize("script", SCRIPTS)
def test_a_script_can_be_read_at_a_sitting(script):
    """CONTRIBUTING.md allows it 250 lines."""
    assert len((REPOSITORY / f"{script}.py").read_text(encoding="utf-8").splitlines()) <= 250
