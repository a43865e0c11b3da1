"""GraspNet trained on labelled images of one domain and unlabelled ones of another.

A domain classifier tells from the features which domain an image is of, and the backbone is
trained against it by way of a gradient reversal (`utils.adaptation`), while the heads learn from
the labelled images alone. Knows neither where the images come from nor how a checkpoint is chosen.
"""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import nn

from models.grasp_examples import Example
from models.graspnet import GraspNet
from models.graspnet_training import Team, Trainer
from utils.adaptation import (
    SOURCE,
    TARGET,
    DomainAdaptationNetwork,
    domain_loss,
    ordinary_norms,
    reversal_weight,
)
from utils.checkpoint import load_weights
from utils.config import AdaptationConfig, TrainConfig
from utils.errors import UserError

STATE = "adaptation"  # the entry of a checkpoint's `extra` from which a training goes on


class Pair(NamedTuple):
    """source: a labelled example, or a batch of them. target: (4, h, w) or (B, 4, h, w), inputs of
    the other domain, as many."""

    source: Example
    target: torch.Tensor


class Features(nn.Module):
    """The part of a GraspNet that is made to forget the domain: all before its heads."""

    def __init__(self, model: GraspNet):
        super().__init__()
        self.model = model

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        return self.model.features(images)


class Heads(nn.Module):
    """The part of a GraspNet that learns from labels alone, with all its maps."""

    def __init__(self, model: GraspNet):
        super().__init__()
        self.model = model

    def forward(self, features: torch.Tensor) -> tuple[torch.Tensor, ...]:
        centres = self.model.centre_head is not None
        return self.model.heads(features, logits=True, centres=centres)


def domain_classifier(channels: int) -> nn.Module:
    """From features (B, channels, H, W) to logits (B, 1) of coming from the target.

    The mean over the image comes last, so it judges textures and edges, not where things lie.
    """
    return nn.Sequential(
        nn.Conv2d(channels, 64, 4, stride=4), nn.ReLU(),
        nn.Conv2d(64, 64, 3, padding=1), nn.ReLU(),
        nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(64, 1),
    )  # fmt: skip


def check_alone(team: Team) -> None:
    """Raise UserError for more than one process."""
    if team.ranks > 1:
        raise UserError(
            f"adaptation.target: got {team.ranks} processes, but only one can adapt a network; "
            "start train_graspnet.py without torchrun"
        )


class AdaptingTrainer(Trainer):
    """A Trainer that takes batches of `Pair`.

    From here on the model's batch norms have statistics for either domain; checkpoints hold an
    ordinary network with those of the target. Raises UserError for more than one process.
    """

    def __init__(
        self, model: GraspNet, settings: TrainConfig, total_steps: int, team: Team,
        adaptation: AdaptationConfig,
    ):  # fmt: skip
        check_alone(team)
        network = DomainAdaptationNetwork(
            feature_extractor=Features(model), task_head=Heads(model),
            domain_classifier=domain_classifier(model.backbone.out_channels),
        )  # fmt: skip
        super().__init__(model, settings, total_steps, team, trained=network)
        self.weight = adaptation.weight

    @property
    def reversal(self) -> float:
        """What the domain loss weighs in the features at this step."""
        progress = self.step / max(self.total_steps - 1, 1)
        return self.weight * reversal_weight(min(progress, 1.0))

    def losses(self, batch: Pair) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """The grasp loss on the source plus the domain loss, and their parts; `domain_accuracy`
        is the classifier's on this batch. With weight 0 there is no classifier's loss: the target
        only tells its batch norms' statistics."""
        device = self.team.device
        source, target = (
            images.to(device, memory_format=torch.channels_last, non_blocking=True)
            for images in (batch.source.image, batch.target)
        )
        labels = batch.source.targets
        targets = type(labels)(*(t.to(device, non_blocking=True) for t in labels))
        mixed = self.precision != torch.float32
        with torch.autocast(device.type, dtype=self.precision, enabled=mixed):
            ours = self.trained(source, SOURCE, self.reversal)
            with torch.set_grad_enabled(self.weight > 0):
                theirs = self.trained(target, TARGET, self.reversal)
        quality, angle, width, *offset = ours.task
        total, parts = self.loss(quality, angle, width, targets, *offset)
        between = domain_loss(ours.domain.float(), theirs.domain.float())
        right = ((ours.domain <= 0).float().mean() + (theirs.domain > 0).float().mean()) / 2
        parts |= {"domain_loss": between.detach(), "domain_accuracy": right}
        return (total + between if self.weight > 0 else total), parts

    def ordinary_model(self) -> GraspNet:
        """A copy with the target's statistics in ordinary batch norms."""
        return ordinary_norms(copy.deepcopy(self.model), TARGET)

    def more_state(self) -> dict[str, Any]:
        """Statistics of both domains, with the weights that they belong to, and the classifier."""
        classifier = self.trained.domain_classifier
        return {STATE: {"model": self.model.state_dict(), "classifier": classifier.state_dict()}}

    def take_weights(self, checkpoint: dict[str, Any], path: Path) -> None:
        saved = checkpoint["extra"][STATE]
        load_weights(self.model, saved, path)
        self.trained.domain_classifier.load_state_dict(saved["classifier"])
