"""Shapes whose geometry is known by hand."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
from trimesh.convex import convex_hull

from envs.cell_layout import Placement, Scene
from envs.object_bodies import compound_object
from envs.object_primitives import Primitive


def cube_corners() -> tuple[np.ndarray]:
    """The one convex part of a cube of 6 cm."""
    return (np.array(list(itertools.product([-0.03, 0.03], repeat=3))),)


def wedge(lean: float, mass: float, friction: float, folder: Path) -> Scene:
    """A solid of so many kg, 6 cm long and high and 7 cm wide at its foot, alone on the table: two
    of its walls lean towards each other, each by `lean` degrees. folder: for its files."""
    foot, height = 0.035, 0.06
    top = foot - height * np.tan(np.radians(lean))
    corners = np.array([
        [x, y, z] for x in (-0.03, 0.03)
        for y, z in ((-foot, 0.0), (foot, 0.0), (-top, height), (top, height))
    ])  # fmt: skip
    density = mass / convex_hull(corners).volume
    shape = Primitive("wedge", None, (corners,), density, friction, (0.5, 0.5, 0.5, 1.0))
    model = compound_object(shape, folder)
    place = np.array([0.5, 0.0, -model.parts[0][:, 2].min()])
    return Scene("isolated", 0, (Placement(model, place, np.eye(4)[3]),))
