"""Convex solids, gripper outline and height maps against closed forms."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from models.planners import HeuristicPlanner
from utils.geometry import (
    ConvexSolid,
    GripperGeometry,
    SceneGeometry,
    SolidObject,
    Workspace,
    intersect_lines,
)
from utils.height_map import HOLE_RISE, height_map_from_frame, height_map_from_scene
from utils.transforms import RGBDFrame, look_at, pose_matrix, project

CORNERS = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
K = np.array([[390.6, 0, 111.5], [0, 390.6, 111.5], [0, 0, 1.0]])  # 224 px, 32 degrees
T_WC = look_at((0.5, 0, 0.8), (0.5, 0, 0), up=(1, 0, 0))


def yaw_pose(x: float, y: float, z: float, yaw: float) -> np.ndarray:
    return pose_matrix((x, y, z), (0, 0, np.sin(yaw / 2), np.cos(yaw / 2)))


def boxes_frame(
    boxes: list[tuple[tuple[float, float, float], float, tuple[float, float]]],
) -> RGBDFrame:
    """The frame of boxes (size, yaw, (x, y)) standing on the table; depth by the slab formula."""
    v, u = np.mgrid[0:224, 0:224]
    rays = (
        np.stack([(u - 111.5) / 390.6, (v - 111.5) / 390.6, np.ones_like(u)], axis=-1)
        @ T_WC[:3, :3].T
    )
    eye = T_WC[:3, 3]
    depth = -eye[2] / rays[..., 2]
    things = []
    for size, yaw, (x, y) in boxes:
        half = np.array(size) / 2
        T = yaw_pose(x, y, half[2], yaw)
        local_eye, local_rays = (eye - T[:3, 3]) @ T[:3, :3], rays @ T[:3, :3]
        with np.errstate(divide="ignore"):
            slabs = np.sort([(s * half - local_eye) / local_rays for s in (-1, 1)], axis=0)
        near, far = slabs[0].max(axis=-1), slabs[1].min(axis=-1)
        depth = np.where((near < far) & (near < depth), near, depth)
        solid = ConvexSolid.from_vertices(CORNERS * half).transformed(T)
        things.append(SolidObject((solid,), T[:3, 3], 0.7))
    rgb = np.zeros((224, 224, 3), np.uint8)
    return RGBDFrame(rgb, depth.astype(np.float32), K, T_WC, truth=SceneGeometry(tuple(things)))


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


def test_height_maps_of_a_known_box() -> None:
    frame = boxes_frame([((0.06, 0.08, 0.05), 0.4, (0.47, 0.03))])
    for heights in (
        height_map_from_frame(frame, Workspace()),
        height_map_from_scene(frame.truth, Workspace()),
    ):
        box = frame.truth.objects[0].centre_of_mass[:2]
        c, s = np.cos(0.4), np.sin(0.4)
        rows, cols = np.mgrid[0 : heights.height.shape[0], 0 : heights.height.shape[1]]
        xy = heights.origin + heights.cell * np.stack([cols, rows], axis=-1) - box
        excess = np.abs(xy @ np.array([[c, -s], [s, c]])) - (0.03, 0.04)
        inside, outside = (excess < -0.002).all(axis=-1), (excess > 0.003).any(axis=-1)
        np.testing.assert_allclose(heights.height[inside], 0.05, atol=1e-4)
        np.testing.assert_allclose(heights.height[outside], 0.0, atol=1e-4)
        assert set(heights.label[inside]) == {0} and set(heights.label[outside]) == {-1}
        np.testing.assert_allclose(heights.centres, [[0.47, 0.03, 0.025]], atol=0.0015)


def test_only_the_hidden_strip_behind_a_box_may_hold_more_than_is_seen() -> None:
    # Outer face at x = 0.62, 0.05 high: the camera, 0.75 over its edge, hides
    # 0.12 * 0.05 / 0.75 = 8 mm of the table behind it.
    frame = boxes_frame([((0.04, 0.10, 0.05), 0.0, (0.60, 0.0))])
    heights = height_map_from_frame(frame, Workspace())
    rows, cols = np.nonzero(heights.ceiling > heights.height + 0.003)
    x = heights.origin[0] + heights.cell * cols
    assert len(x) and x.min() > 0.579 and x.max() < 0.631
    centre_row = heights.index(np.array([0.6, 0.0]))[0]
    assert x[rows == centre_row].min() > 0.618 and x[rows == centre_row].max() > 0.624


def test_a_hole_at_an_edge_does_not_lower_the_map() -> None:
    """A box 5 cm high, the pixels around its outline lost as a depth camera loses them."""
    frame = boxes_frame([((0.04, 0.06, 0.05), 0.0, (0.5, 0.0))])
    on_box = frame.depth < frame.depth.max() - 0.02
    edge = cv2.dilate(on_box.astype(np.uint8), np.ones((5, 5))) > cv2.erode(
        on_box.astype(np.uint8), np.ones((5, 5))
    )
    lossy = replace(frame, depth=np.where(edge, 0, frame.depth).astype(np.float32))
    whole, holed = (height_map_from_frame(f, Workspace()).height for f in (frame, lossy))
    assert edge.sum() > 200
    assert (holed >= whole - 1e-3).all()


def test_what_is_in_a_hole_may_be_higher_than_what_is_beside_it() -> None:
    frame = boxes_frame([((0.06, 0.06, 0.05), 0.0, (0.5, 0.0))])
    depth = frame.depth.copy()
    (u, v), _ = project(np.array([0.5, 0.0, 0.05]), frame.K, frame.T_WC)
    rows, columns = np.s_[int(v) - 3 : int(v) + 4], np.s_[int(u) - 3 : int(u) + 4]
    depth[rows, columns] = 0
    clean = height_map_from_frame(frame, Workspace())
    holed = height_map_from_frame(replace(frame, depth=depth), Workspace())
    np.testing.assert_allclose(holed.height, clean.height, atol=1e-4)
    raised = holed.ceiling - clean.ceiling
    assert raised.max() == pytest.approx(HOLE_RISE, abs=1e-4)
    at = np.argwhere(raised > 1e-3) * holed.cell + holed.origin[::-1]
    assert np.abs(at - (0.0, 0.5)).max() < 0.012


def test_a_thing_that_the_camera_did_not_measure_is_a_wall() -> None:
    """A black box, say: all of its pixels are holes."""
    small, black = ((0.03, 0.03, 0.04), 0.0, (0.45, 0.0)), ((0.10, 0.16, 0.10), 0.0, (0.56, 0.0))
    frame = boxes_frame([small, black])
    depth = np.where(frame.depth < boxes_frame([small]).depth - 1e-4, 0, frame.depth)
    heights = height_map_from_frame(replace(frame, depth=depth), Workspace())
    x, y = np.meshgrid(np.arange(0.53, 0.59, 0.01), np.arange(-0.05, 0.06, 0.01))
    inside = heights.index(np.stack([x, y], axis=-1))
    assert heights.height[inside].min() > 0.08 and set(heights.label[inside].ravel()) == {-1}
    for grasp in HeuristicPlanner(GripperGeometry(), Workspace())(replace(frame, depth=depth)):
        for side in (-1, 1):
            finger = grasp.position + side * (grasp.width / 2 + 0.007) * grasp.closing_direction
            assert not (abs(finger[0] - 0.56) < 0.04 and abs(finger[1]) < 0.07)
