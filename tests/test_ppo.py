"""PPO's parts against hand computations, PyTorch's distributions and Stable-Baselines3."""

from __future__ import annotations

import math

import gymnasium
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from gymnasium import spaces
from torch.distributions import Independent, Normal, TanhTransform, TransformedDistribution

import tests.helpers.quick_envs  # noqa: F401, registers its environments
from models.grasp_policy import (
    ActionDistribution,
    GraspPolicyNetwork,
    GraspPPO,
    load_policy,
    policy_for,
    relief_of,
)
from models.ppo import Batch
from models.ppo_observations import (
    LARGEST,
    ObservationLayout,
    ObservationNormaliser,
    Observations,
    RewardScaler,
)
from models.ppo_rollouts import (
    NotFinite,
    Rollout,
    RolloutCollector,
    StepMemory,
    derived_seeds,
    evaluate_policy,
)
from tests.helpers.compare import same
from utils.checkpoint import save_checkpoint
from utils.config import load_config
from utils.distributed import ALONE
from utils.errors import UserError
from utils.runs import Stopwatch

GAMMA, LAMBDA = 0.9, 0.8
CPU = torch.device("cpu")


def settings_of(*overrides: str):
    small = ["rl.hidden_dim=16", "rl.image_feature_dim=8", "rl.conv_channels=[4,4]",
             "rl.envs=4", "rl.rollout_steps=16", "rl.batch_size=16", "rl.epochs=2"]  # fmt: skip
    return load_config(None, [*small, *overrides]).rl


# --- Advantages --------------------------------------------------------------------------------


def gae(rewards, values, next_values, terminated, truncated):
    columns = (np.array(x, float)[:, None] for x in (rewards, values, next_values))
    terminated, truncated = (np.array(x, bool)[:, None] for x in (terminated, truncated))
    advantages, returns = GraspPPO.compute_gae(
        *columns, terminated, terminated | truncated, GAMMA, LAMBDA
    )
    return advantages[:, 0], returns[:, 0]


def test_gae_by_hand():
    """Three steps; gamma lambda = 0.72, errors 1 + 0.9 * 2 - 1 = 1.8, 1.7, 4.6."""
    advantages, returns = gae([1, 2, 3], [1, 3, 2], [2, 3, 4], [0, 0, 0], [0, 0, 0])
    errors = [1 + 0.9 * 2 - 1, 2 + 0.9 * 3 - 3, 3 + 0.9 * 4 - 2]
    expected = [errors[0] + 0.72 * errors[1] + 0.72**2 * errors[2], errors[1] + 0.72 * errors[2],
                errors[2]]  # fmt: skip
    np.testing.assert_allclose(advantages, expected)
    np.testing.assert_allclose(returns, np.array(expected) + [1, 3, 2])


@pytest.mark.parametrize(
    ("terminated", "truncated", "middle"),
    [
        ([0, 1, 0], [0, 0, 0], 2 - 3),  # nothing comes after a termination
        ([0, 0, 0], [0, 1, 0], 2 + 0.9 * 5 - 3),  # the final observation's value does
        ([0, 1, 0], [0, 1, 0], 2 - 3),  # both at once: a termination
    ],
)
def test_gae_at_the_end_of_an_episode(terminated, truncated, middle):
    advantages, _ = gae([1, 2, 3], [1, 3, 2], [3, 5, 4], terminated, truncated)
    first, last = 1 + 0.9 * 3 - 1, 3 + 0.9 * 4 - 2
    np.testing.assert_allclose(advantages, [first + 0.72 * middle, middle, last])


def test_gae_equals_stable_baselines3():
    """Whose rewards get gamma V(final observation) added where an episode was truncated."""
    from stable_baselines3.common.buffers import RolloutBuffer

    rng = np.random.default_rng(0)
    steps, envs = 40, 3
    rewards, values = rng.normal(size=(2, steps, envs)).astype(np.float32)
    terminated, truncated = rng.random((2, steps, envs)) < [[[0.25]], [[0.3]]]
    ended = terminated | truncated
    last, final = rng.normal(size=envs), rng.normal(size=(steps, envs))
    buffer = RolloutBuffer(
        steps, spaces.Box(-1, 1, (1,)), spaces.Box(-1, 1, (1,)), "cpu", LAMBDA, GAMMA, envs
    )
    starts = np.concatenate([np.zeros((1, envs)), ended[:-1]])
    for t in range(steps):
        paid = rewards[t] + GAMMA * final[t] * (truncated[t] & ~terminated[t])
        buffer.add(
            np.zeros((envs, 1)), np.zeros((envs, 1)), paid, starts[t],
            torch.from_numpy(values[t]), torch.zeros(envs),
        )  # fmt: skip
    buffer.compute_returns_and_advantage(torch.from_numpy(last), ended[-1])

    next_values = np.where(ended, final, np.concatenate([values[1:], last[None]]))
    advantages, returns = GraspPPO.compute_gae(
        rewards, values, next_values.astype(np.float32), terminated, ended, GAMMA, LAMBDA
    )
    np.testing.assert_allclose(advantages, buffer.advantages, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(returns, buffer.returns, rtol=1e-4, atol=1e-5)
    assert (terminated & truncated).any() and truncated.any() and terminated.any()


# --- Distribution ------------------------------------------------------------------------------


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


# --- Network -----------------------------------------------------------------------------------


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
    here, there = torch.zeros(1, 2), torch.ones(1, 2)
    policy, value = network.policy_and_value(image, state, here)
    other_policy, other_value = network.policy_and_value(image, state, there)
    assert torch.equal(policy.mean, other_policy.mean) and not torch.equal(value, other_value)


def estimating() -> GraspPolicyNetwork:
    return GraspPolicyNetwork(8, 3, 2, 16, privileged_dim=3, conv_channels=[4, 4], estimated_dim=2)


def test_the_policy_goes_by_estimates_and_never_by_the_truth():
    network = estimating()
    image, state = torch.rand(5, 4, 16, 16), torch.randn(5, 3)
    network.privileged_norm.update(torch.randn(100, 3) * 4 + 7)
    policy, value = network.policy_and_value(image, state, torch.zeros(5, 3))
    other_policy, other_value = network.policy_and_value(image, state, torch.ones(5, 3))
    assert torch.equal(policy.mean, other_policy.mean) and not torch.equal(value, other_value)
    features = network.features(image, state)
    torch.testing.assert_close(features[:, :2], network.estimate(image, state))
    assert features.shape == (5, 2 + 3) and not features.requires_grad
    scaled = network.privileged_norm(torch.ones(5, 3))[:, :2]
    torch.testing.assert_close(network.truth(torch.ones(5, 3)), scaled)


def test_the_policy_s_loss_leaves_the_estimator_alone_and_its_loss_the_policy():
    network = estimating()
    image, state = torch.rand(5, 4, 16, 16), torch.randn(5, 3)
    estimator = {id(p) for p in network.estimator_parameters()}
    assert 0 < len(estimator) < len(list(network.parameters()))

    policy, value = network.policy_and_value(image, state, torch.zeros(5, 3))
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


# --- Observations and normalising --------------------------------------------------------------

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


# --- Rollouts ----------------------------------------------------------------------------------


class Counting:
    """Two environments whose observation counts the steps of the episode, and that say so by their
    reward: the first is truncated after 3 steps, the second terminated after 4."""

    num_envs = 2

    def restart(self, seeds, which=None):
        if which is None:
            self.seeds, self.count = list(seeds), np.zeros((2, 1), np.float32)
        else:
            self.count[which] = 0
        return self.count

    def step(self, actions):
        self.count += 1
        ends = self.count[:, 0] >= [3, 4]
        infos = {"is_success": ends & [False, True], "_is_success": np.array([True, True])}
        return (
            self.count, self.count[:, 0].astype(float), ends & [False, True],
            ends & [True, False], infos,
        )  # fmt: skip


COUNTED = ObservationLayout.of(spaces.Box(-np.inf, np.inf, (1,)))


def ppo_of(
    *overrides: str, layout=COUNTED, actions: int = 1, seed: int = 0, team=ALONE
) -> GraspPPO:
    torch.manual_seed(seed)
    space = spaces.Box(-1.0, 1.0, (actions,), np.float32)
    settings = settings_of(*overrides)
    ppo = GraspPPO(policy_for(layout, space, settings), layout, settings, team)
    ppo.generator.manual_seed(seed)
    return ppo


def test_a_rollout_keeps_final_observations():
    ppo = ppo_of()
    collector = RolloutCollector(Counting(), COUNTED, 5, CPU, Stopwatch())
    collector.restart([0, 1])
    rollout = collector.collect(ppo.network, ppo.generator)
    assert rollout.observations.state[..., 0].T.tolist() == [[0, 1, 2, 0, 1], [0, 1, 2, 3, 0]]
    assert rollout.last.state[:, 0].tolist() == [2, 1]
    assert rollout.rewards.T.tolist() == [[1, 2, 3, 1, 2], [1, 2, 3, 4, 1]]
    assert rollout.cut == [(2, 0)] and rollout.cut_final.state.tolist() == [[3]]
    assert [tuple(episode[:3]) for episode in rollout.episodes] == [(6, 3, False), (10, 4, True)]
    going_on = collector.collect(ppo.network, ppo.generator)
    assert going_on.observations.state[0, :, 0].tolist() == [2, 1]
    assert going_on.episodes[0].total == 6


def test_what_an_update_learns_from():
    """Values, bootstraps and returns of the rollout above, put together by hand."""
    ppo = ppo_of("rl.normalise_rewards=false", "rl.gae_lambda=1", f"rl.gamma={GAMMA}")
    collector = RolloutCollector(Counting(), COUNTED, 5, CPU, Stopwatch())
    collector.restart([0, 1])
    rollout = collector.collect(ppo.network, ppo.generator)
    batch, _ = ppo._prepare(rollout)

    def value(count: float) -> float:
        empty = torch.empty(1, 0)
        return ppo.network.value(None, torch.tensor([[float(count)]]), empty).item()

    expected = [  # per step, environments beside each other
        [1 + 0.9 * 2 + 0.81 * (3 + 0.9 * value(3)), 1 + 0.9 * 2 + 0.81 * 3 + 0.729 * 4],
        [2 + 0.9 * (3 + 0.9 * value(3)), 2 + 0.9 * 3 + 0.81 * 4],
        [3 + 0.9 * value(3), 3 + 0.9 * 4],
        [1 + 0.9 * (2 + 0.9 * value(2)), 4],
        [2 + 0.9 * value(2), 1 + 0.9 * value(1)],
    ]
    np.testing.assert_allclose(batch.returns.reshape(5, 2), expected, rtol=1e-5)
    first = ppo.losses(batch)
    assert first.approx_kl.item() == 0 and first.clip_fraction.item() == 0  # the ratio is 1


@pytest.mark.parametrize("bad", ["observation", "reward"])
def test_numbers_that_are_none_are_told(bad):
    class Broken(Counting):
        def step(self, actions):
            observation, rewards, *rest = super().step(actions)
            if (observation[1] == 2).all():
                (observation if bad == "observation" else rewards)[1] = np.nan
            return observation, rewards, *rest

    ppo = ppo_of()
    collector = RolloutCollector(Broken(), COUNTED, 5, CPU, Stopwatch())
    collector.restart([0, 1])
    with pytest.raises(NotFinite, match=f"{bad}.*of environment 1 .*step 10[24]"):
        collector.collect(ppo.network, ppo.generator, first_step=100)


def test_evaluation_gives_each_seed_its_episode():
    class Seeded(Counting):
        """The reward is the seed, the length differs between environments."""

        def restart(self, seeds, which=None):
            which = np.ones(2, bool) if which is None else which
            if not hasattr(self, "count"):
                self.count, self.seed = np.zeros((2, 1), np.float32), np.zeros(2)
            self.count[which] = 0
            self.seed[which] = np.array(seeds)[which]
            return self.count

        def step(self, actions):
            observation, _, *rest = super().step(actions)
            return observation, self.seed, *rest

    episodes = evaluate_policy(
        ppo_of().network, Seeded(), COUNTED, [10, 20, 30, 40, 50], CPU, Stopwatch()
    )
    assert [e.total / e.length for e in episodes] == [10, 20, 30, 40, 50]


def test_derived_seeds_are_unrelated_and_repeatable():
    assert derived_seeds(3, 1, 2) == derived_seeds(3, 1, 2)
    places = [(0, 0), (0, 1), (1, 0), (0, 0, 1)]
    assert len({seed for place in places for seed in derived_seeds(50, *place)}) == 200


# --- Updates -----------------------------------------------------------------------------------


def batch_of(size: int, actions: int = 1, seed: int = 0) -> Batch:
    rng = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=rng)

    return Batch(
        Observations((), normal(size, 1), torch.empty(size, 0)), normal(size, actions),
        normal(size) - 2, 3 * normal(size) + 1, normal(size),
    )  # fmt: skip


def test_the_loss_is_that_of_stable_baselines3():
    """Its policy with our weights, and the lines of its PPO.train for one minibatch."""
    from stable_baselines3.common.policies import ActorCriticPolicy

    ppo = ppo_of("rl.entropy_coef=0.02", "rl.normalise_observations=false", actions=2)
    theirs = ActorCriticPolicy(
        spaces.Box(-np.inf, np.inf, (1,)), spaces.Box(-1, 1, (2,)), lambda _: 3e-4,
        net_arch={"pi": [16, 16], "vf": [16, 16]},
    )  # fmt: skip
    ours, extractor = ppo.network, theirs.mlp_extractor
    for mine, yours in (
        (ours.actor, extractor.policy_net), (ours.critic, extractor.value_net),
        (ours.mean_head, theirs.action_net), (ours.value_head, theirs.value_net),
    ):  # fmt: skip
        yours.load_state_dict(mine.state_dict())
    theirs.log_std.data.copy_(ours.log_std.data)

    batch = batch_of(32, actions=2)
    values, log_prob, entropy = theirs.evaluate_actions(batch.observations.state, batch.latents)
    advantages = (batch.advantages - batch.advantages.mean()) / (batch.advantages.std() + 1e-8)
    ratio = (log_prob - batch.log_probs).exp()
    policy_loss = -torch.min(advantages * ratio, advantages * ratio.clamp(0.8, 1.2)).mean()
    value_loss = F.mse_loss(batch.returns, values.flatten())
    loss = policy_loss - 0.02 * entropy.mean() + 0.5 * value_loss

    found = ppo.losses(batch)
    for mine, yours in (
        (found.loss, loss), (found.policy_loss, policy_loss), (found.value_loss, value_loss),
        (found.entropy, entropy.mean()),
        (found.clip_fraction, ((ratio - 1).abs() > 0.2).float().mean()),
        (found.approx_kl, ((ratio - 1) - ratio.log()).mean()),
    ):  # fmt: skip
        torch.testing.assert_close(mine, yours, rtol=1e-5, atol=1e-6)

    norm = ppo.gradient(found.loss)
    loss.backward()
    unclipped = torch.nn.utils.clip_grad_norm_(theirs.parameters(), 0.5)
    assert norm == pytest.approx(unclipped.item(), rel=1e-4) and norm > 0.5
    assert ppo.weights.grad.norm().item() == pytest.approx(0.5, rel=1e-4)
    for mine, yours in ((ours.actor, extractor.policy_net), (ours.value_head, theirs.value_net)):
        for a, b in zip(mine.parameters(), yours.parameters()):
            torch.testing.assert_close(a.grad, b.grad, rtol=1e-4, atol=1e-6)


def rollout_of(ppo: GraspPPO, steps: int = 16, seed: int = 0) -> Rollout:
    """A made-up rollout of four environments with the actions of the policy."""
    rng = np.random.default_rng(seed)
    state = torch.from_numpy(rng.normal(2, 3, (steps + 1, 4, 1)).astype(np.float32))
    noise = torch.from_numpy(rng.normal(size=(steps, 4, 1)).astype(np.float32))
    seen = Observations((), state[:-1], torch.empty(steps, 4, 0))
    with torch.no_grad():
        latents = ppo.network(None, seen.state.flatten(0, 1)).sample(noise.flatten(0, 1))
    return Rollout(
        seen, Observations((), state[-1], torch.empty(4, 0)), latents.view(steps, 4, 1),
        rng.normal(size=(steps, 4)), rng.random((steps, 4)) < 0.1, np.zeros((steps, 4), bool),
        [], COUNTED.empty(0), [],
    )  # fmt: skip


def test_the_learning_rate_is_annealed():
    ppo = ppo_of("rl.lr=0.01")
    rates = [ppo.update(rollout_of(ppo), progress)["learning_rate"] for progress in (0, 0.25, 0.9)]
    assert rates == pytest.approx([0.01, 0.0075, 0.001])
    assert ppo.optimizer.param_groups[0]["lr"] == pytest.approx(0.001)
    constant = ppo_of("rl.lr=0.01", "rl.anneal_lr=false")
    assert constant.update(rollout_of(constant), 0.5)["learning_rate"] == 0.01


def test_an_update_stops_at_the_target_kl():
    free, held = (
        ppo_of("rl.lr=0.05", f"rl.target_kl={kl}", "rl.epochs=10") for kl in ("null", 0.01)
    )
    assert free.update(rollout_of(free))["minibatches"] == 40
    assert held.update(rollout_of(held))["minibatches"] < 40


def test_statistics_change_after_an_update_only():
    ppo = ppo_of()
    rollout = rollout_of(ppo)
    seen = []
    losses = ppo.losses
    ppo.losses = lambda batch: seen.append(ppo.network.state_norm.count.item()) or losses(batch)
    ppo.update(rollout)
    assert set(seen) == {0} and ppo.network.state_norm.count.item() == 64
    np.testing.assert_allclose(
        ppo.network.state_norm.mean, rollout.observations.state.double().mean().item(), rtol=1e-6
    )


def test_a_loss_that_is_no_number_poisons_no_weight():
    ppo = ppo_of()
    ppo.update(rollout_of(ppo))
    before = {name: value.clone() for name, value in ppo.network.state_dict().items()}
    moments = {k: v.clone() for k, v in ppo.optimizer.state_dict()["state"][0].items()}
    broken = rollout_of(ppo)
    broken.rewards[3, 1] = np.inf  # as no collector would let through
    with pytest.raises(NotFinite, match="not finite at update 1"):
        ppo.update(broken)
    assert same(before, dict(ppo.network.state_dict()))
    assert same(moments, ppo.optimizer.state_dict()["state"][0])


def test_updates_learn_what_pays():
    """The reward is -(action - observation / 5)^2: that has to become the mean, give or take what
    the noise of single updates makes of it."""
    ppo = ppo_of("rl.lr=0.01", "rl.epochs=8", "rl.gamma=0.5", "rl.anneal_lr=false",
                 "rl.target_kl=null")  # fmt: skip
    state = torch.tensor([[-2.5], [1.0], [4.5]])

    def error() -> float:
        return (ppo.network(None, state).mean - state / 5).abs().mean().item()

    errors = [error()]
    for number in range(60):
        rollout = rollout_of(ppo, seed=number)
        miss = rollout.latents - rollout.observations.state / 5
        rollout.rewards = -(miss[..., 0].double().numpy() ** 2)
        ppo.update(rollout)
        errors.append(error())
    assert errors[0] > 0.3 and np.median(errors[-30:]) < errors[0] / 3


# --- Checkpoints -------------------------------------------------------------------------------


def test_a_resumed_training_is_the_same_bit_for_bit(tmp_path, config):
    straight = ppo_of()
    rows = [straight.update(rollout_of(straight, seed=k), k / 4) for k in range(2)]
    straight.save(tmp_path / "last.pt", config, history=[1])
    resumed = ppo_of(seed=5)
    assert resumed.load(tmp_path / "last.pt")["history"] == [1]
    assert resumed.updates == 2 and len(rows) == 2
    resumed.generator.set_state(straight.generator.get_state())
    straight.rewards.restart()
    for k in (2, 3):
        assert straight.update(rollout_of(straight, seed=k), k / 4) == resumed.update(
            rollout_of(resumed, seed=k), k / 4
        )
    assert same(dict(straight.network.state_dict()), dict(resumed.network.state_dict()))
    assert same(straight.optimizer.state_dict(), resumed.optimizer.state_dict())
    assert same(dict(straight.rewards.state_dict()), dict(resumed.rewards.state_dict()))


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


def test_checkpoints_that_do_not_fit(tmp_path):
    ppo, path = ppo_of(), tmp_path / "policy.pt"
    ppo.save(path)
    with pytest.raises(UserError, match="another architecture.*hidden_dim"):
        ppo_of("rl.hidden_dim=32").load(path)
    space = spaces.Dict({"other": spaces.Box(-np.inf, np.inf, (1,))})
    with pytest.raises(UserError, match="other observations"):
        ppo_of(layout=ObservationLayout.of(space)).load(path)
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(UserError, match="truncated or damaged"):
        ppo.load(path)
    extra = {"layout": COUNTED.to_plain()}
    save_checkpoint(path, kind="grasp_policy", model_args=ppo.network.model_args,
                    model=ppo.network, extra=extra)  # fmt: skip
    with pytest.raises(UserError, match="weights only"):
        ppo.load(path)
    save_checkpoint(path, kind="graspnet", model_args={}, model=ppo.network)
    with pytest.raises(UserError, match="kind 'graspnet'"):
        load_policy(path)


def test_relief_is_how_far_pixels_stand_out():
    """3 cm over the table is 1, whatever the table's depth; more than 15 cm is cut off."""
    depth = torch.full((2, 1, 16, 16), 0.5)
    depth[1] = 0.2
    depth[:, :, 4:8, 4:8] -= 0.03
    depth[0, :, 12, 12] -= 0.4
    relief = relief_of(depth)
    torch.testing.assert_close(relief[:, :, 5, 5], torch.ones(2, 1))
    assert relief[0, 0, 0, 0] == 0 and relief[0, 0, 12, 12] == 5


def test_the_memory_holds_the_latest_steps():
    memory, generator = StepMemory(5), torch.Generator().manual_seed(0)

    def steps(*numbers: float) -> Observations:
        column = torch.tensor(numbers)[:, None]
        return Observations((column[:, None, None].byte(),), column, -column)

    for part in (steps(0, 1, 2), steps(3, 4, 5, 6)):
        memory.add(part)
    drawn = memory.draw(200, generator)
    assert len(memory) == 5 and set(drawn.state.flatten().tolist()) == {2, 3, 4, 5, 6}
    assert torch.equal(drawn.images[0].flatten().float(), drawn.state.flatten())
    assert torch.equal(drawn.privileged, -drawn.state)
    memory.add(steps(*range(10, 20)))
    assert set(memory.draw(200, generator).state.flatten().tolist()) == set(range(15, 20))
    memory.clear()
    memory.add(steps(7))
    assert memory.draw(3, generator).state.flatten().tolist() == [7, 7, 7]
    none = StepMemory(0)
    none.add(steps(1, 2))
    assert not none
