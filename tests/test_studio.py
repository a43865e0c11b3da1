"""Pictures of scenes: what cannot be written is said before anything is simulated, and what is
written is whole."""

from __future__ import annotations

import imageio.v3 as iio
import numpy as np
import pytest

from envs import studio
from envs.studio import Film, check_files, write_film, write_rgbd
from utils.errors import UserError
from utils.transforms import RGBDFrame

PICTURES = [np.full((32, 48, 3), level, np.uint8) for level in (0, 120, 240)]
FRAME = RGBDFrame(PICTURES[1], np.full((32, 48), 0.5, np.float32), np.eye(3), np.eye(4))


@pytest.mark.parametrize("name", ["scene.png", "scene.JPG", None])
def test_pictures_and_new_folders_pass(tmp_path, name) -> None:
    check_files(None if name is None else tmp_path / name, tmp_path / "new")


@pytest.mark.parametrize(
    ("picture", "folder", "message"),
    [
        ("scene.txt", "new", "--output .*scene.txt: expected a file .png or .jpg or .jpeg"),
        ("no/scene.png", None, "--output .*no/scene.png: not a file in an existing folder"),
        (None, "taken", "--rgbd .*taken: this name is taken"),
    ],
)
def test_what_cannot_be_written_is_refused(tmp_path, picture, folder, message) -> None:
    (tmp_path / "taken").touch()
    with pytest.raises(UserError, match=message):
        check_files(*(None if name is None else tmp_path / name for name in (picture, folder)))


def test_an_image_that_could_not_be_finished_leaves_no_folder(tmp_path, monkeypatch) -> None:
    """Else the same command would be refused afterwards, because the name is taken."""
    write = studio.write_atomic

    def full(path, content):
        if path.name == "T_WC.txt":
            raise UserError("no room")
        write(path, content)

    with monkeypatch.context() as patched:
        patched.setattr(studio, "write_atomic", full)
        with pytest.raises(UserError, match="no room"):
            write_rgbd(FRAME, tmp_path / "in" / "scene", PICTURES[0])
    assert list((tmp_path / "in").iterdir()) == []
    write_rgbd(FRAME, tmp_path / "in" / "scene", PICTURES[0])
    (folder,) = (tmp_path / "in").iterdir()
    names = ["T_WC.txt", "color.png", "depth.png", "intrinsics.json", "scene.png"]
    assert sorted(file.name for file in folder.iterdir()) == names
    assert (iio.imread(folder / "depth.png") == 500).all()
    assert (iio.imread(folder / "color.png") == FRAME.rgb).all()
    with pytest.raises(UserError, match="scene: this name is taken"):
        write_rgbd(FRAME, folder)


@pytest.mark.parametrize("ending", ["mp4", "gif"])
def test_a_film_that_could_not_be_finished_leaves_the_one_before(tmp_path, ending) -> None:
    path = tmp_path / "films" / f"0.{ending}"
    write_film(path, PICTURES, 6.0)
    before = path.read_bytes()
    assert len(iio.imread(path)) >= len(PICTURES)

    no_picture = np.zeros((16, 16, 7), np.uint8)
    with pytest.raises((ValueError, TypeError)):
        write_film(path, [*PICTURES, no_picture], 6.0)
    assert path.read_bytes() == before
    assert [file.name for file in path.parent.iterdir()] == [path.name]


def test_a_film_keeps_its_pictures_small_and_bit_for_bit(cell) -> None:
    shown = []
    with Film(cell, rate=60, size=(120, 92)) as film:
        take = film._studio.picture
        film._studio.picture = lambda: shown.append(take()) or shown[-1]
        cell.step(40)
        kept = sum(one.nbytes for one in film._pictures)
        pictures = list(film.stop())
    assert len(pictures) == len(shown) > 5 and cell.on_step is None
    np.testing.assert_array_equal(pictures, shown)
    assert kept < sum(picture.nbytes for picture in shown) / 3


def test_a_film_ends_with_what_it_shows(cell) -> None:
    with pytest.raises(RuntimeError), Film(cell):
        raise RuntimeError
    assert cell.on_step is None
