"""One round of clutter removal: a policy picks until the scene is empty or the policy gives up.

The stop rule is VGN's (Breyer et al., CoRL 2020): a round ends when every object is removed, when
the planner finds no grasp that is likely enough, or after `max_failures` failed grasps in a row. A
round also ends when its planner raises an exception. What has failed is not tried again at once,
for often nothing has moved: grasps elsewhere that are more likely to succeed than not (whose
quality as planned is 0.5 or more) come first, and of the others those that are not alike one that
has just failed. After a failure, all qualities that are chances count as lower
(`utils.calibration`): by these it is judged, and recorded, whether a grasp is worth trying.

Where a scene has a target, the frames show its visible pixels, as a user's click or a segmenter
would: the simulator gives them, which is a privilege. `models.planner_target` moves aside what is
in its way, and the round ends when the target is in the bin, or after as many grasps as objects.
"""

from __future__ import annotations

import contextlib
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import astuple, replace
from functools import partial
from typing import Protocol

import numpy as np

from envs.cell import Cell, PhysicsError
from envs.cell_layout import Scene
from envs.closed_loop import ClosedLoop
from envs.execution import Approach, ApproachResult, GraspOutcome, execute_grasp, open_loop, reaches
from envs.floating_execution import clears_table, execute_floating
from envs.objects import fits
from envs.scenarios import SCENARIOS, CameraCalibration, disturbed, teach
from envs.second_look import CM3, SecondLook
from models.planner_target import TargetPlanner
from models.planners import Planner, calibration_of, needs_truth, reset_planner
from utils.calibration import LEAST_CHANCE, Calibration
from utils.depth_correction import table_roughness
from utils.errors import TargetLostError, one_line
from utils.geometry import Workspace
from utils.result_records import (
    NO_PLAN,
    OPEN_LOOP,
    PLANNER_ERROR,
    AttemptRecord,
    RoundRecord,
    policy_name,
)
from utils.transforms import PLANAR, Grasp, RGBDFrame, grasp_to_image

# A grasp nearer than both to one that failed is the same one again.
TRIED_DISTANCE = 0.02  # m
TRIED_ANGLE = np.deg2rad(30)
ANOTHER = 0.05  # m from every grasp that failed: most likely another object
ROOM_OVER_TOUCH = 0.004  # m above the height of a contact


class GraspFinder(Protocol):
    """An `envs.execution.Approach` that finds its own grasps on the way, such as
    `envs.policy_approach.PolicyApproach`. closed_at: the hand's pose when it closed, None if it has
    not closed."""

    closed_at: Grasp | None

    def __call__(self, cell: Cell, grasp: Grasp) -> ApproachResult: ...


class PlannerError(Exception):
    """A planner raised an exception or returned something else than grasps."""


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
    taught = None if controller == OPEN_LOOP else teach(cell)
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
    failed: list[Grasp] = []  # in a row
    missed: list[Grasp] = []  # in the round
    stops: list[np.ndarray | None] = []  # where the hand was when its palm met something
    plan_seconds, ended, table_height = 0.0, "cleared", Workspace().table_height

    def see() -> RGBDFrame:
        mount = cell.config.camera.mount
        return calibrated(cell, calibration, mount, cell.frame(privileged))

    try:
        with planner_errors(policy):
            reset_planner(plan, scene.seed)
        while cell.remaining and len(failed) < max_failures:
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
            now = partial(after_a_failure, chances=chances if failed else None)
            worth = [grasp for grasp in grasps if now(grasp).quality >= least]
            ordered = elsewhere_first(worth, missed) if missed else worth
            chosen = first_untried(within_reach(cell, ordered), failed)
            if chosen is None:
                why = _out_of_reach(worth) if worth else _abstained(map(now, grasps), least)
                detail = _details(look_again.remark, why)
                spent = look_again.sim_seconds
                attempts.append(AttemptRecord(False, NO_PLAN, plan_seconds, spent, detail=detail))
                ended = NO_PLAN
                break
            grasp = now(no_deeper(chosen, failed, stops))
            approach: Approach = open_loop
            if controller != OPEN_LOOP:
                seen = frame.without_truth()
                # The time to process an image counts as if the image had come later.
                late = conditions.latency + cell.config.closed_loop.compute_seconds
                approach = ClosedLoop(cell, controller, seen, calibration, taught, late)
            elif approach_by is not None:
                approach = approach_by
            aim = nearest_object(cell, grasp) if too_large else None
            with disturbed(cell, conditions.motion(cell, len(attempts))):
                outcome = (
                    execute_grasp(cell, grasp, approach)
                    if cell.has_arm
                    else execute_floating(cell, grasp)
                )
            if approach_by is not None and approach_by.closed_at is not None:
                grasp = approach_by.closed_at
            held = outcome.object_index
            attempts.append(
                AttemptRecord(
                    outcome.success,
                    outcome.reason,
                    plan_seconds,
                    outcome.sim_seconds + look_again.sim_seconds,
                    grasp_to_image(grasp, frame.K, frame.T_WC),
                    detail=_details(look_again.remark, outcome.detail),
                    held=_name_of(scene, held),
                    turned=None if outcome.motion is None else outcome.motion.turned,
                    slid=None if outcome.motion is None else outcome.motion.slid,
                    graspable=(aim if held is None else held) not in too_large,
                    tilt=grasp.tilt,
                    roughness=0.0 if privileged else table_roughness(frame, table_height),
                    **_turn_ms(approach),
                )
            )
            failed = [] if outcome.success else [*failed, grasp]
            missed += [] if outcome.success else [grasp]
            stops = [] if outcome.success else [*stops, outcome.palm_stopped_at]
            if on_attempt is not None:
                on_attempt(frame, grasp, outcome)
            if wanted is not None:
                if wanted not in cell.remaining:
                    ended = "target" if outcome.success and held == wanted else "lost"
                    break
                if len(attempts) == len(scene.placements):
                    ended = "picks"
                    break
    except PlannerError as error:
        detail, spent = _details(look_again.remark, str(error)), look_again.sim_seconds
        attempts.append(AttemptRecord(False, PLANNER_ERROR, plan_seconds, spent, detail=detail))
        ended = PLANNER_ERROR
    except PhysicsError:
        attempts.append(AttemptRecord(False, "physics", plan_seconds, 0.0))
        ended = "physics"
    if ended == "cleared" and cell.remaining:
        ended = "failures"
    cleared = sum(attempt.success for attempt in attempts)
    if ended == "cleared" and cleared < len(scene.placements):
        ended = "lost"
    return RoundRecord(
        policy_name(policy, controller), scenario, objects, scene.seed, len(scene.placements),
        cleared, tuple(attempts), ended, controller, cell.sample, len(too_large),
        cell.config.camera.depth_noise,
        None if chances is None else astuple(chances),
        None if wanted is None else ended == "target",
    )  # fmt: skip


@contextlib.contextmanager
def planner_errors(name: str) -> Iterator[None]:
    """Turn any exception of a planner, which may be anyone's code, into a PlannerError with its
    name and place."""
    try:
        yield
    except Exception as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        message, place = one_line(error), f"{last.filename}, line {last.lineno}"
        raise PlannerError(f"{name} raised {type(error).__name__}: {message} ({place})") from error


def checked_grasps(grasps: object, planar: bool = False) -> Sequence[Grasp]:
    """What a planner returned. Raises TypeError for anything but a list or tuple of grasps, and
    ValueError where they have to be `planar` and one is tilted."""
    if not isinstance(grasps, list | tuple) or not all(isinstance(g, Grasp) for g in grasps):
        raise TypeError(f"a planner returns a list of Grasp, this one returned {grasps!r:.60}")
    if planar and any(grasp.tilt > PLANAR for grasp in grasps):
        raise ValueError(
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


def _name_of(scene: Scene, index: int | None) -> str | None:
    return None if index is None else scene.placements[index].model.name


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


def _abstained(grasps: Iterable[Grasp], least: float) -> str:
    """Why none of the grasps is tried; empty where there are none."""
    best = max((grasp.quality for grasp in grasps), default=None)
    return "" if best is None else f"abstained: the best quality is {best:.4g}, under {least:g}"


def _out_of_reach(grasps: Sequence[Grasp]) -> str:
    return f"all planned grasps ({len(grasps)}) are out of reach"


def least_quality(planner: Planner, abstain: float | None, has_arm: bool) -> float:
    """Below which quality a planner's grasps are not tried. abstain: as in the config; None leaves
    out what is more likely to fail, where the planner states chances of success, an arm's."""
    if abstain is not None:
        return abstain
    return LEAST_CHANCE if has_arm and calibration_of(planner) is not None else 0.0


def after_a_failure(grasp: Grasp, chances: Calibration | None) -> Grasp:
    """The grasp with the chance that it has after a failure, by its planner's calibration; itself
    without one."""
    if chances is None:
        return grasp
    return replace(grasp, quality=chances.after_failure(grasp.quality))


def within_reach(cell: Cell, grasps: Sequence[Grasp]) -> Iterator[Grasp]:
    """The grasps that the arm can go to, in their order; those from straight above are not asked
    where nothing hangs over the table, because nearly all are. A floating hand reaches all that are
    above the table."""
    reachable = reaches if cell.has_arm else clears_table
    least = 0.0 if cell.hanging else PLANAR
    for grasp in grasps:
        if grasp.tilt < least or reachable(cell, grasp):
            yield grasp


def first_untried(grasps: Iterable[Grasp], failed: Sequence[Grasp]) -> Grasp | None:
    """The first grasp that is not near one of those that failed; the first of all where each is;
    None of none."""
    first = None
    for grasp in grasps:
        first = first or grasp
        if not any(_alike(grasp, other) for other in failed):
            return grasp
    return first


def elsewhere_first(grasps: Iterable[Grasp], failed: Sequence[Grasp]) -> list[Grasp]:
    """The grasps in their order, but first those that are more likely to succeed than not and lie
    ANOTHER from all that failed."""

    def is_near(grasp: Grasp) -> bool:
        gaps = [np.linalg.norm(grasp.position - other.position) for other in failed]
        return grasp.quality < LEAST_CHANCE or bool(min(gaps, default=np.inf) < ANOTHER)

    return sorted(grasps, key=is_near)


def _alike(grasp: Grasp, other: Grasp) -> bool:
    """Whether two grasps are so near each other that one of them is enough to try."""
    along = grasp.approach
    apart = grasp.position - other.position
    beside = apart - (apart @ along) * along  # a deeper grasp is the same one
    cosines = abs(grasp.closing_direction @ other.closing_direction), along @ other.approach
    return bool(np.linalg.norm(beside) <= TRIED_DISTANCE and min(cosines) >= np.cos(TRIED_ANGLE))


def no_deeper(grasp: Grasp, failed: Sequence[Grasp], stops: Sequence[np.ndarray | None]) -> Grasp:
    """The grasp, drawn back before the places `stops` (m, of E) at which the palm met something.

    A camera may miss a thin part that stands up from an object; the contact with the palm tells how
    high that part is.
    """
    deepest = min(
        (
            stop @ grasp.approach - ROOM_OVER_TOUCH
            for other, stop in zip(failed, stops)
            if stop is not None and _alike(replace(other, angle=grasp.angle), grasp)
        ),
        default=np.inf,
    )
    too_deep = grasp.position @ grasp.approach - deepest
    if too_deep <= 0:
        return grasp
    return replace(grasp, position=grasp.position - too_deep * grasp.approach)
