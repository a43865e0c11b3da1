"""Tiny real images of bars with their labels, also as folders of Cornell and Jacquard."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from utils.rectangles import GraspRectangle, RealSample, View
from utils.runs import REPOSITORY

CORNELL = REPOSITORY.parent / "shared" / "data" / "cornell"  # the real images, if they are there
SHAPE = (120, 160)  # rows, columns
VIEW = View(side=100, size=50, metres_per_pixel=0.004)


def sample(rectangle: GraspRectangle, shape=SHAPE, name="pcd0100") -> RealSample:
    """A dark bar through the rectangle, 5 cm high, on a bright table 1.2 m away."""
    rgb, depth = np.full((*shape, 3), 230, np.uint8), np.full(shape, 1.2, np.float32)
    bar = GraspRectangle(
        rectangle.centre, rectangle.angle, rectangle.width / 2, 3 * rectangle.height
    )
    corners = [np.rint(bar.corners()).astype(np.int32)]
    cv2.fillPoly(rgb, corners, (60, 40, 30))
    cv2.fillPoly(depth, corners, 1.15)
    return RealSample(name, "bar", rgb, depth, (rectangle,))


def write_cornell(folder: Path, count: int, first: int = 100, shape=SHAPE) -> Path:
    """Bars around the middle of each image, in different directions, in Cornell's format."""
    folder.mkdir(parents=True, exist_ok=True)
    middle = np.array([shape[1] / 2, shape[0] / 2])
    for number in range(count):
        centre = middle + (2.0 * number - 10, 0)
        rectangle = GraspRectangle(centre, 0.3 * number, 24.0, 12.0)
        one, stem = sample(rectangle, shape), folder / f"pcd{first + number:04d}"
        Image.fromarray(one.rgb).save(f"{stem}r.png")
        Image.fromarray(one.depth).save(f"{stem}d.tiff")
        corners = "\n".join(f"{u:.3f} {v:.3f}" for u, v in rectangle.corners())
        Path(f"{stem}cpos.txt").write_text(corners + "\n")
        Path(f"{stem}cneg.txt").write_text("")
    return folder


def write_jacquard(folder: Path, objects: int = 3, views: int = 2, side: int = 128) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for view in range(views):
        for number in range(objects):
            rectangle = GraspRectangle(np.array([50.0 + 10 * view, 60.0]), 0.5 * number, 30, 14)
            one, stem = sample(rectangle, (side, side)), folder / f"{view}_object{number}"
            Image.fromarray(one.rgb).save(f"{stem}_RGB.png")
            Image.fromarray(one.depth).save(f"{stem}_perfect_depth.tiff")
            degrees = np.degrees(rectangle.angle)
            (folder / f"{stem.name}_grasps.txt").write_text(
                f"{rectangle.centre[0]};{rectangle.centre[1]};{degrees};30;14\n"
            )
    return folder
