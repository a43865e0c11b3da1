"""The loop around a law: smooth start, limits, and how a run ends."""

from __future__ import annotations

import numpy as np
import pytest

from tests.helpers.servo_cases import CORNERS, LAW_NAMES, LAWS
from utils.servo_features import interaction_matrix
from utils.servo_reference import CAMERA, FACING, GOAL, SQUARE, START, object_pose, turned
from utils.visual_servo import (
    ImageBasedVisualServo,
    PointError,
    PositionBasedVisualServo,
    ServoError,
    ServoView,
    TwistLimits,
)


def test_smooth_start_grows_from_zero():
    servo = ImageBasedVisualServo(CAMERA, smooth_start=4.0)
    view, goal = ServoView(CORNERS + 20, 1.0), ServoView(CORNERS, 1.0)
    full = ImageBasedVisualServo(CAMERA).step(view, goal).velocity
    speeds = [servo.step(view, goal).velocity for _ in range(26)]
    np.testing.assert_allclose(speeds[0], 0, atol=1e-15)
    np.testing.assert_allclose(speeds[25], full * (1 - np.exp(-4 * 25 * 0.04)))
    servo.reset()
    np.testing.assert_allclose(servo.step(view, goal).velocity, 0, atol=1e-15)


def test_limited_servo_still_arrives():
    servo = PositionBasedVisualServo(CAMERA, 2.0, limits=TwistLimits(0.05, 0.1))
    history = servo.simulate(SQUARE, START, GOAL)
    assert history.converged
    linear, angular = (np.linalg.norm(part, axis=1) for part in np.hsplit(history.velocities, 2))
    assert linear.max() <= 0.05 + 1e-12 and angular.max() <= 0.1 + 1e-12
    first = linear[0] / 0.05, angular[0] / 0.1
    assert max(first) == pytest.approx(1.0)  # far away, one of the two is as fast as it may be
    view, goal = (ServoView(CORNERS, 1.0, pose) for pose in (START, GOAL))
    free, held = (
        PositionBasedVisualServo(CAMERA, 2.0, **options).step(view, goal).velocity
        for options in ({}, {"limits": TwistLimits(0.05, 0.1)})
    )
    np.testing.assert_allclose(held * np.linalg.norm(free), free * np.linalg.norm(held))


def test_damping_makes_the_step_of_least_damped_squares():
    """v = -gain (L'L + 0.2^2 I)^-1 L' e, solved by numpy."""
    view, goal = ServoView(CORNERS + (30, -20), 0.8), ServoView(CORNERS, 0.8)
    found = ImageBasedVisualServo(CAMERA, 0.5, damping=0.2).step(view, goal).velocity
    camera = ImageBasedVisualServo(CAMERA).camera
    now, then = camera.normalise(view.points), camera.normalise(goal.points)
    L = interaction_matrix(now, np.full(4, 0.8))
    expected = -0.5 * np.linalg.solve(L.T @ L + 0.04 * np.eye(6), L.T @ (now - then).ravel())
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-15)
    plain = ImageBasedVisualServo(CAMERA, 0.5).step(view, goal).velocity
    assert np.linalg.norm(plain - found) > 0.1 * np.linalg.norm(plain)


@pytest.mark.parametrize("servo", LAWS, ids=LAW_NAMES)
def test_last_command_is_zero_however_it_ends(servo):
    views = [ServoView(CORNERS + 9, 1.0, START)] * 3
    goal = ServoView(CORNERS, 1.0, GOAL)
    sent = []
    lost = iter([*views, ServoView(CORNERS[:2], 1.0, None)])
    history = servo.run(lambda: next(lost), sent.append, goal)
    assert history.reason.startswith("stopped by ")
    assert history.iterations == 3 and not history.converged
    assert np.linalg.norm(sent[-2]) > 0
    np.testing.assert_array_equal(sent[-1], np.zeros(6))
    sent.clear()
    with pytest.raises(ServoError):  # nothing was ever seen: bad input, not a lost feature
        servo.run(lambda: ServoView(CORNERS[:2], 1.0, None), sent.append, goal)
    np.testing.assert_array_equal(sent, [np.zeros(6)])


def test_features_that_leave_the_image_stop_the_camera():
    servo = PositionBasedVisualServo(CAMERA)
    small = ImageBasedVisualServo(CAMERA | {"width": 640, "height": 480})
    assert servo.simulate(SQUARE, turned(45), FACING).converged
    near = object_pose([0, 0, 0.2], [0, 0, 0])  # 20 cm at 20 cm fill 840 pixels
    with pytest.raises(PointError, match="640 x 480"):
        small.simulate(SQUARE, near, GOAL)


def test_an_error_that_no_motion_reduces_ends_the_run():
    # The goal's square is larger on one diagonal: no pose shows it. Desired L, frozen view.
    servo = ImageBasedVisualServo(CAMERA, truncation=0.9, interaction="desired")
    goal = ServoView(CORNERS, 1.0)
    xy = servo.camera.normalise(CORNERS)
    L = interaction_matrix(xy, np.ones(4))
    U = np.linalg.svd(L)[0]
    seen = servo.camera.to_pixels(xy + 1e-2 * U[:, 7].reshape(4, 2))
    history = servo.run(lambda: ServoView(seen, 1.0), lambda v: None, goal)
    assert not history.converged
    assert "no motion" in history.reason


def test_views_that_differ_in_their_points_leave_a_history_without_them():
    servo, goal = PositionBasedVisualServo(CAMERA), ServoView(T_CO=GOAL)
    for points in (CORNERS[:3], None):
        views = iter([ServoView(CORNERS, 1.0, START), ServoView(points, 1.0, START)])
        history = servo.run(lambda seen=views: next(seen), lambda v: None, goal, max_iterations=2)
        assert history.points.shape == (2, 0, 2) and history.error_norms.shape == (2,)


def test_a_run_of_no_iterations_has_an_empty_history():
    history = PositionBasedVisualServo(CAMERA).simulate(SQUARE, START, GOAL, max_iterations=0)
    assert history.iterations == len(history.error_norms) == len(history.distances) == 0
    assert history.reason == "stopped after 0 iterations"
