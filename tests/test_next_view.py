"""The next best view of boxes whose shadows are known by casting rays."""

from __future__ import annotations

import numpy as np
import pytest

from tests.helpers.box_frames import BOX, boxes_frame, from_side, seen_from
from utils.geometry import Workspace
from utils.height_map import height_map_from_frame
from utils.next_view import OpenSpace, dome
from utils.transforms import project

K = np.array([[194.0, 0.0, 111.5], [0.0, 194.0, 111.5], [0.0, 0.0, 1.0]])  # 60 degrees
SHAPE = (224, 224)


def open_space(*azimuths: float, boxes=(BOX,)) -> OpenSpace:
    frame = seen_from(*azimuths, boxes=boxes)
    return OpenSpace(height_map_from_frame(frame, Workspace()), Workspace())


def azimuth_of(T_WC: np.ndarray) -> float:
    x, y = T_WC[:2, 3] - (0.5, 0.0)
    return float(np.rad2deg(np.arctan2(y, x)))


def test_an_empty_table_leaves_nothing_open() -> None:
    space = OpenSpace(height_map_from_frame(boxes_frame([]), Workspace()), Workspace())
    assert space.volume == 0.0
    assert space.shown(K, SHAPE, dome(Workspace())[0]) == 0.0


def test_the_open_volume_is_that_of_the_shadow() -> None:
    """Against points drawn at random over the workspace: in the shadow are those outside the box
    that a segment to the eye meets the box before."""
    rng = np.random.default_rng(0)
    low, high = np.array([0.35, -0.15, 0.0]), np.array([0.65, 0.15, 0.10])
    points = rng.uniform(low, high, (40000, 3))
    half, middle = np.array(BOX[0]) / 2, np.array([0.5, 0.0, BOX[0][2] / 2])
    inside = (np.abs(points - middle) <= half).all(axis=1)
    way = from_side(0)[:3, 3] - points
    slabs = np.sort([(middle + sign * half - points) / way for sign in (-1, 1)], axis=0)
    near, far = slabs[0].max(axis=1), slabs[1].min(axis=1)
    shadow = ~inside & (near < far) & (far > 0) & (near < 1)
    volume = shadow.mean() * np.prod(high - low)
    assert open_space(0).volume == pytest.approx(volume, rel=0.05)
    assert open_space(0, 180).volume < 0.1 * volume


@pytest.mark.parametrize("azimuth", [0, 90, -120])
def test_the_best_view_is_from_the_other_side(azimuth: float) -> None:
    space = open_space(azimuth)
    shown = np.array([space.shown(K, SHAPE, T_WC) for T_WC in dome(Workspace())])
    off = np.array([azimuth_of(T_WC) - azimuth for T_WC in dome(Workspace())]) % 360 - 180
    assert abs(off[shown.argmax()]) < 90
    # Past a box as narrow as this one, views from farther aside show as much.
    assert shown[abs(off) <= 31].max() > 0.97 * shown.max() > 0.97 * 0.95 * space.volume
    assert space.shown(K, SHAPE, from_side(azimuth)) < 0.05 * space.volume  # whence it is hidden


def test_what_a_wall_hides_is_not_shown() -> None:
    """A high wall between a box's shadow and the camera that would see it best."""
    wall = ((0.01, 0.30, 0.25), 0.0, (0.38, 0.0))
    view = from_side(180, tilt=60.0, distance=0.45)
    free, behind = open_space(0), open_space(0, boxes=(BOX, wall))
    near_box = np.abs(behind.points[:, :2] - (0.44, 0.0)).max(axis=1) < 0.04
    behind.points = behind.points[near_box]
    assert free.shown(K, SHAPE, view) > 0.8 * free.volume
    assert behind.shown(K, SHAPE, view) < 0.2 * behind.volume


def test_the_dome_looks_at_the_workspace_from_everywhere() -> None:
    corners = np.array([(0.5 + x, y, 0.0) for x in (-0.15, 0.15) for y in (-0.15, 0.15)])
    poses = dome(Workspace())
    for T_WC in poses:
        pixels, depth = project(corners, K, T_WC)
        assert (pixels >= 0).all() and (pixels < 224).all() and (depth > 0).all()
    azimuths = np.sort([azimuth_of(T_WC) for T_WC in poses])
    assert np.diff(azimuths).max() <= 30 + 1e-6


@pytest.mark.parametrize("zoom", [1, 3, 6])
def test_the_view_that_hid_something_does_not_show_it(zoom: int) -> None:
    """Matter is as opaque to a camera of many pixels as to one of few."""
    space = open_space(0)
    K_zoomed = K * [[zoom, zoom, zoom], [zoom, zoom, zoom], [1, 1, 1]]
    shown = space.shown(K_zoomed, (224 * zoom, 224 * zoom), from_side(0))
    assert shown < 0.03 * space.volume
