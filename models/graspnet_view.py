"""What GraspNet tells a planner about one frame: the heights with its objects, and values.

A planner asks `NetworkView` for the height map, for the network's peaks in the world, and for the
quality of candidates, whichever view they were found in. In the holes of the depth image, colours
tell which surface is seen (`table_in_holes`, `surfaces_in_holes`). Where the network has a centre
head, its votes tell the objects apart (`models.graspnet_objects`). This module searches no grasps.
"""

from __future__ import annotations

import functools

import cv2
import numpy as np
import torch

from models.fan_candidates import FanCandidates
from models.fan_views import FanViews
from models.graspnet_decoding import PeakSettings, peak_places, surface_depth
from models.graspnet_inference import run_network, training_scale
from models.graspnet_io import SavedGraspNet
from models.graspnet_objects import labelled_by_centres
from models.planner_candidates import Candidates
from utils.depth_holes import (
    TABLE_FLATNESS,
    depth_of_plane,
    reach_in_pixels,
    surfaces_in_holes,
    table_in_holes,
)
from utils.geometry import Workspace
from utils.height_map import HeightMap, height_map_from_frame
from utils.seen_heights import hides, without_holes
from utils.transforms import (
    RGBDFrame,
    deproject,
    inverse_pose,
    known_depth,
    project,
    transform_points,
)

BLUR = 1.0  # pixels, standard deviation of the Gaussian over the quality
CROP_MARGIN = 0.04  # m around what stands on the table
_LEAST_PIECE = 9  # connected pixels: a piece of fewer is noise, however thin a larger one is
LEAST_QUALITY = 0.02  # so that grasps which fit are ranked where the network sees none


class NetworkView:
    """What a network tells about a frame: heights with its objects, and the quality of candidates.

    The given frame is corrected by its table (`utils.depth_correction`). frame: the same, holes of
    its depth filled where colours tell what is there. holeless: that frame `without_holes`.
    heights: the map from above. crop: whether only the part of the image is looked at in which
    something stands. below: as in `height_map_from_frame`. Where the frame has a second
    one, its network maps serve for what the first does not show. towards: (3,) unit vector in W
    from the middle of the workspace to the camera. Raises UserError for an image that
    the network cannot take.
    """

    def __init__(
        self,
        network: SavedGraspNet,
        frame: RGBDFrame,
        workspace: Workspace,
        crop: bool = False,
        below: bool = False,
    ):
        table = workspace.table_height
        self._first = _Prediction(network, frame, table, crop)
        self._second = None
        if frame.second is not None and known_depth(frame.second.depth).any():
            self._second = _Prediction(network, frame.second, table)
        self.frame = self._first.frame
        towards = frame.T_WC[:3, 3] - [*workspace.centre, table]
        self.towards = towards / np.linalg.norm(towards)
        self.holeless = without_holes(self.frame, workspace)
        self.heights = height_map_from_frame(
            self.frame, workspace, below=below, holeless=self.holeless
        )
        if network.model.centre_head is not None:
            offset = self._first.maps[3][0].numpy()
            scaling = self._first.scaling
            self.heights = labelled_by_centres(self.heights, self.frame, scaling, offset)

    def peaks(self, settings: PeakSettings) -> np.ndarray:
        """(N, 3) points in W of the surface at the peaks of the quality, the highest peak first."""
        peaks = peak_places(self._first.maps[0], settings)
        pixels = self._first.scaling.original_pixels(peaks)
        depth = surface_depth(self.frame.depth, pixels)
        points = deproject(pixels, depth, self.frame.K, self.frame.T_WC)
        return points[np.isfinite(depth)]

    def value(self, heights: HeightMap, candidates: Candidates) -> np.ndarray:
        """(N,) the network's quality of candidates on a height map of the scene."""
        xy, (along, _) = candidates.xy, candidates.axes()
        surface = np.column_stack([xy, heights.height[heights.index(xy)]])
        ends = surface + 0.01 * np.stack([-along, along]) @ np.eye(2, 3)
        ends = transform_points(heights.T_WV, ends)
        quality = self._first.quality(ends)
        if self._second is not None:
            hidden = hides(self.frame, ends.mean(axis=0))
            quality[hidden] = self._second.quality(ends[:, hidden])
        return np.maximum(quality, LEAST_QUALITY)

    def values(self, views: FanViews, candidates: FanCandidates) -> torch.Tensor:
        """(N,) the same of candidates in the views of a fan, by the first frame alone."""
        view, (along, _) = candidates.view, candidates.axes()
        height = views.height.flatten()[views.cells(view, candidates.xy)].double()
        xy = candidates.xy + 0.01 * torch.stack([-along, along])
        ends = torch.cat([xy, height[None, :, None].expand(2, -1, -1)], dim=2)
        frames = views.T_WV[view]
        ends = (frames[:, :3, :3] @ ends[..., None])[..., 0] + frames[:, :3, 3]
        return self._first.qualities(ends).clamp(min=LEAST_QUALITY)


class _Prediction:
    """A network's maps of one image. frame: as in `NetworkView`, the part that was looked at."""

    def __init__(self, network: SavedGraspNet, frame: RGBDFrame, table: float, crop: bool = False):
        self.scaling = training_scale(frame, network.metres_per_pixel)
        if crop:
            frame = around_matter(frame, table)
        self.frame = surfaces_in_holes(table_in_holes(frame, table))
        model = network.model
        self._device = next(model.parameters()).device
        level = None if mostly_table(frame, table) else np.median(depth_of_plane(frame, table))
        centres = model.centre_head is not None
        self.maps = run_network(model, self.frame, self.scaling, centres, level)

    def quality(self, ends: np.ndarray) -> np.ndarray:
        """(N,) quality of closing along the lines between points (2, N, 3) in W."""
        pixels, _ = project(ends, self.frame.K, self.frame.T_WC)
        return quality_between(self._blurred, self.maps[1], *self.scaling.pixels(pixels))

    def qualities(self, ends: torch.Tensor) -> torch.Tensor:
        """(N,) the same as tensors on the network's device."""
        quality, angle = self._maps_there
        to_image = self.scaling.intrinsics(self.frame.K) @ inverse_pose(self.frame.T_WC)[:3]
        to_image, shift = to_image[:, :3].T, to_image[:, 3]
        pixels = ends @ ends.new_tensor(to_image) + ends.new_tensor(shift)
        depth = pixels[..., 2:]
        ahead = (depth > 1e-9).all(dim=0)[:, 0]
        start, end = pixels[..., :2] / torch.where(ahead[:, None], depth, 1.0)
        rows, columns = quality.shape
        column, row = ((start + end) / 2).round().long().T
        column, row = column.clamp(0, columns - 1), row.clamp(0, rows - 1)
        logit = angle[:, row, column]
        share = ((logit - logit.amax(dim=0)) / 3).exp()  # as in `quality_between`
        bins, each = len(share), torch.arange(len(row), device=ends.device)
        du, dv = (end - start).T
        place = torch.atan2(dv, du).remainder(np.pi) * bins / np.pi
        below, part = place.floor().long(), place - place.floor()
        at = (1 - part) * share[below % bins, each] + part * share[(below + 1) % bins, each]
        return torch.where(ahead, quality[row, column] * at, 0.0)

    @functools.cached_property
    def _maps_there(self) -> tuple[torch.Tensor, torch.Tensor]:
        """The blurred quality (H, W) and the angles' logits (K, H, W), where the network is."""
        return torch.from_numpy(self._blurred).to(self._device), self.maps[1][0].to(self._device)

    @functools.cached_property
    def _blurred(self) -> np.ndarray:
        """(H, W) the quality."""
        return cv2.GaussianBlur(self.maps[0][0, 0].numpy(), (0, 0), BLUR)


def mostly_table(frame: RGBDFrame, table_height: float) -> bool:
    """Whether the median depth of a frame is the table's, as it is where networks have learned."""
    known = known_depth(frame.depth)
    table = known & (frame.depth >= depth_of_plane(frame, table_height + TABLE_FLATNESS))
    return bool(2 * table.sum() >= known.sum())


def around_matter(frame: RGBDFrame, table_height: float) -> RGBDFrame:
    """The part of a frame in which something stands on the table, higher than `TABLE_FLATNESS`, or
    may stand unseen. The whole frame where nothing does."""
    high = frame.depth < depth_of_plane(frame, table_height + TABLE_FLATNESS)
    high = (high | ~known_depth(frame.depth)).astype(np.uint8)
    _, _, stats, _ = cv2.connectedComponentsWithStats(high, connectivity=4)
    kept = stats[1:][stats[1:, cv2.CC_STAT_AREA] >= _LEAST_PIECE]  # the first is the table
    if len(kept) == 0:
        return frame
    left, top = kept[:, [cv2.CC_STAT_LEFT, cv2.CC_STAT_TOP]].min(axis=0)
    ends = kept[:, :2] + kept[:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]]
    width, height = ends.max(axis=0) - (left, top)
    margin = reach_in_pixels(frame, CROP_MARGIN)
    return frame.part(
        slice(max(top - margin, 0), top + height + margin),
        slice(max(left - margin, 0), left + width + margin),
    )


def quality_between(
    quality: np.ndarray, angle: torch.Tensor, start: np.ndarray, end: np.ndarray
) -> np.ndarray:
    """(N,) quality of closing along the lines from `start` to `end` (N, 2), in pixels of the maps
    quality (H, W) and angle (1, K, H, W), logits.

    It is the quality at a line's middle, times the quality of the line's angle relative to the best
    angle there. The cube root turns the bins' probabilities into qualities (`targets_from_labels`),
    so that a bin's is exp(logit / 3), up to a factor. It is 0 for lines that the camera cannot see,
    whose pixels are NaN.
    """
    ahead = np.isfinite(start + end).all(axis=1)
    start, end = (np.where(ahead[:, None], pixels, 0.0) for pixels in (start, end))
    u, v = np.rint((start + end) / 2).astype(int).T
    u, v = np.clip(u, 0, quality.shape[1] - 1), np.clip(v, 0, quality.shape[0] - 1)
    logit = angle[0].numpy()[:, v, u]
    bins, each = len(logit), np.arange(len(u))
    du, dv = (end - start).T
    place = np.mod(np.arctan2(dv, du), np.pi) * bins / np.pi  # between two bins
    below, part = np.floor(place).astype(int), place - np.floor(place)
    best = logit.max(axis=0)
    lower, upper = (np.exp((logit[bin % bins, each] - best) / 3) for bin in (below, below + 1))
    return np.where(ahead, quality[v, u] * ((1 - part) * lower + part * upper), 0.0)
