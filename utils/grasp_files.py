"""grasps.json and grasps.png: what predict.py writes, and how it knows its own files again.

This module knows no planner and no network.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from utils.errors import UserError
from utils.geometry import Workspace
from utils.image_overlay import is_grasp_picture
from utils.result_formats import aligned
from utils.table_plane import Table
from utils.transforms import (
    Grasp,
    RGBDFrame,
    grasp_to_image,
    inverse_pose,
    position_quaternion,
    transform_points,
)

# Marks a grasps.json of predict.py. Version 1 had no planner, tilt, workspace, target, clearing and
# remarks.
MARK = {"format": "robot-grasping grasps", "version": 2}


def check_output(folder: Path) -> None:
    """Raise UserError where the results would overwrite files of another program."""
    if folder.exists() and not folder.is_dir():
        raise UserError(f"--out {folder}: exists and is no folder")
    text, drawing = folder / "grasps.json", folder / "grasps.png"
    for path, own in (
        (text, is_own_json(text)),
        (drawing, is_grasp_picture(drawing)),
    ):
        if path.exists() and not own:
            raise UserError(f"{path}: exists and was not written by predict.py; give another --out")


def is_own_json(path: Path) -> bool:
    """Whether a file is a grasps.json of this program."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(content, dict) and content.get("format") == MARK["format"]


def format_grasps(content: dict[str, Any]) -> str:
    """The grasps of a grasps.json as a table for people, best first, then those that clear."""
    lines = [
        [
            kind, str(rank), f"{grasp['quality']:.2f}",
            " ".join(f"{x:.0f}" for x in grasp["pixel"]), f"{1000 * grasp['width']:.0f} mm",
            f"{np.rad2deg(grasp['image_angle']):.0f} deg", f"{np.rad2deg(grasp['tilt']):.0f} deg",
        ]
        for kind in ("grasps", "clearing")
        for rank, grasp in enumerate(content[kind] or [], start=1)
    ]  # fmt: skip
    header = ("list", "rank", "quality", "pixel u v", "width", "image angle", "tilt")
    return aligned(header, lines, to_the_right=range(1, len(header)))


# --- The content ----------------------------------------------------------------------------


def scene_as_plain(
    frame: RGBDFrame, table: Table, workspace: Workspace, posed: bool
) -> dict[str, Any]:
    """Camera, table, workspace and target; `posed`: whether the world is the user's."""
    T_CW = inverse_pose(frame.T_WC)
    centre = np.array([*workspace.centre, workspace.table_height])
    return {
        "K": frame.K.tolist(),
        "T_WC": frame.T_WC.tolist() if posed else None,
        "table": {
            "estimated": table.share is not None,
            "normal_camera": T_CW[:3, 2].tolist(),
            "camera_height": float(frame.T_WC[2, 3] - table.height),
            "height_world": table.height if posed else None,
        },
        "workspace": {
            "size": workspace.size,
            "centre_camera": transform_points(T_CW, centre).tolist(),
            "centre_world": centre.tolist() if posed else None,
        },
        "target": None if frame.target is None else target_as_plain(frame.target),
    }


def target_as_plain(target: np.ndarray) -> dict[str, Any]:
    """Number of pixels of a target (H, W) bool, and their first and last column and row."""
    v, u = np.nonzero(target)
    return {"pixels": len(u), "box": [int(x) for x in (u.min(), v.min(), u.max(), v.max())]}


def grasps_as_plain(grasps: Sequence[Grasp], frame: RGBDFrame, posed: bool) -> list[dict[str, Any]]:
    return [grasp_as_plain(grasp, frame, posed) for grasp in grasps]


def grasp_as_plain(grasp: Grasp, frame: RGBDFrame, posed: bool) -> dict[str, Any]:
    on_image = grasp_to_image(grasp, frame.K, frame.T_WC)
    plain = {
        "quality": grasp.quality,
        "pixel": on_image.pixel.tolist(),
        "image_angle": on_image.angle,
        "width": grasp.width,
        "tilt": grasp.tilt,
        "camera": pose_as_plain(inverse_pose(frame.T_WC) @ grasp.pose),
    }
    if posed:
        plain["world"] = {**pose_as_plain(grasp.pose), "angle": grasp.angle}
    return plain


def pose_as_plain(T: np.ndarray) -> dict[str, Any]:
    position, quaternion = position_quaternion(T)
    return {
        "position": position.tolist(),
        "rotation": T[:3, :3].tolist(),
        "quaternion": quaternion.tolist(),
    }
