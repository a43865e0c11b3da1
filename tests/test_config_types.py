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


@pytest.mark.parametrize(
    "key, value, words",
    [
        ("physics.object_mass", "-0.02,0,uniform,add", r"low \(-0.02\) \+ 0.02.* must be positive"),
        ("physics.object_mass", "0,1,uniform,set", r"low \(0.0\) must be positive"),
        ("physics.robot_mass", "-1,1,uniform,add", "must be positive"),
        ("physics.object_friction", "-1,1,uniform,set", "must not be negative"),
        ("physics.rolling_friction", "-1,1,uniform,add", "must not be negative"),
        ("physics.spinning_friction", "-1,1,uniform,set", "must not be negative"),
        ("physics.table_friction", "-1.1,0,uniform,add", r"\+ 1, the nominal value, must not be"),
        ("physics.finger_friction", "-1,1,uniform,set", "must not be negative"),
        ("physics.contact_stiffness", "-1,1,uniform,set", "must not be negative"),
        ("physics.contact_damping", "-1,1,uniform,set", "must not be negative"),
        ("physics.arm_position_gain", "-1,0,uniform,add", "must be positive"),
        ("physics.arm_velocity_gain", "-1,1,uniform,set", "must not be negative"),
        ("physics.gripper_gain", "-1,1,uniform,set", "must not be negative"),
        ("vision.camera_fov", "-1,0,uniform,add", "must be positive"),
        (
            "vision.camera_fov",
            "1,3,uniform,scale",
            "field of view of 180 degrees out of camera.wris",
        ),
        (
            "vision.camera_fov",
            "1,2.5,uniform,scale",
            "field of view of 180 degrees out of closed_loop.fov_deg",
        ),
        ("physics.gravity", "9,12,uniform,add", r"high \(12\) makes it 2.19 m/s\^2 along z"),
        ("physics.gravity", "-9,0,uniform,set", "it must stay below 0"),
        ("physics.latency", "0,100,uniform,set", r"high \(100\) must be at most 1 s"),
        *(
            (name, "0.9,1.1,uniform,scale", "its nominal value is 0.*use add or set")
            for name in (
                "physics.joint_damping",
                "physics.action_noise",
                "physics.action_bias",
                "physics.latency",
                "vision.camera_shift",
                "vision.camera_turn",
                "vision.colour_noise",
            )
        ),
        ("vision.depth_shift", "-0.6,0,uniform,add", "must not be negative"),
        ("vision.depth_jitter", "-1,0,uniform,set", "must not be negative"),
        ("vision.depth_step", "-0.125,0,uniform,add", "must be positive"),
    ],
)
def test_impossible_results_are_refused(key, value, words):
    with pytest.raises(ConfigError, match=words) as caught:
        load_config(None, [f"randomization.{key}={value},episode"])
    assert str(caught.value).startswith(f"randomization.{key}: ")


@pytest.mark.parametrize(
    "changes",
    [
        ["randomization.physics.object_mass=-0.01,0.01,normal,add,episode"],
        ["randomization.physics.robot_mass=0,0.1,uniform,add,episode"],
        ["randomization.physics.table_friction=-0.2,0.2,normal,add,episode"],
        ["randomization.vision.depth_shift=-0.5,0.5,uniform,add,step"],
        [
            "randomization.vision.camera_fov=1,3,uniform,scale,episode",
            "randomization.parts=physics",
        ],
        ["camera.fov_deg=170", "camera.wrist_fov_deg=170"],
    ],
)
def test_possible_results_are_allowed(changes):
    load_config(None, changes)
