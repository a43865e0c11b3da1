"""Object files of a box of 4 x 5 x 6 cm, whose mass and inertia are known by hand."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

SIDES = (0.04, 0.05, 0.06)


def urdf_box(
    folder: Path, mass: str, inertia: str, origin: str = "", sides: Sequence[float] = SIDES
) -> Path:
    """A URDF of the box, about the origin, that states an inertial; without <inertia> where
    `inertia` is empty. sides: as the file states them."""
    path, size = folder / "box.urdf", " ".join(map(str, sides))
    inertia = inertia and f"<inertia {inertia}/>"
    path.write_text(
        f"""<robot name="box"><link name="a"><inertial>{origin}<mass value="{mass}"/>
        {inertia}</inertial>
        <visual><geometry><box size="{size}"/></geometry></visual>
        <collision><geometry><box size="{size}"/></geometry></collision></link></robot>"""
    )
    return path


def box_moments(mass: float, factor: float = 1.0) -> np.ndarray:
    """(3,) kg m2, those of the box of even density, times a factor."""
    a, b, c = np.square(SIDES)
    return factor * mass / 12 * np.array([b + c, a + c, a + b])


def urdf_inertia(moments) -> str:
    """The attributes of <inertia>."""
    return " ".join(f'{name}="{value}"' for name, value in zip(("ixx", "iyy", "izz"), moments))
