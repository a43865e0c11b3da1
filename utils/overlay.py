"""Grasps drawn on images. Knows the pinhole camera, no simulator and no planner."""

from __future__ import annotations

import cv2
import numpy as np

from utils.transforms import ImageGrasp

SUCCESS_COLOR = (52, 211, 123)  # RGB
FAILURE_COLOR = (248, 92, 92)
PLATE_LENGTH = 0.02  # m, width of a Panda fingertip across the closing line
OUTLINE = (20, 20, 20)
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


def _line(image: np.ndarray, start, end, color, thickness: int) -> None:
    ends = [tuple(int(round(x * 2**_SHIFT)) for x in point) for point in (start, end)]
    cv2.line(image, *ends, color, thickness, cv2.LINE_AA, _SHIFT)
