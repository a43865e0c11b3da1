"""Updates of a GraspPPO alone or, started by torchrun, of several.

    python -m tests.helpers.ppo_step FOLDER

Every process leaves its gradient of the first minibatch and its weights after it in FOLDER.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

import torch

from tests.helpers.ppo_parts import batch_of, ppo_of
from utils.distributed import Team, team

SIZE = 16


def take_step(us: Team) -> dict[str, torch.Tensor]:
    ppo = ppo_of(seed=us.rank, team=us)  # other weights in every process: the first one's count
    batch = batch_of(SIZE)
    ppo.gradient(ppo.losses(batch.rows(slice(us.rank, None, us.ranks))).loss)
    gradient = ppo.weights.grad.clone()
    ppo.optimizer.step()
    ppo.network.observe(batch.rows(slice(us.rank, None, us.ranks)).observations, us)
    return {"gradient": gradient, **ppo.network.state_dict()}


if __name__ == "__main__":
    torch.set_num_threads(1)
    with team("cpu", dict(os.environ)) as us:
        torch.save(take_step(us), Path(sys.argv[1]) / f"{us.rank}.pt")
        if us.ranks > 1:
            torch.distributed.barrier()  # nobody leaves while another one still exchanges
