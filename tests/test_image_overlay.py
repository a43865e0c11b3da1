"""Grasps drawn on images and from near, contact sheets, and predict.py's picture."""

import math
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.textpath import TextPath
from matplotlib.transforms import Bbox

from utils.image_overlay import (
    FAILURE_COLOR,
    MARGIN,
    SUCCESS_COLOR,
    TARGET_COLOR,
    TILE,
    TITLE_HEIGHT,
    close_up,
    contact_sheet,
    draw_grasp,
    grasp_picture,
)
from utils.transforms import Grasp, ImageGrasp, RGBDFrame, look_at

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
    sheet = contact_sheet(images, [f"n{i}" for i in range(5)], columns=3)
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


def test_a_long_caption_is_broken_and_stays_off_its_neighbours() -> None:
    images = [np.full((10, 120, 3), 90, np.uint8)] * 2
    captions = [
        "random, isolated, realsense depth: collision",
        "a_word_that_is_wider_than_its_tile",
    ]
    sheet = contact_sheet(images, captions, columns=2)
    height = len(sheet) - 10
    assert height > TITLE_HEIGHT, "more than one line"
    titles = sheet[:height].min(axis=(0, 2)).reshape(2, 120)
    assert (titles < 128).any(axis=1).all()
    # Anti-aliasing may reach a pixel into the margins.
    assert (titles[:, : MARGIN - 1] == 255).all() and (titles[:, 1 - MARGIN :] == 255).all()


# --- From near ------------------------------------------------------------------------------


def overhead(objects: np.ndarray) -> RGBDFrame:
    """What a camera 0.8 m straight above W sees; objects: (H, W) bool, bright pixels."""
    rows, columns = objects.shape
    rgb = np.where(objects[..., None], 255, 0).astype(np.uint8).repeat(3, axis=2)
    K = np.array([[450.0, 0, (columns - 1) / 2], [0, 450, (rows - 1) / 2], [0, 0, 1]])
    T_WC = look_at(np.array([0, 0, 0.8]), np.zeros(3), up=(0.0, 1.0, 0.0))
    return RGBDFrame(rgb, np.full(objects.shape, 0.8, np.float32), K, T_WC)


@pytest.mark.parametrize("shape", [(224, 224), (90, 160)], ids=["usual", "narrow"])
def test_a_grasp_is_shown_with_the_things_around_it(shape):
    """56 pixels are a quarter of the usual image, and half of its 0.2 m square."""
    objects = np.zeros(shape, bool)
    rows, columns = shape
    objects[rows // 2 - 28 : rows // 2 + 28, columns // 2 - 28 : columns // 2 + 28] = True
    picture = close_up(overhead(objects), Grasp(np.zeros(3), 0.3, 0.05, 1.0), success=True)
    assert picture.shape == (TILE, TILE, 3)
    covered = 56 / min(rows, 0.2 * 450 / 0.8)
    assert abs((picture[0:TILE] > 100).any(axis=2).mean() - covered**2) < 0.05
    drawn = np.argwhere((picture == SUCCESS_COLOR).all(axis=2))
    np.testing.assert_allclose((drawn.min(axis=0) + drawn.max(axis=0)) / 2, TILE / 2, atol=1.5)


def test_near_the_border_the_picture_stays_in_the_image():
    objects = np.ones((224, 224), bool)
    frame = overhead(objects)
    picture = close_up(frame, Grasp(np.array([0.17, 0.0, 0.0]), 0.3, 0.05, 1.0), success=True)
    drawn = np.argwhere((picture == SUCCESS_COLOR).all(axis=2))
    assert picture.shape == (TILE, TILE, 3) and len(drawn)
    assert abs(drawn[:, 1].mean() - TILE / 2) > 0.2 * TILE


def test_a_grasp_whose_closing_line_leans_appears_narrower():
    frame = overhead(np.zeros((224, 224), bool))
    level = Grasp(np.zeros(3), 0.0, 0.08, 1.0)
    leaning = replace(level, approach=np.array([math.sin(1.0), 0.0, -math.cos(1.0)]))
    spans = []
    for grasp in (level, leaning):
        drawn = np.argwhere((close_up(frame, grasp, True) == SUCCESS_COLOR).all(axis=2))
        spans.append(np.ptp(drawn, axis=0).max())
    assert spans[1] < 0.75 * spans[0]


# --- The picture of a prediction ------------------------------------------------------------


@pytest.fixture
def figures(monkeypatch) -> list[Figure]:
    """The figures that were saved, in order."""
    saved, save = [], Figure.savefig

    def keep(figure, *args, **more):
        saved.append(figure)
        save(figure, *args, **more)

    monkeypatch.setattr(Figure, "savefig", keep)
    return saved


def on_a_ball(count: int, quality: float = 0.9, turned: float = 180.0) -> list[Grasp]:
    """Grasps of one place, which are turned against each other."""
    angles = np.radians(np.linspace(0, turned, count, endpoint=False))
    return [Grasp(np.array([0, 0, 0.03]), angle, 0.06, quality) for angle in angles]


def glyphs(text: Text) -> Bbox:
    """What a number's digits cover of the figure, with their dark rim; a text's own box is as high
    as letters that reach below the line."""
    path = TextPath((0, 0), text.get_text(), text.get_fontsize(), prop=text.get_fontproperties())
    points = path.get_extents().size + 2.5
    middle = text.get_transform().transform(text.get_position())
    half = points * text.figure.dpi / 72 / 2
    return Bbox([middle - half, middle + half])


def numbers(figure: Figure) -> list[str]:
    """The numbers on the picture, none of which touches another or the border."""
    (axes,) = figure.axes
    boxes = [glyphs(text) for text in axes.texts]
    for i, box in enumerate(boxes):
        assert not any(box.overlaps(other) for other in boxes[:i]), axes.texts[i].get_text()
        assert all(axes.bbox.contains(*corner) for corner in (box.min, box.max))
    return [text.get_text() for text in axes.texts]


def test_numbers_of_grasps_on_a_round_thing_do_not_overlap(figures):
    frame = overhead(np.zeros((224, 224), bool))
    grasp_picture(frame, on_a_ball(12), [])
    grasp_picture(frame, on_a_ball(30, turned=6.0), [])
    shown = [numbers(figure) for figure in figures]
    titles = [figure.axes[0].get_title(loc="left") for figure in figures]
    assert shown[0] == [str(rank) for rank in range(1, 13)], "those above 10, too"
    assert titles[0] == "12 grasps, best first"
    assert 2 < len(shown[1]) < 30 and shown[1][0] == "1"
    expected = f"30 grasps, best first; the {len(shown[1])} that have room are numbered"
    assert titles[1] == expected


def test_grasps_that_rather_fail_are_drawn_faintly_and_the_legend_says_so(figures):
    frame = overhead(np.zeros((224, 224), bool))
    likely, unlikely = on_a_ball(2), on_a_ball(3, quality=0.49)
    target = np.zeros((224, 224), bool)
    target[100:120, 100:120] = True
    grasp_picture(frame, likely, [])
    grasp_picture(replace(frame, target=target), likely[:1] + unlikely, unlikely)
    grasp_picture(frame, [], [])
    words = [[t.get_text() for one in f.legends for t in one.get_texts()] for f in figures]
    aside, named = "moves aside what is in the way", "the object that was named"
    assert words == [["the best", "others"], ["the best", "quality under 0.5", aside, named], []]
    image = np.zeros((101, 101, 3), np.uint8)
    grasp = ImageGrasp(np.array([50.0, 50.0]), 0.0, 0.5, 0.1, 0.4)
    full, faint = draw_grasp(image, grasp, K), draw_grasp(image, grasp, K, faint=True)
    assert (faint == 255).all(axis=2).sum() < 0.6 * (full == 255).all(axis=2).sum()
    assert full[50, 32:69].min() > 200 > 50 > faint[50, 32:69].min(), "dashed"


def test_what_is_around_a_small_target_is_enlarged(figures):
    target = np.zeros((224, 224), bool)
    target[30:50, 100:120] = True
    grasp_picture(replace(overhead(np.zeros((224, 224), bool)), target=target), [], [])
    picture = figures[0].axes[0].images[0].get_array()
    outline = (picture == TARGET_COLOR).all(axis=2)
    # Half of the image's side, 112 pixels, is shown around it, and above it the 40 that there are.
    assert np.ptp(np.nonzero(outline.any(axis=0))[0]) / picture.shape[1] == pytest.approx(
        20 / 112, rel=0.1
    )
    assert picture.shape[0] / picture.shape[1] == pytest.approx((40 + 56) / 112, rel=0.02)
