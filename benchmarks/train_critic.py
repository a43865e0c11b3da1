"""Train the grasp critic: python -m benchmarks.train_critic --output FILE.pt [key=value]

Draws scenes of training objects, has a floating hand execute candidates of graspnet6d and graspnet
(`envs.critic_examples`), and fits the critic (`models.grasp_critic`) to which of them succeed, from
random weights or from those of `--initial`. The executed grasps stay in the folder of `--examples`,
where a run that was stopped finds them again; those in folders of `--more` are learned from as
well, whatever they were played with. Every tenth scene is held out; on these it prints how often
the candidate that is ranked first succeeds, of those that were drawn at random, by the search
alone, by the critic that it began with, and by the new one, how far the stated chances of all are
from frequencies, and their log loss. It trains on a GPU where there is one (`train.device`).
Written to checkpoints/critic.pt, the critic is what graspnet, graspnet_direct and graspnet6d rank
by from then on, and oracle where no contacts are antipodal; the chances of these four are then
fitted again (`benchmarks.calibrate`). With
`--folds K` it writes no weights, and compares for kinds of hands and cameras the critic that it
begins with and what becomes of it: each Kth of the scenes is judged by weights that learned from
the others.
"""

from __future__ import annotations

import argparse
import hashlib
import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch.nn import functional
from tqdm import tqdm

from envs.critic_examples import (
    GENERATION,
    LABEL,
    PLANNERS,
    Examples,
    numbered_examples_of,
    planner_of,
    usual_sets,
)
from envs.data_generation import content_of_sets
from models.grasp_critic import INPUTS, KIND, SHIPPED, GraspCritic, load_critic
from models.graspnet_io import SHIPPED as SHIPPED_NETWORK
from models.planner_graspnet import JUDGED_FAN
from utils.atomic_files import write_json_atomic
from utils.calibration import calibration_error
from utils.checkpoint import check_weights_file, save_checkpoint
from utils.config import Config
from utils.distributed import choose_device
from utils.errors import UserError
from utils.executor import completed, open_executor
from utils.result_formats import aligned
from utils.runs import git_state, parse_args, run_script

HELD_OUT = 10  # every tenth scene
CONTENT = "content of object_sets"  # of settings.json
SHARD, SHARDS = 50, "scenes-*.npz"  # scenes of a file, at most, and the files' names
EPOCHS, BATCH, RATE, DECAY = 8, 256, 1e-3, 1e-2
FURTHER_RATE = 3e-4  # from weights that are given: at the rate above they forget what they know
CPU = torch.device("cpu")
UPRIGHT = np.cos(np.deg2rad(30))  # cosine of a camera's angle to the vertical, from which it counts
TILTS = INPUTS.index("tilt_left"), INPUTS.index("tilt_right")


def main(argv: Sequence[str] | None = None) -> int:
    def options(parser: argparse.ArgumentParser) -> None:
        parser.add_argument("--output", type=Path, help="file for the weights")
        parser.add_argument("--folds", type=int, help="compare with --initial instead")
        parser.add_argument("--scenes", type=int, default=3000, help="how many, ten or more")
        parser.add_argument(
            "--examples", type=Path, default=Path("data/critic"), help="folder of executed grasps"
        )
        more = "another folder of executed grasps to learn from; may be repeated"
        parser.add_argument("--more", type=Path, action="append", default=[], help=more)
        parser.add_argument("--initial", type=Path, help="critic whose weights to start from")

    config, chosen = parse_args(argv, "Train the grasp critic.", options)
    if (chosen.output is None) == (chosen.folds is None):
        raise UserError("train_critic: give --output FILE.pt or --folds K")
    if chosen.output is not None:
        check_weights_file("--output", chosen.output, KIND)
    elif chosen.initial is None or chosen.more or not 2 <= chosen.folds <= chosen.scenes:
        raise UserError(
            f"--folds {chosen.folds}: give 2 or more, at most one for each scene, with "
            "--initial and without --more"
        )
    if chosen.scenes < HELD_OUT:
        raise UserError(f"--scenes {chosen.scenes}: give {HELD_OUT} or more, a tenth is held out")
    device = choose_device(config.train.device)
    initial = None if chosen.initial is None else load_critic(chosen.initial)
    others = [path for folder in chosen.more for path in shards(folder)]
    examples = collect(config, chosen.scenes, chosen.examples)
    if chosen.folds is not None:
        assert initial is not None  # checked above
        print(compared(initial, examples, config.seed, chosen.folds, device))
        return 0
    held_out = examples.scene % HELD_OUT == 0
    if held_out.sum() < 1 or (~held_out).sum() < 2:
        raise UserError(
            f"{chosen.examples}: {len(held_out)} grasps were executed, {held_out.sum()} of them in "
            "the tenth of the scenes that is held out, too few to learn from and to judge by; do "
            "the objects fit the hand? Else give more --scenes"
        )
    scores = {}
    if initial is not None:
        before = judged(initial, examples.where(held_out))
        scores |= {f"{name} before": value for name, value in before.items()}
    # Another folder may have the same scenes with other labels.
    more = [Examples.load(path) for path in others]
    more = [part.where(part.scene % HELD_OUT != 0) for part in more]
    learned = Examples.joined([examples.where(~held_out), *more])
    critic = fit(learned, config.seed, initial=initial, device=device)
    scores |= judged(critic, examples.where(held_out))
    print(
        f"{len(examples.success)} grasps of {chosen.scenes} scenes, "
        f"{100 * examples.success.mean():.0f} % of them succeeded; "
        f"learned from {len(learned.success)}"
    )
    print(*(f"{name} {value:.3g}" for name, value in scores.items()), sep="\n")
    save_checkpoint(
        chosen.output, kind=KIND, model_args=critic.model_args, model=critic,
        config=config.model_dump(mode="json"),
        extra={"scores": scores, "scenes": chosen.scenes} | git_state()._asdict(),
    )  # fmt: skip
    print(f"wrote {chosen.output}")
    return 0


def collect(config: Config, scenes: int, folder: Path) -> Examples:
    """The candidates of so many scenes, in the scenes' order; the folder keeps those of SHARD
    scenes each in a file, and what it has already is not played again. Raises UserError where it
    holds scenes of another seed or a damaged file."""
    check_same_settings(folder, config)
    played = {number for path in folder.glob(SHARDS) for number in numbers_of(path)}
    missing = [number for number in range(scenes) if number not in played]
    wanted: dict[int, list[int]] = {}
    for number in missing:
        wanted.setdefault(number // SHARD, []).append(number)
    found: dict[int, dict[int, Examples]] = {shard: {} for shard in wanted}
    with (
        open_executor(config.compute, config.data.workers) as workers,
        tqdm(total=scenes, initial=scenes - len(missing), unit="scene") as progress,
    ):
        for number, one in completed(workers, partial(numbered_examples_of, config), missing):
            shard = number // SHARD
            found[shard][number] = one
            numbers = wanted[shard]
            if len(found[shard]) == len(numbers):
                part = found.pop(shard)
                path = folder / f"scenes-{numbers[0]:05d}-{numbers[-1]:05d}.npz"
                Examples.joined([part[number] for number in numbers]).save(path)
            progress.update()
    files = [path for path in sorted(folder.glob(SHARDS)) if numbers_of(path).start < scenes]
    examples = Examples.joined([Examples.load(path) for path in files])
    return examples.where(examples.scene < scenes)


def numbers_of(path: Path) -> range:
    """The numbers of the scenes in a file, by its name."""
    first, last = path.stem.split("-")[1:]
    return range(int(first), int(last) + 1)


def shards(folder: Path) -> list[Path]:
    """The files of executed grasps in a folder. Raises UserError where it has none."""
    found = sorted(folder.glob(SHARDS))
    if not found:
        raise UserError(f"--more {folder}: holds no executed grasps ({SHARDS})")
    return found


def check_same_settings(folder: Path, config: Config) -> None:
    """Note in a folder what the examples depend on besides their numbers. Raises UserError where it
    holds examples of something else."""
    sections = ("gripper", "objects", "scene", "workspace", "execution", "sim", "camera", "robot")
    settings = {name: getattr(config, name).model_dump(mode="json") for name in sections}
    settings |= {"seed": config.seed, "object_sets": usual_sets(config), "label": LABEL}
    settings |= {"candidates": PLANNERS, "generation": GENERATION}
    settings["simulator"] = config.simulator
    own = content_of_sets(config, config.data.object_sets)
    if own:  # so that examples of built-in sets of before there was this entry stay valid
        settings[CONTENT] = own
    for name, weights in (("critic", SHIPPED), ("network", SHIPPED_NETWORK)):
        settings[name] = hashlib.sha256(weights.read_bytes()).hexdigest()
    note = folder / "settings.json"
    if not note.exists():
        write_json_atomic(note, settings)
        return
    try:
        known = json.loads(note.read_text(encoding="utf-8"))
        known.setdefault(CONTENT, own)  # which examples of before did not note
        other = [name for name, value in settings.items() if known.get(name) != value]
    except (OSError, ValueError, AttributeError) as error:
        raise UserError(f"{note}: cannot be read ({error}); give another --examples") from error
    if other:
        raise UserError(
            f"--examples {folder}: holds grasps of another {', '.join(other)}; give another folder"
        )


def fit(
    examples: Examples,
    seed: int,
    epochs: int = EPOCHS,
    initial: GraspCritic | None = None,
    device: torch.device = CPU,
) -> GraspCritic:
    """A critic of these candidates, by cross-entropy. initial: whose weights to start from; the
    facts keep its mean and scale. device: where it is trained; the result is on the CPU."""
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    critic = GraspCritic()
    facts, patches = map(torch.from_numpy, examples.inputs)
    success = torch.from_numpy(examples.success.astype(np.float32))
    if initial is not None:
        critic.load_state_dict(initial.state_dict())
    else:
        critic.mean.copy_(facts.mean(dim=0))
        critic.scale.copy_(facts.std(dim=0).clamp_min(1e-3))
    critic, facts, patches, success = (
        part.to(device) for part in (critic, facts, patches, success)
    )
    optimizer = torch.optim.AdamW(critic.parameters(), lr=RATE, weight_decay=DECAY)
    steps = epochs * -(-len(success) // BATCH)
    rate = RATE if initial is None else FURTHER_RATE
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, rate, total_steps=steps)
    for _ in tqdm(range(epochs), unit="epoch"):
        order = torch.from_numpy(rng.permutation(len(success))).to(device)
        for batch in order.split(BATCH):
            logits = critic(*mirrored(facts[batch], patches[batch], rng))
            loss = functional.binary_cross_entropy_with_logits(logits, success[batch])
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            optimizer.step()
            schedule.step()
    return critic.eval().to(CPU)


def mirrored(
    facts: torch.Tensor, patches: torch.Tensor, rng: np.random.Generator
) -> tuple[torch.Tensor, torch.Tensor]:
    """The inputs of a batch, by chance as a mirror along the closing line shows them, or across it:
    the hand is symmetric."""
    if rng.random() < 0.5:
        patches, facts = patches.flip(3), facts.clone()
        facts[:, list(TILTS)] = facts[:, list(reversed(TILTS))]
    if rng.random() < 0.5:
        patches = patches.flip(2)
    return facts, patches


def judged(critic: GraspCritic, examples: Examples) -> dict[str, float]:
    """For each planner, how many of its plans' first candidates succeed, of those that were drawn,
    ranked by the search alone and by the critic, and the half width of that share's 95 % interval;
    then the calibration error of the critic's chances of all, and their mean log loss."""
    chance = critic.chance(examples.inputs)
    preference = JUDGED_FAN.preference(examples.inputs.facts[:, INPUTS.index("tilt")])
    scores = {}
    for number, name in enumerate(PLANNERS):
        own = (planner_of(examples.plan) == number) & examples.drawn
        for kind, score in (
            ("search", examples.score * preference),
            ("critic", chance * preference),
        ):
            first = first_of_plans(examples.where(own), score[own])
            scores[f"{name} by {kind}"] = float(first.mean())
            scores[f"{name} by {kind} +-"] = half_width(first, scene_of_plans(examples.where(own)))
    scores["calibration error"] = calibration_error(chance, examples.success)
    scores["log loss"] = log_loss(chance, examples.success)
    return scores


def compared(
    initial: GraspCritic, examples: Examples, seed: int, folds: int, device: torch.device = CPU
) -> str:
    """A table of `initial` and of what it becomes: how many first candidates of plans succeed, the
    difference with the half width of its 95 % interval, in points, and the mean log loss."""
    before, after = initial.chance(examples.inputs), np.empty(len(examples.success))
    for fold in range(folds):
        own = examples.scene % folds == fold
        critic = fit(examples.where(~own), seed, initial=initial, device=device)
        after[own] = critic.chance(examples.where(own).inputs)
    facts = dict(zip(INPUTS, examples.inputs.facts.T))
    preference, upright = JUDGED_FAN.preference(facts["tilt"]), facts["camera_height"] > UPRIGHT
    groups = {
        "all": np.ones(len(after), bool),
        "the arm's hand": facts["least_held"] == 0,
        "VGN's hand": facts["least_held"] > 0,
        "camera upright": upright,
        "camera at a side": ~upright,
    }
    lines = []
    for name, group in groups.items():
        own = examples.where(group)
        if not len(own.success):
            continue
        old, new = (
            first_of_plans(own, (chance * preference)[group]).astype(float)
            for chance in (before, after)
        )
        change = 100 * (new - old)
        lines.append([
            name, str(len(old)), f"{100 * old.mean():.1f} %", f"{100 * new.mean():.1f} %",
            f"{change.mean():+.1f} +- {half_width(change, scene_of_plans(own)):.1f}",
            *(f"{log_loss(chance[group], own.success):.3f}" for chance in (before, after)),
        ])  # fmt: skip
    header = ["plans of", "plans", "before", "after", "difference", "log loss", "after"]
    return aligned(header, lines)


def log_loss(chance: np.ndarray, success: np.ndarray) -> float:
    """The mean over outcomes (N,) of minus the logarithm of what was stated of them."""
    return float(-np.log(np.clip(np.where(success, chance, 1 - chance), 1e-4, 1.0)).mean())


def first_of_plans(examples: Examples, score: np.ndarray) -> np.ndarray:
    """For each plan, whether the candidate of the highest score (N,) succeeded."""
    order = np.lexsort((-score, examples.plan))
    _, first = np.unique(examples.plan[order], return_index=True)
    return examples.success[order][first]


def scene_of_plans(examples: Examples) -> np.ndarray:
    """For each plan, in the order of `first_of_plans`, the number of its scene."""
    _, first = np.unique(examples.plan, return_index=True)
    return examples.scene[first]


def half_width(values: np.ndarray, scene: np.ndarray) -> float:
    """Of the 95 % interval of the mean of values (N,), of which those of one scene (N,) are not
    independent: as of the sums of whole scenes."""
    _, number = np.unique(scene, return_inverse=True)
    off = np.bincount(number, weights=values - values.mean())
    scale = len(off) / max(len(off) - 1, 1)
    return float(1.96 * np.sqrt(off @ off * scale) / len(values))


if __name__ == "__main__":
    run_script(main)
