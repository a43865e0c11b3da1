"""The antipodal search, and what the critic sees, in all views of a fan at once, as tensors.

These are the stages of `models.planner_antipodal` and `models.grasp_critic` for the maps of
`models.fan_views`: PyTorch does for the candidates of all views what NumPy does there for those of
one. Names and order are the same, what a step is for is told there, and a test holds both to the
same grasps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
import torch
import torch.nn.functional as F

from models.fan_candidates import FanCandidates, closing_axes
from models.fan_measure import cells_around, measure, turn_onto_faces, without_bumps
from models.fan_views import FanViews, highest_within
from models.grasp_critic import ACROSS, ALONG, LEAST_LOGGED, MOST, STEP, UNIT, GraspCritic
from models.planner_candidates import FACTS, SearchSettings
from models.planner_runs import EDGE_BLUR, NOWHERE
from utils.geometry import GripperGeometry, Workspace

Value = Callable[[FanViews, FanCandidates], torch.Tensor]
"""A factor (N,) on the scores of candidates."""


def search_once(
    views: FanViews,
    gripper: GripperGeometry,
    workspace: Workspace,
    settings: SearchSettings,
    value: Value,
) -> FanCandidates:
    """Feasible candidates of all views, the first of which is the one from above, measured and
    scored, view by view and best first."""
    found = dense_candidates(views.part(0, 1), gripper, workspace, settings)
    if len(views) > 1:
        tilted = views.part(1, len(views)).every(2)
        tilted = dense_candidates(tilted, gripper, workspace, settings)
        found = FanCandidates.joined([found, replace(tilted, view=tilted.view + 1)])
    found = _valued(found, value(views, found)).best(settings.shortlist)
    found = measure(found, views, gripper, settings).best(settings.finalists)
    found = without_bumps(found, views, gripper)
    found = turn_onto_faces(found, views, gripper, settings)
    return _valued(found, value(views, found)).best()


def _valued(found: FanCandidates, value: torch.Tensor) -> FanCandidates:
    return replace(found, score=found.score * value, value=value)


class _Squares(NamedTuple):
    """What is turned of each view: all graspable matter, and fingers beside it, at any angle.
    centre: (B, 2) int64 column and row of the middle cell. half: cells from there to a side."""

    centre: torch.Tensor
    half: int

    @property
    def size(self) -> int:
        return 2 * self.half + 1


class _Turned(NamedTuple):
    """The squares of all views at every angle, view by view: (I, S, S) m in V, as `_Turned` of
    `models.planner_runs`."""

    heights: torch.Tensor
    objects: torch.Tensor
    under_finger: torch.Tensor
    under_palm: torch.Tensor


class _Runs(NamedTuple):
    """M runs of matter over a height of the fingertips. image: (M,) of `_Turned`. row, first, last:
    (M,) where they are in it. tip: (M,) m in V."""

    image: torch.Tensor
    row: torch.Tensor
    first: torch.Tensor
    last: torch.Tensor
    tip: torch.Tensor

    def take(self, some: torch.Tensor) -> _Runs:
        """Those that are marked in `some`, (M,) bool."""
        index = torch.nonzero(some)[:, 0]
        return _Runs(*(column[index] for column in self))

    def of(self, images: torch.Tensor, column: torch.Tensor) -> torch.Tensor:
        """(..., M) of images (I, S, S) at columns (..., M) of the runs' rows."""
        size = images.shape[2]
        return images.flatten()[(self.image * size + self.row) * size + column]


def dense_candidates(
    views: FanViews, gripper: GripperGeometry, workspace: Workspace, settings: SearchSettings
) -> FanCandidates:
    """Runs of matter that may fit between the fingers, in every view."""
    squares = _squares(views, gripper, settings)
    angles = torch.arange(settings.angles, dtype=torch.float64, device=views.height.device)
    angles = angles * np.pi / settings.angles
    turned = _turned(views, squares, angles, gripper)
    levels = _levels(views, gripper, settings).repeat_interleave(settings.angles, dim=0)
    widest = gripper.max_opening - 2 * settings.rooms[0]
    runs = _runs(turned.objects, levels, widest, views.cell)
    runs = _under_a_palm(runs, turned, gripper, settings)
    runs = _between_fingers(runs, turned, views.cell, gripper, settings)
    return _scored(runs, turned, squares, angles, views, workspace, settings)


def _squares(views: FanViews, gripper: GripperGeometry, settings: SearchSettings) -> _Squares:
    on_objects = views.label >= 0
    sides = [on_objects.any(dim=1), on_objects.any(dim=2)]
    first = torch.stack([side.int().argmax(dim=1) for side in sides], dim=1)
    last = torch.stack(
        [side.shape[1] - 1 - side.flip(1).int().argmax(dim=1) for side in sides], dim=1
    )
    last = torch.where(sides[0].any(dim=1, keepdim=True), last, first)
    beside = gripper.max_opening if gripper.opens_fully else max(settings.rooms)
    beside += 2 * gripper.finger_thickness
    if views.others:
        beside += gripper.palm_half_length
    half = int((last - first).double().norm(dim=1).max() / 2 + beside / views.cell) + 2
    return _Squares((first + last) // 2, half)


def _turned(
    views: FanViews, squares: _Squares, angles: torch.Tensor, gripper: GripperGeometry
) -> _Turned:
    height, cell = views.height, views.cell
    device, (count, rows, columns) = height.device, height.shape
    along, across = closing_axes(angles)
    step = torch.arange(-squares.half, squares.half + 1, device=device)
    column, row = (
        along[:, k, None, None] * step + across[:, k, None, None] * step[:, None] for k in (0, 1)
    )
    column, row = (
        torch.floor(part + squares.centre[:, k, None, None, None] + 0.5).long()
        for k, part in enumerate((column, row))
    )  # (B, A, S, S)
    inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    number = torch.arange(count, device=device)
    where = (number[:, None, None, None] * rows + row.clamp(0, rows - 1)) * columns
    where = (where + column.clamp(0, columns - 1)).flatten(0, 1)
    inside = inside.flatten(0, 1)
    ground = height.amin(dim=(1, 2)).repeat_interleave(len(angles))[:, None, None]
    heights = torch.where(inside, height.flatten()[where], ground)
    standing = torch.where(views.label == -1, NOWHERE, height)
    objects = torch.where(inside, standing.flatten()[where], NOWHERE)
    width = int(gripper.finger_thickness / cell)
    under_finger = highest_within(
        heights, int(gripper.finger_half_width / cell), (width // 2, width - 1 - width // 2)
    )
    under_palm = highest_within(
        heights, int(gripper.palm_half_width / cell), int(gripper.palm_half_length / cell)
    )
    return _Turned(heights, objects, under_finger, under_palm)


def _under_a_palm(
    runs: _Runs, turned: _Turned, gripper: GripperGeometry, settings: SearchSettings
) -> _Runs:
    """Those over which the palm has room."""
    centre = ((runs.first + runs.last).double() / 2).round().long()
    under_hand = runs.of(turned.under_palm, centre)
    return runs.take(under_hand < runs.tip - settings.clearance + gripper.palm_height)


def _between_fingers(
    runs: _Runs, turned: _Turned, cell: float, gripper: GripperGeometry, settings: SearchSettings
) -> _Runs:
    """Those beside which both fingers have room."""
    size, width = turned.under_finger.shape[2], (runs.last - runs.first + 1).double() * cell
    rooms = width.new_tensor(settings.rooms)[:, None]  # (rooms, M) from here on
    if gripper.opens_fully:
        rooms = (gripper.max_opening - width[None]) / 2
    beside = (rooms + gripper.finger_thickness / 2) / cell
    left = (runs.first - beside).round().long().clamp(min=0)
    right = (runs.last + beside).round().long().clamp(max=size - 1)
    limit = runs.tip - settings.clearance
    fits = runs.of(turned.under_finger, left) < limit
    fits &= runs.of(turned.under_finger, right) < limit
    fits &= width + 2 * rooms < gripper.max_opening + 2 * cell
    return runs.take(fits.any(dim=0))


def _scored(
    runs: _Runs,
    turned: _Turned,
    squares: _Squares,
    angles: torch.Tensor,
    views: FanViews,
    workspace: Workspace,
    settings: SearchSettings,
) -> FanCandidates:
    """The runs as candidates, with a score that needs no contacts; those without one left out."""
    cell, device = views.cell, angles.device
    view, turn = runs.image // len(angles), runs.image % len(angles)
    along, across = (axes[turn] for axes in closing_axes(angles))
    middle = _pair(views.origin, device) + cell * squares.centre.double()
    base = middle[view] + cell * (runs.row - squares.half).double()[:, None] * across
    at_first, at_inside, xy, at_last = (
        base + cell * (column.double() - squares.half)[:, None] * along
        for column in (
            runs.first, runs.first + 1.5, (runs.first + runs.last).double() / 2, runs.last
        )
    )  # fmt: skip
    frames = views.T_WV[view]
    place = (frames[:, :2, :3] @ torch.cat([xy, runs.tip[:, None]], dim=1)[..., None])[..., 0]
    place = place + frames[:, :2, 3]
    away = (place - _pair(workspace.centre, device)).abs().amax(dim=1)
    reach = away < workspace.size / 2 + settings.reach
    slope = _slopes(views.height, cell)
    facing = torch.minimum(
        *(
            sign * (F.normalize(slope[views.cells(view, end)], dim=1, eps=1e-9) * along).sum(dim=1)
            for sign, end in ((1, at_first), (-1, at_last))
        )
    )
    inside = views.label.flatten()[views.cells(view, at_inside)]
    arm = ((views.centres[view, inside.clamp(min=0), :2] - xy) * across).sum(dim=1).abs()
    rise = runs.of(turned.heights, runs.first) - runs.tip
    score = torch.exp(-((arm / 0.03) ** 2)) * facing.clamp(0, 1) ** 2
    score = score * (reach & (inside >= 0) & (facing > settings.min_facing))
    score = score * (rise / settings.good_engagement).clamp(0.2, 1)
    nothing, none = torch.zeros_like(score), torch.full_like(view, -1)
    facts = score.new_zeros(len(score), len(FACTS))
    width = (runs.last - runs.first + 1).double() * cell
    found = FanCandidates(
        view, xy, angles[turn], runs.tip, width, width, nothing, none, score, facts, nothing
    )
    return found.take(torch.nonzero(score > 0)[:, 0])


def _levels(views: FanViews, gripper: GripperGeometry, settings: SearchSettings) -> torch.Tensor:
    """(B, L) metres in V: heights of the fingertips to try in each view; infinite where a view has
    fewer."""
    on_objects = views.label >= 0
    lowest = torch.where(on_objects, views.table, torch.inf).amin(dim=(1, 2)).double()
    lowest = lowest + settings.table_clearance
    low = torch.where(on_objects, views.height, torch.inf).amin(dim=(1, 2))
    high = torch.where(on_objects, views.height, -torch.inf).amax(dim=(1, 2))
    useless = low - gripper.palm_height - lowest
    first = lowest + settings.level_step * torch.floor(useless / settings.level_step).clamp(min=0)
    count = torch.ceil((high - settings.min_engagement - first) / settings.level_step)
    count = torch.where(count.isfinite(), count, 0).clamp(min=0)
    number = torch.arange(max(int(count.max()), 1), dtype=torch.float64, device=high.device)
    levels = first[:, None] + settings.level_step * number
    return torch.where(number < count[:, None], levels, torch.inf)


def _runs(objects: torch.Tensor, levels: torch.Tensor, max_width: float, cell: float) -> _Runs:
    """Runs of cells over a level along the rows of images (I, S, S). levels: (I, L)."""
    size = objects.shape[2]
    some = objects.amax(dim=2) > levels[:, :1]
    first = some.int().argmax(dim=1)
    last = torch.where(some.any(dim=1), size - 1 - some.flip(1).int().argmax(dim=1), first - 2)
    count = max(int((last - first).max()) // 2 + 1, 0)
    number = torch.arange(count, device=objects.device)
    rows = first[:, None] + 2 * number
    picked = objects.gather(1, rows.clamp(max=size - 1)[..., None].expand(-1, -1, size))
    picked = torch.where((rows <= last[:, None])[..., None], picked, NOWHERE)
    matter = F.pad(picked[:, None] > levels[..., None, None], (1, 1)).flatten()
    edge = torch.nonzero(matter[1:] != matter[:-1])[:, 0]
    line, place = edge // (size + 2), edge % (size + 2)
    line, first, last = line[::2], place[::2], place[1::2] - 1
    found = []
    for bridge in range(3):
        n = max(len(line) - bridge, 0)
        fits = line[:n] == line[bridge:]
        fits &= (last[bridge:] - first[:n] + 1).double() * cell < max_width + cell
        found.append((line[:n][fits], first[:n][fits], last[bridge:][fits]))
    line, first, last = (torch.cat(column) for column in zip(*found))
    image, rest = line // (levels.shape[1] * max(count, 1)), line % max(count, 1)
    level = line // max(count, 1) % levels.shape[1]
    return _Runs(image, rows[image, rest], first, last, levels[image, level])


def _slopes(height: torch.Tensor, cell: float) -> torch.Tensor:
    """(B * R * C, 2) gradients along x and y of the blurred maps."""
    sigma = EDGE_BLUR / cell
    side = round(8 * sigma + 1) | 1  # as OpenCV has it for floats
    kernel = torch.from_numpy(cv2.getGaussianKernel(side, sigma)[:, 0]).to(height.device)
    # In 64 bits, for a GPU may take 32 for less.
    image = F.pad(height.double()[:, None], (side // 2,) * 4, mode="reflect")
    image = F.conv2d(F.conv2d(image, kernel[None, None, None]), kernel[None, None, :, None])
    rows, columns = torch.gradient(image[:, 0], dim=(1, 2))
    return torch.stack([columns, rows], dim=-1).flatten(0, 2)


def chances(
    found: FanCandidates,
    views: FanViews,
    towards: np.ndarray,
    least_held: float,
    critic: GraspCritic,
) -> torch.Tensor:
    """(N,) what the critic gives measured candidates; the arguments as of `critic_inputs`."""
    R, (along, across) = views.T_WV[found.view, :3, :3], found.axes()
    closing = (R[:, :, :2] @ along[..., None])[..., 0]
    approach, camera = -R[:, :, 2], torch.from_numpy(towards).to(R)
    tip = torch.cat([found.xy, found.tip[:, None]], dim=1)
    facts = torch.stack(
        [
            torch.acos((-approach[:, 2]).clamp(-1, 1)),
            closing[:, 2].abs(),
            (closing @ camera).abs(),
            -approach @ camera,
            camera[2].expand(len(found)),
            found.value.clamp(min=LEAST_LOGGED).log(),
            views.rise(found.view, tip),
            found.score.clamp(min=LEAST_LOGGED).log(),
            found.width,
            found.turn.abs(),
            *found.facts.T,
            *_object_size(found, views),
            torch.full_like(found.tip, least_held),
        ],
        dim=1,
    )
    u, v = (
        STEP * (torch.arange(cells, dtype=torch.float64, device=R.device) - (cells - 1) / 2)
        for cells in (ALONG, ACROSS)
    )
    where = cells_around(found.xy, found.view, along, across, u, v, views)
    tips = found.tip[:, None, None]
    layers = [
        ((surface.flatten()[where] - tips).clamp(-MOST, MOST) / UNIT).round()
        for surface in (views.height, views.ceiling)
    ]
    layers.append((views.label.flatten()[where] == found.label[:, None, None]).double())
    return critic(facts.float(), torch.stack(layers, dim=1).to(torch.int8)).sigmoid().double()


def _object_size(found: FanCandidates, views: FanViews) -> torch.Tensor:
    """(3, N) metres: the sizes of the candidates' objects (`models.grasp_critic.object_size`)."""
    rows, columns = views.height.shape[1:]
    here = views.label.flatten(1)[found.view] == found.label[:, None]  # (N, R * C)
    cell = torch.arange(rows * columns, device=here.device)
    x, y = (cell % columns).float() * views.cell, (cell // columns).float() * views.cell
    sizes = []
    for axis in found.axes():
        place = axis[:, :1].float() * x + axis[:, 1:].float() * y
        most = torch.where(here, place, -torch.inf).amax(dim=1)
        least = torch.where(here, place, torch.inf).amin(dim=1)
        sizes.append((most - least + views.cell).clamp(min=0))
    over_table = (views.height - views.table).clamp(min=0).flatten(1)[found.view]
    volume = torch.where(here, over_table, 0.0).sum(dim=1) * views.cell**2
    return torch.stack([*sizes, volume.double() ** (1 / 3)]).double()


def _pair(values: Sequence[float], device: torch.device) -> torch.Tensor:
    return torch.tensor([float(values[0]), float(values[1])], dtype=torch.float64, device=device)
