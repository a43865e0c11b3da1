"""Scenes as pure functions of their seeds, laid out in each simulator."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from envs.cell_layout import Placement, square_walls
from envs.cell_scenes import LAYOUTS, SceneError, _covered, make_scene
from envs.objects import ObjectPart, load_object_set
from envs.simulators import make_layout_table
from tests.helpers.box_frames import CORNERS
from tests.helpers.simulators import INSTALLED
from utils.config import with_settings


@pytest.fixture(scope="module", params=INSTALLED)
def laid_out(request, config):
    """The config with scenes laid out in each simulator."""
    return with_settings(config, "scene", {"simulator": request.param})


@pytest.fixture(scope="module")
def primitives(config):
    return load_object_set("primitives", cache_dir=config.cache_folder)


@pytest.mark.parametrize(
    "layout",
    [
        pytest.param(name, marks=pytest.mark.slow) if name == "household" else name
        for name in LAYOUTS
        if name != "dense"  # piled up by the same function; 15 objects take many seconds
    ],
)
def test_scene_is_a_pure_function_of_its_seed(layout, primitives, laid_out):
    first = make_scene(layout, primitives, 7, laid_out)
    other = make_scene(layout, primitives, 9, laid_out)  # other work in between
    again = make_scene(layout, primitives, 7, laid_out)
    count = {"isolated": 1, "retrieve": 8}.get(layout, laid_out.scene.count)
    assert len(first.placements) == count and first.target == again.target
    for a, b in zip(first.placements, again.placements):
        assert a.model.name == b.model.name
        np.testing.assert_array_equal(a.position, b.position)
        np.testing.assert_array_equal(a.quaternion, b.quaternion)
    assert any((a.position != b.position).any() for a, b in zip(first.placements, other.placements))
    for placement in first.placements:
        offset = abs(placement.position[:2] - laid_out.workspace.center)
        assert offset.max() <= laid_out.workspace.size / 2 and placement.position[2] > 0


@pytest.mark.slow
def test_a_dense_pile_has_fifteen_objects_whatever_the_config_says(primitives, config):
    scene = make_scene("dense", primitives, 11, config)
    assert len(scene.placements) == 15 != config.scene.count
    for placement in scene.placements:
        offset = abs(placement.position[:2] - config.workspace.center)
        assert offset.max() <= config.workspace.size / 2 and placement.position[2] > 0


def test_the_object_to_retrieve_is_the_one_that_is_covered_most(config, box_set):
    """A plate of 8 cm x 6 cm under a box of 3 cm x 6 cm: three eighths of it are covered."""
    flat, narrow = (
        replace(box_set[0], parts=(CORNERS * np.array(size) / 2,))
        for size in ((0.08, 0.06, 0.02), (0.03, 0.06, 0.03))
    )
    level = np.array([0.0, 0.0, 0.0, 1.0])

    def placed(*others) -> tuple[Placement, ...]:
        plate = Placement(flat, np.array([0.5, 0.0, 0.01]), level)
        return plate, *(Placement(narrow, np.array(place), level) for place in others)

    over, beside = (0.5, 0.0, 0.035), (0.4, 0.1, 0.015)
    assert _covered(placed(over, beside), config) == 0
    assert _covered(placed(beside), config) is None  # nothing is covered
    cover = [(0.5 + dx, 0.0, 0.035) for dx in (-0.03, 0.0, 0.03)]
    assert _covered(placed(*cover), config) is None  # nothing is left to be seen


def test_a_household_is_as_mixed_as_its_set(primitives, config):
    """One object of each fifth of the set, sorted by the smallest width; none that the hand cannot
    span; and a set of one gives five of it."""
    some = ObjectPart(primitives, range(25))
    widths = sorted(model.narrowest for model in some)
    assert widths[-1] < 0.074  # so that all of them count
    names = set()
    for seed in range(4):
        scene = make_scene("household", some, seed, config)
        drawn = sorted(placed.model.narrowest for placed in scene.placements)
        for number, width in enumerate(drawn):
            assert widths[5 * number] <= width <= widths[5 * number + 4]
        names |= {placed.model.name for placed in scene.placements}
    assert len(names) > 10
    narrow = with_settings(config, "gripper", {"max_opening": widths[9] + 0.0061})
    scene = make_scene("household", some, 0, narrow)
    assert max(placed.model.narrowest for placed in scene.placements) <= widths[9]
    cubes = load_object_set("box", cache_dir=config.cache_folder)
    assert len(make_scene("household", cubes, 0, config).placements) == 5
    with pytest.raises(SceneError, match="no object of 'box' is less than 0.034 m wide"):
        make_scene("household", cubes, 0, with_settings(config, "gripper", {"max_opening": 0.04}))


def test_packed_objects_stand_apart(primitives, laid_out):
    placements = make_scene("packed", primitives, 3, laid_out).placements
    with make_layout_table(laid_out, [placed.model for placed in placements]) as table:
        bodies = [table.put(*vars(placed).values()) for placed in placements]
        for body in bodies:
            assert not table.is_near(body, [one for one in bodies if one != body], 5e-4)
            assert table.is_near(body, [one for one in bodies if one != body], 0.3)


def test_the_walls_of_a_bin_hold_what_is_in_it(primitives, laid_out):
    """All of every object is between the walls, which stand 2 cm outside the workspace."""
    workspace = laid_out.workspace
    for seed in (3, 4):
        scene = make_scene("bin", primitives, seed, laid_out)
        for axis in (0, 1):
            edges = sorted(
                (w.position + s * w.half_size)[axis] for w in scene.walls for s in (-1, 1)
            )
            assert np.subtract(edges, workspace.center[axis])[[0, 1, -2, -1]] == pytest.approx(
                [-0.18, -0.18, 0.18, 0.18]
            )
        assert [wall.position[2] + wall.half_size[2] for wall in scene.walls] == [0.1] * 4
        for placed in scene.placements:
            turn = Rotation.from_quat(placed.quaternion)
            corners = placed.position + turn.apply(np.concatenate(placed.model.parts))
            assert np.abs(corners[:, :2] - workspace.center).max() < workspace.size / 2 + 0.021


def test_a_cube_on_a_table(box_set, laid_out):
    """A cube of 6 cm falls flat, stays inside a wall until it is taken away, and is gone when it is
    removed."""
    level = np.array([0.0, 0.0, 0.0, 1.0])
    with make_layout_table(laid_out, [box_set[0], box_set[0]]) as table:
        walls = table.put_walls(square_walls((0.5, 0.0), 0.08, 0.1, 0.02))
        cube = table.put(box_set[0], np.array([0.5, 0.0, 0.05]), level)
        assert table.settle([cube])
        position, quaternion = table.pose(cube)
        np.testing.assert_allclose(position, [0.5, 0.0, 0.03], atol=1e-3)
        assert abs(quaternion[3]) == pytest.approx(1, abs=1e-4)
        for distance, near in ((0.045, False), (0.055, True)):  # the wall is 5 cm away
            assert table.is_near(cube, walls, distance) == near
        other = table.put(box_set[0], np.array([0.5, 0.0, 0.15]), level)
        table.remove(cube)
        for wall in walls:
            table.remove(wall)
        assert table.settle([other])  # falls to where the first one was
        np.testing.assert_allclose(table.pose(other)[0], [0.5, 0.0, 0.03], atol=1e-3)


def test_one_layout_table_of_pybullet_at_a_time(config):
    pytest.importorskip("pybullet")
    config = with_settings(config, "scene", {"simulator": "pybullet"})
    with make_layout_table(config, []) as first:
        with pytest.raises(RuntimeError, match="in use already"), make_layout_table(config, []):
            pass
        assert first.settle([])  # still there
    with make_layout_table(config, []):
        pass


def test_impossible_scene_is_refused(box_set, config):
    crowded = with_settings(config, "scene", {"count": 50})
    with pytest.raises(SceneError, match="scene.count"):
        make_scene("packed", box_set, 0, crowded)
    with pytest.raises(SceneError, match="isolated, packed, pile"):
        make_scene("heap", box_set, 0, config)
