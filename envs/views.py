"""Views from the side, drawn for each scene, as protocols of clutter removal have them.

The ranges are keys of the config's section `camera`. This module knows no simulator.
"""

from __future__ import annotations

import numpy as np

from utils.config import CameraConfig, WorkspaceConfig
from utils.errors import UserError
from utils.random_streams import Stream
from utils.transforms import look_at, project


def side_view(camera: CameraConfig, workspace: WorkspaceConfig, seed: int) -> np.ndarray:
    """(4, 4) T_WC of a camera that looks at the workspace's centre on the table from the side.

    Tilt, distance and azimuth are uniform in their ranges; the same seed gives the same pose.
    """
    rng = np.random.default_rng([seed, Stream.SIDE_VIEW])
    tilt, azimuth = (
        np.radians(rng.uniform(*bounds))
        for bounds in (camera.side_tilt_deg, camera.side_azimuth_deg)
    )
    level, up = np.sin(tilt), np.cos(tilt)
    outwards = np.array([level * np.cos(azimuth), level * np.sin(azimuth), up])
    centre = np.array([*workspace.center, 0.0])
    eye = centre + rng.uniform(*camera.side_distance) * outwards
    return look_at(eye, centre, (0.0, 0.0, 1.0))


def check_sees_workspace(camera: CameraConfig, K: np.ndarray, workspace: WorkspaceConfig) -> None:
    """Raise UserError where a fixed camera with intrinsics K shows no place of the workspace.

    No planner would find a grasp, and every policy would be scored with 0 %. Cameras of other
    mounts and views follow the hand or the workspace.
    """
    if camera.mount != "overhead" or camera.view != "fixed":
        return
    steps = np.linspace(-0.5, 0.5, 21) * workspace.size
    x, y = np.meshgrid(workspace.center[0] + steps, workspace.center[1] + steps)
    places = np.stack([x, y, np.zeros_like(x)], axis=-1)
    T_WC = look_at(camera.position, camera.target, camera.up)
    pixels, depth = project(places, K, T_WC)
    last = np.array([camera.width, camera.height]) - 0.5
    inside = ((pixels > -0.5) & (pixels < last)).all(axis=-1)
    if not (inside & (depth > camera.near) & (depth < camera.far)).any():
        raise UserError(
            "camera: sees nothing of the workspace, the square of the table with the side "
            f"{workspace.size:g} m around ({workspace.center[0]:g}, {workspace.center[1]:g}); "
            "point camera.target there, or change camera.position, camera.fov_deg, camera.near or "
            "camera.far"
        )
