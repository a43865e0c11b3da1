"""One round of clutter removal: a policy picks until the scene is empty or the policy gives up.

The stop rule is VGN's (Breyer et al., CoRL 2020): a round ends when every object is removed, when
the planner finds no grasp that is likely enough, or after `max_failures` failed grasps in a row. A
round also ends when its planner raises an exception. `envs.next_grasp` tells which grasp of a plan
is tried.

Where a scene has a target, the frames show its visible pixels, as a user's click or a segmenter
would: the simulator gives them, which is a privilege. `models.planner_target` moves aside what is
in its way, and the round ends when the target is in the tray, or after as many grasps as objects.
"""

from __future__ import annotations

import contextlib
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from dataclasses import astuple, replace
from functools import partial
from typing import Protocol

import numpy as np

from envs.cell import Cell, PhysicsError
from envs.cell_layout import Scene
from envs.closed_loop import ClosedLoop
from envs.execution import Approach, ApproachResult, GraspOutcome, execute_grasp, open_loop
from envs.floating_execution import execute_floating
from envs.next_grasp import Failures, choose, least_quality
from envs.objects import fits
from envs.scenarios import SCENARIOS, CameraCalibration, disturbed, teach
from envs.second_look import CM3, SecondLook
from models.planner_target import TargetPlanner
from models.planners import Planner, calibration_of, needs_truth, reset_planner
from utils.depth_correction import table_roughness
from utils.errors import TargetLostError, one_line
from utils.geometry import Workspace
from utils.result_records import (
    FELL_OFF,
    NO_PLAN,
    OPEN_LOOP,
    PLANNER_ERROR,
    AttemptRecord,
    RoundRecord,
    policy_name,
)
from utils.transforms import PLANAR, Grasp, RGBDFrame, grasp_to_image


class GraspFinder(Protocol):
    """An `envs.execution.Approach` that finds its own grasps on the way, such as
    `envs.policy_approach.PolicyApproach`. closed_at: the hand's pose when it closed, None if it has
    not closed."""

    closed_at: Grasp | None

    def __call__(self, cell: Cell, grasp: Grasp) -> ApproachResult: ...


class PlannerError(Exception):
    """A planner raised an exception or returned something else than grasps."""


class NoGraspsError(TypeError):
    """A planner returned what cannot be executed."""


def run_round(
    cell: Cell,
    scene: Scene,
    plan: Planner,
    *,
    policy: str,
    objects: str,
    max_failures: int,
    scenario: str | None = None,
    controller: str = OPEN_LOOP,
    on_attempt: Callable[[RGBDFrame, Grasp, GraspOutcome], None] | None = None,
    approach_by: GraspFinder | None = None,
    abstain: float | None = 0.0,
    second_look: float = 0.0,
) -> RoundRecord:
    """Load a scene, let a planner work on it, and return the record.

    plan: the planner, which is first reset with the scene's seed if it has `reset`.
    policy, objects: the planner's and the object set's name in the record.
    scenario: a key of SCENARIOS, the conditions of the round; None: the scene's layout.
    controller: how the arm reaches the grasps.
    on_attempt: called after every executed grasp with the frame that it was planned on.
    approach_by: a policy that finds its own grasps on the way; the planned ones are ignored.
    abstain: grasps of less quality are not tried; where there are no others, the round ends as if
        the planner had found none. None: see `least_quality`.
    second_look: cm3 of open space that a second frame has to show for the arm to take it before an
        attempt; 0: it takes none. Planners that see the truth need none, nor do learned policies.
    """
    scenario = scenario or scene.layout
    conditions = SCENARIOS[scenario]
    privileged, chances = needs_truth(plan), calibration_of(plan)
    if chances is not None and not cell.has_arm:
        chances = replace(chances, doubt=0.0)  # an arm's
    least = least_quality(plan, abstain, cell.has_arm)
    taught = None if controller == OPEN_LOOP else teach(cell, scene)
    cell.load(scene)
    calibration = conditions.calibration(cell)
    too_large = {
        index
        for index, placed in enumerate(scene.placements)
        if not fits(placed.model, cell.gripper)
    }
    sees_all = privileged or approach_by is not None
    look_again = SecondLook(
        cell,
        0.0 if sees_all else second_look * CM3,
        partial(calibrated, cell, calibration, "wrist"),
    )
    wanted = scene.target
    if wanted is not None:
        plan = TargetPlanner(plan)
    attempts: list[AttemptRecord] = []
    failures = Failures()
    plan_seconds, began, ended = 0.0, cell.seconds, "cleared"
    table_height = Workspace().table_height

    def see() -> RGBDFrame:
        mount = cell.config.camera.mount
        return calibrated(cell, calibration, mount, cell.frame(privileged))

    try:
        with planner_errors(policy):
            reset_planner(plan, scene.seed)
        while cell.remaining and len(failures.in_a_row) < max_failures:
            plan_seconds, began = 0.0, cell.seconds
            frame = look_again(see)
            if wanted is not None:
                assert frame.segmentation is not None  # a cell's frames have it
                frame = replace(frame, target=frame.segmentation == wanted)
            start = time.perf_counter()
            try:
                with planner_errors(policy):
                    grasps = checked_grasps(
                        plan(frame if privileged else frame.without_truth()),
                        planar=controller != OPEN_LOOP,
                    )
            finally:
                plan_seconds = time.perf_counter() - start + look_again.plan_seconds
            grasp, why = choose(cell, grasps, failures, least, chances)
            if grasp is None:
                detail, spent = _details(look_again.remark, why), look_again.sim_seconds
                attempts.append(AttemptRecord(False, NO_PLAN, plan_seconds, spent, detail=detail))
                ended = NO_PLAN
                break
            approach = approach_by or open_loop
            if controller != OPEN_LOOP:
                seen = frame.without_truth()
                # The time to process an image counts as if the image had come later.
                late = conditions.latency + cell.config.closed_loop.compute_seconds
                approach = ClosedLoop(cell, controller, seen, calibration, taught, late)
            aim = nearest_object(cell, grasp) if too_large else None
            with disturbed(cell, conditions.motion(cell, len(attempts))):
                outcome = (
                    execute_grasp(cell, grasp, approach, firmly=failures.slipped)
                    if cell.has_arm
                    else execute_floating(cell, grasp)
                )
            if approach_by is not None and approach_by.closed_at is not None:
                grasp = approach_by.closed_at
            held = outcome.object_index
            record = AttemptRecord(
                outcome.success,
                outcome.reason,
                plan_seconds,
                outcome.sim_seconds + look_again.sim_seconds,
                grasp_to_image(grasp, frame.K, frame.T_WC),
                detail=_details(look_again.remark, outcome.detail),
                held=None if held is None else scene.placements[held].model.name,
                graspable=(aim if held is None else held) not in too_large,
                tilt=grasp.tilt,
                roughness=0.0 if privileged else table_roughness(frame, table_height),
                **_in_hand(outcome),
                **_turn_ms(approach),
            )
            attempts.append(record)
            failures.note(grasp, outcome)
            if on_attempt is not None:
                on_attempt(frame, grasp, outcome)
            if wanted is not None:
                if wanted not in cell.remaining:
                    ended = "target" if outcome.success and held == wanted else FELL_OFF
                    break
                if len(attempts) == len(scene.placements):
                    ended = "picks"
                    break
    except PlannerError as error:
        detail, spent = _details(look_again.remark, str(error)), look_again.sim_seconds
        attempts.append(AttemptRecord(False, PLANNER_ERROR, plan_seconds, spent, detail=detail))
        ended = PLANNER_ERROR
    except PhysicsError:
        attempts.append(AttemptRecord(False, "physics", plan_seconds, cell.seconds - began))
        ended = "physics"
    if ended == "cleared" and cell.remaining:
        ended = "failures"
    cleared = sum(attempt.success for attempt in attempts)
    if ended == "cleared" and cleared < len(scene.placements):
        ended = FELL_OFF
    return RoundRecord(
        policy_name(policy, controller), scenario, objects, scene.seed, len(scene.placements),
        cleared, tuple(attempts), ended, controller, cell.sample, len(too_large),
        cell.config.camera.depth_noise,
        None if chances is None else astuple(chances),
        None if wanted is None else ended == "target",
    )  # fmt: skip


# --- Parts of a round ------------------------------------------------------------------------


@contextlib.contextmanager
def planner_errors(name: str) -> Iterator[None]:
    """Turn any exception of a planner, which may be anyone's code, into a PlannerError with its
    name and place."""
    try:
        yield
    except Exception as error:
        if isinstance(error, NoGraspsError):
            raise PlannerError(f"{name}: {error}") from error
        last = traceback.extract_tb(error.__traceback__)[-1]
        message, place = one_line(error), f"{last.filename}, line {last.lineno}"
        raise PlannerError(f"{name} raised {type(error).__name__}: {message} ({place})") from error


def checked_grasps(grasps: object, planar: bool = False) -> Sequence[Grasp]:
    """What a planner returned. Raises NoGraspsError for anything but a list or tuple of grasps, and
    where they have to be `planar` and one is tilted."""
    if not isinstance(grasps, list | tuple) or not all(isinstance(g, Grasp) for g in grasps):
        raise NoGraspsError(f"a planner returns a list of Grasp, this one returned {grasps!r:.60}")
    if planar and any(grasp.tilt > PLANAR for grasp in grasps):
        raise NoGraspsError(
            "a closed loop follows grasps from straight above, this planner tilted one; use "
            f"closed_loop.controller={OPEN_LOOP}"
        )
    return grasps


def calibrated(
    cell: Cell, calibration: CameraCalibration, mount: str, frame: RGBDFrame
) -> RGBDFrame:
    """A frame of the overhead or the wrist camera, taken now, with the camera pose of the
    calibration. An image in which no table is found cannot be levelled."""
    T_WE = cell.robot.encoder_pose()
    try:
        return calibration.frame(frame, mount, T_WE)
    except TargetLostError:
        return replace(calibration, levelled=False).frame(frame, mount, T_WE)


def nearest_object(cell: Cell, grasp: Grasp) -> int:
    """The number of the object that is nearest to the point between the fingertips of a grasp."""
    solids = [item.solids for item in cell.truth().objects]
    gaps = [
        min((solid.normals @ grasp.position - solid.offsets).max() for solid in parts)
        for parts in solids
    ]
    return sorted(cell.remaining)[int(np.argmin(gaps))]


def _in_hand(outcome: GraspOutcome) -> dict[str, float]:
    """Fields of an AttemptRecord on how what was held has moved in the hand."""
    moved = outcome.motion
    return {} if moved is None else {"turned": moved.turned, "slid": moved.slid}


def _turn_ms(approach: Approach) -> dict[str, float]:
    """Fields of an AttemptRecord on the turns of a closed loop that has made any."""
    turns = approach.record.turn_seconds if isinstance(approach, ClosedLoop) else []
    if not turns:
        return {}
    return {
        "turn_ms": 1000 * float(np.percentile(turns, 95)),
        "turn_ms_mean": 1000 * float(np.mean(turns)),
    }


def _details(*sentences: str) -> str:
    """Those that are not empty, in one."""
    return "; ".join(filter(None, sentences))
