"""The cell's scenes in MuJoCo; skipped where MuJoCo, which is optional, is missing."""

import numpy as np
import pytest

pytest.importorskip("mujoco", reason='MuJoCo is optional: pip install "mujoco>=3.3,<4"')

from envs.camera import Intrinsics
from envs.cell_scenes import make_scene
from envs.mujoco_camera import camera_of
from envs.mujoco_cell import MujocoCell
from envs.objects import load_object_set
from utils.transforms import look_at


@pytest.fixture(scope="module")
def scene(config):
    objects = load_object_set("primitives", cache_dir=config.cache_folder)
    return make_scene("pile", objects, 1, config)


@pytest.fixture(scope="module")
def world(config, scene):
    with MujocoCell(config) as cell:
        cell.build(scene)
        yield cell


def test_objects_are_the_same_bodies(world, scene):
    for i, placed in enumerate(scene.placements):
        body = world.robot.model.body(f"object{i}")
        assert body.mass[0] == pytest.approx(placed.model.mass)
        np.testing.assert_allclose(np.sort(body.inertia), np.sort(placed.model.inertia), rtol=1e-6)
        np.testing.assert_allclose(world.object_pose(i)[:3, 3], placed.position, atol=1e-9)


def test_shapes_lie_where_pybullet_has_them(world, scene):
    """MuJoCo moves meshes to their own centres; their vertices in W must not notice."""
    for i, placed in enumerate(scene.placements):
        T, body = world.object_pose(i), world.robot.model.body(f"object{i}")
        for k, part in enumerate(placed.model.parts):
            geom = body.geomadr[0] + k
            mesh = world.robot.model.mesh(f"object{i}_{k}")
            begin, count = mesh.vertadr[0], mesh.vertnum[0]
            vertices = world.robot.model.mesh_vert[begin : begin + count]
            R = world.robot.data.geom_xmat[geom].reshape(3, 3)
            seen = vertices @ R.T + world.robot.data.geom_xpos[geom]
            expected = part @ T[:3, :3].T + T[:3, 3]
            for bound in (np.min, np.max):
                np.testing.assert_allclose(bound(seen, 0), bound(expected, 0), atol=1e-5)


def test_what_rests_in_pybullet_rests_here(world, scene):
    """The two worlds' contacts differ by tenths of a millimetre; nothing may fall or fly."""
    world.step(round(1.0 / world.dt))
    for i, placed in enumerate(scene.placements):
        moved = np.linalg.norm(world.object_pose(i)[:3, 3] - placed.position)
        assert moved < 0.02, f"object {i} moved {1000 * moved:.1f} mm"


def test_a_box_slides_on_a_tilt_steeper_than_its_friction(config, box_set):
    """mu = 0.5: gravity tilted by 20 degrees (tangent 0.36) holds it, by 35 (0.70) does not."""
    world = MujocoCell(config)
    world.build(make_scene("isolated", box_set, 0, config))
    start = world.object_pose(0)[:3, 3]
    moved = {}
    for degrees in (20, 35):
        world.robot.model.opt.gravity[:] = (
            9.81 * np.sin(np.radians(degrees)), 0, -9.81 * np.cos(np.radians(degrees)),
        )  # fmt: skip
        world.step(round(0.3 / world.dt))
        moved[degrees] = np.linalg.norm(world.object_pose(0)[:3, 3] - start)
    assert moved[20] < 0.005 < 0.03 < moved[35]


def test_camera_looks_the_same_way():
    """A camera above the table, x of W up in its image: right is -y, backwards is up."""
    T_WC = look_at((0.5, 0, 0.8), (0.5, 0, 0), (1, 0, 0))
    camera = camera_of(Intrinsics(64, 64, 28.0), T_WC)
    np.testing.assert_allclose(
        camera["mat"], np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]).T, atol=1e-12
    )
    np.testing.assert_allclose(camera["pos"], [0.5, 0, 0.8])
    assert camera["fovy"] == 28.0
