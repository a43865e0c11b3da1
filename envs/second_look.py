"""A second look: the wrist camera goes where it sees most of what the first frame leaves open.

`utils.next_view` ranks the poses; this module asks which of them the arm can take, moves it there
and back, and takes the frame. It does not know who plans with it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from envs.arm_clearance import arm_is_clear
from envs.arm_paths import LOOK_EVERY, scales
from envs.cell import ROBOT, Cell, Intrinsics, wrist_mount
from envs.cell_layout import Box, distance_to_box
from envs.execution import follow, go_home
from envs.robot_kinematics import (
    UnreachableError,
    arm_points,
    inverse_kinematics,
    tip_position,
)
from envs.robot_motion import Trajectory
from envs.robot_safety import ArmStoppedError
from utils.depth import seeded_noise
from utils.depth_correction import corrected
from utils.depth_holes import surfaces_in_holes, table_in_holes
from utils.geometry import Workspace
from utils.height_map import HeightMap, height_map_from_frame
from utils.next_view import OpenSpace, dome
from utils.random_streams import Stream
from utils.transforms import RGBDFrame, inverse_pose

CM3 = 1e-6  # m3
_ROLLS = np.deg2rad(np.arange(0, 360, 45))  # of the camera about its axis, which are tried
_HAND_RADIUS = 0.11  # m around points of arm and hand: half the hand's width
_STANDS = 0.02  # m over the table, of matter that the arm keeps clear of
_STILL_SECONDS = 0.1  # for which the arm stands still before the image


class SecondLook:
    """Adds a second frame (`RGBDFrame.second`) to the first, where it promises enough.

    least: m3 of open space that the second frame has to show past what is known; 0: none is taken.
    calibrated: gives a frame that was just taken with the wrist camera the pose that the program
    assumes. plan_seconds, sim_seconds: wall-clock time of the last choice of a view, and simulated
    time of the last motion there and back. remark: what ended the last look before its time, and
    how the arm came home if it could not by itself; empty where nothing did.
    """

    def __init__(self, cell: Cell, least: float, calibrated: Callable[[RGBDFrame], RGBDFrame]):
        self._cell, self._least, self._calibrated = cell, least, calibrated
        self.plan_seconds = self.sim_seconds = 0.0
        self.remark = ""

    def __call__(self, see: Callable[[], RGBDFrame]) -> RGBDFrame:
        """The frame that `see` takes, with a second one where that is worth it. The arm begins and
        ends at home. Where it was stopped, which may have moved something, `see` takes the frame
        again."""
        frame = see()
        if self._least == 0.0:
            return frame
        start, began = time.perf_counter(), self._cell.seconds
        way = way_to_look(self._cell, frame, self._least)
        self.plan_seconds = time.perf_counter() - start
        self.remark = ""
        if way is not None:
            try:
                frame = replace(frame, second=self._taken(way))
            except ArmStoppedError as stop:
                ended = f"the second look was stopped: {stop}"
                self.remark = "; ".join(filter(None, [ended, go_home(self._cell)]))
                frame = see()
        self.sim_seconds = self._cell.seconds - began
        return frame

    def _taken(self, way: Trajectory) -> RGBDFrame:
        """The frame from the end of a way from home, to which the arm returns. Raises
        ArmStoppedError where something is in its way, PhysicsError where the simulation blows up.
        """
        cell = self._cell
        careful = partial(cell.robot.stop_on_contact, cell.config.execution.contact_stop)
        follow(cell, way, careful)
        cell.step(round(_STILL_SECONDS / cell.dt))
        cell.check_physics()
        frame = self._calibrated(wrist_frame(cell))
        follow(cell, cell.robot.joint_move(way.positions[-1], cell.home, **scales(cell)))
        cell.check_physics()
        return frame


def wrist_frame(cell: Cell) -> RGBDFrame:
    """The frame of the wrist camera as the arm stands, with the noise of `camera.depth_noise`, a
    function of the scene's seed and the number of first frames. The robot, which knows its own
    shape and posture, leaves itself out."""
    assert cell.scene is not None  # a cell with a frame has one
    camera = cell.config.camera
    intrinsics = Intrinsics(
        camera.width, camera.height, camera.wrist_fov_deg, camera.near, camera.far
    )
    frame = cell.look(intrinsics, cell.camera_pose("wrist"))
    noise = camera.make_noise(float(frame.K[0, 0]))
    measure = seeded_noise(noise, Stream.SECOND_NOISE, cell.scene.seed, cell.frames)
    assert frame.segmentation is not None  # a cell's frames have it
    depth = np.where(frame.segmentation == ROBOT, 0, measure(frame.depth, frame.rgb))
    return replace(frame, depth=depth.astype(np.float32))


def way_to_look(cell: Cell, frame: RGBDFrame, least: float) -> Trajectory | None:
    """From home to the pose from which the wrist camera sees most of what a frame leaves open; None
    where no pose that the arm can take shows more than `least` m3 of it."""
    camera, workspace = cell.config.camera, cell.config.workspace.geometry
    heights = known_heights(frame, workspace)
    space = OpenSpace(heights, workspace)
    if space.volume <= least:
        return None
    shape = camera.height, camera.width
    K = Intrinsics(camera.width, camera.height, camera.wrist_fov_deg).K
    views = [(space.shown(K, shape, T_WC), T_WC) for T_WC in dome(workspace)]
    things = box_around(heights)
    for shown, T_WC in sorted(views, key=lambda view: -view[0]):
        if shown <= least:
            return None
        for q in _postures(cell, T_WC):
            way = cell.robot.joint_move(cell.home, q, **scales(cell))
            if _is_clear(cell, way, things):
                return way
    return None


def known_heights(frame: RGBDFrame, workspace: Workspace) -> HeightMap:
    """The map from above of a frame in whose holes colours tell table and objects apart: without
    them, the shadow that a depth camera leaves beside each object would count as the object. A
    hole too wide for that stays an obstacle, because a black object may fill it."""
    frame = corrected(frame, workspace.table_height)
    frame = surfaces_in_holes(table_in_holes(frame, workspace.table_height))
    return height_map_from_frame(frame, workspace)


def _postures(cell: Cell, T_WC: np.ndarray) -> Iterator[np.ndarray]:
    """Joint positions (7,) that bring the wrist camera to T_WC (4, 4), but for the turn about its
    axis, the nearest to home first."""
    hand_in_camera, found = inverse_pose(wrist_mount(cell.config.camera)), []
    for roll in _ROLLS:
        turned = T_WC.copy()
        turned[:3, :3] = T_WC[:3, :3] @ Rotation.from_euler("z", roll).as_matrix()
        try:
            found.append(inverse_kinematics(turned @ hand_in_camera, cell.home, cell.home))
        except UnreachableError:
            continue
    yield from sorted(found, key=lambda q: float(abs(q - cell.home).max()))


def _is_clear(cell: Cell, way: Trajectory, things: Box | None) -> bool:
    """Whether E stays in the workspace's box, and the arm clear of the cell and of `things`."""
    safety = cell.config.safety
    tips = np.array([tip_position(q) for q in way.positions.tolist()])
    if (tips < safety.box_lower).any() or (tips > safety.box_upper).any():
        return False
    some = np.append(np.arange(0, len(way), LOOK_EVERY), len(way) - 1)
    q = way.positions[some]
    points = np.concatenate([arm_points(q), tips[some, None]], axis=1)
    if things is not None and distance_to_box(points, things).min() <= _HAND_RADIUS:
        return False
    return arm_is_clear(cell, q)


def box_around(heights: HeightMap) -> Box | None:
    """Of all that stands, or may stand, on the table; None where nothing does."""
    stands = heights.ceiling > heights.table_height + _STANDS
    if not stands.any():
        return None
    row, column = np.nonzero(stands)
    # From the outer edges of the cells, not from their middles.
    first = heights.origin + heights.cell * (np.array([column.min(), row.min()]) - 0.5)
    last = heights.origin + heights.cell * (np.array([column.max(), row.max()]) + 0.5)
    low = np.array([*first, heights.table_height])
    high = np.array([*last, float(heights.ceiling[stands].max())])
    return Box((high - low) / 2, (high + low) / 2)
