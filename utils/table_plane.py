"""The table's plane in images of depth or of distance.

Each situation has a fit of its own: `fit_table_plane` improves a plane that is known to a few
centimetres; `dominant_plane` and `find_table` search the plane where nothing is known before
(RANSAC, then least squares); `find_table_camera` finds both the table and the place from
which an image's distances are measured. All go through `fit_plane` or `robust_fit`.

Frames: C camera, W world, P the table as the camera sees it (origin below the camera, z up). This
module knows no file format, no network and no simulator.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from utils.errors import TargetLostError, UserError
from utils.transforms import inverse_pose, known_depth, transform_points


def fit_plane(points: np.ndarray, fast: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """(3,) unit normal, of either sign, and (3,) centre of the plane with the least sum of squared
    distances to points (N, 3).

    fast: from the 3x3 scatter matrix, for control loops; the normal of the singular value
    decomposition is exact to more digits.
    """
    centre = points.mean(axis=0)
    if fast:
        # Not one array used twice: NumPy would take another routine, with other last digits.
        scatter = (points - centre).T @ (points - centre)
        return np.linalg.eigh(scatter)[1][:, 0], centre
    return np.linalg.svd(points - centre, full_matrices=False)[2][-1], centre


def robust_fit(
    errors: Callable[..., np.ndarray], start: np.ndarray, scale: float, args=(), jac="2-point"
) -> tuple[np.ndarray, float]:
    """The parameters that make most of the `errors` small, and the median of their absolute values.

    errors: function of the parameters and `args`. scale: error beyond which a point counts ever
    less (Cauchy's loss). jac: derivative of the errors, as in `scipy.optimize.least_squares`.
    """
    found = least_squares(errors, start, jac=jac, loss="cauchy", f_scale=scale, args=args)
    return found.x, float(np.median(np.abs(found.fun)))


# --- A plane that is roughly known ----------------------------------------------------------

_PLANE_BANDS = (0.035, 0.012, 0.004)  # m around the expected table, narrower and narrower
_PLANE_SHARE = 0.15  # of the known pixels that have to lie on the table


def fit_table_plane(depth: np.ndarray, K: np.ndarray, T_CW: np.ndarray) -> tuple[np.ndarray, float]:
    """(3,) unit normal towards the camera and offset d (metres) of the table, n . p + d = 0 in C.

    Least squares on the pixels near the plane z = 0 of W; T_CW (4, 4) has to be right to a
    few centimetres. Raises TargetLostError where the image shows too little of the table.
    """
    step = max(1, int(np.sqrt(depth.size / 8000)))
    z = depth[::step, ::step].astype(float)
    v, u = np.mgrid[0 : depth.shape[0] : step, 0 : depth.shape[1] : step]
    points = np.stack([(u - K[0, 2]) / K[0, 0] * z, (v - K[1, 2]) / K[1, 1] * z, z], axis=-1)
    points = points[known_depth(z)]
    normal = T_CW[:3, 2].copy()
    offset = -normal @ T_CW[:3, 3]
    for band in _PLANE_BANDS:
        near = points[np.abs(points @ normal + offset) < band]
        if len(near) < max(50, _PLANE_SHARE * len(points)):
            raise TargetLostError("target lost: the table it stands on is not in the depth image")
        axis, centre = fit_plane(near, fast=True)
        normal = axis if axis @ normal > 0 else -axis
        offset = -normal @ centre
    return normal, float(offset)


def table_frame(normal: np.ndarray, offset: float) -> np.ndarray:
    """(4, 4) T_PC of a table n . p + d = 0 in C: the origin of P lies on it below the camera."""
    x = np.array([1.0, 0, 0]) - normal[0] * normal
    x /= np.linalg.norm(x)
    T_CP = np.eye(4)
    T_CP[:3, :3] = np.column_stack([x, np.cross(normal, x), normal])
    T_CP[:3, 3] = -offset * normal
    return inverse_pose(T_CP)


# --- The dominant plane ---------------------------------------------------------------------

# "Dominant" is all that a depth image can tell: a wall that fills more of the image than the table
# is taken for it.
TOLERANCE = 0.01  # of the median distance: depth noise, and tables that are not quite flat
SMALLEST_SHARE = 0.2  # of the known points that the table has to hold
TRIALS = 300  # they find a plane with a fifth of the points in 91 % of cases, a third in 99.999 %
POINTS = 4000  # spread over the image, on which the search works
REFITS = 5
SPREADS = 2.5  # robust standard deviations within which a point belongs to the refitted plane


@dataclass(frozen=True)
class Plane:
    """normal: (3,) unit vector towards the camera; distance: metres from the camera's centre,
    >= 0; centre: (3,) mean of the points on it; share: of the known points that lie on it. All in
    the frame of the points, whose origin is the camera."""

    normal: np.ndarray
    distance: float
    centre: np.ndarray
    share: float

    def height(self, points: np.ndarray) -> np.ndarray:
        """(...) metres of points (..., 3) above the plane, on the camera's side."""
        return points @ self.normal + self.distance

    def camera_pose(self) -> np.ndarray:
        """(4, 4) T_WC in the world that the plane defines.

        Its z axis is the plane's normal, its origin the foot of the perpendicular from the
        camera, its x axis the image's right-hand direction laid into the plane (down, should right
        be nearly the normal).
        """
        axis = np.eye(3)[0 if abs(self.normal[0]) < 0.9 else 1]
        x = axis - axis @ self.normal * self.normal
        x /= np.linalg.norm(x)
        T_CW = np.eye(4)
        T_CW[:3, :3] = np.column_stack([x, np.cross(self.normal, x), self.normal])
        T_CW[:3, 3] = -self.distance * self.normal
        return inverse_pose(T_CW)


def dominant_plane(points: np.ndarray) -> Plane:
    """The plane on which most points (..., 3) in the camera's frame lie; rows of NaN are unknown.

    Raises UserError where no plane holds a fifth of the points.
    """
    known = points.reshape(-1, 3)
    known = known[np.isfinite(known).all(axis=1)]
    random = np.random.default_rng(0)
    if len(known) < 3:
        raise UserError("depth: too few known pixels to find the table")
    tolerance = TOLERANCE * float(np.median(np.linalg.norm(known, axis=1)))
    sample = known[random.permutation(len(known))[:POINTS]]
    best = _ransac(sample, tolerance, random)
    near = sample[np.abs(sample @ best[:3] + best[3]) < tolerance]
    for _ in range(REFITS):  # with ever nearer points, so that low objects do not tilt the plane
        if len(near) < 3:
            break
        normal, centre = fit_plane(near)
        best = np.append(normal, -normal @ centre)
        residual = sample @ best[:3] + best[3]
        spread = 1.4826 * np.median(np.abs(residual[np.abs(residual) < tolerance]))
        near = sample[np.abs(residual) < min(SPREADS * spread + 1e-4, tolerance)]
    share = float(np.mean(np.abs(known @ best[:3] + best[3]) < tolerance))
    if share < SMALLEST_SHARE:
        raise UserError(
            f"depth: no table found: the largest plane holds {share:.0%} of the known pixels; "
            "give --camera-pose and --table-height"
        )
    if best[3] < 0:
        best = -best
    return Plane(best[:3], float(best[3]), near.mean(axis=0), share)


def _ransac(points: np.ndarray, tolerance: float, random: np.random.Generator) -> np.ndarray:
    """(4,) normal and offset of the triple's plane with the smallest truncated squared distances
    (MSAC, Torr and Zisserman 2000)."""
    corners = points[random.integers(len(points), size=(TRIALS, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    usable = length > 1e-12
    if not usable.any():
        raise UserError("depth: the known pixels lie on one line; the table cannot be found")
    normals = normals[usable] / length[usable, None]
    offsets = -np.einsum("ij,ij->i", normals, corners[usable, 0])
    squared = (points @ normals.T + offsets) ** 2
    chosen = np.minimum(squared, tolerance**2).sum(axis=0).argmin()
    return np.append(normals[chosen], offsets[chosen])


# --- The table in a world -------------------------------------------------------------------

LARGEST_TILT, TRUSTED_TILT = 10.0, 2.0  # degrees between the plane found and the horizontal of W
DEEPEST, SHALLOW = (
    0.05,
    0.2,
)  # m that all but this share of a scene's points may lie below its table


@dataclass(frozen=True)
class Table:
    """T_WC: (4, 4) the camera in the world. height: z of the table in it, metres. share: of the
    known points that lie on the table, or None if the user gave the height. tilt: degrees of the
    plane found from the horizontal; 0 where it defines the world, or none was searched."""

    T_WC: np.ndarray
    height: float
    share: float | None
    tilt: float = 0.0

    def describe(self) -> str:
        """One line for the user."""
        below = self.T_WC[2, 3] - self.height
        tilt = np.rad2deg(np.arccos(np.clip(-self.T_WC[2, 2], -1, 1)))
        source = "as given" if self.share is None else f"found, {self.share:.0%} of the depth image"
        return (
            f"{source}; {below:.3f} m below the camera, whose view is {tilt:.0f} degrees "
            "from straight down"
        )

    def remarks(self) -> list[str]:
        """A remark on a plane that is not level in the world."""
        if self.tilt <= TRUSTED_TILT:
            return []
        return [
            f"the table found is tilted by {self.tilt:.0f} degrees in your world, and was taken "
            "for level; is the camera's pose T_WC, from the optical frame to the world, and exact?"
        ]


def find_table(points: np.ndarray, T_WC: np.ndarray | None = None) -> Table:
    """The table in points (..., 3) of the camera's frame; rows of NaN are unknown.

    Without T_WC (4, 4) the plane itself defines the world, at height 0. With it, the plane has to
    be level in the world, else a UserError is raised. Not every pose in another convention is
    found so: the inverse of that of a camera that looks straight down leaves the plane level, too.
    """
    plane = dominant_plane(points)
    if T_WC is None:
        return Table(plane.camera_pose(), 0.0, plane.share)
    up = T_WC[:3, :3] @ plane.normal
    tilt = float(np.rad2deg(np.arccos(np.clip(up[2], -1, 1))))
    if tilt > LARGEST_TILT:
        raise UserError(
            f"--camera-pose: the largest plane seen would be tilted by {tilt:.0f} degrees in the "
            "world; is the pose T_WC of the optical frame (x right, y down, z forward)? If the "
            "plane is not the table, give --table-height"
        )
    return Table(T_WC, float(transform_points(T_WC, plane.centre)[2]), plane.share, tilt)


def table_at_height(height: float, points: np.ndarray, T_WC: np.ndarray) -> Table:
    """The table at the user's height; UserError if nearly all of the scene would lie under it."""
    above = np.nanquantile(transform_points(T_WC, points)[..., 2], 1 - SHALLOW) - height
    if above < -DEEPEST:
        raise UserError(
            f"--table-height: {1 - SHALLOW:.0%} of what is seen lies {-above:.2f} m or more below "
            f"the table at {height:g} m; check the height and the camera pose"
        )
    return Table(T_WC, height, None)


# --- The camera of an image of distances ----------------------------------------------------

# Cornell's depth images are of that kind. Its point clouds are given in the robot's frame, and the
# images made from them, as `DepthImage.from_pcd` of github.com/dougsm/ggcnn does, hold the length
# of each point's coordinates. Taken for depths they bend the table by centimetres; as distances
# from the robot they leave it flat, and reveal where camera and robot are.
# Pixels, in an image 640 wide, of the square in its middle in which the table is searched, and
# between those that the fit uses; in others in proportion.
SIDE, STEP, WIDTH = 400, 8, 640
# m: better fits count as this good, because the ratio of two fits that are exact but for rounding
# and steps of depth means nothing: 0.03 mm and 0.01 mm, for depths in the cell.
EXACT = 0.0005
LEAST_PIXELS = 50  # from which six parameters are told from three
FLAT = 0.003  # m: noise of a first Kinect at a metre, beyond which a pixel counts ever less
# Where the search starts: a camera one metre from the table that looks at it from half above, and
# the robot on the camera's side of the table.
STEEP = np.array([0.0, 0.8, 1.0])
ROBOT = np.array([0.0, 0.8, 0.2])
GRAZING = 0.1  # of STEEP times a ray, under which it meets that plane ten times as far away
# An origin above and behind a camera that sees less than 50 degrees: every ray leads away from it.
# It is above any table 0.4 m away or more, unless the camera is tilted by 60 degrees.
BEHIND = np.array([0.0, 0.6, -0.1])
# What an image of distances in metres may hold.
FROM_BASE = "distances from a robot's base"
DEPTHS = "depths along the optical axis"
FROM_CAMERA = "distances from the camera"


@dataclass(frozen=True)
class TableCamera:
    """A table and an origin of distances in the camera's optical frame, metres.

    table: (3,) normal of the plane divided by its distance: the plane's points have
    table @ point = 1. origin: (3,) the place from which the distances are measured.
    """

    table: np.ndarray
    origin: np.ndarray

    @property
    def T_WC(self) -> np.ndarray:
        """(4, 4) in the world whose z = 0 is the table, with the origin where the optical axis
        meets it."""
        length = np.linalg.norm(self.table)
        foot = np.array([0.0, 0.0, 1 / self.table[2]])
        T_WC = Plane(-self.table / length, 1 / length, foot, 1.0).camera_pose()
        T_WC[:2, 3] -= (T_WC[:3, :3] @ foot + T_WC[:3, 3])[:2]
        return T_WC

    def depth(self, distance: np.ndarray, K: np.ndarray) -> np.ndarray:
        """(H, W) float32 metres along the optical axis of points at `distance` (H, W) from the
        origin: where each pixel's ray leaves the sphere of that radius around it. 0 where the
        distance is unknown (see `known_depth`).

        Points nearer than `least_depth` come back mirrored in it.
        """
        rays = _rays(distance.shape, K)
        along, squared = rays @ self.origin, (rays**2).sum(axis=-1)
        beside = self.origin @ self.origin - distance.astype(float) ** 2
        # A pixel that is off by its noise may have a sphere that its ray only just misses.
        root = np.sqrt(np.maximum(along**2 - squared * beside, 0))
        depth = (along + root) / squared
        return np.where(known_depth(distance), depth, 0).astype(np.float32)

    def least_depth(self, rays: np.ndarray) -> np.ndarray:
        """(...) metres along the optical axis where rays (..., 3) are nearest to the origin: points
        before and behind that place are equally far from it."""
        return rays @ self.origin / (rays**2).sum(axis=-1)

    def sees(self, shape: tuple[int, int], K: np.ndarray, height: float) -> bool:
        """Whether all matter up to `height` metres above the table is farther than `least_depth` in
        the middle of an image of `shape`."""
        rays = _middle_rays(shape, K)
        over = (1 - height * np.linalg.norm(self.table)) / (rays @ self.table)
        return bool((over > self.least_depth(rays)).all())


def find_table_camera(distance: np.ndarray, K: np.ndarray) -> TableCamera:
    """The camera of an image of distances (H, W) metres, most of whose middle shows a table.

    Objects and walls hardly count in the robust fit. An origin and its mirror image in the table
    explain the image equally well, for every point of the table is as far from either; the result
    is the one on the camera's side, where a robot's base stands.
    """
    found, _ = _fit_distances(*_middle(distance, K))
    table, origin = found[:3], found[3:]
    behind = max(table @ origin - 1, 0)
    return TableCamera(table, origin - 2 * behind * table / (table @ table))


def table_misses(image: np.ndarray, K: np.ndarray) -> dict[str, float]:
    """How badly a table explains an image (H, W) of metres, for each reading of its values.

    The value is the median distance, in metres, of the middle's known pixels from the table that
    fits best; infinite for all where fewer than LEAST_PIXELS are known.

    Six parameters explain an image of distances from a base, three an image of depths or of
    distances from the camera; so the former is never much worse, even where one of the latter is
    the truth.
    """
    rays, seen = _middle(image, K)
    if len(seen) < LEAST_PIXELS:
        return dict.fromkeys((FROM_BASE, DEPTHS, FROM_CAMERA), np.inf)
    slant = np.linalg.norm(rays, axis=1)

    def off(guess: np.ndarray, stretch: np.ndarray) -> np.ndarray:
        return stretch / (rays @ guess) - seen

    misses = {FROM_BASE: _fit_distances(rays, seen)[1]}
    for reading, stretch in ((DEPTHS, np.ones_like(slant)), (FROM_CAMERA, slant)):
        starts = [STEEP]
        # From one start the fit may end at a plane across two surfaces, as a table's edge shows.
        with contextlib.suppress(UserError):  # where no plane dominates
            plane = dominant_plane(rays * (seen / stretch)[:, None])
            starts.append(-plane.normal / plane.distance)
        misses[reading] = min(robust_fit(off, start, FLAT, args=(stretch,))[1] for start in starts)
    return misses


def distances(depth: np.ndarray, K: np.ndarray, origin: np.ndarray = BEHIND) -> np.ndarray:
    """(H, W) float32 metres from an origin (3,) in the optical frame, other than the camera's, to
    the points at depths (H, W); 0 where the depth is unknown (see `known_depth`).

    This is the inverse of `TableCamera.depth` beyond its `least_depth`; so the origin has to lie on
    the camera's side of the table, and best lies behind the camera.
    """
    known = known_depth(depth)
    points = _rays(depth.shape, K) * np.where(known, depth, 0)[..., None]
    return np.where(known, np.linalg.norm(points - origin, axis=-1), 0).astype(np.float32)


def _fit_distances(rays: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, float]:
    """(6,) table and origin, and the median error in metres."""

    def off(guess: np.ndarray) -> np.ndarray:
        points = rays / (rays @ guess[:3])[:, None]
        return np.linalg.norm(points - guess[3:], axis=1) - seen

    return robust_fit(off, np.concatenate([STEEP, ROBOT]), FLAT)


def _middle(image: np.ndarray, K: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n, 3) rays of pixels in the middle of an image whose values are known, and these (n,); of a
    wide-angle camera those alone that meet the plane from which a search starts."""
    values = image[_middle_of(image.shape)].ravel().astype(float)
    rays = _middle_rays(image.shape, K)
    usable = known_depth(values) & (rays @ STEEP > GRAZING)
    return rays[usable], values[usable]


def _middle_rays(shape: tuple[int, ...], K: np.ndarray) -> np.ndarray:
    return _rays(shape, K)[_middle_of(shape)].reshape(-1, 3)


def _middle_of(shape: tuple[int, ...]) -> tuple[slice, ...]:
    side, step = (max(round(pixels * shape[1] / WIDTH), 1) for pixels in (SIDE, STEP))
    return tuple(
        slice(max(0, (length - side) // 2), (length + side) // 2, step) for length in shape
    )


def _rays(shape: tuple[int, ...], K: np.ndarray) -> np.ndarray:
    """(H, W, 3) vectors from the camera to the pixels' points at depth 1."""
    v, u = np.mgrid[: shape[0], : shape[1]]
    return np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(K).T
