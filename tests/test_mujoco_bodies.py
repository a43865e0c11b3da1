"""A scene's bodies in MuJoCo beside PyBullet's; skipped where MuJoCo is missing."""

import numpy as np
import pytest

pytest.importorskip("mujoco", reason='MuJoCo is optional: pip install "mujoco>=3.3,<4"')

from envs.cell_scenes import make_scene
from envs.mujoco_cell import MujocoCell
from envs.objects import load_object_set


@pytest.fixture(scope="module")
def scene(config):
    objects = load_object_set("primitives", cache_dir=config.cache_folder)
    return make_scene("pile", objects, 1, config)


@pytest.fixture(scope="module")
def cell(config, scene):
    with MujocoCell(config) as cell:
        cell.build(scene)
        yield cell


def test_objects_are_the_same_bodies(cell, scene):
    for i, placed in enumerate(scene.placements):
        body = cell.robot.model.body(f"object{i}")
        assert body.mass[0] == pytest.approx(placed.model.mass)
        np.testing.assert_allclose(np.sort(body.inertia), np.sort(placed.model.inertia), rtol=1e-6)
        np.testing.assert_allclose(cell.object_pose(i)[:3, 3], placed.position, atol=1e-9)


def test_shapes_lie_where_pybullet_has_them(cell, scene):
    """MuJoCo moves meshes to their own centres; their vertices in W must not notice."""
    for i, placed in enumerate(scene.placements):
        T, body = cell.object_pose(i), cell.robot.model.body(f"object{i}")
        for k, part in enumerate(placed.model.parts):
            geom = body.geomadr[0] + k
            mesh = cell.robot.model.mesh(f"object{i}_{k}")
            begin, count = mesh.vertadr[0], mesh.vertnum[0]
            vertices = cell.robot.model.mesh_vert[begin : begin + count]
            R = cell.robot.data.geom_xmat[geom].reshape(3, 3)
            seen = vertices @ R.T + cell.robot.data.geom_xpos[geom]
            expected = part @ T[:3, :3].T + T[:3, 3]
            for bound in (np.min, np.max):
                np.testing.assert_allclose(bound(seen, 0), bound(expected, 0), atol=1e-5)


def test_what_rests_in_pybullet_rests_here(cell, scene):
    """The two cells' contacts differ by tenths of a millimetre; nothing may fall or fly."""
    cell.step(round(1.0 / cell.dt))
    for i, placed in enumerate(scene.placements):
        moved = np.linalg.norm(cell.object_pose(i)[:3, 3] - placed.position)
        assert moved < 0.02, f"object {i} moved {1000 * moved:.1f} mm"


def test_a_box_slides_on_a_tilt_steeper_than_its_friction(config, box_set):
    """mu = 0.5: gravity tilted by 20 degrees (tangent 0.36) holds it, by 35 (0.70) does not."""
    cell = MujocoCell(config)
    cell.build(make_scene("isolated", box_set, 0, config))
    start = cell.object_pose(0)[:3, 3]
    moved = {}
    for degrees in (20, 35):
        cell.robot.model.opt.gravity[:] = (
            9.81 * np.sin(np.radians(degrees)), 0, -9.81 * np.cos(np.radians(degrees)),
        )  # fmt: skip
        cell.step(round(0.3 / cell.dt))
        moved[degrees] = np.linalg.norm(cell.object_pose(0)[:3, 3] - start)
    assert moved[20] < 0.005 < 0.03 < moved[35]
