"""GraspNet as a planner: a trained network that sees only the RGB-D image."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np

from models.graspnet_io import SavedGraspNet, for_inference, load_graspnet
from models.prediction import predict_grasps
from utils.geometry import GripperGeometry, Workspace
from utils.transforms import Grasp, RGBDFrame

SHIPPED = Path(__file__).resolve().parent.parent / "checkpoints" / "graspnet.pt"
_MARGIN = 0.05  # m around the workspace; objects that rolled a little way out are still in the game


@functools.cache
def _loaded(path: Path, changed: float) -> SavedGraspNet:
    saved = load_graspnet(path)
    return saved._replace(model=for_inference(saved.model))


class GraspNetPlanner:
    """The network of a checkpoint. Raises UserError if that cannot be loaded."""

    needs_truth = False

    def __init__(
        self,
        gripper: GripperGeometry,
        workspace: Workspace,
        seed: int = 0,
        checkpoint: Path = SHIPPED,
    ):
        changed = checkpoint.stat().st_mtime if checkpoint.exists() else 0.0
        self.network = _loaded(checkpoint, changed)
        self.gripper, self.workspace = gripper, workspace

    def reset(self, seed: int) -> None:
        """Nothing to do: the planner is deterministic."""

    def __call__(self, frame: RGBDFrame) -> list[Grasp]:
        model, metres_per_pixel = self.network.model, self.network.metres_per_pixel
        table_height = self.workspace.table_height
        found = predict_grasps(model, metres_per_pixel, frame, table_height, gripper=self.gripper)
        reach = self.workspace.size / 2 + _MARGIN
        return [
            grasp.in_world
            for grasp in found
            if np.abs(grasp.in_world.position[:2] - self.workspace.centre).max() < reach
        ]
