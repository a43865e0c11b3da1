"""Layouts of observations; running statistics against NumPy and Stable-Baselines3."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from gymnasium import spaces

from models.ppo_observations import (
    LARGEST,
    ObservationLayout,
    ObservationNormaliser,
    RewardScaler,
)
from utils.errors import UserError

GAMMA = 0.9


SPACE = spaces.Dict({
    "rgb": spaces.Box(0, 255, (4, 4, 3), np.uint8),
    "depth": spaces.Box(0.0, 2.0, (4, 4, 1), np.float32),
    "joints": spaces.Box(-1.0, 1.0, (2, 3), np.float64),
    "gripper": spaces.Box(0.0, 1.0, (), np.float32),
    "object": spaces.Box(-1.0, 1.0, (3,), np.float32),
})  # fmt: skip


def test_a_layout_sorts_observations():
    layout = ObservationLayout.of(SPACE, ["depth", "rgb", "joints", "gripper"], ["object"])
    assert (layout.image_channels, layout.state_dim, layout.privileged_dim) == (4, 7, 3)
    SPACE.seed(0)
    samples = [SPACE.sample() for _ in range(5)]
    batch = {key: np.stack([sample[key] for sample in samples]) for key in SPACE}
    room = layout.empty(5)
    layout.write(batch, room)
    image = room.image()
    assert image.shape == (5, 4, 4, 4) and room.images[1].dtype == torch.uint8
    np.testing.assert_allclose(image[:, 0], batch["depth"][..., 0])
    np.testing.assert_allclose(image[:, 1:].movedim(1, -1), batch["rgb"] / 255, atol=1e-6)
    expected = np.concatenate([batch["joints"].reshape(5, 6), batch["gripper"][:, None]], 1)
    np.testing.assert_allclose(room.state, expected, atol=1e-6)
    np.testing.assert_allclose(room.privileged, batch["object"])
    assert ObservationLayout.from_plain(layout.to_plain()) == layout


def test_a_layout_of_everything():
    assert ObservationLayout.of(SPACE, None, ["object"]).state_dim == 7
    assert ObservationLayout.of(spaces.Box(-1, 1, (5,))).state_dim == 5


@pytest.mark.parametrize(
    ("space", "arguments", "message"),
    [
        (SPACE, (["rbg"],), "policy_observations: got 'rbg'.*did you mean rgb"),
        (SPACE, (["rgb"], ["objct"]), "privileged_observations.*did you mean object"),
        (SPACE, (["rgb", "object"], ["object"]), "sees 'object' already"),
        (spaces.Discrete(3), (), "expected a Box"),
        (spaces.Dict({"a": spaces.Dict({"b": spaces.Box(0, 1)})}), (), "'a'.*expected a Box"),
        (spaces.Dict({"a": spaces.Box(0, 1, (4, 4, 1)), "b": spaces.Box(0, 1, (4, 5, 1))}), (),
         "same height and width"),
        (spaces.Dict({"a": spaces.Box(0, 1)}), (None, ["a"]), "see nothing"),
    ],
)  # fmt: skip
def test_observations_that_cannot_be_seen(space, arguments, message):
    with pytest.raises(UserError, match=message):
        ObservationLayout.of(space, *arguments)


def test_the_normaliser_is_numpy_over_everything_seen():
    rng = np.random.default_rng(3)
    batches = [rng.normal([5, -100, 1e4], [2, 0.1, 30], (n, 3)) for n in (7, 1, 200)]
    normaliser = ObservationNormaliser(3)
    plain = torch.tensor([[1.0, 2.0, 3.0]])
    torch.testing.assert_close(normaliser(plain), plain)
    for batch in batches:
        normaliser.update(torch.from_numpy(batch))
    everything = np.concatenate(batches)
    np.testing.assert_allclose(normaliser.mean, everything.mean(0))
    np.testing.assert_allclose(normaliser.variance, everything.var(0))
    assert normaliser.count.item() == 208
    expected = (everything - everything.mean(0)) / everything.std(0)
    found = normaliser(torch.from_numpy(everything)).numpy()
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    assert normaliser(torch.tensor([[1e9, -1e9, 0.0]])).abs().max() == LARGEST


def test_rewards_are_scaled_as_by_stable_baselines3():
    """Its VecNormalize takes in the returns step by step; after a rollout both know the same."""
    from stable_baselines3.common.running_mean_std import RunningMeanStd

    rng = np.random.default_rng(4)
    rewards, ended = rng.normal(3, 2, (60, 4)), rng.random((60, 4)) < 0.1
    theirs, returns = RunningMeanStd(shape=(), epsilon=0), np.zeros(4)
    for reward, end in zip(rewards, ended):
        returns = returns * GAMMA + reward
        theirs.update(returns)
        returns[end] = 0
    scaler = RewardScaler(GAMMA)
    scaler.scale(rewards[:30], ended[:30])
    scaled = scaler.scale(rewards[30:], ended[30:])  # goes on with the episodes under way
    np.testing.assert_allclose(scaler.moments.variance, theirs.var)
    np.testing.assert_allclose(scaled, rewards[30:] / np.sqrt(theirs.var), rtol=1e-6)


def test_rewards_end_at_ten_deviations():
    """As VecNormalize of Stable-Baselines3 clips them: a spike in 1,000 is some 30 deviations."""
    rewards = np.ones((1001, 1))
    rewards[-1] = 1e6
    scaled = RewardScaler(0.0).scale(rewards, np.ones_like(rewards, bool))
    assert scaled.max() == 10.0 and RewardScaler(0.0).scale(-rewards, rewards > 0).min() == -10.0
    assert scaled[0, 0] == pytest.approx(1 / rewards.std(), rel=1e-3)
