"""Track an object on a table: find it again in depth images.

An object on a table moves in the plane: x, y and a turn about the table's normal. `make_template`
keeps it as a patch of heights above the table, from the frame on which its grasp was planned;
`TemplateMatcher` turns each depth image into such a patch where the object is expected and aligns
the two by the inverse compositional algorithm (Baker and Matthews, "Lucas-Kanade 20 years on", IJCV
56(3), 2004) with Huber's weights. It fits the table in every image, so the measured T_CO does not
depend on the camera's calibration.

Frames: C camera, W world, P the table as the camera sees it (origin below the camera, z up), O
object: origin on the table below the grasp, z up, x along the closing line. `utils.object_motion`
filters the poses that are found here. This module knows no simulator, no robot and no control law.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from utils.errors import TargetLostError
from utils.table_plane import fit_table_plane, table_frame
from utils.transforms import Grasp, RGBDFrame, inverse_pose, planar, planar_part, transform_points

CELL = 0.002  # m, side of a template's cell
LOWEST = 0.004  # m over the table above which a point belongs to an object
HIGHEST = 0.30  # m over the table, above everything that the hand can grasp
MARGIN = 0.016  # m of table around the object that belong to the template
_LARGEST = 0.12  # m, half the side of the largest template
_BLURS = (2.5, 1.0)  # cells, coarse to fine
_ITERATIONS = 10  # of the alignment at each blur, at most
_HUBER = 0.008  # m of height beyond which a difference counts less
_ALIGNED = 0.80  # least correlation of template and image
_RIDGE = 0.02  # of the Hessian's turn: a nearly round object keeps its expected turn
_STIFF = 1e3  # of the Hessian's turn: a round object does not turn at all
_YAWS = 24  # directions of the search for an object that is not where it was expected
_PER_METRE, _PER_RADIAN = 0.5, 0.1  # cost in correlation of a metre or radian off the expected pose
_RECTANGLE = (0.015, 0.03)  # m, smallest and largest half side of a template's rectangle of points
_SEEN = 0.6  # least share of the object in the image
_NOISE = 0.001  # m, standard deviation of a measured place
_TURN_NOISE = 0.02  # rad, error of a measured turn from sides that the template has not seen


class Found(NamedTuple):
    """T_CO: (4, 4) the object in the camera. correlation: of image and template, at most 1.
    covariance: (3, 3) of x, y (m) and turn (rad) on the table, in O's axes."""

    T_CO: np.ndarray
    correlation: float
    covariance: np.ndarray


@dataclass(frozen=True)
class ObjectTemplate:
    """The object's height map at the time when its grasp was planned.

    height: (N, N) float32 metres over the table in O; the middle of cell [row, col] is at
    x = CELL (col - (N - 1) / 2) and y likewise from the row. seen: (N, N) bool, where the camera
    saw anything: the rest lay in the object's shadow. points: (8, 3) in O, metres: a rectangle
    fixed to the object, see `_rectangle`.
    """

    height: np.ndarray
    seen: np.ndarray
    points: np.ndarray

    @property
    def side(self) -> int:
        return len(self.height)


def grasp_frame(grasp: Grasp) -> np.ndarray:
    """(4, 4) T_WO: on the table (z = 0) below the grasp, x along its closing line."""
    T = np.eye(4)
    c, s = np.cos(grasp.angle), np.sin(grasp.angle)
    T[:2, :2], T[:2, 3] = [[c, -s], [s, c]], grasp.position[:2]
    return T


def make_template(frame: RGBDFrame, grasp: Grasp) -> ObjectTemplate:
    """Cut the object of a grasp out of the frame on which the grasp was planned.

    Raises TargetLostError where nothing stands on the table at the grasp.
    """
    T_WO = grasp_frame(grasp)
    T_OC = inverse_pose(T_WO) @ frame.T_WC
    reach = int(_LARGEST / CELL)
    whole = _patch(frame.depth, frame.K, T_OC, 2 * reach + 1)
    above = (whole > LOWEST).astype(np.uint8)
    _, label = cv2.connectedComponents(above, connectivity=8)
    rows, cols = np.nonzero(label)
    if len(rows) == 0:
        raise TargetLostError("target lost: nothing stands on the table where it was to be grasped")
    nearest = np.argmin((rows - reach) ** 2 + (cols - reach) ** 2)
    mine = label == label[rows[nearest], cols[nearest]]
    seen = (whole >= 0) & (
        mine | ~(above > 0)
    )  # the object's heights below a neighbour are unknown
    whole = np.where(mine, whole, 0).astype(np.float32)
    rows, cols = np.nonzero(mine)
    half = max(abs(rows - reach).max(), abs(cols - reach).max()) + round(MARGIN / CELL)
    half = min(half, reach)
    cut = slice(reach - half, reach + half + 1)
    return ObjectTemplate(
        whole[cut, cut].copy(), seen[cut, cut].copy(), _rectangle(rows, cols, whole, reach)
    )


def _rectangle(rows, cols, height, reach) -> np.ndarray:
    """(8, 3) in O: corners and middles of the sides of a rectangle about the object's middle, at
    its typical height; as large as the object, within bounds that keep it in the image for long."""
    xy = CELL * (np.column_stack([cols, rows]) - reach)
    low, high = xy.min(axis=0), xy.max(axis=0)
    middle, half = (low + high) / 2, np.clip((high - low) / 2, *_RECTANGLE)
    ring = np.array([[1, 0], [1, 1], [0, 1], [-1, 1], [-1, 0], [-1, -1], [0, -1], [1, -1]])
    return np.column_stack([middle + ring * half, np.full(8, np.median(height[rows, cols]))])


def _patch(depth: np.ndarray, K: np.ndarray, T_OC: np.ndarray, side: int) -> np.ndarray:
    """(side, side) float32 heights over z = 0 in O from a depth image; 0: the table, -1: not seen.

    Each pixel is split into as many points as are needed to leave no cell between pixels empty.
    """
    half = (side - 1) / 2
    box, near = _window(depth, K, T_OC, half * CELL)
    if box is None:
        return np.full((side, side), -1, np.float32)
    split = int(np.clip(np.ceil(1.4 * near / K[0, 0] / CELL), 1, 6))
    z = np.repeat(np.repeat(depth[box].astype(float), split, axis=0), split, axis=1)
    sub = (np.arange(split) + 0.5) / split - 0.5
    v, u = ((np.arange(part.start, part.stop)[:, None] + sub).ravel() for part in box)
    x = ((u - K[0, 2]) / K[0, 0])[None, :] * z
    y = ((v - K[1, 2]) / K[1, 1])[:, None] * z
    rise = T_OC[2, 0] * x + T_OC[2, 1] * y + T_OC[2, 2] * z + T_OC[2, 3]
    keep = (rise < HIGHEST) & (z > 0)
    x, y, z, rise = x[keep], y[keep], z[keep], rise[keep]
    col, row = (
        np.rint((T_OC[k, 0] * x + T_OC[k, 1] * y + T_OC[k, 2] * z + T_OC[k, 3]) / CELL + half)
        for k in (0, 1)
    )
    inside = (col >= 0) & (col < side) & (row >= 0) & (row < side)
    patch = np.full(side * side, -1, np.float32)
    cells = (row[inside] * side + col[inside]).astype(np.intp)
    rise = np.where(rise > LOWEST, rise, 0).astype(np.float32)
    np.maximum.at(patch, cells, rise[inside])
    return patch.reshape(side, side)


def _window(depth, K, T_OC, reach: float) -> tuple[tuple[slice, slice] | None, float]:
    """The window of an image that can show a square of +-reach metres about O, and its largest
    depth; None where nothing of it is in the image."""
    corners = reach * np.array([[a, b, c] for a in (-1, 1) for b in (-1, 1) for c in (0, 1)], float)
    corners[:, 2] = np.where(corners[:, 2] > 0, 0.12, 0.0)
    seen = transform_points(inverse_pose(T_OC), corners)
    far = seen[:, 2]
    if far.max() <= 0.02:
        return None, 0.0
    pixels = seen[:, :2] / np.maximum(far, 0.02)[:, None] * K[[0, 1], [0, 1]] + K[:2, 2]
    low = np.clip(np.floor(pixels.min(axis=0)), 0, depth.shape[::-1]).astype(int)
    high = np.clip(np.ceil(pixels.max(axis=0)) + 1, 0, depth.shape[::-1]).astype(int)
    if (high <= low).any():
        return None, 0.0
    return (slice(low[1], high[1]), slice(low[0], high[0])), float(far.max())


class TemplateMatcher:
    """Finds one template in depth images from a camera with the matrix K (3, 3)."""

    def __init__(self, template: ObjectTemplate, K: np.ndarray, size: tuple[int, int]):
        """size: width and height of the images, pixels."""
        self.template, self.K, self.size = template, K, size
        side = template.side
        self._xy = CELL * (np.arange(side) - (side - 1) / 2)
        self._levels = [_Level(template, blur, self._xy) for blur in _BLURS]
        rows, cols = np.nonzero(template.height > LOWEST)
        self._solid = np.column_stack([self._xy[cols], self._xy[rows], template.height[rows, cols]])
        self._centre = self._solid[:, :2].mean(axis=0)
        self.round = self._levels[-1].round

    def find(self, depth: np.ndarray, T_CO: np.ndarray, T_CW: np.ndarray) -> Found:
        """The object in a depth image (H, W), metres.

        T_CO: (4, 4) expected pose. T_CW: (4, 4) the world in the camera by the calibration, from
        which the fit of the table starts. Raises TargetLostError.
        """
        T_PC = table_frame(*fit_table_plane(depth, self.K, T_CW))
        x, y, turn = planar_part(T_PC @ T_CO)
        expected = planar(x, y, turn)
        if self.seen_share(inverse_pose(T_PC) @ expected) < _SEEN:
            raise TargetLostError("target lost: it is expected outside the image")
        T_PO, correlation, covariance = self._align(depth, T_PC, expected)
        if correlation < _ALIGNED:
            again = self._search(depth, T_PC, expected)
            if again is not None and again[1] > correlation:
                T_PO, correlation, covariance = again
        if correlation < _ALIGNED:
            raise TargetLostError(
                f"target lost: image and template correlate by {correlation:.2f} only, at least "
                f"{_ALIGNED} is needed"
            )
        return Found(inverse_pose(T_PC) @ T_PO, correlation, covariance)

    def seen_share(self, T_CO: np.ndarray, nearest: float = 0.0) -> float:
        """Share of the object's surface that lies within the image, were it at T_CO (4, 4); 0 where
        any of it is nearer than `nearest` metres, of which a depth camera sees nothing."""
        seen = transform_points(T_CO, self._solid)
        if seen[:, 2].min() < nearest:
            return 0.0
        pixels = seen[:, :2] / np.maximum(seen[:, 2:], 1e-3) * self.K[[0, 1], [0, 1]]
        pixels = pixels + self.K[:2, 2]
        inside = (seen[:, 2] > 0) & (pixels > -0.5).all(axis=1)
        return float(np.mean(inside & (pixels < np.array(self.size) - 0.5).all(axis=1)))

    def _align(self, depth, T_PC, T_PO) -> tuple[np.ndarray, float, np.ndarray]:
        """T_PO refined, the correlation there, and the covariance (3, 3)."""
        for attempt in range(2):
            image = _patch(depth, self.K, inverse_pose(T_PO) @ T_PC, self.template.side)
            motion = np.eye(3)
            for level in self._levels[attempt:]:
                motion = level.align(image, motion)
            x, y, turn = motion[0, 2], motion[1, 2], np.arctan2(motion[1, 0], motion[0, 0])
            T_PO = T_PO @ planar(x, y, turn)
            if np.hypot(x, y) < 2 * CELL and abs(turn) < 0.05:
                break
        level = self._levels[-1]
        return T_PO, level.correlation(image, motion), level.covariance()

    def _search(self, depth, T_PC, expected) -> tuple[np.ndarray, float, np.ndarray] | None:
        """The best of many poses: each thing on the table, in each direction. A pose off the
        expected one needs a better correlation, because images follow each other closely: nearly
        round objects would otherwise turn with every search."""
        best = None
        middle = (expected @ planar(*self._centre, 0.0))[:2, 3]
        for place in self._things(depth, T_PC):
            away = _PER_METRE * np.linalg.norm(place - middle)
            for turn in np.pi * (2 * np.arange(_YAWS) / _YAWS - 1):
                yaw = planar_part(expected)[2] + turn
                T_PO = planar(*place, yaw) @ planar(*-self._centre, 0.0)
                image = _patch(depth, self.K, inverse_pose(T_PO) @ T_PC, self.template.side)
                score = self._levels[0].correlation(image, np.eye(3))
                score -= away + _PER_RADIAN * abs(turn)
                if best is None or score > best[0]:
                    best = score, T_PO
        return None if best is None else self._align(depth, T_PC, best[1])

    def _things(self, depth: np.ndarray, T_PC: np.ndarray) -> list[np.ndarray]:
        """(2,) middles in P of the things on the table that are about as large as the template."""
        v, u = np.mgrid[0 : depth.shape[0], 0 : depth.shape[1]]
        K = self.K
        points = np.stack(
            [(u - K[0, 2]) / K[0, 0] * depth, (v - K[1, 2]) / K[1, 1] * depth, depth], axis=-1
        )
        points = transform_points(T_PC, points)
        above = (points[..., 2] > LOWEST) & (points[..., 2] < HIGHEST) & (depth > 0)
        count, label = cv2.connectedComponents(above.astype(np.uint8), connectivity=8)
        things = []
        for number in range(1, count):
            mine = points[label == number]
            size = np.ptp(mine[:, :2], axis=0).max() if len(mine) > 8 else 0.0
            if 0.4 < size / np.ptp(self._solid[:, :2], axis=0).max() < 2.5:
                things.append((mine[:, :2].max(axis=0) + mine[:, :2].min(axis=0)) / 2)
        return things


def _smooth(height: np.ndarray, seen: np.ndarray, blur: float) -> tuple[np.ndarray, np.ndarray]:
    """Heights blurred by a Gaussian over the seen cells only (normalised convolution, Knutsson and
    Westin 1993), and the weight of each cell: 0 where it is not seen."""
    known = seen.astype(np.float32)
    share = cv2.GaussianBlur(known, (0, 0), blur)
    total = cv2.GaussianBlur(np.where(seen, height, 0).astype(np.float32), (0, 0), blur)
    return total / np.maximum(share, 1e-3), known


class _Level:
    """A template at one blur, and the alignment of images to it."""

    def __init__(self, template: ObjectTemplate, blur: float, xy: np.ndarray):
        height, self.blur, self.shape = template.height, blur, template.height.shape
        smooth, known = _smooth(height, template.seen, blur)
        gradient_y, gradient_x = np.gradient(smooth.astype(float), CELL)
        grown = cv2.dilate(height, np.ones((2 * round(MARGIN / CELL) - 3,) * 2))
        self.where = np.flatnonzero((grown > LOWEST) & template.seen)
        y, x = xy[self.where // len(xy)], xy[self.where % len(xy)]
        gx, gy = gradient_x.ravel()[self.where], gradient_y.ravel()[self.where]
        self.J = np.column_stack([gx, gy, gy * x - gx * y])
        self.target = smooth.ravel()[self.where].astype(float)
        half = (len(xy) - 1) / 2
        self._to_cells = np.array([[1 / CELL, 0, half], [0, 1 / CELL, half], [0, 0, 1]])
        self._to_metres = np.linalg.inv(self._to_cells)
        hessian = self.J.T @ self.J
        self.ridge = np.diag([0, 0, _RIDGE * 0.02**2 * (hessian[0, 0] + hessian[1, 1])])
        self.ridge += 1e-9 * np.trace(hessian) * np.eye(3)
        whole = np.linalg.inv(hessian + self.ridge)
        self.scale = _NOISE**2 / max(whole[0, 0], whole[1, 1])
        # The information on a turn about the object's own middle, wherever the grasp is: the part
        # of the turn that no shift can undo.
        shifts, coupling = hessian[:2, :2] + self.ridge[:2, :2], hessian[:2, 2]
        turning = hessian[2, 2] - coupling @ np.linalg.solve(shifts, coupling)
        self.round = bool(turning < 4 * self.ridge[2, 2])
        if self.round:
            self.ridge[2, 2] = _STIFF * hessian[2, 2]
        self._hessian = hessian

    def covariance(self) -> np.ndarray:
        """(3, 3) of the last alignment: an unseen side leaves the place along it uncertain, and the
        turn of a round object is practically unknown."""
        covariance = self.scale * np.linalg.inv(self._hessian + self.ridge)
        covariance += np.diag([0.25 * _NOISE**2, 0.25 * _NOISE**2, _TURN_NOISE**2])
        if self.round:
            covariance[2, :] = covariance[:, 2] = 0.0
            covariance[2, 2] = 100.0
        return covariance

    def _warped(self, image: np.ndarray, motion: np.ndarray) -> np.ndarray:
        matrix = (self._to_cells @ motion @ self._to_metres)[:2]
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return cv2.warpAffine(image, matrix, self.shape, flags=flags).ravel()[self.where]

    def align(self, image: np.ndarray, motion: np.ndarray) -> np.ndarray:
        """(3, 3) motion in the plane that takes the template's cells to the image's."""
        smooth, known = _smooth(image, image >= 0, self.blur)
        for _ in range(_ITERATIONS):
            difference = self._warped(smooth, motion) - self.target
            weight = np.minimum(1.0, _HUBER / np.maximum(np.abs(difference), 1e-9))
            weighted = self.J * (weight * (self._warped(known, motion) > 0.99))[:, None]
            self._hessian = weighted.T @ self.J
            step = np.linalg.solve(self._hessian + self.ridge, weighted.T @ difference)
            motion = motion @ np.linalg.inv(planar(*step)[np.ix_([0, 1, 3], [0, 1, 3])])
            if np.hypot(step[0], step[1]) < 2e-5 and abs(step[2]) < 5e-4:
                break
        return motion

    def correlation(self, image: np.ndarray, motion: np.ndarray) -> float:
        """Normalised product of image and template, both heights over the table, over the cells
        that both have seen; 0 where these are less than half of the template."""
        smooth, known = _smooth(image, image >= 0, self.blur)
        seen, both = self._warped(smooth, motion), self._warped(known, motion) > 0.5
        target = self.target * both
        seen = seen * both
        norms = np.linalg.norm(seen) * np.linalg.norm(target)
        if norms == 0 or target @ target < 0.4 * self.target @ self.target:
            return 0.0
        return float(seen @ target / norms)
