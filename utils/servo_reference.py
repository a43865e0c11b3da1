"""Servo runs with known results: for the tests, the benchmark and `python -m utils.visual_servo`.

The target is a square of 20 cm with a point in each corner. Gain 0.5 1/s, 0.04 s a step and exact
depths, unless a row's name says otherwise. The references do not come from this code: they were
computed with an exact SE(3) exponential and checked against machinevision-toolbox-python 2.4.1.
"""

from __future__ import annotations

from argparse import ArgumentParser
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from utils.errors import ServoError
from utils.servo_control import AdaptiveGain
from utils.servo_history import ServoHistory, plot_histories
from utils.transforms import rotation_exp
from utils.visual_servo import HybridVisualServo, ImageBasedVisualServo, PositionBasedVisualServo

SQUARE = 0.1 * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])  # metres in O
FOCAL = 840.0  # pixels
CAMERA = {"intrinsics": np.array([[FOCAL, 0.0, 320.0], [0.0, FOCAL, 240.0], [0.0, 0.0, 1.0]])}
TOLERANCE = 1e-5  # norm of the image error in normalised coordinates
STEADY_AFTER = 200  # iterations, after which the initial error has decayed to 0.98^200 = 2 %
GAINS = (0.5, 1.0, 2.0, AdaptiveGain())  # 1/s, of the comparison


class KnownResult(NamedTuple):
    """A measured figure and its reference; tolerance: allowed relative deviation."""

    name: str
    value: float
    reference: float
    tolerance: float

    @property
    def holds(self) -> bool:
        return abs(self.value - self.reference) <= self.tolerance * abs(self.reference)


def object_pose(translation, rotation_degrees) -> np.ndarray:
    """(4, 4) T_CO from metres (3,) and an axis-angle vector in degrees (3,)."""
    T = np.eye(4)
    T[:3, :3] = rotation_exp(np.radians(rotation_degrees))
    T[:3, 3] = translation
    return T


START = object_pose([0.15, -0.1, 1.0], [10, -10, 50])
GOAL = object_pose([0, 0, 0.75], [0, 0, 0])
NEAR_GOAL = object_pose([0, 0, 0.5], [0, 0, 0])  # as near as the nearest random start
FACING = object_pose([0, 0, 1.0], [0, 0, 0])


def turned(degrees: float) -> np.ndarray:
    """(4, 4) T_CO at 1 m, turned about the optical axis."""
    return object_pose([0, 0, 1.0], [0, 0, degrees])


def random_start(rng: np.random.Generator) -> np.ndarray:
    """(4, 4) T_CO: 0.5 to 1 m away, up to 10 cm aside, tilted by up to 30 and turned by up to 180
    degrees."""
    about = rng.uniform(0, 2 * np.pi)
    tilt = rng.uniform(0, 30) * np.array([np.cos(about), np.sin(about), 0])
    T = object_pose([*rng.uniform(-0.1, 0.1, 2), rng.uniform(0.5, 1.0)], tilt)
    T[:3, :3] = turned(rng.uniform(-180, 180))[:3, :3] @ T[:3, :3]
    return T


def image_errors(history: ServoHistory) -> np.ndarray:
    """(k,) norms of the image error in normalised coordinates, for any law."""
    difference = (history.points - history.goal_points) / FOCAL
    return np.linalg.norm(difference.reshape(len(difference), -1), axis=1)


def iterations_to_tolerance(history: ServoHistory) -> int:
    """Number of images until the image error is under TOLERANCE, that image included; 0: never."""
    under = image_errors(history) < TOLERANCE
    return int(np.argmax(under)) + 1 if under.any() else 0


def steady_noise(pixels: float, seeds: Sequence[int] = range(8)) -> tuple[float, float]:
    """RMS pose error in mm and degrees of an image-based servo that stays at GOAL under noise.

    One run of this length is accurate to about 5 %: its errors are correlated over 50 iterations.
    """
    squares = []
    for seed in seeds:
        history = ImageBasedVisualServo(CAMERA).simulate(
            SQUARE, GOAL, GOAL, pixel_noise=pixels, rng=np.random.default_rng(seed),
            max_iterations=2500, tolerance=0,
        )  # fmt: skip
        metres, radians = history.pose_errors()
        squares += list(zip(metres[STEADY_AFTER:] ** 2, radians[STEADY_AFTER:] ** 2))
    metres, radians = np.sqrt(np.mean(squares, axis=0))
    return metres * 1e3, np.degrees(radians)


def known_results() -> Iterator[KnownResult]:
    """The measured figures of the reference table."""

    def from_start(servo, **options) -> ServoHistory:
        return servo.simulate(SQUARE, START, GOAL, **options)

    history = from_start(ImageBasedVisualServo(CAMERA), max_iterations=150, tolerance=0)
    norms = history.error_norms
    yield KnownResult("error ratio after 150 iterations", norms[-1] / norms[0], 0.0490, 0.005)
    for interaction, reference in (("current", 534), ("desired", 554), ("mean", 546)):
        history = from_start(ImageBasedVisualServo(CAMERA, interaction=interaction))
        yield KnownResult(f"iterations, {interaction} L", history.iterations, reference, 0.01)
        if interaction == "current":
            yield KnownResult(
                "final position (mm), current L", history.pose_errors()[0][-1] * 1e3, 0.011, 0.05
            )
        if interaction == "desired":
            turn = np.degrees(history.pose_errors()[1][-1])
            yield KnownResult("final rotation (deg), desired L", turn, 0.0009, 0.06)
    adaptive = ImageBasedVisualServo(CAMERA, AdaptiveGain())
    yield KnownResult("iterations, adaptive gain", from_start(adaptive).iterations, 132, 0.01)
    smooth = ImageBasedVisualServo(CAMERA, AdaptiveGain(), smooth_start=4.0)
    yield KnownResult(
        "iterations, adaptive gain, smooth start", from_start(smooth).iterations, 139, 0.01
    )
    for factor, reference in ((0.2, 2755), (0.5, 1117), (2, 544), (5, 547)):
        history = from_start(ImageBasedVisualServo(CAMERA), depth_factor=factor)
        yield KnownResult(f"iterations, depths x {factor}", history.iterations, reference, 0.01)
    for pixels, millimetres, degrees in ((0.5, 1.7, 0.13), (1.0, 3.5, 0.26)):
        found = steady_noise(pixels)
        yield KnownResult(f"steady RMS (mm), noise {pixels} px", found[0], millimetres, 0.1)
        yield KnownResult(f"steady RMS (deg), noise {pixels} px", found[1], degrees, 0.1)
    for degrees, reference in ((90, 0.42), (120, 1.03), (150, 2.98), (170, 11.6)):
        history = ImageBasedVisualServo(CAMERA).simulate(SQUARE, turned(degrees), FACING)
        retreat = history.poses[:, 2, 3].max() - 1.0
        yield KnownResult(f"retreat (m), current L, {degrees} deg", retreat, reference, 0.013)
    desired = ImageBasedVisualServo(CAMERA, interaction="desired")
    nearest = desired.simulate(SQUARE, turned(90), FACING).poses[:, 2, 3].min()
    yield KnownResult("nearest (m), desired L, 90 deg", nearest, 0.67, 0.0075)
    for name, servo in (
        ("position-based", PositionBasedVisualServo(CAMERA)),
        ("2 1/2-D", HybridVisualServo(CAMERA, scheme="2.5d")),
    ):
        history = servo.simulate(SQUARE, turned(180), FACING)
        yield KnownResult(
            f"iterations, {name}, 180 deg", iterations_to_tolerance(history), 566, 0.01
        )


def gain_runs() -> dict[str, ServoHistory]:
    """The image-based law from START to GOAL with each of GAINS, by the gain's name."""
    names = (f"gain {g} 1/s" if isinstance(g, float) else "adaptive gain" for g in GAINS)
    runs = (ImageBasedVisualServo(CAMERA, gain).simulate(SQUARE, START, GOAL) for gain in GAINS)
    return dict(zip(names, runs))


def outcome(servo, T_CO: np.ndarray, T_GO: np.ndarray) -> str:
    """'converged after ...' or the reason why not, a refused first view included."""
    try:
        return servo.simulate(SQUARE, T_CO, T_GO).reason
    except ServoError as error:
        return f"refused by {type(error).__name__}: {error}"


def main(argv: Sequence[str] | None = None) -> None:
    parser = ArgumentParser(description="Repeat known visual servoing results and draw them.")
    parser.add_argument(
        "--folder", type=Path, default=Path("runs/visual_servo"), help="folder of the plots"
    )
    folder = parser.parse_args(argv).folder
    print(f"{'what':40} {'value':>10} {'reference':>10}  holds")
    for row in known_results():
        holds = "yes" if row.holds else "NO"
        print(f"{row.name:40} {row.value:10.4g} {row.reference:10.4g}  {holds}", flush=True)
    print("\nturned by 180 degrees about the optical axis")
    for name, servo in (
        ("image-based", ImageBasedVisualServo(CAMERA)),
        ("position-based", PositionBasedVisualServo(CAMERA)),
        ("blend", HybridVisualServo(CAMERA)),
        ("2 1/2-D", HybridVisualServo(CAMERA, scheme="2.5d")),
    ):
        print(f"{name:16} {outcome(servo, turned(180), FACING)[:80]}")
    print()
    for name, servo, start, goal in (
        ("image_based", ImageBasedVisualServo(CAMERA), START, GOAL),
        ("position_based", PositionBasedVisualServo(CAMERA), START, GOAL),
        ("blend", HybridVisualServo(CAMERA), START, GOAL),
        ("2.5d", HybridVisualServo(CAMERA, scheme="2.5d"), START, GOAL),
        ("retreat_120_degrees", ImageBasedVisualServo(CAMERA), turned(120), FACING),
    ):
        path = folder / f"{name}.png"
        servo.simulate(SQUARE, start, goal).plot(path, title=name.replace("_", " "))
        print(f"wrote {path}")
    plot_histories(gain_runs(), folder / "gains.png")
    print(f"wrote {folder / 'gains.png'}")
