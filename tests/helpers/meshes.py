"""Meshes whose volume is known."""

import trimesh


def l_shape() -> trimesh.Trimesh:
    """One clean, concave surface of volume 5: a 3 x 3 x 1 slab without its upper right quarter of
    2 x 2."""
    slab = trimesh.creation.box(bounds=[[0, 0, 0], [3, 3, 1]])
    quarter = trimesh.creation.box(bounds=[[1, 1, -1], [4, 4, 2]])
    return trimesh.boolean.difference([slab, quarter], engine="manifold")
