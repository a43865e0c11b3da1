"""Cameras: intrinsics by hand, rendered pixels against the pinhole model."""

import shutil

import numpy as np
import pytest

pytest.importorskip("pybullet")

import pybullet

from envs.cell import Intrinsics
from envs.object_bodies import native_object
from envs.object_shapes import NativeShape
from envs.pybullet_bodies import spawn, static_box
from envs.pybullet_camera import PybulletCamera, _egl_plugin, load_renderer
from utils.errors import UserError
from utils.transforms import RGBDFrame, look_at, project

OVERHEAD = look_at([0.5, 0, 0.8], [0.5, 0, 0], up=(1, 0, 0))


@pytest.fixture
def client():
    client = pybullet.connect(pybullet.DIRECT)
    yield client
    pybullet.disconnect(physicsClientId=client)


def tiny(client) -> PybulletCamera:
    return PybulletCamera(client, pybullet.ER_TINY_RENDERER)


def test_intrinsics_by_hand():
    # 90 degrees vertically: the focal length is half the height.
    K = Intrinsics(320, 240, 90.0).K
    np.testing.assert_allclose(K, [[120, 0, 159.5], [0, 120, 119.5], [0, 0, 1]])


@pytest.mark.parametrize("side", [64, 224])
def test_pixels_lie_where_the_pinhole_says(client, side):
    rng = np.random.default_rng(0)
    intrinsics = Intrinsics(side, side, 32.0)
    offsets = []
    for _ in range(60):
        centre = rng.uniform([0.4, -0.1, 0.05], [0.6, 0.1, 0.08])
        plate = static_box(client, [*rng.uniform(0.01, 0.03, 2), 0.001], centre, (1, 0, 0, 1))
        image = tiny(client).render(intrinsics, OVERHEAD)
        v, u = np.nonzero(image.bodies == plate)
        expected, _ = project(centre + [0, 0, 0.001], intrinsics.K, OVERHEAD)
        offsets.append([u.mean(), v.mean()] - expected)
        pybullet.removeBody(plate, physicsClientId=client)
    # Without the half-pixel correction the means are +0.54 and -0.49 pixels.
    assert abs(np.mean(offsets, axis=0)).max() < 0.12


def test_depth_is_metric_and_deprojects_to_the_surface(client):
    box = static_box(client, [0.03, 0.05, 0.04], [0.52, -0.07, 0.04], (1, 0, 0, 1))
    table = static_box(client, [0.6, 0.6, 0.05], [0.5, 0, -0.05], (0.5, 0.5, 0.5, 1))
    intrinsics = Intrinsics(224, 224, 32.0)
    image = tiny(client).render(intrinsics, OVERHEAD)
    assert image.rgb.dtype == np.uint8 and image.depth.dtype == np.float32
    frame = RGBDFrame(image.rgb, image.depth, intrinsics.K, OVERHEAD)
    points = frame.points()
    np.testing.assert_allclose(points[image.bodies == table][:, 2], 0.0, atol=2e-4)
    top = points[(image.bodies == box) & (points[..., 2] > 0.079)]
    np.testing.assert_allclose(top[:, 2], 0.08, atol=2e-4)
    pixel = 0.72 / intrinsics.K[0, 0]  # metres a pixel at the top's distance
    np.testing.assert_allclose(top[:, :2].min(axis=0), [0.49, -0.12], atol=pixel)
    np.testing.assert_allclose(top[:, :2].max(axis=0), [0.55, -0.02], atol=pixel)
    assert tuple(image.rgb[image.bodies == box][0]) > (100, 0, 0)


@pytest.mark.parametrize(
    ("kind", "size"), [("sphere", (0.03,)), ("cylinder", (0.03, 0.08)), ("capsule", (0.016, 0.05))]
)
def test_round_objects_look_as_they_collide(client, kind, size):
    """Points that the camera sees lie on the surface in closed form. (Those of PyBullet's own
    drawings do not: up to 1.2 mm within the sphere, 1.1 mm over the cylinder, 4 mm within the
    caps of the capsule.)"""
    model = native_object("it", NativeShape(kind, size), 1000, 0.5, (1, 0, 0, 1))
    centre, side = np.array([0.5, 0, 0.1]), np.sqrt(0.5)
    body = spawn(client, model, centre, (0, side, 0, side))  # lying along x
    image = tiny(client).render(Intrinsics(400, 400, 12.0), OVERHEAD)
    frame = RGBDFrame(image.rgb, image.depth, Intrinsics(400, 400, 12.0).K, OVERHEAD)
    points = frame.points()[image.bodies == body] - centre
    half = size[-1] / 2 if kind != "sphere" else 0.0
    if kind == "cylinder":
        points = points[abs(points[:, 0]) < half - 0.001]
    points[:, 0] -= np.clip(points[:, 0], -half, half)
    away = np.linalg.norm(points, axis=1) - size[0]
    assert len(away) > 5000
    assert abs(np.percentile(away, [5, 50, 95])).max() < 2e-4


def test_nothing_in_view_has_no_depth(client):
    image = tiny(client).render(Intrinsics(32, 32, 60.0), OVERHEAD)
    assert (image.depth == 0).all() and (image.bodies == -1).all()


def test_shadow_does_not_stick(client):
    # PyBullet keeps the shadow flag from one call to the next unless it is passed every time.
    static_box(client, [0.6, 0.6, 0.05], [0.5, 0, -0.05], (0.5, 0.5, 0.5, 1))
    static_box(client, [0.03, 0.05, 0.1], [0.5, 0, 0.1], (1, 0, 0, 1))
    camera, view = tiny(client), (Intrinsics(64, 64, 32.0), OVERHEAD)
    before = camera.render(*view).rgb
    shadowed = camera.render(*view, {"shadow": 1}).rgb
    assert (shadowed != before).any()
    np.testing.assert_array_equal(camera.render(*view).rgb, before)


def test_renderer_choice(client, monkeypatch):
    assert load_renderer(client, "tiny") == pybullet.ER_TINY_RENDERER
    monkeypatch.setattr("envs.pybullet_camera._has_gpu", lambda: False)
    assert load_renderer(client, "auto") == pybullet.ER_TINY_RENDERER
    monkeypatch.setattr("envs.pybullet_camera._egl_plugin", lambda: None)
    with pytest.raises(UserError, match="sim.renderer=egl"):
        load_renderer(client, "egl")


def test_a_card_that_draws_nothing_leaves_the_software_renderer(client, monkeypatch):
    # Without EGL the plugin ends its process; the one that asks for it goes on.
    monkeypatch.setattr("envs.pybullet_camera._has_gpu", lambda: True)
    monkeypatch.setattr("sys.executable", shutil.which("false"))
    _egl_plugin.cache_clear()
    try:
        assert load_renderer(client, "auto") == pybullet.ER_TINY_RENDERER
    finally:
        _egl_plugin.cache_clear()
