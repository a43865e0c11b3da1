"""Training steps of GraspNet: precision, schedule, checkpoints that resume exactly.

Knows neither where batches come from nor how a trained network is judged.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import torch
from torch import nn
from torch.nn.parallel import DistributedDataParallel

from models.graspnet import GraspLoss, GraspNet
from models.graspnet_examples import Example
from models.graspnet_io import KIND, PIXEL_SIZE
from utils.checkpoint import load_checkpoint, load_weights, restore_rng, rng_states, save_checkpoint
from utils.config import Config, TrainConfig
from utils.distributed import Team
from utils.errors import UserError

GRADIENT_LIMIT = 5.0  # of the gradient's norm; only the first steps ever reach it


def choose_precision(name: str, device: torch.device) -> torch.dtype:
    """What matrix products are computed in. auto: float16 on a GPU, bfloat16 on a CPU that has
    instructions for it, else float32."""
    if name != "auto":
        return getattr(torch, name)
    if device.type == "cuda":
        return torch.float16
    has_bfloat16 = torch.cpu.get_capabilities().get("avx512_bf16", False)
    return torch.bfloat16 if has_bfloat16 else torch.float32


def warm_up_and_cosine(step: int, total: int, warmup_share: float) -> float:
    """Factor on the learning rate: up in a line, then down to 0 as a half cosine (Loshchilov and
    Hutter 2017, without restarts)."""
    warmup = warmup_share * total
    if step < warmup:
        return (step + 1) / (warmup + 1)
    return 0.5 * (1 + math.cos(math.pi * (step - warmup) / max(total - warmup, 1)))


class Trainer:
    """A network in training.

    total_steps: length of the schedule. model is the bare network; trained: what the optimiser
    steps, the model or something larger that holds it. Gradients are averaged over the processes of
    `team`, so that together they take the step of the joint batch (with batch-normalisation
    statistics of each process's part, except on GPUs).
    """

    def __init__(
        self, model: GraspNet, settings: TrainConfig, total_steps: int, team: Team,
        trained: nn.Module | None = None,
    ):  # fmt: skip
        if settings.batch_size % team.ranks:
            raise UserError(
                f"train.batch_size is {settings.batch_size}, but {team.ranks} processes have to "
                "share it equally; make it a multiple"
            )
        self.settings, self.team, self.total_steps, self.step = settings, team, total_steps, 0
        self.precision = choose_precision(settings.precision, team.device)
        model = model.to(team.device, memory_format=torch.channels_last)
        if team.ranks > 1 and team.device.type == "cuda":
            model = nn.SyncBatchNorm.convert_sync_batchnorm(model)
        self.model = model
        self.trained = model if trained is None else trained.to(team.device)
        self._parallel = DistributedDataParallel(self.trained) if team.ranks > 1 else self.trained
        self.loss = GraspLoss(
            settings.quality_weight,
            settings.angle_weight,
            settings.width_weight,
            settings.centre_weight,
        )
        self.optimizer = torch.optim.AdamW(
            self.trained.parameters(), lr=settings.lr, weight_decay=settings.weight_decay
        )
        self.scheduler = torch.optim.lr_scheduler.LambdaLR(
            self.optimizer,
            lambda step: warm_up_and_cosine(step, total_steps, settings.warmup_share),
        )
        self.scaler = torch.amp.GradScaler(
            team.device.type, enabled=self.precision == torch.float16
        )

    def train_step(self, batch: Example) -> dict[str, float]:
        """One optimiser step; the loss and its parts. UserError if the loss is not finite."""
        self._parallel.train()
        total, parts = self.losses(batch)
        if not torch.isfinite(total):
            raise UserError(
                f"the loss is {total.item()} at step {self.step}; the weights of the last "
                "checkpoint are sound: lower train.lr or use train.precision=float32"
            )
        self.optimizer.zero_grad(set_to_none=True)
        self.scaler.scale(total).backward()
        self.scaler.unscale_(self.optimizer)
        nn.utils.clip_grad_norm_(self.trained.parameters(), GRADIENT_LIMIT)
        self.scaler.step(self.optimizer)
        self.scaler.update()
        self.scheduler.step()
        self.step += 1
        return {"loss": total.item(), **{name: value.item() for name, value in parts.items()}}

    def losses(self, batch: Example) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """The loss of a batch and its parts, in the chosen precision."""
        device = self.team.device
        image = batch.image.to(device, memory_format=torch.channels_last, non_blocking=True)
        targets = type(batch.targets)(*(t.to(device, non_blocking=True) for t in batch.targets))
        mixed = self.precision != torch.float32
        with torch.autocast(device.type, dtype=self.precision, enabled=mixed):
            centres = self.model.centre_head is not None
            quality, angle, width, *offset = self._parallel(image, logits=True, centres=centres)
        return self.loss(quality, angle, width, targets, *offset)

    def save(self, path: Path, config: Config, metres_per_pixel: float, **extra: Any) -> None:
        """Everything that `load` needs to go on as if nothing had happened, bit for bit on the
        same device and number of processes."""
        save_checkpoint(
            path,
            kind=KIND,
            model_args=self.model.model_args,
            model=self.ordinary_model(),
            optimizer=self.optimizer,
            scheduler=self.scheduler,
            step=self.step,
            rng=rng_states({}),
            config=config.model_dump(mode="json"),
            extra={
                PIXEL_SIZE: metres_per_pixel,
                "scaler": self.scaler.state_dict(),
                **self.more_state(),
                **extra,
            },
        )

    def load(self, path: Path) -> dict[str, Any]:
        """Go on from a checkpoint of `save`; returns its extra entries."""
        checkpoint = load_checkpoint(
            path, KIND, model_args=self.model.model_args, map_location=self.team.device
        )
        if checkpoint["optimizer"] is None:
            raise UserError(f"{path}: holds weights only, no training to go on with")
        self.take_weights(checkpoint, path)
        self.optimizer.load_state_dict(checkpoint["optimizer"])
        self.scheduler.load_state_dict(checkpoint["scheduler"])
        if checkpoint["extra"]["scaler"]:  # empty from a device that needed none, such as a CPU
            self.scaler.load_state_dict(checkpoint["extra"]["scaler"])
        self.step = checkpoint["step"]
        restore_rng(checkpoint["rng"], {})
        return checkpoint["extra"]

    def ordinary_model(self) -> GraspNet:
        """The network as a checkpoint holds it, for `load_graspnet`."""
        return self.model

    def more_state(self) -> dict[str, Any]:
        """What a checkpoint has to hold of a training besides, plain."""
        return {}

    def take_weights(self, checkpoint: dict[str, Any], path: Path) -> None:
        """Put back what `ordinary_model` and `more_state` gave."""
        load_weights(self.model, checkpoint, path)
