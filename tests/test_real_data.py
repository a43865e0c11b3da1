"""Loaders of the Cornell and Jacquard formats on tiny files made here."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from models.rectangle_folds import object_folds
from tests.helpers.real_images import CORNELL
from utils.errors import UserError
from utils.real_data import (
    CornellDataset,
    JacquardDataset,
    fill_depth_holes,
    open_real_data,
)

SQUARE = "10 5\n30 5\n30 15 \n10 15\n"  # opening 20, plates 10, centre (20, 10)
WITH_NAN = "NaN NaN\n30 5\n30 15\nNaN NaN\n"
JACQUARD_ID = "3_abc0f2"


def write_images(rgb_file: Path, depth_file: Path, depth=1.2, size=(32, 24)) -> None:
    rgb = np.zeros((size[1], size[0], 3), np.uint8)
    rgb[..., 0] = 200  # red, so that swapped channels are noticed
    Image.fromarray(rgb).save(rgb_file)
    Image.fromarray(np.full(size[::-1], depth, np.float32)).save(depth_file)


def write_cornell(folder: Path, number: int, positives=SQUARE, negatives="", **images) -> Path:
    stem = folder / f"pcd{number:04d}"
    folder.mkdir(parents=True, exist_ok=True)
    write_images(Path(f"{stem}r.png"), Path(f"{stem}d.tiff"), **images)
    Path(f"{stem}cpos.txt").write_text(positives)
    Path(f"{stem}cneg.txt").write_text(negatives)
    return folder


def write_jacquard(folder: Path, grasps="10.5;8.0;-30.0;12.0;4.0\n", name=JACQUARD_ID) -> Path:
    write_images(folder / f"{name}_RGB.png", folder / f"{name}_perfect_depth.tiff")
    (folder / f"{name}_grasps.txt").write_text(grasps)
    return folder


def test_cornell_sample(tmp_path):
    write_cornell(tmp_path / "01", 7, SQUARE + WITH_NAN, SQUARE)
    sample = CornellDataset(tmp_path)[0]
    assert sample.name == "pcd0007"
    assert sample.rgb.shape == (24, 32, 3) and sample.rgb.dtype == np.uint8
    assert sample.rgb[0, 0].tolist() == [200, 0, 0]
    assert sample.depth.shape == (24, 32) and sample.depth.dtype == np.float32
    assert (len(sample.positives), len(sample.negatives), sample.skipped) == (1, 1, 1)
    rectangle = sample.positives[0]
    assert rectangle.centre == pytest.approx((20, 10))
    assert (rectangle.width, rectangle.height, rectangle.angle) == pytest.approx((20, 10, 0))


def test_iteration_is_sorted_by_name_over_subfolders(tmp_path):
    write_cornell(tmp_path / "02", 200)
    write_cornell(tmp_path / "01", 199)
    write_cornell(tmp_path / "01", 8)
    data = open_real_data("cornell", tmp_path)
    assert [sample.name for sample in data] == data.names == ["pcd0008", "pcd0199", "pcd0200"]
    assert len(data) == 3


def test_a_file_that_is_there_twice_is_named_in_the_order_of_its_folders(tmp_path):
    """Whatever the order in which the file system lists them."""
    for folder in "cab":
        write_cornell(tmp_path / folder, 1)
    with pytest.raises(UserError) as raised:
        CornellDataset(tmp_path)
    first, second = tmp_path / "a" / "pcd0001cneg.txt", tmp_path / "b" / "pcd0001cneg.txt"
    assert str(raised.value) == f"pcd0001cneg.txt is there twice: {first} and {second}"


def test_objects_from_the_table_of_the_data_set(tmp_path):
    for number in (1000, 1001, 1002):
        write_cornell(tmp_path, number)
    (tmp_path / "z.txt").write_text("1000 4 cup 1\n1001 9 can 1\n1002 4 cup 1\n")
    assert CornellDataset(tmp_path).object_ids == ["object4", "object9", "object4"]
    (tmp_path / "z.txt").write_text("1000 4 cup 1\n")
    with pytest.raises(UserError, match="no row for image 1001"):
        CornellDataset(tmp_path)


def test_objects_without_a_table_are_blocks_of_consecutive_images(tmp_path):
    for number in (3, 4, 5, 8, 101, 102, 105, 106):
        write_cornell(tmp_path, number)
    with pytest.warns(UserWarning, match="no z.txt tells which images show the same object"):
        found = CornellDataset(tmp_path)
    assert found.object_ids == [
        "block0000", "block0004", "block0004", "block0008",
        "from0100", "from0102", "from0102", "from0106",
    ]  # fmt: skip


@pytest.mark.parametrize(
    "suffix, named",
    [("d.tiff", "pcd0001d.tiff.*point clouds"), ("r.png", "pcd0001r.png"), ("cneg.txt", "cneg")],
)
def test_missing_file(tmp_path, suffix, named):
    write_cornell(tmp_path, 1)
    (tmp_path / f"pcd0001{suffix}").unlink()
    with pytest.raises(UserError, match=f"1 files are missing: .*{named}"):
        CornellDataset(tmp_path)


def test_missing_folder_empty_folder_and_unknown_kind(tmp_path):
    with pytest.raises(UserError, match="no folder .*nowhere"):
        CornellDataset(tmp_path / "nowhere")
    with pytest.raises(UserError, match="no Cornell files"):
        CornellDataset(tmp_path)
    with pytest.raises(UserError, match="no Jacquard files"):
        JacquardDataset(tmp_path)
    with pytest.raises(UserError, match="did you mean cornell"):
        open_real_data("cornel", tmp_path)


@pytest.mark.parametrize(
    "positives, named",
    [
        (SQUARE[:-6], "3 corner rows"),
        (SQUARE.replace("5", "x"), "line 1"),
        (SQUARE.replace(" 5", ""), "line 1: need 2 numbers"),
        (WITH_NAN, "no complete rectangle"),
        ("", "no complete rectangle"),
        ("1 1\n" * 4, "width and height > 0"),
    ],
)
def test_broken_cornell_labels(tmp_path, positives, named):
    data = CornellDataset(write_cornell(tmp_path, 1, positives))
    with pytest.raises(UserError, match=rf"pcd0001cpos\.txt.*{named}"):
        data[0]


@pytest.mark.filterwarnings("ignore:Corrupt EXIF data")
@pytest.mark.parametrize("suffix", ["r.png", "d.tiff"])
@pytest.mark.parametrize("keep", [0, 20, 0.6])
def test_half_written_images(tmp_path, suffix, keep):
    file = write_cornell(tmp_path, 1) / f"pcd0001{suffix}"
    content = file.read_bytes()
    file.write_bytes(content[: keep if keep != 0.6 else int(0.6 * len(content))])
    with pytest.raises(UserError, match=rf"pcd0001{suffix}.*not a readable image"):
        CornellDataset(tmp_path)[0]


@pytest.mark.parametrize(
    "depth, named",
    [(1200, "millimetres"), (0, "every depth is zero"), (np.nan, "every depth is zero")],
)
def test_implausible_depth(tmp_path, depth, named):
    with pytest.raises(UserError, match=named):
        CornellDataset(write_cornell(tmp_path, 1, depth=depth))[0]


def test_depth_of_another_size(tmp_path):
    write_cornell(tmp_path, 1)
    write_images(tmp_path / "other.png", tmp_path / "pcd0001d.tiff", size=(30, 24))
    with pytest.raises(UserError, match="30 x 24 px, but pcd0001r.png is 32 x 24 px"):
        CornellDataset(tmp_path)[0]


def test_holes_take_the_nearest_measured_depth():
    depth = np.array([[1.0, np.nan, 1.3, 1.3, 0.0, np.inf, 12.0, 2.0]] * 2)
    depth[0, 1], depth[1, :2] = 1.1, (-1.0, 1.2)
    filled = fill_depth_holes(depth)
    assert filled.dtype == np.float32
    # One column each: the second row's first takes 1.0 above it or 1.2 beside it, as near.
    assert filled[:, 1:] == pytest.approx(
        np.array([[1.1, 1.3, 1.3, 1.3, 1.3, 2.0, 2.0], [1.2, 1.3, 1.3, 1.3, 1.3, 2.0, 2.0]])
    )
    assert filled[1, 0] in (np.float32(1.0), np.float32(1.2))
    with pytest.raises(ValueError, match="no pixel"):
        fill_depth_holes(np.zeros((2, 2)))


def test_jacquard_sample(tmp_path):
    data = JacquardDataset(write_jacquard(tmp_path))
    sample = data[0]
    assert (sample.name, sample.object_id) == (JACQUARD_ID, "abc0f2")
    rectangle = sample.positives[0]
    assert rectangle.centre == pytest.approx((10.5, 8))
    assert rectangle.angle == pytest.approx(np.radians(150))  # -30 degrees, modulo pi
    assert (rectangle.width, rectangle.height) == (12, 4)
    assert sample.negatives == ()
    assert np.all(sample.depth == np.float32(1.2))


@pytest.mark.parametrize(
    "grasps, named",
    [
        ("", "holds no grasp"),
        ("1;2;3;4\n", "line 1: need 5 numbers"),
        ("1;2;3;4;5\n1;2;nan;4;5\n", "grasp 2: .*non-finite"),
        ("1;2;3;-4;5\n", "grasp 1: .*> 0"),
        ("1;2;3;4;five\n", "line 1"),
    ],
)
def test_broken_jacquard_labels(tmp_path, grasps, named):
    data = JacquardDataset(write_jacquard(tmp_path, grasps))
    with pytest.raises(UserError, match=named):
        data[0]


@pytest.mark.skipif(not CORNELL.is_dir(), reason=f"no Cornell data at {CORNELL}")
def test_the_real_cornell_images():
    data = CornellDataset(CORNELL)
    assert len(data) == 80 and len(set(data.object_ids)) == 21
    skipped = {}
    for sample in data:
        assert sample.rgb.shape == (480, 640, 3)
        low, middle, high = np.percentile(sample.depth, [0.1, 50, 99.9])
        assert 0.7 < low < 1.0 < middle < 1.5 < high < 2.2  # metres: camera over 1 m away
        assert sample.positives
        for rectangle in sample.positives:
            assert (rectangle.centre >= 0).all() and (rectangle.centre < (640, 480)).all()
        if sample.skipped:
            skipped[sample.name] = sample.skipped
    assert skipped == {"pcd0132": 2, "pcd0165": 1}  # the NaN rows of the two cpos files
    # Objects begin at 114, 133, 149, 165 nearest to the fifths 116, 132, 148, 164.
    assert [len(fold.test) for fold in object_folds(data.object_ids, 5)] == [14, 19, 16, 16, 15]
