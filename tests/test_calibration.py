"""Chances of success against hand computations, a peer's logistic regression and known chances."""

from __future__ import annotations

import json
from dataclasses import astuple, replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binom

from benchmarks.calibrate import grasps_of
from envs.evaluation_worker import check_everything, work
from envs.next_grasp import least_quality
from envs.rounds import run_round
from envs.simulators import make_cell
from models.graspnet_io import SHIPPED
from models.planner_candidates import with_chances
from models.planners import (
    PLANNERS,
    calibration_of,
    calibrations,
    make_planner,
    needs_truth,
    tilts,
)
from tests.helpers.box_frames import boxes_frame
from tests.helpers.cubes import cube_grasp, cube_scene
from utils.calibration import (
    LEAST_CHANCE,
    Calibration,
    calibration_error,
    draw_reliability,
    error_by_chance,
    load_calibrations,
    reliability,
    risk_coverage,
    unlikely_ones,
)
from utils.config import DEFAULTS, load_config
from utils.depth_correction import corrected
from utils.errors import UserError
from utils.evaluation import Task
from utils.geometry import GripperGeometry, Workspace
from utils.result_records import RoundRecord
from utils.runs import REPOSITORY
from utils.transforms import Grasp, RGBDFrame

CHANCES = st.lists(st.tuples(st.floats(0, 1), st.booleans()), min_size=1, max_size=60)


def test_the_error_is_the_mean_distance_of_the_bins() -> None:
    """By hand: 0.8 and 0.9 are bins 8 and 9. (2 |0.5 - 0.8| + 1 |1 - 0.95|) / 3."""
    chances, successes = [0.8, 0.8, 0.95], [True, False, True]
    assert calibration_error(chances, successes) == pytest.approx((2 * 0.3 + 0.05) / 3)
    assert calibration_error([0.81, 0.89], [True, False]) == pytest.approx(0.35)  # one bin, of 0.1
    bins = reliability(chances, successes)
    assert [one.count for one in bins] == [2, 1]
    np.testing.assert_allclose(bins, [(2, 0.8, 0.5), (1, 0.95, 1.0)])
    assert calibration_error([1.0, 0.0], [True, False]) == 0  # the ends belong to a bin


def test_few_grasps_leave_an_error_to_exact_chances() -> None:
    """Of N grasps with one chance p, the error is |successes / N - p|: by the binomial
    distribution its mean and its 95th percentile are known; of sure ones it is 0."""
    number, chance = 40, 0.9
    successes = np.arange(number + 1)
    weights = binom.pmf(successes, number, chance)
    distance = np.abs(successes / number - chance)
    mean, most = error_by_chance(np.full(number, chance))
    assert mean == pytest.approx((weights * distance).sum(), abs=0.002)
    assert weights[distance <= most + 1e-9].sum() >= 0.95
    assert weights[distance < most - 1e-9].sum() <= 0.95
    assert error_by_chance(np.ones(7)) == (0.0, 0.0)
    assert error_by_chance(np.full(4 * number, chance))[0] < mean


def test_risk_grows_with_the_grasps_that_are_tried() -> None:
    """The surest first: won, lost, won."""
    coverage, risk = risk_coverage([0.2, 0.9, 0.5], [True, True, False])
    np.testing.assert_allclose(coverage, [1 / 3, 2 / 3, 1])
    np.testing.assert_allclose(risk, [0, 1 / 2, 1 / 3])


@given(CHANCES)
def test_counts_add_up_and_the_error_is_a_share(grasps) -> None:
    chances, successes = zip(*grasps)
    assert sum(one.count for one in reliability(chances, successes)) == len(grasps)
    assert 0 <= calibration_error(chances, successes) <= 1
    coverage, risk = risk_coverage(chances, successes)
    assert coverage[-1] == 1 and risk[-1] == pytest.approx(1 - np.mean(successes))


def test_a_fit_finds_the_chances_that_the_grasps_were_drawn_with() -> None:
    rng = np.random.default_rng(0)
    scores, truth = rng.uniform(0.05, 1.2, 20_000), Calibration(1.5, 2.0)
    successes = rng.uniform(size=len(scores)) < truth(scores)
    fitted = Calibration.fit(scores, successes, bounded=False)
    assert fitted.slope == pytest.approx(1.5, abs=0.08)
    assert fitted.offset == pytest.approx(2.0, abs=0.08)


def test_a_fit_is_torchs_logistic_regression_with_platts_targets() -> None:
    scores = np.array([0.1, 0.2, 0.4, 0.5, 0.7, 0.9])
    successes = np.array([False, True, False, True, True, True])
    target = torch.tensor([1 / 4, 5 / 6, 1 / 4, 5 / 6, 5 / 6, 5 / 6], dtype=torch.float64)
    line = torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64, requires_grad=True)
    s = torch.tensor(scores)
    x = torch.stack([s.log(), -(1 - s).log()])
    optimizer = torch.optim.LBFGS([line], max_iter=200, tolerance_grad=1e-12)

    def loss() -> torch.Tensor:
        optimizer.zero_grad()
        logits = line[:2] @ x + line[2]
        value = torch.nn.functional.binary_cross_entropy_with_logits(logits, target)
        value = value + ((line[:2] / 10) ** 2).sum() / 2 / len(scores)
        value.backward()
        return value

    optimizer.step(loss)
    fitted = Calibration.fit(scores, successes)
    np.testing.assert_allclose(
        [fitted.slope, fitted.upper, fitted.offset], line.detach().numpy(), rtol=1e-3, atol=1e-3
    )


def test_scores_that_are_chances_stay_what_they_are() -> None:
    """Beta calibration holds the identity, which Platt's line in log(score) does not."""
    same = Calibration(slope=1.0, offset=0.0, upper=1.0)
    scores = np.array([0.001, 0.1, 0.5, 0.9, 0.99])
    np.testing.assert_allclose(same(scores), scores)
    # By hand: 2 ln(0.8) - 0.5 ln(0.2) + 0.3 = 0.6584, whose logistic is 0.6589.
    assert Calibration(2.0, 0.3, upper=0.5)(0.8) == pytest.approx(0.6589, abs=1e-4)
    rng = np.random.default_rng(0)
    drawn = rng.beta(4, 0.6, 40_000)
    fitted = Calibration.fit(drawn, rng.uniform(size=len(drawn)) < drawn)
    np.testing.assert_allclose(fitted(scores[1:]), scores[1:], atol=0.02)


def test_a_score_of_one_that_comes_back_from_its_chance_is_still_bounded() -> None:
    """By rounding it may come back as a little more, which has to change no fit."""
    rng, stated = np.random.default_rng(3), Calibration(1.57, -0.53, upper=1.07)
    scores = np.append(rng.beta(4, 0.6, 2000), 1.0)
    successes = rng.uniform(size=len(scores)) < scores
    back = stated.scores(stated(scores))
    first, again = Calibration.fit(scores, successes), Calibration.fit(back, successes)
    assert again.upper == pytest.approx(first.upper, rel=0.01) and first.upper > 0.5


def test_scores_that_may_exceed_one_have_platts_line_in_every_sample() -> None:
    """Also where, by chance, none of a sample's scores exceeds 1."""
    scores, successes = [0.2, 0.5, 0.8, 0.9], [False, True, True, True]
    assert Calibration.fit(scores, successes, bounded=False).upper == 0
    assert Calibration.fit([*scores, 1.1], [*successes, True], bounded=False).upper == 0


@pytest.mark.parametrize(
    ("scores", "message"),
    [([], "at least one grasp"), ([0.5, np.nan], "finite"), ([0.5, 1.1], "score is 1.1.*bounded")],
)
def test_what_no_chances_can_be_fitted_to_is_refused(scores, message) -> None:
    with pytest.raises(ValueError, match=message):
        Calibration.fit(scores, [True] * len(scores))


@pytest.mark.parametrize("upper", [0.0, 1.0])
def test_no_chance_has_no_score(upper) -> None:
    assert np.isnan(Calibration(1.0, 0.0, upper=upper).scores([np.nan, 0.5])).tolist() == [1, 0]


def test_a_fit_finds_what_rough_depth_costs() -> None:
    rng = np.random.default_rng(0)
    scores, truth = rng.uniform(0.05, 1.2, 40_000), Calibration(1.5, 2.0, 400.0)
    rough = rng.choice([0.0, 0.0025], len(scores))
    success = rng.uniform(size=len(scores)) < truth(scores, rough)
    fitted = Calibration.fit(scores, success, rough, bounded=False)
    assert fitted.slope == pytest.approx(1.5, abs=0.08)
    assert fitted.offset == pytest.approx(2.0, abs=0.08)
    assert fitted.penalty == pytest.approx(400, abs=25)
    # By hand: ln(0.5) * 1.5 + 2 - 400 * 0.0025 = -0.0397, whose logistic is 0.4901.
    assert truth(0.5, 0.0025) == pytest.approx(0.4901, abs=1e-4)
    assert truth(0.5) > truth(0.5, 0.0025)
    np.testing.assert_allclose(truth.scores(truth(scores, rough), rough), scores)


def test_few_grasps_do_not_make_a_rough_frame_hopeless() -> None:
    fitted = Calibration.fit([0.5, 0.5, 0.5], [True, True, False], [0.0, 0.0, 1e-4])
    assert 0 < fitted.penalty < 5000  # per metre: half a unit of log odds for 0.1 mm at most
    with pytest.raises(ValueError, match="roughness"):
        Calibration.fit([0.5], [True], [np.nan])


def test_no_fit_states_that_noise_helps() -> None:
    rough = np.repeat([0.0, 0.003], 100)
    fitted = Calibration.fit(np.full(200, 0.5), np.arange(200) % 10 < 6 + 3 * (rough > 0), rough)
    assert fitted.penalty == 0


def test_a_fit_finds_how_much_a_failure_before_tells() -> None:
    rng = np.random.default_rng(0)
    scores, truth = rng.uniform(0.05, 1.2, 40_000), Calibration(1.5, 2.0, 0.0, 1.8)
    failed = rng.uniform(size=len(scores)) < 0.3
    success = rng.uniform(size=len(scores)) < truth(scores, 0.0, failed)
    fitted = Calibration.fit(scores, success, 0.0, failed, bounded=False)
    assert fitted.slope == pytest.approx(1.5, abs=0.08)
    assert fitted.offset == pytest.approx(2.0, abs=0.08)
    assert fitted.doubt == pytest.approx(1.8, abs=0.1)
    # By hand: odds of 9 to 1 fall by exp(1.8) = 6.05, to 1.488.
    assert truth.after_failure(0.9) == pytest.approx(1.488 / 2.488, abs=1e-3)
    assert truth.after_failure(float(truth(0.5))) == pytest.approx(float(truth(0.5, 0.0, True)))
    np.testing.assert_allclose(truth.scores(truth(scores, 0.0, failed), 0.0, failed), scores)


def test_few_failures_make_no_certainty_and_none_helps() -> None:
    """Five grasps that all failed after a failure: without a prior, the doubt grows by the end of
    Platt's targets to 6.2; and where grasps succeed more often after one, there is no doubt."""
    failed = np.arange(205) >= 200
    fitted = Calibration.fit(np.full(205, 0.9), ~failed & (np.arange(205) % 20 > 0), 0.0, failed)
    assert 1 < fitted.doubt < 4.5
    fitted = Calibration.fit(np.full(205, 0.9), failed | (np.arange(205) % 2 > 0), 0.0, failed)
    assert fitted.doubt == 0


@pytest.mark.parametrize("upper", [0.0, 0.8])
def test_a_share_of_a_score_has_its_own_chance_at_any_roughness(upper) -> None:
    line = Calibration(1.5, 2.0, 400.0, upper=upper)
    for rough in (0.0, 0.002):
        chance = float(line(0.8, rough))
        assert line.of_share(chance, 0.25, rough) == pytest.approx(float(line(0.2, rough)))


@given(
    st.floats(0.01, 5), st.floats(-5, 5), st.sampled_from([0.0, 0.3, 2.0]),
    st.floats(0.05, 3), st.floats(0.05, 3),
)  # fmt: skip
def test_chances_keep_the_order_of_scores_and_lead_back_to_them(
    slope, offset, upper, one, other
) -> None:
    calibration = Calibration(slope, offset, upper=upper)
    chances = calibration([one, other])
    assert ((chances > 0) & (chances < 1)).all()
    assert (chances[0] - chances[1]) * (one - other) >= 0
    if slope > 0.1 and abs(offset) + slope < 6:
        np.testing.assert_allclose(calibration.scores(chances), [one, other], rtol=1e-6)


def test_scores_that_say_nothing_keep_their_order() -> None:
    fitted = Calibration.fit([0.1, 0.5, 0.9, 0.95], [True, True, False, False])
    assert fitted.slope == pytest.approx(0.01) and np.diff(fitted([0.1, 0.5, 0.9])).min() > 0


def test_one_failure_of_a_lower_score_makes_no_step_of_the_line() -> None:
    """Grasps that are drawn at random have scores that say nothing; nearly all are the best."""
    scores, successes = np.full(380, 1.0), np.arange(380) % 4 == 0
    scores[:3], successes[:3] = 0.95, False
    assert Calibration.fit(scores, successes).slope < 20


@pytest.mark.parametrize("name", calibrations())
@pytest.mark.parametrize("roughness", [0.0, 0.0025])
def test_every_shipped_fit_leads_back_to_its_scores(name, roughness) -> None:
    scores = np.array([0.05, 0.2, 0.5, 0.9, 1.0, 1.2])
    for failed in (False, True):
        chances = calibrations()[name](scores, roughness, failed)
        back = calibrations()[name].scores(chances, roughness, failed)
        np.testing.assert_allclose(back, scores, rtol=1e-4)


def test_where_every_grasp_succeeded_the_chance_is_laplaces() -> None:
    """(N + 1) / (N + 2), whatever the score."""
    fitted = Calibration.fit(np.linspace(0.1, 1.0, 98), np.ones(98, bool))
    np.testing.assert_allclose(fitted([0.1, 0.5, 1.0]), 99 / 100, atol=2e-3)


def test_a_planner_whose_chances_are_missing_says_so(monkeypatch) -> None:
    monkeypatch.setattr("models.planners.calibrations", dict)
    with pytest.warns(UserWarning, match="holds no chances of heuristic: its qualities are scores"):
        heuristic = make_planner("heuristic", GripperGeometry(), Workspace(), 0)
    assert heuristic.calibration is None
    make_planner("random", GripperGeometry(), Workspace(), 0)  # states none


def test_planners_state_chances_in_the_order_of_their_scores() -> None:
    frame = boxes_frame([((0.05, 0.05, 0.05), 0.4, (0.47, 0.03))])
    gripper, workspace = GripperGeometry(), Workspace()
    assert {*calibrations()} == {*PLANNERS} - {"random"}
    for name in calibrations():
        stated = make_planner(name, gripper, workspace, 0)(frame)
        scored = PLANNERS[name](gripper, workspace, 0)(frame)
        qualities = [grasp.quality for grasp in stated]
        assert min(qualities) > 0 and max(qualities) < 1
        if not tilts(PLANNERS[name]):  # whose order prefers steep approaches
            assert qualities == sorted(qualities, reverse=True)
        calibration = calibrations()[name]
        np.testing.assert_allclose(qualities, calibration([grasp.quality for grasp in scored]))
        np.testing.assert_array_equal(
            [grasp.position for grasp in stated], [grasp.position for grasp in scored]
        )
    for other in ("random", str(SHIPPED)):
        assert calibration_of(make_planner(other, gripper, workspace, 0)) is None


@pytest.mark.parametrize(
    "name", [name for name in calibrations() if not needs_truth(PLANNERS[name])]
)
def test_planners_are_less_sure_of_rough_depth(name) -> None:
    frame, rng = boxes_frame([((0.05, 0.05, 0.05), 0.4, (0.47, 0.03))]), np.random.default_rng(0)
    noise = rng.normal(0, 0.002, frame.depth.shape).astype(np.float32)
    frame = replace(frame, depth=frame.depth + noise)
    gripper, workspace, line = GripperGeometry(), Workspace(), Calibration(1.0, 2.0, 300.0)
    planner = PLANNERS[name](gripper, workspace, 0)
    scores = [grasp.quality for grasp in planner(frame)]
    planner.calibration = line
    stated = [grasp.quality for grasp in planner(frame)]
    rough = corrected(frame, workspace.table_height).roughness
    assert scores and rough == pytest.approx(0.002, rel=0.1)
    np.testing.assert_allclose(stated, line(scores, rough))


def test_a_round_records_how_rough_the_depth_was(bullet_cell, box_set, monkeypatch) -> None:
    look, rng = bullet_cell.frame, np.random.default_rng(0)

    def rough(with_truth: bool = False) -> RGBDFrame:
        frame = look(with_truth)
        noise = rng.normal(0, 0.004, frame.depth.shape).astype(np.float32)
        return replace(frame, depth=frame.depth + noise)

    def recorded(privileged: bool) -> float:
        class Plan:
            needs_truth = privileged

            def __call__(self, frame: RGBDFrame) -> list[Grasp]:
                return [cube_grasp()]

        scene, settings = cube_scene(box_set), {"policy": "x", "objects": "box", "max_failures": 1}
        return run_round(bullet_cell, scene, Plan(), **settings).attempts[0].roughness

    assert recorded(privileged=False) < 1e-5
    monkeypatch.setattr(bullet_cell, "frame", rough)
    assert recorded(privileged=False) == pytest.approx(0.004, rel=0.1)
    assert recorded(privileged=True) == 0


def test_grasps_of_less_quality_are_not_tried(bullet_cell, box_set) -> None:
    """Two grasps, neither of which closes on the cube; the surer one is tried twice."""
    grasps = [
        replace(cube_grasp(offset=(x, 0, 0)), quality=quality)
        for x, quality in ((0.13, 0.6), (-0.13, 0.4))
    ]
    settings = {"policy": "x", "objects": "box", "max_failures": 2}
    tried = []

    def play(abstain: float) -> RoundRecord:
        tried.clear()
        return run_round(
            bullet_cell, cube_scene(box_set), lambda frame: list(grasps), **settings,
            abstain=abstain,
            on_attempt=lambda frame, grasp, outcome: tried.append(grasp.quality),
        )  # fmt: skip

    assert play(0.4).ended == "failures" and tried == [0.6, 0.4]
    assert play(0.5).ended == "failures" and tried == [0.6, 0.6]
    none = play(0.7)
    assert none.ended == "no_plan" and tried == []
    assert none.attempts[0].detail == "abstained: the best quality is 0.6, under 0.7"


class Aside:
    """Always the same grasp, which closes beside the cube."""

    calibration = Calibration(1.0, 0.0, 0.0, 2.0)
    grasp = replace(cube_grasp(offset=(0.13, 0, 0)), quality=0.9)

    def __call__(self, frame: RGBDFrame) -> list[Grasp]:
        return [self.grasp]


def test_a_planner_is_less_sure_after_a_failure(bullet_cell, box_set) -> None:
    """By its calibration, in the record as in what is tried."""
    settings = {"policy": "x", "objects": "box", "max_failures": 3}
    record = run_round(bullet_cell, cube_scene(box_set), Aside(), **settings)
    stated = [attempt.grasp.quality for attempt in record.attempts]
    low = 1.218 / 2.218  # odds of 9 fall by exp(2), to 1.218
    np.testing.assert_allclose(stated, [0.9, low, low], atol=1e-3)
    assert record.calibration == (1.0, 0.0, 0.0, 2.0, 0.0)
    np.testing.assert_allclose(grasps_of([record]).scores, 9.0)  # odds, of slope 1 and offset 0
    assert grasps_of([record]).failed.tolist() == [False, True, True]
    sure = run_round(bullet_cell, cube_scene(box_set), Aside(), **settings, abstain=0.6)
    assert sure.ended == "no_plan" and sure.executed == 1
    assert sure.attempts[1].detail == "abstained: the best quality is 0.5491, under 0.6"


def test_a_floating_hand_leaves_an_arm_s_doubt(box_set) -> None:
    config = load_config(None, ["sim.renderer=tiny", "robot.arm=none"])
    with make_cell(config) as cell:
        record = run_round(
            cell, cube_scene(box_set), Aside(), policy="x", objects="box", max_failures=2
        )
    stated = [attempt.grasp.quality for attempt in record.attempts]
    np.testing.assert_allclose(stated, [0.9, 0.9])
    assert record.calibration == (1.0, 0.0, 0.0, 0.0, 0.0)


def test_a_doubt_leaves_the_order_of_grasps(bullet_cell, box_set) -> None:
    """What is likely as planned comes first elsewhere, though it is unlikely after a failure."""

    class Plan(Aside):
        near, far = (
            replace(cube_grasp(offset=(x, 0, 0)), quality=quality)
            for x, quality in ((-0.13, 0.95), (0.13, 0.8))
        )

        def __call__(self, frame: RGBDFrame) -> list[Grasp]:
            return [self.near, self.far]

    settings = {"policy": "x", "objects": "box", "max_failures": 2}
    record = run_round(bullet_cell, cube_scene(box_set), Plan(), **settings)
    # Odds of 4 fall by exp(2), to 0.541.
    stated = [attempt.grasp.quality for attempt in record.attempts]
    np.testing.assert_allclose(stated, [0.95, 0.541 / 1.541], atol=1e-3)


def test_grasps_that_rather_fail_are_left_to_whoever_asks_for_them() -> None:
    """By planners that state chances; a score of 0.05 may be a planner's best."""
    gripper, workspace = GripperGeometry(), Workspace()
    stated, scored = (
        make_planner(name, gripper, workspace, 0) for name in ("heuristic", str(SHIPPED))
    )
    asked = [least_quality(stated, abstain, has_arm=True) for abstain in (None, 0.0, 0.7)]
    assert asked == [LEAST_CHANCE, 0.0, 0.7]
    assert least_quality(scored, None, has_arm=True) == 0.0
    assert least_quality(stated, None, has_arm=False) == 0.0
    assert load_config(DEFAULTS).evaluate.abstain is None


@pytest.mark.parametrize(
    ("planner", "settings", "tried"),
    [
        ("chance", [], False),
        ("chance", ["evaluate.abstain=0"], True),
        ("chance", ["robot.arm=none"], True),
        ("score", [], True),
    ],
)
@pytest.mark.usefixtures("kept_here")
def test_the_evaluation_does_not_try_what_rather_fails(planner, settings, tried) -> None:
    config = load_config(None, settings)
    name = f"tests.helpers.unlikely:{planner}"
    policies = ((name, "open_loop", "none"),)
    (record,) = work(config, Task("box", "isolated", 0, policies)).rounds
    assert record.attempts[0].executed == tried


@pytest.mark.parametrize("policy", [str(SHIPPED), "ppo"], ids=["graspnet", "ppo"])
def test_what_states_no_chances_cannot_abstain(policy) -> None:
    words = [f"evaluate.policies=[{policy}]", "evaluate.abstain=0.5", "evaluate.scenarios=isolated"]
    with pytest.raises(UserError, match="evaluate.abstain: .* states no chances of success"):
        check_everything(load_config(DEFAULTS, words))


def test_random_states_no_chances_whatever_a_file_says(monkeypatch) -> None:
    monkeypatch.setattr("models.planners.calibrations", lambda: {"random": Calibration(1.0, 0.0)})
    assert calibration_of(make_planner("random", GripperGeometry(), Workspace(), 0)) is None


def test_grasps_that_rather_fail_are_told_of() -> None:
    likely, as_likely, no, never = (
        replace(cube_grasp(), quality=chance) for chance in (0.9, 0.5, 0.4, 0.1)
    )
    assert unlikely_ones([likely, as_likely]) == unlikely_ones([]) == []
    (remark,) = unlikely_ones([likely, no, never])
    assert remark.startswith("2 of the 3 grasps have a chance under 0.5, more likely to fail")
    (remark,) = unlikely_ones([likely, no])
    assert remark.startswith("1 of the 2 grasps has a chance under 0.5")


def test_the_diagram_has_a_line_for_each_name() -> None:
    figure = draw_reliability({"a": ([0.8, 0.9], [True, False]), "b": ([0.5, 0.6], [True, True])})
    diagram, risks = figure.axes
    assert [text.get_text() for text in diagram.get_legend().get_texts()] == [
        "a: error 0.550", "b: error 0.450",
    ]  # fmt: skip
    assert len(risks.lines) == 2


@pytest.mark.parametrize("text, message", [
    (None, "does not exist, .* by git checkout checkpoints, .* by python -m benchmarks.calibrate"),
    ('{"planners": {"my:P": {"offset": 1}}}', "no chances of success by planner: .*slope"),
    ('{"planners": {"my:P": null}}', "holds no chances of success"),
    ('{"planners": ["my:P"]}', "holds no chances of success"),
    ("{", "holds no chances of success"),
    ('{"planner": {}}', "holds no chances of success"),
    ('{"planners": {"my:P": {"slope": "1", "offset": 0}}}', "slope is '1', expected a finite"),
    ('{"planners": {"my:P": {"slope": -1, "offset": 0}}}', "slope is -1, .* of 0 or more"),
    ('{"planners": {"my:P": {"slope": 1, "offset": NaN}}}', "offset is nan"),
])  # fmt: skip
def test_chances_that_cannot_be_read_are_no_scores(text, message, tmp_path):
    file = tmp_path / "fits.json"
    if text is not None:
        file.write_text(text)
    with pytest.raises(UserError, match=message):
        load_calibrations(file)


def rows_of(page: str, heading: str) -> list[list[str]]:
    """The cells of the page's table with this first line, without its heading."""
    lines = page[page.index(heading) :].split("\n\n")[0].splitlines()
    return [[cell.strip(" `") for cell in line.strip("| ").split("|")] for line in lines[2:]]


def test_the_page_states_the_chances_of_the_shipped_fits() -> None:
    fits = calibrations()
    page = (REPOSITORY / "docs/calibration.md").read_text(encoding="utf-8")
    heading = "| score | 0.99 | 0.9 | 0.5 | 0.3 |"
    scores, rows = (0.99, 0.9, 0.5, 0.3), rows_of(page, heading)
    assert len(rows) == 4
    for (name, *stated), (_, *after) in zip(rows[::2], rows[1::2]):
        fit = fits[name.removeprefix("chance of `")]
        for failed, told in ((False, stated), (True, after)):
            assert told == [f"{100 * fit(score, failed=failed):.0f} %" for score in scores]
    for name, *_, least, after in rows_of(page, "| planner | left out |")[:3]:
        limits = fits[name].scores([LEAST_CHANCE, LEAST_CHANCE], failed=[False, True])
        assert [least, after] == [f"{limit:.2f}" for limit in limits]


def test_all_five_numbers_of_a_calibration_are_read(tmp_path):
    file = tmp_path / "fits.json"
    fits = {"a": {"slope": 2.0, "offset": 0.3, "penalty": 40.0, "doubt": 0.7, "upper": 0.5}}
    fits["old"] = {"slope": 1.5, "offset": -0.5}
    file.write_text(json.dumps({"planners": fits}))
    found = load_calibrations(file)
    assert astuple(found["a"]) == (2.0, 0.3, 40.0, 0.7, 0.5)
    assert astuple(found["old"]) == (1.5, -0.5, 0.0, 0.0, 0.0)
    logit = 2 * np.log(0.8) - 0.5 * np.log(1 - 0.8) + 0.3  # clean, and after no failure
    assert found["a"](0.8) == pytest.approx(1 / (1 + np.exp(-logit)), abs=1e-6)


def test_a_chance_of_1_belongs_to_the_last_bin():
    """Two failures at 1 and 0.8 in bins of their own: (1 + 0.8) / 2; a bin of 1 and 0.95 has one
    success, and its mean chance is 0.475 too high."""
    assert calibration_error([1.0, 0.8], [False, False]) == pytest.approx(0.9)
    assert calibration_error([1.0, 0.95], [True, False]) == pytest.approx(0.475)


def test_chances_of_grasps_know_how_rough_the_frame_was():
    grasp = Grasp(np.zeros(3), 0.0, 0.04, 0.8)
    for roughness in (0.0, 0.002):
        (found,) = with_chances([grasp], Calibration(1.0, 0.0, penalty=500.0), roughness)
        odds = 0.8 * np.exp(-500 * roughness)  # log odds are log score minus penalty
        assert found.quality == pytest.approx(odds / (1 + odds), abs=1e-6)
