"""What every benchmark reports, and fair timing: metrics with targets, as a table and as JSON.

This module knows nothing of what is measured.
"""

from __future__ import annotations

from argparse import ArgumentParser, ArgumentTypeError
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from utils.atomic_files import write_json_atomic
from utils.errors import UserError


@dataclass(frozen=True)
class Metric:
    """A figure and what it should be: at least `at_least`, at most `at_most`, or neither."""

    name: str
    value: float
    unit: str
    at_least: float | None = None
    at_most: float | None = None

    @property
    def target(self) -> str | None:
        if self.at_least is not None:
            return f">= {self.at_least:g}"
        return None if self.at_most is None else f"<= {self.at_most:g}"

    @property
    def holds(self) -> bool | None:
        """None where there is no target."""
        if self.at_least is not None:
            return self.value >= self.at_least
        return None if self.at_most is None else self.value <= self.at_most


def median_ratio(a: Callable[[], float], b: Callable[[], float], repeats: int) -> float:
    """Median of a() / b() over pairs of runs in alternating order, so that whatever else the
    machine is doing hits both alike. Each call does its work and returns a time or a rate."""
    a(), b()  # caches fill up
    ratios = []
    for i in range(repeats):
        if i % 2:
            second, first = b(), a()
        else:
            first, second = a(), b()
        ratios.append(first / second)
    return float(np.median(ratios))


def format_metrics(metrics: Sequence[Metric]) -> str:
    """Aligned text: metric, value, unit, target, holds."""
    holds = {True: "yes", False: "NO", None: "-"}
    rows = [("metric", "value", "unit", "target", "holds")]
    rows += [(m.name, f"{m.value:.3g}", m.unit, m.target or "-", holds[m.holds]) for m in metrics]
    widths = [max(len(row[i]) for row in rows) for i in range(5)]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths)).rstrip() for row in rows
    )


def report(metrics: Sequence[Metric], path: Path | None) -> None:
    """Print the table and, given a path, write {metric: {value, unit, target, holds}} there."""
    print(format_metrics(metrics))
    if path is not None:
        content = {
            m.name: {"value": m.value, "unit": m.unit, "target": m.target, "holds": m.holds}
            for m in metrics
        }
        write_json_atomic(path, content)


def positive_int(text: str) -> int:
    """The type of an argument that counts something."""
    try:
        value = int(text)
    except ValueError:
        value = 0
    if value < 1:
        raise ArgumentTypeError(f"got {text}, expected a whole number of at least 1")
    return value


def natural_number(text: str) -> int:
    """The type of an argument such as a seed."""
    return 0 if text == "0" else positive_int(text)


def check_installed(*modules: str) -> None:
    """Raise UserError where a peer, or what a benchmark needs besides the project, is missing."""
    for module in modules:
        if find_spec(module) is None:
            raise UserError(f"{module} is not installed; pip install -r requirements-dev.txt")


def benchmark_parser(description: str) -> ArgumentParser:
    """The options that every benchmark takes."""
    parser = ArgumentParser(description=description)
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the metrics there")
    parser.add_argument("--quick", action="store_true", help="fewer repeats, to see that it runs")
    return parser
