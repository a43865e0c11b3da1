"""Images of both simulators show the same scene; skipped where MuJoCo is missing."""

import subprocess
import sys

import numpy as np
import pytest
from scipy import ndimage

from envs.cell import ROBOT, TABLE_OR_BACKGROUND, Intrinsics
from envs.mujoco_camera import MujocoCamera, add_view, camera_of
from utils.runs import REPOSITORY
from utils.transforms import look_at


def away_from_edges(depth: np.ndarray) -> np.ndarray:
    """Pixels with nothing but a plane around them: on it, one over the depth is linear."""
    inverse = np.divide(1, depth, where=depth > 0, out=np.zeros_like(depth))
    bend = np.abs(ndimage.laplace(inverse))
    return ndimage.maximum_filter(bend, 3) < 0.005  # a step of 3 mm at 0.8 m


@pytest.mark.parametrize("mount", ["overhead", "wrist", "oblique"])
def test_both_simulators_look_the_same(cells, pile, mount):
    """The same pixel is the same point of the same body, from every side: intrinsics, poses, depth
    and segmentation agree."""
    for cell in cells:
        cell.build(pile)
    intrinsics = Intrinsics(280, 200, 40.0, near=0.1, far=2.0)
    T_WC = (
        look_at((1.1, -0.5, 0.6), (0.45, 0.0, 0.1))
        if mount == "oblique"
        else cells[0].camera_pose(mount)
    )
    bullet, mujoco = (cell.look(intrinsics, T_WC) for cell in cells)
    inside = away_from_edges(bullet.depth) & away_from_edges(mujoco.depth)
    assert inside.mean() > 0.85
    assert np.abs(bullet.depth - mujoco.depth)[inside].max() < 0.002
    same = bullet.segmentation == mujoco.segmentation
    assert same[inside].mean() > 0.999 and same.mean() > 0.985
    assert set(np.unique(mujoco.segmentation)) >= {TABLE_OR_BACKGROUND, 0, 1, 2, 3, 4}
    if mount == "oblique":
        assert ROBOT in mujoco.segmentation
    np.testing.assert_array_equal(bullet.K, mujoco.K)


def test_colours_are_the_objects_own(cells, pile):
    """Another renderer, but the same colours and light: hues agree where the same body is seen."""
    for cell in cells:
        cell.build(pile)
    bullet, mujoco = (cell.frame() for cell in cells)
    for number in range(len(pile.placements)):
        both = (bullet.segmentation == number) & (mujoco.segmentation == number)
        a, b = (frame.rgb[both].mean(axis=0) for frame in (bullet, mujoco))
        assert a @ b / np.linalg.norm(a) / np.linalg.norm(b) > 0.99
        assert 0.7 < a.sum() / b.sum() < 1.4


def test_ambient_light_reaches_into_shadows(cells, pile):
    """The hand's shadow on the table has the ambient share of the light, 0.5, as films have it."""
    mujoco = cells[1]
    mujoco.build(pile)
    intrinsics, T_WC = (
        Intrinsics(240, 184, 45.0, 0.05, 5.0),
        look_at((1.1, -0.5, 0.6), (0.4, 0, 0.1)),
    )
    light = {"lightDirection": (0, 0, 1), "lightAmbientCoeff": 0.5, "lightDiffuseCoeff": 0.45}
    lit, shaded = (mujoco.look(intrinsics, T_WC, light=light | {"shadow": on}) for on in (0, 1))
    on_table = (lit.segmentation == TABLE_OR_BACKGROUND) & (lit.depth > 0)
    share = shaded.rgb[on_table].mean(axis=1) / lit.rgb[on_table].mean(axis=1)
    assert share.max() == pytest.approx(1.0, abs=0.02)
    assert share.min() == pytest.approx(0.5 / 0.95, abs=0.02)


def test_camera_looks_the_same_way():
    """A camera above the table, x of W up in its image: right is -y, backwards is up."""
    T_WC = look_at((0.5, 0, 0.8), (0.5, 0, 0), (1, 0, 0))
    camera = camera_of(Intrinsics(64, 64, 28.0), T_WC)
    np.testing.assert_allclose(
        camera["mat"], np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]).T, atol=1e-12
    )
    np.testing.assert_allclose(camera["pos"], [0.5, 0, 0.8])
    assert camera["fovy"] == 28.0


def test_table_depth_is_exact(cells, pile):
    """The overhead camera looks straight down on the table from 0.8 m."""
    mujoco = cells[1]
    mujoco.build(pile)
    frame = mujoco.frame()
    table = frame.depth[frame.segmentation == TABLE_OR_BACKGROUND]
    np.testing.assert_allclose(table, 0.8, atol=1e-4)


def test_pictures_of_several_sizes(cells, pile):
    mujoco = cells[1]
    mujoco.build(pile)
    for width, height in ((64, 48), (900, 700), (64, 48)):
        image = mujoco.image(Intrinsics(width, height, 28.0), mujoco.camera_pose("overhead"))
        assert image.rgb.shape == (height, width, 3) and image.depth.shape == (height, width)
        assert image.depth[0, 0] == pytest.approx(0.8, abs=1e-4)


def test_every_shape_of_a_large_scene_is_seen():
    mujoco = pytest.importorskip("mujoco")
    spec = mujoco.MjSpec()
    for x in range(2500):
        body = spec.worldbody.add_body(name=f"ball{x}", pos=[x, 0, 0])
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.1, 0, 0])
    add_view(spec)
    model = spec.compile()
    camera = MujocoCamera(model, mujoco.MjData(model))
    image = camera.render(Intrinsics(32, 32, 28.0), look_at((2499, 0, 1), (2499, 0, 0), (1, 0, 0)))
    camera.close()
    assert image.bodies[16, 16] == model.body("ball2499").id


TRAIN_AFTER_AN_IMAGE = """
import torch
from envs.cell import camera_intrinsics
from envs.cell_layout import EMPTY
from envs.simulators import make_cell
from utils.config import load_config

config = load_config(None, ["simulator=mujoco"])
with make_cell(config) as cell:
    cell.build(EMPTY)
    cell.image(camera_intrinsics(config.camera), cell.camera_pose())
parameter = torch.nn.Parameter(torch.ones(1))
optimiser = torch.optim.SGD([parameter], lr=0.5)
parameter.sum().backward()
optimiser.step()
print(parameter.item())
"""


@pytest.mark.slow
def test_a_network_is_trained_in_a_process_that_has_drawn():
    """Both load an LLVM of their own, which ended the process by a segmentation fault."""
    done = subprocess.run(
        [sys.executable, "-c", TRAIN_AFTER_AN_IMAGE], cwd=REPOSITORY, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert float(done.stdout.splitlines()[-1]) == 0.5
