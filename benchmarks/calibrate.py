"""Chances of success from scores: python -m benchmarks.calibrate RUN... [--output FILE.json]

Reads run folders of evaluate.py, fits each planner's chance of success to its executed grasps
(`utils.calibration`; it falls with the roughness of the frame and after a failure) and prints the
expected calibration error in each scenario and with each depth noise, as stated, and as fitted to
these same grasps, and how many succeeded of those whose fitted chance is too low to try them
(`utils.calibration.LEAST_CHANCE`). With --output the fits are written: into
checkpoints/calibration.json, they are what the project's planners state from then on; planners that
the runs do not have keep theirs. A planner of your own reads its fit from a file of your own
(docs/calibration.md). `random`, whose scores tell nothing, and learned policies are left out.
`make calibration` plays all planners but `random` on training objects and fits them all again:

    python evaluate.py --config configs/calibration.yaml
    python evaluate.py --config configs/calibration_household.yaml
    python evaluate.py --config configs/calibration_rounded.yaml
    python evaluate.py --config configs/calibration_flat.yaml
    python -m benchmarks.calibrate runs/evaluate/<time>-calibration \\
        runs/evaluate/<time>-calibration-household runs/evaluate/<time>-calibration-rounded \\
        runs/evaluate/<time>-calibration-flat \\
        --output checkpoints/calibration.json
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from envs.policy_approach import is_learned
from models.planner_graspnet import WithCritic
from models.planners import PLANNERS
from utils.atomic_files import check_writable, write_json_atomic
from utils.calibration import LEAST_CHANCE, ROUNDING, Calibration, calibration_error
from utils.config import load_config
from utils.errors import UserError
from utils.plugins import is_import_path
from utils.result_formats import aligned, rate_in_percent
from utils.result_records import RoundRecord, read_rounds
from utils.runs import code_states, run_script


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="Fit chances of success to executed grasps.")
    parser.add_argument("runs", type=Path, nargs="+", help="run folders of evaluate.py")
    parser.add_argument("--output", type=Path, help="JSON file for the fits")
    options = parser.parse_args(argv)
    check_writable("--output", options.output)
    played = {run.resolve(): rounds_of(run, options.output) for run in options.runs}
    rounds = [record for own in played.values() for record in own]
    commit = None if options.output is None else commit_of(options.runs)
    lines, found = [], {}
    policies = list(dict.fromkeys(record.policy for record in rounds))
    names = [name for name in policies if states_chances(name)]
    if not rounds:
        raise UserError(f"no round was played in {', '.join(map(str, options.runs))}")
    if not names:
        raise UserError(
            f"no policy of these runs has scores to fit chances to: {', '.join(policies)}; play "
            "planners, such as graspnet or module:name"
        )
    records = {name: [one for one in rounds if one.policy == name] for name in names}
    fits = fitted_chances({name: grasps_of(own) for name, own in records.items()})
    for name, fitted in fits.items():
        own = records[name]
        successes, failed = grasps_of(own).successes, grasps_of(own).failed
        found[name] = {
            **asdict(fitted),
            "grasps": len(successes),
            "successes": int(successes.sum()),
            "after_failure": int(failed.sum()),
            "runs": [
                run.name for run, of in played.items() if any(one.policy == name for one in of)
            ],
            "commit": commit,
        }
        for kind in [None, *dict.fromkeys((one.scenario, one.depth_noise) for one in own)]:
            some = [one for one in own if kind in (None, (one.scenario, one.depth_noise))]
            if len(grasps_of(some).scores) > 0:
                lines.append([name, *(kind or ("all", "all")), *errors(fitted, some)])
    header = ["planner", "scenario", "depth", "grasps", "success", "error as stated", "as fitted"]
    header.append(f"under {LEAST_CHANCE:g}")
    print(aligned(header, lines, range(3, 8)))
    if options.output is not None:
        write_json_atomic(options.output, {"planners": {**fits_of(options.output), **found}})
        print(f"wrote {options.output}")
    return 0


def commit_of(runs: Sequence[Path]) -> str | None:
    """The commit that the runs were played at. Raises UserError if they differ in it, or where its
    files had been changed: chances belong to the code that the grasps were executed with."""
    played = [(run, facts) for run in runs for facts in code_states(run)]
    changed = [run for run, facts in played if facts.get("changes")]
    if changed:
        raise UserError(f"{changed[0]} was played with uncommitted code; play it anew")
    commits = {facts.get("commit") for _, facts in played}
    if len(commits) > 1:
        found = ", ".join(sorted(map(str, commits)))
        raise UserError(f"the runs are of several commits ({found}); play them anew with one")
    return commits.pop()


def states_chances(policy: str) -> bool:
    """Whether a policy's scores may be turned into chances: those of the project's planners that
    have a calibration, and of a user's own planners and networks."""
    if policy in PLANNERS:
        return hasattr(PLANNERS[policy], "calibration")
    return not is_learned(policy) and (is_import_path(policy) or policy.endswith(".pt"))


def fitted_chances(grasps: dict[str, ExecutedGrasps]) -> dict[str, Calibration]:
    """The calibration of each policy from its executed grasps. Raises UserError for a policy
    without grasps."""
    fits = {}
    for name, own in grasps.items():
        if len(own.successes) == 0:
            raise UserError(f"{name}: executed no grasp in these runs; play more rounds")
        judged = is_judged(name)  # the critic sees itself how rough the heights are
        roughness = np.zeros_like(own.roughness) if judged else own.roughness
        # The search's scores may exceed 1; of another's planner, these grasps alone can tell.
        bounded = judged or (name not in PLANNERS and bool(own.scores.max() <= 1.0 + ROUNDING))
        fits[name] = Calibration.fit(own.scores, own.successes, roughness, own.failed, bounded)
    return fits


def is_judged(policy: str) -> bool:
    """Whether the critic has the last word on a policy's grasps, whose chances end at 1."""
    planner = PLANNERS.get(policy)
    return isinstance(planner, type) and issubclass(planner, WithCritic)


def fits_of(path: Path) -> dict[str, Any]:
    """The fits of a file by planner; none where there is no file. Raises UserError for another
    file."""
    if not path.exists():
        return {}
    try:
        return dict(json.loads(path.read_text(encoding="utf-8"))["planners"])
    except (ValueError, KeyError, TypeError):
        raise UserError(f"--output {path}: exists and holds no fits; give another name") from None


def rounds_of(run: Path, output: Path | None) -> list[RoundRecord]:
    """The rounds of a run folder. Raises UserError where there are none, and where fits would be
    written that saw other objects than those of the training, or not the chances of the arm."""
    if not (run / "rounds.jsonl").exists():
        raise UserError(f"{run}: has no rounds.jsonl; give a run folder of evaluate.py")
    config = load_config(run / "config.yaml")
    if output is not None and config.objects.split != "train":
        raise UserError(
            f"{run}: its objects.split is {config.objects.split}; what planners state is fitted to "
            "training objects alone: play it with objects.split=train, or omit --output"
        )
    if output is not None and config.evaluate.abstain != 0:
        raise UserError(
            f"{run}: not all grasps may have been tried; play it with evaluate.abstain=0, or omit "
            "--output"
        )
    # Planners of a user's own may have an arm and a hand of their own.
    ours = any(name in PLANNERS and states_chances(name) for name in config.evaluate.policies)
    for other, key, value in (
        (config.robot.arm == "none", "robot.arm", "panda"),
        (config.evaluate.randomise, "evaluate.randomise", "false"),
        (config.gripper != load_config().gripper, "the section gripper", "the default"),
    ):
        if output is not None and ours and other:
            raise UserError(
                f"{run}: planners state the chances of the nominal cell's arm and hand, and {key} "
                f"is not {value}: play it with that, or omit --output"
            )
    return read_rounds(run / "rounds.jsonl", config.camera.depth_noise)


class ExecutedGrasps(NamedTuple):
    """N executed grasps: scores, qualities as stated, successes, the roughness in metres of the
    frames that they were found in, and whether the attempts before failed, (N,) each."""

    scores: np.ndarray
    stated: np.ndarray
    successes: np.ndarray
    roughness: np.ndarray
    failed: np.ndarray


def grasps_of(rounds: Iterable[RoundRecord]) -> ExecutedGrasps:
    """The executed grasps of some rounds.

    Where qualities are chances, the round's own calibration leads back to the scores.
    """
    scores: list[float] = []
    stated: list[float] = []
    successes: list[bool] = []
    rough: list[float] = []
    before: list[bool] = []
    for record in rounds:
        executed = [one for one in record.attempts if one.executed and one.grasp is not None]
        roughness = [one.roughness for one in executed if one.roughness is not None]
        if len(roughness) < len(executed):
            raise UserError(
                f"{record.policy}, scene {record.seed}: an older run, which does not tell how "
                "rough its frames were; play it again"
            )
        qualities = [attempt.grasp.quality for attempt in executed]
        stated += qualities
        successes += [attempt.success for attempt in executed]
        rough += roughness
        failed = [False, *(not one.success for one in executed)][: len(executed)]
        before += failed
        if record.calibration is not None:
            chances = Calibration(*record.calibration)
            qualities = chances.scores(qualities, roughness, failed).tolist()
        scores += qualities
    return ExecutedGrasps(
        np.array(scores), np.array(stated), np.array(successes, bool), np.array(rough),
        np.array(before, bool),
    )  # fmt: skip


def errors(fitted: Calibration, rounds: Sequence[RoundRecord]) -> list[str]:
    """Cells: grasps, their share of successes, the calibration error as stated and as fitted, and
    the successes of those that an evaluation with these fits would not try."""
    scores, stated, successes, roughness, failed = grasps_of(rounds)
    chances = fitted(scores, roughness, failed)
    unlikely = successes[chances < LEAST_CHANCE]
    return [
        str(len(stated)), f"{rate_in_percent(successes.mean())} %",
        f"{calibration_error(np.clip(stated, 0, 1), successes):.3f}",
        f"{calibration_error(chances, successes):.3f}",
        f"{unlikely.sum()}/{len(unlikely)}",
    ]  # fmt: skip


if __name__ == "__main__":
    run_script(main)
