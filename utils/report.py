"""report.html: one self-contained page that shows how an evaluation went.

The figures come from `utils.results`, the layout from report.html.j2 next to this file. The page
loads nothing from anywhere: pictures of grasps and films are inside it. `picture` draws a grasp,
`balanced` chooses the pictures to show.
"""

from __future__ import annotations

import base64
import io
from collections import Counter, deque
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from utils.atomic_files import command_line, figure_bytes, write_atomic
from utils.calibration import draw_reliability
from utils.config import Config, changed_keys, dump_config
from utils.errors import UNREADABLE_NPZ, UserError
from utils.image_overlay import NEAR, close_up, contact_sheet, write_picture
from utils.result_formats import (
    columns_of,
    depth_in_words,
    failures_in_words,
    has_interval,
    rate_in_percent,
)
from utils.result_records import FAILURES, SUCCESS, RoundRecord, policy_name
from utils.results import (
    SEVERAL,
    Comparison,
    Row,
    hardest_objects,
    stated_chances,
    stop_reasons,
)
from utils.runs import origin_of, this_python
from utils.statistics import FEW_ROUNDS, Difference
from utils.transforms import Grasp, RGBDFrame

HARDEST = 10  # objects that are listed, at which most attempts failed
VIDEO_TYPES = {".gif": "image/gif", ".mp4": "video/mp4", ".webm": "video/webm"}


@dataclass(frozen=True)
class GalleryItem:
    """A picture with its grasp already drawn on it: (H, W, 3) uint8 RGB.

    kind: scenario, object set and depth noise. reason: how the attempt ended, "success" or a key of
    FAILURES.
    """

    image: np.ndarray
    caption: str
    success: bool
    policy: str = ""
    kind: tuple[str, ...] = ()
    reason: str = ""


def write_report(
    path: Path,
    rows: Sequence[Row],
    rounds: Sequence[RoundRecord],
    comparisons: Sequence[Comparison],
    config: Config,
    gallery: Sequence[GalleryItem] = (),
    videos: Sequence[tuple[Path, str]] = (),
    device: str = "",
    interruption: str | None = None,
    privileged: Collection[str] = (),
) -> None:
    """Write the page to `path` in the run's folder; videos are (gif, mp4 or webm file, caption).

    rows, comparisons: the figures of the rounds by `utils.results`. device, interruption: in words.
    privileged: the planners that see the true scene, whose rows are a bound and no headline.
    Raises UserError on a video file that is missing or of another type.
    """
    templates = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    templates.filters |= {"percent": _percent, "number": _number}
    page = templates.get_template("report.html.j2").render(
        groups=_groups(rows, privileged),
        policies=_in_order(row.policy for row in rows),
        comparisons=_comparisons(comparisons),
        few_rounds=FEW_ROUNDS,
        has_interval=has_interval,
        near=NEAR,
        labels={SUCCESS: "success", **FAILURES},
        failures_in_words=failures_in_words,
        depth_in_words=depth_in_words,
        stops=stop_reasons(rounds),
        hardest=hardest_objects(rounds, HARDEST),
        reliability=_reliability(rounds),
        has_arm=config.robot.arm != "none",
        targets_known=any(row.targets for row in rows),
        turns_known=any(row.turn_ms_p95 is not None for row in rows),
        rows=rows,
        columns=columns_of(rows),
        totals={"rounds": len(rounds), "grasps": sum(row.attempts for row in rows)},
        interruption=interruption,
        gallery=[(_png(item.image), item.caption, item.success) for item in gallery],
        videos=[(*_video(Path(file)), caption) for file, caption in videos],
        command=f"{this_python()} {command_line(['evaluate.py', *changed_keys(config)])}",
        seed=config.seed,
        origin=origin_of(path.parent),
        device=device,
        config=dump_config(config),
        date=datetime.now().strftime("%Y-%m-%d %H:%M"),
    )
    write_atomic(path, page)


def _in_order(names: Iterable[str]) -> list[str]:
    return list(dict.fromkeys(names))


def _groups(rows: Sequence[Row], privileged: Collection[str]) -> list[dict[str, Any]]:
    """The rows by (scenario, objects, depth noise), each with its best row, its measures and its
    stacked outcomes."""
    cells: dict[tuple[str, str, str], list[Row]] = {}
    for row in rows:
        cells.setdefault((row.scenario, row.objects, row.depth_noise), []).append(row)
    sets = {row.objects for row in rows}
    groups = []
    for (scenario, objects, noise), cell in cells.items():
        bounds = [row for row in cell if _sees_truth(row, privileged)]
        ranked = [row for row in cell if row not in bounds] or cell
        best = _best(ranked)
        rate = _headline(best).rate
        even = [row.policy for row in ranked if row != best and _headline(row).rate == rate]
        groups.append(
            {
                "scenario": scenario,
                "objects": set_in_words(objects, sets) + depth_in_words(noise),
                "best": (best, _headline(best)),
                "even": even if rate is not None else [],
                "bounds": [(row, _headline(row)) for row in bounds if row != best],
                "measures": list(zip(*([(row, m) for m in _measures(row)] for row in cell))),
                "outcomes": [(row, _outcomes(row)) for row in cell],
            }
        )
    return groups


def set_in_words(objects: str, among: Iterable[str]) -> str:
    """One of the object sets `among`, or several of them with ' + ' between: a folder by its last
    part, unless that is another one's, too."""
    short = {one: Path(one).name or one for one in {*among, *objects.split(SEVERAL)}}
    known = Counter(short.values())
    words = (short[one] if known[short[one]] == 1 else one for one in objects.split(SEVERAL))
    return SEVERAL.join(words)


def _sees_truth(row: Row, privileged: Collection[str]) -> bool:
    """Whether the row's planner, with any controller, is one of the privileged."""
    return any(row.policy == policy_name(planner, row.controller) for planner in privileged)


@dataclass(frozen=True)
class _Measure:
    """A share of a row: what of what, as a title, in words, and in numbers. rate: None of
    nothing."""

    title: str
    words: str
    rate: float | None
    interval: tuple[float, float]
    count: int
    total: int


def _measures(row: Row) -> list[_Measure]:
    """What matters of a row, the headline first. Where one object was wanted, its round ends once
    it is in hand: what else was cleared says nothing."""
    success = _Measure(
        "success", "of grasps succeed", row.success_rate, row.success_ci95, row.successes,
        row.attempts,
    )  # fmt: skip
    if row.targets:
        in_hand = _Measure(
            "target in hand", "of targets are retrieved", row.target_in_hand_rate,
            row.target_in_hand_ci95, row.targets_in_hand, row.targets,
        )  # fmt: skip
        return [in_hand, success]
    cleared = _Measure(
        "cleared", "of objects are cleared", row.cleared_rate, row.cleared_ci95,
        row.objects_cleared, row.objects_total,
    )  # fmt: skip
    return [success, cleared]


def _headline(row: Row) -> _Measure:
    return _measures(row)[0]


def _best(rows: Sequence[Row]) -> Row:
    """The row with the best headline."""

    def rate(row: Row) -> float:
        known = _headline(row).rate
        return -1 if known is None else known

    return max(rows, key=rate)


def _outcomes(row: Row) -> list[dict[str, Any]]:
    """Segments of a bar that holds every call of the planner: successes, then failures."""
    counts = {SUCCESS: row.successes, **row.failures}
    calls = sum(counts.values())
    segments, start = [], 0
    for reason, count in counts.items():
        if count:
            share = {"x": 100 * start / calls, "width": 100 * count / calls}
            segments.append({"reason": reason, "count": count, **share})
            start += count
    return segments


def _comparisons(comparisons: Sequence[Comparison]) -> list[dict[str, Any]]:
    """Pairs of policies with difference and verdict, by (scenario, objects, depth noise) and
    measure."""
    cells: dict[tuple[str, str, str], list[Comparison]] = {}
    for pair in comparisons:
        cells.setdefault((pair.scenario, pair.objects, pair.depth_noise), []).append(pair)
    sets = {one for pair in comparisons for one in pair.objects.split(SEVERAL)}
    return [
        {
            "scenario": scenario,
            "objects": set_in_words(objects, sets) + depth_in_words(noise),
            "measures": [
                ("success", [(pair, pair.success, _verdict(pair.success)) for pair in pairs]),
                ("cleared", [(pair, pair.cleared, _verdict(pair.cleared)) for pair in pairs]),
            ],
        }
        for (scenario, objects, noise), pairs in cells.items()
    ]


def _verdict(difference: Difference | None) -> str:
    """A word for a difference: only an interval that leaves out zero decides."""
    if difference is None:
        return "undefined"
    if not has_interval(difference):
        return "few rounds"
    if difference.low > 0:
        return "better"
    return "worse" if difference.high < 0 else "undecided"


def _reliability(rounds: Sequence[RoundRecord]) -> str | None:
    """The reliability diagram of the policies whose qualities are chances, over all their rounds;
    None where there is none."""
    policies = _in_order(record.policy for record in rounds)
    stated = {
        policy: stated_chances(record for record in rounds if record.policy == policy)
        for policy in policies
    }
    known = {policy: chances for policy, chances in stated.items() if chances is not None}
    if not known:
        return None
    return _data_url(figure_bytes(draw_reliability(known)), "image/png")


def _png(image: np.ndarray) -> str:
    return _data_url(iio.imwrite("<bytes>", image, extension=".png"), "image/png")


def _video(path: Path) -> tuple[str, bool]:
    """The file as a data URL, and whether it is an image (a GIF) to the browser."""
    kind = VIDEO_TYPES.get(path.suffix.lower())
    if kind is None:
        raise UserError(f"{path}: not a video for the report, expected {', '.join(VIDEO_TYPES)}")
    try:
        return _data_url(path.read_bytes(), kind), kind.startswith("image/")
    except OSError as error:
        raise UserError(f"{path}: cannot read this video: {error.strerror}") from error


def _data_url(content: bytes, kind: str) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def _percent(rate: float | None, sign: bool = False) -> str:
    """A rate, or with `sign` a difference, in percent; a true minus, because a hyphen is hard to
    see."""
    if rate is None:
        return "–"
    if not sign:
        return rate_in_percent(rate)
    whole = round(100 * rate)
    return f"{whole:{'+' if sign and whole else ''}d}".replace("-", "−")


def _number(value: float | None, digits: int = 0) -> str:
    return "–" if value is None else f"{value:,.{digits}f}"


# --- Pictures of grasps -------------------------------------------------------------------------

MOST_FAILURES = 24  # on failures.png
_GALLERY = ("image", "caption", "success", "policy", "kind", "reason")


def picture(
    frame: RGBDFrame, grasp: Grasp, policy: str, caption: str, reason: str, kind: tuple[str, ...]
) -> GalleryItem:
    """Draw a grasp on what its frame shows around it; caption: begins the picture's, which ends
    with the reason. policy, reason, kind: see `GalleryItem`."""
    success = reason == SUCCESS
    image = close_up(frame, grasp, success)
    return GalleryItem(image, f"{caption}: {reason}", success, policy, kind, reason)


def write_failures(path: Path, pictures: list[GalleryItem]) -> None:
    """Write one picture of failed grasps, of each kind in turn; no file if nothing failed."""
    failures = _in_turns([p for p in pictures if not p.success], MOST_FAILURES)
    if failures:
        sheet = contact_sheet([p.image for p in failures], [p.caption for p in failures])
        write_picture(path, sheet)


def balanced(pictures: list[GalleryItem], count: int) -> list[GalleryItem]:
    """Choose `count` pictures, half of them failures if there are enough of these."""
    failures = [p for p in pictures if not p.success]
    successes = [p for p in pictures if p.success]
    take = min(len(failures), max(count // 2, count - len(successes)))
    return _in_turns(failures, take) + _in_turns(successes, count - take)


def thinned(pictures: Sequence[GalleryItem], count: int) -> list[GalleryItem]:
    """The pictures of which `write_gallery` chooses the same: of each policy, kind and reason no
    more than it takes at all."""
    seen: Counter[Any] = Counter()
    kept = []
    for item in pictures:
        properties = item.policy, item.kind, item.reason, item.success
        seen[properties] += 1
        if seen[properties] <= (count if item.success else max(count, MOST_FAILURES)):
            kept.append(item)
    return kept


def write_gallery(path: Path, pictures: Sequence[GalleryItem], count: int) -> None:
    """Keep the pictures, all of one size, that a report with `count` of them and failures.png may
    show, for a run that is resumed; no file if there are none."""
    kept = _in_turns([p for p in pictures if not p.success], max(count, MOST_FAILURES))
    kept += _in_turns([p for p in pictures if p.success], count)
    if kept:
        file = io.BytesIO()
        arrays = {name: [getattr(item, name) for item in kept] for name in _GALLERY}
        np.savez_compressed(file, **arrays)
        write_atomic(path, file.getvalue())


def read_gallery(path: Path) -> list[GalleryItem]:
    """The pictures that `write_gallery` has kept; none where there is no file, or one of a version
    that kept whole frames, beside which later pictures do not fit. Raises UserError for a file that
    is damaged."""
    if not path.exists():
        return []
    try:
        with np.load(path) as file:
            if "image" in file and "kind" not in file:
                return []
            columns = [file[name] for name in _GALLERY]
    except UNREADABLE_NPZ as error:
        raise UserError(
            f"{path}: cannot be read as pictures of an evaluation ({error}); delete it, the report "
            "then shows those of later rounds alone"
        ) from error
    images, captions, successes, policies, kinds, reasons = columns
    words = captions.tolist(), successes.tolist(), policies.tolist()
    rows = zip(images, *words, map(tuple, kinds.tolist()), reasons.tolist())
    return [GalleryItem(*row) for row in rows]


def _in_turns(pictures: list[GalleryItem], count: int) -> list[GalleryItem]:
    """At most `count` of the pictures: policies, scenarios, object sets, depth noises and reasons
    take turns, so that neither the worst policy nor the first scenario fills the page.

    Each picture is of those whose properties were shown least so far, then of the combination that
    was. So the first pictures of a choice are those of a smaller one.
    """
    left: dict[tuple[str, ...], deque[GalleryItem]] = {}
    for item in pictures:
        left.setdefault((item.policy, item.reason, *item.kind), deque()).append(item)
    shown: Counter[Any] = Counter()

    def turn(properties: tuple[str, ...]) -> tuple[int, int]:
        return sum(shown[pair] for pair in enumerate(properties)), shown[properties]

    chosen: list[GalleryItem] = []
    while left and len(chosen) < count:
        properties = min(left, key=turn)
        chosen.append(left[properties].popleft())
        shown.update([properties, *enumerate(properties)])
        if not left[properties]:
            del left[properties]
    return chosen
