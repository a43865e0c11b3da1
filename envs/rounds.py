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
from envs.execution import (
    Approach,
    ApproachResult,
    GraspOutcome,
    execute_grasp,
    open_loop,
    physics_errors,
)
from envs.floating_execution import execute_floating
from envs.next_grasp import Failures, choose, least_quality
from envs.objects import fits
from envs.scenarios import SCENARIOS, CameraCalibration, Scenario, disturbed, teach
from envs.second_look import CM3, SecondLook
from models.planner_target import TargetPlanner
from models.planners import Planner, calibration_of, needs_truth, reset_planner
from utils.depth_correction import table_roughness
from utils.errors import TargetLostError, one_line
from utils.geometry import Workspace
from utils.random_streams import planner_seed
from utils.result_records import (
    FELL_OFF,
    NO_PLAN,
    OPEN_LOOP,
    PLANNER_ERROR,
    AttemptRecord,
    RoundRecord,
    policy_name,
)
from utils.transforms import (
    PLANAR,
    Grasp,
    RGBDFrame,
    grasp_to_image,
    inverse_pose,
    transform_points,
)


class GraspFinder(Protocol):
    """An `envs.execution.Approach` that finds its own grasps on the way, such as
    `envs.policy_approach.PolicyApproach`. closed_at: the hand's pose when it closed, None if it has
    not closed."""

    closed_at: Grasp | None

    def __call__(self, cell: Cell, grasp: Grasp) -> ApproachResult: ...


OnAttempt = Callable[[RGBDFrame, Grasp, GraspOutcome], None]


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
    on_attempt: OnAttempt | None = None,
    approach_by: GraspFinder | None = None,
    abstain: float | None = 0.0,
    second_look: float = 0.0,
) -> RoundRecord:
    """Load a scene, let a planner work on it, and return the record.

    plan: the planner, which is first reset with the scene's `planner_seed` if it has `reset`.
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
    work = _Round(
        cell, scene, plan, policy=policy, conditions=SCENARIOS[scenario], controller=controller,
        approach_by=approach_by, abstain=abstain, second_look=second_look,
    )  # fmt: skip
    ended = work.play(max_failures, on_attempt)
    return work.record(scenario, objects, ended)


class _Round:
    """A round under way, whose scene is loaded as it is made; its arguments are those of
    `run_round`.

    attempts: those that are over. plan_seconds: wall-clock time of the planning for the attempt
    under way. began: simulated time of its beginning, s.
    """

    def __init__(
        self, cell: Cell, scene: Scene, plan: Planner, *, policy: str, conditions: Scenario,
        controller: str, approach_by: GraspFinder | None, abstain: float | None, second_look: float,
    ):  # fmt: skip
        self.cell, self.scene, self.policy = cell, scene, policy
        self.conditions, self.controller, self.approach_by = conditions, controller, approach_by
        self.privileged, self.chances = needs_truth(plan), calibration_of(plan)
        if self.chances is not None and not cell.has_arm:
            self.chances = replace(self.chances, doubt=0.0)  # an arm's
        self.least = least_quality(plan, abstain, cell.has_arm)
        self.taught = None if controller == OPEN_LOOP else teach(cell, scene)
        cell.load(scene)
        self.calibration = conditions.calibration(cell)
        self.too_large = {
            index
            for index, placed in enumerate(scene.placements)
            if not fits(placed.model, cell.gripper)
        }
        sees_all = self.privileged or approach_by is not None
        self.look_again = SecondLook(
            cell,
            0.0 if sees_all else second_look * CM3,
            partial(calibrated, cell, self.calibration, "wrist"),
        )
        self.planner = plan if scene.target is None else TargetPlanner(plan)
        self.attempts: list[AttemptRecord] = []
        self.failures = Failures()
        self.plan_seconds, self.began = 0.0, cell.seconds

    def play(self, max_failures: int, on_attempt: OnAttempt | None) -> str:
        """Work on the scene until the round ends; returns the key of ENDINGS."""
        try:
            with planner_errors(self.policy):
                reset_planner(self.planner, planner_seed(self.scene.seed))
            while self.cell.remaining and len(self.failures.in_a_row) < max_failures:
                ended = self.turn(on_attempt)
                if ended is not None:
                    return ended
        except PlannerError as error:
            return self.without_grasp(PLANNER_ERROR, str(error))
        except PhysicsError:
            spent = self.cell.seconds - self.began
            self.attempts.append(AttemptRecord(False, "physics", self.plan_seconds, spent))
            return "physics"
        if self.cell.remaining:
            return "failures"
        return "cleared" if self.cleared == len(self.scene.placements) else FELL_OFF

    def turn(self, on_attempt: OnAttempt | None) -> str | None:
        """Look, plan and, where a grasp is likely enough, try it; returns the key of ENDINGS if the
        round ends with that, or else None."""
        self.plan_seconds, self.began = 0.0, self.cell.seconds
        with physics_errors(self.cell):
            frame = self.look()
        grasps = self.plan(frame)
        start = time.perf_counter()
        with physics_errors(self.cell):
            grasp, why = choose(self.cell, grasps, self.failures, self.least, self.chances)
        self.plan_seconds += time.perf_counter() - start
        if grasp is None:
            return self.without_grasp(NO_PLAN, why)
        grasp, outcome = self.attempt(frame, grasp)
        if on_attempt is not None:
            on_attempt(frame, grasp, outcome)
        return self.ending(outcome)

    def look(self) -> RGBDFrame:
        """What the cameras see now, with the target's pixels where there is one."""
        frame = self.look_again(self.see)
        if self.scene.target is None:
            return frame
        assert frame.segmentation is not None  # a cell's frames have it
        return replace(frame, target=frame.segmentation == self.scene.target)

    def see(self) -> RGBDFrame:
        """A frame of the cell's camera, which only a privileged planner's has the truth of."""
        mount = self.cell.config.camera.mount
        return calibrated(self.cell, self.calibration, mount, self.cell.frame(self.privileged))

    def plan(self, frame: RGBDFrame) -> Sequence[Grasp]:
        """The planner's grasps; the time that it took counts even where it raises PlannerError."""
        start = time.perf_counter()
        try:
            with planner_errors(self.policy):
                return checked_grasps(
                    self.planner(frame if self.privileged else frame.without_truth()),
                    frame,
                    self.cell.config.camera.far,
                    planar=self.controller != OPEN_LOOP,
                )
        finally:
            self.plan_seconds = time.perf_counter() - start + self.look_again.plan_seconds

    def without_grasp(self, reason: str, why: str) -> str:
        """Record that the round ends for lack of a grasp; returns the reason, a key of ENDINGS."""
        detail, spent = _details(self.look_again.remark, why), self.look_again.sim_seconds
        self.attempts.append(AttemptRecord(False, reason, self.plan_seconds, spent, detail=detail))
        return reason

    def attempt(self, frame: RGBDFrame, grasp: Grasp) -> tuple[Grasp, GraspOutcome]:
        """Execute a grasp and record it; returns the one at which the hand closed."""
        cell, approach = self.cell, self.approach(frame)
        aim = nearest_object(cell, grasp)
        with disturbed(cell, self.conditions.motion(cell, len(self.attempts))):
            outcome = (
                execute_grasp(cell, grasp, approach, firmly=self.failures.slipped)
                if cell.has_arm
                else execute_floating(cell, grasp)
            )
        if self.approach_by is not None and self.approach_by.closed_at is not None:
            grasp = self.approach_by.closed_at
        self.attempts.append(self.executed(frame, grasp, aim, approach, outcome))
        self.failures.note(grasp, outcome)
        return grasp, outcome

    def approach(self, frame: RGBDFrame) -> Approach:
        """How the arm reaches the grasp that was planned on a frame."""
        if self.controller == OPEN_LOOP:
            return self.approach_by or open_loop
        # The time to process an image counts as if the image had come later.
        late = self.conditions.latency + self.cell.config.closed_loop.compute_seconds
        return ClosedLoop(
            self.cell, self.controller, frame.without_truth(), self.calibration, self.taught, late
        )

    def executed(
        self, frame: RGBDFrame, grasp: Grasp, aim: int, approach: Approach, outcome: GraspOutcome
    ) -> AttemptRecord:
        """The record of an executed grasp. aim: the number of the object nearest to the planned
        one."""
        held, table_height = outcome.object_index, Workspace().table_height
        return AttemptRecord(
            outcome.success,
            outcome.reason,
            self.plan_seconds,
            outcome.sim_seconds + self.look_again.sim_seconds,
            grasp_to_image(grasp, frame.K, frame.T_WC),
            detail=_details(self.look_again.remark, outcome.detail),
            held=None if held is None else self.scene.placements[held].model.name,
            graspable=(aim if held is None else held) not in self.too_large,
            tilt=grasp.tilt,
            roughness=0.0 if self.privileged else table_roughness(frame, table_height),
            aimed=self.scene.placements[aim].model.name,
            **_in_hand(outcome),
            **_turn_ms(approach),
        )

    def ending(self, outcome: GraspOutcome) -> str | None:
        """The key of ENDINGS with which the last attempt has ended a round with a target, None
        where the round goes on."""
        wanted = self.scene.target
        if wanted is None:
            return None
        if wanted not in self.cell.remaining:
            return "target" if outcome.success and outcome.object_index == wanted else FELL_OFF
        return "picks" if len(self.attempts) == len(self.scene.placements) else None

    @property
    def cleared(self) -> int:
        """Objects that were picked."""
        return sum(attempt.success for attempt in self.attempts)

    def record(self, scenario: str, objects: str, ended: str) -> RoundRecord:
        """The record of the round, which has ended."""
        cell, scene = self.cell, self.scene
        return RoundRecord(
            policy_name(self.policy, self.controller), scenario, objects, scene.seed,
            len(scene.placements), self.cleared, tuple(self.attempts), ended, self.controller,
            cell.sample, len(self.too_large), cell.config.camera.depth_noise,
            None if self.chances is None else astuple(self.chances),
            None if scene.target is None else ended == "target",
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


def checked_grasps(
    grasps: object, frame: RGBDFrame, far: float, planar: bool = False
) -> Sequence[Grasp]:
    """What a planner returned, without grasps that the frame's camera, which sees up to `far` m,
    cannot show. Raises NoGraspsError for anything but a list or tuple of grasps, where it shows
    none of them, and where they have to be `planar` and one is tilted."""
    if not isinstance(grasps, list | tuple) or not all(isinstance(g, Grasp) for g in grasps):
        raise NoGraspsError(f"a planner returns a list of Grasp, this one returned {grasps!r:.60}")
    T_CW = inverse_pose(frame.T_WC)
    seen = [grasp for grasp in grasps if 0 < transform_points(T_CW, grasp.position)[2] <= far]
    if grasps and not seen:
        raise NoGraspsError(
            "a planner returns grasps that its camera sees, in metres in the world frame; the first"
            f" of {len(grasps)} lies at {np.array2string(grasps[0].position, precision=3)}"
        )
    if planar and any(grasp.tilt > PLANAR for grasp in grasps):
        raise NoGraspsError(
            "a closed loop follows grasps from straight above, this planner tilted one; use "
            f"closed_loop.controller={OPEN_LOOP}"
        )
    return seen


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
