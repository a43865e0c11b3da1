"""Pictures and films for people: a scenic camera with shadows and fine meshes where they exist.

To see a scene, and what the cell's camera sees of it:

    python -m envs.studio --objects primitives --layout pile --output scene.png seed=3
    python -m envs.studio --layout packed --rgbd runs/scene

`--rgbd` makes a folder of color.png, depth.png (16 bits, millimetres), intrinsics.json (pixels) and
T_WC.txt, which predict.py reads, and scene.png, which is for people; it prints the command of
predict.py. `film_episode` films any Gymnasium environment that renders "rgb_array".
"""

from __future__ import annotations

import argparse
import io
import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import gymnasium
import imageio.v2 as imageio
import numpy as np
from typing_extensions import Self

from envs.cell import Cell, Intrinsics
from envs.cell_scenes import LAYOUTS, make_scene
from envs.objects import load_objects
from envs.simulators import make_cell
from utils.atomic_files import check_writable, command_line, new_folder, write_atomic
from utils.errors import UserError
from utils.image_overlay import PICTURES, write_picture
from utils.runs import parse_args, run_script, this_python
from utils.transforms import RGBDFrame, look_at

SCENIC_EYE, SCENIC_TARGET = (1.22, -0.50, 0.72), (0.38, -0.12, 0.20)  # m in W
_LIGHT = {"shadow": 1, "lightDirection": (0.6, -0.7, 1.6), "lightAmbientCoeff": 0.5}
FILM_RATE, FILM_SIZE = 6, (480, 368)  # Hz of simulated time; width and height, pixels
SCENE = "scene.png"  # the picture of a scene, where no name is given
_HOLD = 6  # pictures for which the last one of an episode stays
_QUICK = cv2.IMWRITE_PNG_COMPRESSION, 1  # the least
_SPEED = 2.0  # of a film, in multiples of real time


class Studio:
    """Takes pictures of a cell, of its detailed twin where it has one. Close it, or use it in a
    `with` block."""

    def __init__(self, cell: Cell, width: int = 640, height: int = 480):
        self._cell, self._twin = cell, cell.detailed_twin()
        self._intrinsics = Intrinsics(width, height, fov_deg=45.0, near=0.05, far=5.0)
        self._T_WC = look_at(SCENIC_EYE, SCENIC_TARGET)

    def picture(self) -> np.ndarray:
        """(H, W, 3) uint8 picture of the cell as it is now; a twin has the nominal colours, however
        the cell's are randomised."""
        shown = self._cell
        if self._twin is not None:
            self._twin.mirror(self._cell)
            shown = self._twin
        # Not `Cell.image`: a randomised view belongs to the cell's camera and counts its pictures.
        return shown.camera.render_rgb(self._intrinsics, self._T_WC, _LIGHT)

    def close(self) -> None:
        if self._twin is not None:
            self._twin.close()

    def __enter__(self) -> Studio:
        return self

    def __exit__(self, *exception) -> None:
        self.close()


class Film:
    """Films a cell from now on until it is stopped, at the end of a `with` block at the latest. It
    keeps its pictures as PNG: a round of a minute would take 200 MB otherwise.

    rate: pictures a second of simulated time. size: width and height, pixels.
    """

    def __init__(self, cell: Cell, rate: float = FILM_RATE, size: tuple[int, int] = FILM_SIZE):
        self._cell, self._studio, self._rate = cell, Studio(cell, *size), rate
        self._pictures: list[np.ndarray] = []  # encoded
        self._stopped = False
        self._every = max(1, round(1 / (rate * cell.dt)))
        cell.on_step = self._on_step

    def _on_step(self, cell: Cell) -> None:
        if cell.steps % self._every == 0:
            self._keep()

    def _keep(self) -> None:
        picture = cv2.cvtColor(self._studio.picture(), cv2.COLOR_RGB2BGR)
        self._pictures.append(cv2.imencode(".png", picture, _QUICK)[1])

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        if not self._stopped:
            self._end()

    def _end(self) -> None:
        self._stopped, self._cell.on_step = True, None
        self._studio.close()

    def stop(self) -> Iterator[np.ndarray]:
        """Stop filming; gives the pictures, (H, W, 3) uint8 each."""
        if not self._pictures:  # the arm has not moved: at least show the scene
            self._keep()
        self._end()
        return (cv2.imdecode(one, cv2.IMREAD_COLOR_RGB) for one in self._pictures)

    def encoded(self, ending: str) -> bytes:
        """Stop filming; returns a file that runs at twice real time. ending: its name's, "mp4" or
        "gif"."""
        return _encoded(ending, self.stop(), _SPEED * self._rate)


def film_episode(
    env: gymnasium.Env, act: Callable[[Any], np.ndarray], seed: int, path: Path,
    options: dict[str, Any] | None = None,
) -> str:  # fmt: skip
    """Play an episode and write it to an MP4 or GIF in real time; returns the word for how it
    ended. options: of its reset."""
    observation, info = env.reset(seed=seed, options=options)
    pictures, ended, terminated = [env.render()], False, False
    while not ended:
        observation, _, terminated, truncated, info = env.step(act(observation))
        pictures.append(env.render())
        ended = terminated or truncated
    write_film(path, pictures, env.metadata.get("render_fps", 30))
    return str(info.get("reason") or ("terminated" if terminated else "truncated"))


def write_film(path: Path, pictures: Sequence[np.ndarray], rate: float) -> None:
    """Write an MP4 or GIF of `rate` pictures a second, whole or not at all; the last one stays for
    a while."""
    write_atomic(path, _encoded(path.suffix[1:], [*pictures, *[pictures[-1]] * _HOLD], rate))


def _encoded(ending: str, pictures: Iterable[np.ndarray], rate: float) -> bytes:
    """A film as the bytes of a file whose name ends so."""
    if ending == "gif":
        gif = {"format": "gif", "duration": 1000 / rate, "loop": 0}
        return imageio.mimwrite("<bytes>", list(pictures), **gif)
    file = io.BytesIO()
    with imageio.get_writer(file, format=ending, mode="I", fps=rate, quality=6) as writer:
        for picture in pictures:  # one by one: they may be many
            writer.append_data(picture)
    return file.getvalue()


def write_rgbd(frame: RGBDFrame, folder: Path, scene: np.ndarray | None = None) -> list[str]:
    """Write color.png, depth.png in millimetres, intrinsics.json in pixels and T_WC.txt of a frame
    into a new folder, all or nothing; returns the arguments with which predict.py reads them.

    scene: (H, W, 3) uint8, also written there as scene.png; None for none. Raises UserError where
    the folder exists or cannot be written.
    """
    height, width = frame.depth.shape
    (fx, _, cx), (_, fy, cy) = frame.K[:2].tolist()
    numbers = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "width": width, "height": height}
    pose = io.StringIO()
    np.savetxt(pose, frame.T_WC)
    with new_folder(folder) as new:
        write_picture(new / "color.png", frame.rgb)
        write_picture(new / "depth.png", np.rint(1000 * frame.depth).astype(np.uint16))
        write_atomic(new / "intrinsics.json", json.dumps(numbers) + "\n")
        write_atomic(new / "T_WC.txt", pose.getvalue())
        if scene is not None:
            write_picture(new / SCENE, scene)
    files = {
        "--rgb": "color.png", "--depth": "depth.png", "--intrinsics": "intrinsics.json",
        "--camera-pose": "T_WC.txt", "--out": "grasps",
    }  # fmt: skip
    return [text for option, name in files.items() for text in (option, str(folder / name))]


def check_files(picture: Path | None, folder: Path | None) -> None:
    """Raise UserError where the picture or the new folder could not be written at the end."""
    check_writable("--output", picture)
    if picture is not None and picture.suffix.lower() not in PICTURES:
        raise UserError(f"--output {picture}: expected a file {' or '.join(PICTURES)}")
    if folder is not None and folder.exists():
        raise UserError(f"--rgbd {folder}: this name is taken; give a folder that does not exist")


def main(argv: Sequence[str] | None = None) -> None:
    """Write a picture of one scene, and what the cell's camera sees of it."""

    def options(parser: argparse.ArgumentParser) -> None:
        parser.add_argument(
            "--output",
            type=Path,
            help="PNG or JPEG file; default: scene.png, in the folder of --rgbd",
        )
        parser.add_argument(
            "--objects", default="primitives", help="a named set, a folder or an import path"
        )
        parser.add_argument(
            "--layout", default="pile", choices=LAYOUTS, help="how they stand; default: pile"
        )
        parser.add_argument("--rgbd", type=Path, metavar="FOLDER", help="an RGB-D image, too")

    config, chosen = parse_args(argv, "Picture a scene; `seed` chooses it.", options, resumes=False)
    with_image = chosen.rgbd is not None and chosen.output is None
    output = chosen.output or (chosen.rgbd or Path()) / SCENE
    check_files(None if with_image else output, chosen.rgbd)
    objects = load_objects(chosen.objects, config)
    command = None
    with make_cell(config) as cell:
        cell.load(make_scene(chosen.layout, objects, config.seed, config))
        with Studio(cell) as studio:
            picture = studio.picture()
        if chosen.rgbd is not None:
            arguments = write_rgbd(cell.frame(), chosen.rgbd, picture if with_image else None)
            command = f"{this_python()} {command_line(['predict.py', *arguments])}"
    verb = "replaced" if output.exists() and not with_image else "wrote"
    if not with_image:
        write_picture(output, picture)
    print(f"{verb} {output}")
    if chosen.rgbd is not None:
        print(f"wrote {chosen.rgbd}: color.png, depth.png, intrinsics.json, T_WC.txt")
    if command is not None:
        print(command)


if __name__ == "__main__":
    run_script(main)
