"""The object of a grasp in the wrist camera: found in every image, predicted in between.

`WristCamera` gives depth images with the times at which they were taken, perhaps late and perhaps
with the noise of `camera.depth_noise`; `ObjectTracker` finds the object in them and filters its
motion. Reads images and encoders, and takes the camera's mount from a calibration. This module
knows no control law and no stage of an approach. Frames: W world, E gripper, C camera, O object on
the table below its grasp.
"""

from __future__ import annotations

import time
from collections import deque
from typing import NamedTuple

import numpy as np

from envs.cell import Cell, Intrinsics
from envs.robot_kinematics import forward_kinematics
from utils.depth import seeded_noise
from utils.errors import TargetLostError
from utils.object_motion import PlanarMotion
from utils.object_tracking import TemplateMatcher, grasp_frame, make_template
from utils.random_streams import Stream
from utils.transforms import Grasp, RGBDFrame, inverse_pose, planar, planar_part


class WristImage(NamedTuple):
    """A depth image (H, W), metres, the joint positions (7,), rad, at which it was taken, and that
    time, s."""

    depth: np.ndarray
    q: np.ndarray
    seconds: float


class WristCamera:
    """The depth camera in the hand. Its images arrive `latency` seconds after they were taken.

    The noise is a function of the scene's seed, the number of frames planned on so far, and the
    image's own number: every controller meets the same.
    """

    def __init__(self, cell: Cell, latency: float = 0.0):
        camera, settings = cell.config.camera, cell.config.closed_loop
        self.cell, self.latency = cell, latency
        self.intrinsics = Intrinsics(
            settings.width, settings.height, settings.fov_deg, camera.near, camera.far
        )
        self._coming: deque[WristImage] = deque()
        noise = camera.make_noise(float(self.intrinsics.K[0, 0]))
        self._measure = seeded_noise(noise, Stream.WRIST_NOISE, cell.scene.seed, cell.frames)

    def __call__(self) -> WristImage | None:
        """Take an image now; the newest image that has arrived since the last call, or None."""
        cell = self.cell
        seen = cell.look(self.intrinsics, cell.camera_pose("wrist"))
        depth = self._measure(seen.depth, seen.rgb)
        self._coming.append(WristImage(depth, cell.robot.q, cell.seconds))
        arrived = None
        while self._coming and cell.seconds - self._coming[0].seconds >= self.latency - 1e-9:
            arrived = self._coming.popleft()
        return arrived


_HORIZON = 1.5  # s, about what the far stage of an approach has left to go
_TURNING_KNOWN = 0.15  # rad/s, standard deviation below which a turning rate is trusted


class ObjectTracker:
    """The pose and the motion of the object, from images.

    T_WO: (4, 4) as last seen. motion: the filter; None until an image has shown the object.
    image_seconds, found_seconds: times of the last image and of the last one that showed the
    object. spent: wall-clock seconds that the last image took.
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
        """frame: the frame on which the grasp was planned. K (3, 3), size (width and height in
        pixels), T_EC (4, 4): of the wrist camera. lost_seconds: longest time without a sight of
        the object. seconds: now. Raises TargetLostError where nothing stands at the grasp."""
        self.template = make_template(frame, grasp)
        self.matcher = TemplateMatcher(self.template, K, size)
        self.T_EC, self.lost_seconds = T_EC, lost_seconds
        self.T_WO = grasp_frame(grasp)
        self.motion: PlanarMotion | None = None
        self.image_seconds = self.found_seconds = seconds
        self.spent = 0.0

    def update(self, image: WristImage | None) -> bool:
        """Find the object in a new image. Returns whether there was one. Raises TargetLostError
        where the first image does not show the object, or none has for too long."""
        if image is None:
            return False
        start = time.perf_counter()
        self.image_seconds = image.seconds
        T_WC = forward_kinematics(image.q) @ self.T_EC
        expected = self.at(image.seconds)
        try:
            found = self.matcher.find(
                image.depth, inverse_pose(T_WC) @ expected, inverse_pose(T_WC)
            )
        except TargetLostError as error:
            if self.motion is None:
                raise
            if image.seconds - self.found_seconds > self.lost_seconds:
                raise TargetLostError(f"{error}, for {self.lost_seconds} s") from error
            self.spent = time.perf_counter() - start
            return True
        T_WO, accepted = T_WC @ found.T_CO, True
        pose = planar_part(T_WO)
        if self.motion is None:
            self.motion = PlanarMotion(pose, image.seconds, turns=not self.matcher.round)
        else:
            axes = planar(0, 0, pose[2])[:3, :3]
            covariance = axes @ found.covariance @ axes.T
            accepted = self.motion.see(pose, covariance, image.seconds)
        if accepted:  # a false match counts as an image without the object
            self.T_WO, self.found_seconds = T_WO, image.seconds
        elif image.seconds - self.found_seconds > self.lost_seconds:
            raise TargetLostError(
                f"what was found is too far from where the object was going, for "
                f"{self.lost_seconds} s"
            )
        self.spent = time.perf_counter() - start
        return True

    def at(self, seconds: float) -> np.ndarray:
        """(4, 4) T_WO predicted for a time: as last seen, moved by the filter's motion."""
        if self.motion is None:
            return self.T_WO
        x, y, turn = self.motion.at(seconds)[:3]
        x0, y0, turn0 = planar_part(self.T_WO)
        return planar(x, y, turn) @ inverse_pose(planar(x0, y0, turn0)) @ self.T_WO

    def predicted(self, now: float) -> np.ndarray:
        """(4, 4) T_WO shortly before the fingers close; as last seen until the motion is known."""
        known = self.motion is not None and self.motion.covariance[5, 5] < _TURNING_KNOWN**2
        return self.at(now + _HORIZON) if known else self.T_WO

    def twist(self, place: np.ndarray, seconds: float) -> np.ndarray:
        """(6,) v_W of a point at `place` (3,) that moves along with the object."""
        x, y, _, vx, vy, omega = self.motion.at(seconds)
        arm = place[:2] - (x, y)
        return np.array([vx - omega * arm[1], vy + omega * arm[0], 0.0, 0.0, 0.0, omega])
