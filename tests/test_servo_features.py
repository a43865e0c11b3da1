"""Features of a servo: interaction matrices as derivatives, depths, and input that is refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers.servo_cases import derivative, directions, twists
from utils.servo_features import (
    depths_from_image,
    extended_interaction,
    interaction_matrix,
    pose_from_points,
    rotation_interaction,
)
from utils.servo_reference import CAMERA, GOAL, SQUARE, START
from utils.transforms import pose_exp, rotation_exp, rotation_log, transform_points
from utils.visual_servo import CameraMatrixError, DepthFromMotion, ImageBasedVisualServo, PointError

K = CAMERA["intrinsics"]


def moved(point_C, twist, dt):
    return transform_points(pose_exp(-dt * twist), point_C)


points = st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(0.3, 2)).map(np.array)


@given(points, twists)
def test_interaction_matrix_is_the_numerical_derivative(point, twist):
    def image(dt):
        p = moved(point, twist, dt)
        return p[:2] / p[2]

    L = interaction_matrix((point[:2] / point[2])[None], point[2:])
    np.testing.assert_allclose(L @ twist, derivative(image), atol=1e-6)


@given(points, twists)
def test_extended_interaction_is_the_numerical_derivative(point, twist):
    def features(dt):
        p = moved(point, twist, dt)
        return np.array([p[0] / p[2], p[1] / p[2], np.log(p[2])])

    np.testing.assert_allclose(extended_interaction(point) @ twist, derivative(features), atol=1e-6)


@given(directions, st.floats(0, 3.1), directions)
def test_rotation_interaction_is_the_numerical_derivative(axis, angle, w):
    R = rotation_exp(axis * angle)
    found = rotation_interaction(rotation_log(R)) @ w
    numerical = derivative(lambda dt: rotation_log(R @ rotation_exp(dt * w)))
    np.testing.assert_allclose(found, numerical, atol=1e-5)


@given(twists)
def test_pose_from_points_finds_the_pose(twist):
    T = pose_exp(twist)
    np.testing.assert_allclose(pose_from_points(transform_points(T, SQUARE), SQUARE), T, atol=1e-9)


def test_depths_are_learned_from_motion():
    # START is about 1 m away; started at 0.4 m, the estimator must find out on the way.
    servo = ImageBasedVisualServo(CAMERA, depth=DepthFromMotion(0.4))
    history = servo.simulate(SQUARE, START, GOAL, depth_factor=None, tolerance=1e-5)
    assert history.converged
    xy = servo.camera.normalise(history.points[-1])
    again = servo.depth.update(xy, np.zeros(6), 0.04)
    np.testing.assert_allclose(again, 0.75, rtol=0.02)  # GOAL faces the target at 0.75 m
    # The true depth takes 534 iterations, a constant 0.4 m more than twice as many.
    assert history.iterations < 600


@pytest.mark.parametrize(
    ("matrix", "words"),
    [(np.eye(4), "3, 3"), (np.full((3, 3), np.nan), "finite"), (np.diag([-1.0, 1, 1]), "positive"),
     (np.diag([0.0, 1, 1]), "positive"), (np.diag([5.0, 5, 2]), "last row"), ("K", "numbers"),
     (K + [[0, 3, 0], [0, 0, 0], [0, 0, 0]], "skew")],
)  # fmt: skip
def test_what_is_no_camera_matrix_is_refused(matrix, words):
    with pytest.raises(CameraMatrixError, match=words):
        ImageBasedVisualServo({"intrinsics": matrix})


@pytest.mark.parametrize("pixel", [(-1, 5), (5, -1), (10, 5), (5, 8), (np.nan, 5)])
def test_depth_outside_the_image_is_refused(pixel):
    with pytest.raises(PointError, match="depth image"):
        depths_from_image([pixel], np.ones((8, 10)))
