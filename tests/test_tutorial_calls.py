"""The tutorial's calls: those that run as printed, and those that end with one sentence instead."""

from __future__ import annotations

import re

import numpy as np
import pytest
import torch

from envs.grasping_env import RobotGraspingEnv
from models.grasp_policy import GraspPolicyNetwork, GraspPPO
from models.graspnet import GraspLoss, create_model
from utils.adaptation import DomainAdaptationNetwork, train_domain_adaptation
from utils.domain_randomization import DomainRandomizer, TextureRandomizer
from utils.runs import REPOSITORY
from utils.visual_servo import (
    HybridVisualServo,
    ImageBasedVisualServo,
    PositionBasedVisualServo,
)

CAMERA = {"intrinsics": np.array([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]])}
SEEN = [(300, 200), (340, 200), (340, 260), (300, 260)]
WANTED = [(310, 210), (350, 210), (350, 270), (310, 270)]
DEPTH = np.full((480, 640), 0.5)
TABLES = [REPOSITORY / "docs" / f"tutorial_names{language}.md" for language in ("", ".zh-CN")]


def test_the_graspnet_listing_runs_as_printed():
    model = create_model(input_channels=4, num_angle_bins=18)
    x = torch.randn(1, 4, 64, 48)
    quality, angle, width = model(x)
    assert quality.shape == width.shape == (1, 1, 64, 48) and angle.shape == (1, 18, 64, 48)
    assert 0 < width.min().item() <= width.max().item() < 0.15
    assert {"x", "y", "theta", "width"} <= model.predict_grasp(x).keys()
    assert GraspLoss(angle_weight=1.0, width_weight=0.5).width_weight == 0.5


def test_the_servo_listings_run_with_depths_and_poses():
    image_based = ImageBasedVisualServo(CAMERA, lambda_=0.5)
    assert image_based.compute_interaction_matrix((320, 240), 0.5).shape == (2, 6)
    assert image_based.compute_velocity(SEEN, WANTED, Z=0.5).shape == (6,)
    assert image_based.pixel_to_3d(320, 240, 0.5) == pytest.approx([0, 0, 0.5])
    position_based = PositionBasedVisualServo(CAMERA, lambda_=0.5)
    assert position_based.estimate_3d_position((320, 240), DEPTH) == pytest.approx([0, 0, 0.5])
    pose = np.eye(4)
    pose[2, 3] = 0.5
    assert position_based.compute_end_effector_velocity(pose, pose) == pytest.approx(np.zeros(6))
    hybrid = HybridVisualServo(CAMERA, lambda_=0.5, alpha=0.5)
    assert hybrid.compute_velocity(pose, SEEN, pose, SEEN, DEPTH) == pytest.approx(np.zeros(6))


def test_the_policy_and_the_adaptation_network_are_made_as_printed():
    policy = GraspPolicyNetwork(image_feature_dim=512, state_dim=14, action_dim=7, hidden_dim=256)
    image, state = torch.rand(2, 4, 32, 32), torch.rand(2, 14)
    assert policy(image, state).mean.shape == (2, 7)
    assert policy.features(image, state).shape == (2, 512 + 14)
    assert policy.value(image, state, torch.rand(2, 0)).shape == (2,)
    adapted = DomainAdaptationNetwork(feature_dim=256)(torch.rand(2, 3, 28, 28))
    assert [part.shape for part in adapted] == [(2, 10), (2,), (2, 256)]
    textures = TextureRandomizer()
    texture = textures.make(textures.draw(np.random.default_rng(0)))
    assert texture.factor(np.zeros((5, 3))).shape == (5, 3)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: RobotGraspingEnv(render=True, gui=True), "render_mode"),
        (lambda: GraspLoss()(*[torch.rand(1, 1, 8, 8)] * 7), "targets_from_labels"),
        (lambda: ImageBasedVisualServo(CAMERA).compute_velocity(SEEN, WANTED), "depths"),
        (lambda: ImageBasedVisualServo(CAMERA).compute_velocity([SEEN[0]], [WANTED[0]], 1), "3"),
        (
            lambda: ImageBasedVisualServo(CAMERA).compute_joint_velocities(
                (0.4, 0, 0.3, 0, 0, 0), np.ones(6), np.ones((6, 7))
            ),
            r"\(4, 4\)",
        ),
        (
            lambda: PositionBasedVisualServo(CAMERA).compute_end_effector_velocity(
                np.zeros(3), np.ones(3)
            ),
            r"\(4, 4\)",
        ),
        (lambda: GraspPPO(512, 14, 7), "make_ppo"),
        (
            lambda: GraspPolicyNetwork(512, 14, 7)(torch.rand(1, 3, 32, 32), torch.rand(1, 14)),
            "3 channels, the network has 4",
        ),
        (lambda: DomainAdaptationNetwork()(torch.rand(2, 3, 32, 32), 0.5), "reversal"),
        (lambda: DomainAdaptationNetwork()(torch.rand(2, 3, 32, 32), 1.0), "reversal"),
        (
            lambda: train_domain_adaptation(
                torch.rand(2, 3, 8, 8), torch.rand(2, 3, 8, 8), DomainAdaptationNetwork()
            ),
            r"\(images, labels\)",
        ),
        (
            lambda: train_domain_adaptation(
                (torch.rand(2, 3, 8, 8), torch.zeros(2)),
                torch.rand(2, 3, 8, 8),
                DomainAdaptationNetwork(),
                100,
            ),
            r"AdaptationSettings\(steps=",
        ),
        (lambda: DomainRandomizer(0), "expected a cell"),
    ],
)
def test_a_call_that_cannot_be_accepted_ends_with_one_sentence(call, message):
    with pytest.raises((ValueError, TypeError), match=message) as caught:
        call()
    sentence = str(caught.value)
    assert "\n" not in sentence and len(sentence) < 400


def test_weights_of_the_loss_without_names_are_no_others():
    """The tutorial's first one is the angle's, this loss's own is the quality's."""
    with pytest.raises(TypeError, match="positional argument"):
        GraspLoss(1.0, 0.5)


@pytest.mark.parametrize("table", TABLES, ids=lambda table: table.name)
def test_the_table_names_only_what_is_there(table):
    """Dotted names of modules in the table's second column can be found, and what is called there,
    or in the first column of a row that says "same", is defined in one of the modules."""
    text = table.read_text(encoding="utf-8")
    dotted = re.findall(r"`((?:models|utils|envs)\.\w+)\.(\w+)", text)
    assert len(dotted) == 2
    for module, name in dotted:
        assert hasattr(__import__(module, fromlist=[name]), name), f"{module}.{name}"
    called = set()
    for row in re.findall(r"^\| (.*) \|$", text, re.MULTILINE):
        tutorial, here, *_ = row.split(" | ")
        told = tutorial + here if here.startswith(("same", "相同")) else here
        for code in re.findall(r"`([^`]+)`", told):
            called |= set(re.findall(r"(\w+)\(", code))
    called -= {"model", "policy"}  # variables of the table
    defined = {
        name
        for folder in ("envs", "models", "utils")
        for file in (REPOSITORY / folder).glob("*.py")
        for name in re.findall(
            r"^ *(?:class|def) (\w+)", file.read_text(encoding="utf-8"), re.MULTILINE
        )
    }
    assert len(called) > 20 and called - defined == set()
