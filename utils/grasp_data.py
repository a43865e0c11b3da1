"""Simulated grasp data on disk: HDF5 shards of labelled RGB-D frames, and the data set over them.

A data set is a folder with `config.yaml` and the folders `train` and `validation` of numbered
shards. A shard is written whole or not at all, so every existing shard is complete and an
interrupted generation continues with the missing ones. This module knows no simulator and no
network.
"""

from __future__ import annotations

import io
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import torch
from torch.utils.data import Dataset

from utils.atomic_files import write_atomic
from utils.augmentation import LabelledImage
from utils.errors import UserError, one_line
from utils.grasp_labels import GraspLabels, Trial
from utils.transforms import RGBDFrame, project

# Raise it with every change of the files' format or of the code that makes scenes, images, labels.
FORMAT_VERSION = 2
_DEPTH_UNIT = 5e-5  # metres; 16 bits reach 3.2 m
_QUALITY_UNIT = 1 / 255
_MOST_OPEN = 64  # shards of a reading process; systems allow some hundreds of files


@dataclass(frozen=True)
class LabelledFrame:
    """One frame with its dense labels. scene: "pile random_urdfs 17" (layout, objects, seed)."""

    frame: RGBDFrame
    labels: GraspLabels
    scene: str


def shard_path(folder: Path, split: str, number: int) -> Path:
    return Path(folder) / split / f"{number:05d}.h5"


def write_shard(
    path: Path, frames: Sequence[LabelledFrame], trials: Sequence[Trial], max_width: float
) -> None:
    """Write labelled frames, and the label trials made on them, as one HDF5 file.

    max_width: metres, the gripper's widest opening; no label is wider. Depth, quality and width are
    stored as whole numbers of their attribute `unit`, the width in 255 steps; `instance` is the
    number of the object at each pixel, -1 for none, and `centres` holds the objects' centres of
    mass in W. The frames must carry segmentation and truth, of scenes from which no object was
    retired: only then do both number the objects in the same way. Depths that 16 bits do not hold,
    over 3.2 m, are cut off there.
    """
    units = {"depth": _DEPTH_UNIT, "quality": _QUALITY_UNIT, "width": max_width / 255}
    stacked = {
        "rgb": np.stack([f.frame.rgb for f in frames]),
        "depth": _whole([f.frame.depth for f in frames], _DEPTH_UNIT, np.uint16),
        "quality": _whole([f.labels.quality for f in frames], _QUALITY_UNIT, np.uint8),
        "width": _whole([f.labels.width for f in frames], units["width"], np.uint8),
        "valid": np.stack([f.labels.valid for f in frames]),
        "instance": np.stack([np.maximum(f.frame.segmentation, -1) for f in frames]).astype(
            np.int8
        ),
    }
    most = max(len(f.frame.truth.objects) for f in frames)
    centres = np.full((len(frames), most, 3), np.nan)  # scenes differ in their number of objects
    for row, f in zip(centres, frames):
        for number, thing in enumerate(f.frame.truth.objects):
            row[number] = thing.centre_of_mass
    buffer = io.BytesIO()
    tables = {
        "K": np.stack([f.frame.K for f in frames]),
        "T_WC": np.stack([f.frame.T_WC for f in frames]),
        "centres": centres,
        "trials": np.array([(t.quality, t.weight, t.success) for t in trials], float).reshape(
            -1, 3
        ),
    }
    # Checksums of all numbers, and by this version of the format of all that describes them.
    with h5py.File(buffer, "w", libver=("v110", "v110")) as file:
        file.attrs["format_version"] = FORMAT_VERSION
        for name, values in stacked.items():
            # One chunk a frame: frames are read singly and at random.
            data = file.create_dataset(
                name, data=values, chunks=(1, *values.shape[1:]), compression="lzf", shuffle=True,
                fletcher32=True,
            )  # fmt: skip
            if name in units:
                data.attrs["unit"] = units[name]
        for name, values in tables.items():
            file.create_dataset(name, data=values, chunks=True, fletcher32=True)
        file["scene"] = [f.scene for f in frames]
    write_atomic(path, buffer.getvalue())


def _whole(values: Sequence[np.ndarray], unit: float, kind: type) -> np.ndarray:
    scaled = np.rint(np.stack(values) / unit)
    return np.clip(scaled, 0, np.iinfo(kind).max).astype(kind)


def read_trials(folder: Path) -> list[list[Trial]]:
    """Read all label trials on a data set's training images, those of each shard, which holds whole
    scenes."""
    trials = []
    for path in sorted((Path(folder) / "train").glob("*.h5")):
        with _open(path) as file, _reading(path):
            trials.append([Trial(float(q), float(w), bool(s)) for q, w, s in file["trials"][:]])
    return trials


class SimulatedDataset(Dataset):
    """The labelled frames of one split as `LabelledImage`s, read one at a time.

    frames: the largest number of frames; None for all. cameras: K (3, 3) and T_WC (4, 4) of each
    frame. scenes: the scene of each frame, e.g. "pile random_urdfs 17": layout, object set, seed.
    Raises UserError if there is no shard, or if one is damaged or of another format.
    """

    def __init__(self, folder: Path, split: str, frames: int | None = None):
        self.folder = Path(folder) / split
        self.paths = sorted(self.folder.glob("*.h5"))
        if not self.paths:
            raise UserError(f"{self.folder}: no .h5 shards; generate the data first")
        self._place: list[tuple[int, int]] = []  # (shard, frame) of every index
        self.cameras: list[tuple[np.ndarray, np.ndarray]] = []
        self.scenes: list[str] = []
        for shard, path in enumerate(self.paths):
            with _open(path) as file, _reading(path):
                self._place += [(shard, i) for i in range(len(file["depth"]))]
                self.cameras += zip(file["K"][:], file["T_WC"][:])
                self.scenes += list(file["scene"].asstr()[:])
        self._length = min(len(self._place), frames or len(self._place))
        self._files: dict[int, h5py.File] = {}

    def __len__(self) -> int:
        return self._length

    def __getitem__(self, index: int) -> LabelledImage:
        if not 0 <= index < len(self):
            raise IndexError(index)
        with _reading(self.paths[self._place[index][0]]):  # it may have been damaged since
            return self._read(index)

    def _read(self, index: int) -> LabelledImage:
        file, i = self._at(index)
        return LabelledImage(
            rgb=torch.from_numpy(np.moveaxis(file["rgb"][i], -1, 0).copy()),
            depth=torch.from_numpy(file["depth"][i].astype(np.float32) * np.float32(_DEPTH_UNIT)),
            quality=torch.from_numpy(file["quality"][i] * np.float32(_QUALITY_UNIT)),
            width=torch.from_numpy(file["width"][i] * np.float32(file["width"].attrs["unit"])),
            mask=torch.from_numpy(file["valid"][i]),
            centre=torch.from_numpy(self._centre(index, file["instance"][i], file["centres"][i])),
        )

    def _centre(self, index: int, instance: np.ndarray, centres: np.ndarray) -> np.ndarray:
        """Return (2, H, W) the pixel of the object's centre of mass; NaN where there is none."""
        K, T_WC = self.cameras[index]
        if not -1 <= instance.min() <= instance.max() < len(centres):
            raise ValueError("instance names objects without a centre")
        pixels, _ = project(centres, K, T_WC)
        no_object = np.full((1, 2), np.nan)
        return np.moveaxis(np.vstack([pixels, no_object])[instance], -1, 0).astype(np.float32)

    def table_distance(self, index: int) -> float:
        """Return the distance from the camera to the table (z = 0) along the optical axis, m."""
        _, T_WC = self.cameras[index]
        return float(-T_WC[2, 3] / T_WC[2, 2])

    def _at(self, index: int) -> tuple[h5py.File, int]:
        shard, i = self._place[index]
        if shard not in self._files:  # opened by the process that reads, never inherited
            if len(self._files) == _MOST_OPEN:
                self._files.pop(next(iter(self._files))).close()
            self._files[shard] = _open(self.paths[shard])
        return self._files[shard], i

    def __getstate__(self) -> dict:
        return self.__dict__ | {"_files": {}}


# Numbers of dimensions and kinds of numbers of what a shard holds.
_CONTENT = {
    "rgb": (4, "u1"), "depth": (3, "u2"), "quality": (4, "u1"), "width": (4, "u1"),
    "valid": (3, "b1"), "instance": (3, "i1"), "K": (3, "f8"), "T_WC": (3, "f8"),
    "centres": (3, "f8"), "scene": (1, "O"), "trials": (2, "f8"),
}  # fmt: skip
_IMAGES = ("rgb", "depth", "quality", "width", "valid", "instance")
_LARGEST_SIDE = 4096  # pixels, as of the config's cameras
_MOST_COMPRESSED = 100  # times: LZF writes 3 bytes for at most 264


def _open(path: Path) -> h5py.File:
    with _reading(path):
        file = h5py.File(path, "r")
        version = file.attrs["format_version"]
        if version == FORMAT_VERSION:
            _check_content(file, path.stat().st_size)
    if version != FORMAT_VERSION:
        raise UserError(
            f"{path}: data format version {version}, this program reads {FORMAT_VERSION}; "
            "delete the data set's folder, and it is made again"
        )
    return file


@contextmanager
def _reading(path: Path) -> Iterator[None]:
    """Within this context the errors of HDF5 and of contents that make no sense are UserErrors."""
    try:
        yield
    except UserError:
        raise
    except (OSError, KeyError, RuntimeError, ValueError, TypeError, AttributeError) as error:
        # Only the operating system sets a number: the file's content is not to blame.
        if getattr(error, "errno", None) is not None:
            raise UserError(f"{path}: cannot be read ({os.strerror(error.errno)})") from error
        raise UserError(
            f"{path}: not a readable data shard ({one_line(error)}); delete it, and it is made "
            "again"
        ) from error


def _check_content(file: h5py.File, size: int) -> None:
    """Raise ValueError for entries that `write_shard` would not have written: of other shapes or
    types, larger than a file of `size` bytes can hold, or in other files."""
    frames, *sides = file["depth"].shape
    bins = file["quality"].shape[1]
    if not (0 < frames <= size and len(sides) == 2 and 0 < max(*sides, bins) <= _LARGEST_SIDE):
        raise ValueError(f"depth has the shape {file['depth'].shape}")
    shapes = dict.fromkeys(_IMAGES, (frames, *sides)) | {
        "rgb": (frames, *sides, 3), "quality": (frames, bins, *sides),
        "width": (frames, bins, *sides), "K": (frames, 3, 3), "T_WC": (frames, 4, 4),
        "scene": (frames,),
    }  # fmt: skip
    for name, (dimensions, kind) in _CONTENT.items():
        here = isinstance(file.get(name, getlink=True), h5py.HardLink)
        data = file[name]
        if not here or not isinstance(data, h5py.Dataset) or data.is_virtual or data.external:
            raise ValueError(f"{name} is in another file")
        wrong = data.ndim != dimensions or data.dtype != kind
        if wrong or data.shape != shapes.get(name, data.shape):
            raise ValueError(f"{name} is {data.dtype} of the shape {data.shape}")
        if data.nbytes > size * (_MOST_COMPRESSED if name in _IMAGES else 1):
            raise ValueError(f"{name} is larger than the file can hold")
    if file["centres"].shape[::2] != (frames, 3) or file["trials"].shape[1] != 3:
        raise ValueError("centres or trials have other shapes")
    if not 0 < file["width"].attrs["unit"] < 1:
        raise ValueError("width has no unit")
