"""A bar gripped off its centre, in both simulators: python -m benchmarks.show_bar --output FILE.png

A bar of 0.3 kg, 24 x 2 x 3 cm, of friction 0.5, is put between the fingers of the arm at
home, which close with 10 N; then it is let go. Weight turns it, and the friction in the fingers
holds against it. Prints the tilt after 0.6 s for some distances of the grip from the centre, and
draws PyBullet's bars left and MuJoCo's right.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from envs.cell import Cell, Intrinsics
from envs.cell_layout import ObjectModel, Placement, Scene
from envs.object_shapes import NativeShape
from envs.objects import load_object_set
from envs.simulators import cell_class
from utils.image_overlay import picture_path, write_picture
from utils.runs import parse_args, run_script
from utils.transforms import look_at

OUTPUT = Path("runs/show_bar/bar.png")
FORCE = 10.0  # N a finger
OFFSETS = (0.03, 0.045, 0.06)  # m from the centre
SECONDS = 0.6  # after the bar is let go
_VIEW = Intrinsics(480, 320, fov_deg=35.0, near=0.05, far=3.0)
_EYE = np.array([0.0, -0.7, 0.05])  # m from the fingertips


def bar(cube: ObjectModel) -> ObjectModel:
    """The bar, made of an object whose other properties do not matter."""
    return solid(cube, NativeShape("box", (0.24, 0.02, 0.03)), 0.3, 0.5)


def solid(cube: ObjectModel, shape: NativeShape, mass: float, friction: float) -> ObjectModel:
    """An object of a native shape and even density, without rolling friction."""
    mesh = shape.mesh("fine")
    return replace(
        cube, collision=shape, mass=mass, friction=friction, rolling_friction=0.0,
        inertia=mass / mesh.volume * np.diag(mesh.moment_inertia), extents=np.array(mesh.extents),
        parts=(np.asarray(shape.mesh().vertices),),
    )  # fmt: skip


def grip(
    cell: Cell, model: ObjectModel, force: float, off: float = 0.0, turned: np.ndarray | None = None
) -> None:
    """Close the fingers of the arm at home on an object `off` metres along x from their middle.

    turned: (3, 3) the object's rotation; None: as in its file. It is held in place for a second
    while the fingers close.
    """
    cell.build(Scene("isolated", 0, (Placement(model, np.array([0.5, 0, 0.5]), np.eye(4)[3]),)))
    T_WO = np.eye(4)
    T_WO[:3, 3] = cell.robot.tip_pose()[:3, 3] + [off, 0.0, 0.0]
    if turned is not None:
        T_WO[:3, :3] = turned
    cell.robot.command_gripper(0.0, force=force)
    for _ in range(240):
        cell.carry(0, T_WO, np.zeros(3), 0.0)
        cell.step()


def tilt(cell: Cell, axis: int = 0) -> float:
    """Degrees by which the axis of the gripped bar points down."""
    return float(np.degrees(np.arcsin(np.clip(-cell.object_pose(0)[2, axis], -1.0, 1.0))))


def main(argv: Sequence[str] | None = None) -> None:
    def options(parser: argparse.ArgumentParser) -> None:
        parser.add_argument(
            "--output", type=picture_path, default=OUTPUT, help=f"PNG or JPEG; default: {OUTPUT}"
        )

    summary = "Grip a bar off its centre in both simulators."
    config, chosen = parse_args(argv, summary, options, resumes=False)
    model = bar(load_object_set("box", cache_dir=config.cache_folder)[0])
    columns = []
    for name, title in (("pybullet", "PyBullet"), ("mujoco", "MuJoCo")):
        with cell_class(name)(config) as cell:
            column = []
            for off in OFFSETS:
                grip(cell, model, FORCE, off)
                cell.step(round(SECONDS / cell.dt))
                text = f"{title}, {100 * off:.1f} cm off: {tilt(cell):.1f} degrees"
                print(text)
                tip = cell.robot.tip_pose()[:3, 3]
                picture = cell.image(_VIEW, look_at(tip + _EYE, tip)).rgb.copy()
                column.append(
                    cv2.putText(picture, text, (12, 28), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (0, 0, 0))
                )
        columns.append(np.vstack(column))
    write_picture(chosen.output, np.hstack(columns))
    print(f"wrote {chosen.output}")


if __name__ == "__main__":
    run_script(main)
