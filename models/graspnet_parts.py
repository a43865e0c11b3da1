"""Parts of one object put together: the votes of a large object meet in several places.

The network learned from objects of the hand's size, so that it takes a hammer or a cereal box for
several. Where two of its objects touch and are one, the surface goes on, the colour differs in
lightness alone, and the votes turn gradually from the one place to the other; between two objects
at least one of these breaks off (as regions are merged by the evidence along their common boundary:
Felzenszwalb and Huttenlocher, IJCV 2004). This module knows no network.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from utils.compiled import compiled


@dataclass(frozen=True)
class PartSettings:
    """Up to which limits two parts are one object, chosen on training objects (docs/choices.md).

    votes: pixels of the network's image between those of two neighbouring cells of 2 mm. step: m
    between the heights `inside` cells beyond these two, where no pixel shows both parts: over the
    default 10 mm, a slope of 45 degrees. Of each the median along the border counts. tint: distance
    in the plane of CIELAB's a* and b* between the parts' medians, without the lightness, which
    light changes more: all greys are alike.
    """

    votes: float = 4.0
    step: float = 0.010
    inside: int = 2
    tint: float = 6.0
    border: int = 5  # pairs of neighbouring cells at least
    surface: float = 4e-4  # m2 of each part at least: smaller ones may be pixels that show both


def joined_parts(
    label: np.ndarray,
    votes: np.ndarray,
    height: np.ndarray,
    colour: np.ndarray,
    count: int,
    cell: float,
    settings: PartSettings = PartSettings(),
) -> np.ndarray:
    """(count,) which object each of the parts 0 to count - 1 belongs to, numbered from 0 on.

    label: (R, C) int, -1 where no part is to be judged by what is there. votes (N, 2) in pixels,
    height (N,) in metres and colour (N, 3) uint8 sRGB: of the N labelled cells, row by row; `cell`
    m wide.
    """
    owner = label[label >= 0]
    large = np.bincount(owner, minlength=count) * cell**2 >= settings.surface
    limits = settings.votes, settings.step
    border, alike = _borders(label, large, votes, height, limits, settings.inside)
    border, alike = border + border.T, alike + alike.transpose(0, 2, 1)
    one = (border >= settings.border) & (2 * alike > border).all(axis=0)
    tint = np.zeros((count, 2))
    for part in np.flatnonzero(one.any(axis=0)):
        lab = cv2.cvtColor(colour[None, owner == part], cv2.COLOR_RGB2Lab)
        tint[part] = np.median(lab[0, :, 1:], axis=0)
    one &= np.hypot(*(tint.T[:, :, None] - tint.T[:, None])) < settings.tint
    if not one.any():
        return np.arange(count)
    return connected_components(csr_array(one), directed=False)[1]


@compiled
def _borders(
    label: np.ndarray,
    large: np.ndarray,
    votes: np.ndarray,
    height: np.ndarray,
    limits: tuple[float, float],
    inside: int,
) -> tuple[np.ndarray, np.ndarray]:
    """How many pairs of neighbouring cells (M, M) lie in one and the other of `large` parts (M,),
    the first one to the left or above, and how many of these pairs (2, M, M) are alike in votes and
    in height. limits: of these two."""
    rows, columns = label.shape
    number = np.full((rows, columns), -1)
    filled = 0
    for r in range(rows):
        for c in range(columns):
            if label[r, c] >= 0:
                number[r, c] = filled
                filled += 1
    border = np.zeros((len(large), len(large)), np.int64)
    alike = np.zeros((2, len(large), len(large)), np.int64)
    for r in range(rows):
        for c in range(columns):
            one = label[r, c]
            if one < 0 or not large[one]:
                continue
            for down, right in ((0, 1), (1, 0)):
                y, x = r + down, c + right
                if y >= rows or x >= columns:
                    continue
                other = label[y, x]
                if other < 0 or other == one or not large[other]:
                    continue
                i, k = number[r, c], number[y, x]
                apart = np.hypot(votes[i, 0] - votes[k, 0], votes[i, 1] - votes[k, 1])
                back, left = r - inside * down, c - inside * right
                if back >= 0 and left >= 0 and label[back, left] == one:
                    i = number[back, left]
                ahead, on = y + inside * down, x + inside * right
                if ahead < rows and on < columns and label[ahead, on] == other:
                    k = number[ahead, on]
                border[one, other] += 1
                alike[0, one, other] += apart < limits[0]
                alike[1, one, other] += abs(height[i] - height[k]) < limits[1]
    return border, alike
