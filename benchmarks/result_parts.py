"""What `make results` measures: every part of it, with its commands.

A part is a list of commands that anyone can run alone; `benchmarks.results` plays them and writes
the tables. Seed and objects are those of configs/sealed.yaml, on which no choice is made.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from utils.config import load_config
from utils.runs import REPOSITORY

SEALED = REPOSITORY / "configs" / "sealed.yaml"  # what is kept for the tables
SEED = load_config(SEALED).seed
SPLIT = load_config(SEALED).objects.split
TRIAL_SEED, TRIAL_SPLIT = 900, "test"  # of trials
Folders = Mapping[str, Path]  # of what SOURCES names
NOWHERE: Folders = {}
# What a reader has to bring, because it is not ours to ship: the option --NAME, and what it holds.
SOURCES = {
    "cornell": "Cornell's photographs",
    "ycb": "YCB's objects",
    "clutter": "VGN's objects, in pile and packed",
}


@dataclass(frozen=True)
class Command:
    """One program run, whose results.json makes rows of a table.

    arguments: the folders of SOURCES stand there by their names in capitals. rounds: of each row,
    None for what has no rounds. kept: rounds of each row that stay in the repository, so that a
    reader can check them in minutes. seed, split: of the scenes and the objects.
    """

    name: str
    program: str  # a script, or a module of benchmarks with --json
    arguments: str
    rounds: int | None = None
    kept: int = 10
    split: str = SPLIT
    seed: int = SEED

    def trial(self) -> Command:
        """The same on scenes that are not sealed."""
        split = TRIAL_SPLIT if self.split == SPLIT else self.split
        return replace(self, split=split, seed=TRIAL_SEED)

    def scaled(self, scale: float) -> int | None:
        return None if self.rounds is None else max(1, round(self.rounds * scale))

    def line(self, rounds: int | None, folders: Folders = NOWHERE) -> str:
        """The command as a reader would type it."""
        start = self.program if self.program.endswith(".py") else f"-m benchmarks.{self.program}"
        parts = [f"python {start}"]
        if self.program.endswith(".py"):
            parts += [f"seed={self.seed}", f"objects.split={self.split}"]
        parts += [self.arguments.replace(f"seed={SEED}", f"seed={self.seed}")]
        if rounds is not None:
            parts.append(f"evaluate.rounds={rounds}")
        places = {
            name.upper(): shlex.quote(str(folders.get(name, f"path/to/{name}"))) for name in SOURCES
        }
        return re.sub(
            "|".join(places), lambda found: places[found[0]], " ".join(filter(None, parts))
        )


@dataclass(frozen=True)
class Part:
    """Tables that are measured together. minutes: on two cores, all rounds."""

    name: str
    about: str
    minutes: int
    commands: tuple[Command, ...]
    needs: tuple[str, ...] = ()  # of SOURCES


EVALUATE, ALL = "evaluate.py", "random,heuristic,graspnet,graspnet6d,oracle"
FROM_ABOVE = "random,heuristic,graspnet,oracle"
ANY_SIDE = "graspnet,graspnet6d,oracle,oracle6d"
JUDGED = "heuristic,graspnet,graspnet_direct,graspnet6d,oracle"
NOISY_FIRST = "realsense,none"
OBLIQUE = "'camera.position=[0.5,-0.566,0.566]' 'camera.up=[0,0,1]'"  # 45 degrees


def _evaluation(
    name: str,
    rounds: int,
    arguments: str,
    kept: int = 10,
    noises: str = "none",
    split: str = SPLIT,
) -> Command:
    ending = f"evaluate.depth_noises={noises} evaluate.videos=0"
    return Command(name, EVALUATE, f"{arguments} {ending}", rounds, kept, split)


def _policies(name: str, trainings: int = 3) -> str:
    """Those of PPO that were trained alike but for their seed, 0 first, which is what users get."""
    endings = ["", *(f"_{seed}" for seed in range(1, trainings))]
    return ",".join(f"ppo:checkpoints/ppo_{name}{ending}.pt" for ending in endings)


def _single_objects(name: str, policies: str, objects: str, more: str = "") -> Command:
    """Policies, and the heuristic beside them, on 100 objects one by one; more: overrides."""
    where = f"evaluate.scenarios=isolated evaluate.object_sets={objects}"
    return _evaluation(name, 100, f"{more}evaluate.policies={policies},heuristic {where}", kept=3)


PARTS = (
    Part("scoreboard", "five planners on single objects, packed scenes and piles", 100, (
        _evaluation("scoreboard", 50, f"evaluate.policies={ALL} "
                    "evaluate.scenarios=isolated,packed,pile "
                    "evaluate.object_sets=random_urdfs,primitives", noises=NOISY_FIRST),
    )),
    Part("clutter15", "five planners on piles of 15 objects", 50, (
        _evaluation("clutter15", 30, f"scene.count=15 evaluate.policies={ALL} "
                    "evaluate.scenarios=pile evaluate.object_sets=random_urdfs",
                    noises=NOISY_FIRST),
    )),
    Part("six_dof", "planners that grasp from any side beside those from straight above", 40, (
        _evaluation("six_dof", 30, f"evaluate.policies={ANY_SIDE} "
                    "evaluate.scenarios=packed,pile,bin "
                    "evaluate.object_sets=random_urdfs,primitives", noises=NOISY_FIRST, kept=3),
        _evaluation("bowls", 30, f"evaluate.policies={ANY_SIDE} evaluate.scenarios=isolated "
                    "evaluate.object_sets=benchmarks.bowls:bowls", noises=NOISY_FIRST, kept=3),
    )),
    Part("scenes", "scenes that ask for grasps from the side", 20, tuple(
        _evaluation(name, 30, f"evaluate.policies={ANY_SIDE} evaluate.scenarios={scenarios} "
                    f"evaluate.object_sets={name}", noises="realsense", kept=3)
        for name, scenarios in (("tall", "tall,wall,shelf"), ("flat", "wall,flat"))
    )),
    Part("oblique", "a camera 45 degrees off the vertical", 15, (
        _evaluation("oblique", 20, "evaluate.policies=heuristic,graspnet,graspnet6d,oracle6d "
                    "evaluate.scenarios=pile evaluate.object_sets=random_urdfs,primitives "
                    f"{OBLIQUE}", noises=NOISY_FIRST, kept=3),
    )),
    Part("second_look", "the same with a second image from the wrist", 10, (
        _evaluation("second_look", 20, "evaluate.policies=graspnet,graspnet6d "
                    "evaluate.scenarios=pile evaluate.object_sets=random_urdfs,primitives "
                    f"{OBLIQUE} evaluate.second_look=20", noises=NOISY_FIRST, kept=3),
    )),
    Part("unseen", "primitives of families that no training sees", 15, (
        _evaluation("unseen", 30, "evaluate.policies=heuristic,graspnet,graspnet_direct,graspnet6d,"
                    "oracle6d evaluate.scenarios=pile evaluate.object_sets=primitives",
                    noises=NOISY_FIRST, kept=3, split="unseen_families"),
    )),
    Part("household", "household things, some wider than the hand as they lie", 10, (
        _evaluation("household", 20, f"evaluate.policies={ANY_SIDE} evaluate.scenarios=household "
                    "evaluate.object_sets=household", noises=NOISY_FIRST, kept=3),
    )),
    Part("ycb", "YCB's objects, as large and as heavy as they are", 15, (
        _evaluation("ycb", 30, f"evaluate.policies={ANY_SIDE} evaluate.scenarios=household "
                    "evaluate.object_sets=YCB", noises=NOISY_FIRST, kept=0),
    ), needs=("ycb",)),
    Part("clutter", "VGN's objects, with the whole arm", 20, tuple(
        _evaluation(layout, 20, f"evaluate.policies={ANY_SIDE} evaluate.scenarios={layout} "
                    f"evaluate.object_sets=CLUTTER/{layout} objects.scale={scale} "
                    "objects.skip_broken=true", noises=NOISY_FIRST, kept=0)
        for layout, scale in (("pile", 0.9), ("packed", 0.8))
    ), needs=("clutter",)),
    Part("retrieve", "one object under a pile", 20, (
        _evaluation("retrieve", 25, "evaluate.policies=graspnet,oracle "
                    "evaluate.scenarios=retrieve evaluate.object_sets=random_urdfs,primitives",
                    noises="realsense", kept=3),
    )),
    Part("vgn", "the field's protocols with a floating hand and side views", 30, tuple(
        _evaluation(name, 50, f"--config configs/{name}.yaml evaluate.policies=graspnet,graspnet6d "
                    "evaluate.object_sets=random_urdfs", noises=noise, kept=3)
        for name, noise in (("vgn", "gaussian"), ("giga", "gamma"))
    )),
    Part("direct", "the network's peaks alone, and with a search where none is likely", 20, (
        _evaluation("direct", 20, "evaluate.policies=graspnet,graspnet_direct "
                    "evaluate.scenarios=packed,pile,dense evaluate.object_sets=random_urdfs",
                    noises=NOISY_FIRST, kept=3),
        _evaluation("primitives", 20, "evaluate.policies=graspnet,graspnet_direct "
                    "evaluate.scenarios=packed,pile evaluate.object_sets=primitives",
                    noises=NOISY_FIRST, kept=3),
    )),
    Part("calibration", "how well the planners know their chances, in both simulators", 10, (
        _evaluation("pybullet", 10, f"evaluate.policies={JUDGED} evaluate.scenarios=packed,pile "
                    "evaluate.object_sets=random_urdfs,primitives", noises=NOISY_FIRST, kept=1),
        _evaluation("mujoco", 10, f"simulator=mujoco evaluate.policies={JUDGED} "
                    "evaluate.scenarios=packed,pile evaluate.object_sets=random_urdfs,primitives",
                    kept=1),
    )),
    Part("noise", "other depth noises than the scoreboard's", 20, tuple(
        _evaluation(noise, 50, "evaluate.policies=heuristic,graspnet evaluate.scenarios=pile "
                    "evaluate.object_sets=random_urdfs,primitives", kept=3, noises=noise)
        for noise in ("kinect", "gamma")
    )),
    Part("servo", "closed loops on objects that move", 30, (
        _evaluation("servo", 10, "--config configs/servo.yaml", kept=1),
    )),
    Part("mujoco", "piles in both simulators", 25, tuple(
        _evaluation(simulator, 50, f"simulator={simulator} evaluate.policies=heuristic,graspnet,"
                    "oracle evaluate.scenarios=pile evaluate.object_sets=random_urdfs", kept=3)
        for simulator in ("pybullet", "mujoco")
    )),
    Part("mujoco_only", "the default objects without PyBullet, beside those with it", 90, tuple(
        _evaluation(simulator, 100, f"simulator={simulator} scene.simulator={simulator} "
                    f"evaluate.policies={FROM_ABOVE} evaluate.scenarios=isolated,packed,pile "
                    "evaluate.object_sets=primitives", kept=2)
        for simulator in ("mujoco", "pybullet")
    )),
    Part("ppo", "the shipped policies of PPO on unseen single objects", 20, (
        *(_single_objects(objects, _policies(objects), objects)
          for objects in ("box", "random_urdfs", "primitives")),
    )),
    Part("ppo_mujoco", "policies of PPO for boxes in both simulators", 6, tuple(
        _single_objects(simulator, f"{_policies('box_varied_looks')},{_policies('box', 1)}", "box",
                        f"simulator={simulator} ")
        for simulator in ("pybullet", "mujoco")
    )),
    Part("cornell", "Cornell's photographs", 15, (
        Command("simulated", EVALUATE, "--config configs/sim_to_real.yaml transfer.columns="
                "cornell,cornell_as_taken transfer.cornell=CORNELL"),
        Command("folds", "train_graspnet.py", "--config configs/cornell.yaml data.root=CORNELL"),
    ), needs=("cornell",)),
    Part("speed", "the environment against its peers, and the planners; on a quiet machine", 8, (
        Command("environment", "bench_env", ""),
        Command("planning", "bench_planning", ""),
    )),
    Part("scaling", "workers of this machine, of a cluster and of two nodes, and killed ones", 15, (
        Command("scaling", "bench_scaling", f"seed={SEED}"),
    )),
)  # fmt: skip
