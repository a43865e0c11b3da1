"""The RGB-D camera in MuJoCo, and a window for people.

MuJoCo's OpenGL renderer draws the camera's images without a window. Camera model, depth and light
settings are those of `envs.cell`. This module knows nothing of robots, objects or tasks.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import os
import sys
import threading
import warnings
from typing import TYPE_CHECKING

import numpy as np

from envs.cell import DEFAULT_LIGHT, Camera, Image, Intrinsics
from envs.mujoco_panda import load_mujoco
from utils.errors import UserError

if TYPE_CHECKING:
    import mujoco

CAMERA, LIGHT = "camera", "light"  # names in the model
_MORE_SHAPES = 100  # in one picture beside the model's
# The window's first view: degrees, and metres in W.
SCENIC_VIEW = {"azimuth": 150.0, "elevation": -30.0, "distance": 1.6, "lookat": (0.4, -0.1, 0.15)}


def add_view(spec: mujoco.MjSpec) -> None:
    """Add to a model the camera and the light that `MujocoCamera` puts in place."""
    spec.worldbody.add_camera(name=CAMERA)
    light = spec.worldbody.add_light(name=LIGHT)
    light.type = load_mujoco().mjtLightType.mjLIGHT_DIRECTIONAL
    spec.visual.quality.offsamples = 0  # mixed pixels would have mixed depths and numbers
    spec.visual.quality.shadowsize = 2048  # without a graphics card, a film takes half the time


class MujocoCamera(Camera):
    """Renders one model, made with `add_view`, in the state that `data` has.

    Raises UserError where OpenGL cannot draw without a window. Close it before the next one.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData):
        self._mujoco, self._model, self._data = load_mujoco(), model, data
        _gl_context().make_current()
        self._scene = self._mujoco.MjvScene(model, model.ngeom + _MORE_SHAPES)
        self._context = self._mujoco.MjrContext(
            model, self._mujoco.mjtFontScale.mjFONTSCALE_100.value
        )
        self._mujoco.mjr_setBuffer(self._mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._context.readDepthMap = self._mujoco.mjtDepthMap.mjDEPTH_ZEROFAR  # exact far away
        self._camera, self._option = self._mujoco.MjvCamera(), self._mujoco.MjvOption()
        self._camera.type = self._mujoco.mjtCamera.mjCAMERA_FIXED
        self._camera.fixedcamid = model.camera(CAMERA).id

    def render(self, intrinsics: Intrinsics, T_WC: np.ndarray, light: dict | None = None) -> Image:
        """The image of a camera at T_WC (4, 4); its `bodies` are MuJoCo's numbers."""
        self._look(intrinsics, T_WC, light)
        near, far = intrinsics.near, intrinsics.far
        rgb, _ = self._draw(intrinsics, as_numbers=False)
        colours, inverse = self._draw(intrinsics, as_numbers=True)
        # With the far plane at 0, what is stored is linear in one over the depth.
        depth = near * far / (near + (far - near) * inverse)
        nothing = inverse <= 0
        rgb[nothing], depth[nothing] = 255, 0.0  # empty space is white in PyBullet, black here
        return Image(rgb, depth.astype(np.float32), self._bodies(colours))

    def render_rgb(
        self, intrinsics: Intrinsics, T_WC: np.ndarray, light: dict | None = None
    ) -> np.ndarray:
        self._look(intrinsics, T_WC, light)
        rgb, inverse = self._draw(intrinsics, as_numbers=False)
        rgb[inverse <= 0] = 255
        return rgb

    def _look(self, intrinsics: Intrinsics, T_WC: np.ndarray, light: dict | None) -> None:
        """Put camera and light in place."""
        mujoco, model, data = self._mujoco, self._model, self._data
        near, far = intrinsics.near, intrinsics.far
        extent = model.stat.extent
        model.vis.map.znear, model.vis.map.zfar = near / extent, far / extent
        place = camera_of(intrinsics, T_WC)
        number = self._camera.fixedcamid
        model.cam_fovy[number] = place["fovy"]
        mujoco.mj_kinematics(model, data)  # a step leaves poses one step behind
        _shine(model, data, DEFAULT_LIGHT | (light or {}))
        data.cam_xpos[number] = place["pos"]
        data.cam_xmat[number] = place["mat"].ravel()
        mujoco.mjv_updateScene(
            model, data, self._option, None, self._camera, mujoco.mjtCatBit.mjCAT_ALL, self._scene
        )

    def _draw(self, intrinsics: Intrinsics, as_numbers: bool) -> tuple[np.ndarray, np.ndarray]:
        """Colours (H, W, 3) uint8 and the depth buffer (H, W), or numbers of shapes as colours."""
        mujoco, width, height = self._mujoco, intrinsics.width, intrinsics.height
        for flag in (mujoco.mjtRndFlag.mjRND_SEGMENT, mujoco.mjtRndFlag.mjRND_IDCOLOR):
            self._scene.flags[flag] = as_numbers
        _gl_context().make_current()
        if (self._context.offWidth, self._context.offHeight) != (width, height):
            mujoco.mjr_resizeOffscreen(width, height, self._context)
        whole = mujoco.MjrRect(0, 0, width, height)
        rgb = np.empty((height, width, 3), np.uint8)
        depth = np.empty((height, width), np.float32)
        mujoco.mjr_render(whole, self._scene, self._context)
        mujoco.mjr_readPixels(rgb, depth, whole, self._context)
        return rgb[::-1].copy(), depth[::-1].astype(float)  # OpenGL's first row is the lowest

    def _bodies(self, colours: np.ndarray) -> np.ndarray:
        """(H, W) numbers of the bodies whose shapes were drawn, from the shapes' colours."""
        body_of = np.full(self._scene.ngeom + 1, -1, np.int32)
        for shape in self._scene.geoms[: self._scene.ngeom]:
            if shape.segid >= 0 and shape.objtype == self._mujoco.mjtObj.mjOBJ_GEOM:
                body_of[shape.segid + 1] = self._model.geom_bodyid[shape.objid]
        # Red and green hold the number, of which there are fewer than 65,536.
        red, green = colours[..., 0].astype(np.int32), colours[..., 1].astype(np.int32)
        return body_of[red + (green << 8)]

    def close(self) -> None:
        if self._context is not None:
            _gl_context().make_current()
            self._context.free()
            self._context = None


class Window:
    """A window that shows a model while it moves: MuJoCo's viewer, in a thread of its own.

    Raises UserError where no window can be opened.
    """

    def __init__(self) -> None:
        self._viewer = None
        self._threads: set[threading.Thread] = set()
        self._view: dict | None = None
        _check_display()

    def show(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Open the window on another model; the direction of view stays."""
        from mujoco.viewer import launch_passive

        self.close()
        others = set(threading.enumerate())
        try:
            self._viewer = launch_passive(model, data, show_left_ui=False, show_right_ui=False)
        except RuntimeError as error:  # macOS
            raise UserError(
                f"the window needs MuJoCo's own interpreter here: run mjpython instead of python "
                f"({error})"
            ) from error
        self._threads = set(threading.enumerate()) - others
        with self._viewer.lock():
            for name, value in (self._view or SCENIC_VIEW).items():
                setattr(self._viewer.cam, name, value)

    def update(self) -> None:
        """Show the state that the data have now; nothing happens once the user has closed it."""
        if self._viewer is not None and self._viewer.is_running():
            self._viewer.sync()

    def close(self) -> None:
        """Close the window and wait for its thread; may be called again."""
        if self._viewer is None:
            return
        self._view = {name: getattr(self._viewer.cam, name) for name in SCENIC_VIEW}
        self._viewer.close()
        for thread in self._threads:  # OpenGL must not end before it
            thread.join()
        self._viewer = None


def _check_display() -> None:
    import glfw

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the sentence below says it
        if not glfw.init():
            raise UserError(
                "simulator=mujoco: a window needs a display, and there is none here; "
                "render pictures without a window instead (render_mode='rgb_array')"
            )


def camera_of(intrinsics: Intrinsics, T_WC: np.ndarray) -> dict:
    """MuJoCo's parameters of a camera: fovy in degrees, pos (3,) and mat (3, 3) in W, whose columns
    are right, up and backwards."""
    return {
        "fovy": intrinsics.fov_deg,
        "pos": T_WC[:3, 3].copy(),
        "mat": T_WC[:3, :3] @ np.diag([1.0, -1.0, -1.0]),
    }


def _shine(model: mujoco.MjModel, data: mujoco.MjData, light: dict) -> None:
    """Set the light; `light` has the keys of DEFAULT_LIGHT.

    Its place goes into the data at once: MuJoCo derives it from the model's no more, once bodies
    may sleep.
    """
    direction, colour = (np.array(light[k], float) for k in ("lightDirection", "lightColor"))
    number = model.light(LIGHT).id
    data.light_xdir[number] = -direction / np.linalg.norm(direction)
    data.light_xpos[number] = light["lightDistance"] * -data.light_xdir[number]
    model.light_diffuse[number] = light["lightDiffuseCoeff"] * colour
    model.light_specular[number] = light["lightSpecularCoeff"] * colour
    model.light_castshadow[number] = bool(light["shadow"])
    # A light's own ambient share is missing in its shadow, the headlight's is not.
    model.light_ambient[number] = 0.0
    model.vis.headlight.ambient = light["lightAmbientCoeff"] * colour
    for part in ("diffuse", "specular"):
        setattr(model.vis.headlight, part, [0.0, 0.0, 0.0])


def opengl_renderer() -> str:
    """The name of what draws: the graphics card, or Mesa's software (llvmpipe)."""
    _gl_context().make_current()
    from OpenGL import GL

    return GL.glGetString(GL.GL_RENDERER).decode()


@functools.cache
def _gl_context():
    """One OpenGL context for all cameras of the process.

    Where no screen is named, EGL, which needs none: MuJoCo itself asks for a window unless the
    environment variable MUJOCO_GL says otherwise when it is imported.
    """
    mujoco = load_mujoco()
    # Mesa's driver and Triton, which torch loads when a network is first trained, each bring an
    # LLVM: if Triton's comes second, the process ends by a segmentation fault.
    with contextlib.suppress(ImportError):
        import triton  # noqa: F401
    headless = not (os.environ.get("DISPLAY") or os.environ.get("MUJOCO_GL"))
    try:
        if headless and sys.platform == "linux":
            from mujoco.egl import GLContext
        else:
            GLContext = mujoco.GLContext
        context = GLContext(64, 64)
        context.make_current()
    except Exception as error:  # OpenGL's loaders raise many types
        raise UserError(
            f"simulator=mujoco: no OpenGL context to draw with ({type(error).__name__}: {error}); "
            "install libegl1 (Mesa's needs no graphics card), or set MUJOCO_GL to egl, osmesa or "
            "glfw"
        ) from error
    atexit.register(context.free)
    return context
