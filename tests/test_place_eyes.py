"""Eyes that look for a place in the hand's camera image."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from models.grasp_policy import GraspPolicyNetwork
from models.observations import ObservationLayout, Part
from models.place_eyes import PlaceEyes
from models.ranks import ALONE
from train_rl import camera_of
from utils.config import load_config
from utils.errors import UserError

SIDE, FOCAL = 32, 25.0
# Right in the image is the hand's y, down is its -x; the camera sits 7 cm along x.
CAMERA = {
    "K": [[FOCAL, 0.0, (SIDE - 1) / 2], [0.0, FOCAL, (SIDE - 1) / 2], [0.0, 0.0, 1.0]],
    "T_EC": [[0.0, -1.0, 0.0, 0.07], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, -0.1], [0, 0, 0, 1.0]],
}


def test_where_pixels_lie_from_the_hand():
    depth = torch.full((1, SIDE, SIDE), 0.5)
    depth[0, 3, 20] = 0.25
    x, y = PlaceEyes(5, 3, 4, CAMERA).places(depth)[0]
    assert x[10, 4].item() == pytest.approx(0.07 - 0.5 * (10 - 15.5) / FOCAL)
    assert y[10, 4].item() == pytest.approx(0.5 * (4 - 15.5) / FOCAL)
    assert x[3, 20].item() == pytest.approx(0.07 - 0.25 * (3 - 15.5) / FOCAL)
    assert y[3, 20].item() == pytest.approx(0.25 * (20 - 15.5) / FOCAL)


def scenes(count: int, random: np.random.Generator) -> tuple[torch.Tensor, ...]:
    """Images (N, 4, H, W) of two equal posts on a table, and (N, 3): the place of either of them,
    by chance, and how high it is."""
    images = np.full((count, 4, SIDE, SIDE), 0.5, np.float32)
    truth = np.empty((count, 2, 3), np.float32)
    for number in range(count):
        height = random.uniform(0.02, 0.08)
        for post, (low, high) in enumerate(((3, 9), (20, 26))):
            row, column = random.integers(3, 26), random.integers(low, high)
            images[number, 3, row : row + 3, column : column + 3] = 0.5 - height
            v, u = row + 1 - (SIDE - 1) / 2, column + 1 - (SIDE - 1) / 2
            depth = 0.5 - height
            truth[number, post] = 0.07 - depth * v / FOCAL, depth * u / FOCAL, height
    return torch.from_numpy(images), torch.from_numpy(truth)


def test_they_choose_where_a_mean_would_be_wrong():
    random = np.random.default_rng(0)
    torch.manual_seed(0)
    network = GraspPolicyNetwork(
        state_dim=1, action_dim=2, hidden_dim=8, estimated_dim=3, privileged_dim=3, relief=True,
        camera=CAMERA,
    )  # fmt: skip
    images, posts = scenes(1024, random)
    either = posts[torch.arange(1024), torch.from_numpy(random.integers(2, size=1024))]
    network.privileged_norm.update(either, ALONE)
    network.image_norm.update(images[:64].movedim(1, -1).flatten(0, 2), ALONE)
    optimizer = torch.optim.Adam(network.eyes(), 2e-3)
    state = torch.zeros(64, 1)
    for _ in range(12):
        for rows in torch.randperm(1024).split(64):
            optimizer.zero_grad()
            network.estimate_loss(images[rows], state, either[rows]).backward()
            optimizer.step()
    fresh, places = scenes(256, random)
    with torch.no_grad():
        told = network.estimate(fresh, torch.zeros(256, 1))
    norm = network.privileged_norm
    told = told * norm.variance.sqrt().float() + norm.mean.float()
    errors = (told[:, None, :2] - places[..., :2]).norm(dim=2)
    nearer = errors.min(dim=1).values
    assert nearer.quantile(0.9) < 0.04, "m, two pixels; the posts are 0.2 to 0.4 m apart"
    assert (told[:, 2] - places[:, 0, 2]).abs().median() < 0.01


IMAGES = [Part("rgb", (32, 32, 3), "uint8"), Part("depth", (32, 32, 1), "float32")]
PLACE = ["rl.estimate_place=true", "rl.estimated_observations=grasp_goal"]


def test_the_camera_is_the_hand_s():
    config = load_config(
        None, [*PLACE, "env.camera=wrist", "env.resolution=32", "camera.wrist_fov_deg=90"]
    )
    camera = camera_of(config, ObservationLayout(tuple(IMAGES), (), ()))
    assert camera["K"][0] == pytest.approx([16.0, 0.0, 15.5])
    assert [row[3] for row in camera["T_EC"]] == [*config.camera.wrist_position, 1.0]


@pytest.mark.parametrize(
    "settings, images, told",
    [
        (["env.camera=overhead"], IMAGES, "set env.camera=wrist"),
        (["rl.env_id=Pendulum-v1"], IMAGES, "wrist camera"),
        (["env.camera=wrist"], IMAGES[:1], "name it last"),
        (["env.camera=wrist"], IMAGES[::-1], "name it last"),
    ],
)
def test_other_cameras_and_images_are_refused(settings, images, told):
    with pytest.raises(UserError, match=told):
        camera_of(load_config(None, [*PLACE, *settings]), ObservationLayout(tuple(images), (), ()))


def test_eyes_without_anything_to_estimate_are_refused():
    for setting in ("rl.looks=64", "rl.estimate_place=true"):
        with pytest.raises(UserError, match="need estimated_observations"):
            load_config(None, [setting])
