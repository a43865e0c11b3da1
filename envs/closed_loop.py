"""The last centimetres of a closed-loop grasp, in which the camera sees the object no more.

The hand goes straight on along the grasp's axis and along with the object's motion as it was
foreseen, and follows it while the fingers close. Images go on being taken: the watchdog stops the
arm here too when they stop coming. All velocities pass the safety gate (`ServoArm`).

Which way round to grasp: the fingers are alike, so every grasp is two, half a turn apart.

The way round is chosen by the wrist, the last joint: it may turn by less than a whole turn, and an
object that turns takes it along.

Closed-loop grasping: the object is found again in every image of the wrist camera, all the way.

An `Approach` for `envs.execution`, which closes, lifts and judges. Three stages:

far     position-based for every controller, until the object is near the middle of the view: an
        image-based law backs away where the turn is large (see docs/servo.md).
near    the controller's own law, towards a goal that sinks along the grasp's axis as far as the
        camera sees the object. The object's own velocity, as the filter tells it, is added to
        the law's, which takes away the lag behind what moves.
blind   the rest of the way, some centimetres, without looking (`envs.closed_loop`).

All velocities pass the safety gate (`ServoArm`). Reads depth images and encoders; where the
cameras are comes from `CameraCalibration` alone. Frames: W world, E gripper, C camera, O object on the
table below its grasp.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from envs.board_servo import ServoArm, servo_period
from envs.camera import Intrinsics
from envs.camera_calibration import CameraCalibration
from envs.cell import Cell
from envs.closed_loop_tracker import ObjectTracker, WristCamera, WristImage
from envs.execution import HALF_TURN, ApproachResult, GraspFailure
from envs.robot_kinematics import (
    JOINT_LOWER,
    JOINT_UPPER,
    UnreachableError,
    forward_kinematics,
    geometric_jacobian,
    inverse_kinematics,
    pose_error,
)
from envs.robot_safety import ArmStoppedError, reaching_down
from utils.errors import (
    CollinearPointsError,
    FeatureCountError,
    ServoError,
    TargetLostError,
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
from utils.visual_servo import (
    HybridVisualServo,
    ImageBasedVisualServo,
    PositionBasedVisualServo,
)

DAMPING = 0.02  # of the arm's Jacobian
AVOIDANCE_GAIN = 0.5  # 1/s, of the redundant joint's flight from limits
_GAIN = 8.0  # 1/s, towards the foreseen path
_REACHED = 0.0015  # m from the end of the path that count as there
_NEAR_ENOUGH = 0.005  # m that do when the time is over
_BRAKE, _SLOWEST = 6.0, 0.02  # 1/s and m/s: the descent slows towards its end, down to this
_SLACK_SECONDS = 0.35  # beyond what the path takes, for its end


class FinalApproach:
    """A path that is fixed now, in the object's motion: from `start`, down by `height` metres.

    start: (4, 4) T_WE above the grasp. camera: gives a sight, or None where no new image has come.
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
        self.gone = 0.0  # m of the height
        self._steps_to_image = 0  # physics steps
        self._holds = False  # something is gripped, or in the way of the closing hand

    def go(self) -> None:
        """Down to the grasp; raises ServoError where the arm is stopped, or does not get there in
        time."""
        speed = self.settings.descend_speed
        end = self.cell.seconds + self.height / speed + _SLACK_SECONDS
        while True:
            rest = self.height - self.gone
            off = self._step(min(speed, max(_BRAKE * rest, _SLOWEST)) if rest > 0 else 0.0)
            if rest <= 0 and off < _REACHED:
                return
            if self.cell.seconds > end:
                if off < _NEAR_ENOUGH:
                    return
                raise ServoError(f"{1000 * off:.0f} mm off the foreseen path at its end")

    def follow(self, steps: int) -> None:
        """Let physics steps pass while the fingers close, along with the object; hold still once
        something presses harder than the gate allows, which is what a grip does."""
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
        """Follow the path for one physics step, sinking at `sink` m/s; metres off it before."""
        self._keep_watch()
        dt, now = self.cell.dt, self.cell.seconds
        if now - self.target.found_seconds > self.settings.final_seconds:
            raise TargetLostError(f"not seen for {self.settings.final_seconds} s")
        self.gone = min(self.gone + sink * dt, self.height)
        path = self.target.motion.motion(self.start_seconds, now) @ self.start
        path[:3, 3] += self.gone * path[:3, 2]
        q = self.cell.robot.q
        T_WE = forward_kinematics(q)
        error = pose_error(T_WE, path)
        twist = self.target.twist(path[:3, 3], now) + _GAIN * error
        twist[:3] += sink * path[:3, 2] * (self.gone < self.height)
        away = joint_limit_avoidance(q, JOINT_LOWER, JOINT_UPPER, AVOIDANCE_GAIN)
        wish = joint_velocities(geometric_jacobian(q), twist, away, DAMPING)[0]
        # The object is too near to be seen: by design the wish is based on what was foreseen, for
        # no longer than final_seconds, and as long as the camera shows that it lives.
        self.arm.move(wish, now - self.target.image_seconds)
        return float(np.linalg.norm(error[:3]))

    def _keep_watch(self) -> None:
        """Take the image that is due, only to know that the camera lives."""
        if self._steps_to_image == 0:
            self._steps_to_image = servo_period(self.cell)
            sight = self.camera()
            if sight is not None:
                self.target.image_seconds = sight.seconds
        self._steps_to_image -= 1


_ROOM = 0.6  # rad to the wrist's limits that a way round should leave
_LITTLE_ROOM = 0.3  # rad of it at which the other way round is looked at
_LONGEST_TURN = 2.8  # rad of the wrist, less than half a turn


def turned_is_better(cell: Cell, T_WE: np.ndarray) -> bool:
    """Whether to turn a gripper pose (4, 4) round before setting out for it: the smaller turn of
    the wrist that leaves it room to turn with the object. Raises UnreachableError if neither way
    is in reach."""
    ways, now = _ways(cell, T_WE), cell.robot.q[-1]
    roomy = [turned for turned, q in ways.items() if _wrist_room(q) > _ROOM] or list(ways)
    return min(roomy, key=lambda turned: abs(ways[turned][-1] - now))


def must_turn(cell: Cell, T_WE: np.ndarray) -> bool:
    """Whether to turn round on the way to a gripper pose (4, 4), where the wrist, following the
    object, is about to meet its limit."""
    try:
        ways, now = _ways(cell, T_WE), cell.robot.q[-1]
    except UnreachableError:  # at this moment, which is no reason to change anything
        return False
    kept, other = (_wrist_room(ways[turned]) if turned in ways else 0.0 for turned in (0, 1))
    # A law takes the shorter turn; a longer one than half a turn would be the wrong way.
    return kept < _LITTLE_ROOM < other and abs(ways[True][-1] - now) < _LONGEST_TURN


def _ways(cell: Cell, T_WE: np.ndarray) -> dict[bool, np.ndarray]:
    """Joint positions (7,) at a pose as it is (False) and turned by half a turn (True), those that
    can be reached; raises UnreachableError if there are none."""
    ways, error = {}, None
    for turned, pose in ((False, T_WE), (True, T_WE @ HALF_TURN)):
        try:
            ways[turned] = inverse_kinematics(pose, cell.home, cell.home)
        except UnreachableError as unreachable:
            error = unreachable
    if not ways:
        raise error
    return ways


def _wrist_room(q: np.ndarray) -> float:
    """Radians from the last joint to the nearer one of its limits."""
    return float(min(q[-1] - JOINT_LOWER[-1], JOINT_UPPER[-1] - q[-1]))


_RECONSIDER_ANGLE = 0.2  # rad by which the object has to turn for another look at the way round
_NEAR_DISTANCE, _NEAR_ANGLE = 0.03, 0.35  # m and rad off the axis where the law takes over
_FUNNEL = 0.12  # m off the axis allowed for each m above the height of commitment
_SEEN_AT_GOAL = 0.75  # share of the object that the goal's view has to show
_NEAR_PLANE = 0.005  # m kept to the nearest depth that the camera measures

# By controller: the visual servo of the near stage, and its own arguments. Another entry is another
# name for `closed_loop.controller`.
LAWS = {
    "pbvs": (PositionBasedVisualServo, {}),
    "ibvs": (ImageBasedVisualServo, {"interaction": "mean"}),
    "hybrid": (HybridVisualServo, {"scheme": "2.5d"}),
}
CONTROLLERS = (OPEN_LOOP, *LAWS)
_TAUGHT = ("ibvs", "hybrid")  # controllers whose goals are told as they look to the camera


@dataclass
class LoopRecord:
    """What a closed loop did, for tests and figures.

    turn_seconds: wall-clock time of every turn, from the image to the joint velocities, rendering
    left out. seconds, errors: simulated time and the law's correction (6,) in C, minus the way
    still to go, at every turn of the near stage. stage: the last one that was reached.
    """

    turn_seconds: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    errors: list[np.ndarray] = field(default_factory=list)
    stage: str = "far"


def make_law(controller: str, K: np.ndarray, T_EC: np.ndarray, gain: float, dt: float):
    """The visual servo of a controller's near stage; T_EC as it is believed."""
    config = {"intrinsics": K, "mounting": "eye_in_hand", "T_EC": T_EC}
    servo, own = LAWS[controller]
    return servo(config, lambda_=gain, dt=dt, damping=0.0, **own)


class ClosedLoop:
    """The approach of one controller to one grasp, seen in the frame that it was planned on.

    controller: pbvs, ibvs or hybrid. frame: as it is believed to have been taken. taught_T_CE:
    (4, 4) the gripper in the wrist camera as that camera showed it (`envs.camera_calibration.teach`), from
    which ibvs and hybrid have their goal images. camera: gives a WristImage, or None where no new
    image has come. target: the object, once it is looked for.
    """

    target: ObjectTracker

    def __init__(
        self,
        cell: Cell,
        controller: str,
        frame: RGBDFrame,
        calibration: CameraCalibration,
        taught_T_CE: np.ndarray,
        latency: float = 0.0,
        camera=None,
    ):
        self.cell, self.controller, self.frame = cell, controller, frame
        self.T_EC, self.latency = calibration.T_EC, latency
        self.camera = camera or WristCamera(cell, latency)
        grasp = cell.config.closed_loop
        intrinsics = Intrinsics(grasp.width, grasp.height, grasp.fov_deg)
        self.K, self.size = intrinsics.K, (grasp.width, grasp.height)
        period = servo_period(cell) * cell.dt
        self.law = make_law(controller, self.K, self.T_EC, grasp.gain, period)
        self.far_law = make_law("pbvs", self.K, self.T_EC, grasp.gain, period)
        T_CE = taught_T_CE if controller in _TAUGHT else inverse_pose(self.T_EC)
        self.goal_T_CE = T_CE
        self.record = LoopRecord()

    def __call__(self, cell: Cell, grasp: Grasp) -> ApproachResult:
        """See `envs.execution.open_loop`. Raises GraspFailure with what stopped the arm."""
        robot, settings = cell.robot, cell.config.closed_loop
        robot.command_gripper(grasp.width)
        arm = ServoArm(cell, safety=reaching_down(cell.config.safety, settings.floor))
        with _told_as_failure(arm):
            guided = GuidedApproach(self, arm, grasp)
            end = cell.seconds + settings.seconds
            while (start := guided.look()) is None:
                if cell.seconds > end:
                    raise ServoError(f"not at the grasp after {settings.seconds} s")
                guided.go()
            self.record.stage = "final"
            blind = FinalApproach(arm, self.camera, self.target, start, guided.height)
            blind.go()
        self.record.stage = "closing"

        def wait(steps: int) -> None:
            with _told_as_failure(arm):
                blind.follow(steps)

        return ApproachResult(wait, None)


@contextlib.contextmanager
def _told_as_failure(arm: ServoArm) -> Iterator[None]:
    """Whatever ends the block early leaves the arm at rest; what a servo can stop for is told as
    the failure of the grasp."""
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
    """The far and the near stage of one approach: what the arm does while it sees the object."""

    def __init__(self, loop: ClosedLoop, arm: ServoArm, grasp: Grasp):
        """Takes the first image that comes; raises TargetLostError, and UnreachableError where the
        grasp is out of reach."""
        self.loop, self.cell, self.arm = loop, loop.cell, arm
        self.settings = settings = loop.cell.config.closed_loop
        self.target = loop.target = ObjectTracker(
            loop.frame, grasp, loop.K, loop.size, loop.T_EC, settings.lost_seconds,
            self.cell.seconds,
        )  # fmt: skip
        self.T_OE = top_down_pose([0, 0, grasp.position[2]], 0.0)
        self.chosen_at = planar_part(self.target.T_WO)[2]  # rad, direction of the object
        if turned_is_better(self.cell, self._hand_above(self.target.T_WO)):
            self.T_OE = self.T_OE @ HALF_TURN
        self.near, self.height = False, np.inf
        self.lowest = self._lowest_view()
        self.wish = np.zeros(7)
        self._wait_for_sight()

    def look(self) -> np.ndarray | None:
        """Take in what the camera has, and wish for a velocity. Where the blind stage begins, the
        (4, 4) T_WE that its path starts from, `height` above the grasp; None before."""
        new = self.target.take_in(self.loop.camera())
        start = time.perf_counter()
        if not self.near:
            self._reconsider_way_round()
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
            self.loop.record.seconds.append(now)
            self.loop.record.errors.append(step.correction)
            if self._may_commit(off, step.correction):
                return self._where_the_goal_is(T_WE, step.correction)
        self.wish = self._joint_wish(q, T_WE, step.velocity, law, sink)
        if new:
            spent = self.target.spent + time.perf_counter() - start
            self.loop.record.turn_seconds.append(spent)
        return None

    def go(self) -> None:
        """Send the wish until the next image. While images come but do not show the object, the arm
        stands still: what it would go by is too old."""
        watchdog, target = self.arm.gate.safety.watchdog, self.target
        for _ in range(servo_period(self.cell)):
            now = self.cell.seconds
            if now - target.image_seconds <= watchdog < now - target.found_seconds:
                self.arm.wait()
            else:
                self.arm.move(self.wish, now - target.found_seconds)

    def _wait_for_sight(self) -> None:
        """Hold still until a first image has come (it may be late) and shows the object."""
        end = self.cell.seconds + self.settings.lost_seconds
        while not self.target.take_in(self.loop.camera()):
            if self.cell.seconds > end:
                raise TargetLostError(f"no image has come for {self.settings.lost_seconds} s")
            for _ in range(servo_period(self.cell)):
                self.arm.wait()

    def _hand_above(self, T_WO: np.ndarray) -> np.ndarray:
        """(4, 4) T_WE above the grasp of an object at T_WO."""
        T_WE = T_WO @ self.T_OE
        T_WE[2, 3] += self.settings.look_height
        return T_WE

    def _reconsider_way_round(self) -> None:
        """Turn round where the wrist, following the object, is about to meet its limit."""
        foreseen = self.target.foreseen(self.cell.seconds)
        direction = planar_part(foreseen)[2]
        if abs(direction - self.chosen_at) < _RECONSIDER_ANGLE:
            return
        self.chosen_at = direction
        if must_turn(self.cell, self._hand_above(foreseen)):
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
            if self.target.tracker.seen_share(self._goal(height), nearest) >= _SEEN_AT_GOAL:
                return float(height)
        return self.settings.look_height

    def _off_axis(self, T_CO: np.ndarray) -> tuple[float, float, float]:
        """How far off the grasp's axis (m), how high above the grasp (m) and how far turned (rad)
        the gripper is, as the controller has it."""
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
        """The goal's height above the grasp by the next image and the speed (m/s) at which it
        sinks, as long as the gripper is in the funnel above the grasp."""
        distance, height, turn = off
        above = max(height - self.lowest, 0.0)
        settings = self.settings
        allowed = settings.aligned_distance + _FUNNEL * above
        speed = 0.0
        if distance < 2 * allowed and turn < settings.aligned_angle + 2 * above:
            speed = min(settings.descend_speed, settings.gain * above)
        dt = servo_period(self.cell) * self.cell.dt
        self.height = max(min(self.height, height) - speed * dt, self.lowest)
        return self.height, speed

    def _may_commit(self, off: tuple[float, float, float], correction: np.ndarray) -> bool:
        distance, height, turn = off
        settings = self.settings
        return bool(
            height < self.lowest + 0.01
            and distance < settings.aligned_distance
            and turn < settings.aligned_angle
            and self.cell.seconds - self.target.found_seconds <= self.arm.gate.safety.watchdog
        )

    def _views(self, T_CO: np.ndarray, T_GO: np.ndarray, near: bool) -> tuple[ServoView, ServoView]:
        """What is seen and what should be seen: the template's points and its pose. Of the points
        those count that lie within the image; raises FeatureCountError where they are too few."""
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

    def _joint_wish(
        self, q: np.ndarray, T_WE: np.ndarray, v_C: np.ndarray, law: VisualServo, sink: float
    ) -> np.ndarray:
        """(7,) rad/s: the law's velocity, and with it the object's own and the goal's."""
        J = geometric_jacobian(q)
        away = joint_limit_avoidance(q, JOINT_LOWER, JOINT_UPPER, AVOIDANCE_GAIN)
        wish = law.compute_joint_velocities(T_WE, v_C, J, away, DAMPING)
        ahead = self.target.twist(T_WE[:3, 3], self.cell.seconds)
        ahead[2] -= sink
        return wish + joint_velocities(J, ahead, damping=DAMPING)[0]

    def _where_the_goal_is(self, T_WE: np.ndarray, correction: np.ndarray) -> np.ndarray:
        """(4, 4) T_WE of a gripper that the law has nothing to correct of."""
        T_EC = self.loop.T_EC
        return T_WE @ T_EC @ pose_exp(-correction) @ inverse_pose(T_EC)
