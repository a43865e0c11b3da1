"""The figures of an evaluation, counted from its records.

Success rate and cleared rate are VGN's (Breyer et al., CoRL 2020): successes / executed grasps, and
objects removed / objects placed, both over all rounds. Policies and runs are compared on the scenes
that both have played. `utils.result_records` has the records, `utils.result_formats` shows figures.
"""

from __future__ import annotations

import re
import warnings
from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import mean, median
from typing import Any

from utils.calibration import calibration_error
from utils.config import read_config
from utils.errors import UserError
from utils.result_records import (
    CLEAN,
    ENDINGS,
    FAILURES,
    FELL_OFF,
    NO_PLAN,
    OPEN_LOOP,
    RoundRecord,
    loose,
    read_rounds,
)
from utils.runs import code_of
from utils.statistics import (
    Difference,
    clustered_interval,
    paired_difference_interval,
    wilson_interval,
)

LEAST_PLANS = 5  # calls of a planner, from which the median of their times is stated
CLUTTER = ("packed", "pile")  # scenarios that are also compared together
SEVERAL = " + "  # between the names of these scenarios and their object sets

_Key = tuple[str, str, str, str]  # of a row: policy, scenario, object set, depth noise


@dataclass(frozen=True)
class Row:
    """The figures of one policy on one scenario and object set; None where one is undefined.

    attempts: executed grasps. The 95 % intervals take whole rounds as independent, not their
        attempts or objects (`utils.statistics.clustered_interval`).
    plan_ms_median: over all calls of the planner, with the search for what the arm reaches, also
        those that found nothing; None for fewer than LEAST_PLANS, most of which the first ones of
        workers, which load and compile, would be.
    sim_seconds_per_pick: simulated time of all attempts, failed ones too, for each success.
    turned, slid: successes in which the object moved in the hand by more than 15 degrees or 1 cm.
        firm: successes in which it did neither.
    graspable_*: of objects that fit the gripper (`envs.objects.fits`) alone. An attempt belongs to
        the object that it held, or at which it aimed.
    calibration_error: expected calibration error of the grasps' qualities (`utils.calibration`);
        None where they are no chances.
    targets, targets_in_hand: rounds in which one object was wanted, and those in which it ended in
        the tray. picks_to_target: mean number of executed grasps of the latter.
    turn_ms_mean, turn_ms_p95: mean and 95th percentile of the time of a closed loop's turns, of
        which the median over the attempts.
    """

    policy: str
    scenario: str
    objects: str
    depth_noise: str
    seed: int
    rounds: int
    attempts: int
    successes: int
    objects_total: int
    objects_cleared: int
    success_rate: float | None
    success_ci95: tuple[float, float]
    cleared_rate: float | None
    cleared_ci95: tuple[float, float]
    plan_ms_median: float | None
    sim_seconds_per_pick: float | None
    picks_per_hour: float | None
    failures: dict[str, int]
    controller: str = OPEN_LOOP
    turn_ms_p95: float | None = None
    turn_ms_mean: float | None = None
    turned: int = 0
    slid: int = 0
    firm: int = 0
    graspable_attempts: int = 0
    graspable_successes: int = 0
    graspable_total: int = 0
    calibration_error: float | None = None
    targets: int = 0
    targets_in_hand: int = 0
    target_in_hand_rate: float | None = None
    target_in_hand_ci95: tuple[float, float] = (0.0, 1.0)
    picks_to_target: float | None = None


def summarise(rounds: Iterable[RoundRecord], seed: int) -> list[Row]:
    """One row for each (policy, scenario, objects, depth noise), in the order of their first
    round."""
    groups: dict[_Key, list[RoundRecord]] = {}
    for record in rounds:
        groups.setdefault((record.policy, *record.kind), []).append(record)
    return [_row(key, records, seed) for key, records in groups.items()]


def _row(key: _Key, rounds: Sequence[RoundRecord], seed: int) -> Row:
    calls = [attempt for record in rounds for attempt in record.attempts]
    attempts = sum(call.executed for call in calls)
    successes = sum(call.success for call in calls)
    total = sum(record.objects_total for record in rounds)
    cleared = sum(record.objects_cleared for record in rounds)
    reasons = Counter(call.reason for call in calls)
    fitting = [call for call in calls if call.graspable]
    moved = [loose(call.turned, call.slid) for call in calls if call.success]
    seconds = sum(call.sim_seconds for call in calls)
    per_pick = seconds / successes if successes else None
    stated = stated_chances(rounds)
    wanted = [record for record in rounds if record.target_in_hand is not None]
    in_hand = [record.executed for record in wanted if record.target_in_hand]
    turns = [call.turn_ms for call in calls if call.turn_ms is not None]
    means = [call.turn_ms_mean for call in calls if call.turn_ms_mean is not None]
    return Row(
        *key,
        seed=seed,
        rounds=len(rounds),
        attempts=attempts,
        successes=successes,
        objects_total=total,
        objects_cleared=cleared,
        success_rate=successes / attempts if attempts else None,
        success_ci95=clustered_interval([(r.successes, r.executed) for r in rounds]),
        cleared_rate=cleared / total if total else None,
        cleared_ci95=clustered_interval([(r.objects_cleared, r.objects_total) for r in rounds]),
        plan_ms_median=1000 * median(call.plan_seconds for call in calls)
        if len(calls) >= LEAST_PLANS
        else None,
        sim_seconds_per_pick=per_pick,
        picks_per_hour=3600 / per_pick if per_pick else None,
        failures={reason: reasons[reason] for reason in FAILURES},
        controller=rounds[0].controller,
        turn_ms_p95=median(turns) if turns else None,
        turn_ms_mean=median(means) if means else None,
        turned=sum("turned" in how for how in moved),
        slid=sum("slid" in how for how in moved),
        firm=sum(not how for how in moved),
        graspable_attempts=sum(call.executed for call in fitting),
        graspable_successes=sum(call.success for call in fitting),
        graspable_total=total - sum(record.ungraspable for record in rounds),
        calibration_error=None if stated is None else calibration_error(*stated),
        targets=len(wanted),
        targets_in_hand=len(in_hand),
        target_in_hand_rate=len(in_hand) / len(wanted) if wanted else None,
        target_in_hand_ci95=wilson_interval(len(in_hand), len(wanted)),
        picks_to_target=mean(in_hand) if in_hand else None,
    )


def stated_chances(rounds: Iterable[RoundRecord]) -> tuple[list[float], list[bool]] | None:
    """The qualities of the executed grasps, and whether they succeeded, of the rounds whose
    qualities are chances; None where there are none."""
    stated = [
        (attempt.grasp.quality, attempt.success)
        for record in rounds
        for attempt in record.attempts
        if record.calibration is not None and attempt.executed and attempt.grasp is not None
    ]
    if not stated:
        return None
    qualities, successes = zip(*stated)
    return list(qualities), list(successes)


# --- Why attempts failed ------------------------------------------------------------------------

NO_GRASPS = "the planner returned no grasp"
_NUMBER = re.compile(r"-?\d+(\.\d+)?|\b(inf|nan)\b")


@dataclass(frozen=True)
class StopReason:
    """Failures of one policy on a scenario and object set, with one depth noise, for the same
    reason, or rounds that ended because objects were lost.

    count: of attempts, or of rounds. reason: a key of `utils.result_records.FAILURES`; None for
    rounds. sentence: of the first one; those of the others differ in their numbers only. seed: of
    the first one's scene.
    held: the object that was in the hand at the first, if any.
    """

    policy: str
    scenario: str
    objects: str
    depth_noise: str
    reason: str | None
    count: int
    sentence: str
    seed: int
    held: str | None = None

    @property
    def place(self) -> str:
        """The first attempt's scene: 'scene 7' or 'scene 7, mug_0012 in the hand'."""
        return f"scene {self.seed}" + (f", {self.held} in the hand" if self.held else "")


def stop_reasons(rounds: Iterable[RoundRecord]) -> list[StopReason]:
    """The failures that have a sentence, the plans without one, which had no grasps at all, and the
    rounds whose last objects fell off the table, in the order of the rounds; the most frequent
    first within one policy, scenario, object set and depth noise."""
    kinds: dict[_Key, dict[tuple[str | None, str], list[tuple[str, int, str | None]]]] = {}
    for record in rounds:
        cell = kinds.setdefault((record.policy, *record.kind), {})
        for attempt in record.attempts:
            detail = attempt.detail or (NO_GRASPS if attempt.reason == NO_PLAN else "")
            if detail and not attempt.success:
                kind = attempt.reason, _NUMBER.sub("#", detail)
                cell.setdefault(kind, []).append((detail, record.seed, attempt.held))
        if record.ended == FELL_OFF:
            cell.setdefault((None, FELL_OFF), []).append((ENDINGS[FELL_OFF], record.seed, None))
    return [
        StopReason(*where, reason, len(found), *found[0])
        for where, cell in kinds.items()
        for (reason, _), found in sorted(cell.items(), key=lambda item: -len(item[1]))
    ]


# --- Which objects fail ---------------------------------------------------------------------------


@dataclass(frozen=True)
class ObjectOutcomes:
    """What became of the attempts at one object of a set, in all scenarios and depth noises.

    outcomes: by policy, failed and all attempts. An attempt belongs to the object that the hand
    held, or else to the one nearest to the planned grasp.
    """

    objects: str
    name: str
    outcomes: dict[str, tuple[int, int]]

    @property
    def failures(self) -> int:
        return sum(failed for failed, _ in self.outcomes.values())


def hardest_objects(rounds: Iterable[RoundRecord], count: int) -> list[ObjectOutcomes]:
    """Up to `count` objects at which attempts have failed, those with the most failures first; none
    of records from older files, which do not tell where a grasp aimed."""
    found: dict[tuple[str, str], ObjectOutcomes] = {}
    for record in rounds:
        for attempt in record.attempts:
            name = attempt.held or attempt.aimed
            if name is None or attempt.aimed is None:
                continue
            one = found.setdefault((record.objects, name), ObjectOutcomes(record.objects, name, {}))
            failed, tried = one.outcomes.get(record.policy, (0, 0))
            one.outcomes[record.policy] = failed + (not attempt.success), tried + 1
    failing = [one for one in found.values() if one.failures]
    return sorted(failing, key=lambda one: -one.failures)[:count]


# --- Comparisons --------------------------------------------------------------------------------


@dataclass(frozen=True)
class Comparison:
    """Two policies on the rounds that both have played; a difference is first - second, None where
    it is undefined, as that of cleared objects is where one object was wanted."""

    first: str
    second: str
    scenario: str
    objects: str
    depth_noise: str
    success: Difference | None
    cleared: Difference | None


_Kind = tuple[str, str, str]  # scenario, object set and depth noise
# The rounds of each policy by scenario, object set and seed.
_Policies = dict[str, dict[tuple[str, str, int], RoundRecord]]


def compare(
    rounds: Iterable[RoundRecord], seed: int, pairs: Collection[tuple[str, str]] | None = None
) -> list[Comparison]:
    """Paired differences of policies on each scenario, object set and depth noise that they share,
    and at last, for each depth noise, on all that they share in clutter together, where this is of
    several scenarios or object sets.

    seed: of the bootstrap. pairs: the policies to compare, (first, second); None: every pair, the
    later one first.
    """
    cells: dict[_Kind, _Policies] = {}
    clutter: dict[str, _Policies] = {}
    for record in rounds:
        scene = (record.scenario, record.objects, record.seed)
        policies = cells.setdefault(record.kind, {})
        policies.setdefault(record.policy, {})[scene] = record
        if record.scenario in CLUTTER:
            policies = clutter.setdefault(record.depth_noise, {})
            policies.setdefault(record.policy, {})[scene] = record
    found = [
        _compared(first, second, kind, policies, seed)
        for kind, policies in cells.items()
        for first, second in _pairs_of(policies, pairs)
    ]
    for noise, policies in clutter.items():
        for first, second in _pairs_of(policies, pairs):
            shared = policies[first].keys() & policies[second].keys()
            kinds = [kind for kind in cells if any(scene[:2] == kind[:2] for scene in shared)]
            scenarios, sets = (list(dict.fromkeys(kind[i] for kind in kinds)) for i in range(2))
            if len(scenarios) > 1 or len(sets) > 1:
                together = SEVERAL.join(scenarios), SEVERAL.join(sets), noise
                found.append(_compared(first, second, together, policies, seed))
    return found


def _pairs_of(
    policies: _Policies, pairs: Collection[tuple[str, str]] | None
) -> list[tuple[str, str]]:
    """Those of the pairs, or of all, of which both have played."""
    names = list(policies)
    if pairs is None:
        return [(first, second) for i, second in enumerate(names) for first in names[i + 1 :]]
    return [pair for pair in pairs if policies.keys() >= {*pair}]


def _compared(
    first: str,
    second: str,
    kind: _Kind,
    rounds: _Policies,
    seed: int,
) -> Comparison:
    # Sorted, because a bootstrap depends on the order, and a journal on the workers' speed.
    shared = sorted(rounds[first].keys() & rounds[second].keys())
    a, b = ([rounds[name][scene] for scene in shared] for name in (first, second))
    success = _difference(a, b, "successes", "executed", seed)
    # A round with a target ends once it is in hand: what else was cleared is no merit.
    wanted = any(record.target_in_hand is not None for record in [*a, *b])
    cleared = None if wanted else _difference(a, b, "objects_cleared", "objects_total", seed)
    return Comparison(first, second, *kind, success, cleared)


def _difference(
    a: Sequence[RoundRecord], b: Sequence[RoundRecord], top: str, bottom: str, seed: int
) -> Difference | None:
    first, second = (
        [(getattr(r, top), getattr(r, bottom)) for r in side] or [(0, 0)] for side in (a, b)
    )
    return paired_difference_interval(first, second, seed=seed)


# --- Two runs -----------------------------------------------------------------------------------

# Sections and keys of the config that a scene is made from (`envs.cell_scenes.make_scene`): objects
# come to rest in a simulator, so that the steps of the physics count, and some layouts choose what
# the hand can span, or, where one object is wanted, what the hand can take at all.
SCENE_KEYS = (
    "scene", "objects", "workspace", "gripper.max_opening", "sim.frequency",
    "sim.solver_iterations",
)  # fmt: skip


def compare_runs(first: Path, second: Path) -> list[Comparison]:
    """Paired differences between two run folders of evaluate.py on their common scenes, first run -
    second run: of the policies that both have played, else of every policy of the first and every
    one of the second. Runs with one depth noise each are compared whatever these are: where they
    differ, the noise is named 'first - second'.

    Warns where the runs are of two commits, at which a scene of the same seed may lie otherwise.
    Raises UserError where a folder holds no evaluation, and where the scenes do not match.
    """
    (config, before), (other, after) = (_read_run(folder) for folder in (first, second))
    wanted = any(record.target_in_hand is not None for record in [*before, *after])
    for key in [*SCENE_KEYS, *(["gripper"] if wanted else [])]:
        if _differ(config, other, key):
            raise UserError(
                f"--compare {first} {second}: their scenes do not match, because {key} differs in "
                "their configs; compare runs of the same scenes"
            )
    a, b = ({record.depth_noise for record in rounds} for rounds in (before, after))
    if a != b and len(a) == len(b) == 1:
        noise = f"{a.pop()} - {b.pop()}"
        before, after = (
            [replace(one, depth_noise=noise) for one in rounds] for rounds in (before, after)
        )
    if not _scenes(before) & _scenes(after):
        raise UserError(
            f"--compare {first} {second}: they have no scene in common; compare runs with the same "
            "seed, evaluate.scenarios, evaluate.object_sets and evaluate.depth_noises"
        )
    one, another = (" and ".join(code_of(folder)) for folder in (first, second))
    if one and another and one != another:
        warnings.warn(
            f"--compare {first} {second}: played at {one}, and at {another}; where these lay "
            "objects otherwise, scenes of the same seed are not the same",
            stacklevel=2,
        )
    names = [list(dict.fromkeys(record.policy for record in rounds)) for rounds in (before, after)]
    common = [name for name in names[0] if name in names[1]]
    pairs = [(name, name) for name in common] or [(a, b) for a in names[0] for b in names[1]]
    labels = ["A", "B"] if first.name == second.name else [first.name, second.name]
    renamed = [
        replace(record, policy=f"{record.policy} ({label})")
        for label, rounds in zip(labels, (before, after))
        for record in rounds
    ]
    labelled = [(f"{a} ({labels[0]})", f"{b} ({labels[1]})") for a, b in pairs]
    return compare(renamed, config["seed"], labelled)


def _differ(config: dict[str, Any], other: dict[str, Any], key: str) -> bool:
    """Whether a section or key has another value; versions may differ in keys."""
    section, _, name = key.partition(".")
    a, b = config.get(section, {}), other.get(section, {})
    shared = a.keys() & b.keys() & ({name} if name else a.keys())
    return any(a[one] != b[one] for one in shared)


def _read_run(folder: Path) -> tuple[dict[str, Any], list[RoundRecord]]:
    """The config as plain data, so that those of older versions can be read, and the rounds."""
    config, journal = folder / "config.yaml", folder / "rounds.jsonl"
    if not (config.is_file() and journal.is_file()):
        raise UserError(
            f"--compare {folder}: not the folder of an evaluation; choose one with config.yaml and "
            "rounds.jsonl, such as runs/evaluate/20250131-120000"
        )
    plain = read_config(config)
    seed = plain.get("seed")
    if type(seed) is not int or seed < 0:
        raise UserError(f"{config}: holds no seed, so that it is not the config of a run")
    for section in ("camera", *(key.partition(".")[0] for key in SCENE_KEYS)):
        if not isinstance(plain.get(section, {}), dict):
            raise UserError(
                f"{config}: {section} is {plain[section]!r:.40}, so that it is not the config of a "
                "run"
            )
    return plain, read_rounds(journal, plain.get("camera", {}).get("depth_noise") or CLEAN)


def _scenes(rounds: Iterable[RoundRecord]) -> set[tuple[str, str, str, int]]:
    return {(*record.kind, record.seed) for record in rounds}
