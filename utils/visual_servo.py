"""Visual servoing: move a camera until it sees what it should see. The tutorial's chapter 4.

    servo = ImageBasedVisualServo({"intrinsics": K}, lambda_=0.5)
    step = servo.step(ServoView(pixels, depths), ServoView(goal_pixels))    # one image: a twist
    history = servo.run(see, move, goal)        # a whole run, with any camera and any robot
    history = servo.simulate(points_O, T_CO, T_GO)      # the same with an ideal camera

The three control laws stand here: image-based, position-based, and both together. A law says which
displacement of the camera would null the difference between what the camera sees and what it should
see; `utils.servo_loop` turns that displacement into a twist and closes the loop. What else users of
the laws need can be imported from here as well. This module knows no simulator; docs/servo.md
explains the laws, and `python -m utils.visual_servo` repeats known results and draws them
(`utils.servo_reference`).

Frames: C camera (x right, y down, z forward), O object, G the camera at its goal. Twists are
v_C = (v, w), m/s and rad/s, of the camera in its own frame. Formulas: Chaumette and Hutchinson,
"Visual servo control, parts I and II", IEEE Robotics and Automation Magazine 13(4), 2006 and 14(1),
2007; 2 1/2-D: Malis, Chaumette and Boudet, IEEE T-RA 15(2), 1999.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import sin, sqrt
from typing import Any

import numpy as np

from utils.errors import (
    CameraMatrixError,
    CollinearPointsError,
    DepthError,
    FeatureCountError,
    PointError,
    PoseError,
    ServoError,
    SingularMatrixError,
    UserError,
    unknown_choice,
)
from utils.servo_control import (
    AdaptiveGain,
    TwistLimits,
    joint_limit_avoidance,
    pseudo_inverse,
)
from utils.servo_features import (
    DepthFromMotion,
    check_depths,
    check_pose,
    depths_from_image,
    extended_interaction,
    interaction_matrix,
    points_from_depths,
    rotation_interaction,
)
from utils.servo_history import ServoHistory
from utils.servo_loop import ServoCommand, ServoView, VisualServo
from utils.transforms import inverse_pose, rotation_log, transform_points

__all__ = [
    "AdaptiveGain",
    "CameraMatrixError",
    "CollinearPointsError",
    "DepthError",
    "DepthFromMotion",
    "FeatureCountError",
    "HybridVisualServo",
    "ImageBasedVisualServo",
    "PointError",
    "PoseError",
    "PositionBasedVisualServo",
    "ServoCommand",
    "ServoError",
    "ServoHistory",
    "ServoView",
    "SingularMatrixError",
    "TwistLimits",
    "VisualServo",
    "joint_limit_avoidance",
]

INTERACTIONS = ("current", "desired", "mean")
SCHEMES = ("blend", "2.5d")


class ImageBasedVisualServo(VisualServo):
    """v_C = -gain L^+ (s - s*), s the normalised coordinates of three or more points."""

    image_based = True

    def __init__(
        self,
        camera_config: Mapping,
        lambda_: float | AdaptiveGain = 0.5,
        *,
        interaction: str = "current",
        depth: float | DepthFromMotion | None = None,
        **options: Any,
    ) -> None:
        """interaction: L at the current view, at the desired one, or the mean of both.
        depth: used where a view has no depths: metres for all points, or an estimator, whose depths
        in the current view then serve for the desired one, too; with None a view without depths is
        a DepthError. options: see `VisualServo`.
        """
        if interaction not in INTERACTIONS:
            raise unknown_choice("interaction", interaction, INTERACTIONS)
        self.interaction = interaction
        self.depth = depth
        super().__init__(camera_config, lambda_, **options)

    def reset(self) -> None:
        super().reset()
        if isinstance(self.depth, DepthFromMotion):
            self.depth.reset()

    def compute_interaction_matrix(
        self, point: Sequence[float], Z: float | None = None
    ) -> np.ndarray:
        """(2, 6) L of one pixel (u, v) at depth Z, metres; in normalised coordinates."""
        xy = self.camera.normalise_unchecked(np.array([point], dtype=float))
        if not np.isfinite(xy).all():
            raise PointError(f"point: not finite: {point}")
        # An estimator knows the depths of a step's points alone.
        known = None if isinstance(self.depth, DepthFromMotion) else self.depth
        return interaction_matrix(xy, _depths(Z, known, 1))

    def compute_velocity(
        self,
        current_points: np.ndarray,
        desired_points: np.ndarray,
        Z: np.ndarray | float | None = None,
        desired_Z: np.ndarray | float | None = None,
    ) -> np.ndarray:
        """(6,) v_C from current and desired pixels (n, 2).

        Z: current depths, (n,) or one for all points, metres. desired_Z: depths at the goal, which
        only the desired and the mean interaction matrix use; None takes Z for them.
        """
        desired_Z = Z if desired_Z is None else desired_Z
        goal = ServoView(desired_points, desired_Z)
        return self.step(ServoView(current_points, Z), goal).velocity

    def _correct(self, view: ServoView, goal: ServoView) -> tuple[np.ndarray, np.ndarray, float]:
        xy, xy_goal = self._matched_points(view, goal)
        error = (xy - xy_goal).ravel()
        known: np.ndarray | float | None
        if isinstance(self.depth, DepthFromMotion):
            # Once in every step and never with the goal: what has moved since the last call counts
            # as moved by the camera.
            known = self.depth.update(xy, self._velocity, self.dt)
        else:
            known = self.depth
        if self.interaction == "desired":
            L = interaction_matrix(xy_goal, _depths(goal.depths, known, len(xy)))
        else:
            L = interaction_matrix(xy, _depths(view.depths, known, len(xy)))
            if self.interaction == "mean":
                L += interaction_matrix(xy_goal, _depths(goal.depths, known, len(xy)))
                L *= 0.5
        inverse, condition = pseudo_inverse(L, self.damping, self.truncation)
        return error, inverse @ error, condition


def _depths(
    given: np.ndarray | float | None, known: np.ndarray | float | None, count: int
) -> np.ndarray:
    """(count,) the depths of a view, or else those that the servo knows, metres."""
    depths = known if given is None else given
    if depths is None:
        raise DepthError(
            "depths: none given; give Z (or depths in the view), or `depth` to the servo"
        )
    return check_depths(depths, count)


class PositionBasedVisualServo(VisualServo):
    """v = -gain R^T t, w = -gain theta u with (R, t) = T_GC.

    The camera's origin goes straight to the goal while the camera turns about one axis (Chaumette
    and Hutchinson 2006, equation 15).
    """

    def estimate_3d_position(self, point: Sequence[float], depth_map: np.ndarray) -> np.ndarray:
        """(3,) point in C, metres, of a pixel (u, v) in a depth image (H, W).

        Raises PointError outside the image and DepthError where the depth is unknown.
        """
        u, v = point
        return self.pixel_to_3d(u, v, depths_from_image(point, depth_map)[0])

    def compute_end_effector_velocity(
        self, current_pose: np.ndarray, target_pose: np.ndarray
    ) -> np.ndarray:
        """(6,) v_C from the object's current and desired pose T_CO (4, 4). All six components."""
        return self.step(ServoView(T_CO=current_pose), ServoView(T_CO=target_pose)).velocity

    def _correct(self, view: ServoView, goal: ServoView) -> tuple[np.ndarray, np.ndarray, float]:
        T_GC = relative_pose(view, goal)
        turn = rotation_log(T_GC[:3, :3])
        error = np.concatenate([T_GC[:3, 3], turn])
        correction = np.concatenate([T_GC[:3, 3] @ T_GC[:3, :3], turn])
        # L = diag(R, L_w). The singular values of L_w are 1 and twice (theta / 2) / sin(theta / 2).
        half = 0.5 * sqrt(turn @ turn)
        return error, correction, half / sin(half) if half > 1e-8 else 1.0


class HybridVisualServo(VisualServo):
    """Image and pose together, in one of two schemes.

    blend: alpha x position-based + (1 - alpha) x image-based velocity, as in the tutorial.
    2.5d: the 2 1/2-D law. The object's centre moves on a straight line in the image, log Z controls
    its depth, and the rotation is position-based; L is block triangular and regular wherever the
    object is seen.
    """

    image_based = True

    def __init__(
        self,
        camera_config: Mapping,
        lambda_: float | AdaptiveGain = 0.5,
        alpha: float = 0.5,
        *,
        scheme: str = "blend",
        interaction: str = "mean",
        truncation: float = 1e-4,
        **options: Any,
    ) -> None:
        """alpha: share of the position-based velocity, 0 to 1. scheme: blend or 2.5d.

        interaction: of the blend's image-based half. With the mean one the camera turns in place
        also on long turns, where the current one makes it retreat; the mean one is singular at 90
        and 180 degrees, and the position-based half controls what is truncated there.
        options: see `VisualServo`.
        """
        if scheme not in SCHEMES:
            raise unknown_choice("scheme", scheme, SCHEMES)
        if not 0.0 <= alpha <= 1.0:
            raise UserError(f"alpha: expected a share from 0 to 1, got {alpha}")
        options["truncation"] = truncation
        super().__init__(camera_config, lambda_, **options)
        self.alpha = alpha
        self.scheme = scheme
        self.position_controller = PositionBasedVisualServo(camera_config, lambda_, **options)
        self.image_controller = ImageBasedVisualServo(
            camera_config, lambda_, interaction=interaction, **options
        )

    def compute_velocity(
        self,
        current_pose: np.ndarray,
        current_pixels: np.ndarray,
        target_pose: np.ndarray,
        target_pixels: np.ndarray,
        depth_map: np.ndarray,
    ) -> np.ndarray:
        """(6,) v_C from the current and the desired view.

        Poses: T_CO (4, 4). Pixels: (n, 2). depth_map: (H, W) current depths, metres; the depths at
        the goal follow from them and from both poses.
        """
        xy = self.camera.normalise(current_pixels)
        depths = depths_from_image(current_pixels, depth_map)
        view = ServoView(current_pixels, depths, current_pose)
        T_GC = relative_pose(view, ServoView(T_CO=target_pose))
        goal_depths = transform_points(T_GC, points_from_depths(xy, depths))[:, 2]
        return self.step(view, ServoView(target_pixels, goal_depths, target_pose)).velocity

    def _correct(self, view: ServoView, goal: ServoView) -> tuple[np.ndarray, np.ndarray, float]:
        if self.scheme == "2.5d":
            return self._correct_extended(view, goal)
        pose_error, by_pose, pose_condition = self.position_controller._correct(view, goal)
        image_error, by_image, image_condition = self.image_controller._correct(view, goal)
        correction = self.alpha * by_pose + (1.0 - self.alpha) * by_image
        condition = max(pose_condition, image_condition)
        return np.concatenate([image_error, pose_error]), correction, condition

    def _correct_extended(
        self, view: ServoView, goal: ServoView
    ) -> tuple[np.ndarray, np.ndarray, float]:
        turn = rotation_log(relative_pose(view, goal)[:3, :3])
        xy, xy_goal = self._matched_points(view, goal)
        # The centre of the points in space, not of their images, is a fixed point of the object.
        centre, centre_goal = centre_of(xy, view.depths), centre_of(xy_goal, goal.depths)
        error = np.empty(6)
        error[:2] = centre[:2] / centre[2] - centre_goal[:2] / centre_goal[2]
        error[2] = np.log(centre[2] / centre_goal[2])
        error[3:] = turn
        L = np.zeros((6, 6))
        L[:3] = extended_interaction(centre)
        L[3:, 3:] = rotation_interaction(turn)
        inverse, condition = pseudo_inverse(L, self.damping, self.truncation)
        return error, inverse @ error, condition


def centre_of(xy: np.ndarray, depths: np.ndarray | float | None) -> np.ndarray:
    """(3,) mean in C of points at normalised coordinates (n, 2) and depths (n,), metres."""
    if depths is None:
        raise DepthError("depths: needed in the view and in the goal, got None")
    return points_from_depths(xy, check_depths(depths, len(xy))).mean(axis=0)


def relative_pose(view: ServoView, goal: ServoView) -> np.ndarray:
    """(4, 4) T_GC, the camera's pose relative to its goal."""
    T_CO, T_GO = check_pose("view.T_CO", view.T_CO), check_pose("goal.T_CO", goal.T_CO)
    return T_GO @ inverse_pose(T_CO)


if __name__ == "__main__":
    from utils.servo_reference import main

    main()
