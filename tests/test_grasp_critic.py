"""The critic of grasps: its inputs in closed form, its truth on boxes, and what it learns."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from benchmarks.train_critic import Examples, fit, judged
from benchmarks.train_critic import main as train
from envs.critic_examples import examples_of, is_sound
from models.grasp_critic import INPUTS, GraspCritic, critic_inputs, load_critic, shipped_critic
from models.planner_antipodal import measure
from models.planner_candidates import FACTS, Candidates, SearchSettings
from models.planner_graspnet import GraspNetFanPlanner
from tests.helpers.box_frames import boxes_frame
from utils.checkpoint import save_checkpoint
from utils.config import load_config
from utils.errors import UserError
from utils.geometry import GripperGeometry, Workspace
from utils.height_map import HeightMap, height_map_from_frame, height_map_from_scene, tilted_view

UPWARDS = np.array([0.0, 0.0, 1.0])
BOX = boxes_frame([((0.04, 0.06, 0.05), 0.0, (0.5, 0.0))])  # 4 cm along x


def candidates(*angles: float, tip: float = 0.02) -> Candidates:
    """Rough candidates over the middle of the box, 2 cm over the table."""
    count = len(angles)
    xy = np.tile((0.5, 0.0), (count, 1))
    return Candidates.rough(
        xy, np.array(angles), np.full(count, tip), np.full(count, 0.07), np.ones(count)
    )


def column(inputs: np.ndarray, name: str) -> np.ndarray:
    return inputs[:, INPUTS.index(name)]


def view_of(approach: tuple[float, float, float]) -> HeightMap:
    assert BOX.truth is not None
    T_WV = tilted_view(np.array(approach), Workspace())
    return height_map_from_scene(BOX.truth, Workspace(), T_WV=T_WV)


def test_what_is_measured_of_a_box() -> None:
    found = measure(
        candidates(0.0),
        height_map_from_frame(BOX, Workspace()),
        GripperGeometry(),
        SearchSettings(),
    )
    facts = dict(zip(FACTS, found.facts[0]))
    assert facts["wedge"] == pytest.approx(0, abs=0.02)
    assert facts["tilt_left"] == facts["tilt_right"] == 0
    assert facts["cover"] == 1
    assert facts["arm_across"] < 0.002
    assert facts["engagement"] == pytest.approx(0.05 - 0.02, abs=0.002)
    assert facts["room"] == pytest.approx((found.opening[0] - 0.04) / 2, abs=0.003)
    assert facts["one_object"] == 1


def test_inputs_of_a_grasp_from_above() -> None:
    """The camera is 30 degrees off the vertical, towards +x; one line closes along x, one along
    y."""
    towards = np.array([0.5, 0.0, 0.75**0.5])
    found = candidates(0.0, np.pi / 2)
    inputs = critic_inputs(found, view_of((0, 0, -1)), np.array([1.0, np.exp(-2)]), towards)
    assert inputs.shape == (2, len(INPUTS))
    np.testing.assert_allclose(column(inputs, "tilt"), 0, atol=1e-3)
    np.testing.assert_allclose(column(inputs, "closing_slope"), 0, atol=1e-6)
    np.testing.assert_allclose(column(inputs, "closing_to_camera"), (0.5, 0), atol=1e-6)
    np.testing.assert_allclose(column(inputs, "approach_to_camera"), 0.75**0.5, atol=1e-6)
    np.testing.assert_allclose(column(inputs, "value"), (0, -2), atol=1e-6)
    np.testing.assert_allclose(column(inputs, "tip_rise"), 0.02, atol=1e-6)


def test_inputs_of_a_grasp_that_leans() -> None:
    """The hand leans by 30 degrees: a line that closes in the plane of the lean slopes by as much,
    the one across it is level."""
    found = candidates(0.0, np.pi / 2)
    inputs = critic_inputs(found, view_of((0.5, 0, -(0.75**0.5))), np.ones(2), UPWARDS)
    np.testing.assert_allclose(column(inputs, "tilt"), np.deg2rad(30), atol=1e-5)
    slopes = np.sort(column(inputs, "closing_slope"))
    np.testing.assert_allclose(slopes, (0, 0.5), atol=1e-5)


def test_sound_is_what_closes_on_opposite_faces() -> None:
    """Across the 4 cm of the box the contacts hold; at 45 degrees its edges slip; deep in the table
    nothing is free."""
    assert BOX.truth is not None
    planner = GraspNetFanPlanner(GripperGeometry(), Workspace(), critic=GraspCritic())
    heights = view_of((0, 0, -1))
    found = measure(candidates(0.0, np.pi / 4), heights, planner.gripper, planner.settings)
    found.opening[:] = 0.06
    assert is_sound(found, heights.T_WV, BOX.truth, planner).tolist() == [True, False]
    deep = measure(candidates(0.0, tip=-0.01), heights, planner.gripper, planner.settings)
    deep.opening[:] = 0.06
    assert not is_sound(deep, heights.T_WV, BOX.truth, planner).any()


def made_up(scenes: int, seed: int) -> Examples:
    """Candidates that are sound where their cover, one of the inputs, is over a half; the search's
    score says the opposite."""
    rng = np.random.default_rng(seed)
    inputs = rng.random((12 * scenes, len(INPUTS))).astype(np.float32)
    cover = column(inputs, "cover")
    return Examples(inputs, cover > 0.5, 1 - cover, np.repeat(np.arange(scenes), 12))


def test_a_rule_is_learned() -> None:
    scores = judged(fit(made_up(300, 0), seed=0), made_up(100, 1))
    assert scores["first by search"] < 0.05
    assert scores["first by critic"] > 0.98
    assert scores["calibration error"] < 0.03


def test_the_same_examples_give_the_same_critic() -> None:
    one, other = (fit(made_up(30, 0), seed=3) for _ in range(2))
    inputs = made_up(5, 1).inputs
    np.testing.assert_array_equal(one.chance(inputs), other.chance(inputs))


def test_beyond_what_was_seen_a_chance_stays() -> None:
    critic = fit(made_up(30, 0), seed=0)
    far = np.full((1, len(INPUTS)), 1e6, np.float32)
    np.testing.assert_array_equal(critic.chance(far), critic.chance(10 * far))
    assert np.isfinite(critic.chance(far)).all()


def test_a_critic_is_saved_and_loaded(tmp_path) -> None:
    critic = fit(made_up(30, 0), seed=0)
    path = tmp_path / "critic.pt"
    save_checkpoint(path, kind="critic", model_args=critic.model_args, model=critic)
    inputs = made_up(5, 1).inputs
    np.testing.assert_array_equal(load_critic(path).chance(inputs), critic.chance(inputs))
    narrow = GraspCritic(inputs=20)
    save_checkpoint(path, kind="critic", model_args=narrow.model_args, model=narrow)
    with pytest.raises(UserError, match=r"critic\.pt: a checkpoint of another architecture"):
        load_critic(path)
    save_checkpoint(path, kind="graspnet", model_args=critic.model_args, model=critic)
    with pytest.raises(UserError, match=r"critic\.pt: a checkpoint of kind 'graspnet'"):
        load_critic(path)


def test_the_shipped_critic_prefers_level_lines_to_sloping_ones() -> None:
    """From the side, a sloping closing line meets faces that mostly stand upright."""
    critic = shipped_critic()
    assert critic.model_args["inputs"] == len(INPUTS)
    inputs = critic.mean.numpy()[None].repeat(2, axis=0)
    inputs[:, INPUTS.index("closing_slope")] = (0.0, 0.5)
    level, sloping = critic.chance(inputs)
    assert level > 2 * sloping


def test_the_ranking_follows_the_critic() -> None:
    """A critic that likes level approaches and one that likes leaning ones rank accordingly; the
    search alone prefers the straight one."""

    class Fixed(GraspCritic):
        leaning = 0.0

        def chance(self, inputs: np.ndarray) -> np.ndarray:
            leans = column(inputs, "tilt") > 0.1
            return np.where(leans, self.leaning, 1 - self.leaning)

    first = []
    for leaning in (0.0001, 0.9999):
        critic = Fixed()
        critic.leaning = leaning
        planner = GraspNetFanPlanner(GripperGeometry(), Workspace(), critic=critic)
        first.append(planner(BOX)[0].tilt)
    assert first[0] == pytest.approx(0, abs=1e-6)
    assert first[1] > np.deg2rad(25)


@pytest.mark.slow
def test_examples_of_a_scene_are_a_function_of_its_number() -> None:
    config = load_config(None, ["data.object_sets=primitives"])
    first, again = examples_of(config, 4), examples_of(config, 4)
    assert len(first[1]) > 20
    assert 0 < first[1].mean() < 1
    for one, other in zip(first, again):
        np.testing.assert_array_equal(one, other)


def test_too_few_scenes_are_refused(tmp_path) -> None:
    with pytest.raises(UserError, match="--scenes 3: give 10 or more"):
        train(["--scenes", "3", "--output", str(tmp_path / "critic.pt")])


def test_logits_and_chances_agree() -> None:
    critic, inputs = GraspCritic(), made_up(2, 0).inputs
    with torch.inference_mode():
        logits = critic(torch.from_numpy(inputs)).numpy()
    np.testing.assert_allclose(critic.chance(inputs), 1 / (1 + np.exp(-logits)), rtol=1e-5)
