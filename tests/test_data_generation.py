"""Generation of simulated data: its folder, and the same data however often it is interrupted."""

from __future__ import annotations

import errno
import os
import re
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
import trimesh
import yaml

from envs import data_generation
from envs.cell import Intrinsics, PhysicsError, camera_intrinsics
from envs.cell_appearance import Appearance, Texture, draw_camera
from envs.cell_scenes import SceneError
from envs.data_generation import (
    SPLITS,
    content_of_sets,
    data_folder,
    draw_scene,
    execute_pairs,
    generate,
    label_scene,
    missing_shards,
    object_sets,
    with_other_physics,
)
from envs.objects import ObjectError
from envs.simulators import make_cell
from tests.helpers.simulators import pybullet
from utils.config import load_config
from utils.errors import UserError
from utils.executor import LostWorkerError
from utils.grasp_data import SimulatedDataset, read_trials, shard_path
from utils.grasp_labels import Trial
from utils.transforms import look_at

# --- The folder ------------------------------------------------------------------------------


def folder_of(*overrides: str) -> Path:
    return data_folder(load_config(None, overrides))


@pytest.mark.parametrize(
    "override",
    [
        "seed=1", "sim.frequency=120", "camera.width=128", "camera.fov_deg=30",
        "workspace.size=0.25", "objects.density=500", "data.object_sets=box",
        "data.max_objects=3", "data.randomise=false", "data.executed_share=0.5",
        "robot.grip_force=2", "execution.approach_speed=0.02", "safety.contact_stop=5",
    ],
)  # fmt: skip
def test_what_matters_to_an_image_changes_the_folder(override):
    assert folder_of(override) != folder_of()


def test_where_no_grasp_is_executed_the_robot_does_not_matter():
    seen_only = "data.executed_share=0"
    assert folder_of(seen_only, "robot.grip_force=2") == folder_of(seen_only)


def test_the_files_of_an_own_set_matter_wherever_its_folder_is_named(tmp_path):
    one, other = tmp_path / "meshes" / "cube.obj", tmp_path / "meshes" / "part" / "cube.mtl"
    other.parent.mkdir(parents=True)
    seen = set()
    for path, text in ((one, "v 0 0 0"), (one, "v 0 0 1"), (other, "Kd 1 0 0"), (one, "v 0 0 0")):
        path.write_text(text)
        seen.add(folder_of(f"data.object_sets={tmp_path / 'meshes'}"))
    assert len(seen) == 4
    other.unlink()
    assert folder_of(f"data.object_sets={tmp_path / 'meshes'}") in seen


def test_the_meshes_of_an_own_set_matter_wherever_they_lie(tmp_path, monkeypatch):
    """A folder of URDFs that name meshes outside, a plug-in that names the folder, and a part of
    it; the texture of a mesh, too."""
    (tmp_path / "urdf").mkdir()
    (tmp_path / "meshes").mkdir()
    for name in ("one", "two"):
        geometry = f'<geometry><mesh filename="../meshes/{name}.obj"/></geometry>'
        (tmp_path / "urdf" / f"{name}.urdf").write_text(
            f'<robot name="{name}"><link name="a"><visual>{geometry}</visual></link></robot>'
        )
        (tmp_path / "meshes" / f"{name}.obj").write_text("mtllib paint.mtl\nv 0 0 0\n")
    (tmp_path / "my_folder_of_urdfs.py").write_text(
        "from envs.objects import ObjectPart, load_object_set\n"
        f"named = {str(tmp_path / 'urdf')!r}\n"
        "def some(settings):\n"
        "    whole = load_object_set(named, cache_dir=settings.cache_dir)\n"
        "    return ObjectPart(whole, range(2))\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    plug_in = "my_folder_of_urdfs"
    for name in (str(tmp_path / "urdf"), f"{plug_in}:named", f"{plug_in}:some"):
        own, seen = f"data.object_sets={name}", []
        for file, text in (
            ("one.obj", "mtllib paint.mtl\nv 0 0 0\n"),
            ("one.obj", "mtllib paint.mtl\nv 0 0 1\n"),
            ("paint.mtl", "map_Kd wood.png\n"),
            ("wood.png", "pixels"),
            ("wood.png", "other pixels"),
        ):
            (tmp_path / "meshes" / file).write_text(text)
            seen.append(folder_of(own))
        assert len({*seen}) == 5, name
        (tmp_path / "meshes" / "unused.obj").write_text(text)
        assert folder_of(own) == seen[-1]
        for file in ("paint.mtl", "wood.png", "unused.obj"):
            (tmp_path / "meshes" / file).unlink()
        (tmp_path / "meshes" / "one.obj").write_text("mtllib paint.mtl\nv 0 0 0\n")
        assert folder_of(own) == seen[0]


def test_data_of_built_in_sets_and_of_plain_folders_made_before_stay_valid(tmp_path):
    """Digests as they were before the meshes outside a folder counted."""
    (tmp_path / "part").mkdir()
    (tmp_path / "cube.obj").write_text("v 0 0 0")
    (tmp_path / "part" / "cube.mtl").write_text("Kd 1 0 0")
    config = load_config(None, [f"data.object_sets={tmp_path},primitives"])
    before = "d6955bc5c560f0540ae8a42ea53f4f36ffcf7b93424de9366c721a8101005e05"
    assert content_of_sets(config, config.data.object_sets) == {str(tmp_path): before}


@pytest.mark.parametrize(
    "override",
    [
        "data.frames=64", "data.validation_frames=32", "data.workers=3", "train.lr=1e-4",
        "camera.depth_noise=kinect", "objects.split=train", "evaluate.rounds=3", "cache_dir=x",
        "objects.skip_broken=false",
    ],
)  # fmt: skip
def test_what_does_not_matter_keeps_the_folder(override):
    assert folder_of(override) == folder_of()


def test_the_folder_of_a_config_that_skips_nothing_is_that_of_before_there_was_the_key():
    assert "skip_broken" not in data_generation._content(load_config())
    assert folder_of("objects.skip_broken=true") != folder_of()


def test_a_lower_floor_and_another_pose_at_home_make_other_data():
    """The floor stops the arm where labels are executed; the arm at home is in the images."""
    without, home = "data.executed_share=0", "robot.home=[0,-0.5,0,-2.2,0,2,0.8]"
    assert folder_of("closed_loop.floor=0.03") != folder_of()
    assert folder_of(without, "closed_loop.floor=0.03") == folder_of(without)
    assert folder_of(without, home) != folder_of(without)


def test_data_made_before_there_were_side_views_and_floating_hands_stay_valid():
    content = yaml.safe_load(
        data_generation._content(load_config(None, ["data.executed_share=0.5"]))
    )
    assert {"view", "side_tilt_deg", "side_distance", "side_azimuth_deg"}.isdisjoint(
        content["camera"]
    )
    assert "arm" not in content["robot"] and "on_contact" not in content["execution"]
    assert {"opens_fully", "least_held"}.isdisjoint(content["gripper"])
    assert folder_of("gripper.opens_fully=true") != folder_of()
    assert folder_of("gripper.least_held=0.008") != folder_of()


def test_a_named_root_is_taken_as_it_is(tmp_path):
    assert folder_of(f"data.root={tmp_path}") == tmp_path


def test_a_root_of_other_settings_or_of_something_else_is_left_alone(tiny_data, tmp_path):
    _, overrides = tiny_data
    with pytest.raises(UserError, match="other settings.*content.yaml"):
        generate(load_config(None, [*overrides, "seed=5"]))
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(UserError, match="not empty and no data set"):
        generate(load_config(None, [*overrides, f"data.root={tmp_path}"]))
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


def test_sets_that_cannot_be_parted_are_said_before_any_worker_starts(tmp_path, monkeypatch):
    def opened(*_):
        raise AssertionError("a worker was started")

    monkeypatch.setattr(data_generation, "open_executor", opened)
    with pytest.raises(UserError, match="box holds 1 object"):
        generate(load_config(None, [f"data.root={tmp_path / 'a'}", "data.object_sets=box"]))
    (tmp_path / "meshes").mkdir()
    with pytest.raises((UserError, ObjectError), match="meshes"):
        generate(
            load_config(
                None, [f"data.root={tmp_path / 'b'}", f"data.object_sets={tmp_path / 'meshes'}"]
            )
        )


# --- Generation ------------------------------------------------------------------------------


def read_whole(path: Path) -> dict[str, np.ndarray]:
    with h5py.File(path) as file:
        return {name: data[()] for name, data in file.items()}


@pytest.mark.slow
def test_interrupted_generation_goes_on_and_ends_in_the_same_data(tiny_data, tmp_path):
    folder, overrides = tiny_data
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    shard_path(copy, "train", 0).unlink()
    kept = os.stat(shard_path(copy, "validation", 0))
    assert generate(load_config(None, [*overrides, f"data.root={copy}"])) == copy
    # Not the files' bytes: LZF's compression depends on what its memory held before.
    again, first = (read_whole(shard_path(data, "train", 0)) for data in (copy, folder))
    assert again.keys() == first.keys() >= {"depth", "quality", "trials", "scene"}
    for name, values in again.items():
        np.testing.assert_array_equal(values, first[name], name)
    assert os.stat(shard_path(copy, "validation", 0)).st_mtime_ns == kept.st_mtime_ns


def test_every_shard_has_one_owner_whatever_is_there_already(tmp_path):
    config = load_config(None, ["data.frames=161", "data.validation_frames=64"])
    everything = [("train", n) for n in range(6)] + [("validation", n) for n in range(2)]
    shares = [missing_shards(config, tmp_path, rank, 3) for rank in range(3)]
    assert sorted(sum(shares, [])) == everything
    for job in shares[0]:  # the first process is done before the others start
        shard_path(tmp_path, *job).parent.mkdir(exist_ok=True)
        shard_path(tmp_path, *job).touch()
    assert [missing_shards(config, tmp_path, rank, 3) for rank in range(3)] == [[], *shares[1:]]


class OneThread(ThreadPoolExecutor):
    """In place of a process, which would not know of replaced functions."""

    def __init__(self, *_):
        super().__init__(1)

    def size(self):
        return 1


def few_shards(monkeypatch, make_shard, root, frames=96):
    """A config whose shards, three of training and one of validation, are made by `make_shard`."""
    monkeypatch.setattr(data_generation, "open_executor", OneThread)
    monkeypatch.setattr(data_generation, "_make_shard", make_shard)
    return load_config(None, [f"data.root={root}", f"data.frames={frames}",
                              "data.validation_frames=32", "data.object_sets=primitives",
                              "data.workers=1"])  # fmt: skip


def touch_shard(config, folder, shard):
    path = shard_path(folder, *shard)
    path.parent.mkdir(exist_ok=True)
    path.touch(exist_ok=False)
    return 32


def test_what_is_kept_after_ctrl_c_is_said_and_not_made_again(tmp_path, monkeypatch, capsys):
    def interrupted(config, folder, shard):
        if shard == ("train", 2):
            raise KeyboardInterrupt
        return touch_shard(config, folder, shard)

    root = tmp_path / "data"
    config = few_shards(monkeypatch, interrupted, root)
    with pytest.raises(KeyboardInterrupt):
        generate(config)
    said = f"64 of 128 frames are kept in {root}; the same command goes on from there"
    assert said in capsys.readouterr().out
    monkeypatch.setattr(data_generation, "_make_shard", touch_shard)
    assert generate(config) == root and missing_shards(config, root, 0, 1) == []


def test_what_is_kept_after_lost_workers_is_said(tmp_path, monkeypatch):
    def lost(config, folder, shard):
        raise LostWorkerError("4 worker processes in a row died")

    root = tmp_path / "data"
    kept = f"died; the finished shards are safe in {root}: start again, perhaps with data.workers=1"
    with pytest.raises(UserError, match=re.escape(kept)):
        generate(few_shards(monkeypatch, lost, root))


def test_shards_that_were_written_on_another_machine_are_missed(tmp_path, monkeypatch):
    config = few_shards(monkeypatch, lambda *_: 32, tmp_path / "data")
    with pytest.raises(UserError, match="shards that are not here; on a cluster it must be in a "):
        generate(config)


def test_after_an_error_in_a_worker_no_shard_is_begun(tmp_path, monkeypatch):
    """Of more than 30, which one worker makes one after the other."""
    begun = []

    def make_shard(config, folder, shard):
        begun.append(shard)
        if len(begun) == 2:
            raise OSError(errno.ENOSPC, "no space")
        return 32

    config = few_shards(monkeypatch, make_shard, tmp_path / "data", frames=960)
    with pytest.raises(OSError, match="no space"):
        generate(config)
    assert begun == [("train", 0), ("train", 1)]


def test_an_oblique_camera_is_not_varied():
    """Varied are cameras from straight above: others would silently be left out."""
    oblique = ["camera.position=[0.5,-0.566,0.566]", "camera.up=[0,0,1]", "data.frames=960"]
    with pytest.raises(UserError, match="camera.position over camera.target"):
        generate(load_config(None, [*oblique, "data.randomise=true"]))


def test_scenes_that_cannot_be_made_are_refused(config, monkeypatch):
    def none(*_):
        raise SceneError("too many")

    monkeypatch.setattr(data_generation, "make_scene", none)
    given = load_config(None, ["data.object_sets=primitives"])
    with pytest.raises(UserError, match="none of 100 .*data.max_objects"):
        draw_scene(given, "train", 1, object_sets(given))


def test_generated_frames_are_whole(tiny_data):
    folder, _ = tiny_data
    for split in SPLITS:
        images = SimulatedDataset(folder, split)
        assert len(images) == 32 and len(set(images.scenes)) == 8
        graspable = [bool((images[i].quality > 0.5).any()) for i in range(32)]
        assert np.mean(graspable) > 0.8  # of two primitives, nearly always one can be gripped
        for i in range(32):
            known = images[i].depth[images[i].depth > 0]
            assert len(known) > 0.9 * images[i].depth.numel()
            assert known.max() < 1.5 and known.min() > 0.4
    assert not set(SimulatedDataset(folder, "train").scenes) & set(
        SimulatedDataset(folder, "validation").scenes
    )
    trials = [trial for shard in read_trials(folder) for trial in shard]
    assert {0.0} < {t.quality for t in trials} and any(t.success for t in trials)


def test_pixels_lie_around_the_centre_of_their_object(tiny_data):
    """In shards of the real cell: wherever an object is, the pixels that show it are around the
    place that is stored as its centre of mass, and every object has a place of its own."""
    folder, _ = tiny_data
    images = SimulatedDataset(folder, "train")
    distances = []
    for image in (images[i] for i in range(len(images))):
        on = image.centre[0].isfinite()
        centres = image.centre[:, on].T.unique(dim=0)
        assert len(centres) <= 2
        for centre in centres:
            v, u = torch.nonzero((image.centre == centre[:, None, None]).all(0), as_tuple=True)
            if len(u) > 20:
                middle = torch.stack([u.float().mean(), v.float().mean()])
                distances.append(float(torch.linalg.norm(middle - centre)))
    assert len(distances) > 32
    assert np.median(distances) < 1.0 and np.max(distances) < 5.0  # of 64, an object spans 8 to 20


def test_validation_keeps_a_tenth_of_the_training_objects_and_no_test_object(config):
    given = load_config(None, ["data.object_sets=primitives", "objects.split=test"])
    parts = object_sets(given)
    assert {key: len(part) for key, part in parts.items()} == {
        ("primitives", "validation"): 90,
        ("primitives", "train"): 810,
    }
    used: dict[str, set[str]] = {"train": set(), "validation": set()}
    for split, names in used.items():
        for seed in range(4):
            scene, _ = draw_scene(given, split, seed, parts)
            names |= {placed.model.name for placed in scene.placements}
    assert not used["train"] & used["validation"]
    # 900 and above are for testing
    assert all(int(name[-4:]) < 900 for names in used.values() for name in names)


def some_broken(folder: Path, broken: tuple[int, ...]) -> str:
    """Twelve boxes, of which numbers 1 and 4 are for validation; some are no meshes."""
    folder.mkdir()
    for number in range(12):
        box = trimesh.creation.box((0.03, 0.04, 0.05 + 0.001 * number))
        box.export(folder / f"o{number:02d}.stl")
        if number in broken:
            (folder / f"o{number:02d}.stl").write_text("no mesh")
    return str(folder)


def test_a_broken_files_place_is_taken_within_its_own_split(tmp_path, config):
    own = some_broken(tmp_path / "own", broken=(1, 5))
    given = load_config(None, [f"data.object_sets={own}", "objects.skip_broken=true"])
    parts = object_sets(given)
    with pytest.warns(UserWarning, match="leaves out") as said:
        names = {split: [model.name for model in parts[own, split]] for split in SPLITS}
    assert names["validation"] == ["o04", "o04"]
    assert names["train"] == [f"o{number:02d}" for number in (0, 2, 3, 6, 6, 7, 8, 9, 10, 11)]
    assert len(said) == 2


def test_a_split_of_broken_files_alone_is_refused(tmp_path):
    own = some_broken(tmp_path / "own", broken=(1, 4))
    given = load_config(None, [f"data.object_sets={own}", "objects.skip_broken=true"])
    none = r"own: none of 2 files of a part \(training or validation\) can be used: .*o01.*o04"
    with pytest.raises(ObjectError, match=none):
        object_sets(given)[own, "validation"][0]


@pytest.mark.parametrize("plug_in", [False, True])
def test_files_of_one_name_are_in_one_split(tmp_path, monkeypatch, plug_in):
    own = Path(some_broken(tmp_path / "own", broken=()))
    (own / "kitchen").mkdir()
    for mesh in own.glob("*.stl"):
        shutil.copy(mesh, mesh.with_suffix(".ply"))
        shutil.copy(mesh, own / "kitchen")
    (tmp_path / "my_boxes.py").write_text(
        "from envs.objects import ObjectPart, load_object_set\n"
        "def boxes(settings):\n"
        f"    return ObjectPart(load_object_set({str(own)!r}, cache_dir='.'), range(36))\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    name = "my_boxes:boxes" if plug_in else str(own)
    parts = object_sets(load_config(None, [f"data.object_sets={name}"]))
    files = {split: parts[name, split].files for split in SPLITS}
    assert len({*files["train"], *files["validation"]}) == 36
    train, validation = ({file.with_suffix("") for file in files[split]} for split in SPLITS)
    assert len(validation) == 3 and not train & validation
    (tmp_path / "two").mkdir()
    for suffix in ("stl", "ply"):
        shutil.copy(own / "o00.stl", tmp_path / "two" / f"one.{suffix}")
    with pytest.raises(UserError, match="holds 1 object, .* two objects or more, of different nam"):
        object_sets(load_config(None, [f"data.object_sets={tmp_path / 'two'}"]))


def test_older_data_that_may_have_a_shape_in_both_splits_are_made_anew(tmp_path):
    own = some_broken(tmp_path / "own", broken=())
    usual = [f"data.object_sets={own}"]
    mark = "no shape in two splits"
    assert mark not in data_generation._content(load_config(None, usual))
    skipping = load_config(None, [*usual, "objects.skip_broken=true"])
    assert mark in data_generation._content(skipping)
    shutil.copy(Path(own, "o00.stl"), Path(own, "o00.ply"))
    assert mark in data_generation._content(load_config(None, usual))


@pytest.mark.parametrize(
    "name, families", [("thin", 4), ("household", 10), ("rounded", 4), ("primitives", 11)]
)
def test_every_family_is_learned_and_validated(name, families):
    """Families take turns, so that a stride might meet some of them alone."""
    parts = object_sets(load_config(None, [f"data.object_sets={name}"]))
    for split in ("train", "validation"):
        part = parts[name, split]
        assert {one % families for one in part._indices} == set(range(families))


# --- Appearance and physics ------------------------------------------------------------------


@pytest.fixture(scope="module")
def cell_with_scene(tiny_data):
    config = load_config(None, tiny_data[1])
    with make_cell(config) as cell:
        scene, _ = draw_scene(config, "train", 3, object_sets(config))
        cell.load(scene)
        yield cell, scene


def test_without_randomisation_the_plain_camera_sees_plain_objects(tiny_data, cell_with_scene):
    cell, scene = cell_with_scene
    plain = load_config(None, [*tiny_data[1], "data.randomise=false", "data.executed_share=0"])
    first, trials = next(label_scene(plain, scene, "primitives", cell))
    cell.load(scene)
    expected = cell.frame()
    assert np.array_equal(first.frame.rgb, expected.rgb)
    assert np.array_equal(first.frame.depth, expected.depth)
    assert np.array_equal(first.frame.T_WC, look_at((0.5, 0, 0.8), (0.5, 0, 0), (1, 0, 0)))
    assert np.array_equal(first.frame.K, expected.K) and trials == []
    random = load_config(None, [*tiny_data[1], "data.executed_share=0"])
    first, _ = next(label_scene(random, scene, "primitives", cell))
    assert not np.allclose(first.frame.T_WC, expected.T_WC)


def test_physics_of_labels(tiny_data, cell_with_scene):
    """Friction 0.7 to 1.3 of the object's own, mass 0.5 to 1.5, inertia with it; each frame others;
    what is labelled is what is simulated."""
    cell, scene = cell_with_scene
    config = load_config(None, [*tiny_data[1], "data.randomise_physics=true"])
    first, again, second = (with_other_physics(scene, config, number) for number in (0, 0, 1))
    for old, new, same, other in zip(*(s.placements for s in (scene, first, again, second))):
        heavier = new.model.mass / old.model.mass
        assert 0.7 <= new.model.friction / old.model.friction <= 1.3 and 0.5 <= heavier <= 1.5
        np.testing.assert_allclose(new.model.inertia, heavier * old.model.inertia)
        assert (new.model.friction, new.model.mass) == (same.model.friction, same.model.mass)
        assert new.model.friction != other.model.friction
        assert new.model.parts is old.model.parts
    cell.build(first)
    for number, solid in enumerate(cell.truth().objects):
        assert solid.friction == first.placements[number].model.friction
        if pybullet is not None:
            simulated = pybullet.getDynamicsInfo(
                cell.bodies[number], -1, physicsClientId=cell.client
            )
            assert simulated[1] == solid.friction
            assert simulated[0] == pytest.approx(first.placements[number].model.mass)


def test_a_grasp_that_blows_up_the_simulation_has_failed(cell_with_scene, monkeypatch):
    cell, scene = cell_with_scene
    cell.load(scene)

    def blow_up(*_):
        raise PhysicsError("as if")

    pairs = [("grasp", 0.9, 2.0), ("grasp", 0.0, 5.0)]
    monkeypatch.setattr(data_generation, "draw_pairs", lambda *_: pairs)
    monkeypatch.setattr(data_generation, "execute_grasp", blow_up)
    trials = execute_pairs(cell, scene, None, None, np.random.default_rng(0))
    assert trials == [Trial(0.9, 2.0, False), Trial(0.0, 5.0, False)]


def stripes(strength: float) -> Texture:
    """1 cm light, 1 cm dark along x."""
    return Texture(
        np.array([[2 * np.pi / 0.02, 0, 0]]), np.zeros(1), np.full(3, strength), hard=True
    )


def test_a_texture_colours_what_it_is_on_and_leaves_the_depth(cell_with_scene):
    cell, scene = cell_with_scene
    cell.load(scene)
    view = camera_intrinsics(cell.config.camera), cell.camera_pose()
    rng = np.random.default_rng(0)
    plain = Appearance().render(cell, *view, rng)
    count = len(scene.placements)
    for index in range(-1, count):  # the table, then every object
        textures = tuple(stripes(0.5) if i == index else None for i in range(-1, count))
        seen = Appearance(textures=textures).render(cell, *view, rng)
        assert np.array_equal(seen.depth, plain.depth)
        changed = (seen.rgb != plain.rgb).any(axis=-1)
        assert changed[plain.segmentation == index].mean() > 0.5
        assert not changed[plain.segmentation != index].any()
    noisy = Appearance(noise=5.0).render(cell, *view, rng)
    assert np.array_equal(noisy.depth, plain.depth)
    middle = (plain.rgb > 30) & (plain.rgb < 225)  # not cut off at 0 or 255
    # Rounding down takes half a step from the mean and adds a variance of a twelfth.
    error = noisy.rgb[middle].astype(float) - plain.rgb[middle]
    assert error.mean() == pytest.approx(-0.5, abs=0.2)
    assert error.std() == pytest.approx(np.sqrt(25 + 1 / 12), rel=0.1)


def test_a_texture_of_one_wave_is_a_sine():
    wave = Texture(
        np.array([[2 * np.pi / 0.02, 0, 0]]), np.zeros(1), np.array([0.5, 0.2, 0]), False
    )
    points = np.array([[0.0, 1, 2], [0.005, 1, 2], [0.010, 3, 4], [0.015, 3, 4]])
    np.testing.assert_allclose(
        wave.factor(points),
        [[1, 1, 1], [1.5, 1.2, 1], [1, 1, 1], [0.5, 0.8, 1]],
        atol=1e-12,
    )
    np.testing.assert_allclose(stripes(0.3).factor(points)[[1, 3]], [[1.3] * 3, [0.7] * 3])


def test_drawn_textures_at_most_halve_or_add_half():
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.3, 0.3, (500, 3))
    reached = []
    for _ in range(50):
        texture = Texture.draw(rng)
        change = np.abs(texture.factor(points) - 1)
        assert (change <= texture.strength + 1e-12).all() and change.max() <= 0.5
        reached.append(change.max())
    assert max(reached) > 0.3


def test_cameras_are_drawn_around_the_configured_one(config):
    rng = np.random.default_rng(0)
    tilts = []
    for _ in range(300):
        intrinsics, T_WC = draw_camera(rng, config.camera)
        assert isinstance(intrinsics, Intrinsics)
        assert 28 * 0.92 <= intrinsics.fov_deg <= 28 * 1.08
        axis = T_WC[:3, 2]
        distance = -T_WC[2, 3] / axis[2]  # to the table along the axis
        hit = T_WC[:3, 3] + distance * axis
        assert np.abs(hit[:2] - (0.5, 0.0)).max() <= 0.02 + 1e-9
        assert abs(distance - 0.8) <= 0.12 + 1e-9
        tilts.append(np.degrees(np.arccos(-axis[2])))
    assert max(tilts) <= 25 + 1e-6
    assert 0.65 < np.mean(np.array(tilts) <= 3) < 0.95  # four in five are near, some by chance
