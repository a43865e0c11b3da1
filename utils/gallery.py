"""Pictures of grasps, and which of them are shown: successes, failures, of each policy some."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import imageio.v3 as iio

from utils.files import write_atomic
from utils.overlay import contact_sheet, draw_grasp
from utils.report import GalleryItem
from utils.round_records import SUCCESS
from utils.transforms import Grasp, RGBDFrame, grasp_to_image

MOST_FAILURES = 24  # on failures.png


def picture(frame: RGBDFrame, grasp: Grasp, policy: str, scenario: str, reason: str) -> GalleryItem:
    """The frame with the grasp drawn in, and how it went: "success" or why not."""
    on_image, success = grasp_to_image(grasp, frame.K, frame.T_WC), reason == SUCCESS
    image = draw_grasp(frame.rgb, on_image, frame.K, success=success)
    return GalleryItem(image, f"{policy}, {scenario}: {reason}", success, policy)


def write_failures(path: Path, pictures: list[GalleryItem]) -> None:
    """One picture of failed grasps, of each policy in turn; none if nothing failed."""
    failures = _in_turns([p for p in pictures if not p.success])[:MOST_FAILURES]
    if failures:
        sheet = contact_sheet([p.image for p in failures], [p.caption for p in failures])
        write_atomic(path, iio.imwrite("<bytes>", sheet, extension=".png"))


def balanced(pictures: list[GalleryItem], count: int) -> list[GalleryItem]:
    """`count` pictures, half of them failures where there are enough: those teach the most."""
    failures = _in_turns([p for p in pictures if not p.success])
    successes = _in_turns([p for p in pictures if p.success])
    take = min(len(failures), max(count // 2, count - len(successes)))
    return failures[:take] + successes[: count - take]


def _in_turns(pictures: list[GalleryItem]) -> list[GalleryItem]:
    """One of each policy, then another of each: the worst policy fails most and would fill all."""
    number_of: Counter[str] = Counter()
    turns = []
    for position, item in enumerate(pictures):
        turns.append((number_of[item.policy], position))
        number_of[item.policy] += 1
    return [pictures[position] for _, position in sorted(turns)]
