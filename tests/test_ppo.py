"""PPO's update against hand computations and Stable-Baselines3."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from gymnasium import spaces

from models.grasp_policy import (
    GraspPPO,
    load_policy,
)
from models.ppo_observations import ObservationLayout, Observations
from models.ppo_rollouts import (
    Diverged,
    RolloutCollector,
)
from tests.helpers.compare import same
from tests.helpers.ppo_parts import (
    COUNTED,
    batch_of,
    counting,
    ppo_of,
    rollout_of,
)
from utils.checkpoint import save_checkpoint
from utils.errors import UserError
from utils.runs import Stopwatch

GAMMA, LAMBDA = 0.9, 0.8


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


def test_what_an_update_learns_from():
    """Values, bootstraps and returns of the rollout above, put together by hand."""
    ppo = ppo_of("rl.normalise_rewards=false", "rl.gae_lambda=1", f"rl.gamma={GAMMA}")
    collector = RolloutCollector(counting(), COUNTED, 5, Stopwatch())
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


def test_the_first_step_down_a_gradient_as_small_as_adams_epsilon_is_half_the_rate():
    """lr g / (g + epsilon): both moments, corrected, are g and g^2. Details, number 3."""
    ppo = ppo_of("rl.lr=1e-3")
    before = ppo.weights.detach().clone()
    ppo.weights.grad = torch.full_like(ppo.weights, 1e-5)
    ppo.optimizer.step()
    torch.testing.assert_close(
        before - ppo.weights.detach(), torch.full_like(before, 5e-4), rtol=1e-3, atol=0
    )


@pytest.mark.parametrize(
    ("clip", "value", "entropy_coef", "largest"), [(0.2, 0.5, 0.02, 0.5), (0.1, 0.25, 0.01, 0.2)]
)
def test_the_loss_is_that_of_stable_baselines3(clip, value, entropy_coef, largest):
    """Its policy with our weights, and the lines of its PPO.train for one minibatch."""
    from stable_baselines3.common.policies import ActorCriticPolicy

    ppo = ppo_of(
        f"rl.clip_epsilon={clip}", f"rl.value_coef={value}", f"rl.entropy_coef={entropy_coef}",
        f"rl.max_gradient_norm={largest}", "rl.normalise_observations=false", actions=2,
    )  # fmt: skip
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
    clipped = ratio.clamp(1 - clip, 1 + clip)
    policy_loss = -torch.min(advantages * ratio, advantages * clipped).mean()
    value_loss = F.mse_loss(batch.returns, values.flatten())
    loss = policy_loss - entropy_coef * entropy.mean() + value * value_loss

    found = ppo.losses(batch)
    for mine, yours in (
        (found.loss, loss), (found.policy_loss, policy_loss), (found.value_loss, value_loss),
        (found.entropy, entropy.mean()),
        (found.clip_fraction, ((ratio - 1).abs() > clip).float().mean()),
        (found.approx_kl, ((ratio - 1) - ratio.log()).mean()),
    ):  # fmt: skip
        torch.testing.assert_close(mine, yours, rtol=1e-5, atol=1e-6)

    norm = ppo.gradient(found.loss)
    loss.backward()
    unclipped = torch.nn.utils.clip_grad_norm_(theirs.parameters(), largest)
    assert norm == pytest.approx(unclipped.item(), rel=1e-4) and norm > largest
    assert ppo.weights.grad.norm().item() == pytest.approx(largest, rel=1e-4)
    for mine, yours in ((ours.actor, extractor.policy_net), (ours.value_head, theirs.value_net)):
        for a, b in zip(mine.parameters(), yours.parameters()):
            torch.testing.assert_close(a.grad, b.grad, rtol=1e-4, atol=1e-6)


def test_the_learning_rate_is_annealed():
    ppo = ppo_of("rl.lr=0.01")
    rates = [ppo.update(rollout_of(ppo), progress)["learning_rate"] for progress in (0, 0.25, 0.9)]
    assert rates == pytest.approx([0.01, 0.0075, 0.001])
    assert ppo.optimizer.param_groups[0]["lr"] == pytest.approx(0.001)
    constant = ppo_of("rl.lr=0.01", "rl.anneal_lr=false")
    assert constant.update(rollout_of(constant), 0.5)["learning_rate"] == 0.01


def test_an_update_stops_at_the_target_kl():
    """Before the first step from a policy that has gone more than one and a half times as far, as
    OpenAI's baselines do."""
    ppo = ppo_of("rl.target_kl=0.01", "rl.epochs=10")
    gone, losses = iter([0.0, 0.0149, 0.0149, 0.0151, 0.0]), ppo.losses
    ppo.losses = lambda batch: losses(batch)._replace(approx_kl=torch.tensor(next(gone)))
    assert ppo.update(rollout_of(ppo))["optimizer_steps"] == 3
    (state,) = ppo.optimizer.state_dict()["state"].values()
    assert state["step"] == 3
    free = ppo_of("rl.target_kl=null", "rl.epochs=10", "rl.lr=0.05")
    assert free.update(rollout_of(free))["optimizer_steps"] == 40


def test_explained_variance_is_that_of_stable_baselines3():
    from stable_baselines3.common.utils import explained_variance

    ppo = ppo_of("rl.gamma=0.5")
    rollout = rollout_of(ppo)
    rollout.rewards = rollout.observations.state[..., 0].double().numpy()  # values can explain some
    batch, explained = ppo._prepare(rollout)
    with torch.no_grad():
        values = ppo.network.value(None, batch.observations.state, torch.empty(64, 0))
    theirs = explained_variance(values.numpy(), batch.returns.numpy())
    assert explained == pytest.approx(theirs, abs=1e-5) and abs(theirs) > 1e-3


def test_rewards_are_divided_by_the_deviation_of_discounted_returns():
    """Of all that was seen so far, in numpy; what happens in one rollout goes on in the next."""
    scaled, plain = (ppo_of(f"rl.normalise_rewards={on}", "rl.gamma=0.9") for on in ("true", "no"))
    running, seen = np.zeros(4), []
    for number in range(2):
        rollout, by_hand = (rollout_of(ppo, seed=number) for ppo in (scaled, plain))
        for rewards, ended in zip(rollout.rewards, rollout.terminated | rollout.truncated):
            running = 0.9 * running + rewards
            seen.append(running)
            running = np.where(ended, 0, running)
        by_hand.rewards = rollout.rewards / np.std(seen)
        one, another = (
            ppo._prepare(part)[0] for ppo, part in ((scaled, rollout), (plain, by_hand))
        )
        torch.testing.assert_close(one.returns, another.returns, rtol=1e-4, atol=1e-5)
    assert not 0.9 < np.std(seen) < 1.1


def estimating(*overrides: str) -> GraspPPO:
    """A policy that estimates the privileged number from its state."""
    space = spaces.Dict({name: spaces.Box(-np.inf, np.inf, (1,)) for name in ("seen", "truth")})
    layout = ObservationLayout.of(space, ["seen"], ["truth"])
    return ppo_of("rl.estimated_observations=truth", *overrides, layout=layout)


def test_estimates_learn_from_new_and_from_remembered_steps():
    """Of 64 steps in minibatches of 16, each with three times as many remembered ones: they are
    earlier steps, known by their numbers."""
    ppo = estimating("rl.estimate_epochs=2", "rl.estimate_recall=3", "rl.estimate_memory=100")
    sizes, numbers, loss = [], [], ppo.network.estimate_loss

    def spied(image, state, privileged):
        sizes.append(len(state))
        numbers.append(state[:, 0])
        return loss(image, state, privileged)

    ppo.network.estimate_loss = spied
    for first in (0, 64):
        state = torch.arange(first, first + 64.0)[:, None]
        ppo.update_estimator(Observations((), state, state / 100), rate=1e-3)
    assert sizes == 8 * [16] + 8 * [64]
    new, old = (
        torch.cat([seen[part] for seen in numbers[8:]]) for part in (np.s_[:16], np.s_[16:])
    )
    assert sorted(new.tolist()) == sorted(2 * list(range(64, 128)))
    assert old.max() < 64 and len(old.unique()) > 50


def test_the_loss_of_estimates_by_hand():
    """Huber's: e^2 / (2 beta) up to beta = 0.1, from there on e - beta / 2."""
    ppo = estimating("rl.normalise_observations=false")
    state, truth = torch.zeros(8, 1), torch.ones(8, 1)
    for error, loss in ((0.05, 0.0125), (0.5, 0.45)):
        ppo.network.estimate = lambda image, state, error=error: truth + error
        found = ppo.network.estimate_loss(None, state, truth).item()
        assert found == pytest.approx(loss, rel=1e-5)


def test_the_learning_rate_of_estimates_is_annealed():
    ppo = estimating("rl.estimate_lr=0.01", "rl.estimate_memory=0")
    rollout = rollout_of(ppo)
    truth = rollout.observations.state / 10
    rollout.observations = rollout.observations._replace(privileged=truth)
    rollout.last = rollout.last._replace(privileged=torch.zeros(4, 1))
    rollout.cut_final = ppo.layout.empty(0)
    ppo.update(rollout, progress=0.75)
    (group,) = ppo.estimator_optimizer.param_groups
    assert group["lr"] == pytest.approx(0.0025)


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
    with pytest.raises(Diverged, match="not finite at update 1"):
        ppo.update(broken)
    assert same(before, dict(ppo.network.state_dict()))
    assert same(moments, ppo.optimizer.state_dict()["state"][0])


def test_updates_learn_what_pays():
    """The reward is -(action - observation / 5)^2: that has to become the mean, give or take what
    the noise of single updates makes of it."""
    ppo = ppo_of("rl.lr=0.005", "rl.epochs=8", "rl.gamma=0.5", "rl.anneal_lr=false",
                 "rl.target_kl=0.1")  # fmt: skip
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


@pytest.mark.parametrize(("start", "entropy_coef"), [(2, 0), (-5, 10)])
def test_exploration_leaves_its_limits_again(start, entropy_coef):
    """Noise that costs falls from the upper limit; entropy that pays rises from the lower one."""
    ppo = ppo_of("rl.lr=0.01", f"rl.initial_log_std={start}", f"rl.entropy_coef={entropy_coef}")
    for number in range(20):
        rollout = rollout_of(ppo, seed=number)
        rollout.rewards = -(rollout.latents[..., 0].double().numpy() ** 2)
        ppo.update(rollout)
    assert -4.9 < ppo.network.log_std.item() < 1.9


@pytest.mark.parametrize(("start", "sign"), [(2, 1), (-5, -1)])
def test_exploration_stays_within_its_limits(start, sign):
    ppo = ppo_of("rl.lr=0.01", f"rl.initial_log_std={start}")
    ppo.gradient = lambda loss: ppo.weights.grad.fill_(-sign).sum().item()  # towards the limit
    ppo.weights.grad = torch.zeros_like(ppo.weights)
    ppo.update(rollout_of(ppo))
    assert ppo.network.log_std.item() == start


def test_each_epoch_takes_all_steps_in_an_order_of_its_own():
    def orders(seed: int) -> torch.Tensor:
        parts = ppo_of("rl.epochs=3", "rl.target_kl=null")
        ppo = GraspPPO(parts.network, COUNTED, parts.settings, seed=seed)
        rollout, seen, losses = rollout_of(ppo), [], ppo.losses
        ppo.losses = lambda batch: seen.append(batch.latents[:, 0]) or losses(batch)
        ppo.update(rollout)
        places = torch.cat(seen).reshape(3, 64)[..., None] == rollout.latents.flatten()
        return places.long().argmax(dim=-1)

    order = orders(3)
    in_turn = torch.arange(64).expand(3, 64)
    assert torch.equal(order.sort(dim=1).values, in_turn)
    assert len({tuple(one.tolist()) for one in (*order, in_turn[0], *orders(4))}) == 7
    assert torch.equal(order, orders(3))


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
