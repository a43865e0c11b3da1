"""Views from the side, drawn for each scene, as protocols of clutter removal have them.

The ranges are keys of the config's section `camera`. This module knows no simulator.
"""

from __future__ import annotations

import numpy as np

from utils.config import CameraConfig, WorkspaceConfig
from utils.transforms import look_at

_STREAM = 11  # keeps these draws apart from others of the scene's seed


def side_view(camera: CameraConfig, workspace: WorkspaceConfig, seed: int) -> np.ndarray:
    """(4, 4) T_WC of a camera that looks at the workspace's centre on the table from the side.

    Tilt, distance and azimuth are uniform in their ranges; the same seed gives the same pose.
    """
    rng = np.random.default_rng([seed, _STREAM])
    tilt, azimuth = (
        np.radians(rng.uniform(*bounds))
        for bounds in (camera.side_tilt_deg, camera.side_azimuth_deg)
    )
    level, up = np.sin(tilt), np.cos(tilt)
    outwards = np.array([level * np.cos(azimuth), level * np.sin(azimuth), up])
    centre = np.array([*workspace.center, 0.0])
    eye = centre + rng.uniform(*camera.side_distance) * outwards
    return look_at(eye, centre, (0.0, 0.0, 1.0))
