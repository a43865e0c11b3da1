"""Contact sheets; `draw_grasp` is tested in test_report.py."""

import numpy as np

from utils.image_overlay import TITLE_HEIGHT, contact_sheet


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
