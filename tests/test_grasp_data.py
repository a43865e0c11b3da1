"""Simulated grasp data: what is stored comes back, what it says of the labels, and generation that
gives the same bytes whoever does it and whenever it is interrupted."""

from __future__ import annotations

import errno
import os
import pickle
import shutil
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pybullet
import pytest
import torch

from envs import data_generation
from envs.camera import Intrinsics, camera_intrinsics
from envs.cell import PhysicsError
from envs.cell_scenes import SceneError
from envs.data_generation import (
    SPLITS,
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
from envs.pybullet_appearance import Appearance, Texture, draw_camera
from envs.pybullet_cell import PybulletCell
from tests.helpers.box_frames import boxes_frame
from utils.config import load_config
from utils.errors import UserError
from utils.geometry import GripperGeometry, SceneGeometry, SolidObject, Workspace
from utils.grasp_data import LabelledFrame, SimulatedDataset, read_trials, shard_path, write_shard
from utils.grasp_labels import (
    GraspLabels,
    LabelSettings,
    Trial,
    dense_labels,
    draw_pairs,
    label_truth,
)
from utils.transforms import RGBDFrame, look_at, project

SHAPE = (5, 7)
OVERHEAD = look_at((0.5, 0.0, 0.8), (0.5, 0.0, 0.0), (1, 0, 0))


def made_up(rng: np.random.Generator, T_WC: np.ndarray = OVERHEAD) -> LabelledFrame:
    things = [SolidObject((), rng.uniform(-0.1, 0.1, 3), 0.5) for _ in range(rng.integers(1, 4))]
    frame = RGBDFrame(
        rng.integers(0, 256, (*SHAPE, 3), dtype=np.uint8),
        rng.uniform(0, 3.2, SHAPE).astype(np.float32),
        rng.uniform(0, 500, (3, 3)),
        T_WC,
        rng.integers(-2, len(things), SHAPE).astype(np.int32),
        SceneGeometry(tuple(things)),
    )
    frame.depth[0, 0] = 0  # unknown
    quality = rng.uniform(0, 1, (18, *SHAPE)).astype(np.float32)
    quality[0] = 0
    width = rng.uniform(0, 0.08, (18, *SHAPE)).astype(np.float32)
    return LabelledFrame(frame, GraspLabels(quality, width, rng.random(SHAPE) < 0.8), "pile box 7")


@pytest.fixture
def stored(tmp_path):
    """Two shards of two frames each, with three trials in each: the folder and what went in."""
    rng = np.random.default_rng(0)
    frames = [made_up(rng) for _ in range(4)]
    trials = [Trial(0.6, 2.5, True), Trial(0.0, 1000.0, False), Trial(1.0, 1.0, True)]
    for number in range(2):
        write_shard(shard_path(tmp_path, "train", number), frames[2 * number :][:2], trials, 0.08)
    return tmp_path, frames, trials


# --- On disk -------------------------------------------------------------------------------


def test_what_is_stored_comes_back_to_half_a_unit(stored):
    folder, frames, trials = stored
    images = SimulatedDataset(folder, "train")
    assert len(images) == 4
    for index, given in enumerate(frames):
        image = images[index]
        assert np.array_equal(image.rgb.numpy(), given.frame.rgb.transpose(2, 0, 1))
        assert np.array_equal(image.mask.numpy(), given.labels.valid)
        for ours, theirs, unit in (
            (image.depth, given.frame.depth, 5e-5),  # 16 bits over 3.28 m
            (image.quality, given.labels.quality, 1 / 255),
            (image.width, given.labels.width, 0.08 / 255),
        ):
            error = np.abs(ours.numpy() - theirs)
            assert 0.3 * unit < error.max() < 0.5 * unit + 3e-7  # of float32 at 3 m
        assert image.depth[0, 0] == 0 and (image.quality[0] == 0).all()
        K, T_WC = images.cameras[index]
        assert np.array_equal(K, given.frame.K) and np.array_equal(T_WC, given.frame.T_WC)
        for row, column in np.ndindex(SHAPE):
            number = given.frame.segmentation[row, column]
            u, v = image.centre[:, row, column].tolist()
            if number < 0:
                assert np.isnan(u) and np.isnan(v)
            else:
                centre = given.frame.truth.objects[number].centre_of_mass
                expected, _ = project(centre, K, T_WC)
                assert (u, v) == pytest.approx(tuple(expected), abs=1e-3)
    assert images.scenes == ["pile box 7"] * 4
    assert read_trials(folder) == 2 * trials


def test_labels_of_a_wider_hand_are_stored_unclipped(tmp_path):
    """A box of 9 cm: no label for the Panda's own hand, and labels over 9 cm for one of 10 cm."""
    frame = boxes_frame([((0.09, 0.12, 0.05), 0.0, (0.5, 0.0))])
    objects = np.where(frame.points()[..., 2] > 0.01, 0, -1).astype(np.int32)
    hand = GripperGeometry(max_opening=0.10)
    labels = dense_labels(frame, hand, Workspace())
    assert labels.quality.max() > 0.5 and 0.09 < labels.width.max() <= 0.10
    labelled = LabelledFrame(replace(frame, segmentation=objects), labels, "isolated boxes 0")
    write_shard(shard_path(tmp_path, "train", 0), [labelled], [], hand.max_opening)
    stored = SimulatedDataset(tmp_path, "train")[0].width.numpy()
    assert np.abs(stored - labels.width).max() < 0.5 * 0.10 / 255 + 1e-7


def test_depth_beyond_16_bits_is_cut_off_not_wrapped(tmp_path):
    frame = made_up(np.random.default_rng(0))
    frame.frame.depth[1, 1] = 5.0
    write_shard(shard_path(tmp_path, "train", 0), [frame], [], 0.08)
    assert SimulatedDataset(tmp_path, "train")[0].depth[1, 1] == pytest.approx(65535 * 5e-5)
    assert read_trials(tmp_path) == []


def test_frames_limits_how_many_are_used(stored):
    folder, _, _ = stored
    images = SimulatedDataset(folder, "train", 3)
    assert len(images) == 3 and len(list(images)) == 3
    with pytest.raises(IndexError):
        images[3]
    assert len(SimulatedDataset(folder, "train", 10)) == 4


def test_a_data_set_that_was_read_goes_to_another_process(stored):
    images = SimulatedDataset(stored[0], "train")
    first = images[0]
    again = pickle.loads(pickle.dumps(images))[0]
    assert np.array_equal(first.rgb, again.rgb) and np.array_equal(first.quality, again.quality)


def truncated(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-100])


def emptied(path: Path) -> None:
    path.write_bytes(b"")


def replaced(path: Path) -> None:
    path.write_text("no HDF5 at all")


def unmarked(path: Path) -> None:
    with h5py.File(path, "a") as file:
        del file.attrs["format_version"]


def newer(path: Path) -> None:
    with h5py.File(path, "a") as file:
        file.attrs["format_version"] = 99


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (truncated, "not a readable data shard"),
        (emptied, "not a readable data shard"),
        (replaced, "not a readable data shard"),
        (unmarked, "not a readable data shard"),
        (newer, "version 99"),
    ],
)
def test_a_shard_that_cannot_be_read_is_named(stored, spoil, message):
    folder, _, _ = stored
    spoil(shard_path(folder, "train", 1))
    for read in (lambda: SimulatedDataset(folder, "train"), lambda: read_trials(folder)):
        with pytest.raises(UserError, match=message) as caught:
            read()
        assert "00001.h5" in str(caught.value)


def test_a_sound_shard_is_not_blamed_for_the_system(stored, monkeypatch):
    def no_more_files(*_):
        raise OSError(errno.EMFILE, "unable to open file")

    with monkeypatch.context() as patch:
        patch.setattr(h5py, "File", no_more_files)
        with pytest.raises(UserError, match="00000.h5: cannot be read .Too many open") as caught:
            read_trials(stored[0])
    assert "delete" not in str(caught.value)
    shard_path(stored[0], "train", 1).unlink()
    shard_path(stored[0], "train", 1).mkdir()
    with pytest.raises(UserError, match="00001.h5: cannot be read .Is a directory"):
        read_trials(stored[0])


def test_a_folder_without_shards_is_said(tmp_path):
    with pytest.raises(UserError, match="no .h5 shards.*generate"):
        SimulatedDataset(tmp_path, "train")


def test_table_distance_of_a_tilted_camera(tmp_path):
    # 0.6 m up, 30 degrees from straight down: the axis meets the table after 0.6 / cos 30 degrees.
    eye = np.array([0.5, 0.1, 0.6])
    target = eye + (0.6 * np.tan(np.radians(30)), 0.0, -0.6)
    tilted = made_up(np.random.default_rng(0), look_at(eye, target))
    write_shard(shard_path(tmp_path, "train", 0), [tilted], [], 0.08)
    distance = SimulatedDataset(tmp_path, "train").table_distance(0)
    assert distance == pytest.approx(0.6 / (np.sqrt(3) / 2))


# --- Labels against physics ----------------------------------------------------------------


def test_label_truth_of_seven_trials():
    truth = label_truth(
        [
            Trial(1.0, 2.0, True),
            Trial(0.7, 4.0, False),
            Trial(0.6, 1.0, True),
            Trial(0.59, 10.0, True),
            Trial(0.2, 3.0, True),
            Trial(0.0, 5.0, True),
            Trial(0.0, 5.0, False),
        ]
    )
    assert (truth.executed, truth.positives) == (7, 3)
    assert truth.precision == pytest.approx(2 / 3)
    # Wilson's interval of 2 in 3 with z = 1.96, by hand.
    assert truth.precision_ci95 == pytest.approx((0.2077, 0.9385), abs=1e-4)
    assert truth.precision_weighted == pytest.approx(3 / 7)  # (2 + 1) of 2 + 4 + 1
    assert truth.recall_weighted == pytest.approx(3 / 21)  # of 2 + 1 + 10 + 3 + 5
    edges = [(low, high) for low, high, _, _ in truth.by_stratum]
    assert edges == [
        (0, 1e-6), (1e-6, 0.3), (0.3, 0.5), (0.5, 0.6), (0.6, 0.7), (0.7, 0.8), (0.8, 1)
    ]  # fmt: skip
    assert [count for _, _, count, _ in truth.by_stratum] == [2, 1, 0, 1, 1, 1, 1]
    rates = [rate for _, _, _, rate in truth.by_stratum]
    np.testing.assert_equal(rates, [0.5, 1, np.nan, 1, 1, 0, 1])


def test_label_truth_of_nothing_is_not_a_number():
    truth = label_truth([])
    assert truth.executed == truth.positives == 0
    assert np.isnan([truth.precision, truth.precision_weighted, truth.recall_weighted]).all()


def test_pairs_are_drawn_from_every_stratum_with_weights_that_count_them_all():
    """A surface 5 cm above the table in the left half of the image; table in the right half."""
    height, width = 20, 30
    depth = np.full((height, width), 0.8, np.float32)
    segmentation = np.full((height, width), -1, np.int32)
    depth[:, :15], segmentation[:, :15] = 0.75, 0
    K = np.array([[60.0, 0, 14.5], [0, 60.0, 9.5], [0, 0, 1]])
    frame = RGBDFrame(
        np.zeros((height, width, 3), np.uint8), depth, K, OVERHEAD, segmentation, SceneGeometry(())
    )
    quality = np.zeros((18, height, width), np.float32)
    quality[3, 0, :2] = 0.4  # fewer than are asked for
    quality[7, 1, :10] = 0.65
    quality[9, :, 20:] = 0.9  # on the table: not drawn
    opening = np.where(quality > 0, 0.03, 0).astype(np.float32)
    valid = np.ones((height, width), bool)
    valid[19, :15] = False  # not labelled: not drawn
    labels, rng = GraspLabels(quality, opening, valid), np.random.default_rng(0)
    pairs = list(draw_pairs(frame, labels, GripperGeometry(), rng))

    zeros = 18 * 19 * 15 - 12
    found = sorted((q, weight) for _, q, weight in pairs)
    expected = [(0, zeros / 6)] * 6 + [(0.4, 1.0)] * 2 + [(0.65, 10 / 3)] * 3
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    for grasp, q, _ in pairs:
        assert grasp.width == pytest.approx(0.03 if q else GripperGeometry().max_opening)
        tips = grasp.position[2] - GripperGeometry().tip_below_centre
        assert tips == pytest.approx(0.05 - LabelSettings().depth, abs=1e-6)
    angles = {round(np.degrees(g.angle)) for g, q, _ in pairs if q > 0.6}
    # Bin 7 is 70 degrees on the image; +u is -y and +v is -x of this camera: -90 - 70, modulo 180.
    assert angles == {20}


# --- Whose data a folder holds ---------------------------------------------------------------


def folder_of(*overrides: str) -> Path:
    return data_folder(load_config(None, overrides))


@pytest.mark.parametrize(
    "override",
    [
        "seed=1", "sim.frequency=120", "camera.width=128", "camera.fov_deg=30",
        "workspace.size=0.25", "objects.density=500", "data.object_sets=primitives",
        "data.max_objects=3", "data.randomise=false", "data.executed_share=0.5",
    ],
)  # fmt: skip
def test_what_matters_to_an_image_changes_the_folder(override):
    assert folder_of(override) != folder_of()


@pytest.mark.parametrize(
    "override",
    [
        "data.frames=64", "data.validation_frames=32", "data.workers=3", "train.lr=1e-4",
        "camera.depth_noise=kinect", "objects.split=train", "evaluate.rounds=3", "cache_dir=x",
    ],
)  # fmt: skip
def test_what_does_not_matter_keeps_the_folder(override):
    assert folder_of(override) == folder_of()


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


def test_sets_that_cannot_be_parted_are_said_before_any_worker_starts(tmp_path):
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


@pytest.mark.slow
def test_interrupted_generation_goes_on_and_ends_in_the_same_bytes(tiny_data, tmp_path):
    folder, overrides = tiny_data
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    shard_path(copy, "train", 0).unlink()
    kept = os.stat(shard_path(copy, "validation", 0))
    assert generate(load_config(None, [*overrides, f"data.root={copy}"])) == copy
    again, first = (shard_path(data, "train", 0).read_bytes() for data in (copy, folder))
    assert again == first
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


def test_an_error_in_a_worker_cancels_the_shards_not_begun(tmp_path, monkeypatch):
    begun = []

    def make_shard(folder, split, number):
        begun.append(number)
        if number == 0:
            raise OSError(errno.ENOSPC, "no space")
        time.sleep(0.2)  # under way when the error is met
        return 32

    # A thread in place of the process, which would not know of the replaced functions.
    monkeypatch.setattr(
        data_generation, "ProcessPoolExecutor", lambda workers, **_: ThreadPoolExecutor(workers)
    )
    monkeypatch.setattr(data_generation, "_make_shard", make_shard)
    config = load_config(None, [f"data.root={tmp_path / 'data'}", "data.frames=960",
                                "data.object_sets=primitives", "data.workers=1"])  # fmt: skip
    with pytest.raises(OSError, match="no space"):
        generate(config)
    assert len(begun) < 5


def test_scenes_that_cannot_be_made_are_told(config, monkeypatch):
    def none(*_):
        raise SceneError("too many")

    monkeypatch.setattr(data_generation, "make_scene", none)
    given = load_config(None, ["data.object_sets=primitives"])
    with (
        PybulletCell(config) as cell,
        pytest.raises(UserError, match="none of 100 .*data.max_objects"),
    ):
        draw_scene(given, "train", 1, object_sets(given), cell)


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
    trials = read_trials(folder)
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


def test_validation_keeps_every_tenth_training_object_and_no_test_object(config):
    given = load_config(None, ["data.object_sets=primitives", "objects.split=test"])
    parts = object_sets(given)
    assert {key: len(part) for key, part in parts.items()} == {
        ("primitives", "validation"): 90,
        ("primitives", "train"): 810,
    }
    with PybulletCell(config) as cell:
        for split, kept in (("train", False), ("validation", True)):
            for seed in range(4):
                scene, _ = draw_scene(given, split, seed, parts, cell)
                for placed in scene.placements:
                    number = int(placed.model.name[-4:])  # 900 and above are for testing
                    assert number < 900 and (number % 10 == 0) is kept


# --- Looks -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def cell_with_scene(tiny_data):
    config = load_config(None, tiny_data[1])
    with PybulletCell(config) as cell:
        scene, _ = draw_scene(config, "train", 3, object_sets(config), cell)
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
        simulated = pybullet.getDynamicsInfo(cell.bodies[number], -1, cell.client)
        assert solid.friction == simulated[1] == first.placements[number].model.friction
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
    plain = Appearance().photograph(cell, *view, rng)
    count = len(scene.placements)
    for index in range(-1, count):  # the table, then every object
        textures = tuple(stripes(0.5) if i == index else None for i in range(-1, count))
        seen = Appearance(textures=textures).photograph(cell, *view, rng)
        assert np.array_equal(seen.depth, plain.depth)
        changed = (seen.rgb != plain.rgb).any(axis=-1)
        assert changed[plain.segmentation == index].mean() > 0.5
        assert not changed[plain.segmentation != index].any()
    noisy = Appearance(noise=5.0).photograph(cell, *view, rng)
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
