"""Training of GraspNet: the network to train, precision, schedule, steps, exact resume.

This module knows neither the source of the batches nor how a trained network is judged.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn
from torch.nn.parallel import DistributedDataParallel

from models.graspnet import GraspLoss, GraspNet, create_model
from models.graspnet_data import Example
from models.graspnet_io import KIND, PIXEL_SIZE, load_graspnet, load_initial
from utils.checkpoint import (
    load_checkpoint,
    load_weights,
    reading,
    restore_rng,
    rng_states,
    save_checkpoint,
)
from utils.config import Config
from utils.config_schema import TrainConfig
from utils.distributed import Team
from utils.errors import UserError

GRADIENT_LIMIT = 5.0  # of the gradient's norm; only the first steps ever reach it


def choose_precision(name: str, device: torch.device) -> torch.dtype:
    """Return the type in which matrix products are computed.

    name: a type's name or auto, which is float16 on a GPU, bfloat16 on a CPU that has instructions
    for it, else float32.
    """
    if name != "auto":
        return getattr(torch, name)
    if device.type == "cuda":
        return torch.float16
    has_bfloat16 = torch.cpu.get_capabilities().get("avx512_bf16", False)
    return torch.bfloat16 if has_bfloat16 else torch.float32


def warm_up_and_cosine(step: int, total: int, warmup_share: float) -> float:
    """Return the factor on the learning rate at a step: a linear warm-up, then a half cosine down
    to 0 (Loshchilov and Hutter, "SGDR", 2017, without restarts)."""
    warmup = warmup_share * total
    if step < warmup:
        return (step + 1) / (warmup + 1)
    return 0.5 * (1 + math.cos(math.pi * (step - warmup) / max(total - warmup, 1)))


def make_network(config: Config, max_width: float, quiet: bool = False) -> GraspNet:
    """Make the network that the config describes; raises UserError if that is impossible. quiet:
    without a remark on its first weights."""
    # Only simulated images are labelled with centres of mass.
    centre_head = config.data.kind == "simulated" and config.train.centre_weight > 0
    model = create_model(name=config.train.backbone, max_width=max_width, centre_head=centre_head)
    if config.train.initial is not None:
        load_initial(model, config.train.initial, quiet)
    return model


def check_network(config: Config) -> None:
    """Raise UserError if the network that the config describes cannot be made."""
    initial, width = config.train.initial, config.gripper.max_opening
    make_network(config, width if initial is None else load_graspnet(initial).model.max_width)


class Trainer:
    """A network in training.

    total_steps: length of the schedule. model: the bare network. trained: the module whose
    parameters the optimiser changes, by default the model, else a module that contains it.
    epochs_before: how many epochs it had finished when it was resumed.
    Gradients are averaged over the processes of `team`, so that these together take the step of the
    joint batch (with batch-normalisation statistics of each process's part, except on GPUs).
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
        self.epochs_before = 0
        self.precision = choose_precision(settings.precision, team.device)
        model = model.to(team.device, memory_format=torch.channels_last)
        if team.ranks > 1 and team.device.type == "cuda":
            model = nn.SyncBatchNorm.convert_sync_batchnorm(model)
        self.model = model
        self.trained = model if trained is None else trained.to(team.device)
        self._parallel = DistributedDataParallel(self.trained) if team.ranks > 1 else self.trained
        self.loss = GraspLoss(
            quality_weight=settings.quality_weight,
            angle_weight=settings.angle_weight,
            width_weight=settings.width_weight,
            centre_weight=settings.centre_weight,
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

    @property
    def was_finished(self) -> bool:
        """Whether no epoch was left to train when it was resumed."""
        return self.epochs_before == self.settings.epochs

    def announcement(self, config: Config, images: int, run: Path) -> str:
        """What is trained on how many images, or that this was done before, in one line."""
        if self.was_finished:
            return f"{run} was finished before, after {self.epochs_before} epochs: nothing to train"
        target = config.adaptation.target
        return (
            f"{self.describe()}, on {images} {config.data.kind} images"
            f"{'' if target is None else f', adapted to {target}'}, for {self.settings.epochs} "
            f"epochs, seed {config.seed}; results in {run}"
        )

    def describe(self) -> str:
        """Describe the network and the processes that train it."""
        parameters = sum(p.numel() for p in self.model.parameters())
        return (
            f"GraspNet {self.model.model_args['backbone']}, {parameters:,} parameters, "
            f"{self.team.ranks} process(es), {self.team.device}, "
            f"{str(self.precision).removeprefix('torch.')}"
        )

    def train_step(self, batch: Example) -> dict[str, float]:
        """Take one optimiser step; returns the loss and its parts.

        Raises UserError, without changing a weight, if the loss is not finite.
        """
        self._parallel.train()
        total, parts = self.losses(batch)
        if not torch.isfinite(total):
            raise UserError(
                f"the loss is {total.item()} at step {self.step}; start a new run with a lower "
                "train.lr or with train.precision=float32, from the weights of this run's last.pt "
                "(train.initial=RUN/last.pt) where there is one: they are sound"
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
        """Return the loss of a batch and its parts, in the chosen precision."""
        device = self.team.device
        image = batch.image.to(device, memory_format=torch.channels_last, non_blocking=True)
        targets = type(batch.targets)(*(t.to(device, non_blocking=True) for t in batch.targets))
        mixed = self.precision != torch.float32
        with torch.autocast(device.type, dtype=self.precision, enabled=mixed):
            centres = self.model.centre_head is not None
            quality, angle, width, *offset = self._parallel(image, logits=True, centres=centres)
        return self.loss(quality, angle, width, targets, *offset)

    def save(self, path: Path, config: Config, metres_per_pixel: float, **extra: Any) -> None:
        """Write a checkpoint from which `load` continues the training, bit for bit on the same
        device and number of processes. extra: plain entries to keep beside it."""
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

    def resume(self, path: Path) -> tuple[list[dict[str, float]], list[dict[str, float]]]:
        """Continue from a checkpoint if it exists; returns its entries `history` and `losses`."""
        saved = self.load(path) if path.is_file() else {}
        history = saved.get("history", [])
        self.epochs_before = len(history)
        return history, saved.get("losses", [])

    def load(self, path: Path) -> dict[str, Any]:
        """Continue from a checkpoint of `save`; returns its extra entries."""
        checkpoint = load_checkpoint(
            path, KIND, model_args=self.model.model_args, map_location=self.team.device
        )
        if checkpoint["optimizer"] is None:
            raise UserError(f"{path}: holds weights only, no training to go on with")
        with reading(path):
            self.take_weights(checkpoint, path)
            self.optimizer.load_state_dict(checkpoint["optimizer"])
            self.scheduler.load_state_dict(checkpoint["scheduler"])
            if checkpoint["extra"]["scaler"]:  # empty from a device that needed none, as a CPU
                self.scaler.load_state_dict(checkpoint["extra"]["scaler"])
            self.step = checkpoint["step"]
            restore_rng(checkpoint["rng"], {})
        return checkpoint["extra"]

    def ordinary_model(self) -> GraspNet:
        """Return the network that a checkpoint holds for `load_graspnet`."""
        return self.model

    def more_state(self) -> dict[str, Any]:
        """Return further plain entries that a checkpoint needs to resume the training."""
        return {}

    def take_weights(self, checkpoint: dict[str, Any], path: Path) -> None:
        """Load the weights that `ordinary_model` and `more_state` gave to the checkpoint."""
        load_weights(self.model, checkpoint, path)


def mean_of(rows: Sequence[dict[str, float]]) -> dict[str, float]:
    """Average every entry over rows that have the same names."""
    return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
