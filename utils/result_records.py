"""What an evaluation records: rounds and their attempts, and the journal that holds them.

Records come from the cell (`envs.execution` judges, `envs.rounds` writes them down); what they add
up to is for `utils.results`.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from utils.errors import UserError
from utils.runs import write_atomic
from utils.transforms import ImageGrasp

SUCCESS = "success"
OPEN_LOOP = "open_loop"  # the controller that does not look again
NO_PLAN = "no_plan"
FAILURES = {  # reason: what a reader sees, in the order in which a grasp can fail
    NO_PLAN: "no plan",
    "ik": "IK",
    "lost": "lost from sight",
    "stopped": "stopped",
    "collision": "collision on approach",
    "missed": "missed",
    "slipped": "slipped",
    "dropped": "dropped",
    "physics": "simulation blew up",
}
ENDINGS = {  # why a round ended
    "cleared": "every object removed",
    NO_PLAN: "the planner found no grasp",
    "failures": "too many failures in a row",
    "lost": "the objects that were left fell off the table",
    "physics": "the simulation blew up",
}


def contestant(policy: str, controller: str) -> str:
    """The name under which a policy is scored with a controller, such as heuristic+ibvs; a policy
    alone stands for its open loop."""
    return policy if controller == OPEN_LOOP else f"{policy}+{controller}"


@dataclass(frozen=True)
class AttemptRecord:
    """One call of a planner and, unless it found nothing, the grasp that was executed.

    reason: "success" or a key of FAILURES; a "no_plan" is a failure but not an executed grasp.
    plan_seconds: wall-clock time of the planner. sim_seconds: simulated time of the execution.
    grasp: where it was on the image, for pictures. turn_ms, turn_ms_mean: 95th percentile and mean
    of the wall-clock time of a closed loop's turns, rendering left out. detail: a sentence on a
    failure. held: name of the object that was in the hand, if any, however the attempt ended.
    """

    success: bool
    reason: str
    plan_seconds: float
    sim_seconds: float
    grasp: ImageGrasp | None = None
    turn_ms: float | None = None
    detail: str = ""
    turn_ms_mean: float | None = None
    held: str | None = None

    def __post_init__(self) -> None:
        if self.reason != SUCCESS and self.reason not in FAILURES:
            raise ValueError(f"reason {self.reason!r} is not {SUCCESS} or in {list(FAILURES)}")
        if self.success != (self.reason == SUCCESS):
            raise ValueError(f"success={self.success} contradicts reason={self.reason!r}")

    @property
    def executed(self) -> bool:
        return self.reason != NO_PLAN


@dataclass(frozen=True)
class RoundRecord:
    """One scene worked on by one policy until `ended` (a key of ENDINGS).

    seed: the scene's own seed; rounds of two policies pair up by (scenario, objects, seed).
    A round that ended with "no_plan" has an attempt with that reason at its end.
    controller: how the arm got to its grasps; a policy of a closed loop is called by both, see
    `contestant`. randomization: what was drawn for the scene (`utils.domain_randomization`), None
    where it was the nominal cell's.
    """

    policy: str
    scenario: str
    objects: str
    seed: int
    objects_total: int
    objects_cleared: int
    attempts: tuple[AttemptRecord, ...]
    ended: str
    controller: str = OPEN_LOOP
    randomization: dict[str, Any] | None = None

    def __post_init__(self) -> None:
        if self.ended not in ENDINGS:
            raise ValueError(f"ended {self.ended!r} is not one of {list(ENDINGS)}")
        if not 0 <= self.objects_cleared <= self.objects_total:
            raise ValueError(f"cleared {self.objects_cleared} of {self.objects_total} objects")
        last = self.attempts[-1].reason if self.attempts else None
        if (self.ended == NO_PLAN) != (last == NO_PLAN):
            raise ValueError(f"a round that ended with {self.ended!r} has {last!r} at its end")

    @property
    def executed(self) -> int:
        return sum(attempt.executed for attempt in self.attempts)

    @property
    def successes(self) -> int:
        return sum(attempt.success for attempt in self.attempts)


# --- The journal: one round a line, so that an interrupted evaluation can go on ----------------


def append_round(path: Path, record: RoundRecord) -> None:
    """Add a finished round to the journal."""
    content = asdict(record)
    for attempt in content["attempts"]:
        if attempt["grasp"] is not None:
            attempt["grasp"]["pixel"] = [float(x) for x in attempt["grasp"]["pixel"]]
    with path.open("a", encoding="utf-8") as journal:
        journal.write(json.dumps(content, allow_nan=False) + "\n")


def read_rounds(path: Path) -> list[RoundRecord]:
    """The rounds of a journal; an empty list where there is none yet.

    A last line cut short by a crash is taken off the file; any other line that is not a round
    raises UserError.
    """
    if not path.exists():
        return []
    text = path.read_text(encoding="utf-8", errors="replace")
    whole = text[: text.rfind("\n") + 1]
    if whole != text:
        write_atomic(path, whole)
    lines = whole.split("\n")
    rounds = []
    for number, line in enumerate(lines[:-1], start=1):  # what follows the last newline is cut
        try:
            content = json.loads(line)
            attempts = tuple(
                AttemptRecord(**(a | {"grasp": a["grasp"] and ImageGrasp(**a["grasp"])}))
                for a in content.pop("attempts")
            )
            rounds.append(RoundRecord(**content, attempts=attempts))
        except (ValueError, TypeError, KeyError) as error:
            raise UserError(
                f"{path}, line {number}: not a recorded round ({error}); delete the line or start "
                "a new run without --resume"
            ) from error
    return rounds
