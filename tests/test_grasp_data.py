"""Simulated grasp data on disk: what is stored comes back, and damaged shards are named."""

from __future__ import annotations

import errno
import pickle
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from tests.helpers.box_frames import boxes_frame
from utils import grasp_data
from utils.errors import UserError
from utils.geometry import GripperGeometry, SceneGeometry, SolidObject, Workspace
from utils.grasp_data import LabelledFrame, SimulatedDataset, read_trials, shard_path, write_shard
from utils.grasp_labels import GraspLabels, Trial, dense_labels
from utils.transforms import RGBDFrame, look_at, project

SHAPE = (5, 7)
OVERHEAD = look_at((0.5, 0.0, 0.8), (0.5, 0.0, 0.0), (1, 0, 0))


def pinhole(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def made_up(rng: np.random.Generator, T_WC: np.ndarray = OVERHEAD) -> LabelledFrame:
    things = [SolidObject((), rng.uniform(-0.1, 0.1, 3), 0.5) for _ in range(rng.integers(1, 4))]
    frame = RGBDFrame(
        rng.integers(0, 256, (*SHAPE, 3), dtype=np.uint8),
        rng.uniform(0, 3.2, SHAPE).astype(np.float32),
        pinhole(*rng.uniform(1, 500, 4)),
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
    assert read_trials(folder) == 2 * [trials]


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
    assert read_trials(tmp_path) == [[]]


def test_frames_limits_how_many_are_used(stored):
    folder, _, _ = stored
    images = SimulatedDataset(folder, "train", 3)
    assert len(images) == 3 and len(list(images)) == 3
    with pytest.raises(IndexError):
        images[3]
    assert len(SimulatedDataset(folder, "train", 10)) == 4


def test_few_files_are_open_at_a_time(stored, monkeypatch):
    monkeypatch.setattr(grasp_data, "_MOST_OPEN", 1)
    images = SimulatedDataset(stored[0], "train")
    assert len(images.paths) > 1
    once = [images[i].rgb for i in range(len(images))]
    assert all(np.array_equal(images[i].rgb, once[i]) for i in reversed(range(len(images))))
    assert len(images._files) == 1


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


# --- Hostile files --------------------------------------------------------------------------------


def link_elsewhere(file, folder):
    del file["K"]
    file["K"] = h5py.ExternalLink(folder / "other.h5", "K")


def store_elsewhere(file, folder):
    del file["K"]
    file.create_dataset("K", (2, 3, 3), "f8", external=[(str(folder / "secret"), 0, 144)])


def ask_for_terabytes(file, folder):
    del file["centres"]
    file.create_dataset("centres", (2, 10**10, 3), "f8", chunks=(1, 1000, 3))


def ask_for_frames_without_end(file, folder):
    shape = (10**9, *file["depth"].shape[1:])
    del file["depth"]
    file.create_dataset("depth", shape, "u2", chunks=(1, *shape[1:]))


def ask_for_images_of_gigabytes(file, folder):
    """In chunks that were never written."""
    side, bins = 4096, 4096
    image, labels = (side, side), (bins, side, side)
    shapes = dict.fromkeys(("depth", "valid", "instance"), image) | {"rgb": (*image, 3)}
    for name, shape in (shapes | {"quality": labels, "width": labels}).items():
        kind, attributes = file[name].dtype, dict(file[name].attrs)
        del file[name]
        data = file.create_dataset(name, (2, *shape), kind, chunks=(1,) * (1 + len(shape)))
        data.attrs.update(attributes)


def change_the_type(file, folder):
    del file["valid"]
    file["valid"] = np.ones((2, *SHAPE), np.float64)


def change_the_shape(file, folder):
    del file["T_WC"]
    file["T_WC"] = np.zeros((2, 3, 3))


@pytest.mark.parametrize(
    "spoil",
    [
        link_elsewhere, store_elsewhere, ask_for_terabytes, ask_for_frames_without_end,
        ask_for_images_of_gigabytes, change_the_type, change_the_shape,
    ],
)  # fmt: skip
def test_what_no_shard_has_is_refused(stored, spoil):
    folder, *_ = stored
    path = shard_path(folder, "train", 0)
    (folder / "other.h5").write_bytes(path.read_bytes())
    (folder / "secret").write_bytes(bytes(144))
    with h5py.File(path, "a") as file:
        spoil(file, folder)
    with pytest.raises(UserError, match="00000.h5: not a readable data shard"):
        SimulatedDataset(folder, "train")


def test_an_object_without_a_centre_is_noticed(stored):
    folder, *_ = stored
    with h5py.File(shard_path(folder, "train", 0), "a") as file:
        file["instance"][1] = 100
    images = SimulatedDataset(folder, "train")
    images[0]
    with pytest.raises(UserError, match="not a readable data shard .instance names objects"):
        images[1]


def test_a_flipped_bit_is_noticed(stored):
    """In the middle of the numbers of an image, which HDF5 alone would decompress to others."""
    folder, *_ = stored
    path = shard_path(folder, "train", 0)
    with h5py.File(path) as file:
        place = file["rgb"].id.get_chunk_info(1).byte_offset + 20
    content = bytearray(path.read_bytes())
    content[place] ^= 4
    path.write_bytes(content)
    images = SimulatedDataset(folder, "train")
    images[0]
    with pytest.raises(UserError, match="00000.h5: not a readable data shard.*delete it"):
        images[1]


def test_a_shard_that_is_cut_short_while_it_is_read_is_named(stored):
    folder, *_ = stored
    images = SimulatedDataset(folder, "train")
    images[0]
    path = shard_path(folder, "train", 1)
    path.write_bytes(path.read_bytes()[:3000])
    with pytest.raises(UserError, match="00001.h5: not a readable data shard"):
        images[2]
