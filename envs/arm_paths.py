"""Paths of the arm: to a grasp, up with what it holds, to the tray; and whether they are clear.

All is planned before anything moves. Planners keep the hand clear on its straight way to a grasp;
the arm's links are checked here. What hangs over the table, such as the board of a shelf, no
straight way up passes: the hand leaves a place below it as it came, back along the approach, and
the hand and what it holds are checked on the whole path. This module judges no grasp.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import numpy as np

from envs.arm_clearance import arm_is_clear, hand_is_clear, held_points
from envs.cell import Cell
from envs.cell_layout import TRAY_CENTRE, TRAY_HEIGHT
from envs.robot_kinematics import (
    HALF_TURN,
    UnreachableError,
    all_postures,
    choose_posture,
    forward_kinematics,
    tip_position,
)
from envs.robot_motion import Trajectory
from utils.transforms import Grasp, top_down_pose

_OVER_TRAY = TRAY_HEIGHT + 0.17  # m over the table, where E releases an object, or higher
# m over execution.lift_height, to which the lower end of an object is lifted: a heavy one that is
# gripped beside its middle may turn until it hangs, far below the hand.
LIFT_MARGIN = 0.15
# m by which an object is lifted slowly, m/s, and the share of it after which the hand may hurry:
# fingers that close at 5 cm/s keep in touch with slipping walls that lean by up to 35 degrees, as
# long as it takes to press harder.
_SLOW_LIFT, _SLOW_LIFT_SPEED, _SLOW_LIFT_SHARE = 0.015, 0.07, 0.5
_SLOW_HEIGHT = 0.04  # m above a grasp, below which the hand comes down at execution.approach_speed
LOOK_EVERY = 12  # references between two at which arm and hand are looked at
_OFF_TABLE = 0.015  # m by which an object is lifted before it leaves a place below something
_OUT = 0.09  # m before what hangs over the table, where an object in the hand is out from under it
_LEVEL = 0.3  # least level part of an approach that leads out from under something
_FARTHEST = 0.4  # m, of a way out
_STEP = 0.01  # m, between two places that are looked at
_OVER = 0.04  # m over what hangs over the table, at which the lower end of an object passes

Plan = tuple[Trajectory, Trajectory, np.ndarray]


def first_plan(cell: Cell, grasp: Grasp) -> Plan:
    """The first of `all_plans` on which the arm is clear of the cell; if none is, the first.
    Raises UnreachableError, also where something hangs over the table and none is clear of it."""
    plans = list(all_plans(cell, grasp))
    if len(plans) == 1 and not cell.hanging:
        return plans[0]
    clear = next((plan for plan in plans if clears(cell, plan, grasp)), None)
    if clear is None and cell.hanging:
        raise UnreachableError("something hangs over the table in every way of the arm")
    return clear or plans[0]


def all_plans(cell: Cell, grasp: Grasp) -> Iterator[Plan]:
    """For each posture at the pregrasp: the way there, from there straight to the grasp, and the
    grasp's pose (4, 4), which may be flipped. Raises UnreachableError where there is none."""
    pregrasp = backed(grasp.pose, standoff(cell, grasp))
    failures, found, below = [], False, bool(cell.hanging)
    for q_pregrasp in all_postures(pregrasp, cell.home, more=below):
        at = q_pregrasp[None]
        if below and not (arm_is_clear(cell, at) and hand_is_clear(cell, at)):
            failures.append(UnreachableError("the arm meets something at the pregrasp"))
            continue
        target = _same_side(forward_kinematics(q_pregrasp), grasp.pose)
        try:
            down = _descent(cell, q_pregrasp, target)
        except UnreachableError as error:
            failures.append(error)
            continue
        found = True
        yield cell.robot.joint_move(cell.robot.q, q_pregrasp, **scales(cell)), down, target
        if below:
            with contextlib.suppress(UnreachableError):
                yield _from_above(cell, q_pregrasp), down, target
    if not found:
        raise failures[0]


def standoff(cell: Cell, grasp: Grasp) -> float:
    """Metres before a grasp at which the straight approach starts."""
    out = way_out(cell, grasp.position, -grasp.approach)
    return max(cell.config.execution.pregrasp_height, out)


def _from_above(cell: Cell, q: np.ndarray) -> Trajectory:
    """A way to joint positions q (7,) that passes over what hangs over the table and comes straight
    down before it. Raises UnreachableError."""
    above = forward_kinematics(q)
    above[2, 3] = height_over(cell, above[2, 3])
    rise = line(cell, q, above)
    back = np.vstack([rise.positions[-2::-1], q])
    fall = Trajectory(back, np.vstack([-rise.velocities[-2::-1], np.zeros(7)]))
    return _joined([cell.robot.joint_move(cell.robot.q, rise.positions[-1], **scales(cell)), fall])


def clears(cell: Cell, plan: Plan, grasp: Grasp) -> bool:
    """Whether the arm, but for its hand, stays clear of the cell on a plan and while it lifts. The
    hand is the planners' matter, unless something hangs over the table: then it is checked, too,
    with the object on the way to the tray."""
    reach, down, target = plan
    try:
        lift = way_up(cell, down.positions[-1], target, grasp.position[2])
        parts = [reach, down, lift]
        if cell.hanging:
            top = raised(cell, target, grasp.position[2])[2, 3]
            parts.append(way_to_tray(cell, lift.positions[-1], top))
    except UnreachableError:
        return False
    looked_at = [part.positions[::LOOK_EVERY] for part in parts]
    if not cell.hanging:
        return arm_is_clear(cell, np.concatenate(looked_at))
    return (
        arm_is_clear(cell, np.concatenate(looked_at))
        and hand_is_clear(cell, np.concatenate(looked_at[:3]))
        and hand_is_clear(cell, looked_at[3], held_points(target))
    )


def _descent(cell: Cell, q: np.ndarray, target: np.ndarray) -> Trajectory:
    """From joint positions q (7,) straight to `target` (4, 4): quickly, and slowly at the end."""
    settings = cell.config.execution
    if settings.pregrasp_height <= _SLOW_HEIGHT:
        return line(cell, q, target, settings.approach_speed)
    quick = line(cell, q, backed(target, _SLOW_HEIGHT))
    slow = line(cell, quick.positions[-1], target, settings.approach_speed)
    # Both are parts of one line, so that no corner is cut. The second one has half of its speed
    # when the first one ends, so that both together are no faster than the approach.
    left = _distances(target, slow)
    speeding = int(np.argmax(-np.diff(left) > settings.approach_speed * cell.dt / 2))
    return cell.robot.blended_moves(q, quick, slow, speeding, **scales(cell))


def way_up(cell: Cell, q: np.ndarray, T_WE: np.ndarray, height: float) -> Trajectory:
    """From joint positions q (7,) and pose T_WE (4, 4) the way on which an object is lifted that
    the hand gripped `height` m over the table: straight up, slowly at first, or where something
    hangs over it, level out from under it before. Raises UnreachableError."""
    before = withdrawn(cell, T_WE)
    if before is T_WE:
        off = T_WE.copy()
        off[2, 3] += _SLOW_LIFT
        slow = line(cell, q, off, _SLOW_LIFT_SPEED)
        lift = line(cell, slow.positions[-1], raised(cell, T_WE, height))
        end = higher_than(T_WE[2, 3] + _SLOW_LIFT_SHARE * _SLOW_LIFT, slow)
        return cell.robot.blended_moves(q, slow, lift, end, **scales(cell))
    off = T_WE.copy()
    off[2, 3] = before[2, 3]
    parts: list[Trajectory] = []
    for pose in (off, before, raised(cell, before, height)):
        parts.append(line(cell, parts[-1].positions[-1] if parts else q, pose))
    return _joined(parts)


def withdrawn(cell: Cell, T_WE: np.ndarray) -> np.ndarray:
    """The pose (4, 4) of a hand at T_WE that has gone out from under what hangs over the table: the
    same object where nothing does. It goes level, because the object may be nearly as high as the
    room below, and a little over the table."""
    back = -T_WE[:3, 2] * (1.0, 1.0, 0.0)
    size = np.linalg.norm(back)
    out = way_out(cell, T_WE[:3, 3], back / size) if size > _LEVEL else 0.0
    if out == 0.0:
        return T_WE
    before = T_WE.copy()
    before[:3, 3] += out * back / size + (0.0, 0.0, _OFF_TABLE)
    return before


def raised(cell: Cell, T_WE: np.ndarray, height: float) -> np.ndarray:
    """The pose (4, 4) at which an object is lifted high enough that a hand, now at T_WE, gripped
    `height` m over the table; never below T_WE."""
    lifted = T_WE.copy()
    high = max(height, 0.0) + cell.config.execution.lift_height + LIFT_MARGIN
    lifted[2, 3] = max(high, height_over(cell, height), T_WE[2, 3] + 2 * _SLOW_LIFT)
    return lifted


def place_over_tray(top: float) -> np.ndarray:
    """(3,) m in W, where E releases an object that has been lifted `top` m high: it may hang far
    below the hand."""
    return np.array([*TRAY_CENTRE, max(_OVER_TRAY, top)])


def way_to_tray(cell: Cell, q: np.ndarray, top: float) -> Trajectory:
    """From joint positions q (7,), at which an object has been lifted `top` m high, to the tray; by
    way of home, where the hand is high, if something hangs over the table. Raises
    UnreachableError."""
    posture = choose_posture(top_down_pose(place_over_tray(top), -np.pi / 2), cell.home)
    if not cell.hanging:
        return cell.robot.joint_move(q, posture, **scales(cell))
    first = cell.robot.joint_move(q, cell.home, **scales(cell))
    return _joined([first, cell.robot.joint_move(cell.home, posture, **scales(cell))])


def _joined(parts: list[Trajectory]) -> Trajectory:
    """Motions after each other, with a rest between them."""
    positions, velocities = zip(*((part.positions, part.velocities) for part in parts))
    return Trajectory(np.concatenate(positions), np.concatenate(velocities))


def backed(T_WE: np.ndarray, distance: float) -> np.ndarray:
    """The pose (4, 4), `distance` m back against the approach."""
    back = T_WE.copy()
    back[:3, 3] -= distance * T_WE[:3, 2]
    return back


def _distances(target: np.ndarray, trajectory: Trajectory) -> np.ndarray:
    """(N,) metres that E is back from `target` (4, 4) at each reference, along the approach."""
    tips = np.array([tip_position(q) for q in trajectory.positions.tolist()])
    return (target[:3, 3] - tips) @ target[:3, 2]


def farther_than(distance: float, target: np.ndarray, trajectory: Trajectory) -> int:
    """The number of references at which E is more than `distance` m back from the target."""
    return int((_distances(target, trajectory) > distance).sum())


def higher_than(height: float, trajectory: Trajectory) -> int:
    """The number of references at which E is more than `height` m above the table."""
    return sum(tip_position(q)[2] > height for q in trajectory.positions.tolist())


def _same_side(reached: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """`pose`, flipped if the arm has reached a flipped pose."""
    return pose if reached[:3, 1] @ pose[:3, 1] > 0 else pose @ HALF_TURN


def line(cell: Cell, q: np.ndarray, pose: np.ndarray, speed: float = np.inf) -> Trajectory:
    return cell.robot.straight_move(q, pose, speed, cell.home, **scales(cell))


def scales(cell: Cell) -> dict[str, float]:
    robot = cell.config.robot
    return {
        "velocity_scale": robot.velocity_scale,
        "acceleration_scale": robot.acceleration_scale,
    }


def way_out(cell: Cell, place: np.ndarray, back: np.ndarray) -> float:
    """Metres by which E has to go from a place (3,) along `back` (3,), a unit vector, to be out
    from under all that hangs over the table; 0 where it is out already, or cannot get out so."""
    steps = np.arange(0.0, _FARTHEST, _STEP)
    places = place + steps[:, None] * back
    below = np.zeros(len(steps), bool)
    for box in cell.hanging:
        apart = np.maximum(abs(places - box.position) - box.half_size, 0.0)[:, :2]
        below |= (np.linalg.norm(apart, axis=1) < _OUT) & (places[:, 2] < box.position[2])
    return float(steps[below.argmin()]) if below[0] and not below.all() else 0.0


def height_over(cell: Cell, gripped_at: float) -> float:
    """Metres over the table at which the hand takes an object, that it gripped at `gripped_at` m,
    over what hangs over the table; 0 where nothing does."""
    tops = [box.position[2] + box.half_size[2] for box in cell.hanging]
    return max(tops) + _OVER + max(gripped_at, 0.0) if tops else 0.0
