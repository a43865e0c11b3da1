"""The antipodal search, and what the critic sees, in all views of a fan at once, as tensors.

These are the stages of `models.planner_antipodal` and `models.grasp_critic` for the maps of
`models.fan_views`: PyTorch does for the candidates of all views what NumPy does there for those of
one. Names and order are the same, what a step is for is told there, and a test holds both to the
same grasps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import cv2
import numpy as np
import torch
import torch.nn.functional as F

from models.fan_candidates import FanCandidates
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


def dense_candidates(
    views: FanViews, gripper: GripperGeometry, workspace: Workspace, settings: SearchSettings
) -> FanCandidates:
    """Runs of matter that may fit between the fingers, in every view."""
    device, cell, (rows, columns) = views.height.device, views.cell, views.height.shape[1:]
    on_objects, height = views.label >= 0, views.height
    levels = _levels(views, on_objects, gripper, settings)
    # A square that holds all graspable matter of a view, and fingers beside it, at any angle.
    sides = [on_objects.any(dim=1), on_objects.any(dim=2)]
    first = torch.stack([side.int().argmax(dim=1) for side in sides], dim=1)
    last = torch.stack(
        [side.shape[1] - 1 - side.flip(1).int().argmax(dim=1) for side in sides], dim=1
    )
    last = torch.where(on_objects.any(dim=1).any(dim=1, keepdim=True), last, first)
    centre_cell, thickness = (first + last) // 2, gripper.finger_outline[1][0]
    beside = (gripper.max_opening if gripper.opens_fully else max(settings.rooms)) + 2 * thickness
    if views.others:
        beside += gripper.palm_half_length
    half = int((last - first).double().norm(dim=1).max() / 2 + beside / cell) + 2
    size, middle = 2 * half + 1, _pair(views.origin, device) + cell * centre_cell.double()

    # Every view at every angle.
    angles = torch.arange(settings.angles, dtype=torch.float64, device=device)
    angles = angles * np.pi / settings.angles
    along = torch.stack([angles.cos(), angles.sin()], dim=1)
    across = torch.stack([-along[:, 1], along[:, 0]], dim=1)
    step = torch.arange(-half, half + 1, device=device)
    column, row = (
        along[:, k, None, None] * step + across[:, k, None, None] * step[:, None] for k in (0, 1)
    )
    column, row = (
        torch.floor(part + centre_cell[:, k, None, None, None] + 0.5).long()
        for k, part in enumerate((column, row))
    )  # (B, A, S, S)
    inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    every = torch.arange(len(views), device=device)
    where = (every[:, None, None, None] * rows + row.clamp(0, rows - 1)) * columns
    where = (where + column.clamp(0, columns - 1)).flatten(0, 1)
    inside = inside.flatten(0, 1)
    ground = height.amin(dim=(1, 2)).repeat_interleave(settings.angles)[:, None, None]
    standing = torch.where(views.label == -1, NOWHERE, height)
    turned = torch.where(inside, height.flatten()[where], ground)
    objects = torch.where(inside, standing.flatten()[where], NOWHERE)

    image, level, row, first, last = _runs(
        objects, levels.repeat_interleave(settings.angles, dim=0),
        gripper.max_opening - 2 * settings.rooms[0], cell,
    )  # fmt: skip
    width = int(thickness / cell)
    finger = highest_within(
        turned, int(gripper.finger_half_width / cell), (width // 2, width - 1 - width // 2)
    )
    palm = highest_within(
        turned, int(gripper.palm_outline[1][0] / cell), int(gripper.palm_half_length / cell)
    )
    view, turn = image // settings.angles, image % settings.angles
    tip = levels[view, level]

    def at(images: torch.Tensor, column: torch.Tensor, some: torch.Tensor) -> torch.Tensor:
        return images.flatten()[(image[some] * size + row[some]) * size + column]

    length = (last - first + 1).double() * cell
    centre = ((first + last).double() / 2).round().long()
    every = torch.arange(len(tip), device=device)
    free = torch.nonzero(at(palm, centre, every) < tip - settings.clearance + gripper.palm_height)[
        :, 0
    ]
    limit = tip[free] - settings.clearance
    rooms = tip.new_tensor(settings.rooms)[:, None]  # (rooms, M) from here on
    if gripper.opens_fully:
        rooms = (gripper.max_opening - length[None, free]) / 2
    offset = (rooms + thickness / 2) / cell
    left = (first[free] - offset).round().long().clamp(min=0)
    right = (last[free] + offset).round().long().clamp(max=size - 1)
    fits = (at(finger, left, free) < limit) & (at(finger, right, free) < limit)
    fits &= length[free] + 2 * rooms < gripper.max_opening + 2 * cell
    free = free[fits.any(dim=0)]
    view, turn, row, tip = view[free], turn[free], row[free], tip[free]
    first, last, image, width = first[free], last[free], image[free], length[free]

    along, across = along[turn], across[turn]
    base = middle[view] + cell * (row - half).double()[:, None] * across
    at_first, at_inside, xy, at_last = (
        base + cell * (column.double() - half)[:, None] * along
        for column in (first, first + 1.5, (first + last).double() / 2, last)
    )
    frames = views.T_WV[view]
    place = (frames[:, :2, :3] @ torch.cat([xy, tip[:, None]], dim=1)[..., None])[..., 0]
    place = place + frames[:, :2, 3]
    away = (place - _pair(workspace.centre, device)).abs().amax(dim=1)
    reach = away < workspace.size / 2 + settings.reach
    slope = _slopes(height, cell)
    facing = torch.minimum(
        *(
            sign * (F.normalize(slope[views.cells(view, end)], dim=1, eps=1e-9) * along).sum(dim=1)
            for sign, end in ((1, at_first), (-1, at_last))
        )
    )
    inside = views.label.flatten()[views.cells(view, at_inside)]
    arm = ((views.centres[view, inside.clamp(min=0), :2] - xy) * across).sum(dim=1).abs()
    rise = turned.flatten()[(image * size + row) * size + first] - tip
    score = torch.exp(-((arm / 0.03) ** 2)) * facing.clamp(0, 1) ** 2
    score = score * (reach & (inside >= 0) & (facing > settings.min_facing))
    score = score * (rise / settings.good_engagement).clamp(0.2, 1)
    nothing, none = torch.zeros_like(score), torch.full_like(view, -1)
    facts = score.new_zeros(len(score), len(FACTS))
    found = FanCandidates(
        view, xy, angles[turn], tip, width, width, nothing, none, score, facts, nothing
    )
    return found.take(torch.nonzero(score > 0)[:, 0])


def _levels(
    views: FanViews, on_objects: torch.Tensor, gripper: GripperGeometry, settings: SearchSettings
) -> torch.Tensor:
    """(B, L) metres in V: heights of the fingertips to try in each view; infinite where a view has
    fewer. on_objects: (B, R, C) bool."""
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


def _runs(
    objects: torch.Tensor, levels: torch.Tensor, max_width: float, cell: float
) -> tuple[torch.Tensor, ...]:
    """Runs of cells over a level along the rows of images (I, S, S): image, level, row, first and
    last column, each (M,). levels: (I, L)."""
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
    return image, level, rows[image, rest], first, last


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
