"""RGB-D cameras: pinhole intrinsics, pose, rendering through PyBullet, metric depth.

Knows nothing of robots, objects or tasks.
"""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pybullet

from utils.errors import UserError

# The light that every picture gets unless it says otherwise. PyBullet keeps these settings from
# one call to the next (the shadow flag above all), so each call names all of them.
DEFAULT_LIGHT = {
    "lightDirection": (0.3, -0.4, 1.0),
    "lightColor": (1.0, 1.0, 1.0),
    "lightDistance": 2.0,
    "lightAmbientCoeff": 0.55,
    "lightDiffuseCoeff": 0.45,
    "lightSpecularCoeff": 0.05,
    "shadow": 0,
}

_OPENGL_FROM_OPTICAL = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL looks along -z with y up


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

    def projection_matrix(self, renderer: int) -> list[float]:
        """OpenGL's projection matrix, column by column, such that pixel centres are integers.

        TinyRenderer draws half a pixel to the right and half a pixel up of where OpenGL does
        (measured on 120 small plates, see tests/test_camera.py); the last two terms take it back.
        """
        matrix = list(
            pybullet.computeProjectionMatrixFOV(
                self.fov_deg, self.width / self.height, self.near, self.far
            )
        )
        if renderer == pybullet.ER_TINY_RENDERER:
            matrix[8] += 1 / self.width
            matrix[9] += 1 / self.height
        return matrix


@dataclass(frozen=True)
class Image:
    """rgb (H, W, 3) uint8; depth (H, W) float32 metres along the optical axis, 0 where nothing is
    nearer than the far plane; bodies (H, W) int32 PyBullet body numbers, -1 for none."""

    rgb: np.ndarray
    depth: np.ndarray
    bodies: np.ndarray


def render(
    client: int, intrinsics: Intrinsics, T_WC: np.ndarray, renderer: int, light: dict | None = None
) -> Image:
    """What a camera at T_WC (4, 4) sees of a physics client's world."""
    width, height = intrinsics.width, intrinsics.height
    view = np.linalg.inv(T_WC @ _OPENGL_FROM_OPTICAL)
    _, _, rgba, z_buffer, bodies = pybullet.getCameraImage(
        width,
        height,
        viewMatrix=view.T.ravel(),
        projectionMatrix=intrinsics.projection_matrix(renderer),
        renderer=renderer,
        flags=0,
        physicsClientId=client,
        **(DEFAULT_LIGHT if light is None else DEFAULT_LIGHT | light),
    )
    # Wheels built without numpy return tuples (bullet3 #4523).
    rgba = np.asarray(rgba, dtype=np.uint8).reshape(height, width, 4)
    z_buffer = np.asarray(z_buffer, dtype=np.float32).reshape(height, width)
    bodies = np.asarray(bodies, dtype=np.int32).reshape(height, width)
    near, far = intrinsics.near, intrinsics.far
    depth = near * far / (far - (far - near) * z_buffer)
    depth[depth >= far * (1 - 1e-5)] = 0.0  # the cleared z-buffer, not quite 1 in single precision
    return Image(np.ascontiguousarray(rgba[:, :, :3]), depth, bodies)


def load_renderer(client: int, choice: str) -> int:
    """PyBullet's number of the renderer to use: `tiny` (software), `egl` (GPU) or `auto`.

    `auto` takes EGL only where there is a graphics card: on Mesa's software driver it is slower
    than TinyRenderer at every size.
    """
    if choice == "tiny" or (choice == "auto" and not _has_gpu()):
        return pybullet.ER_TINY_RENDERER
    module = importlib.util.find_spec("eglRenderer")
    plugin = (
        pybullet.loadPlugin(module.origin, "_eglRendererPlugin", physicsClientId=client)
        if module is not None
        else -1
    )
    if plugin >= 0:
        return pybullet.ER_BULLET_HARDWARE_OPENGL
    if choice == "egl":
        raise UserError(
            "sim.renderer=egl: PyBullet's EGL plugin could not be loaded on this machine; "
            "use sim.renderer=auto or sim.renderer=tiny"
        )
    return pybullet.ER_TINY_RENDERER


def _has_gpu() -> bool:
    return Path("/dev/nvidia0").exists() or any(Path("/dev/dri").glob("renderD*"))
