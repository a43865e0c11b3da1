"""The motion filter on paths in closed form, pushes and false matches."""

from __future__ import annotations

import numpy as np
import pytest

from utils.object_motion import PlanarMotion


def arc(t, speed=0.05, rate=0.3):
    """x, y, turn on a circle of radius speed / rate."""
    radius = speed / rate
    return radius * np.sin(rate * t), radius * (1 - np.cos(rate * t)), rate * t


def test_a_turning_path_is_predicted():
    motion = PlanarMotion(arc(0), 0.0)
    covariance = np.diag([1e-3, 1e-3, 0.02]) ** 2
    for k in range(1, 61):
        motion.see(arc(k / 30), covariance, k / 30)
    np.testing.assert_allclose(motion.at(2.5)[:3], arc(2.5), atol=1e-3)
    np.testing.assert_allclose(np.hypot(*motion.velocity[:2]), 0.05, atol=1e-3)
    T = motion.motion(2.0, 2.5)
    np.testing.assert_allclose(T[:2, :2] @ arc(2.0)[:2] + T[:2, 3], arc(2.5)[:2], atol=1.5e-3)


def test_noise_of_a_millimetre_does_not_set_a_resting_object_going():
    rng = np.random.default_rng(0)
    motion = PlanarMotion((0.5, 0.0, 0.0), 0.0)
    covariance = np.diag([1e-3, 1e-3, 0.02]) ** 2
    speeds = []
    for k in range(1, 91):
        noisy = (0.5, 0.0, 0.0) + rng.normal(size=3) * [1e-3, 1e-3, 0.02]
        motion.see(noisy, covariance, k / 30)
        speeds.append(np.hypot(*motion.velocity[:2]))
    assert np.mean(speeds[45:]) < 0.01


def test_a_push_is_forgotten_soon():
    motion = PlanarMotion((0.0, 0.0, 0.0), 0.0)
    covariance = np.diag([1e-3, 1e-3, 0.02]) ** 2
    for k in range(1, 91):
        place = np.clip((k / 30 - 1.0) / 0.4, 0, 1) * 0.06  # 6 cm within 0.4 s
        motion.see((place, 0.0, 0.0), covariance, k / 30)
    np.testing.assert_allclose(motion.at(3.5)[0], 0.06, atol=2e-3)


@pytest.mark.parametrize("false", [(0.05, 0.0, 0.0), (0.0, -0.3, 0.0), (0.0, 0.0, 1.5)])
def test_one_false_match_does_not_move_the_target(false):
    """On a straight path at 5 cm/s with one sighting of something else, which is as if there had
    been no sighting."""
    covariance = np.diag([1e-3, 1e-3, 0.02]) ** 2
    motion = PlanarMotion((0.0, 0.0, 0.2), 0.0)
    for k in range(1, 91):
        pose = np.array([0.05 * k / 30, 0.0, 0.2])
        accepted = motion.see(pose + (false if k == 60 else 0.0), covariance, k / 30)
        assert accepted == (k != 60)
        if k >= 60:
            np.testing.assert_allclose(motion.at(k / 30)[:3], pose, atol=5e-4)
            np.testing.assert_allclose(motion.velocity, [0.05, 0, 0], atol=5e-3)


@pytest.fixture
def resting():
    """The motion of what has lain at the origin for a second, and the sightings' covariance."""
    covariance = np.diag([1e-3, 1e-3, 0.02]) ** 2
    motion = PlanarMotion((0.0, 0.0, 0.0), 0.0)
    for k in range(1, 31):
        motion.see((0.0, 0.0, 0.0), covariance, k / 30)
    return motion, covariance


def test_false_matches_here_and_there_are_no_push(resting):
    motion, covariance = resting
    assert not motion.see((0.2, 0.0, 0.0), covariance, 31 / 30)
    assert not motion.see((-0.2, 0.0, 0.0), covariance, 32 / 30)
    np.testing.assert_allclose(motion.state[:3], 0.0, atol=5e-4)
    # But what stays where it was found once is there.
    assert not motion.see((0.2, 0.0, 0.0), covariance, 33 / 30)
    assert motion.see((0.2, 0.0, 0.0), covariance, 34 / 30)
    np.testing.assert_allclose(motion.state[:3], [0.2, 0.0, 0.0], atol=3e-3)


def test_a_false_match_after_a_push_is_no_push(resting):
    """What lies still is pushed by 2 cm, seen twice there, then once 24 mm beside it."""
    motion, covariance = resting
    assert not motion.see((0.02, 0.0, 0.0), covariance, 31 / 30)
    assert motion.see((0.02, 0.0, 0.0), covariance, 32 / 30)
    assert not motion.see((0.02, 0.024, 0.0), covariance, 33 / 30)
    assert motion.see((0.02, 0.0, 0.0), covariance, 34 / 30)
    np.testing.assert_allclose(motion.state[1], 0.0, atol=1e-3)
