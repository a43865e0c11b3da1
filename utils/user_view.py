"""What the image of any camera shows of a scene: the part to plan on, and whether it shows enough.

A planner works on a square of the table. `workspace_of` finds the square that holds what stands on
the table; `check_view` refuses an image that shows too little for grasps to be more than a guess.
`corrected_view` says what had to be done to its depths. This module knows no planner and no file.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from utils.depth_correction import (
    SCALE_REACH,
    TRUSTED_SCALE,
    bump_height,
    corrected,
    scale_to_table,
)
from utils.depth_holes import check_rgbd, depth_of_plane
from utils.errors import UserError
from utils.geometry import Workspace
from utils.height_map import LABEL_FLOOR
from utils.table_plane import (
    DEPTHS,
    EXACT,
    FLAT,
    FROM_BASE,
    FROM_CAMERA,
    TOLERANCE,
    Table,
    find_table,
    find_table_camera,
    table_at_height,
    table_misses,
)
from utils.transforms import RGBDFrame, deproject, known_depth, project

LOWEST = 0.006  # m: least height over the table of matter that a hand grasps
SMALLEST, LARGEST = 0.30, 1.0  # m, sides of a workspace; height maps have up to 580 x 580 cells
LARGEST_SPAN, SMALLEST_SPAN = 3.0, 0.06  # m, of an image that a hand grasps from
# What is so much (m) over the table, and holds this share of the known pixels in two layers (m),
# may be the table, and what was taken for it the floor.
HIGH_TABLE, WIDE_TABLE, LAYER = 0.25, 0.2, 0.02
OFF_CENTRE = 0.3  # of half the image, a principal point from its middle
MARGIN = 0.02  # m around what stands on the table
ROUGH = 0.002  # m, standard deviation of a table whose bumps are as high as what a hand grasps
# An image is not taken for depths where a flat table fits another reading at least so many times
# better: as distances from a base 17 times and more for Cornell's 80, at most 1.5 times for 90
# images of the cell (scenes of all kinds, 0 to 65 degrees off the vertical, all depth noises).
MISREAD = 4.0
_BIN, _FILLED = 0.01, 0.2  # m, and the share of such a square that counts as matter: not noise

# The network has learned from above, and planners are measured up to 45 degrees off the vertical
# (docs/six_dof.md). At 70 degrees an object hides the table behind it for 2.7 times its height.
OBLIQUE, MOST_OBLIQUE = 45.0, 70.0  # degrees
MOST_MARKED = 0.5  # share of an image that one object's mask is expected to mark
MANY_UNSEEN, MOST_UNSEEN = 0.25, 0.5  # shares of the workspace's pixels whose depth is unknown
_SAMPLES = 100  # along each side of a workspace, to see how much of it is in the image


def workspace_of(
    frame: RGBDFrame, table_height: float, marked: np.ndarray | None = None
) -> tuple[Workspace, list[str]]:
    """The square of the table that holds all matter that a frame shows above it, and remarks.

    A square of SMALLEST at least; around where the optical axis meets the table where no matter is
    seen. Where the matter is spread over more than LARGEST, the square has that side and lies
    around the pixels that the user has `marked` (H, W), else around the optical axis, and a remark
    says so. Raises UserError as `check_rgbd` does: without known depths, or for other units.
    """
    check_rgbd(frame.rgb, frame.depth)
    points = frame.points()
    raised = np.isfinite(points[..., 2]) & (points[..., 2] > table_height + LOWEST)
    middle, place = _looked_at(frame, table_height), "in the middle of the view"
    if marked is not None and (marked & raised).any():
        middle, place = np.median(points[marked & raised][:, :2], axis=0), "around the target"
    xy = points[raised][:, :2]
    if len(xy):
        cells, cell_of = np.unique(np.floor(xy / _BIN).astype(int), axis=0, return_inverse=True)
        area = frame.depth[raised] ** 2 / (frame.K[0, 0] * frame.K[1, 1])
        filled = np.bincount(cell_of.ravel(), area) > _FILLED * _BIN**2
        xy = cells[filled] * _BIN + _BIN / 2
    if len(xy) == 0:
        return Workspace(_pair(middle), SMALLEST, table_height), []
    low, high = xy.min(axis=0) - MARGIN, xy.max(axis=0) + MARGIN
    size = float((high - low).max())
    if size <= LARGEST:
        return Workspace(_pair((low + high) / 2), max(size, SMALLEST), table_height), []
    inwards = np.minimum(np.maximum(middle, low + LARGEST / 2), high - LARGEST / 2)
    centre = np.where(high - low < LARGEST, (low + high) / 2, inwards)
    remark = (
        f"what is above the table is spread over {size:.1f} m, so that only the square of "
        f"{LARGEST:g} m {place} was searched; crop the image, or give --workspace "
        "(with --camera-pose)"
    )
    return Workspace(_pair(centre), LARGEST, table_height), [remark]


def as_depths(image: np.ndarray, K: np.ndarray, from_base: bool | None = None) -> np.ndarray:
    """(H, W) metres along the optical axis of an image (H, W) of depths, or of distances in metres
    `from_base` of a robot, as Cornell's depth images hold them; 0 where unknown.

    from_base: what the user says; None for nothing. Then the image is taken for depths. Raises
    UserError where distances from a base or from the camera explain a flat table far better, and
    for distances from a base that no flat table explains.
    """
    if from_base is False:
        return image
    misses = table_misses(image, K)
    base, camera, depths = (misses[reading] for reading in (FROM_BASE, FROM_CAMERA, DEPTHS))
    fits = f"fits to {1000 * base:.2g} mm so, to {1000 * depths:.2g} mm as {DEPTHS}"
    if from_base:
        if base > FLAT:
            raise UserError(
                f"--from-base: the depth image shows no flat table: it {fits}, at most "
                f"{1000 * FLAT:g} mm are allowed; leave the option out if it holds depths"
            )
        return find_table_camera(image, K).depth(image, K)
    if camera <= FLAT and depths > MISREAD * max(camera, EXACT):
        raise UserError(
            f"--depth seems to hold {FROM_CAMERA}: a flat table fits to {1000 * camera:.2g} mm so, "
            f"to {1000 * depths:.2g} mm as {DEPTHS}; divide each by the length of its pixel's ray "
            "((u - cx) / fx, (v - cy) / fy, 1), or give --no-from-base if it holds depths"
        )
    if base <= FLAT and depths > MISREAD * max(base, EXACT):
        raise UserError(
            f"--depth seems to hold {FROM_BASE}, as Cornell's depth images do: a flat table {fits};"
            " give --from-base, which turns them into depths, or --no-from-base if it holds depths"
        )
    return image


def locate_table(image: RGBDFrame, T_WC: np.ndarray | None, height: float | None) -> Table:
    """The table in an image whose world is the camera's frame.

    T_WC: (4, 4) the camera in the user's world, height: z of the table in it, m. Without a height
    the table is searched (`find_table`), and without T_WC it defines the world. Where a smaller
    flat surface is seen beneath the plane found, that is the table: the plane is the top of
    something wide, as of boxes side by side. Raises UserError.
    """
    check_rgbd(image.rgb, image.depth)
    depth, width, tall = _span(image)
    if min(width, tall) < SMALLEST_SPAN / 2:
        raise UserError(
            f"at the median depth of {depth:.3g} m the image spans {width:.2g} m x {tall:.2g} m, "
            "too little for a hand's grasps; check the unit of the depth and the focal length"
        )
    if T_WC is not None and height is not None:
        return table_at_height(height, image.points(), T_WC)
    table = find_table(image.points(), T_WC)
    frame = replace(image, T_WC=table.T_WC)
    scale = scale_to_table(frame, table.height)
    if abs(scale - 1) <= TRUSTED_SCALE:
        return table
    # Depths in which the table was searched say nothing about the camera's scale. What they ask for
    # is a plane that is parallel, and 1 / scale times as far away.
    deeper = (table.T_WC[2, 3] - table.height) * (1 / scale - 1)
    if T_WC is None:  # the table is at z = 0
        lower = table.T_WC.copy()
        lower[2, 3] += deeper
        table = replace(table, T_WC=lower)
    else:
        table = replace(table, height=table.height - deeper)
    above = replace(image, T_WC=table.T_WC).points()[..., 2] - table.height
    known = known_depth(image.depth)
    near = np.abs(above[known]) < TOLERANCE * np.median(image.depth[known])
    return replace(table, share=float(near.mean()))


def corrected_view(frame: RGBDFrame, table_height: float) -> tuple[RGBDFrame, list[str]]:
    """The frame as planners correct it by its table (`utils.depth_correction`), and remarks where
    all depths were scaled, or the table is rough: it may be the camera that is wrong, but also its
    pose or the height."""
    scale, after, remarks = scale_to_table(frame, table_height), corrected(frame, table_height), []
    if abs(scale - 1) > TRUSTED_SCALE:
        remarks.append(
            f"all depths were multiplied by {scale:.3f}, so that the flat surface that was taken "
            f"for the table lies at its height of {table_height:g} m; check that height, the "
            "camera's pose and the unit of the depth image"
        )
    if after.roughness > ROUGH:
        remarks.append(
            f"the table is rough by {1000 * after.roughness:.1f} mm in the depth image: what has "
            "its colour may be taken for it, and what lies on something else for a bump, up to a "
            f"height of {1000 * bump_height(after.roughness):.0f} mm; check the depth image, the "
            "intrinsics and the camera's pose if one was given, or lay a cloth of another colour "
            "below"
        )
    return after, remarks


def given_workspace(
    frame: RGBDFrame, table_height: float, numbers: Sequence[float]
) -> tuple[Workspace, list[str]]:
    """The square of [x, y, size], metres in W, and a remark where much of it is outside the image.
    Raises UserError for one of another size than SMALLEST / 2 to LARGEST."""
    x, y, size = numbers
    if not np.isfinite([x, y, size]).all() or not SMALLEST / 2 <= size <= LARGEST:
        raise UserError(
            f"--workspace {x:g} {y:g} {size:g}: expected the centre and a side of "
            f"{SMALLEST / 2:g} to {LARGEST:g} m"
        )
    workspace = Workspace((x, y), size, table_height)
    outside = _outside_share(frame, workspace)
    if outside <= MANY_UNSEEN:
        return workspace, []
    remark = f"{outside:.0%} of --workspace lies outside the image, where nothing is found"
    return workspace, [remark]


def chosen_workspace(
    frame: RGBDFrame,
    table_height: float,
    numbers: Sequence[float] | None,
    marked: np.ndarray | None,
) -> tuple[Workspace, list[str]]:
    """The square that is searched, and remarks: `given_workspace` of the numbers; where there are
    none, `workspace_of` the frame and the marked pixels."""
    if numbers is None:
        return workspace_of(frame, table_height, marked)
    return given_workspace(frame, table_height, numbers)


def _outside_share(frame: RGBDFrame, workspace: Workspace) -> float:
    """Share of a square of the table that lies outside the image."""
    across = (np.arange(_SAMPLES) + 0.5) / _SAMPLES - 0.5
    xy = np.stack(np.meshgrid(across, across), axis=-1).reshape(-1, 2)
    points = np.insert(xy * workspace.size + workspace.centre, 2, workspace.table_height, axis=1)
    pixels, _ = project(points, frame.K, frame.T_WC)  # NaN behind the camera, which is outside
    height, width = frame.depth.shape
    inside = (pixels >= -0.5) & (pixels < (width - 0.5, height - 0.5))
    return float(1 - inside.all(axis=1).mean())


def check_mask(mask: np.ndarray | None) -> list[str]:
    """A remark on a mask (H, W) of one object that marks most of the image."""
    share = 0.0 if mask is None else float(mask.mean())
    if share <= MOST_MARKED:
        return []
    return [f"--mask marks {share:.0%} of the image as the object; is it inverted?"]


def check_view(frame: RGBDFrame, workspace: Workspace, given: bool = False) -> list[str]:
    """Remarks on a view that shows little. given: whether the user has said how high the table is.
    Raises UserError for a view from which grasps would be guessed: too oblique, or with too little
    of the workspace in the image or measured."""
    tilt = float(np.rad2deg(np.arccos(np.clip(-frame.T_WC[2, 2], -1, 1))))
    if tilt > MOST_OBLIQUE:
        raise UserError(
            f"the view is too oblique: the camera looks {tilt:.0f} degrees off the table's normal, "
            f"at most {MOST_OBLIQUE:g} are allowed; look more from above"
        )
    remarks = [*_check_units(frame), *_check_table(frame, workspace.table_height, given)]
    (height, width), (cx, cy) = frame.depth.shape, frame.K[:2, 2]
    if not (0 <= cx < width and 0 <= cy < height):
        remarks.append(
            f"the principal point ({cx:g}, {cy:g}) lies outside the image of {width}x{height} "
            "pixels: right for a part of an image, wrong for intrinsics of another resolution"
        )
    elif max(abs(2 * cx / width - 1), abs(2 * cy / height - 1)) > OFF_CENTRE:
        remarks.append(
            f"the principal point ({cx:g}, {cy:g}) is far from the middle of the image of "
            f"{width}x{height} pixels; are the intrinsics those of another resolution?"
        )
    if tilt > OBLIQUE:
        remarks.append(
            f"the camera looks {tilt:.0f} degrees off the table's normal; planners are measured up "
            f"to {OBLIQUE:g} degrees alone"
        )
    unseen = unseen_share(frame, workspace)
    if unseen is None:
        x, y = workspace.centre
        raise UserError(
            f"the image does not show the place to search, {workspace.size:g} m around "
            f"({x:g}, {y:g}) m; check --workspace, --camera-pose and --table-height"
        )
    if unseen > MOST_UNSEEN:
        raise UserError(
            f"too much is unseen: {unseen:.0%} of the place that was searched has no depth, at "
            f"most {MOST_UNSEEN:.0%} are allowed; give a better depth image or another view"
        )
    if unseen > MANY_UNSEEN:
        remarks.append(f"{unseen:.0%} of the place that was searched has no depth")
    return remarks


def _check_units(frame: RGBDFrame) -> list[str]:
    """A remark on an image that spans far more or far less than a hand's workspace: units may be
    wrong."""
    remarks = []
    depth, width, height = _span(frame)
    if max(width, height) > LARGEST_SPAN or min(width, height) < SMALLEST_SPAN:
        remarks.append(
            f"at the median depth of {depth:.3g} m the image spans {width:.3g} m x {height:.3g} m; "
            "check the unit of the depth and the focal length if that is not so"
        )
    return remarks


def _check_table(frame: RGBDFrame, table_height: float, given: bool) -> list[str]:
    """A remark on a wide flat surface far over the table, which may be a floor then; or, where its
    height was given, farther over it than depths are scaled to meet it."""
    known, least = known_depth(frame.depth), HIGH_TABLE
    if given:
        least = min(HIGH_TABLE, SCALE_REACH * (frame.T_WC[2, 3] - table_height))
    over = frame.points()[known][:, 2] - table_height
    high = over[over > least]
    layers = np.floor((high - least) / LAYER).astype(int)
    counts = np.bincount(layers, minlength=2)
    pairs = counts[:-1] + counts[1:]  # a surface may lie on the border of two
    share = float(pairs.max() / len(over))
    if share < WIDE_TABLE:
        return []
    lower = int(pairs.argmax())
    height = np.median(high[(layers == lower) | (layers == lower + 1)])
    return [
        f"a flat surface {height:.2f} m over the table holds {share:.0%} of the image; if that is "
        "the table, "
        + (
            "correct --table-height or --camera-pose"
            if given
            else "crop the image to it, or give --camera-pose and --table-height"
        )
    ]


def _span(frame: RGBDFrame) -> tuple[float, float, float]:
    """The median known depth, and how wide and high what the image shows is there; metres."""
    depth = float(np.median(frame.depth[known_depth(frame.depth)]))
    rows, columns = frame.depth.shape
    return depth, columns * depth / frame.K[0, 0], rows * depth / frame.K[1, 1]


def check_found(found: int, frame: RGBDFrame, workspace: Workspace) -> list[str]:
    """A remark on a frame in which no grasp was found."""
    if found:
        return []
    points = frame.points()
    rises = points[..., 2] > workspace.table_height + LABEL_FLOOR
    over = np.abs(points[..., :2] - workspace.centre).max(axis=-1) <= workspace.size / 2
    if not (rises & over).any():
        lowest = 1000 * LABEL_FLOOR
        return [f"no grasp was found: nothing there rises {lowest:g} mm over the table"]
    return [
        "no grasp was found on what stands there: it may be too small, too wide for the hand, or "
        "too close to other things"
    ]


def unseen_share(frame: RGBDFrame, workspace: Workspace) -> float | None:
    """Share of the pixels that look at the workspace, through it at the table's height, whose depth
    is unknown; None where none does."""
    depth = depth_of_plane(frame, workspace.table_height)
    v, u = np.nonzero((depth > 0) & np.isfinite(depth))
    foot = deproject(np.column_stack([u, v]), depth[v, u], frame.K, frame.T_WC)
    inside = np.abs(foot[:, :2] - workspace.centre).max(axis=1) <= workspace.size / 2
    known = known_depth(frame.depth)[v, u][inside]
    return float(1 - known.mean()) if len(known) else None


def _looked_at(frame: RGBDFrame, table_height: float) -> np.ndarray:
    """(2,) where the optical axis meets the table; the camera's foot where it does not."""
    eye, axis = frame.T_WC[:3, 3], frame.T_WC[:3, 2]
    if axis[2] > -0.1:
        return eye[:2]
    return (eye + axis * (table_height - eye[2]) / axis[2])[:2]


def _pair(xy: np.ndarray) -> tuple[float, float]:
    return float(xy[0]), float(xy[1])
