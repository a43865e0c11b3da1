"""Servo the cell's arm to a target board that is seen in rendered images.

Eye in hand: the wrist camera looks at a board that lies still. Eye to hand: the overhead camera
looks at a board that the gripper carries. The loop reads images and joint encoders, never a true
pose. Frames: W world, E gripper, C camera, O board.

Knows no control law (see `utils.visual_servo`) and decides on no limit (see `envs.robot_safety`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from envs.board import Board, CarriedBoard
from envs.camera import Intrinsics, wrist_mount
from envs.cell import Cell
from envs.robot_kinematics import JOINT_LOWER, JOINT_UPPER, forward_kinematics, geometric_jacobian
from envs.robot_safety import ArmStoppedError, SafetyGate
from utils.config import SafetyConfig, ServoConfig
from utils.errors import ServoError, unknown_choice
from utils.servo_control import joint_limit_avoidance
from utils.servo_features import MOUNTINGS, ServoCamera
from utils.servo_history import ServoHistory
from utils.servo_loop import ServoCommand, ServoView, VisualServo
from utils.transforms import transform_points

_MOUNTS = dict(zip(MOUNTINGS, ("wrist", "overhead")))
_DAMPING = 0.01  # of the arm's Jacobian (m and rad), which matters near singular postures only
_AVOIDANCE_GAIN = 1.0  # 1/s, of the redundant joint's flight from limits
_MAX_LAG = 0.05  # rad by which the commanded joint positions may be ahead of the true ones
_REST_SECONDS = 0.1  # for the arm to come to rest after the last command


class Sight(NamedTuple):
    """What was seen, and the simulated time in seconds at which the image was taken."""

    view: ServoView
    seconds: float


def servo_period(cell: Cell) -> int:
    """Physics steps from one image to the next."""
    return max(1, round(cell.config.sim.frequency / cell.config.servo.rate))


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
    return {"camera_config": config, "dt": servo_period(cell) * cell.dt}


def _mount(mounting: str) -> str:
    if mounting not in _MOUNTS:
        raise unknown_choice("mounting", mounting, _MOUNTS)
    return _MOUNTS[mounting]


def view_of(board: Board, camera: ServoCamera, T_CO: np.ndarray) -> ServoView:
    """What the camera sees, or should see, of a board at T_CO (4, 4)."""
    points = transform_points(T_CO, board.points)
    return ServoView(camera.to_pixels(points[:, :2] / points[:, 2:]), points[:, 2], T_CO)


class BoardCamera:
    """One of the cell's cameras, and the eyes that find the board in its images."""

    def __init__(self, cell: Cell, board: Board, mounting: str):
        self.cell, self.board = cell, board
        self.intrinsics, self.mount = servo_intrinsics(cell, mounting), _mount(mounting)

    def __call__(self) -> Sight:
        """Take an image now and find the board in it; raises TargetLostError.

        Depths are those of the pose that fits the points best: a colour camera suffices.
        """
        rgb = self.cell.look(self.intrinsics, self.cell.camera_pose(self.mount)).rgb
        pixels = self.board.find(rgb)
        T_CO = self.board.pose(pixels, self.intrinsics.K)
        depths = transform_points(T_CO, self.board.points)[:, 2]
        return Sight(ServoView(pixels, depths, T_CO), self.cell.seconds)


class ServoArm:
    """The arm behind the servo's gate: the only way for a servo's velocities to the arm's own."""

    def __init__(
        self,
        cell: Cell,
        carried: CarriedBoard | None = None,
        safety: SafetyConfig | None = None,
    ):
        """safety: the gate's limits; None: those of the cell's config."""
        self.cell, self.robot, self.carried = cell, cell.robot, carried
        guarded = np.zeros((1, 3))
        if carried is not None:
            guarded = np.vstack([guarded, carried.corners_E])
        safety = safety or cell.config.safety
        self.gate = SafetyGate(safety, cell.config.robot, cell.dt, guarded)
        self._reference, self._velocity = cell.robot.q, np.zeros(7)  # as sent last

    def move(self, wish: np.ndarray, perception_age: float) -> None:
        """Send what may be sent of joint velocities (7,), rad/s, and do one physics step.

        perception_age: seconds since what the wish is based on was seen. Raises ArmStoppedError,
        with the motors already told to hold still, where the gate lets nothing pass.
        """
        q = self.robot.q
        force = self.robot.contact_force()
        if self.carried is not None:
            force += self.carried.contact_force()
        verdict = self.gate.check(wish, q, force, perception_age, self._velocity)
        if verdict.reason is not None:
            self._hold()
            raise ArmStoppedError(verdict.reason, verdict.contact)
        self._velocity = verdict.velocity
        ahead = self._reference + verdict.velocity * self.cell.dt
        # An arm that something holds back must not store up a way to jump when it is let go.
        ahead = np.clip(ahead, q - _MAX_LAG, q + _MAX_LAG)
        self._reference = self.robot.command_arm(ahead, verdict.velocity)
        self.cell.step()

    def wait(self) -> None:
        """Stand still for one physics step, for which nothing has to have been seen."""
        self._hold()
        self.cell.step()

    def stop(self) -> None:
        """Come to rest where the arm is now."""
        self._hold()
        self.cell.step(round(_REST_SECONDS / self.cell.dt))

    def _hold(self) -> None:
        self._reference, self._velocity = self.robot.q, np.zeros(7)
        self.robot.hold()


def servo_to_goal(
    cell: Cell,
    servo: VisualServo,
    goal: ServoView,
    see: Callable[[], Sight | None],
    carried: CarriedBoard | None = None,
) -> ServoHistory:
    """Move the arm until the camera sees the goal; what happened, image by image.

    see() gives what was seen last, or None where no new image has come. Ends with the arm at rest:
    converged where the way still to go stays small (`servo.settled_...`), else with the reason, be
    it the time, a lost target or the gate. Raises ServoError where that happens before the target
    was seen even once.
    """
    arm, settings = ServoArm(cell, carried), cell.config.servo
    views: list[ServoView] = []
    steps: list[ServoCommand] = []
    wish, seen, settled = np.zeros(7), cell.seconds, 0
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
                wish = _joint_velocities(servo, step.velocity, cell.robot.q)
                settled = settled + 1 if _is_small(step.correction, settings) else 0
                converged = settled >= settings.settled_frames
            for _ in range(servo_period(cell)):
                arm.move(wish, cell.seconds - seen)
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
