"""The record of a run and its pictures."""

from __future__ import annotations

import numpy as np
import pytest

from tests.helpers.servo_cases import CORNERS, LAW_NAMES, LAWS
from utils.errors import UserError
from utils.servo_history import plot_histories
from utils.servo_loop import ServoView
from utils.servo_reference import CAMERA, GOAL, SQUARE, START
from utils.transforms import pose_exp
from utils.visual_servo import PositionBasedVisualServo


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


def test_every_panel_has_its_curves_with_labels_and_units():
    history = LAWS[0].simulate(SQUARE, START, GOAL, max_iterations=10)
    figure = history.plot()
    panels = {(axes.get_xlabel(), axes.get_ylabel()): axes for axes in figure.axes}
    time = "time (s)"
    velocities = {
        ("linear velocity (m/s)", "vx vy vz"): slice(0, 3),
        ("angular velocity (rad/s)", "ωx ωy ωz"): slice(3, 6),
    }
    for (label, names), part in velocities.items():
        axes = panels[time, label]
        assert [line.get_label() for line in axes.get_lines()] == names.split()
        for line, values in zip(axes.get_lines(), history.velocities.T[part]):
            np.testing.assert_array_equal(line.get_xdata(), history.times)
            np.testing.assert_array_equal(line.get_ydata(), values)
    errors = panels[time, "error, each component"].get_lines()
    np.testing.assert_array_equal(np.array([line.get_ydata() for line in errors]), history.errors.T)
    (condition,) = panels[time, "condition number"].get_lines()
    np.testing.assert_array_equal(condition.get_ydata(), history.condition_numbers)
    image = panels["u (px)", "v (px)"]
    named = [line.get_label() for line in image.get_lines()][-3:]
    assert named == ["start", "end", "goal"] and image.yaxis_inverted()
    assert panels["x (m)", "y (m)"].get_zlabel() == "z (m)"


def test_history_without_poses_or_points_still_draws(tmp_path):
    by_image = LAWS[0].run(
        lambda: ServoView(CORNERS + 5, 1.0), lambda v: None, ServoView(CORNERS, 1.0), 3
    )
    by_pose = LAWS[1].run(lambda: ServoView(T_CO=START), lambda v: None, ServoView(T_CO=GOAL), 3)
    for name, history in {"image": by_image, "pose": by_pose}.items():
        figure = history.plot(tmp_path / f"{name}.png")
        assert (tmp_path / f"{name}.png").stat().st_size > 20_000
        panels = {axes.get_xlabel() + axes.get_ylabel(): axes for axes in figure.axes}
        assert len(panels["time (s)linear velocity (m/s)"].get_lines()) == 3
        image, path = panels["u (px)v (px)"], panels["x (m)y (m)"]
        if name == "image":
            assert path.get_title() == "camera path unknown: no poses" and not path.get_lines()
            assert len(image.get_lines()) == len(CORNERS) + 3
        else:
            assert [text.get_text() for text in image.texts] == ["the views hold no points"]
            assert len(path.get_lines()) > 1 and not image.get_lines()


def test_runs_are_compared_in_one_picture(tmp_path):
    runs = {
        f"gain {gain}": PositionBasedVisualServo(CAMERA, gain).simulate(SQUARE, START, GOAL)
        for gain in (1.0, 2.0)
    }
    figure = plot_histories(runs, tmp_path / "gains.png")
    assert (tmp_path / "gains.png").stat().st_size > 20_000
    # The angle shrinks by 1 - gain dt a step.
    last = [line.get_ydata()[50] for line in figure.axes[1].get_lines()]
    assert last[1] / last[0] == pytest.approx((0.92 / 0.96) ** 50)
    names = [text.get_text() for text in figure.axes[1].get_legend().get_texts()]
    assert [name.split(":")[0] for name in names] == ["gain 1.0", "gain 2.0"]


def test_a_picture_that_cannot_be_drawn_leaves_the_one_before(tmp_path):
    history = LAWS[0].simulate(SQUARE, START, GOAL, max_iterations=5)
    path = tmp_path / "servo.png"
    history.plot(path)
    before = path.read_bytes()
    with pytest.raises(ValueError):  # mathtext that has no end fails within the drawing
        history.plot(path, title="$\\frac{$")
    assert path.read_bytes() == before
    path.unlink()
    path.mkdir()
    with pytest.raises(UserError, match="servo.png: exists and is no file"):
        history.plot(path)


def test_a_picture_has_the_format_of_its_name_and_else_is_a_png(tmp_path):
    history = LAWS[0].simulate(SQUARE, START, GOAL, max_iterations=5)
    history.plot(tmp_path / "servo.svg")
    history.plot(tmp_path / "servo")
    assert "<svg" in (tmp_path / "servo.svg").read_text()
    assert (tmp_path / "servo.png").read_bytes().startswith(b"\x89PNG")
