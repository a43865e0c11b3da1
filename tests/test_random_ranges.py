"""Ranges against closed forms, and textures."""

import json

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from utils.config import ConfigError, UserError, load_config
from utils.config_types import Range
from utils.random_ranges import changed, draw
from utils.random_view import TextureRandomizer


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
def test_wrong_ranges_are_told(value, words):
    with pytest.raises(ConfigError, match=r"randomization.physics.gravity") as caught:
        load_config(None, [f"randomization.physics.gravity={value}"])
    assert words in str(caught.value)


def test_a_negative_latency_is_refused():
    with pytest.raises(ConfigError, match="must not be negative"):
        load_config(None, ["randomization.physics.latency=-1,1,uniform,set,episode"])


# --- Textures ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pictures")
    halves = np.zeros((32, 64, 3), np.uint8)
    halves[:, 32:] = 200, 100, 50  # BGR
    cv2.imwrite(str(folder / "halves.png"), halves)
    return folder


def test_textures_come_back_from_json_and_stick_to_the_object(pictures):
    randomizer, rng = TextureRandomizer(pictures), np.random.default_rng(1)
    points = rng.uniform(-0.1, 0.1, (500, 3))
    kinds = set()
    for _ in range(30):
        description = randomizer.draw(rng)
        kinds.add(description["kind"])
        factors = randomizer.make(description).factor(points)
        again = TextureRandomizer().make(json.loads(json.dumps(description))).factor(points)
        assert factors.shape == (500, 3) and (factors >= 0).all()
        np.testing.assert_array_equal(factors, again)
    assert kinds == {"grain", "picture", "waves"}


def test_grain_repeats_after_sixteen_points():
    texture = TextureRandomizer.make(
        {
            "kind": "grain", "seed": 0, "size": 0.01, "strength": [0.5, 0.5, 0.5],
        }
    )  # fmt: skip
    period = np.array([[0.003, 0.001, 0.002]])
    np.testing.assert_allclose(texture.factor(period), texture.factor(period + 0.16), atol=1e-12)


def test_picture_factors(pictures):
    texture = TextureRandomizer.make(
        {
            "kind": "picture", "file": str(pictures / "halves.png"), "size": 0.1,
            "axes": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], "offset": [0.0, 0.0],
        }
    )  # fmt: skip
    x = np.array([0.01, 0.04, 0.06, 0.09, 0.11, -0.01])
    seen = texture.factor(np.column_stack([x, 0 * x, x]))
    bright = np.array([50, 100, 200]) / (350 / 6)  # RGB; the picture's mean is 350 / 6
    expected = np.where((x % 0.1 > 0.05)[:, None], bright, 0)
    np.testing.assert_allclose(seen, expected)


def test_wrong_textures_are_told(tmp_path):
    with pytest.raises(UserError, match="no such folder"):
        TextureRandomizer(tmp_path / "none")
    with pytest.raises(UserError, match="no picture"):
        TextureRandomizer(tmp_path)
    (tmp_path / "bad.png").write_bytes(b"no picture")
    with pytest.raises(UserError, match="bad.png is not a picture"):
        TextureRandomizer(tmp_path)
    with pytest.raises(UserError, match="'marble' is unknown"):
        TextureRandomizer.make({"kind": "marble"})
