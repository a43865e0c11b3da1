"""Candidates of all views of a fan, posed on their maps, measured and scored, as tensors.

`measure` and the others are those of `models.planner_measure` with PyTorch: names and order are the
same, what a step is for is told there, and a test holds both to the same numbers. On a GPU,
`measure` is recorded as a CUDA graph.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import fields, replace
from typing import NamedTuple

import numpy as np
import torch

from models.fan_candidates import FanCandidates
from models.fan_views import FanViews
from models.planner_candidates import FACTS, SearchSettings, grip_score
from models.planner_measure import (
    BESIDE,
    BESIDE_LINES,
    LINES,
    PALM_STEP,
    REACH,
    UNSURE,
    Contacts,
    Held,
    Lines,
    least_engagement,
)
from utils.depth_correction import bump_height
from utils.geometry import GripperGeometry
from utils.grasp_quality import NEAR_FACE, TOUCH, contact_levels
from utils.height_map import OTHER_LABEL, WALL_LABEL


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


def without_bumps(found: FanCandidates, views: FanViews, gripper: GripperGeometry) -> FanCandidates:
    """The candidates but for those on bumps that the noise of a depth image has made."""
    if views.noise == 0:
        return found
    along, across = found.axes()
    lines = {"device": found.xy.device, "dtype": found.xy.dtype}
    beside = torch.linspace(*BESIDE, BESIDE_LINES, **lines) + found.width[:, None] / 2
    beside = torch.stack([-beside, beside], dim=1)[..., None, None]  # (N, side, line, 1, 1)
    over = torch.linspace(-1, 1, BESIDE_LINES, **lines)[:, None] * gripper.finger_half_width
    points = found.xy[:, None, None, None] + beside * along[:, None, None, None]
    points = points + over * across[:, None, None, None]
    where = views.cells(found.view[:, None, None, None], points).flatten(2)
    surface = views.height.flatten()[where].median(dim=2).values
    label = views.label.flatten()[where]
    on_table = ((label == -1) | (label == WALL_LABEL)).double().mean(dim=2) >= 0.5
    engagement = found.facts[:, FACTS.index("engagement")]
    rise = (found.tip + engagement)[:, None] - surface
    kept = (on_table | (rise > bump_height(views.noise))).all(dim=1)
    kept &= engagement > least_engagement(views.noise)
    return found.take(torch.nonzero(kept)[:, 0])


def measure(
    candidates: FanCandidates, views: FanViews, gripper: GripperGeometry, settings: SearchSettings
) -> FanCandidates:
    """The candidates posed on their maps, centred between their contacts, and scored."""
    radius = int(np.ceil(PALM_STEP / np.sqrt(2) / views.cell)) + 1
    maps = _Maps(views, views.highest_beside, views.ceiling_within(radius))
    if views.height.device.type == "cuda" and len(candidates):
        return _measured_by_recording(candidates, maps, gripper, settings)
    return _measured(candidates, maps, gripper, settings)


class _Maps(NamedTuple):
    """What candidates are measured on. beside: (B, R, C) `FanViews.highest_beside`. under_palm:
    (B, R, C) m in V, the highest ceilings that a point under the palm stands for."""

    views: FanViews
    beside: torch.Tensor
    under_palm: torch.Tensor

    def tensors(self) -> dict[str, torch.Tensor]:
        """All that changes from frame to frame."""
        names = ("height", "ceiling", "label", "centres", "T_WV", "beyond")
        found = {name: getattr(self.views, name) for name in names}
        found |= {"beside": self.beside, "under_palm": self.under_palm}
        return {name: part for name, part in found.items() if part is not None}

    def copied(self) -> _Maps:
        """The same with tensors of their own."""
        own = {name: part.clone() for name, part in self.tensors().items()}
        beside, under_palm = own.pop("beside"), own.pop("under_palm")
        return _Maps(replace(self.views, **own), beside, under_palm)


class _Recording:
    """`_measured` for so many candidates and such maps, recorded as a CUDA graph: a GPU starts its
    hundreds of short steps itself, which takes Python longer than the GPU needs for them.

    The arguments are an example; those of each call have to have the same shapes.
    """

    def __init__(
        self,
        candidates: FanCandidates,
        maps: _Maps,
        gripper: GripperGeometry,
        settings: SearchSettings,
    ):
        mine = maps.copied()
        self._inputs = [*_columns(candidates), *mine.tensors().values()]
        # Kept, with what is cached in them: the graph reads their memory.
        self._arguments = arguments = candidates, mine, gripper, settings
        warm_up = torch.cuda.Stream()
        warm_up.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(warm_up):  # before a recording, as PyTorch asks for
            _measured(*arguments)
        torch.cuda.current_stream().wait_stream(warm_up)
        self._graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._graph, pool=_memory()):
            self._result = _measured(*arguments)

    def __call__(self, candidates: FanCandidates, maps: _Maps) -> FanCandidates:
        """The measured candidates; the next call, of any recording, overwrites them."""
        given = [*_columns(candidates), *maps.tensors().values()]
        for mine, new in zip(self._inputs, given):
            mine.copy_(new)
        self._graph.replay()
        return self._result


# Each holds maps of its own, 0.03 to 0.2 GB. A workspace needs up to four: a coarse and a fine map,
# with the margins and with relaxed ones.
MOST_RECORDINGS = 8
_recordings: dict[tuple, _Recording] = {}


@functools.cache
def _memory() -> tuple[int, int]:
    """The memory that all recordings share: their results are copied before the next one plays."""
    return torch.cuda.graph_pool_handle()


@torch.inference_mode()
def _measured_by_recording(
    candidates: FanCandidates, maps: _Maps, gripper: GripperGeometry, settings: SearchSettings
) -> FanCandidates:
    """As `_measured`. A recording serves all numbers of candidates up to one of a few."""
    views, count = maps.views, len(candidates)
    device = views.height.device
    most = settings.finalists * len(views)
    size = most if count <= most else settings.shortlist * len(views)
    number = torch.arange(max(size, count), device=device)
    padded = candidates.take(number.clamp(max=count - 1))
    shapes = tuple((name, part.shape) for name, part in maps.tensors().items())
    key = (
        gripper, settings, len(number), shapes, views.origin, views.cell, views.table_height,
        views.others, device,
    )  # fmt: skip
    if key not in _recordings:
        while len(_recordings) >= MOST_RECORDINGS:
            del _recordings[next(iter(_recordings))]  # the oldest
        _recordings[key] = _Recording(padded, maps, gripper, settings)
    return _recordings[key](padded, maps).take(number[:count])


def _columns(candidates: FanCandidates) -> list[torch.Tensor]:
    return [getattr(candidates, field.name) for field in fields(candidates)]


def _measured(
    candidates: FanCandidates, maps: _Maps, gripper: GripperGeometry, settings: SearchSettings
) -> FanCandidates:
    """See `measure`."""
    views = maps.views
    posed = _Posed(candidates, maps, gripper, settings)
    tip, contacts, held = posed.tip, posed.contacts, posed.held
    opening = posed.widest_opening()
    good = posed.graspable() & (opening > 0)
    good &= posed.palm_gap() >= settings.clearance - tip
    covered = posed.covered(opening)
    opening, covered = torch.where(good, opening, 0.0), torch.where(good, covered, 0.0)

    engagement, room = contacts.top - tip, (opening - contacts.width) / 2
    tilt = torch.maximum(contacts.tilt_left, contacts.tilt_right)
    together = held.left == held.right
    on_top = torch.where(contacts.touched, contacts.top, 0.0)
    score = grip_score(
        torch, settings, wedge=contacts.wedge, turn=contacts.turn,
        tilt=torch.where(contacts.touched, tilt, np.pi / 2), arms=held.arms, cover=contacts.cover,
        engagement=engagement, roomy=0.4 + 0.6 * ((room - 0.003) / 0.005).clamp(0, 1),
        covered=covered, together=together,
        over_table=views.rise(candidates.view, torch.cat([held.xy, on_top[:, None]], dim=1)),
    )  # fmt: skip
    columns = (
        contacts.wedge, contacts.tilt_left, contacts.tilt_right, contacts.cover, *held.arms,
        engagement, covered, room, together.double(),
    )  # fmt: skip
    facts = torch.stack(columns, dim=1).nan_to_num(nan=0.0, posinf=np.pi, neginf=-np.pi)
    most = np.pi / settings.angles
    return FanCandidates(
        candidates.view, held.xy, candidates.angle, tip, contacts.width, opening,
        contacts.turn.clamp(-most, most), held.label, torch.where(good, score, 0.0), facts,
        candidates.value,
    )  # fmt: skip


class _Posed:
    """Candidates on the maps of their views, their pads closed on what is between them."""

    def __init__(
        self,
        candidates: FanCandidates,
        maps: _Maps,
        gripper: GripperGeometry,
        settings: SearchSettings,
    ):
        self.maps, self.views, self.gripper, self.settings = maps, maps.views, gripper, settings
        self.view, self.xy, self.tip = candidates.view, candidates.xy, candidates.tip
        self.along, self.across = candidates.axes()
        self.lines = self._lines()
        self.contacts = self._contacts(candidates.width)
        self.held = self._held()

    @property
    def _exact(self) -> dict:
        return {"dtype": torch.float64, "device": self.xy.device}

    def _cells(self, xy: torch.Tensor, u: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
        return cells_around(xy, self.view, self.along, self.across, u, v, self.views)

    def _lines(self) -> Lines[torch.Tensor]:
        views, gripper = self.views, self.gripper
        reach = gripper.max_opening / 2 + gripper.finger_outline[-1][0] + REACH
        most = np.ceil(reach / views.cell)
        u = torch.arange(-most, most + 1, **self._exact) * views.cell
        v = torch.linspace(-1, 1, LINES, **self._exact) * gripper.finger_half_width
        where = self._cells(self.xy, u, v)
        height = views.height.flatten()[where]
        return Lines(u, v, where, height, height.amax(dim=1))

    def _contacts(self, claimed: torch.Tensor) -> Contacts[torch.Tensor]:
        tip, lines, u, cell = self.tip, self.lines, self.lines.u, self.views.cell
        window = u.abs() <= claimed[:, None] / 2 + self.settings.rooms[0]
        top = torch.where(window, lines.highest, -torch.inf).amax(dim=1)
        lower, upper = contact_levels(tip, top - tip)
        low = (lines.height > lower[:, None, None]) & window[:, None]
        low_left, low_right = _first_contacts(low, u, cell)
        high = (lines.highest > upper[:, None]) & window
        high_left, high_right = _first_contacts(high, u, cell)
        left, right = low_left.amin(dim=1), low_right.amax(dim=1)
        touched = left.isfinite() & high_left.isfinite()
        left, right = torch.where(touched, left, 0.0), torch.where(touched, right, 0.0)
        turn, wedge, cover = _fit_faces(
            low_left - left[:, None], right[:, None] - low_right, lines.v
        )
        rise = upper - tip - 0.001
        return Contacts(
            left, right, touched, top, low_right - low_left, turn, wedge, cover,
            torch.atan2((high_left - left).clamp(min=0), rise),
            torch.atan2((right - high_right).clamp(min=0), rise),
        )  # fmt: skip

    def _held(self) -> Held[torch.Tensor]:
        contacts, views = self.contacts, self.views
        xy = self.xy + contacts.shift[:, None] * self.along
        inner = (contacts.width / 3).clamp(max=0.003)
        left, right = (
            views.label.flatten()[views.cells(self.view, self.xy + end[:, None] * self.along)]
            for end in (contacts.left + inner, contacts.right - inner)
        )
        label = torch.maximum(left, right)
        centre = views.centres[self.view, label.clamp(min=0)]
        arms = (
            ((centre[:, :2] - xy) * self.across).sum(dim=1).abs(),
            ((centre[:, :2] - xy) * self.along).sum(dim=1).abs(),
            (centre[:, 2] - self.tip - self.gripper.pad_height / 2).abs(),
        )
        return Held(xy, label, left, right, arms)

    def graspable(self) -> torch.Tensor:
        """(N,) bool, whose pads close on one object that may be grasped."""
        views, settings, lines = self.views, self.settings, self.lines
        contacts, held, tip, width = self.contacts, self.held, self.tip, self.contacts.width
        good = contacts.touched & (contacts.wedge < settings.max_wedge)
        good &= contacts.top - tip >= settings.min_engagement
        good &= torch.minimum(held.left, held.right) > WALL_LABEL
        good &= (held.label >= 0) & (width > 0)
        if views.beyond is not None:
            good &= ~views.beyond.flatten()[views.cells(self.view, held.xy)]
        if self.gripper.least_held:
            longest = contacts.chords.sort(dim=1).values[:, -(LINES // 3) :]
            thickness = longest.mean(dim=1) - views.cell * self.along.abs().sum(dim=1)
            good &= thickness > self.gripper.least_held + UNSURE
        if views.others:
            between = (lines.u - contacts.shift[:, None]).abs() < width[:, None] / 2
            mixed = (
                (views.label.flatten()[lines.where] == OTHER_LABEL)
                & (lines.height > tip[:, None, None])
                & between[:, None]
            )
            good &= mixed.sum(dim=(1, 2)) / (LINES * between.sum(dim=1)) <= settings.most_other
        return good

    def widest_opening(self) -> torch.Tensor:
        """(N,) widest opening of the fingers that is free on a straight descent; 0 where none
        is."""
        gripper, settings, width = self.gripper, self.settings, self.contacts.width
        obstacles = self.maps.beside.flatten()[self.lines.where].amax(dim=1)
        rooms = (np.inf,) if gripper.opens_fully else settings.rooms
        half = torch.stack([width / 2 + room for room in rooms])  # (rooms, N)
        half = half.clamp(max=gripper.max_opening / 2)
        least = width / 2 + settings.rooms[0]
        sill = torch.where(self._near > least[:, None], settings.clearance + 0.001, torch.inf)
        outward = self._near - half[..., None]
        below_finger = _outline(gripper.finger_outline, outward.clamp(min=0))
        under = torch.where(outward < -settings.inner_margin, sill, below_finger)
        fits = (obstacles - under).amax(dim=2) <= self.tip - settings.clearance
        fits &= half >= least - 1e-9
        return torch.where(fits, 2 * half, 0.0).amax(dim=0)

    @property
    def _near(self) -> torch.Tensor:
        """(N, U) m along the closing lines, from the middle between the contacts."""
        return (self.lines.u - self.contacts.shift[:, None]).abs()

    def palm_gap(self) -> torch.Tensor:
        """(N,) smallest gap between the palm's underside, fingertips at 0, and the matter below
        it."""
        ends = self.gripper.palm_half_length, self.gripper.palm_outline[-1][0]
        u, v = (
            torch.linspace(-end, end, 2 * int(np.ceil(end / PALM_STEP)) + 1, **self._exact)
            for end in ends
        )
        nearby = self.maps.under_palm.flatten()[self._cells(self.held.xy, u, v)].amax(dim=2)
        return (_outline(self.gripper.palm_outline, v.abs()) - nearby).amin(dim=1)

    def covered(self, opening: torch.Tensor) -> torch.Tensor:
        """(N,) share of the hand under which matter may be hidden. opening: (N,) m."""
        if self.gripper.opens_fully:
            opening = torch.minimum(opening, self.contacts.width + 2 * self.settings.rooms[-1])
        under = _outline(self.gripper.finger_outline, self._near - opening[:, None] / 2)
        over = self.views.ceiling.flatten()[self.lines.where] - under[:, None]
        return (over > self.tip[:, None, None]).double().mean(dim=(1, 2))


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


def _outline(outline: Sequence[tuple[float, float]], outward: torch.Tensor) -> torch.Tensor:
    """(...) height of an underside at distances outward, linear between its corners; infinite
    beside it."""
    under = torch.full_like(outward, torch.inf)
    for (near, low), (far, high) in zip(outline, outline[1:]):
        here = (outward >= near) & (outward <= far)
        under = torch.where(here, low + (high - low) / (far - near) * (outward - near), under)
    return under
