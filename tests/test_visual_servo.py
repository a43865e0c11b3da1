"""The three laws: closed forms of their paths, refused input, the tutorial's calls."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.helpers.servo_cases import CORNERS, LAWS
from utils.errors import UserError
from utils.runs import REPOSITORY
from utils.servo_features import interaction_matrix, rotation_interaction
from utils.servo_reference import (
    CAMERA,
    FACING,
    FOCAL,
    GOAL,
    NEAR_GOAL,
    SQUARE,
    START,
    iterations_to_tolerance,
    random_start,
    turned,
)
from utils.transforms import inverse_pose, pose_exp, rotation_log, transform_points
from utils.visual_servo import (
    AdaptiveGain,
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
)


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


def path_length(history) -> float:
    """Metres that the camera travelled relative to the object."""
    positions = history.camera_poses[:, :3, 3]
    return float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())


def test_position_based_camera_goes_straight():
    history = LAWS[1].simulate(SQUARE, START, GOAL)
    chord = np.linalg.norm(history.camera_poses[0, :3, 3] - history.camera_poses[-1, :3, 3])
    assert path_length(history) == pytest.approx(chord, rel=1e-3)


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
    assert path_length(history) < 1e-6


def test_mean_matrix_at_90_degrees_is_refused_without_truncation():
    servo = ImageBasedVisualServo(CAMERA, interaction="mean")
    with pytest.raises(SingularMatrixError, match="truncation"):
        servo.simulate(SQUARE, turned(90), FACING)


@pytest.mark.parametrize("servo", [LAWS[1], LAWS[3]], ids=["position", "2.5d"])
@pytest.mark.parametrize("degrees", [90, 150, 178, 179.9, 180])
def test_pose_and_extended_control_turn_in_place(servo, degrees):
    history = servo.simulate(SQUARE, turned(degrees), FACING)
    assert history.converged
    assert path_length(history) < 1e-9
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


def test_condition_number_is_that_of_the_interaction_matrix():
    history = LAWS[0].simulate(SQUARE, START, GOAL, max_iterations=1)
    p = transform_points(START, SQUARE)
    L = interaction_matrix(p[:, :2] / p[:, 2:], p[:, 2])
    assert history.condition_numbers[0] == pytest.approx(np.linalg.cond(L))
    history = LAWS[1].simulate(SQUARE, START, GOAL, max_iterations=1)
    turn = rotation_interaction(rotation_log((GOAL @ inverse_pose(START))[:3, :3]))
    assert history.condition_numbers[0] == pytest.approx(np.linalg.cond(turn))


@pytest.mark.parametrize("depth", [0.0, -0.5, np.nan, np.inf, [1, 1, 1, 0], [1, 1, np.nan, 1]])
def test_impossible_depths_are_refused(depth):
    for servo in LAWS[0], LAWS[3]:
        with pytest.raises(DepthError, match="in front of the camera"):
            servo.step(ServoView(CORNERS, depth, START), ServoView(CORNERS + 5, 1.0, GOAL))


def test_missing_depths_are_refused_and_never_assumed():
    with pytest.raises(DepthError, match="none"):
        ImageBasedVisualServo(CAMERA).compute_velocity(CORNERS, CORNERS + 5)
    assumed = ImageBasedVisualServo(CAMERA, depth=0.8).compute_velocity(CORNERS, CORNERS + 5)
    direct = ImageBasedVisualServo(CAMERA).compute_velocity(CORNERS, CORNERS + 5, Z=0.8)
    np.testing.assert_array_equal(assumed, direct)


@pytest.mark.parametrize("interaction", ["current", "desired", "mean"])
def test_depths_are_learned_from_the_camera_s_motion_and_not_from_the_goal_s_points(interaction):
    """The way to a goal without depths is as long as with the true ones, and the estimates end at
    the goal's 0.75 m."""
    exact = ImageBasedVisualServo(CAMERA, interaction=interaction).simulate(SQUARE, START, GOAL)
    servo = ImageBasedVisualServo(CAMERA, interaction=interaction, depth=DepthFromMotion(0.4))
    T_CO = START

    def seen(T):
        p = transform_points(T, SQUARE)
        return ServoView(servo.camera.to_pixels(p[:, :2] / p[:, 2:]))

    def move(velocity):
        nonlocal T_CO
        T_CO = pose_exp(-servo.dt * velocity) @ T_CO

    history = servo.run(lambda: seen(T_CO), move, seen(GOAL))
    assert history.converged and history.iterations == pytest.approx(exact.iterations, abs=10)
    xy = servo.camera.normalise(history.points[-1])
    np.testing.assert_allclose(servo.depth.update(xy, np.zeros(6), servo.dt), 0.75, rtol=0.005)


def test_an_estimator_keeps_what_it_knows_when_a_single_point_is_asked_for():
    servo = ImageBasedVisualServo(CAMERA, depth=DepthFromMotion(0.4))
    with pytest.raises(DepthError, match="none"):
        servo.compute_interaction_matrix((404, 408))
    assert servo.compute_interaction_matrix((404, 408), Z=0.5).shape == (2, 6)


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
     lambda: DepthFromMotion(0.0), lambda: DepthFromMotion(1.0, noise=0),
     lambda: DepthFromMotion(1.0, noise=np.nan), lambda: DepthFromMotion(1.0, noise=-1)],
)  # fmt: skip
def test_impossible_settings_are_refused(make):
    with pytest.raises(UserError):
        make()


# --- The tutorial's calls ------------------------------------------------------------------------


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


def test_every_servo_error_is_a_user_error():
    assert all(issubclass(e, ServoError) for e in (DepthError, PointError, CollinearPointsError))
    assert issubclass(ServoError, UserError)


def test_the_example_of_the_docs_runs_as_printed(tmp_path, monkeypatch, capsys):
    """docs/servo.md compares gains; its table holds what the example prints."""
    page = (REPOSITORY / "docs" / "servo.md").read_text(encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    exec(re.search(r"```python\n(.*?)```", page, re.DOTALL).group(1), {})
    assert (tmp_path / "gains.png").stat().st_size > 20_000
    lines = capsys.readouterr().out.splitlines()
    printed = [re.search(r"after (\d+) iterations (\S+) mm off", line).groups() for line in lines]
    rows = re.findall(r"^\| [^|]+ \| (\d+) \| ([\d.]+) \| ([\d.]+) mm \|$", page, re.MULTILINE)
    assert [(images, off) for images, _, off in rows] == printed and len(rows) == 4
    assert [float(seconds) for _, seconds, _ in rows] == [
        pytest.approx(int(images) * 0.04, abs=0.05) for images, _, _ in rows
    ]
