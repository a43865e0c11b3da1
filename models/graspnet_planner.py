"""GraspNet as a planner: the depth image tells which grasps fit, the network what they are worth.

A network names places well to a few millimetres; fingers need better than that beside an object.
So the antipodal search of the other planners proposes exact poses, and what the network says of
their places and angles ranks them: before they are measured on the height map, so that few have to
be, and after. Its votes for centres of mass tell the objects apart, and the colours what a hole in
the depth image is. Nothing but the RGB-D image is seen.
"""

from __future__ import annotations

import functools
from pathlib import Path

import cv2
import numpy as np
import torch

from models.antipodal import SearchSettings, search
from models.candidates import Candidates
from models.graspnet_io import SHIPPED, SavedGraspNet, for_inference, load_graspnet
from models.instances import labelled_by_centres
from models.prediction import scaled_maps
from utils.depth_holes import table_in_holes
from utils.geometry import GripperGeometry, Workspace
from utils.height_map import height_map_from_frame
from utils.transforms import Grasp, RGBDFrame, project

# Half the heuristic's angles: turning onto the faces and the network make up for it. What belongs
# together is known better than by height alone.
SETTINGS = SearchSettings(angles=9, shortlist=120, finalists=120, split_factor=0.1)
BLUR = 1.0  # pixels, standard deviation of the Gaussian over the quality
LEAST = 0.02  # quality that anything has which fits


@functools.cache
def _loaded(path: Path, changed: float) -> SavedGraspNet:
    saved = load_graspnet(path)
    return saved._replace(model=for_inference(saved.model))


class GraspNetPlanner:
    """The network of a checkpoint, unless one is given. UserError if it cannot be loaded."""

    needs_truth = False

    def __init__(
        self,
        gripper: GripperGeometry,
        workspace: Workspace,
        seed: int = 0,
        checkpoint: Path = SHIPPED,
        network: SavedGraspNet | None = None,
        settings: SearchSettings = SETTINGS,
    ):
        changed = checkpoint.stat().st_mtime if checkpoint.exists() else 0.0
        self.network = network or _loaded(checkpoint, changed)
        self.gripper, self.workspace, self.settings = gripper, workspace, settings

    def reset(self, seed: int) -> None:
        """Nothing to do: the planner is deterministic."""

    def __call__(self, frame: RGBDFrame) -> list[Grasp]:
        model, metres_per_pixel, *_ = self.network
        frame = table_in_holes(frame, self.workspace.table_height)
        knows_centres = model.centre_head is not None
        scaling, maps = scaled_maps(model, metres_per_pixel, frame, knows_centres)
        heights = height_map_from_frame(frame, self.workspace)

        def value(candidates: Candidates) -> np.ndarray:
            xy, (along, _) = candidates.xy, candidates.axes()
            surface = np.column_stack([xy, heights.height[heights.index(xy)]])
            ends = surface + 0.01 * np.stack([-along, along]) @ np.eye(2, 3)
            pixels, _ = project(ends, frame.K, frame.T_WC)
            return np.maximum(quality_between(maps, *scaling.pixels(pixels)), LEAST)

        if knows_centres:
            heights = labelled_by_centres(heights, frame, scaling, maps[3][0].numpy())
        found = search(heights, self.gripper, self.workspace, self.settings, value)
        found = found.distinct(
            self.settings.returned, self.settings.distinct_distance, self.settings.distinct_turn
        )
        return found.grasps(self.gripper)


def quality_between(
    maps: tuple[torch.Tensor, torch.Tensor, torch.Tensor], start: np.ndarray, end: np.ndarray
) -> np.ndarray:
    """(N,) what a network's maps say of closing along the lines from `start` to `end` (N, 2), in
    the maps' pixels: the quality in their middle times the share of the best angle's that theirs
    has. The cube root turns the bins' probabilities into qualities (`targets_from_labels`)."""
    quality = cv2.GaussianBlur(maps[0][0, 0].numpy(), (0, 0), BLUR)
    u, v = np.rint((start + end) / 2).astype(int).T
    u, v = np.clip(u, 0, quality.shape[1] - 1), np.clip(v, 0, quality.shape[0] - 1)
    share = np.cbrt(maps[1][0, :, v, u].softmax(dim=0).numpy())
    bins, each = len(share), np.arange(len(u))
    du, dv = (end - start).T
    place = np.mod(np.arctan2(dv, du), np.pi) * bins / np.pi  # between two bins
    below, part = np.floor(place).astype(int), place - np.floor(place)
    at = (1 - part) * share[below % bins, each] + part * share[(below + 1) % bins, each]
    return quality[v, u] * at / share.max(axis=0)
