"""Intervals against published tables, SciPy, and closed forms."""

import numpy as np
import pytest
from scipy.stats import binomtest

from utils.statistics import (
    clustered_interval,
    counts_by_group,
    mean_maximum_rank_violation,
    paired_difference_interval,
    pearson_correlation,
    wilson_interval,
)


@pytest.mark.parametrize(
    ("successes", "n", "low", "high"),
    [  # Newcombe, Statistics in Medicine 17 (1998), table I, method 3 (score, no correction)
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0000, 0.1611),
        (1, 29, 0.0061, 0.1718),
    ],
)
def test_wilson_published(successes, n, low, high):
    assert wilson_interval(successes, n) == pytest.approx((low, high), abs=5e-5)


@pytest.mark.parametrize(("successes", "n"), [(0, 1), (1, 1), (3, 7), (50, 100), (999, 1000)])
def test_wilson_is_scipy_s(successes, n):
    interval = binomtest(successes, n).proportion_ci(0.95, method="wilson")
    expected = (interval.low, interval.high)
    assert wilson_interval(successes, n) == pytest.approx(expected, abs=1e-12)


def test_wilson_edges():
    assert wilson_interval(0, 0) == (0.0, 1.0)
    assert wilson_interval(0, 9)[0] == 0.0 and wilson_interval(9, 9)[1] == 1.0
    for bad in [(-1, 3), (4, 3), (1, 0)]:
        with pytest.raises(ValueError, match="successes"):
            wilson_interval(*bad)


def test_clustered_interval_by_hand():
    """Four rounds of five that are all or nothing: as much as four trials tell, of which two
    succeeded. Off the rate by 2.5 each: 4/3 * 4 * 6.25 over 20 * 0.25 is an effect of 20/3, so
    three trials."""
    rounds = [(5, 5), (0, 5), (5, 5), (0, 5)]
    z2 = 3.841459
    spread = np.sqrt(z2 * (0.25 / 3 + z2 / 36)) / (1 + z2 / 3)
    assert clustered_interval(rounds) == pytest.approx((0.5 - spread, 0.5 + spread), abs=1e-6)


def test_clustered_interval_is_wilsons_where_rounds_do_not_matter():
    alike = [(4, 5)] * 8  # less spread than chance has
    assert clustered_interval(alike) == pytest.approx(wilson_interval(32, 40))
    assert clustered_interval([(3, 5)]) == pytest.approx(wilson_interval(3, 5))  # one round alone
    assert clustered_interval([(5, 5), (3, 3)]) == pytest.approx(wilson_interval(8, 8))
    assert clustered_interval([(0, 5), (0, 0)])[0] == 0.0
    assert clustered_interval([(0, 0)]) == (0.0, 1.0)
    with pytest.raises(ValueError, match="more successes"):
        clustered_interval([(2, 1)])


def test_trials_are_counted_by_group():
    groups, right = ["cup", "pan", "cup", "pan", "pot"], [True, False, False, True, True]
    assert counts_by_group(groups, right) == [(1, 2), (1, 2), (1, 1)]
    with pytest.raises(ValueError, match="shorter"):
        counts_by_group(groups, right[:4])


def test_clustered_interval_holds_the_truth_where_rounds_end_early():
    """30 rounds of 15 objects that end at the second failure in a row: 95 of 100 intervals hold the
    true share, and Wilson's, of objects as if they were independent, far fewer."""
    rng = np.random.default_rng(0)

    def a_round(objects=15, chance=0.75):
        cleared = failed = 0
        while cleared < objects and failed < 2:
            good = rng.random() < chance
            cleared, failed = cleared + good, 0 if good else failed + 1
        return cleared, objects

    truth = np.mean([a_round()[0] for _ in range(20_000)]) / 15
    hits = {"clustered": 0, "wilson": 0}
    for _ in range(400):
        rounds = [a_round() for _ in range(30)]
        low, high = clustered_interval(rounds)
        hits["clustered"] += low <= truth <= high
        low, high = wilson_interval(*np.sum(rounds, axis=0).tolist())
        hits["wilson"] += low <= truth <= high
    assert 0.92 * 400 <= hits["clustered"] <= 0.99 * 400
    assert hits["wilson"] < 0.75 * 400


def test_paired_binary_approaches_the_normal_interval():
    # 400 pairs: 80 times only a succeeds, 40 times only b. The difference is 0.1 and its standard
    # error sqrt((80 + 40 - 40^2 / 400) / 400^2) = sqrt(116) / 400 = 0.026926 (closed form).
    a = np.repeat([1, 1, 0, 0], [200, 80, 40, 80])
    b = np.repeat([1, 0, 1, 0], [200, 80, 40, 80])
    result = paired_difference_interval(a, b)
    assert result.value == pytest.approx(0.1)
    assert result.low == pytest.approx(0.1 - 1.96 * 0.026926, abs=0.004)
    assert result.high == pytest.approx(0.1 + 1.96 * 0.026926, abs=0.004)
    assert result.rounds == 400


def test_paired_ratio_of_sums_by_hand():
    # a: 1/1 and 1/3 give 2/4, not the mean of rates 2/3; b: 1/2 and 0/2 give 1/4.
    a, b = [(1, 1), (1, 3)], [(1, 2), (0, 2)]
    result = paired_difference_interval(a, b)
    assert result.value == pytest.approx(2 / 4 - 1 / 4)
    # Only three resamples exist: twice the first (1 - 1/2), twice the second (1/3 - 0), both.
    assert result.low == pytest.approx(0.25)
    assert result.high == pytest.approx(0.5)


def test_a_bootstrap_draws_the_same_in_blocks(monkeypatch):
    rng = np.random.default_rng(3)
    tried = rng.integers(1, 9, 37)
    a, b = (np.stack([rng.binomial(tried, 0.7), tried], axis=1) for _ in range(2))
    whole = paired_difference_interval(a, b, seed=5)
    monkeypatch.setattr("utils.statistics._MOST_DRAWS", 37 * 999)
    assert paired_difference_interval(a, b, seed=5) == whole
    # All at once, as numpy has it.
    draws = np.random.default_rng(5).multinomial(37, np.full(37, 1 / 37), size=10_000)
    rates = [(draws @ side)[:, 0] / (draws @ side)[:, 1] for side in (a, b)]
    assert (whole.low, whole.high) == tuple(np.quantile(rates[0] - rates[1], [0.025, 0.975]))


def test_pairing_cancels_the_scene():
    # The same outcomes for both: no difference in any resample, however hard the scenes vary.
    a = np.random.default_rng(1).integers(0, 2, 50)
    result = paired_difference_interval(a, a)
    assert (result.value, result.low, result.high) == (0.0, 0.0, 0.0)
    unpaired = paired_difference_interval(a, np.roll(a, 1))
    assert unpaired.high - unpaired.low > 0.2


def test_paired_is_seeded_and_antisymmetric():
    a, b = [(1, 2), (2, 2), (0, 1), (3, 4)], [(0, 1), (2, 3), (1, 1), (1, 1)]
    assert paired_difference_interval(a, b) == paired_difference_interval(a, b)
    forward, back = paired_difference_interval(a, b), paired_difference_interval(b, a)
    assert (forward.low, forward.high) == pytest.approx((-back.high, -back.low))


def test_paired_undefined_and_bad_input():
    assert paired_difference_interval(np.zeros((0, 2)), np.zeros((0, 2))) is None
    assert paired_difference_interval([(0, 0)], [(1, 1)]) is None
    with pytest.raises(ValueError, match="rounds"):
        paired_difference_interval([1, 0], [1])
    with pytest.raises(ValueError, match="more successes"):
        paired_difference_interval([(2, 1)], [(1, 1)])
    with pytest.raises(ValueError, match="shape"):
        paired_difference_interval(np.zeros((2, 3)), np.zeros((2, 3)))


def test_resamples_without_an_attempt_are_left_out():
    result = paired_difference_interval([(0, 0), (1, 1)], [(0, 1), (1, 1)])
    assert np.isfinite([result.low, result.high]).all()


def test_pearson_by_hand():
    # Deviations (-1, 0, 1) and (-1, 1, 0): 1 / 2.
    assert pearson_correlation([1, 2, 3], [1, 3, 2]) == pytest.approx(0.5)
    assert pearson_correlation([0.2, 0.4, 0.9], [0.1, 0.2, 0.45]) == pytest.approx(1.0)
    assert pearson_correlation([1, 2], [5, 3]) == pytest.approx(-1.0)


def test_pearson_agrees_with_numpy():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 30))
    assert pearson_correlation(a, b) == pytest.approx(np.corrcoef(a, b)[0, 1])


def test_pearson_is_undefined_without_change():
    assert pearson_correlation([0.5], [0.5]) is None
    assert pearson_correlation([0.5, 0.5], [0.1, 0.9]) is None


def test_rank_violation_by_hand():
    # Real 0.2 < 0.5 < 0.9; the simulation swaps the first two: each of them is violated by 0.3,
    # the third by nothing.
    real = [0.2, 0.5, 0.9]
    assert mean_maximum_rank_violation(real, [0.5, 0.2, 0.9]) == pytest.approx(0.6 / 3)
    # All turned round: 0.7, 0.4 (with the third) and 0.7.
    assert mean_maximum_rank_violation(real, [0.9, 0.5, 0.2]) == pytest.approx(1.8 / 3)
    assert mean_maximum_rank_violation(real, [0.01, 0.02, 0.03]) == 0.0


def test_rank_violation_of_ties():
    """Equal in the simulation, but really 0.4 apart: the lower one's rank is not predicted."""
    assert mean_maximum_rank_violation([0.3, 0.7], [0.5, 0.5]) == pytest.approx(0.4 / 2)
    assert mean_maximum_rank_violation([0.3, 0.3], [0.5, 0.5]) == 0.0


def test_lists_that_do_not_pair_up_are_refused():
    for measure in (pearson_correlation, mean_maximum_rank_violation):
        with pytest.raises(ValueError, match="one length"):
            measure([0.1, 0.2], [0.1])
