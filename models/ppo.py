"""GraspPPO: proximal policy optimisation of a GraspPolicyNetwork, from rollouts.

Read `GraspPPO.update` first: it prepares a batch (values, then advantages by `compute_gae`), takes
optimiser steps on `losses`, and trains the state estimator. The sources, cited by these names:

- PPO: Schulman et al., "Proximal policy optimization algorithms" (2017).
- GAE: Schulman et al., "High-dimensional continuous control using generalized advantage
  estimation" (ICLR 2016).
- Details: Huang et al., "The 37 implementation details of proximal policy optimization" (2022).
- KL: Schulman, "Approximating KL divergence" (2020).

This module never sees an environment.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
import torch.nn.functional as F
from torch import nn

from models.ppo_observations import ObservationLayout, Observations, RewardScaler
from models.ppo_rollouts import Diverged, Rollout, StepMemory, joined
from utils.checkpoint import load_checkpoint, load_weights, reading, save_checkpoint
from utils.config_schema import Config, RLConfig
from utils.distributed import ALONE, Team
from utils.errors import UserError

KIND = "grasp_policy"
ADAM_EPSILON = 1e-5  # Details, number 3
SMALLEST_DEVIATION = 1e-8  # of advantages, so that equal ones do not divide by zero
KL_SLACK = 1.5  # an update stops beyond this many times the target, as in OpenAI's baselines


class Batch(NamedTuple):
    """B steps to learn from; all but observations, latents and features are (B,).

    latents: (B, A), see `models.grasp_policy.ActionDistribution`. log_probs: of the latents under
    the policy that drew them. features: (B, F) of the network where it has a state estimator, whose
    weights this loss does not train; None where the loss trains the encoder too.
    """

    observations: Observations
    latents: torch.Tensor
    log_probs: torch.Tensor
    advantages: torch.Tensor
    returns: torch.Tensor
    features: torch.Tensor | None = None

    def rows(self, index: torch.Tensor | slice) -> Batch:
        parts = (None if part is None else part[index] for part in self[1:])
        return Batch(self.observations.rows(index), *parts)


Rows = TypeVar("Rows", Batch, Observations)


class Losses(NamedTuple):
    """A minibatch's loss, its parts, and two measures of how far the policy moved; scalars."""

    loss: torch.Tensor
    policy_loss: torch.Tensor
    value_loss: torch.Tensor
    entropy: torch.Tensor
    approx_kl: torch.Tensor
    clip_fraction: torch.Tensor


class GraspPPO:
    """A policy in training.

    network: the GraspPolicyNetwork that is trained; it sees observations by `layout`. settings: the
    config's section `rl`. seed: names this object's randomness, which is the order of minibatches
    and what callers draw from `generator`. In a team every process brings its own rollouts, and
    gradients are averaged, so that together the processes take the step of the joint minibatch.

    `models.grasp_policy.make_ppo(observation_space, action_space, config)` makes both from an
    environment's spaces.
    """

    def __init__(
        self,
        network: nn.Module,
        layout: ObservationLayout | None = None,
        settings: RLConfig | None = None,
        team: Team = ALONE,
        seed: int = 0,
    ):
        if not isinstance(network, nn.Module) or layout is None or settings is None:
            raise TypeError(
                f"GraspPPO: got {network!r} for a network; make one with its training by "
                "models.grasp_policy.make_ppo(env.observation_space, env.action_space, config), or "
                "a network alone by GraspPolicyNetwork(512, 14, 7)"
            )
        if settings.batch_size % team.ranks or settings.envs % team.ranks:
            raise UserError(
                f"rl.envs is {settings.envs} and rl.batch_size {settings.batch_size}, but "
                f"{team.ranks} processes have to share both equally; make them multiples"
            )
        self.network, self.layout = network.to(team.device), layout
        self.settings, self.team = settings, team
        self.rewards = RewardScaler(settings.gamma).to(team.device)
        self.updates = 0
        self.generator = torch.Generator().manual_seed(seed)
        # Not in a checkpoint: it is cleared at every one, so that a resumed run equals a whole one.
        self.memory = StepMemory(settings.estimate_memory)
        team.share_weights(network)
        of_estimator = self.network.estimator_parameters()
        ids = {id(p) for p in of_estimator}
        self.weights = in_one_vector([p for p in self.network.parameters() if id(p) not in ids])
        self.optimizer = torch.optim.Adam([self.weights], settings.lr, eps=ADAM_EPSILON, fused=True)
        self.estimator_weights = self.estimator_optimizer = None
        if of_estimator:
            self.estimator_weights = in_one_vector(of_estimator)
            self.estimator_optimizer = torch.optim.Adam(
                [self.estimator_weights], settings.estimate_lr, fused=True
            )

    # --- An update ------------------------------------------------------------------------------

    def update(self, rollout: Rollout, progress: float = 0.0) -> dict[str, float]:
        """Learn from a rollout: several passes over it in shuffled minibatches.

        progress: share of the training that is done, for the annealed learning rate.
        Returns means over the minibatches, the gradients' norm before it was clipped, and how many
        steps the optimizer took.
        Raises Diverged, with the weights as they were before that minibatch, if a gradient is no
        number.
        """
        batch, explained_variance = self._prepare(rollout)
        left = 1 - progress if self.settings.anneal_lr else 1
        lr = self.settings.lr * left
        for group in self.optimizer.param_groups:
            group["lr"] = lr
        parts: list[torch.Tensor] = []
        norms: list[float] = []
        steps = 0
        for minibatch in self._minibatches(batch, len(batch.latents), self.settings.epochs):
            losses = self.losses(minibatch)
            norm = self.gradient(losses.loss)
            if not math.isfinite(norm):
                raise Diverged(
                    f"a gradient is not finite at update {self.updates} (loss "
                    f"{losses.loss.item():.3g}, of the value {losses.value_loss.item():.3g})"
                )
            parts.append(torch.stack([part.detach() for part in losses]))
            norms.append(norm)
            if self._too_far(losses.approx_kl):
                break
            self.optimizer.step()
            steps += 1
            self.network.limit_exploration()
        estimates = {}
        if self.estimator_weights is not None:
            rate = self.settings.estimate_lr * left
            estimates["estimate_loss"] = self.update_estimator(self._flat(rollout), rate)
        # Only now, so that the rollout and its update use the same statistics for normalising.
        self.network.observe(self._flat(rollout), self.team)
        self.updates += 1
        means = self.team.gather(torch.stack(parts).mean(0)).mean(0).tolist()
        explained = self.team.gather(parts[0].new_tensor([explained_variance])).mean().item()
        return dict(zip(Losses._fields, means)) | {
            "gradient_norm": float(np.mean(norms)),
            "explained_variance": explained,
            "std": self.network.log_std.detach().exp().mean().item(),
            "learning_rate": lr,
            "optimizer_steps": float(steps),
            **estimates,
        }

    def _prepare(self, rollout: Rollout) -> tuple[Batch, float]:
        """The batch that an update learns from, and the share of the returns' variance that the
        critic explains."""
        steps, envs = rollout.rewards.shape
        device = self.team.device
        observations = self._flat(rollout)
        latents = rollout.latents.flatten(0, 1).to(device)
        log_probs, values, features = self._evaluate(observations, latents)
        values = values.cpu().numpy().reshape(steps, envs)
        # V of the observation after each step: the next one's, the last one's, or the final one's
        # of an episode that was truncated.
        after = joined([rollout.cut_final, rollout.last]).map(lambda part: part.to(device))
        _, after_values, _ = self._evaluate(after)
        after_values = after_values.cpu().numpy()
        next_values = np.concatenate([values[1:], after_values[None, -envs:]])
        for (t, env), value in zip(rollout.cut, after_values):
            next_values[t, env] = value
        ended = rollout.terminated | rollout.truncated
        rewards = rollout.rewards
        if self.settings.normalise_rewards:
            rewards = self.rewards.scale(rewards, ended, self.team)
        advantages, returns = self.compute_gae(
            rewards.astype(np.float32), values, next_values, rollout.terminated, ended,
            self.settings.gamma, self.settings.gae_lambda,
        )  # fmt: skip
        if self.estimator_weights is None:
            features = None
        else:
            observations = observations._replace(images=())
        batch = Batch(
            observations, latents, log_probs,
            *(torch.from_numpy(x.ravel()).to(device) for x in (advantages, returns)), features,
        )  # fmt: skip
        spread = float(returns.var())
        return batch, 1 - float((returns - values).var()) / spread if spread else 0.0

    @staticmethod
    def compute_gae(
        rewards: np.ndarray, values: np.ndarray, next_values: np.ndarray,
        terminated: np.ndarray, ended: np.ndarray, gamma: float, lamda: float,
    ) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
        """Advantages and returns, (T, N) each; GAE, equations 11 to 16.

        values: V(s_t); next_values: V of the observation after the step, which is the *final* one
        where an episode ended. terminated: nothing comes after the step, so that V counts as 0.
        ended: terminated or truncated; the sum over future errors ends there. All (T, N).
        """
        advantages = np.empty_like(values)
        errors = rewards + gamma * next_values * ~terminated - values
        carried = gamma * lamda * ~ended
        advantage = np.zeros_like(values[0])
        for t in reversed(range(len(values))):
            advantage = errors[t] + carried[t] * advantage
            advantages[t] = advantage
        return advantages, advantages + values

    def losses(self, batch: Batch) -> Losses:
        """The loss of a minibatch: PPO, equation 9 with the clipped objective of equation 7, signs
        turned for minimising."""
        settings, advantages = self.settings, self._normalised(batch.advantages)
        seen, features = batch.observations, batch.features
        if features is None:
            features = self.network.features(seen.image(), seen.state)
        distribution, values = self.network.policy_and_value_of(features, seen.privileged)
        log_ratio = distribution.log_prob(batch.latents) - batch.log_probs
        ratio = log_ratio.exp()
        clipped = ratio.clamp(1 - settings.clip_epsilon, 1 + settings.clip_epsilon)
        policy_loss = -torch.minimum(ratio * advantages, clipped * advantages).mean()
        value_loss = F.mse_loss(values, batch.returns)
        entropy = distribution.entropy(self._entropy_noise(batch.latents)).mean()
        loss = policy_loss + settings.value_coef * value_loss - settings.entropy_coef * entropy
        with torch.no_grad():
            approx_kl = (ratio - 1 - log_ratio).mean()  # KL: k3, unbiased and of low variance
            clip_fraction = (ratio != clipped).float().mean()
        return Losses(loss, policy_loss, value_loss, entropy, approx_kl, clip_fraction)

    def gradient(self, loss: torch.Tensor, weights: nn.Parameter | None = None) -> float:
        """Put the gradient of a loss, averaged over the team, in `grad` of the weights (None: those
        of policy and critic), its norm clipped as that of one vector; returns the norm before."""
        gradient = (self.weights if weights is None else weights).grad
        gradient.zero_()
        loss.backward()
        self.team.average(gradient)
        norm = gradient.norm().item()
        if norm > self.settings.max_gradient_norm:
            gradient.mul_(self.settings.max_gradient_norm / norm)
        return norm

    # --- Parts of an update ---------------------------------------------------------------------

    def _flat(self, rollout: Rollout) -> Observations:
        """The observations of a rollout's steps, (T * N, ...), on the device."""
        return rollout.observations.map(lambda part: part.flatten(0, 1).to(self.team.device))

    @torch.no_grad()
    def _evaluate(
        self, observations: Observations, latents: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """(B,) log-probabilities of latents, values, and (B, F) features; computed a part at a time
        to bound the memory."""
        size = self.settings.batch_size
        log_probs, values, features = [], [], []
        for start in range(0, len(observations.state), size):
            part = observations.map(lambda whole: whole[start : start + size])  # noqa: B023
            features.append(self.network.features(part.image(), part.state))
            distribution, value = self.network.policy_and_value_of(features[-1], part.privileged)
            values.append(value)
            if latents is not None:
                log_probs.append(distribution.log_prob(latents[start : start + size]))
        known = torch.cat(log_probs) if log_probs else torch.empty(0)
        return known, torch.cat(values), torch.cat(features)

    def _minibatches(self, steps: Rows, count: int, epochs: int) -> Iterator[Rows]:
        """All `count` rows in another order in each epoch."""
        size = self.settings.batch_size // self.team.ranks
        for _ in range(epochs):
            order = torch.randperm(count, generator=self.generator)
            shuffled = steps.rows(order.to(self.team.device))
            for start in range(0, count, size):
                yield shuffled.rows(slice(start, start + size))

    def _normalised(self, advantages: torch.Tensor) -> torch.Tensor:
        """Advantages with zero mean and unit deviation over the joint minibatch (Details, number
        7)."""
        joint = self.team.gather(advantages)
        if joint.numel() == 1:
            return advantages
        return (advantages - joint.mean()) / (joint.std() + SMALLEST_DEVIATION)

    def _entropy_noise(self, latents: torch.Tensor) -> torch.Tensor | None:
        """Standard normal noise, from which a squashed policy's entropy is estimated."""
        if not self.network.squash:
            return None
        return torch.randn(latents.shape, generator=self.generator).to(latents.device)

    def _too_far(self, approx_kl: torch.Tensor) -> bool:
        """Whether the update has moved the policy so far that it has to stop."""
        target = self.settings.target_kl
        if target is None:
            return False
        return float(self.team.gather(approx_kl.detach()).mean()) > KL_SLACK * target

    # --- The state estimator --------------------------------------------------------------------

    def update_estimator(self, new: Observations, rate: float) -> float:
        """Train the estimates on new observations (B, ...) and remembered ones; returns the mean
        loss. rate: learning rate."""
        for group in self.estimator_optimizer.param_groups:
            group["lr"] = rate
        losses = []
        for seen in self._new_and_remembered(new):
            loss = self.network.estimate_loss(seen.image(), seen.state, seen.privileged)
            norm = self.gradient(loss, self.estimator_weights)
            if not math.isfinite(norm):
                raise Diverged(f"a gradient of the estimates is not finite ({self.updates=})")
            self.estimator_optimizer.step()
            losses.append(loss.detach())
        self.memory.add(new)
        return self.team.gather(torch.stack(losses).mean()).mean().item()

    @torch.no_grad()
    def estimate_loss(self, seen: Observations) -> float:
        """The loss of the estimates for observations (B, ...), without learning from them."""
        size, losses = self.settings.batch_size, []
        for start in range(0, len(seen.state), size):
            part = seen.rows(slice(start, start + size))
            losses.append(self.network.estimate_loss(part.image(), part.state, part.privileged))
        return self.team.gather(torch.stack(losses).mean()).mean().item()

    def _new_and_remembered(self, new: Observations) -> Iterator[Observations]:
        """Minibatches of new steps, each with `estimate_recall` times as many from earlier
        rollouts, as soon as there are some."""
        settings = self.settings
        for seen in self._minibatches(new, len(new.state), settings.estimate_epochs):
            count = settings.estimate_recall * len(seen.state)
            yield joined([seen, self.memory.draw(count, self.generator)]) if self.memory else seen

    # --- Checkpoints ----------------------------------------------------------------------------

    def save(self, path: Path, config: Config | None = None, **extra: Any) -> None:
        """Write everything that `load` needs to continue, and `load_policy` to act."""
        state = {"layout": self.layout.to_plain(), "rewards": self.rewards.state_dict()}
        if self.estimator_optimizer is not None:
            state["estimator"] = self.estimator_optimizer.state_dict()
        save_checkpoint(
            path,
            kind=KIND,
            model_args=self.network.model_args,
            model=self.network,
            optimizer=self.optimizer,
            step=self.updates,
            config=None if config is None else config.model_dump(mode="json"),
            extra={**state, **extra},
        )

    def load(self, path: Path) -> dict[str, Any]:
        """Continue from a checkpoint of `save`; returns its extra entries. Raises UserError if the
        checkpoint does not fit."""
        checkpoint = load_checkpoint(
            path, KIND, model_args=self.network.model_args, map_location=self.team.device
        )
        extra = checkpoint["extra"]
        with reading(path):
            if ObservationLayout.from_plain(extra["layout"]) != self.layout:
                raise UserError(f"{path}: a policy of other observations than this environment's")
            if checkpoint["optimizer"] is None:
                raise UserError(f"{path}: holds weights only, no training to go on with")
            load_weights(self.network, checkpoint, path)
            self.rewards.load_state_dict(extra["rewards"])
            self.optimizer.load_state_dict(checkpoint["optimizer"])
            if self.estimator_optimizer is not None:
                self.estimator_optimizer.load_state_dict(extra["estimator"])
        self.updates = checkpoint["step"]
        return extra


def in_one_vector(parameters: list[nn.Parameter]) -> nn.Parameter:
    """Lay weights and their gradients side by side: the parameters become views of the vector
    returned, their gradients views of its `grad`.

    A norm, a step of the optimiser or a message between processes is then one operation, which
    counts for small networks, and the gradient is clipped as a whole.
    """
    whole = nn.Parameter(torch.cat([p.detach().flatten() for p in parameters]))
    whole.grad = torch.zeros_like(whole)
    sizes = [p.numel() for p in parameters]
    for p, part, gradient in zip(parameters, whole.detach().split(sizes), whole.grad.split(sizes)):
        p.data, p.grad = part.view_as(p), gradient.view_as(p)
    return whole
