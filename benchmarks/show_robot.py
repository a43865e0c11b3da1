"""The Panda's shapes beside the stock meshes: python -m benchmarks.show_robot

Prints for each part how far the tangent planes of our convex shape lie outside (+) or inside (-) of
those of the convex hull of pybullet_data's collision mesh, over directions spread evenly.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial import ConvexHull

from envs.panda_model import panda_links
from envs.pybullet_files import data_folder
from utils.errors import UserError
from utils.geometry import GripperGeometry
from utils.runs import run_script


def main(argv: Sequence[str] | None = None) -> None:
    argparse.ArgumentParser(description=__doc__.splitlines()[0]).parse_args(argv)
    D = directions(20000)
    stock = stock_hulls()
    print(f"{'part':8}{'vertices':>10}{'of stock':>10}{'outside':>10}{'inside':>10}{'rms':>8}  mm")
    shapes = {s.part: s.hull for link in panda_links(GripperGeometry()) for s in link.shapes}
    for part, hull in shapes.items():
        off = 1000 * (support(hull, D) - support(stock[part], D))
        print(
            f"{part:8}{len(hull):10}{len(stock[part]):10}{off.max():10.2f}{off.min():10.2f}"
            f"{np.sqrt((off**2).mean()):8.2f}"
        )


def directions(count: int, seed: int = 0) -> np.ndarray:
    """(count, 3) random unit vectors."""
    D = np.random.default_rng(seed).normal(size=(count, 3))
    return D / np.linalg.norm(D, axis=1, keepdims=True)


def support(points: np.ndarray, D: np.ndarray) -> np.ndarray:
    """(N,) how far points (V, 3) reach along unit vectors (N, 3): their hull's support function."""
    return (D @ points.T).max(axis=1)


def stock_hulls() -> dict[str, np.ndarray]:
    """Vertices (V, 3) of the convex hull of each part's collision mesh in pybullet_data, m. Raises
    UserError where that is not installed."""
    folder = data_folder()
    if folder is None:
        raise UserError("pybullet_data is not installed, so there is nothing to compare with")
    meshes = sorted((folder / "franka_panda" / "meshes" / "collision").glob("*.obj"))
    return {mesh.stem: _hull(mesh) for mesh in meshes}


def _hull(mesh: Path) -> np.ndarray:
    lines = mesh.read_text().splitlines()
    points = np.array([line.split()[1:4] for line in lines if line.startswith("v ")], dtype=float)
    return points[ConvexHull(points).vertices]


if __name__ == "__main__":
    run_script(main)
