"""The depth camera in the hand as a closed loop reads it: images with their times, perhaps late,
and as noisy as `camera.depth_noise` has the cell's cameras.

Knows neither what is looked for in the images nor where anybody believes the camera to be.

The object of a grasp as the wrist camera sees it: found in every image, foreseen in between.

Reads depth images and the encoders at which they were taken, and believes where the camera sits on
the hand. Knows no control law and no stage of an approach. Frames: W world, E gripper, C camera, O
object on the table below its grasp.
"""

from __future__ import annotations

import time
from collections import deque
from typing import NamedTuple

import numpy as np

from envs.camera import Intrinsics
from envs.cell import Cell
from envs.robot_kinematics import forward_kinematics
from utils.depth import make_depth_noise
from utils.errors import TargetLostError
from utils.object_tracking import PlanarMotion, TemplateMatcher, grasp_frame, make_template
from utils.transforms import Grasp, RGBDFrame, inverse_pose, planar, planar_part

_NOISE_STREAM = 3  # keeps these draws apart from the scene's of the same seed


class WristImage(NamedTuple):
    """A depth image (H, W), metres, the joint positions (7,) when it was taken, and that time."""

    depth: np.ndarray
    q: np.ndarray
    seconds: float


class WristCamera:
    """The depth camera in the hand, whose images arrive `latency` seconds after they were taken.

    The noise is a function of the scene's seed, the number of frames planned on so far, and that of
    the image: every controller meets the same.
    """

    def __init__(self, cell: Cell, latency: float = 0.0):
        camera, grasp = cell.config.camera, cell.config.closed_loop
        self.cell, self.latency = cell, latency
        self.intrinsics = Intrinsics(
            grasp.width, grasp.height, grasp.fov_deg, camera.near, camera.far
        )
        self._coming: deque[WristImage] = deque()
        focal = float(self.intrinsics.K[0, 0])
        self._noise = make_depth_noise(camera.depth_noise, focal, camera.depth_noise_args)
        self._rng = np.random.default_rng([cell.scene.seed, cell.frames, _NOISE_STREAM])

    def __call__(self) -> WristImage | None:
        """Take an image now; the newest that has arrived by now, or None."""
        cell = self.cell
        depth = cell.look(self.intrinsics, cell.camera_pose("wrist")).depth
        if self._noise is not None:
            depth = self._noise(depth, self._rng)
        self._coming.append(WristImage(depth, cell.robot.q, cell.seconds))
        arrived = None
        while self._coming and cell.seconds - self._coming[0].seconds >= self.latency - 1e-9:
            arrived = self._coming.popleft()
        return arrived


_FORESIGHT = 1.5  # s, about what is left of the way in the far stage of an approach
_TURNING_KNOWN = 0.15  # rad/s, standard deviation of a turning rate that can be relied on


class ObjectTracker:
    """Where the object is, as far as images tell.

    T_WO: (4, 4) as last seen. motion: how it moves; None until it was seen. image_seconds,
    found_seconds: when the last image was taken, and the last one that showed the object. spent: s
    of wall-clock time that the last image took.
    """

    def __init__(
        self,
        frame: RGBDFrame,
        grasp: Grasp,
        K: np.ndarray,
        size: tuple[int, int],
        T_EC: np.ndarray,
        lost_seconds: float,
        seconds: float,
    ):
        """frame: that the grasp was planned on. K (3, 3), size (width, height in pixels), T_EC
        (4, 4): of the camera that looks from now, `seconds`, on. lost_seconds: for which images may
        not show the object. Raises TargetLostError where nothing stands at the grasp."""
        self.template = make_template(frame, grasp)
        self.tracker = TemplateMatcher(self.template, K, size)
        self.T_EC, self.lost_seconds = T_EC, lost_seconds
        self.T_WO = grasp_frame(grasp)
        self.motion: PlanarMotion | None = None
        self.image_seconds = self.found_seconds = seconds
        self.spent = 0.0

    def take_in(self, sight: WristImage | None) -> bool:
        """Find the object in a new image; whether there was one. Raises TargetLostError where the
        first image does not show it, or none has for too long."""
        if sight is None:
            return False
        start = time.perf_counter()
        self.image_seconds = sight.seconds
        T_WC = forward_kinematics(sight.q) @ self.T_EC
        expected = self.at(sight.seconds)
        try:
            found = self.tracker.find(
                sight.depth, inverse_pose(T_WC) @ expected, inverse_pose(T_WC)
            )
        except TargetLostError as error:
            if self.motion is None:
                raise
            if sight.seconds - self.found_seconds > self.lost_seconds:
                raise TargetLostError(f"{error}, for {self.lost_seconds} s") from error
            self.spent = time.perf_counter() - start
            return True
        T_WO, believed = T_WC @ found.T_CO, True
        pose = planar_part(T_WO)
        if self.motion is None:
            self.motion = PlanarMotion(pose, sight.seconds, turns=not self.tracker.round)
        else:
            axes = planar(0, 0, pose[2])[:3, :3]
            covariance = axes @ found.covariance @ axes.T
            believed = self.motion.see(pose, covariance, sight.seconds)
        if believed:  # a false match shows no more than an image without the object
            self.T_WO, self.found_seconds = T_WO, sight.seconds
        self.spent = time.perf_counter() - start
        return True

    def at(self, seconds: float) -> np.ndarray:
        """(4, 4) T_WO expected at a time: as last seen, moved to where the filter has it."""
        if self.motion is None:
            return self.T_WO
        x, y, turn = self.motion.at(seconds)[:3]
        x0, y0, turn0 = planar_part(self.T_WO)
        return planar(x, y, turn) @ inverse_pose(planar(x0, y0, turn0)) @ self.T_WO

    def foreseen(self, now: float) -> np.ndarray:
        """(4, 4) T_WO a little before the fingers close, once it is known how the object moves."""
        known = self.motion is not None and self.motion.covariance[5, 5] < _TURNING_KNOWN**2
        return self.at(now + _FORESIGHT) if known else self.T_WO

    def twist(self, place: np.ndarray, seconds: float) -> np.ndarray:
        """(6,) in W of a point at `place` (3,) that is carried along with the object."""
        x, y, _, vx, vy, omega = self.motion.at(seconds)
        arm = place[:2] - (x, y)
        return np.array([vx - omega * arm[1], vy + omega * arm[0], 0.0, 0.0, 0.0, omega])
