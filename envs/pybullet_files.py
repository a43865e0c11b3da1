"""Files that come with PyBullet, in the package `pybullet_data`: objects and the Panda's meshes.

Reading the files needs no simulator.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path


def data_folder() -> Path | None:
    """The folder of `pybullet_data`, None where PyBullet is not installed."""
    found = importlib.util.find_spec("pybullet_data")
    return None if found is None else Path(found.origin).parent


def panda_meshes() -> dict[str, Path]:
    """Detailed meshes of the parts of `envs.panda_model`, as far as there are any: all of them have
    102,000 triangles."""
    folder = data_folder()
    if folder is None:
        return {}
    panda = folder / "franka_panda" / "meshes"
    visual = ("link1", "link2", "link3", "link4", "link5", "link6", "hand", "finger")
    meshes = {part: panda / "visual" / f"{part}.obj" for part in visual}
    # Base and flange are there in few triangles only.
    meshes |= {part: panda / "collision" / f"{part}.obj" for part in ("link0", "link7")}
    return {part: mesh for part, mesh in meshes.items() if mesh.exists()}
