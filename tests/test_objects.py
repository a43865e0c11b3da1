"""Object sets: what they hold, folders, plug-ins, clear errors, and repeatability."""

import importlib
import pickle
import sys
import warnings
from concurrent.futures import Future
from pathlib import Path

import numpy as np
import pytest
import trimesh

from envs.object_bodies import load_object
from envs.object_primitives import FAMILIES, HOUSEHOLD_MASSES, UNSEEN_FAMILIES
from envs.objects import BROKEN_RANDOM_URDFS, ObjectError, ObjectPart, load_object_set, prepare
from envs.pybullet_files import data_folder
from tests.helpers.object_files import box_moments, urdf_box, urdf_inertia
from tests.helpers.simulators import needs_pybullet, pybullet
from utils.config import load_config
from utils.errors import UserError
from utils.executor import open_executor
from utils.geometry import GripperGeometry

if pybullet is not None:
    from envs.pybullet_bodies import spawn

IDENTITY = (0, 0, 0, 1)


def test_the_box_is_the_tutorials(tmp_path):
    objects = load_object_set("box", cache_dir=tmp_path)
    assert len(objects) == 1
    assert objects[0].mass == pytest.approx(0.1)
    assert objects[0].extents == pytest.approx([0.06] * 3)
    assert objects[0].inertia == pytest.approx([0.1 * 0.06**2 / 6] * 3)
    assert objects[0].color == (1.0, 0.2, 0.2, 1.0)


@pytest.mark.parametrize(
    ("name", "train_size", "key"),
    [
        ("primitives", 900, "indices"),
        pytest.param("random_urdfs", 899, "files", marks=needs_pybullet),
    ],
)
def test_sizes_and_disjoint_splits(tmp_path, name, train_size, key):
    train = load_object_set(name, split="train", cache_dir=tmp_path)
    test = load_object_set(name, split="test", cache_dir=tmp_path)
    sealed = load_object_set(name, split="sealed", cache_dir=tmp_path)
    assert (len(train), len(test), len(sealed)) == (train_size, 100, 100)
    used = {*getattr(train, key), *getattr(test, key)}
    assert bool(used & set(getattr(sealed, key))) == (name == "random_urdfs")  # there are no more
    assert not set(getattr(train, key)) & set(getattr(test, key))


@needs_pybullet
def test_random_urdfs_weigh_a_tenth_of_a_kilogram_however_thin(tmp_path):
    """Number 350 fills 0.24 cm3; a file of a user would be refused. The set is scaled by 0.65."""
    objects = load_object_set("random_urdfs", cache_dir=tmp_path)
    (thin,) = (n for n, file in enumerate(objects.files) if file.stem == "350")
    assert objects[thin].mass == pytest.approx(0.1 * 0.65**3)
    with pytest.raises(ObjectError, match="350.urdf states 0.1 kg, which makes 4.2e"):
        load_object(objects.files[thin], cache_dir=tmp_path)


def test_families_are_equally_frequent(tmp_path):
    indices = load_object_set("primitives", split="train", cache_dir=tmp_path).indices
    counts = np.bincount([index % len(FAMILIES) for index in indices])
    assert counts.max() - counts.min() <= 1


def test_unseen_families_are_in_no_other_split(tmp_path):
    assert not set(UNSEEN_FAMILIES) & set(FAMILIES)
    unseen = load_object_set("primitives", split="unseen_families", cache_dir=tmp_path)
    assert len(unseen) == 100
    assert [unseen[index].name.split("_")[0] for index in range(4)] == list(UNSEEN_FAMILIES)
    with pytest.raises(ObjectError, match="random_urdfs has no families"):
        load_object_set("random_urdfs", split="unseen_families", cache_dir=tmp_path)


def test_thin_things_for_tests_are_others_than_those_for_training(tmp_path):
    train = load_object_set("thin", split="train", cache_dir=tmp_path)
    test = load_object_set("thin", split="test", cache_dir=tmp_path)
    assert (len(train), len(test)) == (200, 50) and not set(train.indices) & set(test.indices)
    dark = [max(train[index].color[:3]) < 0.2 for index in range(40)]
    assert 0.3 < np.mean(dark) < 0.9
    with pytest.raises(ObjectError, match="training may see all families of thin"):
        load_object_set("thin", split="unseen_families", cache_dir=tmp_path)


@pytest.mark.parametrize("name", ["tall", "flat"])
def test_other_special_sets_are_split_alike(tmp_path, name):
    parts = [load_object_set(name, split=split, cache_dir=tmp_path).indices
             for split in ("train", "test", "sealed")]  # fmt: skip
    assert [len(part) for part in parts] == [200, 50, 50]
    assert len(set().union(*parts)) == 300


@pytest.mark.parametrize("name", ["household", "rounded"])
def test_large_sets_are_in_three_parts(tmp_path, name):
    parts = [load_object_set(name, split=split, cache_dir=tmp_path)
             for split in ("train", "test", "sealed")]  # fmt: skip
    assert [len(part) for part in parts] == [900, 100, 100]
    assert len({index for part in parts for index in part.indices}) == 1100


def test_household_things_weigh_what_such_things_do(tmp_path):
    things = load_object_set("household", split="train", cache_dir=tmp_path)
    for model in (things[index] for index in range(30)):
        low, high = HOUSEHOLD_MASSES[model.name.split("_")[0]]
        volume = sum(trimesh.convex.convex_hull(part).volume for part in model.parts)
        # As drawn, but no matter is lighter than 100 kg/m3 nor heavier than 2,500.
        assert low <= model.mass <= high or model.mass / volume == pytest.approx(
            100 if model.mass > high else 2500, rel=0.02
        )


@pytest.mark.parametrize("scale", [0.1, 0.5])
def test_nothing_small_is_too_light_for_physics(tmp_path, scale):
    for name in ("box", "primitives", "household"):
        objects = load_object_set(name, scale=scale, cache_dir=tmp_path)
        light = min(
            (objects[i] for i in range(min(20, len(objects)))), key=lambda model: model.mass
        )
        assert light.mass >= 0.02 - 1e-9
        sides = light.extents  # no moment is larger than that of all the mass in its corners
        assert (light.inertia < light.mass * (sides @ sides) / 4).all()


def test_primitives_weigh_and_slide_as_promised(tmp_path):
    objects = load_object_set("primitives", cache_dir=tmp_path)
    for model in (objects[index] for index in range(len(FAMILIES))):
        assert 0.4 <= model.friction <= 1.0
        assert 0.03 - 1e-6 <= model.mass <= 0.3 + 1e-6


def test_a_set_is_a_sequence_that_makes_each_object_once(tmp_path):
    objects = load_object_set("primitives", cache_dir=tmp_path)
    assert objects[0] is objects[0]
    assert objects[-1] is objects[99]
    with pytest.raises(IndexError):
        objects[100]


def test_what_workers_get_does_not_change_while_objects_are_kept(tmp_path):
    """A thread pickles it at any time: a dictionary that grows meanwhile ends the run."""
    (tmp_path / "things").mkdir()
    for k in range(5):
        box = trimesh.creation.box((0.02 + 0.005 * k, 0.04, 0.03))
        box.export(tmp_path / "things" / f"box{k}.stl")
    objects = load_object_set(str(tmp_path / "things"), cache_dir=tmp_path / "cache")
    sent = []

    class Two:
        def size(self) -> int:
            return 2

        def waits(self) -> bool:
            return False

        def submit(self, function, item) -> Future:
            sent.append(pickle.dumps(function))
            done = Future()
            done.set_result(pickle.loads(sent[-1])(item))
            return done

    prepare(objects, Two(), GripperGeometry())
    assert len(sent) == 5 and len(set(sent)) == 1
    assert objects[4].name == "box4"


def test_prepare_in_parallel_makes_the_same_objects(tmp_path):
    _write_folder(tmp_path / "things")
    serial = load_object_set(str(tmp_path / "things"), cache_dir=tmp_path / "a")
    parallel = load_object_set(str(tmp_path / "things"), cache_dir=tmp_path / "b")
    for objects, count in ((serial, 1), (parallel, 2)):
        with open_executor(load_config().compute, count) as workers:
            prepare(objects, workers, GripperGeometry())
    for a, b in zip(serial, parallel, strict=True):
        assert a.name == b.name and a.mass == b.mass
        assert Path(b.collision).parent == tmp_path / "b" and b.collision.exists()


def test_what_does_not_fit_the_hand_is_named_once(tmp_path):
    (tmp_path / "mixed").mkdir()
    for name, sides in {
        "book": (0.04, 0.15, 0.2),
        "die": (0.1,) * 3,
        "brick": (0.09, 0.1, 0.2),
    }.items():
        trimesh.creation.box(sides).export(tmp_path / "mixed" / f"{name}.stl")
    for hand, names in ((GripperGeometry(), "brick, die"), (GripperGeometry(0.098), "die")):
        objects = load_object_set(str(tmp_path / "mixed"), cache_dir=tmp_path / "cache")
        count = len(names.split())
        with (
            open_executor(load_config().compute, 1) as workers,
            pytest.warns(UserWarning, match=f"{count} of 3 .* {hand.max_opening} m.*: {names};"),
        ):
            prepare(objects, workers, hand)


# --- random_urdfs ---------------------------------------------------------------------------


@needs_pybullet
def test_random_urdfs_are_concave_and_named(tmp_path):
    model = load_object_set("random_urdfs", cache_dir=tmp_path)[0]
    assert model.name == "000" and model.friction == 1.0
    assert len(model.parts) > 1
    mesh = trimesh.load_scene(model.fine_visual.path).to_mesh()
    # 0.015 is the URDF's own scale, 0.65 the set's
    assert model.fine_visual.scale == pytest.approx((0.015 * 0.65,) * 3)
    shown = mesh.vertices * model.fine_visual.scale + model.fine_visual.position
    assert np.concatenate(model.parts).min(axis=0) == pytest.approx(shown.min(axis=0), abs=5e-4)
    assert np.concatenate(model.parts).max(axis=0) == pytest.approx(shown.max(axis=0), abs=5e-4)


@needs_pybullet
@pytest.mark.parametrize("number", BROKEN_RANDOM_URDFS)
def test_the_broken_random_urdf_is_broken_and_says_so(tmp_path, number):
    path = data_folder() / "random_urdfs" / f"{number}" / f"{number}.urdf"
    with pytest.raises(ObjectError, match=f"{number}.obj has .* not finite"):
        load_object(path, cache_dir=tmp_path)
    files = load_object_set("random_urdfs", split="train", cache_dir=tmp_path).files
    assert path not in files


# --- folders --------------------------------------------------------------------------------

URDF = """<robot name="t"><link name="a">
  <contact><lateral_friction value="0.3"/></contact>
  <visual><geometry><mesh filename="mesh/box.obj" scale="0.5 0.5 0.5"/></geometry>
    <material name="m"><color rgba="0 1 0 1"/></material></visual>
  <collision><geometry><mesh filename="mesh/box.obj" scale="0.5 0.5 0.5"/></geometry></collision>
</link>
<link name="b"><collision><geometry><box size="0.02 0.02 0.02"/></geometry></collision></link>
<joint name="j" type="fixed"><parent link="a"/><child link="b"/><origin xyz="0 0 0.03"/></joint>
</robot>"""


def _write_folder(folder: Path) -> None:
    (folder / "sub" / "mesh").mkdir(parents=True)
    for suffix in ("obj", "stl", "ply", "glb"):
        trimesh.creation.box((0.03, 0.04, 0.08)).export(folder / f"one.{suffix}")
    trimesh.creation.box((0.08, 0.08, 0.08)).export(folder / "sub" / "mesh" / "box.obj")
    (folder / "sub" / "two.urdf").write_text(URDF)


def test_a_folder_holds_its_urdfs_and_the_meshes_that_none_of_them_uses(tmp_path):
    _write_folder(tmp_path / "things")
    objects = load_object_set(str(tmp_path / "things"), density=800, cache_dir=tmp_path / "cache")
    assert objects.name == "things"
    assert [path.name for path in objects.files] == [
        "one.glb", "one.obj", "one.ply", "one.stl", "two.urdf",
    ]  # fmt: skip
    for index in range(4):
        assert np.sort(objects[index].extents) == pytest.approx([0.03, 0.04, 0.08], abs=1e-6)
        assert objects[index].mass == pytest.approx(800 * 0.03 * 0.04 * 0.08)
    # a 2 cm cube stands on a 4 cm cube
    urdf = objects[4]
    assert urdf.mass == pytest.approx(800 * (0.04**3 + 0.02**3))
    assert urdf.extents == pytest.approx([0.04, 0.04, 0.06], abs=1e-6)
    assert urdf.friction == 0.3 and urdf.color == (0, 1, 0, 1)


def test_fine_visuals_of_every_format_can_be_spawned(tmp_path, client):
    _write_folder(tmp_path / "things")
    for model in load_object_set(str(tmp_path / "things"), cache_dir=tmp_path / "cache"):
        body = spawn(client, model, (0, 0, 1), IDENTITY, fine=True)
        (shape,) = pybullet.getVisualShapeData(body, physicsClientId=client)
        assert Path(shape[4].decode()) == model.fine_visual.path
        assert shape[7] == pytest.approx(model.color)


def test_fit_makes_the_middle_side_what_it_says(tmp_path):
    _write_folder(tmp_path / "things")
    folder = str(tmp_path / "things")
    model = load_object_set(folder, fit=0.06, cache_dir=tmp_path / "cache")[1]
    assert np.sort(model.extents) == pytest.approx([0.045, 0.06, 0.12], abs=1e-6)
    with pytest.raises(UserError, match=r"scale=0.5 and objects.fit=0.06: .* leave out one"):
        load_object_set(folder, fit=0.06, scale=0.5, cache_dir=tmp_path / "cache")
    with pytest.raises(UserError, match=r"expected .* to 3 m; objects.fit=60 is in metres"):
        load_object_set(folder, fit=60, cache_dir=tmp_path / "cache")[1]


def test_objects_too_large_for_the_hand_warn_once(tmp_path):
    (tmp_path / "big").mkdir()
    for name in ("a", "b"):
        trimesh.creation.box((0.3, 0.4, 0.8)).export(tmp_path / "big" / f"{name}.stl")
    objects = load_object_set(str(tmp_path / "big"), cache_dir=tmp_path / "cache")
    with pytest.warns(UserWarning, match="a.stl .* opens 0.08 m .*objects.fit"):
        objects[0]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        objects[1]


def test_a_folder_remarks_upon_impossible_inertias_once(tmp_path):
    for name in ("one", "two"):
        (tmp_path / "set" / name).mkdir(parents=True)
        urdf_box(tmp_path / "set" / name, "0.4", urdf_inertia((1e-3,) * 3))
    objects = load_object_set(str(tmp_path / "set"), cache_dir=tmp_path / "cache")
    with pytest.warns(UserWarning, match="inertia that no body") as found:
        assert [model.mass for model in objects] == pytest.approx([0.4, 0.4])
    assert sum(issubclass(one.category, UserWarning) for one in found) == 1


# --- Files that are wrong -----------------------------------------------------------------------


def _write_bad_folder(folder: Path) -> None:
    """Two sound boxes, two that are inside out, and three files that are none."""
    folder.mkdir()
    box = trimesh.creation.box((0.03, 0.04, 0.08))
    for name in ("b", "e"):
        box.export(folder / f"{name}.stl")
    box.invert()
    for name in ("c", "f"):
        box.export(folder / f"{name}.stl")
    (folder / "a.obj").write_text("v 0 0 0\n")
    (folder / "d.urdf").write_text("<robot")
    trimesh.creation.box((30, 40, 80)).export(folder / "g.stl")


def test_broken_files_end_a_run_unless_they_are_skipped(tmp_path):
    _write_bad_folder(tmp_path / "set")
    with pytest.raises(ObjectError, match=r"d\.urdf cannot be read"):
        load_object_set(str(tmp_path / "set"), cache_dir=tmp_path)


@pytest.mark.parametrize("count", [1, 2])
def test_skipped_files_and_mended_ones_are_named_once_for_a_set(tmp_path, count):
    _write_bad_folder(tmp_path / "set")
    objects = load_object_set(str(tmp_path / "set"), skip_broken=True, cache_dir=tmp_path)
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        with open_executor(load_config().compute, count) as workers:
            prepare(objects, workers, GripperGeometry())
        said = sorted(str(one.message) for one in found)
    assert len(said) == 4
    for name in ("a.obj", "d.urdf", "g.stl"):
        assert sum("objects.skip_broken leaves out" in text and name in text for text in said) == 1
    assert sum("inside out" in text and "(and so may others)" in text for text in said) == 1
    assert [model.name for model in objects] == ["b", "b", "c", "e", "e", "f", "b"]
    assert all(model.extents == pytest.approx([0.03, 0.04, 0.08]) for model in objects)


@pytest.mark.parametrize("told", [False, True])
def test_what_no_material_weighs_is_left_out_in_worker_processes_too(tmp_path, told):
    """And in a folder that is called as a built-in set."""
    folder = tmp_path / "random_urdfs"
    for name, mass in (("grams", "400"), ("fine", "0.4")):
        (folder / name).mkdir(parents=True)
        urdf_box(folder / name, mass, urdf_inertia(box_moments(float(mass))))
    objects = load_object_set(str(folder), skip_broken=True, cache_dir=tmp_path)
    objects.told = told  # of its notes, as in a worker
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert [model.mass for model in objects] == [0.4, 0.4]


def test_a_set_of_broken_files_alone_is_refused(tmp_path):
    (tmp_path / "set").mkdir()
    for name in "abcde":
        (tmp_path / "set" / f"{name}.obj").write_text("v 0 0 0\n")
    objects = load_object_set(str(tmp_path / "set"), skip_broken=True, cache_dir=tmp_path)
    with pytest.raises(ObjectError, match=r"none of 5 files can .*a\.obj.*b\.obj.*; and 2 more"):
        objects[0]


def test_a_part_of_files_is_a_part_of_them_again(tmp_path):
    """As of a plug-in that takes some objects of a folder, which are then split."""
    _write_bad_folder(tmp_path / "set")
    whole = load_object_set(str(tmp_path / "set"), skip_broken=True, cache_dir=tmp_path)
    some = ObjectPart(whole, [1, 3, 4])  # b, d and e, of which d is broken
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert [model.name for model in some.part([0, 1])] == ["b", "b"]
        assert [model.name for model in some.part([1, 2])] == ["e", "e"]


# --- errors ---------------------------------------------------------------------------------


def test_an_unknown_set_names_what_is_allowed(tmp_path):
    with pytest.raises(ObjectError, match="'boxes', .* box, primitives, random_urdfs, .* folder"):
        load_object_set("boxes", cache_dir=tmp_path)


def test_an_empty_folder_names_the_suffixes(tmp_path):
    with pytest.raises(
        ObjectError, match=r"holds no object.*\.urdf, \.xml, \.obj, \.stl, \.ply, \.glb, \.dae$"
    ):
        load_object_set(str(tmp_path), cache_dir=tmp_path)


# --- Plug-ins -------------------------------------------------------------------------------


@pytest.fixture
def plug_in(tmp_path, monkeypatch):
    """Writes the module `my_objects` into the current folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)

    def write(text: str) -> None:
        sys.modules.pop("my_objects", None)
        (tmp_path / "my_objects.py").write_text(text)
        importlib.invalidate_caches()

    yield write
    sys.modules.pop("my_objects", None)


def test_an_object_set_by_import_path(plug_in, tmp_path):
    """A function of the settings, a set, or a folder: what a name of `OBJECT_SETS` could be."""
    (tmp_path / "cups").mkdir()
    trimesh.creation.box((0.03, 0.04, 0.05)).export(tmp_path / "cups" / "cup.stl")
    plug_in(
        "from envs.objects import OBJECT_SETS, ObjectPart, SetSettings\n"
        "def three(settings):\n"
        "    return ObjectPart(OBJECT_SETS['primitives'](settings), range(3))\n"
        "folder = 'cups'\n"
        "def of_folder(settings):\n"
        "    return 'cups'\n"
        "box = OBJECT_SETS['box'](SetSettings('test', None, None, 1000.0, 0.08, '.'))\n"
    )
    own = {
        name: load_object_set(f"my_objects:{name}", split="train", scale=2.0, cache_dir=tmp_path)
        for name in ("three", "folder", "of_folder", "box")
    }
    whole = load_object_set("primitives", split="train", scale=2.0, cache_dir=tmp_path)
    assert len(own["three"]) == 3
    assert [model.name for model in own["three"]] == [whole[i].name for i in range(3)]
    for name in ("folder", "of_folder"):
        np.testing.assert_allclose(own[name][0].extents, [0.06, 0.08, 0.10], rtol=1e-6)
    assert own["box"][0].name == "cube"


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("my_objects:nothing", "my_objects has no 'nothing'"),
        ("my_objekts:sets", "there is no module 'my_objekts'"),
        ("my_objects:number", "'my_objects:number' gives 3, expected an envs.objects.ObjectSet or"),
        ("my_objects:missing", "gives 'no/such/folder', expected an envs.objects.ObjectSet or the"),
        ("my_objects:fails", "'my_objects:fails' raised ZeroDivisionError: division by zero"),
    ],
)
def test_a_plug_in_without_objects_is_named(plug_in, tmp_path, path, message):
    plug_in("number = 3\nmissing = 'no/such/folder'\ndef fails(settings):\n    return 1 / 0\n")
    with pytest.raises(UserError, match=message) as error:
        load_object_set(path, cache_dir=tmp_path)
    assert "\n" not in str(error.value)


# --- What is refused ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"split": "val"},
            "objects.split is 'val'; allowed are train, test, sealed, unseen_families",
        ),
        ({"scale": -1.0}, "objects.scale is -1.0"),
        ({"density": float("nan")}, "objects.density is nan"),
        ({"fit": 0.06}, "objects.fit does not apply"),
        ({"scale": 1e-6}, "objects.scale is 1e-06, expected 0.1 to 10 for the set 'primitives'"),
        ({"scale": 1e3}, "objects.scale is 1000, expected 0.1 to 10 for the set 'primitives'"),
    ],
)
def test_arguments_out_of_range_are_named(tmp_path, arguments, message):
    with pytest.raises(ObjectError, match=message):
        load_object_set("primitives", cache_dir=tmp_path, **arguments)
