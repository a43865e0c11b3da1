"""Depth beside edges, told by colour."""

import cv2
import numpy as np

from utils.depth_edges import depth_by_colour
from utils.depth_noise import KinectNoise
from utils.transforms import RGBDFrame

K = np.array([[449.0, 0.0, 111.5], [0.0, 449.0, 111.5], [0.0, 0.0, 1.0]])
LOOKING_DOWN = np.diag([1.0, -1.0, -1.0, 1.0])


def scene() -> RGBDFrame:
    """A red disc and a green bar, 5 cm over a grey table 80 cm away."""
    depth, rgb = np.full((224, 224), 0.8, np.float32), np.full((224, 224, 3), 150, np.uint8)
    for draw in (
        lambda image, value: cv2.circle(image, (70, 80), 25, value, -1),
        lambda image, value: cv2.rectangle(image, (110, 120), (190, 145), value, -1),
    ):
        draw(depth, 0.75)
    cv2.circle(rgb, (70, 80), 25, (200, 40, 30), -1)
    cv2.rectangle(rgb, (110, 120), (190, 145), (30, 160, 60), -1)
    return RGBDFrame(rgb, depth, K, LOOKING_DOWN)


def off(depth: np.ndarray, truth: np.ndarray) -> float:
    """Share of the pixels within 6 of an edge that are unknown or wrong by over 1 cm."""
    edge = cv2.morphologyEx(truth, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > 0.01
    near = cv2.dilate(edge.astype(np.uint8), np.ones((13, 13), np.uint8)) > 0
    return float((np.abs(depth - truth) > 0.01)[near].mean())


def test_edges_are_where_the_colours_change() -> None:
    """Of uniform colours on a flat table there is nothing that colour does not tell."""
    frame = scene()
    noisy = KinectNoise(image_focal=449.0)(frame.depth, np.random.default_rng(0))
    assert off(noisy, frame.depth) > 0.15
    mended = depth_by_colour(RGBDFrame(frame.rgb, noisy, K, LOOKING_DOWN)).depth
    assert off(mended, frame.depth) < 0.01


def test_a_clean_image_stays_as_it_is() -> None:
    frame = scene()
    np.testing.assert_array_equal(depth_by_colour(frame).depth, frame.depth)


def test_what_nothing_resembles_stays_unknown() -> None:
    """A thin blue mast in a hole: no reliable pixel is blue."""
    frame = scene()
    frame.depth[20:60, 150:158] = 0
    frame.rgb[20:60, 152:155] = (20, 30, 220)
    mended = depth_by_colour(frame).depth
    assert (mended[20:60, 152:155] == 0).all()
    np.testing.assert_allclose(mended[24:56, 150], 0.8)


def test_without_any_depth_nothing_is_told() -> None:
    frame = scene()
    frame.depth[:] = 0
    assert (depth_by_colour(frame).depth == 0).all()
