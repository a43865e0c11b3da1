"""What a servo did, step by step, and pictures of it.

Knows no control law; only what each step recorded.

The loop that every visual servo shares: from a view to a twist, and on until the goal is seen.

Knows neither how a law corrects an error nor a simulator; see `utils.visual_servo` for the laws and
the frames.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import exp, sqrt
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from utils.errors import DepthError, FeatureCountError, PointError, ServoError, UserError
from utils.servo_control import AdaptiveGain, TwistLimits, camera_jacobian, joint_velocities
from utils.servo_features import (
    ServoCamera,
    check_depths,
    check_pose,
    points_from_depths,
    pose_from_points,
)
from utils.transforms import pose_exp, rotation_log

FRAME_COLOURS = ("tab:red", "tab:green", "tab:blue")  # x, y, z


@dataclass(frozen=True)
class ServoHistory:
    """One row for each of the k images that the servo looked at, the first and last included.

    poses: (k, 4, 4) T_CO of the object in the camera; NaN where it was not known.
    goal_pose: (4, 4) T_CO wanted; NaN where it was not given.
    points: (k, n, 2) pixels, or (k, 0, 2) where only poses were used. goal_points: (n, 2).
    errors: (k, m), in the law's own units. velocities: (k, 6) v_C commanded, m/s and rad/s.
    condition_numbers: (k,). gains: (k,) 1/s. dt: seconds between images.
    converged: whether the error's norm came under the tolerance. reason: why it ended.
    """

    poses: np.ndarray
    goal_pose: np.ndarray
    points: np.ndarray
    goal_points: np.ndarray
    errors: np.ndarray
    velocities: np.ndarray
    condition_numbers: np.ndarray
    gains: np.ndarray
    dt: float
    converged: bool
    reason: str

    @property
    def iterations(self) -> int:
        """Images looked at, the one that was found good enough included."""
        return len(self.errors)

    @property
    def times(self) -> np.ndarray:
        """(k,) seconds since the first image."""
        return np.arange(self.iterations) * self.dt

    @property
    def error_norms(self) -> np.ndarray:
        """(k,) Euclidean norms of the errors."""
        return np.linalg.norm(self.errors, axis=1)

    @property
    def camera_poses(self) -> np.ndarray:
        """(k, 4, 4) T_OC of the camera in the object's frame."""
        return np.linalg.inv(self.poses)

    @property
    def distances(self) -> np.ndarray:
        """(k,) metres between camera and object origin."""
        return np.linalg.norm(self.poses[:, :3, 3], axis=1)

    @property
    def path_length(self) -> float:
        """Metres that the camera travelled."""
        positions = self.camera_poses[:, :3, 3]
        return float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())

    def pose_errors(self) -> tuple[np.ndarray, np.ndarray]:
        """(k,) metres and (k,) radians between the camera's pose and the wanted one."""
        T = self.goal_pose @ self.camera_poses  # T_GC: the camera seen from its goal
        turns = [np.linalg.norm(rotation_log(R)) for R in T[:, :3, :3]]
        return np.linalg.norm(T[:, :3, 3], axis=1), np.array(turns)

    def plot(self, path: Path | str | None = None, title: str = "") -> Figure:
        """Errors, velocities, condition number, image trajectories and the camera's 3-D path.

        Also writes a picture where `path` names one.
        """
        figure = Figure(figsize=(13, 7.5), layout="constrained")
        figure.suptitle(f"{title}: {self.reason}" if title else self.reason)
        panels = [figure.add_subplot(2, 3, i) for i in (1, 2, 3, 4)]
        self._plot_errors(panels[0])
        self._plot_velocities(panels[1], slice(0, 3), "linear velocity (m/s)", "v")
        self._plot_velocities(panels[3], slice(3, 6), "angular velocity (rad/s)", "ω")
        self._plot_condition(panels[2])
        self._plot_image(figure.add_subplot(2, 3, 5))
        self._plot_path(figure.add_subplot(2, 3, 6, projection="3d"))
        if path is not None:
            Path(path).parent.mkdir(parents=True, exist_ok=True)
            figure.savefig(path, dpi=90)
        return figure

    def _plot_errors(self, axes: Axes) -> None:
        axes.plot(self.times, self.errors, linewidth=0.8)
        axes.set(xlabel="time (s)", ylabel="error, each component")
        log = axes.twinx()
        log.semilogy(self.times, self.error_norms, "k--", linewidth=1.5)
        log.set_ylabel("norm of the error (dashed)")
        axes.grid(True, alpha=0.3)

    def _plot_velocities(self, axes: Axes, part: slice, label: str, letter: str) -> None:
        for values, axis, colour in zip(self.velocities.T[part], "xyz", FRAME_COLOURS):
            axes.plot(self.times, values, color=colour, label=f"{letter}{axis}")
        axes.set(xlabel="time (s)", ylabel=label)
        axes.grid(True, alpha=0.3)
        axes.legend(loc="best", fontsize="small")

    def _plot_condition(self, axes: Axes) -> None:
        axes.semilogy(self.times, self.condition_numbers, color="tab:purple")
        axes.set(xlabel="time (s)", ylabel="condition number")
        axes.grid(True, alpha=0.3)

    def _plot_image(self, axes: Axes) -> None:
        axes.set(xlabel="u (px)", ylabel="v (px)", title="points in the image")
        if not self.points.size:
            axes.text(0.5, 0.5, "no points were used", ha="center", transform=axes.transAxes)
            return
        for i in range(self.points.shape[1]):
            axes.plot(*self.points[:, i].T, linewidth=1)
        for corners, style, label in (
            (self.points[0], "ko--", "start"),
            (self.points[-1], "ks-", "end"),
            (self.goal_points, "r*", "goal"),
        ):
            outline = np.vstack([corners, corners[:1]])
            axes.plot(*outline.T, style, linewidth=0.6, markersize=5, fillstyle="none", label=label)
        axes.set_aspect("equal", adjustable="datalim")
        axes.invert_yaxis()  # v grows downwards
        axes.grid(True, alpha=0.3)
        axes.legend(loc="best", fontsize="small")

    def _plot_path(self, axes) -> None:
        axes.set(xlabel="x (m)", ylabel="y (m)", zlabel="z (m)", title="camera, object at 0")
        T = self.camera_poses
        if not np.isfinite(T).all():
            axes.set_title("camera path unknown: no poses")
            return
        positions = T[:, :3, 3]
        axes.plot(*positions.T, color="black", linewidth=1)
        length = 0.12 * float(np.ptp(np.vstack([positions, np.zeros(3)]), axis=0).max())
        for i in np.unique(np.linspace(0, len(T) - 1, 8).astype(int)):
            for axis, colour in enumerate(FRAME_COLOURS):
                tip = positions[i] + length * T[i, :3, axis]
                axes.plot(*np.column_stack([positions[i], tip]), color=colour, linewidth=1)
        axes.scatter(0, 0, 0, color="tab:orange", marker="s", label="object")
        if np.isfinite(self.goal_pose).all():
            goal = np.linalg.inv(self.goal_pose)[:3, 3]
            axes.scatter(*goal, color="tab:red", marker="*", s=60, label="goal")
        axes.invert_zaxis()  # the camera looks along +z, so a camera above the object has z < 0
        half = 0.25 * float(np.ptp(np.vstack([positions, np.zeros(3)]), axis=0).max())
        for axis, values in (("x", positions[:, 0]), ("y", positions[:, 1])):
            # A straight path would make the box so thin that its labels overlap.
            getattr(axes, f"set_{axis}lim")(min(values.min(), -half), max(values.max(), half))
        axes.locator_params(nbins=4)
        axes.set_aspect("equal")
        axes.legend(loc="upper left", fontsize="small")


STALLED = 1e-12  # a correction this small (m, rad) will never move a camera


class ServoView(NamedTuple):
    """What a camera saw, or should see. What a law does not use may be None.

    points: (n, 2) pixels. depths: (n,) or one for all, metres along the optical axis.
    T_CO: (4, 4) pose of the object in the camera.
    """

    points: np.ndarray | None = None
    depths: np.ndarray | float | None = None
    T_CO: np.ndarray | None = None


class ServoCommand(NamedTuple):
    """velocity: (6,) v_C. error: (m,) in the law's units. gain: 1/s.

    correction: (6,) minus the way still to go, metres and radians in C; velocity is -gain times
    it, before smooth start and limits.
    """

    velocity: np.ndarray
    error: np.ndarray
    condition_number: float
    gain: float
    correction: np.ndarray


class VisualServo(ABC):
    """What the three laws share: gain, smooth start, limits, the loop, and the arm behind it.

    A law only says, in `_correct`, which displacement would null the error at once.
    """

    def __init__(
        self,
        camera_config: Mapping,
        lambda_: float | AdaptiveGain = 0.5,
        *,
        dt: float = 0.04,
        smooth_start: float | None = None,
        limits: TwistLimits | None = None,
        damping: float = 0.0,
        truncation: float = 0.0,
    ):
        """camera_config: {"intrinsics": K, ...}, see `ServoCamera.from_config`.
        lambda_: gain, 1/s, or an AdaptiveGain. dt: seconds between two steps.
        smooth_start: mu, 1/s; the velocity grows from zero as 1 - exp(-mu t); None starts at once.
        limits: largest speeds; None for none. damping, truncation: see `pseudo_inverse`.
        Raises CameraMatrixError or UserError.
        """
        self.camera = ServoCamera.from_config(camera_config)
        if not isinstance(lambda_, AdaptiveGain) and not 0.0 < lambda_ < np.inf:
            raise UserError(f"lambda_: expected a positive gain in 1/s, got {lambda_}")
        if not 0.0 < dt < np.inf:
            raise UserError(f"dt: expected a positive time in seconds, got {dt}")
        for name, value in (("damping", damping), ("truncation", truncation)):
            if not 0.0 <= value < np.inf:
                raise UserError(f"{name}: expected zero or a positive number, got {value}")
        if smooth_start is not None and not 0.0 < smooth_start < np.inf:
            raise UserError(f"smooth_start: expected a positive rate in 1/s, got {smooth_start}")
        self.lambda_ = lambda_
        self.dt = dt
        self.smooth_start = smooth_start
        self.limits = limits
        self.damping = damping
        self.truncation = truncation
        self._goal: tuple[tuple[bytes, tuple], np.ndarray] | None = None
        self.reset()

    @property
    def K(self) -> np.ndarray:
        """(3, 3) pinhole matrix, pixels."""
        return self.camera.K

    def reset(self) -> None:
        """Begin anew: the next step is the first one of a smooth start."""
        self._time = 0.0
        self._first_correction: np.ndarray | None = None
        self._velocity = np.zeros(6)

    def step(self, view: ServoView, goal: ServoView) -> ServoCommand:
        """The twist that brings `view` towards `goal`. Raises a ServoError on bad input."""
        error, correction, condition = self._correct(view, goal)
        gain = self.lambda_
        if isinstance(gain, AdaptiveGain):
            gain = gain(float(np.abs(correction).max()))
        velocity = -gain * correction
        if self.smooth_start is not None:
            if self._first_correction is None:
                self._first_correction = correction
            fading = exp(-self.smooth_start * self._time)
            velocity = velocity + gain * fading * self._first_correction
        if self.limits is not None:
            velocity = self.limits.scale(velocity)
        self._time += self.dt
        self._velocity = velocity
        self._stalled = correction @ correction < STALLED**2
        return ServoCommand(velocity, error, condition, gain, correction)

    def run(
        self,
        see: Callable[[], ServoView],
        move: Callable[[np.ndarray], object],
        goal: ServoView,
        max_iterations: int = 3000,
        tolerance: float = 1e-5,
    ) -> ServoHistory:
        """See and move until the error's norm is under `tolerance`.

        see() returns the present ServoView; move(v_C) has the camera move with v_C until the next call.
        However it ends, the last command is zero. Bad input in the first view raises; later on, a
        lost feature set ends the run with the reason in the history.
        """
        self.reset()
        views: list[ServoView] = []
        steps: list[ServoCommand] = []
        converged, reason = False, f"stopped after {max_iterations} iterations"
        try:
            while len(steps) < max_iterations:
                try:
                    view = see()
                    step = self.step(view, goal)
                except ServoError as error:
                    if not steps:
                        raise
                    reason = f"stopped by {type(error).__name__}: {error}"
                    break
                views.append(view)
                steps.append(step)
                if sqrt(step.error @ step.error) < tolerance:
                    converged, reason = True, f"converged after {len(steps)} iterations"
                    break
                if self._stalled:
                    reason = "stopped: no motion reduces what is left of the error"
                    break
                move(step.velocity)
        finally:
            move(np.zeros(6))
        return self.history(views, steps, goal, converged, reason)

    def simulate(
        self,
        points_O: np.ndarray,
        T_CO: np.ndarray,
        T_GO: np.ndarray,
        *,
        depth_factor: float | None = 1.0,
        pixel_noise: float = 0.0,
        rng: np.random.Generator | None = None,
        max_iterations: int = 3000,
        tolerance: float = 1e-5,
    ) -> ServoHistory:
        """Servo an ideal camera that moves exactly as told.

        points_O: (n, 3) points of the object. T_CO, T_GO: (4, 4) the object in the camera at the
        start and at the goal. depth_factor: the depths told are the true ones times this; None
        tells none. pixel_noise: standard deviation of each coordinate in pixels, from `rng`; the
        pose told is then the one fitted to the noisy points at their true depths.
        """
        camera = _SimulatedCamera(self, points_O, T_CO, depth_factor, pixel_noise, rng)
        ideal = _SimulatedCamera(self, points_O, T_GO, 1.0, 0.0, None)
        history = self.run(camera.see, camera.move, ideal.see(), max_iterations, tolerance)
        history.poses[:] = camera.poses[: history.iterations]  # the true ones, not those told
        return history

    def compute_joint_velocities(
        self,
        end_effector_pose: np.ndarray,
        velocity: np.ndarray,
        jacobian: np.ndarray,
        secondary: np.ndarray | None = None,
        damping: float = 0.0,
    ) -> np.ndarray:
        """Joint velocities (n,) that give the camera the twist v_C relative to what it looks at.

        end_effector_pose: (4, 4) T_WE. jacobian: (6, n) of E's origin in the axes of W, linear
        first. secondary: (n,) wished joint velocities, done as far as they leave v_C alone. The
        camera's mounting comes from camera_config. Raises SingularMatrixError in a singular
        posture unless damped.
        """
        T_WE = check_pose("end_effector_pose", end_effector_pose)
        camera = self.camera
        J = camera_jacobian(camera.mounting, T_WE, jacobian, camera.T_EC, camera.T_WC)
        return joint_velocities(J, velocity, secondary, damping)[0]

    def pixel_to_3d(self, u: float, v: float, Z: float) -> np.ndarray:
        """(3,) point in C, metres, seen at pixel (u, v) and depth Z."""
        xy = self.camera.normalise_unchecked(np.array([[u, v]], dtype=float))
        if not np.isfinite(xy).all():
            raise PointError(f"point: not finite: {(u, v)}")
        return points_from_depths(xy, check_depths(Z, 1))[0]

    @abstractmethod
    def _correct(self, view: ServoView, goal: ServoView) -> tuple[np.ndarray, np.ndarray, float]:
        """Error (m,), L^+ error (6,), condition number of L."""

    def _goal_xy(self, points) -> np.ndarray:
        """Normalised coordinates of the goal's points: checked once, not in every step."""
        points = np.asarray(points, dtype=float)
        # Compared by value, as the caller may write into the array.
        content = points.tobytes(), points.shape
        if self._goal is None or self._goal[0] != content:
            self._goal = content, self.camera.normalise(points)
        return self._goal[1]

    def history(
        self,
        views: list[ServoView],
        steps: list[ServoCommand],
        goal: ServoView,
        converged: bool,
        reason: str,
    ) -> ServoHistory:
        """What a run that saw `views` and answered with `steps`, one each, leaves behind."""
        unknown = np.full((4, 4), np.nan)
        no_points = np.empty((0, 2))
        return ServoHistory(
            poses=np.array([unknown if v.T_CO is None else v.T_CO for v in views]),
            goal_pose=unknown if goal.T_CO is None else np.asarray(goal.T_CO),
            points=np.array([no_points if v.points is None else v.points for v in views]),
            goal_points=no_points if goal.points is None else np.asarray(goal.points),
            errors=np.array([s.error for s in steps]),
            velocities=np.array([s.velocity for s in steps]),
            condition_numbers=np.array([s.condition_number for s in steps]),
            gains=np.array([s.gain for s in steps]),
            dt=self.dt,
            converged=converged,
            reason=reason,
        )


class _SimulatedCamera:
    """An ideal camera in front of points: sees them where they are and moves as it is told."""

    def __init__(self, servo: VisualServo, points_O, T_CO, depth_factor, pixel_noise, rng):
        if pixel_noise and rng is None:
            raise UserError("simulate: pixel_noise needs an rng, so that the run can be repeated")
        self.camera, self.dt = servo.camera, servo.dt
        self.points_O = np.asarray(points_O, dtype=float)
        if self.points_O.ndim != 2 or self.points_O.shape[1] != 3:
            raise FeatureCountError(f"points_O: expected (n, 3), got {self.points_O.shape}")
        self.T_CO = check_pose("T_CO", T_CO)
        self.depth_factor, self.pixel_noise, self.rng = depth_factor, pixel_noise, rng
        self.poses: list[np.ndarray] = []

    def see(self) -> ServoView:
        T_CO = self.T_CO
        self.poses.append(T_CO)
        points_C = self.points_O @ T_CO[:3, :3].T + T_CO[:3, 3]
        depths = points_C[:, 2]
        if not depths.min() > 0.0:
            raise DepthError(f"depths: behind the camera: {depths.round(4).tolist()}")
        pixels = self.camera.to_pixels(points_C[:, :2] / depths[:, None])
        if self.pixel_noise:
            pixels = pixels + self.rng.normal(0.0, self.pixel_noise, pixels.shape)
            xy = self.camera.normalise_unchecked(pixels)
            T_CO = pose_from_points(points_from_depths(xy, depths), self.points_O)
        told = None if self.depth_factor is None else depths * self.depth_factor
        return ServoView(pixels, told, T_CO)

    def move(self, velocity: np.ndarray) -> None:
        self.T_CO = pose_exp(-self.dt * velocity) @ self.T_CO
