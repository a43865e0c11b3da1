"""One round of clutter removal: a policy picks until the scene is empty or it gives up.

The stop rule is VGN's (Breyer et al., CoRL 2020): a round ends when everything is cleared, when
the policy finds no grasp, or after `max_failures` failed grasps in a row.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from envs.cell import Cell, PhysicsError
from envs.execution import GraspOutcome, execute_grasp
from envs.scenes import Scene
from utils.results import NO_PLAN, AttemptRecord, RoundRecord
from utils.transforms import Grasp, RGBDFrame, grasp_to_image


def run_round(
    cell: Cell,
    scene: Scene,
    plan: Callable[[RGBDFrame], list[Grasp]],
    *,
    policy: str,
    objects: str,
    max_failures: int,
    with_truth: bool = False,
    on_attempt: Callable[[RGBDFrame, Grasp, GraspOutcome], None] | None = None,
) -> RoundRecord:
    """Load a scene and let a planner work on it; the record of what happened.

    policy, objects: names for the record. with_truth: the planner is privileged. on_attempt is
    called after every executed grasp with the frame it was planned on (for pictures).
    """
    cell.load(scene)
    attempts: list[AttemptRecord] = []
    failures_in_a_row, plan_seconds, ended = 0, 0.0, "cleared"
    try:
        while cell.remaining and failures_in_a_row < max_failures:
            frame = cell.frame(with_truth)
            start = time.perf_counter()
            grasps = plan(frame if with_truth else frame.without_truth())
            plan_seconds = time.perf_counter() - start
            if not grasps:
                attempts.append(AttemptRecord(False, NO_PLAN, plan_seconds, 0.0))
                ended = NO_PLAN
                break
            outcome = execute_grasp(cell, grasps[0])
            on_image = grasp_to_image(grasps[0], frame.K, frame.T_WC)
            attempts.append(
                AttemptRecord(
                    outcome.success, outcome.reason, plan_seconds, outcome.sim_seconds, on_image
                )
            )
            failures_in_a_row = 0 if outcome.success else failures_in_a_row + 1
            if on_attempt is not None:
                on_attempt(frame, grasps[0], outcome)
    except PhysicsError:
        attempts.append(AttemptRecord(False, "physics", plan_seconds, 0.0))
        ended = "physics"
    if ended == "cleared" and cell.remaining:
        ended = "failures"
    cleared = sum(attempt.success for attempt in attempts)
    if ended == "cleared" and cleared < len(scene.placements):
        ended = "lost"
    return RoundRecord(
        policy, scene.layout, objects, scene.seed, len(scene.placements), cleared,
        tuple(attempts), ended,
    )  # fmt: skip
