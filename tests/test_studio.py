"""Pictures of scenes: what cannot be written is said before anything is simulated."""

from __future__ import annotations

import pytest

from envs.studio import check_files
from utils.errors import UserError


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
