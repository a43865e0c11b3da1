"""Pictures of grasps: drawn on images, close up, in contact sheets, and for the user of predict.py.

This module knows the pinhole camera, but no simulator, no planner and no network.
"""

from __future__ import annotations

import io
from argparse import ArgumentTypeError
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import imageio.v3 as iio
import numpy as np
from PIL import Image

from utils.atomic_files import write_atomic
from utils.calibration import LEAST_CHANCE
from utils.images import PixelScaling
from utils.transforms import Grasp, ImageGrasp, RGBDFrame, grasp_to_image, project

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PICTURES = (".png", ".jpg", ".jpeg")  # what a picture's name may end in
SUCCESS_COLOR = (52, 211, 123)  # RGB
FAILURE_COLOR = (248, 92, 92)
PLATE_LENGTH = 0.02  # m, width of a Panda fingertip across the closing line
OUTLINE = (20, 20, 20)
TITLE_HEIGHT = 20  # pixels, of a caption of one line
LINE_HEIGHT = 15  # pixels, of each further line
MARGIN = 4  # pixels of a tile's caption that stay empty on either side
TILE = 240  # pixels, the side of a picture of a grasp from near
NEAR = 0.2  # m at the grasp's distance, the side of what such a picture shows
DASHES = 5  # of a faint closing line
_FONT, _TEXT = cv2.FONT_HERSHEY_SIMPLEX, 0.42  # of captions
_SHIFT = 4  # OpenCV's fixed-point bits: ends of lines at 1/16 pixel


def draw_grasp(
    image: np.ndarray,
    grasp: ImageGrasp,
    K: np.ndarray,
    color: tuple[int, int, int] | None = None,
    success: bool | None = None,
    faint: bool = False,
) -> np.ndarray:
    """A copy of the (H, W, 3) uint8 RGB image with the grasp on it.

    Two finger plates stand at +-width/2 along the closing line, which is drawn thinly between
    them; lengths in pixels are metres * fx / depth. Without `color`, a success is green, a failure
    red and an unknown outcome white. faint: plates are thin and the closing line is dashed. Raises
    ValueError for another image type and for a depth that is not > 0.
    """
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
        raise ValueError(f"draw_grasp: need (H, W, 3) uint8, got {image.shape} {image.dtype}")
    if not grasp.depth > 0:
        raise ValueError(f"draw_grasp: the grasp's depth must be > 0 m, got {grasp.depth}")
    if color is None:
        color = {True: SUCCESS_COLOR, False: FAILURE_COLOR, None: (255, 255, 255)}[success]
    half_width, half_plate = _halves(grasp, K)
    left, right = grasp.pixel - half_width, grasp.pixel + half_width
    thin = max(1, round(min(image.shape[:2]) / 220))
    plate = thin if faint else 2 * thin + 1
    if faint:
        ends = np.linspace(left, right, 2 * DASHES)  # dashes as long as the gaps
        lines = [(start, end, (thin + 1) // 2) for start, end in zip(ends[::2], ends[1::2])]
    else:
        lines = [(left, right, thin)]
    lines += [(tip - half_plate, tip + half_plate, plate) for tip in (left, right)]
    drawn = np.ascontiguousarray(image).copy()
    for extra, shade in ((2, OUTLINE), (0, color)):  # a dark rim shows on any background
        for start, end, thickness in lines:
            _line(drawn, start, end, shade, thickness + extra)
    return drawn


def _halves(grasp: ImageGrasp, K: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (2,) from the grasp's centre to a fingertip, and from there to an end of its plate."""
    closing = np.array([np.cos(grasp.angle), np.sin(grasp.angle)])
    across = np.array([-closing[1], closing[0]])
    scale = K[0, 0] / grasp.depth
    return closing * grasp.width / 2 * scale, across * PLATE_LENGTH / 2 * scale


def as_seen(grasp: Grasp, K: np.ndarray, T_WC: np.ndarray) -> ImageGrasp:
    """The grasp on an image of square pixels, as wide as it appears: a closing line that leans
    appears shorter; of a level one under an upright camera this is the width itself."""
    on_image = grasp_to_image(grasp, K, T_WC)
    half = grasp.closing_direction * grasp.width / 2
    ends, _ = project([grasp.position - half, grasp.position + half], K, T_WC)
    width = float(np.linalg.norm(ends[1] - ends[0])) * on_image.depth / K[0, 0]
    return replace(on_image, width=width)


def close_up(frame: RGBDFrame, grasp: Grasp, success: bool | None = None) -> np.ndarray:
    """(TILE, TILE, 3) uint8: the grasp on the square of NEAR metres around it, or on the largest
    one of an image that shows less. At the image's border the square stays inside it."""
    (rows, columns), (fx, fy) = frame.depth.shape, frame.K[[0, 1], [0, 1]]
    depth = float(project(grasp.position, frame.K, frame.T_WC)[1])
    focal = max(TILE * depth / NEAR, TILE * fx / columns, TILE * fy / rows)
    scaling = PixelScaling.to_focal_length(frame.K, focal)
    picture, K = scaling.image(frame.rgb), scaling.intrinsics(frame.K)
    seen = as_seen(grasp, K, frame.T_WC)
    most = np.array(picture.shape[1::-1]) - TILE
    left, top = np.clip(np.round(seen.pixel - TILE / 2), 0, most).astype(int)
    square = picture[top : top + TILE, left : left + TILE]
    return draw_grasp(square, replace(seen, pixel=seen.pixel - (left, top)), K, success=success)


def contact_sheet(
    images: Sequence[np.ndarray], captions: Sequence[str], columns: int = 6
) -> np.ndarray:
    """Images (H, W, 3) uint8 of one size in rows of `columns`, each with its caption above, which
    is broken into lines of the image's width."""
    width = images[0].shape[1]
    texts = [_lines(caption, width - 2 * MARGIN) for caption in captions]
    height = TITLE_HEIGHT + (max(map(len, texts)) - 1) * LINE_HEIGHT
    tiles = []
    for image, lines in zip(images, texts):
        title = np.full((height, width, 3), 255, np.uint8)
        for number, line in enumerate(lines):
            # A word that is wider than the image, such as a path, has no place to be broken at.
            scale = _TEXT * min(1.0, (width - 2 * MARGIN) / max(_text_width(line), 1))
            place = (MARGIN, 14 + number * LINE_HEIGHT)
            cv2.putText(title, line, place, _FONT, scale, OUTLINE, 1, cv2.LINE_AA)
        tiles.append(np.vstack([title, image]))
    columns = min(columns, len(tiles))
    tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % columns)
    return np.vstack([np.hstack(tiles[i : i + columns]) for i in range(0, len(tiles), columns)])


def _lines(text: str, width: int) -> list[str]:
    """The text broken at spaces into lines of at most `width` pixels, where words allow it."""
    lines = [""]
    for word in text.split():
        longer = f"{lines[-1]} {word}".strip()
        if lines[-1] and _text_width(longer) > width:
            lines.append(word)
        else:
            lines[-1] = longer
    return lines


def _text_width(text: str) -> int:
    return cv2.getTextSize(text, _FONT, _TEXT, 1)[0][0]


def picture_path(name: str) -> Path:
    """The file of a picture that an option names, as the type of this option. Raises
    ArgumentTypeError for a name that tells no type."""
    path = Path(name)
    if path.suffix.lower() not in PICTURES:
        raise ArgumentTypeError(f"{name!r} is no file {' or '.join(PICTURES)}")
    return path


def write_picture(path: Path, image: np.ndarray) -> None:
    """Write (H, W, 3) uint8 RGB as a file of the type that its name says, whole or not at all; its
    folder is made."""
    write_atomic(path, iio.imwrite("<bytes>", image, extension=Path(path).suffix))


def _line(image: np.ndarray, start, end, color, thickness: int) -> None:
    ends = [tuple(int(round(x * 2**_SHIFT)) for x in point) for point in (start, end)]
    cv2.line(image, *ends, color, thickness, cv2.LINE_AA, _SHIFT)


# --- The picture of a prediction ------------------------------------------------------------

PICTURE_SIDE = 1000  # pixels, the longer side of the picture
PICTURE_HEIGHT, DPI = 6.6, 150  # inches, and dots an inch
LEGEND_COLUMN, LEGEND_ROW, LEGEND_LETTER = 2.8, 0.25, 0.085  # inches
NUMBER_SIZE, NUMBER_RIM = 9.0, 2.5  # points
COVERED = 0.3  # share of a number's place that may lie on fingers; of more, one cannot read whose
INK, PAPER = "#1d2430", "white"
TARGET_COLOR, ASIDE_COLOR = (255, 176, 32), (96, 165, 250)  # RGB
OTHER_COLOR, FAINT_COLOR = (255, 255, 255), (205, 205, 205)
MARK = "Software", "robot-grasping predict.py"  # PNG text that marks pictures of this project


def grasp_picture(frame: RGBDFrame, grasps: Sequence[Grasp], clearing: Sequence[Grasp]) -> bytes:
    """The image with ranked grasps, as bytes of a PNG.

    The best grasp is green, those of a quality under LEAST_CHANCE are faint, and all are numbered
    whose number has room. The frame's target is outlined, and the part of the image around it is
    enlarged; of the grasps that move aside what is in its way, of which one is enough, the first is
    blue.
    """
    from matplotlib.figure import Figure  # slow to import, and few callers need it

    if frame.target is not None:
        frame = _around_target(frame, (*grasps, *clearing[:1]))
    scaling = _to_picture(frame.K, frame.depth.shape)
    picture, K = scaling.image(frame.rgb), scaling.intrinsics(frame.K)
    if frame.target is not None:
        mask = scaling.image(frame.target.astype(np.float32)) > 0.5
        outlines, _ = cv2.findContours(
            mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
        )
        for colour, width in ((OUTLINE, 5), (TARGET_COLOR, 3)):
            cv2.drawContours(picture, outlines, -1, colour, width, cv2.LINE_AA)
    seen = [as_seen(grasp, K, frame.T_WC) for grasp in (*grasps, *clearing[:1])]
    faint = [one.quality < LEAST_CHANCE for one in seen]
    colours = [FAINT_COLOR if weak else OTHER_COLOR for weak in faint]
    if grasps:
        colours[0] = SUCCESS_COLOR
    if clearing:
        colours[-1] = ASIDE_COLOR
    bare = picture
    for one, colour, weak in reversed(list(zip(seen, colours, faint))):  # the best on top
        picture = draw_grasp(picture, one, K, colour, faint=weak)
    rows, columns = picture.shape[:2]
    taken, scale = (picture != bare).any(axis=2), rows / (PICTURE_HEIGHT * DPI)
    places = number_places(seen[: len(grasps)], K, taken, scale)

    kinds = [
        (SUCCESS_COLOR, "-", "the best", bool(grasps)),
        (OTHER_COLOR, "-", "others", OTHER_COLOR in colours),
        (FAINT_COLOR, "--", f"quality under {LEAST_CHANCE:g}", any(faint)),
        (ASIDE_COLOR, "-", "moves aside what is in the way", bool(clearing)),
        (TARGET_COLOR, "-", "the object that was named", frame.target is not None),
    ]
    legend = [(colour, style, words) for colour, style, words, there in kinds if there]
    width = PICTURE_HEIGHT * columns / rows
    short = sum(len(words) + 9 for _, _, words in legend) * LEGEND_LETTER < width
    across = len(legend) if short else max(1, int(width / LEGEND_COLUMN))
    below = -(-len(legend) // max(across, 1)) * LEGEND_ROW
    figure = Figure(figsize=(width, PICTURE_HEIGHT + 0.4 + below), layout="constrained")
    figure.set_facecolor(PAPER)
    image = figure.add_subplot()
    image.imshow(picture, interpolation="antialiased")
    _finish(image, _title(len(grasps), len(places)))
    for rank, place in places.items():
        _number(image, rank, place)
    _explain(figure, legend, across)
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=DPI, metadata=dict([MARK]))
    return file.getvalue()


def _around_target(frame: RGBDFrame, grasps: Sequence[Grasp]) -> RGBDFrame:
    """The part of a frame that shows its target, the grasps and as much again around them, with the
    target."""
    v, u = np.nonzero(frame.target)
    shown = [np.column_stack([u, v])]
    for grasp in grasps:
        half = grasp.closing_direction * grasp.width / 2
        ends = grasp.position - half, grasp.position + half
        shown.append(project(ends, frame.K, frame.T_WC)[0])
    pixels = np.concatenate(shown)  # NaN behind the camera
    low, high = np.nanmin(pixels, axis=0), np.nanmax(pixels, axis=0)
    half = max((high - low).max(), min(frame.depth.shape) / 4)
    shape, middle = np.array(frame.depth.shape), (low + high)[::-1] / 2
    first = np.clip(middle - half, 0, shape - 1).astype(int)
    last = np.clip(middle + half, 1, shape).astype(int)
    rows, columns = map(slice, first, last)
    return replace(frame.part(rows, columns), target=frame.target[rows, columns])


def _title(count: int, numbered: int) -> str:
    if count == 0:
        return "no grasp found"
    title = f"{count} grasp{'' if count == 1 else 's'}, best first"
    return title if numbered == count else f"{title}; the {numbered} that have room are numbered"


def is_grasp_picture(path) -> bool:
    """Whether the file is a picture that `grasp_picture` made."""
    try:
        with Image.open(path, formats=["PNG"]) as image:
            return image.info.get(MARK[0]) == MARK[1]
    except Exception:  # Pillow raises errors of many kinds for files of others
        return False


def _to_picture(K: np.ndarray, shape: tuple[int, ...]) -> PixelScaling:
    """Square pixels, and the longer side as the picture wants it."""
    focal = K[0, 0]
    factor = PICTURE_SIDE / max(shape[1], shape[0] * focal / K[1, 1])
    return PixelScaling.to_focal_length(K, factor * focal)


def number_places(
    grasps: Sequence[ImageGrasp], K: np.ndarray, taken: np.ndarray, scale: float
) -> dict[int, np.ndarray]:
    """Where ranks from 1 are written: the centre (2,), in pixels, of each number that has room.

    taken: (H, W) bool, the pixels on which grasps are drawn. scale: pixels of the image a dot.
    A number stands beside a fingertip of its grasp, in the image, on no number and on few pixels of
    grasps, if it can nearer to its own fingers than to others; better grasps choose first.
    """
    written = np.zeros(taken.shape, bool)
    middles = np.array([_fingertips(grasp, K) for grasp in grasps]).reshape(-1, 2, 2)
    places = {}
    for rank, grasp in enumerate(grasps, start=1):
        size = number_size(rank, scale)
        choices = []
        for place in _beside_fingertips(grasp, K, size, scale):
            box = _box(place, size, taken.shape)
            if box is None or written[box].any() or (covered := taken[box].mean()) > COVERED:
                continue
            nearest = np.linalg.norm(middles - place, axis=-1).min(axis=1).argmin()
            choices.append((covered + (nearest != rank - 1), len(choices), place, box))
        if choices:  # of equal ones the first, which is straight beside the fingertip
            _, _, places[rank], box = min(choices, key=lambda choice: choice[:2])
            written[box] = True
    return places


def number_size(rank: int, scale: float) -> np.ndarray:
    """(2,) width and height in pixels of a rank's number with its rim. scale: pixels a dot."""
    digits, dots = len(str(rank)), DPI / 72
    glyphs = NUMBER_SIZE * np.array([0.7 * digits, 0.75])  # of bold DejaVu Sans
    return (glyphs + NUMBER_RIM + 1.5) * dots * scale


def _fingertips(grasp: ImageGrasp, K: np.ndarray) -> np.ndarray:
    """(2, 2) pixels."""
    half_width, _ = _halves(grasp, K)
    return np.stack([grasp.pixel - half_width, grasp.pixel + half_width])


def _beside_fingertips(
    grasp: ImageGrasp, K: np.ndarray, size: np.ndarray, scale: float
) -> list[np.ndarray]:
    """Centres (2,) of a number of this size, in pixels, that do not touch its own fingers: beyond
    either fingertip, then more and more sideways."""
    half_width, half_plate = _halves(grasp, K)
    out = half_width / max(float(np.linalg.norm(half_width)), 1e-9)
    side, reach = half_plate, 10 * scale  # a plate's half thickness with its rim, and a gap
    side = side / np.linalg.norm(side)
    places = []
    for turn in np.radians([0, 30, -30, 60, -60, 90, -90]):
        for sign in (1, -1):
            towards = sign * (np.cos(turn) * out + np.sin(turn) * side)
            along_plate = abs(np.sin(turn)) * np.linalg.norm(half_plate)
            away = along_plate + reach + np.abs(towards) @ size / 2
            places.append(grasp.pixel + sign * half_width + away * towards)
    return places


def _box(place: np.ndarray, size: np.ndarray, shape: tuple[int, ...]) -> tuple[slice, slice] | None:
    """The pixels (rows, columns) of a number at a place (2,); None where they leave the image."""
    (left, top), (right, bottom) = np.floor(place - size / 2), np.ceil(place + size / 2)
    if left < 0 or top < 0 or right > shape[1] or bottom > shape[0]:
        return None
    return slice(int(top), int(bottom)), slice(int(left), int(right))


def _number(axes: Axes, rank: int, pixel: np.ndarray) -> None:
    from matplotlib import patheffects

    text = axes.text(
        *pixel, str(rank), color="white", fontsize=NUMBER_SIZE, fontweight="bold",
        ha="center", va="center_baseline",
    )  # fmt: skip
    text.set_path_effects([patheffects.withStroke(linewidth=NUMBER_RIM, foreground=INK)])


def _explain(
    figure: Figure, legend: Sequence[tuple[tuple[int, int, int], str, str]], columns: int
) -> None:
    """What the colours mean, below the picture. legend: RGB, line style and words of each."""
    from matplotlib import patheffects
    from matplotlib.lines import Line2D

    rim = [patheffects.withStroke(linewidth=4.5, foreground=INK)]  # white shows on paper, too
    lines = [
        Line2D([], [], color=np.array(colour) / 255, linestyle=style, linewidth=2.5, label=words,
               path_effects=rim)
        for colour, style, words in legend
    ]  # fmt: skip
    if lines:
        figure.legend(
            handles=lines, loc="outside lower left", ncols=columns, fontsize=9, frameon=False,
            labelcolor=INK,
        )  # fmt: skip


def _finish(axes: Axes, title: str) -> None:
    axes.set_title(title, fontsize=10, color=INK, loc="left")
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(False)
