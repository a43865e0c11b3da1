"""Scenes as pure functions of their seeds, laid out in each simulator."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from envs.cell_layout import Placement, square_walls
from envs.cell_scenes import LAYOUTS, SceneError, _covered, make_scene
from envs.objects import ObjectPart, load_object_set
from envs.simulators import make_cell, make_layout_table
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


@pytest.fixture(scope="module")
def sets(config, primitives):
    """The set of objects of each layout."""
    tall, flat = (load_object_set(name, cache_dir=config.cache_folder) for name in ("tall", "flat"))
    return {layout: primitives for layout in LAYOUTS} | {
        "tall": tall, "wall": tall, "flat": flat, "shelf": tall,
    }  # fmt: skip


@pytest.mark.parametrize(
    "layout",
    [
        pytest.param(name, marks=pytest.mark.slow) if name == "household" else name
        for name in LAYOUTS
        if name != "dense"  # piled up by the same function; 15 objects take many seconds
    ],
)
def test_scene_is_a_pure_function_of_its_seed(layout, sets, laid_out):
    first = make_scene(layout, sets[layout], 7, laid_out)
    other = make_scene(layout, sets[layout], 9, laid_out)  # other work in between
    again = make_scene(layout, sets[layout], 7, laid_out)
    counts = {"isolated": 1, "wall": 3, "flat": 2, "retrieve": 8, "shelf": 3}
    assert len(first.placements) == counts.get(layout, laid_out.scene.count)
    assert first.target == again.target
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


@pytest.mark.parametrize("seed", [98600010, 98600028, 99300022, 99300117])
def test_what_stands_upright_goes_on_standing(config, seed):
    """Boards of 8 cm on their edge of 2 cm: after 2 s nothing has moved by 4 mm. Of the
    first two scenes, found at rest once, three objects had toppled; of the others, found at rest
    for a second, one each when it was put down anew (on some machines)."""
    objects = load_object_set("random_urdfs", cache_dir=config.cache_folder, split="train")
    scene = make_scene("packed", objects, seed, config)
    with make_cell(config) as cell:
        cell.load(scene)
        before, after = [], []
        for places in (before, after):
            places += [cell.object_position(number) for number in range(len(scene.placements))]
            if places is before:
                cell.step(round(2.0 / cell.dt))
    np.testing.assert_allclose(after, before, atol=0.004)


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


def corners_of(placed) -> np.ndarray:
    """(N, 3) corners in W of the convex parts of an object."""
    turn = Rotation.from_quat(placed.quaternion)
    return placed.position + turn.apply(np.concatenate(placed.model.parts))


@pytest.mark.parametrize("seed", [3, 4])
def test_tall_things_stand_close_together(sets, laid_out, seed):
    """Higher than the hand is long from its fingertips to its wrist, and each so near another one
    that no finger, 14 mm thick and with 4 mm of room, passes between the two."""
    placements = make_scene("tall", sets["tall"], seed, laid_out).placements
    for placed in placements:
        heights = corners_of(placed)[:, 2]
        assert heights.min() == pytest.approx(0.0, abs=2e-3) and 0.118 < heights.max() < 0.26
    with make_layout_table(laid_out, [placed.model for placed in placements]) as table:
        bodies = [table.put(*vars(placed).values()) for placed in placements]
        for body in bodies:
            others = [one for one in bodies if one != body]
            assert table.is_near(body, others, 0.018) and not table.is_near(body, others, 5e-4)


@pytest.mark.parametrize("name", ["tall", "flat"])
def test_things_lean_on_the_wall(sets, laid_out, name):
    scene = make_scene("wall", sets[name], 3, laid_out)
    (wall,) = scene.walls
    face = laid_out.workspace.center[1] + laid_out.workspace.size / 2
    assert wall.position[1] - wall.half_size[1] == pytest.approx(face)
    for placed in scene.placements:
        turn = Rotation.from_quat(placed.quaternion).as_matrix()
        lean = np.degrees(np.arccos(abs(turn[2, np.argmax(placed.model.extents)])))
        corners = corners_of(placed)
        assert 8 < lean < 35
        assert corners[:, 2].min() == pytest.approx(0.0, abs=2e-3)  # stands on the table
        assert corners[:, 1].max() > face - 0.002  # and touches the wall, or leans over it


@pytest.mark.parametrize("seed", [3, 4])
def test_flat_things_lie_on_the_block_and_overhang_its_edge(sets, laid_out, seed):
    scene = make_scene("flat", sets["flat"], seed, laid_out)
    (block,) = scene.walls
    edge, top = (block.position + block.half_size)[1:]
    for placed in scene.placements:
        corners = corners_of(placed)
        assert np.sort(np.ptp(corners, axis=0))[1] > 0.08  # wider than the hand
        assert corners[:, 2].min() == pytest.approx(top, abs=2e-3)
        assert np.ptp(corners[:, 2]) < 0.017
        assert 0.015 < corners[:, 1].max() - edge < 0.065
        assert placed.position[1] < edge


@pytest.mark.parametrize("seed", [3, 4])
def test_tall_things_stand_below_the_board_with_room_for_fingers(sets, laid_out, seed):
    """The board's lower side is 0.3 m over the table; a finger with its room needs 2 cm."""
    scene = make_scene("shelf", sets["tall"], seed, laid_out)
    board, back = scene.walls
    low, high = board.position - board.half_size, board.position + board.half_size
    assert low[2] == pytest.approx(0.30) and board.solid().hangs(0.0)
    assert not back.solid().hangs(0.0) and back.position[1] < low[1] + 0.02
    for placed in scene.placements:
        corners = corners_of(placed)
        assert corners[:, 2].min() == pytest.approx(0.0, abs=2e-3) and corners[:, 2].max() < 0.27
        assert (placed.position > low - (0, 0, 1))[:2].all() and (placed.position < high).all()
        assert high[1] - placed.position[1] < 0.15  # the arm goes in no deeper
    with make_layout_table(laid_out, [placed.model for placed in scene.placements]) as table:
        bodies = [table.put(*vars(placed).values()) for placed in scene.placements]
        for body in bodies:
            assert not table.is_near(body, [one for one in bodies if one != body], 0.02)


def test_planners_know_walls_that_stand_there_for_good_and_no_bin(sets, config):
    for layout, count in (("wall", 1), ("flat", 1), ("shelf", 2)):
        scene = make_scene(layout, sets[layout], 3, config)
        assert len(scene.fixtures) == len(scene.walls) == count
        for fixture, wall in zip(scene.fixtures, scene.walls):
            corners = wall.position + np.array([wall.half_size, -wall.half_size])
            np.testing.assert_allclose(fixture.vertices.max(axis=0), corners[0])
            np.testing.assert_allclose(fixture.vertices.min(axis=0), corners[1])
    assert make_scene("bin", sets["bin"], 3, config).fixtures == ()


@pytest.mark.parametrize(("layout", "what"), [("tall", "0.12 m long"), ("flat", "0.085 m wide")])
def test_a_layout_refuses_a_set_without_objects_of_its_shape(box_set, config, layout, what):
    with pytest.raises(SceneError, match=f"no object of 'box' is .*{what}.* use the set {layout}"):
        make_scene(layout, box_set, 0, config)


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


def test_a_wall_that_was_taken_away_stays_away_when_others_are_built(box_set, laid_out):
    with make_layout_table(laid_out, [box_set[0]]) as table:
        for wall in table.put_walls(square_walls((0.5, 0.0), 0.08, 0.1, 0.02)):
            table.remove(wall)
        table.put_walls(square_walls((0.5, 0.0), 0.2, 0.1, 0.02))
        cube = table.put(box_set[0], np.array([0.59, 0.0, 0.05]), np.array([0.0, 0.0, 0.0, 1.0]))
        assert table.settle([cube])
        np.testing.assert_allclose(table.pose(cube)[0], [0.59, 0.0, 0.03], atol=1e-3)


@pytest.mark.parametrize("frequency", [240, 2000])
def test_rest_is_looked_for_after_a_time_and_not_a_number_of_steps(box_set, config, frequency):
    """Within the 0.05 s up to the first look a cube falls freely, by g t^2 / 2 and at most half a
    step's way more (Bullet's steps are symplectic Euler's)."""
    pytest.importorskip("pybullet")
    config = with_settings(config, "sim", {"frequency": frequency})
    with make_layout_table(config, [box_set[0]]) as table:
        cube = table.put(box_set[0], np.array([0.5, 0.0, 1.0]), np.array([0, 0, 0, 1.0]))
        assert table.settle([])
        fallen = 1.0 - table.pose(cube)[0][2]
    assert fallen == pytest.approx(9.81 * 0.05**2 / 2, abs=1.1e-3)


def test_one_layout_table_of_pybullet_at_a_time(config):
    pytest.importorskip("pybullet")
    config = with_settings(config, "scene", {"simulator": "pybullet"})
    with make_layout_table(config, []) as first:
        with pytest.raises(RuntimeError, match="in use already"), make_layout_table(config, []):
            pass
        assert first.settle([])  # still there
    with make_layout_table(config, []):
        pass


@pytest.mark.parametrize(
    ("layout", "simulator", "short", "least"),
    [
        ("packed", "pybullet", 0.99, "1"),
        ("packed", "mujoco", 0.99, "1"),
        ("isolated", "mujoco", 0.24, "0.25"),
        ("isolated", "pybullet", 0.04, "0.05"),
    ],
)
def test_too_short_a_time_to_rest_is_named(box_set, config, layout, simulator, short, least):
    if simulator not in INSTALLED:
        pytest.skip(f"needs {simulator}")
    hasty = with_settings(config, "scene", {"simulator": simulator, "settle_seconds": short})
    expected = f"settle_seconds={short} is too short for .* {simulator}, .* rest for {least} s;"
    with pytest.raises(SceneError, match=expected):
        make_scene(layout, box_set, 0, hasty)


def test_impossible_scene_is_refused(box_set, config):
    crowded = with_settings(config, "scene", {"count": 50})
    with pytest.raises(SceneError, match="scene.count"):
        make_scene("packed", box_set, 0, crowded)
    tiny = with_settings(config, "workspace", {"size": 0.01})
    with pytest.raises(SceneError, match=r"for those of a folder\) or a larger workspace.size"):
        make_scene("dense", box_set, 0, tiny)  # whose number of objects is fixed
    with pytest.raises(SceneError, match="isolated, packed, pile"):
        make_scene("heap", box_set, 0, config)
