"""Grasps drawn on images. Knows the pinhole camera, no simulator and no planner."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from utils.transforms import ImageGrasp

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
    them; lengths in pixels are metres * fx / depth. Without `color`, green is a success and red a
    failure, white neither. Raises ValueError on another image type or a depth that is not > 0.
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
