"""RGB-D cameras whatever simulates them: pinhole intrinsics, light, images, the abstract `Camera`.

`envs.pybullet_camera` and `envs.mujoco_camera` implement it. This module knows no simulator, no
robot and no task.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from utils.config import CameraConfig

# The light of every picture that names no other. The keys are those of PyBullet's getCameraImage:
# lightDirection points towards the light, lightDistance is in metres, shadow is 0 or 1.
DEFAULT_LIGHT = {
    "lightDirection": (0.3, -0.4, 1.0),
    "lightColor": (1.0, 1.0, 1.0),
    "lightDistance": 2.0,
    "lightAmbientCoeff": 0.55,
    "lightDiffuseCoeff": 0.45,
    "lightSpecularCoeff": 0.05,
    "shadow": 0,
}


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera without distortion. width, height in pixels; fov_deg is vertical;
    near and far bound the depths that are seen, in metres."""

    width: int
    height: int
    fov_deg: float
    near: float = 0.1
    far: float = 2.0

    @property
    def K(self) -> np.ndarray:
        """(3, 3) pinhole matrix; square pixels; integer coordinates at pixel centres."""
        focal = self.height / 2 / np.tan(np.radians(self.fov_deg) / 2)
        return np.array(
            [
                [focal, 0.0, (self.width - 1) / 2],
                [0.0, focal, (self.height - 1) / 2],
                [0.0, 0.0, 1.0],
            ]
        )


@dataclass(frozen=True)
class Image:
    """rgb (H, W, 3) uint8; depth (H, W) float32 metres along the optical axis, 0 where nothing is
    nearer than the far plane; bodies (H, W) int32 the simulator's body numbers, -1 for none."""

    rgb: np.ndarray
    depth: np.ndarray
    bodies: np.ndarray


class Camera(ABC):
    """Renders one simulated cell from any pose."""

    @abstractmethod
    def render(self, intrinsics: Intrinsics, T_WC: np.ndarray, light: dict | None = None) -> Image:
        """The image of a camera at T_WC (4, 4); `light` changes entries of DEFAULT_LIGHT."""

    def close(self) -> None:  # noqa: B027 - not every renderer holds resources
        """Free what the renderer holds; may be called again."""


def camera_intrinsics(camera: CameraConfig) -> Intrinsics:
    """The configured camera's intrinsics; the wrist camera has a field of view of its own."""
    fov = camera.fov_deg if camera.mount == "overhead" else camera.wrist_fov_deg
    return Intrinsics(camera.width, camera.height, fov, camera.near, camera.far)


def wrist_mount(camera: CameraConfig) -> np.ndarray:
    """(4, 4) T_EC: the wrist camera beside the hand, its optical axis along the approach."""
    T = np.eye(4)
    # Image right is E's +y, the closing line; at home image up points away from the robot.
    T[:3, :3] = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    T[:3, 3] = camera.wrist_position
    return T
