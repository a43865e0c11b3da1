"""The RGB-D camera in PyBullet: images rendered by TinyRenderer or EGL, with metric depth.

This module knows nothing of robots, objects or tasks.
"""

from __future__ import annotations

import functools
import importlib.util
import subprocess
import sys
from pathlib import Path

import numpy as np
import pybullet

from envs.cell import DEFAULT_LIGHT, Camera, Image, Intrinsics
from utils.errors import UserError

_EGL = "_eglRendererPlugin"  # its name in its file
_OPENGL_FROM_OPTICAL = np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL looks along -z with y up


class PybulletCamera(Camera):
    """Renders one physics client. renderer: PyBullet's number, see `load_renderer`."""

    def __init__(self, client: int, renderer: int):
        self.client, self.renderer = client, renderer

    def render(self, intrinsics: Intrinsics, T_WC: np.ndarray, light: dict | None = None) -> Image:
        """The image of a camera at T_WC (4, 4); its `bodies` are PyBullet's numbers.

        PyBullet keeps light settings from one call to the next (the shadow flag above all), so each
        call names all of them.
        """
        width, height = intrinsics.width, intrinsics.height
        view = np.linalg.inv(T_WC @ _OPENGL_FROM_OPTICAL)
        _, _, rgba, z_buffer, bodies = pybullet.getCameraImage(
            width,
            height,
            viewMatrix=view.T.ravel(),
            projectionMatrix=projection_matrix(intrinsics, self.renderer),
            renderer=self.renderer,
            flags=0,
            physicsClientId=self.client,
            **(DEFAULT_LIGHT if light is None else DEFAULT_LIGHT | light),
        )
        # Wheels built without numpy return tuples (bullet3 #4523).
        rgba = np.asarray(rgba, dtype=np.uint8).reshape(height, width, 4)
        z_buffer = np.asarray(z_buffer, dtype=np.float32).reshape(height, width)
        bodies = np.asarray(bodies, dtype=np.int32).reshape(height, width)
        near, far = intrinsics.near, intrinsics.far
        depth = near * far / (far - (far - near) * z_buffer)
        # The cleared z-buffer is not quite 1 in single precision.
        depth[depth >= far * (1 - 1e-5)] = 0.0
        return Image(np.ascontiguousarray(rgba[:, :, :3]), depth, bodies)


def projection_matrix(intrinsics: Intrinsics, renderer: int) -> list[float]:
    """OpenGL's projection matrix, column by column, such that pixel centres are integers.

    TinyRenderer draws half a pixel to the right and half a pixel up of where OpenGL does
    (measured on 120 small plates, see tests/test_pybullet_camera.py); the last two terms take it
    back.
    """
    matrix = list(
        pybullet.computeProjectionMatrixFOV(
            intrinsics.fov_deg,
            intrinsics.width / intrinsics.height,
            intrinsics.near,
            intrinsics.far,
        )
    )
    if renderer == pybullet.ER_TINY_RENDERER:
        matrix[8] += 1 / intrinsics.width
        matrix[9] += 1 / intrinsics.height
    return matrix


def load_renderer(client: int, choice: str) -> int:
    """PyBullet's number of the renderer to use: `tiny` (software), `egl` (GPU) or `auto`.

    `auto` takes EGL only where there is a graphics card that draws by it: on Mesa's software
    driver it is slower than TinyRenderer at every size. Raises UserError for `egl` where nothing
    draws by it.
    """
    if choice == "tiny" or (choice == "auto" and not _has_gpu()):
        return pybullet.ER_TINY_RENDERER
    plugin = _egl_plugin()
    if plugin and pybullet.loadPlugin(plugin, _EGL, physicsClientId=client) >= 0:
        return pybullet.ER_BULLET_HARDWARE_OPENGL
    if choice == "egl":
        raise UserError(
            "sim.renderer=egl: PyBullet's EGL plugin could not be loaded on this machine; "
            "use sim.renderer=auto or sim.renderer=tiny"
        )
    return pybullet.ER_TINY_RENDERER


@functools.cache
def _egl_plugin() -> str | None:
    """The file of PyBullet's EGL plugin; None where it cannot be loaded. That is tried in a process
    of its own, which the plugin ends where it finds no EGL, as on servers with a card for
    computing alone."""
    module = importlib.util.find_spec("eglRenderer")
    if module is None or module.origin is None:
        return None
    trial = (
        "import pybullet, sys; client = pybullet.connect(pybullet.DIRECT); "
        "sys.exit(pybullet.loadPlugin(*sys.argv[1:], physicsClientId=client) < 0)"
    )
    command = [sys.executable, "-c", trial, module.origin, _EGL]
    failed = subprocess.run(command, capture_output=True, check=False).returncode
    return None if failed else module.origin


def _has_gpu() -> bool:
    return Path("/dev/nvidia0").exists() or any(Path("/dev/dri").glob("renderD*"))
