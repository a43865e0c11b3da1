"""What is executed for the critic, and in which scenes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from envs import critic_examples
from envs.cell_scenes import SceneError, make_scene
from envs.critic_examples import at_rest, examples_of, execute, worth_trying
from envs.objects import load_object_set
from envs.simulators import make_cell
from models.grasp_critic import INPUTS, CriticInputs, GraspCritic
from tests.helpers.executed_grasps import column
from utils.config import load_config
from utils.errors import UserError
from utils.transforms import Grasp


def test_executed_are_grasps_of_a_scene_at_rest() -> None:
    """Across a box's narrow side the hand lifts it, unless so narrow a thing counts as none; 8 cm
    beside it closes on nothing; a hand that would go into the table is not tried."""
    config = load_config(None, ["robot.arm=none"])
    box = load_object_set("box", cache_dir=config.cache_folder)
    with make_cell(config) as cell:
        scene = at_rest(cell, make_scene("isolated", box, 3, config))
        place = scene.placements[0].position
        T = cell.object_pose(0)
        axis = T[:3, int(np.argmin(box[0].extents))]
        good = Grasp(place, float(np.arctan2(axis[1], axis[0])), 0.08, 1.0)
        assert execute(cell, scene, good, 0.0)
        narrow = float(min(box[0].extents))
        assert execute(cell, scene, good, narrow - 0.003)
        assert not execute(cell, scene, good, narrow + 0.003)
        assert not execute(cell, scene, replace(good, position=place + [0.0, 0.08, 0.0]), 0.0)
        assert not execute(cell, scene, replace(good, position=place - [0.0, 0.0, 0.05]), 0.0)
        assert execute(cell, scene, good, 0.0)  # each on a fresh scene


@pytest.mark.slow
def test_examples_of_a_scene_are_a_function_of_its_number() -> None:
    """Of a pile of three, seen with noise in pictures of both sizes: larger scenes take longer."""
    config = load_config(None, ["data.object_sets=primitives"])
    first, again = examples_of(config, 12), examples_of(config, 12)
    assert len(first.success) > 20
    assert 0 < first.success.mean() < 1
    for one, other in zip((*first.inputs, *first[1:]), (*again.inputs, *again[1:])):
        np.testing.assert_array_equal(one, other)


def test_half_of_what_is_tried_is_what_the_critic_likes_best(monkeypatch) -> None:
    class Liking(GraspCritic):
        def chance(self, inputs: CriticInputs) -> np.ndarray:
            return column(inputs, "cover").astype(float)

    monkeypatch.setattr(critic_examples, "shipped_critic", Liking)
    facts = np.zeros((30, len(INPUTS)), np.float32)  # all from straight above
    facts[:, INPUTS.index("cover")] = cover = np.random.default_rng(0).permutation(30) / 30
    inputs = CriticInputs(facts, np.zeros((30, 3, 24, 48), np.int8))
    tried, drawn = worth_trying(inputs, 9, np.random.default_rng(1))
    assert len(tried) == len(set(tried)) == 9
    assert drawn.sum() == 5
    best = [i for i in np.argsort(-cover) if i not in tried[drawn]]
    assert set(tried[~drawn]) == set(best[:4])
    others, _ = worth_trying(inputs, 9, np.random.default_rng(2))
    assert set(tried) != set(others)
    favourite, shares = np.argmax(cover), []
    for seed in range(300):  # it is drawn as often as any other: 5 times of 30
        tried, drawn = worth_trying(inputs, 9, np.random.default_rng(seed))
        shares.append(favourite in tried[drawn])
    assert np.mean(shares) == pytest.approx(5 / 30, abs=3 * np.sqrt(5 / 30 * 25 / 30 / 300))
    assert len(worth_trying(inputs.take(np.arange(3)), 9, np.random.default_rng(1))[0]) == 3


def test_some_scenes_hold_larger_objects() -> None:
    config = load_config(None, [])
    sets = critic_examples._sets_of(config)
    assert "thin, large" not in sets
    pytest.importorskip("pybullet_data")  # which has random_urdfs
    usual, large = sets["random_urdfs"][0].extents, sets["random_urdfs, large"][0].extents
    np.testing.assert_allclose(np.divide(large, usual), 1 / 0.65, rtol=0.01)  # as their files say


def test_scenes_that_cannot_be_made_are_refused(monkeypatch) -> None:
    def none(*_):
        raise SceneError("too many")

    monkeypatch.setattr(critic_examples, "make_scene", none)
    config = load_config(None, [])
    sets = {name: name for name in critic_examples._sets_of(config)}
    with pytest.raises(UserError, match="none of 100 .*workspace.size"):
        critic_examples.draw_scene(config, sets, np.random.default_rng(0))  # type: ignore[arg-type]


def test_a_third_of_the_scenes_of_a_set_hold_its_larger_objects(monkeypatch) -> None:
    """Of those sets that have larger ones, and of no others."""
    drawn = []

    def scene(layout: str, objects: str, seed: int, config) -> str:
        drawn.append((layout, objects))
        return objects

    monkeypatch.setattr(critic_examples, "make_scene", scene)
    config, rng = load_config(None, []), np.random.default_rng(0)
    sets = {name: name for name in critic_examples._sets_of(config)}
    for _ in range(2000):
        critic_examples.draw_scene(config, sets, rng)  # type: ignore[arg-type]
    names = [name for _, name in drawn]
    kinds = {name.removesuffix(", large") for name in sets if name.endswith(", large")}
    assert kinds == {"random_urdfs", "primitives"} & set(sets) >= {"primitives"}
    for kind in kinds:
        large, usual = names.count(f"{kind}, large"), names.count(kind)
        assert large / (large + usual) == pytest.approx(0.35, abs=0.05)
    layouts = [layout for layout, _ in drawn]
    assert layouts.count("household") / 2000 == pytest.approx(0.29, abs=0.03)
    assert {name for layout, name in drawn if layout == "shelf"} == {"tall"}
    assert {name for layout, name in drawn if layout == "household"} == {"household", "rounded"}
