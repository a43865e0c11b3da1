"""How likely a grasp that was found on a height map succeeds: a small network on its surroundings.

From one side the far contact of a grasp is a guess, and the search picks the grasps whose guesses
look best. The critic has seen on training scenes which of them held. It looks at the heights around
the hand, seen and possible, drawn in the frame of the closing line, as GQ-CNN looks at a depth
image (Mahler et al., Dex-Net 2.0, RSS 2017), and at what the search measured
(`models.planner_measure.measure`), how the closing line lies to the vertical and to the camera,
how large the object looks, which tells of a light and of a heavy one, how narrow a hand counts as
empty, and the grasp network's value. `benchmarks.train_critic` trains it on executed grasps. This
module knows neither images nor scenes.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import nn

from models.planner_candidates import FACTS, Candidates
from models.planner_measure import cells_around
from utils.checkpoint import build_model, load_checkpoint
from utils.compiled import compiled
from utils.height_map import HeightMap

SHIPPED = Path(__file__).resolve().parent.parent / "checkpoints" / "critic.pt"
KIND = "critic"
VIEW_INPUTS = (
    "tilt", "closing_slope", "closing_to_camera", "approach_to_camera", "camera_height", "value",
    "tip_rise", "log_score", "width", "turn",
)  # fmt: skip
# Metres of the grasp's object as the map shows it: extents along and across the closing line, and
# the edge of a cube of the volume under its surface.
OBJECT_INPUTS = ("extent_along", "extent_across", "edge")
# At last the width at which the hand counts as empty (`GripperGeometry.least_held`).
INPUTS = (*VIEW_INPUTS, *FACTS, *OBJECT_INPUTS, "least_held")
LEAST_LOGGED = 1e-6  # of scores and values, in their logarithms

STEP = 0.004  # m between the cells of a patch
ALONG, ACROSS = 48, 24  # cells: the whole palm along the closing line, the fingers' surroundings
MOST = 0.1  # m over and under the fingertips, beyond which a height tells no more
_LAYERS = 3  # of a patch: heights, ceilings, and where the grasp's own object is
_AT_ONCE = 4096  # candidates
UNIT = 0.001  # m of a patch's heights, which are whole numbers


class CriticInputs(NamedTuple):
    """What the critic sees of N candidates.

    facts: (N, len(INPUTS)) float32, metres and radians. patches: (N, 3, V, U) int8, the map's
    heights and ceilings over the fingertips in millimetres, and 1 where the map has the candidate's
    object; U runs along the closing line, V across it.
    """

    facts: np.ndarray
    patches: np.ndarray

    def take(self, index: np.ndarray) -> CriticInputs:
        return CriticInputs(self.facts[index], self.patches[index])

    @staticmethod
    def joined(parts: list[CriticInputs]) -> CriticInputs:
        return CriticInputs(*(np.concatenate(column) for column in zip(*[nothing(), *parts])))


def nothing() -> CriticInputs:
    """The inputs of no candidate."""
    patches = np.empty((0, _LAYERS, ACROSS, ALONG), np.int8)
    return CriticInputs(np.empty((0, len(INPUTS)), np.float32), patches)


class GraspCritic(nn.Module):
    """Facts (N, len(INPUTS)) and patches (N, 3, V, U) of `CriticInputs`, as float32 and int8, to
    logits (N,) of the chance.

    mean, scale: of the training facts, part of the weights.
    """

    def __init__(self, inputs: Sequence[str] = INPUTS, channels: Sequence[int] = (24, 48, 64)):
        super().__init__()
        self.model_args = {"inputs": list(inputs), "channels": list(channels)}
        self.register_buffer("mean", torch.zeros(len(inputs)))
        self.register_buffer("scale", torch.ones(len(inputs)))
        first, second, third = channels
        self.patch = nn.Sequential(
            nn.Conv2d(_LAYERS, first, 5, stride=2, padding=2), nn.ReLU(),
            nn.Conv2d(first, second, 3, stride=2, padding=1), nn.ReLU(),
            nn.Conv2d(second, third, 3, stride=2, padding=1), nn.ReLU(),
            nn.Flatten(), nn.Linear(third * ACROSS * ALONG // 64, 64), nn.ReLU(),
        )  # fmt: skip
        self.fact = nn.Sequential(nn.Linear(len(inputs), 64), nn.ReLU())
        self.layers = nn.Sequential(nn.Linear(128, 64), nn.ReLU(), nn.Linear(64, 1))

    def forward(self, facts: torch.Tensor, patches: torch.Tensor) -> torch.Tensor:
        # Outside of what training has seen, a fact says no more than at its border.
        facts = ((facts - self.mean) / self.scale).clamp(-5, 5)
        heights = patches[:, :2].float() * (UNIT / 0.03)
        # What may be hidden is told by how far the ceiling lies over the surface.
        seen = torch.cat(
            [heights[:, :1], heights[:, 1:] - heights[:, :1], patches[:, 2:].float()], dim=1
        )
        return self.layers(torch.cat([self.patch(seen), self.fact(facts)], dim=1))[:, 0]

    @torch.inference_mode()
    def chance(self, inputs: CriticInputs) -> np.ndarray:
        """(N,) chances in 0..1."""
        device = self.mean.device
        facts, patches = (torch.from_numpy(part).to(device).split(_AT_ONCE) for part in inputs)
        parts = [self(*some) for some in zip(facts, patches)]
        return torch.cat(parts).sigmoid().cpu().numpy().astype(float)


def critic_inputs(
    found: Candidates,
    heights: HeightMap,
    value: np.ndarray,
    towards: np.ndarray,
    least_held: float,
) -> CriticInputs:
    """What the critic sees of measured candidates on a height map.

    value: (N,) of the grasp network. towards: (3,) unit vector in W from the scene to the camera.
    least_held: of the gripper, m.
    """
    R, count = heights.T_WV[:3, :3], len(found)
    along, across = found.axes()
    closing, approach = along @ R[:, :2].T, -R[:, 2]
    tip = np.column_stack([found.xy, found.tip])
    view = (
        np.full(count, np.arccos(np.clip(-approach[2], -1, 1))),
        np.abs(closing[:, 2]),
        np.abs(closing @ towards),
        np.full(count, -approach @ towards),
        np.full(count, towards[2]),
        np.log(np.maximum(value, LEAST_LOGGED)),
        heights.rise(tip),
        np.log(np.maximum(found.score, LEAST_LOGGED)),
        found.width,
        np.abs(found.turn),
    )
    facts = [*view, found.facts, *object_size(found, heights), np.full(count, least_held)]
    u, v = (STEP * (np.arange(cells) - (cells - 1) / 2) for cells in (ALONG, ACROSS))
    where = cells_around(found.xy, along, across, u, v, heights)
    surfaces = (np.ascontiguousarray(part).ravel() for part in (heights.height, heights.ceiling))
    label = np.ascontiguousarray(heights.label).ravel()
    patches = _patches(where, found.tip, found.label, *surfaces, label)
    return CriticInputs(np.column_stack(facts).astype(np.float32), patches)


@compiled
def _patches(
    where: np.ndarray,
    tip: np.ndarray,
    own: np.ndarray,
    height: np.ndarray,
    ceiling: np.ndarray,
    label: np.ndarray,
) -> np.ndarray:
    """(N, 3, V, U) int8 as of `CriticInputs`, of the flat cells `where` (N, V, U) of a map. tip,
    own: (N,) of the candidates."""
    count, lines, places = where.shape
    patches = np.empty((count, _LAYERS, lines, places), np.int8)
    for i in range(count):
        for line in range(lines):
            for k in range(places):
                cell = where[i, line, k]
                rise = min(max(height[cell] - tip[i], -MOST), MOST)
                patches[i, 0, line, k] = int(np.rint(rise / UNIT))
                rise = min(max(ceiling[cell] - tip[i], -MOST), MOST)
                patches[i, 1, line, k] = int(np.rint(rise / UNIT))
                patches[i, 2, line, k] = label[cell] == own[i]
    return patches


def object_size(found: Candidates, heights: HeightMap) -> np.ndarray:
    """(3, N) OBJECT_INPUTS of candidates; 0 for those of no object."""
    over_table = np.maximum(heights.height - heights.table(), 0.0)
    row, column = np.nonzero(heights.label >= 0)
    cells = heights.label[row, column], over_table[row, column]
    return _sizes(found.label, *found.axes(), row, column, *cells, heights.cell)


@compiled
def _sizes(
    own: np.ndarray,
    along: np.ndarray,
    across: np.ndarray,
    row: np.ndarray,
    column: np.ndarray,
    label: np.ndarray,
    over_table: np.ndarray,
    cell: float,
) -> np.ndarray:
    """(3, N) as of `object_size`. own: (N,) the labels of candidates with the axes along and across
    (N, 2). row, column, label, over_table: (K,) of the map's cells of objects, m; `cell` m wide."""
    size = np.zeros((3, len(own)))
    for i in range(len(own)):
        least, most, volume = np.full(2, np.inf), np.full(2, -np.inf), 0.0
        for k in range(len(row)):
            if label[k] == own[i]:
                x, y = cell * column[k], cell * row[k]
                places = along[i, 0] * x + along[i, 1] * y, across[i, 0] * x + across[i, 1] * y
                for axis in range(2):
                    least[axis] = min(least[axis], places[axis])
                    most[axis] = max(most[axis], places[axis])
                volume += over_table[k]
        if most[0] >= least[0]:
            size[0, i], size[1, i] = most[0] - least[0] + cell, most[1] - least[1] + cell
            size[2, i] = np.cbrt(volume * cell**2)
    return size


def load_critic(path: Path | str) -> GraspCritic:
    """The critic of a file, in evaluation mode. Raises UserError, naming the file, where it is
    missing, damaged or of another architecture."""
    expected = GraspCritic().model_args
    return build_model(GraspCritic, load_checkpoint(path, KIND, model_args=expected), path)


@functools.cache
def shipped_critic() -> GraspCritic:
    return load_critic(SHIPPED).to(memory_format=torch.channels_last)  # quickest on CPUs
