"""Damaged and hostile files of every kind that the program reads: part `files` of the soak.

`KINDS` makes a sound file of each kind and reads it as the program does; `damaged` changes its
bytes. Reading has to give something, or a `UserError`: one sentence.
"""

from __future__ import annotations

import json
import os
import re
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Event
from typing import Any

import numpy as np
import psutil
import trimesh
import yaml
from PIL import Image

from benchmarks.soak_tally import Tally
from envs.object_files import read_object
from envs.object_meshes import Decomposition, _read_parts, _write_parts
from envs.object_parts import MassProperties
from models.grasp_policy import GraspPolicyNetwork, load_policy
from models.graspnet import create_model
from models.graspnet_io import load_graspnet, save_graspnet
from models.ppo import KIND as POLICY
from utils.atomic_files import write_atomic
from utils.camera_files import read_intrinsics, read_pose
from utils.checkpoint import save_checkpoint
from utils.config import load_config
from utils.errors import UserError, one_line
from utils.geometry import SceneGeometry, SolidObject
from utils.grasp_data import LabelledFrame, SimulatedDataset, read_trials, write_shard
from utils.grasp_labels import GraspLabels, Trial
from utils.images import read_depth, read_rgb
from utils.result_records import (
    AttemptRecord,
    RoundRecord,
    append_round,
    read_rounds,
    read_sample,
    write_sample,
)
from utils.runs import new_run_folder
from utils.transforms import ImageGrasp, RGBDFrame, look_at

TRIES = 2_000  # of each kind
LARGEST_GROWTH = 500e6  # bytes that reading a small file may take
LONGEST = 20.0  # s that it may take
CLEAR_REFS = Path("/proc/self/clear_refs")  # 5 resets the peak of the resident memory
COUNTS_PEAKS = os.access(CLEAR_REFS, os.W_OK)
# What takes the place of a number or a word in a text.
WORDS = (
    b"nan", b"-inf", b"1e309", b"-1", b"0", b"9" * 400, b"null", b"[]", b"{}", b"true", b"'x'",
    b"../../../etc/passwd", b"os:system", b"*a", b"&a", b"!!python/object/apply:os.system [id]",
    b"2020-99-99", b"\x00", b"\xff\xfe", b"[" * 2000, b'{"a":' * 2000,
)  # fmt: skip


@dataclass(frozen=True)
class Kind:
    """A kind of file: its name, what writes a sound one, and what reads one."""

    name: str
    write: Callable[[Path], object]
    read: Callable[[Path], object]


def damaged(content: bytes, random: np.random.Generator) -> bytes:
    """A file's bytes, cut short, with flipped bits, or otherwise changed."""
    data, kind = bytearray(content), random.integers(7)
    start = int(random.integers(len(data)))
    length = int(random.integers(1, 1 + min(200, len(data) - start)))
    if kind == 0:
        del data[start:]
    elif kind == 1:
        for place in random.integers(len(data), size=random.integers(1, 9)):
            data[place] ^= 1 << int(random.integers(8))
    elif kind == 2:
        data[start : start + length] = random.bytes(length)
    elif kind == 3:
        del data[start : start + length]
    elif kind == 4:
        data[start:start] = data[start : start + length]
    elif kind == 5:
        data[start : start + length] = bytes([random.choice([0, 255])]) * length
    else:
        data = bytearray(_with_another_word(bytes(data), start, random))
    return bytes(data)


def _with_another_word(content: bytes, start: int, random: np.random.Generator) -> bytes:
    """A word or number near `start` is replaced."""
    letters = b"abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789.+-_"
    end = start
    while start > 0 and content[start - 1] in letters:
        start -= 1
    while end < len(content) and content[end] in letters:
        end += 1
    return content[:start] + WORDS[random.integers(len(WORDS))] + content[end:]


def problem(
    kind: Kind, path: Path, most: float = LARGEST_GROWTH, longest: float = LONGEST
) -> str | None:
    """What is wrong with how a file is read; None where it gives something or one sentence.

    most: bytes that reading it may take. longest: seconds that it may take."""
    before, begun = psutil.Process().memory_info().rss, time.perf_counter()
    forget_peak()
    try:
        kind.read(path)
    except UserError as error:
        if not str(error).strip():
            return "the error says nothing"
    except Exception as error:
        return f"{type(error).__name__}: {one_line(error)}"
    if peak_memory() - before > most:
        return "it takes too much memory"
    return "it takes too long" if time.perf_counter() - begun > longest else None


def forget_peak() -> None:
    """From now on `peak_memory` counts anew."""
    if COUNTS_PEAKS:
        CLEAR_REFS.write_text("5")


def peak_memory() -> int:
    """The most bytes that were resident since `forget_peak`; only Linux can tell, elsewhere they
    are those of this moment."""
    if not COUNTS_PEAKS:
        return psutil.Process().memory_info().rss
    (peak,) = re.findall(r"^VmHWM:\s*(\d+) kB$", Path("/proc/self/status").read_text(), re.M)
    return 1024 * int(peak)


def soak_files(scale: float, seed: int, stop: Event) -> Iterator[Tally]:
    """Damaged files of every kind, each read in a folder beside a sound one."""
    random = np.random.default_rng(seed)
    for kind in KINDS:
        tally = Tally(f"damaged file: {kind.name}")
        yield tally
        with TemporaryDirectory() as folder:
            sound = Path(folder) / "sound" / kind.name.split()[-1]
            sound.parent.mkdir()
            kind.write(sound)
            content = sound.read_bytes()
            for _ in range(round(TRIES * scale)):
                if stop.is_set():
                    break
                path = sound.with_name(f"damaged{sound.name}")
                path.write_bytes(damaged(content, random))
                found = problem(kind, path)
                path.unlink()
                tally.add(found is None, lost=sound.read_bytes() != content)
                if found is not None and not tally.note:
                    tally.note = found


# --- Sound files --------------------------------------------------------------------------------


def _shard(path: Path) -> None:
    random, shape = np.random.default_rng(0), (6, 8)
    frame = RGBDFrame(
        random.integers(0, 256, (*shape, 3), dtype=np.uint8),
        random.uniform(0.5, 0.8, shape).astype(np.float32),
        np.array([[20.0, 0, 4], [0, 20, 3], [0, 0, 1]]),
        look_at((0.5, 0.0, 0.8), (0.5, 0.0, 0.0), (1, 0, 0)),
        random.integers(-1, 1, shape).astype(np.int32),
        SceneGeometry((SolidObject((), np.zeros(3), 0.5),)),
    )
    maps = random.uniform(0, 0.05, (2, 18, *shape)).astype(np.float32)
    labels = GraspLabels(maps[0], maps[1], np.ones(shape, bool))
    write_shard(path, [LabelledFrame(frame, labels, "pile box 7")] * 3, [Trial(1, 1, True)], 0.08)


def _read_shard(path: Path) -> None:
    folder = path.parent.parent / "set" / "train"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "00000.h5").write_bytes(path.read_bytes())
    read_trials(folder.parent)
    images = SimulatedDataset(folder.parent, "train")
    for index in range(len(images)):
        images[index], images.table_distance(index)


def _network(path: Path) -> None:
    save_graspnet(path, create_model(name="ggcnn"), metres_per_pixel=0.002)


def _policy(path: Path) -> None:
    network = GraspPolicyNetwork(8, 3, 2, 8, image_channels=0)
    layout = {"images": [], "state": [["state", [3], "float32"]], "privileged": []}
    config = load_config().model_dump(mode="json")
    extra = {"layout": layout, "history": []}
    save_checkpoint(
        path, kind=POLICY, model_args=network.model_args, model=network, config=config, extra=extra
    )


def _journal(path: Path) -> None:
    grasp = ImageGrasp(np.array([4.0, 5.0]), 0.1, 0.7, 0.08, 0.9)
    attempts = (AttemptRecord(True, "success", 0.1, 6.0, grasp),)
    for number in range(4):
        append_round(
            path, RoundRecord("heuristic", "pile", "box", number, 1, 1, attempts, "cleared")
        )


def _sample(path: Path) -> None:
    run = new_run_folder("evaluate", None, load_config(None, ["seed=3"]), path.parent / "runs")
    _journal(run / "rounds.jsonl")
    write_sample(run, path)


def _mesh(path: Path) -> None:
    trimesh.creation.box((0.04, 0.05, 0.06)).export(path)


URDF = """<?xml version="1.0"?>
<robot name="box"><link name="base">
  <contact><lateral_friction value="0.8"/></contact>
  <inertial><mass value="0.1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
  <visual><origin xyz="0 0 0.01" rpy="0 0 0.1"/><geometry><box size="0.04 0.05 0.06"/></geometry>
    <material name="red"><color rgba="1 0 0 1"/></material></visual>
  <collision><geometry><box size="0.04 0.05 0.06"/></geometry></collision>
</link></robot>
"""

MJCF = """<mujoco>
<compiler angle="radian" meshdir="."/>
<default><geom friction="0.8"/>
  <default class="visual"><geom contype="0" conaffinity="0" density="0"/></default></default>
<asset><material name="red" rgba="1 0 0 1"/>
  <mesh name="wedge" vertex="0 0 0 0.04 0 0 0 0.05 0 0 0 0.06" scale="1 1 1"/></asset>
<worldbody><body name="box" pos="0 0 0.03"><freejoint/>
  <inertial pos="0 0 0" mass="0.1" diaginertia="5e-5 4e-5 3e-5"/>
  <geom class="visual" type="mesh" mesh="wedge" material="red"/>
  <geom name="solid" type="box" size="0.02 0.025 0.03" euler="0 0 0.1"/>
  <body><geom type="capsule" size="0.01 0.02" mass="0.05"/></body>
</body></worldbody>
</mujoco>
"""


def _image(path: Path, kind: str) -> None:
    random = np.random.default_rng(0)
    if kind == "depth":
        Image.fromarray(random.integers(400, 900, (12, 16)).astype(np.uint16)).save(path)
    elif kind == "metres":
        Image.fromarray(random.uniform(0.4, 0.9, (12, 16)).astype(np.float32)).save(path)
    else:
        Image.fromarray(random.integers(0, 256, (12, 16, 3), dtype=np.uint8)).save(path)


def _text(content: Any) -> Callable[[Path], None]:
    return lambda path: write_atomic(
        path, content if isinstance(content, str) else json.dumps(content)
    )


def _read_intrinsics(path: Path) -> None:
    read_intrinsics([str(path)], 640, 480)


_POSE = look_at((0.5, 0.0, 0.8), (0.5, 0.0, 0.0), (1, 0, 0))
_PARTS = Decomposition(
    [np.random.default_rng(number).uniform(-1, 1, (8, 3)) for number in range(3)],
    MassProperties(1.0, np.zeros(3), np.eye(3)),
    "",
)

KINDS = (
    Kind("config.yaml", _text(yaml.safe_dump(load_config().model_dump(mode="json"))), load_config),
    Kind("colour.png", lambda path: _image(path, "rgb"), read_rgb),
    Kind("colour.jpg", lambda path: _image(path, "rgb"), read_rgb),
    Kind("depth.png", lambda path: _image(path, "depth"), read_depth),
    Kind("depth.tiff", lambda path: _image(path, "metres"), read_depth),
    Kind("depth.npy", lambda path: np.save(path, np.full((12, 16), 0.7, np.float32)), read_depth),
    Kind(
        "intrinsics.json",
        _text({"fx": 615, "fy": 615, "cx": 320, "cy": 240, "width": 640, "height": 480}),
        _read_intrinsics,
    ),
    Kind("pose.json", _text({"T_WC": _POSE.tolist()}), read_pose),
    Kind("pose.yaml", _text(yaml.safe_dump({"T_WC": _POSE.tolist()})), read_pose),
    Kind("pose.txt", lambda path: np.savetxt(path, _POSE), read_pose),
    Kind("pose.npy", lambda path: np.save(path, _POSE), read_pose),
    *(Kind(f"mesh{suffix}", _mesh, read_object) for suffix in (".obj", ".stl", ".ply", ".glb")),
    Kind("object.urdf", _text(URDF), read_object),
    Kind("object.xml", _text(MJCF), read_object),
    Kind("parts.npz", lambda path: _write_parts(path, _PARTS), _read_parts),
    Kind("shard.h5", _shard, _read_shard),
    Kind(
        "network.pt",
        lambda path: save_graspnet(path, create_model(name="ggcnn"), 0.002),
        load_graspnet,
    ),
    Kind("policy.pt", _policy, load_policy),
    Kind("rounds.jsonl", _journal, read_rounds),
    Kind("sample.jsonl", _sample, read_sample),
)
