"""Learning curves of train_rl.py: python -m benchmarks.learning_curves FILE.png RUN [RUN ...]

A line for each run: success of the training's own episodes (with exploration noise, and half of
them begun near the object where the config says so), smoothed over 5,000 steps, and the
deterministic evaluations at full difficulty as dots. RUN may be LABEL=FOLDER.
"""

from __future__ import annotations

import json
from argparse import ArgumentParser
from collections.abc import Sequence
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from utils.atomic_files import check_writable, save_figure
from utils.errors import UserError
from utils.runs import run_script

SMOOTHED = 5000  # steps


def main(argv: Sequence[str] | None = None) -> None:
    parser = ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("output", type=Path)
    parser.add_argument("runs", nargs="+", metavar="RUN")
    options = parser.parse_args(argv)
    check_writable("FILE.png", options.output)
    matplotlib.use("Agg")
    figure, axis = plt.subplots(figsize=(7, 3.6), layout="constrained")
    for text in options.runs:
        label, _, folder = text.rpartition("=")
        draw(axis, Path(folder), label or Path(folder).name)
    axis.set(xlabel="environment steps", ylabel="episodes that succeed", ylim=(-0.03, 1.03))
    axis.grid(alpha=0.3)
    axis.legend()
    save_figure(options.output, figure)
    print(f"wrote {options.output}")


def draw(axis: plt.Axes, run: Path, label: str) -> None:
    steps, success = training_success(run)
    (line,) = axis.plot(steps, smoothed(steps, success, SMOOTHED), label=label)
    at, shares = np.array(evaluations(run)).reshape(-1, 2).T
    axis.plot(at, shares, "o", color=line.get_color())


def training_success(run: Path) -> tuple[np.ndarray, np.ndarray]:
    """Steps (N,) and the share of episodes that succeeded (N,) in the rollout before each."""
    if not (run / "tensorboard").is_dir():
        raise UserError(f"{run}: no run folder of train_rl.py, which holds `tensorboard`")
    events = EventAccumulator(str(run / "tensorboard"), {"scalars": 0})
    events.Reload()
    if "training/success_share" not in events.Tags()["scalars"]:
        raise UserError(
            f"{run}: no training/success_share in its TensorBoard events; give a run's folder"
        )
    points = events.Scalars("training/success_share")
    return np.array([p.step for p in points]), np.array([p.value for p in points])


def evaluations(run: Path) -> list[tuple[int, float]]:
    """(step, success) of each, from results.json or, of a run under way, from TensorBoard."""
    file = run / "results.json"
    if file.is_file():
        history = json.loads(file.read_text())["history"]
        return [(row["step"], row["success"]) for row in history if "success" in row]
    events = EventAccumulator(str(run / "tensorboard"), {"scalars": 0})
    events.Reload()
    if "evaluation/success" not in events.Tags()["scalars"]:  # none yet
        return []
    return [(p.step, p.value) for p in events.Scalars("evaluation/success")]


def smoothed(steps: np.ndarray, values: np.ndarray, width: float) -> np.ndarray:
    """(N,) means of the values over the `width` steps up to each."""
    first = np.searchsorted(steps, steps - width, side="right")
    total = np.concatenate([[0.0], np.cumsum(values)])
    last = np.arange(1, len(steps) + 1)
    return (total[last] - total[first]) / (last - first)


if __name__ == "__main__":
    run_script(main)
