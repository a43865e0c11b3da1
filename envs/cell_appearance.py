"""The appearance of training images: colours, textures, light and camera poses from a generator.

`utils.random_view` draws textures over the rendered image. Nothing here changes physics, and only
the camera's pose changes depth.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from envs.cell import TABLE_OR_BACKGROUND, Cell, Intrinsics, camera_intrinsics
from utils.config_schema import CameraConfig
from utils.random_view import Texture, random_colour
from utils.transforms import RGBDFrame, known_depth, look_at

_PLAIN_SHARE = 0.15  # of the scenes keep the cell's own appearance
_ONE_COLOUR_SHARE = 0.2  # of the others have all objects in one colour, a quarter in the table's
_OBLIQUE_SHARE = 0.2  # of the camera poses are far from the configured one


@dataclass(frozen=True)
class Appearance:
    """Colours, textures and light of one scene.

    table, objects: RGBA (4,) and (N, 4) in 0..1, None for the cell's own. textures: of the table
    and then each object, None for none. light: changed entries of `envs.cell.DEFAULT_LIGHT`.
    noise: standard deviation of the colour noise, 0..255.
    """

    table: np.ndarray | None = None
    objects: np.ndarray | None = None
    textures: tuple[Texture | None, ...] = ()
    light: dict | None = None
    noise: float = 0.0

    @staticmethod
    def draw(rng: np.random.Generator, count: int) -> Appearance:
        """A random appearance for a scene of `count` objects."""
        if rng.random() < _PLAIN_SHARE:
            return Appearance()
        grey = np.full(3, rng.uniform(0.15, 0.95))
        table = grey if rng.random() < 0.5 else random_colour(rng)
        objects = np.stack([random_colour(rng) for _ in range(count)])
        if rng.random() < _ONE_COLOUR_SHARE:
            objects[:] = table if rng.random() < 0.25 else objects[0]
        textures = tuple(Texture.draw(rng) if rng.random() < 0.4 else None for _ in range(count))
        wood = Texture.draw(rng) if rng.random() < 0.5 else None
        return Appearance(
            np.append(table, 1.0),
            np.column_stack([objects, np.ones(count)]),
            (wood, *textures),
            _light(rng),
            rng.uniform(0, 6),
        )

    def paint(self, cell: Cell) -> None:
        """Colour the loaded scene's table and objects."""
        if self.table is None:
            return
        cell.randomizable().paint([self.table, *self.objects])

    def render(
        self, cell: Cell, intrinsics: Intrinsics, T_WC: np.ndarray, rng: np.random.Generator
    ) -> RGBDFrame:
        """The painted scene in this light, with textures and colour noise, and with its truth."""
        frame = cell.look(intrinsics, T_WC, with_truth=True, light=self.light)
        rgb = frame.rgb.astype(np.float32)
        for index, texture in enumerate(self.textures, start=TABLE_OR_BACKGROUND):
            seen = (frame.segmentation == index) & known_depth(frame.depth)
            if texture is None or not seen.any():
                continue
            points = frame.points()[seen]
            if index != TABLE_OR_BACKGROUND:
                pose = cell.object_pose(index)
                points = (points - pose[:3, 3]) @ pose[:3, :3]
            rgb[seen] *= texture.factor(points)
        if self.noise:
            rgb += self.noise * rng.standard_normal(rgb.shape, dtype=np.float32)
        return replace(frame, rgb=np.clip(rgb, 0, 255).astype(np.uint8))


def draw_camera(rng: np.random.Generator, camera: CameraConfig) -> tuple[Intrinsics, np.ndarray]:
    """Intrinsics and pose (4, 4) T_WC near those of a camera straight above what the configured one
    looks at, at its distance; now and then far.

    Near: within 2 cm, 3 degrees and 8 % of the focal length, of every roll. Far: up to 25 degrees
    oblique, though not over the robot, and 12 cm nearer or farther.
    """
    far = rng.random() < _OBLIQUE_SHARE
    position, target = np.array(camera.position), np.array(camera.target)
    distance = np.linalg.norm(position - target)
    tilt = np.radians(rng.uniform(0, 25 if far else 3))
    # From the robot's side its hand would hide the table from an oblique camera.
    heading = rng.uniform(-1, 1) * np.pi * (2 / 3 if far else 1)
    away = np.array([np.cos(heading) * np.sin(tilt), np.sin(heading) * np.sin(tilt), np.cos(tilt)])
    shift = np.append(rng.uniform(-0.02, 0.02, 2), 0.0)
    length = distance + rng.uniform(-1, 1) * (0.12 if far else 0.02)
    up = [np.cos(roll := rng.uniform(0, 2 * np.pi)), np.sin(roll), 0.0]
    if rng.random() < 0.3:
        up = camera.up
    intrinsics = camera_intrinsics(camera)
    wider = replace(intrinsics, fov_deg=intrinsics.fov_deg * rng.uniform(0.92, 1.08))
    return wider, look_at(target + shift + length * away, target + shift, up)


def _light(rng: np.random.Generator) -> dict:
    tilt, heading = np.radians(rng.uniform(0, 60)), rng.uniform(0, 2 * np.pi)
    ambient = rng.uniform(0.35, 0.75)
    return {
        "lightDirection": (
            float(np.sin(tilt) * np.cos(heading)),
            float(np.sin(tilt) * np.sin(heading)),
            float(np.cos(tilt)),
        ),
        "lightColor": tuple(rng.uniform(0.8, 1.0, 3).tolist()),
        "lightAmbientCoeff": float(ambient),
        "lightDiffuseCoeff": float(rng.uniform(0.7, 1.1) - ambient),
        "lightSpecularCoeff": float(rng.uniform(0, 0.3)),
        "shadow": int(rng.random() < 0.5),
    }
