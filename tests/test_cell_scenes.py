"""Scenes as pure functions of their seeds."""

import numpy as np
import pybullet
import pytest

from envs.cell_scenes import LAYOUTS, SceneError, make_scene
from envs.objects import load_object_set
from envs.pybullet_bodies import LayoutTable
from utils.config import with_settings


@pytest.fixture(scope="module")
def cell(bullet_cell):
    return bullet_cell


@pytest.fixture(scope="module")
def primitives(config):
    return load_object_set("primitives", cache_dir=config.cache_folder)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_scene_is_a_pure_function_of_its_seed(layout, primitives, config, cell):
    first = make_scene(layout, primitives, 7, config)
    other = make_scene(layout, primitives, 9, config)  # other work in between
    again = make_scene(layout, primitives, 7, config)
    assert len(first.placements) == (1 if layout == "isolated" else config.scene.count)
    for a, b in zip(first.placements, again.placements):
        assert a.model.name == b.model.name
        np.testing.assert_array_equal(a.position, b.position)
        np.testing.assert_array_equal(a.quaternion, b.quaternion)
    assert any((a.position != b.position).any() for a, b in zip(first.placements, other.placements))
    for placement in first.placements:
        offset = abs(placement.position[:2] - config.workspace.center)
        assert offset.max() <= config.workspace.size / 2 and placement.position[2] > 0


def test_packed_objects_stand_apart(primitives, config, cell):
    scene = make_scene("packed", primitives, 3, config)
    cell.load(scene)
    for i, a in enumerate(cell.bodies):
        for b in cell.bodies[:i]:
            assert not pybullet.getContactPoints(a, b, physicsClientId=cell.client)


def test_one_layout_table_at_a_time(config):
    with LayoutTable(config) as first:
        with pytest.raises(RuntimeError, match="in use already"), LayoutTable(config):
            pass
        assert first.settle([])  # still there
    with LayoutTable(config):
        pass


def test_impossible_scene_is_refused(box_set, config):
    crowded = with_settings(config, "scene", {"count": 50})
    with pytest.raises(SceneError, match="scene.count"):
        make_scene("packed", box_set, 0, crowded)
    with pytest.raises(SceneError, match="isolated, packed, pile"):
        make_scene("heap", box_set, 0, config)
