"""How likely the contacts of a grasp are what they seem: a small network on measured quantities.

From one side the far contact of a grasp is a guess, and the search picks the grasps whose guesses
look best. The critic has seen on training scenes which of them were true: its inputs are what the
search measures (`models.planner_antipodal.measure`), how the closing line lies to the vertical and
to the camera, and the grasp network's value; its output is the chance that exact contacts hold,
there or a few millimetres beside (`models.planner_contacts.exact_quality`), and the open hand has
room. `benchmarks.train_critic`
trains it. This module knows neither images nor scenes.
"""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
import torch
from torch import nn

from models.planner_candidates import FACTS, Candidates
from utils.checkpoint import build_model, load_checkpoint
from utils.height_map import HeightMap

SHIPPED = Path(__file__).resolve().parent.parent / "checkpoints" / "critic.pt"
KIND = "critic"
VIEW_INPUTS = (
    "tilt", "closing_slope", "closing_to_camera", "approach_to_camera", "camera_height", "value",
    "tip_rise", "log_score", "width", "turn",
)  # fmt: skip
INPUTS = (*VIEW_INPUTS, *FACTS)
_LEAST = 1e-6  # of scores and values, in their logarithms


class GraspCritic(nn.Module):
    """Inputs (N, len(INPUTS)) as `critic_inputs` has them to logits (N,) of the chance.

    mean, scale: of the training inputs, part of the weights.
    """

    def __init__(self, inputs: int = len(INPUTS), width: int = 64):
        super().__init__()
        self.model_args = {"inputs": inputs, "width": width}
        self.register_buffer("mean", torch.zeros(inputs))
        self.register_buffer("scale", torch.ones(inputs))
        self.layers = nn.Sequential(
            nn.Linear(inputs, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU(),
            nn.Linear(width, 1),
        )  # fmt: skip

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        # Outside of what training has seen, an input says no more than at its border.
        return self.layers(((x - self.mean) / self.scale).clamp(-5, 5))[:, 0]

    @torch.inference_mode()
    def chance(self, inputs: np.ndarray) -> np.ndarray:
        """(N,) chances in 0..1 of inputs (N, len(INPUTS))."""
        return self(torch.from_numpy(inputs)).sigmoid().numpy().astype(float)


def critic_inputs(
    found: Candidates, heights: HeightMap, value: np.ndarray, towards: np.ndarray
) -> np.ndarray:
    """(N, len(INPUTS)) float32 for measured candidates on a height map.

    value: (N,) of the grasp network. towards: (3,) unit vector in W from the scene to the camera.
    """
    R, count = heights.T_WV[:3, :3], len(found)
    along, _ = found.axes()
    closing, approach = along @ R[:, :2].T, -R[:, 2]
    tip = np.column_stack([found.xy, found.tip])
    view = (
        np.full(count, np.arccos(np.clip(-approach[2], -1, 1))),
        np.abs(closing[:, 2]),
        np.abs(closing @ towards),
        np.full(count, -approach @ towards),
        np.full(count, towards[2]),
        np.log(np.maximum(value, _LEAST)),
        heights.rise(tip),
        np.log(np.maximum(found.score, _LEAST)),
        found.width,
        np.abs(found.turn),
    )
    return np.column_stack([*view, found.facts]).astype(np.float32)


def load_critic(path: Path | str) -> GraspCritic:
    """The critic of a file, in evaluation mode. Raises UserError, naming the file, where it is
    missing, damaged or of another architecture."""
    expected = GraspCritic().model_args
    return build_model(GraspCritic, load_checkpoint(path, KIND, model_args=expected), path)


@functools.cache
def shipped_critic() -> GraspCritic:
    return load_critic(SHIPPED)
