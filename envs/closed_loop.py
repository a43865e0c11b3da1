"""Closed-loop grasping: the arm follows a grasp that it finds again in every wrist image.

`ClosedLoop` is an `Approach` for `envs.execution`, which closes, lifts and judges. It has three
stages:

far     position-based for every controller, until the object is near the middle of the view: an
        image-based law retreats where the turn is large (see docs/servo.md).
near    the controller's own law, towards a goal that sinks along the grasp's axis as long as the
        camera sees the object. The object's velocity from the motion filter is fed forward, which
        removes the lag behind a moving object.
final   the last centimetres, in which the object is too near to be seen: straight down along the
        grasp's axis and along with the predicted motion of the object, while the fingers close as
        well. Images are still taken: the watchdog stops the arm when none arrive.

All velocities pass the safety gate (`envs.servo_arm`). The loop reads depth images and encoders;
camera poses come from a `CameraCalibration` alone. Frames: W world, E gripper, C camera, O object
on the table below its grasp, G goal.
"""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from envs.cell import Cell, Intrinsics
from envs.closed_loop_tracker import ObjectTracker, WristCamera, WristImage
from envs.execution import ApproachResult, GraspFailure
from envs.robot_kinematics import (
    HALF_TURN,
    JOINT_LOWER,
    JOINT_UPPER,
    forward_kinematics,
    geometric_jacobian,
    must_flip,
    pose_error,
    should_flip,
)
from envs.robot_safety import ArmStoppedError, reaching_down
from envs.scenarios import SCENARIOS, CameraCalibration
from envs.servo_arm import ServoArm, image_period
from utils.errors import (
    CollinearPointsError,
    FeatureCountError,
    ServoError,
    TargetLostError,
    UserError,
)
from utils.result_records import OPEN_LOOP
from utils.servo_control import joint_limit_avoidance, joint_velocities
from utils.servo_features import MIN_POINTS
from utils.servo_loop import ServoView, VisualServo
from utils.transforms import (
    Grasp,
    RGBDFrame,
    inverse_pose,
    planar_part,
    pose_exp,
    top_down_pose,
    transform_points,
)
from utils.visual_servo import HybridVisualServo, ImageBasedVisualServo, PositionBasedVisualServo

# By controller: the visual servo of the near stage, and its own arguments. A new entry is a new
# name for `closed_loop.controller`.
LAWS = {
    "pbvs": (PositionBasedVisualServo, {}),
    "ibvs": (ImageBasedVisualServo, {"interaction": "mean"}),
    "hybrid": (HybridVisualServo, {"scheme": "2.5d"}),  # 2 1/2-D
}
CONTROLLERS = (OPEN_LOOP, *LAWS)

_DAMPING = 0.02  # of the arm's Jacobian
_AVOIDANCE_GAIN = 0.5  # 1/s, of the redundant joint's motion away from its limits

_RECONSIDER_ANGLE = 0.2  # rad of the object's turn after which a wrist flip is considered again
_NEAR_DISTANCE, _NEAR_ANGLE = 0.03, 0.35  # m and rad off the axis at which the near stage begins
_FUNNEL = 0.12  # m off the axis allowed for each m above the height of commitment
_SEEN_AT_GOAL = 0.75  # share of the object that the goal's view has to show
_NEAR_PLANE = 0.005  # m kept to the nearest depth that the camera measures

_PATH_GAIN = 8.0  # 1/s, towards the path of the final approach
_REACHED = 0.0015  # m from the end of the path that count as its end
_NEAR_ENOUGH = 0.005  # m that suffice when the time is over
_BRAKE, _SLOWEST = 6.0, 0.02  # 1/s and m/s: the descent slows towards its end, down to this speed
_SLACK_SECONDS = 0.35  # beyond the path's own time


def check_watchdog(cell: Cell, scenario: str) -> None:
    """Raise UserError where images come so late or so seldom that the watchdog would stop every
    approach in a scenario, a key of SCENARIOS."""
    config, period = cell.config, image_period(cell)
    latency = SCENARIOS[scenario].latency + config.closed_loop.compute_seconds
    # An image arrives when a later one is taken, and counts until the next one arrives.
    late = math.ceil((latency - 1e-9) / (period * cell.dt))
    oldest = ((late + 1) * period - 1) * cell.dt
    if oldest > config.safety.watchdog + 1e-9:
        raise UserError(
            f"safety.watchdog: {config.safety.watchdog:g} s stops every closed loop in the "
            f"scenario {scenario}, where images become {oldest:.3f} s old before the next one "
            f"arrives: servo.rate is {config.servo.rate} Hz, and images are {latency:g} s late "
            "(by the scenario and closed_loop.compute_seconds); set safety.watchdog to "
            f"{math.ceil(100 * oldest) / 100:g} or more"
        )


@dataclass
class LoopRecord:
    """What a closed loop did, for tests and figures.

    turn_seconds: wall-clock time of every turn of the loop, from the image to the joint velocities,
    without rendering. stage: the last stage that was reached: far, near, final or closing.
    """

    turn_seconds: list[float] = field(default_factory=list)
    stage: str = "far"


def make_law(controller: str, K: np.ndarray, T_EC: np.ndarray, gain: float, dt: float):
    """The visual servo of a controller's near stage. T_EC: (4, 4) from the calibration."""
    config = {"intrinsics": K, "mounting": "eye_in_hand", "T_EC": T_EC}
    servo, own = LAWS[controller]
    return servo(config, lambda_=gain, dt=dt, damping=0.0, **own)


class ClosedLoop:
    """The approach of one controller to one grasp.

    controller: a key of LAWS. frame: the frame on which the grasp was planned, with the
    calibration's camera pose. taught_T_CE: (4, 4) the gripper in the wrist camera as that camera
    has shown it (`envs.scenarios.teach`); the goal views of image-based laws come from it.
    latency: s.
    camera: returns a WristImage, or None where no new image has arrived; None: the cell's.
    target: the tracked object, once the approach has begun.
    """

    target: ObjectTracker

    def __init__(
        self,
        cell: Cell,
        controller: str,
        frame: RGBDFrame,
        calibration: CameraCalibration,
        taught_T_CE: np.ndarray | None,
        latency: float = 0.0,
        camera=None,
    ):
        self.cell, self.controller, self.frame = cell, controller, frame
        self.T_EC, self.latency = calibration.T_EC, latency
        self.camera = camera or WristCamera(cell, latency)
        settings = cell.config.closed_loop
        intrinsics = Intrinsics(settings.width, settings.height, settings.fov_deg)
        self.K, self.size = intrinsics.K, (settings.width, settings.height)
        period = image_period(cell) * cell.dt
        self.law = make_law(controller, self.K, self.T_EC, settings.gain, period)
        self.far_law = make_law("pbvs", self.K, self.T_EC, settings.gain, period)
        # The goal of an image-based law is a view that the camera itself has shown.
        self.goal_T_CE = taught_T_CE if self.law.image_based else inverse_pose(self.T_EC)
        self.record = LoopRecord()

    def __call__(self, cell: Cell, grasp: Grasp) -> ApproachResult:
        """See `envs.execution.open_loop`. Raises GraspFailure with what stopped the arm."""
        robot, settings = cell.robot, cell.config.closed_loop
        robot.command_gripper(cell.gripper.opening_before(grasp.width))
        arm = ServoArm(cell, safety=reaching_down(cell.config.safety, settings.floor))
        with _servo_errors_as_failures(arm):
            guided = GuidedApproach(self, arm, grasp)
            end = cell.seconds + settings.seconds
            while (start := guided.update()) is None:
                if cell.seconds > end:
                    raise ServoError(f"not at the grasp after {settings.seconds} s")
                guided.follow()
            self.record.stage = "final"
            final = FinalApproach(arm, self.camera, self.target, start, guided.height)
            final.descend()
        self.record.stage = "closing"

        def wait(steps: int) -> None:
            with _servo_errors_as_failures(arm):
                final.follow(steps)

        return ApproachResult(wait, None)


@contextlib.contextmanager
def _servo_errors_as_failures(arm: ServoArm) -> Iterator[None]:
    """Bring the arm to rest when an exception leaves the block, and turn a ServoError into the
    GraspFailure with its reason."""
    try:
        yield
    except BaseException as error:
        arm.stop()
        if isinstance(error, ServoError):
            raise GraspFailure(_reason_of(error), detail=f"stopped: {error}") from error
        raise


def _reason_of(error: ServoError) -> str:
    if isinstance(error, TargetLostError | FeatureCountError | CollinearPointsError):
        return "lost"
    contact = isinstance(error, ArmStoppedError) and error.contact
    return "collision" if contact else "stopped"


class GuidedApproach:
    """The far and the near stage of one approach, in which the camera sees the object."""

    def __init__(self, loop: ClosedLoop, arm: ServoArm, grasp: Grasp):
        """Waits for the first image. Raises TargetLostError, and UnreachableError where the grasp
        is out of reach."""
        self.loop, self.cell, self.arm = loop, loop.cell, arm
        self.settings = settings = loop.cell.config.closed_loop
        self.target = loop.target = ObjectTracker(
            loop.frame, grasp, loop.K, loop.size, loop.T_EC, settings.lost_seconds,
            self.cell.seconds,
        )  # fmt: skip
        self.T_OE = top_down_pose([0, 0, grasp.position[2]], 0.0)
        self.chosen_at = planar_part(self.target.T_WO)[2]  # rad, direction of the object
        if should_flip(self._hand_above(self.target.T_WO), self.cell.home, self.cell.robot.q):
            self.T_OE = self.T_OE @ HALF_TURN
        self.near, self.height = False, np.inf
        self.lowest = self._lowest_view()
        self.desired = np.zeros(7)
        self._wait_for_first_sight()

    def update(self) -> np.ndarray | None:
        """Take an image and compute the desired joint velocities. Returns None, and at the end of
        the near stage the (4, 4) T_WE at which the final approach starts, `height` above the grasp.
        """
        new = self.target.update(self.loop.camera())
        start = time.perf_counter()
        if not self.near:
            self._reconsider_flip()
        q, now = self.cell.robot.q, self.cell.seconds
        T_WE = forward_kinematics(q)
        T_CO = inverse_pose(T_WE @ self.loop.T_EC) @ self.target.at(now)
        off = self._off_axis(T_CO)
        if not self.near:
            self._choose_stage(off)
        law, height = (self.loop.law, self.height) if self.near else (
            self.loop.far_law, self.settings.look_height
        )  # fmt: skip
        sink = 0.0
        if self.near:
            height, sink = self._sink(off)
        view, goal = self._views(T_CO, self._goal(height), self.near)
        step = law.step(view, goal)
        if self.near:
            self.loop.record.stage = "near"
            if self._may_commit(off):
                return self._pose_at_goal(T_WE, step.correction)
        self.desired = self._joint_velocities(q, T_WE, step.velocity, law, sink)
        if new:
            spent = self.target.spent + time.perf_counter() - start
            self.loop.record.turn_seconds.append(spent)
        return None

    def follow(self) -> None:
        """Send the desired velocities until the next image. While images arrive that do not show
        the object, the arm stands still: its last sight of the object is too old."""
        watchdog, target = self.arm.gate.safety.watchdog, self.target
        for _ in range(image_period(self.cell)):
            now = self.cell.seconds
            if now - target.image_seconds <= watchdog < now - target.found_seconds:
                self.arm.wait()
            else:
                self.arm.move(self.desired, now - target.found_seconds)

    def _wait_for_first_sight(self) -> None:
        """Hold still until a first image has arrived, perhaps late, and shows the object."""
        end = self.cell.seconds + self.settings.lost_seconds
        while not self.target.update(self.loop.camera()):
            if self.cell.seconds > end:
                raise TargetLostError(f"no image has arrived for {self.settings.lost_seconds} s")
            for _ in range(image_period(self.cell)):
                self.arm.wait()

    def _hand_above(self, T_WO: np.ndarray) -> np.ndarray:
        """(4, 4) T_WE above the grasp of an object at T_WO."""
        T_WE = T_WO @ self.T_OE
        T_WE[2, 3] += self.settings.look_height
        return T_WE

    def _reconsider_flip(self) -> None:
        """Flip the wrist where it would meet its limit while it follows the object."""
        predicted = self.target.predicted(self.cell.seconds)
        direction = planar_part(predicted)[2]
        if abs(math.remainder(direction - self.chosen_at, math.tau)) < _RECONSIDER_ANGLE:
            return
        self.chosen_at = direction
        if must_flip(self._hand_above(predicted), self.cell.home, self.cell.robot.q):
            self.T_OE = self.T_OE @ HALF_TURN

    def _goal(self, height: float) -> np.ndarray:
        """(4, 4) T_CO: the object as the camera should see it from `height` above the grasp."""
        raised = self.T_OE.copy()
        raised[2, 3] += height
        return self.loop.goal_T_CE @ inverse_pose(raised)

    def _lowest_view(self) -> float:
        """The height above the grasp from which the camera still sees the object."""
        heights = np.arange(self.settings.commit_height, self.settings.look_height, 0.01)
        nearest = self.cell.config.camera.near + _NEAR_PLANE
        for height in heights:
            if self.target.matcher.seen_share(self._goal(height), nearest) >= _SEEN_AT_GOAL:
                return float(height)
        return self.settings.look_height

    def _off_axis(self, T_CO: np.ndarray) -> tuple[float, float, float]:
        """Distance of the gripper from the grasp's axis (m), its height above the grasp (m) and its
        turn about the axis (rad), by the controller's own goal."""
        T_EO = inverse_pose(self.loop.goal_T_CE) @ T_CO
        T_GE = inverse_pose(self.T_OE) @ inverse_pose(T_EO)  # G: the gripper at the grasp
        turn = abs(np.arctan2(T_GE[1, 0], T_GE[0, 0]))
        return float(np.hypot(*T_GE[:2, 3])), float(-T_GE[2, 3]), float(turn)

    def _choose_stage(self, off: tuple[float, float, float]) -> None:
        distance, height, turn = off
        settled = distance < _NEAR_DISTANCE and turn < _NEAR_ANGLE
        if settled and height < self.settings.look_height + _NEAR_DISTANCE:
            self.near, self.height = True, max(height, self.lowest)
            self.loop.law.reset()

    def _sink(self, off: tuple[float, float, float]) -> tuple[float, float]:
        """The goal's height above the grasp at the next image and the speed (m/s) at which it
        sinks, which is 0 while the gripper is outside the funnel above the grasp."""
        distance, height, turn = off
        above = max(height - self.lowest, 0.0)
        settings = self.settings
        allowed = settings.aligned_distance + _FUNNEL * above
        speed = 0.0
        if distance < 2 * allowed and turn < settings.aligned_angle + 2 * above:
            speed = min(settings.descend_speed, settings.gain * above)
        dt = image_period(self.cell) * self.cell.dt
        self.height = max(min(self.height, height) - speed * dt, self.lowest)
        return self.height, speed

    def _may_commit(self, off: tuple[float, float, float]) -> bool:
        distance, height, turn = off
        settings = self.settings
        return bool(
            height < self.lowest + 0.01
            and distance < settings.aligned_distance
            and turn < settings.aligned_angle
            and self.cell.seconds - self.target.found_seconds <= self.arm.gate.safety.watchdog
        )

    def _views(self, T_CO: np.ndarray, T_GO: np.ndarray, near: bool) -> tuple[ServoView, ServoView]:
        """Current and desired view: the template's points and its pose. In the near stage only the
        points within the image count; raises FeatureCountError where they are too few."""
        views = []
        seen = np.ones(len(self.target.template.points), bool)
        for T in (T_CO, T_GO):
            points = transform_points(T, self.target.template.points)
            pixels = points[:, :2] / points[:, 2:] * self.loop.K[[0, 1], [0, 1]]
            views.append(ServoView(pixels + self.loop.K[:2, 2], points[:, 2], T))
        if near:
            pixels = views[0].points
            seen = (pixels > -0.5).all(axis=1) & (pixels < np.array(self.loop.size) - 0.5).all(1)
            if seen.sum() < MIN_POINTS:
                raise FeatureCountError(
                    f"points: {seen.sum()} of those on the object are in the image, needed are at "
                    f"least {MIN_POINTS}"
                )
        return tuple(ServoView(v.points[seen], v.depths[seen], v.T_CO) for v in views)

    def _joint_velocities(
        self, q: np.ndarray, T_WE: np.ndarray, v_C: np.ndarray, law: VisualServo, sink: float
    ) -> np.ndarray:
        """(7,) rad/s: the law's velocity plus those of the object and of the sinking goal."""
        J = geometric_jacobian(q)
        away = joint_limit_avoidance(q, JOINT_LOWER, JOINT_UPPER, _AVOIDANCE_GAIN)
        desired = law.compute_joint_velocities(T_WE, v_C, J, away, _DAMPING)
        ahead = self.target.twist(T_WE[:3, 3], self.cell.seconds)
        ahead[2] -= sink
        return desired + joint_velocities(J, ahead, damping=_DAMPING)

    def _pose_at_goal(self, T_WE: np.ndarray, correction: np.ndarray) -> np.ndarray:
        """(4, 4) T_WE of the gripper once the law's correction is done."""
        T_EC = self.loop.T_EC
        return T_WE @ T_EC @ pose_exp(-correction) @ inverse_pose(T_EC)


class FinalApproach:
    """The final stage: a path from `start` straight down by `height` metres, which moves along with
    the predicted motion of the object.

    start: (4, 4) T_WE above the grasp. camera: returns a WristImage, or None where no new image has
    arrived.
    """

    def __init__(
        self,
        arm: ServoArm,
        camera: Callable[[], WristImage | None],
        target: ObjectTracker,
        start: np.ndarray,
        height: float,
    ):
        self.arm, self.cell, self.camera, self.target = arm, arm.cell, camera, target
        self.settings = arm.cell.config.closed_loop
        self.start, self.start_seconds, self.height = start, arm.cell.seconds, height
        self.descended = 0.0  # m of the height
        self._steps_to_image = 0  # physics steps
        self._holds = False  # the hand grips something, or something blocks it

    def descend(self) -> None:
        """Descend to the grasp. Raises ServoError where the arm is stopped or late."""
        speed = self.settings.descend_speed
        end = self.cell.seconds + self.height / speed + _SLACK_SECONDS
        while True:
            rest = self.height - self.descended
            off = self._step(min(speed, max(_BRAKE * rest, _SLOWEST)) if rest > 0 else 0.0)
            if rest <= 0 and off < _REACHED:
                return
            if self.cell.seconds > end:
                if off < _NEAR_ENOUGH:
                    return
                raise ServoError(f"{1000 * off:.0f} mm off the predicted path at its end")

    def follow(self, steps: int) -> None:
        """Move along with the object for some physics steps while the fingers close; hold still
        once a contact force exceeds the gate's limit, as that of a grip does."""
        for _ in range(steps):
            try:
                if not self._holds:
                    self._step(0.0)
                    continue
            except ArmStoppedError as stop:
                if not stop.contact:
                    raise
                self._holds = True
            self.arm.wait()

    def _step(self, sink: float) -> float:
        """Follow the path for one physics step, sinking at `sink` m/s; the distance from it before,
        in metres."""
        self._keep_watch()
        dt, now = self.cell.dt, self.cell.seconds
        if now - self.target.found_seconds > self.settings.final_seconds:
            raise TargetLostError(f"not seen for {self.settings.final_seconds} s")
        self.descended = min(self.descended + sink * dt, self.height)
        path = self.target.motion.motion(self.start_seconds, now) @ self.start
        path[:3, 3] += self.descended * path[:3, 2]
        q = self.cell.robot.q
        T_WE = forward_kinematics(q)
        error = pose_error(T_WE, path)
        twist = self.target.twist(path[:3, 3], now) + _PATH_GAIN * error
        twist[:3] += sink * path[:3, 2] * (self.descended < self.height)
        away = joint_limit_avoidance(q, JOINT_LOWER, JOINT_UPPER, _AVOIDANCE_GAIN)
        desired = joint_velocities(geometric_jacobian(q), twist, away, _DAMPING)
        # The object is too near to be seen: by design the velocity rests on a prediction, for no
        # longer than final_seconds, and only as long as images arrive.
        self.arm.move(desired, now - self.target.image_seconds)
        return float(np.linalg.norm(error[:3]))

    def _keep_watch(self) -> None:
        """Take the image that is due, only to check that the camera still delivers."""
        if self._steps_to_image == 0:
            self._steps_to_image = image_period(self.cell)
            image = self.camera()
            if image is not None:
                self.target.image_seconds = image.seconds
        self._steps_to_image -= 1
