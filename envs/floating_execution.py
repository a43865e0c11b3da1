"""Execute planned grasps with a floating hand and judge them, as VGN's clutter removal does.

The sibling of `envs.execution` for cells without an arm (Breyer et al., "Volumetric Grasping
Network", CoRL 2020, whose protocol GIGA, Edge Grasp Network, OrbitGrasp and others share). This
module does not know how grasps are planned.
"""

from __future__ import annotations

from dataclasses import replace
from typing import cast

import numpy as np

from envs.arm_paths import LIFT_MARGIN
from envs.cell import Cell
from envs.cell_layout import GRAVITY, REST_SPEED, rest_check_steps, table_box
from envs.execution import (
    GraspFailure,
    GraspOutcome,
    InHandMotion,
    close_fingers,
    holding_force,
    physics_errors,
)
from envs.floating_hand import FloatingHand, meets_box, park
from utils.result_records import loose
from utils.transforms import Grasp

PREGRASP = 0.05  # m back along the approach, where the hand is put: VGN's
RETREAT = 0.10  # m, VGN's
SIDEWAYS = np.pi / 3  # rad of tilt beyond which VGN's hand retreats straight up
CARRY, CARRY_SPEED = np.array([0.0, -0.25, 0.0]), 1.0  # m, m/s: towards an arm's tray


def clears_table(cell: Cell, grasp: Grasp) -> bool:
    """Whether the whole hand is above the table, or beside it, at a grasp."""
    opening = cell.gripper.opening_before(grasp.width)
    return not meets_box(cell.gripper, grasp.pose, opening, table_box())


def execute_floating(cell: Cell, grasp: Grasp) -> GraspOutcome:
    """Put the hand before a grasp, approach, close, retreat, and judge.

    The hand is put PREGRASP before the grasp, as wide open as the gripper's `opens_fully` says, and
    moves at execution.approach_speed. A contact where it is put is a `collision`, and so is one on
    its way in, unless execution.on_contact is `grip`: then the hand stops and closes there.
    Success: after a retreat of RETREAT, along the approach or, from a side where nothing hangs over
    the table, straight up, both fingers grip one object and are more than gripper.least_held apart.
    `missed`: nothing was ever between the fingers, or too narrow a thing. `slipped`: an object was,
    and was lost. A picked object is retired. With execution.strict, an object may also not move in
    the hand. At the end of an attempt the hand is away and the objects have come to rest. Raises
    PhysicsError when the simulation blows up.
    """
    start = cell.seconds
    outcome = _not_empty(cell, attempt(cell, grasp))
    if outcome.success and outcome.object_index is not None:
        cell.retire(outcome.object_index)
    park(floating_hand(cell), cell.config.workspace)
    _let_rest(cell)
    cell.check_physics()
    cell.retire_lost_objects()
    detail = "" if outcome.success else outcome.detail
    return replace(outcome, sim_seconds=cell.seconds - start, detail=detail)


def attempt(cell: Cell, grasp: Grasp, carry: bool = False) -> GraspOutcome:
    """As `execute_floating`, up to the judgement, and however thin the object is: afterwards the
    hand is where it is, with what it holds, and the detail of a success tells what it met.

    carry: ask for what an arm has to do (`envs.execution.execute_grasp`) as far as a hand can show
    it. The fingers press as hard as its weight needs, and after the retreat the object is carried
    CARRY away; at the end it has to be off the table and, unless something hangs over it, lifted.
    """
    cell.check_physics()
    with physics_errors(cell):
        outcome = _attempt(cell, grasp, carry)
    cell.check_physics()  # before the hand is put elsewhere, which hides what blew up
    return outcome


def _attempt(cell: Cell, grasp: Grasp, carry: bool) -> GraspOutcome:
    hand = floating_hand(cell)
    start, held, motion = cell.seconds, None, None
    reason, met, detail = "success", "", ""
    try:
        met = _approach(cell, hand, grasp)
        hand.yield_to_fingers()
        close_fingers(cell, cell.step)
        hand.hold()
        closed = float(hand.tip_pose()[2, 3])
        held = cell.held_object()
        motion = None if held is None else InHandMotion(cell, held)
        if carry and held is not None:
            hand.command_gripper(0.0, max(holding_force(_weight(cell, held)), hand.grip_force))
        with hand.carrying():
            _retreat(cell, hand, grasp)
            _judge(cell, held, motion)
            if carry and held is not None:
                _carry(cell, hand, held, max(grasp.position[2], closed))
        detail = met
    except GraspFailure as failure:
        reason, detail = failure.reason, ", and ".join(filter(None, [met, failure.detail]))
    stopped_at = None
    if reason == "collision" and hand.palm_touches():
        stopped_at = hand.tip_pose()[:3, 3].copy()
    return GraspOutcome(reason, cell.seconds - start, held, detail, stopped_at, motion)


def floating_hand(cell: Cell) -> FloatingHand:
    """The robot of a cell without an arm."""
    return cast(FloatingHand, cell.robot)


def _approach(cell: Cell, hand: FloatingHand, grasp: Grasp) -> str:
    """Bring the open hand to a grasp; where it met something on its way and closes there, says
    how far before the grasp. Raises GraspFailure where a contact is a collision."""
    pregrasp = grasp.pose
    pregrasp[:3, 3] -= PREGRASP * grasp.approach
    hand.put(pregrasp, cell.gripper.opening_before(grasp.width))
    if hand.overlaps():
        raise GraspFailure(
            "collision",
            f"the open hand has no room where it starts, {1000 * PREGRASP:.0f} mm before the grasp",
        )
    for q, velocity in zip(*hand.line(grasp.position, cell.config.execution.approach_speed)):
        hand.command(q, velocity)
        cell.step()
        if hand.contact_force() > 0.0:
            left = float((grasp.position - hand.tip_pose()[:3, 3]) @ grasp.approach)
            met = f"the open hand met something {1000 * left:.0f} mm before the grasp"
            if cell.config.execution.on_contact == "fail":
                raise GraspFailure("collision", met)
            hand.hold()
            return f"{met} and closed there"
    return ""


def _retreat(cell: Cell, hand: FloatingHand, grasp: Grasp) -> None:
    up = grasp.tilt > SIDEWAYS + 1e-6 and not cell.hanging
    away = np.array([0.0, 0.0, 1.0]) if up else -grasp.approach
    _move(cell, hand, hand.tip_pose()[:3, 3] + RETREAT * away, cell.config.execution.approach_speed)


def _move(cell: Cell, hand: FloatingHand, goal: np.ndarray, speed: float) -> None:
    """Move the hand on a straight line to `goal` (3,) m in W."""
    for q, velocity in zip(*hand.line(goal, speed)):
        hand.command(q, velocity)
        cell.step()


def _weight(cell: Cell, index: int) -> float:
    """Newtons."""
    assert cell.scene is not None  # something is held
    return cell.scene.placements[index].model.mass * GRAVITY


def _carry(cell: Cell, hand: FloatingHand, held: int, height: float) -> None:
    """Lift what was gripped `height` m over the table as high as an arm has to, and carry it aside;
    below something that hangs, it stays where it is. Raises GraspFailure."""
    least = 0.0
    if not cell.hanging:
        least = cell.config.execution.lift_height
        top = hand.tip_pose()[:3, 3]
        top[2] = max(top[2], max(height, 0.0) + least + LIFT_MARGIN)
        _move(cell, hand, top, cell.config.execution.approach_speed)
        _move(cell, hand, top + CARRY, CARRY_SPEED)
    if not cell.is_lifted(held, least):
        raise GraspFailure("dropped")


def _judge(cell: Cell, gripped: int | None, motion: InHandMotion | None) -> None:
    """Raises GraspFailure unless the object that was gripped is held after the retreat."""
    if gripped is None or motion is None:
        raise GraspFailure("missed")
    if cell.held_object() != gripped:
        raise GraspFailure("slipped")
    motion.look()
    moved = loose(motion.turned, motion.slid)
    if moved and cell.config.execution.strict:
        raise GraspFailure(moved[0])


def _not_empty(cell: Cell, outcome: GraspOutcome) -> GraspOutcome:
    """The outcome of an attempt by VGN's rule: a hand that is nearly closed counts as empty."""
    hand = floating_hand(cell)
    least = hand.gripper.least_held
    if not outcome.success or hand.opening > least:
        return outcome
    thin = (
        f"the fingers are {1000 * hand.opening:.1f} mm apart after the retreat, where "
        f"{1000 * least:g} mm or less count as empty"
    )
    detail = ", and ".join(filter(None, [outcome.detail, thin]))
    return replace(outcome, reason="missed", detail=detail)


def _let_rest(cell: Cell) -> None:
    """Wait until the objects rest, for at most scene.settle_seconds."""
    steps = rest_check_steps(cell.config.sim.frequency)
    for _ in range(int(cell.config.scene.settle_seconds / (steps * cell.dt))):
        cell.step(steps)
        if all(cell.speed(index) < REST_SPEED for index in cell.remaining):
            return
