"""The height maps of all views of a fan at once, as tensors on one device.

What `utils.height_map.tilted_height_map` does for one view with NumPy and OpenCV is done here for
all views in one pass, which a GPU does in the time of one. Fixtures and second frames are left to
NumPy. This module knows neither networks nor the search.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import torch
import torch.nn.functional as F

from utils.depth_holes import depth_of_plane
from utils.height_map import LABEL_FLOOR, OTHER_LABEL, RIM, HeightMap
from utils.seen_heights import (
    ABOVE_RAYS,
    BORROWED_WITHIN,
    FARTHEST,
    GRAZING_JUMP,
    GRAZING_SHARES,
    HOLE_RISE,
    MOST_SHARES,
    STEEPEST,
    WALL,
    subpixels,
)
from utils.transforms import RGBDFrame, known_depth

CENTRES = 32  # objects, in steps of which there are centres


@dataclass(frozen=True)
class FanViews:
    """B height maps of one scene, each in a frame V of its own, on one grid of R x C cells.

    height, ceiling: (B, R, C) float32; label: (B, R, C) int64; centres: (B, M, 3) float64; beyond:
    (B, R, C) bool, or None; each as of `HeightMap`; the last of the centres may be filled up with
    zeros. T_WV: (B, 4, 4) float64. origin: (x, y) m in V. cell: m. table_height: m in W. others:
    whether OTHER_LABEL occurs. noise: as of `HeightMap`.
    """

    height: torch.Tensor
    ceiling: torch.Tensor
    label: torch.Tensor
    centres: torch.Tensor
    T_WV: torch.Tensor
    origin: tuple[float, float]
    cell: float
    table_height: float
    beyond: torch.Tensor | None = None
    others: bool = False
    noise: float = 0.0
    _ceiling_within: dict = field(default_factory=dict, init=False, repr=False, compare=False)

    def __len__(self) -> int:
        return len(self.height)

    def cells(self, view: torch.Tensor, xy: torch.Tensor) -> torch.Tensor:
        """(...) flat indices of the cells of points (..., 2) m in the views (...); the nearest cell
        if outside."""
        rows, columns = self.height.shape[1:]
        first, last, step = self._grid
        cells = ((xy - first) / self.cell).round().clamp_(min=0).minimum(last)
        return (cells @ step).long() + view * (rows * columns)

    @functools.cached_property
    def _grid(self) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """(2,) float64 each, along x and y: metres of the first cell, the number of the last one,
        and how many cells a step goes on in a flat map."""
        rows, columns = self.height.shape[1:]
        numbers = (self.origin, (columns - 1, rows - 1), (1, columns))
        return tuple(self.T_WV.new_tensor(pair) for pair in numbers)

    def rise(self, view: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
        """(N,) metres of points (N, 3) in the views (N,) over the table."""
        up = self.T_WV[view, 2]
        return (points * up[:, :3]).sum(dim=1) + (up[:, 3] - self.table_height)

    @functools.cached_property
    def table(self) -> torch.Tensor:
        """(B, R, C) float32 metres in V of the table."""
        shape = self.height.shape[1:]
        return _table_slopes(self.T_WV, shape, self.origin, self.cell, self.table_height)

    @functools.cached_property
    def highest_beside(self) -> torch.Tensor:
        """(B, R, C) the highest surface of each cell and of the eight beside it."""
        return highest_within(self.height, 1)

    def ceiling_within(self, radius: int) -> torch.Tensor:
        """(B, R, C) the highest ceiling within `radius` cells. The result is kept."""
        if radius not in self._ceiling_within:
            self._ceiling_within[radius] = _highest_in_disc(self.ceiling, radius)
        return self._ceiling_within[radius]

    def part(self, first: int, end: int) -> FanViews:
        """The maps of some of the views."""
        height, ceiling, label, centres, T_WV = (
            part[first:end]
            for part in (self.height, self.ceiling, self.label, self.centres, self.T_WV)
        )
        beyond = None if self.beyond is None else self.beyond[first:end]
        return replace(
            self, height=height, ceiling=ceiling, label=label, centres=centres, T_WV=T_WV,
            beyond=beyond,
        )  # fmt: skip

    def every(self, stride: int) -> FanViews:
        """Coarser maps: every `stride`-th cell along rows and columns, without `beyond`."""
        height, ceiling, label = (
            part[:, ::stride, ::stride].contiguous()
            for part in (self.height, self.ceiling, self.label)
        )
        cell = stride * self.cell
        return replace(self, height=height, ceiling=ceiling, label=label, cell=cell, beyond=None)


def fan_views(
    overhead: HeightMap,
    filled: RGBDFrame,
    hiding: np.ndarray,
    T_WV: np.ndarray,
    device: torch.device,
) -> FanViews:
    """The maps of the scene in the frames T_WV (B, 4, 4), on the grid of the map from above.

    filled, hiding: the frame `without_holes`, which has neither fixtures nor a second frame. Of an
    image of 640 x 480 pixels the points of all views take some 0.5 GB.
    """
    shape, cell, table = overhead.height.shape, overhead.cell, overhead.table_height
    origin = (float(overhead.origin[0]), float(overhead.origin[1]))
    frames = torch.from_numpy(np.ascontiguousarray(T_WV, dtype=float)).to(device)
    draw = _Drawing(filled, frames, shape, origin, cell)

    # As `seen_heights` does.
    slope = _table_slopes(frames, shape, origin, cell, table)
    seen = draw.surface(filled.depth)
    hidden = ~seen.isfinite()
    lowest = -highest_within(-torch.where(hidden, torch.inf, seen), int(BORROWED_WITHIN / cell))
    borrowed = torch.where(lowest.isfinite(), lowest, slope)
    height = torch.maximum(torch.where(hidden, borrowed, seen), slope)
    grazed = draw.grazing(filled.depth)
    above = hidden & grazed.isfinite() & (height > grazed + ABOVE_RAYS)
    height = torch.where(above, slope, height)
    ceiling = torch.maximum(grazed, height)
    upright = (frames[:, 2, 2] == 1.0)[:, None, None]
    ceiling = torch.where(upright & ~hidden, height, ceiling)
    if hiding.any():
        nearer = draw.surface(np.where(hiding, filled.depth - HOLE_RISE, 0))
        ceiling = torch.maximum(ceiling, nearer)
    walled, unknown = height, ~known_depth(filled.depth)
    if unknown.any():
        below = draw.surface(np.where(unknown, depth_of_plane(filled, table), 0)).isfinite()
        wall = height.amax(dim=(1, 2), keepdim=True) + WALL
        walled = torch.where(hidden & below, wall, height)

    # As `tilted_height_map` does.
    points = _in_world(frames, height, origin, cell)
    place = [(points[k] - origin[k]) / cell for k in (0, 1)]
    matter = points[2] > table + LABEL_FLOOR
    for along, count in zip(place, shape[::-1]):
        matter &= (along >= 0) & (along <= count - 1)
    column, row = (
        along.round().clamp(0, count - 1).long() for along, count in zip(place, shape[::-1])
    )
    known = torch.from_numpy(overhead.label).to(device, torch.int64)
    label = torch.where(matter, known[row, column], -1)
    label = _with_rims(label, matter)
    rotation, shift = frames[:, :3, :3], frames[:, None, :3, 3]
    # As many for most scenes, so that what is recorded for a number of them serves most.
    count = len(overhead.centres)
    centres = np.zeros((max(-(-count // CENTRES), 1) * CENTRES, 3))
    centres[:count] = overhead.centres
    centres = (torch.from_numpy(centres).to(device) - shift) @ rotation
    beyond = None
    if overhead.beyond is not None:
        beyond = torch.from_numpy(overhead.beyond).to(device)[row, column]
    ceiling = torch.maximum(ceiling, walled)
    others = bool((overhead.label == OTHER_LABEL).any())
    return FanViews(
        walled, ceiling, label, centres, frames, origin, cell, table, beyond, others,
        overhead.noise,
    )  # fmt: skip


class _Drawing:
    """Draws points of a frame into the cells of all views, of which each keeps the highest."""

    def __init__(
        self,
        frame: RGBDFrame,
        frames: torch.Tensor,
        shape: tuple[int, int],
        origin: tuple[float, float],
        cell: float,
    ):
        self._shape, self._device = shape, frames.device
        self._split = subpixels(frame, cell)
        # From a pixel times its depth to columns, rows and metres of each view.
        to_view = torch.linalg.inv(frames) @ frames.new_tensor(np.asarray(frame.T_WC, float))
        steps = torch.tensor([1 / cell, 1 / cell, 1.0], dtype=torch.float64, device=self._device)
        first = torch.tensor([*origin, 0.0], dtype=torch.float64, device=self._device)
        ahead = frames.new_tensor(np.linalg.inv(np.asarray(frame.K, float)))
        self._ray = steps[:, None] * (to_view[:, :3, :3] @ ahead)  # (B, 3, 3)
        self._eye = (steps * (to_view[:, :3, 3] - first))[..., None]  # (B, 3, 1)

    def surface(self, depth: np.ndarray) -> torch.Tensor:
        """(B, R, C) float32 highest point of a depth image (H, W) in each cell, -inf where there is
        none; each pixel stands for several points of its square."""
        depth = self._tensor(depth)
        row, column = torch.nonzero(_known(depth), as_tuple=True)
        depth = depth[row, column]
        sub = (np.arange(self._split) + 0.5) / self._split - 0.5
        return self._highest(
            self._points(torch.stack([column + du, row + dv]), depth)
            for dv, du in itertools.product(sub.tolist(), sub.tolist())
        )

    def grazing(self, depth: np.ndarray) -> torch.Tensor:
        """(B, R, C) the same of points on the rays between neighbouring pixels that lie beside a
        step of the depth."""
        return self._highest(self._grazing_points(self._tensor(depth)))

    def _grazing_points(self, depth: torch.Tensor) -> Iterator[torch.Tensor]:
        for down, right in ((0, 1), (1, 0)):
            here = depth[: len(depth) - down, : depth.shape[1] - right]
            there = depth[down:, right:]
            edge = ((here - there).abs() > GRAZING_JUMP) & _known(here) & _known(there)
            row, column = torch.nonzero(edge, as_tuple=True)
            if len(row) == 0:
                continue
            near = self._points(torch.stack([column, row]), here[row, column])
            far = self._points(torch.stack([column + right, row + down]), there[row, column])
            cells = 2 * (far - near)[:, :2].norm(dim=1)  # (B, N) halves
            longest = cells.amax(dim=1)
            yield from self._between(near, far, longest.clamp(2, GRAZING_SHARES).long())
            far_reaching = cells > GRAZING_SHARES
            some = far_reaching.any(dim=0)
            if some.any():
                near, far, longer = near[..., some], far[..., some], far_reaching[:, None, some]
                for points in self._between(near, far, longest.clamp(2, MOST_SHARES).long()):
                    column, row, z = points.split(1, dim=1)
                    z = torch.where(
                        longer.repeat(1, 1, z.shape[2] // longer.shape[2]), z, -torch.inf
                    )
                    yield torch.cat([column, row, z], dim=1)

    def _between(
        self, near: torch.Tensor, far: torch.Tensor, count: torch.Tensor
    ) -> Iterator[torch.Tensor]:
        """(B, 3, M x N) points on the lines between `near` and `far` (B, 3, N), in a view as many
        on each as `count` (B,) says; not all at once, because a thousand fill a memory."""
        count = count[:, None, None, None]
        shares = torch.arange(int(count.max()), device=self._device)[:, None]
        for some in shares.split(GRAZING_SHARES):
            share = (some / (count - 1)).clamp(max=1.0)
            yield (near[:, :, None] + share * (far - near)[:, :, None]).flatten(2)

    def _points(self, pixels: torch.Tensor, depth: torch.Tensor) -> torch.Tensor:
        """(B, 3, N) float32 columns, rows and metres of pixels (2, N) at depths (N,)."""
        ahead = torch.cat([pixels, torch.ones_like(pixels[:1])]).double() * depth
        return (self._ray @ ahead + self._eye).float()

    def _tensor(self, depth: np.ndarray) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(depth, dtype=np.float32)).to(self._device)

    def _highest(self, parts: Iterable[torch.Tensor]) -> torch.Tensor:
        """(B, R, C) highest z of points, each part (B, 3, N): columns, rows, metres."""
        (rows, columns), views = self._shape, len(self._ray)
        size = (rows + 2) * (columns + 2)  # with a rim for points outside
        height = torch.full((views, size), -torch.inf, device=self._device)
        for points in parts:
            column, row = (
                points[:, k].round().clamp(-1, count).long() + 1
                for k, count in enumerate((columns, rows))
            )
            height.scatter_reduce_(1, row * (columns + 2) + column, points[:, 2], "amax")
        return height.reshape(views, rows + 2, columns + 2)[:, 1:-1, 1:-1].contiguous()


def highest_within(
    image: torch.Tensor, rows: int | Sequence[int], columns: int | Sequence[int] | None = None
) -> torch.Tensor:
    """(B, R, C) highest value of images in the window of so many cells before and behind each one;
    of one number, as many on all sides."""
    columns = rows if columns is None else columns
    (above, below), (left, right) = (
        (side, side) if isinstance(side, int) else side for side in (rows, columns)
    )
    padded = F.pad(image[:, None], (left, right, above, below), value=-torch.inf)
    padded = F.max_pool2d(padded, (above + below + 1, 1), stride=1)
    return F.max_pool2d(padded, (1, left + right + 1), stride=1)[:, 0]


def _highest_in_disc(image: torch.Tensor, radius: int) -> torch.Tensor:
    """(B, R, C) highest value within OpenCV's disc of a radius in cells."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    highest = torch.full_like(image, -torch.inf)
    rows, columns = image.shape[1:]
    padded = F.pad(image[:, None], (radius,) * 4, value=-torch.inf)[:, 0]
    for half in np.unique(disc.sum(axis=1) // 2):  # rows of the disc that are as long
        lines = np.flatnonzero(disc.sum(axis=1) // 2 == half)
        wide = F.max_pool2d(padded, (1, 2 * int(half) + 1), stride=1)
        first = radius - int(half)
        for line in lines:
            part = wide[:, line : line + rows, first : first + columns]
            highest = torch.maximum(highest, part)
    return highest


def _numbers(count: int, device: torch.device) -> torch.Tensor:
    """(count,) float64: 0, 1, 2 and so on."""
    return torch.arange(count, dtype=torch.float64, device=device)


def _known(depth: torch.Tensor) -> torch.Tensor:
    return depth.isfinite() & (depth > 0)


def _table_slopes(
    frames: torch.Tensor,
    shape: Sequence[int],
    origin: tuple[float, float],
    cell: float,
    table: float,
) -> torch.Tensor:
    """(B, R, C) float32 metres in V: the table, `table` m high in W, in each cell of a grid; as
    `table_slope`."""
    rows, columns = (_numbers(count, frames.device) for count in shape)
    steep_x, steep_y, up, middle = frames[:, 2].T[..., None, None]
    level = (table - middle) - steep_x * (origin[0] + cell * columns)
    level = level - steep_y * (origin[1] + cell * rows)[:, None]
    return (level / up.clamp(min=STEEPEST)).clamp(table - FARTHEST, table + FARTHEST).float()


def _in_world(
    frames: torch.Tensor, height: torch.Tensor, origin: tuple[float, float], cell: float
) -> torch.Tensor:
    """(3, B, R, C) float64 points in W of the heights (B, R, C) of a grid in V."""
    rows, columns = (_numbers(count, height.device) for count in height.shape[1:])
    x, y = origin[0] + cell * columns, (origin[1] + cell * rows)[:, None]
    return torch.stack(
        [
            a[:, None, None] * x + b[:, None, None] * y + c[:, None, None] * height
            + d[:, None, None]
            for a, b, c, d in (frames[:, k].T for k in range(3))
        ]
    )  # fmt: skip


def _with_rims(label: torch.Tensor, matter: torch.Tensor) -> torch.Tensor:
    """Labels (B, R, C) in which unlabelled matter within RIM cells of a label has the nearest one:
    at the rim of an object its surface may lie beside its label."""
    known = label != -1
    near = highest_within(known.float(), RIM) > 0
    view, row, column = torch.nonzero(near & matter & ~known, as_tuple=True)
    steps = torch.arange(-RIM, RIM + 1, device=label.device)
    offsets = torch.cartesian_prod(steps, steps)
    offsets = offsets[offsets.square().sum(dim=1).argsort(stable=True)]
    rows, columns = label.shape[1:]
    row, column = (
        (at[:, None] + offset).clamp(0, count - 1)
        for at, offset, count in zip((row, column), offsets.T, (rows, columns))
    )
    around = label[view[:, None], row, column]
    nearest = (around != -1).int().argmax(dim=1, keepdim=True)
    label = label.clone()
    label[view, row[:, 0], column[:, 0]] = around.gather(1, nearest)[:, 0]
    return label
