"""Closed-loop grasping: the object is found again in every image of the wrist camera, all the way.

An `Approach` for `envs.execution`, which closes, lifts and judges. Three stages:

far     position-based for every controller, until the object is near the middle of the view: an
        image-based law backs away where the turn is large (see docs/servo.md).
near    the controller's own law, towards a goal that sinks along the grasp's axis as far as the
        camera sees the object. The object's own velocity, as the filter tells it, is added to
        the law's, which takes away the lag behind what moves.
blind   the rest of the way, some centimetres, without looking (`envs.blind_descent`).

All velocities pass the safety gate (`GuardedArm`). Reads depth images and encoders; where the
cameras are comes from `CameraBeliefs` alone. Frames: W world, E gripper, C camera, O object on the
table below its grasp.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from envs.base_cell import BaseCell
from envs.beliefs import CameraBeliefs
from envs.blind_descent import AVOIDANCE_GAIN, DAMPING, BlindDescent
from envs.camera import Intrinsics
from envs.execution import HALF_TURN, Around, GraspFailure
from envs.kinematics import JOINT_LOWER, JOINT_UPPER, forward_kinematics, geometric_jacobian
from envs.panda import MAX_OPENING
from envs.safety import ArmStoppedError, reaching_down
from envs.servoing import GuardedArm, servo_period
from envs.sighted_object import SightedObject
from envs.way_round import must_turn, turned_is_better
from envs.wrist_camera import WristCamera
from utils.se3 import pose_exp
from utils.servo_errors import (
    CollinearPointsError,
    FeatureCountError,
    ServoError,
    TargetLostError,
)
from utils.servo_features import MIN_POINTS
from utils.servo_laws import joint_limit_avoidance, joint_velocities
from utils.servo_loop import View, VisualServo
from utils.tabletop import planar_part
from utils.transforms import (
    Grasp,
    RGBDFrame,
    inverse_pose,
    top_down_pose,
    transform_points,
)
from utils.visual_servo import (
    HybridVisualServo,
    ImageBasedVisualServo,
    PositionBasedVisualServo,
)

_RECONSIDER_ANGLE = 0.2  # rad by which the object has to turn for another look at the way round
_NEAR_DISTANCE, _NEAR_ANGLE = 0.03, 0.35  # m and rad off the axis where the law takes over
_FUNNEL = 0.12  # m off the axis allowed for each m above the height of commitment
_SEEN_AT_GOAL = 0.75  # share of the object that the goal's view has to show
_NEAR_PLANE = 0.005  # m kept to the nearest depth that the camera measures

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
    options = {"lambda_": gain, "dt": dt, "damping": 0.0}
    if controller == "pbvs":
        return PositionBasedVisualServo(config, **options)
    if controller == "ibvs":
        return ImageBasedVisualServo(config, interaction="mean", **options)
    return HybridVisualServo(config, scheme="2.5d", **options)


class ClosedLoop:
    """The approach of one controller to one grasp, seen in the frame that it was planned on.

    controller: pbvs, ibvs or hybrid. frame: as it is believed to have been taken. taught_T_CE:
    (4, 4) the gripper in the wrist camera as that camera showed it (`envs.beliefs.teach`), from
    which ibvs and hybrid have their goal images. camera: gives a DepthSight, or None where no new
    image has come. target: the object, once it is looked for.
    """

    target: SightedObject

    def __init__(
        self,
        cell: BaseCell,
        controller: str,
        frame: RGBDFrame,
        beliefs: CameraBeliefs,
        taught_T_CE: np.ndarray,
        latency: float = 0.0,
        camera=None,
    ):
        self.cell, self.controller, self.frame = cell, controller, frame
        self.T_EC, self.latency = beliefs.T_EC, latency
        self.camera = camera or WristCamera(cell, latency)
        grasp = cell.config.grasp
        intrinsics = Intrinsics(grasp.width, grasp.height, grasp.fov_deg)
        self.K, self.size = intrinsics.K, (grasp.width, grasp.height)
        period = servo_period(cell) * cell.dt
        self.law = make_law(controller, self.K, self.T_EC, grasp.gain, period)
        self.far_law = make_law("pbvs", self.K, self.T_EC, grasp.gain, period)
        T_CE = taught_T_CE if controller in _TAUGHT else inverse_pose(self.T_EC)
        self.goal_T_CE = T_CE
        self.record = LoopRecord()

    def __call__(self, cell: BaseCell, grasp: Grasp) -> Around:
        """See `envs.execution.open_loop`. Raises GraspFailure with what stopped the arm."""
        robot, settings = cell.robot, cell.config.grasp
        robot.command_gripper(min(grasp.width, MAX_OPENING))
        arm = GuardedArm(cell, safety=reaching_down(cell.config.safety, settings.floor))
        with _told_as_failure(arm):
            guided = GuidedDescent(self, arm, grasp)
            end = cell.seconds + settings.seconds
            while (start := guided.look()) is None:
                if cell.seconds > end:
                    raise ServoError(f"not at the grasp after {settings.seconds} s")
                guided.go()
            self.record.stage = "blind"
            blind = BlindDescent(arm, self.camera, self.target, start, guided.height)
            blind.go()
        self.record.stage = "closing"

        def wait(steps: int) -> None:
            with _told_as_failure(arm):
                blind.follow(steps)

        return Around(wait, None)


@contextlib.contextmanager
def _told_as_failure(arm: GuardedArm) -> Iterator[None]:
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


class GuidedDescent:
    """The far and the near stage of one approach: what the arm does while it sees the object."""

    def __init__(self, loop: ClosedLoop, arm: GuardedArm, grasp: Grasp):
        """Takes the first image that comes; raises TargetLostError, and UnreachableError where the
        grasp is out of reach."""
        self.loop, self.cell, self.arm = loop, loop.cell, arm
        self.settings = settings = loop.cell.config.grasp
        self.target = loop.target = SightedObject(
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

    def _views(self, T_CO: np.ndarray, T_GO: np.ndarray, near: bool) -> tuple[View, View]:
        """What is seen and what should be seen: the template's points and its pose. Of the points
        those count that lie within the image; raises FeatureCountError where they are too few."""
        views = []
        seen = np.ones(len(self.target.template.points), bool)
        for T in (T_CO, T_GO):
            points = transform_points(T, self.target.template.points)
            pixels = points[:, :2] / points[:, 2:] * self.loop.K[[0, 1], [0, 1]]
            views.append(View(pixels + self.loop.K[:2, 2], points[:, 2], T))
        if near:
            pixels = views[0].points
            seen = (pixels > -0.5).all(axis=1) & (pixels < np.array(self.loop.size) - 0.5).all(1)
            if seen.sum() < MIN_POINTS:
                raise FeatureCountError(
                    f"points: {seen.sum()} of those on the object are in the image, needed are at "
                    f"least {MIN_POINTS}"
                )
        return tuple(View(v.points[seen], v.depths[seen], v.T_CO) for v in views)

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
