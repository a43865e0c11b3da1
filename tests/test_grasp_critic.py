"""The critic of grasps: its inputs in closed form, its file, and who ranks by it."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
import torch

from benchmarks.train_critic import TILTS, fit, mirrored
from envs import critic_examples
from models.grasp_critic import (
    INPUTS,
    CriticInputs,
    GraspCritic,
    critic_inputs,
    load_critic,
    shipped_critic,
)
from models.graspnet_io import SHIPPED as NETWORK
from models.planner_candidates import FACTS, Candidates, SearchSettings
from models.planner_graspnet import (
    GraspNetDirectPlanner,
    GraspNetFanPlanner,
    GraspNetPlanner,
    loaded,
)
from models.planner_measure import measure
from tests.helpers.box_frames import boxes_frame
from tests.helpers.executed_grasps import column, made_up
from utils.checkpoint import save_checkpoint
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
    inputs = critic_inputs(found, view_of((0, 0, -1)), np.array([1.0, np.exp(-2)]), towards, 0.0)
    assert inputs.facts.shape == (2, len(INPUTS))
    np.testing.assert_allclose(column(inputs, "tilt"), 0, atol=1e-3)
    np.testing.assert_allclose(column(inputs, "closing_slope"), 0, atol=1e-6)
    np.testing.assert_allclose(column(inputs, "closing_to_camera"), (0.5, 0), atol=1e-6)
    np.testing.assert_allclose(column(inputs, "approach_to_camera"), 0.75**0.5, atol=1e-6)
    np.testing.assert_allclose(column(inputs, "value"), (0, -2), atol=1e-6)
    np.testing.assert_allclose(column(inputs, "tip_rise"), 0.02, atol=1e-6)
    np.testing.assert_allclose(column(inputs, "least_held"), 0)


def test_how_large_the_object_of_a_grasp_looks() -> None:
    """Along its faces a box of 4 x 6 x 5 cm has these extents, at 45 degrees (4 + 6) / sqrt(2) cm
    both ways; its volume is that of a cube of 4.93 cm."""
    found = candidates(0.0, np.pi / 2, np.pi / 4, 0.0)
    found.label[:3] = 0
    inputs = critic_inputs(found, view_of((0, 0, -1)), np.ones(4), UPWARDS, 0.0)
    diagonal = 0.1 / np.sqrt(2)
    for name, expected in (
        ("extent_along", (0.04, 0.06, diagonal, 0)),
        ("extent_across", (0.06, 0.04, diagonal, 0)),
        ("edge", (0.0493, 0.0493, 0.0493, 0)),
    ):
        np.testing.assert_allclose(column(inputs, name), expected, atol=0.004, err_msg=name)


def test_inputs_of_a_grasp_that_leans() -> None:
    """The hand leans by 30 degrees: a line that closes in the plane of the lean slopes by as much,
    the one across it is level."""
    found = candidates(0.0, np.pi / 2)
    inputs = critic_inputs(found, view_of((0.5, 0, -(0.75**0.5))), np.ones(2), UPWARDS, 0.0)
    np.testing.assert_allclose(column(inputs, "tilt"), np.deg2rad(30), atol=1e-5)
    slopes = np.sort(column(inputs, "closing_slope"))
    np.testing.assert_allclose(slopes, (0, 0.5), atol=1e-5)


def test_the_patch_of_a_box() -> None:
    """The box is 4 cm along x, 6 cm along y and 5 cm high. With the fingertips 2 cm over the table
    it rises 30 mm over them, the table lies 20 mm under them. Cells are 4 mm apart."""
    heights = view_of((0, 0, -1))
    found = candidates(0.0, np.pi / 2)
    found.label[:] = 0
    patches = critic_inputs(found, heights, np.ones(2), UPWARDS, 0.0).patches
    assert patches.shape == (2, 3, 24, 48)
    for patch, half in zip(patches, (20, 30)):  # mm, of the box along the closing line
        place = np.abs(4 * (np.arange(48) - 23.5))
        clear = np.abs(place - half) > 1  # of the edge, whose cells are of either side
        inside = place[clear] < half
        for row in patch[:, 11:13, clear].swapaxes(0, 1):
            np.testing.assert_allclose(row[0], np.where(inside, 30, -20), atol=1)
            np.testing.assert_array_equal(row[0], row[1])  # nothing is hidden
            np.testing.assert_array_equal(row[2], inside)


def test_a_mirrored_patch_is_that_of_the_turned_hand() -> None:
    """Turned by half a turn, the hand is the same, and its patch is mirrored along both axes."""
    heights = view_of((0, 0, -1))
    found = candidates(0.3, 0.3 + np.pi)
    found.xy += (0.013, 0.007)
    found.label[:] = 0
    one, turned = critic_inputs(found, heights, np.ones(2), UPWARDS, 0.0).patches
    assert np.mean(turned != one[:, ::-1, ::-1]) < 0.01  # rounding to cells

    class Always:
        def random(self) -> float:
            return 0.0

    inputs = made_up(2, 0)
    facts, patches = map(torch.from_numpy, inputs.inputs)
    facts_after, patches_after = mirrored(facts, patches, Always())  # type: ignore[arg-type]
    np.testing.assert_array_equal(patches_after, patches.flip(2, 3))
    np.testing.assert_array_equal(facts_after[:, TILTS[0]], facts[:, TILTS[1]])
    others = [k for k in range(len(INPUTS)) if k not in TILTS]
    np.testing.assert_array_equal(facts_after[:, others], facts[:, others])


def test_beyond_what_was_seen_a_chance_stays() -> None:
    critic = fit(made_up(30, 0), seed=0, epochs=2)
    patches = made_up(1, 0).inputs.patches[:1]
    far, farther = (
        critic.chance(CriticInputs(np.full((1, len(INPUTS)), value, np.float32), patches))
        for value in (1e6, 1e7)
    )
    np.testing.assert_array_equal(far, farther)
    assert np.isfinite(far).all()


def test_a_critic_is_saved_and_loaded(tmp_path) -> None:
    critic = fit(made_up(30, 0), seed=0, epochs=1)
    path = tmp_path / "critic.pt"
    save_checkpoint(path, kind="critic", model_args=critic.model_args, model=critic)
    inputs = made_up(5, 1).inputs
    np.testing.assert_array_equal(load_critic(path).chance(inputs), critic.chance(inputs))
    other = GraspCritic(inputs=[*INPUTS[1:], INPUTS[0]])
    save_checkpoint(path, kind="critic", model_args=other.model_args, model=other)
    with pytest.raises(UserError, match=r"critic\.pt: a checkpoint of another architecture"):
        load_critic(path)
    save_checkpoint(path, kind="graspnet", model_args=critic.model_args, model=critic)
    with pytest.raises(UserError, match=r"critic\.pt: a checkpoint of kind 'graspnet'"):
        load_critic(path)


def test_logits_and_chances_agree_and_no_candidate_has_no_chance() -> None:
    critic, inputs = GraspCritic(), made_up(2, 0).inputs
    with torch.inference_mode():
        logits = critic(*map(torch.from_numpy, inputs)).numpy()
    np.testing.assert_allclose(critic.chance(inputs), 1 / (1 + np.exp(-logits)), rtol=1e-5)
    assert critic.chance(inputs.take(np.array([], int))).shape == (0,)


def test_the_shipped_critic_prefers_opposite_faces_and_a_free_hand() -> None:
    """Across the 4 cm of a box the fingers hold, at 45 degrees its edges slip; and where a second
    box stands under a finger, the hand has no room."""
    crowded = boxes_frame([
        ((0.04, 0.06, 0.05), 0.0, (0.5, 0.0)), ((0.04, 0.06, 0.05), 0.0, (0.545, 0.0)),
    ])  # fmt: skip
    chances = []
    for frame, angle in ((BOX, 0.0), (BOX, np.pi / 4), (crowded, 0.0)):
        alone = height_map_from_frame(BOX, Workspace())
        found = measure(candidates(angle), alone, GripperGeometry(), SearchSettings())
        found.opening[:] = 0.06
        heights = height_map_from_frame(frame, Workspace())
        inputs = critic_inputs(found, heights, np.ones(1), UPWARDS, 0.0)
        chances.append(float(shipped_critic().chance(inputs)[0]))
    assert chances[0] > 0.8
    assert chances[1] < chances[0]
    assert chances[2] < chances[0]


def test_the_ranking_of_a_fan_follows_the_critic() -> None:
    """A critic that likes level approaches and one that likes leaning ones rank accordingly; the
    search alone prefers the straight one."""

    class Fixed(GraspCritic):
        leaning = 0.0

        def chance(self, inputs: CriticInputs) -> np.ndarray:
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


@pytest.mark.parametrize(("chance", "leans"), [(0.98, False), (0.97, True)])
def test_other_sides_are_looked_at_where_no_grasp_from_above_is_likely(chance, leans) -> None:
    """From a chance of 0.975 on, the plan is the one from straight above, grasp by grasp."""

    class Fixed(GraspCritic):
        def chance(self, inputs: CriticInputs) -> np.ndarray:
            return np.full(len(inputs.facts), chance)

    parts = GripperGeometry(), Workspace()
    above = GraspNetPlanner(*parts, critic=Fixed())(BOX)
    planner = GraspNetFanPlanner(*parts, critic=Fixed())
    grasps = planner(BOX)
    planar = [grasp.pose for grasp in grasps if grasp.tilt == 0]
    np.testing.assert_array_equal(planar, [grasp.pose for grasp in above])
    assert (max(grasp.tilt for grasp in grasps) > np.deg2rad(25)) == leans
    assert grasps[0].tilt == 0, "of grasps that are as likely, the steep ones come first"
    alone = GraspNetFanPlanner(*parts, critic=Fixed(), likely=np.inf)(BOX)
    assert max(grasp.tilt for grasp in alone) > np.deg2rad(25)
    planner.return_at_least(33)
    assert (planner._above.settings.returned, planner.fan.returned) == (33, 40)


def test_how_likely_a_peak_has_to_be_is_the_users_to_say() -> None:
    """Under it the search is asked as well, also from straight above by the planner of a fan."""
    parts = GripperGeometry(), Workspace()
    above = GraspNetFanPlanner(*parts, likely=0.99)._above
    for likely, planner in ((0.975, GraspNetPlanner(*parts)), (0.99, above)):
        for chance in (likely - 0.001, likely):
            asked = []

            def judge(heights: HeightMap, found: Candidates, _, chance=chance, asked=asked):
                asked.append(found)
                return np.full(len(found), chance)

            planner.judge = judge
            planner(BOX)
            assert len(asked) == (2 if chance < likely else 1)


@pytest.mark.parametrize(
    ("of_peaks", "of_search", "asked_twice"),
    [(0.98, 0.99, False), (0.975, 0.99, False), (0.97, 0.99, True), (0.97, 0.5, True)],
)
def test_a_search_follows_where_no_peak_is_likely(of_peaks, of_search, asked_twice) -> None:
    """From a chance of 0.975 on, the plan is that of the peaks alone, grasp by grasp; below, those
    of the search are ranked with them."""
    parts = GripperGeometry(), Workspace()
    planner, peaks = GraspNetPlanner(*parts), GraspNetDirectPlanner(*parts)
    asked = []

    def judge(heights: HeightMap, found: Candidates, inputs: CriticInputs) -> np.ndarray:
        asked.append(found)
        return np.full(len(found), of_peaks if len(asked) == 1 else of_search)

    planner.judge, peaks.judge = judge, lambda _, found, __: np.full(len(found), of_peaks)
    grasps, alone = planner(BOX), peaks(BOX)
    assert len(asked) == 1 + asked_twice
    if not asked_twice:
        assert len(alone) > 1
        np.testing.assert_array_equal([g.pose for g in grasps], [g.pose for g in alone])
        return
    assert grasps[0].quality == max(of_peaks, of_search)
    by_quality = {of_peaks: asked[0], of_search: asked[1]}
    proposed = {q: found.grasps(planner.gripper) for q, found in by_quality.items()}
    for grasp in grasps:
        assert any(np.allclose(grasp.pose, one.pose) for one in proposed[grasp.quality])


def test_examples_are_grasps_at_peaks_and_of_the_search() -> None:
    """On the box the best peak is likely, and a plan is that of the peaks alone."""
    kinds = (GraspNetDirectPlanner, GraspNetPlanner)
    peaks, both = (
        critic_examples.judged_by(kind(GripperGeometry(), Workspace()), BOX)[2] for kind in kinds
    )
    poses = [grasp.pose for grasp in both]
    assert all(np.array([pose == one.pose for pose in poses]).all((1, 2)).any() for one in peaks)
    assert len(both) > len(peaks) > 0


def test_the_wrist_keeps_clear_of_what_stands_beside_a_grasp_from_above() -> None:
    """Within 3 cm of a box 5 cm high stands one that is 22 cm high. The wrist is 12 cm wide and
    begins 13 cm over the fingertips: no grasp from above is nearer than 6 cm to the high one."""
    low, high = ((0.05, 0.05, 0.05), 0.0, (0.5, 0.0)), ((0.2, 0.1, 0.22), 0.0, (0.5, 0.105))
    frame = boxes_frame([low, high])
    parts = GripperGeometry(), Workspace()
    nearest = [
        min(0.055 - grasp.position[1] for grasp in kind(*parts)(frame) if grasp.tilt < 1e-6)
        for kind in (GraspNetPlanner, GraspNetFanPlanner)
    ]
    assert nearest[0] < 0.057, "the planner from above knows no wrist"
    assert nearest[1] > 0.059


def test_who_ranks_by_the_shipped_critic_and_who_by_one_that_is_given() -> None:
    frame = boxes_frame([((0.05, 0.06, 0.05), 0.0, (0.5, 0.0))])

    class Fixed(GraspCritic):
        def chance(self, inputs: CriticInputs) -> np.ndarray:
            return np.full(len(inputs.facts), 0.123)

    parts = GripperGeometry(), Workspace()
    other = loaded(NETWORK)  # for weights of one's own, there is no critic
    assert GraspNetPlanner(*parts, network=other).judge is None
    for kind in (GraspNetPlanner, GraspNetDirectPlanner, GraspNetFanPlanner):
        preferred = [grasp for grasp in kind(*parts, critic=Fixed())(frame) if grasp.tilt < 1e-6]
        assert {round(grasp.quality, 6) for grasp in preferred} == {0.123}
    fan_alone = partial(GraspNetFanPlanner, likely=np.inf)
    for kind in (GraspNetPlanner, GraspNetDirectPlanner, fan_alone):
        planner = kind(*parts)
        inputs, _, _ = critic_examples.judged_by(kind(*parts), frame)
        stated, grasps = shipped_critic().chance(inputs), planner(frame)
        assert len(grasps) > 2 and (kind is fan_alone) == any(grasp.tilt > 0.1 for grasp in grasps)
        for grasp in grasps:
            assert np.abs(stated - grasp.quality).min() < 1e-6


@pytest.mark.parametrize("kind", [GraspNetPlanner, GraspNetDirectPlanner])
def test_the_ranking_of_a_planar_planner_follows_the_critic(kind) -> None:
    """One critic likes wide things, the other one narrow things."""
    wide, narrow = (0.5, -0.07), (0.5, 0.07)
    frame = boxes_frame([((0.05, 0.06, 0.05), 0.0, wide), ((0.03, 0.06, 0.05), 0.0, narrow)])

    def by_width(sign: int, heights: HeightMap, found: Candidates, inputs: CriticInputs):
        return np.where(sign * (column(inputs, "width") - 0.04) > 0, 0.9999, 0.0001)

    for sign, place in ((1, wide), (-1, narrow)):
        planner = kind(GripperGeometry(), Workspace())
        planner.judge = partial(by_width, sign)
        grasp = planner(frame)[0]
        assert np.linalg.norm(grasp.position[:2] - place) < 0.04
