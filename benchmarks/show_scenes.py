"""A film of four scenes that ask for grasps from a side: python -m benchmarks.show_scenes

`graspnet6d` clears one scene of each of `tall`, `wall`, `flat` and `shelf`. The four rounds run
side by side, faster than real time, and say below how they end.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from envs.cell_scenes import make_scene
from envs.evaluation_worker import new_planner
from envs.objects import load_objects
from envs.rounds import run_round
from envs.simulators import make_cell
from envs.studio import Film, write_film
from utils.config import Config
from utils.errors import UserError
from utils.runs import parse_args, run_script

OUTPUT = Path("runs/show_scenes/scenes.gif")
SCENES = (("tall", "tall"), ("wall", "tall"), ("flat", "flat"), ("shelf", "tall"))  # and objects
PLANNER = "graspnet6d"
_RATE, _SPEED = 4.0, 2.5  # pictures a second of simulated time, and how much faster they are shown
_SIZE = (320, 246)
_BAR = 24  # pixels of the caption


def main(argv: Sequence[str] | None = None) -> None:
    def options(parser: argparse.ArgumentParser) -> None:
        parser.add_argument(
            "--output", type=Path, default=OUTPUT, help=f"GIF or MP4; default: {OUTPUT}"
        )

    summary = "Film four scenes that ask for grasps from a side."
    config, chosen = parse_args(argv, summary, options, resumes=False)
    if chosen.output.suffix not in (".gif", ".mp4"):
        raise UserError(f"--output: {chosen.output} is no .gif or .mp4 file; name such a file")
    films = [film(config, layout, objects) for layout, objects in SCENES]
    longest = max(len(pictures) for pictures in films)
    ended = [pictures + [pictures[-1]] * (longest - len(pictures)) for pictures in films]
    tiles = [np.vstack([np.hstack(four[:2]), np.hstack(four[2:])]) for four in zip(*ended)]
    write_film(chosen.output, tiles, _RATE * _SPEED)
    print(f"wrote {chosen.output}")


def film(config: Config, layout: str, objects: str) -> list[np.ndarray]:
    """Pictures (H, W, 3) uint8 of one round."""
    scene = make_scene(layout, load_objects(objects, config), config.seed, config)
    with make_cell(config) as cell, Film(cell, _RATE, _SIZE) as filming:
        record = run_round(
            cell, scene, new_planner(PLANNER, config), policy=PLANNER, objects=objects,
            max_failures=config.evaluate.max_failures, abstain=config.evaluate.abstain,
        )  # fmt: skip
        pictures = list(filming.stop())
    outcome = f"{layout}: {record.objects_cleared} of {record.objects_total} in the tray"
    outcome += f", {len(record.attempts)} attempts"
    print(outcome)
    return [captioned(picture, outcome) for picture in pictures]


def captioned(picture: np.ndarray, words: str) -> np.ndarray:
    """The picture over a white bar with the words."""
    bar = np.full((_BAR, picture.shape[1], 3), 255, np.uint8)
    cv2.putText(bar, words, (6, 17), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 0), 1, cv2.LINE_AA)
    return np.vstack([picture, bar])


if __name__ == "__main__":
    run_script(main)
