"""Pictures for the documentation: where they are written."""

from importlib import import_module
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest

from benchmarks import show_depth
from utils.runs import REPOSITORY
from utils.transforms import RGBDFrame

SCRIPTS = sorted(path.stem for path in (REPOSITORY / "benchmarks").glob("show_*.py"))


class Parsed(Exception):
    """Ends a script once its arguments are known."""


@pytest.mark.parametrize("name", sorted({*SCRIPTS} - {"show_grasp_loop", "show_robot"}))
def test_pictures_go_under_runs_which_git_ignores(name, monkeypatch):
    script = import_module(f"benchmarks.{name}")
    parse = script.parse_args

    def stop(*args, **others):
        raise Parsed(parse(*args, **others)[1].output)

    monkeypatch.setattr(script, "parse_args", stop)
    with pytest.raises(Parsed) as parsed:
        script.main([])
    assert parsed.value.args[0].parts[:2] == ("runs", name)


def test_the_folder_of_a_picture_is_made(monkeypatch, tmp_path, capsys):
    image = np.zeros((240, 240, 3), np.uint8)
    frame = RGBDFrame(image, np.full((240, 240), 0.8, np.float32), np.eye(3), np.eye(4))
    monkeypatch.setattr(show_depth, "frames_of", lambda *_: {"none": frame})
    monkeypatch.chdir(tmp_path)
    show_depth.main([])
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]
    assert iio.imread(tmp_path / "runs" / "show_depth" / "depth.png").ndim == 3
    assert f"wrote {Path('runs', 'show_depth', 'depth.png')}" in capsys.readouterr().out
