"""Servo the cell's arm to a board of markers that it sees in rendered images.

Eye in hand: the wrist camera looks at a board that lies still. Eye to hand: the overhead camera
looks at a board that the gripper carries (`Cell.attach_board`). The loop reads images and joint
encoders, never a true pose. Frames: W world, E gripper, C camera, O board.

The laws stand in `utils.servo_laws`, the limits in `envs.robot_safety`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from envs.board import Board, CarriedBoard
from envs.cell import Cell, Intrinsics, wrist_mount
from envs.robot_kinematics import JOINT_LOWER, JOINT_UPPER, forward_kinematics, geometric_jacobian
from envs.servo_arm import ServoArm, image_period
from utils.config import ServoConfig
from utils.errors import ServoError, unknown_choice
from utils.servo_control import joint_limit_avoidance
from utils.servo_features import MOUNTINGS, ServoCamera
from utils.servo_history import ServoHistory
from utils.servo_loop import ServoCommand, ServoView, VisualServo
from utils.transforms import transform_points

_MOUNTS = dict(zip(MOUNTINGS, ("wrist", "overhead")))
_DAMPING = 0.01  # of the arm's Jacobian (m and rad), which matters near singular postures only
_AVOIDANCE_GAIN = 1.0  # 1/s, of the redundant joint's motion away from its limits


class Sight(NamedTuple):
    """A view, and the simulated time in seconds at which its image was taken."""

    view: ServoView
    seconds: float


def servo_intrinsics(cell: Cell, mounting: str) -> Intrinsics:
    """Of the wrist (eye_in_hand) or overhead (eye_to_hand) camera, in the servo's resolution."""
    camera, servo = cell.config.camera, cell.config.servo
    fov = camera.wrist_fov_deg if _mount(mounting) == "wrist" else camera.fov_deg
    return Intrinsics(servo.width, servo.height, fov, camera.near, camera.far)


def servo_settings(cell: Cell, mounting: str) -> dict:
    """Arguments for a `VisualServo` of this cell: `camera_config`, and `dt` between two images."""
    intrinsics = servo_intrinsics(cell, mounting)
    config = {
        "intrinsics": intrinsics.K,
        "width": intrinsics.width,
        "height": intrinsics.height,
        "mounting": mounting,
    }
    if mounting == "eye_in_hand":
        config["T_EC"] = wrist_mount(cell.config.camera)
    else:
        config["T_WC"] = cell.camera_pose("overhead")
    return {"camera_config": config, "dt": image_period(cell) * cell.dt}


def _mount(mounting: str) -> str:
    if mounting not in _MOUNTS:
        raise unknown_choice("mounting", mounting, _MOUNTS)
    return _MOUNTS[mounting]


def view_of(board: Board, camera: ServoCamera, T_CO: np.ndarray) -> ServoView:
    """The exact view of a board at T_CO (4, 4)."""
    points = transform_points(T_CO, board.points)
    return ServoView(camera.to_pixels(points[:, :2] / points[:, 2:]), points[:, 2], T_CO)


class BoardCamera:
    """One of the cell's cameras; each call takes an image and finds the board in it."""

    def __init__(self, cell: Cell, board: Board, mounting: str):
        self.cell, self.board = cell, board
        self.intrinsics, self.mount = servo_intrinsics(cell, mounting), _mount(mounting)

    def __call__(self) -> Sight:
        """Raises TargetLostError where the image does not show the whole board.

        Depths are those of the pose that fits the points best: a colour camera suffices.
        """
        rgb = self.cell.look(self.intrinsics, self.cell.camera_pose(self.mount)).rgb
        pixels = self.board.find(rgb)
        T_CO = self.board.pose(pixels, self.intrinsics.K)
        depths = transform_points(T_CO, self.board.points)[:, 2]
        return Sight(ServoView(pixels, depths, T_CO), self.cell.seconds)


def servo_to_goal(
    cell: Cell,
    servo: VisualServo,
    goal: ServoView,
    see: Callable[[], Sight | None],
    carried: CarriedBoard | None = None,
) -> ServoHistory:
    """Move the arm until the camera sees the goal; the history of the run, image by image.

    see() returns the last sight, or None where no new image has arrived. carried: the board on the
    hand, if there is one. The run ends with the arm at rest: converged where the correction stays
    small (`servo.settled_...`), else with the reason, such as the time, a lost target or the gate.
    Raises ServoError where that happens before the first sight.
    """
    arm, settings = ServoArm(cell, carried), cell.config.servo
    views: list[ServoView] = []
    steps: list[ServoCommand] = []
    desired, seen, settled = np.zeros(7), cell.seconds, 0
    end = cell.seconds + settings.seconds
    converged, reason = False, f"stopped: not settled after {settings.seconds} s"
    servo.reset()
    try:
        while cell.seconds < end and not converged:
            sight = see()
            if sight is not None:
                step = servo.step(sight.view, goal)
                views.append(sight.view)
                steps.append(step)
                seen = sight.seconds
                desired = _joint_velocities(servo, step.velocity, cell.robot.q)
                settled = settled + 1 if _is_small(step.correction, settings) else 0
                converged = settled >= settings.settled_frames
            for _ in range(image_period(cell)):
                arm.move(desired, cell.seconds - seen)
    except ServoError as error:
        if not steps:
            raise
        reason = f"stopped: {error}"
    finally:
        arm.stop()
    if converged:
        reason = f"settled after {len(steps)} images"
    return servo.history(views, steps, goal, converged, reason)


def _joint_velocities(servo: VisualServo, velocity: np.ndarray, q: np.ndarray) -> np.ndarray:
    """(7,) rad/s that give the camera the twist v_C relative to the target."""
    away = joint_limit_avoidance(q, JOINT_LOWER, JOINT_UPPER, _AVOIDANCE_GAIN)
    return servo.compute_joint_velocities(
        forward_kinematics(q), velocity, geometric_jacobian(q), away, _DAMPING
    )


def _is_small(correction: np.ndarray, settings: ServoConfig) -> bool:
    return bool(
        np.linalg.norm(correction[:3]) < settings.settled_distance
        and np.linalg.norm(correction[3:]) < settings.settled_angle
    )
