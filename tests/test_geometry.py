"""Convex solids and the gripper's outline against closed forms."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.helpers.box_frames import CORNERS, yaw_pose
from utils.config import load_config
from utils.errors import UserError
from utils.geometry import (
    ConvexSolid,
    GripperGeometry,
    SceneGeometry,
    Workspace,
    intersect_lines,
)


def test_line_through_a_box_by_hand() -> None:
    box = ConvexSolid.from_vertices(CORNERS * (0.5, 1.0, 2.0))
    origins = [(-3, 0, 0), (0, 0, 9), (-3, 1.5, 0), (-1, 0, 0)]
    directions = [(2, 0, 0), (0, 0, -1), (1, 0, 0), (1, 1, 0)]
    hits = intersect_lines(box, origins, directions)
    assert hits.enter == pytest.approx([1.25, 7, np.inf, 0.5])
    assert hits.leave == pytest.approx([1.75, 11, -np.inf, 1.0])
    assert hits.hit.tolist() == [True, True, False, True]
    np.testing.assert_allclose(
        hits.enter_normal[[0, 1, 3]], [(-1, 0, 0), (0, 0, 1), (-1, 0, 0)], atol=1e-9
    )
    np.testing.assert_allclose(
        hits.leave_normal[[0, 1, 3]], [(1, 0, 0), (0, 0, -1), (0, 1, 0)], atol=1e-9
    )
    assert np.isnan(hits.enter_normal[2]).all()


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000))
def test_random_lines_against_points_along_them(seed: int) -> None:
    random = np.random.default_rng(seed)
    solid = ConvexSolid.from_vertices(random.normal(size=(12, 3)))
    origins, directions = random.normal(size=(2, 20, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    hits = intersect_lines(solid, origins, directions)
    t = np.linspace(-8, 8, 4001)
    points = origins[:, None] + t[:, None] * directions[:, None]
    inside = (points @ solid.normals.T <= solid.offsets).all(axis=-1)
    for line in range(20):
        if inside[line].any():
            lo, hi = t[inside[line]][[0, -1]]
            assert hits.enter[line] == pytest.approx(lo, abs=0.0041)
            assert hits.leave[line] == pytest.approx(hi, abs=0.0041)
        else:
            assert not hits.hit[line] or hits.leave[line] - hits.enter[line] < 0.0041


def test_a_moved_solid_is_hit_where_the_moved_line_was() -> None:
    T = yaw_pose(0.3, -0.2, 0.1, 0.7)
    solid = ConvexSolid.from_vertices(CORNERS)
    origin, direction = np.array([[-4, 0.2, 0.1]]), np.array([1.0, 0.1, 0.05])
    still = intersect_lines(solid, origin, direction)
    moved = intersect_lines(
        solid.transformed(T), origin @ T[:3, :3].T + T[:3, 3], T[:3, :3] @ direction
    )
    assert moved.enter == pytest.approx(still.enter) and moved.leave == pytest.approx(still.leave)
    np.testing.assert_allclose(moved.enter_normal, still.enter_normal @ T[:3, :3].T, atol=1e-9)


def test_walls_move_with_their_scene_and_hang_where_they_leave_room_below() -> None:
    """Over a table 10 cm high a board from 26 cm on hangs, 16 cm over it; a block from 12 cm on,
    and a wall from the table on, do not: less than 5 cm of room is none."""

    def block(low: float, high: float) -> ConvexSolid:
        corners = CORNERS * (0.1, 0.1, (high - low) / 2) + (0, 0, (high + low) / 2)
        return ConvexSolid.from_vertices(corners)

    board, low, wall = (block(*ends) for ends in ((0.26, 0.28), (0.12, 0.30), (0.10, 0.40)))
    scene = SceneGeometry((), 0.10, (board, low, wall))
    assert scene.uncovered().walls == (low, wall)
    T = np.eye(4)
    T[:3, 3] = 0.0, 0.2, 0.1
    moved = scene.transformed(T).walls[0]
    np.testing.assert_allclose(moved.vertices, board.vertices + T[:3, 3])


def test_the_configs_default_hand_is_the_pandas_own() -> None:
    assert load_config().gripper.geometry == GripperGeometry()


def test_gripper_outline_bounds_pybullets_meshes() -> None:
    folder = pytest.importorskip("pybullet_data").getDataPath() + "/franka_panda/meshes/collision/"

    def mesh(name: str) -> ConvexSolid:
        with open(folder + name) as lines:
            return ConvexSolid.from_vertices(
                [line.split()[1:4] for line in lines if line.startswith("v ")]
            )

    gripper, finger, hand = GripperGeometry(), mesh("finger.obj"), mesh("hand.obj")
    # panda.urdf: finger joints 0.0584, grasp target 0.105 below the hand frame.
    tip = 0.0584 + finger.vertices[:, 2].max()
    assert gripper.tip_below_centre == pytest.approx(tip - 0.105, abs=1e-4)
    assert gripper.finger_half_width == pytest.approx(finger.vertices[:, 0].max(), abs=1e-4)
    x, y = (
        axis.ravel()
        for axis in np.meshgrid(np.linspace(-0.0316, 0.0316, 41), np.linspace(-0.1, 0.1, 201))
    )
    columns = np.column_stack([x, y, 0 * x])
    for solid, base, claimed in (
        (finger, 0.0584, gripper.finger_underside(np.maximum(y, 0))),
        (hand, 0.0, gripper.palm_underside(x)),
    ):
        hits = intersect_lines(solid, columns, (0.0, 0.0, 1.0))
        true = tip - base - hits.leave
        assert (
            claimed[hits.hit] - true[hits.hit]
        ).max() < 0.0004  # the claimed outline is nowhere above the mesh


@pytest.mark.parametrize("part", [{"size": -1}, {"size": 0.0}, {"centre": (0.5,)},
                                  {"centre": (np.nan, 0)}, {"size": np.inf}])  # fmt: skip
def test_a_workspace_that_is_none_is_refused(part: dict) -> None:
    with pytest.raises(UserError, match="workspace: "):
        Workspace(**part)
