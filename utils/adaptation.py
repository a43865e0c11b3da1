"""Unsupervised domain adaptation: training for unlabelled images of another domain.

Domain-adversarial training after Ganin et al., "Domain-adversarial training of neural networks"
(JMLR 2016): a classifier separates source from target features, and the feature extractor is
trained against it through a gradient reversal. No label of the target is needed. This module knows
no data set, no robot and no task: networks and the task's loss are arguments.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from copy import deepcopy
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import torch
from torch import nn
from torch.nn import functional as F

from utils.errors import UserError

SOURCE, TARGET = 0, 1
_SHARPNESS = 10.0  # gamma of Ganin et al.'s schedules of the reversal and of the learning rate
# A checkpoint may be chosen only if its source score is this close to the best one: that excludes
# networks which are confident but wrong everywhere.
_SOURCE_SLACK = 0.02

Loss = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]


class GradientReversal(torch.autograd.Function):
    """The identity forwards; backwards the gradient times -weight."""

    @staticmethod
    def forward(ctx, values: torch.Tensor, weight: float) -> torch.Tensor:
        ctx.weight = weight
        return values.view_as(values)

    @staticmethod
    def backward(ctx, gradient: torch.Tensor) -> tuple[torch.Tensor, None]:
        return -ctx.weight * gradient, None


def reverse_gradient(values: torch.Tensor, weight: float) -> torch.Tensor:
    """Return `values` (any shape) unchanged, with the gradient reversed and scaled by `weight`."""
    return GradientReversal.apply(values, weight)


def reversal_weight(progress: float) -> float:
    """Return 2 / (1 + exp(-10 p)) - 1 for p from 0 (start) to 1 (end): Ganin et al., section 5.2.2.

    The weight rises from 0, while the domain classifier still knows nothing, to nearly 1.
    """
    if not 0 <= progress <= 1:
        raise ValueError(f"reversal_weight: progress must be within 0..1, got {progress}")
    return 2 / (1 + math.exp(-_SHARPNESS * progress)) - 1


class DomainBatchNorm(nn.Module):
    """Batch normalisation of (B, C, ...) with statistics for each domain and one weight and bias.

    Statistics of a mixture fit neither domain (Li et al., "Revisiting batch normalization for
    practical domain adaptation", 2016). `select_domain` sets the domain in use. ordinary: the class
    that `ordinary_norms` puts back.
    """

    def __init__(
        self,
        channels: int,
        eps: float = 1e-5,
        momentum: float = 0.1,
        ordinary: type[nn.BatchNorm1d] | type[nn.BatchNorm2d] = nn.BatchNorm2d,
    ):
        super().__init__()
        self.eps, self.momentum, self.domain = eps, momentum, SOURCE
        self.ordinary = ordinary
        self.weight = nn.Parameter(torch.ones(channels))
        self.bias = nn.Parameter(torch.zeros(channels))
        self.register_buffer("running_mean", torch.zeros(2, channels))
        self.register_buffer("running_var", torch.ones(2, channels))

    def forward(self, values: torch.Tensor) -> torch.Tensor:
        return F.batch_norm(
            values, self.running_mean[self.domain], self.running_var[self.domain],
            self.weight, self.bias, self.training, self.momentum, self.eps,
        )  # fmt: skip


def per_domain_norms(module: nn.Module) -> nn.Module:
    """Replace every BatchNorm1d and BatchNorm2d in the module by a DomainBatchNorm.

    The weights stay, and the running statistics become those of both domains. Changes the module in
    place (unless it is a BatchNorm itself) and returns it.
    """
    if isinstance(module, nn.BatchNorm1d | nn.BatchNorm2d):
        if not (module.affine and module.track_running_stats and module.momentum is not None):
            raise ValueError("per_domain_norms: needs affine norms with running averages")
        norm = DomainBatchNorm(module.num_features, module.eps, module.momentum, type(module))
        with torch.no_grad():
            for name in ("weight", "bias", "running_mean", "running_var"):
                getattr(norm, name).copy_(getattr(module, name))
        return norm.to(module.weight.device)
    for name, child in module.named_children():
        setattr(module, name, per_domain_norms(child))
    return module


def ordinary_norms(module: nn.Module, domain: int = TARGET) -> nn.Module:
    """Replace every DomainBatchNorm by an ordinary norm with the statistics of one domain.

    This is the inverse of `per_domain_norms`: the module then needs nothing of this file. Changes
    the module in place (unless it is a DomainBatchNorm itself) and returns it.
    """
    if isinstance(module, DomainBatchNorm):
        norm = module.ordinary(len(module.weight), module.eps, module.momentum)
        with torch.no_grad():
            norm.weight.copy_(module.weight)
            norm.bias.copy_(module.bias)
            norm.running_mean.copy_(module.running_mean[domain])
            norm.running_var.copy_(module.running_var[domain])
        return norm.to(module.weight.device).train(module.training)
    for name, child in module.named_children():
        setattr(module, name, ordinary_norms(child, domain))
    return module


def select_domain(module: nn.Module, domain: int) -> None:
    """Let every DomainBatchNorm in the module use this domain's statistics."""
    for part in module.modules():
        if isinstance(part, DomainBatchNorm):
            part.domain = domain


class Outputs(NamedTuple):
    """task: the output of the task head. domain: (B,) logits of the target domain. features: the
    output of the feature extractor."""

    task: torch.Tensor
    domain: torch.Tensor
    features: torch.Tensor


class DomainAdaptationNetwork(nn.Module):
    """A feature extractor with a task head and, behind a gradient reversal, a domain classifier.

    feature_extractor: images (B, ...) to features (B, F, ...). task_head: features to the input of
    the task's loss. domain_classifier: features to (B,) or (B, 1) logits. None makes the default
    for small images (B, 3, H, W) and `classes` classes, with features (B, feature_dim). The
    extractor's batch norms become norms per domain; the heads should have none.
    """

    def __init__(
        self,
        feature_dim: int = 128,
        classes: int = 10,
        *,
        feature_extractor: nn.Module | None = None,
        task_head: nn.Module | None = None,
        domain_classifier: nn.Module | None = None,
    ):
        super().__init__()
        self.feature_extractor = per_domain_norms(feature_extractor or _small_cnn(feature_dim))
        self.task_head = task_head or nn.Linear(feature_dim, classes)
        self.domain_classifier = domain_classifier or nn.Sequential(
            nn.Linear(feature_dim, 128), nn.ReLU(), nn.Linear(128, 1)
        )

    def forward(self, images: torch.Tensor, domain: int = TARGET, reversal: float = 1.0) -> Outputs:
        """Return the outputs for images (B, ...) that all come from one domain, SOURCE or TARGET.

        reversal: the weight of the reversed gradient, the tutorial's `alpha`.
        """
        # The tutorial's alpha, a float, stands here in its call; its 1.0 equals TARGET.
        if isinstance(domain, float) or domain not in (SOURCE, TARGET):
            raise ValueError(
                f"domain: got {domain!r}, expected SOURCE (0) or TARGET (1); the tutorial's alpha "
                "is the argument `reversal`"
            )
        select_domain(self.feature_extractor, domain)
        features = self.feature_extractor(images)
        logits = self.domain_classifier(reverse_gradient(features, reversal))
        return Outputs(self.task_head(features), logits.reshape(len(images)), features)


def _small_cnn(feature_dim: int) -> nn.Module:
    return nn.Sequential(
        nn.Conv2d(3, 24, 5, stride=2, padding=2, bias=False), nn.BatchNorm2d(24), nn.ReLU(),
        nn.Conv2d(24, 48, 3, stride=2, padding=1, bias=False), nn.BatchNorm2d(48), nn.ReLU(),
        nn.AdaptiveAvgPool2d(5), nn.Flatten(),
        nn.Linear(48 * 25, feature_dim, bias=False), nn.BatchNorm1d(feature_dim), nn.ReLU(),
    )  # fmt: skip


def domain_loss(source: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Return the binary cross-entropy of the domain classifier's logits (B,) on images of the
    source and of the target; both domains count alike."""
    of_source = F.binary_cross_entropy_with_logits(source, torch.zeros_like(source))
    of_target = F.binary_cross_entropy_with_logits(target, torch.ones_like(target))
    return (of_source + of_target) / 2


# --- Training ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class AdaptationSettings:
    """The settings of `train_domain_adaptation`.

    steps: of the optimiser. batch_size: images of each domain in a step. lr, weight_decay: of
    AdamW; the rate falls as lr / (1 + 10 p)^0.75 (Ganin et al.). adversarial: weight of the domain
    loss in the features, times `reversal_weight`; 0 trains on the source alone. held_out: share of
    each domain that is kept for choosing the checkpoint. checks: number of checkpoints, spread over
    the training, of which one is chosen.
    """

    steps: int = 1000
    batch_size: int = 64
    lr: float = 2e-3
    weight_decay: float = 1e-4
    adversarial: float = 1.0
    held_out: float = 0.2
    checks: int = 10

    def __post_init__(self) -> None:
        for name in ("steps", "batch_size", "checks"):
            if getattr(self, name) < 1:
                raise ValueError(f"AdaptationSettings.{name} must be >= 1")
        if not 0 < self.held_out < 1:
            raise ValueError("AdaptationSettings.held_out must be within 0..1")
        if not (self.lr > 0 and self.adversarial >= 0 and self.weight_decay >= 0):
            raise ValueError("AdaptationSettings: lr must be > 0, the other weights >= 0")


@dataclass(frozen=True)
class Check:
    """Scores of the network at one step of the training; no target label is used.

    source_score: on the held-out source. information: nats, see `mutual_information`, on the
    held-out target. domain_accuracy: of the domain classifier on the held-out images (GraspNet's
    training takes the batches instead); 0.5 is chance.
    """

    step: int
    source_score: float
    information: float
    domain_accuracy: float


@dataclass
class AdaptationHistory:
    """checks: in order. chosen: the check whose weights the network has in the end."""

    checks: list[Check] = field(default_factory=list)
    chosen: Check | None = None


def train_domain_adaptation(
    source: tuple[torch.Tensor, torch.Tensor],
    target: torch.Tensor,
    model: DomainAdaptationNetwork,
    settings: AdaptationSettings | None = None,
    *,
    seed: int = 0,
    task_loss: Loss = F.cross_entropy,
    source_score: Loss | None = None,
) -> AdaptationHistory:
    """Train the network in place on labelled source and unlabelled target images.

    source: images (N, ...) and labels (N, ...). target: images (M, ...); M may differ from N, each
    step takes equally many images of both, and each domain starts over when it is used up.
    task_loss: (task head's output, labels) to a scalar. source_score: the same arguments to a
    score, higher is better; None takes the share of correct classes.

    The final weights are those of the check with the most `mutual_information` on held-out target
    images, among the checks whose source score is within 0.02 of the best. No target label is used:
    confidence alone would prefer a network that calls everything a 1, the source score alone
    ignores the target, and the information of the predictions is high only where they are certain
    and differ. Every task head whose output is (B, classes, ...) logits has this information.

    Without an adversary (`settings.adversarial` 0) the target's images only update the statistics
    of its batch norms, and the source score alone chooses. Raises UserError if a domain has too few
    images, and for the tutorial's call: a source without labels, or a number of epochs as settings.
    """
    settings = AdaptationSettings() if settings is None else settings
    if not isinstance(settings, AdaptationSettings):
        raise UserError(f"settings: got {settings!r}, expected AdaptationSettings(steps=...)")
    rng = np.random.default_rng(seed)
    score = source_score or _accuracy
    if isinstance(source, torch.Tensor):
        raise UserError("source: got images alone, expected the pair (images, labels)")
    images, labels = source
    if len(images) != len(labels):
        raise UserError(f"source has {len(images)} images and {len(labels)} labels")
    train_s, held_s = _split(rng, len(images), settings, "source")
    train_t, held_t = _split(rng, len(target), settings, "target")
    batches = zip(_batches(rng, train_s, settings), _batches(rng, train_t, settings))
    optimiser = torch.optim.AdamW(
        model.parameters(), lr=settings.lr, weight_decay=settings.weight_decay
    )
    history, weights = AdaptationHistory(), []
    check_steps = set(np.linspace(0, settings.steps, settings.checks + 1).round().astype(int)[1:])
    model.train()
    for step in range(1, settings.steps + 1):
        progress = (step - 1) / max(settings.steps - 1, 1)
        for group in optimiser.param_groups:
            group["lr"] = settings.lr / (1 + _SHARPNESS * progress) ** 0.75
        chosen_s, chosen_t = next(batches)
        reversal = settings.adversarial * reversal_weight(progress)
        on_source = model(images[chosen_s], SOURCE, reversal)
        with torch.set_grad_enabled(bool(settings.adversarial)):
            on_target = model(target[chosen_t], TARGET, reversal)
        loss = task_loss(on_source.task, labels[chosen_s])
        if settings.adversarial:
            loss = loss + domain_loss(on_source.domain, on_target.domain)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        if step in check_steps:
            check = _check(model, step, images[held_s], labels[held_s], target[held_t], score)
            history.checks.append(check)
            weights.append(deepcopy(model.state_dict()))
    adversarial = bool(settings.adversarial)
    history.chosen = choose_check(history.checks, with_information=adversarial)
    model.load_state_dict(weights[history.checks.index(history.chosen)])
    model.eval()
    return history


def choose_check(checks: list[Check], with_information: bool = True) -> Check:
    """Return the check whose weights to keep, see `train_domain_adaptation`; of equals the last."""
    if not with_information:
        return max(checks, key=lambda check: (check.source_score, check.step))
    enough = max(check.source_score for check in checks) - _SOURCE_SLACK
    able = [check for check in checks if check.source_score >= enough]
    return max(able, key=lambda check: (check.information, check.step))


def mutual_information(logits: torch.Tensor) -> float:
    """Return the mutual information of images and predicted classes: H(mean p) - mean H(p), nats.

    It lies within 0 .. log(classes). logits: (B, classes, ...); dimensions behind the classes count
    as further images. From Bridle, Heading and MacKay, "Unsupervised classifiers, mutual
    information and phantom targets" (1991).
    """
    log_p = F.log_softmax(logits.double(), dim=1).transpose(0, 1).flatten(1)
    p = log_p.exp()
    mean = p.mean(1)
    return float(torch.special.entr(mean).sum() + (p * log_p).sum(0).mean())


@torch.no_grad()
def outputs_of(
    model: DomainAdaptationNetwork, images: torch.Tensor, domain: int = TARGET, batch: int = 512
) -> Outputs:
    """Return the network's outputs in evaluation mode for images (N, ...) of one domain."""
    was_training = model.training
    model.eval()
    parts = [model(images[i : i + batch], domain) for i in range(0, len(images), batch)]
    model.train(was_training)
    return Outputs(*(torch.cat(values) for values in zip(*parts)))


def _check(
    model: DomainAdaptationNetwork, step: int, images: torch.Tensor, labels: torch.Tensor,
    target: torch.Tensor, score: Loss,
) -> Check:  # fmt: skip
    """Score the network on held-out images, labels and target images."""
    on_source, on_target = outputs_of(model, images, SOURCE), outputs_of(model, target, TARGET)
    correct = torch.cat([on_source.domain <= 0, on_target.domain > 0]).double()
    # Both domains count alike, however many images are held out.
    sizes = len(on_source.domain), len(on_target.domain)
    weights = torch.cat([torch.full((n,), 0.5 / n, dtype=torch.double) for n in sizes])
    return Check(
        step,
        float(score(on_source.task, labels)),
        mutual_information(on_target.task),
        float((correct * weights).sum()),
    )


def _accuracy(logits: torch.Tensor, labels: torch.Tensor) -> torch.Tensor:
    return (logits.argmax(1) == labels).double().mean()


def _split(
    rng: np.random.Generator, count: int, settings: AdaptationSettings, domain: str
) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices of the images to train on and of the held-out ones."""
    held_out = max(1, round(settings.held_out * count))
    if count - held_out < settings.batch_size:
        raise UserError(
            f"the {domain} has {count} images, too few for batches of {settings.batch_size} "
            f"when {held_out} are held out; give more images or a smaller batch_size"
        )
    order = rng.permutation(count)
    return order[held_out:], order[:held_out]


def _batches(
    rng: np.random.Generator, numbers: np.ndarray, settings: AdaptationSettings
) -> Iterator[torch.Tensor]:
    """Yield full batches of shuffled indices, without end."""
    while True:
        order = rng.permutation(numbers)
        for i in range(0, len(order) - settings.batch_size + 1, settings.batch_size):
            yield torch.from_numpy(order[i : i + settings.batch_size])
