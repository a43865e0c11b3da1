"""Real RGB-D images from disk: Cornell and Jacquard with labelled rectangles, and unlabelled ones.

A missing or broken file is a `UserError` that names the file. A new format is a `RealDataset` in
this file and an entry in `FORMATS`, whose names `data.kind` accepts: the data set, the view of its
camera and the size of a training example. The data themselves are not part of this project. This
module knows no network and no simulator.
"""

from __future__ import annotations

import os
import re
import warnings
from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import ndimage

from utils.errors import UserError, unknown_choice
from utils.images import open_image
from utils.rectangles import GraspRectangle, RealSample, View, rectangles_from_corners
from utils.transforms import known_depth

MIN_DEPTH, MAX_DEPTH = 0.3, 10.0  # m: outside, a pixel is a hole; a whole image, a unit error
IMAGES_PER_OBJECT = 4  # Cornell's usual number of consecutive images of one object

# The first image of each object in Cornell's folder 01, found by eye on the 80 images 100..179
# that this project measures on; used where the data set's own table z.txt is missing.
FOLDER_01 = range(100, 180)
OBJECT_STARTS_01 = (
    100, 102, 106, 110, 114, 118, 122, 126, 129, 133, 137, 141, 145, 149, 153, 157, 161, 165, 169,
    173, 177,
)  # fmt: skip

CORNELL_HINT = (
    "; Cornell's archives hold point clouds pcdNNNN.txt from which pcdNNNNd.tiff is made "
    "(float32, metres)"
)


@dataclass(frozen=True)
class Record:
    """The files of one sample, by the suffixes of their names, with its name and its object."""

    name: str
    object_id: str
    files: dict[str, Path]


class RealDataset(Sequence[RealSample]):
    """A read-only sequence of samples in the order of their names, read from disk on access.

    Opening the data set checks that all files exist, so that no missing file stops a training
    halfway.
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
        """Read one image; raises UserError naming a broken file."""


class CornellDataset(RealDataset):
    """The Cornell Grasp Dataset: `pcdNNNN` + r.png, d.tiff, cpos.txt, cneg.txt, in any subfolder.

    The object of each image comes from `z.txt` or `processedData/z.txt` under the root (rows of
    image number, object number, description); without it from the table of folder 01, else from
    blocks of `IMAGES_PER_OBJECT` consecutive numbers, a guess whose borders may cut an object; a
    warning tells of it.
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
    """The Jacquard dataset: `<id>` + _RGB.png, _perfect_depth.tiff (rendered), _grasps.txt.

    An id is `<view>_<object>`: the views of one object share its part after the first underscore.
    The depth images with a simulated sensor's holes, _stereo_depth.tiff, are not read.
    """

    def __init__(self, root: str | Path) -> None:
        root = existing_folder(root)
        files = group_files(root, r"(.+?)(_RGB\.png|_perfect_depth\.tiff|_grasps\.txt)")
        if not files:
            raise UserError(f"{root}: no Jacquard files <id>_RGB.png found here or in subfolders")
        check_complete(root, files, ("_RGB.png", "_perfect_depth.tiff", "_grasps.txt"))
        super().__init__(
            root, [Record(n, n.split("_", 1)[-1], f) for n, f in sorted(files.items())]
        )

    def read(self, record: Record) -> RealSample:
        positives = _read_jacquard_rectangles(record.files["_grasps.txt"])
        rgb, depth = read_rgbd(record.files["_RGB.png"], record.files["_perfect_depth.tiff"])
        return RealSample(record.name, record.object_id, rgb, depth, positives)


@dataclass(frozen=True)
class RealFormat:
    """A format of real data with labels.

    open: makes the data set of a folder. size: (rows, columns) of its images. view: what a network
    sees of them. crop: side of a training example, pixels of the view.
    """

    open: Callable[[str | Path], RealDataset]
    size: tuple[int, int]
    view: View
    crop: int


FORMATS = {
    # The table, which fills the middle of the image, seen 45 degrees from above. A first Kinect
    # (525 px focal length) at a median 1.2 m; at three fifths of its resolution the network sees
    # all of a cereal box at once.
    "cornell": RealFormat(
        CornellDataset,
        (480, 640),
        View(side=400, size=240, metres_per_pixel=1.2 / 525 * 400 / 240, slanted=True),
        crop=128,
    ),
    # The whole image, as small as GG-CNN and GR-ConvNet take it. Its objects have no true size
    # (ShapeNet's are scaled at random): a pixel is taken to span what one of Cornell does.
    "jacquard": RealFormat(
        JacquardDataset,
        (1024, 1024),
        View(side=1024, size=300, metres_per_pixel=1.2 / 525 * 400 / 300),
        crop=160,
    ),
}


def open_real_data(kind: str, root: str | Path | None) -> RealDataset:
    """Open the data set of format `kind` in the folder `root`.

    Raises UserError for an unknown format, no folder, a missing one, or missing files.
    """
    if kind not in FORMATS:
        raise unknown_choice("data.kind", kind, FORMATS)
    if root is None:
        raise UserError(
            f"data.root: data.kind={kind} needs the folder that holds the data set: add "
            f"data.root=path/to/{kind}"
        )
    return FORMATS[kind].open(root)


# --- Reading files --------------------------------------------------------------------------


def fill_depth_holes(depth: np.ndarray) -> np.ndarray:
    """Return depth (H, W) float32 metres in which every hole has the nearest measured depth.

    A hole is NaN, infinite, or outside MIN_DEPTH..MAX_DEPTH: the 0 or -1 of sensors, and the foot
    of the ramp that inpainting left at the border of Cornell's images. Nearest means Euclidean
    distance in the image, exactly (`utils.depth_holes.fill_holes` is faster and approximates it);
    unlike inpainting this never invents a depth that was not measured. Raises ValueError if no
    pixel was measured.
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
    """Read colour (H, W, 3) uint8 and depth (H, W) float32 metres, whose holes are filled."""
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
    """Read a cpos or cneg file, four `u v` rows a rectangle; returns the rectangles, and how many
    more have a NaN."""
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
    """Read a grasps file: rows `u;v;theta;opening;jaw size` in pixels and degrees.

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
    """Read a text file as (N, columns) float; blank lines are skipped, NaN is allowed."""
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


# --- Finding files and objects --------------------------------------------------------------


def existing_folder(root: str | Path, key: str = "data.root") -> Path:
    """Return the folder that a config key names; raises UserError if it does not exist."""
    root = Path(os.path.expanduser(root))
    if not root.is_dir():
        raise UserError(f"{key}: no folder {root}")
    return root


def group_files(root: Path, pattern: str) -> dict[str, dict[str, Path]]:
    """Return the files under root whose names match (name)(suffix), as {name: {suffix: path}}."""
    groups: dict[str, dict[str, Path]] = {}
    for path in sorted(root.rglob("*")):
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
    """Raise UserError, naming the missing files, if a group of `group_files` lacks a suffix."""
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
    """Return the object of each image number; `CornellDataset` describes the sources."""
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
    if set(numbers) != set(FOLDER_01):
        warnings.warn(
            f"{root}: no z.txt tells which images show the same object; 100 to 179 were taken for "
            f"those of Cornell's folder 01, of others each {IMAGES_PER_OBJECT} numbers for one "
            "object. Where that is wrong, folds by object share objects: write z.txt, a row of "
            "image number, object number and description for each image",
            stacklevel=2,
        )
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


# --- Unlabelled photographs -----------------------------------------------------------------

KEY = "adaptation.target"  # the config key that names the folder
SIZE = (640, 480)  # pixels, of a first Kinect: the folder does not hold the camera's scale
FEWEST = 5  # images: some are held out, and statistics of one or two mean nothing


class UnlabelledImages(RealDataset):
    """Unlabelled photographs of another domain, to which a network can be adapted.

    They are pairs `NAMEr.png` (colour) and `NAMEd.tiff` (float32, metres from the robot's base as
    Cornell's are, see `utils.table_plane`) in any subfolder, such as Cornell's `pcdNNNNr.png`;
    labels beside them are never opened. Opening raises UserError if the folder or a file of a pair
    is missing, if there are fewer than `FEWEST` images, or if one is not of `SIZE`.
    `models.graspnet_adaptation` checks that the files hold distances.
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
        """Read an image without rectangles."""
        rgb, depth = read_rgbd(record.files["r.png"], record.files["d.tiff"])
        return RealSample(record.name, record.object_id, rgb, depth, positives=())
