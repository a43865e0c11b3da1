"""The loop that every visual servo shares: from a view to a twist, until the camera sees its goal.

A control law is a subclass of `VisualServo` that says which displacement of the camera would null
the error (`utils.visual_servo`). Everything else stands here: gain, smooth start, limits, the loop
around any camera and any robot, and an ideal camera to try a law on. This module knows no
simulator.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from math import exp, sqrt
from typing import NamedTuple

import numpy as np

from utils.errors import DepthError, FeatureCountError, PointError, ServoError, UserError
from utils.servo_control import AdaptiveGain, TwistLimits, camera_jacobian, joint_velocities
from utils.servo_features import (
    ServoCamera,
    check_depths,
    check_pose,
    points_from_depths,
    pose_from_points,
)
from utils.servo_history import ServoHistory
from utils.transforms import pose_exp

STALLED = 1e-12  # m and rad: a smaller correction does not move a camera


class ServoView(NamedTuple):
    """What a camera sees, or should see at its goal. What a law does not use may be None.

    points: (n, 2) pixels. depths: (n,) or one for all, metres along the optical axis.
    T_CO: (4, 4) pose of the object in the camera.
    """

    points: np.ndarray | None = None
    depths: np.ndarray | float | None = None
    T_CO: np.ndarray | None = None


class ServoCommand(NamedTuple):
    """What a law answers to one view.

    velocity: (6,) desired v_C. error: (m,) in the law's units. condition_number: of the
    interaction matrix. gain: 1/s. correction: (6,) metres and radians in C, minus the displacement
    that is left to the goal; velocity is -gain times it, before smooth start and limits.
    """

    velocity: np.ndarray
    error: np.ndarray
    condition_number: float
    gain: float
    correction: np.ndarray


class VisualServo(ABC):
    """What the laws share: gain, smooth start, limits, the loop, and the arm behind the camera.

    A law implements `_correct`, the displacement that would null the error at once.

    image_based: whether the law compares images, so that its goal has to be a view that the camera
    itself has shown, and not one computed with a calibration.
    """

    image_based = False

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
        limits: largest speeds; None sets no limit. damping, truncation: see `pseudo_inverse`.
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
        """Forget the run so far: the next step is the first one of a smooth start."""
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

        see() returns the present ServoView; move(v_C) makes the camera move with v_C until the next
        call. The last command is zero, however the run ends. Bad input in the first view raises a
        ServoError; in a later view it ends the run, and the history holds the reason.
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
        """Servo an ideal camera, which moves exactly with the commanded velocity.

        points_O: (n, 3) points of the object. T_CO, T_GO: (4, 4) the object in the camera at the
        start and at the goal. depth_factor: the views hold the true depths times this factor, or
        no depths for None. pixel_noise: standard deviation of each coordinate in pixels, drawn
        from `rng`; the views' pose is then fitted to the noisy points at their true depths.
        """
        camera = _SimulatedCamera(self, points_O, T_CO, depth_factor, pixel_noise, rng)
        ideal = _SimulatedCamera(self, points_O, T_GO, 1.0, 0.0, None)
        history = self.run(camera.see, camera.move, ideal.see(), max_iterations, tolerance)
        true = camera.poses[: history.iterations]  # and not the fitted ones
        history.poses[:] = np.reshape(true, history.poses.shape)
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
        first. secondary: (n,) desired joint velocities of a second task, of which the part that
        does not change v_C is added. damping: of the Jacobian's inverse. The camera's mounting
        comes from camera_config. Raises SingularMatrixError in a singular posture without damping.
        """
        T_WE = check_pose("end_effector_pose", end_effector_pose)
        camera = self.camera
        J = camera_jacobian(camera.mounting, T_WE, jacobian, camera.T_EC, camera.T_WC)
        return joint_velocities(J, velocity, secondary, damping)

    def pixel_to_3d(self, u: float, v: float, Z: float) -> np.ndarray:
        """(3,) point in C, metres, seen at pixel (u, v) and depth Z."""
        xy = self.camera.normalise_unchecked(np.array([[u, v]], dtype=float))
        if not np.isfinite(xy).all():
            raise PointError(f"point: not finite: {(u, v)}")
        return points_from_depths(xy, check_depths(Z, 1))[0]

    @abstractmethod
    def _correct(self, view: ServoView, goal: ServoView) -> tuple[np.ndarray, np.ndarray, float]:
        """Error (m,), L^+ error (6,), condition number of L."""

    def _matched_points(self, view: ServoView, goal: ServoView) -> tuple[np.ndarray, np.ndarray]:
        """Normalised coordinates (n, 2) of the points in the view and in the goal, checked."""
        if view.points is None or goal.points is None:
            raise FeatureCountError("points: needed in the view and in the goal, got None")
        xy, xy_goal = self.camera.normalise(view.points), self._goal_xy(goal.points)
        if len(xy) != len(xy_goal):
            raise FeatureCountError(
                f"points: the view has {len(xy)} and the goal has {len(xy_goal)}; give as many"
            )
        return xy, xy_goal

    def _goal_xy(self, points) -> np.ndarray:
        """Normalised coordinates of the goal's points; a goal is checked only once."""
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
        """The history of a run that answered each of `views` with one of `steps`; without points
        where the views differ in how many they hold."""
        unknown = np.full((4, 4), np.nan)
        no_points = np.empty((0, 2))
        points = [no_points if v.points is None else np.asarray(v.points) for v in views]
        if len({seen.shape for seen in points}) > 1:
            points = [no_points] * len(views)
        k = len(steps)
        return ServoHistory(
            poses=np.reshape([unknown if v.T_CO is None else v.T_CO for v in views], (k, 4, 4)),
            goal_pose=unknown if goal.T_CO is None else np.asarray(goal.T_CO),
            points=np.array(points) if k else np.empty((0, 0, 2)),
            goal_points=no_points if goal.points is None else np.asarray(goal.points),
            errors=np.array([s.error for s in steps]) if k else np.empty((0, 0)),
            velocities=np.reshape([s.velocity for s in steps], (k, 6)),
            condition_numbers=np.array([s.condition_number for s in steps]),
            gains=np.array([s.gain for s in steps]),
            dt=self.dt,
            converged=converged,
            reason=reason,
        )


class _SimulatedCamera:
    """An ideal camera in front of points; it moves exactly with the commanded velocity."""

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
        seen_depths = None if self.depth_factor is None else depths * self.depth_factor
        return ServoView(pixels, seen_depths, T_CO)

    def move(self, velocity: np.ndarray) -> None:
        self.T_CO = pose_exp(-self.dt * velocity) @ self.T_CO
