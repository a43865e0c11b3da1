"""Fixtures shared by the tests: a config whose generated files go to one cache for the run."""

from __future__ import annotations

import hypothesis
import pytest

from tests.helpers.simulators import INSTALLED
from utils.config import Config, load_config

# The same examples everywhere, and no verdict from how busy the machine is.
hypothesis.settings.register_profile("everywhere", deadline=None, derandomize=True)
hypothesis.settings.load_profile("everywhere")


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
    """32 training and 32 validation images of 64 pixels, and the overrides that made them."""
    from envs.data_generation import generate

    folder = tmp_path_factory.mktemp("tiny_data")
    overrides = [
        "sim.renderer=tiny", "camera.width=64", "camera.height=64", f"data.root={folder}",
        "data.frames=32", "data.validation_frames=32", "data.object_sets=primitives",
        "data.max_objects=2", "data.executed_share=0.01", "data.workers=1",
    ]  # fmt: skip
    generate(load_config(None, overrides))
    return folder, overrides


@pytest.fixture(scope="module", params=INSTALLED)
def taught_cell(request, config: Config):
    """The cell of each simulator, whose wrist camera has been shown the board."""
    from envs.scenarios import teach
    from envs.simulators import cell_class

    with cell_class(request.param)(config) as cell:
        teach(cell)  # empties the cell, the first time
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
