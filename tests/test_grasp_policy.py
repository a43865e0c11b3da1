"""GraspPolicyNetwork against PyTorch's distributions and hand computations; policies from files."""

from __future__ import annotations

import math
import warnings

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from torch.distributions import Independent, Normal, TanhTransform, TransformedDistribution

import tests.helpers.quick_envs  # noqa: F401, registers its environments
from models.grasp_policy import (
    ActionDistribution,
    GraspPolicyNetwork,
    load_policy,
    make_ppo,
    policy_for,
    relief_of,
    save_policy,
)
from models.ppo_actor import Actor
from models.ppo_observations import (
    ObservationLayout,
)
from tests.helpers.ppo_parts import (
    ppo_of,
    settings_of,
)
from utils.config import load_config
from utils.distributed import ALONE
from utils.errors import UserError


def distribution(squashed: bool) -> ActionDistribution:
    rng = torch.Generator().manual_seed(1)
    return ActionDistribution(
        torch.randn(5, 3, generator=rng), torch.tensor([-1.0, 0.2, 0.5]), squashed
    )


def test_log_probability_and_entropy_of_a_gaussian():
    ours = distribution(False)
    theirs = Independent(Normal(ours.mean, ours.log_std.exp()), 1)
    latent = ours.sample(torch.randn(5, 3))
    torch.testing.assert_close(ours.log_prob(latent), theirs.log_prob(latent))
    torch.testing.assert_close(ours.entropy().expand(5), theirs.entropy())


def test_log_probability_of_a_squashed_gaussian():
    ours = distribution(True)
    theirs = TransformedDistribution(
        Independent(Normal(ours.mean.double(), ours.log_std.double().exp()), 1), TanhTransform()
    )
    latent = ours.sample(torch.randn(5, 3))
    torch.testing.assert_close(
        ours.log_prob(latent).double(),
        theirs.log_prob(latent.double().tanh()),
        rtol=1e-4,
        atol=1e-4,
    )
    far = torch.full((5, 3), 40.0)  # tanh(40) is 1 to the last bit, its logarithm must not be inf
    assert torch.isfinite(ours.log_prob(far)).all()


def test_a_squashed_density_integrates_to_one_and_its_entropy_is_right():
    one = ActionDistribution(torch.tensor([[0.7]]), torch.tensor([-0.3]), True)
    edges = torch.linspace(-1 + 1e-6, 1 - 1e-6, 200_001, dtype=torch.float64)
    log_density = one.log_prob(edges.atanh().float()[:, None]).double()
    density = log_density.exp()
    assert torch.trapezoid(density, edges).item() == pytest.approx(1, abs=1e-3)
    entropy = -torch.trapezoid(density * log_density, edges).item()
    noise = torch.randn(200_000, 1, generator=torch.Generator().manual_seed(0))
    estimates = one.entropy(noise)
    assert estimates.shape == (200_000,)
    error = estimates.std().item() / math.sqrt(len(estimates))
    assert estimates.mean().item() == pytest.approx(entropy, abs=4 * error)


def test_the_network_of_the_tutorial():
    network = GraspPolicyNetwork(image_feature_dim=512, state_dim=14, action_dim=7, hidden_dim=256)
    image, state = torch.rand(2, 4, 224, 224), torch.randn(2, 14)
    policy = network(image, state)
    assert policy.mean.shape == (2, 7) and policy.log_std.shape == (7,)
    assert network.value(image, state, torch.empty(2, 0)).shape == (2,)
    assert policy.mean.abs().max() < 0.5, "a new policy acts around 0"


def test_weights_start_orthogonal():
    network = GraspPolicyNetwork(state_dim=20, hidden_dim=20, image_channels=0, hidden_layers=1)
    weight = network.actor[0].weight.detach()
    torch.testing.assert_close(weight @ weight.T, 2 * torch.eye(20), atol=1e-5, rtol=0)
    head = network.mean_head.weight.detach()
    torch.testing.assert_close(head @ head.T, 1e-4 * torch.eye(7), atol=1e-8, rtol=0)
    assert network.value_head.weight.norm().item() == pytest.approx(1, abs=1e-5)


def test_only_the_critic_sees_what_is_privileged():
    network = GraspPolicyNetwork(8, 3, 2, 16, privileged_dim=2, conv_channels=[4, 4])
    image, state = torch.rand(1, 4, 16, 16), torch.randn(1, 3)
    features = network.features(image, state)
    here, there = torch.zeros(1, 2), torch.ones(1, 2)
    policy, value = network.policy_and_value_of(features, here)
    other_policy, other_value = network.policy_and_value_of(features, there)
    assert torch.equal(policy.mean, other_policy.mean) and not torch.equal(value, other_value)


def estimating() -> GraspPolicyNetwork:
    return GraspPolicyNetwork(8, 3, 2, 16, privileged_dim=3, conv_channels=[4, 4], estimated_dim=2)


def test_the_policy_goes_by_estimates_and_never_by_the_truth():
    network = estimating()
    image, state = torch.rand(5, 4, 16, 16), torch.randn(5, 3)
    network.privileged_norm.update(torch.randn(100, 3) * 4 + 7)
    features = network.features(image, state)
    policy, value = network.policy_and_value_of(features, torch.zeros(5, 3))
    other_policy, other_value = network.policy_and_value_of(features, torch.ones(5, 3))
    assert torch.equal(policy.mean, other_policy.mean) and not torch.equal(value, other_value)
    torch.testing.assert_close(features[:, :2], network.estimate(image, state))
    assert features.shape == (5, 2 + 3) and not features.requires_grad
    scaled = network.privileged_norm(torch.ones(5, 3))[:, :2]
    torch.testing.assert_close(network.truth(torch.ones(5, 3)), scaled)


def test_the_policy_s_loss_leaves_the_estimator_alone_and_its_loss_the_policy():
    network = estimating()
    image, state = torch.rand(5, 4, 16, 16), torch.randn(5, 3)
    estimator = {id(p) for p in network.estimator_parameters()}
    assert 0 < len(estimator) < len(list(network.parameters()))

    policy, value = network.policy_and_value_of(network.features(image, state), torch.zeros(5, 3))
    (policy.log_prob(torch.zeros(5, 2)).sum() + value.sum()).backward()
    assert all((p.grad is None) == (id(p) in estimator) for p in network.parameters())

    network.zero_grad()
    network.estimate(image, state).square().sum().backward()
    assert all((p.grad is not None) == (id(p) in estimator) for p in network.parameters())


@pytest.mark.parametrize("squash", [False, True])
def test_actions_keep_to_the_bounds(squash):
    space = spaces.Box(np.array([-1, 0], np.float32), np.array([3, 0.08], np.float32))
    layout = ObservationLayout.of(spaces.Box(-1, 1, (3,)))
    network = policy_for(layout, space, settings_of(f"rl.squash={squash}"))
    far = network.action(torch.tensor([[50.0, 50.0], [-50.0, -50.0]])).detach().numpy()
    np.testing.assert_allclose(far, [space.high, space.low], atol=1e-6)
    middle = network.action(torch.zeros(1, 2)).detach().numpy()
    np.testing.assert_allclose(middle, [[1, 0.04]] if squash else [[0, 0]], atol=1e-6)


@pytest.mark.parametrize(
    ("name", "overrides", "message"),
    [
        ("QuickDiscrete-v0", [], "Discrete.*Box of floats"),
        ("QuickUnbounded-v0", ["rl.squash=true"], "no bounds"),
    ],
)
def test_actions_that_cannot_be_learned(name, overrides, message):
    env = gymnasium.make(name).unwrapped
    layout = ObservationLayout.of(env.observation_space)
    with pytest.raises(UserError, match=message):
        policy_for(layout, env.action_space, settings_of(*overrides))


def test_actions_of_more_dimensions_are_no_vector():
    layout = ObservationLayout.of(spaces.Box(-1.0, 1.0, (2,), np.float32))
    with pytest.raises(UserError, match="Box of floats with one dimension"):
        policy_for(layout, spaces.Box(-1.0, 1.0, (2, 3), np.float32), settings_of())


@pytest.mark.parametrize(("side", "fits"), [(14, False), (15, True)])
def test_images_of_which_the_convolutions_leave_nothing(side, fits):
    """Three 3x3 convolutions with stride 2 make 15 pixels 7, 3 and 1."""
    image = spaces.Box(0, 255, (side, 40, 3), np.uint8)
    layout = ObservationLayout.of(spaces.Dict(rgb=image))
    actions, settings = spaces.Box(-1.0, 1.0, (2,)), settings_of("rl.conv_channels=[4,4,4]")
    if fits:
        network = policy_for(layout, actions, settings)
        seen = layout.read_one({"rgb": image.sample()})
        assert network.features(seen.image(), seen.state).shape == (1, 8)
    else:
        with pytest.raises(UserError, match=r"leave nothing of 'rgb', 40x14.*rl.conv_channels"):
            policy_for(layout, actions, settings)


@pytest.mark.parametrize("squash", [False, True])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_actions_lie_in_their_space_to_the_last_bit(dtype, squash):
    """0.1 in single precision is above 0.1, and squashed actions pass the bounds by rounding."""
    rng = np.random.default_rng(0)
    low, size = rng.uniform(-1, 1, 200), rng.uniform(0.01, 1, 200)
    space = spaces.Box(low.astype(dtype), (low + size).astype(dtype), dtype=dtype)
    layout = ObservationLayout.of(spaces.Box(-1.0, 1.0, (2,), np.float32))
    network = policy_for(layout, space, settings_of(f"rl.squash={squash}".lower()))
    for latent in (-20.0, 20.0):
        wanted = torch.full((1, 200), latent)
        by_network = network.action(wanted)[0].numpy()
        by_actor = Actor(network).action(wanted[0].numpy())
        assert space.contains(by_network) and space.contains(by_actor)
        np.testing.assert_allclose(by_network, space.low if latent < 0 else space.high, atol=1e-6)


def test_relief_is_how_far_pixels_stand_out():
    """3 cm over the table is 1, whatever the table's depth; more than 15 cm is cut off."""
    depth = torch.full((2, 1, 16, 16), 0.5)
    depth[1] = 0.2
    depth[:, :, 4:8, 4:8] -= 0.03
    depth[0, :, 12, 12] -= 0.4
    relief = relief_of(depth)
    torch.testing.assert_close(relief[:, :, 5, 5], torch.ones(2, 1))
    assert relief[0, 0, 0, 0] == 0 and relief[0, 0, 12, 12] == 5


def test_a_saved_policy_acts_the_same(tmp_path):
    env = gymnasium.make("QuickPoint-v0", images=True, disable_env_checker=True)
    layout = ObservationLayout.of(env.observation_space)
    ppo = ppo_of(layout=layout, actions=2)
    observation, _ = env.reset(seed=0)
    batch = layout.read_one(observation)
    ppo.network.observe(batch, ALONE)  # statistics have to come back too
    ppo.save(tmp_path / "policy.pt")
    policy = load_policy(tmp_path / "policy.pt")
    expected = ppo.network.action(ppo.network(batch.image(), batch.state).mean).detach().numpy()
    np.testing.assert_allclose(policy(observation), expected[0], rtol=1e-5)
    assert policy.network.state_norm.count.item() == 1

    with pytest.raises(UserError, match="needs 'depth', but the observation holds state"):
        policy({"state": observation["state"]})
    with pytest.raises(UserError, match=r"'state' has shape \(3,\), the policy needs \(2,\)"):
        policy(observation | {"state": np.zeros(3, np.float32)})


def test_a_policy_in_half_precision_acts_nearly_the_same(tmp_path):
    """Weights are rounded by 2^-11 of themselves at most."""
    env = gymnasium.make("QuickPoint-v0", images=True, disable_env_checker=True)
    ppo = ppo_of(layout=ObservationLayout.of(env.observation_space), actions=2)
    ppo.save(tmp_path / "whole.pt")
    whole = load_policy(tmp_path / "whole.pt")
    save_policy(tmp_path / "half.pt", whole)
    half = load_policy(tmp_path / "half.pt")
    actions = [
        (whole(observation), half(observation))
        for observation in (env.reset(seed=seed)[0] for seed in range(20))
    ]
    assert any((one != other).any() for one, other in actions)
    np.testing.assert_allclose(*np.swapaxes(actions, 0, 1), atol=0.01)


@pytest.mark.parametrize("high", [2.0, math.inf, math.nan])
def test_a_policy_of_actions_without_bounds_is_read_again(tmp_path, high):
    space = spaces.Box(-np.inf, np.inf, (2,), np.float32)
    config = load_config(None, ["rl.hidden_dim=16", "rl.squash=false"])
    ppo = make_ppo(spaces.Box(-1.0, 1.0, (3,)), space, config)
    ppo.network.action_high.fill_(high)
    ppo.save(tmp_path / "policy.pt")
    if math.isnan(high):
        with pytest.raises(UserError, match="not finite"):
            load_policy(tmp_path / "policy.pt")
    else:
        action = load_policy(tmp_path / "policy.pt").network.action(torch.full((1, 2), 50.0))
        assert (action == min(high, 50.0)).all()


SEEN = spaces.Dict({name: spaces.Box(-1, 1, (2,)) for name in ("place", "speed")})


@pytest.fixture
def continued(tmp_path):
    """A function that makes a PPO for spaces, with the weights of a policy that has seen SEEN and
    acted between -1 and 1; change: what is done to the checkpoint first."""
    small = ["rl.hidden_dim=16", "rl.squash=true", "rl.normalise_observations=true"]
    path = tmp_path / "policy.pt"
    act = spaces.Box(-1.0, 1.0, (2,), np.float32)
    make_ppo(SEEN, act, load_config(None, [*small, "seed=1"])).save(path)

    def make(observation_space, action_space, change=lambda stored: None):
        stored = torch.load(path, weights_only=True)
        change(stored)
        torch.save(stored, path)
        config = load_config(None, [*small, f"rl.initial={path}"])
        return make_ppo(observation_space, action_space, config).network, stored["model"]

    return make


def test_a_policy_that_is_continued_acts_within_the_new_environment_s_bounds(continued):
    network, stored = continued(SEEN, spaces.Box(-0.3, 0.5, (2,), np.float32))
    assert (network.action_low == -0.3).all() and (network.action_high == 0.5).all()
    torch.testing.assert_close(network.mean_head.weight, stored["mean_head.weight"])


def test_a_policy_that_is_continued_keeps_the_unit_of_its_values(tmp_path):
    settings = ["rl.hidden_dim=16"]
    act = spaces.Box(-1.0, 1.0, (2,), np.float32)
    before = make_ppo(SEEN, act, load_config(None, settings))
    before.rewards.scale(np.random.default_rng(0).normal(0, 40, (64, 8)), np.zeros((64, 8), bool))
    before.save(tmp_path / "whole.pt")
    save_policy(tmp_path / "shipped.pt", load_policy(tmp_path / "whole.pt"))
    for name in ("whole", "shipped"):
        initial = f"rl.initial={tmp_path / name}.pt"
        after = make_ppo(SEEN, act, load_config(None, [*settings, initial]))
        assert after.rewards.moments.variance.item() == pytest.approx(
            before.rewards.moments.variance.item(), rel=1e-3
        )
        # 512 steps were seen, of which a rollout's worth still counts.
        rollout = after.settings.envs * after.settings.rollout_steps
        assert after.rewards.moments.count.item() == min(512, rollout)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("activation=relu", "trained with rl.activation=tanh, and this one has relu; set"),
        ("squash=true", "rl.squash=false, and this one has true; set rl.squash=false, or"),
        ("normalise_observations=false", "rl.normalise_observations=true, and this one has false"),
    ],
)
def test_weights_of_another_function_are_not_continued(tmp_path, change, message):
    """Though all their shapes fit."""
    act, small = spaces.Box(-1.0, 1.0, (2,), np.float32), ["rl.hidden_dim=16"]
    path = tmp_path / "policy.pt"
    make_ppo(SEEN, act, load_config(None, small)).save(path)
    config = load_config(None, [*small, f"rl.initial={path}", f"rl.{change}"])
    with pytest.raises(UserError, match=f"rl.initial {path}: .*{message}"):
        make_ppo(SEEN, act, config)


def test_actions_that_meant_something_else_are_remarked_on(tmp_path):
    act, small = spaces.Box(-1.0, 1.0, (2,), np.float32), ["rl.hidden_dim=16"]
    trained = load_config(None, [*small, "env.frame=hand", "env.gripper=change"])
    path = tmp_path / "policy.pt"
    make_ppo(SEEN, act, trained).save(path, trained)
    initial = f"rl.initial={path}"
    with pytest.warns(UserWarning) as caught:
        make_ppo(SEEN, act, load_config(None, [*small, initial, "env.gripper=change"]))
    (warning,) = caught
    assert "trained with env.frame=hand, and not with world, so that" in str(warning.message)
    same = [*small, initial, "env.frame=hand", "env.gripper=change"]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        make_ppo(SEEN, act, load_config(None, same))
        # Nothing is moved by joints here.
        make_ppo(SEEN, act, load_config(None, [*same, "env.joint_step=0.05"]))
    for step in ("position_step=0.01", "gripper_step=0.02", "substeps=10"):
        with pytest.warns(UserWarning, match=f"{step.partition('=')[0]}=.* mean something else"):
            make_ppo(SEEN, act, load_config(None, [*same, f"env.{step}"]))


def test_an_unknown_entry_to_estimate_is_named_with_its_key():
    act = spaces.Box(-1, 1, (2,))
    config = load_config(None, ["rl.estimated_observations=[x]"])
    for space in (spaces.Box(-1, 1, (3,)), spaces.Dict({"observation": spaces.Box(-1, 1, (3,))})):
        with pytest.raises(UserError, match="rl.estimated_observations: .*'x'.* of observation"):
            make_ppo(space, act, config)


@pytest.mark.parametrize("keys", [["depth", "rgb"], ["rgb"], ["state"], ["grey"]])
def test_relief_asks_for_depth_last(keys):
    box = {
        "rgb": spaces.Box(0, 255, (32, 32, 3), np.uint8),
        "grey": spaces.Box(0, 255, (32, 32, 1), np.uint8),
        "depth": spaces.Box(0, 2, (32, 32, 1), np.float32),
        "state": spaces.Box(-1, 1, (3,), np.float32),
    }
    act = spaces.Box(-1.0, 1.0, (2,), np.float32)
    settings = ["rl.relief=true", "rl.conv_channels=[4,4]"]
    seen = f"rl.policy_observations={','.join(keys)}"
    with pytest.raises(UserError, match="rl.relief: .*depth image.*last"):
        make_ppo(spaces.Dict(box), act, load_config(None, [*settings, seen]))
    seen = "rl.policy_observations=state,rgb,depth"
    make_ppo(spaces.Dict(box), act, load_config(None, [*settings, seen]))


def _diverged(stored):
    stored["model"]["mean_head.bias"][0] = math.nan


def _without_layout(stored):
    del stored["extra"]["layout"]


@pytest.mark.parametrize(
    ("names", "change", "message"),
    [
        (("speed", "place"), lambda stored: None, r"sees place \(2,\), speed .*this one speed"),
        (("place", "force"), lambda stored: None, r"this one place \(2,\), force \(2,\); set rl.p"),
        (("place", "speed"), _diverged, "weights that are not finite"),
        (("place", "speed"), _without_layout, "the checkpoint's entries do not fit"),
    ],
)
def test_a_policy_that_cannot_be_continued_is_refused(continued, names, change, message):
    space = spaces.Dict([(name, spaces.Box(-1, 1, (2,))) for name in names])
    with pytest.raises(UserError, match=message):
        continued(space, spaces.Box(-1.0, 1.0, (2,), np.float32), change)
