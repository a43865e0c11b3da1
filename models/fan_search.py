"""The antipodal search, and what the critic sees, in all views of a fan at once, as tensors.

These are the stages of `models.planner_antipodal` and `models.grasp_critic` for the maps of
`models.fan_views`: PyTorch does for the candidates of all views what NumPy does there for those of
one. Names and order are the same, what a step is for is told there, and a test holds both to the
same grasps.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import cv2
import numpy as np
import torch
import torch.nn.functional as F

from models.fan_views import FanViews, highest_within
from models.grasp_critic import ACROSS, ALONG, LEAST, MOST, STEP, UNIT, GraspCritic
from models.planner_antipodal import EDGE_BLUR, LINES, NOWHERE, PALM_STEP, REACH, UNSURE
from models.planner_candidates import FACTS, SearchSettings, grip_score
from utils.geometry import GripperGeometry, Workspace
from utils.grasp_quality import NEAR_FACE, TOUCH, contact_levels
from utils.height_map import OTHER_LABEL, WALL_LABEL

Value = Callable[["FanViews", "FanCandidates"], torch.Tensor]
"""A factor (N,) on the scores of candidates."""


@dataclass
class FanCandidates:
    """N candidate grasps of several views: view (N,) int64; value (N,) the factor that a `Value`
    gave them; the others as of `Candidates`."""

    view: torch.Tensor
    xy: torch.Tensor
    angle: torch.Tensor
    tip: torch.Tensor
    width: torch.Tensor
    opening: torch.Tensor
    turn: torch.Tensor
    label: torch.Tensor
    score: torch.Tensor
    facts: torch.Tensor
    value: torch.Tensor

    def __len__(self) -> int:
        return len(self.angle)

    @staticmethod
    def joined(parts: Sequence[FanCandidates]) -> FanCandidates:
        """All candidates of several lists."""
        return FanCandidates(
            *(
                torch.cat([getattr(part, field.name) for part in parts])
                for field in fields(FanCandidates)
            )
        )

    def take(self, index: torch.Tensor) -> FanCandidates:
        """Those with the numbers `index` (M,)."""
        return FanCandidates(*(getattr(self, field.name)[index] for field in fields(self)))

    def axes(self) -> tuple[torch.Tensor, torch.Tensor]:
        """(N, 2) unit vectors along the closing line and across it."""
        along = torch.stack([self.angle.cos(), self.angle.sin()], dim=-1)
        return along, torch.stack([-along[:, 1], along[:, 0]], dim=-1)

    def best(self, count: int | None = None) -> FanCandidates:
        """The `count` best feasible candidates of each view, view by view, best first."""
        some = torch.nonzero(self.score > 0)[:, 0]
        some = some[(-self.score[some]).argsort(stable=True)]
        some = some[self.view[some].argsort(stable=True)]
        if count is not None:
            some = some[_place(self.view[some]) < count]
        return self.take(some)

    def distinct(self, count: int, distance: float, angle: float) -> FanCandidates:
        """Non-maximum suppression in each view of candidates that lie as `best` leaves them."""
        if len(self) == 0:
            return self
        view, place = self.view, _place(self.view)
        shape = int(view.max()) + 1, int(place.max()) + 1
        number = torch.full(shape, -1, device=view.device)
        number[view, place] = torch.arange(len(self), device=view.device)
        xy, turned = self.xy[number], self.angle[number]
        apart = (xy[:, :, None] - xy[:, None]).norm(dim=3) >= distance
        between = (turned[:, :, None] - turned[:, None]).abs() % np.pi
        apart |= torch.minimum(between, np.pi - between) >= angle
        free, kept = number >= 0, torch.zeros_like(number, dtype=torch.bool)
        every = torch.arange(len(free), device=view.device)
        for _ in range(count):
            first, some = free.int().argmax(dim=1), free.any(dim=1)
            kept[every, first] |= some
            free &= apart[every, first]
            free[every, first] = False
        return self.take(number[kept])


def _place(view: torch.Tensor) -> torch.Tensor:
    """(N,) the number of each candidate in its view; they lie view by view."""
    number = torch.arange(len(view), device=view.device)
    if len(view) == 0:
        return number
    first = torch.cat([view.new_ones(1, dtype=torch.bool), view[1:] != view[:-1]])
    return number - torch.where(first, number, 0).cummax(dim=0).values


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


def turn_onto_faces(
    found: FanCandidates,
    views: FanViews,
    gripper: GripperGeometry,
    settings: SearchSettings,
    times: int = 2,
) -> FanCandidates:
    """Measured candidates, each turned and measured again as long as its score rises."""
    better = torch.ones_like(found.score, dtype=torch.bool)
    for _ in range(times):
        turned = replace(found, angle=(found.angle + found.turn) % np.pi)
        turned = measure(turned, views, gripper, settings)
        better = better & (turned.score > found.score)
        columns = (
            (getattr(part, field.name) for part in (turned, found))
            for field in fields(FanCandidates)
        )
        found = FanCandidates(
            *(
                torch.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, old)
                for new, old in columns
            )
        )
    return found


def measure(
    candidates: FanCandidates, views: FanViews, gripper: GripperGeometry, settings: SearchSettings
) -> FanCandidates:
    """The candidates posed on their maps, centred between their contacts, and scored."""
    radius = int(np.ceil(PALM_STEP / np.sqrt(2) / views.cell)) + 1
    maps = views.highest_beside, views.ceiling_within(radius)
    if views.height.device.type == "cuda" and len(candidates):
        return _measured_by_recording(candidates, views, *maps, gripper, settings)
    return _measured(candidates, views, *maps, gripper, settings)


class _Recording:
    """`_measured` for so many candidates and such maps, recorded as a CUDA graph: a GPU starts its
    hundreds of short steps itself, which takes Python longer than the GPU needs for them.

    The arguments are an example; those of each call have to have the same shapes.
    """

    def __init__(
        self,
        candidates: FanCandidates,
        views: FanViews,
        beside: torch.Tensor,
        under_palm: torch.Tensor,
        gripper: GripperGeometry,
        settings: SearchSettings,
    ):
        maps = {name: part.clone() for name, part in _maps_of(views).items()}
        self._views = replace(views, **maps)
        self._inputs = [*_columns(candidates.take(slice(None))), *maps.values()]
        self._inputs += [beside.clone(), under_palm.clone()]
        count = len(fields(FanCandidates))
        arguments = (
            FanCandidates(*self._inputs[:count]), self._views, *self._inputs[-2:], gripper, settings
        )  # fmt: skip
        warm_up = torch.cuda.Stream()
        warm_up.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(warm_up):  # before a recording, as PyTorch asks for
            _measured(*arguments)
        torch.cuda.current_stream().wait_stream(warm_up)
        self._graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._graph, pool=_memory()):
            self._result = _measured(*arguments)

    def __call__(
        self,
        candidates: FanCandidates,
        views: FanViews,
        beside: torch.Tensor,
        under_palm: torch.Tensor,
    ) -> FanCandidates:
        """The measured candidates; the next call, of any recording, overwrites them."""
        given = [*_columns(candidates), *_maps_of(views).values(), beside, under_palm]
        for mine, new in zip(self._inputs, given):
            mine.copy_(new)
        self._graph.replay()
        return self._result


_recordings: dict[tuple, _Recording] = {}


@functools.cache
def _memory() -> tuple[int, int]:
    """The memory that all recordings share: their results are copied before the next one plays."""
    return torch.cuda.graph_pool_handle()


@torch.inference_mode()
def _measured_by_recording(
    candidates: FanCandidates,
    views: FanViews,
    beside: torch.Tensor,
    under_palm: torch.Tensor,
    gripper: GripperGeometry,
    settings: SearchSettings,
) -> FanCandidates:
    """As `_measured`. A recording serves all numbers of candidates up to one of a few."""
    device, count = views.height.device, len(candidates)
    most = settings.finalists * len(views)
    size = most if count <= most else settings.shortlist * len(views)
    number = torch.arange(max(size, count), device=device)
    padded = candidates.take(number.clamp(max=count - 1))
    shapes = tuple((name, part.shape) for name, part in _maps_of(views).items())
    key = (
        gripper, settings, len(number), shapes, views.origin, views.cell, views.table_height,
        views.others, device,
    )  # fmt: skip
    if key not in _recordings:
        _recordings[key] = _Recording(padded, views, beside, under_palm, gripper, settings)
    return _recordings[key](padded, views, beside, under_palm).take(number[:count])


def _columns(candidates: FanCandidates) -> list[torch.Tensor]:
    return [getattr(candidates, field.name) for field in fields(candidates)]


def _maps_of(views: FanViews) -> dict[str, torch.Tensor]:
    names = ("height", "ceiling", "label", "centres", "T_WV", "beyond")
    return {name: getattr(views, name) for name in names if getattr(views, name) is not None}


def _measured(
    candidates: FanCandidates,
    views: FanViews,
    beside: torch.Tensor,
    under_palm: torch.Tensor,
    gripper: GripperGeometry,
    settings: SearchSettings,
) -> FanCandidates:
    """See `measure`. beside, under_palm: (B, R, C) `FanViews.highest_beside`, and the highest
    ceilings that a point under the palm stands for."""
    device, cell, tip = views.height.device, views.cell, candidates.tip
    view, width, (along, across) = candidates.view, candidates.width, candidates.axes()
    most = np.ceil((gripper.max_opening / 2 + gripper.finger_outline[-1][0] + REACH) / cell)
    u = torch.arange(-most, most + 1, dtype=torch.float64, device=device) * cell
    v = torch.linspace(-1, 1, LINES, dtype=torch.float64, device=device)
    v = v * gripper.finger_half_width
    where = cells_around(candidates.xy, view, along, across, u, v, views)  # (N, V, U)
    height = views.height.flatten()[where]
    highest = height.amax(dim=1)

    window = u.abs() <= width[:, None] / 2 + settings.rooms[0]
    top = torch.where(window, highest, -torch.inf).amax(dim=1)
    engagement = top - tip
    lower, upper = contact_levels(tip, engagement)
    low = (height > lower[:, None, None]) & window[:, None]
    low_left, low_right = _first_contacts(low, u, cell)
    high = (highest > upper[:, None]) & window
    high_left, high_right = _first_contacts(high, u, cell)
    left, right = low_left.amin(dim=1), low_right.amax(dim=1)
    touched = left.isfinite() & high_left.isfinite()
    left, right = torch.where(touched, left, 0.0), torch.where(touched, right, 0.0)
    width, shift = right - left, (right + left) / 2
    turn, wedge, cover = _fit_faces(low_left - left[:, None], right[:, None] - low_right, v)
    rise = upper - tip - 0.001
    tilt_left = torch.atan2((high_left - left).clamp(min=0), rise)
    tilt_right = torch.atan2((right - high_right).clamp(min=0), rise)
    tilt = torch.where(touched, torch.maximum(tilt_left, tilt_right), np.pi / 2)

    xy = candidates.xy + shift[:, None] * along
    inner = (width / 3).clamp(max=0.003)
    ends = [
        views.label.flatten()[views.cells(view, candidates.xy + end[:, None] * along)]
        for end in (left + inner, right - inner)
    ]
    label = torch.maximum(*ends)
    centre = views.centres[view, label.clamp(min=0)]
    arms = (
        ((centre[:, :2] - xy) * across).sum(dim=1).abs(),
        ((centre[:, :2] - xy) * along).sum(dim=1).abs(),
        (centre[:, 2] - tip - gripper.pad_height / 2).abs(),
    )

    good = touched & (wedge < settings.max_wedge) & (engagement >= settings.min_engagement)
    good &= (torch.minimum(*ends) > WALL_LABEL) & (label >= 0) & (width > 0)
    if views.beyond is not None:
        good &= ~views.beyond.flatten()[views.cells(view, xy)]
    if gripper.least_held:
        chords = (low_right - low_left).sort(dim=1).values[:, -(LINES // 3) :]
        thickness = chords.mean(dim=1) - cell * along.abs().sum(dim=1)
        good &= thickness > gripper.least_held + UNSURE
    if views.others:
        between = (u - shift[:, None]).abs() < width[:, None] / 2
        mixed = (
            (views.label.flatten()[where] == OTHER_LABEL)
            & (height > tip[:, None, None])
            & between[:, None]
        )
        good &= mixed.sum(dim=(1, 2)) / (LINES * between.sum(dim=1)) <= settings.most_other
    near = (u - shift[:, None]).abs()
    around = beside.flatten()[where].amax(dim=1)
    opening = _widest_opening(around, near, tip, width, gripper, settings)
    good &= opening > 0
    gap = _palm_gap(xy, view, along, across, views, under_palm, gripper)
    good &= gap >= settings.clearance - tip
    open_wide = opening
    if gripper.opens_fully:
        open_wide = torch.minimum(opening, width + 2 * settings.rooms[-1])
    under = _outline(gripper.finger_outline, near - open_wide[:, None] / 2)
    over = views.ceiling.flatten()[where] - under[:, None]
    covered = (over > tip[:, None, None]).double().mean(dim=(1, 2))
    opening, covered = torch.where(good, opening, 0.0), torch.where(good, covered, 0.0)

    room, together = (opening - width) / 2, ends[0] == ends[1]
    on_top = torch.where(touched, top, 0.0)
    score = grip_score(
        torch, settings, wedge=wedge, turn=turn, tilt=tilt, arms=arms, cover=cover,
        engagement=engagement, roomy=0.4 + 0.6 * ((room - 0.003) / 0.005).clamp(0, 1),
        covered=covered, together=together,
        over_table=views.rise(view, torch.cat([xy, on_top[:, None]], dim=1)),
    )  # fmt: skip
    turn = turn.clamp(-np.pi / settings.angles, np.pi / settings.angles)
    facts = torch.stack(
        [
            wedge, tilt_left, tilt_right, cover, *arms, engagement, covered, room,
            together.double(),
        ],
        dim=1,
    )  # fmt: skip
    facts = facts.nan_to_num(nan=0.0, posinf=np.pi, neginf=-np.pi)
    score = torch.where(good, score, 0.0)
    columns = (width, opening, turn, label, score, facts, candidates.value)
    return FanCandidates(view, xy, candidates.angle, tip, *columns)


def cells_around(xy, view, along, across, u, v, views: FanViews) -> torch.Tensor:
    """(N, V, U) flat indices of the maps' cells u (U,) along and v (V,) across, m, from the centres
    xy (N, 2) in the views (N,); along, across: (N, 2) unit vectors."""
    places = (
        (xy[:, k, None] + u * along[:, k, None])[:, None] + v[:, None] * across[:, k, None, None]
        for k in (0, 1)
    )
    return views.cells(view[:, None, None], torch.stack(tuple(places), dim=-1))


def _first_contacts(
    matter: torch.Tensor, u: torch.Tensor, cell: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """(...) places at which lines (..., U) first meet matter, from the left and from the right."""
    left = torch.where(matter, u, torch.inf).amin(dim=-1) - cell / 2
    right = torch.where(matter, u, -torch.inf).amax(dim=-1) + cell / 2
    return left, right


def _fit_faces(
    left_gap: torch.Tensor, right_gap: torch.Tensor, v: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Turn, wedge and cover, each (N,), as of `utils.grasp_quality.fit_faces`."""
    gap = torch.stack([left_gap, right_gap])
    weight = (gap < NEAR_FACE).double()
    cover = (weight * (gap < TOUCH)).mean(dim=-1).amin(dim=0)
    gap = torch.where(gap < NEAR_FACE, gap, 0.0)
    mean_v = (weight * v).sum(dim=-1) / weight.sum(dim=-1).clamp(min=1)
    spread = weight * (v - mean_v[..., None])
    variance = (spread * v).sum(dim=-1)
    slope = (spread * gap).sum(dim=-1) / torch.where(variance > 1e-9, variance, torch.inf)
    left, right = slope.atan()
    return -(left - right) / 2, (left + right).abs() / 2, cover


def _widest_opening(
    obstacles: torch.Tensor,
    near: torch.Tensor,
    tip: torch.Tensor,
    width: torch.Tensor,
    gripper: GripperGeometry,
    settings: SearchSettings,
) -> torch.Tensor:
    """(N,) widest opening of the fingers that is free on a straight descent; 0 where none is."""
    rooms = (np.inf,) if gripper.opens_fully else settings.rooms
    half = torch.stack([width / 2 + room for room in rooms])  # (rooms, N)
    half = half.clamp(max=gripper.max_opening / 2)
    least = width / 2 + settings.rooms[0]
    sill = torch.where(near > least[:, None], settings.clearance + 0.001, torch.inf)
    outward = near - half[..., None]
    below_finger = _outline(gripper.finger_outline, outward.clamp(min=0))
    under = torch.where(outward < -settings.inner_margin, sill, below_finger)
    fits = (obstacles - under).amax(dim=2) <= tip - settings.clearance
    fits &= half >= least - 1e-9
    return torch.where(fits, 2 * half, 0.0).amax(dim=0)


def _palm_gap(
    xy, view, along, across, views: FanViews, under_palm: torch.Tensor, gripper: GripperGeometry
) -> torch.Tensor:
    """(N,) smallest gap between the palm's underside, fingertips at 0, and the matter below it."""
    u, v = (
        torch.linspace(
            -end, end, 2 * int(np.ceil(end / PALM_STEP)) + 1, dtype=torch.float64, device=xy.device
        )
        for end in (gripper.palm_half_length, gripper.palm_outline[-1][0])
    )
    nearby = under_palm.flatten()[cells_around(xy, view, along, across, u, v, views)].amax(dim=2)
    return (_outline(gripper.palm_outline, v.abs()) - nearby).amin(dim=1)


def _outline(outline: Sequence[tuple[float, float]], outward: torch.Tensor) -> torch.Tensor:
    """(...) height of an underside at distances outward, linear between its corners; infinite
    beside it."""
    under = torch.full_like(outward, torch.inf)
    for (near, low), (far, high) in zip(outline, outline[1:]):
        here = (outward >= near) & (outward <= far)
        under = torch.where(here, low + (high - low) / (far - near) * (outward - near), under)
    return under


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
            found.value.clamp(min=LEAST).log(),
            views.rise(found.view, tip),
            found.score.clamp(min=LEAST).log(),
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
