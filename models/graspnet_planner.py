"""GraspNet as a planner: the depth image tells which grasps fit, the network what they are worth.

A network names places well to a few millimetres; fingers need better than that beside an object.
So the antipodal search of the other planners proposes exact poses, and the network's quality at
each of them ranks them: before they are measured on the height map, so that few have to be, and
after. Nothing but the RGB-D image is seen.
"""

from __future__ import annotations

import functools
from pathlib import Path

import cv2
import numpy as np

from models.antipodal import SearchSettings, search
from models.candidates import Candidates
from models.graspnet_io import SHIPPED, SavedGraspNet, for_inference, load_graspnet
from models.prediction import scaled_maps
from utils.geometry import GripperGeometry, Workspace
from utils.height_map import HeightMap, height_map_from_frame
from utils.transforms import Grasp, RGBDFrame, project

# Coarser than the heuristic's: turning onto the faces and the network make up for it.
SETTINGS = SearchSettings(angles=9, level_step=0.009, shortlist=120, finalists=120)
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
        scaling, maps = scaled_maps(self.network.model, self.network.metres_per_pixel, frame)
        quality = cv2.GaussianBlur(maps[0][0, 0].numpy(), (0, 0), BLUR)
        quality = scaling.original_map(quality, frame.depth.shape)
        heights = height_map_from_frame(frame, self.workspace)
        found = search(
            heights,
            self.gripper,
            self.workspace,
            self.settings,
            lambda candidates: np.maximum(seen_quality(candidates, quality, heights, frame), LEAST),
        )
        found = found.distinct(self.settings.returned, 0.01, np.deg2rad(20))
        return found.grasps(self.gripper)


def seen_quality(
    candidates: Candidates, quality: np.ndarray, heights: HeightMap, frame: RGBDFrame
) -> np.ndarray:
    """(N,) of the map `quality` (H, W) at the pixels that show the surface over each candidate."""
    surface = heights.height[heights.index(candidates.xy)]
    pixels, _ = project(np.column_stack([candidates.xy, surface]), frame.K, frame.T_WC)
    u, v = np.rint(pixels).astype(int).T
    rows, columns = quality.shape
    return quality[np.clip(v, 0, rows - 1), np.clip(u, 0, columns - 1)]
