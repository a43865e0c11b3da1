"""What an evaluation records: rounds, their attempts, and the journal rounds.jsonl that holds them.

`envs.execution` judges the attempts, `envs.rounds` makes the records, `utils.results` adds them
up. A sample is the beginning of a journal with its config, its commit and the versions of the
packages, so that anyone can play the same rounds again (`python evaluate.py --replay SAMPLE`).
"""

from __future__ import annotations

import json
import math
import sys
from collections import Counter
from collections.abc import Callable, Hashable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from utils.atomic_files import append_line, locked, write_atomic
from utils.config import changed_keys, load_config, values_of
from utils.errors import UserError
from utils.transforms import ImageGrasp

SUCCESS = "success"
OPEN_LOOP = "open_loop"  # the controller that takes no further image on the way to the grasp
CLEAN = "none"  # the depth noise of a camera without noise
NO_PLAN = "no_plan"
PLANNER_ERROR = "planner_error"
FELL_OFF = "fell_off"  # how a round ends whose last objects left the table without a pick
FAILURES = {  # reason: its name in tables, in the order in which a grasp can fail
    NO_PLAN: "no plan",
    PLANNER_ERROR: "planner failed",
    "ik": "IK",
    "lost": "lost from sight",
    "stopped": "stopped",
    "collision": "collision on approach",
    "missed": "missed",
    "slipped": "slipped",
    "dropped": "dropped",
    "turned": "turned in the hand",
    "slid": "slid in the hand",
    "physics": "simulation blew up",
}
ENDINGS = {  # why a round ended
    "cleared": "every object removed",
    NO_PLAN: "the planner found no grasp that is likely enough and within reach",
    PLANNER_ERROR: "the planner raised an exception",
    "failures": "too many failures in a row",
    FELL_OFF: "the objects that were left, or the target, fell off the table",
    "target": "the target is in the tray",
    "picks": "as many grasps as objects, and the target is still there",
    "physics": "the simulation blew up",
}


# An object that moves farther than this in the hand was not held firmly.
MOST_TURNED, MOST_SLID = math.radians(15), 0.01  # rad, m


def loose(turned: float | None, slid: float | None) -> list[str]:
    """Which of `turned` and `slid`, the keys of FAILURES, an object was that moved so far in the
    hand; None stands for nothing that was held."""
    moved = {"turned": (turned or 0.0) > MOST_TURNED, "slid": (slid or 0.0) > MOST_SLID}
    return [how for how, far in moved.items() if far]


def policy_name(planner: str, controller: str) -> str:
    """The name under which a planner with a controller is scored, such as heuristic+ibvs; the
    planner's name alone stands for its open loop."""
    return planner if controller == OPEN_LOOP else f"{planner}+{controller}"


@dataclass(frozen=True)
class AttemptRecord:
    """One call of a planner and, if it found a grasp, the execution of that grasp.

    reason: "success" or a key of FAILURES; "no_plan" and "planner_error" are failures without an
        executed grasp.
    plan_seconds: wall-clock time of the planner and of the search for what the arm reaches.
    sim_seconds: simulated time of the execution.
    grasp: the grasp on the image, for pictures.
    turn_ms, turn_ms_mean: 95th percentile and mean of the wall-clock time of a closed loop's turns,
        without rendering.
    detail: a sentence on a failure.
    held: name of the object that was in the hand, if any, however the attempt ended.
    turned, slid: rad and m by which it moved there; None without it.
    graspable: whether the object that was held, or at which the grasp aimed, fits the gripper.
    tilt: rad of the executed grasp's approach from straight above.
    roughness: m, of the table in the frame that the planner saw; 0 where it saw the truth, None
        without a grasp and in older files.
    aimed: name of the object nearest to the planned grasp; None without a grasp and in older files.
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
    turned: float | None = None
    slid: float | None = None
    graspable: bool = True
    tilt: float = 0.0
    roughness: float | None = None
    aimed: str | None = None

    def __post_init__(self) -> None:
        if self.reason != SUCCESS and self.reason not in FAILURES:
            raise ValueError(f"reason {self.reason!r} is not {SUCCESS} or in {list(FAILURES)}")
        if self.success != (self.reason == SUCCESS):
            raise ValueError(f"success={self.success} contradicts reason={self.reason!r}")

    @property
    def executed(self) -> bool:
        return self.reason not in (NO_PLAN, PLANNER_ERROR)


@dataclass(frozen=True)
class RoundRecord:
    """One policy's work on one scene until `ended` (a key of ENDINGS).

    policy: the planner's name, in a closed loop with the controller's (see `policy_name`).
    seed: the scene's own seed; rounds of two policies pair up by (scenario, objects, depth_noise,
        seed).
    attempts: a round that ended with "no_plan" or "planner_error" has this reason at its end.
    controller: how the arm reached the grasps.
    randomization: the sample of the scene (`utils.domain_randomization`), None in a nominal cell.
    ungraspable: how many of the scene's objects do not fit the gripper.
    depth_noise: of the cell's cameras, as `camera.depth_noise` names it.
    calibration: slope, offset, penalty, doubt and upper slope by which the grasps' qualities are
        chances of success (`utils.calibration`); None where they are scores.
    target_in_hand: whether the one object that was wanted ended in the tray; None where all were.
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
    ungraspable: int = 0
    depth_noise: str = CLEAN
    calibration: tuple[float, float, float, float, float] | None = None
    target_in_hand: bool | None = None

    def __post_init__(self) -> None:
        if self.ended not in ENDINGS:
            raise ValueError(f"ended {self.ended!r} is not one of {list(ENDINGS)}")
        if not 0 <= self.objects_cleared <= self.objects_total:
            raise ValueError(f"cleared {self.objects_cleared} of {self.objects_total} objects")
        last = self.attempts[-1].reason if self.attempts else None
        for reason in (NO_PLAN, PLANNER_ERROR):
            if (self.ended == reason) != (last == reason):
                raise ValueError(f"a round that ended with {self.ended!r} has {last!r} at its end")

    @property
    def kind(self) -> tuple[str, str, str]:
        """Scenario, object set and depth noise: rounds of other kinds are counted apart."""
        return self.scenario, self.objects, self.depth_noise

    @property
    def identity(self) -> tuple[str, str, str, str, int]:
        """Policy, kind and seed, which no two rounds of a run share."""
        return (self.policy, *self.kind, self.seed)

    @property
    def planner(self) -> str:
        """The policy's name without its controller."""
        return self.policy.removesuffix(policy_name("", self.controller))

    @property
    def executed(self) -> int:
        return sum(attempt.executed for attempt in self.attempts)

    @property
    def successes(self) -> int:
        return sum(attempt.success for attempt in self.attempts)


# --- The journal: one round a line, so that an interrupted evaluation can be resumed -----------


def writing(path: Path) -> AbstractContextManager[None]:
    """Within this context, no other process enters it for the same journal; see
    `utils.atomic_files.locked`."""
    place = path.with_name(f".{path.name}.lock")  # `cut_torn_line` may replace the journal itself
    return locked(
        place,
        f"{path}: another process is adding rounds to it; wait until it has ended, or start a new "
        "run",
    )


def append_round(path: Path, record: RoundRecord) -> None:
    """Add a finished round to the journal, on the disk, or nothing. Raises UserError where that
    cannot be done, as on a full disk."""
    append_line(path, _line(record))


def _line(record: RoundRecord) -> str:
    content = asdict(record)
    for attempt in content["attempts"]:
        if attempt["grasp"] is not None:
            attempt["grasp"]["pixel"] = [float(x) for x in attempt["grasp"]["pixel"]]
    return json.dumps(content, allow_nan=False) + "\n"


def cut_torn_line(path: Path) -> None:
    """Remove a last line that a crash cut short, so that the next round begins a line of its own;
    within `writing` alone, because a line that another process is adding looks the same."""
    content = path.read_bytes() if path.exists() else b""
    whole = content[: content.rfind(b"\n") + 1]
    if whole != content:
        write_atomic(path, whole)


def read_rounds(path: Path, depth_noise: str = CLEAN) -> list[RoundRecord]:
    """The rounds of a journal; an empty list where there is none yet.

    depth_noise: of the rounds of older files, which name none: their config's.
    A last line that a crash cut short does not count; any other line that is no round raises
    UserError, and so does a round that is there twice.
    """
    if not path.exists():
        return []
    text = path.read_text(encoding="utf-8", errors="replace")
    rounds = _parse(path, text.split("\n")[:-1], depth_noise)
    check_played_once(rounds, str(path))
    return rounds


def check_played_once(rounds: Sequence[RoundRecord], source: str) -> None:
    """Raise UserError for a round that is there twice: it would count twice, and hide one that is
    missing."""
    for (policy, scenario, objects, noise, seed), count in Counter(
        one.identity for one in rounds
    ).items():
        if count > 1:
            raise UserError(
                f"{source}: holds the round of {policy} on {objects} in the scenario {scenario}, "
                f"with the depth noise {noise} and the seed {seed}, {count} times; delete all "
                "lines of it but one, or start a new run"
            )


def _parse(
    path: Path, lines: Sequence[str], depth_noise: str, first_line: int = 1
) -> list[RoundRecord]:
    rounds = []
    for number, line in enumerate(lines, start=first_line):
        try:
            content = json.loads(line, parse_constant=_no_number)
            rounds.append(_round({"depth_noise": depth_noise} | content))
        # Missing entries and entries of other types are any of these; nesting without end is one.
        except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
            raise UserError(
                f"{path}, line {number}: not a recorded round ({error}); delete the line, or play "
                "the rounds anew"
            ) from error
    return rounds


def _round(content: dict[str, Any]) -> RoundRecord:
    attempts = content.pop("attempts")
    _check_types(content, _ROUND_TYPES)
    if content["ended"] == "lost":  # its name in older files
        content["ended"] = FELL_OFF
    for attempt in attempts:
        _check_types(attempt, _ATTEMPT_TYPES)
        grasp = attempt["grasp"]
        if grasp is not None:
            numbers = [*grasp["pixel"], *(grasp[name] for name in _GRASP_NUMBERS)]
            if len(numbers) != 2 + len(_GRASP_NUMBERS) or not all(map(_is_number, numbers)):
                raise ValueError("a grasp does not consist of numbers")
            attempt["grasp"] = ImageGrasp(**grasp)
    if content.get("calibration") is not None:
        numbers = content["calibration"]
        if not 2 <= len(numbers) <= 5 or not all(map(_is_number, numbers)):
            raise ValueError("a calibration does not consist of five numbers")
        # Older files have no upper slope, still older ones no doubt, and the oldest no penalty.
        slope, offset, penalty, doubt, upper = [*numbers, 0.0, 0.0, 0.0][:5]
        content["calibration"] = (slope, offset, penalty, doubt, upper)
    return RoundRecord(**content, attempts=tuple(AttemptRecord(**one) for one in attempts))


_ROUND_TYPES = {
    "policy": str, "scenario": str, "objects": str, "seed": int, "objects_total": int,
    "objects_cleared": int, "ended": str, "controller": str, "ungraspable": int,
    "depth_noise": str, "target_in_hand": bool, "randomization": dict,
}  # fmt: skip
_ATTEMPT_TYPES = {
    "success": bool, "reason": str, "plan_seconds": float, "sim_seconds": float, "graspable": bool,
    "turn_ms": float, "turn_ms_mean": float, "detail": str, "held": str, "turned": float,
    "slid": float, "tilt": float, "roughness": float, "aimed": str,
}  # fmt: skip
_ADDED = {  # missing in older files
    "controller": OPEN_LOOP, "ungraspable": 0, "target_in_hand": None, "randomization": None,
    "graspable": True, "turn_ms": None, "turn_ms_mean": None, "detail": "", "held": None,
    "turned": None, "slid": None, "tilt": 0.0, "roughness": None, "aimed": None,
}  # fmt: skip
_MAY_BE_NONE = [name for name, value in _ADDED.items() if value is None]
_GRASP_NUMBERS = ("angle", "depth", "width", "quality")


def _check_types(content: dict[str, Any], types: dict[str, type]) -> None:
    for name, kind in types.items():
        value = content.get(name, _ADDED[name]) if name in _ADDED else content[name]
        if value is None and name in _MAY_BE_NONE:
            continue
        if not (_is_number(value) if kind is float else type(value) is kind):
            raise ValueError(f"{name} is {value!r:.40}")


_LARGEST = sys.float_info.max  # JSON's whole numbers have no end


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and type(value) is not bool and abs(value) <= _LARGEST


def _no_number(name: str) -> None:
    raise ValueError(f"{name} is no number")


# --- Samples: the first rounds of a run, to be checked by others --------------------------------


@dataclass(frozen=True)
class Sample:
    """The first rounds of a run, and what is needed to play them again.

    overrides: dotted keys that make the run's config out of the defaults. commit: of the run.
    versions: of Python and the packages.
    """

    commit: str | None
    versions: dict[str, str | None]
    overrides: list[str]
    rounds: list[RoundRecord]


def versions_of(facts: Mapping[str, Any]) -> dict[str, str | None]:
    """What may change a round, of the facts of `utils.runs.environment`."""
    # Runs of older versions do not tell their processor.
    known = {name: facts[name] for name in ("processor", "python") if facts.get(name)}
    return known | facts["packages"]


def write_sample(run: Path, path: Path, count: int = 10, commit: str | None = None) -> None:
    """Write the first `count` rounds of each policy, scenario, object set and depth noise of a run
    folder to a file of JSON lines, the first of which holds config, commit and versions. commit:
    the one to name, None for that of the run."""
    facts = json.loads((run / "environment.json").read_text(encoding="utf-8"))
    config = load_config(run / "config.yaml")
    origin = {
        "commit": commit or facts["commit"],
        "versions": versions_of(facts),
        "overrides": changed_keys(config),
    }
    rows: dict[tuple[str, ...], list[RoundRecord]] = {}
    rounds = read_rounds(run / "rounds.jsonl", config.camera.depth_noise)
    for record in sorted(rounds, key=lambda record: record.seed):
        rows.setdefault((record.policy, *record.kind), []).append(record)
    lines = [_line(record) for row in rows.values() for record in row[:count]]
    write_atomic(path, json.dumps(origin) + "\n" + "".join(lines))


_SAMPLE_TYPES = {"commit": str | None, "versions": dict, "overrides": list}


def read_sample(path: Path) -> Sample:
    """Read a file of `write_sample`. Raises UserError for a file that is none."""
    try:
        first, *lines = path.read_text(encoding="utf-8").splitlines()
        origin = Sample(**json.loads(first), rounds=[])
        for name, kinds in _SAMPLE_TYPES.items():
            if not isinstance(getattr(origin, name), kinds):
                raise ValueError(f"{name} is {getattr(origin, name)!r:.40}")
        versions = [one for one in origin.versions.values() if one is not None]
        if not all(isinstance(one, str) for one in [*origin.overrides, *versions]):
            raise ValueError("its overrides and versions are no texts")
        noise = values_of(origin.overrides).get("camera", {}).get("depth_noise", CLEAN)
    except OSError as error:
        raise UserError(f"{path}: cannot read this sample: {error.strerror}") from error
    except (ValueError, TypeError, AttributeError, RecursionError) as error:
        raise UserError(
            f"{path}: not a sample of rounds ({error}); choose a file of docs/results"
        ) from error
    return replace(origin, rounds=_parse(path, lines, noise, first_line=2))


def without_times(record: RoundRecord) -> RoundRecord:
    """The record without its wall-clock times, in which alone two equal rounds differ, and without
    what older files lack and the rest tells."""
    attempts = tuple(
        replace(attempt, plan_seconds=0.0, turn_ms=None, turn_ms_mean=None, aimed=None)
        for attempt in record.attempts
    )
    return replace(record, attempts=attempts)


def differing_rounds(
    before: Sequence[RoundRecord],
    after: Sequence[RoundRecord],
    seen_as: Callable[[RoundRecord], Hashable] = lambda record: _line(without_times(record)),
) -> list[RoundRecord]:
    """The rounds of `before` that `after` does not hold, or holds otherwise. seen_as: what of a
    record counts; by default all of it but wall-clock times."""
    held = {seen_as(record) for record in after}
    return [record for record in before if seen_as(record) not in held]


def ending(record: RoundRecord) -> Hashable:
    """What a round is scored by: what was cleared, and how each attempt ended. The places, angles
    and seconds of a record depend in their last digits on the processor, too."""
    attempts = tuple((attempt.success, attempt.reason) for attempt in record.attempts)
    score = record.objects_cleared, record.target_in_hand, record.ended, attempts
    return record.policy, record.kind, record.seed, score
