"""GraspNet as a planner: a trained network finds the grasps, the same depth image makes them exact.

It sees nothing but the RGB-D image.
"""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np

from models.grasp_refinement import refine
from models.graspnet import PeakSettings
from models.graspnet_io import SHIPPED, SavedGraspNet, for_inference, load_graspnet
from models.prediction import predict_grasps
from utils.geometry import GripperGeometry, Workspace
from utils.height_map import height_map_from_frame
from utils.transforms import Grasp, RGBDFrame

# Many and doubtful ones too: what fits the depth image is then ranked anew. The wide blur prefers
# the middle of a good region, as fingers do.
PEAKS = PeakSettings(threshold=0.05, count=60, blur=2.0)
RETURNED = 20
_MARGIN = 0.05  # m around the workspace; objects that rolled a little way out are still in the game


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
    ):
        changed = checkpoint.stat().st_mtime if checkpoint.exists() else 0.0
        self.network = network or _loaded(checkpoint, changed)
        self.gripper, self.workspace = gripper, workspace

    def reset(self, seed: int) -> None:
        """Nothing to do: the planner is deterministic."""

    def __call__(self, frame: RGBDFrame) -> list[Grasp]:
        found = predict_grasps(
            self.network.model,
            self.network.metres_per_pixel,
            frame,
            self.workspace.table_height,
            count=PEAKS.count,
            gripper=self.gripper,
            peaks=PEAKS,
        )
        reach = self.workspace.size / 2 + _MARGIN
        near = [
            grasp.in_world
            for grasp in found
            if np.abs(grasp.in_world.position[:2] - self.workspace.centre).max() < reach
        ]
        if not near:
            return []
        exact = refine(near, height_map_from_frame(frame, self.workspace), self.gripper)
        # Where nothing fits, a poor attempt may still move or clear an object; none ends the round.
        return (exact or near)[:RETURNED]
