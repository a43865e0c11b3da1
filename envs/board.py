"""A board with four ArUco markers: a body in the cell that can be found again in an image.

Frame O: origin in the middle of the board's face, x right and y up as the face is looked at, z out
of it. The pattern is slanted on the board, because an edge along the rows or columns of an image
without soft edges tells its place to half a pixel only, and one across them much better. (A goal at
which the slanted pattern itself is parallel to the image is the one to avoid: it costs up to 1 mm.)

The markers are those of Garrido-Jurado et al., "Automatic generation and detection of highly
reliable fiducial markers under occlusion", Pattern Recognition 47(6), 2014. Their corners come from
an alignment of the whole board (Evangelidis and Psarakis, "Parametric image alignment using
enhanced correlation coefficient maximization", IEEE T-PAMI 30(10), 2008), which uses every edge of
the pattern and is several times as precise as looking for each corner by itself.

This module knows neither robot nor servo.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from utils.errors import TargetLostError

MARKERS = 4
_DICTIONARY = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
_MARKER, _GAP, _MARGIN = 6, 2, 1  # cells; a marker is 4 cells of code and a black rim around them
_CELLS = 2 * (_MARGIN + _MARKER) + _GAP  # along the pattern's side
_SIDE = 20  # cells along the board's side: white all around, so that nothing behind it blurs in
_SLANT = np.radians(8.0)  # from the board's axes to the pattern's, about z
_CELL_PIXELS = 10  # of the pattern to which the image is aligned
_BLACK_HEIGHT = 1e-4  # m by which the black stands out of the white, so that it is what is seen
_SQUARE = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])  # its corners' columns and rows, clockwise
_OUTERMOST = _MARGIN + (_CELLS - 2 * _MARGIN) * _SQUARE  # corners of the markers
WHITE, BLACK = (0.95, 0.95, 0.95, 1.0), (0.03, 0.03, 0.03, 1.0)
_ALIGNED = 0.9  # least correlation of the board's image with its pattern; a free view has 0.98


@dataclass(frozen=True)
class Board:
    """Four square markers, numbers 0 to 3, clockwise from the top left.

    cell: side of a marker's smallest square, metres; markers have 6 of them, the board has 20.
    thickness: metres.
    """

    cell: float = 0.01
    thickness: float = 0.004

    @property
    def size(self) -> float:
        """Side in metres."""
        return _SIDE * self.cell

    @property
    def points(self) -> np.ndarray:
        """(4, 3) the outermost corner of each marker in O, metres, clockwise from the top left."""
        return self._place(_OUTERMOST)

    def _place(self, columns_rows: np.ndarray) -> np.ndarray:
        """(n, 3) points in O, metres, of places (n, 2) in the pattern, cells."""
        x, y = (columns_rows - _CELLS / 2).T * [[self.cell], [-self.cell]]
        c, s = np.cos(_SLANT), np.sin(_SLANT)
        return np.stack([c * x - s * y, s * x + c * y, np.zeros(len(x))], axis=1)

    def find(self, rgb: np.ndarray) -> np.ndarray:
        """(4, 2) pixels (u, v) of `points` in a colour image (H, W, 3) uint8.

        Raises TargetLostError unless all four markers are seen, and seen well.
        """
        grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
        quads, numbers, _ = _DETECTOR.detectMarkers(grey)
        found = {} if numbers is None else dict(zip(numbers.ravel().tolist(), quads))
        missing = [str(number) for number in range(MARKERS) if number not in found]
        if missing:
            raise TargetLostError(
                f"target lost: of its {MARKERS} markers not seen: {', '.join(missing)}"
            )
        rough = np.concatenate([found[number][0] for number in range(MARKERS)])
        start, _ = cv2.findHomography(_PATTERN_CORNERS, rough)
        try:
            correlation, warp = cv2.findTransformECC(
                _PATTERN, grey, start.astype(np.float32), cv2.MOTION_HOMOGRAPHY, _STOP, None, _BLUR
            )
        except cv2.error as error:  # it says so where it diverges
            raise TargetLostError("target lost: the board cannot be aligned") from error
        if correlation < _ALIGNED:
            raise TargetLostError(
                f"target lost: the board's image and its pattern correlate by {correlation:.2f} "
                f"only, at least {_ALIGNED} is needed"
            )
        return cv2.perspectiveTransform(_PATTERN_POINTS[None], warp.astype(float))[0]

    def pose(self, pixels: np.ndarray, K: np.ndarray) -> np.ndarray:
        """(4, 4) T_CO from the pixels (4, 2) of `points` and the pinhole matrix K (3, 3)."""
        # A plane seen from far away has two poses that look alike; IPPE gives the better one.
        _, turn, shift = cv2.solvePnP(self.points, pixels, K, None, flags=cv2.SOLVEPNP_IPPE)
        turn, shift = cv2.solvePnPRefineLM(self.points, pixels, K, None, turn, shift)
        T_CO = np.eye(4)
        T_CO[:3, :3], T_CO[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
        return T_CO

    def white(self) -> tuple[list[float], list[float]]:
        """Half sizes (3,) of the box behind the black cells, and its middle (3,) in O, metres."""
        half = [self.size / 2, self.size / 2, self.thickness / 2]
        return half, [0.0, 0.0, -_BLACK_HEIGHT - self.thickness / 2]

    def black(self) -> tuple[list, list]:
        """Vertices (n, 3) in O and triangles (3 m,), their corners' numbers, of all black cells."""
        black = np.argwhere(_cells() == 0)[:, ::-1]
        vertices = self._place((black[:, None] + _SQUARE[::-1]).reshape(-1, 2))
        first = 4 * np.arange(len(black))[:, None]
        return vertices.tolist(), (first + [0, 1, 2, 0, 2, 3]).ravel().tolist()


def _marker_places() -> np.ndarray:
    """(4, 2) row and column in the pattern of each marker's first cell."""
    near, far = _MARGIN, _MARGIN + _MARKER + _GAP
    return np.array([[near, near], [near, far], [far, far], [far, near]])


def _cells() -> np.ndarray:
    """(16, 16) uint8 the pattern, a number for each cell: 0 black, 255 white."""
    cells = np.full((_CELLS, _CELLS), 255, np.uint8)
    for number, (row, column) in enumerate(_marker_places()):
        marker = _DICTIONARY.generateImageMarker(number, _MARKER)
        cells[row : row + _MARKER, column : column + _MARKER] = marker
    return cells


def _pattern_corners() -> np.ndarray:
    """(16, 2) the markers' corners in the pattern's pixels, each marker's from its top left
    clockwise."""
    places = [place[::-1] + _MARKER * _SQUARE for place in _marker_places()]
    return _to_pattern(np.concatenate(places))


def _to_pattern(columns_rows: np.ndarray) -> np.ndarray:
    """Pixels (n, 2) of the pattern from cells (n, 2); integer pixels are the pixels' centres."""
    return columns_rows * float(_CELL_PIXELS) - 0.5


def _detector() -> cv2.aruco.ArucoDetector:
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    return cv2.aruco.ArucoDetector(_DICTIONARY, parameters)


_DETECTOR = _detector()
_PATTERN = np.kron(_cells(), np.ones((_CELL_PIXELS, _CELL_PIXELS), np.uint8))
_PATTERN_CORNERS = _pattern_corners()
_PATTERN_POINTS = _to_pattern(_OUTERMOST)
_STOP = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 1e-5)
_BLUR = 3  # pixels, of both images before they are compared
