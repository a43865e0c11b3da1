"""Depth images corrected by what the table in them tells: the camera's scale, and its roughness.

The table's height is known. So the table shows by which factor the camera measures too far or too
near, and how rough a flat surface appears. `corrected` takes both errors out of a frame: the first
by a factor, the second by a filter whose guide is the colour image, so that edges of objects stay,
and by the table's own depth where the colour is the table's. What lies far below the table, as the
floor beside it, becomes table.
Holes are the subject of `utils.depth_holes`. This module knows no simulator and no network.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from utils.depth_holes import (
    LIKE_TABLE,
    depth_of_plane,
    middle_depth,
    reach_in_pixels,
    sampled,
)
from utils.transforms import RGBDFrame, inverse_pose, known_depth, transform_points

TRUSTED_SCALE = 0.002  # errors of the scale below this are left alone: 1.6 mm at 0.8 m
SCALE_SPREAD = 0.04  # standard deviation of the errors of scale that are expected
SCALE_REACH = 0.12  # and the largest one
BACKGROUND = 0.9  # what is measured farther than the table's depth over this is no table
TRUSTED_ROUGHNESS = 0.003  # m, standard deviation of a table that needs no smoothing
SMOOTHING_RADIUS = 0.007  # m, half the side of the windows that are smoothed
COLOUR_NOISE = 0.01  # standard deviation of colours, 0..1, that are one surface
TRUSTED_FLATNESS = 0.0003  # m, standard deviation of a table that need not be made flat
# The table is measured within so many standard deviations of its roughness, and within so many m:
# what is rougher has another reason, as a wrong pose of the camera.
TABLE_SPREAD, HIGHEST_BUMP = 5.0, 0.015


def corrected(frame: RGBDFrame, table_height: float) -> RGBDFrame:
    """The frame with its depth scaled until the table lies at `table_height` (m in W), without
    background, smoothed where the table is rough, and the table flat; as it is where its camera is
    as good as that already. It tells how rough the table was. So is its second frame."""
    if frame.second is not None:
        frame = replace(frame, second=corrected(frame.second, table_height))
    asked = _ratio_to_table(frame, table_height)
    scale, spread = _scale_and_spread(asked)
    if scale != 1:
        frame = replace(frame, depth=(scale * frame.depth).astype(np.float32))
    if (asked < BACKGROUND * scale).sum() > _MUCH_BACKGROUND * len(asked):
        frame = replace(frame, depth=without_background(frame, table_height))
    rest = roughness = spread * middle_depth(frame) if spread else 0.0
    if roughness > TRUSTED_ROUGHNESS:
        frame = replace(frame, depth=smoothed_by_colour(frame))
        rest = table_roughness(frame, table_height)
    if rest > TRUSTED_FLATNESS:
        frame = replace(frame, depth=flattened_by_colour(frame, table_height, rest))
    # A frame that was corrected before is less rough now, but no more certain.
    roughness, rest = max(frame.roughness, roughness), max(frame.noise, rest)
    return replace(frame, roughness=roughness, noise=rest)


def without_background(frame: RGBDFrame, table_height: float) -> np.ndarray:
    """(H, W) float32 depth with the table's own, as if the table went on, where the measured one is
    more than 1 / BACKGROUND times as large; and 0, unknown, where a pixel's ray meets no table.

    The floor beside a table, or a wall behind it, may fill most of an image: lengths in pixels,
    which are taken at the median depth, are to be those on the table.
    """
    table = depth_of_plane(frame, table_height)
    met = np.isfinite(table) & (table > 0)
    beyond = known_depth(frame.depth) & (BACKGROUND * frame.depth > table) & met
    return np.where(beyond, table, np.where(met, frame.depth, 0)).astype(np.float32)


def scale_to_table(frame: RGBDFrame, table_height: float) -> float:
    """The factor by which depths have to be multiplied for the table to lie at its height; 1 where
    too little of a table is seen."""
    return _densest(_ratio_to_table(frame, table_height))


def _densest(asked: np.ndarray) -> float:
    """The factor of the table, of those that pixels (N,) ask for; 1 where too few agree.

    Those of the table ask for the same one. It is the densest of all, weighted by how likely a
    camera is to be that wrong, because the top of a box asks alike, too. But nothing lies under a
    table: where a flat surface is seen beneath that one, it is the table, and what asked alike was
    the top of something wide; a small one counts only where it is at the table's height already.
    """
    least = _LEAST_SHARE * len(asked)
    asked = asked[np.abs(asked - 1) < SCALE_REACH]
    if len(asked) <= least:
        return 1.0
    edges = np.arange(1 - SCALE_REACH, 1 + SCALE_REACH, _BIN)
    count = np.histogram(asked, edges)[0].astype(float)
    middle = (edges[1:] + edges[:-1]) / 2
    density = cv2.GaussianBlur(count[None], (0, 0), _BLUR / _BIN)[0]
    best = float(middle[(density * np.exp(-(((middle - 1) / SCALE_SPREAD) ** 2) / 2)).argmax()])
    peaks = middle[1:-1][(density[1:-1] > density[:-2]) & (density[1:-1] >= density[2:])]
    for lower in peaks[peaks < best - 2 * _BLUR]:  # the farthest first
        count = (np.abs(asked - lower) < 2 * _BLUR).sum()
        if count > least:
            best = float(lower)
            break
        if count > _LOWER_SHARE * len(asked) and abs(lower - 1) < 2 * _BLUR:
            return 1.0  # too little to measure the scale by, and right as it is
    for _ in range(_REFITS):
        alike = asked[np.abs(asked - best) < 2 * _BLUR]
        if len(alike) <= least:
            return 1.0
        best = float(alike.mean())
    return best


_BIN = 0.001  # of the histogram of factors
_BLUR = 0.005  # standard deviation that is expected among the table's factors
_REFITS = 3
_LEAST_SHARE = 0.15  # of the known pixels that have to agree on the table
_LOWER_SHARE = 0.05  # of those near any table, that tell of a flat surface beneath the densest
_MUCH_BACKGROUND = 0.01  # of the known pixels
_SAMPLE = 20_000  # pixels that are asked
_NEAREST = 0.01  # m, in front of which a camera sees nothing


def table_roughness(frame: RGBDFrame, table_height: float) -> float:
    """Standard deviation in metres of the table's depth, once the frame is scaled to the table,
    from the median absolute deviation of all pixels near it; 0 where no table is seen. Depth in
    steps, as a Kinect's, has none: half of the table lies on one step."""
    scale, spread = _scale_and_spread(_ratio_to_table(frame, table_height))
    return spread * scale * middle_depth(frame) if spread else 0.0


def _scale_and_spread(asked: np.ndarray) -> tuple[float, float]:
    """The factor by which a frame's depth is corrected, 1 where it is trusted as it is, and the
    standard deviation of the table's depth as a share of it. asked: (N,) as of `_densest`."""
    scale = _densest(asked)
    if abs(scale - 1) <= TRUSTED_SCALE:
        scale = 1.0
    error = asked / scale - 1
    near = error[np.abs(error) < 4 * _BLUR]
    if len(near) <= _LEAST_SHARE * len(error):
        return scale, 0.0
    return scale, 1.4826 * float(np.median(np.abs(near - np.median(near))))


def _ratio_to_table(frame: RGBDFrame, table_height: float) -> np.ndarray:
    """(N,) the table's depth over the measured one, for a sample of the known pixels whose ray
    meets the table and no fixture: the top of a board is as flat as the table, and may cover more
    of it."""
    table = depth_of_plane(frame, table_height)
    on = known_depth(frame.depth) & np.isfinite(table) & (table > 0)
    on &= ~_fixture_pixels(frame)
    pixels = sampled(np.flatnonzero(on), _SAMPLE)
    return table.take(pixels) / frame.depth.take(pixels)


def _fixture_pixels(frame: RGBDFrame) -> np.ndarray:
    """(H, W) bool, pixels whose rays meet a fixture."""
    found = np.zeros(frame.depth.shape, np.uint8)
    for solid in frame.fixtures:
        corners = transform_points(inverse_pose(frame.T_WC), solid.vertices)
        front, back = corners[corners[:, 2] > _NEAREST], corners[corners[:, 2] <= _NEAREST]
        # The part before the camera is the hull of the corners there and of where lines to the
        # corners behind it cross the nearest plane.
        share = (front[:, None, 2] - _NEAREST) / (front[:, None, 2] - back[:, 2])
        crossings = front[:, None] + share[..., None] * (back - front[:, None])
        seen = np.concatenate([front, crossings.reshape(-1, 3)]) @ frame.K.T
        if len(seen):
            outline = np.rint(np.clip(seen[:, :2] / seen[:, 2:], -1e6, 1e6)).astype(np.int32)
            cv2.fillConvexPoly(found, cv2.convexHull(outline), 1)
    return found > 0


def smoothed_by_colour(frame: RGBDFrame) -> np.ndarray:
    """(H, W) float32 depth, smoothed by the guided filter: in each window the depth that is linear
    in the colours and nearest to the measured one (He, Sun and Tang, "Guided image filtering",
    TPAMI 2013). Where the colour is uniform that is the mean, and a step in colour may be a step in
    depth. Unknown pixels stay 0 and weigh nothing.
    """
    known = known_depth(frame.depth)
    if not known.any():
        return frame.depth
    radius = reach_in_pixels(frame, SMOOTHING_RADIUS)
    weight = known.astype(np.float32)
    share = np.maximum(_window_sum(weight, radius), 1e-6)

    def mean(image: np.ndarray) -> np.ndarray:
        """Over the known pixels of each window."""
        return _window_sum(weight * image, radius) / share

    middle = np.float32(middle_depth(frame))
    depth = np.where(known, frame.depth - middle, 0).astype(np.float32)
    colours = np.moveaxis(frame.rgb.astype(np.float32) / 255, -1, 0)
    colour_mean, depth_mean = [mean(c) for c in colours], mean(depth)
    together = [mean(c * depth) - m * depth_mean for c, m in zip(colours, colour_mean)]
    spread = {
        (i, j): mean(colours[i] * colours[j]) - colour_mean[i] * colour_mean[j]
        + (COLOUR_NOISE**2 if i == j else 0)
        for i in range(3) for j in range(i, 3)
    }  # fmt: skip
    slope = _solved(spread, together)
    level = depth_mean - sum(a * m for a, m in zip(slope, colour_mean))
    smooth = sum(mean(a) * c for a, c in zip(slope, colours)) + mean(level) + middle
    return np.where(known, smooth, 0).astype(np.float32)


def flattened_by_colour(frame: RGBDFrame, table_height: float, roughness: float) -> np.ndarray:
    """(H, W) float32 depth with the table's own at those pixels that have its colour and are
    measured within TABLE_SPREAD times its roughness (m), and within HIGHEST_BUMP, of it.

    Otherwise the noise of a flat table is as high as a spoon: fingers would keep off its bumps, and
    so never reach what lies between them.
    """
    table = depth_of_plane(frame, table_height)
    error = np.abs(frame.depth - table)
    sure = np.flatnonzero(known_depth(frame.depth) & (error < roughness))
    if not len(sure):
        return frame.depth
    colours = frame.rgb.reshape(-1, 3)[sampled(sure, _COLOURS)]
    unlike = frame.rgb - np.median(colours, axis=0).astype(np.float32)
    unlike = cv2.transform(unlike * unlike, np.ones((1, 3), np.float32))
    flat = known_depth(frame.depth) & (error < bump_height(roughness)) & (unlike < LIKE_TABLE**2)
    return np.where(flat, table, frame.depth).astype(np.float32)


def bump_height(roughness: float) -> float:
    """Metres up to which a flat surface of this roughness (m) rises: what has the table's colour
    counts as table so far, and what rises less is nothing to grasp."""
    return min(TABLE_SPREAD * roughness, HIGHEST_BUMP)


_COLOURS = 1000  # pixels that tell the table's colour


def _window_sum(image: np.ndarray, radius: int) -> np.ndarray:
    size = (2 * radius + 1, 2 * radius + 1)
    return cv2.boxFilter(image, cv2.CV_32F, size, normalize=False, borderType=cv2.BORDER_CONSTANT)


def _solved(matrix: dict[tuple[int, int], np.ndarray], right: list[np.ndarray]) -> list[np.ndarray]:
    """The solution of a symmetric 3 x 3 system at each pixel, by cofactors; `matrix` holds its
    upper triangle."""
    a, b, c, d, e, f = (matrix[at] for at in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)))
    inverse = (
        (d * f - e * e, c * e - b * f, b * e - c * d),
        (c * e - b * f, a * f - c * c, b * c - a * e),
        (b * e - c * d, b * c - a * e, a * d - b * b),
    )
    determinant = a * inverse[0][0] + b * inverse[0][1] + c * inverse[0][2]
    return [sum(x * y for x, y in zip(row, right)) / determinant for row in inverse]
