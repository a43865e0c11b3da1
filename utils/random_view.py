"""What a camera sees, changed: light, camera error, textures, colours and depth noise.

Light, pose and field of view are for the renderer; the rest is laid over its image. Needs no
renderer and knows no distribution.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from utils.depth_noise import KinectNoise
from utils.random_ranges import changed
from utils.textures import SolidTexture
from utils.transforms import deproject, known_depth

_GREY = np.array([0.299, 0.587, 0.114], np.float32)  # luma weights, ITU-R BT.601
_NOISE_STREAM = 2  # keeps a frame's noise apart from what else is drawn with the same seed
KINECT = {"depth_shift": "shift", "depth_jitter": "noise", "depth_step": "step"}
LIGHTS = {
    "light_colour": "lightColor",
    "light_ambient": "lightAmbientCoeff",
    "light_diffuse": "lightDiffuseCoeff",
    "light_specular": "lightSpecularCoeff",
}

Change = tuple[str, Any]  # operation, and a value or a list of them


class RandomView:
    """A change of everything a cell's camera sees; the same changes and frames give the same.

    changes: for frame k of the episode, by parameter; names are the keys of the config's section
    randomization.vision. shadow: 0 or 1. noisy_depth: measure depth as `KinectNoise` does.
    textures: by PyBullet's body number. pose: (4, 4) of a body in W, for its texture.
    seed: of the noise, together with the frame's number.
    T_CC: (4, 4), the pose of the true camera in the calibrated one's frame. fov_scale: factor on
    the field of view. Both are those of the frame begun last.
    """

    def __init__(
        self,
        changes: Callable[[int], Mapping[str, Change]],
        seed: int,
        shadow: int,
        noisy_depth: bool,
        textures: Mapping[int, SolidTexture],
        pose: Callable[[int], np.ndarray],
    ):
        self._changes, self._seed, self._shadow = changes, seed, shadow
        self._noisy_depth, self._textures, self._pose = noisy_depth, dict(textures), pose
        self.frames = 0

    def begin_frame(self) -> None:
        """Go on to the next frame, before anything is asked about it."""
        self._now = self._changes(self.frames)
        self._rng = np.random.default_rng([self._seed, _NOISE_STREAM, self.frames])
        self.frames += 1
        self.T_CC = np.eye(4)
        turn = self._value("camera_turn", [0.0] * 3)
        self.T_CC[:3, :3] = Rotation.from_rotvec(turn, degrees=True).as_matrix()
        self.T_CC[:3, 3] = self._value("camera_shift", [0.0] * 3)
        self.fov_scale = self._value("camera_fov", 1.0)

    def lit(self, light: Mapping[str, Any]) -> dict[str, Any]:
        """Light settings of `getCameraImage`, changed from nominal ones."""
        lit = {name: self._value(key, light[name]) for key, name in LIGHTS.items()}
        x, y, z = light["lightDirection"]
        tilt = np.radians(
            self._value("light_tilt", float(np.degrees(np.arctan2(np.hypot(x, y), z))))
        )
        heading = np.radians(self._value("light_heading", float(np.degrees(np.arctan2(y, x)))))
        level = np.sin(tilt)
        direction = level * np.cos(heading), level * np.sin(heading), np.cos(tilt)
        lit["lightDirection"] = [float(part) for part in direction]
        return dict(light) | lit | {"shadow": self._shadow}

    def develop(
        self,
        rgb: np.ndarray,
        depth: np.ndarray,
        bodies: np.ndarray,
        K: np.ndarray,
        T_WC: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        """rgb (H, W, 3) uint8 and depth (H, W) float32 metres of a rendered image, changed.

        bodies: (H, W) body numbers. K, T_WC: the camera that really took it.
        """
        image = rgb.astype(np.float32)
        known = known_depth(depth)
        for body, texture in self._textures.items():
            rows, cols = np.nonzero((bodies == body) & known)
            if len(rows):
                points = deproject(np.column_stack([cols, rows]), depth[rows, cols], K, T_WC)
                T = self._pose(body)
                factors = texture.factor((points - T[:3, 3]) @ T[:3, :3])
                image[rows, cols] = np.clip(image[rows, cols] * factors, 0, 255)
        image = self._coloured(image)
        if self._noisy_depth:
            depth = self._measured(depth, float(K[0, 0]))
        return np.rint(np.clip(image, 0, 255)).astype(np.uint8), depth

    def _coloured(self, image: np.ndarray) -> np.ndarray:
        gain = np.array(self._value("white_balance", [1.0] * 3), np.float32)
        image = image * (gain * np.float32(self._value("brightness", 1.0)))
        saturation = np.float32(self._value("saturation", 1.0))
        if saturation != 1:
            grey = (image @ _GREY)[..., None]
            image = grey + saturation * (image - grey)
        contrast = np.float32(self._value("contrast", 1.0))
        if contrast != 1:
            mean = (image @ _GREY).mean()
            image = mean + contrast * (image - mean)
        noise = self._value("colour_noise", 0.0)
        if noise > 0:
            draws = self._rng.standard_normal(image.shape, dtype=np.float32)
            image = image + np.float32(noise) * draws
        return image

    def _measured(self, depth: np.ndarray, focal: float) -> np.ndarray:
        noise = KinectNoise(image_focal=focal)
        values = {field: self._value(key, getattr(noise, field)) for key, field in KINECT.items()}
        return replace(noise, **values)(depth, self._rng)

    def _value(self, name: str, nominal: Any) -> Any:
        if name not in self._now:
            return nominal
        operation, value = self._now[name]
        if isinstance(value, Sequence):
            return [changed(operation, n, v) for n, v in zip(nominal, value)]
        return changed(operation, nominal, value)
