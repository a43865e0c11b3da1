"""An object as the hand sees it, and how far the hand still has to go to grasp it from above.

Ground truth from the simulator: for rewards, for critics, and for teaching a network to see it;
never for a policy that is to work without it. Knows nothing of robots or of PyBullet.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial import ConvexHull

DIRECTIONS = 36  # over half a turn, from the closing line on: every 5 degrees
TOLD = 8  # of these that an outline tells: about every 22.5 degrees

_FINGERS = 0.035  # m, the hand would hit what reaches farther up between the fingers than this
_OVER = 0.02  # m over an object's highest point at which the fingertips pass freely
_SIDE_SLACK, _LENGTH_SLACK = 0.008, 0.015  # m off the middle from where the hand may come down
_EDGE = 0.01  # m beyond that slack over which the way down is closed
_OPENING_SLACK = 0.01  # m by which the fingers should be wider apart than the object


# (3, 2 DIRECTIONS + 1): the directions over a whole turn in the closing line's frame, and up.
_TURNS = math.pi / DIRECTIONS * np.arange(2 * DIRECTIONS)
_AXES = np.column_stack([[np.cos(_TURNS), np.sin(_TURNS), 0 * _TURNS], [0.0, 0.0, 1.0]])


class Outline:
    """The outer points of one object.

    parts: arrays (V, 3) of its convex parts' vertices in the body frame, metres.
    """

    def __init__(self, parts: tuple[np.ndarray, ...]):
        points = np.concatenate(parts)
        self._points = points[ConvexHull(points).vertices]

    def seen_from(self, T_WO: np.ndarray, T_WE: np.ndarray) -> View:
        """The object at T_WO (4, 4) as seen from a hand at T_WE (4, 4)."""
        x, y = T_WE[0, 1], T_WE[1, 1]  # of the closing line
        length = math.hypot(x, y)
        x, y = x / length, y / length
        turn = np.array([[x, -y, 0.0], [y, x, 0.0], [0.0, 0.0, 1.0]])
        reach = np.maximum.reduce(self._points @ (T_WO[:3, :3].T @ turn @ _AXES))
        between = T_WO[:3, 3] - T_WE[:3, 3]
        height = float(between[2])
        return View(
            between @ T_WE[:3, :3],
            reach[:DIRECTIONS] + reach[DIRECTIONS:-1],
            float(reach[-1]) + height,
            height,
        )


class View:
    """offset: (3,) m from E to the object's centre, along E's axes. widths: (DIRECTIONS,) m, of the
    object's shadow from straight above, along lines turned about +z of W from the fingers' closing
    line by multiples of 180 / DIRECTIONS degrees. top: m, its highest point over E. centre: m, its
    centre over E."""

    def __init__(self, offset: np.ndarray, widths: np.ndarray, top: float, centre: float):
        self.offset, self.widths, self.top, self.centre = offset, widths, top, centre

    def outline(self) -> np.ndarray:
        """(TOLD + 1,) m: some of the widths, and the top. They tell a cylinder from a box and where
        a box's sides are without naming an angle, which symmetric objects have several of."""
        told = np.empty(TOLD + 1)
        told[:TOLD] = self.widths[:: -(-DIRECTIONS // TOLD)][:TOLD]
        told[TOLD] = self.top
        return told

    def way_to_grasp(self, opening: float) -> float:
        """Metres that the hand, open by `opening` metres, has yet to go until it is around the
        object's middle: sideways, up or down, in turning, and in opening, added up.

        Down it is only over the object; elsewhere the way goes by a point over the object's top.
        A hand that came down beside it is therefore farther away than one above it.
        """
        x, y = abs(float(self.offset[0])), abs(float(self.offset[1]))
        off = max(x - _LENGTH_SLACK, y - _SIDE_SLACK, 0.0)
        down = max(self.centre, self.top - _FINGERS)  # of E at the grasp, over where E is now
        closed = min(off / _EDGE, 1.0)
        height = (1 - closed) * down + closed * (self.top + _OVER)
        narrowest = float(self.widths.min())
        turn = float(self.widths[0]) - narrowest
        open_up = max(narrowest + _OPENING_SLACK - opening, 0.0)
        return math.hypot(x, y) + abs(height) + turn + open_up
