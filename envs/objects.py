"""Object sets: the objects to be grasped, by name, from a folder of files, or from a plug-in.

`OBJECT_SETS` lists the named sets; `load_object_set` also takes a folder of files or an import
path. `envs.object_bodies` makes the single objects. This module knows neither robot nor scene, and
no file format.
"""

from __future__ import annotations

import copy
import os
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from tqdm import tqdm

from envs.cell_layout import ObjectModel
from envs.object_bodies import compound_object, load_object, native_object
from envs.object_files import DEFAULT_DENSITY, files_of, object_files
from envs.object_meshes import ObjectError
from envs.object_primitives import (
    FAMILIES,
    FLAT_FAMILIES,
    HOUSEHOLD_FAMILIES,
    ROUNDED_FAMILIES,
    TALL_FAMILIES,
    THIN_FAMILIES,
    UNSEEN_FAMILIES,
    NativeShape,
    make_primitive,
)
from envs.pybullet_files import data_folder
from models.graspable import is_graspable
from utils.config import Config
from utils.config_types import AUTO
from utils.errors import UserError, did_you_mean, one_line
from utils.executor import Workers, completed
from utils.geometry import GripperGeometry
from utils.plugins import is_import_path, load_plugin

_REASONS = 3  # of files that cannot be used, which an error tells

# Numbers of the first object of each split, and the end, in large and in small sets.
LARGE = {"train": 0, "test": 900, "sealed": 1000, "end": 1100}
SMALL = {"train": 0, "test": 200, "sealed": 250, "end": 300}
# The families and the splits of each procedural set besides `primitives`.
SPECIAL = {
    "thin": (THIN_FAMILIES, SMALL), "tall": (TALL_FAMILIES, SMALL), "flat": (FLAT_FAMILIES, SMALL),
    "household": (HOUSEHOLD_FAMILIES, LARGE), "rounded": (ROUNDED_FAMILIES, LARGE),
}  # fmt: skip
PRIMITIVES_UNSEEN = 100
BROKEN_RANDOM_URDFS = (168,)  # its OBJ holds vertices that are not numbers
RANDOM_URDFS_SCALE = 0.65  # at 1.0, 92 % of them are too wide for the Panda hand when lying flat
LARGEST_EXTENT = 0.5  # m, of an object that a hand could take at all
SCALES = 0.1, 10.0  # of the sets whose sizes are known: things from 3 mm to 3 m

Split = Literal["train", "test", "sealed", "unseen_families"]


class ObjectSet(ABC, Sequence[ObjectModel]):
    """A sequence of objects, each made when first asked for and then kept in memory."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.told = False  # whether the user has been told the notes, by another process
        self._models: dict[int, ObjectModel] = {}
        self._order: list[int] | None = None
        self._notes: dict[str, str] = {}  # a sentence for each kind of remark
        self._said: set[str] = set()  # the kinds that the user has been told

    @property
    def notes(self) -> dict[str, str]:
        """What the user should know of the objects made so far: a sentence for each kind of
        remark."""
        return self._notes

    @abstractmethod
    def __len__(self) -> int: ...

    @abstractmethod
    def _build(self, index: int) -> ObjectModel:
        """Make the object; raises ObjectError if it cannot be made."""

    def part(self, indices: Sequence[int]) -> ObjectSet:
        """The objects of these numbers alone; nothing takes their place that is not among them."""
        return ObjectPart(self, indices)

    def shape_name(self, index: int) -> Hashable:
        """What objects of the same shape have in common, so that all go to one split."""
        return index

    def sources(self) -> set[Path]:
        """The files that the objects are read from (`envs.object_files.files_of`); none where they
        are computed."""
        return set()

    def by_width(self, widest: float) -> list[int]:
        """Numbers of the objects that are at most `widest` metres wide where they are narrowest,
        the narrowest first. The first call makes all objects."""
        if self._order is None:
            self._order = sorted(range(len(self)), key=lambda index: self[index].narrowest)
        return [index for index in self._order if self[index].narrowest <= widest]

    def __getitem__(self, index: int) -> ObjectModel:
        index = range(len(self))[index]  # negative indices, and IndexError past the end
        if index not in self._models:
            self.keep(index, self._build(index), self._notes)
        return self._models[index]

    def keep(self, index: int, model: ObjectModel, notes: dict[str, str]) -> None:
        """Take an object that a copy of this set has made, with the copy's notes."""
        self._models[index] = model
        self._notes = notes | self._notes
        for kind in [] if self.told else [kind for kind in self._notes if kind not in self._said]:
            self._said.add(kind)
            warnings.warn(self._notes[kind], stacklevel=3)


class ObjectPart(ObjectSet):
    """Some objects of a set, given by their numbers there."""

    def __init__(self, whole: ObjectSet, indices: Sequence[int]) -> None:
        super().__init__(whole.name)
        self._whole, self._indices = whole, tuple(indices)

    def __len__(self) -> int:
        return len(self._indices)

    def part(self, indices: Sequence[int]) -> ObjectSet:
        return self._whole.part([self._indices[index] for index in indices])

    def shape_name(self, index: int) -> Hashable:
        return self._whole.shape_name(self._indices[index])

    def sources(self) -> set[Path]:
        return self._whole.sources()

    def _build(self, index: int) -> ObjectModel:
        return self._whole[self._indices[index]]


@dataclass(frozen=True)
class SetSettings:
    """What an object set is made with; `load_object_set` describes each field."""

    split: Split
    scale: float | None
    fit: float | None
    density: float
    max_opening: float
    cache_dir: Path
    skip_broken: bool = False


def load_object_set(
    name_or_path: str,
    *,
    split: Split = "test",
    scale: float | None = None,
    fit: float | None = None,
    density: float = DEFAULT_DENSITY,
    max_opening: float = GripperGeometry().max_opening,
    cache_dir: str | Path,
    skip_broken: bool = False,
) -> ObjectSet:
    """A set of `OBJECT_SETS`, the URDF, MJCF and mesh files below a folder (in metres), or a
    plug-in.

    name_or_path: a name, a folder, or an import path `module:name` of an `ObjectSet`, of a folder's
        path, or of a function that takes `SetSettings` and returns one of the two.
    split: of the procedural sets and `random_urdfs`; `box` and folders hold the same objects in
        each.
        sealed: others, for the published tables alone; of `random_urdfs` the test objects.
        unseen_families: 100 objects of `primitives` of four families that the others do not have.
    scale: factor on all lengths; None for 1, or 0.65 for `random_urdfs`. 0.1 to 10 for the other
        named sets.
    fit: in place of `scale`, rescale each object of `random_urdfs` or of a folder so that the
        second longest side of its oriented bounding box has this many metres.
    density: kg/m3 of those objects of a folder whose file states no mass; `box` and the procedural
        sets have their own. No object weighs less than 0.02 kg.
    max_opening: m, of the gripper; a warning names the first object of a folder that is far too
        large for it.
    cache_dir: where convex parts are kept.
    skip_broken: of a folder, let another file take the place of one that cannot be used (in a part
        of the set, one of the same part); a warning names it.
    Raises UserError for an unknown name, a missing or empty folder, a plug-in that cannot be used,
    a split or number that is not allowed; a broken mesh raises it when its object is asked for.
    """
    if split not in get_args(Split):
        raise ObjectError(f"objects.split is {split!r}; allowed are {', '.join(get_args(Split))}")
    for key, value in {"scale": scale, "fit": fit, "density": density}.items():
        if value is not None and not (np.isfinite(value) and value > 0):
            raise ObjectError(f"objects.{key} is {value}; it must be a number above 0")
    if scale is not None and fit is not None:
        raise ObjectError(
            f"objects.scale={scale:g} and objects.fit={fit:g}: each sets the size; leave out one"
        )
    settings = SetSettings(split, scale, fit, density, max_opening, Path(cache_dir), skip_broken)
    check_object_set(name_or_path, "objects")
    if name_or_path in OBJECT_SETS:
        return OBJECT_SETS[name_or_path](settings)
    if is_folder(name_or_path):
        return _folder(Path(name_or_path), settings)
    return _plugin(name_or_path, settings)


def load_objects(name: str, config: Config, split: Split | None = None) -> ObjectSet:
    """`load_object_set` with a config's settings. split: None for the config's."""
    settings = config.objects.model_dump() | ({} if split is None else {"split": split})
    return load_object_set(
        name, max_opening=config.gripper.max_opening, cache_dir=config.cache_folder, **settings
    )


def check_object_set(name_or_path: str, where: str) -> None:
    """Raise UserError for what `load_object_set` does not know; `where` is the config's key."""
    if name_or_path in OBJECT_SETS or is_folder(name_or_path):
        return
    if is_import_path(name_or_path):
        found = load_plugin(name_or_path, where, must_be_callable=False)
        if not (callable(found) or isinstance(found, ObjectSet) or is_folder(found)):
            raise _no_objects(name_or_path, found, where)
        return
    # A config's lists of sets know `auto`, too, which the config answers itself.
    known = (AUTO, *OBJECT_SETS) if where.endswith(".object_sets") else tuple(OBJECT_SETS)
    raise ObjectError(
        f"{where}: got {name_or_path!r}, expected one of {', '.join(known)}, an existing "
        f"folder or an import path module:name{did_you_mean(name_or_path, known)}"
    )


def _folder(folder: Path, settings: SetSettings) -> ObjectSet:
    folder = Path(os.path.expanduser(folder))
    files = object_files(folder, settings.skip_broken)
    return FileSet(folder.resolve().name, files, settings.scale or 1.0, settings)


def _plugin(path: str, settings: SetSettings) -> ObjectSet:
    found = load_plugin(path, "objects", must_be_callable=False)
    if callable(found):
        try:
            found = found(settings)
        except UserError:
            raise
        except Exception as error:  # whatever the plug-in raises is its author's to fix
            raise ObjectError(
                f"objects: {path!r} raised {type(error).__name__}: {one_line(error)}"
            ) from error
    if isinstance(found, ObjectSet):
        return found
    if is_folder(found):
        return _folder(Path(found), settings)
    raise _no_objects(path, found, "objects")


def is_folder(found: object) -> bool:
    """Whether what names a set of objects is the path of a folder, which may begin with ~."""
    # Unlike pathlib's, these leave the home folder of a user that is not known, and names that are
    # too long for a file.
    return isinstance(found, str | Path) and os.path.isdir(os.path.expanduser(found))


def _no_objects(path: str, found: object, where: str) -> ObjectError:
    return ObjectError(
        f"{where}: {path!r} gives {found!r:.80}, expected an envs.objects.ObjectSet or the path of "
        "an existing folder"
    )


def prepare(objects: ObjectSet, workers: Workers, gripper: GripperGeometry) -> None:
    """Make every object of a set, in parallel, so that the cache holds it. One remark names those
    that do not fit the gripper."""
    # A set of their own for the workers: a thread pickles it while this one keeps what they made.
    make, indices = partial(_make, copy.deepcopy(objects), gripper), range(len(objects))
    made: Iterable[tuple[int, ObjectModel, bool, dict[str, str]]]
    if min(workers.size(), len(objects)) > 1:
        made = completed(workers, make, indices)
    else:  # no process has to be started
        made = map(make, indices)
    unfit = {}
    with tqdm(total=len(objects), desc=f"objects {objects.name}") as progress:
        for index, model, fitting, notes in made:
            objects.keep(index, model, notes)
            progress.set_postfix_str(model.name, refresh=False)
            progress.update()
            if not fitting:
                unfit[index] = model.name
    if unfit:
        names = ", ".join(unfit[index] for index in sorted(unfit))
        warnings.warn(
            f"{len(unfit)} of {len(objects)} objects of {objects.name} are too large or too small "
            f"for a hand that opens {gripper.max_opening} m and comes from straight above, however "
            f"they lie: {names}; tables also give the rates without them",
            stacklevel=2,
        )


def _make(
    objects: ObjectSet, gripper: GripperGeometry, index: int
) -> tuple[int, ObjectModel, bool, dict[str, str]]:
    model = objects._build(index)
    return index, model, fits(model, gripper), objects.notes


@lru_cache(maxsize=1024)
def fits(model: ObjectModel, gripper: GripperGeometry) -> bool:
    """Whether the gripper can take an object in a pose in which it can rest on the table
    (`models.graspable`). The answer is kept: it takes about 0.05 s."""
    return bool(model.extents.max() <= LARGEST_EXTENT) and is_graspable(
        model.geometry(), model.friction, gripper
    )


# --- the sets -------------------------------------------------------------------------------


class BoxSet(ObjectSet):
    """The tutorial's red cube: half extent 0.03 m, 0.1 kg."""

    def __init__(self, settings: SetSettings) -> None:
        _check_size("box", settings)
        super().__init__("box")
        self.scale = settings.scale or 1.0

    def __len__(self) -> int:
        return 1

    def _build(self, index: int) -> ObjectModel:
        side = 0.06 * self.scale
        color = (1.0, 0.2, 0.2, 1.0)
        return native_object("cube", NativeShape("box", (side,) * 3), 0.1 / side**3, 0.5, color)


class PrimitiveSet(ObjectSet):
    """Procedural solids of `envs.object_primitives`: of `primitives`, or of an entry of SPECIAL,
    those for training, for tests, or for the published tables alone; of `primitives` also 100 of
    the families that no training sees."""

    def __init__(self, settings: SetSettings, name: str = "primitives") -> None:
        _check_size(name, settings)
        super().__init__(name)
        unseen = settings.split == "unseen_families"
        families, first = SPECIAL.get(name, (FAMILIES, LARGE))
        if unseen and name in SPECIAL:
            raise ObjectError(
                f"objects.split=unseen_families: training may see all families of {name}; use "
                "primitives, or objects.split=test"
            )
        self.indices = {
            "train": range(first["train"], first["test"]),
            "test": range(first["test"], first["sealed"]),
            "sealed": range(first["sealed"], first["end"]),
            "unseen_families": range(PRIMITIVES_UNSEEN),
        }[settings.split]
        self.families = UNSEEN_FAMILIES if unseen else families
        self.scale, self.cache_dir = settings.scale or 1.0, settings.cache_dir

    def __len__(self) -> int:
        return len(self.indices)

    def _build(self, index: int) -> ObjectModel:
        shape = make_primitive(self.indices[index], self.scale, self.families)
        if shape.native is not None:
            return native_object(
                shape.name, shape.native, shape.density, shape.friction, shape.color
            )
        return compound_object(shape, self.cache_dir)


class FileSet(ObjectSet):
    """URDF, MJCF and mesh files, one object each. scale: factor on their lengths, in place of the
    settings' own. any_mass: as in `load_object`."""

    def __init__(
        self,
        name: str,
        files: Sequence[Path],
        scale: float,
        settings: SetSettings,
        any_mass: bool = False,
    ) -> None:
        super().__init__(name)
        self.files, self.scale, self.any_mass = tuple(files), scale, any_mass
        self.fit, self.density = settings.fit, settings.density
        self.max_opening, self.cache_dir = settings.max_opening, settings.cache_dir
        self.skip_broken, self.is_part = settings.skip_broken, False

    def __len__(self) -> int:
        return len(self.files)

    def part(self, indices: Sequence[int]) -> FileSet:
        """So that another file of the part, and none of the others, takes a broken one's place."""
        part = copy.copy(self)  # what the user has been told is one for all parts
        part.files, part.is_part = tuple(self.files[index] for index in indices), True
        part._models, part._order, part._notes = {}, None, dict(self._notes)
        return part

    def shape_name(self, index: int) -> Hashable:
        return self.files[index].resolve().with_suffix("")  # as of bowl.obj and bowl.stl

    def sources(self) -> set[Path]:
        return set().union(*map(files_of, self.files))

    def _build(self, index: int) -> ObjectModel:
        reasons = []
        for path in (*self.files[index:], *self.files[:index]):
            try:
                return self._load(path)
            except ObjectError as error:
                if not self.skip_broken:
                    raise
                self._notes[str(path)] = f"objects.skip_broken leaves out a file: {error}"
                reasons.append(str(error))
        more = len(reasons) - _REASONS
        raise ObjectError(
            f"objects {self.name}: none of {len(self.files)} files "
            f"{'of a part (training or validation) ' * self.is_part}can be used: "
            + "; ".join([*reasons[:_REASONS], *([f"and {more} more"] if more > 0 else [])])
        )

    def _load(self, path: Path) -> ObjectModel:
        model = load_object(
            path, scale=self.scale, fit=self.fit, density=self.density,
            any_mass=self.any_mass, cache_dir=self.cache_dir,
        )  # fmt: skip
        for remark in model.remarks:
            self._notes.setdefault(remark, f"object {path}: {remark} (and so may others)")
        if model.extents.max() > LARGEST_EXTENT:
            sides = " x ".join(f"{side:.3g}" for side in model.extents)
            self._notes.setdefault(
                "too large",
                f"object {path} measures {sides} m, too large for a hand that opens "
                f"{self.max_opening} m (and so may others be); set objects.fit, for example to "
                "0.06, or objects.scale",
            )
        return model


def _random_urdfs(settings: SetSettings) -> ObjectSet:
    if settings.split == "unseen_families":
        raise ObjectError(
            "objects.split=unseen_families: random_urdfs has no families; use primitives, or "
            "objects.split=test"
        )
    nominal = RANDOM_URDFS_SCALE if settings.fit is None else 1.0
    files = _random_urdf_files(settings.split)
    # It is known to hold a few that no hand can take, placeholders for inertias, and 0.1 kg for
    # each, however thin; of a folder all of it is a surprise.
    found = FileSet("random_urdfs", files, settings.scale or nominal, settings, any_mass=True)
    found.told = True
    return found


def _random_urdf_files(split: str) -> list[Path]:
    """Test and sealed: every name that ends in 0, as in Quillen et al. 2018 (arXiv 1802.10264)."""
    data = data_folder()
    if data is None:
        raise ObjectError(
            "objects: random_urdfs comes with PyBullet, which is not installed; use primitives, "
            "box or a folder of meshes"
        )
    folder = data / "random_urdfs"
    numbers = [n for n in range(1000) if (n % 10 == 0) == (split != "train")]
    return [folder / f"{n:03d}" / f"{n:03d}.urdf" for n in numbers if n not in BROKEN_RANDOM_URDFS]


def _check_size(name: str, settings: SetSettings) -> None:
    """Raise ObjectError where the settings make no size of a set whose sizes are known."""
    if settings.fit is not None:
        raise ObjectError(
            f"objects.fit does not apply to the set {name!r}, whose sizes are known; "
            "leave it out or use objects.scale"
        )
    scale, (low, high) = settings.scale or 1.0, SCALES
    if not low <= scale <= high:
        raise ObjectError(
            f"objects.scale is {scale:g}, expected {low:g} to {high:g} for the set {name!r}, whose "
            "objects are 3 to 30 cm long; leave it out"
        )


# The names of object sets in a config. A new set is a function of the settings, and an entry here.
OBJECT_SETS: dict[str, Callable[[SetSettings], ObjectSet]] = {
    "box": BoxSet,
    "primitives": PrimitiveSet,
    "random_urdfs": _random_urdfs,
    **{name: partial(PrimitiveSet, name=name) for name in SPECIAL},
}
