"""train_graspnet.py as a module that loses one of its processes, once, within the second epoch."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import train_graspnet
from models.graspnet_training import Trainer
from utils.runs import run_script

LOST_AT = 6  # steps, of which the first four are an epoch


def lose_one(trainer: Trainer) -> None:
    if trainer.step == LOST_AT and trainer.team.rank == 1 and not Path("lost").exists():
        Path("lost").touch()
        os.kill(os.getpid(), signal.SIGKILL)


if __name__ == "__main__":
    whole_step = Trainer.train_step

    def train_step(trainer, batch):
        lose_one(trainer)
        return whole_step(trainer, batch)

    Trainer.train_step = train_step
    run_script(train_graspnet.main)
