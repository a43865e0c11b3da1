"""Views from the side that a scene's seed draws."""

import re
import shlex

import numpy as np
import pytest

from envs.cell_layout import Placement, Scene, side_view
from envs.objects import load_object_set
from envs.simulators import make_cell
from utils.config import load_config
from utils.errors import UserError
from utils.runs import REPOSITORY


def test_side_views_look_at_the_workspace_from_all_sides_within_their_ranges():
    config = load_config(None, ["workspace.center=[0.45,0.1]"])
    poses = np.array([side_view(config.camera, config.workspace, seed) for seed in range(400)])
    away = poses[:, :3, 3] - (0.45, 0.1, 0.0)
    distance = np.linalg.norm(away, axis=1)
    tilt = np.degrees(np.arccos(away[:, 2] / distance))
    azimuth = np.degrees(np.arctan2(away[:, 1], away[:, 0]))
    for values, low, high in ((distance, 0.6, 0.75), (tilt, 45, 60), (azimuth, -180, 180)):
        assert low <= values.min() < low + 0.02 * (high - low)
        assert high - 0.02 * (high - low) < values.max() <= high
        spread = (high - low) / np.sqrt(12)  # of a uniform distribution
        assert values.mean() == pytest.approx((low + high) / 2, abs=4 * spread / 20)
    # The optical axis passes through the centre, and the image's upper edge is level.
    np.testing.assert_allclose(poses[:, :3, 2], -away / distance[:, None], atol=1e-12)
    np.testing.assert_allclose(poses[:, 2, 0], 0.0, atol=1e-12)
    assert (poses[:, 2, 1] < 0).all()


def test_the_same_seed_gives_the_same_view():
    config = load_config(None)
    first, again, other = (side_view(config.camera, config.workspace, s) for s in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert abs(first - other).max() > 1e-3


@pytest.mark.parametrize(
    "override",
    ["camera.side_tilt_deg=[60,45]", "camera.side_tilt_deg=[0,45]", "camera.side_distance=[0,1]"],
)
def test_impossible_ranges_are_refused(override):
    with pytest.raises(UserError, match=r"must be a range \[low, high\] within"):
        load_config(None, [override])


@pytest.mark.parametrize("name", ["vgn", "giga"])
def test_the_cameras_of_the_protocols(name):
    """540 pixels of focal length, 640 x 480; GIGA's stands still, 0.6 m from a point 5 cm over the
    table's middle and 60 degrees off the vertical."""
    from envs.cell import camera_intrinsics

    config = load_config(REPOSITORY / "configs" / f"{name}.yaml")
    K = camera_intrinsics(config.camera).K
    assert K[0, 0] == pytest.approx(540, abs=0.01) and (K[0, 2], K[1, 2]) == (319.5, 239.5)
    if name == "vgn":
        assert config.camera.view == "side"
        return
    away = np.subtract(config.camera.position, config.camera.target)
    assert config.camera.view == "fixed" and tuple(config.camera.target) == (0.5, 0.0, 0.05)
    assert np.linalg.norm(away) == pytest.approx(0.6, abs=1e-4)
    assert np.degrees(np.arccos(away[2] / np.linalg.norm(away))) == pytest.approx(60, abs=0.01)


@pytest.mark.parametrize("name", ["vgn", "giga"])
def test_the_whole_arm_plays_the_protocols_as_the_page_says(name):
    """The page's command makes a cell whose cameras see a cube in the workspace's middle, in all of
    ten scenes, for the arm at rest is in none of their ways."""
    page = (REPOSITORY / "docs" / "vgn.md").read_text(encoding="utf-8")
    (line,) = re.findall(rf"configs/{name}\.yaml (robot\.arm=panda .*)", page)
    config = load_config(REPOSITORY / "configs" / f"{name}.yaml", shlex.split(line))
    cubes = load_object_set("box", cache_dir=config.cache_folder)
    at = Placement(cubes[0], np.array([*config.workspace.center, 0.03]), np.eye(4)[3])
    with make_cell(config) as cell:
        for seed in range(10):
            cell.load(Scene("isolated", seed, (at,)))
            frame = cell.frame()
            # From 0.75 m a face is 43 pixels wide, and no view of a cube shows less than a face.
            assert (frame.segmentation == 0).sum() > 43 * 43
