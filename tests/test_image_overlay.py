"""Grasps drawn on images, and contact sheets."""

import math
from dataclasses import replace

import numpy as np
import pytest

from utils.image_overlay import (
    FAILURE_COLOR,
    SUCCESS_COLOR,
    TITLE_HEIGHT,
    contact_sheet,
    draw_grasp,
)
from utils.transforms import ImageGrasp

K = np.array([[200.0, 0, 50], [0, 200, 50], [0, 0, 1]])


@pytest.mark.parametrize("angle", [0.0, math.pi / 2])
def test_overlay_plates_stand_at_half_the_width(angle):
    image = np.full((101, 101, 3), 128, np.uint8)
    grasp = ImageGrasp(np.array([50.0, 50.0]), angle, depth=0.5, width=0.1, quality=1.0)
    drawn = draw_grasp(image, grasp, K, success=True)
    half = 0.1 / 2 * 200 / 0.5  # 20 pixels
    for side in (-1, 1):
        u = round(50 + side * half * math.cos(angle))
        v = round(50 + side * half * math.sin(angle))
        assert tuple(drawn[v, u]) == SUCCESS_COLOR
    rows, columns = np.nonzero((drawn != 128).any(axis=2))
    along, across = (columns, rows) if angle == 0 else (rows, columns)
    assert 40 <= np.ptp(along) <= 48 and 8 <= np.ptp(across) <= 16  # 40 and 8, plus line widths
    assert (image == 128).all()  # the given image is left alone


def test_overlay_colours_and_bad_input():
    image = np.zeros((101, 101, 3), np.uint8)
    grasp = ImageGrasp(np.array([50.0, 50.0]), 0.0, 0.5, 0.05, 1.0)
    # A plate, 0.05 / 2 * 200 / 0.5 = 10 pixels right of the centre.
    plate = {c: tuple(draw_grasp(image, grasp, K, success=c)[50, 60]) for c in (False, None)}
    assert plate == {False: FAILURE_COLOR, None: (255, 255, 255)}
    assert tuple(draw_grasp(image, grasp, K, (1, 2, 3), True)[50, 60]) == (1, 2, 3)
    with pytest.raises(ValueError, match="uint8"):
        draw_grasp(image.astype(float), grasp, K)
    with pytest.raises(ValueError, match="depth"):
        draw_grasp(image, replace(grasp, depth=0.0), K)


def test_a_contact_sheet_holds_every_image_below_its_caption() -> None:
    images = [np.full((10, 30, 3), 20 * (i + 1), np.uint8) for i in range(5)]
    sheet = contact_sheet(images, [f"number {i}" for i in range(5)], columns=3)
    tile = TITLE_HEIGHT + 10
    assert sheet.shape == (2 * tile, 90, 3)
    for i, image in enumerate(images):
        row, column = divmod(i, 3)
        top, left = row * tile, 30 * column
        np.testing.assert_array_equal(
            sheet[top + TITLE_HEIGHT : top + tile, left : left + 30], image
        )
        assert (sheet[top : top + TITLE_HEIGHT, left : left + 30] < 128).any()  # there is writing
    assert (sheet[tile:, 60:] == 255).all()  # the place of the sixth
