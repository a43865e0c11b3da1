"""Fixtures shared by the tests: a config whose generated files go to one cache for the run."""

from __future__ import annotations

import hashlib
import os
import sys
from collections import Counter
from pathlib import Path

import hypothesis
import pytest
from filelock import FileLock

from tests.helpers.simulators import INSTALLED
from utils.config import Config, load_config

ENVS = Path(__file__).parents[1] / "envs"
# The same examples everywhere, and no verdict from how busy the machine is.
hypothesis.settings.register_profile("everywhere", deadline=None, derandomize=True)
hypothesis.settings.load_profile("everywhere")


def pytest_configure() -> None:
    """What the cache holds was made by the code that is tested: other code has another folder in
    $ROBOT_GRASPING_CACHE, also in the processes that tests start."""
    names = ("object_parts", "object_meshes", "object_files", "object_bodies", "panda_model",
             "panda_urdf")  # fmt: skip
    digest = hashlib.sha256(b"".join((ENVS / f"{name}.py").read_bytes() for name in names))
    own = Path("tests", digest.hexdigest()[:12])
    cache = load_config().cache_folder
    if cache.parts[-2:] != own.parts:  # a process of pytest-xdist has the variable already
        os.environ["ROBOT_GRASPING_CACHE"] = str(cache / own)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The files with the most slow tests first: a file stays in one process, and so the last files
    have to be short for two processes to end together."""
    slow = Counter(item.path for item in items if item.get_closest_marker("slow"))
    items.sort(key=lambda item: -slow[item.path])


@pytest.fixture(autouse=True)
def without_other_tests_plug_ins(monkeypatch):
    """A worker of a cluster must have the plug-ins that the main process has loaded."""
    monkeypatch.setattr("utils.plugins._loaded", set())


@pytest.fixture(autouse=True)
def same_torch():
    """Torch draws the same numbers whichever tests came before, and after a test has as many
    threads as before it. Tests that do without torch do not wait for its import."""
    torch = sys.modules.get("torch")
    if torch is None:
        yield
        return
    torch.manual_seed(0)
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="session")
def config() -> Config:
    """The defaults, rendered by the CPU so that pictures are the same everywhere."""
    return load_config(None, ["sim.renderer=tiny"])


@pytest.fixture(scope="session")
def box_set(config: Config):
    """The object set of the tutorial's cube."""
    from envs.objects import load_object_set

    return load_object_set("box", cache_dir=config.cache_folder)


@pytest.fixture(scope="session")
def tiny_data(tmp_path_factory):
    """32 training and 32 validation images of 64 pixels, and the overrides that made them.

    The processes of one run share them; the first that needs them makes them."""
    from envs.data_generation import generate

    shared = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:  # whose folder lies in that of the whole run
        shared = shared.parent
    folder = shared / "tiny_data"
    overrides = [
        "sim.renderer=tiny", "camera.width=64", "camera.height=64", f"data.root={folder}",
        "data.frames=32", "data.validation_frames=32", "data.object_sets=primitives",
        "data.max_objects=2", "data.executed_share=0.007", "data.workers=1",
    ]  # fmt: skip
    with FileLock(shared / "tiny_data.lock"):
        generate(load_config(None, overrides))
    return folder, overrides


@pytest.fixture
def kept_here():
    """What a worker process would keep, such as cells, is kept until the end of the test."""
    from utils.worker_process import forget

    yield
    forget()


@pytest.fixture
def played_here(monkeypatch, kept_here):
    """Evaluations play their rounds in this process instead of worker processes."""
    from tests.helpers.played_here import CallingExecutor

    monkeypatch.setattr("utils.evaluation.open_executor", CallingExecutor)


@pytest.fixture
def client():
    """A PyBullet client with a plane; modules that need another client define their own."""
    pybullet = pytest.importorskip("pybullet")
    client = pybullet.connect(pybullet.DIRECT)
    pybullet.setGravity(0, 0, -9.81, physicsClientId=client)
    plane = pybullet.createCollisionShape(pybullet.GEOM_PLANE, physicsClientId=client)
    pybullet.createMultiBody(0, plane, physicsClientId=client)
    yield client
    pybullet.disconnect(client)


@pytest.fixture
def make_env(config: Config):
    """Makes environments, state-only unless given otherwise, and closes them after the test."""
    from envs.grasping_env import RobotGraspingEnv

    made = []

    def make(render_mode=None, **settings) -> RobotGraspingEnv:
        settings = {"observations": ["state"], "resolution": 32} | settings
        made.append(RobotGraspingEnv(render_mode, config, **settings))
        return made[-1]

    yield make
    for env in made:
        env.close()


@pytest.fixture(scope="module", params=INSTALLED)
def taught_cell(request, config: Config):
    """The cell of each simulator, whose wrist camera has been shown the board."""
    from envs.scenarios import teach
    from envs.simulators import cell_class

    with cell_class(request.param)(config) as cell:
        teach(cell)  # empties the cell, the first time
        yield cell


@pytest.fixture(scope="module")
def bullet_cell(config: Config):
    """An empty cell, in PyBullet where it is installed."""
    from envs.simulators import cell_class

    with cell_class(INSTALLED[0])(config) as cell:
        yield cell


@pytest.fixture(scope="module")
def scene(config: Config, box_set):
    """The isolated scene of one box."""
    from envs.cell_scenes import make_scene

    return make_scene("isolated", box_set, 0, config)


@pytest.fixture
def cell(taught_cell, scene):
    """The cell of either simulator with the scene of one box, loaded; modules that need another
    cell define their own."""
    taught_cell.load(scene)
    return taught_cell


@pytest.fixture(scope="module")
def cells(config: Config):
    """A PyBullet cell and a MuJoCo cell."""
    pytest.importorskip("pybullet")
    from envs.simulators import cell_class

    with cell_class("pybullet")(config) as bullet, cell_class("mujoco")(config) as mujoco:
        yield bullet, mujoco


@pytest.fixture(scope="module")
def pile(config: Config):
    """A pile of objects of the default test set."""
    from envs.cell_scenes import make_scene
    from envs.objects import load_object_set

    objects = load_object_set(config.evaluate.object_sets[0], cache_dir=config.cache_folder)
    return make_scene("pile", objects, 2, config)
