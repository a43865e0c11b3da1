"""Visual servoing: the reference table, closed forms, peers, and input that must be refused."""

import json
import sys

import numpy as np
import pybullet
import pybullet_data
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pybullet_utils.bullet_client import BulletClient
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from benchmarks import bench_servo
from utils.errors import UserError
from utils.servo_control import camera_jacobian, joint_velocities, pseudo_inverse
from utils.servo_features import (
    depths_from_image,
    extended_interaction,
    interaction_matrix,
    pose_from_points,
    rotation_interaction,
)
from utils.servo_reference import (
    CAMERA,
    FACING,
    FOCAL,
    GOAL,
    NEAR_GOAL,
    SQUARE,
    START,
    Row,
    iterations_to_tolerance,
    main,
    object_pose,
    random_start,
    rows,
    steady_noise,
    turned,
)
from utils.transforms import (
    inverse_pose,
    pose_exp,
    pose_log,
    pose_matrix,
    rotation_exp,
    rotation_log,
    skew,
    transform_points,
    velocity_transform,
)
from utils.visual_servo import (
    AdaptiveGain,
    CameraMatrixError,
    CollinearPointsError,
    DepthError,
    DepthFromMotion,
    FeatureCountError,
    HybridVisualServo,
    ImageBasedVisualServo,
    PointError,
    PoseError,
    PositionBasedVisualServo,
    ServoError,
    ServoView,
    SingularMatrixError,
    TwistLimits,
    joint_limit_avoidance,
)

K = CAMERA["intrinsics"]
CORNERS = np.array([[220.0, 140], [420, 140], [420, 340], [220, 340]])  # pixels, a square
LAWS = (
    ImageBasedVisualServo(CAMERA),
    PositionBasedVisualServo(CAMERA),
    HybridVisualServo(CAMERA),
    HybridVisualServo(CAMERA, scheme="2.5d"),
)
LAW_NAMES = ("image", "position", "blend", "2.5d")

unit = st.floats(-1, 1)
directions = (
    st.tuples(unit, unit, unit)
    .map(np.array)
    .filter(lambda v: np.linalg.norm(v) > 0.1)
    .map(lambda v: v / np.linalg.norm(v))
)
twists = st.tuples(*[st.floats(-1.5, 1.5)] * 6).map(np.array)


# Rigid motion


def twist_matrix(twist):
    A = np.zeros((4, 4))
    A[:3, :3], A[:3, 3] = skew(twist[3:]), twist[:3]
    return A


@given(twists, st.sampled_from([0, 1e-9, 1e-6, 0.9e-4, 1.1e-4, 1, 2]))
def test_exponential_is_the_matrix_exponential(twist, scale):
    twist = twist * scale
    np.testing.assert_allclose(pose_exp(twist), expm(twist_matrix(twist)), atol=1e-13)


@given(directions, st.floats(0, np.pi - 1e-6), st.tuples(unit, unit, unit))
def test_pose_log_undoes_the_exponential(axis, angle, linear):
    twist = np.array([*linear, *(axis * angle)])
    np.testing.assert_allclose(pose_log(pose_exp(twist)), twist, atol=1e-9)


@given(directions, st.floats(-15, 0).map(lambda power: np.pi - 10**power))
def test_rotation_log_near_pi(axis, angle):
    R = rotation_exp(axis * angle)
    np.testing.assert_allclose(rotation_exp(rotation_log(R)), R, atol=1e-14)
    if angle < np.pi - 1e-9:
        np.testing.assert_allclose(rotation_log(R), axis * angle, atol=1e-12)


@given(directions)
def test_rotation_log_at_pi_about_any_axis(axis):
    # R = 2 u u^T - I is the rotation by pi about u; +u and -u are the same rotation.
    found = rotation_log(2 * np.outer(axis, axis) - np.eye(3))
    assert np.linalg.norm(found) == pytest.approx(np.pi, abs=1e-12)
    np.testing.assert_allclose(np.outer(found, found) / np.pi**2, np.outer(axis, axis), atol=1e-12)


@given(twists)
def test_rotation_log_is_scipys(twist):
    R = Rotation.from_rotvec(1.2 * twist[3:])
    np.testing.assert_allclose(rotation_log(R.as_matrix()), R.as_rotvec(), atol=1e-12)


@given(twists, twists)
def test_velocity_transform_is_the_adjoint(pose, twist):
    # T_AB [v_B] T_BA = [v_A] for the same motion, by definition of a change of frame.
    T = pose_exp(pose)
    seen = T @ twist_matrix(twist) @ inverse_pose(T)
    np.testing.assert_allclose(twist_matrix(velocity_transform(T) @ twist), seen, atol=1e-12)


def test_velocity_transform_has_the_lever_arm_by_hand():
    # E turns with 2 rad/s about its z; a camera 0.1 m along E's x moves with w x r = 0.2 m/s in y.
    T_CE = object_pose([-0.1, 0, 0], [0, 0, 0])
    np.testing.assert_allclose(
        velocity_transform(T_CE) @ [0, 0, 0, 0, 0, 2], [0, 0.2, 0, 0, 0, 2], atol=1e-15
    )


# How features move


def moved(point_C, twist, dt):
    return transform_points(pose_exp(-dt * twist), point_C)


points = st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(0.3, 2)).map(np.array)


def derivative(function, step=1e-5):
    return (function(step) - function(-step)) / (2 * step)


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


def test_interaction_matrix_by_hand_in_pixels():
    # 84 px right and 168 px below the centre: x = 0.1, y = 0.2; at Z = 0.5.
    L = ImageBasedVisualServo(CAMERA).compute_interaction_matrix((404, 408), Z=0.5)
    np.testing.assert_allclose(L, [[-2, 0, 0.2, 0.02, -1.01, 0.2], [0, -2, 0.4, 1.04, -0.02, -0.1]])


def test_pixel_to_3d_by_hand():
    servo = PositionBasedVisualServo(CAMERA)
    np.testing.assert_allclose(servo.pixel_to_3d(404, 408, 0.5), [0.05, 0.1, 0.5])
    depth_map = np.zeros((480, 640), np.float32)
    depth_map[408, 404] = 0.5
    np.testing.assert_allclose(servo.estimate_3d_position((404.4, 407.6), depth_map)[2], 0.5)


@given(twists)
def test_pose_from_points_finds_the_pose(twist):
    T = pose_exp(twist)
    np.testing.assert_allclose(pose_from_points(transform_points(T, SQUARE), SQUARE), T, atol=1e-9)


def test_depths_are_learned_from_motion():
    # START is about 1 m away; told 0.4 m, the estimator must find out on the way.
    servo = ImageBasedVisualServo(CAMERA, depth=DepthFromMotion(0.4))
    history = servo.simulate(SQUARE, START, GOAL, depth_factor=None, tolerance=1e-5)
    assert history.converged
    xy = servo.camera.normalise(history.points[-1])
    again = servo.depth.update(xy, np.zeros(6), 0.04)
    np.testing.assert_allclose(again, 0.75, rtol=0.02)  # GOAL faces the target at 0.75 m
    # The true depth takes 534 iterations, a constant 0.4 m more than twice as many.
    assert history.iterations < 600


# The reference table


@pytest.mark.slow
def test_every_row_of_the_reference_table_holds():
    table = list(rows())
    assert len(table) == 23
    assert [row for row in table if not row.holds] == []


def test_a_row_can_fail():
    assert not Row("", 1.2, 1.0, 0.1).holds


def test_error_decays_as_in_theory_for_small_steps_and_the_exact_matrix():
    # Three points make L square, so that the error itself obeys edot = -gain e.
    three = SQUARE[:3]
    near = pose_exp(1e-6 * np.array([1, -2, 3, 2, 1, -3])) @ GOAL
    history = ImageBasedVisualServo(CAMERA, 0.5).simulate(
        three, near, GOAL, max_iterations=100, tolerance=0
    )
    expected = history.error_norms[0] * 0.98 ** np.arange(100)
    np.testing.assert_allclose(history.error_norms, expected, rtol=1e-5)
    np.testing.assert_allclose(history.errors[60], history.errors[0] * 0.98**60, rtol=1e-3)


def test_rotation_error_decays_exactly_in_position_based_and_extended_control():
    for scheme in LAWS[1], LAWS[3]:
        history = scheme.simulate(SQUARE, START, GOAL, max_iterations=200, tolerance=0)
        angles = history.pose_errors()[1]
        # The start's angle is |(10, -10, 50)| = 51.96 degrees.
        expected = np.radians(np.sqrt(2700)) * 0.98 ** np.arange(200)
        np.testing.assert_allclose(angles, expected, rtol=1e-9)


def test_position_based_camera_goes_straight():
    history = LAWS[1].simulate(SQUARE, START, GOAL)
    chord = np.linalg.norm(history.camera_poses[0, :3, 3] - history.camera_poses[-1, :3, 3])
    assert history.path_length == pytest.approx(chord, rel=1e-3)


@pytest.mark.parametrize("degrees", [90, 120, 150])
def test_camera_retreat_is_near_chaumettes_closed_form(degrees):
    history = LAWS[0].simulate(SQUARE, turned(degrees), FACING)
    # The formula holds for a flat image (narrow view); 20 cm at 1 m is within 5 %.
    retreat = 1 / np.cos(np.radians(degrees / 2)) - 1
    assert history.converged
    assert history.distances.max() - 1 == pytest.approx(retreat, rel=0.05)


def test_desired_matrix_fails_on_long_turns():
    servo = ImageBasedVisualServo(CAMERA, interaction="desired")
    assert servo.simulate(SQUARE, turned(120), FACING).converged
    for degrees in 150, 170:
        assert not servo.simulate(SQUARE, turned(degrees), FACING).converged


@pytest.mark.parametrize("degrees", [90, 120, 150, 170, 179.9])
def test_mean_matrix_turns_in_place(degrees):
    # At 90 degrees the mean matrix of a square is singular, so truncation has to be asked for.
    servo = ImageBasedVisualServo(CAMERA, interaction="mean", truncation=1e-6)
    history = servo.simulate(SQUARE, turned(degrees), FACING)
    assert history.converged
    assert history.path_length < 1e-6


def test_mean_matrix_at_90_degrees_is_refused_without_truncation():
    servo = ImageBasedVisualServo(CAMERA, interaction="mean")
    with pytest.raises(SingularMatrixError, match="truncation"):
        servo.simulate(SQUARE, turned(90), FACING)


@pytest.mark.parametrize("servo", [LAWS[1], LAWS[3]], ids=["position", "2.5d"])
@pytest.mark.parametrize("degrees", [90, 150, 178, 179.9, 180])
def test_pose_and_extended_control_turn_in_place(servo, degrees):
    history = servo.simulate(SQUARE, turned(degrees), FACING)
    assert history.converged
    assert history.path_length < 1e-9
    # The image error is 0.2828 theta for small theta; it must shrink to 1e-5 as 0.98^k.
    expected = 1 + np.ceil(np.log(0.2828 * np.radians(degrees) / 1e-5) / -np.log(0.98))
    assert iterations_to_tolerance(history) == pytest.approx(expected, abs=1)


def test_turned_by_180_degrees_image_based_diverges_and_hybrid_does_not():
    history = LAWS[0].simulate(SQUARE, turned(180), FACING)
    assert not history.converged
    assert history.distances.max() > 10
    assert "stopped by" in history.reason
    for servo in LAWS[2:]:
        history = servo.simulate(SQUARE, turned(180), FACING)
        assert history.converged
        assert history.distances.max() < 1.5


def test_noise_is_what_a_linear_filter_leaves():
    # Each step keeps 0.98 of the pose error and adds 0.02 L^+ noise, so the variance settles at
    # 0.02^2 / (1 - 0.98^2) of that of L^+ noise.
    xy = SQUARE[:, :2] / 0.75
    L = interaction_matrix(xy, np.full(4, 0.75))
    covariance = (0.5 / FOCAL) ** 2 * np.linalg.inv(L.T @ L) * 0.02**2 / (1 - 0.98**2)
    millimetres, degrees = steady_noise(0.5)
    assert millimetres == pytest.approx(1e3 * np.sqrt(np.trace(covariance[:3, :3])), rel=0.06)
    assert degrees == pytest.approx(np.degrees(np.sqrt(np.trace(covariance[3:, 3:]))), rel=0.06)


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["blend", "2.5d"])
def test_hybrid_converges_from_200_random_starts_without_straying(scheme):
    rng = np.random.default_rng(7)
    servo = HybridVisualServo(CAMERA, 2.0, scheme=scheme)  # a higher gain takes the same path
    for _ in range(200):
        history = servo.simulate(SQUARE, random_start(rng), NEAR_GOAL, max_iterations=1000)
        assert history.converged
        assert history.distances.max() < 1.5 * history.distances[0]
        metres, radians = history.pose_errors()
        assert metres[-1] < 2e-5
        assert radians[-1] < 3e-5


@pytest.mark.slow
def test_same_iterations_as_the_toolbox():
    pytest.importorskip("machinevisiontoolbox", reason=bench_servo.HOW_TO_INSTALL)
    ours, theirs = bench_servo.our_run(START, GOAL), bench_servo.peer_run(START, GOAL)
    assert ours[0] == theirs[0] == 534
    # Both stop within a hundredth of a millimetre, and of each other's pose.
    np.testing.assert_allclose(ours[1], theirs[1], atol=2e-6)


def test_benchmark_says_how_to_install_the_toolbox(monkeypatch):
    monkeypatch.setitem(sys.modules, "machinevisiontoolbox", None)  # as if it were not there
    with pytest.raises(SystemExit, match="pip install --no-deps machinevision-toolbox-python"):
        bench_servo.main([])


@pytest.mark.slow
def test_benchmark_writes_its_metrics(tmp_path, capsys):
    pytest.importorskip("machinevisiontoolbox", reason=bench_servo.HOW_TO_INSTALL)
    bench_servo.main(["--quick", "--json", str(tmp_path / "servo.json")])
    metrics = json.loads((tmp_path / "servo.json").read_text())
    assert metrics["iterations_A_ours"]["value"] == 534
    assert metrics["converged_hybrid_2.5d"]["holds"]
    assert "step_time_toolbox_over_ours" in capsys.readouterr().out


# Gains, limits, inverses


def test_adaptive_gain_by_hand():
    gain = AdaptiveGain(4, 0.4, 30)
    assert gain(0) == 4
    assert gain(0.12) == pytest.approx(0.4 + 3.6 * np.exp(-1))
    assert gain(100) == pytest.approx(0.4)
    slope = (gain(1e-7) - gain(0)) / 1e-7
    assert slope == pytest.approx(-30, rel=1e-5)


def test_smooth_start_grows_from_zero():
    servo = ImageBasedVisualServo(CAMERA, smooth_start=4.0)
    view, goal = ServoView(CORNERS + 20, 1.0), ServoView(CORNERS, 1.0)
    full = ImageBasedVisualServo(CAMERA).step(view, goal).velocity
    speeds = [servo.step(view, goal).velocity for _ in range(26)]
    np.testing.assert_allclose(speeds[0], 0, atol=1e-15)
    np.testing.assert_allclose(speeds[25], full * (1 - np.exp(-4 * 25 * 0.04)))
    servo.reset()
    np.testing.assert_allclose(servo.step(view, goal).velocity, 0, atol=1e-15)


@given(twists)
def test_limits_scale_the_whole_twist(twist):
    limited = TwistLimits(0.2, 0.7).scale(twist)
    assert np.linalg.norm(limited[:3]) <= 0.2 + 1e-12
    assert np.linalg.norm(limited[3:]) <= 0.7 + 1e-12
    np.testing.assert_allclose(
        limited * np.linalg.norm(twist), twist * np.linalg.norm(limited), atol=1e-12
    )


def test_limited_servo_still_arrives():
    servo = PositionBasedVisualServo(CAMERA, 2.0, limits=TwistLimits(0.05, 0.1))
    history = servo.simulate(SQUARE, START, GOAL)
    assert history.converged
    assert np.linalg.norm(history.velocities[:, :3], axis=1).max() == pytest.approx(0.05, rel=0.5)
    assert np.linalg.norm(history.velocities[:, 3:], axis=1).max() <= 0.1 + 1e-12


def test_joint_velocities_are_scaled_by_one_factor():
    scaled = scale_joint_velocities(np.array([1.0, -4.35, 0.5]), [2.175, 2.175, 2.61])
    np.testing.assert_allclose(scaled, [0.5, -2.175, 0.25])


def test_pseudo_inverse_exact_damped_and_truncated():
    A = np.random.default_rng(1).normal(size=(8, 6))
    inverse, condition = pseudo_inverse(A)
    np.testing.assert_allclose(inverse, np.linalg.pinv(A), atol=1e-12)
    assert condition == pytest.approx(np.linalg.cond(A))
    damped, condition = pseudo_inverse(A, damping=0.3)
    np.testing.assert_allclose(damped, np.linalg.solve(A.T @ A + 0.09 * np.eye(6), A.T))
    assert condition == pytest.approx(np.linalg.cond(A))
    singular = np.diag([2.0, 1.0, 0.0])
    truncated, condition = pseudo_inverse(singular, truncation=1e-6)
    np.testing.assert_allclose(truncated, np.diag([0.5, 1.0, 0.0]))
    assert condition == np.inf


@pytest.mark.parametrize("A", [np.diag([1.0, 1e-12]), np.zeros((2, 2)), np.full((2, 2), np.nan)])
def test_pseudo_inverse_refuses_singular_matrices(A):
    with pytest.raises(SingularMatrixError, match="matrix"):
        pseudo_inverse(A)


def test_pseudo_inverse_refuses_infinity_even_when_damped():
    with pytest.raises(SingularMatrixError, match="finite"):
        pseudo_inverse(np.array([[np.inf, 1], [1, 1]]), damping=0.1, truncation=0.1)


# The arm behind the camera


@pytest.fixture(scope="module")
def panda():
    """A fixed Panda; gives T_WE, Jacobian and E's world velocity, told by PyBullet."""
    client = BulletClient(pybullet.DIRECT)
    client.setAdditionalSearchPath(pybullet_data.getDataPath())
    body = client.loadURDF("franka_panda/panda.urdf", useFixedBase=True)
    yield Panda(client, body)
    client.disconnect()


class Panda:
    HAND = 11
    q = np.array([0.3, -0.5, 0.2, -2.0, 0.4, 1.7, 0.6])

    def __init__(self, client, body):
        self.client, self.body = client, body

    def pose(self, q):
        for joint, angle in enumerate(q):
            self.client.resetJointState(self.body, joint, angle)
        state = self.client.getLinkState(self.body, self.HAND, computeForwardKinematics=1)
        return pose_matrix(state[4], state[5])

    def velocity(self, q, qdot):
        for joint, (angle, speed) in enumerate(zip(q, qdot)):
            self.client.resetJointState(self.body, joint, angle, speed)
        state = self.client.getLinkState(
            self.body, self.HAND, computeLinkVelocity=1, computeForwardKinematics=1
        )
        np.testing.assert_allclose(state[0], state[4], atol=1e-9)  # this link's mass is at E
        return np.concatenate([state[6], state[7]])

    def jacobian(self, q):
        zeros = [0.0] * 9
        J = self.client.calculateJacobian(self.body, self.HAND, [0, 0, 0], [*q, 0, 0], zeros, zeros)
        return np.vstack(J)[:, :7]


T_EC = object_pose([0.05, -0.02, -0.06], [10, 20, 90])
T_WC = object_pose([0.9, 0.1, 0.8], [150, 60, 20])
IN_HAND = CAMERA | {"mounting": "eye_in_hand", "T_EC": T_EC}
TO_HAND = CAMERA | {"mounting": "eye_to_hand", "T_WC": T_WC}


def test_camera_velocity_is_that_of_pybullets_link(panda):
    qdot = np.array([0.3, -0.2, 0.5, 0.1, -0.4, 0.6, -0.7])
    T_WE, v_W = panda.pose(panda.q), panda.velocity(panda.q, qdot)
    # By hand: the camera's origin is an arm r away from E, so its velocity is v + w x r.
    r = T_WE[:3, :3] @ T_EC[:3, 3]
    R_CW = (T_WE @ T_EC)[:3, :3].T
    by_hand = np.concatenate([R_CW @ (v_W[:3] + np.cross(v_W[3:], r)), R_CW @ v_W[3:]])
    J = camera_jacobian("eye_in_hand", T_WE, panda.jacobian(panda.q), T_EC=T_EC)
    np.testing.assert_allclose(J @ qdot, by_hand, atol=1e-6)


@pytest.mark.parametrize("config", [IN_HAND, TO_HAND], ids=["in hand", "to hand"])
def test_image_moves_as_the_joints_say(panda, config):
    """L J qdot is the measured motion of the points, with the sign and lever arm of the mount."""
    q, qdot = panda.q, np.array([0.3, -0.2, 0.5, 0.1, -0.4, 0.6, -0.7])
    servo = ImageBasedVisualServo(config)
    in_hand = config is IN_HAND
    T_WE = panda.pose(q)
    T_WC_now = T_WE @ T_EC if in_hand else T_WC
    # Points 0.5 m in front of the camera: fixed in the world, or riding on the hand.
    points_C = SQUARE + [0.02, 0.03, 0.5]
    carried = transform_points(
        inverse_pose(np.eye(4) if in_hand else T_WE), transform_points(T_WC_now, points_C)
    )

    def image(dt):
        T_WE = panda.pose(q + dt * qdot)
        if in_hand:
            p = transform_points(inverse_pose(T_WE @ T_EC), carried)
        else:
            p = transform_points(inverse_pose(T_WC) @ T_WE, carried)
        return (p[:, :2] / p[:, 2:]).ravel()

    camera = servo.camera
    J = camera_jacobian(
        camera.mounting, T_WE, panda.jacobian(q), T_EC=camera.T_EC, T_WC=camera.T_WC
    )
    L = interaction_matrix(points_C[:, :2] / points_C[:, 2:], points_C[:, 2])
    # PyBullet's poses are good to about 1e-7 m, hence the long step; the values are around 1.
    np.testing.assert_allclose(L @ J @ qdot, derivative(image, 2e-3), atol=1e-3)


@pytest.mark.parametrize("config", [IN_HAND, TO_HAND], ids=["in hand", "to hand"])
@pytest.mark.parametrize("law", [ImageBasedVisualServo, PositionBasedVisualServo])
def test_arm_servoes_to_the_goal(panda, config, law):
    """The whole chain: views from PyBullet's kinematics, joints moved by the servo's velocities."""
    servo = law(config, 1.0)
    q_goal = panda.q + np.array([0.1, -0.1, 0.1, 0.1, -0.1, 0.1, 0.2])
    in_hand = config is IN_HAND

    def look(T_WE):
        T_CO = inverse_pose(T_WE @ T_EC) @ T_WO if in_hand else inverse_pose(T_WC) @ T_WE @ T_EO
        p = transform_points(T_CO, SQUARE)
        return ServoView(servo.camera.to_pixels(p[:, :2] / p[:, 2:]), p[:, 2], T_CO)

    goal_pose = panda.pose(q_goal)
    ahead = object_pose([0, 0, 0.5], [15, -10, 30])  # of the object in the camera at the goal
    T_WO = goal_pose @ T_EC @ ahead
    T_EO = inverse_pose(goal_pose) @ T_WC @ ahead
    state = {"q": panda.q.copy()}

    def move(v_C):
        T_WE = panda.pose(state["q"])
        qdot = servo.compute_joint_velocities(T_WE, v_C, panda.jacobian(state["q"]))
        state["q"] = state["q"] + servo.dt * qdot

    history = servo.run(lambda: look(panda.pose(state["q"])), move, look(goal_pose), 600)
    assert history.converged
    # The error shrinks by 1 - gain dt = 0.96 a step: 1e-5 is reached after about 270.
    assert history.iterations == pytest.approx(
        1 + np.log(1e-5 / history.error_norms[0]) / np.log(0.96), rel=0.05
    )


def test_secondary_task_leaves_the_camera_alone_and_the_limit_behind(panda):
    servo = ImageBasedVisualServo(IN_HAND)
    T_WE, J_W = panda.pose(panda.q), panda.jacobian(panda.q)
    twist = np.array([0.05, -0.02, 0.03, 0.1, 0.2, -0.1])
    upper, lower = panda.q + 2.0, panda.q - 2.0
    lower[2], upper[2] = panda.q[2] - 3.9, panda.q[2] + 0.1  # joint 3 is near its upper limit
    wish = joint_limit_avoidance(panda.q, lower, upper, gain=2.0)
    # 10 % of 4 rad is 0.4; 0.3 rad of it are used up.
    np.testing.assert_allclose(wish, [0, 0, -0.6, 0, 0, 0, 0], atol=1e-12)
    plain = servo.compute_joint_velocities(T_WE, twist, J_W)
    kind = servo.compute_joint_velocities(T_WE, twist, J_W, secondary=wish)
    J = camera_jacobian("eye_in_hand", T_WE, J_W, T_EC=T_EC)
    np.testing.assert_allclose(J @ plain, twist, atol=1e-10)
    np.testing.assert_allclose(J @ kind, twist, atol=1e-10)
    assert kind[2] < plain[2] - 0.01


def test_damped_joint_velocities_keep_the_secondary_task_out_of_the_task(panda):
    J = panda.jacobian(panda.q)
    still = joint_velocities(J, np.zeros(6), np.ones(7), damping=0.05)[0]
    np.testing.assert_allclose(J @ still, 0, atol=1e-10)
    assert np.linalg.norm(still) > 0.1


def test_singular_posture_is_refused_or_damped(panda):
    servo = ImageBasedVisualServo(IN_HAND)
    T_WE, twist = panda.pose(panda.q), np.full(6, 0.1)
    flat = panda.jacobian(panda.q)
    flat[2] = flat[1]
    with pytest.raises(SingularMatrixError):
        servo.compute_joint_velocities(T_WE, twist, flat)
    assert np.isfinite(servo.compute_joint_velocities(T_WE, twist, flat, damping=0.05)).all()


@pytest.mark.parametrize(
    ("config", "missing"), [({}, "T_EC"), ({"mounting": "eye_to_hand"}, "T_WC")]
)
def test_joint_velocities_need_the_mounting(config, missing):
    servo = ImageBasedVisualServo(CAMERA | config)
    with pytest.raises(PoseError, match=missing):
        servo.compute_joint_velocities(np.eye(4), np.zeros(6), np.eye(6))


# The tutorial's doors


def test_the_three_doors_lead_to_the_same_laws():
    history = LAWS[0].simulate(SQUARE, START, GOAL, max_iterations=1)
    corners, wanted = history.points[0], history.goal_points
    depths, wanted_depths = transform_points(START, SQUARE)[:, 2], np.full(4, 0.75)
    image = ImageBasedVisualServo(CAMERA).compute_velocity(corners, wanted, depths)
    np.testing.assert_allclose(image, history.velocities[0])
    pose = PositionBasedVisualServo(CAMERA).compute_end_effector_velocity(START, GOAL)
    # By hand: v = 0.5 (t_C - R_CG t_G) with R_CG = R_CO here, w = -0.5 log(R_GC).
    t = START[:3, 3] - START[:3, :3] @ GOAL[:3, 3]
    np.testing.assert_allclose(pose[:3], 0.5 * t)
    np.testing.assert_allclose(pose[3:], 0.5 * np.radians([10, -10, 50]))
    depth_map = np.zeros((480, 640), np.float32)
    for (u, v), depth in zip(np.rint(corners).astype(int), depths):
        depth_map[v, u] = depth
    for alpha in 0.0, 0.3, 1.0:
        servo = HybridVisualServo(CAMERA, alpha=alpha, interaction="current")
        blend = servo.compute_velocity(START, corners, GOAL, wanted, depth_map)
        np.testing.assert_allclose(blend, alpha * pose + (1 - alpha) * image, atol=1e-7)
    extended = HybridVisualServo(CAMERA, scheme="2.5d")
    assert extended.compute_velocity(START, corners, GOAL, wanted, depth_map).shape == (6,)
    desired = ImageBasedVisualServo(CAMERA, interaction="desired")
    L = interaction_matrix(desired.camera.normalise(wanted), wanted_depths)
    expected = -0.5 * np.linalg.pinv(L) @ ((corners - wanted) / FOCAL).ravel()
    np.testing.assert_allclose(
        desired.compute_velocity(corners, wanted, depths, wanted_depths), expected
    )


def test_estimated_pose_is_the_pose():
    p = transform_points(START, SQUARE)
    servo = PositionBasedVisualServo(CAMERA)
    found = servo.estimate_pose(servo.camera.to_pixels(p[:, :2] / p[:, 2:]), p[:, 2], SQUARE)
    np.testing.assert_allclose(found, START, atol=1e-12)


# Input that must be refused


@pytest.mark.parametrize(
    ("matrix", "words"),
    [(np.eye(4), "3, 3"), (np.full((3, 3), np.nan), "finite"), (np.diag([-1.0, 1, 1]), "positive"),
     (np.diag([0.0, 1, 1]), "positive"), (np.diag([5.0, 5, 2]), "last row"), ("K", "numbers"),
     (K + [[0, 3, 0], [0, 0, 0], [0, 0, 0]], "skew")],
)  # fmt: skip
def test_what_is_no_camera_matrix_is_refused(matrix, words):
    with pytest.raises(CameraMatrixError, match=words):
        ImageBasedVisualServo({"intrinsics": matrix})


@pytest.mark.parametrize("depth", [0.0, -0.5, np.nan, np.inf, [1, 1, 1, 0], [1, 1, np.nan, 1]])
def test_impossible_depths_are_refused(depth):
    for servo in LAWS[0], LAWS[3]:
        with pytest.raises(DepthError, match="in front of the camera"):
            servo.step(ServoView(CORNERS, depth, START), ServoView(CORNERS + 5, 1.0, GOAL))


def test_missing_depths_are_refused_and_never_assumed():
    with pytest.raises(DepthError, match="none"):
        ImageBasedVisualServo(CAMERA).compute_velocity(CORNERS, CORNERS + 5)
    assumed = ImageBasedVisualServo(CAMERA, depth=0.8).compute_velocity(CORNERS, CORNERS + 5)
    told = ImageBasedVisualServo(CAMERA).compute_velocity(CORNERS, CORNERS + 5, Z=0.8)
    np.testing.assert_array_equal(assumed, told)


@pytest.mark.parametrize(
    ("seen", "wanted", "error"),
    [(CORNERS, CORNERS[:3], FeatureCountError), (CORNERS[:2], CORNERS[:2], FeatureCountError),
     (None, CORNERS, FeatureCountError), (CORNERS * np.nan, CORNERS, PointError),
     (CORNERS, CORNERS * np.inf, PointError), (CORNERS[0], CORNERS, PointError),
     (CORNERS - [230, 0], CORNERS, PointError), (CORNERS + [220, 0], CORNERS, PointError),
     (CORNERS, CORNERS + [0, 140], PointError),
     (CORNERS * [1, 0] + [0, 200], CORNERS, CollinearPointsError),
     (np.array([[10.0, 10], [20, 20], [30, 30], [400, 400]]), CORNERS, CollinearPointsError),
     (CORNERS, np.full((4, 2), 50.0), CollinearPointsError)],
)  # fmt: skip
def test_impossible_points_are_refused(seen, wanted, error):
    sized = CAMERA | {"width": 640, "height": 480}
    for servo in ImageBasedVisualServo(sized), HybridVisualServo(sized, scheme="2.5d"):
        with pytest.raises(error, match="points"):
            servo.step(ServoView(seen, 1.0, START), ServoView(wanted, 1.0, GOAL))


def test_counts_of_depths_must_match():
    with pytest.raises(FeatureCountError, match="4 points"):
        ImageBasedVisualServo(CAMERA).compute_velocity(CORNERS, CORNERS + 5, Z=[1.0, 1.0])


def test_the_goal_is_checked_again_when_it_is_written_into():
    servo, goal = ImageBasedVisualServo(CAMERA), CORNERS.copy()
    servo.compute_velocity(CORNERS, goal, 1.0)
    goal[0] = np.nan
    with pytest.raises(PointError):
        servo.compute_velocity(CORNERS, goal, 1.0)


@pytest.mark.parametrize("pixel", [(-1, 5), (5, -1), (10, 5), (5, 8), (np.nan, 5)])
def test_depth_outside_the_image_is_refused(pixel):
    with pytest.raises(PointError, match="depth image"):
        depths_from_image([pixel], np.ones((8, 10)))


@pytest.mark.parametrize("depth", [0, np.nan, -1])
def test_unknown_depth_in_the_image_is_refused(depth):
    depth_map = np.ones((8, 10), np.float32)
    depth_map[3, 4] = depth
    with pytest.raises(DepthError):
        PositionBasedVisualServo(CAMERA).estimate_3d_position((4, 3), depth_map)


@pytest.mark.parametrize(
    "T", [None, np.eye(3), np.eye(4) * np.nan, np.diag([1.0, 1, -1, 1]), np.diag([2.0, 2, 2, 1]),
          np.eye(4) + np.eye(4, k=-3)],
)  # fmt: skip
def test_what_is_no_pose_is_refused(T):
    for view, goal in (T, GOAL), (START, T):
        with pytest.raises(PoseError):
            PositionBasedVisualServo(CAMERA).compute_end_effector_velocity(view, goal)


@pytest.mark.parametrize(
    "make",
    [lambda: ImageBasedVisualServo(CAMERA, 0.0), lambda: ImageBasedVisualServo(CAMERA, np.nan),
     lambda: ImageBasedVisualServo(CAMERA, interaction="average"),
     lambda: HybridVisualServo(CAMERA, scheme="2d"), lambda: HybridVisualServo(CAMERA, alpha=1.5),
     lambda: ImageBasedVisualServo(CAMERA, dt=0), lambda: ImageBasedVisualServo({}),
     lambda: ImageBasedVisualServo(CAMERA, damping=-1), lambda: TwistLimits(0, 1),
     lambda: ImageBasedVisualServo(CAMERA, smooth_start=-1),
     lambda: ImageBasedVisualServo(CAMERA | {"widht": 640}), lambda: AdaptiveGain(1, 2),
     lambda: ImageBasedVisualServo(CAMERA | {"width": 640}),
     lambda: ImageBasedVisualServo(CAMERA | {"mounting": "ceiling"}),
     lambda: DepthFromMotion(0.0)],
)  # fmt: skip
def test_impossible_settings_are_refused(make):
    with pytest.raises(UserError):
        make()


def test_every_servo_error_is_a_user_error():
    assert all(issubclass(e, ServoError) for e in (DepthError, PointError, CollinearPointsError))
    assert issubclass(ServoError, UserError)


# The loop and its history


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


@pytest.mark.parametrize("servo", LAWS, ids=LAW_NAMES)
def test_history_holds_every_step_and_draws_itself(servo, tmp_path):
    history = servo.simulate(SQUARE, START, GOAL, max_iterations=30)
    k = history.iterations
    assert k == 30 and history.times[-1] == pytest.approx(29 * 0.04)
    assert history.poses.shape == (k, 4, 4) and history.velocities.shape == (k, 6)
    assert (history.condition_numbers >= 1).all()
    # Each pose is the one before, moved by the velocity recorded with it.
    np.testing.assert_allclose(
        history.poses[7], pose_exp(-0.04 * history.velocities[6]) @ history.poses[6], atol=1e-12
    )
    figure = history.plot(tmp_path / "sub" / "servo.png", title="test")
    assert (tmp_path / "sub" / "servo.png").stat().st_size > 20_000
    assert {"u (px)", "condition number"} <= {
        label for axes in figure.axes for label in (axes.get_xlabel(), axes.get_ylabel())
    }


def test_condition_number_is_that_of_the_interaction_matrix():
    history = LAWS[0].simulate(SQUARE, START, GOAL, max_iterations=1)
    p = transform_points(START, SQUARE)
    L = interaction_matrix(p[:, :2] / p[:, 2:], p[:, 2])
    assert history.condition_numbers[0] == pytest.approx(np.linalg.cond(L))
    history = LAWS[1].simulate(SQUARE, START, GOAL, max_iterations=1)
    turn = rotation_interaction(rotation_log((GOAL @ inverse_pose(START))[:3, :3]))
    assert history.condition_numbers[0] == pytest.approx(np.linalg.cond(turn))


def test_history_without_poses_or_points_still_draws(tmp_path):
    by_image = LAWS[0].run(
        lambda: ServoView(CORNERS + 5, 1.0), lambda v: None, ServoView(CORNERS, 1.0), 3
    )
    by_pose = LAWS[1].run(lambda: ServoView(T_CO=START), lambda v: None, ServoView(T_CO=GOAL), 3)
    for history in by_image, by_pose:
        history.plot(tmp_path / "servo.png")


@pytest.mark.slow
def test_demo_prints_the_table_and_draws(tmp_path, capsys, monkeypatch):
    some = [Row("right", 1.0, 1.0, 0.01), Row("wrong", 2.0, 1.0, 0.01)]
    monkeypatch.setattr("utils.servo_reference.rows", lambda: some)
    main(["--folder", str(tmp_path)])
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].split() == ["right", "1", "1", "yes"]
    assert lines[2].split() == ["wrong", "2", "1", "NO"]
    assert len(list(tmp_path.glob("*.png"))) == 5


@settings(max_examples=30)
@given(st.integers(0, 10_000))
def test_extended_control_keeps_the_centre_on_a_straight_line(seed):
    T_CO = random_start(np.random.default_rng(seed))
    history = LAWS[3].simulate(SQUARE, T_CO, NEAR_GOAL, max_iterations=120, tolerance=0)
    centres = history.poses[:, :2, 3] / history.poses[:, 2:3, 3]
    way = centres[-1] - centres[0]
    length = np.linalg.norm(way)
    off = np.abs((centres - centres[0]) @ np.array([-way[1], way[0]])) / length
    assert off.max() <= 0.02 * length + 1e-3  # a step's curvature; the image is about 1 wide
