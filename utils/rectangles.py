"""Grasp rectangles, the labels of Cornell and Jacquard, and the real images that carry them.

The rectangle metric scores a prediction, `rasterise` makes dense targets of labels, and a `View` is
the part of a labelled image that a network sees.

A grasp rectangle is two gripper plates seen from above. Its image angle is that of the closing
line, from +u (right) towards +v (down), modulo pi, as in `utils.transforms.ImageGrasp`; lengths
are pixels. `utils.real_data` reads the images from disk and has the view of each format's camera.
This module reads no file and knows no network.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np

from utils.grasp_labels import ANGLE_BINS
from utils.table_plane import robust_fit
from utils.transforms import angle_difference, wrap_to_pi_range

MATCH_IOU = 0.25  # Jiang, Moseson, Saxena, "Efficient grasping from RGBD images", ICRA 2011
MATCH_ANGLE = np.pi / 6
_ROUNDING = 1e-9  # margin: a difference of exactly the limit does not pass by a rounding error
_FLAT = 0.005  # of the table's distance: noise, below which a pixel belongs to the table
_TABLE_STEP = 8  # pixels between those to which the table is fitted


@dataclass(frozen=True, eq=False)
class GraspRectangle:
    """centre: (2,) pixel (u, v). angle: closing line, radians, kept in [0, pi).

    width: opening between the plates, along the closing line, pixels. height: length of the
    plates, across it, pixels. Raises ValueError for non-finite numbers or lengths not > 0.
    """

    centre: np.ndarray
    angle: float
    width: float
    height: float

    def __post_init__(self) -> None:
        centre = np.asarray(self.centre, dtype=float)
        if centre.shape != (2,):
            raise ValueError(f"GraspRectangle.centre must have shape (2,), got {centre.shape}")
        if not np.isfinite([*centre, self.angle, self.width, self.height]).all():
            raise ValueError(f"GraspRectangle holds a non-finite number: {self!r}")
        if not (self.width > 0 and self.height > 0):
            raise ValueError(f"GraspRectangle needs width and height > 0, got {self!r}")
        object.__setattr__(self, "centre", centre)
        object.__setattr__(self, "angle", wrap_to_pi_range(self.angle))

    @property
    def axes(self) -> np.ndarray:
        """(2, 2) unit vectors (u, v): along the closing line, and across it along the plates."""
        c, s = np.cos(self.angle), np.sin(self.angle)
        return np.array([[c, s], [-s, c]])

    @property
    def area(self) -> float:
        """Pixels squared."""
        return self.width * self.height

    @staticmethod
    def from_corners(corners: np.ndarray) -> GraspRectangle:
        """Return the rectangle of four corners (4, 2) in (u, v), in Cornell's order.

        Cornell's first edge (corner 0 to 1) is the opening and the second (1 to 2) lies along a
        plate; corners run either way round. Hand-drawn corners are not exactly rectangular:
        opposite edges are averaged.
        """
        a, b, c, d = np.asarray(corners, dtype=float).reshape(4, 2)
        along, across = (b - a + c - d) / 2, (c - b + d - a) / 2
        return GraspRectangle(
            (a + b + c + d) / 4,
            float(np.arctan2(along[1], along[0])),
            float(np.hypot(*along)),
            float(np.hypot(*across)),
        )

    def corners(self) -> np.ndarray:
        """Return the (4, 2) corners (u, v) in Cornell's order; the inverse of `from_corners`."""
        along, across = self.axes * [[self.width / 2], [self.height / 2]]
        return self.centre + np.stack(
            [-along - across, along - across, along + across, across - along]
        )

    def transformed(self, matrix: np.ndarray) -> GraspRectangle:
        """Return the rectangle after a similarity of the image: (3, 3) matrix on (u, v, 1) columns.

        Turning, shifting, one scale for both axes, and mirroring keep it a rectangle; for other
        matrices the result is the rectangle through the midpoints of the mapped edges.
        """
        corners = np.column_stack([self.corners(), np.ones(4)]) @ np.asarray(matrix).T
        return GraspRectangle.from_corners(corners[:, :2])


def rectangles_from_corners(corners: np.ndarray) -> list[GraspRectangle]:
    """Return the rectangles of (N, 4, 2) corners, without those with a NaN, as Cornell has some."""
    corners = np.asarray(corners, dtype=float).reshape(-1, 4, 2)
    return [GraspRectangle.from_corners(c) for c in corners if np.isfinite(c).all()]


def intersection_over_union(a: GraspRectangle, b: GraspRectangle) -> float:
    """Return the exact IoU of two rotated rectangles, in [0, 1].

    a's outline is clipped by b's four sides in b's own frame (Sutherland and Hodgman 1974).
    OpenCV's `rotatedRectangleIntersection` is wrong for rectangles that share an edge in about one
    case of fifty (opencv 5.0, float32).
    """
    outline = (a.corners() - b.centre) @ b.axes.T
    for axis, half in enumerate((b.width / 2, b.height / 2)):
        for side in (-1.0, 1.0):
            outline = _clip(outline, half - side * outline[:, axis])
    u, v = outline.T
    shared = abs(np.dot(u, np.roll(v, -1)) - np.dot(v, np.roll(u, -1))) / 2  # shoelace formula
    return float(np.clip(shared / (a.area + b.area - shared), 0.0, 1.0))


def _clip(outline: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """Return the part of a convex outline (N, 2) with a signed distance `inside` (N,) >= 0."""
    kept = []
    for i in range(len(outline)):
        j = (i + 1) % len(outline)
        if inside[i] >= 0:
            kept.append(outline[i])
        if (inside[i] >= 0) != (inside[j] >= 0):
            t = inside[i] / (inside[i] - inside[j])
            kept.append(outline[i] + t * (outline[j] - outline[i]))
    return np.array(kept).reshape(-1, 2)


def rectangle_match(
    predicted: GraspRectangle,
    labels: Iterable[GraspRectangle],
    iou: float = MATCH_IOU,
    angle: float = MATCH_ANGLE,
) -> bool:
    """Whether the prediction agrees with at least one label, by the rectangle metric.

    It agrees if the IoU exceeds `iou` and the angles, as undirected lines, differ by less than
    `angle` radians, both with the same label. Jiang et al. 2011; Lenz, Lee, Saxena, "Deep learning
    for detecting robotic grasps", IJRR 2015.
    """
    return any(
        angle_difference(predicted.angle, label.angle) < angle - _ROUNDING
        and intersection_over_union(predicted, label) > iou + _ROUNDING
        for label in labels
    )


class DenseTargets(NamedTuple):
    """quality: (B, H, W) float32 in [0, 1]. width: (B, H, W) float32 pixels, 0 without a label."""

    quality: np.ndarray
    width: np.ndarray


def rasterise(rectangles: Sequence[GraspRectangle], shape: tuple[int, int]) -> DenseTargets:
    """Draw rectangles as dense targets of an image of shape (H, W).

    Each rectangle labels the pixels of the central third along its closing line, over the whole
    plate length, as GG-CNN does (Morrison, Corke, Leitner, RSS 2018, section V); a rectangle that
    is too thin to cover a pixel's centre labels the pixel nearest to its own centre. There the
    nearest angle bin gets quality 1, which falls linearly to 0 over one bin beyond half a bin.
    Where labels overlap, each bin keeps the highest quality and the quality-weighted mean width, so
    the order of the labels does not matter.
    """
    height, width = shape
    step = np.pi / ANGLE_BINS
    quality = np.zeros((ANGLE_BINS, height, width))
    weighted_width, total = np.zeros_like(quality), np.zeros_like(quality)
    for rectangle in rectangles:
        rows, columns = _central_third(rectangle, shape)
        beyond = angle_difference(rectangle.angle, np.arange(ANGLE_BINS) * step) - step / 2
        weights = np.where(beyond <= _ROUNDING, 1.0, np.clip(1 - beyond / step, 0, 1))
        for k in np.flatnonzero(weights):
            at = (k, rows, columns)
            quality[at] = np.maximum(quality[at], weights[k])
            weighted_width[at] += weights[k] * rectangle.width
            total[at] += weights[k]
    mean_width = np.divide(weighted_width, total, out=weighted_width, where=total > 0)
    return DenseTargets(quality.astype(np.float32), mean_width.astype(np.float32))


def _central_third(
    rectangle: GraspRectangle, shape: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and columns of the pixels whose centres lie in the rectangle's central third."""
    reach = np.hypot(rectangle.width / 6, rectangle.height / 2)
    last = np.array(shape[::-1]) - 1
    low = np.clip(np.floor(rectangle.centre - reach), 0, last + 1).astype(int)
    high = np.clip(np.ceil(rectangle.centre + reach), -1, last).astype(int)
    v, u = np.mgrid[low[1] : high[1] + 1, low[0] : high[0] + 1]
    offset = np.stack([u, v], axis=-1) - rectangle.centre
    along, across = np.moveaxis(np.abs(offset @ rectangle.axes.T), -1, 0)
    covered = (along <= rectangle.width / 6 + _ROUNDING) & (
        across <= rectangle.height / 2 + _ROUNDING
    )
    if not covered.any():
        nearest = np.rint(rectangle.centre).astype(int)
        if (nearest >= 0).all() and (nearest <= last).all():
            return nearest[1:], nearest[:1]
    return v[covered], u[covered]


# --- Images with rectangles ---------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class RealSample:
    """One real image with its labels.

    name: the image's id. object_id: images with the same id show the same object.
    rgb: (H, W, 3) uint8. depth: (H, W) float32 metres along the optical axis, holes filled.
    positives, negatives: rectangles in pixels of this image; Jacquard has no negatives.
    skipped: rectangles left out because a corner is NaN.
    """

    name: str
    object_id: str
    rgb: np.ndarray
    depth: np.ndarray
    positives: tuple[GraspRectangle, ...]
    negatives: tuple[GraspRectangle, ...] = ()
    skipped: int = 0


@dataclass(frozen=True)
class View:
    """The central square of a camera's images, resampled for the network.

    side: pixels of the image that the square measures; it never depends on the labels. size: pixels
    that it measures for the network. metres_per_pixel: the length that one of these spans at the
    image's typical depth; it converts widths between pixels and metres. slanted: whether the camera
    sees the table from the side, so that its samples need `levelled`.
    """

    side: int
    size: int
    metres_per_pixel: float
    slanted: bool = False

    def matrix(self, shape: tuple[int, int]) -> np.ndarray:
        """Return the (3, 3) matrix from a pixel (u, v, 1) of an image (H, W) to the view's."""
        zoom = self.size / self.side
        height, width = shape
        matrix = np.diag([zoom, zoom, 1.0])
        matrix[:2, 2] = (self.size - 1) / 2 - zoom * np.array([width - 1, height - 1]) / 2
        return matrix

    def warp(
        self,
        sample: RealSample,
        change: np.ndarray | None = None,
        border: int = cv2.BORDER_REPLICATE,
    ) -> tuple[np.ndarray, np.ndarray, list[GraspRectangle]]:
        """Return rgb (size, size, 3) uint8, depth (size, size) metres and the labelled rectangles
        in the view, after a `change` (3, 3) of the view's pixels. border: OpenCV's, of what lies
        beyond the image; by default its edge is repeated."""
        matrix = self.matrix(sample.depth.shape)
        matrix = matrix if change is None else change @ matrix
        rgb, depth = (
            cv2.warpAffine(
                image, matrix[:2], (self.size, self.size), flags=method,
                borderMode=border,
            )
            for image, method in ((sample.rgb, cv2.INTER_LINEAR), (sample.depth, cv2.INTER_NEAREST))
        )  # fmt: skip
        return rgb, depth, [rectangle.transformed(matrix) for rectangle in sample.positives]

    def levelled(self, sample: RealSample) -> RealSample:
        """Return the sample with depth as if every ray met the table at the same distance.

        In a slanted view depth depends mostly on the place on the table; levelled, it depends on
        the height above the table, as in images from above. The square has to show mostly table.
        """
        inverse = _inverse_table(sample.depth, self.side)
        middle = float(np.median(_central(inverse, self.side)))
        return replace(sample, depth=(sample.depth * (inverse / middle)).astype(np.float32))


def _inverse_table(depth: np.ndarray, side: int) -> np.ndarray:
    """Return one over the table's depth, (H, W) in 1/m: a quadratic of the pixel.

    For a plane it is linear; the squares absorb lens distortion, and ranges in place of depths. The
    fit over the central square is robust: objects and walls are far off the table and hardly count.
    """
    height, width = depth.shape
    v, u = (np.mgrid[:height, :width] - np.reshape([height / 2, width / 2], (2, 1, 1))) / side
    terms = np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=-1)
    seen = _central(terms * depth[..., None], side)[::_TABLE_STEP, ::_TABLE_STEP].reshape(-1, 6)
    start = np.linalg.lstsq(seen, np.ones(len(seen)), rcond=None)[0]
    # SciPy before 1.16 scales the derivative in place.
    found, _ = robust_fit(lambda x: seen @ x - 1, start, _FLAT, jac=lambda x: seen.copy())
    return terms @ found


def _central(image: np.ndarray, side: int) -> np.ndarray:
    """Return the square of `side` pixels in the middle of (H, W, ...), or less in small images."""
    top, left = (max(0, (length - side) // 2) for length in image.shape[:2])
    return image[top : top + side, left : left + side]
