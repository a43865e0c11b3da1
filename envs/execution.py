"""Execute planned grasps with the whole arm and judge them: the only place that says success.

Labelling, evaluation and demonstrations all call `execute_grasp`, so they agree on what a
successful grasp is; `envs.floating_execution` judges those of a hand without an arm.
`utils.result_records.FAILURES` lists the reasons of failed attempts. This module does not know how
grasps are planned.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from envs.arm_paths import (
    LIFT_MARGIN,
    all_plans,
    clears,
    farther_than,
    first_plan,
    height_over,
    higher_than,
    line,
    place_over_tray,
    raised,
    scales,
    standoff,
    way_to_tray,
    way_up,
    withdrawn,
)
from envs.cell import Cell, require_arm
from envs.panda_model import FINGER_FORCE
from envs.robot import FINGER_SPEED, Robot
from envs.robot_kinematics import UnreachableError, forward_kinematics
from envs.robot_motion import Trajectory
from envs.robot_safety import ArmStoppedError, reaching_down
from utils.config import Config
from utils.errors import UserError
from utils.result_records import loose
from utils.transforms import Grasp

_CHECK_SECONDS = 0.05  # between two checks of the fingers or of the object in them
_FELT_SECONDS = 1 / 60  # in which the arm feels what its hand holds before the fingers press anew
_CLOSE_SECONDS = 0.4  # longest wait for the fingers to close, beside the time that their way takes
_LEAST_FRICTION = 0.4  # that a grip counts on
# Times robot.grip_force, with which a hand lifts what gives way in it, and after an attempt that
# lost what it had gripped: most such things are bowls, of whose friction cone the leaning wall
# takes the larger part.
FIRM = 4.0
_GIVES = 0.005  # m by which fingers close on what gives way between them; things settle by less
_HOLD_MARGIN = 3.0  # times the force that this friction needs, for what hangs beside its middle
# Times the closing force, along the closing line, that the arm feels when one finger presses alone
# (it feels 2, and of a grip of both a few tenths); steps in which it feels; m and number of shifts.
_ONE_SIDED, _FEELING_STEPS, _SHIFT, _MOST_SHIFTS = 0.8, 4, 0.002, 12
_RELEASE_SECONDS = 0.12  # in which the fingers open and an object falls out of them
_HIGH = 0.2  # m over the table, from which the arm may go home on any way
_CORNER = 0.04  # m of the upper end of a straight way down that may be cut off
_LIFT_CORNER = 0.12  # and of a straight way up


class InHandMotion:
    """How far an object has moved in the hand since it was gripped, the farthest seen so far.

    turned: rad. slid: m along the fingertips, by that point of the object which was between them;
    along the closing line both fingers move with the object.
    """

    def __init__(self, cell: Cell, index: int):
        self._cell, self._index = cell, index
        self.turned = self.slid = 0.0
        self._gripped = self._pose_in_hand()

    def _pose_in_hand(self) -> np.ndarray:
        return np.linalg.inv(self._cell.robot.tip_pose()) @ self._cell.object_pose(self._index)

    def look(self) -> None:
        """Measure once more."""
        moved = self._pose_in_hand() @ np.linalg.inv(self._gripped)
        self.turned = max(self.turned, float(Rotation.from_matrix(moved[:3, :3]).magnitude()))
        self.slid = max(self.slid, float(np.linalg.norm(moved[[0, 2], 3])))


def holding_force(pull: float) -> float:
    """N a finger that hold what pulls at the hand with so many newtons."""
    return min(_HOLD_MARGIN * pull / (2 * _LEAST_FRICTION), FINGER_FORCE)


class WeighingGrip:
    """Presses as hard as the weight needs that the arm feels, and never less than
    robot.grip_force: light objects creep out of a hard grip, heavy ones slip out of a soft one.

    firmly: press with `FIRM` times that force at least, as it does from the moment in which the
    fingers have closed by more than `_GIVES` since the grip was made.
    """

    def __init__(self, robot: Robot, firmly: bool = False):
        self._robot, self._force, self._gripped = robot, robot.grip_force, robot.opening
        self._firm = FIRM * robot.grip_force
        self._steps = max(1, round(_FELT_SECONDS / robot.dt))
        self._felt: list[float] = []  # N, since the fingers were told last
        if firmly:
            self._press_with(self._firm)

    def feel(self) -> None:
        """Ask once after every physics step: press as hard as what was felt lately needs."""
        self._felt.append(self._robot.external_force())
        if len(self._felt) == self._steps:
            pull, self._felt = float(np.median(self._felt)), []
            self._press_with(holding_force(pull))
        if self._gripped - self._robot.opening > _GIVES:
            self._press_with(self._firm)

    def _press_with(self, force: float) -> None:
        if (force := min(force, FINGER_FORCE)) > self._force:
            self._force = force
            self._robot.command_gripper(0.0, force)


@dataclass(frozen=True)
class GraspOutcome:
    """The result of an attempt.

    reason: `success`, or a key of `utils.result_records.FAILURES`: `ik` (the arm cannot reach a
    pose or the line to it), `collision` (a contact stopped the approach), `missed` (the fingers
    closed on nothing, or on what is no wider than gripper.least_held), `slipped` (the object was
    lost before the lift height), `dropped` (lost after it), `turned` and `slid` (in the hand, where
    execution.strict asks), `stopped` (by the gate that every command to the arm passes, or because
    time ran out), and in a closed loop `lost` (the camera no longer saw the object).
    sim_seconds: simulated time from home and back to home, at legal joint speeds.
    object_index: the object that the hand held, even if it lost the object or stopped later; None
    if it held nothing.
    detail: one more sentence on the failure, or empty. palm_stopped_at: (3,) metres in W, where
    E was when something under the palm stopped the approach. motion: of the object in the hand;
    None if it held nothing.
    """

    reason: str
    sim_seconds: float
    object_index: int | None = None
    detail: str = ""
    palm_stopped_at: np.ndarray | None = None
    motion: InHandMotion | None = None

    @property
    def success(self) -> bool:
        return self.reason == "success"


class GraspFailure(Exception):
    """Ends an attempt with a reason of `utils.result_records.FAILURES`."""

    def __init__(self, reason: str, detail: str = ""):
        super().__init__(detail or reason)
        self.reason, self.detail = reason, detail


class ApproachResult(NamedTuple):
    """What an approach leaves behind: the open gripper around the object, ready to close.

    wait: lets a number of physics steps pass while the fingers close. pose: (4, 4) T_WE from which
    the arm lifts; None stands for its pose at that time. closed_at: metres in W, the height of E at
    which the fingers closed, where the hand may have risen since; None: it has not.
    """

    wait: Callable[[int], None]
    pose: np.ndarray | None
    closed_at: float | None = None


def open_loop(cell: Cell, grasp: Grasp) -> ApproachResult:
    """Move the open gripper to a grasp as planned, without another image.

    Raises UnreachableError before the arm has moved, and ArmStoppedError on a collision.
    """
    settings = cell.config.execution
    start = cell.robot.q  # all is planned before anything moves
    reach, down, target = first_plan(cell, grasp)
    corner = farther_than(standoff(cell, grasp) - _CORNER, target, down)
    way = cell.robot.blended_moves(start, reach, down, corner, **scales(cell))

    cell.robot.command_gripper(cell.gripper.opening_before(grasp.width))
    follow(cell, way, partial(cell.robot.stop_on_contact, settings.contact_stop))
    return ApproachResult(cell.step, target)


def reaches(cell: Cell, grasp: Grasp) -> bool:
    """Whether the arm can go to a grasp as `open_loop` does, and lift what it grips, without
    touching what stands in the cell for good; nothing moves."""
    try:
        return any(clears(cell, plan, grasp) for plan in all_plans(cell, grasp))
    except UnreachableError:
        return False


Approach = Callable[[Cell, Grasp], ApproachResult]


def check_tray(config: Config) -> None:
    """Raise UserError where the gate's box ends before the lowest place over the tray: every picked
    object would end as `stopped` on its way there, and no grasp could succeed."""
    lowest = place_over_tray(config.execution.lift_height + LIFT_MARGIN)
    safety, place = config.safety, lowest.round(3).tolist()
    box = reaching_down(safety, config.closed_loop.floor)
    if not all(low <= at <= high for low, at, high in zip(box.box_lower, place, box.box_upper)):
        raise UserError(
            f"safety: the box from box_lower {list(safety.box_lower)} to box_upper "
            f"{list(safety.box_upper)} leaves out {place} m, over which the hand releases objects "
            "into the tray, so that every pick would be stopped on its way there; widen the box "
            "until it holds that point"
        )


def execute_grasp(
    cell: Cell, grasp: Grasp, approach: Approach = open_loop, firmly: bool = False
) -> GraspOutcome:
    """Approach, close, lift, carry to the tray, release, return home.

    Success: both fingers grip one object, which is off the table with its centre of mass above
    execution.lift_height all the way to the tray and for execution.hold_seconds at least (checked
    every 0.05 s). With execution.strict, it also must not turn or slide in the hand on the way (see
    `utils.result_records.loose`). A picked object is retired. The arm is at home at the end of
    every attempt. Raises PhysicsError when the simulation blows up.

    approach: moves the open gripper around the object; everything after it is the same for all.
    firmly: lift with `FIRM` times robot.grip_force, as for what has slipped out of the hand before.
    """
    require_arm(cell.config, "execute_grasp")
    cell.check_physics()
    with physics_errors(cell):
        return _execute(cell, grasp, approach, firmly)


@contextlib.contextmanager
def physics_errors(cell: Cell) -> Iterator[None]:
    """Raise PhysicsError in place of the ValueError with which planning ends where the simulation
    has blown up: it starts from joint positions that are not finite then."""
    try:
        yield
    except ValueError:
        cell.check_physics()
        raise


def _execute(cell: Cell, grasp: Grasp, approach: Approach, firmly: bool) -> GraspOutcome:
    start, held, motion, reason, detail = cell.seconds, None, None, "success", ""
    try:
        closed, height = _grip(cell, grasp, approach)
        held = cell.held_object()
        motion = None if held is None else InHandMotion(cell, held)
        grip = WeighingGrip(cell.robot, firmly)
        with cell.robot.carrying():
            _carry_to_tray(cell, held, closed, height, motion, grip)
    except UnreachableError:
        reason = "ik"
    except GraspFailure as failure:
        reason, detail = failure.reason, failure.detail
        cell.robot.hold()  # it may be in the middle of a motion
    except ArmStoppedError as stop:
        reason, detail = "collision" if stop.contact else "stopped", f"stopped: {stop}"
    stopped_at = None
    if reason == "collision" and cell.robot.palm_touches():
        stopped_at = cell.robot.tip_pose()[:3, 3].copy()
    cell.check_physics()  # before the arm may be put at home by hand, which hides what blew up
    detail = "; ".join(filter(None, [detail, go_home(cell)]))
    if reason == "success":
        cell.retire(held)  # in the tray, into which it has fallen meanwhile
    cell.check_physics()
    cell.retire_lost_objects()
    return GraspOutcome(reason, cell.seconds - start, held, detail, stopped_at, motion)


def _grip(cell: Cell, grasp: Grasp, approach: Approach) -> tuple[np.ndarray, float]:
    """Approach and close: (4, 4) T_WE from which the arm lifts what it feels between the fingers,
    and the height in W at which they closed. Raises GraspFailure."""
    result = approach(cell, grasp)
    close_fingers(cell, result.wait)
    cell.robot.hold()  # a closed loop sends nothing from here on
    shifted = give_way(cell)
    if not feels_it(cell):
        raise GraspFailure("missed")
    stays = result.pose is not None and not shifted
    T_WE = result.pose if stays else forward_kinematics(cell.robot.q)
    if result.closed_at is not None:
        return T_WE, result.closed_at
    return T_WE, max(grasp.position[2], T_WE[2, 3])


def feels_it(cell: Cell) -> bool:
    """Whether the closed hand grips something. Before the answer is no, it is asked once more: the
    motor of a hand that holds something may press less for a moment."""
    if cell.robot.grips():
        return True
    cell.step(round(_CHECK_SECONDS / cell.dt))
    return cell.robot.grips()


def give_way(cell: Cell) -> bool:
    """Shift the hand along its closing line as long as one finger alone presses on something.

    The fingers move together, and an object is seldom in their middle. A light one is pushed there;
    a heavy one jams the finger that comes first, and the arm feels it. Whether the hand has moved.
    """
    robot, shift, before = cell.robot, _SHIFT, 0.0
    for _ in range(_MOST_SHIFTS):
        if robot.latency:
            cell.step(robot.latency)  # until the last command has arrived
        pushes = []
        for _ in range(_FEELING_STEPS):
            cell.step()
            pushes.append(float(robot.external_push() @ robot.closing_direction()))
        push = float(np.median(pushes[1:]))  # the first time, nothing is felt
        if abs(push) < _ONE_SIDED * robot.grip_force:
            break
        if push * before < 0:  # the last shift was too much, and the other finger presses now
            shift /= 2
        T = forward_kinematics(robot.q)
        T[:3, 3] += np.sign(push) * shift * robot.closing_direction()
        before = push
        try:
            follow(cell, line(cell, robot.q, T, cell.config.execution.approach_speed))
        except (UnreachableError, ArmStoppedError):  # it grips as it can
            break
    if before == 0.0:
        return False
    # Both fingers come to rest on it.
    cell.step(robot.latency + round(_CHECK_SECONDS / cell.dt))
    return True


def _still_lifted(cell: Cell, index: int, motion: InHandMotion) -> None:
    if not cell.is_lifted(index, cell.config.execution.lift_height):
        raise GraspFailure("dropped")
    motion.look()


def _carry_to_tray(
    cell: Cell,
    index: int | None,
    closed: np.ndarray,
    height: float,
    motion: InHandMotion | None,
    grip: WeighingGrip,
) -> None:
    """Lift an object, gripped `height` m over the table at T_WE `closed` (4, 4), and carry it over
    the tray. Raises GraspFailure; with execution.strict also where the object moved in the hand.
    index: None where the hand only believes that it holds one."""
    settings, robot, start = cell.config.execution, cell.robot, cell.robot.q
    top = raised(cell, closed, height)[2, 3]
    lift = way_up(cell, start, closed, height)
    carry = way_to_tray(cell, lift.positions[-1], top)
    corner = higher_than(top - _LIFT_CORNER, lift)
    way = robot.blended_moves(start, lift, carry, corner, **scales(cell))
    every = round(_CHECK_SECONDS / cell.dt)
    for first in range(0, len(lift), every):
        robot.renew_contacts()
        follow(cell, way[first : min(first + every, len(lift))], grip.feel)
    if index is None or motion is None:
        raise GraspFailure("missed")
    if not cell.is_lifted(index, settings.lift_height):
        raise GraspFailure("slipped")
    end = cell.seconds + settings.hold_seconds
    for first in range(len(lift), len(way), every):
        robot.renew_contacts()
        follow(cell, way[first : first + every], grip.feel)
        _still_lifted(cell, index, motion)
    while cell.seconds < end:
        robot.renew_contacts()
        for _ in range(every):
            cell.step()
            grip.feel()
        _still_lifted(cell, index, motion)
    moved = loose(motion.turned, motion.slid)
    if moved and settings.strict:
        raise GraspFailure(moved[0])


def close_fingers(cell: Cell, wait: Callable[[int], None]) -> None:
    """Close the fingers until they stop moving, once the command has arrived."""
    longest = cell.gripper.max_opening / (2 * FINGER_SPEED) + _CLOSE_SECONDS
    cell.robot.command_gripper(0.0)
    if cell.robot.latency:
        wait(cell.robot.latency)
    before = cell.robot.opening
    for _ in range(round(longest / _CHECK_SECONDS)):
        wait(round(_CHECK_SECONDS / cell.dt))
        opening = cell.robot.opening
        if abs(opening - before) < 2e-4:
            return
        before = opening


def go_home(cell: Cell) -> str:
    """Open, leave a place below something as the hand came, rise on a straight line if the hand is
    low, and return to the home posture. Returns a remark for the outcome's detail where the arm
    cannot do so by itself, else an empty text."""
    robot, speed = cell.robot, cell.config.execution.approach_speed
    robot.open_gripper()
    cell.step(round(_RELEASE_SECONDS / cell.dt))
    T = forward_kinematics(robot.q)
    # Without the lines, the joint motion below goes up as well, only less straight.
    with contextlib.suppress(UnreachableError, ArmStoppedError):
        before = withdrawn(cell, T)
        if before is not T:
            T = before
            follow(cell, line(cell, robot.q, T, speed))
        high = max(_HIGH, height_over(cell, cell.gripper.palm_half_length))
        if T[2, 3] < high:
            up = T.copy()
            up[2, 3] = high
            follow(cell, line(cell, robot.q, up, speed))
    try:
        try:
            follow(cell, robot.joint_move(robot.q, cell.home, **scales(cell)))
        except ArmStoppedError:  # the joint motion leaves the workspace; a straight line does not
            follow(cell, line(cell, robot.q, forward_kinematics(cell.home), speed))
            follow(cell, robot.joint_move(robot.q, cell.home, **scales(cell)))
    except (UnreachableError, ArmStoppedError):
        # An arm stretched to the edge of the workspace can bend its elbow only by leaving it.
        robot.place(cell.home)
        return "no way home within the workspace, it was put there by hand"
    return ""


def follow(
    cell: Cell, trajectory: Trajectory, after_step: Callable[[], object] | None = None
) -> None:
    """Run a trajectory. Raises what `after_step` raises, and ArmStoppedError where the gate refuses
    a command."""
    for q, velocity in zip(trajectory.positions, trajectory.velocities):
        cell.robot.command_arm(q, velocity)
        cell.step()
        if after_step is not None:
            after_step()
