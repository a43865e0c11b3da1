"""Carry out planned grasps with the whole arm, and judge them: the ONE place that says success.

Labelling, evaluation and demos all call `execute_grasp`, so they cannot disagree about what a
successful grasp is. Knows nothing of how grasps are found.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from envs.cell import Cell
from envs.cell_layout import BIN_CENTRE, BIN_HEIGHT
from envs.robot_kinematics import (
    Trajectory,
    UnreachableError,
    forward_kinematics,
    inverse_kinematics,
)
from envs.robot_safety import ArmStoppedError, reaching_down
from utils.config import Config
from utils.errors import UserError
from utils.transforms import Grasp, top_down_pose

_LOOK_SECONDS = 0.05  # between two looks at the fingers or at the object in them
_CLOSE_SECONDS = 1.2  # longest wait for the fingers to close
_RELEASE_SECONDS = 0.35  # for the fingers to open and the object to fall into the bin
OVER_BIN = np.array([*BIN_CENTRE, BIN_HEIGHT + 0.17])  # m in W, where E lets go of an object
HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])  # about the approach: the same grasp, other finger


@dataclass(frozen=True)
class GraspOutcome:
    """How an attempt ended.

    reason: `success`, or how it failed: `ik` (a pose or the line to it cannot be reached),
    `collision` (a contact stopped the approach), `missed` (the fingers closed on nothing),
    `slipped` (lost before the lift height), `dropped` (lost after it), `stopped` (by the gate that
    every command to the arm passes, or out of time); of a closed loop also `lost` (the object was
    not seen any more).
    sim_seconds: simulated time from home and back home, at legal joint speeds.
    object_index: the object that was held, if any, also where it was lost or the arm stopped later.
    detail: a sentence on the failure, if there is more to say. palm_stopped_at: metres, height of E
    where something under the palm stopped the approach.
    """

    reason: str
    sim_seconds: float
    object_index: int | None = None
    detail: str = ""
    palm_stopped_at: float | None = None

    @property
    def success(self) -> bool:
        return self.reason == "success"


class GraspFailure(Exception):
    """Ends an attempt early with a reason."""

    def __init__(self, reason: str, detail: str = ""):
        super().__init__(detail or reason)
        self.reason, self.detail = reason, detail


class ApproachResult(NamedTuple):
    """The open gripper is where it should close. wait: lets a number of physics steps pass while
    the fingers close. pose: (4, 4) T_WE from which to lift; None: where the arm is by then."""

    wait: Callable[[int], None]
    pose: np.ndarray | None


def open_loop(cell: Cell, grasp: Grasp) -> ApproachResult:
    """Bring the open gripper around a grasp as planned, without looking again. Raises
    ArmStoppedError on a collision and UnreachableError before anything has moved."""
    settings = cell.config.execution
    pregrasp = grasp.pose.copy()
    pregrasp[2, 3] += settings.pregrasp_height
    q_pregrasp = choose_posture(cell, pregrasp)
    target = _same_side(forward_kinematics(q_pregrasp), grasp.pose)
    approach = _line(cell, q_pregrasp, target)  # planned before anything moves

    cell.robot.command_gripper(grasp.width)
    _follow(cell, cell.robot.joint_move(cell.robot.q, q_pregrasp, **_scales(cell)))
    _follow(cell, approach, stop_force=settings.contact_stop)
    return ApproachResult(cell.step, target)


Approach = Callable[[Cell, Grasp], ApproachResult]


def check_bin(config: Config) -> None:
    """Raise UserError where the gate's box ends before the bin: whatever is picked would end as
    `stopped` on its way there, so that no grasp could succeed."""
    told, place = config.safety, OVER_BIN.round(3).tolist()
    box = reaching_down(told, config.closed_loop.floor)
    if not all(low <= at <= high for low, at, high in zip(box.box_lower, place, box.box_upper)):
        raise UserError(
            f"safety: the box from box_lower {list(told.box_lower)} to box_upper "
            f"{list(told.box_upper)} leaves out {place} m, where the hand lets go of objects over "
            "the bin, so that every pick would be stopped on its way there; widen the box until it "
            "holds that point"
        )


def execute_grasp(cell: Cell, grasp: Grasp, approach: Approach = open_loop) -> GraspOutcome:
    """Approach, close, lift, hold, carry to the bin, release, go home.

    Success: one object gripped by both fingers, off the table, its centre of mass above
    execution.lift_height, for execution.hold_seconds and all the way to the bin (looked at every
    0.05 s). A picked object is retired. Whatever happens, the arm is home again at the end. Raises
    PhysicsError when the simulation blows up.

    approach: how the open gripper gets around the object; the rest is the same for all.
    """
    cell.check_physics()
    start, held, reason, detail = cell.seconds, None, "success", ""
    try:
        held, raised = _grip(cell, grasp, approach)
        _lift(cell, held, raised)
        _carry_to_bin(cell, held)
    except UnreachableError:
        reason = "ik"
    except GraspFailure as failure:
        reason, detail = failure.reason, failure.detail
    except ArmStoppedError as stop:
        reason, detail = "collision" if stop.contact else "stopped", f"stopped: {stop}"
    stopped_at = None
    if reason == "collision" and cell.robot.palm_touches():
        stopped_at = float(cell.robot.tip_pose()[2, 3])
    detail = "; ".join(filter(None, [detail, _go_home(cell)]))
    cell.check_physics()
    cell.retire_lost_objects()
    return GraspOutcome(reason, cell.seconds - start, held, detail, stopped_at)


def _grip(cell: Cell, grasp: Grasp, approach: Approach) -> tuple[int, np.ndarray]:
    """From home to an object between the fingers: its number, and (4, 4) T_WE to which to lift it.
    Raises GraspFailure."""
    around = approach(cell, grasp)
    _close(cell, around.wait)
    cell.robot.hold()  # nothing that it followed is sent any more
    index = cell.held_object()
    if index is None:
        raise GraspFailure("missed")
    lifted = (forward_kinematics(cell.robot.q) if around.pose is None else around.pose).copy()
    # A learned policy names no grasp beforehand: it counts where its hand has closed.
    height = max(grasp.position[2], lifted[2, 3], 0.0)
    lifted[2, 3] = height + cell.config.execution.lift_height + 0.05
    return index, lifted


def _lift(cell: Cell, index: int, lifted: np.ndarray) -> None:
    """Raise the hand to `lifted` (4, 4) and hold the object there. Raises GraspFailure."""
    settings = cell.config.execution
    _follow(cell, _line(cell, cell.robot.q, lifted))
    if not cell.is_lifted(index, settings.lift_height):
        raise GraspFailure("slipped")
    for _ in range(round(settings.hold_seconds / _LOOK_SECONDS)):
        cell.step(round(_LOOK_SECONDS / cell.dt))
        _still_lifted(cell, index)


def _still_lifted(cell: Cell, index: int) -> None:
    if not cell.is_lifted(index, cell.config.execution.lift_height):
        raise GraspFailure("dropped")


def _carry_to_bin(cell: Cell, index: int) -> None:
    posture = choose_posture(cell, top_down_pose(OVER_BIN, -np.pi / 2))
    carry = cell.robot.joint_move(cell.robot.q, posture, **_scales(cell))
    every = round(_LOOK_SECONDS / cell.dt)
    for start in range(0, len(carry), every):
        _follow(cell, carry[start : start + every])
        _still_lifted(cell, index)
    cell.robot.open_gripper()
    cell.step(round(_RELEASE_SECONDS / cell.dt))
    cell.retire(index)


def _close(cell: Cell, wait: Callable[[int], None]) -> None:
    """Close the fingers until they stop moving."""
    cell.robot.command_gripper(0.0)
    before = cell.robot.opening
    for _ in range(round(_CLOSE_SECONDS / _LOOK_SECONDS)):
        wait(round(_LOOK_SECONDS / cell.dt))
        opening = cell.robot.opening
        if abs(opening - before) < 2e-4:
            return
        before = opening


def _go_home(cell: Cell) -> str:
    """Open, rise on a straight line if the hand is low, and return to the home posture. A remark
    for the outcome's detail where the arm could not do so by itself."""
    robot = cell.robot
    robot.open_gripper()
    cell.step(round(0.1 / cell.dt))
    T = forward_kinematics(robot.q)
    if T[2, 3] < 0.2:
        up = T.copy()
        up[2, 3] = 0.2
        # Where the line cannot be had, the joint motion below goes up as well, only less straight.
        with contextlib.suppress(UnreachableError, ArmStoppedError):
            _follow(cell, _line(cell, robot.q, up))
    try:
        try:
            _follow(cell, robot.joint_move(robot.q, cell.home, **_scales(cell)))
        except ArmStoppedError:  # the way bulges out of the workspace; a straight line does not
            _follow(cell, _line(cell, robot.q, forward_kinematics(cell.home)))
            _follow(cell, robot.joint_move(robot.q, cell.home, **_scales(cell)))
    except (UnreachableError, ArmStoppedError):
        # Stretched right at the edge of the workspace it could bend its elbow only by leaving it.
        robot.place(cell.home)
        return "no way home within the workspace, it was put there by hand"
    return ""


def choose_posture(cell: Cell, pose: np.ndarray) -> np.ndarray:
    """Joint positions (7,) for a gripper pose or the same grasp turned by half a turn, whichever
    is nearer to home. Raises UnreachableError if neither can be reached."""
    found, error = [], None
    for candidate in (pose, pose @ HALF_TURN):
        try:
            found.append(inverse_kinematics(candidate, cell.home, cell.home))
        except UnreachableError as unreachable:
            error = unreachable
    if not found:
        raise error
    return min(found, key=lambda q: float(abs(q - cell.home).max()))


def _same_side(reached: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """`pose`, turned by half a turn if the arm chose that way round."""
    return pose if reached[:3, 1] @ pose[:3, 1] > 0 else pose @ HALF_TURN


def _line(cell: Cell, q: np.ndarray, pose: np.ndarray) -> Trajectory:
    speed = cell.config.execution.approach_speed
    return cell.robot.straight_move(q, pose, speed, cell.home, **_scales(cell))


def _scales(cell: Cell) -> dict[str, float]:
    robot = cell.config.robot
    return {
        "velocity_scale": robot.velocity_scale,
        "acceleration_scale": robot.acceleration_scale,
    }


def _follow(cell: Cell, trajectory: Trajectory, stop_force: float | None = None) -> None:
    """Run a trajectory; raises ArmStoppedError, with the arm held where it is, at a contact above
    `stop_force` N and where the gate refuses to go on."""
    for q, velocity in zip(trajectory.positions, trajectory.velocities):
        cell.robot.command_arm(q, velocity)
        cell.step()
        if stop_force is not None:
            cell.robot.stop_on_contact(stop_force)
