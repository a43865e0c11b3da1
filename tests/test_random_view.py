"""Textures: plain data that survive JSON, on known points, and errors."""

import json

import cv2
import numpy as np
import pytest

from utils.errors import UserError
from utils.random_view import RandomView, TextureRandomizer


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pictures")
    halves = np.zeros((32, 64, 3), np.uint8)
    halves[:, 32:] = 200, 100, 50  # BGR
    cv2.imwrite(str(folder / "halves.png"), halves)
    return folder


def test_textures_come_back_from_json(pictures):
    randomizer, rng = TextureRandomizer(pictures), np.random.default_rng(1)
    points = rng.uniform(-0.1, 0.1, (500, 3))
    kinds = set()
    for _ in range(30):
        description = randomizer.draw(rng)
        kinds.add(description["kind"])
        factors = randomizer.make(description).factor(points)
        again = TextureRandomizer().make(json.loads(json.dumps(description))).factor(points)
        assert factors.shape == (500, 3) and (factors >= 0).all()
        np.testing.assert_array_equal(factors, again)
    assert kinds == {"grain", "picture", "waves"}


def test_grain_repeats_after_sixteen_points():
    texture = TextureRandomizer.make(
        {
            "kind": "grain", "seed": 0, "size": 0.01, "strength": [0.5, 0.5, 0.5],
        }
    )  # fmt: skip
    period = np.array([[0.003, 0.001, 0.002]])
    np.testing.assert_allclose(texture.factor(period), texture.factor(period + 0.16), atol=1e-12)


def test_picture_factors(pictures):
    texture = TextureRandomizer.make(
        {
            "kind": "picture", "file": str(pictures / "halves.png"), "size": 0.1,
            "axes": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], "offset": [0.0, 0.0],
        }
    )  # fmt: skip
    x = np.array([0.01, 0.04, 0.06, 0.09, 0.11, -0.01])
    seen = texture.factor(np.column_stack([x, 0 * x, x]))
    bright = np.array([50, 100, 200]) / (350 / 6)  # RGB; the picture's mean is 350 / 6
    expected = np.where((x % 0.1 > 0.05)[:, None], bright, 0)
    np.testing.assert_allclose(seen, expected)


def test_textures_stick_to_a_body_that_moves(pictures):
    """A plane 1 m in front of a camera of 100 pixels: 3 cm are 3 pixels, a quarter turn about the
    optical axis turns the picture."""
    texture = TextureRandomizer.make(
        {
            "kind": "picture", "file": str(pictures / "halves.png"), "size": 0.1,
            "axes": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], "offset": [0.0, 0.0],
        }
    )  # fmt: skip
    K = np.array([[100.0, 0, 20], [0, 100, 20], [0, 0, 1]])
    pose = np.eye(4)
    view = RandomView(lambda frame: {}, 0, 0, False, {7: texture}, lambda body: pose)
    grey, depth = np.full((41, 41, 3), 100, np.uint8), np.ones((41, 41), np.float32)
    bodies = np.full((41, 41), 7)
    bodies[:, :2] = 8  # another body, without a texture

    def seen() -> np.ndarray:
        view.begin_frame()
        return view.develop(grey, depth, bodies, K, np.eye(4))[0]

    # Half a pixel aside, so that no point lies on an edge of the picture.
    pose[:2, 3] = 0.005
    before = seen()
    assert (before[:, :2] == 100).all() and len(np.unique(before[:, 2:])) > 2
    pose[0, 3] += 0.03
    np.testing.assert_array_equal(seen()[:, 5:], before[:, 2:-3])
    pose[:2, :2], pose[:2, 3] = [[0, -1], [1, 0]], [-0.005, 0.005]
    np.testing.assert_array_equal(seen()[2:, 2:], before[2:, 2:].transpose(1, 0, 2))


def test_wrong_textures_are_refused(tmp_path):
    with pytest.raises(UserError, match="no such folder"):
        TextureRandomizer(tmp_path / "none")
    with pytest.raises(UserError, match="no picture"):
        TextureRandomizer(tmp_path)
    (tmp_path / "bad.png").write_bytes(b"no picture")
    with pytest.raises(UserError, match="bad.png: not a readable image"):
        TextureRandomizer(tmp_path)
    with pytest.raises(UserError, match="'marble' is unknown"):
        TextureRandomizer.make({"kind": "marble"})
