"""Ranges against closed forms: distributions, operations, and what is refused."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from utils.config import ConfigError, load_config
from utils.config_types import Range, changed, draw


def spec(low, high, distribution="uniform", operation="add", every="episode") -> Range:
    return Range(low, high, distribution, operation, every)


@pytest.mark.parametrize(
    "range_, law",
    [
        (spec(-1.0, 3.0), stats.uniform(-1, 4)),
        (spec(0.5, 8.0, "log_uniform"), stats.loguniform(0.5, 8)),
        (spec(-1.0, 3.0, "normal"), stats.truncnorm(-2, 2, loc=1, scale=1)),
    ],
)
def test_distributions(range_, law):
    """Kolmogorov and Smirnov's distance of 4,000 draws is under 1.63 / sqrt(4000) in 99 of 100."""
    values = draw(range_, np.random.default_rng(0), 4000)
    assert stats.kstest(values, law.cdf).statistic < 1.63 / np.sqrt(4000)


@given(
    st.floats(1e-3, 10), st.floats(0, 10), st.sampled_from(["uniform", "log_uniform", "normal"]),
    st.integers(0, 99),
)  # fmt: skip
def test_draws_stay_in_range(low, width, distribution, seed):
    range_ = spec(low, low + width, distribution)
    value = draw(range_, np.random.default_rng(seed))
    assert isinstance(value, float) and low <= value <= low + width
    assert draw(range_, np.random.default_rng(seed)) == value


def test_operations():
    assert changed("scale", 3.0, 2.0) == 6 and changed("add", 3.0, 2.0) == 5
    assert changed("set", 3.0, 2.0) == 2


@pytest.mark.parametrize(
    "value, words",
    [
        ("2,1,uniform,add,episode", "must not be greater"),
        ("0,1,log_uniform,add,episode", "log_uniform needs low > 0"),
        ("0,1,uniform,scale,episode", "needs low > 0"),
        ("0,1,unifrom,add,episode", "uniform | log_uniform | normal"),
        ("0,1", "low, high"),
    ],
)
def test_wrong_ranges_are_refused(value, words):
    with pytest.raises(ConfigError, match=r"randomization.physics.gravity") as caught:
        load_config(None, [f"randomization.physics.gravity={value}"])
    assert words in str(caught.value)


def test_a_negative_latency_is_refused():
    with pytest.raises(ConfigError, match="must not be negative"):
        load_config(None, ["randomization.physics.latency=-1,1,uniform,set,episode"])
