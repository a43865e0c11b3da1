"""Changes of what a camera sees: light, camera error, textures, colours and depth noise.

The renderer applies light, pose and field of view; `RandomView` applies the rest to its image.
Textures are functions of a point on the object ("solid textures", Peachey 1985), generated or taken
from a folder of pictures. They stick to the object, need no texture coordinates, are the same in
every renderer, and load nothing into PyBullet, which never frees textures (bullet3 #3285). This
module needs no renderer and knows neither simulator nor distribution.
"""

from __future__ import annotations

import colorsys
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from utils.config_types import Change, changed
from utils.depth import KinectNoise
from utils.errors import UserError
from utils.images import open_image
from utils.transforms import deproject, known_depth

PICTURES = (".png", ".jpg", ".jpeg", ".bmp", ".webp")
_LARGEST_PICTURE = 256  # pixels, longer side that is kept
_LATTICE = 16  # points of a grain's lattice along each axis, which then repeats


class SolidTexture(Protocol):
    def factor(self, points: np.ndarray) -> np.ndarray:
        """(N, 3) factors of the colours at points (N, 3), in the object's frame in metres."""


@dataclass(frozen=True)
class Texture:
    """A sum of waves through space that brightens and darkens a colour.

    waves: (M, 3) wave vectors, rad/m. phases: (M,). strength: (3,) per colour channel, in 0..1.
    hard: two tones (stripes, checks) instead of smooth changes.
    """

    waves: np.ndarray
    phases: np.ndarray
    strength: np.ndarray
    hard: bool

    @staticmethod
    def draw(rng: np.random.Generator) -> Texture:
        count = int(rng.integers(1, 4))
        direction = rng.normal(size=(count, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        length = np.exp(rng.uniform(np.log(0.006), np.log(0.08), size=(count, 1)))  # metres
        return Texture(
            2 * np.pi / length * direction,
            rng.uniform(0, 2 * np.pi, count),
            rng.uniform(0, 0.5) * rng.uniform(0.4, 1.0, 3),
            bool(rng.random() < 0.4),
        )

    def factor(self, points: np.ndarray) -> np.ndarray:
        """(N, 3) factors of the colours at points (N, 3) in metres."""
        wave = np.sin(points @ self.waves.T + self.phases).mean(axis=1)
        wave = np.sign(wave) if self.hard else wave
        return 1 + wave[:, None] * self.strength


@dataclass(frozen=True)
class Grain:
    """Spots: random values on a cubic lattice, interpolated between its points (value noise).

    values: (L, L, L) in -1..1, repeating. size: metres between points. strength: (3,) in 0..1.
    """

    values: np.ndarray
    size: float
    strength: np.ndarray

    def factor(self, points: np.ndarray) -> np.ndarray:
        found = map_coordinates(self.values, points.T / self.size, order=1, mode="grid-wrap")
        return 1 + found[:, None] * self.strength


@dataclass(frozen=True)
class Picture:
    """A picture that repeats, seen along a direction through the object.

    pixels: (H, W, 3) factors of mean 1. axes: (2, 3) unit vectors along its columns and rows.
    size: metres that its width spans. offset: (2,) in pixels.
    """

    pixels: np.ndarray
    axes: np.ndarray
    size: float
    offset: np.ndarray

    def factor(self, points: np.ndarray) -> np.ndarray:
        height, width = self.pixels.shape[:2]
        pixel = points @ self.axes.T * (width / self.size) + self.offset
        col, row = np.floor(pixel).astype(int).T
        return self.pixels[row % height, col % width]


class TextureRandomizer:
    """Draws textures, made up or from a folder of pictures.

    A draw is a plain dict, and `make` builds the texture from it: what is recorded shows the same
    again. folder: of pictures (any below it), which then make half of the draws.
    Raises UserError if the folder is missing or holds no picture.
    """

    def __init__(self, folder: Path | None = None):
        self.files: tuple[str, ...] = ()
        if folder is not None:
            self.load_textures(folder)

    def load_textures(self, folder: Path) -> None:
        """Use the pictures of a folder instead of those so far; see the class for errors."""
        folder = Path(os.path.expanduser(folder))
        if not folder.is_dir():
            raise UserError(f"texture folder {folder}: no such folder")
        files = sorted(str(p) for p in folder.rglob("*") if p.suffix.lower() in PICTURES)
        if not files:
            raise UserError(f"texture folder {folder}: no picture ({', '.join(PICTURES)}) in it")
        for file in files:
            _read_picture(file)
        self.files = tuple(files)

    def draw(self, rng: np.random.Generator) -> dict[str, Any]:
        """The description of a random texture."""
        if self.files and rng.random() < 0.5:
            across = rng.normal(size=(2, 3))
            across[1] -= across[0] * (across[1] @ across[0]) / (across[0] @ across[0])
            return {
                "kind": "picture",
                "file": self.files[int(rng.integers(len(self.files)))],
                "axes": (across / np.linalg.norm(across, axis=1, keepdims=True)).tolist(),
                "size": float(np.exp(rng.uniform(np.log(0.03), np.log(0.3)))),
                "offset": rng.uniform(0, _LARGEST_PICTURE, 2).tolist(),
            }
        if rng.random() < 0.5:
            wave = Texture.draw(rng)
            return {
                "kind": "waves",
                "waves": wave.waves.tolist(),
                "phases": wave.phases.tolist(),
                "strength": wave.strength.tolist(),
                "hard": wave.hard,
            }
        return {
            "kind": "grain",
            "seed": int(rng.integers(2**31)),
            "size": float(np.exp(rng.uniform(np.log(0.002), np.log(0.04)))),
            "strength": (rng.uniform(0, 0.6) * rng.uniform(0.4, 1.0, 3)).tolist(),
        }

    @staticmethod
    def make(description: Mapping[str, Any]) -> SolidTexture:
        """The texture of a draw. Raises UserError for one of an unknown kind, whose picture cannot
        be read, or that is no draw."""
        try:
            return _texture(description)
        except UserError:
            raise
        except (KeyError, TypeError, ValueError) as error:
            raise UserError(
                f"texture {description!r:.60}: its entries are not those of a draw ({error!r}); "
                "give one as it was recorded"
            ) from error


def _texture(description: Mapping[str, Any]) -> SolidTexture:
    kind = description.get("kind")
    if kind == "picture":
        return Picture(
            _read_picture(description["file"]), np.array(description["axes"]),
            description["size"], np.array(description["offset"]),
        )  # fmt: skip
    strength = np.array(description.get("strength", ()))
    if kind == "waves":
        waves, phases = (np.array(description[name]) for name in ("waves", "phases"))
        return Texture(waves, phases, strength, description["hard"])
    if kind == "grain":
        rng = np.random.default_rng(description["seed"])
        return Grain(rng.uniform(-1, 1, (_LATTICE,) * 3), description["size"], strength)
    raise UserError(f"texture kind {kind!r} is unknown; known are grain, picture, waves")


def random_colour(rng: np.random.Generator) -> np.ndarray:
    """(3,) RGB in 0..1, of any hue and saturation and not quite black."""
    hue, saturation, value = rng.random(), rng.uniform(0, 1), rng.uniform(0.1, 1)
    return np.array(colorsys.hsv_to_rgb(hue, saturation, value))


@lru_cache(maxsize=256)
def _read_picture(file: str) -> np.ndarray:
    """(H, W, 3) RGB factors of mean 1. Raises UserError."""
    picture = np.array(open_image(Path(file)).convert("RGB"))
    shrink = min(1.0, _LARGEST_PICTURE / max(picture.shape[:2]))
    size = [max(1, round(side * shrink)) for side in picture.shape[1::-1]]
    picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    factors = picture / max(float(picture.mean()), 1.0)
    factors.flags.writeable = False
    return factors


_GREY = np.array([0.299, 0.587, 0.114], np.float32)  # luma weights, ITU-R BT.601
_NOISE_STREAM = 2  # keeps a frame's noise apart from what else is drawn with the same seed
# `KinectNoise.noise` is in steps: depth_step changes the jitter in pixels, too.
KINECT = {"depth_shift": "shift", "depth_jitter": "noise", "depth_step": "step"}
LIGHTS = {
    "light_colour": "lightColor",
    "light_ambient": "lightAmbientCoeff",
    "light_diffuse": "lightDiffuseCoeff",
    "light_specular": "lightSpecularCoeff",
}


class RandomView:
    """Changes the images of a cell's camera; the same changes and frames give the same images.

    changes: for frame k of the episode, by parameter; names are the keys of the config's section
    randomization.vision. shadow: 0 or 1. noisy_depth: whether the depth gets a `KinectNoise`.
    textures: by the simulator's body number. pose: (4, 4) of a body in W, for its texture.
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
        """Begin the next frame; call this before anything else of the frame."""
        self._now = self._changes(self.frames)
        self._rng = np.random.default_rng([self._seed, _NOISE_STREAM, self.frames])
        self.frames += 1
        self.T_CC = np.eye(4)
        turn = self._value("camera_turn", [0.0] * 3)
        self.T_CC[:3, :3] = Rotation.from_rotvec(turn, degrees=True).as_matrix()
        self.T_CC[:3, 3] = self._value("camera_shift", [0.0] * 3)
        self.fov_scale = self._value("camera_fov", 1.0)

    def lit(self, light: Mapping[str, Any]) -> dict[str, Any]:
        """Light settings as in `envs.cell.DEFAULT_LIGHT`, changed from nominal ones."""
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

        bodies: (H, W) body numbers. K, T_WC: of the camera that rendered it, errors included.
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
