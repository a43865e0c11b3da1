"""Why attempts were stopped: the cell's sentences on it, those alike counted together.

Reads `utils.round_records`; what stops the arm is for `envs.safety` and the loops to say.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

from utils.round_records import RoundRecord

_NUMBER = re.compile(r"-?\d+(\.\d+)?|\b(inf|nan)\b")


@dataclass(frozen=True)
class StopReason:
    """count: attempts that one policy ended so on a scenario and object set. reason: a key of
    `utils.round_records.FAILURES`. sentence: the first attempt's; the others differ in their
    numbers only. seed: of that attempt's scene. held: the object in the hand then, if any."""

    policy: str
    scenario: str
    objects: str
    reason: str
    count: int
    sentence: str
    seed: int
    held: str | None = None

    @property
    def place(self) -> str:
        """Where the first one was: 'scene 7' or 'scene 7, mug_0012 in the hand'."""
        return f"scene {self.seed}" + (f", {self.held} in the hand" if self.held else "")


def stop_reasons(rounds: Iterable[RoundRecord]) -> list[StopReason]:
    """Every failure on which there is a sentence, in the order of the rounds, the most frequent
    kinds of a cell first."""
    kinds: dict[tuple[str, str, str], dict[tuple[str, str], list[tuple[str, int, str | None]]]] = {}
    for record in rounds:
        cell = kinds.setdefault((record.policy, record.scenario, record.objects), {})
        for attempt in record.attempts:
            if attempt.detail and not attempt.success:
                kind = attempt.reason, _NUMBER.sub("#", attempt.detail)
                cell.setdefault(kind, []).append((attempt.detail, record.seed, attempt.held))
    return [
        StopReason(*where, reason, len(told), *told[0])
        for where, cell in kinds.items()
        for (reason, _), told in sorted(cell.items(), key=lambda item: -len(item[1]))
    ]


def print_stop_reasons(stops: Iterable[StopReason]) -> None:
    """One line each on stdout; nothing if there are none."""
    lines = [
        f"{stop.count:4d} x {stop.policy}, {stop.scenario}, {stop.objects}: {stop.sentence} "
        f"({stop.place})"
        for stop in stops
    ]
    if lines:
        print("\n".join(["\nwhat stopped the arm", *lines]))
