"""Simulated grasp data: images of seeded scenes with dense labels, some of which are executed.

Every shard is a pure function of the config, the split and its number. Worker processes write the
shards one by one, so that an interrupted generation continues with those that are missing.
`envs.cell_appearance` draws how the images look, `utils.grasp_labels` computes the labels, and
`utils.grasp_data` reads and writes the shards.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Hashable, Iterable, Iterator
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import numpy as np
import yaml
from tqdm import tqdm

from envs.cell import Cell, PhysicsError, camera_intrinsics, require_arm
from envs.cell_appearance import Appearance, draw_camera
from envs.cell_layout import Scene
from envs.cell_scenes import SceneError, make_scene
from envs.execution import check_tray, execute_grasp
from envs.objects import OBJECT_SETS, ObjectSet, load_objects
from envs.simulators import cell_class
from utils.atomic_files import write_atomic
from utils.config import Config, dump_config, load_config, with_settings
from utils.config_types import changed, draw
from utils.errors import UserError
from utils.executor import LostWorkerError, completed, open_executor
from utils.grasp_data import FORMAT_VERSION, LabelledFrame, shard_path, write_shard
from utils.grasp_labels import LabelSettings, Trial, dense_labels, draw_pairs
from utils.runs import named_files
from utils.worker_process import kept

SPLITS = ("train", "validation")
HELD_OUT = 10  # one of so many training objects is kept for validation
FRAMES_PER_SCENE = 4  # the whole scene, then parts of it, as in a round that clears it
SCENES_PER_SHARD = 8
MOST_DRAWS = 100  # for one scene; each draw tries several times to place its objects
_LAYOUT_SHARES = {"isolated": 0.1, "packed": 0.3, "pile": 0.4, "bin": 0.2}
_MOST_PACKED = 6  # objects side by side; for eight, 50 draws often find no places, for ten none did
_PHYSICS = ("object_friction", "object_mass")  # on which labels and their trials can depend
_FIRST_SEED = {
    "train": 1_000_000_000,
    "validation": 2_000_000_000,
}  # of scenes; those of an evaluation with a seed below 10,000 are smaller


_STRAIGHT = np.radians(5)  # off the vertical, of a camera whose pose may be varied (`draw_camera`)
# `generate` refuses other views than the fixed one, and a hand without an arm.
_SIDE_VIEW = ("view", "side_tilt_deg", "side_distance", "side_azimuth_deg")


def data_folder(config: Config, root: Path = Path("data")) -> Path:
    """Return the folder of a config's simulated data, whose name is a hash of all that the data
    depend on."""
    if config.data.root is not None:
        return config.data.root
    return root / f"simulated-{hashlib.sha256(_content(config).encode()).hexdigest()[:8]}"


def _content(config: Config) -> str:
    """Return as YAML all that one shard depends on; the number of shards does not belong to it."""
    everything = config.model_dump(mode="json")
    keys = ("seed", "simulator", "sim", "camera", "workspace", "scene")
    chosen = {key: everything[key] for key in keys}
    for key in ("depth_noise", "depth_noise_args", *_SIDE_VIEW):  # images are stored clean
        chosen["camera"].pop(key)
    chosen["objects"] = everything["objects"] | {"split": "train"}
    if not config.objects.skip_broken:  # so that data made before there was this key stays valid
        chosen["objects"].pop("skip_broken")
    data = everything["data"]
    chosen["data"] = {
        key: data[key] for key in ("object_sets", "max_objects", "randomise", "executed_share")
    }
    usual = load_config(None)
    if config.data.executed_share > 0:
        if config.closed_loop.floor != usual.closed_loop.floor:  # valid as above
            chosen["floor"] = everything["closed_loop"]["floor"]
        chosen |= {key: everything[key] for key in ("robot", "execution", "safety")}
        chosen["robot"].pop("arm")
        chosen["execution"].pop("on_contact")
    elif config.robot.home != usual.robot.home:  # valid as above: the arm is in the images
        chosen["home"] = everything["robot"]["home"]
    if config.data.randomise_physics:
        physics = everything["randomization"]["physics"]
        chosen["physics"] = {key: physics[key] for key in _PHYSICS}
    chosen["generation"] = {
        "held_out": {"one_of": HELD_OUT, "drawn": "at random"},
        "frames_per_scene": FRAMES_PER_SCENE,
        "scenes_per_shard": SCENES_PER_SHARD,
        "layout_shares": _LAYOUT_SHARES,
        "most_packed": _MOST_PACKED,
        "first_seed": _FIRST_SEED,
    }
    own = content_of_sets(config, config.data.object_sets)
    if own:
        chosen["files"] = own
    chosen["labels"] = json.loads(json.dumps(asdict(LabelSettings())))  # tuples become lists
    chosen["gripper"] = json.loads(json.dumps(asdict(config.gripper.geometry)))
    for name in ("opens_fully", "least_held"):
        if not chosen["gripper"][name]:  # valid as above
            chosen["gripper"].pop(name)
    return yaml.safe_dump({"format_version": FORMAT_VERSION} | chosen)


def content_of_sets(config: Config, names: Iterable[str]) -> dict[str, str]:
    """A digest of what each set of a user's own is made of, by its name: the files below its
    folder, the module of a plug-in, and the files that its objects are read from, wherever they
    lie. Raises UserError for a set that cannot be loaded."""
    modules, found = named_files(config), {}
    for name in names:
        if name in OBJECT_SETS:
            continue
        objects = load_objects(name, config, "train")
        sources, parts = objects.sources(), [modules[name]] if name in modules else []
        if sources or not parts:
            parts.append(_digest(Path(name).expanduser(), sources))
        doubles = len(_by_shape(objects)) < len(objects)
        if sources and (doubles or config.objects.skip_broken):
            parts.append("no shape in two splits")  # which older data may have
        found[name] = " ".join(parts)
    return found


def _digest(folder: Path, sources: set[Path]) -> str:
    """SHA-256 of the names and contents of all files below a folder, and of the `sources` that lie
    elsewhere."""
    below = sorted(path for path in folder.rglob("*") if path.is_file())
    named = [(path, path.relative_to(folder).as_posix()) for path in below]
    elsewhere = sources - {path.resolve() for path in below}
    digest = hashlib.sha256()
    for path, name in [*named, *((path, path.name) for path in sorted(elsewhere))]:
        content = hashlib.sha256(path.read_bytes()).hexdigest()
        digest.update(f"{name} {content}\n".encode())
    return digest.hexdigest()


def generate(config: Config, rank: int = 0, ranks: int = 1) -> Path:
    """Write the shards that the data set of a config still lacks; returns its folder.

    rank, ranks: this process makes every ranks-th shard (`torchrun`).
    Raises UserError if the folder holds data of another config, if labels cannot be executed, if
    robot or camera are not those of training data, or if the workers died or wrote elsewhere.
    However the generation ends, it finishes the shards under way and begins no others.
    """
    require_arm(config, "the generation of training data")
    for key, value, needed in (
        ("view", config.camera.view, "fixed"),
        ("mount", config.camera.mount, "overhead"),
    ):
        if value != needed:
            raise UserError(
                f"camera.{key}={value}: training images are taken around camera.position; set "
                f"camera.{key}={needed}"
            )
    away = np.subtract(config.camera.position, config.camera.target)
    if config.data.randomise and np.arctan2(np.hypot(*away[:2]), away[2]) > _STRAIGHT:
        raise UserError(
            "data.randomise=true: training images are then taken from around straight above; put "
            "camera.position over camera.target, or set data.randomise=false"
        )
    folder = data_folder(config)
    missing = missing_shards(config, folder, rank, ranks)
    if missing:
        object_sets(config)  # an unusable set raises here, not in a worker, and leaves no folder
        if config.data.executed_share:
            check_tray(config)
    _claim(folder, config)
    if not missing:
        return folder
    make = partial(_make_shard, config, folder.absolute())
    try:
        with (
            open_executor(config.compute, config.data.workers) as workers,
            tqdm(
                total=len(missing) * SCENES_PER_SHARD * FRAMES_PER_SCENE, unit="frame", desc="data"
            ) as progress,
        ):
            try:
                for frames in completed(workers, make, missing):
                    progress.update(frames)
            except BaseException:  # Ctrl-C, or an error in a worker such as a full disk
                progress.write("stopping: finishing the shards under way")
                workers.shutdown()
                progress.write(
                    f"{_frames_kept(config, folder)} frames are kept in {folder}; the same command "
                    "goes on from there"
                )
                raise
    except LostWorkerError as error:
        raise UserError(
            f"{error}; the finished shards are safe in {folder}: start again, perhaps with "
            "data.workers=1"
        ) from error
    if missing_shards(config, folder, rank, ranks):
        raise UserError(
            f"data.root {folder}: the workers have written shards that are not here; on a cluster "
            "it must be in a folder that all machines share"
        )
    return folder


def missing_shards(config: Config, folder: Path, rank: int, ranks: int) -> list[tuple[str, int]]:
    """Return (split, number) of this process's shards that do not exist yet. The process that makes
    a shard does not depend on which shards exist, because others may be writing at this moment."""
    everything = [
        (split, number) for split in SPLITS for number in range(shard_count(config, split))
    ]
    return [job for job in everything[rank::ranks] if not shard_path(folder, *job).exists()]


def shard_count(config: Config, split: str) -> int:
    """Return the number of shards that hold at least the configured number of frames."""
    frames = config.data.frames if split == "train" else config.data.validation_frames
    return -(-frames // (FRAMES_PER_SCENE * SCENES_PER_SHARD))


def _frames_kept(config: Config, folder: Path) -> str:
    """Return how many frames of how many are on disk, e.g. "64 of 384"."""
    shards = sum(shard_count(config, split) for split in SPLITS)
    kept, each = shards - len(missing_shards(config, folder, 0, 1)), SCENES_PER_SHARD
    return f"{kept * each * FRAMES_PER_SCENE} of {shards * each * FRAMES_PER_SCENE}"


def _claim(folder: Path, config: Config) -> None:
    """Make the folder, or raise UserError if it holds something other than this data set."""
    content, mark = _content(config), folder / "content.yaml"
    # Another process may be claiming the folder at this moment. It writes the mark before anything
    # else, so a folder that is not empty here has a mark in the next line.
    occupied = any(folder.glob("[!.]*"))
    if mark.exists():
        if mark.read_text(encoding="utf-8") != content:
            raise UserError(
                f"data.root {folder}: holds data made with other settings (see {mark}); choose "
                "another folder, or leave data.root out"
            )
        return
    if occupied:
        raise UserError(f"data.root {folder}: not empty and no data set; choose another folder")
    write_atomic(mark, content)
    write_atomic(folder / "config.yaml", dump_config(config))


# --- In a worker process --------------------------------------------------------------------


@kept
def _cell_of(config: Config) -> Cell:
    return cell_class(config.simulator)(config)


def _make_shard(config: Config, folder: Path, shard: tuple[str, int]) -> int:
    """Write a shard, given by its split and number; returns how many frames it holds."""
    (split, number), cell, sets = shard, _cell_of(config), _sets_of(config)
    frames: list[LabelledFrame] = []
    trials: list[Trial] = []
    first = number * SCENES_PER_SHARD
    for scene_number in range(first, first + SCENES_PER_SHARD):
        seed = _FIRST_SEED[split] + scene_number
        scene, name = draw_scene(config, split, seed, sets)
        for frame, more_trials in label_scene(config, scene, name, cell):
            frames.append(frame)
            trials += more_trials
    write_shard(shard_path(folder, split, number), frames, trials, cell.gripper.max_opening)
    return len(frames)


def object_sets(config: Config) -> dict[tuple[str, str], ObjectSet]:
    """Return the training objects of each set by (set, split); no test object is among them."""
    parts = {}
    for name in config.data.object_sets:
        whole = load_objects(name, config, "train")
        shapes = _by_shape(whole)
        if len(shapes) < 2:
            raise UserError(
                f"data.object_sets: {name} holds {len(shapes)} object, but some have to be kept "
                "for validation; give sets of two objects or more, of different names"
            )
        # Drawn, because families of objects take turns: every tenth may be of one of ten families.
        drawn = np.random.default_rng(len(shapes)).permutation(len(shapes))
        count = math.ceil(len(shapes) / HELD_OUT)
        for split, chosen in (("validation", drawn[:count]), ("train", drawn[count:])):
            parts[name, split] = whole.part(sorted(sum((shapes[i] for i in chosen), [])))
    return parts


def _by_shape(objects: ObjectSet) -> list[list[int]]:
    """The numbers of the objects, those of the same shape together."""
    found: dict[Hashable, list[int]] = {}
    for index in range(len(objects)):
        found.setdefault(objects.shape_name(index), []).append(index)
    return list(found.values())


_sets_of = kept(object_sets)


def draw_scene(
    config: Config, split: str, seed: int, sets: dict[tuple[str, str], ObjectSet]
) -> tuple[Scene, str]:
    """Draw a scene of random layout, object set and number of objects; returns it and the set's
    name.

    Raises UserError if none of MOST_DRAWS draws gives a scene.
    """
    rng = np.random.default_rng([config.seed, seed])
    layouts, shares = zip(*_LAYOUT_SHARES.items())
    for _ in range(MOST_DRAWS):
        layout = layouts[rng.choice(len(layouts), p=shares)]
        name = config.data.object_sets[rng.integers(len(config.data.object_sets))]
        most = config.data.max_objects
        if layout == "packed":
            most = min(most, _MOST_PACKED)
        count = int(rng.integers(2, most + 1))
        crowded = with_settings(config, "scene", {"count": count})
        try:
            scene_seed = int(rng.integers(2**62))
            scene = make_scene(layout, sets[name, split], scene_seed, crowded)
        except SceneError:  # too many for this layout: another draw, from the same generator
            continue
        return replace(scene, seed=seed), name
    raise UserError(
        f"none of {MOST_DRAWS} scenes drawn for seed {seed} came to rest inside the workspace; use "
        "smaller objects (objects.scale, objects.fit), fewer (data.max_objects) or a larger "
        "workspace.size"
    )


def label_scene(
    config: Config, scene: Scene, set_name: str, cell: Cell
) -> Iterator[tuple[LabelledFrame, list[Trial]]]:
    """Yield labelled frames of a scene and of random parts of it, some with trials of their
    labels."""
    rng = np.random.default_rng([config.seed, scene.seed, 1])
    workspace = config.workspace.geometry
    configured = cell.config.camera
    for number in range(FRAMES_PER_SCENE):
        part = _part(scene, rng) if number else scene
        if config.data.randomise_physics:
            part = with_other_physics(part, config, number)
        cell.load(part)
        appearance = Appearance.draw(rng, len(part.placements))
        intrinsics, T_WC = draw_camera(rng, configured)
        if not config.data.randomise:
            appearance = Appearance()
            intrinsics, T_WC = camera_intrinsics(configured), cell.camera_pose()
        appearance.paint(cell)
        try:
            frame = appearance.render(cell, intrinsics, T_WC, rng)
        except PhysicsError:  # where it came to no rest; the next one is loaded into a rebuilt cell
            continue
        labels = dense_labels(frame, cell.gripper, workspace)
        trials = []
        if rng.random() < config.data.executed_share:
            trials = execute_pairs(cell, part, frame, labels, rng)
        yield (
            LabelledFrame(frame, labels, f"{scene.layout} {set_name} {scene.seed}"),
            trials,
        )


def _part(scene: Scene, rng: np.random.Generator) -> Scene:
    """Return a scene without up to three of its objects; at least one stays."""
    total = len(scene.placements)
    count = int(rng.integers(max(total - 3, 1), total + 1))
    kept = np.sort(rng.choice(total, count, replace=False))
    return replace(scene, placements=tuple(scene.placements[i] for i in kept))


def with_other_physics(scene: Scene, config: Config, number: int) -> Scene:
    """Return the scene of frame `number` with each object's friction and mass changed, in the
    physics and in the labels alike. The changes have a generator of their own, so that everything
    else about the frame stays as it is."""
    rng = np.random.default_rng([config.seed, scene.seed, 2, number])
    ranges, placements = config.randomization.physics, []
    for placed in scene.placements:
        friction, mass = (getattr(ranges, name) for name in _PHYSICS)
        model = placed.model
        heavier = changed(mass.operation, model.mass, draw(mass, rng))
        model = replace(
            model,
            friction=changed(friction.operation, model.friction, draw(friction, rng)),
            mass=heavier,
            inertia=model.inertia * (heavier / model.mass),
        )
        placements.append(replace(placed, model=model))
    return replace(scene, placements=tuple(placements))


def execute_pairs(cell: Cell, scene: Scene, frame, labels, rng: np.random.Generator) -> list[Trial]:
    """Execute labelled pairs of every quality, each on the freshly loaded scene. A grasp during
    which the simulation blows up has failed."""
    trials = []
    for grasp, quality, weight in draw_pairs(frame, labels, cell.gripper, rng):
        cell.load(scene)
        try:
            success = execute_grasp(cell, grasp).success
        except PhysicsError:  # the next pair loads its scene into a rebuilt cell
            success = False
        trials.append(Trial(quality, weight, success))
    return trials
