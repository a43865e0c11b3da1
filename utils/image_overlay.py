"""Pictures of grasps: drawn on images, in contact sheets, and for the user of predict.py.

This module knows the pinhole camera, but no simulator, no planner and no network.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import TYPE_CHECKING

import cv2
import numpy as np
from PIL import Image

from utils.images import PixelScaling
from utils.transforms import Grasp, ImageGrasp, RGBDFrame, grasp_to_image

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SUCCESS_COLOR = (52, 211, 123)  # RGB
FAILURE_COLOR = (248, 92, 92)
PLATE_LENGTH = 0.02  # m, width of a Panda fingertip across the closing line
OUTLINE = (20, 20, 20)
TITLE_HEIGHT = 20  # pixels, of a caption
_SHIFT = 4  # OpenCV's fixed-point bits: ends of lines at 1/16 pixel


def draw_grasp(
    image: np.ndarray,
    grasp: ImageGrasp,
    K: np.ndarray,
    color: tuple[int, int, int] | None = None,
    success: bool | None = None,
) -> np.ndarray:
    """A copy of the (H, W, 3) uint8 RGB image with the grasp on it.

    Two finger plates stand at +-width/2 along the closing line, which is drawn thinly between
    them; lengths in pixels are metres * fx / depth. Without `color`, a success is green, a failure
    red and an unknown outcome white. Raises ValueError for another image type and for a depth that
    is not > 0.
    """
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
        raise ValueError(f"draw_grasp: need (H, W, 3) uint8, got {image.shape} {image.dtype}")
    if not grasp.depth > 0:
        raise ValueError(f"draw_grasp: the grasp's depth must be > 0 m, got {grasp.depth}")
    if color is None:
        color = {True: SUCCESS_COLOR, False: FAILURE_COLOR, None: (255, 255, 255)}[success]
    closing = np.array([np.cos(grasp.angle), np.sin(grasp.angle)])
    across = np.array([-closing[1], closing[0]])
    half_width = closing * grasp.width / 2 * K[0, 0] / grasp.depth
    half_plate = across * PLATE_LENGTH / 2 * K[0, 0] / grasp.depth
    left, right = grasp.pixel - half_width, grasp.pixel + half_width
    thin = max(1, round(min(image.shape[:2]) / 220))
    lines = [
        (left, right, thin),
        (left - half_plate, left + half_plate, 2 * thin + 1),
        (right - half_plate, right + half_plate, 2 * thin + 1),
    ]
    drawn = np.ascontiguousarray(image).copy()
    for extra, shade in ((2, OUTLINE), (0, color)):  # a dark rim shows on any background
        for start, end, thickness in lines:
            _line(drawn, start, end, shade, thickness + extra)
    return drawn


def contact_sheet(
    images: Sequence[np.ndarray], captions: Sequence[str], columns: int = 6
) -> np.ndarray:
    """Images (H, W, 3) uint8 of one size in rows of `columns`, each with its caption above."""
    height, width = images[0].shape[:2]
    tiles = []
    for image, caption in zip(images, captions):
        title = np.full((TITLE_HEIGHT, width, 3), 255, np.uint8)
        scale = min(0.42, 0.42 * width / max(_text_width(caption), 1))
        cv2.putText(
            title, caption, (2, 14), cv2.FONT_HERSHEY_SIMPLEX, scale, OUTLINE, 1, cv2.LINE_AA
        )
        tiles.append(np.vstack([title, image]))
    columns = min(columns, len(tiles))
    tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % columns)
    return np.vstack([np.hstack(tiles[i : i + columns]) for i in range(0, len(tiles), columns)])


def _text_width(text: str) -> int:
    return cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.42, 1)[0][0]


def _line(image: np.ndarray, start, end, color, thickness: int) -> None:
    ends = [tuple(int(round(x * 2**_SHIFT)) for x in point) for point in (start, end)]
    cv2.line(image, *ends, color, thickness, cv2.LINE_AA, _SHIFT)


# --- The picture of a prediction ------------------------------------------------------------

NUMBERED = 10  # grasps with a rank beside them; more would hide each other
PICTURE_SIDE = 1000  # pixels, the longer side of the picture
INK, PAPER = "#1d2430", "white"
TARGET_COLOR, ASIDE_COLOR = (255, 176, 32), (96, 165, 250)  # RGB
MARK = "Software", "robot-grasping predict.py"  # PNG text that marks pictures of this project


def grasp_picture(frame: RGBDFrame, grasps: Sequence[Grasp], clearing: Sequence[Grasp]) -> bytes:
    """The image with ranked grasps, as bytes of a PNG.

    The first ten grasps are numbered, the best is green. The frame's target is outlined; grasps
    that move aside what is in its way, of which one is enough, are blue.
    """
    from matplotlib.figure import Figure  # slow to import, and few callers need it

    scaling = _to_picture(frame.K, frame.depth.shape)
    picture = scaling.image(frame.rgb)
    if frame.target is not None:
        mask = scaling.image(frame.target.astype(np.float32)) > 0.5
        outlines, _ = cv2.findContours(
            mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
        )
        for colour, width in ((OUTLINE, 5), (TARGET_COLOR, 3)):
            cv2.drawContours(picture, outlines, -1, colour, width, cv2.LINE_AA)
    colours = [SUCCESS_COLOR, *[(255, 255, 255)] * len(grasps)]
    picture = _with_grasps(scaling, picture, frame, clearing[:1], [ASIDE_COLOR])
    picture = _with_grasps(scaling, picture, frame, grasps, colours)
    rows, columns = picture.shape[:2]
    height = 6.6  # inches
    figure = Figure(figsize=(height * columns / rows, height + 0.3), layout="constrained")
    figure.set_facecolor(PAPER)
    image = figure.add_subplot()
    image.imshow(picture, interpolation="antialiased")
    title = f"{len(grasps)} grasp{'' if len(grasps) == 1 else 's'}, best first"
    title = title if grasps else "no grasp found"
    if clearing:
        title += "; blue: the first to move aside what is in the way"
    _finish(image, title)
    for rank, grasp in reversed(list(enumerate(grasps[:NUMBERED], start=1))):  # the best on top
        pixel = grasp_to_image(grasp, frame.K, frame.T_WC).pixel
        _number(image, rank, scaling.pixels(pixel))
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=150, metadata=dict([MARK]))
    return file.getvalue()


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


def _with_grasps(
    scaling: PixelScaling,
    picture: np.ndarray,
    frame: RGBDFrame,
    grasps: Sequence[Grasp],
    colours: Sequence[tuple[int, int, int]],
) -> np.ndarray:
    """The scaled picture with the grasps, the first on top."""
    for grasp, colour in reversed(list(zip(grasps, colours))):
        seen = grasp_to_image(grasp, frame.K, frame.T_WC)
        angle = np.arctan2(np.sin(seen.angle) * scaling.v, np.cos(seen.angle) * scaling.u)
        moved = ImageGrasp(scaling.pixels(seen.pixel), angle, seen.depth, seen.width, seen.quality)
        picture = draw_grasp(picture, moved, scaling.intrinsics(frame.K), colour)
    return picture


def _number(axes: Axes, rank: int, pixel: np.ndarray) -> None:
    from matplotlib import patheffects

    text = axes.annotate(
        str(rank), pixel, xytext=(5, 5), textcoords="offset points",
        color="white", fontsize=9, fontweight="bold", annotation_clip=True,
    )  # fmt: skip
    text.set_path_effects([patheffects.withStroke(linewidth=2.5, foreground=INK)])


def _finish(axes: Axes, title: str) -> None:
    axes.set_title(title, fontsize=10, color=INK, loc="left")
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(False)
