"""Recorded rounds whose figures are known by hand."""

from __future__ import annotations

from dataclasses import replace

from utils.config import load_config
from utils.result_records import AttemptRecord, RoundRecord


def stopped(reason: str, detail: str) -> AttemptRecord:
    """A failed attempt of a closed loop."""
    return AttemptRecord(False, reason, 0.01, 5.0, turn_ms=14.0, detail=detail, turn_ms_mean=8.0)


def attempt(reason: str, plan: float = 0.01, sim: float = 5.0) -> AttemptRecord:
    return AttemptRecord(reason == "success", reason, plan, sim)


def a_round(policy, seed, total, cleared, attempts, ended="failures", scenario="pile"):
    return RoundRecord(policy, scenario, "box", seed, total, cleared, tuple(attempts), ended)


ROUNDS = [
    a_round("heuristic", 0, 5, 2, [
        attempt("success", 0.010, 6), attempt("missed", 0.020, 4), attempt("success", 0.030, 6),
        attempt("slipped", 0.040, 5), attempt("dropped", 0.050, 3),
    ]),
    a_round("heuristic", 1, 5, 1, [attempt("success", 0.060, 6), attempt("no_plan", 0.100, 0)],
            "no_plan"),
    a_round("random", 0, 5, 0, [attempt("ik", sim=0), attempt("collision", sim=2)]),
    a_round("random", 1, 5, 0, [attempt("no_plan", sim=0)], "no_plan"),
]  # fmt: skip
CONFIG = load_config(
    None,
    ["evaluate.policies=heuristic,random", "evaluate.scenarios=pile", "evaluate.rounds=2",
     "evaluate.object_sets=box", "evaluate.depth_noises=none"],
)  # fmt: skip

# One object was wanted: two of three rounds end with it in the tray, after 1 and 4 grasps.
RETRIEVED = [
    replace(
        a_round("heuristic", seed, 5, 2, [attempt("success")] * picks, "target" if found else
                "picks", "retrieve"),
        target_in_hand=found,
    )
    for seed, (picks, found) in enumerate([(1, True), (4, True), (2, False)])
]  # fmt: skip

OLD = "stopped: what was seen last is {} ms old, the watchdog allows 100 ms"
STOPS = [
    a_round("heuristic+ibvs", 7, 1, 0, [stopped("stopped", OLD.format(104))]),
    a_round("heuristic+ibvs", 8, 1, 0, [stopped("collision", "stopped: contact with 12.0 N")]),
    a_round("heuristic+ibvs", 9, 1, 0, [stopped("stopped", OLD.format(108))]),
]
