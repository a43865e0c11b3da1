"""The depth camera in the hand as a closed loop reads it: images with their times, perhaps late,
and as noisy as `camera.depth_noise` has the cell's cameras.

Knows neither what is looked for in the images nor where anybody believes the camera to be.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from envs.base_cell import BaseCell
from envs.camera import Intrinsics
from utils.depth_noise import KinectNoise

_NOISE_STREAM = 3  # keeps these draws apart from the scene's of the same seed


class DepthSight(NamedTuple):
    """A depth image (H, W), metres, the joint positions (7,) when it was taken, and that time."""

    depth: np.ndarray
    q: np.ndarray
    seconds: float


class WristCamera:
    """The depth camera in the hand, whose images arrive `latency` seconds after they were taken.

    The noise is a function of the scene's seed, the number of frames planned on so far, and that of
    the image: every controller meets the same.
    """

    def __init__(self, cell: BaseCell, latency: float = 0.0):
        camera, grasp = cell.config.camera, cell.config.grasp
        self.cell, self.latency = cell, latency
        self.intrinsics = Intrinsics(
            grasp.width, grasp.height, grasp.fov_deg, camera.near, camera.far
        )
        self._coming: deque[DepthSight] = deque()
        self._noise = None
        if camera.depth_noise == "kinect":
            self._noise = KinectNoise(image_focal=float(self.intrinsics.K[0, 0]))
            self._rng = np.random.default_rng([cell.scene.seed, cell.frames, _NOISE_STREAM])

    def __call__(self) -> DepthSight | None:
        """Take an image now; the newest that has arrived by now, or None."""
        cell = self.cell
        depth = cell.look(self.intrinsics, cell.camera_pose("wrist")).depth
        if self._noise is not None:
            depth = self._noise(depth, self._rng)
        self._coming.append(DepthSight(depth, cell.robot.q, cell.seconds))
        arrived = None
        while self._coming and cell.seconds - self._coming[0].seconds >= self.latency - 1e-9:
            arrived = self._coming.popleft()
        return arrived
