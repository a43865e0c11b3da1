"""Steps of a Trainer alone or, started by torchrun, of several.

    python -m tests.helpers.one_step FOLDER

Every process leaves its gradients of the first step and its weights after three in FOLDER.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

import torch

from models.graspnet import create_model, targets_from_labels
from models.graspnet_data import Example
from models.graspnet_training import Trainer
from utils.config import load_config
from utils.distributed import Team, team

BATCH = 4
SETTINGS = ["train.precision=float32", f"train.batch_size={BATCH}", "train.lr=1e-3"]


def joint_batch(step: int) -> Example:
    """Images whose numbers of graspable and of labelled pixels differ much."""
    rng = torch.Generator().manual_seed(step)
    quality = torch.rand(BATCH, 18, 36, 24, generator=rng)
    quality *= torch.tensor([0.1, 0.31, 0.5, 1.0])[:, None, None, None]
    width = 0.08 * torch.rand(quality.shape, generator=rng)
    valid = (torch.rand(BATCH, 1, 36, 24, generator=rng) < 0.5).float()
    valid[1] = 1
    image = torch.rand(BATCH, 4, 36, 24, generator=rng) - 0.5
    offset = 20 * torch.randn(BATCH, 2, 36, 24, generator=rng)
    offset[1] = torch.nan  # shows no object
    offset[2, :, 5:] = torch.nan
    return Example(image, targets_from_labels(quality, width, valid, 0.3, offset))


def part_of(batch: Example, rank: int, ranks: int) -> Example:
    own = slice(rank, None, ranks)
    return Example(batch.image[own], type(batch.targets)(*(t[own] for t in batch.targets)))


def take_steps(us: Team) -> dict[str, dict[str, torch.Tensor]]:
    torch.manual_seed(us.rank)  # other weights in every process: those of the first have to count
    model = create_model(name="ggcnn", max_width=0.08, centre_head=True)
    trainer = Trainer(model, load_config(None, SETTINGS).train, 10, us)
    gradients = {}
    for step in range(3):
        trainer.train_step(part_of(joint_batch(step), us.rank, us.ranks))
        gradients = gradients or {n: p.grad.clone() for n, p in trainer.model.named_parameters()}
    return {"gradients": gradients, "weights": trainer.model.state_dict()}


if __name__ == "__main__":
    torch.set_num_threads(1)
    with team("cpu", dict(os.environ)) as us:
        torch.save(take_steps(us), Path(sys.argv[1]) / f"{us.rank}.pt")
