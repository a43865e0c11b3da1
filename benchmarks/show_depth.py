"""One scene as each depth camera sees it: python -m benchmarks.show_depth --output FILE.png

Draws heights over the table, of a scene without noise and with each profile of `utils.depth`, and
below each the middle enlarged; pixels without a depth are red. `seed` chooses the scene.
`transfer.cornell=path/to/cornell` adds the photograph `--photograph`, a first Kinect's from 1.2 m.
Prints how many pixels are lost, and how much the heights of the table scatter.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from envs.cell_scenes import LAYOUTS, make_scene
from envs.objects import load_objects
from envs.simulators import make_cell
from models.photographs import frame_of, photographs
from utils.config import Config
from utils.depth import DEPTH_NOISES
from utils.errors import UserError
from utils.evaluation import with_depth_noise
from utils.image_overlay import contact_sheet, picture_path, write_picture
from utils.result_records import CLEAN
from utils.runs import parse_args, run_script
from utils.transforms import RGBDFrame, deproject, known_depth

OUTPUT = Path("runs/show_depth/depth.png")
_SIDE = 224  # pixels of each picture
_LOWEST, _HIGHEST = -0.02, 0.08  # m over the table, black and white
_UNKNOWN = (200, 30, 30)
_MIDDLE = 0.4  # share of the image's side that is enlarged
_TABLE = 0.015  # m from the median height, within which a pixel shows the table


def main(argv: Sequence[str] | None = None) -> None:
    def options(parser: argparse.ArgumentParser) -> None:
        parser.add_argument(
            "--output", type=picture_path, default=OUTPUT, help=f"PNG or JPEG; default: {OUTPUT}"
        )
        parser.add_argument("--objects", default="random_urdfs", help="a named set or a folder")
        parser.add_argument("--layout", default="pile", choices=LAYOUTS)
        parser.add_argument("--photograph", default="pcd0100", help="name of the photograph")

    summary = "Show a scene under each depth noise."
    config, chosen = parse_args(argv, summary, options, resumes=False)
    frames = frames_of(config, chosen.objects, chosen.layout)
    if config.transfer.cornell is not None:
        samples = {sample.name: sample for sample in photographs(config.transfer.cornell)}
        name = chosen.photograph
        if name not in samples:
            raise UserError(f"--photograph {name}: not in {config.transfer.cornell}; name another")
        frames[f"Cornell, {name}"] = frame_of(samples[name], shrunk=1.0)
    wholes, middles = [], []
    for name, frame in frames.items():
        over_table = heights(frame)
        lost, scatter = lost_and_scatter(over_table)
        print(f"{name}: {100 * lost:.1f} % lost, the table scatters by {1000 * scatter:.1f} mm")
        square = _middle(over_table, 1.0)
        wholes.append(_picture(square))
        middles.append(_picture(_middle(square, _MIDDLE)))
    sheet = contact_sheet(
        wholes + middles, [*frames, *(f"{n}, middle" for n in frames)], len(frames)
    )
    write_picture(chosen.output, sheet)
    print(f"wrote {chosen.output}")


def frames_of(config: Config, objects: str, layout: str) -> dict[str, RGBDFrame]:
    """The same scene's first frame without noise and with each known one."""
    models = load_objects(objects, config)
    scene = make_scene(layout, models, config.seed, config)
    frames = {}
    for name in (CLEAN, *DEPTH_NOISES):
        with make_cell(with_depth_noise(config, name)) as cell:
            cell.load(scene)
            frames[name] = cell.frame()
    return frames


def heights(frame: RGBDFrame) -> np.ndarray:
    """(H, W) metres over the table z = 0 of W; NaN where the depth is unknown."""
    v, u = np.mgrid[: frame.depth.shape[0], : frame.depth.shape[1]]
    z = deproject(np.stack([u, v], axis=-1), frame.depth, frame.K, frame.T_WC)[..., 2]
    return np.where(known_depth(frame.depth), z, np.nan)


def lost_and_scatter(over_table: np.ndarray) -> tuple[float, float]:
    """The share of pixels without a height, and the robust standard deviation, in metres, of those
    that show the table."""
    off = np.abs(over_table - np.nanmedian(over_table))
    return float(np.isnan(off).mean()), 1.4826 * float(np.median(off[off < _TABLE]))


def _middle(image: np.ndarray, share: float) -> np.ndarray:
    """The square in the middle of an image whose side is this share of the image's shorter one."""
    half = round(share * min(image.shape) / 2)
    row, column = (side // 2 for side in image.shape)
    return image[row - half : row + half, column - half : column + half]


def _picture(over_table: np.ndarray) -> np.ndarray:
    grey = np.clip((over_table - _LOWEST) / (_HIGHEST - _LOWEST), 0, 1)
    shown = np.repeat(np.uint8(255 * np.nan_to_num(grey))[..., None], 3, axis=2)
    shown[np.isnan(over_table)] = _UNKNOWN
    return cv2.resize(shown, (_SIDE, _SIDE), interpolation=cv2.INTER_NEAREST)


if __name__ == "__main__":
    run_script(main)
