"""What of a data set trains and what tests, without leaks: by image, by object, in folds.

This module knows indices and the objects' names alone, no images.

Real grasp data in the formats of Cornell and Jacquard.

Both give RGB-D images of one object with labelled grasp rectangles. Whatever is missing or broken
in a folder is a `UserError` that names the file. The data themselves are not part of this project.
This module knows no network and no simulator.

Unlabelled RGB-D photographs of another domain: what a network can be adapted to.

A folder in Cornell's layout; whatever labels lie there are never opened. This module knows no
network and no simulator.
"""

from __future__ import annotations

import re
from abc import abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import ndimage

from utils.errors import UserError, unknown_choice
from utils.images import open_image
from utils.rectangles import GraspRectangle, rectangles_from_corners
from utils.transforms import known_depth


@dataclass(frozen=True)
class Split:
    """Indices into a data set, each list sorted; no index is in both."""

    train: tuple[int, ...]
    test: tuple[int, ...]

    def describe(self, names: Sequence[str]) -> str:
        """Two lines with the counts and every name, to be printed: there is no official split."""
        return "\n".join(
            f"{part} ({len(indices)}): {' '.join(names[i] for i in indices)}"
            for part, indices in (("train", self.train), ("test", self.test))
        )


def image_wise_split(count: int, test_fraction: float, seed: int) -> Split:
    """Images drawn at random: test objects may be known from other images in training."""
    order = np.random.default_rng(seed).permutation(count)
    return _split(count, order[: _test_size(count, test_fraction)])


def object_wise_split(object_ids: Sequence[str], test_fraction: float, seed: int) -> Split:
    """Whole objects drawn at random: no test object is seen in training."""
    objects = np.array(sorted(set(object_ids)))
    drawn = np.random.default_rng(seed).permutation(objects)
    test_objects = set(drawn[: _test_size(len(objects), test_fraction)])
    return _split(len(object_ids), [i for i, o in enumerate(object_ids) if o in test_objects])


def block_folds(object_ids: Sequence[str], folds: int, seed: int | None = None) -> list[Split]:
    """k folds for cross-validation; consecutive images of one object are never torn apart.

    A block is a run of equal object ids. Without a seed the blocks keep their order, so each test
    fold is one stretch of the data set; with a seed they are shuffled first. Fold sizes differ by
    as little as whole blocks in that order allow. An object photographed again later makes a
    second block: where that happens, `object_wise_split` is the stricter one.
    """
    starts = [i for i in range(len(object_ids)) if i == 0 or object_ids[i] != object_ids[i - 1]]
    blocks = np.split(np.arange(len(object_ids)), starts[1:])
    if not 2 <= folds <= len(blocks):
        raise UserError(f"folds: got {folds}, expected 2 to {len(blocks)} (the number of blocks)")
    if seed is not None:
        order = np.random.default_rng(seed).permutation(len(blocks))
        blocks = [blocks[i] for i in order]
    ends = np.cumsum([len(block) for block in blocks])
    cuts = [0]
    for k in range(1, folds):  # the border nearest to k / folds of all images; no fold empty
        low, high = cuts[-1] + 1, len(blocks) - (folds - k)
        nearest = np.abs(ends[low - 1 : high] - k * len(object_ids) / folds).argmin()
        cuts.append(low + int(nearest))
    cuts.append(len(blocks))
    return [_split(len(object_ids), np.concatenate(blocks[a:b])) for a, b in zip(cuts, cuts[1:])]


def object_folds(object_ids: Sequence[str], folds: int, seed: int | None = None) -> list[Split]:
    """k folds for cross-validation by object: those of a test image are in no training image.

    As `block_folds`, but with all images of an object in one block, wherever they stand in the data
    set; objects come in the order in which they first appear.
    """
    first: dict[str, int] = {}
    for index, name in enumerate(object_ids):
        first.setdefault(name, index)
    order = sorted(range(len(object_ids)), key=lambda i: first[object_ids[i]])
    splits = block_folds([object_ids[i] for i in order], folds, seed)
    return [_split(len(order), [order[i] for i in split.test]) for split in splits]


def image_folds(count: int, folds: int, seed: int) -> list[Split]:
    """k folds for cross-validation by image, drawn at random: a test image's object may be known
    from training images. Fold sizes differ by at most one."""
    if not 2 <= folds <= count:
        raise UserError(f"folds: got {folds}, expected 2 to {count} (the number of images)")
    order = np.random.default_rng(seed).permutation(count)
    return [_split(count, test) for test in np.array_split(order, folds)]


def _test_size(count: int, fraction: float) -> int:
    """At least one on either side."""
    if count < 2 or not 0 < fraction < 1:
        raise UserError(f"cannot split {count} items with test fraction {fraction}")
    return min(max(round(count * fraction), 1), count - 1)


def _split(count: int, test: Sequence[int]) -> Split:
    chosen = {int(i) for i in test}
    return Split(tuple(i for i in range(count) if i not in chosen), tuple(sorted(chosen)))


MIN_DEPTH, MAX_DEPTH = 0.3, 10.0  # m: outside, a pixel is a hole; a whole image, a unit error
IMAGES_PER_OBJECT = 4  # Cornell's usual number of consecutive images of one object

# The first image of each object in Cornell's folder 01, seen by eye on the 80 images 100..179
# that this project measures on; used where the data set's own table z.txt is not at hand.
FOLDER_01 = range(100, 180)
OBJECT_STARTS_01 = (
    100, 102, 106, 110, 114, 118, 122, 126, 129, 133, 137, 141, 145, 149, 153, 157, 161, 165, 169,
    173, 177,
)  # fmt: skip

CORNELL_HINT = (
    "; Cornell's archives hold point clouds pcdNNNN.txt from which pcdNNNNd.tiff is made "
    "(float32, metres)"
)


@dataclass(frozen=True, eq=False)
class RealSample:
    """One labelled image.

    name: the image's id. object_id: images with the same one show the same object.
    rgb: (H, W, 3) uint8. depth: (H, W) float32 metres along the optical axis, holes filled.
    positives, negatives: rectangles in pixels of this image; Jacquard has no negatives.
    object_mask: (H, W) bool, the object's pixels, or None where the format has none.
    skipped: rectangles left out because a corner is NaN.
    """

    name: str
    object_id: str
    rgb: np.ndarray
    depth: np.ndarray
    positives: tuple[GraspRectangle, ...]
    negatives: tuple[GraspRectangle, ...] = ()
    object_mask: np.ndarray | None = None
    skipped: int = 0


@dataclass(frozen=True)
class Record:
    """Where one sample lies: its name, its object, and its files by their role's suffix."""

    name: str
    object_id: str
    files: dict[str, Path]


class RealDataset(Sequence[RealSample]):
    """A read-only sequence of samples, read from disk when asked for; order is by name.

    All files are checked to exist when the data set is opened, so training never stops halfway
    for a missing one.
    """

    def __init__(self, root: Path, records: Sequence[Record]) -> None:
        self.root = root
        self.records = tuple(records)

    @property
    def names(self) -> list[str]:
        return [record.name for record in self.records]

    @property
    def object_ids(self) -> list[str]:
        return [record.object_id for record in self.records]

    def __len__(self) -> int:
        return len(self.records)

    def __getitem__(self, index: int) -> RealSample:
        return self.read(self.records[index])

    def __iter__(self) -> Iterator[RealSample]:
        return (self.read(record) for record in self.records)

    @abstractmethod
    def read(self, record: Record) -> RealSample:
        """Read one image; raises UserError naming the file that is at fault."""


class CornellDataset(RealDataset):
    """The Cornell Grasp Dataset: `pcdNNNN` + r.png, d.tiff, cpos.txt, cneg.txt, in any subfolder.

    The object of each image comes from `z.txt` or `processedData/z.txt` under the root (rows of
    image number, object number, description); without it from the table of folder 01, else from
    blocks of `IMAGES_PER_OBJECT` consecutive numbers, a guess whose borders may cut an object.
    """

    SUFFIXES = ("r.png", "d.tiff", "cpos.txt", "cneg.txt")

    def __init__(self, root: str | Path) -> None:
        root = existing_folder(root)
        files = group_files(root, r"pcd(\d{4})(r\.png|d\.tiff|cpos\.txt|cneg\.txt)")
        if not files:
            raise UserError(f"{root}: no Cornell files pcdNNNNr.png found here or in subfolders")
        check_complete(root, files, self.SUFFIXES, "pcd", CORNELL_HINT)
        objects = _cornell_objects(root, [int(name) for name in files])
        super().__init__(
            root, [Record(f"pcd{n}", objects[int(n)], f) for n, f in sorted(files.items())]
        )

    def read(self, record: Record) -> RealSample:
        positives, skipped = _read_cornell_rectangles(record.files["cpos.txt"])
        negatives, also_skipped = _read_cornell_rectangles(record.files["cneg.txt"])
        if not positives:
            raise UserError(f"{record.files['cpos.txt']}: holds no complete rectangle")
        rgb, depth = read_rgbd(record.files["r.png"], record.files["d.tiff"])
        return RealSample(
            record.name, record.object_id, rgb, depth, positives, negatives,
            skipped=skipped + also_skipped,
        )  # fmt: skip


class JacquardDataset(RealDataset):
    """The Jacquard dataset: `<id>` + _RGB.png, _<kind>_depth.tiff, _grasps.txt, _mask.png.

    depth: "perfect" (rendered) or "stereo" (with a simulated sensor's holes). An id is
    `<view>_<object>`: the views of one object share its part after the first underscore.
    """

    def __init__(self, root: str | Path, depth: str = "perfect") -> None:
        if depth not in ("perfect", "stereo"):
            raise unknown_choice("data.depth", depth, ("perfect", "stereo"))
        root = existing_folder(root)
        self.depth_file = f"_{depth}_depth.tiff"
        files = group_files(
            root, r"(.+?)(_RGB\.png|_(?:perfect|stereo)_depth\.tiff|_grasps\.txt|_mask\.png)"
        )
        if not files:
            raise UserError(f"{root}: no Jacquard files <id>_RGB.png found here or in subfolders")
        check_complete(root, files, ("_RGB.png", self.depth_file, "_grasps.txt", "_mask.png"))
        super().__init__(
            root, [Record(n, n.split("_", 1)[-1], f) for n, f in sorted(files.items())]
        )

    def read(self, record: Record) -> RealSample:
        positives = _read_jacquard_rectangles(record.files["_grasps.txt"])
        rgb, depth = read_rgbd(record.files["_RGB.png"], record.files[self.depth_file])
        mask_file = record.files["_mask.png"]
        mask = np.asarray(open_image(mask_file).convert("L")) > 0
        if mask.shape != depth.shape:
            raise UserError(f"{mask_file}: {_size(mask)}, but the colour image is {_size(rgb)}")
        return RealSample(record.name, record.object_id, rgb, depth, positives, object_mask=mask)


def open_real_data(kind: str, root: str | Path, depth: str = "perfect") -> RealDataset:
    """The data set of `data.kind` ("cornell" or "jacquard") under `data.root`.

    depth: Jacquard's depth image, "perfect" or "stereo". Raises UserError for an unknown kind, a
    missing folder, or missing files.
    """
    if kind == "cornell":
        return CornellDataset(root)
    if kind == "jacquard":
        return JacquardDataset(root, depth)
    raise unknown_choice("data.kind", kind, ("cornell", "jacquard"))


# Reading


def fill_depth_holes(depth: np.ndarray) -> np.ndarray:
    """(H, W) float32 metres in which every hole has the depth of the nearest measured pixel.

    A hole is NaN, infinite, or outside MIN_DEPTH..MAX_DEPTH: the 0 or -1 of sensors, and the foot
    of the ramp that inpainting left at the border of Cornell's images. Nearest means Euclidean
    distance in the image; unlike inpainting this never invents a depth that was not measured.
    Raises ValueError where nothing was measured.
    """
    depth = np.asarray(depth, dtype=np.float32)
    hole = ~((depth >= MIN_DEPTH) & (depth <= MAX_DEPTH))  # comparisons with NaN are False
    if hole.all():
        raise ValueError("no pixel has a plausible depth")
    if not hole.any():
        return depth.copy()
    rows, columns = ndimage.distance_transform_edt(
        hole, return_distances=False, return_indices=True
    )
    return depth[rows, columns]


def read_rgbd(rgb_file: Path, depth_file: Path) -> tuple[np.ndarray, np.ndarray]:
    """(H, W, 3) uint8 and (H, W) float32 metres without holes."""
    rgb = np.array(open_image(rgb_file).convert("RGB"))
    depth = np.asarray(open_image(depth_file))
    if depth.ndim != 2:
        raise UserError(f"{depth_file}: need one channel of depth, got shape {depth.shape}")
    if depth.shape != rgb.shape[:2]:
        raise UserError(f"{depth_file}: {_size(depth)}, but {rgb_file.name} is {_size(rgb)}")
    known = depth[known_depth(depth)]
    if known.size == 0:
        raise UserError(f"{depth_file}: every depth is zero, negative or NaN")
    if not MIN_DEPTH <= np.median(known) <= MAX_DEPTH:
        raise UserError(
            f"{depth_file}: median depth {np.median(known):.4g}, expected {MIN_DEPTH} to "
            f"{MAX_DEPTH} metres; is it in millimetres? Store it in metres"
        )
    return rgb, fill_depth_holes(depth)


def _read_cornell_rectangles(file: Path) -> tuple[tuple[GraspRectangle, ...], int]:
    """The rectangles of a cpos or cneg file, four `u v` rows each, and how many had a NaN."""
    rows = _read_numbers(file, 2, None)
    if len(rows) % 4:
        raise UserError(f"{file}: {len(rows)} corner rows, not a multiple of 4; is it cut short?")
    corners = rows.reshape(-1, 4, 2)
    try:
        rectangles = tuple(rectangles_from_corners(corners))
    except ValueError as error:
        raise UserError(f"{file}: {error}") from error
    return rectangles, len(corners) - len(rectangles)


def _read_jacquard_rectangles(file: Path) -> tuple[GraspRectangle, ...]:
    """The rectangles of a grasps file: rows `u;v;theta;opening;jaw size`, pixels and degrees.

    Jacquard's theta already runs from +u towards +v (GG-CNN, whose angles run the other way,
    negates it in `load_from_jacquard_file`).
    """
    rows = _read_numbers(file, 5, ";")
    if len(rows) == 0:
        raise UserError(f"{file}: holds no grasp")
    rectangles = []
    for number, (u, v, theta, opening, jaw) in enumerate(rows, start=1):
        try:
            rectangles.append(
                GraspRectangle(np.array([u, v]), float(np.radians(theta)), opening, jaw)
            )
        except ValueError as error:
            raise UserError(f"{file}: grasp {number}: {error}") from error
    return tuple(rectangles)


def _read_numbers(file: Path, columns: int, separator: str | None) -> np.ndarray:
    """(N, columns) float from a text file; blank lines are skipped, NaN is allowed."""
    rows = []
    try:
        text = file.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{file}: cannot be read as text ({error})") from error
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip():
            continue
        try:
            row = [float(cell) for cell in line.strip().rstrip(";").split(separator)]
        except ValueError as error:
            raise UserError(f"{file}, line {number}: {line.strip()!r}: {error}") from error
        if len(row) != columns:
            raise UserError(f"{file}, line {number}: need {columns} numbers, got {line.strip()!r}")
        rows.append(row)
    return np.array(rows, dtype=float).reshape(-1, columns)


def _size(image: np.ndarray) -> str:
    return f"{image.shape[1]} x {image.shape[0]} px"


# Finding files and objects


def existing_folder(root: str | Path, key: str = "data.root") -> Path:
    """The folder that a config key names; UserError if there is none."""
    root = Path(root).expanduser()
    if not root.is_dir():
        raise UserError(f"{key}: no folder {root}")
    return root


def group_files(root: Path, pattern: str) -> dict[str, dict[str, Path]]:
    """Files under root whose whole name fits (name)(suffix), as {name: {suffix: path}}."""
    groups: dict[str, dict[str, Path]] = {}
    for path in root.rglob("*"):
        fit = re.fullmatch(pattern, path.name)
        if fit is None:
            continue
        known = groups.setdefault(fit[1], {})
        if fit[2] in known:
            raise UserError(f"{path.name} is there twice: {known[fit[2]]} and {path}")
        known[fit[2]] = path
    return groups


def check_complete(
    root: Path,
    groups: dict[str, dict[str, Path]],
    suffixes: Sequence[str],
    prefix: str = "",
    hint: str = "",
) -> None:
    """Raise UserError that names files of `group_files` which some name lacks."""
    missing = [
        f"{prefix}{name}{suffix}"
        for name in sorted(groups)
        for suffix in suffixes
        if suffix not in groups[name]
    ]
    if missing:
        hint = hint if any(name.endswith("d.tiff") for name in missing) else ""
        shown = ", ".join(missing[:5]) + (", ..." if len(missing) > 5 else "")
        raise UserError(f"{root}: {len(missing)} files are missing: {shown}{hint}")


def _cornell_objects(root: Path, numbers: Sequence[int]) -> dict[int, str]:
    """The object of each image number; see `CornellDataset` for where it comes from."""
    for table in (root / "z.txt", root / "processedData" / "z.txt"):
        if table.is_file():
            return _read_object_table(table, numbers)
    objects = {}
    for number in numbers:
        if number in FOLDER_01:
            start = max(s for s in OBJECT_STARTS_01 if s <= number)
            objects[number] = f"from{start:04d}"
        else:
            objects[number] = f"block{number // IMAGES_PER_OBJECT * IMAGES_PER_OBJECT:04d}"
    return objects


def _read_object_table(table: Path, numbers: Sequence[int]) -> dict[int, str]:
    objects = {}
    for line in table.read_text(errors="replace").splitlines():
        cells = line.split()
        if len(cells) >= 2 and cells[0].isdigit():
            objects[int(cells[0])] = f"object{cells[1]}"
    unknown = [number for number in numbers if number not in objects]
    if unknown:
        raise UserError(f"{table}: has no row for image {unknown[0]:04d}")
    return objects


KEY = "adaptation.target"  # the config key that names the folder
SIZE = (640, 480)  # pixels, of a first Kinect: nothing else in the folder tells the camera's scale
FEWEST = 5  # images: some are held out, and statistics of one or two mean nothing


class UnlabelledImages(RealDataset):
    """Pairs `NAMEr.png` (colour) and `NAMEd.tiff` (float32, metres from the robot's base as
    Cornell's are, see `utils.table_plane`) in any subfolder.

    Cornell's names `pcdNNNNr.png` are such names. Raises UserError, when it is opened, if there is
    no such folder, if a file of a pair is missing, if there are fewer than `FEWEST` images, or
    if one is not of `SIZE`. What the depths hold is for others to check (`models.graspnet_adaptation`).
    """

    def __init__(self, root: str | Path) -> None:
        root = existing_folder(root, KEY)
        files = group_files(root, r"(.+)(r\.png|d\.tiff)")
        if not files:
            raise UserError(
                f"{KEY} {root}: no images NAMEr.png with their depth NAMEd.tiff (float32, metres) "
                "found here or in subfolders"
            )
        check_complete(root, files, ("r.png", "d.tiff"), hint=CORNELL_HINT)
        if len(files) < FEWEST:
            raise UserError(
                f"{KEY} {root}: {len(files)} image{'s' * (len(files) > 1)}, expected at least "
                f"{FEWEST}; they stand for a whole domain, so give more"
            )
        for file in (pair["r.png"] for pair in files.values()):
            size = open_image(file).size
            if size != SIZE:
                raise UserError(
                    f"{KEY}: {file} is {size[0]} x {size[1]} px, expected {SIZE[0]} x {SIZE[1]} as "
                    "of Cornell's camera, whose scale is taken for granted"
                )
        super().__init__(root, [Record(name, name, pair) for name, pair in sorted(files.items())])

    def read(self, record: Record) -> RealSample:
        """An image without rectangles."""
        rgb, depth = read_rgbd(record.files["r.png"], record.files["d.tiff"])
        return RealSample(record.name, record.object_id, rgb, depth, positives=())
