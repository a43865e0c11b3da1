"""What the holes of a depth image are taken for."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.helpers.box_frames import boxes_frame
from utils import depth_holes
from utils.depth_holes import depth_of_plane, near_side, surfaces_in_holes, table_in_holes
from utils.transforms import RGBDFrame

TABLE, ITEM = (158, 152, 142), (30, 160, 60)
BOX = ((0.04, 0.06, 0.05), 0.4, (0.5, 0.0))


def with_a_hole() -> tuple[RGBDFrame, np.ndarray, np.ndarray]:
    """A green box on a grey table whose depth is lost on and around one of its edges; the clean
    depth; where it is lost."""
    frame = boxes_frame([BOX])
    on_box = frame.points()[..., 2] > 0.001
    rgb = np.where(on_box[..., None], ITEM, TABLE).astype(np.uint8)
    v, u = np.argwhere(on_box).T
    lost = np.zeros(on_box.shape, bool)
    lost[v.min() - 8 : v.min() + 8, u.min() : u.max() + 12] = True
    assert (lost & on_box).sum() > 50 and (lost & ~on_box).sum() > 50
    return replace(frame, rgb=rgb, depth=np.where(lost, 0, frame.depth)), frame.depth, lost


def test_holes_count_as_the_near_surface_beside_them() -> None:
    depth = np.full((20, 20), 0.8, np.float32)
    depth[:, 10:] = 0.7
    depth[5:8, 8:12] = 0.0  # over the edge
    depth[15, 2] = np.nan  # within the table
    filled = near_side(depth, 16)
    assert (filled[5:8, 8:12] == np.float32(0.7)).all()
    assert filled[15, 2] == np.float32(0.8)
    known = depth > 0
    np.testing.assert_array_equal(filled[known], depth[known])
    depth[5:8] = 0.0  # a hole takes the nearest surface around it as far as it reaches
    depth[5:8, 19] = 0.6
    assert (near_side(depth, reach=9)[5:8, 10:19] == np.float32(0.6)).all()
    assert near_side(depth, reach=9)[6, 5] == np.float32(0.7)
    assert (near_side(np.zeros((20, 20), np.float32), 16) == 0).all()
    clean = np.full((4, 4), 0.5, np.float32)
    assert near_side(clean, 16) is clean


def test_what_has_the_tables_colour_is_table_and_nothing_else() -> None:
    frame, clean, lost = with_a_hole()
    found = table_in_holes(frame, 0.0).depth
    on_box = (frame.rgb == ITEM).all(axis=-1)
    assert (found[lost & on_box] == 0).all(), "a part of the box stays unknown"
    np.testing.assert_allclose(found[lost & ~on_box], clean[lost & ~on_box], atol=1e-5)
    np.testing.assert_array_equal(found[~lost], frame.depth[~lost])


def test_an_object_of_the_tables_colour_stays_unknown() -> None:
    frame, _, lost = with_a_hole()
    grey = replace(frame, rgb=np.full_like(frame.rgb, 150))
    assert (table_in_holes(grey, 0.0).depth[lost] == 0).all()


def test_colours_beyond_the_smeared_rim_count() -> None:
    """Two pixels of table around the box are measured as box, as by a camera that matches
    windows: they must not make the table's colour that of an object."""
    frame, clean, lost = with_a_hole()
    near = clean.min()
    for _ in range(2):
        rim = near_side(np.where(clean < near + 0.002, clean, 0).astype(np.float32), 2)
        frame = replace(
            frame, depth=np.where(~lost & (rim > 0) & (rim < near + 0.002), rim, frame.depth)
        )
    found = table_in_holes(frame, 0.0).depth
    on_box = (frame.rgb == ITEM).all(axis=-1)
    np.testing.assert_allclose(found[lost & ~on_box], clean[lost & ~on_box], atol=1e-5)


def test_a_thin_post_of_the_tables_colour_stays_unknown() -> None:
    """Thinner than the smeared rim that is left out of an object's colour."""
    frame = boxes_frame([((0.006, 0.006, 0.06), 0.0, (0.5, 0.03)), BOX])
    post = (frame.points()[..., 2] > 0.01) & (frame.points()[..., 1] > 0.02)
    green = (frame.points()[..., 2] > 0.001) & ~post
    rgb = np.where(green[..., None], ITEM, TABLE).astype(np.uint8)
    lost = post & (np.arange(224) % 2 == 0)
    assert lost.sum() >= 4
    frame = replace(frame, rgb=rgb, depth=np.where(lost, 0, frame.depth))
    assert (table_in_holes(frame, 0.0).depth[lost] == 0).all()


def test_a_wide_hole_of_the_tables_colour_stays_unknown() -> None:
    """Glass shows the table."""
    frame, clean, _ = with_a_hole()
    lost = np.zeros(clean.shape, bool)
    lost[150:200, 20:70] = True
    found = table_in_holes(replace(frame, depth=np.where(lost, 0, clean)), 0.0).depth
    assert (found[155:195, 25:65] == 0).all()


@pytest.mark.parametrize("noise", [4, 8])
def test_noisy_colours_are_told_apart(noise: int) -> None:
    frame, clean, lost = with_a_hole()
    on_box = (frame.rgb == ITEM).all(axis=-1)
    rng = np.random.default_rng(0)
    rgb = np.clip(frame.rgb + rng.normal(0, noise, frame.rgb.shape), 0, 255).astype(np.uint8)
    found = table_in_holes(replace(frame, rgb=rgb), 0.0).depth
    assert (found[lost & on_box] == 0).mean() > 0.99
    # The colours of the box's rim are smoothed into the table's.
    assert (np.abs(found - clean)[lost & ~on_box] < 1e-5).mean() > 0.85


def test_a_hole_at_an_edge_takes_the_depth_of_the_surface_that_has_its_colour() -> None:
    """Along the outline of a box, on it and on the table; a colour of neither stays unknown, and
    so does a hole within a surface, in which a thin part may stand that was lost whole."""
    frame, clean, _ = with_a_hole()
    on_box = (frame.rgb == ITEM).all(axis=-1)
    square = np.ones((3, 3), np.uint8)
    outline = cv2.dilate(on_box.astype(np.uint8), square) != cv2.erode(
        on_box.astype(np.uint8), square
    )
    assert (outline & on_box).sum() > 50 and (outline & ~on_box).sum() > 50
    frame = replace(frame, depth=np.where(outline, 0, clean))
    found = surfaces_in_holes(frame).depth
    np.testing.assert_allclose(found, clean, atol=1e-3)
    np.testing.assert_array_equal(found[~outline], clean[~outline])
    strange = np.where(outline[..., None], (200, 30, 30), frame.rgb).astype(np.uint8)
    assert (surfaces_in_holes(replace(frame, rgb=strange)).depth[outline] == 0).all()
    within = cv2.erode(on_box.astype(np.uint8), np.ones((13, 13), np.uint8)) > 0
    assert within.sum() > 20
    found = surfaces_in_holes(replace(frame, depth=np.where(within, 0, clean))).depth
    assert (found[within] == 0).all()


def test_of_two_surfaces_of_one_colour_the_nearer_one_in_the_image_counts() -> None:
    depth = np.full((20, 40), 0.8, np.float32)
    depth[:, 20:] = 0.7
    depth[:, 18:21] = 0.0
    frame = RGBDFrame(
        np.full((20, 40, 3), 90, np.uint8), depth, np.diag([400.0, 400.0, 1.0]), np.eye(4)
    )
    found = surfaces_in_holes(frame).depth[10]
    np.testing.assert_array_equal(found[[18, 20]], np.float32([0.8, 0.7]))


def test_images_without_holes_or_without_depth_are_left_alone() -> None:
    frame = boxes_frame([BOX])
    assert table_in_holes(frame, 0.0) is frame
    nothing = replace(frame, depth=np.zeros_like(frame.depth))
    assert table_in_holes(nothing, 0.0) is nothing
    assert surfaces_in_holes(frame) is frame
    assert surfaces_in_holes(nothing) is nothing


@pytest.mark.parametrize("height", [0.0, 0.05])
def test_rays_meet_a_plane_where_they_should(height: float) -> None:
    frame = boxes_frame([])
    points = replace(frame, depth=depth_of_plane(frame, height)).points()
    np.testing.assert_allclose(points[..., 2], height, atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_holes_take_the_first_pixel_of_their_colour(seed: int) -> None:
    """In an image with many alike and many lost pixels, up to its border."""
    random = np.random.default_rng(seed)
    depth = random.uniform(0.5, 0.6, (9, 11)).astype(np.float32)
    rgb = random.choice(np.array([10, 20, 60], np.uint8), (9, 11, 3))
    known = random.random(depth.shape) < 0.4
    holes = ~known & (random.random(depth.shape) < 0.7)
    steps = [(0, 1), (0, -1), (1, 0), (-1, 0), (2, 1), (-2, -1)]
    expected = np.where(known, depth, 0)
    for v, u in zip(*np.nonzero(holes)):
        for down, right in steps:
            y, x = v + down, u + right
            inside = 0 <= y < 9 and 0 <= x < 11
            if inside and known[y, x] and np.linalg.norm(1.0 * rgb[y, x] - rgb[v, u]) < 20:
                expected[v, u] = depth[y, x]
                break
    found = depth_holes._from_alike(depth, rgb, known, holes, np.array(steps))
    np.testing.assert_array_equal(found, expected)
    assert (found[holes] > 0).sum() > 5
